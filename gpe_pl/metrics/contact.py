"""Contact of bodies with walls and obstacles: when they touch, how long, and how high they bounce."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.trajectory.boundary import nodes_beside_shapes, search_tree
from gpe_pl.trajectory.trajectory import Trajectory

FARTHEST = 1.5
"""A body has no contact if its smallest gap to walls and obstacles in the ground truth exceeds this [rest spacings]. Particles of the material point solver
stay up to 1.1 spacings away from the walls that they rest on; nodes of finite elements reach the surface."""

NEAR = 0.75
"""A body is in contact while its gap exceeds the smallest gap in the ground truth by at most this [rest spacings]. A corner of an obstacle that touches the
middle of an edge is half a spacing away from both nodes of the edge."""


def boundary_gaps(trajectory: Trajectory, bodies: list[Int64[np.ndarray, "_"]]) -> Float[np.ndarray, "frame body"]:
    """Return the smallest distance [m] of the nodes of each body to walls and obstacles.

    It is the signed distance to the shapes of a boundary, or the distance to a boundary node that belongs to none of them, if that is nearer. If the boundary
    moves or has no shapes, it is the distance to the nearest boundary node. Nodes whose
    motion is given do not count, and neither do nodes in one cell with them, because a clamp at a wall is no contact. The gap is infinite without a boundary,
    and for a body without other nodes.
    """
    boundary, pos = trajectory.boundary, trajectory.pos.astype(np.float64)
    if boundary.shapes and boundary.motion is None:
        distance = signed_distance(boundary.shapes, pos)
        loose = boundary.pos[nodes_beside_shapes(boundary)]
        if len(loose):
            distance = np.minimum(distance, search_tree(loose, trajectory.metadata.periodicity).query(pos)[0])
    elif len(boundary.pos):
        periodicity = trajectory.metadata.periodicity
        distance = np.stack([boundary.at(frame).tree(periodicity).query(x)[0] for frame, x in enumerate(pos)])
    else:
        distance = np.full(pos.shape[:2], np.inf)
    free = ~_near_held_nodes(trajectory)
    return np.stack([distance[:, nodes[free[nodes]]].min(axis=1, initial=np.inf) for nodes in bodies], axis=1)


def _near_held_nodes(trajectory: Trajectory) -> Bool[np.ndarray, "node"]:
    """Return a mask of the nodes whose motion is given along an axis, and of those in one cell with them."""
    if trajectory.prescribed is None:
        return np.zeros(trajectory.num_nodes, bool)
    held = np.asarray(trajectory.prescribed.any(axis=1))
    near = held.copy()
    if trajectory.cells is not None:
        near[trajectory.cells[held[trajectory.cells].any(axis=1)]] = True
    return near


def contact_limits(gap: Float[np.ndarray, "frame body"], spacing: float) -> Float[np.ndarray, "body"]:
    """Return the largest gap [m] at which each body counts as in contact, from its gaps in the ground truth; minus infinity for a body without contact."""
    closest = gap.min(axis=0, initial=np.inf)
    return np.where(closest <= FARTHEST * spacing, closest + NEAR * spacing, -np.inf)


def contact_times(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"], frame_dt: float) -> Float[np.ndarray, "body"]:
    """Return the time [s] for which each body is in contact. Gaps between frames are interpolated linearly.

    Args:
        gap: gaps of the bodies to walls and obstacles [m].
        limit: largest gap of each body in contact [m], see ``contact_limits``.
        frame_dt: time between frames [s].
    """
    with np.errstate(invalid="ignore"):
        above, below = np.maximum(gap - limit, 0.0), np.maximum(limit - gap, 0.0)
        above, below = above[1:] + above[:-1], below[1:] + below[:-1]
        inside = np.divide(below, above + below, out=np.zeros_like(below), where=np.isfinite(above) & (above + below > 0))
    return inside.sum(axis=0) * frame_dt


def has_touched(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]) -> Bool[np.ndarray, "frame body"]:
    """Return a mask of the frames from each body's first contact to the end; arguments as for ``contact_times``."""
    return np.logical_or.accumulate(gap <= limit, axis=0)


def in_first_contact(gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]) -> Bool[np.ndarray, "frame body"]:
    """Return a mask of the frames of each body's first contact, until its gap first exceeds the limit again; arguments as for ``contact_times``."""
    touches = gap <= limit
    let_go = np.logical_or.accumulate(has_touched(gap, limit) & ~touches, axis=0)
    return touches & ~let_go


def bounce_heights(
    height: Float[np.ndarray, "frame body"], gap: Float[np.ndarray, "frame body"], limit: Float[np.ndarray, "body"]
) -> Float[np.ndarray, "body"]:
    """Return the largest rise [m] of each body's centre of mass after its first contact.

    In each frame, the rise is measured from the lowest point that the centre has reached since the first contact.

    Args:
        height: height of the centre of mass [m].
        gap, limit: as for ``contact_times``.
    """
    since = has_touched(gap, limit)
    lowest = np.minimum.accumulate(np.where(since, height, np.inf), axis=0)
    return np.where(since, height - np.where(since, lowest, 0.0), 0.0).max(axis=0, initial=0.0)
