"""Static friction: nodes that rest on a wall and hardly move keep their positions.

The errors of a network at rest add up over frames, so that a heap creeps. A node is therefore kept in place if it is slower, before and after a step, than a
fraction of the speed that gravity gives in one frame. A resting node starts to move when the unbalanced part of gravity exceeds this fraction. Unsupported
nodes are accelerated by all of gravity and fall. Nodes are kept in place only if they have edges to a wall at rest that bears them, directly or through other
nodes, and no edges to a moving wall. A wall bears a node above it if it is no steeper than its angle of friction (Coulomb's law): a ceiling bears nothing, and
a slope of 45° only with a friction coefficient of 1 or more. Openings and prescribed nodes that move count as moving walls. Where they are at rest, they
hold nothing either. With static friction, the total forces of walls obey Coulomb's law, too (see ``nn.friction_cone``).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.schema import STICKY

LEVEL = 1e-4
"""Rounding that the cosine of a wall's slope may have, so that a frictionless level floor bears."""


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


def supported(contacts: WallContacts, gravity: Float[Tensor, " dim"]) -> Bool[Tensor, " island"]:
    """Return a mask of the islands that touch a wall that bears, and that nothing moves: no wall, opening or given motion."""
    walls = pushes = torch.zeros(contacts.is_pushed.shape[0], device=gravity.device)
    walls = walls.index_add(0, contacts.at, bears(contacts.normal, contacts.friction, gravity).to(walls.dtype))
    pushes = pushes.index_add(0, contacts.at, contacts.moves.to(pushes.dtype))
    return ~contacts.is_pushed & (walls > 0) & (pushes == 0)


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
