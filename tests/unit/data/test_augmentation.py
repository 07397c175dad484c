"""Images of training windows obey the same mechanics: turned and moved scenes have turned and equal accelerations, and their walls go along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.augmentation import Augmentation, AugmentationError, boosted, turned_with_gravity
from gpe_pl.data.dataset import StartKey, StoredTrajectory, WindowDataset
from gpe_pl.fit import fit
from gpe_pl.geometry.shapes import Box, Wall, domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.training.run import TrainingSettings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Rotation
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import tiny

DT, HISTORY = 0.01, 2


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """A drop that falls beside a wall and turns."""
    rng = np.random.default_rng(0)
    times = DT * np.arange(9)[:, None, None]
    start, vel, acc = rng.uniform(0.05, 0.25, (12, 3)), rng.uniform(-1, 1, (12, 3)), rng.uniform(-5, 5, (12, 3))
    bounds = ((0.0, 1.0), (0.0, 0.8), (0.0, 0.6))
    return Trajectory.from_numpy(
        start + times * vel + times**2 * acc / 2, DT, "fluid", {"fluid": 0.01}, bounds=bounds, gravity=(0.0, 0.0, -9.81), spacing=0.1,
        boundary=Boundary.sample(domain_walls(bounds, 0.3), 0.1, 3),
    )  # fmt: skip


def windows(truth: Trajectory, augmentation: Augmentation) -> WindowDataset:
    stored = StoredTrajectory(Path("shard"), "0", truth.num_frames, truth.num_nodes, truth)
    return WindowDataset([stored], GraphBuilder(GraphConfig(history=HISTORY), truth.metadata), seed=3, augmentation=augmentation)


def test_a_turned_window_has_the_turned_target_and_walls(truth: Trajectory) -> None:
    plain, turned = (windows(truth, a)[StartKey(7, 1, 2)] for a in (Augmentation(), Augmentation(rotate=True)))
    centre = torch.tensor([0.5, 0.4, 0.3])
    before, after = plain.truth - centre, turned.truth - centre
    torch.testing.assert_close(after[..., 2], before[..., 2], rtol=0, atol=1e-7)
    torch.testing.assert_close(after[..., :2].norm(dim=-1), before[..., :2].norm(dim=-1), rtol=0, atol=1e-6)
    assert (after - before).abs().max() > 0.05
    angle = torch.atan2(after[0, 0, 1], after[0, 0, 0]) - torch.atan2(before[0, 0, 1], before[0, 0, 0])
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    torch.testing.assert_close(
        turned.target(turned.state, 0, DT)[0], plain.target(plain.state, 0, DT)[0] @ turn.T, rtol=0, atol=2e-2
    )  # stored in float32
    torch.testing.assert_close(
        turned.state.boundary.normal, plain.state.boundary.normal @ turn.T.to(plain.state.boundary.normal), rtol=0, atol=1e-6
    )
    other = windows(truth, Augmentation(rotate=True))[StartKey(6, 1, 2)]
    assert (other.truth - turned.truth).abs().max() > 0.01


def test_a_moving_frame_changes_velocities_and_not_accelerations(truth: Trajectory) -> None:
    plain, moved = (windows(truth, a)[StartKey(5, 1, 3)] for a in (Augmentation(), Augmentation(boost_speed=2.0)))
    velocity = (moved.state.vel - plain.state.vel)[0]
    assert velocity[2] == 0 and 0.1 < velocity.abs().max() < 2
    torch.testing.assert_close(moved.state.pos, plain.state.pos)
    torch.testing.assert_close(moved.target(moved.state, 0, DT)[0], plain.target(plain.state, 0, DT)[0], rtol=0, atol=2e-2)
    torch.testing.assert_close(
        moved.state.boundary.vel, velocity.to(moved.state.boundary.vel).expand(moved.state.boundary.vel.shape), rtol=0, atol=1e-6
    )
    later = moved.state.later(DT, moved.state.pos, moved.state.vel)
    torch.testing.assert_close(later.boundary.pos.double(), moved.state.boundary.pos.double() + DT * velocity, rtol=0, atol=1e-6)
    graphs = [windows(truth, a)[0] for a in (Augmentation(), Augmentation(boost_speed=2.0))]
    edges = [graph["boundary", "radius", "fluid"] for graph in graphs]
    assert edges[0].edge_index.shape[1] > 0
    torch.testing.assert_close(edges[1].odd, edges[0].odd, rtol=0, atol=1e-4)  # distances and velocities relative to walls


def test_a_wall_that_moves_already_gets_the_velocity_in_addition(truth: Trajectory) -> None:
    once = boosted(truth, np.array([0.3, 0.0, 0.0]), 4)
    twice = boosted(once, np.array([-0.3, 0.5, 0.0]), 4)
    assert twice.boundary.motion is not None
    np.testing.assert_allclose(twice.boundary.motion.vel, np.broadcast_to([0.0, 0.5, 0.0], twice.boundary.motion.vel.shape), atol=1e-7)
    np.testing.assert_allclose(twice.boundary.motion.pos[4], truth.boundary.pos, atol=1e-6)


@pytest.mark.parametrize("number", range(24))
def test_a_quarter_turn_takes_gravity_walls_and_targets_along(truth: Trajectory, number: int) -> None:
    matrix = Rotation.between_axes(number, (0.0, 0.0, 0.0)).matrix
    image = turned_with_gravity(truth, number)
    np.testing.assert_allclose(image.metadata.gravity, matrix @ truth.metadata.gravity)
    np.testing.assert_allclose(np.ptp(image.metadata.bounds, axis=1), np.abs(matrix) @ [1.0, 0.8, 0.6])
    middle = np.array([0.5, 0.4, 0.3])
    np.testing.assert_allclose(image.pos - middle, (truth.pos - middle) @ matrix.T, atol=1e-6)
    np.testing.assert_allclose(image.boundary.normal, truth.boundary.normal @ matrix.T, atol=1e-7)
    low, high = np.array(image.metadata.bounds).T
    assert (image.boundary.pos >= low - 1e-6).all() and (image.boundary.pos <= high + 1e-6).all()
    before, after = windows(truth, Augmentation())[StartKey(2, 1, 2)], windows(image, Augmentation())[StartKey(2, 1, 2)]
    turned = before.target(before.state, 0, DT)[0] @ torch.from_numpy(matrix).T
    torch.testing.assert_close(after.target(after.state, 0, DT)[0], turned, rtol=0, atol=2e-2)  # stored in float32


@pytest.mark.parametrize(("dim", "count"), [(2, 4), (3, 24)])
def test_rotations_between_axes_are_a_group(dim: int, count: int) -> None:
    matrices = [Rotation.between_axes(number, (0.0,) * dim).matrix for number in range(count)]
    np.testing.assert_array_equal(matrices[0], np.eye(dim))
    known = {(matrix + 0.0).tobytes() for matrix in matrices}  # without negative zeros
    assert len(known) == count and all(((a @ b) + 0.0).tobytes() in known for a in matrices for b in matrices)
    assert all(np.linalg.det(matrix) == pytest.approx(1) for matrix in matrices)
    with pytest.raises(IndexError):
        Rotation.between_axes(count, (0.0,) * dim)


def test_every_direction_of_gravity_is_drawn_alike() -> None:
    pos = np.random.default_rng(0).uniform(0.2, 0.8, (5, 6, 2))
    held = np.zeros((6, 2), bool)
    held[1, 0] = True
    scene = Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, bounds=[[0, 2], [0, 1]], gravity=(0.0, -9.81), prescribed=held)
    moved = [Augmentation(quarter_turns=True).moved(scene, 1, 0, sample) for sample in range(400)]
    counts: dict[tuple[float, ...], int] = {}
    for image in moved:
        assert image.prescribed is not None and image.prescribed.sum() == 1
        assert image.prescribed[1].tolist() == [image.metadata.gravity[0] == 0, image.metadata.gravity[1] == 0]  # across gravity, as before
        counts[image.metadata.gravity] = counts.get(image.metadata.gravity, 0) + 1
    assert len(counts) == 4 and min(counts.values()) > 70


def test_windows_of_the_elastic_law_are_not_turned_by_any_angle(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"training.rotate=true: the elastic law reads the shapes of walls"):
        fit(tiny(tmp_path, tmp_path, "data=fem", "model=gpe_tuned", "training.rotate=true"))


@pytest.mark.parametrize("number", range(1, 24))
def test_a_quarter_turn_keeps_the_shapes_of_walls(truth: Trajectory, number: int) -> None:
    image = turned_with_gravity(truth, number).boundary
    assert len(image.shapes) == 6
    distance = np.min([np.abs(shape.signed_distance(image.pos)) for shape in image.shapes], axis=0)
    assert distance.max() < 1e-6


def test_a_stress_in_the_plane_turns_with_it() -> None:
    turn, stress = Rotation.between_axes(1, (0.0, 0.0)), np.array([1.0, 2.0, 3.0, 4.0])
    full = turn.matrix @ np.array([[1.0, 2.0], [2.0, 3.0]]) @ turn.matrix.T
    np.testing.assert_allclose(turn.tensor(stress), [full[0, 0], full[0, 1], full[1, 1], 4.0])


def test_stresses_turn_with_the_planes_they_act_on() -> None:
    rng = np.random.default_rng(1)
    stress, normal = rng.normal(size=6), rng.normal(size=3)

    def traction(s: np.ndarray, n: np.ndarray) -> np.ndarray:
        return np.array([[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]]) @ n

    turn = Rotation.about(1, 0.7, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(traction(turn.tensor(stress), turn.vector(normal)), turn.vector(traction(stress, normal)), atol=1e-12)


def under(truth: Trajectory, **changes: Any) -> Trajectory:
    return replace(truth, metadata=replace(truth.metadata, **changes))


def with_walls(truth: Trajectory, *sides: str) -> Trajectory:
    walls = dict(zip(("x_low", "x_high", "y_low", "y_high", "z_low", "z_high"), domain_walls(truth.metadata.bounds, 0.3), strict=True))
    scene = replace(truth, boundary=Boundary.sample(tuple(walls[side] for side in sides), 0.1, 3))
    return under(scene, gravity=(0.0, 0.0, 0.0))


def images(scene: Trajectory) -> np.ndarray:
    """Return for many samples which axes are mirrored [sample, axis]."""
    return np.array([[plane is not None for plane in Augmentation(mirror=True).reflection(scene, 0, k).planes] for k in range(64)])


def test_without_gravity_a_floor_without_a_ceiling_is_below(truth: Trajectory) -> None:
    fluid_fall = with_walls(truth, "y_low")
    assert images(fluid_fall).any(axis=0).tolist() == [True, False, True]
    turned = Augmentation(rotate=True, boost_speed=1.0).moved(fluid_fall, 0, 0, 1)
    np.testing.assert_allclose(turned.pos[..., 1], truth.pos[..., 1], atol=1e-6)
    assert np.abs(turned.pos[0] - truth.pos[0]).max() > 0.01
    np.testing.assert_allclose(turned.boundary.normal, np.broadcast_to([0, 1, 0], turned.boundary.normal.shape), atol=1e-6)
    Augmentation(rotate=True).check(fluid_fall)
    corner = with_walls(truth, "x_low", "z_low")
    assert images(corner).any(axis=0).tolist() == [False, True, False]
    with pytest.raises(AugmentationError, match=r"training.rotate=true: needs scenes in 3D"):
        windows(corner, Augmentation(rotate=True))


def test_obstacles_and_ramps_do_not_hide_the_floor(truth: Trajectory) -> None:
    low, high = zip(*truth.metadata.bounds, strict=True)
    floor = domain_walls(truth.metadata.bounds, 0.3)[2]
    raised = Box((0.4, 0.3, 0.2), (0.6, 0.5, 0.4), 0.3)
    ramp = Wall((-np.sin(0.6), np.cos(0.6), 0.0), 0.0, low, high, 0.3)
    inclined = Boundary.from_numpy(*ramp.sample(0.05), shapes=(ramp,))
    cases = [(Boundary.sample((floor, raised), 0.05, 3), [0, 2]), (inclined, [2]), (Boundary.sample((raised,), 0.05, 3), [0, 1, 2])]
    for boundary, level in cases:
        scene = under(replace(truth, boundary=boundary), gravity=(0.0, 0.0, 0.0))
        assert np.flatnonzero(images(scene).any(axis=0)).tolist() == level


def test_without_gravity_and_with_walls_on_both_sides_or_none_all_axes_are_level(truth: Trajectory) -> None:
    for sides in ((), ("x_low", "x_high"), ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high")):
        assert images(with_walls(truth, *sides)).any(axis=0).tolist() == [True, True, True]
    beside_a_wall = under(with_walls(truth, "x_low"), gravity=(0.0, 0.0, -9.81))  # gravity tells the vertical, whatever the walls
    assert images(beside_a_wall).any(axis=0).tolist() == [True, True, False]


@pytest.mark.parametrize("own", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.5, -2.0, 0.3), (0.0, 0.0, 0.0)])
def test_extremes_have_the_fastest_and_slowest_walls_of_windows(truth: Trajectory, own: tuple[float, float, float]) -> None:
    """Whatever the direction in which the walls of the scene move."""
    moving = boosted(truth, np.array(own), 0)
    augmentation = Augmentation(boost_speed=1.0)

    def speeds(scene: Trajectory) -> np.ndarray:
        motion = scene.boundary.motion
        return np.linalg.norm(scene.boundary.vel if motion is None else motion.vel, axis=-1)

    known = np.concatenate([speeds(image) for image in augmentation.extremes(moving)])
    drawn = np.concatenate([speeds(augmentation.moved(moving, 4, 0, sample)) for sample in range(100)])
    assert known.min() <= drawn.min() and drawn.max() <= known.max()
    level, vertical = np.abs(own[:2]), own[2]
    np.testing.assert_allclose(known.max(), np.hypot(np.linalg.norm(level + 1.0), vertical), rtol=1e-6)
    np.testing.assert_allclose(known.min(), np.hypot(np.linalg.norm((level - 1.0).clip(0.0)), vertical), rtol=1e-6, atol=1e-6)


def test_extremes_of_a_scene_without_walls_are_the_scene(truth: Trajectory) -> None:
    open_space = with_walls(truth)
    (image,) = Augmentation(boost_speed=1.0).extremes(open_space)
    assert image is open_space


@pytest.mark.parametrize("sides", [(), ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high")])
@pytest.mark.parametrize("pull", [0.0, -9.81])
def test_gravity_that_is_not_stored_is_noticed(
    truth: Trajectory, caplog: pytest.LogCaptureFixture, sides: tuple[str, ...], pull: float
) -> None:
    """Walls on all sides or none do not tell the vertical, so images would turn a pull over."""
    scene = with_walls(truth, *sides)
    fall = (0.5 * pull * (DT * np.arange(truth.num_frames)) ** 2)[:, None, None] * np.array([0.0, 1.0, 0.0])
    scene = replace(scene, pos=(scene.pos + fall).astype(np.float32))
    for augmentation in (Augmentation(), Augmentation(boost_speed=1.0), Augmentation(quarter_turns=True)):
        windows(scene, augmentation)
    assert "no gravity is stored" not in caplog.text
    windows(scene, Augmentation(mirror=True))
    assert ("no gravity is stored, but nodes accelerate along y" in caplog.text) == (pull != 0)
    caplog.clear()
    windows(under(scene, gravity=(0.0, pull or -1.0, 0.0)), Augmentation(mirror=True))
    assert not caplog.text


@pytest.mark.parametrize("augmentation", [Augmentation(mirror=True), Augmentation(boost_speed=1.0)])
def test_images_without_a_level_axis_are_named(truth: Trajectory, caplog: pytest.LogCaptureFixture, augmentation: Augmentation) -> None:
    windows(under(truth, gravity=(0.0, -9.81, 0.0)), augmentation)
    assert not caplog.text
    windows(under(truth, gravity=(1.0, -9.0, 2.0)), augmentation)
    assert "they change no window, as no axis is level" in caplog.text


def test_scenes_without_the_symmetry_are_refused(truth: Trajectory) -> None:
    with pytest.raises(AugmentationError, match=r"training.rotate=true: needs scenes in 3D"):
        Augmentation(rotate=True).check(under(truth, gravity=(1.0, 0.0, -9.0)))
    with pytest.raises(AugmentationError, match=r"not in periodic domains"):
        Augmentation(boost_speed=1.0).check(under(truth, periodic=(True, False, False)))
    Augmentation(mirror=True).check(under(truth, periodic=(True, False, False)))
    with pytest.raises(ValueError, match=r"not together with targets=solver"):
        TrainingSettings(num_steps=10, val_interval=10, rotate=True, targets="solver")
