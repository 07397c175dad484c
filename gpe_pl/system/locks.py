"""Folders that one command at a time writes to.

The lock of ``FOLDER`` is ``.FOLDER.lock`` beside it, and belongs to the operating system, which releases it however its process ends. ``.FOLDER.holder``
says who has it. Where a disk has no such locks, the existence of the file is the lock: one of a process that has ended is removed on the same machine, and
on another one the message says which file to delete. Whoever only reads needs no lock.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_text

log = logging.getLogger(__name__)

LONGEST_NAME = 200
WITHOUT_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP}
"""What disks answer that have no locks."""
RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Environment variables that number the processes of one run, as Lightning reads them."""

_held: set[Path] = set()
"""Locks of this process."""


class FolderError(GpeError):
    """A folder cannot be made or written, another command writes to it, or it was deleted meanwhile; the message names the folder and what to do."""


@dataclass(frozen=True)
class Holder:
    """Who holds a lock."""

    pid: int
    host: str
    command: str
    since: str

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}: {self.command}"


@contextlib.contextmanager
def held(folder: Path, key: str = "paths.runs", waits: bool = False, makes: bool = True, num_processes: int = 1) -> Iterator[None]:
    """Inside, no other command writes to the folder.

    A process that holds a folder may do so again.

    Args:
        folder: of a run, a sweep or a data set.
        key: where its parent is configured, for messages.
        waits: until the other command has ended, rather than refuse; a log line says for whom.
        makes: the folder.
        num_processes: of the run. Of several, which ``RANKS`` number, the first holds the folder for all.

    Raises:
        FolderError: another command writes to the folder, the folder cannot be made, or it was deleted inside.
    """
    path = _beside(folder, "lock")
    if num_processes > 1 and is_later_process():
        yield
        return
    if path in _held:
        with _same(folder):
            yield
        return
    made = _make(folder if makes else folder.parent, key)
    lock = _acquired(folder, path, waits)
    _held.add(path)
    holder = _beside(folder, "holder")
    try:
        replace_text(holder, json.dumps(asdict(_this_process())))
        with _same(folder):
            yield
    finally:
        _held.discard(path)
        with contextlib.suppress(OSError):
            holder.unlink(missing_ok=True)
        if not isinstance(lock, SoftFileLock):
            with contextlib.suppress(OSError):  # Windows does not remove what is open
                path.unlink(missing_ok=True)  # before the release: who has opened it meanwhile sees that it is gone, and tries again
        lock.release()
        for each in made:
            with contextlib.suppress(OSError):  # nothing was written to it
                each.rmdir()


def _acquired(folder: Path, path: Path, waits: bool) -> BaseFileLock:
    for kind in (FileLock, SoftFileLock):
        lock: BaseFileLock = kind(path, thread_local=False)
        try:
            try:
                lock.acquire(timeout=0)
            except Timeout:
                if not waits:
                    advice = f"; if that process is gone, delete {path}" if isinstance(lock, SoftFileLock) else ""
                    raise FolderError(
                        f"{folder}: another command writes to it ({_holder(folder)}); wait until it has ended{advice}"
                    ) from None
                log.warning("%s: waiting until another command has written it (%s)", folder, _holder(folder))
                lock.acquire(poll_interval=0.2)
            return lock
        except OSError as error:
            if isinstance(error, Timeout) or error.errno not in WITHOUT_LOCKS:
                raise FolderError(f"{path}: cannot be locked ({error.strerror or error}); choose a folder that can be written") from None
    raise FolderError(f"{path}: the disk has no locks; choose a folder on another")


def _beside(folder: Path, suffix: str) -> Path:
    place = folder.resolve()
    name = place.name
    if len(name.encode()) > LONGEST_NAME:  # of a run in a sweep
        name = hashlib.sha256(name.encode()).hexdigest()
    return place.with_name(f".{name}.{suffix}")


def _make(folder: Path, key: str) -> list[Path]:
    """Make a folder; returns what had to be made, the innermost first."""
    missing: list[Path] = []
    try:
        for each in (folder, *folder.parents):
            if each.exists():
                break
            missing.append(each)
        folder.mkdir(parents=True, exist_ok=True)
        return missing
    except OSError as error:
        for each in missing:
            with contextlib.suppress(OSError):
                each.rmdir()
        raise FolderError(f"{folder}: cannot be made ({error.strerror}); choose another folder with {key}=…") from None


@contextlib.contextmanager
def _same(folder: Path) -> Iterator[None]:
    """Raises ``FolderError`` where a folder that is there at the start is not at the end, or another one is."""
    before = _identity(folder)
    handle = None
    if before is not None:
        with contextlib.suppress(OSError):  # Windows opens no folders
            handle = os.open(folder, os.O_RDONLY)  # keeps its number from being given to another one
    lost = f"{folder}: was deleted or replaced while this command wrote to it; run the command again"
    try:
        yield
        if before is not None and _identity(folder) != before:
            raise FolderError(lost)
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError) or error.errno == getattr(errno, "ESTALE", errno.ENOENT)
        if is_missing and _identity(folder) != before:  # with another error, the command itself has removed what it had begun
            raise FolderError(lost) from error
        raise
    finally:
        if handle is not None:
            os.close(handle)


def _identity(folder: Path) -> tuple[int, int] | None:
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def is_later_process() -> bool:
    """Whether ``RANKS`` number this process, and not as the first."""
    return next((os.environ[key] for key in RANKS if key in os.environ), "0") != "0"


def _this_process() -> Holder:
    module = getattr(sys.modules.get("__main__"), "__spec__", None)
    command = f"python -m {module.name}" if module is not None else Path(sys.argv[0] or "python").name
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    return Holder(os.getpid(), platform.node(), " ".join([command, *sys.argv[1:]])[:LONGEST_NAME], since)


def _holder(folder: Path) -> str:
    """Who holds the lock of a folder, as far as it is known: the lock comes before the note."""
    try:
        values: Any = json.loads(_beside(folder, "holder").read_bytes()[:10_000])
        return str(Holder(int(values["pid"]), str(values["host"]), str(values["command"]), str(values["since"])))
    except (OSError, ArithmeticError, ValueError, KeyError, TypeError, RecursionError):
        return "which has just begun"
