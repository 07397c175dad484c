"""Rollouts of open scenes: what enters and leaves, for any simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpe_pl.geometry.shapes import Box
from gpe_pl.learned.approximate import _Rest
from gpe_pl.rollout.baselines import Ballistic, ConstantVelocity
from gpe_pl.rollout.ensemble import Ensemble
from gpe_pl.rollout.flow import through_openings
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Replay, SimulationError, rollout, steps
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

SAND, DT = node_code("sand"), 0.05
INLET = Opening((0.0, 0.0), (0.2, 0.3), "x_low", speed=1.0, spacing=0.1, node_type=SAND, mass=2.0, params=(30.0,))
OUTLET = Opening((0.8, -1.0), (1.0, 2.0), "x_high")
METADATA = Metadata("channel", ("sand",), ("friction_angle",), DT, 0.1, 0.2, ((0.0, 1.0), (0.0, 1.0)), (0.0, 0.0))


def channel(*openings: Opening, shapes: tuple[Box, ...] = ()) -> State:
    pos = INLET.nodes_at_start()
    count = len(pos)
    boundary = Boundary.sample(shapes, 0.1, 2) if shapes else Boundary.empty(2)
    state = State(
        pos, np.tile(INLET.velocity_at(0.0), (count, 1)), np.full(count, SAND, np.uint8), np.full(count, 2.0, np.float32),
        np.full((count, 1), 30.0, np.float32), boundary, np.zeros(2), param_names=("friction_angle",),
    )  # fmt: skip
    return state.opened(openings)


def test_nodes_that_entered_less_those_that_left_are_there() -> None:
    result = rollout(ConstantVelocity(DT), channel(INLET, OUTLET), 100, METADATA, Guard(bounds=METADATA.bounds, spacing=0.1))
    assert result.termination is None
    alive = result.alive
    assert alive is not None
    entered, left = np.diff(alive.astype(int), axis=0) == 1, np.diff(alive.astype(int), axis=0) == -1
    assert entered.sum() == 3 * round(100 * DT / 0.1)
    np.testing.assert_array_equal(alive[1:].sum(axis=1), alive[0].sum() + np.cumsum(entered.sum(axis=1) - left.sum(axis=1)))
    assert alive[-1].sum() == 3 * 8  # steady: eight layers from the inlet to the outlet
    assert (result.pos[alive][:, 0] < 0.8).all()
    assert (result.mass == 2.0).all()


def test_the_inlet_prescribes_the_velocity_of_its_nodes_and_gravity_acts_after_it() -> None:
    state = replace(channel(INLET), gravity=np.array([0.0, -1.0]))
    result = rollout(Ballistic(DT), state, 12, METADATA)
    assert result.alive is not None
    inside = result.alive[1:] & INLET.contains(result.pos[:-1].reshape(-1, 2)).reshape(result.alive[1:].shape) & result.alive[:-1]
    np.testing.assert_allclose(result.vel[1:][inside], np.tile([1.0, 0.0], (inside.sum(), 1)))
    first = result.pos[-1, 0]
    assert first[0] == pytest.approx(0.05 + 12 * DT)
    assert first[1] < result.pos[0, 0, 1]


def test_nodes_leave_at_the_speed_of_an_outlet_with_a_speed() -> None:
    outlet = replace(INLET, low=(0.5, 0.0), high=(0.8, 0.3), side="x_high", speed=-0.5)
    result = rollout(ConstantVelocity(DT), channel(INLET, outlet), 60, METADATA)
    assert result.alive is not None
    inside = outlet.contains(result.pos[-2].astype(float)) & result.alive[-2] & result.alive[-1]
    assert inside.any()
    np.testing.assert_allclose(result.vel[-1, inside], np.tile([0.5, 0.0], (inside.sum(), 1)))
    assert result.pos[result.alive][:, 0].max() <= 0.8 + 1e-9


def test_a_rollout_of_tensors_is_the_same() -> None:
    state = channel(INLET, OUTLET)
    history = np.repeat(state.vel[:, None], 3, axis=1)
    with_history = replace(state, velocity_history=history)
    plain = rollout(ConstantVelocity(DT), with_history, 40, METADATA)
    tensors = rollout(ConstantVelocity(DT), with_history.to_torch(), 40, METADATA)
    np.testing.assert_array_equal(plain.pos, tensors.pos)
    np.testing.assert_array_equal(plain.alive, tensors.alive)
    *_, last = steps(ConstantVelocity(DT), with_history.to_torch(), 40)
    assert isinstance(last.pos, torch.Tensor)
    assert last.velocity_history is not None
    assert last.velocity_history.shape == (last.num_nodes, 3, 2)
    assert (last.velocity_history[-1] == torch.tensor([1.0, 0.0])).all()  # of a node that has just entered


def test_a_replay_shows_the_nodes_of_each_frame() -> None:
    first = rollout(ConstantVelocity(DT), channel(INLET, OUTLET), 40, METADATA)
    again = rollout(Replay(first), first.state(10), 30, METADATA)
    later = first.frames(10)
    np.testing.assert_array_equal(again.pos, later.pos)
    np.testing.assert_array_equal(again.alive, later.alive)


def test_a_rollout_from_a_later_frame_continues_the_first() -> None:
    first = rollout(ConstantVelocity(DT), channel(INLET, OUTLET), 40, METADATA)
    again = rollout(ConstantVelocity(DT), first.state(13), 27, METADATA)
    np.testing.assert_allclose(again.pos, first.frames(13).pos, atol=1e-6)
    np.testing.assert_array_equal(again.alive, first.frames(13).alive)


def test_the_guard_names_a_node_by_its_identity_and_follows_it_through_walls() -> None:
    thin = Box((0.55, -1.0), (0.63, 2.0), 0.0)
    state = channel(INLET, replace(OUTLET, low=(0.05, 0.25), high=(0.1, 0.3), side="y_high"), shapes=(thin,))
    guard = Guard(spacing=0.1)
    fast = rollout(ConstantVelocity(2 * DT), state, 9, replace(METADATA, frame_dt=2 * DT), guard)
    assert fast.termination is not None
    assert fast.termination.reason == "tunnelling"
    assert fast.alive is not None
    assert fast.alive[-1, fast.termination.node]
    x = fast.pos[-1, fast.termination.node, 0]
    assert x == fast.pos[-1][fast.alive[-1], 0].max()


def test_an_ensemble_refuses_open_scenes() -> None:
    with pytest.raises(SimulationError, match="an ensemble cannot predict open scenes"):
        Ensemble((ConstantVelocity(DT), ConstantVelocity(DT))).step(channel(INLET))


def test_nodes_that_were_at_rest_still_are_when_others_enter() -> None:
    before = channel(replace(INLET, low=(-0.1, 0.0), high=(0.1, 0.3))).to_torch()
    after = replace(ConstantVelocity(DT).step(before), internal=_Rest(torch.arange(6)))
    new = through_openings(before, after)
    assert isinstance(new.internal, _Rest)
    assert new.internal.count.tolist() == [0, 0, 0, 3, 4, 5, 0, 0, 0]  # three move with the inlet, three are new
