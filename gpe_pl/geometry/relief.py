"""How much farther than it is a solid seems to be, because it is sharp or thin there.

A grid sees a solid as a mean over its cells, so it hardly sees a sharp corner. With K a kernel of the width of a cell and s the solid, 1 inside and 0 outside,
the solid part of the neighbourhood of a point is::

    φ(x) = ∫ K(y) s(x + y) dy

A flat wall at distance d has φ₀(d). The relief of a point is the distance of the flat wall that fills as much, minus the distance of the point::

    φ₀⁻¹(φ(x)) − d(x)

Beside a right-angled corner in 2D it is up to two thirds of a rest spacing, at the corner of a box in 3D up to 1.1, and at flat walls it is zero.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from gpe_pl.geometry.compiled_distance import compiled_distance
from gpe_pl.geometry.shapes import Shape

CELL = 2.0
"""Width of a cell of the kernel in rest spacings: the material point method has two particles per cell along each axis."""
REACH = 1.5 * CELL
"""Radius of the kernel, the quadratic B-spline of the distance, in rest spacings."""
SOFT = 0.5
"""Distance from the surface over which points of the quadrature count in part, in rest spacings."""
TOLERANCE = 0.05
"""Smaller reliefs count as none, since the quadrature gives them to flat walls up to 2.6 rest spacings away; in rest spacings."""


@lru_cache(maxsize=2)
def _quadrature(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [point, dim] in rest spacings, and weights [point] of the kernel, whose sum is 1."""
    x, weight = np.polynomial.legendre.leggauss(5)
    radius = (x + 1) / 2 * REACH
    q = radius / CELL
    kernel = np.where(q < 0.5, 0.75 - q**2, 0.5 * (1.5 - q) ** 2) * weight * radius ** (dim - 1)
    rings = [_directions(dim, 16 if dim == 2 else 64, turn=k % 2 / 2) for k in range(len(radius))]
    points = np.concatenate([r * ring for r, ring in zip(radius, rings, strict=True)])
    weights = np.concatenate([np.full(len(ring), k / len(ring)) for k, ring in zip(kernel, rings, strict=True)])
    return points, weights / weights.sum()


def _directions(dim: int, count: int, turn: float = 0.0) -> np.ndarray:
    """Return unit vectors in evenly spread directions [direction, dim]; in 3D along a Fibonacci spiral."""
    number = np.arange(count)
    if dim == 2:
        angle = 2 * np.pi * (number + turn) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    height = 1 - (2 * number + 1) / count
    angle = 2 * np.pi * (number * (np.sqrt(5) - 1) / 2 + turn)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)


def _solid(distance: np.ndarray) -> np.ndarray:
    """Return how far points [rest spacings] count as solid, from 0 to 1."""
    return np.clip(0.5 - distance / (2 * SOFT), 0.0, 1.0)


@lru_cache(maxsize=2)
def _flat(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return distances from a flat wall [rest spacings], and the solid part of the neighbourhood there, a mean over directions of the wall."""
    points, weights = _quadrature(dim)
    distance = np.linspace(-REACH - SOFT, REACH + SOFT, 257)
    height = points @ _directions(dim, 64, turn=0.25).T
    return distance, np.einsum("dpw,p->d", _solid(distance[:, None, None] + height), weights) / height.shape[1]


def reliefs(
    shapes: tuple[Shape, ...], points: Float[np.ndarray, "point dim"], distance: Float[np.ndarray, "point"], spacing: float
) -> Float[np.ndarray, "point"]:
    """Return the relief of points [m], at least 0. The values of points farther than ``REACH`` from a surface, on either side, mean nothing.

    Args:
        shapes: the solids.
        points: positions [m].
        distance: signed distance of the points from the nearest solid [m].
        spacing: rest spacing [m].
    """
    dim = points.shape[1]
    offsets, weights = _quadrature(dim)
    around = (points[:, None] + spacing * offsets).reshape(-1, dim)
    part = _solid(compiled_distance(shapes, around).reshape(len(points), len(weights)) / spacing) @ weights
    at, flat = _flat(dim)
    relief = np.interp(-part, -flat, at) - distance / spacing
    return np.where(relief > TOLERANCE, relief, 0.0) * spacing
