"""Walls with prescribed motion are stored, learned from, rolled out, and shown at their position in each frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.data.importers import save_dataset
from gpe_pl.data.sampling import StartKey
from gpe_pl.data.validate import validate
from gpe_pl.export.program import ExportedStep, scene_of
from gpe_pl.export.trajectories import write_vtk
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.approximate import Repeating, Sleeping, _Rest
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.baselines import Ballistic, ConstantVelocity
from gpe_pl.rollout.loop import rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, node_code
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.viewer import write_viewer

DT, NUM_FRAMES, SPACING = 0.01, 12, 0.05


def paddle(turn: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a row of nodes that rotates about its middle and rises: positions [frame, node, 2] and normals of the first frame."""
    row, time = np.stack([np.linspace(-0.15, 0.15, 7), np.zeros(7)], axis=1), DT * np.arange(NUM_FRAMES)
    angle = turn * time
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    centre = np.stack([0.5 + 0 * time, 0.3 + 1.5 * time], axis=1)
    return centre[:, None] + row @ rotation, np.broadcast_to([0.0, 2.0], (7, 2))


def scene(seed: int = 0) -> Trajectory:
    """Return drops that fall onto a paddle beside a floor at rest."""
    rng, time = np.random.default_rng(seed), DT * np.arange(NUM_FRAMES)[:, None, None]
    block = SPACING * np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2) + [0.37, 0.4]
    pos = block + rng.uniform(-0.3, 0.3, 2) * time + 0.5 * np.array([0, -9.81]) * time**2 + 0.001 * rng.normal(size=block.shape)
    way, normal = paddle()
    return Trajectory.from_numpy(
        pos, DT, "fluid", {"fluid": 1e-3}, gravity=[0, -9.81], bounds=[[0, 1], [0, 1]], spacing=SPACING,
        boundary=Boundary.moving(way, normal, DT, friction=0.5),
    )  # fmt: skip


@pytest.fixture
def truth() -> Trajectory:
    return scene()


@pytest.mark.parametrize("factor", [0.5, 2.0, 10.0])
def test_a_boundary_with_frames_of_another_length_is_refused(truth: Trajectory, factor: float) -> None:
    way, normal = paddle()
    wrong = Boundary.moving(way, normal, factor * DT)
    with pytest.raises(
        ArrayError, match=f"its velocities are {1 / factor:.3g} times those of its positions, whose frames are 0.01 s apart"
    ):
        Trajectory.from_numpy(truth.pos, DT, "fluid", {"fluid": 1e-3}, boundary=wrong, bounds=[[0, 1], [0, 1]])
    still = Boundary.moving(np.repeat(way[:1], NUM_FRAMES, axis=0), normal, factor * DT)
    assert Trajectory.from_numpy(truth.pos, DT, "fluid", {"fluid": 1e-3}, boundary=still, bounds=[[0, 1], [0, 1]]).num_frames == NUM_FRAMES


@pytest.fixture
def simulator(truth: Trajectory) -> LearnedSimulator:
    builder = GraphBuilder(GraphConfig(history=2), truth.metadata)
    torch.manual_seed(0)
    learned = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder).eval()
    learned.acceleration_std.fill_(5.0)
    return learned


def test_motion_of_a_paddle() -> None:
    way, normal = paddle()
    boundary = Boundary.moving(way, normal, DT)
    for frame in (0, 4, NUM_FRAMES - 1):
        now = boundary.at(frame)
        np.testing.assert_allclose(now.pos, way[frame], atol=1e-6)
        along = way[frame, 1] - way[frame, 0]
        np.testing.assert_allclose(now.normal @ along, 0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(now.normal, axis=1), 1, atol=1e-6)
        assert (now.normal[:, 1] > 0).all()
    np.testing.assert_allclose(boundary.at(3).vel, (way[4] - way[3]) / DT, atol=1e-5)
    np.testing.assert_array_equal(boundary.at(3).at(2).pos, boundary.at(5).pos)


def test_where_its_motion_ends_a_wall_stays() -> None:
    boundary = Boundary.moving(*paddle(), DT)
    last = boundary.at(NUM_FRAMES - 1)
    for beyond in (last.at(1), boundary.at(NUM_FRAMES + 5), last.at(1).at(1)):
        np.testing.assert_array_equal(beyond.pos, last.pos)
        assert not beyond.vel.any() and beyond.motion is None


def test_a_boundary_that_stands_still_is_one_object() -> None:
    boundary = Boundary.from_numpy(np.ones((3, 2)), np.ones((3, 2)))
    assert boundary.at(7) is boundary


def test_in_three_dimensions_normals_turn_with_the_body() -> None:
    rng = np.random.default_rng(0)
    body = rng.normal(size=(40, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    angle = 0.3 * np.arange(5)
    spin = np.stack([np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angle])
    way = np.einsum("fde,ne->fnd", spin, body) + 0.1 * np.arange(5)[:, None, None]
    boundary = Boundary.moving(way, body, 0.1)
    np.testing.assert_allclose(boundary.at(4).normal, body @ spin[4].T, atol=1e-5)


def test_motion_across_a_seam() -> None:
    space = Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))
    way = np.array([[0.8, 0.5], [0.85, 0.5]]) + 0.06 * np.arange(6)[:, None, None] * [1, 0]
    boundary = Boundary.moving(way, [[0, 1], [0, 1]], DT, periodicity=space)
    np.testing.assert_allclose(boundary.at(5).pos, way[5] - [1, 0], atol=1e-6)
    np.testing.assert_allclose(boundary.at(3).vel, [[6, 0], [6, 0]], rtol=1e-4)


def test_motion_far_from_the_origin_moves_with_it(truth: Trajectory) -> None:
    far = np.array([5000.0, -3000.0])
    way, normal = paddle()
    shifted = replace(truth, pos=truth.pos + far, boundary=Boundary.moving(way + far, normal, DT)).seen_from(far)
    for frame in (0, 7):
        np.testing.assert_allclose(shifted.state(frame).boundary.pos, way[frame], atol=1e-9)


def test_motion_has_the_frames_of_the_nodes() -> None:
    pos = np.random.default_rng(0).uniform(size=(5, 4, 2))
    with pytest.raises(ArrayError, match="boundary: its motion has 12 frames, pos has 5"):
        Trajectory.from_numpy(pos, DT, "fluid", {"fluid": 1e-3}, boundary=Boundary.moving(*paddle(), DT))


def test_states_and_parts_of_a_trajectory(truth: Trajectory) -> None:
    way, _ = paddle()
    np.testing.assert_allclose(truth.state(5, history=2).boundary.pos, way[5], atol=1e-6)
    part = truth.frames(3, 8)
    assert part.boundary.motion is not None and part.boundary.motion.num_frames == 5
    np.testing.assert_allclose(part.state(2).boundary.pos, way[5], atol=1e-6)


def test_the_store_keeps_it_and_reads_windows_of_it(truth: Trajectory, tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-0.h5", [truth])
    stored = read_trajectory(tmp_path / "shard-0.h5", "00000", verify=True)
    window = read_trajectory(tmp_path / "shard-0.h5", "00000", frames=slice(4, 9))
    for trajectory, offset in ((stored, 0), (window, 4)):
        for frame in range(trajectory.num_frames):
            for name in ("pos", "vel", "normal"):
                there, here = getattr(trajectory.state(frame).boundary, name), getattr(truth.state(frame + offset).boundary, name)
                np.testing.assert_array_equal(there, here.astype(np.float32))


def test_a_window_of_one_frame_still_belongs_to_a_motion(truth: Trajectory, tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-0.h5", [truth])
    read, cut = read_trajectory(tmp_path / "shard-0.h5", "00000", frames=slice(4, 5)), truth.frames(4, 5)
    assert read.boundary.motion is not None and cut.boundary.motion is not None
    assert read.boundary.motion.num_frames == cut.boundary.motion.num_frames == 1
    np.testing.assert_array_equal(read.boundary.at(1).vel, 0.0)  # a wall stays where its motion ends


def test_the_validator_knows_it(truth: Trajectory, tmp_path: Path) -> None:
    save_dataset(tmp_path, "paddles", train=[scene(k) for k in range(3)])
    assert validate([tmp_path / "paddles"]).violations == []
    motion = truth.boundary.motion
    assert motion is not None
    bad = motion.normal.copy()
    bad[3, 2] = 0.5
    write_shard(tmp_path / "train" / "shard-0.h5", [replace(truth, boundary=replace(truth.boundary, motion=replace(motion, normal=bad)))])
    messages = [str(v) for v in validate([tmp_path / "train" / "shard-0.h5"]).violations]
    assert any("frame 3, boundary_node 2" in message for message in messages)
    short = replace(truth.boundary, motion=motion.frames(0, 7))
    write_shard(tmp_path / "train" / "shard-0.h5", [replace(truth, boundary=short)])
    messages = [str(v) for v in validate([tmp_path / "train" / "shard-0.h5"]).violations]
    assert any("boundary_pos" in message and "size 7" in message for message in messages)


@pytest.mark.parametrize("held", [True, False])
def test_windows_show_the_wall_of_their_frame(tmp_path: Path, simulator: LearnedSimulator, held: bool) -> None:
    save_dataset(tmp_path, "paddles", train=[scene(k) for k in range(3)])
    root = next(tmp_path.rglob("train")).parent
    data = WindowDataset(open_split(root, "train", cache_bytes=2**30 if held else 0), simulator.builder)
    number, frame = data.locate(4)
    state = scene(number).state(frame, history=2).to_torch()
    expected, graph = simulator.builder(state), data[4]
    assert expected["boundary", "radius", "fluid"].edge_index.shape[1] > 0
    torch.testing.assert_close(graph[BOUNDARY].x, expected[BOUNDARY].x)
    torch.testing.assert_close(graph["boundary", "radius", "fluid"].odd, expected["boundary", "radius", "fluid"].odd)
    start = data[StartKey(4, 4, 3, 0)]
    after = simulator.step(simulator.step(start.state))
    np.testing.assert_allclose(after.boundary.pos.numpy(), paddle()[0][frame + 2], atol=1e-6)


def test_every_simulator_takes_the_wall_along(truth: Trajectory, simulator: LearnedSimulator) -> None:
    start = simulator.initial_state(truth, 2)
    sleepy = LearnedSimulator(simulator.model, simulator.builder).eval()
    sleepy.skips = Skips(sleep_after=2)
    for runner in (simulator, Ballistic(DT), ConstantVelocity(DT), Sleeping(sleepy), Repeating(simulator, DT, 3)):
        state = start
        for frame in range(3, 7):
            state = runner.step(state)
            np.testing.assert_allclose(np.asarray(state.boundary.pos), paddle()[0][frame], atol=1e-6)
        run = rollout(runner, start, 4, truth.metadata)
        assert run.boundary.motion is not None
        np.testing.assert_allclose(run.boundary.motion.pos, paddle()[0][2:7], atol=1e-6)
    longer = rollout(simulator, start, NUM_FRAMES, truth.metadata)
    assert longer.boundary.motion is not None and longer.boundary.motion.num_frames == NUM_FRAMES + 1
    np.testing.assert_allclose(longer.boundary.motion.pos[-1], paddle()[0][-1], atol=1e-6)


def test_a_wall_that_comes_wakes_what_sleeps(truth: Trajectory, simulator: LearnedSimulator) -> None:
    simulator.skips = Skips(sleep_after=1, rest_step_spacings=1e3, rest_step_change_spacings=1e3)
    state = simulator.initial_state(truth, 2)
    calm = replace(state, internal=_Rest(torch.full((state.num_nodes,), 5)))
    assert Sleeping(simulator).step(calm).num_asleep == 0
    far = replace(calm, pos=calm.pos + torch.tensor([5.0, 0.0]))
    assert Sleeping(simulator).step(far).num_asleep == state.num_nodes


def test_an_exported_step_is_told_where_the_wall_is(truth: Trajectory, simulator: LearnedSimulator) -> None:
    state = simulator.step(simulator.initial_state(truth, 2))
    moved, _ = ExportedStep(simulator)(scene_of(simulator, state))
    torch.testing.assert_close(moved["pos.fluid"], simulator.step(state).pos, rtol=0, atol=1e-9)


def test_pictures_and_files_show_it_as_nodes(truth: Trajectory, simulator: LearnedSimulator, tmp_path: Path) -> None:
    shown = truth.with_moving_boundary()
    assert shown.num_nodes == truth.num_nodes + 7 and len(shown.boundary.pos) == 0
    np.testing.assert_allclose(shown.pos[:, truth.num_nodes :], paddle()[0], atol=1e-6)
    assert (shown.node_type[truth.num_nodes :] == node_code(BOUNDARY)).all()
    assert shown.with_moving_boundary() is shown
    prediction = rollout(simulator, simulator.initial_state(truth, 0 + 2), 4, truth.metadata)
    assert write_viewer(tmp_path / "page.html", truth.frames(2, 7), {"GPE": prediction}) > 0
    write_vtk(tmp_path / "series.pvd", truth)
    assert not (tmp_path / "series" / "boundary.vtu").exists()
