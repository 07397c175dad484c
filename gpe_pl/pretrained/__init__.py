"""Trained simulators that come with the package: ``{name}.ckpt``, and its model card ``{name}.md``."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
SUFFIX = ".ckpt"


def names() -> list[str]:
    """What can be named in the place of a checkpoint's path."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def checkpoint_path(checkpoint: Path | str) -> Path:
    """The file of a shipped model, or the path itself if it is none of their names."""
    return FOLDER / f"{checkpoint}{SUFFIX}" if str(checkpoint) in names() else Path(checkpoint)
