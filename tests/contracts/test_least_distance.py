"""Liquid nodes of rollouts keep a least distance: gaps close, momentum stays, and nothing else moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.export.program import export_model
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.learned.checkpoint_file import CheckpointError
from gpe_pl.learned.least_distance import LeastDistanceError, checked, distance_in, kept_apart
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import node_code
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

DT, DISTANCE = 0.005, 0.04


def liquid(dim: int = 2, num_nodes: int = 24) -> State:
    return scenes.state(num_nodes, ("fluid",), history=2, dim=dim, high=0.45 if dim == 2 else 0.2).to_torch()


def nearest(state: State) -> np.ndarray:
    return nearest_distances(state.pos.detach().numpy(), state.periodicity)


@pytest.mark.parametrize("dim", [2, 3])
def test_gaps_close_and_momentum_stays(dim: int) -> None:
    state = liquid(dim)
    after = kept_apart(state, DISTANCE, DT)
    assert nearest(state).min() < 0.7 * DISTANCE
    assert nearest(after).min() > 0.8 * DISTANCE
    mass = state.mass[:, None]
    torch.testing.assert_close((mass * after.vel).sum(0), (mass * state.vel).sum(0), rtol=0, atol=1e-10)
    torch.testing.assert_close((mass * after.pos).sum(0), (mass * state.pos).sum(0), rtol=0, atol=1e-12)
    torch.testing.assert_close(after.vel - state.vel, (after.pos - state.pos) / DT)
    assert after.velocity_history is not None and torch.equal(after.velocity_history[:, -1], after.vel)


def test_a_pair_moves_apart_along_its_line_by_masses() -> None:
    state = liquid(num_nodes=2)
    pos, mass = torch.tensor([[0.3, 0.3], [0.33, 0.3]], dtype=torch.float64), torch.tensor([1.0, 3.0], dtype=torch.float64)
    after = kept_apart(replace(state, pos=pos, mass=mass), DISTANCE, DT)
    left = 0.01 * 0.7**10  # of the gap, after ten passes
    way = (0.01 - left) * torch.tensor([[-0.75, 0.0], [0.25, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(after.pos, pos + way, rtol=0, atol=1e-12)


def test_nodes_at_one_place_move_apart() -> None:
    state = liquid(num_nodes=2)
    state = state.corrected(state.pos[:1].repeat(2, 1), state.vel)
    apart = kept_apart(state, 0.5 * scenes.SPACING, 0.01).pos
    assert float((apart[0] - apart[1]).norm()) > 0.4 * scenes.SPACING
    weight = state.mass / state.mass.sum()
    torch.testing.assert_close(weight @ apart, weight @ state.pos)


def test_rigid_bodies_of_a_liquid_keep_their_shape() -> None:
    state = liquid()
    body = torch.where(torch.arange(len(state.pos)) < 12, 0, -1)
    after = kept_apart(replace(state, rigid_body=body), DISTANCE, DT)
    assert torch.equal(after.pos[:12], state.pos[:12])
    assert not torch.equal(after.pos[12:], state.pos[12:])


def test_nodes_beside_prescribed_ones_move_all_the_way() -> None:
    """A prescribed node stays, as if its mass were infinite; along its free axes, the masses count."""
    pos = torch.tensor([[0.3, 0.3], [0.33, 0.3]], dtype=torch.float64)
    left = 0.01 * 0.7**10  # of the gap, after ten passes
    for given, share in (([True, True], 1.0), ([True, False], 1.0), ([False, True], 0.25)):
        held = np.array([given, [False, False]])
        state = replace(liquid(num_nodes=2), mass=torch.tensor([1.0, 3.0], dtype=torch.float64), pos=pos)
        state = replace(state, loads=Loads(held, np.repeat(pos.numpy()[None, :1], 2, axis=0)))
        after = kept_apart(state, DISTANCE, DT)
        way = (0.01 - left) * torch.tensor([[share - 1, 0.0], [share, 0.0]], dtype=torch.float64)
        torch.testing.assert_close(after.pos, pos + way, rtol=0, atol=1e-12)
    both = replace(state, loads=Loads(np.ones((2, 2), bool), np.repeat(pos.numpy()[None], 2, axis=0)))
    assert torch.equal(kept_apart(both, DISTANCE, DT).pos, pos)


def test_free_nodes_keep_their_distance_from_many_prescribed_ones() -> None:
    state = liquid(num_nodes=60)
    held = np.zeros((60, 2), bool)
    held[:30] = True
    state = replace(state, loads=Loads(held, np.repeat(state.pos.numpy()[None, :30], 2, axis=0)))
    after = kept_apart(state, 0.03, DT)
    assert torch.equal(after.pos[:30], state.pos[:30])
    assert float(torch.cdist(after.pos[:30], after.pos[30:]).min()) > 0.8 * 0.03


def test_nodes_apart_and_other_materials_stay() -> None:
    state = liquid()
    assert kept_apart(state, 0.5 * float(nearest(state).min()), DT) is state
    sand = scenes.state(40, ("sand",)).to_torch()
    assert kept_apart(sand, DISTANCE, DT) is sand
    both = scenes.state(40, ("fluid", "sand")).to_torch()
    after, wet = kept_apart(both, DISTANCE, DT), both.node_type == node_code("fluid")
    assert torch.equal(after.pos[~wet], both.pos[~wet]) and not torch.equal(after.pos[wet], both.pos[wet])


def test_the_seam_of_a_periodic_domain_is_no_gap() -> None:
    state = replace(liquid(num_nodes=2), periodicity=Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False)))
    state = replace(state, pos=torch.tensor([[0.001, 0.5], [0.999, 0.5]], dtype=torch.float64))
    after = kept_apart(state, DISTANCE, DT)
    assert nearest(after).min() > 0.9 * DISTANCE
    assert bool((after.pos >= 0).all()) and bool((after.pos < 1).all())


def test_gradients_pass_through() -> None:
    state = liquid(num_nodes=6)
    pos = torch.tensor([[0.3 + 0.03 * k, 0.3 + 0.001 * k**2] for k in range(6)], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: kept_apart(replace(state, pos=p), DISTANCE, DT).pos, pos)


def test_the_distance_is_a_quantile_of_the_liquid() -> None:
    pos = np.random.default_rng(0).uniform(0, 1, (3, 120, 2))
    wet = Trajectory.from_numpy(pos, 0.01, ["fluid"] * 60 + ["sand"] * 60, {"fluid": 1e-3, "sand": 30.0}, spacing=0.1)
    expected = np.quantile([nearest_distances(wet.pos[k, :60].astype(float)) for k in range(3)], 0.25)
    assert distance_in([wet], 0.25) == pytest.approx(expected, rel=1e-12)
    dry = Trajectory.from_numpy(pos, 0.01, ["sand"] * 120, {"sand": 30.0}, spacing=0.1)
    with pytest.raises(LeastDistanceError, match="no liquid; set training.least_distance=null"):
        distance_in([dry], 0.25)


@pytest.fixture(scope="module")
def simulator() -> LearnedSimulator:
    builder = scenes.builder(("fluid",), history=2)
    torch.manual_seed(0)
    return LearnedSimulator(GPE(builder.spec, hidden_channels=8, num_message_passing_steps=1), builder).eval()


def test_rollouts_keep_it_and_training_does_not(simulator: LearnedSimulator) -> None:
    state, kept = liquid(), simulator.configured(least_distance=DISTANCE)
    plain = simulator.step(state)
    expected = kept_apart(plain, DISTANCE, simulator.builder.metadata.frame_dt)
    assert not torch.equal(expected.pos, plain.pos)
    torch.testing.assert_close(kept.step(state).pos, expected.pos)
    together = kept.step_all([state, state])[1]
    assert isinstance(together, State)
    torch.testing.assert_close(together.pos, expected.pos)
    kept.train()
    trained = kept.next_states([state])[0]
    kept.eval()
    assert isinstance(trained, State)
    torch.testing.assert_close(trained.pos, plain.pos)


def test_checkpoints_store_it_and_programs_refuse_it(simulator: LearnedSimulator, tmp_path: Path) -> None:
    kept = simulator.configured(least_distance=DISTANCE)
    kept.save(tmp_path / "model.ckpt")
    assert LearnedSimulator.from_checkpoint(tmp_path / "model.ckpt").least_distance == DISTANCE
    checkpoint = torch.load(tmp_path / "model.ckpt", weights_only=True)
    checkpoint["simulator"]["least_distance"] = -1.0
    torch.save(checkpoint, tmp_path / "bad.ckpt")
    with pytest.raises(CheckpointError, match="least_distance=-1.0: must be a finite number"):
        LearnedSimulator.from_checkpoint(tmp_path / "bad.ckpt")
    with pytest.raises(LeastDistanceError, match="set least_distance of the simulator to 0"):
        export_model(kept, tmp_path / "model.pt2")
    for value in (True, "0.1", float("nan"), float("inf")):
        with pytest.raises(LeastDistanceError):
            checked(value)


def test_models_of_several_scales_keep_it_in_spacings() -> None:
    builder = scenes.builder(("fluid",), scales="dimensionless")
    own = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder).eval()
    own.least_distance = 0.01
    spacing = builder.metadata.spacing
    assert own.at(2 * spacing).least_distance == pytest.approx(0.02)
    assert own.at(2 * spacing).at(spacing).least_distance == pytest.approx(0.01) == own.least_distance
