"""Locks that let only one command at a time write to a folder.

The lock of ``FOLDER`` is the file ``.FOLDER.lock`` in the same parent folder. The operating system holds it and releases it however the process ends.
``.FOLDER.holder`` names the process that has the lock. On disks without such locks, the existence of the file is the lock. If a process has ended and left its
file there, the next command on the same machine removes it; on another machine, a message names the file to delete. Readers need no lock.
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
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.run_folder import watched

log = logging.getLogger(__name__)

LONGEST_NAME = 200
"""Longest folder name that names of locks contain [bytes], and longest command that a holder file contains [characters]."""
WITHOUT_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP}
"""Error numbers of disks without locks."""
RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Environment variables that number the processes of one run, as Lightning reads them."""

_locked: set[Path] = set()
"""Locks that this process holds."""


class FolderError(GpeError):
    """Raised when a folder cannot be created or written, is in use by another command, or was deleted; the message names it and says what to do."""


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock: its id (``pid``), machine (``host``), ``command`` and start time (``since``)."""

    pid: int
    host: str
    command: str
    since: str

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}: {self.command}"


@contextlib.contextmanager
def locked(folder: Path, key: str = "paths.runs", waits: bool = False, makes: bool = True, num_processes: int = 1) -> Iterator[None]:
    """Keep other commands from writing to a folder inside the block.

    A process that already holds the lock may take it again.

    Args:
        folder: folder of a run, a sweep or a data set.
        key: configuration key of the parent folder, for messages.
        waits: wait until the other command has ended instead of raising; a log line names that command.
        makes: create the folder, else only its parent folder. New folders that are still empty at the end of the block are removed.
        num_processes: number of processes of the run, which ``RANKS`` number. The first process holds the lock for all.

    Raises:
        FolderError: another command writes to the folder, the folder cannot be created, or it was deleted inside the block.
    """
    path = _beside(folder, "lock")
    if num_processes > 1 and is_later_process():
        yield
        return
    if path in _locked:
        with _same(folder):
            yield
        return
    made = _make(folder if makes else folder.parent, key)
    lock = _acquired(folder, path, waits)
    _locked.add(path)
    holder = _beside(folder, "holder")
    try:
        replace_text(holder, json.dumps(asdict(_this_process())))
        with _same(folder):
            yield
    finally:
        _locked.discard(path)
        with contextlib.suppress(OSError):
            holder.unlink(missing_ok=True)
        if not isinstance(lock, SoftFileLock):
            with contextlib.suppress(OSError):  # Windows does not remove open files
                path.unlink(missing_ok=True)  # before the release: a process that has opened it sees that it is gone, and tries again
        lock.release()
        for each in made:
            with contextlib.suppress(OSError):  # fails unless the folder is still empty
                each.rmdir()


def _acquired(folder: Path, path: Path, waits: bool) -> BaseFileLock:
    def take(lock: BaseFileLock) -> None:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not waits:
                advice = f"; if that process is gone, delete {path}" if isinstance(lock, SoftFileLock) else ""
                raise FolderError(f"{folder}: another command writes to it ({_holder(folder)}); wait until it has ended{advice}") from None
            log.warning("%s: waiting until another command has written it (%s)", folder, _holder(folder))
            lock.acquire(poll_interval=0.2)

    return _taken(path, take)


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Wait until no other process is in a block with this lock file.

    Raises:
        FolderError: the lock file cannot be written.
    """
    lock = _taken(path, lambda lock: lock.acquire(poll_interval=0.2))
    try:
        yield
    finally:
        lock.release()


def _taken(path: Path, take: Callable[[BaseFileLock], object]) -> BaseFileLock:
    """Return a lock that ``take`` has acquired: a lock of the disk, or a lock file where the disk has no locks."""
    for kind in (FileLock, SoftFileLock):
        lock: BaseFileLock = kind(path, thread_local=False)
        was_there = path.exists()
        try:
            take(lock)
            return lock
        except OSError as error:
            if isinstance(error, Timeout) or error.errno not in WITHOUT_LOCKS:
                raise FolderError(f"{path}: cannot be locked ({error.strerror or error}); choose a folder that can be written") from None
            # the first kind makes the file before it finds that there are no locks; the second kind would take it for that of another process
            if not was_there and path.exists() and not path.stat().st_size:
                path.unlink(missing_ok=True)
    raise FolderError(f"{path}: the disk has no locks; choose a folder on another disk")


def _beside(folder: Path, suffix: str) -> Path:
    place = folder.resolve()
    name = place.name
    if len(name.encode()) > LONGEST_NAME:  # names of a sweep's runs can be longer
        name = hashlib.sha256(name.encode()).hexdigest()
    return place.with_name(f".{name}.{suffix}")


def _make(folder: Path, key: str) -> list[Path]:
    """Create a folder and return the folders that were missing, the innermost first."""
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
    """Raise ``FolderError`` if a folder that exists at the start of the block has been deleted or replaced at its end."""
    lost = f"{folder}: was deleted or replaced while this command wrote to it; run the command again"
    existed = folder.exists()
    with watched(folder) as is_same:
        try:
            yield
            if existed and not is_same():
                raise FolderError(lost)
        except OSError as error:
            is_missing = isinstance(error, FileNotFoundError | NotADirectoryError) or error.errno == getattr(errno, "ESTALE", errno.ENOENT)
            if is_missing and not is_same():  # after another error, the command itself removes its unfinished folder
                raise FolderError(lost) from error
            raise


def is_later_process() -> bool:
    """Whether this process is not the first of its run, according to ``RANKS``."""
    return next((os.environ[key] for key in RANKS if key in os.environ), "0") != "0"


def _this_process() -> Holder:
    module = getattr(sys.modules.get("__main__"), "__spec__", None)
    command = f"python -m {module.name}" if module is not None else Path(sys.argv[0] or "python").name
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    return Holder(os.getpid(), platform.node(), " ".join([command, *sys.argv[1:]])[:LONGEST_NAME], since)


def _holder(folder: Path) -> str:
    """Describe the holder of a folder's lock, if its file exists already. The lock is taken before the file is written."""
    try:
        values: Any = json.loads(_beside(folder, "holder").read_bytes()[:10_000])
        return str(Holder(int(values["pid"]), str(values["host"]), str(values["command"]), str(values["since"])))
    except (OSError, ArithmeticError, ValueError, KeyError, TypeError, RecursionError):
        return "which has just begun"
