"""Trained simulators that come with the package: ``{name}.ckpt``, and its model card ``{name}.md``."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from gpe_pl.files.names import portable

FOLDER = Path(__file__).parent
SUFFIX = ".ckpt"
BEST = Path("checkpoints") / f"best{SUFFIX}"
"""Of a run, relative to its folder."""


def names() -> list[str]:
    """What can be named in the place of a checkpoint's path."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def checkpoint_path(checkpoint: Path | str) -> Path:
    """The file of a shipped model, the best checkpoint of a run's folder, or the path itself if it is neither."""
    if str(checkpoint) in names():
        return FOLDER / f"{checkpoint}{SUFFIX}"
    path = Path(checkpoint)
    return path / BEST if path.is_dir() else path


def fingerprint(checkpoint: Path | str) -> str:
    """What a configuration knows a checkpoint by, wherever it lies: its file's name and the beginning of its checksum."""
    path = checkpoint_path(checkpoint)
    return f"{path.name} (sha256 {sha256(path.read_bytes()).hexdigest()[:12]})"


def model_name(checkpoint: Path | str | None, runs: Path | str) -> str:
    """What a model is called in the name of a folder: as it is shipped, or as its run below the folder ``runs``, ``_`` for ``/``. It is ``names.portable``."""
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
