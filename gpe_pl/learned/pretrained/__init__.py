"""Shipped models: trained simulators ``{name}.ckpt`` with their model cards ``{name}.md``."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from gpe_pl.files.names import portable

FOLDER = Path(__file__).parent
SUFFIX = ".ckpt"
BEST = Path("checkpoints") / f"best{SUFFIX}"
"""Path of the best checkpoint in the folder of a run."""


def names() -> list[str]:
    """Return the names of the shipped models. Where a checkpoint's path is expected, you can give such a name."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def checkpoint_path(checkpoint: Path | str) -> Path:
    """Return the path of a checkpoint, given by its path, the name of a shipped model, or the folder of a run, whose best checkpoint is taken."""
    if str(checkpoint) in names():
        return FOLDER / f"{checkpoint}{SUFFIX}"
    path = Path(checkpoint)
    return path / BEST if path.is_dir() else path


def fingerprint(checkpoint: Path | str) -> str:
    """Return a text that identifies a checkpoint in configurations, wherever it lies: the file's name and the beginning of its checksum."""
    path = checkpoint_path(checkpoint)
    return f"{path.name} (sha256 {sha256(path.read_bytes()).hexdigest()[:12]})"


def model_name(checkpoint: Path | str | Sequence[Any] | None, runs: Path | str) -> str:
    """Return the name of a model for use in folder names: that of a shipped model, or the path of its run below ``runs`` with ``_`` for ``/``.

    An ensemble has the name of its first member and the number of members.
    If the checkpoint is not the best one of its run, its file's name is appended. For a checkpoint outside a folder ``checkpoints/``, the result is the file's
    name. Characters that file names cannot have are encoded by ``names.portable``.
    """
    if isinstance(checkpoint, Sequence) and not isinstance(checkpoint, str):
        first = model_name(checkpoint[0] if checkpoint else None, runs)
        return first if len(checkpoint) == 1 else f"{first}_ensemble_of_{len(checkpoint)}"
    if checkpoint is None or str(checkpoint) in names():
        return str(checkpoint)
    path = Path(checkpoint).resolve()
    if path.suffix != SUFFIX:
        run, own = path, ""
    elif path.parent.name != BEST.parent.name:
        return portable(path.stem)
    else:
        run, own = path.parent.parent, "" if path.name == BEST.name else path.stem
    root = Path(runs).resolve()
    parts = run.relative_to(root).parts if run.is_relative_to(root) else (run.name,)
    return "_".join(portable(part) for part in (*parts, own) if part)
