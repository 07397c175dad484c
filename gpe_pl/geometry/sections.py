"""Plane sections of triangle meshes, as solids in 2D."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gpe_pl.geometry.grid_distance import enclosed, is_oriented
from gpe_pl.geometry.shapes import DistanceGrid

MOST_AT_ONCE = 2_000_000
"""Number of pairs of a grid node and a segment whose distances are computed together."""


def section(triangles: Float[np.ndarray, "triangle 3 3"], depth: float) -> Float[np.ndarray, "segment 2 2"]:
    """Return the segments in which the plane y = ``depth`` [m] cuts triangles, as ends (x, z) in m. The side that triangles look to is to their right."""
    below = triangles[:, :, 1] < depth  # a corner on the plane counts as above, so that each triangle has no or two cut edges
    found = []
    for triangle, is_below in zip(triangles, below, strict=True):
        ends = []
        for a, b in ((0, 1), (1, 2), (2, 0)):
            if is_below[a] != is_below[b]:
                fraction = (depth - triangle[a, 1]) / (triangle[b, 1] - triangle[a, 1])
                ends.append((triangle[a] + fraction * (triangle[b] - triangle[a]))[[0, 2]])
        if len(ends) == 2:
            normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
            (x, z) = ends[1] - ends[0]
            found.append(ends if z * normal[0] - x * normal[2] >= 0 else ends[::-1])
    return np.array(found, dtype=np.float64).reshape(-1, 2, 2)


def solid_within(
    segments: Float[np.ndarray, "segment 2 2"], bounds: tuple[tuple[float, float], ...], spacing: float, friction: float
) -> DistanceGrid:
    """Return the solid within closed outlines as signed distances at the nodes of a grid.

    Args:
        segments: ends of the segments of the outlines [m].
        bounds: ``(low, high)`` of the domain along x and y [m]; the grid extends one cell beyond it.
        spacing: spacing of the grid [m].
        friction: Coulomb coefficient of the surface.

    Raises:
        ValueError: the outlines enclose no node of the grid.
    """
    low = np.array([a - spacing for a, _ in bounds])
    counts = tuple(int(np.ceil((b - a) / spacing)) + 3 for a, b in bounds)
    nodes = low + spacing * np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 2)
    oriented = is_oriented(segments)
    parts = np.array_split(nodes, max(1, len(nodes) * len(segments) // MOST_AT_ONCE + 1))
    values = np.concatenate([_signed(part, segments, oriented) for part in parts])
    if not (values < 0).any():
        raise ValueError(f"no outline encloses a point of the grid of {spacing:g} m in the domain {bounds}")
    return DistanceGrid.from_values(low, spacing, values.reshape(counts), friction)


def _signed(points: np.ndarray, segments: np.ndarray, oriented: bool) -> np.ndarray:
    """Return signed distances [point] in m.

    A point is inside if outlines go around it, also if several do. If they are not ``oriented``, it is inside if a ray from it crosses an odd number of
    segments.
    """
    a, b = segments[None, :, 0], segments[None, :, 1]
    edge, way = b - a, points[:, None] - a
    along = np.clip(np.sum(way * edge, axis=-1) / np.maximum(np.sum(edge * edge, axis=-1), 1e-300), 0.0, 1.0)
    distance = np.linalg.norm(way - along[..., None] * edge, axis=-1).min(axis=1, initial=np.inf)
    x, y = points[:, None, 0], points[:, None, 1]
    spans = (a[..., 1] > y) != (b[..., 1] > y)
    rise = np.where(spans, edge[..., 1], 1.0)
    crosses = spans & (x < a[..., 0] + (y - a[..., 1]) / rise * edge[..., 0])
    turns = np.sum(crosses * np.sign(edge[..., 1]), axis=1)
    return np.where(enclosed(turns.astype(np.int64), oriented), -distance, distance)
