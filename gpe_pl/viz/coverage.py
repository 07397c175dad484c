"""Figure of the coverage of error bands: nominal against observed, and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.figures import COLUMN_WIDTH
from gpe_pl.viz.film_strip import new_figure

ACCEPTED = 0.05
"""Half width of the grey zone around nominal coverage."""


@dataclass(frozen=True)
class CoverageCurves:
    """Coverage of a group of scenes.

    Attributes:
        num_scenes: number of scenes.
        inside: observed coverage of each level in each frame [level, frame].
        radius: typical radius of the bands in each frame [spacings].
        error: typical error in each frame [spacings].
    """

    num_scenes: int
    inside: Float[np.ndarray, "level frame"]
    radius: Float[np.ndarray, " frame"]
    error: Float[np.ndarray, " frame"]


def coverage_figure(
    groups: Mapping[str, CoverageCurves], levels: Sequence[float], level: float, frame_dt: float, horizons: Mapping[int, str]
) -> Figure:
    """Draw nominal against observed coverage of each group with a line per horizon, then the coverage of one level and the radii over time.

    Args:
        groups: coverage by name of the group.
        levels: nominal coverages.
        level: one of ``levels``, for the panels over time.
        frame_dt: time between frames [s].
        horizons: labels of horizons by number of frames. Horizons that a group does not reach are left out.
    """
    figure = new_figure(COLUMN_WIDTH / 1.5 * (len(groups) + 2), 2.5)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(1, len(groups) + 2)
    nominal = 100 * np.asarray(levels)
    for axes, (name, group) in zip(panels, groups.items(), strict=False):
        axes.fill_between(
            [40, 100], [40 - 100 * ACCEPTED, 100 - 100 * ACCEPTED], [40 + 100 * ACCEPTED, 100 + 100 * ACCEPTED], color="0.92", linewidth=0
        )
        axes.plot([40, 100], [40, 100], ":", color="0.5", linewidth=1)
        reached = {frame: label for frame, label in horizons.items() if frame < group.inside.shape[1]}
        for k, (frame, label) in enumerate(reached.items()):
            color = colormaps["viridis"](0.9 * k / max(1, len(reached) - 1))
            axes.plot(nominal, 100 * group.inside[:, frame], "o-", markersize=3, linewidth=1, color=color, label=label)
        axes.set_xlim(45, 100)
        axes.set_ylim(_lowest(100 * group.inside[:, list(reached)]), 102)
        axes.legend(fontsize=6, frameon=False, loc="lower right", handlelength=1.2)
        _labelled(axes, f"{name}, {group.num_scenes} scenes", "nominal [%]", "observed [%]")
    over_time, sizes = panels[-2:]
    row = list(levels).index(level)
    over_time.axhspan(100 * (level - ACCEPTED), 100 * (level + ACCEPTED), color="0.92", linewidth=0)
    over_time.axhline(100 * level, color="0.5", linewidth=1, linestyle=":")
    for k, (name, group) in enumerate(groups.items()):
        time, color = frame_dt * np.arange(1, group.inside.shape[1]), PALETTE[k]
        over_time.plot(time, 100 * group.inside[row, 1:], color=color, linewidth=1.2, label=name)
        sizes.plot(time, group.radius[1:], color=color, linewidth=1.2, label=f"bands, {name}")
        sizes.plot(time, group.error[1:], color=color, linewidth=1, linestyle=":")
    over_time.set_ylim(min(_lowest(100 * group.inside[row, 1:]) for group in groups.values()), 102)
    over_time.legend(fontsize=6, frameon=False, loc="lower right", handlelength=1.2)
    sizes.set_yscale("log")
    sizes.set_ylim(bottom=1e-3)
    _labelled(over_time, f"bands of {100 * level:g} %", "time [s]", "observed [%]")
    _labelled(sizes, "bands, and median error (dotted)", "time [s]", "spacings")
    return figure


def _lowest(observed: np.ndarray) -> float:
    """Return the lower end of an axis that shows all coverages [%], the worst of all."""
    return min(45.0, float(observed.min(initial=100.0)) - 2)


def _labelled(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=7.5)
    axes.set_xlabel(x, fontsize=7.5)
    axes.set_ylabel(y, fontsize=7.5)
    axes.tick_params(which="both", labelsize=6.5)
    axes.spines[["top", "right"]].set_visible(False)
