"""Where libraries keep what they compile: apart for each version of the sources, and also where package and home cannot be written."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
import time
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

COMPILED = ("schema.py", "graphs/islands.py", "geometry/grid_distance.py", "data/importers/tfrecord.py", "nn/fused*.py", "solvers/**/*.py")
"""Sources of compiled functions, and of the types and constants in them."""
NAME = "gpe_pl-compiled-"
"""Begins the names of folders of compiled functions; a digest of ``COMPILED`` follows."""
SECONDS_UNUSED = 30 * 24 * 3600
"""After so long, compiled functions of other sources are removed."""


def prepare() -> None:
    """Choose folders for what Numba compiles, and for Matplotlib and Triton where those that they would take cannot be written.

    Numba compiles a function again when its own file has changed, but not when another file has that defines a type, a constant or a function in it. So each
    version of ``COMPILED`` has a folder of its own: in ``NUMBA_CACHE_DIR`` if that is set, else in the package, else in the user's folder for caches, else in
    one below the system's temporary folder. Where none can be written, each process compiles anew. Matplotlib and Triton warn where they have no folder, and
    work anew in each process; what the user has set stays.
    Takes effect on what is imported afterwards.
    """
    _prepare_numba()
    if not _is_writable(Path("~/.config/matplotlib").expanduser()):
        _set("MPLCONFIGDIR", "matplotlib")
    if not _is_writable(Path("~/.triton").expanduser()):
        _set("TRITON_CACHE_DIR", "triton")


def _prepare_numba() -> None:
    parent = _parent_of_compiled()
    if parent is None:
        _compile_without_cache()
        return
    folder = parent / (NAME + _digest())
    try:
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        if is_new:
            _remove_unused(parent)
    except OSError:  # Numba looks for another place itself
        if not any(map(_is_writable, _usual_places())):
            _compile_without_cache()
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)  # read at its import


def _parent_of_compiled() -> Path | None:
    """Where folders of compiled functions lie."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        chosen = Path(given)
        return chosen.parent if chosen.name.startswith(NAME) else chosen  # that of the process that started this one
    if own := next(filter(_is_writable, _usual_places()), None):
        return own
    temporary = _own_folder()
    return None if temporary is None else temporary / "numba"


def _usual_places() -> tuple[Path, Path]:
    """Folders in the package and in the user's folder for caches."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return PACKAGE / "__pycache__", home / "numba"


def _compile_without_cache() -> None:
    """Numba refuses to compile a function that wants a cache where it finds no place for one: each process compiles anew, in its memory."""
    from numba.core.dispatcher import Dispatcher

    setattr(Dispatcher, "enable_caching", lambda _: None)  # noqa: B010


def _digest() -> str:
    """Of the names and contents of ``COMPILED``."""
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(path for pattern in COMPILED for path in PACKAGE.glob(pattern)):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()}\n".encode())
        digest.update(hashlib.blake2b(path.read_bytes()).digest())
    return digest.hexdigest()


def _remove_unused(parent: Path) -> None:
    for folder in parent.glob(f"{NAME}*"):
        if folder.stat().st_mtime < time.time() - SECONDS_UNUSED:
            shutil.rmtree(folder, ignore_errors=True)


def _is_writable(folder: Path) -> bool:
    """Whether a folder can be written, or made; ``access`` also knows of disks that are read-only."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _set(variable: str, name: str) -> None:
    if variable not in os.environ and (folder := _own_folder()) is not None:
        os.environ[variable] = str(folder / name)


def _own_folder() -> Path | None:
    """A folder that only this user can write: what libraries find there they run."""
    import tempfile

    try:
        user = os.getuid() if hasattr(os, "getuid") else 0
        folder = Path(tempfile.gettempdir()) / f"gpe_pl-{user}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        is_own = stat.S_ISDIR(found.st_mode) and (os.name == "nt" or (found.st_uid == user and not found.st_mode & 0o077))
        return folder if is_own else Path(tempfile.mkdtemp(prefix="gpe_pl-"))
    except OSError:
        return None
