"""Exact neighbour search: every pair within the radius, each once, none dropped.

Compiled cell lists find the pairs (``cell_lists``). A k-d tree [Maneewongvatana & Mount 1999, as in SciPy] finds them if nodes are too scattered for a grid,
and for comparison inside ``system.compiled.unfused``. Both return the same pairs in the same order. The search takes a few per cent of a model step, so
neighbour lists are not kept between steps. Along periodic axes, the distance of two nodes is that of their nearest images. The radius must be below half the
period.
"""

from __future__ import annotations

from functools import cached_property
from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int64
from numba import njit
from scipy.spatial import cKDTree

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.graphs import cell_lists
from gpe_pl.rollout.guard import CROWDING_LIMIT
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.system.compiled import is_wanted
from gpe_pl.trajectory.boundary import search_tree

MOST_PAIRS = 2**26
"""Largest number of pairs that a search lists: a gigabyte of indices."""
NUM_SAMPLED = 64
"""Number of nodes whose neighbours serve to estimate the number of all pairs."""
ROUNDING = 1e-9
"""Fraction by which searches in a k-d tree enlarge the radius, against rounding. Exact distances decide afterwards."""


class Points:
    """Positions to search among, sorted once for all searches.

    Args:
        pos: positions [node, dim] in m.
        radius: radius of all searches [m].
        periodicity: axes along which space repeats.
    """

    def __init__(self, pos: Float64[np.ndarray, "node dim"], radius: float, periodicity: Periodicity = NOWHERE) -> None:
        periodicity.check_radius(radius)
        self.pos, self.radius, self.periodicity = pos, radius, periodicity

    def __len__(self) -> int:
        return len(self.pos)

    @cached_property
    def cells(self) -> cell_lists.CellList | None:
        """Cell list, or None where trees have to be used."""
        return cell_lists.cell_list(self.pos, self.radius, self.periodicity)

    @cached_property
    def tree(self) -> cKDTree:
        return search_tree(self.pos, self.periodicity)

    @cached_property
    def places(self) -> Int64[np.ndarray, " node"]:
        """Place of each node in the order in which a cell list would sort the nodes."""
        x, place = self.tree.data, np.empty(len(self), np.int64)
        side, around, _ = cell_lists.grid(self.radius, self.periodicity, x.shape[1])
        cells = np.floor(x / side[: x.shape[1]])
        cells = np.where(around[: x.shape[1]] > 0, np.minimum(cells, around[: x.shape[1]] - 1), cells)
        place[np.lexsort(cells.T[::-1])] = np.arange(len(self))
        return place


@njit(cache=True)
@no_type_check
def are_below(values, largest):
    """Tell whether the magnitudes of all values [value] are below ``largest``; NaN is not."""
    found = True
    for k in range(values.shape[0]):
        found &= abs(values[k]) < largest
    return found


def pairs_at_rest(num_nodes: int, radius: float, spacing: float, dim: int) -> float:
    """Return the number of pairs within the radius R in a cloud with one node per spacing^dim.

    It is N/2 V_dim (R / spacing)^dim, where V_dim is the volume of the unit ball.
    """
    ball = {1: 2.0, 2: np.pi, 3: 4 / 3 * np.pi}[dim]
    return num_nodes / 2 * ball * (radius / spacing) ** dim


def check_crowding(points: Points, spacing: float) -> None:
    """Raise an error if a cloud of nodes has collapsed.

    Pairs are counted before they are listed, because counting needs no memory. If no cell contains enough nodes for a collapse, counting is skipped.

    Raises:
        SimulationError: with reason ``clustering``, if more than ``CROWDING_LIMIT`` times as many pairs lie within the radius as at rest. The message names
            the most crowded node.
    """
    num_nodes, dim = points.pos.shape
    if num_nodes < 2:
        return
    limit = CROWDING_LIMIT * pairs_at_rest(num_nodes, points.radius, spacing, dim)
    if num_nodes**2 / 2 <= limit or (points.cells is not None and cell_lists.num_near(points.cells, dim) <= limit):
        return
    tree = points.tree
    num_pairs = (int(tree.count_neighbors(tree, points.radius)) - num_nodes) // 2
    if num_pairs > limit:
        node = int(np.argmax(tree.query_ball_point(tree.data, points.radius, return_length=True)))
        raise SimulationError(
            f"{num_pairs} pairs of nodes within the radius of {points.radius:.3g} m, most at node {node}; nodes {spacing:.3g} m apart would have "
            f"{limit / CROWDING_LIMIT:.0f}: the material has collapsed onto itself",
            reason="clustering",
            node=node,
        )


def radius_pairs(
    pos: Float64[np.ndarray, "node dim"] | Points, radius: float, periodicity: Periodicity = NOWHERE
) -> Int64[np.ndarray, "2 edge"]:
    """Return the unordered pairs of distinct nodes at most ``radius`` [m] apart, each once, in the order of ``cell_lists``.

    Row 0 is the source, row 1 the target; the source is the lower node.

    Raises:
        SimulationError: there are more pairs than memory can hold.
    """
    points = pos if isinstance(pos, Points) else Points(pos, radius, periodicity)
    if len(points) < 2:
        return np.empty((2, 0), dtype=np.int64)
    if is_wanted() and points.cells is not None:
        pairs = cell_lists.pairs_within(points.cells, radius, MOST_PAIRS)
        if pairs is not None:
            return pairs
    _check_number(points.tree, points.tree, radius)
    i, j = points.tree.query_pairs(radius * (1 + ROUNDING), output_type="ndarray").T
    return _exact(np.minimum(i, j), np.maximum(i, j), points, points)


def radius_between(
    source: Float64[np.ndarray, "source dim"] | Points,
    target: Float64[np.ndarray, "target dim"] | Points,
    radius: float,
    periodicity: Periodicity = NOWHERE,
) -> Int64[np.ndarray, "2 edge"]:
    """Return the pairs of a source node and a target node of two different sets at most ``radius`` [m] apart, in the order of ``cell_lists``.

    Args:
        source: positions [m]; or ``Points`` with the same radius and periodicity.
        target: as ``source``.
        radius: largest distance of a pair [m].
        periodicity: axes along which space repeats.

    Raises:
        SimulationError: there are more pairs than memory can hold.
    """
    sources, targets = (x if isinstance(x, Points) else Points(x, radius, periodicity) for x in (source, target))
    if len(sources) == 0 or len(targets) == 0:
        return np.empty((2, 0), dtype=np.int64)
    if is_wanted() and sources.cells is not None and targets.cells is not None:
        pairs = cell_lists.pairs_between(sources.cells, targets.cells, radius, 2 * MOST_PAIRS)
        if pairs is not None:
            return pairs
    _check_number(sources.tree, targets.tree, radius)
    found = sources.tree.sparse_distance_matrix(targets.tree, radius * (1 + ROUNDING), output_type="ndarray")
    return _exact(found["i"], found["j"], sources, targets)


def _exact(j: np.ndarray, i: np.ndarray, sources: Points, targets: Points) -> Int64[np.ndarray, "2 edge"]:
    """Return the pairs of a source j and a target i within the radius, in the order of ``cell_lists``."""
    squared, space = np.zeros(len(j)), sources.periodicity
    for axis in range(sources.pos.shape[1]):
        d = np.abs(sources.tree.data[j, axis] - targets.tree.data[i, axis])
        if axis in space.axes:
            d = np.where(d > 0.5 * space.period[axis], space.period[axis] - d, d)
        squared += d * d
    near = squared <= sources.radius * sources.radius
    pairs = np.stack([j[near], i[near]]).astype(np.int64)
    first, second = targets.places[pairs[1]], sources.places[pairs[0]]
    if sources is targets:
        first, second = np.minimum(first, second), np.maximum(first, second)
    return np.ascontiguousarray(pairs[:, np.lexsort((second, first))])


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
