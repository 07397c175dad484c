"""How thick the walls of a closed surface are, to find parts that a grid of distances does not resolve."""

from __future__ import annotations

import numpy as np

NUM_POINTS = (40, 300)
"""Smallest and largest number of points of the surface from which the thickness is measured."""
MOST_PAIRS = 3_000_000
"""Number of pairs of a point and a face above which there are fewer points."""
SLACK = 1e-9
"""Fraction of a face by which it reaches beyond its rim, so that nothing passes between two faces."""
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
