"""Strength of the edges within the radius: 1 at distances up to a fraction of it, and falling smoothly to 0 at the radius.

An edge appears when two nodes come within the radius. What depends on whether it exists would jump then. What depends on its strength does not. Nearest
neighbours in a material are at full strength if the radius is at least 1.25 spacings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import njit
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.nn.fused import works_on
from gpe_pl.nn.stores import contents
from gpe_pl.schema import BOUNDARY, RADIUS

FULL = 0.8
"""Distance over the radius up to which an edge has its full strength."""
TINY = 1e-12
"""Square of a distance over the radius that keeps gradients finite at zero distance."""


class Ties(NamedTuple):
    """Strongest edges of nodes and islands.

    Attributes:
        node: strength of the strongest edge of each node; 1 for nodes of bodies, which cells connect.
        wall: strength of the strongest edge of each island to a wall.
    """

    node: Float[Tensor, " node"]
    wall: Float[Tensor, " island"]


def strength(offset: Float[Tensor, "edge dim"]) -> Float[Tensor, " edge"]:
    """Return the strength of edges, given their displacements over the radius."""
    distance = (offset.square().sum(dim=1) + TINY).sqrt()
    t = ((1 - distance) / (1 - FULL)).clamp(0.0, 1.0)
    return t * t * (3 - 2 * t)


def ties(data: HeteroData, materials: Sequence[str], island: Int64[Tensor, " node"], count: int) -> Ties:
    """Return the strongest edges of the nodes of these materials, one material after the other.

    Args:
        data: graph.
        materials: materials.
        island: island of each node.
        count: number of islands, or an upper bound of it.
    """
    nodes, relations = contents(data)
    first, in_body = dict[str, int](), list[Tensor]()
    for m in materials:
        first[m] = sum(own.shape[0] for own in in_body)
        mass = nodes[m]["mass"]
        in_body.append((nodes[m]["body"] >= 0).to(mass) if "body" in nodes[m] else torch.zeros_like(mass))
    node = in_body[0] if len(in_body) == 1 else torch.cat(in_body)
    wall = node.new_zeros(count)
    edges = [
        (first.get(source, -1), first[target], store["edge_index"], store["offset"])
        for (source, name, target), store in relations.items()
        if name == RADIUS and target in first and (source == BOUNDARY or source in first)
    ]
    offsets = [offset for *_, offset in edges]
    if edges and works_on(*offsets) and not (torch.is_grad_enabled() and any(offset.requires_grad for offset in offsets)):
        for j, i, edge_index, offset in edges:
            arrays = edge_index.numpy(), np.ascontiguousarray(offset.detach().numpy())
            _strongest(j, i, *arrays, island.numpy(), node.numpy(), wall.numpy())
        return Ties(node, wall)
    for j, i, (source, target), offset in edges:
        own = strength(offset)
        node = node.scatter_reduce(0, i + target, own, "amax")
        if j < 0:
            wall = wall.scatter_reduce(0, island[i + target], own, "amax")
        else:
            node = node.scatter_reduce(0, j + source, own, "amax")
    return Ties(node, wall)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _strongest(first_source, first_target, edge_index, offset, island, node, wall):
    """Raise the strengths of nodes and islands to those of these edges, in place. Edges from walls have a negative ``first_source``."""
    for e in range(edge_index.shape[1]):
        i, j = first_target + edge_index[1, e], first_source + edge_index[0, e]
        if node[i] == 1.0 and (wall[island[i]] == 1.0 if first_source < 0 else node[j] == 1.0):
            continue  # at full strength already, as most
        square = 0.0
        for a in range(offset.shape[1]):
            square += offset[e, a] ** 2
        t = min(max((1.0 - np.sqrt(square + TINY)) / (1.0 - FULL), 0.0), 1.0)
        own = t * t * (3.0 - 2.0 * t)
        node[i] = max(node[i], own)
        if first_source < 0:
            wall[island[i]] = max(wall[island[i]], own)
        else:
            node[j] = max(node[j], own)
