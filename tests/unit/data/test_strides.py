"""Data at every ``stride``-th frame are the data that a solver with longer frames would have stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset, stride_of
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.dataset import StoredTrajectory, WindowDataset, every, long_enough, open_split
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.data.statistics import acceleration_std
from gpe_pl.data.strides import MOST_RADII, REACH, connectivity_radius
from gpe_pl.files import sealed
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.metrics import per_frame_mse
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.loop import rollout
from gpe_pl.simulate import simulate
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import StoreError, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import DATA, compose
from tests.scenes import assert_equal_graphs

STRIDE, HISTORY, NUM_FRAMES = 3, 2, 20


def calm(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with a tenth of its motion, because jumps across the domain mark damaged data."""
    return replace(trajectory, pos=trajectory.pos[:1] + np.float32(0.05) * (trajectory.pos - trajectory.pos[:1]))


def store(root: Path, trajectories: dict[str, list[Trajectory]]) -> Path:
    for split, own in trajectories.items():
        write_shard(root / split / "shard-00000.h5", own)
    std = acceleration_std(trajectories["train"])
    sealed.write(root / "statistics.json", {"acceleration_std": std, "data_sha256": split_checksum(root, "train")})
    return root


@pytest.fixture
def stored(new_trajectory: Callable[..., Trajectory]) -> dict[str, list[Trajectory]]:
    seeds = {"train": (0, 1), "val": (2,)}
    return {split: [calm(new_trajectory(seed, num_frames=NUM_FRAMES, split=split)) for seed in own] for split, own in seeds.items()}


def module_of(root: Path, **settings: Any) -> TrajectoryDataModule:
    return TrajectoryDataModule(root, GraphConfig(history=HISTORY), Noise(0.0, 0.1), batch_size=BatchSize(2), seed=1, **settings)


def windows(module: TrajectoryDataModule, views: list[StoredTrajectory]) -> WindowDataset:
    own = module.train_set
    return WindowDataset(views, module.builder, own.noise, own.velocity_unit, own.seed)


@pytest.mark.slow
@pytest.mark.parametrize("cache_bytes", [0, 2**30])
def test_every_third_frame_is_the_same_as_a_data_set_that_stores_no_others(
    stored: dict[str, list[Trajectory]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache_bytes: int
) -> None:
    monkeypatch.setattr("gpe_pl.data.datamodule.open_split", partial(open_split, cache_bytes=cache_bytes))
    view = module_of(store(tmp_path / "all", stored), stride=STRIDE)

    def third(trajectory: Trajectory) -> Trajectory:
        metadata = replace(
            trajectory.metadata, frame_dt=STRIDE * trajectory.metadata.frame_dt, connectivity_radius=view.metadata.connectivity_radius
        )
        return replace(trajectory, metadata=metadata, pos=trajectory.pos[::STRIDE], vel=trajectory.vel[::STRIDE])

    other = module_of(store(tmp_path / "third", {split: [third(t) for t in own] for split, own in stored.items()}))
    assert (view.train_set.trajectories[0].cached is None) == (cache_bytes == 0)
    assert view.metadata == other.metadata and view.builder.scales == other.builder.scales
    assert view.train_set.velocity_unit == other.train_set.velocity_unit > 0
    own = windows(view, [v for v in view.train_set.trajectories if v.phase == 0])
    assert len(own) == len(other.train_set) == 2 * 4 and len(view.val_set) == len(other.val_set) == 4
    for mine, its in ((own, other.train_set), (view.val_set, other.val_set)):
        for k in range(len(mine)):
            a, b = mine[k], its[k]
            assert int(a.frame) == STRIDE * int(b.frame) and int(a.trajectory) == int(b.trajectory)
            b.frame = a.frame
            assert_equal_graphs(a, b)
    for a, b in zip(view.val_trajectories(1), other.val_trajectories(1), strict=True):
        np.testing.assert_array_equal(a.pos, b.pos)
        assert a.metadata.frame_dt == b.metadata.frame_dt


def test_training_windows_begin_at_every_stored_frame(stored: dict[str, list[Trajectory]], tmp_path: Path) -> None:
    data = module_of(store(tmp_path, stored), stride=STRIDE).train_set
    places = sorted((int(data[k].trajectory), int(data[k].frame)) for k in range(len(data)))
    assert places == [(t, frame) for t in (0, 1) for frame in range(STRIDE * HISTORY, NUM_FRAMES - STRIDE)]
    for view in data.trajectories:
        whole = view.window(0, view.num_frames)
        np.testing.assert_array_equal(whole.pos, stored["train"][int(view.name)].pos[view.phase :: STRIDE])
        np.testing.assert_array_equal(view.window(1, 3).vel, whole.vel[1:3])
        assert whole.start_time == pytest.approx(0.01 * view.phase)


def test_statistics_of_a_stride_are_kept_until_the_data_change(stored: dict[str, list[Trajectory]], tmp_path: Path) -> None:
    root = store(tmp_path, stored)
    unit, file = module_of(root, stride=2).train_set.velocity_unit, root / "statistics_stride_2.json"
    assert {"acceleration_std", "max_speed", "data_sha256"} <= sealed.read(file, "").keys()
    sealed.write(file, sealed.read(file, "") | {"acceleration_std": 1.0})
    assert module_of(root, stride=2).train_set.velocity_unit == pytest.approx(0.02)
    sealed.write(file, sealed.read(file, "") | {"data_sha256": "of other data"})
    assert module_of(root, stride=2).train_set.velocity_unit == unit
    file.write_text("{")
    assert module_of(root, stride=2).train_set.velocity_unit == unit


@pytest.mark.parametrize("stride", [1, 2, 5])
@pytest.mark.parametrize("acceleration", [0.0, -3.0])
def test_a_flight_has_its_acceleration_at_any_stride(trajectory: Trajectory, stride: int, acceleration: float) -> None:
    dt, gravity = trajectory.metadata.frame_dt, np.array(trajectory.metadata.gravity)
    time = dt * np.arange(21)[:, None, None]
    pos = trajectory.pos[:1].astype(np.float64) + np.array([0.5, -0.25]) * time + 0.5 * np.array([0.0, acceleration]) * time**2
    flight = replace(trajectory, pos=pos, vel=np.broadcast_to(np.array([0.5, -0.25]) + np.array([0.0, acceleration]) * time, pos.shape))
    views = every([StoredTrajectory(Path("shard"), "0", 21, flight.num_nodes, flight)], stride, phases=stride)
    data = WindowDataset(views, GraphBuilder(GraphConfig(history=2), views[0].window(0, 1).metadata))
    expected = torch.from_numpy(np.array([0.0, acceleration]) - gravity).float().expand(flight.num_nodes, 2)
    for k in range(len(data)):
        torch.testing.assert_close(data[k]["sand"].target, expected, rtol=1e-4, atol=1e-4)
    falling = replace(flight, boundary=Boundary.empty(2), pos=pos + 0.5 * (gravity - np.array([0.0, acceleration])) * time**2).every(stride)
    num_steps = falling.num_frames - 3
    prediction = rollout(BASELINES["ballistic"](stride * dt), falling.state(2, 2), num_steps, falling.metadata)
    assert prediction.metadata.frame_dt == stride * dt and prediction.num_frames == num_steps + 1
    assert per_frame_mse(prediction, falling.frames(2)).max() < 1e-20


def test_walls_move_as_far_in_longer_frames(trajectory: Trajectory) -> None:
    way = 0.01 * np.arange(6.0)[:, None, None] ** 2 * np.array([1.0, 0.0]) + np.array([[0.2, 0.5], [0.2, 0.6]])
    moving = Boundary.moving(way, np.tile([1.0, 0.0], (2, 1)), trajectory.metadata.frame_dt)
    short = replace(trajectory, boundary=moving)
    longer = short.every(2)
    assert longer.boundary.motion is not None and longer.metadata.frame_dt == 2 * trajectory.metadata.frame_dt
    np.testing.assert_array_equal(longer.boundary.motion.pos, way[::2])
    np.testing.assert_allclose(longer.boundary.motion.vel[:2] * longer.metadata.frame_dt, np.diff(way[::2], axis=0), rtol=1e-12)
    np.testing.assert_array_equal(longer.boundary.vel, longer.boundary.motion.vel[0])
    np.testing.assert_array_equal(longer.state(1).boundary.pos, way[2])
    assert longer.state(2).time == pytest.approx(short.state(4).time)
    assert trajectory.every(3).boundary is trajectory.boundary and trajectory.every(1) is trajectory


def test_the_radius_follows_the_fastest_node_up_to_a_limit(trajectory: Trajectory) -> None:
    m = trajectory.metadata  # radius 0.15 m, frames of 0.01 s
    assert [connectivity_radius(m, 4, speed) for speed in (1.0, 10.0, 100.0)] == pytest.approx([0.15, 0.2, MOST_RADII * 0.15])
    assert connectivity_radius(m, 1, 100.0) == 0.15
    around = replace(m, periodic=(True, False), bounds=((0.0, 0.5), (0.0, 1.0)))
    assert connectivity_radius(replace(around, connectivity_radius=0.1), 4, 6.2) == pytest.approx(REACH * 4 * 0.01 * 6.2)
    with pytest.raises(StoreError, match=r"data.stride=4: nodes move up to 0.28 m in a frame, .* half the period of 0.5 m .* at most 3$"):
        connectivity_radius(around, 4, 7.0)


@pytest.mark.slow
@pytest.mark.parametrize("value", ["0", "-2", "1.5", "true", "null", "many"])
@pytest.mark.parametrize("data", ["sand", "imported"])
def test_other_strides_than_counts_of_frames_are_refused(value: str, data: str) -> None:
    with pytest.raises(ConfigError, match=r"^data.stride=.*: must be an integer of at least 1, the number of stored frames in a frame of"):
        stride_of(compose("fit", f"data={data}", f"data.stride={value}"))


def test_commands_that_store_frames_refuse_a_stride(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="^data.stride=2: solvers store every frame; leave it out here"):
        simulate(compose("simulate", *DATA, "data.stride=2", f"paths.data={tmp_path}"))
    with pytest.raises(ConfigError, match="^data.stride=2: solvers store every frame"):
        dataset("data=sand", "data.stride=2")
    assert not [*tmp_path.iterdir()]


def test_a_stride_that_leaves_no_window_is_refused(stored: dict[str, list[Trajectory]], tmp_path: Path) -> None:
    root = store(tmp_path, stored)
    assert len(module_of(root, stride=6).val_set) == 1
    for stride in (7, 10**15):
        with pytest.raises(
            StoreError, match=rf"no trajectory has the 4 frames .*; the longest has . with data.stride={stride}; choose a smaller"
        ):
            module_of(root, stride=stride)
    assert [t.num_frames for _, t in long_enough(root, "val", HISTORY, 6)] == [4]
    assert [*long_enough(root, "val", HISTORY, 7)] == []
