"""Cell lists: nodes sorted into the cells of a grid, and the pairs within a radius found from them (compiled, on the CPU).

Cells are a little wider than the radius, so the neighbours of a node lie in its own cell and in the cells around it [Allen and Tildesley, Computer Simulation
of Liquids (1987), section 5.3.2]. Nodes are sorted by cell, with the last axis fastest; nodes of one cell keep their order. Pairs are sorted by their first
node in this order, then by their second. Nodes that are near in space are therefore near in memory.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float64, Int64
from numba import njit

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity

MARGIN = 1e-6
"""Fraction by which cells are wider than the radius, so that no rounding moves a neighbour beyond the next cell."""
FARTHEST = 1e8
"""Largest distance from the origin [radii]. Beyond it, rounding of positions could exceed ``MARGIN``, and no grid is used."""
CELLS_PER_NODE = 64
"""Largest number of cells per node. Nodes so scattered that a grid needs more get no grid."""
FEW_CELLS = 4096
"""Number of cells that a grid may always have, even with few nodes."""


class CellList(NamedTuple):
    """Nodes sorted by cell.

    Attributes:
        points: positions [3, node] in m in the order of the cells; the third row is zero in 2D. Along periodic axes they start at the corner of the domain.
        nodes: number of the node at each place in this order.
        start: place at which the nodes of each cell start, and the number of nodes [cell + 1].
        first: coordinates of the first cell [3].
        counts: number of cells along each axis [3].
        period: period of each axis [3] in m; 0 for axes that are not periodic.
    """

    points: Float64[np.ndarray, "3 node"]
    nodes: Int64[np.ndarray, " node"]
    start: Int64[np.ndarray, " cells"]
    first: Int64[np.ndarray, " 3"]
    counts: Int64[np.ndarray, " 3"]
    period: Float64[np.ndarray, " 3"]


def grid(radius: float, periodicity: Periodicity, dim: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each of three axes the width of cells [m], the number of cells in a period, and the period [m]; the last two are 0 without a period."""
    side, period, around = np.full(3, radius * (1 + MARGIN)), np.zeros(3), np.zeros(3, np.int64)
    if periodicity:
        period[:dim] = periodicity.period
        around[period > 0] = np.maximum(1, period[period > 0] // side[period > 0])
        side[period > 0] = period[period > 0] / around[period > 0]
    return side, around, period


def cell_list(pos: Float64[np.ndarray, "node dim"], radius: float, periodicity: Periodicity = NOWHERE) -> CellList | None:
    """Return the cell list of nodes for a search within ``radius`` [m], or None if the nodes are too scattered for a grid."""
    side, around, period = grid(radius, periodicity, pos.shape[1])
    if periodicity:
        pos = periodicity.from_corner(pos)
    most = max(FEW_CELLS, CELLS_PER_NODE * len(pos))
    found, points, nodes, start, first, counts = _sorted_by_cell(np.ascontiguousarray(pos), side, around, most)
    return CellList(points, nodes, start, first, counts, period) if found else None


def pairs_within(cells: CellList, radius: float, most: int) -> Int64[np.ndarray, "2 pair"] | None:
    """Return the pairs of different nodes at most ``radius`` [m] apart, each once, the lower node first; None if there may be more than ``most``."""
    found, pairs = _near(*cells, *cells[:5], True, radius, most)
    return pairs if found else None


def pairs_between(sources: CellList, targets: CellList, radius: float, most: int) -> Int64[np.ndarray, "2 pair"] | None:
    """Return the pairs of a source and a target at most ``radius`` [m] apart, in the order of the targets; None if there may be more than ``most``.

    Both cell lists are of the same radius and periodicity.
    """
    found, pairs = _near(*sources, *targets[:5], False, radius, most)
    return pairs if found else None


def num_near(cells: CellList, dim: int) -> float:
    """Return an upper bound of the number of pairs within the radius: 3^dim / 2 times the sum over cells of the squared number of nodes."""
    return 0.5 * 3**dim * float(np.square(np.diff(cells.start).astype(np.float64)).sum())


@njit(cache=True, error_model="numpy")
@no_type_check
def _sorted_by_cell(pos, side, around, most):
    """Return whether the nodes fit a grid of at most ``most`` cells, and the arrays of ``CellList`` without the period (counting sort)."""
    num_nodes, dim = pos.shape
    place = np.empty((3, num_nodes), np.int64)  # coordinates of each node's cell
    first, counts = np.zeros(3, np.int64), np.ones(3, np.int64)
    points, nodes = np.zeros((3, num_nodes)), np.empty(num_nodes, np.int64)
    fits, total = True, 1
    for a in range(dim):
        low, high = np.int64(0), np.int64(0)
        for n in range(num_nodes):
            x = pos[n, a] / side[a]
            if not abs(x) < FARTHEST:  # also NaN
                fits = False
                x = 0.0
            c = np.int64(np.floor(x))
            if around[a] > 0:
                c = min(c, around[a] - 1)
            place[a, n] = c
            low = c if n == 0 else min(low, c)
            high = c if n == 0 else max(high, c)
        if around[a] > 0:
            low, high = np.int64(0), around[a] - 1
        first[a], counts[a] = low, high - low + 1
        if counts[a] > most // total:
            fits = False
        else:
            total *= counts[a]
    if not fits:
        return False, points, nodes, np.zeros(1, np.int64), first, counts
    start = np.zeros(total + 1, np.int64)
    cell = np.empty(num_nodes, np.int64)
    for n in range(num_nodes):
        c = np.int64(0)
        for a in range(dim):
            c = c * counts[a] + (place[a, n] - first[a])
        cell[n] = c
        start[c] += 1
    for c in range(1, total + 1):
        start[c] += start[c - 1]
    for n in range(num_nodes - 1, -1, -1):  # the places of a cell are filled from behind
        start[cell[n]] -= 1
        k = start[cell[n]]
        nodes[k] = n
        for a in range(dim):
            points[a, k] = pos[n, a]
    return True, points, nodes, start, first, counts


@njit(cache=True, error_model="numpy")
@no_type_check
def _stretches(cell, start, first, counts, period, begin, end):
    """Write the stretches of places that the cells around a cell [3] occupy, in order; return their number. Adjacent stretches become one."""
    cells = np.empty(27, np.int64)
    number = 0
    for dx in range(-1, 2):
        x = _along(cell[0] + dx, 0, dx, first, counts, period)
        if x < 0:
            continue
        for dy in range(-1, 2):
            y = _along(cell[1] + dy, 1, dy, first, counts, period)
            if y < 0:
                continue
            for dz in range(-1, 2):
                z = _along(cell[2] + dz, 2, dz, first, counts, period)
                if z < 0:
                    continue
                c = (x * counts[1] + y) * counts[2] + z
                k = number
                while k > 0 and cells[k - 1] > c:
                    cells[k] = cells[k - 1]
                    k -= 1
                cells[k] = c
                number += 1
    count = 0
    for k in range(number):
        low, high = start[cells[k]], start[cells[k] + 1]
        if low == high:
            continue
        if count > 0 and end[count - 1] == low:
            end[count - 1] = high
        else:
            begin[count], end[count] = low, high
            count += 1
    return count


@njit(cache=True, error_model="numpy")
@no_type_check
def _along(c, axis, step, first, counts, period):
    """Return the row of a cell along an axis, or -1 if there is none, or if another step leads to the same cell around the period."""
    n = counts[axis]
    k = c - first[axis]
    if period[axis] > 0:
        if (n == 1 and step != 0) or (n == 2 and step < 0):
            return -1
        return k % n
    return k if 0 <= k < n else -1


@njit(cache=True, error_model="numpy")
@no_type_check
def _near(
    points,
    nodes,
    start,
    first,
    counts,
    period,
    target_points,
    target_nodes,
    target_start,
    target_first,
    target_counts,
    is_same,
    radius,
    most,
):
    """Return whether there are at most ``most`` pairs of a source and a target within the radius, and the pairs; each once if both lists are the same."""
    limit = radius * radius
    half = np.empty(3)
    for a in range(3):
        half[a] = 0.5 * period[a] if period[a] > 0 else np.inf
    begin, end, cell = np.empty(27, np.int64), np.empty(27, np.int64), np.empty(3, np.int64)
    capacity = 16 * target_nodes.shape[0] + 64
    found = np.empty((2, capacity), np.int64)
    number, at, previous, count = 0, 0, -1, 0
    for p in range(target_nodes.shape[0]):
        while target_start[at + 1] <= p:  # the cell that place p belongs to
            at += 1
        if at != previous:
            cell[2] = at % target_counts[2] + target_first[2]
            cell[1] = at // target_counts[2] % target_counts[1] + target_first[1]
            cell[0] = at // (target_counts[2] * target_counts[1]) + target_first[0]
            count = _stretches(cell, start, first, counts, period, begin, end)
            previous = at
        x, y, z, i = target_points[0, p], target_points[1, p], target_points[2, p], target_nodes[p]
        for k in range(count):
            low = max(begin[k], p + 1) if is_same else begin[k]
            if number + end[k] - low > capacity:
                if capacity > most:
                    return False, found
                capacity = 2 * capacity + end[k] - low
                larger = np.empty((2, capacity), np.int64)
                _copy(found, number, larger)
                found = larger
            for q in range(low, end[k]):
                dx, dy, dz = abs(x - points[0, q]), abs(y - points[1, q]), abs(z - points[2, q])
                dx = period[0] - dx if dx > half[0] else dx
                dy = period[1] - dy if dy > half[1] else dy
                dz = period[2] - dz if dz > half[2] else dz
                if dx * dx + dy * dy + dz * dz <= limit:
                    j = nodes[q]
                    found[0, number] = min(i, j) if is_same else j
                    found[1, number] = max(i, j) if is_same else i
                    number += 1
    pairs = np.empty((2, number), np.int64)
    _copy(found, number, pairs)
    return True, pairs


@njit(cache=True, error_model="numpy")
@no_type_check
def _copy(pairs, number, to):
    for k in range(number):
        to[0, k], to[1, k] = pairs[0, k], pairs[1, k]
