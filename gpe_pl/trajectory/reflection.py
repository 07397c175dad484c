"""Mirror images of scenes. The mirror image of a motion obeys the same laws of physics if gravity is mirrored, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from array_api_compat import array_namespace, device

from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Trajectory

Array = Any


@dataclass(frozen=True)
class Reflection:
    """Reflection at planes, each normal to one axis. It is its own inverse.

    Attributes:
        planes: position of the plane normal to each axis [m]; None for axes that stay.
    """

    planes: tuple[float | None, ...]

    @classmethod
    def of(cls, bounds: Sequence[tuple[float, float]], axes: Sequence[int]) -> Reflection:
        """Return the reflection at the middle of a domain along some axes."""
        return cls(tuple((low + high) / 2 if axis in axes else None for axis, (low, high) in enumerate(bounds)))

    @classmethod
    def at(cls, axis: int, offset: float, dim: int) -> Reflection:
        """Return the reflection at the plane normal to an axis at ``offset`` [m]."""
        return cls(tuple(offset if k == axis else None for k in range(dim)))

    def vector(self, x: Array) -> Array:
        """Return the images of vectors [..., dim]."""
        return x * _row([1.0 if plane is None else -1.0 for plane in self.planes], x)

    def point(self, x: Array) -> Array:
        """Return the images of positions [..., dim] in m."""
        return self.vector(x) + _row([0.0 if plane is None else 2 * plane for plane in self.planes], x)

    def tensor(self, x: Array) -> Array:
        """Return the images of stresses [..., component], in the order of ``schema.STRESS_COMPONENTS``. Some shears change sign."""
        turned = [plane is not None for plane in self.planes]
        pairs = [(0, 0), (0, 1), (1, 1)] if len(turned) == 2 else [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        signs = [-1.0 if turned[i] != turned[j] else 1.0 for i, j in pairs] + [1.0] * (len(turned) == 2)
        return x * _row(signs, x)

    def boundary(self, boundary: Boundary) -> Boundary:
        """Return the image of a boundary; it has nodes and no shapes."""
        motion = boundary.motion
        if motion is not None:
            motion = BoundaryMotion(self.point(motion.pos), self.vector(motion.vel), self.vector(motion.normal))
        return replace(
            boundary,
            pos=self.point(boundary.pos),
            vel=self.vector(boundary.vel),
            normal=self.vector(boundary.normal),
            shapes=(),
            motion=motion,
        )

    def state(self, state: State, boundary: Boundary) -> State:
        """Return the image of a state, given that of its boundary. ``periodicity`` and ``internal`` stay as they are."""
        history, rest_pos, stress = state.velocity_history, state.rest_pos, state.stress
        return replace(
            state,
            pos=self.point(state.pos),
            vel=self.vector(state.vel),
            velocity_history=None if history is None else self.vector(history),
            frame_velocity=None if state.frame_velocity is None else self.vector(state.frame_velocity),
            rest_pos=None if rest_pos is None else self.point(rest_pos),
            gravity=self.vector(state.gravity),
            stress=None if stress is None else self._stress(stress),
            boundary=boundary,
        )

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return the image of a trajectory; the same object if there are no planes. The planes must map gravity and the domain onto themselves."""
        if all(plane is None for plane in self.planes):
            return trajectory
        rest_pos, stress = trajectory.rest_pos, trajectory.stress
        return replace(
            trajectory,
            pos=self.point(trajectory.pos),
            vel=self.vector(trajectory.vel),
            rest_pos=None if rest_pos is None else self.point(rest_pos),
            stress=None if stress is None else self._stress(stress),
            boundary=self.boundary(trajectory.boundary),
        )

    def _stress(self, stress: Stress) -> Stress:
        return Stress(self.tensor(stress.node), self.tensor(stress.cell))


def _row(values: list[float], like: Any) -> Array:
    """Return numbers in the array library, precision and device of an array."""
    return array_namespace(like).asarray(values, dtype=like.dtype, device=device(like))
