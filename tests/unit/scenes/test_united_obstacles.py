"""Obstacles that touch or overlap are one obstacle, so that nothing catches on the face between them; others are named."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, Polygon, Sphere
from gpe_pl.scenes.scene import Scene
from gpe_pl.scenes.united_obstacles import united

POINTS = np.random.default_rng(0).uniform(-0.2, 1.2, (400, 2))


def distances(shapes: Any) -> np.ndarray:
    return np.asarray(np.min([shape.signed_distance(POINTS) for shape in shapes], axis=0))


def test_tiles_of_a_floor_are_one_box(caplog: pytest.LogCaptureFixture) -> None:
    tiles = {f"tile {k}": Box((low, 0.0), (high, 0.3), 0.2, 0.1) for k, (low, high) in enumerate(pairwise(np.linspace(0, 1, 6).tolist()))}
    (floor,) = united(tiles, 0.05)
    assert isinstance(floor, Polygon) and len(floor.vertices) == 4 and (floor.friction, floor.restitution) == (0.2, 0.1)
    np.testing.assert_allclose(distances([floor]), Box((0.0, 0.0), (1.0, 0.3), 0.2).signed_distance(POINTS), atol=1e-12)
    assert not caplog.records


def test_a_ramp_with_a_plateau_and_a_block_apart() -> None:
    ramp, plateau = Polygon(((0.0, 0.0), (0.5, 0.0), (0.5, 0.2)), 0.4), Box((0.45, 0.0), (0.8, 0.2), 0.4)
    apart = Box((0.9, 0.0), (1.0, 0.1), 0.4)
    shapes = united({"ramp": ramp, "apart": apart, "plateau": plateau}, 0.02)
    assert len(shapes) == 2 and apart in shapes
    outside = distances([ramp, plateau, apart]) > 0
    np.testing.assert_array_equal(distances(shapes) > 0, outside)
    np.testing.assert_allclose(distances(shapes)[outside], distances([ramp, plateau, apart])[outside], atol=1e-5)


@pytest.mark.parametrize(
    "other",
    [
        Box((0.5, 0.0), (1.0, 0.3), 0.9),
        Sphere((0.5, 0.2), 0.15, 0.2),
        Sphere((0.25, 0.15), 0.05, 0.2),
        Box((0.48, 0.28), (0.8, 0.6), 0.2),
        Box((0.47, 0.3), (0.8, 0.6), 0.2),
    ],
    ids=["another friction", "disc", "disc inside", "neck", "narrow face"],
)
def test_others_that_touch_are_named(other: Any, caplog: pytest.LogCaptureFixture) -> None:
    shapes = {"obstacle 1": Box((0.0, 0.0), (0.5, 0.3), 0.2), "obstacle 2": other, "obstacle 3": Sphere((0.9, 0.9), 0.05, 0.2)}
    assert united(shapes, 0.02) == tuple(shapes.values())
    (record,) = caplog.records
    assert record.getMessage().startswith(
        "obstacle 1 and obstacle 2 touch or overlap: what slides across the face between them can catch on it"
    )


def test_a_ring_of_boxes_is_open_on_one_side(caplog: pytest.LogCaptureFixture) -> None:
    """A polygon has no hole, so three sides become one, and the last one stays."""
    sides = [((0.0, 0.0), (1.0, 0.1)), ((0.0, 0.9), (1.0, 1.0)), ((0.0, 0.1), (0.1, 0.9)), ((0.9, 0.1), (1.0, 0.9))]
    shapes = {str(k): Box(*corners, 0.2) for k, corners in enumerate(sides)}
    found = united(shapes, 0.02)
    assert len(found) == 2 and len(caplog.records) == 2
    np.testing.assert_array_equal(distances(found) > 0, distances(shapes.values()) > 0)


@pytest.mark.parametrize("other", [Box((0.5, 0.3), (0.8, 0.6), 0.2), Sphere((0.25, 0.35), 0.05, 0.2)], ids=["corner", "tangent disc"])
def test_shapes_that_meet_in_a_point_have_no_face_between_them(other: Any, caplog: pytest.LogCaptureFixture) -> None:
    shapes = {"obstacle 1": Box((0.0, 0.0), (0.5, 0.3), 0.2), "obstacle 2": other}
    assert united(shapes, 0.02) == tuple(shapes.values())
    assert not caplog.records


def test_sizes_do_not_matter_for_corners() -> None:
    """Corners of small shapes stay where they are beside a floor that is far larger, and a slit of rounding is closed."""
    floor = Box((-1e4, -1.0), (1e4, 0.0), 0.2)
    left, right = Box((0.30003, 0.0), (0.40007, 0.20003), 0.2), Box((0.40007 + 1e-9, 0.0), (0.5, 0.20003), 0.2)
    (found,) = united({"left": left, "floor": floor, "right": right}, 1.0)
    assert isinstance(found, Polygon)
    assert {(0.30003, 0.20003), (0.5, 0.20003), (1e4, 0.0)} <= {*found.vertices} and len(found.vertices) == 8


def test_many_small_tiles_in_any_order() -> None:
    lows = np.random.default_rng(0).permutation(60) / 60
    tiles = {f"{low}": Box((float(low), 0.0), (float(low) + 1 / 60, 0.1), 0.2) for low in lows}
    (floor,) = united(tiles, 0.01)
    assert isinstance(floor, Polygon) and len(floor.vertices) == 4


@pytest.mark.slow
def test_a_stair_of_thick_boxes_is_solved() -> None:
    scene = Scene(box=(1.0, 1.0)).block("sand", (0.05, 0.6), (0.15, 0.15)).obstacle(Box((0.0, 0.0), (0.3, 0.2), 0.3))
    for corner in ((0.29, 0.19), (0.295, 0.2), (0.2, 0.2)):
        assert scene.obstacle(Box(corner, (0.6, 0.4), 0.3)).solve(0.02).first.termination is None


def test_three_dimensional_boxes_stay(caplog: pytest.LogCaptureFixture) -> None:
    shapes = {"one": Box((0.0, 0.0, 0.0), (0.5, 1.0, 0.3), 0.2), "two": Box((0.5, 0.0, 0.0), (1.0, 1.0, 0.3), 0.2)}
    assert united(shapes, 0.1) == tuple(shapes.values())
    assert "one and two touch" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize(("material", "like"), [("elastomer", "elastomer"), ("sand", "sand"), ("solid", "fem")])
def test_bodies_slide_over_a_seam_as_over_one_box(material: str, like: str) -> None:
    floors = [[Box((0.0, 0.0), (2.0, 0.2), 0.0)], [Box((0.0, 0.0), (0.5, 0.2), 0.0), Box((0.5, 0.0), (2.0, 0.2), 0.0)]]
    ends = []
    for floor in floors:
        scene = Scene(box=(2.0, 1.0), friction=0.0).block(material, at=(0.2, 0.2), size=(0.15, 0.08), velocity=(2.0, 0.0))
        for box in floor:
            scene = scene.obstacle(box)
        ends.append(float(scene.solve(0.3, like=like).first.pos[-1, :, 0].mean()))
    assert ends[1] == pytest.approx(ends[0], abs=1e-3)
