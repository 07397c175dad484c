"""Obstacles that touch or overlap. Solvers and models take the surface of each shape alone, so a face between two shapes stops what slides across it.

In 2D, boxes and polygons with the same friction become one polygon, which has no such face. A warning names others.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from itertools import combinations

import numpy as np
import shapely

from gpe_pl.geometry.shapes import Box, Polygon, Shape

log = logging.getLogger(__name__)

TOUCHING = 1e-6
"""Largest distance of shapes that touch, as a fraction of the largest side of the smaller one. It is that of rounding."""


def united(shapes: Mapping[str, Shape], spacing: float) -> tuple[Shape, ...]:
    """Return the shapes, of which those that touch or overlap are one where possible. A warning names pairs that touch and stay two shapes.

    Args:
        shapes: obstacles by name.
        spacing: distance of the points of surfaces that are compared [m].
    """
    group = {name: name for name in shapes}
    found: dict[str, Shape] = dict(shapes)
    for kind in dict.fromkeys(filter(None, map(_kind, shapes.values()))):
        members = [name for name, shape in shapes.items() if _kind(shape) == kind]
        for names, polygon in _unions({name: _outline(shapes[name]) for name in members}, kind):
            group |= dict.fromkeys(names, names[0])
            found[names[0]] = polygon
    for one, other in combinations(shapes, 2):
        if group[one] != group[other] and _touch(shapes[one], shapes[other], spacing):
            log.warning(
                "%s and %s touch or overlap: what slides across the face between them can catch on it; one obstacle in their place has none",
                one,
                other,
            )
    return tuple(found[name] for name in shapes if group[name] == name)


def _kind(shape: Shape) -> tuple[float, float] | None:
    """Return friction and restitution of a polygon or a box in 2D; None for other shapes."""
    is_flat = isinstance(shape, Polygon) or (isinstance(shape, Box) and len(shape.low) == 2)
    return (shape.friction, shape.restitution) if is_flat else None


def _outline(shape: Shape) -> shapely.Polygon:
    if isinstance(shape, Box):
        return shapely.box(*shape.low, *shape.high)
    assert isinstance(shape, Polygon)
    return shapely.Polygon(shape.vertices)


def _unions(outlines: Mapping[str, shapely.Polygon], kind: tuple[float, float]) -> list[tuple[list[str], Polygon]]:
    """Return the unions of at least two outlines that are simple polygons, each with the names of its members."""
    size = max(max(np.ptp(np.reshape(own.bounds, (2, 2)), axis=0)) for own in outlines.values())
    together = shapely.union_all([*outlines.values()], grid_size=TOUCHING * size)
    unions = []
    for part in shapely.get_parts(together):
        names = [name for name, own in outlines.items() if part.intersection(own).area > 0.5 * own.area]
        if len(names) > 1 and not part.interiors:
            corners = shapely.orient_polygons(part.simplify(TOUCHING * size)).exterior.coords[:-1]
            unions.append((names, Polygon(tuple((float(x), float(y)) for x, y in corners), *kind)))
    return unions


def _touch(one: Shape, other: Shape, spacing: float) -> bool:
    """Whether a point of the surface of one shape lies in or on the other."""
    tolerance = TOUCHING * min(one.extent, other.extent)
    return any(bool((b.signed_distance(a.sample(spacing)[0]) <= tolerance).any()) for a, b in ((one, other), (other, one)))
