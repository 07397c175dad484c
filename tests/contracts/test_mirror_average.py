"""Averaging over mirror images makes rollouts mirror-symmetric, and is the plain mean of the steps of the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset
from gpe_pl.data.dataset import StoredTrajectory, WindowDataset
from gpe_pl.data.ground_truth import generate_trajectory
from gpe_pl.data.noise import Noise
from gpe_pl.evaluation.mirror_check import mirror_equivariance_error
from gpe_pl.export.program import MirrorAverageError, export_model
from gpe_pl.geometry.shapes import DistanceGrid, Sphere, domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.checkpoint_file import CheckpointError
from gpe_pl.learned.mirror_average import MirrorAverage
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import SimulationError, Simulator, steps
from gpe_pl.rollout.mirrored import Mirrored
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests import elastic, scenes
from tests.runs import compose

START, STEPS = 60, 8  # bodies touch the ground by then
DISC = Sphere((0.5, 0.2), 0.1, 0.3)


@pytest.fixture(scope="module", params=["sand", pytest.param("fluid", marks=pytest.mark.slow), "fem"])
def scene(request: pytest.FixtureRequest) -> tuple[LearnedSimulator, Trajectory]:
    overrides = (f"data={request.param}", "size=tiny")
    trajectory = generate_trajectory(dataset(*overrides), "train", 0, num_frames=START + STEPS + 1)
    cfg = compose("fit", "model=gpe_tuned", *overrides)
    builder = GraphBuilder(GraphConfig(**cfg.graph), trajectory.metadata)
    torch.manual_seed(0)
    model = GPE(builder.spec, **{key: value for key, value in cfg.model.items() if key != "_target_"})
    learned = LearnedSimulator(model, builder)
    stored = StoredTrajectory(Path("a"), "0", trajectory.num_frames, trajectory.num_nodes, trajectory)
    windows = WindowDataset([stored], builder, Noise(0.0, 0.0, 0.0), 1.0, 0, bool(cfg.model.get("stress")))
    learned.fit_statistics([windows[k] for k in range(0, len(windows), 4)])
    for name, parameter in model.named_parameters():
        if not parameter.any() and "elastic" not in name:  # decoders begin at zero
            torch.nn.init.normal_(parameter, std=0.02)
    return learned.eval(), trajectory


def averaged(learned: LearnedSimulator) -> LearnedSimulator:
    return learned.configured(mirror_average=True)


@pytest.mark.slow
def test_mirror_images_move_alike(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    plain, mean = (mirror_equivariance_error(s, trajectory, START) for s in (learned, averaged(learned)))
    assert mean <= 1e-3 * plain  # solids in free flight have no error at all


def test_a_step_is_the_mean_of_the_steps_of_all_images(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    metadata = trajectory.metadata
    state = learned.initial_state(trajectory, START)
    middle = [sum(bounds) / 2 for bounds in metadata.bounds]
    images: list[Simulator] = [learned, Mirrored(learned, 0, middle[0])]
    if metadata.dim == 3:
        images += [Mirrored(image, 1, middle[1]) for image in images]
    after = [image.step(state) for image in images]
    mean = averaged(learned).step(state)
    for name in ("pos", "vel", "velocity_history", "frame_velocity"):
        values = [getattr(s, name) for s in after]
        if values[0] is None:
            assert getattr(mean, name) is None
        else:
            torch.testing.assert_close(getattr(mean, name), torch.stack(values).mean(dim=0), rtol=1e-6, atol=1e-6 * metadata.spacing)
    if mean.stress is not None:
        expected = torch.stack([s.stress.cell for s in after if s.stress is not None]).mean(dim=0)
        torch.testing.assert_close(mean.stress.cell, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


def test_scenes_together_move_as_alone(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    mean = averaged(learned)
    first, second = (mean.initial_state(trajectory, frame) for frame in (START, START + 2))
    together = mean.step_all([first, second])
    for alone, state in zip((mean.step(first), mean.step(second)), together, strict=True):
        assert not isinstance(state, SimulationError)
        torch.testing.assert_close(state.pos, alone.pos, rtol=0.0, atol=1e-6 * trajectory.metadata.spacing)


def test_gravity_along_every_axis_leaves_nothing_to_average(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    mean, state = averaged(learned), learned.initial_state(trajectory, START)
    mean.step(state)  # has images of the boundary, which the next state shares
    tilted = replace(state, gravity=torch.full_like(state.gravity, -1.0))
    assert torch.equal(mean.step(tilted).pos, learned.step(tilted).pos)


def test_without_gravity_no_image_has_its_floor_above(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    state = learned.initial_state(trajectory, START)
    floor = state.boundary.take(torch.nonzero(state.boundary.normal[:, 1] > 0.9)[:, 0])
    seen: list[State] = []

    def recorded(states: list[State]) -> list[State | SimulationError]:
        seen.extend(states)
        return list(states)

    MirrorAverage(trajectory.metadata.bounds, trajectory.metadata.frame_dt).next_states(
        recorded, [replace(state, gravity=torch.zeros_like(state.gravity), boundary=floor)]
    )
    assert len(seen) == 2 ** (state.dim - 1)
    assert len(floor.pos) > 0 and all((image.boundary.normal[:, 1] > 0.9).all() for image in seen)


@pytest.mark.slow
def test_checkpoints_store_it(scene: tuple[LearnedSimulator, Trajectory], tmp_path: Path) -> None:
    learned = scene[0]
    averaged(learned).save(tmp_path / "model.ckpt")
    assert LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt").mirror_average
    checkpoint = torch.load(tmp_path / "model.ckpt", weights_only=True)
    checkpoint["simulator"]["mirror_average"] = 2
    torch.save(checkpoint, tmp_path / "bad.ckpt")
    with pytest.raises(CheckpointError, match="mirror_average=2: must be true or false"):
        LearnedSimulator.from_checkpoint(tmp_path / "bad.ckpt")
    del checkpoint["simulator"]["mirror_average"]  # as before it existed
    torch.save(checkpoint, tmp_path / "old.ckpt")
    assert not LearnedSimulator.from_checkpoint(tmp_path / "old.ckpt").mirror_average


def test_programs_refuse_it(scene: tuple[LearnedSimulator, Trajectory], tmp_path: Path) -> None:
    with pytest.raises(MirrorAverageError, match="evaluation.mirror_average=false"):
        export_model(averaged(scene[0]), tmp_path / "model.pt2")


def test_averaged_nodes_stay_in_a_periodic_domain() -> None:
    bounds = ((0.0, 0.5), (0.0, 1.0))
    space = replace(scenes.metadata(), bounds=bounds, periodic=(True, False))
    builder = GraphBuilder(GraphConfig(history=1), space)
    torch.manual_seed(0)
    simulator = averaged(LearnedSimulator(GPE(builder.spec, num_message_passing_steps=2, hidden_channels=8), builder).eval())
    for parameter in simulator.model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    simulator.acceleration_std.fill_(400.0)
    state = scenes.state(40)
    pos = np.random.default_rng(0).uniform((0.49, 0.0), (0.5, 1.0), (40, 2))  # beside the seam
    state = replace(state, pos=pos, vel=0.0 * state.vel, velocity_history=0.0 * state.vel[:, None], boundary=Boundary.empty(2))
    state = replace(state, periodicity=space.periodicity).to_torch()
    x = simulator.step(state).pos[:, 0]
    assert float(simulator.configured(mirror_average=False).step(state).pos[:, 0].min()) < 0.1  # some have crossed it
    assert bool(((x >= 0) & (x < 0.5)).all())


def test_the_boundary_may_change_between_steps(scene: tuple[LearnedSimulator, Trajectory]) -> None:
    learned, trajectory = scene
    mean = averaged(learned)
    state = mean.initial_state(trajectory, START)
    without = replace(state, boundary=replace(state.boundary, pos=state.boundary.pos + 100.0, shapes=()))
    for begin in (state, without, state):
        *_, once = steps(mean, begin, 2)
        *_, again = steps(averaged(learned), begin, 2)
        assert torch.equal(once.pos, again.pos)


class Unmirrored:
    """An obstacle of a class for which no mirror image is known."""

    kind, friction, restitution, extent = "unmirrored", 0.3, 0.0, 0.1

    def signed_distance(self, points: Any) -> Any:
        return DISC.signed_distance(points)

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        return DISC.sample(spacing)


def falling_on(obstacle: Any) -> tuple[State, np.ndarray]:
    """Return a symmetric lattice that falls on an obstacle in the middle of the domain, and the row of the mirror image of each node."""
    number, h = np.arange(28).reshape(7, 4), scenes.SPACING
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    rest = h * np.argwhere(number >= 0) + np.array([0.5 - 3 * h, 0.31])
    vel = np.tile([0.0, -2.0], (28, 1))
    state = scenes.mesh_state("lattice", elastic.BODIES, 1, seed=0)
    state = replace(
        state,
        pos=rest,
        vel=vel,
        velocity_history=vel[:, None],
        node_type=np.full(28, node_code(elastic.BODIES[0]), np.uint8),
        mass=np.ones(28),
        material_params=np.full((28, 1), 20.0),
        rest_pos=rest.copy(),
        cells=cells,
        boundary=Boundary.sample((*domain_walls(((0.0, 1.0),) * 2, 0.3), obstacle), h, 2),
    )
    return state.to_torch(), number[::-1].reshape(-1)


@pytest.mark.parametrize("as_grid", [False, True])
def test_the_elastic_law_sees_the_images_of_obstacles(as_grid: bool) -> None:
    nodes = np.stack(np.meshgrid(*2 * [0.02 * np.arange(51)], indexing="ij"), axis=-1)
    grid = DistanceGrid.from_values((0.0, 0.0), 0.02, DISC.signed_distance(nodes), 0.3)
    state, image = falling_on(grid if as_grid else DISC)
    simulator = elastic.simulator(network=0.0, wall_layer=1.0)
    for _ in range(6):
        state = averaged(simulator).step(state)
    mirrored = state.pos[image] * torch.tensor([-1.0, 1.0]) + torch.tensor([1.0, 0.0])
    assert float((state.vel[:, 1] + 2.0).abs().max()) > 0.5  # it has met the obstacle
    assert float((state.pos - mirrored).abs().max()) < 1e-5 * scenes.SPACING


def test_a_shape_without_an_image_is_refused_for_the_elastic_law() -> None:
    state, _ = falling_on(Unmirrored())
    simulator = averaged(elastic.simulator())
    with pytest.raises(SimulationError, match="mirror_average: shapes of the kind unmirrored have no mirror image"):
        simulator.step(state)
    known, _ = falling_on(DISC)
    refused, moved = simulator.step_all([state, known])
    assert isinstance(refused, SimulationError) and isinstance(moved, State)
