"""Targets of the solver: without a deviation those of the data; with one, where the solver goes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset
from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.dataset import StartKey, StoredTrajectory, WindowDataset
from gpe_pl.data.ground_truth import generate_trajectory
from gpe_pl.data.noise import Noise
from gpe_pl.data.training_samples import UnrollStart
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.rollout.loop import Restartable
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.mpm.restart import gradients
from gpe_pl.trajectory.trajectory import Trajectory

HISTORY = 2
SCENE = ("size=tiny", "data.num_frames=12", "data.scene.max_speed=4")
BODIES = ("data.scene.drop_height=[0.001,0.002]",)
OVERRIDES = {"fem": (*BODIES, "data.scene.num_cells=60"), "elastomer": BODIES, "fluid": ()}


def truth_of(data: str) -> tuple[Restartable, Trajectory]:
    spec = dataset(f"data={data}", *SCENE, *OVERRIDES[data])
    assert isinstance(spec.solver, Restartable)
    return spec.solver, generate_trajectory(spec, split="train", index=0)


@pytest.fixture(scope="module")
def fem() -> tuple[Restartable, Trajectory]:
    return truth_of("fem")


def windows(solver: Restartable | None, truth: Trajectory, noise: Noise | None = None, mirror: bool = False) -> WindowDataset:
    stored = StoredTrajectory(Path("shard"), "0", truth.num_frames, truth.num_nodes, truth)
    builder = GraphBuilder(GraphConfig(history=HISTORY, mesh=True), truth.metadata)
    return WindowDataset(
        [stored], builder, noise, 0.05, seed=3, stress=truth.stress is not None, solver=solver, augmentation=Augmentation(mirror)
    )


def start_of(solver: Restartable | None, truth: Trajectory, num_steps: int = 3) -> tuple[WindowDataset, UnrollStart]:
    data = windows(solver, truth)
    return data, data[StartKey(0, 4, num_steps)]


@pytest.mark.parametrize("step", [0, 2])
@pytest.mark.parametrize("data", ["fem", *(pytest.param(name, marks=pytest.mark.slow) for name in ("elastomer", "fluid"))])
def test_the_true_state_has_the_target_of_the_data(data: str, step: int) -> None:
    solver, truth = truth_of(data)
    windows, start = start_of(solver, truth)
    assert start.solver_targets is not None
    plain, before = replace(start, solver_targets=None), torch.from_numpy(start.solver_targets.pos[step])
    state = replace(start.state, pos=start.truth[step], vel=(start.truth[step] - before) / truth.metadata.frame_dt, frame_velocity=None)
    here, there = (s.graph(windows.builder, state, step) for s in (start, plain))
    material = truth.metadata.materials[0]
    torch.testing.assert_close(here[material].target, there[material].target, rtol=1e-9, atol=1e-6)
    assert float(here[material].target.abs().max()) > 0.1
    if data == "fem":
        torch.testing.assert_close(here[material].stress_target, there[material].stress_target, rtol=1e-6, atol=1e-3)


def test_the_target_of_another_state_leads_where_the_solver_goes(fem: tuple[Restartable, Trajectory]) -> None:
    """A strain of 3 % at one moment: the body answers by restoring forces, about which the target that leads back knows nothing."""
    solver, truth = fem
    dt, first = truth.metadata.frame_dt, 4 + HISTORY
    windows, start = start_of(solver, truth)
    true = truth.state(first)
    centre = true.pos.mean(axis=0)
    pos = centre + (true.pos - centre) * [1.03, 1.0]
    graph = start.graph(windows.builder, replace(start.state, pos=torch.from_numpy(pos)), 0)
    vel = start.state.vel.numpy() + (graph["solid"].target.numpy() + start.state.gravity.numpy()) * dt
    expected = solver.step(replace(true, pos=pos, stress=None))
    np.testing.assert_allclose(pos + vel * dt, expected.pos, atol=2e-6 * truth.metadata.spacing)
    assert expected.stress is not None
    assert graph["solid"].stress_target.numpy() == pytest.approx(expected.stress.node, rel=1e-3, abs=10.0)
    plain = replace(start, solver_targets=None).graph(windows.builder, replace(start.state, pos=torch.from_numpy(pos)), 0)
    back = np.sum((graph["solid"].target - plain["solid"].target).numpy() * (pos - true.pos))
    assert back < 0  # towards the shape at rest


def test_noisy_windows_have_the_targets_of_the_solver(fem: tuple[Restartable, Trajectory]) -> None:
    solver, truth = fem
    noise = Noise(velocity_of_change=0.3)
    with_solver, without, clean = (
        windows(s, truth, n)[4] for s, n in ((solver, noise), (None, noise), (solver, Noise(velocity_of_change=0.0)))
    )
    assert torch.equal(with_solver["solid"].x, without["solid"].x)
    assert not torch.allclose(with_solver["solid"].target, without["solid"].target, rtol=0.1)
    assert torch.equal(clean["solid"].target, windows(None, truth)[4]["solid"].target)  # without noise the data are the target


def test_a_state_that_the_solver_refuses_keeps_the_usual_target(fem: tuple[Restartable, Trajectory]) -> None:
    solver, truth = fem
    windows, start = start_of(solver, truth)
    state = replace(start.state, pos=start.state.pos + 5.0)  # outside the domain
    graph, plain = (s.graph(windows.builder, state, 0) for s in (start, replace(start, solver_targets=None)))
    assert torch.equal(graph["solid"].target, plain["solid"].target)


def test_gradients_of_linear_fields_are_exact_and_loose_nodes_take_the_nearest() -> None:
    count = 5
    lattice = np.stack(np.meshgrid(*[np.arange(count, dtype=float)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = np.array([i * count + j for i in range(count - 1) for j in range(count - 1)])
    cells = corner[:, None] + [0, count, count + 1, 1]
    at, matrix = np.concatenate([lattice, [[-1.0, 0.2]]]), np.array([[1.1, 0.3], [-0.2, 0.9]])
    np.testing.assert_allclose(gradients(at @ matrix.T, at, cells), np.tile(matrix, (len(at), 1, 1)), atol=1e-12)
    bent = at**2
    assert np.array_equal(gradients(bent, at, cells)[-1], gradients(bent, at, cells)[0])


def test_elastomers_continue_from_positions_nearly_as_if_undisturbed() -> None:
    """A stretched block: its restart moves as the continued run does, and a restart without deformation would not."""
    solver, truth = truth_of("elastomer")
    assert isinstance(solver, MPM)
    state = truth.state(0)
    for _ in range(8):
        state = solver.step(state)
    after, again = solver.step(state), solver.step(solver.restarted(replace(state, internal=None)))
    asleep = solver.step(replace(state, internal=None, time=0.0, cells=None, rest_pos=None))

    def distance(other: np.ndarray) -> float:
        return float(np.sqrt(np.mean((other - after.pos) ** 2)))

    assert distance(again.pos) < 0.3 * distance(asleep.pos)


@pytest.mark.parametrize("overrides", [["data=sand"], ["data=mixed"]])
def test_materials_with_memory_cannot_restart(overrides: list[str]) -> None:
    solver = dataset(*overrides, "size=tiny").solver
    assert isinstance(solver, MPM)
    assert not solver.can_restart


def test_mirrored_windows_are_images_with_the_images_of_all_targets(fem: tuple[Restartable, Trajectory]) -> None:
    """About half of the windows are mirrored; positions, velocities, targets and stresses of these are images, also of unrolls."""
    solver, truth = fem
    plain, mirrored = (windows(solver, truth, mirror=mirror) for mirror in (False, True))
    flipped = 0
    for sample in range(12):
        key = StartKey(sample, 4, 2)
        one, other = plain[key], mirrored[key]
        if torch.equal(one.state.pos, other.state.pos):
            continue
        flipped += 1
        sign = torch.tensor([-1.0, 1.0], dtype=torch.float64)
        pos = one.state.pos * torch.tensor([1.02, 1.0])
        deviating = (replace(one.state, pos=pos), replace(other.state, pos=pos * sign + torch.tensor([1.0, 0.0])))
        torch.testing.assert_close(other.state.pos, one.state.pos * sign + torch.tensor([1.0, 0.0]), rtol=0, atol=1e-6)
        here, there = (s.graph(plain.builder, state, 1) for s, state in zip((one, other), deviating, strict=True))
        torch.testing.assert_close(there["solid"].target, here["solid"].target * sign.float(), rtol=1e-4, atol=0.2)
        stress = here["solid"].stress_target * torch.tensor([1.0, -1.0, 1.0, 1.0])
        torch.testing.assert_close(there["solid"].stress_target, stress, rtol=1e-3, atol=30.0)
        assert float(stress[:, 1].abs().max()) > 1e3
    assert 2 <= flipped <= 10
