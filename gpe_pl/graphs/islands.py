"""Islands: connected components of the dynamic nodes. What no edge reaches from outside can only fall freely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Islands:
    """Components of a graph of dynamic nodes.

    Attributes:
        label: island of each node [node], numbered from 0.
        is_free: for each island [island], whether no edge ties it to the boundary.
    """

    label: Int64[np.ndarray, "node"]
    is_free: Bool[np.ndarray, "island"]

    def mean(self, values: Float64[np.ndarray, "node dim"], mass: Float64[np.ndarray, "node"]) -> Float64[np.ndarray, "island dim"]:
        """Mass-weighted mean over each island."""
        count = len(self.is_free)
        total = np.stack([np.bincount(self.label, mass * column, count) for column in values.T], axis=-1)
        return total / np.bincount(self.label, mass, count)[:, None]


def find_islands(num_nodes: int, edge_index: Int64[np.ndarray, "2 edge"], touches_boundary: Bool[np.ndarray, "node"]) -> Islands:
    """Islands of a graph.

    Args:
        num_nodes: dynamic nodes.
        edge_index: edges between them, in any direction.
        touches_boundary: nodes that have an edge with a boundary node.
    """
    source, target = edge_index
    graph = coo_array((np.ones(len(source), dtype=bool), (source, target)), shape=(num_nodes, num_nodes))
    count, label = connected_components(graph, directed=False)
    is_free = np.ones(count, dtype=bool)
    is_free[label[touches_boundary]] = False
    return Islands(label.astype(np.int64), is_free)
