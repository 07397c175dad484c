"""Topology of a graph: the indices that a search finds in a state. Features follow from a topology and a state by tensor operations alone.

``gpe_pl.graphs.search`` finds the topology of a state with NumPy and SciPy. An exported program takes the topology as its input.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from gpe_pl.errors import GpeError
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.schema import CELL, EdgeType, level_of


class GraphError(GpeError, ValueError):
    """Raised when a state does not fit the data set of the builder; the message says why."""


@dataclass(frozen=True)
class MeshEdges:
    """Edges of meshes between points: the nodes of the state, followed by the virtual nodes in the order of their levels.

    Attributes:
        relations: relations in the order of their edges, those along cells first.
        counts: number of edges of each relation.
        ends: source (row 0) and target (row 1) of the edges of all relations.
    """

    relations: tuple[EdgeType, ...]
    counts: tuple[int, ...]
    ends: Int64[Tensor, "2 edge"]

    @property
    def num_cell_relations(self) -> int:
        """Number of relations along cells, which come first."""
        return sum(name == CELL for _, name, _ in self.relations)

    @cached_property
    def starts(self) -> Int64[np.ndarray, " _"]:
        """First edge of each relation, and the number of edges."""
        return np.cumsum([0, *self.counts])

    @cached_property
    def levels(self) -> Float64[np.ndarray, " relation"]:
        """Level of the sources of each relation; 0 for edges along cells."""
        return np.array([0.0 if name == CELL else float(level_of(source)) for source, name, _ in self.relations])


@dataclass(frozen=True)
class MeshTopology:
    """Virtual nodes above the meshes of a scene.

    Attributes:
        num_virtual: number of virtual nodes of each level, lowest level first.
        descent: pairs of a virtual node of any level (row 0, numbered from the lowest level up) and a node of the state below it (row 1). A pair without a
            virtual node has the total number of virtual nodes in row 0; ``descent_of`` makes such pairs.
        rest_pos: undeformed positions of the nodes of the state [m]; in periodic domains the images that keep each body together.
        shift: vector to add to each position so that meshes stay in one piece at the seams of a periodic domain [m]; None stands for zero.
        edges: edges between points, for the compiled features; None where they are not needed.
    """

    num_virtual: tuple[int, ...]
    descent: Int64[Tensor, "2 pair"]
    rest_pos: Float64[Tensor, "node dim"]
    shift: Float64[Tensor, "node dim"] | None = None
    edges: MeshEdges | None = None

    def to(self, device: torch.device) -> MeshTopology:
        """Return the same virtual nodes on a device, without the edges between points unless it is the CPU."""
        if device.type == "cpu":
            return self
        shift = None if self.shift is None else self.shift.to(device)
        return MeshTopology(self.num_virtual, self.descent.to(device), self.rest_pos.to(device), shift)


@dataclass(frozen=True)
class IslandTopology:
    """Groups of nodes that the edges connect.

    Attributes:
        label: island of each node of the state.
        is_held: whether a given motion or an opening moves a node of an island.
        body: for each material of meshes, the index of the body of each node. It is -1 in scenes without cells.
        num_bodies: number of bodies, or an upper bound of it.
        arm: positions relative to the mean of the island [m], for periodic domains; zero in an island that wraps around the domain. None if they follow from
            positions alone.
        body_arm: for each material of meshes, positions relative to the mean of the body [m], for periodic domains; None elsewhere, where ``arm`` is as good.
    """

    label: Int64[Tensor, " node"]
    is_held: Bool[Tensor, " island"]
    body: dict[str, Int64[Tensor, " _"]]
    num_bodies: int
    arm: Float64[Tensor, "node dim"] | None = None
    body_arm: dict[str, Float64[Tensor, "_ dim"]] | None = None

    def to(self, device: torch.device) -> IslandTopology:
        """Return the same islands on a device."""
        if device.type == "cpu":
            return self
        body = {m: b.to(device) for m, b in self.body.items()}
        arm = None if self.arm is None else self.arm.to(device)
        body_arm = None if self.body_arm is None else {m: b.to(device) for m, b in self.body_arm.items()}
        return IslandTopology(self.label.to(device), self.is_held.to(device), body, self.num_bodies, arm, body_arm)


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
    """Return ``MeshTopology.descent`` from the parents of nodes, level by level. The result has a pair for every node and level.

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
