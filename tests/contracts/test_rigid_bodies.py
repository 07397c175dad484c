"""Rigid bodies keep their shape in the store, in rollouts of models and baselines, and in containment; plain and compiled steps agree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist

from gpe_pl.evaluation.rollouts import evaluate
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.export.play_scene import state_for_page
from gpe_pl.export.program import RigidBodyError, scene_of
from gpe_pl.geometry.shapes import domain_walls, signed_distance, surface_tolerance
from gpe_pl.metrics.rollouts import rollout_metrics
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.containment import Contained, contain
from gpe_pl.rollout.loop import rollout
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import iter_trajectories, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.contracts.test_learned_simulator import builder_of, learned

BOUNDS = ((0.0, 1.0), (0.0, 1.0))
SPACING, DT = 0.05, 0.01
CELLS = np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)


def falling(dim: int = 2, num_frames: int = 12) -> Trajectory:
    """Return two rigid blocks and some grains that fall; the second block spins."""
    bounds = BOUNDS if dim == 2 else (*BOUNDS, (0.0, 1.0))
    block = SPACING * (CELLS - 1.5)
    time = DT * np.arange(num_frames)
    turn = np.stack([np.stack([np.cos(3 * time), -np.sin(3 * time)]), np.stack([np.sin(3 * time), np.cos(3 * time)])])
    grains = np.stack([np.linspace(0.1, 0.9, 9), np.full(9, 0.15)], axis=1)
    still = np.concatenate([block + np.array([0.3, 0.4]), grains])
    pos = np.concatenate([np.repeat(still[None], num_frames, axis=0), np.einsum("ijf,nj->fni", turn, block) + np.array([0.7, 0.4])], axis=1)
    pos[..., 1] -= 0.5 * 9.81 * time[:, None] ** 2
    if dim == 3:
        pos = np.concatenate([pos, np.broadcast_to(np.linspace(0.4, 0.6, pos.shape[1])[:, None], (*pos.shape[:2], 1))], axis=2)
    walls = Boundary.sample(domain_walls(bounds, 0.5), SPACING, dim)
    body = np.repeat([0, -1, 1], [16, 9, 16])
    kinds = ["solid" if b >= 0 else "sand" for b in body]
    about: dict[str, Any] = {
        "gravity": (0.0, -9.81, 0.0)[:dim],
        "bounds": bounds,
        "boundary": walls,
        "spacing": SPACING,
        "connectivity_radius": 0.117,
    }
    return Trajectory.from_numpy(pos, DT, kinds, {"solid": 1e6, "sand": 30.0}, rigid_body=body, **about)


def distances(trajectory: Trajectory) -> list[np.ndarray]:
    assert trajectory.rigid_body is not None
    return [np.stack([pdist(frame) for frame in trajectory.pos[:, trajectory.rigid_body == body]]) for body in (0, 1)]


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "friction"), [(2, 0.3), (3, 0.0)])
def test_a_contained_rollout_keeps_distances_and_both_paths_agree(dim: int, friction: float) -> None:
    truth = falling(dim)
    simulator = learned(builder_of(truth, islands=True), decoder="pair", interaction="odd").double()
    simulator.acceleration_std.fill_(300.0)
    simulator.static_friction = friction
    start = simulator.initial_state(truth, 2)
    predicted = rollout(Contained(simulator, DT), start, 40, truth.metadata)
    assert predicted.termination is None
    for found in distances(predicted):
        assert np.abs(found - found[0]).max() < 1e-9 * found[0].max()
    assert np.ptp(predicted.pos[:, :16], axis=0).max() > SPACING
    assert signed_distance(truth.boundary.shapes, predicted.pos[-1]).min() >= -surface_tolerance(truth.boundary.shapes)
    with unfused():
        plain = rollout(Contained(simulator, DT), start, 3, truth.metadata)
    np.testing.assert_allclose(plain.pos, predicted.pos[:4], atol=1e-9)


def test_the_step_has_the_momentum_of_the_predicted_accelerations() -> None:
    truth = falling()
    simulator = learned(builder_of(truth)).double()
    simulator.acceleration_std.fill_(300.0)
    start = simulator.initial_state(truth, 2)
    rigid, free = simulator.step(start), simulator.step(replace(start, rigid_body=None))
    for rows in (slice(0, 16), slice(25, 41)):
        arm = start.pos[rows] - start.pos[rows].mean(dim=0)
        assert torch.allclose(rigid.vel[rows].sum(dim=0), free.vel[rows].sum(dim=0), rtol=1e-10)
        own, wanted = ((arm[:, 0] * s.vel[rows, 1] - arm[:, 1] * s.vel[rows, 0]).sum() for s in (rigid, free))
        assert torch.allclose(own, wanted, rtol=1e-9)
        assert not torch.allclose(rigid.vel[rows], free.vel[rows], rtol=1e-3)
    assert torch.equal(rigid.vel[16:25], free.vel[16:25])


@pytest.mark.parametrize("backend", ["numpy", "torch", "plain"])
def test_containment_moves_a_body_as_a_whole(backend: str) -> None:
    truth = falling()
    state = truth.state(3, history=2)
    state = state.corrected(state.pos - np.array([0.25, 0.35]), state.vel)
    state = state if backend == "numpy" else state.to_torch()
    if backend == "plain":
        with unfused():
            contained, moved = contain(state, DT)
    else:
        contained, moved = contain(state, DT)
    pos, before = np.asarray(contained.pos), np.asarray(state.pos)
    shapes = truth.boundary.shapes
    assert signed_distance(shapes, pos).min() >= -surface_tolerance(shapes)
    for rows in (slice(0, 16), slice(25, 41)):
        np.testing.assert_allclose(pdist(pos[rows]), pdist(before[rows]), rtol=1e-12)
    assert np.asarray(moved)[:16].all()
    np.testing.assert_allclose(contained.vel - state.vel, (contained.pos - state.pos) / DT, atol=1e-9)


def test_a_mirror_average_moves_bodies_rigidly() -> None:
    truth = falling()
    simulator = learned(builder_of(truth)).double()
    simulator.acceleration_std.fill_(3000.0)
    simulator.mirror_average = True
    predicted = rollout(simulator, simulator.initial_state(truth, 2), 8, truth.metadata)
    for found in distances(predicted):
        assert np.abs(found - found[0]).max() < 1e-9 * found[0].max()
    image = replace(truth, pos=np.concatenate([1 - truth.pos[..., :1], truth.pos[..., 1:]], axis=-1), vel=truth.vel * np.array([-1.0, 1.0]))
    other = rollout(simulator, simulator.initial_state(image, 2), 8, truth.metadata)
    np.testing.assert_allclose(1 - other.pos[..., 0], predicted.pos[..., 0], atol=1e-9)
    assert np.ptp(predicted.pos[:, :16], axis=0).max() > SPACING


def test_a_mirror_average_at_another_frame_interval_moves_bodies_by_their_velocities() -> None:
    truth = falling()
    simulator = learned(builder_of(truth, scales="dimensionless")).double().configured(mirror_average=True)
    slower = truth.every(2)
    start = simulator.on(slower.metadata).initial_state(slower, 2)
    after = simulator.on(slower.metadata).step(start)
    np.testing.assert_allclose((after.pos - start.pos)[:16], after.vel[:16] * slower.metadata.frame_dt, atol=1e-12)


def test_exported_programs_and_pages_refuse_rigid_bodies(tmp_path: Path) -> None:
    truth = falling()
    simulator = learned(builder_of(truth))
    start = simulator.initial_state(truth, 2)
    with pytest.raises(RigidBodyError, match="do not move rigid bodies as a whole, and this scene has 2"):
        scene_of(simulator, start)
    with pytest.raises(RigidBodyError):
        state_for_page(start, [0], truth.metadata.spacing)
    write_shard(tmp_path / "test" / "shard-00000.h5", [truth])
    with pytest.raises(RigidBodyError, match=r"leave model and page out of evaluation\.export"):
        evaluate(simulator, tmp_path, EvaluationSettings(["test"], num_pictures=0, export=["model"]), tmp_path / "run")
    assert not [*(tmp_path / "run").iterdir()]
    assert scene_of(simulator, replace(start, rigid_body=torch.full((41,), -1)))


def test_store_and_windows_keep_the_bodies(tmp_path: Path) -> None:
    truth = falling()
    write_shard(tmp_path / "train" / "shard-00000.h5", [truth])
    (stored,) = iter_trajectories(tmp_path, "train")
    assert truth.rigid_body is not None
    np.testing.assert_array_equal(stored.rigid_body, truth.rigid_body)
    np.testing.assert_array_equal(stored.frames(1, 5).every(2).state(1, history=1).rigid_body, truth.rigid_body)


def test_deformation_is_measured() -> None:
    truth = falling()
    spread = replace(truth, pos=truth.pos.copy())
    spread.pos[5, 15] += np.array([0.0, SPACING])
    values = {r.metric: r.value for r in rollout_metrics(spread, truth, ["full"])}
    assert 0.1 < values["rigid_deformation"] < 0.4
    exact = {r.metric: r.value for r in rollout_metrics(truth, truth, ["full"])}
    assert exact["rigid_deformation"] < 1e-6
    loose = replace(truth, rigid_body=None)
    assert "rigid_deformation" not in {r.metric for r in rollout_metrics(loose, loose, ["full"])}


def test_the_ballistic_baseline_lands_a_body_as_a_whole() -> None:
    truth = falling()
    predicted = rollout(Ballistic(DT), truth.state(1, 1), 60, truth.metadata)
    for found in distances(predicted):
        assert np.abs(found - found[0]).max() < 1e-9 * found[0].max()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (np.zeros(3, np.int64), r"rigid_body: is int64\[3\], expected integers \[node 41\]"),
        (np.zeros(41), r"rigid_body: is float64\[41\], expected integers"),
        (np.full(41, -2), "rigid_body: node 0 is -2, must be -1 or the number of a body"),
    ],
)
def test_wrong_bodies_are_refused(body: np.ndarray, message: str) -> None:
    truth = falling()
    with pytest.raises(ArrayError, match=message):
        Trajectory.from_numpy(truth.pos, DT, "sand", {"sand": 30.0}, rigid_body=body)
