"""Exact neighbour search: every pair within the radius, each once, none dropped.

A k-d tree on the CPU [Maneewongvatana & Mount 1999, as in SciPy]; at a few per cent of a model step it is not worth a skin there. Along periodic axes
the distance of two nodes is that of their nearest images, and the radius must be below half the period.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from gpe_pl.periodicity import NOWHERE, Periodicity


def radius_pairs(pos: Float64[np.ndarray, "node dim"], radius: float, periodicity: Periodicity = NOWHERE) -> Int64[np.ndarray, "2 edge"]:
    """Unordered pairs of distinct nodes at most ``radius`` [m] apart; row 0 is the source, row 1 the target, each pair once."""
    if len(pos) < 2:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    pairs = _tree(pos, periodicity).query_pairs(radius, output_type="ndarray")
    return np.ascontiguousarray(pairs.T, dtype=np.int64)


def radius_between(
    source_pos: Float64[np.ndarray, "source dim"],
    target_pos: Float64[np.ndarray, "target dim"],
    radius: float,
    periodicity: Periodicity = NOWHERE,
) -> Int64[np.ndarray, "2 edge"]:
    """Pairs of a source node and a target node of two different sets at most ``radius`` [m] apart."""
    if len(source_pos) == 0 or len(target_pos) == 0:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    found = _tree(source_pos, periodicity).sparse_distance_matrix(_tree(target_pos, periodicity), radius, output_type="ndarray")
    return np.stack([found["i"], found["j"]]).astype(np.int64)


def _tree(pos: np.ndarray, periodicity: Periodicity) -> cKDTree:
    if not periodicity:
        return cKDTree(pos, balanced_tree=False, compact_nodes=False)
    return cKDTree(periodicity.from_corner(pos), balanced_tree=False, compact_nodes=False, boxsize=periodicity.period)
