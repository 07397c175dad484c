"""Rigid bodies keep their shape, and have the momentum and angular momentum of the predicted velocities."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.trajectory.rigid_bodies import all_of_bodies, moved_rigidly, rigid_displacement
from gpe_pl.trajectory.state import State
from tests import scenes

DT = 0.01


def moment(arm: np.ndarray, mass: np.ndarray, vel: np.ndarray) -> np.ndarray:
    outer = np.einsum("n,ni,nj->ij", mass, arm, vel)
    return outer - outer.T


@pytest.mark.parametrize("turn", [1e-9, 0.1, 0.8])
@pytest.mark.parametrize("dim", [2, 3])
def test_momentum_and_angular_momentum_are_those_of_the_predicted_velocities(dim: int, turn: float) -> None:
    rng = np.random.default_rng(1)
    pos, mass = rng.normal(size=(20, dim)), rng.uniform(0.5, 2.0, 20)
    spin = rng.normal(size=(dim, dim))
    spin = (spin - spin.T) / np.linalg.norm(spin - spin.T)
    vel = rng.normal(size=dim) + turn / DT * pos @ spin + 0.1 * turn / DT * rng.normal(size=pos.shape)
    way = rigid_displacement(pos, vel, mass, DT)
    np.testing.assert_allclose(mass @ way, mass @ vel * DT, rtol=1e-10, atol=1e-15)
    arm = pos - mass @ pos / mass.sum()
    wanted = moment(arm, mass, vel) * DT
    np.testing.assert_allclose(moment(arm, mass, way), wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(pdist(pos + way), pdist(pos), rtol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("dim", [2, 3])
def test_single_nodes_and_nodes_in_a_row_move_rigidly_too(dim: int, count: int) -> None:
    rng = np.random.default_rng(2)
    pos = np.linspace(0, 1, count)[:, None] * np.ones(dim)
    vel = rng.normal(size=(count, dim))
    way = rigid_displacement(pos, vel, np.ones(count), DT)
    np.testing.assert_allclose(way.mean(axis=0), DT * vel.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(pdist(pos + way), pdist(pos), rtol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_turn_too_large_for_a_step_keeps_the_shape(dim: int) -> None:
    pos = np.random.default_rng(3).normal(size=(8, dim))
    vel = np.zeros_like(pos)
    vel[:, 0], vel[:, 1] = -500 * pos[:, 1], 500 * pos[:, 0]
    way = rigid_displacement(pos, vel, np.ones(8), DT)
    np.testing.assert_allclose(pdist(pos + way), pdist(pos), rtol=1e-9)


def spinning(backend: str) -> State:
    """Return two bodies of 8 and 5 nodes that spin and drift, and 7 nodes of no body."""
    state = scenes.state(20, history=2, walls=False, dim=3)
    body = np.repeat([4, -1, 0], [8, 7, 5])
    spin = np.zeros_like(state.vel)
    spin[:, 0], spin[:, 1], spin[:, 2] = -9 * state.pos[:, 1], 9 * state.pos[:, 0], 1.0
    state = replace(state, rigid_body=body).corrected(state.pos, np.where(body[:, None] >= 0, spin, state.vel))
    return state.to_torch() if backend == "torch" else state


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_bodies_keep_shape_momentum_and_spin_over_many_steps_and_other_nodes_are_free(backend: str) -> None:
    start = state = spinning(backend)
    momenta = []
    for _ in range(100):
        after = state.later(DT, state.pos + DT * state.vel, state.vel)
        state = moved_rigidly(state, after, DT)
        pos, vel, mass = (np.asarray(x)[:8] for x in (state.pos, state.vel, state.mass))
        before = pos - DT * vel
        momenta.append(moment(before - mass @ before / mass.sum(), mass, vel))
    for rows in (slice(0, 8), slice(15, 20)):
        np.testing.assert_allclose(pdist(np.asarray(state.pos)[rows]), pdist(np.asarray(start.pos)[rows]), rtol=1e-11)
        assert np.abs(np.asarray(state.pos - start.pos)[rows]).max() > 0.3
    np.testing.assert_allclose(momenta[-1], momenta[0], rtol=1e-8)
    np.testing.assert_allclose(np.asarray(state.pos)[8:15], np.asarray(start.pos + 100 * DT * start.vel)[8:15])
    assert state.velocity_history is not None
    np.testing.assert_array_equal(np.asarray(state.velocity_history)[:, -1], np.asarray(state.vel))


def test_a_scene_without_bodies_is_the_same_object() -> None:
    state = scenes.state(5)
    after = state.later(DT, state.pos, state.vel)
    assert moved_rigidly(state, after, DT) is after


def test_a_body_moves_across_the_seam_of_a_periodic_domain() -> None:
    space = Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))
    pos = np.array([[0.95, 0.5], [0.99, 0.5], [0.03, 0.5], [0.07, 0.52]])
    vel = np.tile([1.0, 0.0], (4, 1))
    state = replace(
        scenes.state(4, walls=False), pos=pos, vel=vel, velocity_history=None, periodicity=space, rigid_body=np.zeros(4, np.int64)
    )
    after = moved_rigidly(state, state.later(0.1, pos + 0.1 * vel, vel), 0.1)
    np.testing.assert_allclose(after.pos, [[0.05, 0.5], [0.09, 0.5], [0.13, 0.5], [0.17, 0.52]], atol=1e-12)
    np.testing.assert_allclose(after.vel, vel, atol=1e-12)


def test_gradients_pass_through_the_motion() -> None:
    pos = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vel = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: rigid_displacement(pos, v, torch.ones(6, dtype=torch.float64), 0.1), vel)


def test_joined_scenes_keep_their_bodies_apart() -> None:
    a, b = (
        replace(scenes.state(4, walls=False, seed=k), rigid_body=np.array(body)) for k, body in enumerate([[0, 0, -1, 1], [0, -1, 0, 0]])
    )
    both = State.joined([a, b])
    np.testing.assert_array_equal(both.rigid_body, [0, 0, -1, 1, 2, -1, 2, 2])
    np.testing.assert_array_equal(both.take(np.array([5, 4])).rigid_body, [-1, 2])


def test_a_body_is_marked_as_a_whole_or_not_at_all() -> None:
    mask, body = np.array([True, False, True, True, False]), np.array([0, 0, 3, 3, -1])
    np.testing.assert_array_equal(all_of_bodies(mask, body), [False, False, True, True, False])
    assert all_of_bodies(mask, None) is mask


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("sides", [(1, 1, 1), (1, 0.5, 0.2), (1, 0.1, 0.1)])
def test_a_body_asked_for_too_large_a_turn_gets_the_largest_fraction_of_its_angular_momentum(
    sides: tuple[float, ...], backend: str
) -> None:
    rng = np.random.default_rng(4)
    pos = np.stack(np.meshgrid(*(np.linspace(-s, s, 4) for s in sides)), axis=-1).reshape(-1, 3)
    for _ in range(30):
        axis = rng.normal(size=3)
        vel = np.cross(600 * axis / np.linalg.norm(axis), pos)  # 6 rad in one frame
        asked = DT * np.cross(pos, vel).sum(axis=0)
        body: Any = [torch.from_numpy(x) if backend == "torch" else x for x in (pos, vel, np.ones(64))]
        way = np.asarray(rigid_displacement(body[0], body[1], body[2], DT))
        np.testing.assert_allclose(pdist(pos + way), pdist(pos), rtol=1e-9)
        got = np.cross(pos, way).sum(axis=0)
        fraction = got @ asked / (asked @ asked)
        assert 0 < fraction < 1
        np.testing.assert_allclose(got, fraction * asked, atol=1e-6 * float(np.linalg.norm(asked)))
        more = rigid_displacement(pos, 1.02 * fraction * vel, np.ones(64), DT)  # there is no rotation with a little more
        assert np.cross(pos, np.asarray(more)).sum(axis=0) @ asked < 1.01 * fraction * (asked @ asked)
