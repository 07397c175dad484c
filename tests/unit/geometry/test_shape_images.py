"""Images of walls and obstacles have the distances of the originals at images of points."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import Repeated
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Isometry, Reflection, Rotation, level_axes

BOUNDS = ((-0.2, 1.0), (0.1, 0.9))


def grid_of(shape: Shape, low: tuple[float, ...], counts: tuple[int, ...], spacing: float = 0.05) -> DistanceGrid:
    """Return a shape as a grid of distances."""
    nodes = np.stack(np.meshgrid(*(x + spacing * np.arange(n) for x, n in zip(low, counts, strict=True)), indexing="ij"), axis=-1)
    return DistanceGrid.from_values(low, spacing, shape.signed_distance(nodes), shape.friction, shape.restitution)


class Unmirrored:
    """A half-space with a face along the first axis."""

    kind, friction, restitution, extent = "unmirrored", 0.3, 0.0, 1.0

    def signed_distance(self, points: Any) -> Any:
        return points[..., 1]

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0.0, 0.0]]), np.array([[0.0, 1.0]])


SHAPES: list[Any] = [
    *domain_walls(BOUNDS, 0.3),
    Sphere((0.3, 0.4), 0.1, 0.2, 0.5),
    Bowl((0.3, 0.4), 0.3, 0.2),
    Box((0.1, 0.2), (0.3, 0.5), 0.4),
    Polygon(((0.1, 0.1), (0.5, 0.2), (0.2, 0.4)), 0.6),
    grid_of(Sphere((0.3, 0.4), 0.1, 0.2, 0.5), (0.1, 0.15), (9, 11)),
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
    if shape.kind not in ("sphere", "bowl", "distance_grid"):  # whose points begin on one axis or at one corner
        expected = isometry.point(shape.sample(0.05)[0])
        np.testing.assert_allclose([surface.min(axis=0), surface.max(axis=0)], [expected.min(axis=0), expected.max(axis=0)], atol=1e-12)
    assert (image.signed_distance(surface + 1e-3 * normal) > 0).all()


@pytest.mark.parametrize("number", range(24))
def test_images_of_three_dimensional_shapes_under_quarter_turns(number: int) -> None:
    turn, points = Rotation.between_axes(number, (0.2, 0.5, 0.1)), np.random.default_rng(0).uniform(-0.5, 1.5, (200, 3))
    bounds = ((-0.2, 1.0), (0.1, 0.9), (0.0, 0.5))
    ball = Sphere((0.3, 0.4, 0.1), 0.1, 0.2)
    shapes: list[Any] = [
        *domain_walls(bounds, 0.3),
        Box((0.1, 0.2, 0.0), (0.3, 0.5, 0.2), 0.4),
        ball,
        grid_of(ball, (0.1, 0.2, 0.0), (9, 8, 5)),
    ]
    for shape in shapes:
        (image,) = turn.shapes([shape])
        np.testing.assert_allclose(image.signed_distance(turn.point(points)), shape.signed_distance(points), atol=1e-12)


def test_an_oblique_turn_leaves_no_shapes() -> None:
    assert Rotation.about(2, 0.3, (0.0, 0.0, 0.0)).shapes([Sphere((0.3, 0.4, 0.1), 0.1, 0.2)]) == ()


def test_a_boundary_keeps_its_shapes_if_all_have_images() -> None:
    mirror, other = Reflection((0.4, None)), cast(Any, Unmirrored())
    image = mirror.boundary(Boundary.sample(tuple(SHAPES), 0.05, 2))
    assert len(image.shapes) == len(SHAPES)
    assert mirror.boundary(Boundary.sample((*SHAPES, other), 0.05, 2)).shapes == ()


def test_two_mirror_images_of_a_grid_are_the_grid() -> None:
    grid, mirror = cast(Any, SHAPES[-1]), Reflection((0.5, 0.25))
    (image,) = mirror.shapes([grid])
    again = cast(Any, mirror.shapes([image])[0])
    assert again.values.tolist() == grid.values.tolist()


@pytest.mark.parametrize("shape", [s for s in SHAPES if s.kind != "wall"], ids=lambda shape: shape.kind)
@pytest.mark.parametrize("periodic", [(True, False), (True, True)])
def test_repeated_shapes_repeat_their_image(shape: Any, periodic: tuple[bool, bool]) -> None:
    space = Periodicity(BOUNDS, periodic)
    for mirror in (Reflection.of(BOUNDS, [0]), Reflection.of(BOUNDS, [0, 1])):
        image, points = cast(Any, mirror.shapes([Repeated(shape, space)])[0]), np.random.default_rng(0).uniform(-0.2, 0.9, (200, 2))
        expected = Repeated(shape, space).signed_distance(points)
        np.testing.assert_allclose(image.signed_distance(mirror.point(points)), expected, atol=1e-12)
        assert image.periodicity is space
    turn = next(turn for k in range(4) if (turn := Rotation.between_axes(k, (0.2, 0.5))).matrix[0, 1] == 1)
    image = cast(Any, turn.shapes([Repeated(shape, space)])[0])
    assert image.periodicity.periodic == periodic[::-1]
    np.testing.assert_allclose(image.signed_distance(turn.point(points)), expected, atol=1e-12)


def test_rounding_makes_no_gravity() -> None:
    normal = np.array([[0.0, 1.0]])
    assert level_axes((9.81 * np.cos(-np.pi / 2), 9.81 * np.sin(-np.pi / 2)), normal) == [0]
    assert level_axes((0.01, -9.81), normal) == []
