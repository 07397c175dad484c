"""Picture of a scene before any rollout, with its faults in red."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.scenes.obstacles import MeshObstacle
from gpe_pl.viz.coloring import MATERIAL_COLORS
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

if TYPE_CHECKING:
    from gpe_pl.scenes.scene import Scene

NUM_POINTS = 80
"""Number of points along the longest side of the box with which bodies and obstacles are drawn."""
WRONG = "#d62728"
LABEL = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}


def draw(scene: Scene, faults: Mapping[str, str], path: Path) -> None:
    """Draw box, bodies and obstacles from the front, with their names, to a picture; those with a fault are red, and the faults are its title."""
    bounds = np.array(scene.box)
    across, up = 0, scene.dim - 1
    width, height = np.ptp(bounds, axis=1)[[across, up]]
    figure = new_figure(6.0, 6.0 * float(np.clip(height / width, 0.3, 2.0)) + 0.3 * (1 + len(faults)))
    axes = figure.add_axes((0.09, 0.09, 0.88, 0.85 - 0.04 * len(faults)))
    step = float(np.ptp(bounds, axis=1).max()) / NUM_POINTS
    for body in scene.bodies:
        grid = np.meshgrid(*[np.arange(a + step / 2, b, step) for a, b in zip(body.low, body.high, strict=True)], indexing="ij")
        points = np.stack(grid, axis=-1).reshape(-1, scene.dim)
        inside = points[body.contains(points)]
        color = WRONG if body.name in faults else MATERIAL_COLORS[body.material]
        axes.plot(inside[:, across], inside[:, up], ".", color=color, markersize=3)
        middle = (body.low + body.high) / 2
        axes.annotate(body.name, (middle[across], middle[up]), ha="center", fontsize=8, bbox=LABEL)
    for name, obstacle in scene.obstacles:
        try:
            shape = obstacle.shape(scene.box, 2 * step) if isinstance(obstacle, MeshObstacle) else obstacle
            points, _ = shape.sample(step)
        except (GpeError, ValueError):
            continue
        axes.plot(points[:, across], points[:, up], ".", color=WRONG if name in faults else "0.4", markersize=3)
        axes.annotate(name, points.mean(axis=0)[[across, up]], ha="center", fontsize=8, bbox=LABEL)
    for zone in scene.zones:
        (left, bottom), (right, top) = zone.low[[across, up]], zone.high[[across, up]]
        color = WRONG if zone.name in faults else "0.4"
        axes.plot([left, right, right, left, left], [bottom, bottom, top, top, bottom], "--", color=color)
        axes.annotate(f"{zone.name}\n{zone.opening}", ((left + right) / 2, top), ha="center", fontsize=8, bbox=LABEL)
    low, high = bounds[[across, up]].T
    axes.plot([low[0], high[0], high[0], low[0], low[0]], [low[1], low[1], high[1], high[1], low[1]], color="black")
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[across]} [m]")
    axes.set_ylabel(f"{'xyz'[up]} [m]")
    axes.set_title("\n".join([scene.title, *(f"{name}: {fault}"[:110] for name, fault in faults.items())]), fontsize=8)
    save_figure(figure, path)
