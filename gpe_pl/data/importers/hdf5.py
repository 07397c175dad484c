"""Reading of arrays from untrusted HDF5 files. Arrays are checked before they are read, and no other file is opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from gpe_pl.data.importers.source import MAX_TRAJECTORIES, ImportFailure, Refusal, natural
from gpe_pl.errors import GpeError
from gpe_pl.files.hdf5_arrays import dataset_in, is_named, is_own, obstacle


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading.

    Raises:
        ImportFailure: the file does not exist.
        Refusal: the file is damaged. This replaces the various errors that HDF5 raises while the file is open.
    """
    if not path.is_file():
        raise ImportFailure(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except GpeError:
        raise
    except (
        OSError,
        RuntimeError,
        LookupError,
        ValueError,
        TypeError,
        MemoryError,
        AttributeError,
    ) as error:  # h5py raises all of these on damaged files
        raise Refusal(f"{path.name}: not a readable HDF5 file (damaged or truncated: {error})") from None


def groups(path: Path) -> list[str]:
    """Return the names of a file's groups, in order of their numbers.

    Raises:
        ImportFailure: the file cannot be read, or has no groups or too many.
    """
    try:
        with opened(path) as file:
            if len(file) > MAX_TRAJECTORIES:
                raise ImportFailure(f"{path}: holds {len(file)} groups, at most {MAX_TRAJECTORIES} are read")
            names = [name for name in sorted(file, key=natural) if is_own(file, name) and isinstance(file[name], h5py.Group)]
    except Refusal as refusal:
        raise ImportFailure(f"{path}: {refusal}") from None
    if not names:
        raise ImportFailure(f"{path}: holds no groups; each trajectory should be a group")
    return names


def array(group: h5py.Group, name: str, axes: str, kinds: str = "fiu") -> np.ndarray:
    """Read an array.

    Args:
        group: file or group.
        name: name of the array in the group.
        axes: names of the axes, separated by commas. The array must have this number of axes.
        kinds: letters of the allowed types, as in ``numpy.dtype.kind``.

    Raises:
        Refusal: the array is missing, damaged, of another type or shape, larger than its file, or needs far more memory or time to read than its size.
    """
    if not is_named(group, name):
        raise Refusal(f"has no {name!r}; there are {', '.join(map(repr, sorted(group)[:10])) or 'no arrays'}")
    dataset = dataset_in(group, name)
    if dataset is None:
        raise Refusal(f"{name!r} is not an array inside this file")
    count = len(axes.split(", "))
    if dataset.shape is None or dataset.dtype.kind not in kinds or len(dataset.shape) != count:
        raise Refusal(
            f"{name!r} is {dataset.dtype}{list(dataset.shape or ())}, expected {'integers' if 'f' not in kinds else 'numbers'} [{axes}]"
        )
    if (reason := obstacle(dataset)) is not None:
        raise Refusal(f"{name!r} {reason}")
    try:
        return np.asarray(dataset[()])
    except (OSError, RuntimeError, MemoryError) as error:
        raise Refusal(f"{name!r} is damaged ({error})") from None
