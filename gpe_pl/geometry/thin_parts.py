"""How thick solids are, to find parts that a grid does not resolve."""

from __future__ import annotations

import math

import numpy as np

from gpe_pl.geometry.compiled_distance import compiled_distance
from gpe_pl.geometry.shapes import Box, DistanceGrid, Polygon, Shape, Sphere, outward_normal

NUM_POINTS = (40, 300)
"""Smallest and largest number of points of the surface from which the thickness is measured."""
MOST_PAIRS = 3_000_000
"""Number of pairs of a point and a face above which there are fewer points."""
SLACK = 1e-9
"""Fraction of a face by which it reaches beyond its rim, so that nothing passes between two faces."""
QUANTILE = 0.05
"""Part of the surface that may be thinner, as the tips of wedges are."""
MOST_INCLINED = math.radians(2)
"""Largest angle between two faces of a ``DistanceGrid`` that bound a thin part. At a larger angle they form a wedge, which is thin at its tip only."""


def thickness(shape: Shape) -> float:
    """Return the smallest thickness of a shape [m].

    It is the diameter of a sphere and the shortest side of a box. In a polygon it is the shortest way through it, either from the middle of an edge along the
    inward normal or from a concave corner. In a ``DistanceGrid`` it is the thickness below which a twentieth of the surface is, between faces that are parallel
    up to ``MOST_INCLINED``. It is infinite for all other shapes.
    """
    if isinstance(shape, Sphere):
        return 2.0 * shape.radius
    if isinstance(shape, Box):
        return min(high - low for low, high in zip(shape.low, shape.high, strict=True))
    if isinstance(shape, DistanceGrid):
        return _thickness_of_grid(shape)
    return _thickness_of_polygon(shape) if isinstance(shape, Polygon) else math.inf


def _thickness_of_polygon(shape: Polygon) -> float:
    vertices = np.array(shape.vertices, dtype=np.float64)
    before, after = vertices - np.roll(vertices, 1, axis=0), np.roll(vertices, -1, axis=0) - vertices
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    straight = np.abs(turn) <= 1e-9 * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    a = vertices[~straight]  # a vertex on a straight line does not divide an edge
    edge = np.roll(a, -1, axis=0) - a
    tangent = edge / np.linalg.norm(edge, axis=1)[:, None]
    thinnest_part = _between_corners(a, edge, turn[~straight] < 0)
    for k, middle in enumerate(a + edge / 2):
        inward = np.array([-tangent[k, 1], tangent[k, 0]])
        # Coordinates of all vertices in the frame of this edge: along it and into the polygon.
        along, depth = (a - middle) @ tangent[k], (a - middle) @ inward
        for j in range(len(a)):
            n = (j + 1) % len(a)
            if j != k and along[j] != along[n] and min(along[j], along[n]) <= 0.0 <= max(along[j], along[n]):
                hit = depth[j] + (depth[n] - depth[j]) * along[j] / (along[j] - along[n])
                if hit > 0.0:
                    thinnest_part = min(thinnest_part, float(hit))
    return thinnest_part


def _between_corners(corners: np.ndarray, edge: np.ndarray, concave: np.ndarray) -> float:
    """Return the length [m] of the shortest neck of a polygon that starts at a concave corner, infinite without one.

    A neck is a way into the polygon to which there is no shorter one beside it: it ends at right angles on an edge, or at another concave corner.

    Args:
        corners: corners, counter-clockwise [corner, 2] in m.
        edge: vector from each corner to the next one [corner, 2] in m.
        concave: mask of the concave corners [corner].
    """
    shortest, count = math.inf, len(corners)

    def widens(k: int, way: np.ndarray) -> bool:
        """Tell whether both edges of a corner lead away from the other end of a way that starts there."""
        return bool(concave[k] and way @ edge[k] <= 0.0 <= way @ edge[k - 1])

    for k in np.flatnonzero(concave).tolist():
        for j in range(count):
            if j in (k, (k - 1) % count):
                continue
            t = (corners[k] - corners[j]) @ edge[j] / (edge[j] @ edge[j])
            way = corners[j] + min(max(t, 0.0), 1.0) * edge[j] - corners[k]
            is_neck = 0.0 < t < 1.0 or widens(j if t <= 0.0 else (j + 1) % count, -way)
            if is_neck and widens(k, way):
                shortest = min(shortest, float(np.linalg.norm(way)))
    return shortest


def _thickness_of_grid(grid: DistanceGrid) -> float:
    """Follow ways from points of the surface into the solid. A way that leaves the nodes of the grid does not count, because the solid may go on there."""
    points = grid.surface_points(3 * grid.spacing)
    if len(points) == 0:
        return math.inf
    points = np.random.default_rng(0).permutation(points)[: NUM_POINTS[1]]
    step, shapes = 0.1 * grid.spacing, (grid,)
    first, last = np.array(grid.origin), np.array(grid.origin) + grid.spacing * (np.array(grid.counts) - 1)
    normal = outward_normal(grid, points, step)
    way, depth = np.zeros(len(points)), np.full(len(points), step)
    through, going = np.full(len(points), np.inf), np.arange(len(points))
    while len(going):
        stride = np.maximum(0.5 * depth[going], step)
        place = points[going] - (way[going] + stride)[:, None] * normal[going]
        distance = compiled_distance(shapes, place)
        has_left = distance >= 0
        out = going[has_left]
        through[out] = way[out] + stride[has_left] * depth[out] / (depth[out] + distance[has_left])
        way[going] += stride
        depth[going] = -distance
        going = going[~has_left & (place >= first).all(axis=1) & (place <= last).all(axis=1)]
    hit = np.flatnonzero(np.isfinite(through))
    other = outward_normal(grid, points[hit] - through[hit][:, None] * normal[hit], step)
    inclined = np.sum(normal[hit] * other, axis=1) > -math.cos(MOST_INCLINED)
    through[hit[inclined]] = np.inf
    return float(np.sort(through)[int(QUANTILE * len(through))]) + 1e-3 * grid.spacing  # the stored distances are rounded


def thinnest(faces: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thickness [m] below which a twentieth of a surface is, and a point [dim] in m of such a part.

    The thickness at a point is the way from there through the solid, against the normal.

    Args:
        faces: corners of triangles [triangle, 3, 3], or ends of the segments of outlines [segment, 2, 2], in m. They look outwards, or all inwards.
    """
    points, inward = _sampled(faces, *_outward(faces))
    ways = np.array([_way(point, direction, faces) for point, direction in zip(points, inward, strict=True)])
    order = np.argsort(ways)
    chosen = order[int(QUANTILE * len(order))]
    return float(ways[chosen]), points[order[0]]


def _outward(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sizes of faces [face] and their unit normals [face, dim] out of the solid."""
    edge = faces[:, 1] - faces[:, 0]
    if faces.shape[1] == 2:
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        size = np.linalg.norm(normal, axis=1)
    else:
        normal = np.cross(edge, faces[:, 2] - faces[:, 0])
        size = 0.5 * np.linalg.norm(normal, axis=1)
    volume = np.sum((faces.mean(axis=1) - faces.mean(axis=(0, 1))) * normal)  # a multiple of it
    return size, np.sign(volume or 1.0) * normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]


def _sampled(faces: np.ndarray, size: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points evenly spread over the surface, and the directions into the solid there."""
    rng, count = np.random.default_rng(0), int(np.clip(MOST_PAIRS // len(faces), *NUM_POINTS))
    face = np.searchsorted(np.cumsum(size), (np.arange(count) + 0.5) / count * size.sum()).clip(max=len(faces) - 1)
    weights = rng.dirichlet(np.ones(faces.shape[1]), count)
    return np.einsum("pc,pcd->pd", weights, faces[face]), -normal[face]


def _way(point: np.ndarray, direction: np.ndarray, faces: np.ndarray) -> float:
    """Return the way [m] from a point along a direction to the next face, infinite if there is none.

    In 3D this is the intersection of Möller & Trumbore 1997, Fast, minimum storage ray/triangle intersection, J. Graphics Tools 2.
    """
    start, edge = point - faces[:, 0], faces[:, 1] - faces[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # of faces along the direction
        if faces.shape[1] == 2:
            scale = edge[:, 0] * direction[1] - edge[:, 1] * direction[0]
            place = (start[:, 0] * direction[1] - start[:, 1] * direction[0]) / scale
            way = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / scale
            within = (place >= -SLACK) & (place <= 1 + SLACK)
        else:
            other = faces[:, 2] - faces[:, 0]
            across, turned = np.cross(direction, other), np.cross(start, edge)
            scale = np.einsum("fd,fd->f", edge, across)
            u, v = np.einsum("fd,fd->f", start, across) / scale, turned @ direction / scale
            way = np.einsum("fd,fd->f", other, turned) / scale
            within = (u >= -SLACK) & (v >= -SLACK) & (u + v <= 1 + SLACK)
        ahead = within & (way > 1e-6 * np.ptp(faces, axis=(0, 1)).max())  # not the face of the point
    return float(way[ahead].min(initial=np.inf))
