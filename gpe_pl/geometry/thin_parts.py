"""How thick the walls of a closed surface are, to find parts that a grid of distances does not resolve."""

from __future__ import annotations

import numpy as np

NUM_POINTS = 300
"""Number of points of the surface from which the thickness is measured."""
QUANTILE = 0.05
"""Part of the surface that may be thinner, as the tips of wedges are."""


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
    rng = np.random.default_rng(0)
    face = np.searchsorted(np.cumsum(size), (np.arange(NUM_POINTS) + 0.5) / NUM_POINTS * size.sum()).clip(max=len(faces) - 1)
    weights = rng.dirichlet(np.ones(faces.shape[1]), NUM_POINTS)
    return np.einsum("pc,pcd->pd", weights, faces[face]), -normal[face]


def _way(point: np.ndarray, direction: np.ndarray, faces: np.ndarray) -> float:
    """Return the way [m] from a point along a direction to the next face, infinite if there is none."""
    a, edges = faces[:, 0] - point, faces[:, 1:] - faces[:, :1]
    system = np.concatenate([np.broadcast_to(direction, (len(faces), 1, len(direction))), -edges], axis=1).transpose(0, 2, 1)
    crosses = np.abs(np.linalg.det(system)) > 1e-12 * np.prod(np.linalg.norm(edges, axis=2), axis=1)
    solution = np.linalg.solve(system[crosses], a[crosses][..., None])[..., 0]
    way, place = solution[:, 0], solution[:, 1:]
    within = (place >= -1e-9).all(axis=1) & (place.sum(axis=1) <= 1 + 1e-9) & (way > 1e-6 * np.ptp(faces, axis=(0, 1)).max())
    return float(way[within].min(initial=np.inf))
