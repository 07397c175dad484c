"""Images of walls and obstacles under maps of space that map axes onto axes: mirror images and quarter turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpe_pl.geometry.shapes import Bowl, Box, Polygon, Shape, Sphere, Wall


def image_of(shape: Shape, matrix: np.ndarray, shift: np.ndarray) -> Shape | None:
    """Return the image of a wall or obstacle under ``x → matrix @ x + shift``; None for kinds that have none, such as grids of distances.

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
    return None
