"""Solids of several parts: where they overlap they are solid, and cavities are free, in 2D sections and in 3D."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.grid_distance import is_oriented, mesh_distances
from gpe_pl.geometry.sections import section, solid_within
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere
from gpe_pl.geometry.thin_parts import thickness, thinnest

FACES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)
SPACING, COUNTS = 0.05, (21, 21, 21)


def box(low: float, high: float, shift: float = 0.0, inverted: bool = False) -> np.ndarray:
    """Return the triangles of a cube whose faces look outwards, or inwards, moved along x."""
    corners = np.stack(np.meshgrid([low, high], [low, high], [low, high], indexing="ij"), axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    triangles = corners[FACES] + np.array([shift, 0.0, 0.0])
    return triangles[:, ::-1] if inverted else triangles


def inside_3d(triangles: np.ndarray) -> np.ndarray:
    return mesh_distances(triangles, np.zeros(3), SPACING, COUNTS, "inside")[:, 10, 10] < 0


def inside_2d(triangles: np.ndarray) -> np.ndarray:
    solid = solid_within(section(triangles, 0.5), ((0.0, 1.0), (0.0, 1.0)), SPACING, 0.0)
    return solid.signed_distance(np.stack([SPACING * np.arange(21), np.full(21, 0.5)], axis=1)) < 0


@pytest.mark.parametrize("inside", [inside_2d, inside_3d])
@pytest.mark.parametrize("inverted", [False, True])
def test_overlapping_parts_are_solid_and_a_cavity_is_free(inside, inverted: bool) -> None:
    place = SPACING * np.arange(21)
    one, other = box(0.22, 0.58, inverted=inverted), box(0.22, 0.58, 0.2, inverted)
    np.testing.assert_array_equal(inside(np.concatenate([one, other])), (place > 0.22) & (place < 0.78))
    shell = np.concatenate([box(0.12, 0.88, inverted=inverted), box(0.32, 0.68, inverted=not inverted)])
    expected = ((place > 0.12) & (place < 0.32)) | ((place > 0.68) & (place < 0.88))
    np.testing.assert_array_equal(inside(shell), expected)


@pytest.mark.parametrize("inside", [inside_2d, inside_3d])
def test_faces_that_look_to_different_sides_still_enclose(inside) -> None:
    mixed = box(0.22, 0.58)
    mixed[::2] = mixed[::2, ::-1]
    assert not is_oriented(mixed) and is_oriented(box(0.22, 0.58))
    place = SPACING * np.arange(21)
    np.testing.assert_array_equal(inside(mixed), (place > 0.22) & (place < 0.58))


def test_an_open_mesh_is_not_oriented() -> None:
    assert not is_oriented(box(0.2, 0.6)[1:])
    assert is_oriented(section(box(0.2, 0.6), 0.5)) and not is_oriented(section(box(0.2, 0.6), 0.5)[1:])


def outline(corners: list[tuple[float, float]]) -> np.ndarray:
    """Return the segments of a polygon whose corners run clockwise, so that free space is to their left."""
    points = np.array(corners)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


@pytest.mark.parametrize("turned", [False, True])
def test_the_thickness_is_that_of_the_thinnest_part(turned: bool) -> None:
    foot = [(0.4, 0.0), (0.6, 0.0), (0.6, 0.03), (0.503, 0.03), (0.503, 0.4), (0.497, 0.4), (0.497, 0.03), (0.4, 0.03)]
    found, place = thinnest(outline(foot[::-1] if turned else foot))
    assert found == pytest.approx(0.006, rel=1e-6) and 0.497 <= place[0] <= 0.503
    square = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.2), (0.0, 0.2)]
    assert thinnest(outline(square))[0] == pytest.approx(0.2)
    cube, plate = box(0.2, 0.6), box(0.2, 0.6) * np.array([1.0, 1.0, 0.02])
    faces = cube[:, ::-1] if turned else cube
    assert thinnest(faces)[0] == pytest.approx(0.4) and thinnest(plate)[0] == pytest.approx(0.008)


STEP = 0.01


def gridded(shape: Shape, shift: float) -> DistanceGrid:
    """Return a 2D solid as distances at the nodes of a grid around the unit square, moved by part of a cell."""
    axis = (shift - 5) * STEP + STEP * np.arange(112)
    return DistanceGrid.from_values(
        axis[[0, 0]], STEP, shape.signed_distance(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)), 0.3
    )


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5, 0.77])
def test_the_thickness_of_a_grid_of_distances_is_that_of_its_solid(shift: float) -> None:
    slab = Polygon(((0.2, 0.2), (0.23, 0.16), (0.83, 0.61), (0.8, 0.65)), 0.3)
    table = Polygon(((0.1, 0.0), (0.3, 0.0), (0.3, 0.46), (0.9, 0.46), (0.9, 0.5), (0.1, 0.5)), 0.3)
    for shape, true in ((Box((0.1, 0.3), (0.9, 0.325), 0.3), 0.025), (slab, 0.05), (table, 0.04), (Sphere((0.5, 0.5), 0.06, 0.3), 0.12)):
        assert thickness(gridded(shape, shift)) == pytest.approx(true, abs=0.1 * STEP)
    assert thickness(gridded(Box((0.1, 0.2), (0.9, 0.7), 0.3), shift)) == pytest.approx(0.5, abs=0.1 * STEP)


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5, 0.77])
def test_tips_of_wedges_and_solids_that_fill_the_grid_are_not_thin(shift: float) -> None:
    ramp, spike = Polygon(((0.1, 0.2), (0.9, 0.2), (0.9, 0.4)), 0.3), Polygon(((0.4, 0.2), (0.6, 0.2), (0.5, 0.6)), 0.3)
    ground = Polygon(((-1.0, -1.0), (2.0, -1.0), (2.0, 0.1), (0.6, 0.4), (0.5, 0.15), (-1.0, 0.3)), 0.3)
    for shape in (ramp, spike, ground, Bowl((0.5, 0.5), 0.45, 0.3)):
        assert thickness(gridded(shape, shift)) > 0.15


def test_the_neck_of_a_polygon_counts() -> None:
    hourglass = Polygon(((0.1, 0.2), (0.9, 0.2), (0.505, 0.3), (0.9, 0.4), (0.1, 0.4), (0.495, 0.3)), 0.3)
    notch = Polygon(((0.1, 0.2), (0.65, 0.2), (0.7, 0.37), (0.75, 0.2), (0.9, 0.2), (0.9, 0.4), (0.1, 0.4)), 0.3)
    assert thickness(hourglass) == pytest.approx(0.01) and thickness(notch) == pytest.approx(0.03)
    angle, count = np.linspace(0, 2 * np.pi, 60, endpoint=False), 3
    clover = 0.5 + 0.3 * (1 + 0.3 * np.cos(count * angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert thickness(Polygon(tuple(map(tuple, clover.tolist())), 0.3)) > 0.3
