"""Training on open scenes: windows have the nodes of their frame, the history of rollouts, and targets for nodes that a model moves."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.damage import damage
from gpe_pl.data.dataset import StartKey, WindowDataset, collated, open_split, usable
from gpe_pl.data.noise import Noise
from gpe_pl.data.open_windows import OpenScenesError, continued
from gpe_pl.data.statistics import acceleration_std, motion
from gpe_pl.data.training_samples import UnrollStart
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.nn.stores import predicted_rows
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import steps
from gpe_pl.solvers.flip import FLIP
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.open_scenes import BOUNDS, DT, OPENINGS, open_trajectory
from tests.scenes import assert_equal_graphs

HISTORY = 2


@pytest.fixture
def trajectory() -> Trajectory:
    return open_trajectory()


@pytest.fixture
def data(tmp_path: Path, trajectory: Trajectory) -> WindowDataset:
    return dataset(tmp_path, [trajectory])


def dataset(root: Path, trajectories: list[Trajectory], noise: Noise | None = None, **settings: Any) -> WindowDataset:
    write_shard(root / "train" / "shard-00000.h5", trajectories)
    stored = usable(open_split(root, "train"))
    builder = GraphBuilder(GraphConfig(history=HISTORY), stored[0].window(0, 1).metadata)
    return WindowDataset(stored, builder, noise, 0.1, **settings)


def test_a_window_is_the_graph_of_the_rollout(data: WindowDataset, trajectory: Trajectory) -> None:
    counts = set()
    for window in range(len(data)):
        graph, frame = data[window], data.locate(window)[1]
        expected = data.builder(trajectory.state(frame, HISTORY).to_torch())
        for name, value in expected["sand"].items():
            torch.testing.assert_close(graph["sand"][name], value, rtol=0, atol=2e-4)
        counts.add(graph["sand"].num_nodes)
    assert len(counts) > 3


@pytest.mark.parametrize("phase", [0, 1])
def test_windows_of_longer_frames_have_the_time_of_their_frame(data: WindowDataset, trajectory: Trajectory, phase: int) -> None:
    """Openings with a speed that varies, and the nodes that enter, depend on it."""
    (stored,) = data.trajectories
    view = replace(stored, stride=2, phase=phase)
    longer = WindowDataset([view], GraphBuilder(GraphConfig(history=HISTORY), view.window(0, 1).metadata), None, 0.1)
    whole = trajectory.frames(phase).every(2) if phase else trajectory.every(2)
    for window in range(len(longer)):
        start, frame = longer[StartKey(window, window, 1)], longer.locate(window)[1]
        assert isinstance(start, UnrollStart)
        assert start.state.time == pytest.approx(whole.state(frame, HISTORY).time)


@pytest.mark.parametrize("stride", [1, 2])
def test_windows_of_a_trajectory_that_begins_later_have_the_time_of_the_scene(tmp_path: Path, trajectory: Trajectory, stride: int) -> None:
    later = dataset(tmp_path, [trajectory.frames(7)])
    view = [replace(stored, stride=stride) for stored in later.trajectories]
    windows = WindowDataset(view, GraphBuilder(GraphConfig(history=HISTORY), view[0].window(0, 1).metadata), None, 0.1)
    start = windows[StartKey(0, 0, 1)]
    assert isinstance(start, UnrollStart)
    assert start.state.time == pytest.approx((7 + HISTORY * stride) * DT)


def test_targets_are_those_of_nodes_that_stay_and_that_no_opening_moves(data: WindowDataset, trajectory: Trajectory) -> None:
    assert trajectory.alive is not None
    left_out = set()
    for window in range(len(data)):
        graph, frame = data[window], data.locate(window)[1]
        alive = trajectory.alive[frame]
        stays, inside = trajectory.alive[frame + 1][alive], carried(OPENINGS, trajectory.pos[frame, alive])
        known = ~graph["sand"].without_target.numpy()
        np.testing.assert_array_equal(known, stays & ~inside)
        np.testing.assert_allclose(graph["sand"].target[known], 0.0, atol=5e-3)  # all fall freely
        assert len(predicted_rows(graph["sand"], graph["sand"].target)) == known.sum()
        left_out |= {*zip(stays.tolist(), inside.tolist(), strict=True)}
    assert {(False, False), (True, True)} <= left_out


def test_noise_spares_what_openings_move(tmp_path: Path, trajectory: Trajectory) -> None:
    plain, noisy = dataset(tmp_path / "a", [trajectory]), dataset(tmp_path / "b", [trajectory], Noise(0.01, 0.5))
    for window in (0, 7, 14):
        state, own = (data[StartKey(0, window, 0)].state for data in (plain, noisy))
        inside = carried(OPENINGS, state.pos.numpy())
        assert torch.equal(state.pos[inside], own.pos[inside])
        assert torch.equal(state.velocity_history[inside], own.velocity_history[inside])  # type: ignore[index]
        assert (state.pos[~inside] != own.pos[~inside]).all()


def test_nodes_go_on_before_they_enter_and_after_they_leave(trajectory: Trajectory) -> None:
    assert trajectory.alive is not None
    window = trajectory.frames(3, 12)
    assert window.alive is not None
    pos = continued(window)
    np.testing.assert_array_equal(pos[window.alive], window.pos[window.alive].astype(np.float64))
    step = np.diff(pos, axis=0)
    for node in range(window.num_nodes):
        frames = np.flatnonzero(window.alive[:, node])
        for frame in (*range(frames[0]), *range(frames[-1], len(pos) - 1)):
            nearest = frames[0] if frame < frames[0] else frames[-1]
            np.testing.assert_allclose(step[frame, node], DT * window.vel[nearest, node], atol=1e-6)


def test_unrolls_follow_identities(data: WindowDataset) -> None:
    start = data[StartKey(0, 1, 8)]
    states = [start.state, *steps(Ballistic(DT), _numpy(start.state), 8)]
    num_known = 0
    for step, state in enumerate(states):
        state = state.to_torch()
        target, mask = start.target(state, step, DT)[0], start.without_target(state, step)
        assert mask is not None
        np.testing.assert_allclose(target[~mask], 0.0, atol=5e-3)
        num_known += int((~mask).sum())
    assert states[-1].num_nodes != states[0].num_nodes
    assert num_known > 50


def _numpy(state: State) -> State:
    arrays: dict[str, Any] = {name: value.numpy() for name, value in vars(state).items() if isinstance(value, torch.Tensor)}
    return replace(state, **arrays)


def test_a_node_that_the_truth_lacks_has_no_target(data: WindowDataset) -> None:
    start = data[StartKey(0, 1, 2)]
    state = start.state
    assert state.node_id is not None
    other = replace(state, node_id=state.node_id + (torch.arange(state.num_nodes) == state.num_nodes - 1) * 99)
    before, after = (start.without_target(s, 0) for s in (state, other))
    assert after is not None and before is not None
    assert bool(after[-1])
    assert torch.equal(before[:-1], after[:-1])


def test_starts_reach_other_processes(data: WindowDataset) -> None:
    start = data[StartKey(0, 1, 3)]
    copied: UnrollStart = pickle.loads(pickle.dumps(start))
    assert_equal_graphs(start.graph(data.builder, start.state, 0), copied.graph(data.builder, copied.state, 0))


def test_open_and_closed_scenes_go_into_one_batch(tmp_path: Path, trajectory: Trajectory) -> None:
    assert trajectory.alive is not None
    closed = replace(trajectory.of_nodes(trajectory.alive[0]), alive=None, openings=())
    data = dataset(tmp_path, [trajectory, closed])
    first, second = data[0], data[len(data) - 1]
    assert not second["sand"].without_target.any()
    batch: Any = collated([first, second])
    assert batch["sand"].without_target.tolist() == [*first["sand"].without_target.tolist(), *[False] * closed.num_nodes]


def test_statistics_count_nodes_while_they_are_there(trajectory: Trajectory) -> None:
    assert trajectory.alive is not None
    alive = trajectory.alive
    sizes = {key: len(values) for key, values in motion(trajectory)}
    assert sizes["velocity"] == (alive[1:] & alive[:-1]).sum()
    assert sizes["acceleration"] == (alive[2:] & alive[1:-1] & alive[:-2]).sum()
    parked = replace(trajectory, pos=np.where(alive[..., None], trajectory.pos, 9.0))
    assert acceleration_std([parked]) == acceleration_std([trajectory])


def test_activity_counts_nodes_while_they_are_there(tmp_path: Path, trajectory: Trajectory) -> None:
    data = dataset(tmp_path, [trajectory])
    activity = data.activity()
    assert len(activity) == len(data)
    assert np.isfinite(activity).all()
    assert activity.max() < 3  # gravity of 2 m/s² and a turning inlet, but no jumps of nodes that enter


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"unroll_steps": 2},
            "training.unroll_steps=2: the data have scenes with inlets and outlets; set unroll_steps=null and push_fraction=0.6",
        ),
        (
            {"solver": cast(Any, FLIP(BOUNDS, 0.1, DT))},
            "training.targets=solver: the data have scenes with inlets and outlets; set targets=trajectory",
        ),
        (
            {"augmentation": Augmentation(mirror=True)},
            "training.mirror, rotate, quarter_turns and boost_speed: the data have scenes with inlets and outlets",
        ),
    ],
)
def test_settings_that_need_nodes_that_stay_are_refused(
    tmp_path: Path, trajectory: Trajectory, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(OpenScenesError, match=message):
        dataset(tmp_path, [trajectory], **settings)


def test_open_scenes_that_cannot_be_learned_from_are_named(trajectory: Trajectory) -> None:
    assert trajectory.alive is not None
    assert damage(trajectory) is None
    empty = trajectory.alive.copy()
    empty[20:] = False
    assert damage(replace(trajectory, alive=empty)) == "no node is in the scene in frame 20"
