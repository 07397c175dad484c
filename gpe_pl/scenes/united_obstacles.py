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
NECKS = (4.0, 2.0, 1.0, 0.5)
"""Widths [spacings] below which a union must not have a neck, from wide to narrow. The first counts that both members have nowhere."""


def united(shapes: Mapping[str, Shape], spacing: float) -> tuple[Shape, ...]:
    """Return the shapes, of which those that touch or overlap are one where possible. A warning names pairs that touch and stay two shapes.

    A union is not made if it encloses a space or has a neck that its members have not, because solvers refuse thin obstacles.

    Args:
        shapes: obstacles by name.
        spacing: distance of nodes [m].
    """
    if len(shapes) < 2:
        return tuple(shapes.values())
    group, found = {name: name for name in shapes}, dict(shapes)
    for kind in dict.fromkeys(filter(None, map(_kind, shapes.values()))):
        rest = {name: _outline(shape) for name, shape in shapes.items() if _kind(shape) == kind}
        while rest:
            first = next(iter(rest))
            names, outline = _grown(first, rest, spacing)
            rest = {name: own for name, own in rest.items() if name not in names}
            if len(names) > 1:
                group |= dict.fromkeys(names, first)
                found[first] = Polygon(tuple((float(x), float(y)) for x, y in outline.exterior.coords[:-1]), *kind)
    surfaces = {name: shape.sample(spacing)[0] for name, shape in shapes.items()}
    for one, other in combinations(shapes, 2):
        if group[one] != group[other] and _share_a_face(shapes[one], surfaces[one], shapes[other], surfaces[other], spacing):
            log.warning(
                "%s and %s touch or overlap: what slides across the face between them can catch on it; leave a gap, or make them one shape",
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


def _grown(first: str, outlines: Mapping[str, shapely.Polygon], spacing: float) -> tuple[list[str], shapely.Polygon]:
    """Return the names of the outlines that can be added to the first one by one, and their union, counter-clockwise."""
    names, union = [first], outlines[first]
    waiting = [name for name in outlines if name != first]
    while True:
        for name in waiting:
            if (larger := _union(union, outlines[name], spacing)) is not None:
                names, union = [*names, name], larger
                waiting.remove(name)
                break
        else:
            return names, union


def _union(one: shapely.Polygon, other: shapely.Polygon, spacing: float) -> shapely.Polygon | None:
    """Return the union of two outlines, or None if they are apart or it is no simple polygon without further necks."""
    tolerance = TOUCHING * min(float(np.ptp(np.reshape(own.bounds, (2, 2)), axis=0).max()) for own in (one, other))
    if not shapely.dwithin(one, other, tolerance):
        return None
    union = one.union(shapely.snap(other, one, tolerance))
    if not isinstance(union, shapely.Polygon) or any(shapely.Polygon(hole).area > spacing**2 for hole in union.interiors):
        return None
    width = next((neck * spacing for neck in NECKS if _is_wide(one, neck * spacing) and _is_wide(other, neck * spacing)), 0.0)
    union = shapely.orient_polygons(shapely.Polygon(union.exterior).simplify(tolerance))
    return union if not width or _is_wide(union, width) else None


def _is_wide(outline: shapely.Polygon, width: float) -> bool:
    """Whether an outline has no neck narrower than a width [m]: what is farther inside than half of it is one piece."""
    inner = outline.buffer(-width / 2, join_style="mitre")
    return isinstance(inner, shapely.Polygon) and not inner.is_empty


def _share_a_face(one: Shape, surface: np.ndarray, other: Shape, other_surface: np.ndarray, spacing: float) -> bool:
    """Whether a stretch of the surface [point, dim] of one shape, at least a spacing [m] long, lies in or on the other."""
    tolerance = TOUCHING * min(one.extent, other.extent)
    low = np.maximum(surface.min(axis=0), other_surface.min(axis=0)) - tolerance
    high = np.minimum(surface.max(axis=0), other_surface.max(axis=0)) + tolerance
    for shape, points in ((other, surface), (one, other_surface)):
        near = points[np.all((points >= low) & (points <= high), axis=1)]
        inside = near[np.asarray(shape.signed_distance(near)) <= tolerance] if len(near) else near
        if len(inside) and np.ptp(inside, axis=0).max() >= (1 - 1e-6) * spacing:
            return True
    return False
