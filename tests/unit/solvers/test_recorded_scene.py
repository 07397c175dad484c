"""Recordings of another solver become similar scenes at another spacing, and damaged ones are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.solvers.recorded_scene import RecordedScene, RecordingError, read_recording
from gpe_pl.solvers.scenes import SceneDistribution, describe

msgpack = pytest.importorskip("msgpack")
zstandard = pytest.importorskip("zstandard")

OUTSIDE = Path(__file__).parents[3].parent / "shared" / "data" / "canyon.msgpack.zst"
SLOPE = 0.2


def packed(array: Any) -> dict[bytes, Any]:
    array = np.asarray(array)
    return {b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": list(array.shape), b"data": array.tobytes()}


def frame(**changes: Any) -> dict[str, Any]:
    """Return a slope y = −SLOPE x with 8 particles of spacing 0.1 m above it."""
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-0.5, 0.5, 41)))
    normal = np.array([SLOPE, 1.0, 0.0]) / math.hypot(SLOPE, 1)
    pos = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=-1) * 0.1 + [-0.8, 0.4, 0.0]
    values = {
        "box": np.stack([x, -SLOPE * x, z], axis=-1),
        "box_normals": np.broadcast_to(normal, (len(x), 3)),
        "pos": pos,
        "vel": np.broadcast_to([0.0, -0.5, 0.25], (8, 3)),
        "m": np.full(8, 1.0),
        "viscosity": np.full(8, 0.01),
    }
    return {name: packed(np.asarray(value, np.float32)) for name, value in {**values, **changes}.items()}


def write(path: Path, content: Any) -> str:
    path.write_bytes(zstandard.ZstdCompressor().compress(msgpack.packb(content)))
    return str(path)


@pytest.fixture
def file(tmp_path: Path) -> str:
    return write(tmp_path / "slope.msgpack.zst", [frame(), {"pos": packed(np.zeros((1, 3)))}])


def test_a_recording_is_read_with_its_vertical_axis_last(file: str) -> None:
    recording = read_recording(file)
    assert recording.spacing == pytest.approx(0.1) and recording.viscosity == pytest.approx(0.01)
    np.testing.assert_allclose(recording.walls[:, 2], -SLOPE * recording.walls[:, 0], atol=1e-6)
    np.testing.assert_allclose(recording.normals[0], np.array([SLOPE, 0.0, 1.0]) / math.hypot(SLOPE, 1), atol=1e-6)
    np.testing.assert_allclose(recording.vel, np.broadcast_to([0.0, -0.25, -0.5], (8, 3)), atol=1e-6)
    assert np.linalg.det([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) == 1  # no mirror image


@pytest.mark.parametrize("s", [0.25, 1.0, 4.0])
def test_scaling_keeps_froude_and_reynolds_numbers(file: str, s: float) -> None:
    recording = read_recording(file)
    scaled = recording.scaled(s)
    assert scaled.spacing == pytest.approx(s * recording.spacing)

    def numbers(r: Any) -> list[float]:
        length, speed = np.ptp(r.walls[:, 0]), np.linalg.norm(r.vel[0])
        return [speed**2 / (9.81 * length), speed * length / r.viscosity]

    assert numbers(scaled) == pytest.approx(numbers(recording))
    steps = 1000  # in times that scale with the square root, everything falls equally far
    fallen = [r.vel[0, 2] * t - 9.81 * t**2 / 2 for r, t in ((recording, 1e-3 * steps), (scaled, 1e-3 * steps * math.sqrt(s)))]
    assert fallen[1] == pytest.approx(s * fallen[0])


@pytest.mark.parametrize("spacing", [0.05, 0.1])
def test_walls_have_the_spacing_of_the_model_and_particles_their_place_above_them(file: str, spacing: float) -> None:
    scene = RecordedScene(file, 2 * spacing)
    assert isinstance(scene, SceneDistribution)
    state = scene.sample({}, 0)
    s = spacing / 0.1
    assert scene.scale == pytest.approx(s) and scene.max_nodes == state.num_nodes == 8
    assert cKDTree(state.pos).query(state.pos, k=2)[0][:, 1] == pytest.approx(np.full(8, spacing), rel=1e-4)
    ground = state.boundary.shapes[-1]
    on_ground = np.abs(ground.signed_distance(state.boundary.pos)) < 0.01 * spacing
    pos = state.boundary.pos[on_ground]
    np.testing.assert_allclose(pos[:, 2], s * SLOPE * (2.0 - pos[:, 0] / s), atol=0.05 * spacing)
    gap = cKDTree(pos).query(scene.recording.walls)[0]
    assert gap.max() < 1.2 * spacing
    above = s * (0.4 + SLOPE * -0.8) / math.hypot(SLOPE, 1)  # of the lowest particle
    assert signed_distance(state.boundary.shapes[-1:], state.pos).min() == pytest.approx(above, abs=0.1 * spacing)
    assert state.material_params[0, 0] == pytest.approx(0.01 * s**1.5)
    assert np.linalg.norm(state.vel[0]) == pytest.approx(math.sqrt(s) * math.hypot(0.5, 0.25))
    assert describe(scene, 0.005).spacing == pytest.approx(spacing)


def test_a_flood_fills_the_lowest_free_places_upstream(file: str) -> None:
    scene = RecordedScene(file, 0.1, num_particles=60)
    state = scene.sample({"fluid": 0.5}, 3)
    assert state.num_nodes == scene.max_nodes == 60 and not state.vel.any() and state.material_params[0, 0] == 0.5
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0.2 * scene.spacing
    assert state.pos[:, 0].max() < scene.bounds[0][1] / 3
    np.testing.assert_array_equal(scene.sample({}, 3).pos, state.pos)
    assert not np.array_equal(scene.sample({}, 4).pos, state.pos)
    with pytest.raises(ValueError, match="do not fit into the upstream third, at most"):
        RecordedScene(file, 0.1, num_particles=10**6).sample({}, 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "no frames"),
        ({"pos": 1}, "not a recording"),
        ([{"pos": packed(np.zeros((1, 3)))}], "KeyError"),
        ([frame(pos=np.zeros((8, 2)))], r"pos of the first frame is \(8, 2\)"),
        ([frame(vel=np.full((8, 3), np.nan))], "vel of the first frame"),
        ([frame(box=np.zeros((0, 3)), box_normals=np.zeros((0, 3)))], "must have walls"),
        ([frame(m=np.zeros(8))], "positive mass"),
        ([frame(box_normals=np.ones((81 * 41, 3)))], "box_normals of the first frame are not unit vectors"),
        ([{**frame(), "m": {**packed(np.zeros(8)), b"type": "|O"}}], "not an array of numbers"),
        ([{**frame(), "m": {**packed(np.zeros(8)), b"shape": [9]}}], "cannot reshape"),
    ],
)
def test_a_file_that_is_no_such_recording_is_refused(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        read_recording(write(tmp_path / "scene.msgpack.zst", content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pos": [-0.8, -0.3, 0.1]}, r"particle 2 lies 0\.\d+ m deep in the ground or outside the walls"),
        ({"pos": [-3.0, 0.9, 0.1]}, r"particle 2 lies 2 m deep in the ground or outside the walls"),
        ({"vel": [0.0, -1e30, 0.0]}, r"particle 2 moves at 1e\+30 m/s"),
    ],
)
def test_particles_that_no_liquid_has_are_named(tmp_path: Path, change: dict[str, list[float]], message: str) -> None:
    (name, value), wrong = next(iter(change.items())), {}
    stored = frame()[name]
    wrong[name] = np.frombuffer(stored[b"data"], np.float32).reshape(8, 3).copy()
    wrong[name][2] = value
    scene = RecordedScene(write(tmp_path / "wrong.msgpack.zst", [frame(**wrong)]), 0.2)
    with pytest.raises(RecordingError, match=message):
        scene.sample({}, 0)
    assert replace(scene, num_particles=4).sample({}, 0).num_nodes == 4  # a flood takes the ground alone


def test_a_damaged_or_missing_file_is_named(tmp_path: Path, file: str) -> None:
    cut = tmp_path / "cut.msgpack.zst"
    cut.write_bytes(Path(file).read_bytes()[:1000])
    for path, message in ((cut, "not a recording"), (tmp_path / "none.zst", "no such file")):
        with pytest.raises(RecordingError, match=rf"{path.name}: {message}"):
            read_recording(path)


@pytest.mark.long
@pytest.mark.skipif(not OUTSIDE.exists(), reason="needs ../shared/data/canyon.msgpack.zst")
def test_the_outside_canyon_is_a_scene() -> None:
    state = RecordedScene(str(OUTSIDE), 0.1).sample({}, 0)
    assert state.num_nodes == 1280 and len(state.boundary.pos) > 50_000
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0.05
    recording = RecordedScene(str(OUTSIDE), 0.1).recording
    distance = np.abs(state.boundary.shapes[-1].signed_distance(recording.walls))
    assert np.quantile(distance, [0.5, 0.99]) == pytest.approx([0.0, 0.0], abs=0.025)
