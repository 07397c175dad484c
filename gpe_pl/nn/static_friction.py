"""Static friction: nodes that rest on a wall and hardly move keep their positions.

The errors of a network at rest add up over frames, so that a heap creeps. A node is therefore kept in place if it is slower, before and after a step, than a
fraction of the speed that gravity gives in one frame. A resting node starts to move when the unbalanced part of gravity exceeds this fraction. Unsupported
nodes are accelerated by all of gravity and fall. Nodes are kept in place only if they have edges to a wall at rest, directly or through other nodes, and no
edges to a moving wall. Openings and prescribed nodes that move count as moving walls. Where they are at rest, they hold nothing either.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.state import State


def supported(is_free: Bool[Tensor, " island"], contacts: Iterable[tuple[Tensor, Tensor]]) -> Bool[Tensor, " island"]:
    """Return a mask of the islands that touch walls, none of which moves.

    Args:
        is_free: whether nothing outside touches an island. Openings and prescribed nodes do.
        contacts: for edges to walls, the island at one end [edge] and whether the wall at the other end moves [edge].
    """
    walls = pushes = torch.zeros(is_free.shape[0], device=is_free.device)
    for island, is_moving in contacts:
        walls = walls.index_add(0, island, torch.ones_like(is_moving, dtype=walls.dtype))
        pushes = pushes.index_add(0, island, is_moving.to(pushes.dtype))
    return ~is_free & (walls > 0) & (pushes == 0)


def pushed(state: State, island: Int64[Tensor, " node"], dt: float) -> list[tuple[Tensor, Tensor]]:
    """Return contacts, as in ``supported``, of the nodes that openings or given motion move in the frame of ``dt`` [s] that begins with a state."""
    if not state.openings and state.loads is None:
        return []
    pos, moves = as_numpy(state.pos), np.zeros(state.num_nodes, bool)
    for opening in state.openings:
        if opening.drives and opening.mean_velocity(state.time, state.time + dt).any():
            moves |= opening.contains(pos)
    if state.loads is not None:
        moves[state.loads.rows] |= (state.loads.next_positions() != state.loads.path[0]).any(axis=1)
    moving = island[torch.from_numpy(np.flatnonzero(moves)).to(island.device)]
    return [(moving, torch.ones_like(moving, dtype=torch.bool))]


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
