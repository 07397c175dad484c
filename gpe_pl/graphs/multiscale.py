"""The multi-scale graph of meshes: cell edges, and levels of virtual nodes above every connected body (paper, section 2.2).

A virtual node of level l represents the mesh nodes in a box of the rest configuration that is 2^l rest spacings wide. The boxes form a quadtree or octree. This
works for any mesh, and on a lattice every virtual node has exactly 2×2(×2) children. The body lies in the middle of its root's box, so that siblings are of
similar size.

Only the positions of virtual nodes change with time. The graph of a mesh is therefore built once and cached by the content of its arrays. All frames of a
rollout and all windows of a trajectory use the same object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gpe_pl.errors import GpeError
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.graphs.islands import unwrapped
from gpe_pl.trajectory.boundary import search_tree
from gpe_pl.trajectory.cells import cell_edges, components, pair_keys, unique_pairs

SNAP = 1e-3
"""Nodes this near below the face of a box count as on it [rest spacings]. Rounding then does not divide a row of a lattice between two boxes."""

MAX_CACHED = 1024
"""Largest number of multi-scale graphs kept in memory; a graph of a thousand nodes takes about 0.2 MB."""

REACH = 2.0
"""Distance within which a node without a cell belongs to a body [rest spacings]. It is longer than the diagonal of a cubic cell."""


class MeshError(GpeError, ValueError):
    """Raised when cells and rest positions do not form a mesh; the message names the cell or node."""


@dataclass(frozen=True, eq=False)
class MultiscaleGraph:
    """The part of a mesh's graph that does not change with time.

    Points are the nodes of the state, followed by the virtual nodes in the order of their levels.

    Attributes:
        rest_pos: undeformed positions of the nodes of the state [m]; in a periodic domain the images that keep bodies together.
        body: connected body of each point; a node without a cell is a body of its own.
        level: level of each point, 0 for the nodes of the state.
        parent: virtual node one level up. It is -1 for roots, for nodes without a cell, and at the highest level of bodies that would have more levels than
            ``num_levels``.
        cell_edges: pairs of nodes with a common cell, the lower node first.
        same_edges: pairs of neighbouring virtual nodes of one level and body, by level.
        down_edges: pairs of a virtual node and each of its children, by level.
        descent: pairs of a virtual node and each mesh node below it.
    """

    rest_pos: Float64[np.ndarray, "node dim"]
    body: Int64[np.ndarray, "point"]
    level: Int64[np.ndarray, "point"]
    parent: Int64[np.ndarray, "point"]
    cell_edges: Int64[np.ndarray, "2 cell_edge"]
    same_edges: Int64[np.ndarray, "2 same_edge"]
    down_edges: Int64[np.ndarray, "2 down_edge"]
    descent: Int64[np.ndarray, "2 pair"]

    @property
    def num_nodes(self) -> int:
        """Number of nodes of the state."""
        return len(self.rest_pos)

    def moving_bodies(
        self, kind: Int64[np.ndarray, " node"], spacing: float, periodicity: Periodicity = NOWHERE
    ) -> tuple[Int64[np.ndarray, " node"], Int64[np.ndarray, "2 bond"]]:
        """Return the body that each node of the state moves with, and the bonds: pairs of a node without a cell and the node beside it that has its body.

        A node without a cell moves with the body of its kind that lies within ``REACH`` spacings at rest, directly or through other nodes without a cell. If
        there is no such body, the node is a body of its own.

        Args:
            kind: node types.
            spacing: rest spacing [m].
            periodicity: axes along which space repeats.
        """
        return _moving_bodies(self, kind.tobytes(), spacing, periodicity)

    def are_in_contact(self, pairs: Int64[np.ndarray, "2 edge"], radius: float) -> Bool[np.ndarray, " edge"]:
        """Return a mask of the pairs of nodes that are contacts, given pairs of nodes whose present distance is below the radius [m].

        A pair of nodes of two bodies is a contact. A pair within one body is a contact if its nodes are more than two radii apart at rest and have no
        common cell.
        """
        j, i = pairs
        contact = self.body[j] != self.body[i]
        inside = np.flatnonzero(~contact)
        far = ((self.rest_pos[i[inside]] - self.rest_pos[j[inside]]) ** 2).sum(axis=1) > (2 * radius) ** 2
        inside = inside[far]
        contact[inside] = ~np.isin(pair_keys(pairs[:, inside], self.num_nodes), pair_keys(self.cell_edges, self.num_nodes))
        return contact


def levels_of(extent: float, spacing: float) -> int:
    """Return the number of levels of virtual nodes that gives every body in a domain of longest side ``extent`` [m] one root, ⌈log₂(extent / spacing)⌉."""
    return max(1, math.ceil(math.log2(extent / spacing)))


def multiscale_graph(
    rest_pos: Float64[np.ndarray, "node dim"],
    cells: Int64[np.ndarray, "cell corner"],
    spacing: float,
    num_levels: int,
    periodicity: Periodicity = NOWHERE,
) -> MultiscaleGraph:
    """Return the multi-scale graph of a mesh, built once for equal arguments; its arrays are read-only.

    Args:
        rest_pos: undeformed positions [m].
        cells: nodes of each cell.
        spacing: rest spacing [m].
        num_levels: largest number of levels of virtual nodes. A body has fewer levels if its root is lower.
        periodicity: axes along which space repeats.

    Raises:
        MeshError: a cell has a node that does not exist, or a rest position is not finite.
    """
    rest_pos, cells = np.ascontiguousarray(rest_pos, np.float64), np.ascontiguousarray(cells, np.int64)
    return _cached(rest_pos.tobytes(), rest_pos.shape, cells.tobytes(), cells.shape, spacing, num_levels, periodicity)


@lru_cache(maxsize=MAX_CACHED)
def _cached(
    rest_pos: bytes,
    rest_shape: tuple[int, ...],
    cells: bytes,
    cells_shape: tuple[int, ...],
    spacing: float,
    num_levels: int,
    periodicity: Periodicity,
) -> MultiscaleGraph:
    nodes, corners = np.frombuffer(rest_pos).reshape(rest_shape), np.frombuffer(cells, np.int64).reshape(cells_shape)
    graph = build(nodes, corners, spacing, num_levels, periodicity)
    for array in vars(graph).values():
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return graph


@lru_cache(maxsize=MAX_CACHED)
def _moving_bodies(
    graph: MultiscaleGraph, kind: bytes, spacing: float, periodicity: Periodicity
) -> tuple[Int64[np.ndarray, " node"], Int64[np.ndarray, "2 bond"]]:
    body, kinds = graph.body[: graph.num_nodes].copy(), np.frombuffer(kind, np.int64)
    bonds, inside = [np.empty((2, 0), np.int64)], periodicity.from_corner(graph.rest_pos) if periodicity else graph.rest_pos
    is_placed = np.zeros(graph.num_nodes, dtype=bool)
    is_placed[graph.cell_edges] = True
    for code in np.unique(kinds):
        loose = np.flatnonzero((kinds == code) & ~is_placed)
        placed = np.flatnonzero((kinds == code) & is_placed)
        while len(loose) and len(placed):  # then those beside the ones that found their body
            distance, nearest = search_tree(graph.rest_pos[placed], periodicity).query(inside[loose])
            found = distance <= REACH * spacing
            body[loose[found]] = body[placed[nearest[found]]]
            bonds.append(np.stack([placed[nearest[found]], loose[found]]))
            loose, placed = loose[~found], loose[found]
    pairs = np.concatenate(bonds, axis=1)
    body.setflags(write=False)
    pairs.setflags(write=False)
    return body, pairs


def build(rest_pos: np.ndarray, cells: np.ndarray, spacing: float, num_levels: int, periodicity: Periodicity = NOWHERE) -> MultiscaleGraph:
    """Do the same as ``multiscale_graph`` without the cache."""
    num_nodes = len(rest_pos)
    bad = np.flatnonzero(((cells < 0) | (cells >= num_nodes)).any(axis=1))
    if len(bad):
        raise MeshError(f"cell {bad[0]} has the nodes {cells[bad[0]].tolist()}, there are {num_nodes} nodes")
    bad = np.flatnonzero(~np.isfinite(rest_pos).all(axis=1))
    if len(bad):
        raise MeshError(f"node {bad[0]} has a rest position that is not finite")
    edges = cell_edges(cells, num_nodes)
    rest_pos, _ = unwrapped(rest_pos, edges, periodicity)
    num_bodies, body = components(edges, num_nodes)

    nodes = np.unique(cells)  # in cells
    box, depth = _smallest_boxes(rest_pos, nodes, body, num_bodies, spacing)
    bodies, boxes, levels, parents = [body], [box], [np.zeros(num_nodes, dtype=np.int64)], []
    same, descent = [np.empty((2, 0), dtype=np.int64)], [np.empty((2, 0), dtype=np.int64)]
    children, lower_edges, ancestor, first = nodes, edges, np.arange(num_nodes), 0  # of the level below; ``first`` is its first point
    for level in range(1, num_levels + 1):
        merged = boxes[-1][children - first] >> 1
        merged_body = bodies[-1][children - first]
        above = first + len(bodies[-1])
        _, example, number = np.unique(_box_keys(merged_body, merged), return_index=True, return_inverse=True)
        parent = np.full(len(bodies[-1]), -1)
        parent[children - first] = above + number
        parents.append(parent)
        bodies.append(merged_body[example])
        boxes.append(merged[example])
        levels.append(np.full(len(example), level))

        joined = parent[lower_edges - first]
        joined = joined[:, (joined >= 0).all(axis=0)]  # bodies that end below have no parents
        lower_edges = unique_pairs(joined[:, joined[0] != joined[1]], above + len(example))
        same.append(lower_edges)
        nodes = nodes[parent[ancestor[nodes] - first] >= 0]
        ancestor[nodes] = parent[ancestor[nodes] - first]
        descent.append(np.stack([ancestor[nodes], nodes]))
        first = above
        children = first + np.flatnonzero((depth[bodies[-1]] > level).any(axis=1))
    parents.append(np.full(len(bodies[-1]), -1))

    parent = np.concatenate(parents)
    child = np.flatnonzero(parent >= 0)
    return MultiscaleGraph(
        rest_pos, np.concatenate(bodies), np.concatenate(levels), parent, edges,
        np.concatenate(same, axis=1), np.stack([parent[child], child]), np.concatenate(descent, axis=1),
    )  # fmt: skip


def _smallest_boxes(
    rest_pos: np.ndarray, nodes: np.ndarray, body: np.ndarray, num_bodies: int, spacing: float
) -> tuple[Int64[np.ndarray, "node dim"], Int64[np.ndarray, "body dim"]]:
    """Return the integer coordinates of each node in its body [rest spacings], and how often they can be halved along each axis until all are zero."""
    box, low = np.zeros(rest_pos.shape, dtype=np.int64), np.full((num_bodies, rest_pos.shape[1]), np.inf)
    np.minimum.at(low, body[nodes], rest_pos[nodes])
    box[nodes] = np.floor((rest_pos[nodes] - low[body[nodes]]) / spacing + SNAP)
    width = np.ones(low.shape, dtype=np.int64)
    np.maximum.at(width, body[nodes], box[nodes] + 1)
    depth = np.ceil(np.log2(width)).astype(np.int64)
    margin = (2**depth - width) // 4 * 2  # on either side; even, so that the rows at the low corner merge in pairs
    box[nodes] += margin[body[nodes]]
    return box, depth


def _box_keys(body: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return one number per body and box."""
    key = body
    for column in box.T:
        key = key * (column.max(initial=0) + 1) + column
    return key
