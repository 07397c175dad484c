"""Atomic writes: a file appears complete or not at all."""

from __future__ import annotations

import errno
import glob
import hashlib
import os
import platform
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from gpe_pl.errors import GpeError

FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Error numbers for missing room: the disk is full, the file is too large, or the user's quota is used up."""

ALMOST_FULL = 2**20
"""A disk with fewer free bytes counts as full. A command that fails has often removed its unfinished file already, which frees some bytes."""


LONGEST_STEM = 204
"""Longest name of a file, without its suffix, that names of temporary files contain [bytes]."""


class FullDiskError(GpeError):
    """Raised when the disk is full; the message names the file or folder that was written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: cannot be written, there is no room ({reason}); make some, and run the command again")
        self.path, self.reason = path, reason


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``, with the same suffix, that replaces ``path`` when the block succeeds.

    The temporary file or folder is removed when the block fails. A missing folder is created. Leftovers of killed processes of this machine are removed.
    Its name has a part drawn at random, because other containers can have the host name and the process ids of this one.

    Raises:
        FullDiskError: there is no room.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    start, end = f".{_shortened(path.stem)}.{machine_name()}.", f".part{path.suffix}"
    for leftover in path.parent.glob(f"{glob.escape(start)}*{glob.escape(end)}"):
        if not _is_running(leftover.name.removeprefix(start).removesuffix(end).partition("-")[0]):
            _remove(leftover)
    part = path.with_name(f"{start}{os.getpid()}-{secrets.token_hex(4)}{end}")
    try:
        yield part
        _flush(part)
        os.replace(part, path)
    except FullDiskError as error:  # ``part`` is a folder, and a file in it did not fit
        raise FullDiskError(path, error.reason) from None
    except OSError as error:
        if error.errno is None or error.errno not in FULL:
            raise
        raise FullDiskError(path, os.strerror(error.errno)) from None
    finally:
        _remove(part)


def unnamed(error: OSError, folders: Iterable[Path]) -> OSError | FullDiskError:
    """Return a ``FullDiskError`` for an error that says the disk is full (``FULL``) and names no file. Return any other error unchanged.

    The message names those of ``folders`` whose disks are full, or all of them if none is.
    """
    if error.errno is None or error.errno not in FULL or error.filename is not None:
        return error
    places = list(dict.fromkeys(folders))
    full = [place for place in places if free_bytes(place) < ALMOST_FULL] or places
    return FullDiskError(Path(" or ".join(map(str, full))), os.strerror(error.errno))


def free_bytes(folder: Path) -> int:
    """Return the number of free bytes on the disk of a folder. The folder need not exist yet."""
    return shutil.disk_usage(next(place for place in (folder, *folder.absolute().parents) if place.exists())).free


def replace_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def replace_bytes(path: Path, content: bytes | bytearray | memoryview) -> None:
    """Write a binary file atomically."""
    with replacing(path) as part:
        part.write_bytes(content)


def machine_name() -> str:
    """Return a short name of the machine and, on Linux, of the container, whose process ids mean nothing outside it."""
    try:
        container = os.readlink("/proc/self/ns/pid")
    except OSError:
        container = ""
    return hashlib.sha256(f"{platform.node()} {container}".encode()).hexdigest()[:8]


def _shortened(stem: str) -> str:
    """Return a name to which some forty bytes can be added; file systems allow 255."""
    return stem if len(stem.encode()) <= LONGEST_STEM else hashlib.sha256(stem.encode()).hexdigest()


def _is_running(pid: str) -> bool:
    """Whether a process with this id runs on this machine; True for text that is no id."""
    return not pid.isdigit() or psutil.pid_exists(int(pid))


def _flush(path: Path) -> None:
    """Flush a file to the disk, so that a power cut does not leave an empty file under the final name."""
    if path.is_file():
        with open(path, "rb+") as file:  # Windows flushes only files that are open for writing
            os.fsync(file.fileno())


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
