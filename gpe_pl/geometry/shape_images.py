"""Images of walls and obstacles under maps of space that map axes onto axes: mirror images and quarter turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import Repeated
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, Wall

MAX_GRIDS = 64
"""Number of grids of distances whose images are kept. Packing and unpacking their values takes time."""
ROUNDING = 1e-9
"""Bounds of a domain that differ by less than this fraction of its size are the same."""


def image_of(shape: Shape, matrix: np.ndarray, shift: np.ndarray) -> Shape | None:
    """Return the image of a wall or obstacle under ``x → matrix @ x + shift``; None for shapes of other classes than those of ``gpe_pl.geometry``.

    Args:
        shape: wall or obstacle.
        matrix: permutation of the axes with signs [dim, dim].
        shift: displacement [dim] in m.
    """

    def images(points: Any) -> np.ndarray:
        return np.asarray(points, np.float64) @ matrix.T + shift

    def between(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
        ends = np.sort(images([low, high]), axis=0)
        return {"low": tuple(ends[0].tolist()), "high": tuple(ends[1].tolist())}

    if isinstance(shape, Sphere | Bowl):
        return replace(shape, center=tuple(images(shape.center).tolist()))
    if isinstance(shape, Box):
        return replace(shape, **between(shape.low, shape.high))
    if isinstance(shape, Polygon):
        vertices = images(shape.vertices)
        return replace(shape, vertices=tuple(map(tuple, (vertices if np.linalg.det(matrix) > 0 else vertices[::-1]).tolist())))
    if isinstance(shape, Wall):
        normal = matrix @ np.asarray(shape.normal, np.float64)
        return replace(shape, normal=tuple(normal.tolist()), offset=float(shape.offset + normal @ shift), **between(shape.low, shape.high))
    if isinstance(shape, DistanceGrid):
        return _grid_image(shape, tuple(map(tuple, np.asarray(matrix, np.float64).tolist())), tuple(np.asarray(shift, np.float64).tolist()))
    if isinstance(shape, Repeated):
        image = image_of(shape.shape, matrix, shift)
        low, high = between(*np.transpose(shape.periodicity.bounds).tolist()).values()
        return None if image is None else Repeated(image, _periodicity_image(shape.periodicity, matrix, tuple(zip(low, high, strict=True))))
    return None


@lru_cache(MAX_GRIDS)
def _grid_image(grid: DistanceGrid, matrix: tuple[tuple[float, ...], ...], shift: tuple[float, ...]) -> DistanceGrid:
    rows = np.array(matrix)
    first = rows @ np.array(grid.origin) + shift
    last = rows @ (np.array(grid.origin) + grid.spacing * (np.array(grid.counts) - 1)) + shift
    axes = np.abs(rows).argmax(axis=1)  # axis of the grid along each axis of its image
    turned = np.flatnonzero(rows.sum(axis=1) < 0)
    values = np.flip(grid.values.transpose(axes), tuple(turned.tolist()))
    return DistanceGrid.from_values(np.minimum(first, last), grid.spacing, values, grid.friction, grid.restitution)


def _periodicity_image(space: Periodicity, matrix: np.ndarray, bounds: tuple[tuple[float, float], ...]) -> Periodicity:
    """Return the periodicity with images of its bounds; the same object if the domain is mapped onto itself."""
    periodic = tuple(space.periodic[axis] for axis in np.abs(matrix).argmax(axis=1))
    size = np.ptp(space.bounds)
    is_same = periodic == space.periodic and np.abs(np.subtract(bounds, space.bounds)).max() <= ROUNDING * size
    return space if is_same else Periodicity(bounds, periodic)
