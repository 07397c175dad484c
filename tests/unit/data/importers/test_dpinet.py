"""Rigid cubes, grippers and shaken boxes of DPI-Net and its successor are read as rigid bodies and moving walls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure
from gpe_pl.trajectory.boundary import BoundaryMotion
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.sources import motion, rigid
from tests.unit.data.importers.test_formats import imported

FRAME_DT = 1 / 60


def motion_of(trajectory: Trajectory) -> BoundaryMotion:
    assert trajectory.boundary.motion is not None
    return trajectory.boundary.motion


@pytest.mark.slow
def test_rigid_cubes(tmp_path: Path) -> None:
    for k in range(3):
        pos = motion(num_nodes=128, dim=3, seed=k)
        pos = rigid(pos, slice(0, 64), slice(64, 128))
        with_ground = np.concatenate([pos, np.zeros((len(pos), 1, 3), np.float32)], axis=1)
        scene = np.array([2.0, -7.5 - k, *np.zeros(6), 1.0])
        quats = np.zeros((1, 4), np.float32)
        sources.dpinet(tmp_path / "data_RigidFall" / str(k), with_ground, None, shape_quats=quats, scene_params=scene)
    report, stored = imported(tmp_path, tmp_path / "data_RigidFall", "dpinet")
    (trajectory,) = stored["train"]
    np.testing.assert_array_equal(trajectory.rigid_body, np.repeat([0, 1], 64))
    assert trajectory.metadata.materials == ("solid",)
    assert trajectory.metadata.gravity == (0.0, -7.5, 0.0)
    assert [s.normal for s in trajectory.boundary.shapes] == [(0.0, 1.0, 0.0)]  # type: ignore[attr-defined]
    assert not any("gravity is not in the source" in note for note in report.notes)


def turned(angle: float) -> np.ndarray:
    """Return the quaternion of a turn about the y axis, the scalar part last."""
    return np.array([0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)], np.float32)


@pytest.mark.slow
def test_grippers_are_moving_walls(tmp_path: Path) -> None:
    for k in range(3):
        pos = motion(num_nodes=60, dim=3, seed=k)
        centres = np.zeros((len(pos), 2, 3), np.float32)
        centres[:, 0], centres[:, 1] = [-0.9, 0.6, 0.0], [0.9, 0.6, 0.0]
        centres[:, 0, 0] += 0.3 * np.sin(np.arange(len(pos)) / 3)
        world = np.concatenate([pos, centres], axis=1)
        both = np.concatenate([0 * world, world], axis=2)
        extra = {"shape_quats": np.stack([turned(0.5), turned(0.0)]), "scene_params": np.array([9.0, 9.0, 9.0, 0.4, 0.3, 0.2])}
        folder = tmp_path / "data_RiceGrip" / "train" / str(k)
        sources.dpinet(folder, both, np.gradient(both, FRAME_DT, axis=0), clusters=np.zeros((1, 1, 1, 60)), **extra)
    report, stored = imported(tmp_path, tmp_path / "data_RiceGrip", "dpinet", spacing=0.1)
    (trajectory,) = stored["train"]
    np.testing.assert_allclose(trajectory.pos, motion(num_nodes=60, dim=3, seed=0))
    assert trajectory.metadata.param_names == ("hardening_coefficient", "critical_compression", "critical_stretch")
    np.testing.assert_allclose(trajectory.material_params[0], [0.4, 0.3, 0.2], rtol=1e-6)
    walls = motion_of(trajectory)
    moves = np.ptp(walls.pos, axis=0)[:, 0] > 0.1
    first, second = walls.pos[0, moves], walls.pos[0, ~moves & (walls.pos[0, :, 0] > 0.7)]
    assert first[:, 1].min() >= 0 and 1.3 < first[:, 1].max() < 1.4 + 1e-6
    wide = 0.15 * (np.cos(0.5) + np.sin(0.5))  # half the width of the turned box
    np.testing.assert_allclose([first[:, 0].min(), first[:, 0].max()], [-0.9 - wide, -0.9 + wide], atol=0.03)
    np.testing.assert_allclose([second[:, 0].min(), second[:, 0].max()], [0.75, 1.05], atol=0.01)
    away = (walls.normal[0, moves] * (first - first.mean(axis=0))).sum(axis=1)
    assert (away > 0).mean() > 0.9
    assert any("clusterStiffness" in note for note in report.notes)


@pytest.mark.slow
def test_a_shaken_box_moves(tmp_path: Path) -> None:
    width, depth = 0.7, 0.2
    side, face, middle = width / 2 + 0.0125, depth / 2 + 0.0125, 0.5125
    box = np.array([[0, 0.0125, 0], [-side, middle, 0], [side, middle, 0], [0, middle, -face], [0, middle, face]])
    for k in range(3):
        pos = motion(num_nodes=40, dim=3, seed=k)
        shaken = box + 0.2 * np.sin(np.arange(len(pos)) / 3)[:, None, None] * [1.0, 0.0, 0.0]
        both = np.concatenate([pos, shaken.astype(np.float32)], axis=1)
        extra = {
            "shape_quats": np.tile([1.0, 0, 0, 0], (5, 1)).astype(np.float32),
            "scene_params": np.array([0, 0, 0, 10, 17, 3, width, depth]),
        }
        sources.dpinet(tmp_path / "data_FluidShake" / "train" / str(k), both, np.gradient(both, FRAME_DT, axis=0), **extra)
    _, stored = imported(tmp_path, tmp_path / "data_FluidShake", "dpinet", spacing=0.05)
    (trajectory,) = stored["train"]
    assert not trajectory.boundary.shapes
    walls = motion_of(trajectory)
    np.testing.assert_allclose(walls.pos[0].min(axis=0), [-width / 2 - 0.025, 0, -0.125], atol=1e-6)
    np.testing.assert_allclose(walls.pos[0].max(axis=0), [width / 2 + 0.025, 1.025, 0.125], atol=1e-6)
    way = np.tile([0.2 * np.sin(5 / 3), 0, 0], (walls.pos.shape[1], 1))
    np.testing.assert_allclose(walls.pos[5] - walls.pos[0], way, atol=1e-6)


@pytest.mark.slow
def test_the_ground_is_at_zero_unless_a_node_is_below(tmp_path: Path) -> None:
    for name, lift in (("above", 0.0), ("below", 0.35)):
        for k in range(3):
            pos = motion(dim=3, seed=k) - np.array([0.0, lift, 0.0], np.float32)
            sources.dpinet(tmp_path / name / "train" / str(k), pos, np.gradient(pos, FRAME_DT, axis=0))
        lowest = min((motion(dim=3, seed=k)[..., 1] - lift).min() for k in range(3))
        _, stored = imported(tmp_path / name / "sets", tmp_path / name, "dpinet")
        for trajectory in (stored["train"][0], stored["test"][0]):
            assert trajectory.metadata.bounds[1][0] == pytest.approx(min(0.0, lowest), abs=1e-6)
            np.testing.assert_allclose(trajectory.boundary.pos[:, 1], min(0.0, lowest), atol=1e-6)


@pytest.mark.slow
def test_a_damaged_first_file_does_not_hide_the_walls_of_a_bath(tmp_path: Path) -> None:
    for k in range(4):
        pos = rigid(motion(num_nodes=80, dim=3, seed=k), slice(0, 64))
        sources.dpinet(tmp_path / "bath" / "train" / str(k), pos, np.gradient(pos, FRAME_DT, axis=0), clusters=np.zeros((1, 64), int))
    (tmp_path / "bath" / "train" / "0" / "0.h5").write_bytes(b"cut off")
    report, stored = imported(tmp_path, tmp_path / "bath", "dpinet")
    assert len(stored["train"][0].boundary.shapes) == 5
    assert [event.trajectory for event in report.refusals] == ["train/0"]


@pytest.mark.slow
def test_a_rollout_of_another_environment_is_refused(tmp_path: Path) -> None:
    for k in range(5):
        pos, extra = motion(num_nodes=80, dim=3, seed=k), {}
        if k == 1:
            pos, extra = rigid(pos, slice(0, 64)), {"clusters": np.zeros((1, 64), int)}
        sources.dpinet(tmp_path / "fall" / "train" / str(k), pos, np.gradient(pos, FRAME_DT, axis=0), **extra)
    report, stored = imported(tmp_path, tmp_path / "fall", "dpinet")
    assert [str(event) for event in report.refusals] == [
        "train, train/1: is of BoxBath, most rollouts are of FluidFall; put it into a folder of its own"
    ]
    assert stored["train"][0].metadata.materials == ("fluid",)


def test_rollouts_that_are_not_of_one_environment_are_refused(tmp_path: Path) -> None:
    for k in range(2):
        pos = rigid(motion(num_nodes=80, dim=3, seed=k), slice(0, 64))
        extra = {"clusters": np.zeros((1, 64), int)} if k else {}
        sources.dpinet(tmp_path / "both" / "train" / str(k), pos, np.gradient(pos, FRAME_DT, axis=0), **extra)
    with pytest.raises(ImportFailure, match=r"holds 1 rollouts each of FluidFall and BoxBath; put each into a folder of its own"):
        imported(tmp_path, tmp_path / "both", "dpinet")
