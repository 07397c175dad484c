"""Kinds of mesh cells, which follow from their dimension and number of corners.

Cells are stored in one array [cell, corner]. A cell with fewer corners than others repeats its last corner: a triangle among quadrilaterals is
``[a, b, c, c]``. Nodes that cells connect, directly or through others, are a body.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gpe_pl.schema import CELL_KINDS

Array = Any


def fitting_kinds(num_corners: int, dim: int) -> list[str]:
    """Return the kinds with this number of corners that exist in a space of this dimension."""
    return [kind for kind, (own_dim, corners) in CELL_KINDS.items() if corners == num_corners and own_dim <= dim]


def kinds_of(cells: np.ndarray, cell_dim: int | None, dim: int) -> np.ndarray:
    """Return the kind of each cell [cell] as an index into ``schema.CELL_KINDS``; -1 if no kind has this number of corners, or a node occurs twice.

    Repetitions of the last corner at the end of a cell do not count.

    Args:
        cells: nodes of each cell [cell, corner].
        cell_dim: largest dimension of the cells; None stands for the dimension of space. It tells quadrilaterals from tetrahedra.
        dim: dimension of space.
    """
    ordered = np.sort(cells, axis=1)
    corners = 1 + (ordered[:, 1:] != ordered[:, :-1]).sum(axis=1)
    repeated = (is_corner(cells) != (np.arange(cells.shape[1]) < corners[:, None])).any(axis=1)  # except the last corner
    kinds = np.full(len(cells), -1)
    for code, (own_dim, number) in enumerate(CELL_KINDS.values()):
        is_possible = own_dim == (cell_dim or dim) if number == 4 else own_dim <= dim
        kinds[(corners == number) & is_possible] = code
    kinds[repeated] = -1
    return kinds


def is_corner(cells: Array) -> Array:
    """Return a mask [cell, corner] of the entries of ``cells``, arrays or tensors, that are corners and not repetitions of the last one."""
    own = cells >= 0  # all true
    own[:, 1:] = cells[:, 1:] != cells[:, :-1]
    return own


def mean_over_corners(values: Array, cells: Array) -> Array:
    """Return the mean [cell, …] of values [node, …] over the corners of each cell [cell, corner]; arrays or tensors."""
    own = is_corner(cells).reshape(*cells.shape, *[1] * (values.ndim - 1))
    return (values[cells] * own).sum(axis=1) / own.sum(axis=1)


def stacked(groups: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return one array of cells from arrays [cell, corner] of each kind, in their order. Cells with fewer corners than others repeat their last corner."""
    width = max((cells.shape[1] for cells in groups.values()), default=3)
    padded = [np.pad(cells, ((0, 0), (0, width - cells.shape[1])), mode="edge") for cells in groups.values()]
    return np.concatenate([np.empty((0, width), np.int32), *padded]).astype(np.int32)


def cell_edges(cells: Int64[np.ndarray, "cell corner"], num_nodes: int) -> Int64[np.ndarray, "2 edge"]:
    """Return the pairs of nodes with a common cell, each once, the lower node first."""
    pairs = [cells[:, [a, b]].T for a, b in itertools.combinations(range(cells.shape[1]), 2)]
    both = np.concatenate([np.empty((2, 0), dtype=np.int64), *pairs], axis=1)
    return unique_pairs(both[:, both[0] != both[1]], num_nodes)  # a cell may name a node twice: a triangle among quadrilaterals


def pair_keys(pairs: np.ndarray, count: int) -> Any:
    """Return one number per unordered pair of two numbers below ``count``."""
    return pairs.min(axis=0) * count + pairs.max(axis=0)


def unique_pairs(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return each unordered pair [2, pair] of two numbers below ``count`` once, the lower number first."""
    keys = np.unique(pair_keys(pairs, count))
    return np.stack([keys // count, keys % count])


def components(edges: Int64[np.ndarray, "2 edge"], num_nodes: int) -> tuple[int, Int64[np.ndarray, "node"]]:
    """Return the number of connected components of a graph, and the component of each node."""
    ones = np.ones(edges.shape[1], dtype=bool)
    number, label = connected_components(coo_array((ones, tuple(edges)), shape=(num_nodes, num_nodes)), directed=False)
    return int(number), label.astype(np.int64)


def bodies(cells: np.ndarray, num_nodes: int) -> list[Int64[np.ndarray, "node"]]:
    """Return the nodes of each body, in ascending order; nodes of no cell belong to none."""
    cells = np.asarray(cells, np.int64)
    used, (_, label) = np.unique(cells), components(cell_edges(cells, num_nodes), num_nodes)
    if not len(used):
        return []
    order = np.argsort(label[used], kind="stable")
    _, first = np.unique(label[used][order], return_index=True)
    return np.split(used[order], first[1:])
