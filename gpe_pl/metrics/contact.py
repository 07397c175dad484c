"""Contact of bodies with walls and obstacles: when they touch, how long, and how high they bounce."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.trajectory.trajectory import Trajectory

FARTHEST = 1.5
"""A body whose closest approach in the ground truth is further away than this has no contact, in spacings. Particles of the material point solver stay up to
1.1 spacings away from the walls that they rest on; nodes of finite elements reach the surface."""

NEAR = 0.75
"""A body touches while its gap is at most the smallest gap in the ground truth plus this, in spacings. An obstacle's corner that touches the edge of a cell
between two nodes is half a spacing from both."""


def boundary_gaps(trajectory: Trajectory, bodies: list[Int64[np.ndarray, "_"]]) -> Float[np.ndarray, "frame body"]:
    """Return the smallest distance [m] of the nodes of each body to walls and obstacles.

    It is the signed distance to the shapes of a boundary. If the boundary moves or has no shapes, it is the distance to the nearest boundary node. It is
    infinite without a boundary.
    """
    boundary, pos = trajectory.boundary, trajectory.pos.astype(np.float64)
    if boundary.shapes and boundary.motion is None:
        distance = signed_distance(boundary.shapes, pos)
    elif len(boundary.pos):
        periodicity = trajectory.metadata.periodicity
        distance = np.stack([boundary.at(frame).tree(periodicity).query(x)[0] for frame, x in enumerate(pos)])
    else:
        distance = np.full(pos.shape[:2], np.inf)
    return np.stack([distance[:, nodes].min(axis=1) for nodes in bodies], axis=1)


def contact_limits(gap: Float[np.ndarray, "frame body"], spacing: float) -> Float[np.ndarray, "body"]:
    """Return the gap [m] below which each body touches, from the gaps in the ground truth; minus infinity for a body that never does."""
    closest = gap.min(axis=0, initial=np.inf)
    return np.where(closest <= FARTHEST * spacing, closest + NEAR * spacing, -np.inf)


def contact_times(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"], frame_dt: float) -> Float[np.ndarray, "body"]:
    """Return the time [s] for which each body touches. Gaps between frames are interpolated linearly."""
    with np.errstate(invalid="ignore"):
        above, below = np.maximum(gap - limit, 0.0), np.maximum(limit - gap, 0.0)
        above, below = above[1:] + above[:-1], below[1:] + below[:-1]
        inside = np.divide(below, above + below, out=np.zeros_like(below), where=np.isfinite(above) & (above + below > 0))
    return inside.sum(axis=0) * frame_dt


def has_touched(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]) -> Bool[np.ndarray, "frame body"]:
    """Return a mask of the frames from the first contact of each body on."""
    return np.logical_or.accumulate(gap <= limit, axis=0)


def in_first_contact(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]) -> Bool[np.ndarray, "frame body"]:
    """Return a mask of the frames of each body's first contact, up to the frame before it lets go."""
    touches = gap <= limit
    let_go = np.logical_or.accumulate(has_touched(gap, limit) & ~touches, axis=0)
    return touches & ~let_go


def bounce_heights(
    height: Float[np.ndarray, "frame body"], gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]
) -> Float[np.ndarray, "body"]:
    """Return the largest rise [m] of each body's centre of mass after its first contact, from the lowest point that it had reached since then.

    Args:
        height: height of the centre of mass [m].
        gap, limit: as for ``contact_times``.
    """
    since = has_touched(gap, limit)
    lowest = np.minimum.accumulate(np.where(since, height, np.inf), axis=0)
    return np.where(since, height - np.where(since, lowest, 0.0), 0.0).max(axis=0, initial=0.0)
