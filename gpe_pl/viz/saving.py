"""Figure files that appear complete or not at all, on request also as vector graphics.

The environment variable ``GPE_FIGURES=svg`` (or ``pdf``, or ``svg,pdf``) writes every PNG figure of commands, suites and sweep reports in these formats, too.
Processes of a sweep inherit it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIABLE = "GPE_FIGURES"
VECTOR = ("svg", "pdf")


class FigureFormatError(GpeError, ValueError):
    """Raised when ``GPE_FIGURES`` names another format than those of ``VECTOR``."""


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Write a figure, and a PNG also in the formats that ``GPE_FIGURES`` names.

    Args:
        figure: the figure.
        path: file, whose suffix is the format.
        options: those of ``savefig``.

    Raises:
        FullDiskError: the disk is full.
        FigureFormatError: ``GPE_FIGURES`` names an unknown format.
    """
    further = further_formats() if path.suffix == ".png" else ()
    for suffix in (path.suffix, *(f".{kind}" for kind in further)):
        with replacing(path.with_suffix(suffix)) as part:
            figure.savefig(part, **options)


def further_formats() -> tuple[str, ...]:
    """Return the formats that ``GPE_FIGURES`` names. Commands call this before they begin.

    Raises:
        FigureFormatError: it names an unknown format.
    """
    named = tuple(part.strip().lower() for part in os.environ.get(VARIABLE, "").split(",") if part.strip())
    if wrong := [kind for kind in named if kind not in VECTOR]:
        raise FigureFormatError(
            f"{VARIABLE}={os.environ[VARIABLE]}: {wrong[0]!r} must be {' or '.join(VECTOR)}, or both with a comma between them"
        )
    return named
