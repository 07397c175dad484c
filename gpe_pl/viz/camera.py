"""The camera: projection of points of a scene onto the picture."""

import math

import numpy as np
from jaxtyping import Float

from gpe_pl.geometry.shapes import Bowl
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.captions import SHOWN_OUTSIDE

ELEVATION, AZIMUTH = math.radians(24), math.radians(-60)
"""Direction from a 3D scene to the viewer: angle above the ground, and angle around the vertical."""

MARGIN = 0.015
"""Smallest margin, for the lines of walls, as a fraction of the longer side."""


def vertical_axis(trajectory: Trajectory) -> int:
    """Return the axis along which gravity is strongest; the last axis if there is no gravity."""
    gravity = np.abs(trajectory.metadata.gravity)
    return int(np.argmax(gravity)) if gravity.any() else trajectory.metadata.dim - 1


class Camera:
    """View of a scene. A 2D scene is shown unchanged. A 3D scene is seen obliquely from above in a parallel projection, so sizes do not depend on the distance.

    Attributes:
        plane: unit vectors to the right and upward in the picture [2, dim].
        toward: unit vector to the viewer [dim]; zero in 2D.
        low, high: corners in the picture [2] of the domain, or of the bowl in it, with a margin [m].
    """

    def __init__(self, trajectory: Trajectory) -> None:
        bounds = np.asarray(trajectory.metadata.bounds, float)
        if trajectory.metadata.dim == 2:
            self.plane, self.toward = np.eye(2), np.zeros(2)
        else:
            up = vertical_axis(trajectory)
            order = np.roll(np.arange(3), 2 - up)  # right-handed, with the vertical axis last
            sin, cos, rise = math.sin(AZIMUTH), math.cos(AZIMUTH), math.sin(ELEVATION)
            frame = np.zeros((3, 3))
            flat = math.cos(ELEVATION)
            frame[:, order] = [(-sin, cos, 0), (-rise * cos, -rise * sin, flat), (flat * cos, flat * sin, rise)]
            self.plane, self.toward = frame[:2], frame[2]
        corners = np.stack([m.ravel() for m in np.meshgrid(*bounds, indexing="ij")], axis=-1)
        on_paper, depth = self.project(corners)
        low, high = on_paper.min(axis=0), on_paper.max(axis=0)
        for shape in trajectory.boundary.shapes:
            if isinstance(shape, Bowl):  # everything happens inside the bowl
                center, _ = self.project(np.asarray(shape.center, float))
                low, high = np.maximum(low, center - shape.radius), np.minimum(high, center + shape.radius)
        margin = max(MARGIN * (high - low).max(), SHOWN_OUTSIDE * trajectory.metadata.spacing)
        self.low, self.high = low - margin, high + margin
        self._depth_range = float(depth.min()), float(depth.max())

    @property
    def aspect(self) -> float:
        """Height of the picture divided by its width."""
        width, height = self.high - self.low
        return float(height / width)

    def project(self, points: Float[np.ndarray, "*shape dim"]) -> tuple[Float[np.ndarray, "*shape 2"], Float[np.ndarray, "*shape"]]:
        """Return the positions of points in the picture [m], and their depths: distances from the origin towards the viewer [m]."""
        return points @ self.plane.T, np.asarray(points @ self.toward)

    def turn(self, directions: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
        """Return the components of directions to the right, upward and towards the viewer."""
        return directions @ np.stack([*self.plane, self.toward]).T

    def haze(self, depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Return the haze of points of these depths [m], from 1 at the far end of the domain to 0 at the near end; 0 in 2D."""
        far, near = self._depth_range
        return np.clip((near - depth) / (near - far), 0, 1) if near > far else np.zeros_like(depth)
