"""Static friction: what lies on a wall and hardly moves stays where it is.

A network is never exactly right, and what it is wrong by at rest adds up, frame by frame, to a heap that creeps. So nodes are held that are slower, before a
step and after it, than a share of what gravity gives within a frame: what rests starts to move when more than this share of gravity is left over. What nothing
supports gets all of it and falls. Only nodes are held that edges tie to a wall, directly or through others, and to none that moves.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor


def supported(is_free: Bool[Tensor, " island"], contacts: Iterable[tuple[Tensor, Tensor]]) -> Bool[Tensor, " island"]:
    """Islands that touch walls, none of which moves.

    Args:
        is_free: whether an island touches no wall.
        contacts: for edges to walls, the island [edge] at one end and whether the wall at the other moves [edge].
    """
    pushes = torch.zeros(is_free.shape[0], device=is_free.device)
    for island, is_moving in contacts:
        pushes = pushes.index_add(0, island, is_moving.to(pushes.dtype))
    return ~is_free & (pushes == 0)


def is_held(
    before: Float[Tensor, "node dim"],
    after: Float[Tensor, "node dim"],
    island: Int64[Tensor, " node"],
    is_supported: Bool[Tensor, " island"],
    speed: Float[Tensor, ""],
) -> Bool[Tensor, " node"]:
    """Nodes that stay where they are: in supported islands, and slower than ``speed`` [m/s] before and after a step."""
    slow = (before.square().sum(dim=1) < speed**2) & (after.square().sum(dim=1) < speed**2)
    return slow & is_supported[island]
