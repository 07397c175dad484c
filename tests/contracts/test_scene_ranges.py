"""A checkpoint stores the ranges of gravity and boundary nodes of its training, and a scene outside them gives one warning per kind."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.data.augmentation import Augmentation, turned_with_gravity
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.importers.source import joined
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.files import sealed
from gpe_pl.geometry.periodicity import NOWHERE
from gpe_pl.geometry.shapes import Sphere, domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.pretrained import names
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import STICKY
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.scene_ranges import described, outside, scene_range, united
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes

GRAVITY = (0.0, -9.81)
WALLS = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3)


def boundary(friction: float = 0.3, restitution: float = 0.0, spacing: float = scenes.SPACING) -> Boundary:
    b = Boundary.sample(WALLS, spacing, 2)
    return replace(b, friction=np.full(len(b.pos), friction), restitution=np.full(len(b.pos), restitution))


def sliding(speed: float, frames: int = 4) -> Boundary:
    """Return walls that are at rest at first and then slide along themselves."""
    b = boundary()
    vel = np.zeros((frames, *b.pos.shape))
    vel[2, :, 0] = speed
    return replace(b, motion=BoundaryMotion(np.stack([b.pos] * frames), vel, np.stack([b.normal] * frames)))


def ranges(*scenes_: tuple[tuple[float, float], Boundary]) -> np.ndarray:
    return united(scene_range(np.array(gravity), b, NOWHERE) for gravity, b in scenes_)


def trained(*scenes_: tuple[tuple[float, float], Boundary]) -> LearnedSimulator:
    build = scenes.builder()
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=4), build).eval()
    graph = build(scenes.state(20).to_torch())
    graph["sand"].target = torch.ones(20, 2)
    simulator.fit_statistics([graph], {"sand": torch.tensor([[0.0], [90.0]])}, ranges(*scenes_) if scenes_ else None)
    return simulator


def scene(gravity: tuple[float, float] = GRAVITY, b: Boundary | None = None, mass: float = 1.0) -> State:
    """Return a scene whose masses are ``mass`` times those of training."""
    plain = scenes.state(20)
    return replace(plain, mass=mass * plain.mass, gravity=np.array(gravity), boundary=boundary() if b is None else b).to_torch()


ONE = (GRAVITY, boundary())
SEVERAL = (
    (GRAVITY, boundary(0.1, 0.2)),
    ((0.0, -4.905), boundary(0.6, 0.5)),
    ((1.0, -9.81), sliding(2.0)),
)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda: scene((9.81, 0.0)), "gravity is (9.81, 0) m/s², in training it was (0, -9.81) m/s²"),
        (lambda: scene((0.0, -1.62)), "gravity is (0, -1.62) m/s², in training it was (0, -9.81) m/s²"),
        (lambda: scene((0.0, 0.0)), "gravity is (0, 0) m/s², in training it was (0, -9.81) m/s²"),
        (lambda: scene(b=boundary(0.8)), "friction of boundary nodes is 0.8, in training it was 0.3"),
        (lambda: scene(b=boundary(STICKY)), "friction of boundary nodes is 1e+06, in training it was 0.3"),
        (lambda: scene(b=boundary(restitution=0.5)), "restitution of boundary nodes is 0.5, in training it was 0"),
        (lambda: scene(b=sliding(-1.5)), "speed of boundary nodes is 1.5 m/s, in training it was 0 m/s"),
        (lambda: scene(b=boundary(spacing=0.1)), "spacing of boundary nodes is 0.1 m, in training it was 0.05 m"),
    ],
)
def test_what_training_had_constant_and_a_scene_changes_is_warned_of(
    change: Callable[[], State], line: str, caplog: pytest.LogCaptureFixture
) -> None:
    simulator = trained(ONE)
    assert simulator.untrained_scene(scene()) == []
    state = change()
    assert simulator.untrained_scene(state) == [line]
    for _ in range(3):
        simulator.standing(state, simulator.builder.metadata)
    assert [r.getMessage() for r in caplog.records] == [f"outside the training data: {line}"]


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_nodes_of_other_masses_are_warned_of(factor: float, caplog: pytest.LogCaptureFixture) -> None:
    simulator, masses = trained(ONE), scenes.state(20).mass
    known = f"{masses.min():g} to {masses.max():g} kg"
    assert dict(simulator.described_training())["mass of nodes of sand"] == known
    for near in (0.6, 1.9):
        assert simulator.untrained_scene(scene(mass=near)) == []
    state = scene(mass=factor)
    line = f"mass of nodes of sand is {state.mass[0].item():g} kg, in training it was {known}"
    assert simulator.untrained_scene(state) == [line]
    simulator.standing(state, simulator.builder.metadata)
    assert [r.getMessage() for r in caplog.records] == [f"outside the training data: {line}"]


def test_an_obstacle_with_wider_gaps_than_the_walls_is_warned_of() -> None:
    """The obstacle has few of many nodes, so the typical spacing stays that of training. Nodes left out where shapes meet make no gap."""
    simulator, space = trained(ONE), scenes.SPACING
    ball = Sphere((0.5, 0.4), 0.15, 0.3)
    whole = Boundary.sample((*WALLS, ball), space, 2)
    whole = replace(whole, friction=np.full(len(whole.pos), 0.3), restitution=np.zeros(len(whole.pos)))
    assert simulator.untrained_scene(scene(b=whole)) == []
    coarse, walls = Boundary.sample((ball,), 2.5 * space, 2), boundary()
    assert 10 * len(coarse.pos) < len(walls.pos)
    both = joined(2, walls, coarse)
    (line,) = simulator.untrained_scene(scene(b=both))
    assert re.fullmatch(r"spacing of boundary nodes is 0\.1\d* m, in training it was 0\.05 m", line)


def test_other_values_of_a_kind_that_was_warned_of_add_no_line(caplog: pytest.LogCaptureFixture) -> None:
    simulator = trained(ONE)
    for gravity in ((9.81, 0.0), (0.0, 9.81), (0.0, 0.0)):
        simulator.standing(scene(gravity, boundary(0.9)), simulator.builder.metadata)
    assert len(caplog.records) == 2


def test_between_trained_values_nothing_is_warned_of() -> None:
    simulator = trained(*SEVERAL)
    for state in (scene((0.5, -7.0)), scene(b=boundary(0.4, 0.3)), scene(b=sliding(1.0)), scene(b=Boundary.empty(2))):
        assert simulator.untrained_scene(state) == []
    for state in (scene((1.5, -7.0)), scene(b=boundary(0.05, 0.3)), scene(b=sliding(2.5))):
        assert len(simulator.untrained_scene(state)) == 1


def test_walls_where_training_had_none_are_one_line() -> None:
    simulator = trained((GRAVITY, Boundary.empty(2)))
    assert simulator.untrained_scene(scene(b=Boundary.empty(2))) == []
    assert simulator.untrained_scene(scene()) == ["the scene has boundary nodes, training had none"]
    assert dict(described(simulator.trained_scene.numpy()))["friction of boundary nodes"] == "none"


def test_rounding_is_no_other_value() -> None:
    simulator = trained((GRAVITY, boundary(0.3, 0.1)))
    b = boundary(0.3, 0.1)
    rounded = replace(b, friction=b.friction.astype(np.float32), restitution=b.restitution.astype(np.float32), vel=b.vel + 1e-7)
    assert simulator.untrained_scene(scene((0.0, float(np.float32(-9.81))), rounded)) == []


def test_an_untrained_simulator_knows_of_no_range() -> None:
    assert trained().untrained_scene(scene((5.0, 5.0), boundary(0.9, 0.9))) == []


def test_the_range_travels_in_the_checkpoint(tmp_path: Path) -> None:
    simulator = trained(ONE)
    simulator.save(tmp_path / "a.ckpt")
    again = LearnedSimulator.from_checkpoint(tmp_path / "a.ckpt")
    assert torch.equal(again.trained_scene, simulator.trained_scene)
    assert again.untrained_scene(scene((9.81, 0.0))) == simulator.untrained_scene(scene((9.81, 0.0))) != []
    assert torch.equal(again.trained_mass, simulator.trained_mass)
    assert again.untrained_scene(scene(mass=10.0)) == simulator.untrained_scene(scene(mass=10.0)) != []
    simulator.trained_scene[0, 1] = 3.0
    simulator.save(tmp_path / "b.ckpt")
    with pytest.raises(CheckpointError, match="the lowest value of trained_scene is above the highest"):
        LearnedSimulator.from_checkpoint(tmp_path / "b.ckpt")


def test_a_checkpoint_without_the_range_of_masses_warns_of_none(tmp_path: Path) -> None:
    simulator = trained(ONE)
    simulator.save(tmp_path / "a.ckpt")
    content = torch.load(tmp_path / "a.ckpt", weights_only=True)
    del content["state_dict"]["simulator.trained_mass"]
    torch.save(content, tmp_path / "a.ckpt")
    again = LearnedSimulator.from_checkpoint(tmp_path / "a.ckpt")
    assert again.untrained_scene(scene(mass=10.0)) == []
    assert "mass of nodes of sand" not in dict(again.described_training())


def test_what_begins_with_other_weights_knows_both_ranges() -> None:
    first, second = trained(ONE), trained(((0.0, -4.0), boundary(0.5)))
    second.start_from(first)
    np.testing.assert_array_equal(second.trained_scene.numpy(), ranges(ONE, ((0.0, -4.0), boundary(0.5))))


def test_the_range_is_that_of_all_training_trajectories(store: Path) -> None:
    shard = next((store / "train").glob("*.h5"))
    held = [read_trajectory(shard, name) for name in trajectory_names(shard)]
    count, frames = len(held[0].boundary.pos), held[0].num_frames
    still = replace(held[0].boundary, restitution=np.full(count, 0.25, np.float32))
    way = BoundaryMotion(np.stack([still.pos] * frames), np.zeros((frames, count, 2), np.float32), np.stack([still.normal] * frames))
    way.vel[-1, :, 0] = 3.0
    pos = (held[0].pos[:1] + 1e-3 * np.sin(np.arange(frames))[:, None, None]).astype(np.float32)
    calm = replace(held[0], pos=pos)
    shard.unlink()
    write_shard(shard, [calm, replace(calm, boundary=still), replace(calm, boundary=replace(still, motion=way).at(0))])
    sealed.write(store / "statistics.json", {"acceleration_std": 50.0, "data_sha256": split_checksum(store, "train")})
    module = TrajectoryDataModule(store, GraphConfig(history=2), Noise(0.0, 0.5), batch_size=BatchSize(2), seed=1)
    low, high = module.trained_scene()
    assert (low[:2] == high[:2]).all() and tuple(low[:2]) == calm.metadata.gravity
    assert (low[3], high[3]) == (0.0, 0.25)
    assert (low[4], high[4]) == (0.0, 3.0)
    turned = TrajectoryDataModule(
        store, GraphConfig(history=2), Noise(0.0, 0.5), BatchSize(2), seed=1, augmentation=Augmentation(quarter_turns=True)
    )
    low, high = turned.trained_scene()
    down = max(map(abs, calm.metadata.gravity))
    np.testing.assert_allclose([low[:2], high[:2]], [[-down, -down], [down, down]])
    image = turned_with_gravity(calm, 1)
    scene = scene_range(np.asarray(image.metadata.gravity), image.boundary, image.metadata.periodicity)
    assert not [*outside(np.stack([low, high]), scene, 1.0)]
    boosted = TrajectoryDataModule(
        store, GraphConfig(history=2), Noise(0.0, 0.5), BatchSize(2), seed=1, augmentation=Augmentation(boost_speed=5.0)
    )
    assert boosted.trained_scene()[:, 4].tolist() == [0.0, 8.0]  # the wall that moved along x already


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_shipped_models_know_their_gravity(name: str) -> None:
    simulator = LearnedSimulator.from_checkpoint(name)
    metadata = simulator.builder.metadata
    low, high = simulator.trained_scene.numpy()
    assert tuple(low[: metadata.dim]) == tuple(high[: metadata.dim]) == metadata.gravity
    assert np.isfinite(simulator.trained_scene).all()


def test_another_version_of_the_solver_is_warned_of(new_trajectory: Callable[..., Trajectory], caplog: pytest.LogCaptureFixture) -> None:
    for version in ("1", "2"):  # in this order: the model's own version has nothing to warn of
        trajectory = new_trajectory(solver_version=version)
        build = GraphBuilder(GraphConfig(history=2), new_trajectory().metadata)
        simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=4), build)
        for frame in (3, 4):
            simulator.initial_state(trajectory, frame)
    (line,) = [r.getMessage() for r in caplog.records if "solver" in r.getMessage()]
    assert line.startswith("outside the training data: the ground truth is from version 2 of the solver random, in training version 1")
