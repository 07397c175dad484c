"""Figure files that appear complete or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gpe_pl.files.atomic import replacing


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Write a figure; options are those of ``savefig``. Raise ``FullDiskError`` if the disk is full."""
    with replacing(path) as part:
        figure.savefig(part, **options)
