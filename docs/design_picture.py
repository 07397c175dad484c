"""Picture and numbers of the guide's design: an obstacle that guides sand, found with gradients and without, verified with the solver.

``python docs/design_picture.py`` writes ``docs/images/design.png`` and ``docs/images/design.txt``.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image

from gpe_pl.files.markdown import table_row
from gpe_pl.geometry.shapes import Polygon
from gpe_pl.scenes.design import Design, design
from gpe_pl.scenes.scene import Scene
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

IMAGES = Path(__file__).parent / "images"
TARGET = (0.45, 0.3)
SECONDS, SHIFT, ANGLE = 0.15, 0.03, 30.0
GRADIENTS = 8
"""Largest number of gradients. The derivative-free search gets as many rollouts as cost the same processor time."""
RAMP = Polygon(((0.17, 0.28), (0.37, 0.28), (0.37, 0.32), (0.17, 0.32)), 0.3)


def scene() -> Scene:
    """Return a block of sand that falls on a plate."""
    return (
        Scene(box=(1.0, 1.0), title="sand on a plate").block("sand", at=(0.22, 0.42), size=(0.1, 0.1), velocity=(0.0, -2.0)).obstacle(RAMP)
    )


def found(method: str, evaluations: int, solve: bool = True) -> Design:
    """Return the design that a method finds."""
    return design(scene(), TARGET, shift=SHIFT, angle=ANGLE, seconds=SECONDS, method=method, evaluations=evaluations, solve=solve)  # type: ignore[arg-type]


def panel(figure: object, place: tuple[float, float, float, float], own: Scene, nodes: np.ndarray, title: str) -> None:
    """Draw nodes, obstacle and target."""
    axes = figure.add_axes(place)  # type: ignore[attr-defined]
    axes.plot(*nodes.T, ".", color="#c2a36b", markersize=2)
    ((_, shape),) = own.obstacles
    assert isinstance(shape, Polygon)
    axes.fill(*np.asarray(shape.vertices).T, color="0.4")
    axes.plot(*TARGET, "x", color="#d62728")
    axes.set(xlim=(0, 1), ylim=(0, 0.6), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, fontsize=8)


def main() -> None:
    """Search with gradients, then without for the same time, and write what was found."""
    start = scene().solve(SECONDS, like="sand").first
    gradient = found("gradient", GRADIENTS)
    designs = {f"first, {gradient.method}": gradient}
    trial = found("derivative_free", 3, solve=False)
    per_rollout = trial.processor_seconds / trial.num_rollouts
    rest = max(3, math.floor(gradient.processor_seconds / per_rollout) - trial.num_rollouts + 3)
    designs["second, derivative_free"] = found("derivative_free", rest)
    lines = [
        table_row(["search", "rollouts", "gradients", "processor time [s]", "model, start", "model, best", "solver, start", "solver, best"])
    ]
    lines.append("|" + "---|" * 8)
    for name, own in designs.items():
        numbers = [f"{value:.4f}" for pair in own.distances.values() for value in pair]
        lines.append(table_row([name, str(own.num_rollouts), str(own.num_gradients), f"{own.processor_seconds:.1f}", *numbers]))
    text = [*lines, "", "Root mean square distances of all nodes from the target [m].", ""]
    text += [f"{name}\n{own.summary()}\n" for name, own in designs.items()]
    (IMAGES / "design.txt").write_text("\n".join(text))
    print("\n".join(text))
    figure = new_figure(7.2, 2.0)
    shown = [("start (solver)", scene(), start.pos[-1])]
    shown += [(f"{name.partition(chr(32))[2]} (solver)", own.scene, own.rollouts["solver"].pos[-1]) for name, own in designs.items()]
    for k, (title, own_scene, nodes) in enumerate(shown):
        panel(figure, (0.01 + 0.33 * k, 0.02, 0.31, 0.84), own_scene, nodes, title)
    save_figure(figure, IMAGES / "design.png")
    with Image.open(IMAGES / "design.png") as drawn:
        drawn.convert("RGB").quantize(64).save(IMAGES / "design.png", optimize=True)


if __name__ == "__main__":
    main()
