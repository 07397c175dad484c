"""Relief: sharp and thin solids seem farther, flat walls and inner corners do not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpe_pl.geometry.relief import REACH, reliefs
from gpe_pl.geometry.shapes import Box, Polygon, Sphere, domain_walls, signed_distance

SPACING = 0.02


def relief(shapes: tuple, points: np.ndarray) -> np.ndarray:
    """Return reliefs in rest spacings."""
    return reliefs(shapes, points, signed_distance(shapes, points), SPACING) / SPACING


def turned_box(angle: float) -> Polygon:
    """Return a large square whose corner is at the origin and whose sides there lie along -x and -y, turned by an angle."""
    corners = np.array([[0, 0], [-1, 0], [-1, -1], [0, -1]]) @ np.array(
        [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
    )
    return Polygon(tuple((float(x), float(y)) for x, y in corners), 0.3)


@pytest.mark.parametrize("dim", [2, 3])
def test_flat_walls_and_inner_corners_have_none(dim: int) -> None:
    walls = domain_walls(((0.0, 1.0),) * dim, 0.3)
    box = Box((0.3,) * dim, (0.7,) * dim, 0.3)
    distance = SPACING * np.linspace(0.0, 0.8 * REACH, 8)
    in_front, inner = np.full((8, dim), 0.5), np.repeat(distance[:, None], dim, axis=1)
    in_front[:, 0] = 0.7 + distance
    assert not relief((*walls, box), np.concatenate([in_front, inner])).any()


@pytest.mark.parametrize("angle", np.linspace(0.0, 1.5, 5))
def test_flat_walls_of_any_direction_have_none(angle: float) -> None:
    middle, outward = -0.5, np.array([math.cos(angle), math.sin(angle)])
    along = np.array([-outward[1], outward[0]])
    points = np.array([middle * along + SPACING * d * outward for d in np.linspace(0.0, 0.8 * REACH, 9)])
    assert not relief((turned_box(angle),), points).any()


@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 4])
def test_a_corner_has_one_that_fades_with_the_distance(angle: float) -> None:
    outward = np.array([math.cos(angle + math.pi / 4), math.sin(angle + math.pi / 4)])
    found = relief((turned_box(angle),), SPACING * np.array([0.0, 0.5, 1.0, 1.5])[:, None] * outward)
    assert (np.diff(found) < 0).all() and found == pytest.approx([0.68, 0.6, 0.52, 0.4], abs=0.05)


def test_sharper_and_thinner_solids_have_more() -> None:
    def at_tip(half_angle: float) -> float:
        wedge = Polygon(((0.0, 0.0), (-0.5, 0.5 * math.tan(half_angle)), (-0.5, -0.5 * math.tan(half_angle))), 0.3)
        return float(relief((wedge,), np.array([[0.5 * SPACING, 0.0]]))[0])

    def at_pole(radius: float) -> float:
        return float(relief((Sphere((0.0, 0.0), radius * SPACING, 0.3),), np.array([[(radius + 0.5) * SPACING, 0.0]]))[0])

    assert at_tip(0.3) > at_tip(0.6) > at_tip(1.0) > 0.1
    assert at_pole(1.0) > at_pole(2.0) > at_pole(4.0) > at_pole(100.0) == 0.0


def test_a_corner_in_three_dimensions_has_more_than_an_edge() -> None:
    box, step = Box((0.3,) * 3, (0.7,) * 3, 0.3), 0.5 * SPACING
    edge, corner = np.array([0.7 + step / 2**0.5, 0.7 + step / 2**0.5, 0.5]), np.full(3, 0.7 + step / 3**0.5)
    of_edge, of_corner = relief((box,), np.stack([edge, corner]))
    assert of_corner > of_edge + 0.2 > 0.5
