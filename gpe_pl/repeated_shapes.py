"""Shapes in periodic domains, where each stands for all its images: an obstacle across a seam has its other part on the other side."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.geometry import Box, Polygon, Shape, Wall, surface_tolerance
from gpe_pl.periodicity import Periodicity

Array = Any


@dataclass(frozen=True)
class Repeated:
    """A shape with its images along the axes that repeat.

    Attributes:
        shape: one of them, no wider than a period along these axes, except boxes.
        periodicity: where space repeats.
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
        """Distance [...] in m to the nearest image."""
        xp, space = array_namespace(points), self.periodicity
        centre = xp.asarray(self._centre, dtype=points.dtype, device=device(points))
        near = centre + space.shortest(points - centre)
        if not isinstance(self.shape, Polygon):  # symmetric, or with an inside of which each image has its own part
            return self._whole.signed_distance(near)
        distance = self.shape.signed_distance(near)
        for images in itertools.product((-1.0, 0.0, 1.0), repeat=len(space.axes)):
            if any(images):
                shift = np.zeros(len(space.period))
                shift[list(space.axes)] = np.array(images) * space.period[list(space.axes)]
                there = near + xp.asarray(shift, dtype=points.dtype, device=device(points))
                distance = xp.minimum(distance, self.shape.signed_distance(there))
        return distance

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Boundary nodes inside the domain, each once, and their normals; faces at which an image meets the next one have none."""
        pos, normal = self.shape.sample(spacing)
        outside = self.signed_distance(pos) > -1e-3 * surface_tolerance((self.shape,))
        return self.periodicity.wrapped(pos[outside]), normal[outside]

    @cached_property
    def _centre(self) -> np.ndarray:
        values = vars(self.shape)
        if "center" in values:
            return np.array(values["center"], dtype=float)
        if "vertices" in values:
            corners = np.array(values["vertices"], dtype=float)
        elif "origin" in values:  # of a grid
            corners = np.stack([values["origin"], np.asarray(values["origin"]) + values["spacing"] * (np.asarray(values["counts"]) - 1)])
        else:
            corners = np.array([values["low"], values["high"]], dtype=float)
        return np.asarray((corners.min(axis=0) + corners.max(axis=0)) / 2)

    @cached_property
    def _whole(self) -> Shape:
        """The shape without the faces at which it meets its own images."""
        if not isinstance(self.shape, Box):
            return self.shape
        low, high, period = np.array(self.shape.low), np.array(self.shape.high), self.periodicity.period
        reach = np.where((period > 0) & (high - low >= period * (1 - 1e-9)), period, 0.0)
        return replace(self.shape, low=tuple((low - reach).tolist()), high=tuple((high + reach).tolist()))


def repeated(shapes: tuple[Shape, ...], periodicity: Periodicity) -> tuple[Shape, ...]:
    """Shapes that know their images; walls are plane, so they have no further ones along themselves. The same object where no axis repeats."""
    if not periodicity:
        return shapes
    return tuple(shape if isinstance(shape, (Wall, Repeated)) else Repeated(shape, periodicity) for shape in shapes)
