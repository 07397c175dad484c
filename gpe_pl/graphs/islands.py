"""Islands: connected components of the graph of dynamic nodes. An island that nothing outside acts on can only fall freely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numba import njit

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.graphs.neighbors import Points, radius_between, radius_pairs


@dataclass(frozen=True)
class Islands:
    """Components of a graph of dynamic nodes.

    Attributes:
        label: island of each node [node], numbered from 0.
        is_free: for each island [island], whether none of its nodes touches anything outside.
    """

    label: Int64[np.ndarray, "node"]
    is_free: Bool[np.ndarray, "island"]

    def mean(self, values: Float64[np.ndarray, "node dim"], mass: Float64[np.ndarray, "node"]) -> Float64[np.ndarray, "island dim"]:
        """Return the mass-weighted mean over each island."""
        count = len(self.is_free)
        total = np.stack([np.bincount(self.label, mass * column, count) for column in values.T], axis=-1)
        return total / np.bincount(self.label, mass, count)[:, None]


def find_islands(num_nodes: int, edge_index: Int64[np.ndarray, "2 edge"], touches: Bool[np.ndarray, "node"]) -> Islands:
    """Return the islands of a graph.

    Args:
        num_nodes: number of dynamic nodes.
        edge_index: edges between them, in any direction.
        touches: nodes on which something outside acts, such as an edge to a boundary node or a given motion.
    """
    label, count = _components(num_nodes, edge_index)
    is_free = np.ones(count, dtype=bool)
    is_free[label[touches]] = False
    return Islands(label, is_free)


@njit(cache=True)
@no_type_check
def _components(num_nodes, edge_index):
    """Return the component of each node, numbered by first node, and the number of components (union–find with path halving, Tarjan & van Leeuwen 1984)."""
    parent = np.arange(num_nodes)
    for k in range(edge_index.shape[1]):
        a, b = edge_index[0, k], edge_index[1, k]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a < b:
            parent[b] = a
        else:
            parent[a] = b
    label = np.empty(num_nodes, np.int64)
    count = 0
    for n in range(num_nodes):  # a parent comes before its children
        if parent[n] == n:
            label[n] = count
            count += 1
        else:
            label[n] = label[parent[n]]
    return label, count


def islands_within(
    radius: float,
    pos: Float64[np.ndarray, "node dim"],
    boundary: Float64[np.ndarray, "boundary dim"] | Points,
    mesh_edges: Int64[np.ndarray, "2 edge"],
    periodicity: Periodicity = NOWHERE,
) -> Islands:
    """Return the islands of nodes that lie within a radius [m] of each other or that mesh edges connect.

    An island is free if no boundary node lies within the radius.

    Args:
        radius: largest distance of connected nodes [m].
        pos: positions of dynamic nodes [m].
        boundary: positions of boundary nodes [m], or ``Points`` of them.
        mesh_edges: edges of meshes, which connect their nodes at any distance.
        periodicity: axes along which space repeats.
    """
    points, touches = Points(pos, radius, periodicity), np.zeros(len(pos), dtype=bool)
    touches[radius_between(boundary, points, radius, periodicity)[1]] = True
    return find_islands(len(pos), np.concatenate([radius_pairs(points, radius, periodicity), mesh_edges], axis=1), touches)


def unwrapped(
    pos: Float64[np.ndarray, "node dim"], edge_index: Int64[np.ndarray, "2 edge"], periodicity: Periodicity
) -> tuple[Float64[np.ndarray, "node dim"], Bool[np.ndarray, "node"]]:
    """Return positions [m] moved by ``image_shifts``, so that connected nodes lie beside each other, and a mask of the nodes for which that is impossible."""
    if not periodicity:
        return pos, np.zeros(len(pos), dtype=bool)
    shift, goes_around = image_shifts(pos, edge_index, periodicity)
    return pos + shift, goes_around


def image_shifts(
    pos: Float64[np.ndarray, "node dim"], edge_index: Int64[np.ndarray, "2 edge"], periodicity: Periodicity
) -> tuple[Float64[np.ndarray, "node dim"], Bool[np.ndarray, "node"]]:
    """Return multiples of the period [m] that move each node beside its neighbours, and a mask of the nodes whose component wraps around the domain.

    The images of such a component cannot all lie side by side, so its multiples have no meaning.

    Args:
        pos: positions [m].
        edge_index: edges that are shorter than half the period.
        periodicity: axes along which space repeats.
    """
    j, i = edge_index
    difference = pos[i] - pos[j]
    turns = np.round((periodicity.shortest(difference) - difference) / np.where(periodicity.period > 0, periodicity.period, 1.0))
    image, goes_around = _images(len(pos), edge_index, turns.astype(np.int64))
    return image * periodicity.period, goes_around


@njit(cache=True)
@no_type_check
def _images(num_nodes, edge_index, turns):
    """Return the number of periods by which each node moves, and a mask of the nodes without a solution.

    In a solution, the target of every edge k moves by ``turns[k]`` periods more than its source.
    """
    num_edges, dim = turns.shape
    first = np.zeros(num_nodes + 1, np.int64)  # of a node's entries in ``edge``
    for k in range(num_edges):
        first[edge_index[0, k] + 1] += 1
        first[edge_index[1, k] + 1] += 1
    first = np.cumsum(first)
    filled = first[:-1].copy()
    edge = np.empty(2 * num_edges, np.int64)
    for k in range(num_edges):
        for end in range(2):
            node = edge_index[end, k]
            edge[filled[node]] = k
            filled[node] += 1
    image = np.zeros((num_nodes, dim), np.int64)
    component = np.full(num_nodes, -1)
    goes_around = np.zeros(num_nodes, np.bool_)  # of components, by their first node
    queue = np.empty(num_nodes, np.int64)
    for start in range(num_nodes):
        if component[start] >= 0:
            continue
        component[start] = start
        queue[0], length, done = start, 1, 0
        while done < length:
            node = queue[done]
            done += 1
            for e in range(first[node], first[node + 1]):
                k = edge[e]
                is_source = edge_index[0, k] == node
                other = edge_index[1, k] if is_source else edge_index[0, k]
                sign = 1 if is_source else -1
                if component[other] < 0:
                    component[other] = start
                    for d in range(dim):
                        image[other, d] = image[node, d] + sign * turns[k, d]
                    queue[length] = other
                    length += 1
                else:
                    for d in range(dim):
                        if image[other, d] != image[node, d] + sign * turns[k, d]:
                            goes_around[start] = True
    return image, goes_around[component]


def free_since(before: Islands, now: Islands) -> Bool[np.ndarray, "island"]:
    """Return a mask of the islands that are free now and that consist of one or several whole islands of the frame before, all of which were free.

    If an island touched something in the frame before, its last velocity still contains the effect of that contact.
    """
    together = np.zeros((len(before.is_free), len(now.is_free)), dtype=bool)
    together[before.label, now.label] = True
    whole = together.sum(axis=1) == 1
    return now.is_free & ~np.any(together & ~(whole & before.is_free)[:, None], axis=0)
