"""Checks of mesh cells whose rest positions are known: whether nodes are counted from 0, and whether corners are in VTK's order."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.schema import CELL_KINDS
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.cells import is_corner, kinds_of
from gpe_pl.trajectory.strain import local_gradients

ROUNDING = 1e-6
"""Relative difference of lengths below which they may be equal."""
NO_VOLUME = 1e-6
"""Volume of a cell, as a fraction of that of a cube as wide as the cell, below which it has no volume."""
ROUNDINGS = 8
"""Number of roundings of a position by which corners of a cell may be displaced."""
CELLS_AT_ONCE = 4096
"""Number of cells whose Jacobians fit into the cache of a processor."""


def check_at_rest(cells: np.ndarray, cell_dim: int, rest_pos: np.ndarray, periodicity: Periodicity) -> None:
    """Raise ``ArrayError`` if cells [cell, corner] count nodes from 1, or if the corners of a cell are in another order than VTK's.

    Args:
        cells: nodes of each cell [cell, corner], all of which exist.
        cell_dim: largest dimension of the cells.
        rest_pos: undeformed positions [node, dim] in m.
        periodicity: axes along which space repeats.
    """
    check_counted_from_0(cells, rest_pos, periodicity)
    for kind, rows in _by_kind(cells, cell_dim, rest_pos.shape[1]):
        low, high = _volumes(kind, cells[rows], rest_pos, periodicity)
        wrong = (low < 0) & (high > 0)
        if wrong.any():
            number = int(wrong.argmax())
            corners = cells[rows[number], : CELL_KINDS[kind][1]].tolist()
            raise ArrayError(
                f"cells: {kind} {number} with the corners {corners} is tangled: its Jacobian changes sign; corners must run in VTK's order"
            )


def check_counted_from_0(cells: np.ndarray, rest_pos: np.ndarray, periodicity: Periodicity) -> None:
    """Raise ``ArrayError`` if cells [cell, corner] count nodes from 1: node 0 is in no cell, and with numbers less by one the cells have shorter sides.

    Args:
        cells: nodes of each cell [cell, corner], all of which exist.
        rest_pos: undeformed positions [node, dim] in m.
        periodicity: axes along which space repeats.
    """

    def sides(corners: np.ndarray) -> float:
        ways = periodicity.shortest((rest_pos[corners] - rest_pos[np.roll(corners, 1, axis=1)]).astype(np.float64))
        return float(np.linalg.norm(ways, axis=-1).sum())

    if len(cells) and cells.min() == 1 and sides(cells - 1) < (1 - ROUNDING) * sides(cells):
        raise ArrayError(
            f"cells: node 0 is in no cell, and the nodes of cell 0, {cells[0].tolist()}, are nearer to each other if they are counted from 1; "
            "subtract 1 from all numbers, or put nodes without cells last"
        )


def suspects(cells: np.ndarray, cell_dim: int | None, rest_pos: np.ndarray, periodicity: Periodicity) -> Iterator[str]:
    """Yield warnings about cells without volume, and about cells that occur twice. Arguments are those of ``check_at_rest``."""
    flat = list[int]()
    for kind, rows in _by_kind(cells, cell_dim, rest_pos.shape[1]):
        low, high = _volumes(kind, cells[rows], rest_pos, periodicity)
        flat += rows[(low == 0) & (high == 0)].tolist()
    if flat:
        yield f"{len(flat)} cells have no volume at rest, the first is cell {min(flat)}: are corners in one line or plane?"
    ordered = np.sort(np.where(is_corner(cells), cells, -1), axis=1)
    order = np.lexsort(ordered.T)
    repeated = order[1:][(ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)]
    if len(repeated):
        yield f"{len(repeated)} cells have the corners of another cell, the first is cell {repeated.min()}: was a part of the mesh written twice?"


def _by_kind(cells: np.ndarray, cell_dim: int | None, dim: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each kind of surfaces and volumes with the rows of its cells."""
    kinds = kinds_of(cells, cell_dim, dim)
    for code, (kind, (own_dim, _)) in enumerate(CELL_KINDS.items()):
        if own_dim > 1 and len(rows := np.flatnonzero(kinds == code)):
            yield kind, rows


def _volumes(
    kind: str, cells: np.ndarray, rest_pos: np.ndarray, periodicity: Periodicity
) -> tuple[Float[np.ndarray, " cell"], Float[np.ndarray, " cell"]]:
    """Return the lowest and the highest volume at the points of each cell of a kind [m^dim]; those that may be roundings are 0.

    Volumes of surfaces in space are areas. They are negative where the normal points against that of the point with the largest area.
    """
    own_dim, count = CELL_KINDS[kind]
    local = _of_wedge() if kind == "wedge" else local_gradients(own_dim, count)[0]
    is_single = (rest_pos == rest_pos.astype(np.float32)).all()
    rounding = ROUNDINGS * np.finfo(np.float32 if is_single else np.float64).eps * float(np.abs(rest_pos).max(initial=0.0))
    lows, highs = np.empty(len(cells)), np.empty(len(cells))
    for start in range(0, len(cells), CELLS_AT_ONCE):
        part = slice(start, start + CELLS_AT_ONCE)
        corners = rest_pos[cells[part, :count].T].astype(np.float64)
        corners = np.moveaxis(periodicity.shortest(corners - corners[:1]), 2, 0)
        width = np.sqrt(np.square(corners).sum(axis=0).max(axis=0))
        volume = _determinants(np.ascontiguousarray(corners), local)
        volume[np.abs(volume) <= (NO_VOLUME * width + rounding) * width ** (own_dim - 1)] = 0.0
        lows[part], highs[part] = volume.min(axis=0), volume.max(axis=0)
    return lows, highs


def _determinants(
    corners: Float[np.ndarray, "dim corner cell"], local: Float[np.ndarray, "point corner own_dim"]
) -> Float[np.ndarray, "point cell"]:
    """Return the determinant of the Jacobian at each point; of surfaces in space, the area with a sign (see ``_volumes``)."""
    num_points, num_corners, own_dim = local.shape
    matrix = local.transpose(0, 2, 1).reshape(-1, num_corners)
    rows = [(matrix @ along).reshape(num_points, own_dim, -1) for along in corners]

    def minor(i: int, j: int) -> np.ndarray:
        return np.asarray(rows[i][:, 0] * rows[j][:, 1] - rows[j][:, 0] * rows[i][:, 1])

    if len(rows) == 2:
        return minor(0, 1)
    normal = np.stack([minor(1, 2), minor(2, 0), minor(0, 1)])
    if own_dim == 3:
        return np.asarray(sum(row[:, 2] * component for row, component in zip(rows, normal, strict=True)))
    area = np.sqrt(np.square(normal).sum(axis=0))
    largest = np.take_along_axis(normal, area.argmax(axis=0)[None, None], axis=1)
    return np.copysign(area, (normal * largest).sum(axis=0))


def _of_wedge() -> Float[np.ndarray, "point corner dim"]:
    """Return the gradients of the shape functions of a wedge at three points of a triangle and two along its height."""
    triangle, slopes = np.array([[1, 1], [4, 1], [1, 4]]) / 6.0, np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    points = []
    for x, y in triangle:
        for height in (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)):
            share = np.array([1.0 - x - y, x, y])
            lower = np.column_stack([(1.0 - height) * slopes, -share])
            points.append(np.concatenate([lower, np.column_stack([height * slopes, share])]))
    return np.stack(points)
