"""Solids of several parts: where they overlap they are solid, and cavities are free, in 2D sections and in 3D."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.grid_distance import is_oriented, mesh_distances
from gpe_pl.geometry.sections import section, solid_within
from gpe_pl.geometry.thin_parts import thinnest

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
