"""Cache folders for the code that libraries compile.

Each version of the sources has its own folder. A folder is found even where the package and the home folder cannot be written.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
import time
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

COMPILED = (
    "schema.py",
    "data/importers/tfrecord.py",
    "geometry/compiled_distance.py",
    "geometry/compiled_surfaces.py",
    "geometry/grid_distance.py",
    "graphs/cell_lists.py",
    "graphs/compiled_features.py",
    "graphs/elastic_cells_kernels.py",
    "graphs/features.py",
    "graphs/islands.py",
    "graphs/mesh_topology.py",
    "graphs/neighbors.py",
    "learned/next_states.py",
    "nn/*_kernels.py",
    "nn/edge_strength.py",
    "nn/friction_cone.py",
    "nn/fused*.py",
    "nn/matrix_product.py",
    "nn/network_program*.py",
    "nn/pointers.py",
    "nn/static_friction.py",
    "rollout/guard.py",
    "solvers/**/*.py",
    "training/parameter_passes.py",
    "trajectory/strain.py",
)
"""Source files of compiled functions, and of the types and constants in them."""
NAME = "gpe_pl-compiled-"
"""Prefix of the names of folders of compiled functions; a digest of ``COMPILED`` follows."""
SECONDS_UNUSED = 30 * 24 * 3600
"""Folders of compiled functions that were unused for this time [s] are removed."""


def prepare() -> None:
    """Choose cache folders for Numba, and for Matplotlib and Triton where their default folders cannot be written.

    Numba compiles a function again when its own file changes, but not when the change is in another file that defines a type, a constant or a function which
    it uses. Each version of ``COMPILED`` therefore has its own folder. It lies in the first of these places that is set or can be written:
    ``NUMBA_CACHE_DIR``, the package, the user's cache folder, the system's temporary folder. If there is none, each process compiles again.

    Matplotlib and Triton without a folder would warn and work again in each process. Environment variables that the user has set are kept. The choice affects
    only libraries that are imported afterwards.
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
    except OSError:  # Numba then looks for another place itself
        if not any(map(_is_writable, _usual_places())):
            _compile_without_cache()
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)  # read at its import


def _parent_of_compiled() -> Path | None:
    """Return the parent of the folders of compiled functions, or None if no place can be written."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        chosen = Path(given)
        return chosen.parent if chosen.name.startswith(NAME) else chosen  # set by the process that started this one
    if own := next(filter(_is_writable, _usual_places()), None):
        return own
    temporary = _own_folder()
    return None if temporary is None else temporary / "numba"


def _usual_places() -> tuple[Path, Path]:
    """Return the cache folders in the package and in the user's cache folder."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return PACKAGE / "__pycache__", home / "numba"


def _compile_without_cache() -> None:
    """Make each process compile in memory. Otherwise Numba refuses to compile a function with ``cache=True`` when it finds no place for the cache."""
    from numba.core.dispatcher import Dispatcher

    setattr(Dispatcher, "enable_caching", lambda _: None)  # noqa: B010


def _digest() -> str:
    """Return a digest of the names and contents of ``COMPILED``."""
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
    """Whether a folder can be written, or created. Unlike the file mode, ``os.access`` also detects disks that are read-only."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _set(variable: str, name: str) -> None:
    if variable not in os.environ and (folder := _own_folder()) is not None:
        os.environ[variable] = str(folder / name)


def _own_folder() -> Path | None:
    """Return a temporary folder that only this user can write, or None. Libraries run the code that they find there."""
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


def has_compiled(source: str) -> bool:
    """Tell whether the cache has compiled functions of a source file, given by its path in the package."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return folder is not None and any(Path(folder).glob(f"*/{Path(source).stem}.*.nbi"))
