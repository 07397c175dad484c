"""Exact neighbour search: every pair within the radius, each once, none dropped.

A k-d tree on the CPU [Maneewongvatana & Mount 1999, as in SciPy]; at a few per cent of a model step it is not worth a skin there.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from gpe_pl.rollout import CROWDING_LIMIT, SimulationError, crowding


def pairs_at_rest(num_nodes: int, radius: float, spacing: float, dim: int) -> float:
    """Pairs of a cloud with one node per spacing^dim: N/2 V_dim (R / spacing)^dim."""
    ball = {1: 2.0, 2: np.pi, 3: 4 / 3 * np.pi}[dim]
    return num_nodes / 2 * ball * (radius / spacing) ** dim


def check_crowding(pos: Float64[np.ndarray, "node dim"], radius: float, spacing: float) -> None:
    """Refuse a cloud that has collapsed: its pairs are counted before they are listed, which takes time but no memory,
    and that only where a bound from the number of nodes in boxes does not say that there are few.

    Raises:
        SimulationError: ``CROWDING_LIMIT`` times as many pairs within the radius [m] as at rest; names the most crowded node. Reason ``clustering``.
    """
    num_nodes, dim = pos.shape
    if num_nodes < 2:
        return
    limit = CROWDING_LIMIT * pairs_at_rest(num_nodes, radius, spacing, dim)
    if 3**dim / 2 * float(crowding(pos, radius).sum()) <= limit:  # no fewer than there are: a node's neighbours lie in 3^dim boxes
        return
    tree = cKDTree(pos)
    num_pairs = (int(tree.count_neighbors(tree, radius)) - num_nodes) // 2
    if num_pairs > limit:
        node = int(np.argmax(tree.query_ball_point(pos, radius, return_length=True)))
        raise SimulationError(
            f"{num_pairs} pairs of nodes within the radius of {radius:.3g} m, most at node {node}; nodes {spacing:.3g} m apart would have "
            f"{limit / CROWDING_LIMIT:.0f}: the material has collapsed onto itself",
            reason="clustering",
            node=node,
        )


def radius_pairs(pos: Float64[np.ndarray, "node dim"], radius: float) -> Int64[np.ndarray, "2 edge"]:
    """Unordered pairs of distinct nodes at most ``radius`` [m] apart; row 0 is the source, row 1 the target, each pair once."""
    if len(pos) < 2:
        return np.empty((2, 0), dtype=np.int64)
    pairs = cKDTree(pos, balanced_tree=False, compact_nodes=False).query_pairs(radius, output_type="ndarray")
    return np.ascontiguousarray(pairs.T, dtype=np.int64)


def radius_between(
    source_pos: Float64[np.ndarray, "source dim"], target_pos: Float64[np.ndarray, "target dim"], radius: float
) -> Int64[np.ndarray, "2 edge"]:
    """Pairs of a source node and a target node of two different sets at most ``radius`` [m] apart."""
    if len(source_pos) == 0 or len(target_pos) == 0:
        return np.empty((2, 0), dtype=np.int64)
    source = cKDTree(source_pos, balanced_tree=False, compact_nodes=False)
    target = cKDTree(target_pos, balanced_tree=False, compact_nodes=False)
    found = source.sparse_distance_matrix(target, radius, output_type="ndarray")
    return np.stack([found["i"], found["j"]]).astype(np.int64)
