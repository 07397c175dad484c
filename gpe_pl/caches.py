"""Where libraries keep what they compile and look up, on systems on which neither the package nor the home can be written."""

from __future__ import annotations

import os
import stat
from pathlib import Path

PACKAGE = Path(__file__).parent


def prepare() -> None:
    """Give libraries a folder of the user below the system's temporary one, where those that they would take cannot be written.

    Numba fails without a folder; Matplotlib and Triton warn, and work anew in each process. What the user has set stays. Takes effect on what is imported
    afterwards.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if not (_is_writable(PACKAGE) or _is_writable(home / "numba")):
        _set("NUMBA_CACHE_DIR", "numba")
    if not _is_writable(Path("~/.config/matplotlib").expanduser()):
        _set("MPLCONFIGDIR", "matplotlib")
    if not _is_writable(Path("~/.triton").expanduser()):
        _set("TRITON_CACHE_DIR", "triton")


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
