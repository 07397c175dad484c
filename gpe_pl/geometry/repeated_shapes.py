"""Shapes in periodic domains. A shape represents all its periodic images, so an obstacle that crosses a seam continues on the other side."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import Box, DistanceGrid, Polygon, Shape, Wall, signed_distance, surface_tolerance

Array = Any

ON_SEAM = 1e-9
"""Tolerance for the ends of shapes on a seam, as a fraction of the period."""


@dataclass(frozen=True)
class Repeated:
    """A shape together with its images along the periodic axes.

    Attributes:
        shape: one of the images. Along periodic axes only boxes may be wider than a period. A shape as wide as a period joins its images without a gap.
        periodicity: periodicity of the domain.
    """

    shape: Shape
    periodicity: Periodicity
    kind: ClassVar[str] = "repeated"

    @property
    def friction(self) -> float:
        return self.shape.friction

    @property
    def restitution(self) -> float:
        return self.shape.restitution

    @property
    def extent(self) -> float:
        return self.shape.extent

    def signed_distance(self, points: Array) -> Array:
        """Return the signed distance [...] in m to the nearest image."""
        xp, space = array_namespace(points), self.periodicity
        centre = xp.asarray(self._centre, dtype=points.dtype, device=device(points))
        near = centre + space.shortest(points - centre)
        # The image with the nearest centre counts if the shape is symmetric, or if each image has its own part of the inside.
        if not isinstance(self.shape, (Polygon, DistanceGrid)):
            return self._whole.signed_distance(near)
        distance = self._to_image(near)
        axes = [axis for axis in space.axes if axis != self._spanned]
        for images in itertools.product((-1.0, 0.0, 1.0), repeat=len(axes)):
            if any(images):
                shift = np.zeros(len(space.period))
                shift[axes] = np.array(images) * space.period[axes]
                there = near + xp.asarray(shift, dtype=points.dtype, device=device(points))
                distance = xp.minimum(distance, self._to_image(there))
        return distance

    def _to_image(self, points: Array) -> Array:
        """Return the signed distance [...] in m of points [..., dim] to the image at the place of the shape.

        Past the nodes of a ``DistanceGrid`` along periodic axes, the linear continuation could make solids where none are. There the distance is that of the
        surface point which belongs to the nearest point with nodes. If that point is solid, its depth remains, less the way from it.
        """
        shape = self._whole
        if not isinstance(shape, DistanceGrid):
            return shape.signed_distance(points)
        xp, repeats = array_namespace(points), np.array(self.periodicity.periodic)
        origin, size = np.array(shape.origin), shape.spacing * (np.array(shape.counts) - 1)
        first, last = np.where(repeats, origin, -np.inf), np.where(repeats, origin + size, np.inf)
        low, high = (xp.asarray(end, dtype=points.dtype, device=device(points)) for end in (first, last))
        nearest = xp.minimum(xp.maximum(points, low), high)
        distance, gradient = shape.interpolated(nearest)
        slope, beyond = _length(gradient)[..., None], points - nearest
        outward = gradient / xp.where(
            slope > 0.5, slope, xp.ones_like(slope)
        )  # where the slope is small, no direction leads to the surface
        way, to_surface = (_length(vector) for vector in (beyond, beyond + distance[..., None] * outward))
        return xp.where(way > 0, xp.where(distance > 0, to_surface, distance + way), distance)

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Return boundary nodes inside the domain and their normals, each node once. Faces where two images join have no nodes."""
        pos, normal = self.shape.sample(spacing)
        free = ~is_covered(pos, normal, (self.shape,), (self,))
        return self.periodicity.wrapped(pos[free]), normal[free]

    @cached_property
    def _centre(self) -> np.ndarray:
        values = vars(self.shape)
        if "center" in values:
            return np.array(values["center"], dtype=float)
        if "vertices" in values:
            corners = np.array(values["vertices"], dtype=float)
        elif "origin" in values:  # a DistanceGrid
            corners = np.stack([values["origin"], np.asarray(values["origin"]) + values["spacing"] * (np.asarray(values["counts"]) - 1)])
        else:
            corners = np.array([values["low"], values["high"]], dtype=float)
        return np.asarray((corners.min(axis=0) + corners.max(axis=0)) / 2)

    @cached_property
    def _whole(self) -> Shape:
        """The shape, extended so that it has no faces where it joins its own images."""
        if isinstance(self.shape, Polygon) and self._spanned is not None:
            return self._chained(self.shape, self._spanned)
        if not isinstance(self.shape, Box):
            return self.shape
        low, high, period = np.array(self.shape.low), np.array(self.shape.high), self.periodicity.period
        reach = np.where((period > 0) & (high - low >= period * (1 - ON_SEAM)), period, 0.0)
        return replace(self.shape, low=tuple((low - reach).tolist()), high=tuple((high + reach).tolist()))

    @cached_property
    def _spanned(self) -> int | None:
        """The axis along which a polygon spans a whole period with one edge on each seam, or None."""
        if isinstance(self.shape, Polygon):
            corners = np.array(self.shape.vertices, dtype=float)
            for axis in self.periodicity.axes:
                is_as_wide = abs(np.ptp(corners[:, axis]) / self.periodicity.period[axis] - 1) <= ON_SEAM
                if is_as_wide and all(at.sum() == 2 and (at & np.roll(at, 1)).any() for at in self._on_seams(corners, axis)):
                    return axis
        return None

    def _on_seams(self, corners: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Return masks [corner] of the corners at the lower end of a shape and at its upper end."""
        x, close = corners[:, axis], ON_SEAM * self.periodicity.period[axis]
        return x <= x.min() + close, x >= x.max() - close

    def _chained(self, polygon: Polygon, axis: int) -> Polygon:
        """Join a polygon that spans an axis with its images on both sides."""
        corners = np.array(polygon.vertices, dtype=float)
        low, _ = self._on_seams(corners, axis)
        corners = np.roll(corners, -int(np.flatnonzero(low & ~np.roll(low, -1))[0]), axis=0)  # begins where the edge on the lower seam ends
        _, high = self._on_seams(corners, axis)
        there, back = np.split(corners, [1 + int(high.argmax())])
        shifts = [k * self.periodicity.period[axis] * np.eye(2)[axis] for k in (-1, 0, 1)]
        chain = np.concatenate([*(there + shift for shift in shifts), *(back + shift for shift in reversed(shifts))])
        is_new = (np.abs(chain - np.roll(chain, 1, axis=0)) > ON_SEAM * self.periodicity.period[axis]).any(axis=1)
        return replace(polygon, vertices=tuple(map(tuple, chain[is_new].tolist())))


def _length(vectors: Array) -> Array:
    """Return lengths [...] of vectors [..., dim], without an infinite derivative at length 0."""
    xp = array_namespace(vectors)
    squared = xp.sum(vectors * vectors, axis=-1)
    return xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, xp.ones_like(squared))), xp.zeros_like(squared))


def is_covered(pos: np.ndarray, normal: np.ndarray, shapes: tuple[Shape, ...], images: tuple[Shape, ...]) -> np.ndarray:
    """Return a mask of boundary nodes of ``shapes`` that are covered by one of ``images``, so that there is no free space in front of them.

    Args:
        pos: positions of the boundary nodes [node, dim] in m.
        normal: unit normals into free space [node, dim].
        shapes: shapes that the nodes belong to.
        images: the same shapes with their images.

    Returns:
        Mask [node].
    """
    ahead = surface_tolerance(shapes)
    points = pos.astype(np.float64) + ahead * normal
    here, there = signed_distance(shapes, points), signed_distance(images, points)
    return np.asarray((there < 0.5 * ahead) & (there < here - 0.5 * ahead))


def repeated(shapes: tuple[Shape, ...], periodicity: Periodicity) -> tuple[Shape, ...]:
    """Wrap shapes so that they include their images. Walls stay, because their planes already extend along periodic axes.

    The same object is returned if no axis is periodic.
    """
    if not periodicity:
        return shapes
    return tuple(shape if isinstance(shape, (Wall, Repeated)) else Repeated(shape, periodicity) for shape in shapes)
