"""Exact neighbour search: every pair within the radius, each once, none dropped.

A k-d tree on the CPU [Maneewongvatana & Mount 1999, as in SciPy]; at a few per cent of a model step it is not worth a skin there. Along periodic axes
the distance of two nodes is that of their nearest images, and the radius must be below half the period.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from gpe_pl.periodicity import NOWHERE, Periodicity
from gpe_pl.trajectory import search_tree


def radius_pairs(pos: Float64[np.ndarray, "node dim"], radius: float, periodicity: Periodicity = NOWHERE) -> Int64[np.ndarray, "2 edge"]:
    """Unordered pairs of distinct nodes at most ``radius`` [m] apart; row 0 is the source, row 1 the target, each pair once."""
    if len(pos) < 2:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    pairs = search_tree(pos, periodicity).query_pairs(radius, output_type="ndarray")
    return np.ascontiguousarray(pairs.T, dtype=np.int64)


def radius_between(
    source: Float64[np.ndarray, "source dim"] | cKDTree,
    target: Float64[np.ndarray, "target dim"],
    radius: float,
    periodicity: Periodicity = NOWHERE,
) -> Int64[np.ndarray, "2 edge"]:
    """Pairs of a source node and a target node of two different sets at most ``radius`` [m] apart.

    Args:
        source: positions [m], or ``search_tree`` of them with the same periodicity.
        target: positions [m].
        radius: [m].
        periodicity: where space repeats; a tree given as ``source`` must have been built for it.
    """
    tree = source if isinstance(source, cKDTree) else search_tree(source, periodicity)
    if tree.n == 0 or len(target) == 0:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    found = tree.sparse_distance_matrix(search_tree(target, periodicity), radius, output_type="ndarray")
    return np.stack([found["i"], found["j"]]).astype(np.int64)
