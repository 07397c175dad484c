"""Folders of runs: each belongs to one configuration, which is written into it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gpe_pl.errors import GpeError
from gpe_pl.files import sealed

CONFIG = "config.json"
DATA_CHECKSUMS = "data_sha256"
"""Key of a configuration: the checksums of the splits that were used. Data of one name may be replaced."""
HYDRA = ".hydra"
"""Folder in that of a run, in which Hydra writes through links."""
OFFERED = ("comparison", "larger")
"""Tables of ``data`` and ``size`` that other keys are taken from."""


class RunError(GpeError, RuntimeError):
    """A run folder cannot be used; the message says why and what to do."""


def claim(run_dir: Path, config: dict[str, Any], results: Sequence[str] = ("checkpoints/last.ckpt", "metrics.csv")) -> None:
    """Take a folder for a run with this configuration; one without ``results`` (patterns) is free.

    Raises:
        RunError: the folder holds a run with another configuration, or a link that leads out of it; names the first differing key, or the link.
    """
    config = without_tables(config)
    refuse_links(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    path = run_dir / CONFIG
    if any(found.name != CONFIG for pattern in results for found in run_dir.glob(pattern)):
        different = sorted(differences(config_in(path), config)) if path.exists() else [f"of which there is no {CONFIG}"]
        if different:
            raise RunError(
                f"{run_dir} holds a run with another configuration ({'; '.join(different[:3])}); choose another name=… or delete the folder"
            )
        return
    sealed.write(path, config)


def refuse_links(run_dir: Path) -> None:
    """Raise ``RunError`` where the folder of a run or data set, which may be someone else's, has a link through which a command would write outside of it."""
    inside = run_dir.resolve()
    for path in sorted(path for folder in (run_dir, run_dir / HYDRA) if folder.is_dir() for path in folder.iterdir()):
        if path.is_symlink() and not path.resolve().is_relative_to(inside):
            raise RunError(f"{path}: a link that leads out of its folder; remove it, or make the folder itself a link")


def release(run_dir: Path) -> None:
    """Give a claimed folder back if nothing was written to it."""
    if [path.name for path in run_dir.iterdir()] == [CONFIG]:
        (run_dir / CONFIG).unlink()
        run_dir.rmdir()


def without_tables(values: dict[str, Any]) -> dict[str, Any]:
    """A configuration without what data and sizes offer to comparisons and evaluations; graph, model, training and the evaluated scene say what was taken.

    The budget of a comparison stays: it decides the number of steps.
    """
    kept = {
        name: {key: value for key, value in part.items() if key not in OFFERED}
        for name in ("data", "size")
        if isinstance(part := values.get(name), dict)
    }
    size = values.get("size")
    budget = size.get("comparison", {}).get("budget_minutes") if isinstance(size, dict) else None
    return values | kept | ({} if budget is None else {"size": kept["size"] | {"comparison": {"budget_minutes": budget}}})


def config_in(path: Path) -> dict[str, Any]:
    """The configuration that a run has left in a file; raises ``RunError`` if that is damaged, or was changed since."""
    try:
        return sealed.read(path, f"the run was made with other settings; delete the folder {path.parent} or choose another name=…")
    except sealed.SealError as error:
        raise RunError(str(error)) from None


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """Where two configurations differ: each key with both values."""
    if isinstance(a, dict) and isinstance(b, dict):
        return [d for k in sorted({*a, *b}) for d in differences(a.get(k), b.get(k), f"{path}.{k}" if path else k)]
    return [] if a == b else [f"{path}: {a!r} there, {b!r} now"]
