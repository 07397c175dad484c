"""A simulator that sees the mirror image of every scene, for checks of mirror symmetry."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from array_api_compat import array_namespace, device

from gpe_pl.rollout.loop import Simulator
from gpe_pl.trajectory.boundary import Array, Boundary, Motion
from gpe_pl.trajectory.state import State, Stress


@dataclass(frozen=True)
class Mirrored:
    """Mirrors a state at a plane, makes the step, and mirrors the result back.

    A rollout equals that of the inner simulator if the simulator knows no left and right. The image of a boundary has no shapes, so the inner simulator has to
    read boundary nodes, as learned simulators do. Containment goes outside: ``Contained(Mirrored(simulator, …), dt)``.

    Attributes:
        simulator: simulator that makes the steps.
        axis: axis normal to the plane.
        offset: position of the plane along the axis [m].
    """

    simulator: Simulator
    axis: int
    offset: float
    _images: dict[int, tuple[Boundary, Boundary]] = field(default_factory=dict, repr=False, compare=False)

    def step(self, state: State) -> State:
        after = self.simulator.step(self._image(state, self._boundary(state.boundary)))
        return self._image(after, state.boundary.at(1))

    def _image(self, state: State, boundary: Boundary) -> State:
        history, rest_pos, stress = state.velocity_history, state.rest_pos, state.stress
        return replace(
            state,
            pos=self._point(state.pos),
            vel=self._vector(state.vel),
            velocity_history=None if history is None else self._vector(history),
            rest_pos=None if rest_pos is None else self._point(rest_pos),
            gravity=self._vector(state.gravity),
            stress=None if stress is None else Stress(self._tensor(stress.node, state.dim), self._tensor(stress.cell, state.dim)),
            boundary=boundary,
        )

    def _boundary(self, boundary: Boundary) -> Boundary:
        """Return the image of a boundary; that of a boundary at rest is made once, and so is its search tree."""
        known = self._images.get(id(boundary))
        if known is not None and known[0] is boundary:
            return known[1]
        motion = boundary.motion
        if motion is not None:
            motion = Motion(self._point(motion.pos), self._vector(motion.vel), self._vector(motion.normal))
        image = replace(
            boundary,
            pos=self._point(boundary.pos),
            vel=self._vector(boundary.vel),
            normal=self._vector(boundary.normal),
            shapes=(),
            motion=motion,
        )
        self._images.clear()
        self._images[id(boundary)] = boundary, image
        return image

    def _vector(self, x: Array) -> Array:
        return x * _row([-1.0 if axis == self.axis else 1.0 for axis in range(x.shape[-1])], x)

    def _point(self, x: Array) -> Array:
        return self._vector(x) + _row([2 * self.offset if axis == self.axis else 0.0 for axis in range(x.shape[-1])], x)

    def _tensor(self, x: Array, dim: int) -> Array:
        """Return the images of stresses; shears between the axis and another one change sign."""
        pairs = [(0, 0), (0, 1), (1, 1), (2, 2)] if dim == 2 else [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        return x * _row([-1.0 if (i == self.axis) != (j == self.axis) else 1.0 for i, j in pairs], x)


def _row(values: list[float], like: Any) -> Array:
    """Return numbers in the array library, precision and device of an array."""
    return array_namespace(like).asarray(values, dtype=like.dtype, device=device(like))
