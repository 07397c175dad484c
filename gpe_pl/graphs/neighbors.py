"""Exact neighbour search: every pair within the radius, each once, none dropped.

The search uses a k-d tree on the CPU [Maneewongvatana & Mount 1999, as in SciPy]. It takes a few per cent of a model step, so neighbour lists are not kept
between steps. Along periodic axes, the distance of two nodes is that of their nearest images. The radius must be below half the period.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.rollout.guard import CROWDING_LIMIT, crowding
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.boundary import search_tree

MOST_PAIRS = 2**26
"""Largest number of pairs that a search lists: a gigabyte of indices."""
NUM_SAMPLED = 64
"""Number of nodes whose neighbours serve to estimate the number of all pairs."""


def pairs_at_rest(num_nodes: int, radius: float, spacing: float, dim: int) -> float:
    """Return the number of pairs within the radius R in a cloud with one node per spacing^dim.

    It is N/2 V_dim (R / spacing)^dim, where V_dim is the volume of the unit ball.
    """
    ball = {1: 2.0, 2: np.pi, 3: 4 / 3 * np.pi}[dim]
    return num_nodes / 2 * ball * (radius / spacing) ** dim


def check_crowding(pos: Float64[np.ndarray, "node dim"], radius: float, spacing: float, periodicity: Periodicity = NOWHERE) -> None:
    """Raise an error if a cloud of nodes has collapsed.

    Pairs are counted before they are listed, because counting needs no memory. If no box contains enough nodes for a collapse, counting is skipped.

    Raises:
        SimulationError: with reason ``clustering``, if more than ``CROWDING_LIMIT`` times as many pairs lie within the radius [m] as at rest; names the most
            crowded node.
    """
    num_nodes, dim = pos.shape
    if num_nodes < 2:
        return
    limit = CROWDING_LIMIT * pairs_at_rest(num_nodes, radius, spacing, dim)
    boxes = 4**dim if periodicity else 3**dim  # that the neighbours of a node lie in; at a seam some boxes are narrower
    if boxes / 2 * float(crowding(periodicity.wrapped(pos), radius).sum()) <= limit:  # no fewer than there are
        return
    tree = search_tree(pos, periodicity)
    num_pairs = (int(tree.count_neighbors(tree, radius)) - num_nodes) // 2
    if num_pairs > limit:
        node = int(np.argmax(tree.query_ball_point(tree.data, radius, return_length=True)))
        raise SimulationError(
            f"{num_pairs} pairs of nodes within the radius of {radius:.3g} m, most at node {node}; nodes {spacing:.3g} m apart would have "
            f"{limit / CROWDING_LIMIT:.0f}: the material has collapsed onto itself",
            reason="clustering",
            node=node,
        )


def radius_pairs(pos: Float64[np.ndarray, "node dim"], radius: float, periodicity: Periodicity = NOWHERE) -> Int64[np.ndarray, "2 edge"]:
    """Return the unordered pairs of distinct nodes at most ``radius`` [m] apart, each once; row 0 is the source, row 1 the target.

    Raises:
        SimulationError: there are more pairs than memory can hold.
    """
    if len(pos) < 2:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    tree = search_tree(pos, periodicity)
    _check_number(tree, tree, radius)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    return np.ascontiguousarray(pairs.T, dtype=np.int64)


def radius_between(
    source: Float64[np.ndarray, "source dim"] | cKDTree,
    target: Float64[np.ndarray, "target dim"],
    radius: float,
    periodicity: Periodicity = NOWHERE,
) -> Int64[np.ndarray, "2 edge"]:
    """Return the pairs of a source node and a target node of two different sets at most ``radius`` [m] apart.

    Args:
        source: positions [m], or ``search_tree`` of them with the same periodicity.
        target: positions [m].
        radius: largest distance of a pair [m].
        periodicity: axes along which space repeats; a tree given as ``source`` must have been built for it.

    Raises:
        SimulationError: there are more pairs than memory can hold.
    """
    tree = source if isinstance(source, cKDTree) else search_tree(source, periodicity)
    if tree.n == 0 or len(target) == 0:
        return np.empty((2, 0), dtype=np.int64)
    periodicity.check_radius(radius)
    other = search_tree(target, periodicity)
    _check_number(tree, other, radius)
    found = tree.sparse_distance_matrix(other, radius, output_type="ndarray")
    return np.stack([found["i"], found["j"]]).astype(np.int64)


def _check_number(tree: cKDTree, other: cKDTree, radius: float) -> None:
    """Raise ``SimulationError`` if there would be too many pairs of neighbours for the memory.

    The number of pairs is estimated from a sample of nodes. A radius in the wrong unit is a likely cause.
    """
    if tree.n * other.n <= MOST_PAIRS:
        return
    sample = np.unique(np.linspace(0, other.n - 1, NUM_SAMPLED).astype(int))
    number = float(np.mean(tree.query_ball_point(other.data[sample], radius, return_length=True))) * other.n
    if number > 2 * MOST_PAIRS:
        raise SimulationError(
            f"about {number / tree.n:.3g} nodes within the radius of {radius:.3g} m of each of {tree.n} nodes are too many; the radius "
            "(connectivity_radius) or the positions may be in another unit",
            reason="clustering",
        )
