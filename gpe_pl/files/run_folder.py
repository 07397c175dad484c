"""Run folders. Each belongs to one configuration, which is stored in it as ``config.json``."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gpe_pl.errors import GpeError
from gpe_pl.files import sealed

CONFIG = "config.json"
DATA_CHECKSUMS = "data_sha256"
"""Configuration key with the checksums of the splits that a run used, because data of the same name may be replaced."""
HYDRA = ".hydra"
"""Subfolder of a run folder that Hydra writes. Hydra follows links in it."""
LOGS = "log"
"""Subfolder of a run folder with the logs of a training."""
TENSORBOARD = "tensorboard"
"""Subfolder of a run folder with event files of TensorBoard. A resumed run continues there."""
RUN_ID = "run_id"
"""File in a run folder with the identifier of the run in W&B. A resumed run continues under it."""
LOGGED = (LOGS, TENSORBOARD, RUN_ID)
"""What a training writes before it has results."""
LOOKUPS = ("comparison", "larger", "base_name")
"""Keys of ``data`` and ``size`` from which other configuration keys take their values, and which are not stored."""


class RunError(GpeError, RuntimeError):
    """Raised when a run folder cannot be used; the message says why and what to do."""


def claim(run_dir: Path, config: dict[str, Any], results: Sequence[str] = ("checkpoints/last.ckpt", "metrics.csv")) -> None:
    """Assign a folder to a run with this configuration and write the configuration into it.

    Args:
        run_dir: folder of the run; created if it is missing.
        config: configuration of the run.
        results: file patterns. A folder without any such file is free, whatever its configuration. What another configuration logged is then removed
            (``LOGGED``), and so is the identifier under which trackers would continue its run.

    Raises:
        RunError: the folder has results, but its configuration is another one (the message names up to three differing keys), missing or damaged; or the
            folder contains a link that leads out of it (``refuse_links``).
    """
    config = without_tables(config)
    refuse_links(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    path = run_dir / CONFIG
    if any(found.name != CONFIG for pattern in results for found in run_dir.glob(pattern)):
        different = sorted(differences(config_in(path), config)) if path.exists() else [f"its {CONFIG} is missing"]
        if different:
            raise RunError(
                f"{run_dir} holds a run with another configuration ({'; '.join(different[:3])}); choose another name=… or delete the folder"
            )
        return
    if not _has(path, config):
        for name in LOGGED:  # tables and trackers would show the earlier run's curve as this run's
            shutil.rmtree(run_dir / name, ignore_errors=True) if (run_dir / name).is_dir() else (run_dir / name).unlink(missing_ok=True)
    sealed.write(path, config)


def _has(path: Path, config: dict[str, Any]) -> bool:
    """Tell whether a file has a configuration."""
    try:
        return not any(differences(config_in(path), config))
    except (RunError, OSError):
        return False


def refuse_links(run_dir: Path) -> None:
    """Check that no link in the folder of a run or data set leads out of it. Commands would write through such a link, and the folder may come from others.

    Only the entries of the folder itself and of its ``.hydra`` are checked.

    Raises:
        RunError: a link leads out of the folder; the message names it.
    """
    inside = run_dir.resolve()
    for path in sorted(path for folder in (run_dir, run_dir / HYDRA) if folder.is_dir() for path in folder.iterdir()):
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            raise RunError(f"{path}: a link that leads out of its folder; remove it, or make the folder itself a link")


@contextlib.contextmanager
def without_orphans(folder: Path, description: str = CONFIG) -> Iterator[None]:
    """At the end of the block, remove a folder that was created inside the block and has no description.

    Such a folder appears when somebody deletes the folder of a running command and the command then writes another file. No command could continue from it.

    Args:
        folder: folder of a run or a data set.
        description: name of the file that describes the content of the folder.
    """
    with watched(folder) as is_same:
        try:
            yield
        finally:
            if not is_same() and not (folder / description).exists():
                shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether a folder is still the same as at the beginning: neither deleted nor replaced."""
    before, handle = _identity(folder), None
    if before is not None:
        with contextlib.suppress(OSError):  # Windows cannot open folders
            handle = os.open(folder, os.O_RDONLY)  # keeps the system from giving the folder's number to another folder
    try:
        yield lambda: _identity(folder) == before
    finally:
        if handle is not None:
            os.close(handle)


def _identity(folder: Path) -> tuple[int, int] | None:
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def release(run_dir: Path) -> None:
    """Delete a claimed folder if it contains nothing but its configuration."""
    if [path.name for path in run_dir.iterdir()] == [CONFIG]:
        (run_dir / CONFIG).unlink()
        run_dir.rmdir()


def without_tables(values: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration without the lookup tables (``LOOKUPS``) of ``data`` and ``size``.

    The values taken from these tables are kept under graph, model, training and the evaluated scene. The time budget of a comparison stays, because it
    decides the number of steps.
    """
    kept = {
        name: {key: value for key, value in part.items() if key not in LOOKUPS}
        for name in ("data", "size")
        if isinstance(part := values.get(name), dict)
    }
    size = values.get("size")
    budget = size.get("comparison", {}).get("budget_minutes") if isinstance(size, dict) else None
    return values | kept | ({} if budget is None else {"size": kept["size"] | {"comparison": {"budget_minutes": budget}}})


def config_in(path: Path) -> dict[str, Any]:
    """Read the configuration that a run has stored.

    Raises:
        RunError: the file is damaged, or was changed after the run wrote it.
        OSError: the file cannot be read.
    """
    try:
        return sealed.read(path, f"the run was made with other settings; delete the folder {path.parent} or choose another name=…")
    except sealed.SealError as error:
        raise RunError(str(error)) from None


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """List the keys in which two configurations differ, each with both values."""
    if isinstance(a, dict) and isinstance(b, dict):
        return [d for k in sorted({*a, *b}) for d in differences(a.get(k), b.get(k), f"{path}.{k}" if path else k)]
    return [] if a == b else [f"{path}: {a!r} there, {b!r} now"]
