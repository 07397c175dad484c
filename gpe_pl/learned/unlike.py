"""Tells whether a scene is unlike those that a model knows, by physical quantities of its graph.

Each quantity has a name with its node type, such as ``speed of sand [m/s]``. Its limits are those of calibration scenes, which ``bands`` stores. Without them,
speeds and accelerations are compared with the statistics of the training data that every checkpoint holds. Checks look at a few frames of a rollout
(``sampled_frames``), so other steps take no longer. A quantity that no calibration scene has is unlike; one that the training statistics lack is not checked.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.nn.blocks import Standardize
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import CELL, RADIUS, role
from gpe_pl.trajectory.state import State

log = logging.getLogger(__name__)

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest value of each quantity, by name."""
NUM_SAMPLES = 5
"""Number of frames of a rollout that are checked, evenly spread from its start to its end."""
MARGIN = 0.25
"""Fraction of its width by which a quantity may leave the range of calibration scenes, whose ends are extremes of a few scenes."""
MOST_SPEED, MOST_ACCELERATION = 10.0, 60.0
"""Multiples of the root mean square in training up to which speeds and accelerations are not unlike. Test scenes of shipped models reach 5 and 26."""


def sampled_frames(num_frames: int) -> set[int]:
    """Return the frames of a rollout of ``num_frames`` frames that are checked."""
    return {int(frame) for frame in np.linspace(0, num_frames - 1, NUM_SAMPLES).round()}


@torch.no_grad()
def quantities(simulator: LearnedSimulator, state: State) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest value of each quantity of a scene at one instant.

    Quantities of each material are the speed [m/s], the acceleration over the last frame [m/s²] and the number of edges within the radius per node.
    Quantities of each pair of node types are the distances of edges [m]. Those of meshes are the stretch of edges, which is extension over length at rest.

    Args:
        simulator: simulator whose graphs the model sees.
        state: state of the simulator.

    Raises:
        SimulationError: the graph cannot be built.
    """
    builder = simulator.builder
    spec, scales, dim = builder.spec, builder.scales, builder.spec.dim
    graph, found = builder(state), dict[str, Tensor]()
    for material in spec.materials:
        x = graph[material].x
        found[f"speed of {material} [m/s]"] = x[:, :dim].norm(dim=1) * scales.velocity
        if builder.config.history > 1:
            found[f"acceleration of {material} [m/s²]"] = x[:, dim : 2 * dim].norm(dim=1) * scales.acceleration
        targets = [graph[r].edge_index[1] for r in spec.relations if r[1] == RADIUS and r[2] == material]
        found[f"edges per node of {material}"] = torch.bincount(torch.cat(targets), minlength=len(x)).double()
    for relation in spec.relations:
        source, kind, target = relation
        edges = graph[relation]
        if kind == RADIUS:
            found[f"distance of {role(target)} from {role(source)} [m]"] = edges.odd[:, :dim].norm(dim=1) * scales.radius
        elif kind == CELL and edges.even.shape[1]:
            found[f"stretch of edges of {role(target)}"] = edges.even[:, 0] / edges.even[:, 2].clamp(min=1e-9)
    return {name: (float(values.min()), float(values.max())) for name, values in found.items() if len(values)}


def united(ranges: Iterable[Ranges]) -> dict[str, tuple[float, float]]:
    """Return the ranges that contain all given ones."""
    whole: dict[str, tuple[float, float]] = {}
    for own in ranges:
        for name, (low, high) in own.items():
            before = whole.get(name, (low, high))
            whole[name] = min(low, before[0]), max(high, before[1])
    return whole


def trained_limits(simulator: LearnedSimulator) -> dict[str, tuple[float, float]]:
    """Return limits from the statistics of the training data: multiples of the root mean square of speeds and accelerations."""
    builder, found = simulator.builder, dict[str, tuple[float, float]]()
    dim, scales = builder.spec.dim, builder.scales
    for material in builder.spec.materials:
        standard = cast(Standardize, simulator.standardizer.node[material])
        if standard.is_identity:
            continue
        square = (standard.mean.square() + standard.std.square()).double()
        found[f"speed of {material} [m/s]"] = 0.0, MOST_SPEED * float(square[:dim].sum().sqrt()) * scales.velocity
        if builder.config.history > 1:
            found[f"acceleration of {material} [m/s²]"] = (
                0.0,
                MOST_ACCELERATION * float(square[dim : 2 * dim].sum().sqrt()) * scales.acceleration,
            )
    return found


def unlike(found: Ranges, limits: Ranges, margin: float = MARGIN, known: str = "calibration scenes") -> Iterator[tuple[str, str]]:
    """Yield the name of each quantity that is beyond its limits, and a line that says by how much. Quantities without limits are unlike, too.

    Args:
        found: ranges of a scene.
        limits: ranges of the scenes that the model knows.
        margin: fraction of a range's width by which it may be left.
        known: name of these scenes, for the line.
    """
    for name, (low, high) in found.items():
        if name not in limits:
            yield name, f"{name} does not occur in {known}"
            continue
        lowest, highest = limits[name]
        width = max(highest - lowest, 1e-9)
        if high > highest + margin * width:
            yield name, f"{name} is up to {high:.3g}, in {known} at most {highest:.3g}{_times(high, highest)}"
        elif low < lowest - margin * width:
            yield name, f"{name} is down to {low:.3g}, in {known} at least {lowest:.3g}"


def _times(value: float, limit: float) -> str:
    return f" ({value / limit:.2g} times as much)" if limit > 0 else ""


class Watch:
    """Collects the quantities of a rollout in its sampled frames.

    Args:
        simulator: simulator, or the first member of an ensemble.
        num_steps: number of frames that the rollout adds.

    Attributes:
        found: ranges of the quantities so far.
    """

    def __init__(self, simulator: LearnedSimulator, num_steps: int) -> None:
        self.simulator, self.frames = simulator, sampled_frames(num_steps + 1)
        self.found: dict[str, tuple[float, float]] = {}

    def see(self, frame: int, state: State) -> None:
        """Take the quantities of a state, if its frame is sampled. A state without a graph is left out, because the rollout stops there."""
        if frame in self.frames:
            try:
                self.found = united([self.found, quantities(self.simulator, state)])
            except SimulationError:
                return


class UnlikeScenes:
    """Counts scenes that are unlike the known ones, and warns once for each quantity.

    Args:
        limits: limits of the quantities.
        known: name of the scenes that these are from, for messages.
        is_complete: whether the scenes had no other quantities than those with limits, so that other quantities are unlike.
        spread: largest mean spread of an ensemble in calibration scenes, in frames 1, 2, … [m].

    Attributes:
        lines: what is unlike in the first scene, and the number of scenes, by quantity.
    """

    def __init__(self, limits: Ranges, known: str, is_complete: bool, spread: Sequence[float] = ()) -> None:
        self.limits, self.known, self.is_complete, self.spread = limits, known, is_complete, spread
        self.lines: dict[str, tuple[str, int]] = {}
        self.num_scenes = 0

    def add(self, found: Ranges, spread: np.ndarray | None = None) -> int:
        """Take the quantities of a scene and its mean spread in each frame [m]. Return the number of quantities that are unlike."""
        if not self.is_complete:
            found = {name: values for name, values in found.items() if name in self.limits}
        beyond = [*unlike(found, self.limits, known=self.known), *self._wide(spread)]
        for name, line in beyond:
            first, count = self.lines.get(name, (line, 0))
            self.lines[name] = first, count + 1
        self.num_scenes += 1
        return len(beyond)

    def _wide(self, spread: np.ndarray | None) -> Iterator[tuple[str, str]]:
        if spread is None or not self.spread:
            return
        stop = min(len(spread) - 1, len(self.spread))
        for frame in sorted(sampled_frames(stop + 1) - {0}):
            if spread[frame] > (1 + MARGIN) * self.spread[frame - 1]:
                yield (
                    "spread of the ensemble",
                    f"spread of the ensemble is {spread[frame]:.3g} m after {frame} frames, in {self.known} at most {self.spread[frame - 1]:.3g} m"
                    f"{_times(spread[frame], self.spread[frame - 1])}",
                )
                return

    def warn(self, where: str) -> None:
        """Log a warning for each quantity. ``where`` names the scenes."""
        for line, count in self.lines.values():
            number = f"{count} of {self.num_scenes} scenes of " if self.num_scenes > 1 else ""
            log.warning("unlike %s in %s%s: %s", self.known, number, where, line)
