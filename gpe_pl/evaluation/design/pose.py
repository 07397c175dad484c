"""Pose of an obstacle in 2D: a shift, and a turn about its centre. Gradients pass from its boundary nodes to the pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
import torch
from jaxtyping import Float64
from torch import Tensor

from gpe_pl.errors import GpeError
from gpe_pl.geometry.mesh_points import in_mesh
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, Wall, signed_distance
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

NAMES = ("shift x", "shift y", "angle")
"""Numbers of a pose: shift [m] and angle [rad]."""
UNITS = ("m", "m", "deg")
CLOSEST = 0.5
"""Poses between two checked ones move no point of the obstacle by more than this distance from one of them [spacings]."""


TOUCHES = "obstacle: it touches a wall or another obstacle; move it into free space"


class PoseError(GpeError, ValueError):
    """Raised for an obstacle that cannot be moved, or limits within which it touches other parts of the scene."""


@dataclass(frozen=True)
class Obstacle:
    """An obstacle that can be moved.

    Attributes:
        shape: its shape at the start.
        number: index of the shape in ``Boundary.shapes``.
        centre: centroid of the shape, about which it turns [2] in m.
        nodes: mask of its nodes among all boundary nodes.
    """

    shape: Sphere | Polygon
    number: int
    centre: np.ndarray
    nodes: np.ndarray

    @classmethod
    def of(cls, number: int, boundary: Boundary) -> Obstacle:
        """Return the obstacle of a shape, given by its index in the sampled boundary of its scene as arrays.

        Raises:
            PoseError: it is no disc or polygon in 2D (see ``movable`` for boxes), or touches another wall or obstacle.
        """
        shape = boundary.shapes[number]
        if boundary.pos.shape[1] != 2 or not isinstance(shape, Sphere | Polygon):
            what = f"{type(shape).__name__} in {boundary.pos.shape[1]}D"
            raise PoseError(f"obstacle: discs, polygons, and boxes as polygons can be moved in 2D, not {what}")
        if _Others.of(number, boundary, shape.extent / 50).distance(shape) <= 0:
            raise PoseError(TOUCHES)
        nodes = np.abs(shape.signed_distance(boundary.pos)) <= 1e-6 * shape.extent
        centre = np.array(shape.center if isinstance(shape, Sphere) else shapely.Polygon(shape.vertices).centroid.coords[0])
        return cls(shape, number, centre, nodes)

    def moved_shape(self, pose: Sequence[float]) -> Sphere | Polygon:
        """Return the shape at a pose."""
        if isinstance(self.shape, Sphere):
            center = np.asarray(self.shape.center) + np.asarray(pose[:2])
            return replace(self.shape, center=tuple(center.tolist()))
        corners = _corners(self.shape)
        moved = (
            _turned(torch.from_numpy(corners - self.centre), torch.tensor(float(pose[2]), dtype=torch.float64)).numpy()
            + self.centre
            + np.asarray(pose[:2])
        )
        return Polygon(tuple((float(x), float(y)) for x, y in moved), self.shape.friction, self.shape.restitution)

    def moved(self, state: State, pose: Float64[Tensor, "3"]) -> State:
        """Return a state of tensors with the nodes of the obstacle at a pose. Gradients pass to the pose."""
        boundary, rows = state.boundary, torch.from_numpy(self.nodes)[:, None]
        centre = torch.from_numpy(self.centre)
        pos = torch.where(rows, centre + pose[:2] + _turned(boundary.pos - centre, pose[2]), boundary.pos)
        normal = torch.where(rows, _turned(boundary.normal.to(pos.dtype), pose[2]).to(boundary.normal.dtype), boundary.normal)
        shape = self.moved_shape(pose.detach().tolist())
        shapes = tuple(shape if k == self.number else own for k, own in enumerate(boundary.shapes))
        return replace(state, boundary=replace(boundary, pos=pos, normal=normal, shapes=shapes))

    def check_limits(
        self, limits: Sequence[float], boundary: Boundary, pos: np.ndarray, spacing: float, cells: np.ndarray | None = None
    ) -> None:
        """Check that the obstacle can take every pose within limits.

        Args:
            limits: largest shifts [m] and angle [rad], of both signs.
            boundary: boundary of the scene, as arrays.
            pos: positions of nodes at the start [node, 2].
            spacing: rest spacing of nodes [m].
            cells: cells of meshes [cell, corner], if there are any.

        Raises:
            PoseError: at some pose it touches a wall, another obstacle, a node or a mesh; the message names the pose.
        """
        others = _Others.of(self.number, boundary, spacing)
        reach = float(np.linalg.norm(_corners(self.shape) - self.centre, axis=1).max())
        sets = [(np.zeros(3), np.asarray(limits, np.float64))]  # middle and half widths of sets of poses
        while sets:
            pose, half = sets.pop()
            shape = self.moved_shape(pose.tolist())
            to_walls = others.distance(shape)
            to_nodes = float(shape.signed_distance(pos).min(initial=math.inf))
            if cells is not None and in_mesh(shape.sample(spacing)[0], pos, cells).any():
                to_nodes = 0.0
            if min(to_walls, to_nodes) <= 0:
                touched = "a wall or another obstacle" if to_walls <= 0 else "the material"
                raise PoseError(f"shift, angle: at {text(pose.tolist())} the obstacle touches {touched}; choose smaller limits, or move it")
            moves = np.array([half[0], half[1], reach * half[2]])  # how far poses of the set move points of the obstacle
            if math.hypot(moves[0], moves[1]) + moves[2] > max(min(to_walls, to_nodes), CLOSEST * spacing):
                is_widest = np.arange(3) == int(moves.argmax())
                step, smaller = np.where(is_widest, half / 2, 0.0), np.where(is_widest, half / 2, half)
                sets += [(pose - step, smaller), (pose + step, smaller)]


@dataclass(frozen=True)
class _Others:
    """Walls and obstacles that the moved one must not touch.

    Attributes:
        shapes: their shapes.
        spacing: distance of points on surfaces [m].
        outlines: those that are polygons, or boxes in 2D.
        points: points on the surfaces of the others but walls, and how far these reach beyond the points [m].
    """

    shapes: tuple[Shape, ...]
    spacing: float
    outlines: tuple[shapely.Polygon, ...]
    points: tuple[tuple[np.ndarray, float], ...]

    @classmethod
    def of(cls, number: int, boundary: Boundary, spacing: float) -> _Others:
        """Return all shapes of a boundary but one, given by its index."""
        shapes = tuple(movable(own) for k, own in enumerate(boundary.shapes) if k != number)
        outlines = tuple(shapely.Polygon(own.vertices) for own in shapes if isinstance(own, Polygon))
        return cls(shapes, spacing, outlines, tuple(_points(own, spacing) for own in shapes if not isinstance(own, Wall)))

    def distance(self, shape: Sphere | Polygon) -> float:
        """Return the distance [m] of a shape from the nearest of the others; 0 or less if they touch.

        A surface between whose points a narrow part of the other shape fits has points of that part in it, and outlines may also cross without any.
        """
        points, radius = _points(shape, self.spacing)
        found = [float(signed_distance(self.shapes, points).min()) - radius] if self.shapes else []
        found += [float(shape.signed_distance(points).min()) - radius for points, radius in self.points]
        if isinstance(shape, Polygon):
            own = shapely.Polygon(shape.vertices)
            found += [float(own.distance(outline)) for outline in self.outlines]
        return min(found, default=math.inf)


def _points(shape: Shape, spacing: float) -> tuple[np.ndarray, float]:
    """Return points on the surface of a shape [point, 2], corners included, and 0; of a disc its centre and radius [m]."""
    return (np.array([shape.center]), shape.radius) if isinstance(shape, Sphere) else (shape.sample(spacing)[0], 0.0)


def movable(shape: Shape) -> Shape:
    """Return a shape as it can be moved: a box in 2D becomes the polygon with its outline [m], all others stay.

    Nodes at corners of a box have other normals than those of a polygon, and a box that is turned is a polygon. So a search that moved the nodes of the box
    would not search among the scenes that it returns.
    """
    if not isinstance(shape, Box) or len(shape.low) != 2:
        return shape
    (left, bottom), (right, top) = shape.low, shape.high
    return Polygon(((left, bottom), (right, bottom), (right, top), (left, top)), shape.friction, shape.restitution)


def text(pose: Sequence[float]) -> str:
    """Return a pose for readers."""
    return f"a shift of ({pose[0]:.3g}, {pose[1]:.3g}) m and an angle of {math.degrees(pose[2]):.3g}°"


def _corners(shape: Sphere | Polygon) -> np.ndarray:
    """Return the corners of a shape [corner, 2] in m, counter-clockwise; of a disc its centre."""
    return np.array([shape.center] if isinstance(shape, Sphere) else shape.vertices, float)


def _turned(vectors: Tensor, angle: Tensor) -> Tensor:
    """Return vectors [..., 2] turned counter-clockwise by an angle [rad]."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
