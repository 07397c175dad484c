"""What importers of finite-element computations share: sizes and orientation of cells, masses and means at nodes, and frames at even intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from gpe_pl.data.importers.source import Facts, Refusal
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.schema import CELL_KINDS

SIMPLICES = {
    "line": [[0, 1]],
    "triangle": [[0, 1, 2]],
    "quadrilateral": [[0, 1, 2], [0, 2, 3]],
    "tetrahedron": [[0, 1, 2, 3]],
    "wedge": [[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]],
    "hexahedron": [[0, 1, 3, 4], [1, 2, 3, 6], [1, 3, 4, 6], [1, 4, 5, 6], [3, 4, 6, 7]],
}
"""Simplices that fill each kind of cell."""
WEDGE = [0, 2, 1, 3, 5, 4]
"""Corners of a wedge in VTK's order, from the other orientation."""
UNEVEN = 1e-3
"""Frames are evenly spaced if their intervals differ by less than this fraction."""


def sizes(
    rest_pos: Float[np.ndarray, "node dim"], kind: str, cells: np.ndarray, periodicity: Periodicity = NOWHERE
) -> Float[np.ndarray, "cell"]:
    """Return the lengths [m], areas [m²] or volumes [m³] of cells [cell, corner] of one kind.

    Cells over the seam of a periodic domain have their shortest edges, so cells have to be shorter than half the period.
    """
    corners = rest_pos[cells]
    edges = [periodicity.shortest(corners[:, s[1:]] - corners[:, s[:1]]) for s in np.array(SIMPLICES[kind])]
    gram = np.array([np.linalg.det(e @ e.swapaxes(1, 2)) for e in edges])
    return np.asarray(np.sqrt(np.maximum(gram, 0.0)).sum(axis=0) / math.factorial(edges[0].shape[1]))


def outward(rest_pos: Float[np.ndarray, "node 3"], wedges: np.ndarray, periodicity: Periodicity) -> np.ndarray:
    """Return wedges [cell, 6] in VTK's order: seen from outside, the corners of the first triangle run counter-clockwise. Formats differ in this."""
    corners = rest_pos[wedges]
    volume = np.linalg.det(periodicity.shortest(corners[:, 1:4] - corners[:, :1]))
    return np.where((volume > 0)[:, None], wedges[:, WEDGE], wedges)


def add_to_nodes(total: np.ndarray, cells: np.ndarray, values: np.ndarray) -> None:
    """Add a value of each cell [cell, …] to each of its nodes, in place."""
    np.add.at(total, cells.ravel(), np.repeat(values, cells.shape[1], axis=0))


def of_highest_dimension(cells: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the cells of the highest dimension by kind. The sizes of others, such as triangles on the surface of tetrahedra, cannot be added to theirs."""
    highest = max((CELL_KINDS[kind][0] for kind in cells), default=0)
    return {kind: own for kind, own in cells.items() if CELL_KINDS[kind][0] == highest}


def without_faces(cells: Mapping[str, np.ndarray], num_nodes: int) -> dict[str, np.ndarray]:
    """Return cells by kind without those whose corners all belong to one cell of a higher dimension, as the triangles that mesh generators write on the surface
    of tetrahedra.
    """
    found = {}
    for kind, own in cells.items():
        rows = _corners(own, num_nodes)
        higher = [_corners(c, num_nodes) for k, c in cells.items() if CELL_KINDS[k][0] > CELL_KINDS[kind][0] and len(c)]
        is_face = np.zeros(len(own), bool)
        for other in higher:
            is_face |= (rows @ other.T).max(axis=1).toarray().ravel() == own.shape[1]
        if not is_face.all():
            found[kind] = own[~is_face]
    return found


def _corners(cells: np.ndarray, num_nodes: int) -> csr_array:
    """Return the sparse matrix [cell, node] that is 1 at the corners of each cell."""
    ones, starts = np.ones(cells.size, np.int32), np.arange(0, cells.size + 1, cells.shape[1])
    found = csr_array((ones, cells.flatten(), starts), shape=(len(cells), num_nodes))
    found.sum_duplicates()
    found.data[:] = 1  # collapsed cells have a corner twice
    return found


def mean_at_nodes(
    rest_pos: np.ndarray, cells: Mapping[str, np.ndarray], values: Mapping[str, np.ndarray], periodicity: Periodicity = NOWHERE
) -> np.ndarray:
    """Return the mean [node, …] of the values of the cells around each node, weighted by the sizes of the cells; 0 at nodes without a cell.

    At each node only the cells of the highest dimension there count.

    Args:
        rest_pos: positions at rest [node, dim] in m.
        cells: nodes of the cells by kind [cell, corner].
        values: values of the cells by kind [cell, …].
        periodicity: periodic axes of the domain.
    """
    shape = next(iter(values.values())).shape[1:]
    total, weight = np.zeros((len(rest_pos), *shape)), np.zeros(len(rest_pos))
    left = dict(cells)
    while left:
        highest, without = of_highest_dimension(left), weight == 0
        for kind, own in highest.items():
            size = sizes(rest_pos, kind, own, periodicity)
            here = without[own] * size[:, None]
            weighted = here.reshape(*own.shape, *[1] * len(shape)) * values[kind][:, None]
            weighted[here == 0] = 0.0  # also where cells that do not count have no value
            np.add.at(total, own, weighted)
            np.add.at(weight, own, here)
            del left[kind]
    return np.asarray(total / np.where(weight > 0, weight, 1.0).reshape(-1, *[1] * len(shape)))


def between_frames(force: Float[np.ndarray, "frame node dim"]) -> Float[np.ndarray, "frame node dim"]:
    """Return the forces that act from each frame to the next, as means of those at both times. Programs write the forces at the time of a result."""
    return (force + np.concatenate([force[1:], force[-1:]])) / 2


def interval(times: np.ndarray) -> float:
    """Return the time between frames [s] at ``times`` [frame] in s: the mean of intervals that are even but for rounding, otherwise the first one."""
    steps = np.diff(times)
    return float(steps.mean() if _are_even(steps) else steps[0])


def check_intervals(times: np.ndarray, facts: Facts, advice: str) -> None:
    """Check that frames are ``facts.frame_dt`` apart, or evenly spaced if that is None.

    Args:
        times: times of the frames [frame] in s.
        facts: facts of the data set.
        advice: what to do if they are not.

    Raises:
        Refusal: intervals differ.
    """
    steps = np.diff(times)
    step = interval(times)
    expected = facts.frame_dt or step
    if not _are_even(steps):
        raise Refusal(f"intervals between results are {steps.min():g} to {steps.max():g} s, expected {expected:g} s; {advice}")
    if abs(step / expected - 1) > UNEVEN:
        raise Refusal(
            f"results are {step:g} s apart, and frame_dt is {expected:g} s (of the command, or of other trajectories); both must be the same"
        )


def _are_even(steps: np.ndarray) -> bool:
    return bool(steps.min() > 0 and np.ptp(steps) <= UNEVEN * steps[0])
