"""Figure of an acceptance scene: the solver above, the model below."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from matplotlib.figure import Figure

from gpe_pl.benchmarks.acceptance.trial import Shown
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.coloring import Coloring
from gpe_pl.viz.film_strip import LINE, TEXT_WIDTH, new_figure
from gpe_pl.viz.panel import Panel
from gpe_pl.viz.scenery import INK

GAP, LEFT = 0.05, 0.2
"""Distance between panels, and width of the row labels [inch]."""


def scene_figure(columns: Sequence[Shown]) -> Figure:
    """Draw the solver above and the model below, in the given columns. Colours mean stress if both have one, else the height at the start."""
    trajectories = [t for c in columns for t in (c.truth, c.model)]
    has_stress = all(t.stress is not None for t in trajectories)
    coloring = Coloring("von_mises" if has_stress else "height", trajectories, sorted({c.frame for c in columns}))
    width = (TEXT_WIDTH - LEFT) / len(columns) - GAP
    height = width * Camera(columns[0].truth).aspect
    titles = ["\n".join(part for line in c.title.split("\n") for part in textwrap.wrap(line, int(width / 0.055))) for c in columns]
    above = LINE * max(title.count("\n") + 1 for title in titles) + 0.06
    total = above + 2 * (height + GAP)
    figure = new_figure(TEXT_WIDTH, total)
    for k, (column, title) in enumerate(zip(columns, titles, strict=True)):
        x = LEFT + k * (width + GAP)
        figure.text((x + width / 2) / TEXT_WIDTH, 1 - (above - 0.04) / total, title, ha="center", va="bottom", fontsize=7, color=INK)
        for row, trajectory in enumerate((column.truth, column.model)):
            y = total - above - (row + 1) * height - row * GAP
            panel = Panel(figure, (x / TEXT_WIDTH, y / total, width / TEXT_WIDTH, height / total), trajectory, coloring)
            panel.show_frame(column.frame)
            if k == 0:
                label = ("solver", "model")[row]
                figure.text(
                    0.5 * LEFT / TEXT_WIDTH, (y + height / 2) / total, label, rotation=90, ha="center", va="center", fontsize=8, color=INK
                )
    return figure
