"""Mirror images of walls and obstacles have the distances of the originals at mirrored points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpe_pl.geometry.reflected_shapes import reflected
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Sphere, domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Reflection, level_axes

BOUNDS = ((-0.2, 1.0), (0.1, 0.9))
SHAPES: list[Any] = [
    *domain_walls(BOUNDS, 0.3),
    Sphere((0.3, 0.4), 0.1, 0.2, 0.5),
    Bowl((0.3, 0.4), 0.3, 0.2),
    Box((0.1, 0.2), (0.3, 0.5), 0.4),
    Polygon(((0.1, 0.1), (0.5, 0.2), (0.2, 0.4)), 0.6),
]


@pytest.mark.parametrize("planes", [(0.35, None), (None, 0.6), (0.1, 0.2)])
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_images_are_as_far_from_images_of_points(shape: Any, planes: tuple[float | None, ...]) -> None:
    image, points = reflected(shape, planes), np.random.default_rng(0).uniform(-0.5, 1.5, (200, 2))
    assert image is not None and (image.friction, image.restitution) == (shape.friction, shape.restitution)
    np.testing.assert_allclose(image.signed_distance(Reflection(planes).point(points)), shape.signed_distance(points), atol=1e-12)
    again = reflected(image, planes)
    assert again is not None
    np.testing.assert_allclose(again.signed_distance(points), shape.signed_distance(points), atol=1e-12)


def test_a_boundary_keeps_its_shapes_if_all_have_images() -> None:
    mirror = Reflection((0.4, None))
    image = mirror.boundary(Boundary.sample(tuple(SHAPES), 0.05, 2))
    assert len(image.shapes) == len(SHAPES)
    grid = DistanceGrid.from_values(np.zeros(2), 0.1, np.linspace(-1, 1, 36).reshape(6, 6), 0.3)
    assert mirror.boundary(Boundary.sample((*SHAPES, grid), 0.05, 2)).shapes == ()


def test_rounding_makes_no_gravity() -> None:
    normal = np.array([[0.0, 1.0]])
    assert level_axes((9.81 * np.cos(-np.pi / 2), 9.81 * np.sin(-np.pi / 2)), normal) == [0]
    assert level_axes((0.01, -9.81), normal) == []
