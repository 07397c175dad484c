"""Averages the step of a simulator over a scene and its mirror images, so that left and right are treated alike.

A network does not learn mirror symmetry exactly: a symmetric body that falls flat begins to turn. The mean over the group of reflections is exactly symmetric
(group averaging), and its error is smaller, because errors of the images differ. It costs a pass of the model per image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import torch

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.models.base import Model
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Reflection, level_axes
from gpe_pl.trajectory.rigid_bodies import moved_rigidly
from gpe_pl.trajectory.state import State, Stress

MAX_BOUNDARIES = 64
"""Number of boundaries whose images are kept."""


@dataclass
class MirrorAverage:
    """Makes averaged steps.

    Attributes:
        bounds: ``(low, high)`` of the domain per axis [m]. The images are mirrored at its middle.
        dt: frame interval [s].
        reads_shapes: whether the model reads the shapes of walls. Scenes with a shape that has no image (``geometry.shape_images``) then have an error.
    """

    bounds: Sequence[tuple[float, float]]
    dt: float
    reads_shapes: bool = False
    _images: dict[tuple[int, tuple[Reflection, ...]], tuple[Boundary, list[Boundary]]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, builder: GraphBuilder, model: Model) -> MirrorAverage:
        """Return the average for a model and the builder of its graphs. Models with the elastic law read shapes."""
        return cls(builder.metadata.bounds, builder.metadata.frame_dt, bool(model.settings.get("elastic")))

    def next_states(
        self, next_states: Callable[[list[State]], list[State | SimulationError]], states: list[State]
    ) -> list[State | SimulationError]:
        """Return the states one frame later. A scene whose graph, or that of an image, cannot be built has its error instead.

        Args:
            next_states: makes the steps of several scenes without averaging, and has no memory between steps.
            states: states of the scenes.
        """
        reflections = [self._reflections(state) for state in states]
        images = [
            reflection.state(state, boundary)
            for state, own in zip(states, reflections, strict=True)
            for reflection, boundary in zip(own, self._boundaries(state.boundary, own), strict=True)
        ]
        plain = next_states([*states, *images])
        mirrored = iter(plain[len(states) :])
        return [
            self._mean(before, state, [(reflection, next(mirrored)) for reflection in own])
            for before, state, own in zip(states, plain[: len(states)], reflections, strict=True)
        ]

    def _reflections(self, state: State) -> list[Reflection]:
        """Return the reflections along the level axes, and their products."""
        bounds = state.periodicity.bounds if state.periodicity else self.bounds
        level = level_axes(state.gravity.tolist(), state.boundary.normal)
        chosen = [[axis for axis, turns in zip(level, which, strict=True) if turns] for which in product((False, True), repeat=len(level))]
        return [Reflection.of(bounds, axes) for axes in chosen[1:]]

    def _boundaries(self, boundary: Boundary, reflections: list[Reflection]) -> list[Boundary]:
        """Return the images of a boundary; those of a boundary at rest are made once, and so are their search trees."""
        key = id(boundary), tuple(reflections)  # a scene with another gravity may share the boundary
        known = self._images.get(key)
        if known is None or known[0] is not boundary:
            if len(self._images) >= MAX_BOUNDARIES:
                self._images.clear()
            known = self._images[key] = boundary, [reflection.boundary(boundary) for reflection in reflections]
        return known[1]

    def _mean(self, before: State, state: State | SimulationError, images: list[tuple[Reflection, Any]]) -> State | SimulationError:
        if isinstance(state, SimulationError) or not images:
            return state
        if error := next((image for _, image in images if isinstance(image, SimulationError)), None):
            return error
        if self.reads_shapes and before.boundary.shapes and not images[0][1].boundary.shapes:
            kind = next(shape.kind for shape in before.boundary.shapes if not images[0][0].shapes([shape]))
            message = (
                f"mirror_average: shapes of the kind {kind} have no mirror image, which the elastic law needs; set mirror_average=false"
            )
            return SimulationError(message, reason="input")
        back = [reflection.state(image, state.boundary) for reflection, image in images]
        changes = [state.periodicity.shortest(other.pos - state.pos) for other in back]
        stress = [s.stress for s in (state, *back) if s.stress is not None]
        mean = [_mean([getattr(s, name) for s in (state, *back)]) for name in ("vel", "velocity_history", "frame_velocity")]
        pos = state.periodicity.wrapped(state.pos + sum(changes) / (1 + len(back)))
        values = {"pos": pos, "vel": mean[0], "velocity_history": mean[1], "frame_velocity": mean[2]}
        if state.loads is not None:  # an average would round the given motion
            values = {name: v if v is None else state.loads.at_prescribed(getattr(state, name), v) for name, v in values.items()}
        stress_mean = Stress(_mean([s.node for s in stress]), _mean([s.cell for s in stress])) if stress else None
        return moved_rigidly(before, replace(state, **values, stress=stress_mean), self.dt)  # a mean of rotations is smaller than the body


def _mean(values: Sequence[Any]) -> Any:
    """Return the mean of tensors; None if there are none."""
    return None if values[0] is None else torch.stack([*values]).mean(dim=0)
