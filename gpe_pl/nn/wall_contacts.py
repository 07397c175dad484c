"""Contacts of the islands of a scene with walls, by the edges of its graph."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int64
from torch import Tensor


@dataclass(frozen=True)
class WallContacts:
    """Edges of the nodes of a scene to walls, and what else acts on its islands.

    Attributes:
        island: island of each node of the scene.
        others_act: for each island, whether forces, given motion or openings act on its nodes.
        is_pushed: for each island, whether given motion or openings move some of its nodes in the present frame.
        at: island at each edge.
        normal: unit normal of the wall at each edge, into free space.
        friction: Coulomb coefficient of the wall at each edge.
        moves: whether the wall at each edge moves.
    """

    island: Int64[Tensor, " node"]
    others_act: Bool[Tensor, " island"]
    is_pushed: Bool[Tensor, " island"]
    at: Int64[Tensor, " edge"]
    normal: Float[Tensor, "edge dim"]
    friction: Float[Tensor, " edge"]
    moves: Bool[Tensor, " edge"]
