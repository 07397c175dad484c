"""The layout of trajectory figures: one row per trajectory, time to the right."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.captions import as_written, frame_time, in_common
from gpe_pl.viz.coloring import Coloring
from gpe_pl.viz.panel import Panel
from gpe_pl.viz.scenery import INK

TEXT_WIDTH = 7.0
"""Width [inch] of a figure that spans both columns of a paper."""

LINE, CHARACTER = 0.14, 0.062
"""Height of a line and approximate width of a character of a row's label [inch]."""

LOWEST_ROW, LOWEST_BAR = 0.5, 0.8
"""Least heights of a row, also of a flat scene, and of a colour bar [inch]."""
BAR_MARGIN, BAR_CHARACTER = 0.3, 0.054
"""Height by which the label of a colour bar may exceed the bar, and approximate width of a character of this label [inch]."""


def new_figure(width: float, height: float, dpi: int = 150) -> Figure:
    """Return an empty figure of this width and height [inch], with its own canvas and unknown to pyplot."""
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def evenly_spaced_frames(num_frames: int, num_columns: int) -> list[int]:
    """Return up to ``num_columns`` different frames from the first to the last.

    Raises:
        ValueError: ``num_columns`` is not positive.
    """
    if num_columns < 1:
        raise ValueError(f"num_columns must be positive, got {num_columns}")
    return np.unique(np.round(np.linspace(0, num_frames - 1, num_columns)).astype(int)).tolist()


def film_strip(rows: Sequence[tuple[str, Trajectory]], frames: Sequence[int], coloring: Coloring, dpi: int = 150) -> Figure:
    """Draw a panel per trajectory and frame, times above the columns, materials and the meaning of colours below, and a colour bar or legend.

    Rows of a flat scene are higher than its panels, so that labels and notes have room.

    Args:
        rows: label and trajectory of each row, from top to bottom, of scenes in the same domain.
        frames: one frame per column; a trajectory that ended earlier shows a note.
        coloring: colours of all rows.
        dpi: dots per inch, unless ``savefig`` sets another value.
    """
    trajectories = [trajectory for _, trajectory in rows]
    # The ground truth has no error, so the bar stands beside the rows below it.
    first_with_bar = 1 if coloring.by == "error" else 0
    has_bar = coloring.bar_label is not None and len(rows) > first_with_bar
    legend = coloring.legend(trajectories)
    aspect = Camera(trajectories[0]).aspect
    with_bar = 0.74 if coloring.by == "error" else 0.9  # inch; errors have up to six characters, stresses include the unit
    right = with_bar if has_bar else 0.04
    caption = textwrap.fill("; ".join(filter(None, [in_common(trajectories), coloring.explanation])), int(TEXT_WIDTH / CHARACTER))
    below = 0.24 if legend else 0.06
    top, bottom, gap = 0.22, below + LINE * (caption.count("\n") + 1) + 0.04, 0.05

    def panel_width(left: float) -> float:
        return (TEXT_WIDTH - left - right - gap * (len(frames) - 1)) / len(frames)

    wrap_at = int(max(LOWEST_ROW, panel_width(0.5) * aspect) / CHARACTER)
    labels = [
        "\n".join(part for line in label.split("\n") for part in textwrap.wrap(line, wrap_at, break_long_words=False)) for label, _ in rows
    ]
    left = 0.06 + LINE * max(label.count("\n") + 1 for label in labels)
    longest = max(len(line) for label in labels for line in label.split("\n"))
    lowest = max(LOWEST_ROW, longest * CHARACTER, LOWEST_BAR / len(rows) if has_bar else 0.0)
    bar_height = max(LOWEST_BAR, (len(rows) - first_with_bar) * max(lowest, panel_width(left) * aspect))
    bar_label = textwrap.fill(coloring.bar_label or "", int((bar_height + BAR_MARGIN) / BAR_CHARACTER))
    right += LINE * bar_label.count("\n")
    width = panel_width(left)
    row_height = max(lowest, width * aspect)
    above = (row_height - width * aspect) / 2
    height = top + len(rows) * (row_height + gap) + bottom
    figure = new_figure(TEXT_WIDTH, height, dpi)

    def rectangle(row: int, column: int) -> tuple[float, float, float, float]:
        x, y = left + column * (width + gap), height - top - (row + 1) * row_height - row * gap + above
        return x / TEXT_WIDTH, y / height, width / TEXT_WIDTH, width * aspect / height

    style: dict[str, Any] = {"fontsize": 8, "color": INK, "ha": "center"}
    for i, (label, trajectory) in enumerate(zip(labels, trajectories, strict=True)):
        for j, frame in enumerate(frames):
            Panel(figure, rectangle(i, j), trajectory, coloring, above).show_frame(frame)
        x, y, _, h = rectangle(i, 0)
        figure.text(left / 2 / TEXT_WIDTH, y + h / 2, as_written(label), rotation=90, va="center", linespacing=1.1, **style)
    for j, frame in enumerate(frames):
        x, _, w, _ = rectangle(0, j)
        text = ("" if j else "$t$ = ") + frame_time(frame, trajectories[0])
        figure.text(x + w / 2, 1 - (top - 0.05) / height, text, va="bottom", **style)
    figure.text(0.5, below / height, as_written(caption), va="bottom", linespacing=1.1, **style)
    if has_bar:
        rows_beside = len(rows) - first_with_bar
        tall = max(LOWEST_BAR, rows_beside * row_height + (rows_beside - 1) * gap)
        draw_bar(figure, coloring, bar_label, (1 - (right - 0.1) / TEXT_WIDTH, (bottom + gap) / height, 0.08 / TEXT_WIDTH, tall / height))
    if legend:
        draw_legend(figure, legend, 0.0)
    return figure


def draw_legend(figure: Figure, legend: Mapping[str, Any], bottom: float) -> None:
    """Draw a line with the colour of each material. ``bottom`` is its lower edge, as a fraction of the figure."""
    handles = [Line2D([], [], linestyle="", marker="o", markersize=5, color=color, label=name) for name, color in legend.items()]
    figure.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, bottom),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        borderpad=0.2,
        handletextpad=0.1,
    )


def draw_bar(
    figure: Figure,
    coloring: Coloring,
    label: str,
    rectangle: tuple[float, float, float, float],
    orientation: Literal["vertical", "horizontal"] = "vertical",
) -> None:
    """Draw the scale of the colours into a rectangle [left, bottom, width, height], as fractions of the figure."""
    formatter = EngFormatter(unit="Pa") if coloring.by == "von_mises" else None
    axes = figure.add_axes(rectangle)
    bar = figure.colorbar(
        ScalarMappable(coloring.scale, coloring.color_map), cax=axes, extend="max", format=formatter, orientation=orientation
    )
    bar.set_label(label, fontsize=7, color=INK)
    bar.ax.tick_params(labelsize=6.5, width=0.5, length=2)
    bar.outline.set_linewidth(0.5)
