"""Solids of several parts: where they overlap they are solid, and cavities are free, in 2D sections and in 3D."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.grid_distance import is_oriented, mesh_distances
from gpe_pl.geometry.sections import section, solid_within

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
