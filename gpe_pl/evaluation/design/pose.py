"""Pose of an obstacle in 2D: a shift, and a turn about its centre. Gradients pass from its boundary nodes to the pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from gpe_pl.errors import GpeError
from gpe_pl.geometry.mesh_points import in_mesh
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, signed_distance
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

NAMES = ("shift x", "shift y", "angle")
"""Numbers of a pose: shift [m] and angle [rad]."""
UNITS = ("m", "m", "deg")
CLOSEST = 0.5
"""Poses between two checked ones move no point of the obstacle by more than this distance from one of them [spacings]."""


class PoseError(GpeError, ValueError):
    """Raised for an obstacle that cannot be moved, or limits within which it touches other parts of the scene."""


@dataclass(frozen=True)
class Obstacle:
    """An obstacle that can be moved.

    Attributes:
        shape: its shape at the start.
        centre: point about which it turns [2] in m.
        nodes: mask of its nodes among all boundary nodes.
    """

    shape: Sphere | Polygon
    centre: np.ndarray
    nodes: np.ndarray

    @classmethod
    def of(cls, shape: Shape, boundary: Boundary) -> Obstacle:
        """Return the obstacle with a shape, given the sampled boundary of its scene as arrays.

        Raises:
            PoseError: it is no disc or polygon in 2D (see ``movable`` for boxes), or touches another wall or obstacle.
        """
        if boundary.pos.shape[1] != 2 or not isinstance(shape, Sphere | Polygon):
            what = f"{type(shape).__name__} in {boundary.pos.shape[1]}D"
            raise PoseError(f"obstacle: discs, polygons, and boxes as polygons can be moved in 2D, not {what}")
        others = tuple(other for other in boundary.shapes if other != shape)
        points, _ = shape.sample(shape.extent / 50)
        if others and bool((signed_distance(others, points) <= 0).any()):
            raise PoseError("obstacle: it touches a wall or another obstacle; move it into free space")
        nodes = np.abs(shape.signed_distance(boundary.pos)) <= 1e-6 * shape.extent
        return cls(shape, _corners(shape).mean(axis=0), nodes)

    def moved_shape(self, pose: Sequence[float]) -> Shape:
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
        shapes = tuple(shape if own == self.shape else own for own in boundary.shapes)
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
        others = tuple(other for other in boundary.shapes if other != self.shape)
        reach = float(np.linalg.norm(_corners(self.shape) - self.centre, axis=1).max())
        sets = [(np.zeros(3), np.asarray(limits, np.float64))]  # middle and half widths of sets of poses
        while sets:
            pose, half = sets.pop()
            shape = self.moved_shape(pose.tolist())
            points, _ = shape.sample(spacing)
            to_walls = float(signed_distance(others, points).min()) if others else math.inf
            to_nodes = float(shape.signed_distance(pos).min(initial=math.inf))
            if cells is not None and in_mesh(points, pos, cells).any():
                to_nodes = 0.0
            if min(to_walls, to_nodes) <= 0:
                touched = "a wall or another obstacle" if to_walls <= 0 else "the material"
                raise PoseError(f"shift, angle: at {text(pose.tolist())} the obstacle touches {touched}; choose smaller limits, or move it")
            moves = np.array([half[0], half[1], reach * half[2]])  # how far poses of the set move points of the obstacle
            if math.hypot(moves[0], moves[1]) + moves[2] > max(min(to_walls, to_nodes), CLOSEST * spacing):
                is_widest = np.arange(3) == int(moves.argmax())
                step, smaller = np.where(is_widest, half / 2, 0.0), np.where(is_widest, half / 2, half)
                sets += [(pose - step, smaller), (pose + step, smaller)]


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
