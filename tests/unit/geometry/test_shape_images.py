"""Images of walls and obstacles have the distances of the originals at images of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Sphere, domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Isometry, Reflection, Rotation, level_axes

BOUNDS = ((-0.2, 1.0), (0.1, 0.9))
SHAPES: list[Any] = [
    *domain_walls(BOUNDS, 0.3),
    Sphere((0.3, 0.4), 0.1, 0.2, 0.5),
    Bowl((0.3, 0.4), 0.3, 0.2),
    Box((0.1, 0.2), (0.3, 0.5), 0.4),
    Polygon(((0.1, 0.1), (0.5, 0.2), (0.2, 0.4)), 0.6),
]


@pytest.mark.parametrize(
    "isometry",
    [
        *(Reflection(planes) for planes in ((0.35, None), (None, 0.6), (0.1, 0.2))),
        *(Rotation.between_axes(k, (0.2, 0.5)) for k in range(4)),
    ],
)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_images_are_as_far_from_images_of_points(shape: Any, isometry: Isometry) -> None:
    (image,), points = isometry.shapes([shape]), np.random.default_rng(0).uniform(-0.5, 1.5, (200, 2))
    assert (image.friction, image.restitution) == (shape.friction, shape.restitution)
    np.testing.assert_allclose(image.signed_distance(isometry.point(points)), shape.signed_distance(points), atol=1e-12)
    surface, normal = image.sample(0.05)
    if shape.kind not in ("sphere", "bowl"):  # whose points begin on one axis
        expected = isometry.point(shape.sample(0.05)[0])
        np.testing.assert_allclose([surface.min(axis=0), surface.max(axis=0)], [expected.min(axis=0), expected.max(axis=0)], atol=1e-12)
    assert (image.signed_distance(surface + 1e-3 * normal) > 0).all()


@pytest.mark.parametrize("number", range(24))
def test_images_of_three_dimensional_shapes_under_quarter_turns(number: int) -> None:
    turn, points = Rotation.between_axes(number, (0.2, 0.5, 0.1)), np.random.default_rng(0).uniform(-0.5, 1.5, (200, 3))
    bounds = ((-0.2, 1.0), (0.1, 0.9), (0.0, 0.5))
    shapes: list[Any] = [*domain_walls(bounds, 0.3), Box((0.1, 0.2, 0.0), (0.3, 0.5, 0.2), 0.4), Sphere((0.3, 0.4, 0.1), 0.1, 0.2)]
    for shape in shapes:
        (image,) = turn.shapes([shape])
        np.testing.assert_allclose(image.signed_distance(turn.point(points)), shape.signed_distance(points), atol=1e-12)


def test_an_oblique_turn_leaves_no_shapes() -> None:
    assert Rotation.about(2, 0.3, (0.0, 0.0, 0.0)).shapes([Sphere((0.3, 0.4, 0.1), 0.1, 0.2)]) == ()


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
