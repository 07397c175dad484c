"""Mirror images and rotations of scenes. The image of a motion obeys the same laws of physics if gravity is mapped, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product
from typing import Any, Protocol

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.geometry.shape_images import image_of
from gpe_pl.geometry.shapes import Shape
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Trajectory

Array = Any

LEVEL = 1e-9
"""Gravity along an axis counts as none if it is smaller than this fraction of its length, as rounding makes it."""
ONE_WAY = 0.05
"""Walls face mostly one way along an axis if the mean of this component of their normals is larger. The mean is 0 over closed surfaces."""


def level_axes(gravity: Sequence[float], normal: Array) -> list[int]:
    """Return the axes along which a scene may be mirrored and moved: those without gravity.

    Without any gravity, an axis along which walls face mostly one way counts as the vertical and is left out. Data may store no gravity because another force
    balances it, as in liquids that fall at their terminal velocity; their scenes still have a floor, and no ceiling. Obstacles in a scene face both ways.

    Args:
        gravity: gravity [dim] in m/s².
        normal: unit normals of walls [boundary_node, dim].
    """
    if any(float(pull) != 0 for pull in gravity):
        return without_gravity(gravity)
    return [axis for axis in range(len(gravity)) if abs(float(normal[:, axis].sum())) <= ONE_WAY * normal.shape[0]]


def without_gravity(gravity: Sequence[float]) -> list[int]:
    """Return the axes along which there is no gravity [m/s²], up to rounding."""
    size = max(abs(float(pull)) for pull in gravity)
    return [axis for axis, pull in enumerate(gravity) if abs(float(pull)) <= LEVEL * size]


class Isometry(Protocol):
    """A map of space that keeps lengths, given by its images of points, vectors and symmetric tensors."""

    def vector(self, x: Array) -> Array:
        """Return the images of vectors [..., dim]."""

    def point(self, x: Array) -> Array:
        """Return the images of positions [..., dim] in m."""

    def tensor(self, x: Array) -> Array:
        """Return the images of stresses [..., component], in the order of ``schema.STRESS_COMPONENTS``."""

    def boundary(self, boundary: Boundary) -> Boundary:
        """Return the image of a boundary. It has shapes if all of its shapes have images."""
        motion = boundary.motion
        if motion is not None:
            motion = BoundaryMotion(self.point(motion.pos), self.vector(motion.vel), self.vector(motion.normal))
        return replace(
            boundary,
            pos=self.point(boundary.pos),
            vel=self.vector(boundary.vel),
            normal=self.vector(boundary.normal),
            shapes=self.shapes(boundary.shapes),
            motion=motion,
        )

    def shapes(self, shapes: Sequence[Shape]) -> tuple[Shape, ...]:
        """Return the images of all walls and obstacles (``image_of``), or none if one of them has no image."""

    def openings(self, openings: tuple[Opening, ...]) -> tuple[Opening, ...]:
        """Return the images of inlets and outlets.

        Raises:
            ValueError: there are some, and the map turns them.
        """
        if openings:
            raise ValueError("inlets and outlets lie along the axes, so they cannot be turned")
        return openings

    def state(self, state: State, boundary: Boundary) -> State:
        """Return the image of a state, given that of its boundary. ``periodicity`` and ``internal`` stay as they are."""
        history, rest_pos, stress, loads = state.velocity_history, state.rest_pos, state.stress, state.loads
        if loads is not None:
            loads = replace(loads, path=self.point(loads.path), force=None if loads.force is None else self.vector(loads.force))
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
            loads=loads,
            openings=self.openings(state.openings),
        )

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return the image of a trajectory. Its metadata, with gravity and domain, stay as they are."""
        rest_pos, stress = trajectory.rest_pos, trajectory.stress
        return replace(
            trajectory,
            pos=self.point(trajectory.pos),
            vel=self.vector(trajectory.vel),
            rest_pos=None if rest_pos is None else self.point(rest_pos),
            stress=None if stress is None else self._stress(stress),
            boundary=self.boundary(trajectory.boundary),
            force=None if trajectory.force is None else self.vector(trajectory.force),
        )

    def _stress(self, stress: Stress) -> Stress:
        return Stress(self.tensor(stress.node), self.tensor(stress.cell))


@dataclass(frozen=True)
class Reflection(Isometry):
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

    def shapes(self, shapes: Sequence[Shape]) -> tuple[Shape, ...]:
        """Return the images of all walls and obstacles, or none if one of them has no image."""
        return _images(shapes, np.diag(self.vector(np.ones(len(self.planes)))), self.point(np.zeros(len(self.planes))))

    def openings(self, openings: tuple[Opening, ...]) -> tuple[Opening, ...]:
        """Return the images of inlets and outlets, with their sides."""
        return tuple(map(self._opening, openings))

    def _opening(self, opening: Opening) -> Opening:
        ends = np.sort([self.point(np.array(corner, np.float64)) for corner in (opening.low, opening.high)], axis=0)
        side = opening.side
        if self.planes[opening.axis] is not None:
            axis, _, end = side.partition("_")
            side = f"{axis}_{'high' if end == 'low' else 'low'}"
        return replace(opening, low=tuple(ends[0].tolist()), high=tuple(ends[1].tolist()), side=side)

    def tensor(self, x: Array) -> Array:
        """Return the images of stresses [..., component], in the order of ``schema.STRESS_COMPONENTS``. Some shears change sign."""
        turned = [plane is not None for plane in self.planes]
        pairs = [(0, 0), (0, 1), (1, 1)] if len(turned) == 2 else [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        signs = [-1.0 if turned[i] != turned[j] else 1.0 for i, j in pairs] + [1.0] * (len(turned) == 2)
        return x * _row(signs, x)

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return the image of a trajectory; the same object if there are no planes. The planes must map gravity and the domain onto themselves."""
        return trajectory if all(plane is None for plane in self.planes) else super().trajectory(trajectory)


@dataclass(frozen=True)
class Rotation(Isometry):
    """Rotation of scenes, with NumPy arrays.

    Attributes:
        matrix: rotation of vectors [dim, dim].
        centre: point that stays [dim] in m.
    """

    matrix: np.ndarray
    centre: np.ndarray

    @classmethod
    def about(cls, axis: int, angle: float, centre: Sequence[float]) -> Rotation:
        """Return the rotation by an angle [rad] about an axis of coordinates through a point [3] in m."""
        first, second = (axis + 1) % 3, (axis + 2) % 3
        matrix = np.eye(3)
        matrix[[first, first, second, second], [first, second, first, second]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        return cls(matrix, np.asarray(centre, float))

    @classmethod
    def between_axes(cls, number: int, centre: Sequence[float]) -> Rotation:
        """Return one of the rotations about a point [dim] in m that map axes onto axes: 4 in 2D, 24 in 3D, numbered from 0, the identity."""
        return cls(_between_axes(len(centre))[number], np.asarray(centre, float))

    def vector(self, x: Array) -> Array:
        """Return the images of vectors [..., dim]."""
        return (x @ self.matrix.T).astype(x.dtype)

    def point(self, x: Array) -> Array:
        """Return the images of positions [..., dim] in m."""
        return ((x - self.centre) @ self.matrix.T + self.centre).astype(x.dtype)

    def shapes(self, shapes: Sequence[Shape]) -> tuple[Shape, ...]:
        """Return the images of all walls and obstacles; none if one of them has no image, or axes are not mapped onto axes."""
        matrix = np.round(self.matrix)
        is_quarter_turn = np.abs(self.matrix - matrix).max() < LEVEL
        return _images(shapes, matrix, self.centre - matrix @ self.centre) if is_quarter_turn else ()

    def tensor(self, x: Array) -> Array:
        """Return the images of stresses [..., component], in the order of ``schema.STRESS_COMPONENTS``."""
        dim = len(self.centre)
        places, rows = ([0, 1, 1, 2], [0, 1, 3]) if dim == 2 else ([0, 1, 2, 1, 3, 4, 2, 4, 5], [0, 1, 2, 4, 5, 8])
        turned = self.matrix @ x[..., places].reshape(*x.shape[:-1], dim, dim) @ self.matrix.T
        in_plane = turned.reshape(*x.shape[:-1], dim**2)[..., rows]
        return np.concatenate([in_plane, x[..., len(rows) :]], axis=-1).astype(x.dtype)


def _images(shapes: Sequence[Shape], matrix: np.ndarray, shift: np.ndarray) -> tuple[Shape, ...]:
    """Return the images of all shapes (``image_of``), or none if one of them has no image."""
    images = [image_of(shape, matrix, shift) for shape in shapes]
    return () if None in images else tuple(image for image in images if image is not None)


@cache
def _between_axes(dim: int) -> list[np.ndarray]:
    """Return the rotations [dim, dim] that map axes onto axes; the first is the identity."""
    signed = (
        np.eye(dim)[list(order)] * np.array(signs) for order in permutations(range(dim)) for signs in product((1.0, -1.0), repeat=dim)
    )
    return [matrix for matrix in signed if np.linalg.det(matrix) > 0]


def _row(values: list[float], like: Any) -> Array:
    """Return numbers in the array library, precision and device of an array."""
    return array_namespace(like).asarray(values, dtype=like.dtype, device=device(like))
