"""Topology of a graph: the indices that a search finds in a state. Features follow from a topology and a state by tensor operations alone.

``gpe_pl.graphs.search`` finds the topology of a state with NumPy and SciPy. An exported program takes the topology as its input.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from gpe_pl.errors import GpeError
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.schema import EdgeType


class GraphError(GpeError, ValueError):
    """Raised when a state does not fit the data set of the builder; the message says why."""


@dataclass(frozen=True)
class MeshTopology:
    """Virtual nodes above the meshes of a scene.

    Attributes:
        num_virtual: number of virtual nodes of each level, lowest level first.
        descent: pairs of a virtual node of any level (row 0, numbered from the lowest level up) and a node of the state below it (row 1). ``descent_of`` has a
            pair for every node and level; if the node has no ancestor in that level, row 0 has the total number of virtual nodes.
        rest_pos: undeformed positions of the nodes of the state [m]; in periodic domains the images that keep each body together.
        shift: vector to add to each position so that meshes stay in one piece at the seams of a periodic domain [m]; None stands for zero.
    """

    num_virtual: tuple[int, ...]
    descent: Int64[Tensor, "2 pair"]
    rest_pos: Float64[Tensor, "node dim"]
    shift: Float64[Tensor, "node dim"] | None = None


@dataclass(frozen=True)
class IslandTopology:
    """Groups of nodes that the edges connect.

    Attributes:
        label: island of each node of the state.
        is_free: whether an island has no edge to the boundary.
        body: for each material of meshes, the index of the body of each node. It is -1 in scenes without cells.
        num_bodies: number of bodies, or an upper bound of it.
        arm: positions relative to the centre of the island [m], for periodic domains. It is zero in an island that wraps around the domain. With None,
            it is computed from positions.
    """

    label: Int64[Tensor, " node"]
    is_free: Bool[Tensor, " island"]
    body: dict[str, Int64[Tensor, " _"]]
    num_bodies: int
    arm: Float64[Tensor, "node dim"] | None = None


@dataclass(frozen=True)
class Topology:
    """Indices of a graph.

    Attributes:
        rows: rows of each material's nodes in the state.
        edges: ``edge_index`` of each relation, as rows of the source's and the target's node store. A relation that is missing has no edges.
        boundary_rows: boundary nodes of the state that the graph has; None stands for all.
        mesh: virtual nodes; None in a scene without cells.
        islands: connected groups of nodes; None without ``GraphConfig.islands``.
        periodicity: axes along which edges take the shortest way around.
    """

    rows: dict[str, Int64[Tensor, " _"]]
    edges: dict[EdgeType, Int64[Tensor, "2 _"]]
    boundary_rows: Int64[Tensor, " boundary_node"] | None = None
    mesh: MeshTopology | None = None
    islands: IslandTopology | None = None
    periodicity: Periodicity = NOWHERE


def descent_of(parents: list[Int64[Tensor, " _"]], num_virtual: tuple[int, ...]) -> Int64[Tensor, "2 pair"]:
    """Return ``MeshTopology.descent`` of nodes whose parents are known level by level.

    Args:
        parents: for each level, the parent of every node of the level below, as a row of its level. A node without a parent has the number of virtual nodes of
            the level.
        num_virtual: number of virtual nodes of each level.
    """
    if not parents:
        return torch.empty(2, 0, dtype=torch.int64)
    total, first = sum(num_virtual), 0
    node = torch.arange(parents[0].shape[0])
    ancestor, above = node, []
    for parent, size in zip(parents, num_virtual, strict=True):
        ancestor = torch.cat([parent, parent.new_full((1,), size)])[ancestor]  # nodes without an ancestor here have none above
        above.append(torch.where(ancestor < size, first + ancestor, total))
        first += size
    return torch.stack([torch.cat(above), node.repeat(len(above))])
