"""Lattices of particles, and bodies of random shape that are cut out of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

JITTER = 0.25
"""Largest displacement from the initial lattice along each axis [spacings]. A regular lattice would separate along its rows when the material spreads."""

MESHED = ("elastomer",)
"""Materials whose particles keep their neighbours. Their particles start on a regular lattice, whose cells form their mesh."""


class Body(NamedTuple):
    """Particles of one body: positions [point, dim] in m, material, the nodes of its mesh cells [cell, corner], and whether it starts at rest."""

    pos: np.ndarray
    material: str
    cells: np.ndarray
    rests: bool = False


def integer_lattice(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return points [point, dim] with integer coordinates from ``first`` to ``last`` [dim]."""
    axes = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def jittered_lattice(first: np.ndarray, last: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return jittered points [point, dim] around the integer points from ``first`` to ``last`` [dim]."""
    lattice = integer_lattice(first, last)
    return lattice + rng.uniform(-JITTER, JITTER, lattice.shape)


def lattice_body(count: int, spacing: float, material: str, dim: int, rng: np.random.Generator, flat: int | None = None) -> Body:
    """Return a randomly turned body of ``count`` lattice points around the origin, jittered unless it is meshed.

    Every shape is a level set of a gauge, so the ``count`` points of smallest gauge fill the shape at the right size. With ``flat``, the body is not
    turned, and is the half of its shape on the positive side of this axis; its first layer is half a spacing from the origin.
    """
    gauge = _random_convex_shape(rng, dim)
    reach = math.ceil(2.0 * count ** (1 / dim)) + 2
    lattice = integer_lattice(np.full(dim, -reach), np.full(dim, reach))
    is_meshed = material in MESHED
    jitter = np.zeros(lattice.shape) if is_meshed else rng.uniform(-JITTER, JITTER, lattice.shape)
    offset = rng.uniform(-0.5, 0.5, dim)
    if flat is not None:
        offset[flat] = 0.5
    points = lattice + jitter + offset
    size = gauge(points)
    if flat is not None:
        size[lattice[:, flat] < 0] = np.inf
    kept = np.argsort(size, kind="stable")[:count]
    cells = lattice_cells(lattice[kept]) if is_meshed else np.empty((0, dim + 1), dtype=np.int64)
    pos = spacing * points[kept]
    return Body(pos if flat is not None else pos @ _rotation(rng, dim).T, material, cells)


def _rotation(rng: np.random.Generator, dim: int) -> np.ndarray:
    """Draw a uniformly distributed rotation [dim, dim]; in 3D from a random unit quaternion."""
    if dim == 2:
        turn = rng.uniform(0, 2 * math.pi)
        return np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def lattice_cells(sites: np.ndarray) -> np.ndarray:
    """Return simplices [cell, dim + 1] of positive orientation that fill every lattice cell with all corners among the integer sites [point, dim].

    Each cell is cut along paths from its lowest to its highest corner, one simplex per order of the axes (Kuhn 1960), so that neighbours share faces.
    """
    dim = sites.shape[1]
    number = {tuple(site): k for k, site in enumerate(sites.tolist())}
    cells = []
    for axes in itertools.permutations(range(dim)):
        path = np.concatenate([np.zeros((1, dim), int), np.cumsum(np.eye(dim, dtype=int)[list(axes)], axis=0)])
        if np.linalg.det(path[1:]) < 0:
            path[[1, 2]] = path[[2, 1]]
        cells.append(path)
    corners = np.array(list(itertools.product((0, 1), repeat=dim)))
    whole = [s for s in sites if all(tuple(c) in number for c in (s + corners).tolist())]
    simplices = [[number[tuple(c)] for c in (s + path).tolist()] for s in whole for path in cells]
    return np.array(simplices, dtype=np.int64).reshape(-1, dim + 1)


def _random_convex_shape(rng: np.random.Generator, dim: int) -> Callable[[np.ndarray], np.ndarray]:
    """Draw a convex shape, as the function that gives the factor [point] by which it must be scaled to reach each point [point, dim]."""
    kind = rng.integers(3)
    if kind == 0:
        half = _half_lengths(rng, dim)
        return lambda x: np.max(np.abs(x) / half, axis=-1)
    if kind == 1:
        return lambda x: np.linalg.norm(x, axis=-1)
    sides = int(rng.integers(3, 8))
    if dim == 2:
        angle = 2 * math.pi * (np.arange(sides) + rng.uniform(-0.2, 0.2, sides)) / sides
        normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    else:  # four normals of a tetrahedron close the shape, more normals cut it
        normals = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], *rng.normal(size=(sides, 3))])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
    return lambda x: np.max(x @ normals.T, axis=-1)


def _half_lengths(rng: np.random.Generator, dim: int) -> np.ndarray:
    """Draw half edge lengths [dim] of a box of volume 2^dim."""
    if dim == 2:
        stretch = math.sqrt(rng.uniform(1.0, 2.5))
        return np.array([stretch, 1.0 / stretch])
    lengths = np.sqrt(rng.uniform(1.0, 2.5, dim))
    return lengths / np.prod(lengths) ** (1 / dim)
