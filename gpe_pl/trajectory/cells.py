"""Kinds of mesh cells, told by their dimension and number of corners.

Cells are stored in one array [cell, corner]. A cell with fewer corners than others repeats its last one: a triangle among quadrilaterals is ``[a, b, c, c]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gpe_pl.schema import CELL_KINDS

Array = Any


def fitting_kinds(num_corners: int, dim: int) -> list[str]:
    """Kinds that have so many corners and exist in a space of this dimension."""
    return [kind for kind, (own_dim, corners) in CELL_KINDS.items() if corners == num_corners and own_dim <= dim]


def kinds_of(cells: np.ndarray, cell_dim: int | None, dim: int) -> np.ndarray:
    """Kind of each cell [cell] as its place in ``schema.CELL_KINDS``, -1 where the number of corners is that of none, or a node is there twice.

    Args:
        cells: nodes of each cell [cell, corner].
        cell_dim: dimension of the cells; None: that of space, apart from triangles.
        dim: of space.
    """
    ordered = np.sort(cells, axis=1)
    corners = 1 + (ordered[:, 1:] != ordered[:, :-1]).sum(axis=1)
    repeated = (is_corner(cells) != (np.arange(cells.shape[1]) < corners[:, None])).any(axis=1)  # other than the last corner, at the end
    kinds = np.full(len(cells), -1)
    for code, (own_dim, number) in enumerate(CELL_KINDS.values()):
        kinds[(corners == number) & (own_dim == (cell_dim or dim) or number == 3)] = code
    kinds[repeated] = -1
    return kinds


def is_corner(cells: Array) -> Array:
    """Which entries of cells [cell, corner], arrays or tensors, are corners, and not the last one again."""
    own = cells >= 0  # all of them
    own[:, 1:] = cells[:, 1:] != cells[:, :-1]
    return own


def mean_over_corners(values: Array, cells: Array) -> Array:
    """Mean [cell, …] over the corners of each cell [cell, corner] of values [node, …], arrays or tensors."""
    own = is_corner(cells).reshape(*cells.shape, *[1] * (values.ndim - 1))
    return (values[cells] * own).sum(axis=1) / own.sum(axis=1)


def stacked(groups: Mapping[str, np.ndarray]) -> np.ndarray:
    """One array of cells from those of each kind [cell, corner], in their order."""
    width = max((cells.shape[1] for cells in groups.values()), default=3)
    padded = [np.pad(cells, ((0, 0), (0, width - cells.shape[1])), mode="edge") for cells in groups.values()]
    return np.concatenate([np.empty((0, width), np.int32), *padded]).astype(np.int32)
