"""Static friction: nodes that rest on a wall and hardly move keep their positions.

The errors of a network at rest add up over frames, so that a heap creeps. A node is therefore kept in place if it is slower, before and after a step, than a
fraction of the speed that gravity gives in one frame. A resting node starts to move when the unbalanced part of gravity exceeds this fraction. Unsupported
nodes are accelerated by all of gravity and fall. Nodes are kept in place only if they have edges to a wall at rest that bears them, directly or through other
nodes, and no edges to a moving wall. A wall bears a node above it if it is no steeper than its angle of friction (Coulomb's law): a ceiling bears nothing, and
a slope of 45° only with a friction coefficient of 1 or more. Openings and prescribed nodes that move count as moving walls. Where they are at rest, they
hold nothing either.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gpe_pl.schema import STICKY
from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.state import State

LEVEL = 1e-4
"""Rounding that the cosine of a wall's slope may have, so that a frictionless level floor bears."""

Contacts = tuple[Int64[Tensor, " edge"], Bool[Tensor, " edge"], Bool[Tensor, " edge"]]
"""For edges to walls: the island at one end, and whether the wall at the other end moves and whether it bears (``bears``)."""


def bears(
    normal: Float[Tensor, "boundary_node dim"], friction: Float[Tensor, " boundary_node"], gravity: Float[Tensor, " dim"]
) -> Bool[Tensor, " boundary_node"]:
    """Return a mask of the wall nodes on which something can rest: the slope is at most the angle of friction.

    Args:
        normal: unit normals into free space.
        friction: Coulomb coefficients.
        gravity: acceleration by gravity [m/s²]. Without it, no wall bears.
    """
    along = -(normal @ gravity.to(normal.dtype))
    return along > (1 - LEVEL) * gravity.norm() / (1 + friction.clamp(max=STICKY).square()).sqrt()


def supported(is_free: Bool[Tensor, " island"], contacts: Iterable[Contacts]) -> Bool[Tensor, " island"]:
    """Return a mask of the islands that touch a wall that bears, and none that moves.

    Args:
        is_free: whether nothing outside touches an island. Openings and prescribed nodes do.
        contacts: edges to walls.
    """
    walls = pushes = torch.zeros(is_free.shape[0], device=is_free.device)
    for island, is_moving, is_bearing in contacts:
        walls = walls.index_add(0, island, is_bearing.to(walls.dtype))
        pushes = pushes.index_add(0, island, is_moving.to(pushes.dtype))
    return ~is_free & (walls > 0) & (pushes == 0)


def pushed(state: State, island: Int64[Tensor, " node"], dt: float) -> list[Contacts]:
    """Return contacts of the nodes that openings or given motion move in the frame of ``dt`` [s] that begins with a state."""
    if not state.openings and state.loads is None:
        return []
    pos, is_moved = as_numpy(state.pos), np.zeros(state.num_nodes, bool)
    for opening in state.openings:
        if opening.drives and opening.mean_velocity(state.time, state.time + dt).any():
            is_moved |= opening.contains(pos)
    if state.loads is not None:
        is_moved[state.loads.rows] |= (state.loads.next_positions() != state.loads.path[0]).any(axis=1)
    moving = island[torch.from_numpy(np.flatnonzero(is_moved)).to(island.device)]
    moves = torch.ones_like(moving, dtype=torch.bool)
    return [(moving, moves, ~moves)]


def keeps_position(
    before: Float[Tensor, "node dim"],
    after: Float[Tensor, "node dim"],
    island: Int64[Tensor, " node"],
    is_supported: Bool[Tensor, " island"],
    speed: Float[Tensor, ""],
) -> Bool[Tensor, " node"]:
    """Return a mask of the nodes that keep their positions.

    Args:
        before: velocities before the step [m/s].
        after: velocities after the step [m/s].
        island: island of each node.
        is_supported: whether each island rests on walls, see ``supported``.
        speed: speed below which a node keeps its position, both before and after the step [m/s].
    """
    slow = (before.square().sum(dim=1) < speed**2) & (after.square().sum(dim=1) < speed**2)
    return slow & is_supported[island]
