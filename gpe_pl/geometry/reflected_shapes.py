"""Mirror images of walls and obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpe_pl.geometry.shapes import Bowl, Box, Polygon, Shape, Sphere, Wall


def reflected(shape: Shape, planes: Sequence[float | None]) -> Shape | None:
    """Return the mirror image of a wall or obstacle; None for kinds that have none, such as grids of distances.

    Args:
        shape: wall or obstacle.
        planes: position of the plane normal to each axis [m]; None for axes that stay.
    """
    sign = np.array([1.0 if plane is None else -1.0 for plane in planes])
    shift = np.array([0.0 if plane is None else 2 * plane for plane in planes])

    def images(points: Any) -> np.ndarray:
        return np.asarray(points, np.float64) * sign + shift

    def between(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
        ends = np.sort(images([low, high]), axis=0)
        return {"low": tuple(ends[0].tolist()), "high": tuple(ends[1].tolist())}

    if isinstance(shape, Sphere | Bowl):
        return replace(shape, center=tuple(images(shape.center).tolist()))
    if isinstance(shape, Box):
        return replace(shape, **between(shape.low, shape.high))
    if isinstance(shape, Polygon):
        vertices = images(shape.vertices)
        return replace(shape, vertices=tuple(map(tuple, (vertices if sign.prod() > 0 else vertices[::-1]).tolist())))
    if isinstance(shape, Wall):
        normal = np.asarray(shape.normal, np.float64) * sign
        return replace(shape, normal=tuple(normal.tolist()), offset=float(shape.offset + normal @ shift), **between(shape.low, shape.high))
    return None
