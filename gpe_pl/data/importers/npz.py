"""Reading of arrays from untrusted ``.npz`` archives. Headers are checked before anything is read, and pickles are refused by default."""

from __future__ import annotations

import math
import pickle
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from gpe_pl.data.importers.source import MAX_TRAJECTORIES, ImportFailure, Refusal
from gpe_pl.files import regular_files
from gpe_pl.files.hdf5_arrays import LARGEST_DEFLATE_RATIO, most_unpacked
from gpe_pl.files.zip_members import num_members

HEADERS: dict[tuple[int, int], Any] = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}

DAMAGE = (
    *(OSError, EOFError, KeyError, ValueError, TypeError, ArithmeticError, SyntaxError),  # the last two from the text of a header
    *(MemoryError, RuntimeError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
    *(pickle.UnpicklingError, AttributeError, ImportError),
)
"""Errors that reading a damaged archive or a pickle can raise."""


class ObjectsRefused(ImportFailure):
    """Raised for an array of Python objects if ``allow_pickle`` is false.

    Attributes:
        fault: what is wrong, without the path and the remedy.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.fault = f"{name!r} is an array of Python objects, a pickle, which can run any code when it is read"
        super().__init__(f"{path}: {self.fault}. If you trust whoever wrote it, pass allow_pickle=true")


def names(path: Path) -> list[str]:
    """Return the names of the arrays in an archive, in its order.

    Raises:
        ImportFailure: the archive cannot be read, or has too many arrays.
    """
    try:
        regular_files.check(path)
        if (count := num_members(path)) > MAX_TRAJECTORIES:
            raise ImportFailure(f"{path}: holds {count} arrays, at most {MAX_TRAJECTORIES} are read")
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except DAMAGE as error:
        if isinstance(error, ImportFailure):
            raise
        raise ImportFailure(f"{path}: not a readable .npz archive ({error})") from None


def read(path: Path, name: str, allow_pickle: bool = False, most_values: int | None = None) -> np.ndarray:
    """Read an array.

    Args:
        path: archive.
        name: name of the array.
        allow_pickle: read arrays of Python objects, which can run any code.
        most_values: maximum number of values, or None.

    Raises:
        Refusal: the array is damaged, larger than the archive, unpacks to far more than is stored, or has more than ``most_values`` values.
        ObjectsRefused: the array has Python objects, and ``allow_pickle`` is false.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(f"{name}.npy")
            if member.file_size > max(member.compress_size, 1) * LARGEST_DEFLATE_RATIO:
                raise Refusal(f"{name!r} claims {member.file_size} bytes, the archive holds {member.compress_size}")
            if member.compress_type != zipfile.ZIP_STORED and member.file_size > (most := most_unpacked(member.compress_size)):
                raise Refusal(
                    f"{name!r} unpacks to {member.file_size} bytes from {member.compress_size}, at most {most} are read; write it with numpy.savez"
                )
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise Refusal(f"{name!r} is compressed in another way than NumPy does; write it with numpy.savez_compressed")
            with archive.open(member) as file:
                version = npy.read_magic(file)
                if version not in HEADERS:
                    raise Refusal(f"{name!r} has version {version} of the .npy format, expected one of {', '.join(map(str, HEADERS))}")
                shape, dtype = _header(file, version, name)
                if dtype.hasobject and not allow_pickle:
                    raise ObjectsRefused(path, name)
                if most_values is not None and math.prod(shape) > most_values:
                    raise Refusal(f"{name}: has shape {list(shape)}, at most {most_values} values are expected")
                left = member.file_size - file.tell()
                if not dtype.hasobject and math.prod(shape) * dtype.itemsize != left:
                    raise Refusal(
                        f"{name!r} claims {dtype}{list(shape)}, {math.prod(shape) * dtype.itemsize} bytes; the archive has {left}"
                    )
            with archive.open(member) as file:
                return npy.read_array(file, allow_pickle=allow_pickle)
    except DAMAGE as error:
        if isinstance(error, (Refusal, ImportFailure)):
            raise
        raise Refusal(f"{name!r} is damaged ({error})") from None


def _header(file: Any, version: tuple[int, int], name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read shape and type of an array. NumPy parses headers as Python text, so damaged headers can raise any error."""
    try:
        shape, _, dtype = HEADERS[version](file)
    except Exception as error:
        raise Refusal(f"{name!r} is damaged (header: {type(error).__name__}: {str(error)[:100]})") from None
    if any(type(n) is not int or n < 0 for n in shape):
        raise Refusal(f"{name!r} is damaged (header: its shape is {str(shape)[:100]})")
    return shape, dtype
