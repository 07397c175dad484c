"""Figures of quantities: over time in one scene, and over many scenes, predicted against true and over a material parameter."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gpe_pl.viz.coloring import PALETTE, REFERENCE
from gpe_pl.viz.film_strip import new_figure

PANEL = (2.3, 2.0)
"""Size of a panel [inch]."""

Course = tuple[str, Mapping[str, Float[np.ndarray, "_"]]]
"""Unit of a quantity, and its values of frames 1, 2, … by simulator. A rollout that stopped early has fewer."""
Numbers = tuple[str, list[tuple[float, float, float]]]
"""Unit of a quantity; and material parameter, true and predicted value in each scene that has the quantity. A parameter is NaN where a scene has several
values or none, and a prediction where the rollout stopped early."""


def courses_figure(courses: Mapping[str, Course], start_time: float, frame_dt: float, title: str) -> Figure:
    """Draw quantities of one scene against time, a panel each.

    Args:
        courses: quantities by name.
        start_time: time of frame 0 in the scene [s].
        frame_dt: time between frames [s].
        title: heading of the figure, with the material parameters.
    """
    columns = -(-len(courses) // 2)
    figure = new_figure(PANEL[0] * columns, PANEL[1] * 2 + 0.3)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(2, columns, squeeze=False).ravel()
    for axes, (name, (unit, values)) in zip(panels, courses.items(), strict=False):
        for k, (who, course) in enumerate(values.items()):
            style = {"color": "0.2", "linewidth": 1.6} if k == 0 else {"color": PALETTE[k], "linewidth": 1.2, "linestyle": "--"}
            axes.plot(start_time + frame_dt * np.arange(1, len(course) + 1), course, label=who, **style)
        _labelled(axes, "time [s]", f"{name} [{unit}]")
    for axes in panels[len(courses) :]:
        axes.set_axis_off()
    panels[0].legend(fontsize=6.5, frameon=False)
    figure.suptitle(title, fontsize=8)
    return figure


def parity_figure(numbers: Mapping[str, Numbers], parameter_label: str, title: str) -> Figure:
    """Draw one number per scene of each quantity: above predicted against true with the line of equality, below both against the parameter.

    Scenes without a parameter value are grey above, and not shown below. If no scene has one, the lower row is left out.

    Args:
        numbers: quantities by name.
        parameter_label: name and unit of the parameter.
        title: heading of the figure.
    """
    values = np.array([parameter for _, scenes in numbers.values() for parameter, *_ in scenes])
    rows = 2 if np.isfinite(values).any() else 1
    if rows == 2:  # one scale for all panels, because points without a number of a quantity are left out there
        colors = ScalarMappable(Normalize(np.nanmin(values), np.nanmax(values)), colormaps["viridis"].with_extremes(bad=REFERENCE))
    figure = new_figure(max(PANEL[0] * len(numbers), 4.0), PANEL[1] * rows + 0.3)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(rows, len(numbers), squeeze=False)
    for axes, (name, (unit, scenes)) in zip(panels.T, numbers.items(), strict=True):
        value, true, predicted = np.asarray(scenes, float).T
        ends = np.array([np.nanmin([true, predicted]), np.nanmax([true, predicted])])
        ends = ends + np.array([-0.05, 0.05]) * max(np.ptp(ends), 1e-12)
        axes[0].plot(ends, ends, ":", color="0.5", linewidth=1)
        axes[0].scatter(true, predicted, s=14, color=colors.to_rgba(value) if rows == 2 else PALETTE[1])
        _labelled(axes[0], f"true {name} [{unit}]", "predicted")
        if rows == 2:
            axes[1].scatter(value, true, s=16, facecolors="none", edgecolors="0.2", linewidths=0.9, label="ground truth")
            axes[1].scatter(value, predicted, s=14, marker="x", color=PALETTE[1], linewidths=1.1, label="prediction")
            _labelled(axes[1], parameter_label, f"{name} [{unit}]")
    if rows == 2:
        bar = figure.colorbar(colors, ax=panels[0, -1])
        bar.set_label(parameter_label, fontsize=7)
        bar.ax.tick_params(labelsize=6)
        bar.ax.yaxis.get_offset_text().set_fontsize(6)
        panels[1, 0].legend(fontsize=6.5, frameon=False)
        if not np.isfinite(values).all():
            grey = Line2D([], [], linestyle="", marker="o", markersize=4, color=REFERENCE, label="several values or none")
            panels[0, 0].legend(handles=[grey], fontsize=6.5, frameon=False)
    figure.suptitle(title, fontsize=8)
    return figure


def _labelled(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=7.5)
    axes.set_ylabel(y, fontsize=7.5)
    axes.tick_params(labelsize=6.5)
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_offset_text().set_fontsize(6)  # a common power of ten
    axes.spines[["top", "right"]].set_visible(False)
