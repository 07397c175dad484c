"""Containment of rigid bodies: an impact at a wall turns a body, adds no energy, leaves no node inside, and keeps the motion along the wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import Box, Shape, Wall, domain_walls, signed_distance, surface_tolerance
from gpe_pl.rollout import rigid_containment
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.containment import Contained, contain
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.rigid_bodies import moved_rigidly, rigid_displacement, rigid_modes
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

DT = 0.005
ROD = np.stack([np.linspace(-0.2, 0.2, 9), np.zeros(9)], axis=1)
SQUARE = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 5)] * 2), axis=-1).reshape(-1, 2)
CUBE = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, 4)] * 3), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Falls:
    """Free flight, which knows no walls."""

    dt: float = DT

    def step(self, state: State) -> State:
        vel = state.vel + state.gravity * self.dt
        return moved_rigidly(state, state.later(self.dt, state.pos + vel * self.dt, vel), self.dt)


def turned(arm: np.ndarray, angle: float) -> np.ndarray:
    """Return arms turned in the plane of the first and the last axis."""
    result = arm.copy()
    result[:, 0] = np.cos(angle) * arm[:, 0] - np.sin(angle) * arm[:, -1]
    result[:, -1] = np.sin(angle) * arm[:, 0] + np.cos(angle) * arm[:, -1]
    return result


def moving(
    arm: np.ndarray,
    centre: tuple[float, ...],
    vel: tuple[float, ...] | None = None,
    spin: float = 0.0,
    gravity: float = 0.0,
    size: float = 1.0,
    obstacles: tuple[Shape, ...] = (),
) -> State:
    """Return a state of one rigid body in a box of an edge length [m]; angular velocity [1/s] in the plane of the first and the last axis."""
    dim = arm.shape[1]
    shapes = (*domain_walls(((0.0, size),) * dim, 0.5), *obstacles)
    pos = np.stack([turned(arm, spin * DT * k) + np.array(centre) + DT * k * np.array(vel or (0.0,) * dim) for k in range(3)])
    trajectory = Trajectory.from_numpy(
        pos,
        DT,
        ["solid"] * len(arm),
        {"solid": 1e6},
        rigid_body=np.zeros(len(arm), dtype=int),
        gravity=(0.0,) * (dim - 1) + (-gravity,),
        bounds=((0.0, size),) * dim,
        boundary=Boundary.sample(shapes, 0.05, dim),
        spacing=0.05,
        connectivity_radius=0.12,
    )
    return trajectory.state(1, history=1)


def energies_and_states(state: State, num_steps: int) -> tuple[np.ndarray, list[State]]:
    """Return the energy per mass [J/kg] before and after each contained step, and the states."""
    contained, states = Contained(Falls(), DT), [state]
    for _ in range(num_steps):
        states.append(contained.step(states[-1]))
    kinetic = np.array([0.5 * (s.vel**2).sum(axis=1).mean() for s in states])
    return kinetic - np.array([(s.pos @ s.gravity).mean() for s in states]), states


@pytest.mark.slow
@pytest.mark.parametrize("spin", [2.0, 10.0, 30.0])
@pytest.mark.parametrize("size", [1.0, 0.42])
def test_a_spinning_rod_that_strikes_walls_gains_no_energy(spin: float, size: float) -> None:
    start = moving(ROD, (size / 2, 0.205 if size < 1 else 0.19), (0.0, -0.5), spin, size=size)
    energy, states = energies_and_states(start, 200)
    assert np.diff(energy).max() < 1e-9 * energy[0]
    assert energy[-1] < 0.99 * energy[0]  # it did strike
    shapes = start.boundary.shapes
    assert min(signed_distance(shapes, s.pos).min() for s in states) >= -surface_tolerance(shapes)
    np.testing.assert_allclose(pdist(states[-1].pos), pdist(ROD), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "rest"), [(10.0, 0.0), (44.0, 0.0), (46.0, 90.0)])
def test_a_square_that_lands_on_a_corner_tips_over_to_the_next_side(degrees: float, rest: float) -> None:
    start = moving(turned(SQUARE, np.radians(degrees)), (0.5, 0.4), gravity=9.81)
    energy, states = energies_and_states(start, 400)
    side = states[-1].pos[4] - states[-1].pos[0]
    assert np.degrees(np.arctan2(side[1], side[0])) == pytest.approx(rest, abs=1e-6)
    assert energy[-1] == pytest.approx(9.81 * 0.1, rel=1e-6)
    assert np.diff(energy).max() < 1e-4 * energy[0]


@pytest.mark.parametrize("arm", [SQUARE, CUBE], ids=["2d", "3d"])
def test_a_body_that_lands_flat_stays_level_and_keeps_its_motion_along_the_floor(arm: np.ndarray) -> None:
    dim = arm.shape[1]
    start = moving(arm, (0.3,) * (dim - 1) + (0.3,), (0.25,) + (0.0,) * (dim - 1), gravity=9.81)
    _, states = energies_and_states(start, 100)
    last = states[-1]
    bottom = np.sort(last.pos[:, -1])[: len(arm) // (5 if dim == 2 else 4)]
    np.testing.assert_allclose(bottom, 0.0, atol=1e-12)
    np.testing.assert_allclose(last.vel, np.broadcast_to([0.25] + [0.0] * (dim - 1), last.vel.shape), atol=1e-9)


def test_a_rod_that_strikes_with_one_end_turns_as_the_impulse_says() -> None:
    """At the end of a rod the impulse is m v / (1 + l² / (4 k²)), with the radius of gyration k; the end stops and the centre goes on."""
    start = moving(ROD, (0.5, 0.3), (0.0, -1.0))
    corner = Box((0.65, 0.0), (0.72, 0.2949), 0.5)
    boundary = Boundary.sample((*start.boundary.shapes, corner), 0.05, 2)
    state = State(**{**vars(start), "boundary": boundary, "pos": start.pos - np.array([0.0, 0.0009])})
    before = state.vel.copy()
    after, moved = contain(state, DT)
    assert moved.all()
    gyration = (ROD[:, 0] ** 2).mean()
    at = ROD[-1, 0]  # the outermost node above the box
    depth = 0.2949 - state.pos[-1, 1]
    lift = depth / (1 + at**2 / gyration)
    assert (after.pos - state.pos)[:, 1].mean() == pytest.approx(lift, rel=1e-3)
    assert after.pos[-1, 1] == pytest.approx(0.2949, abs=1e-6)
    np.testing.assert_allclose(after.vel - before, (after.pos - state.pos) / DT, atol=1e-12)
    assert after.pos[0, 1] < state.pos[0, 1]  # the other end goes down


def test_a_body_in_a_gap_that_is_too_narrow_goes_back() -> None:
    start = moving(SQUARE, (0.5, 0.5), (0.5, 0.0))
    jaws = (Box((0.55, 0.0), (0.9, 0.45), 0.5), Box((0.55, 0.55), (0.9, 1.0), 0.5))
    boundary = Boundary.sample((*start.boundary.shapes, *jaws), 0.05, 2)
    state = State(**{**vars(start), "boundary": boundary, "pos": start.pos + np.array([0.1, 0.0])})
    after, moved = contain(state, DT)
    assert moved.all()
    np.testing.assert_allclose(after.pos, state.pos - state.vel * DT)
    np.testing.assert_allclose(after.vel, 0.0, atol=1e-12)


def test_a_body_across_the_seam_of_a_periodic_domain_is_put_back_as_a_whole() -> None:
    start = moving(ROD, (0.5, 0.3), (0.0, -1.0))
    floor = (Wall((0.0, 1.0), 0.0, (0.0, 0.0), (1.0, 1.0), 0.5),)
    pos = start.pos + np.array([0.5, -0.302])
    pos[:, 1] += 0.01 * ROD[:, 0]
    around = Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))
    whole = State(**{**vars(start), "boundary": Boundary.sample(floor, 0.05, 2), "pos": pos - np.array([0.5, 0.0])})
    split = State(**{**vars(whole), "periodicity": around, "pos": around.wrapped(pos)})
    assert np.ptp(split.pos[:, 0]) > 0.5
    (a, _), (b, _) = contain(whole, DT), contain(split, DT)
    np.testing.assert_allclose(around.wrapped(a.pos + np.array([0.5, 0.0])), b.pos, atol=1e-12)
    np.testing.assert_allclose(a.vel, b.vel, atol=1e-10)


def test_tensors_and_arrays_agree_and_keep_gradients() -> None:
    state = moving(turned(SQUARE, 0.3), (0.5, 0.2))
    state = state.corrected(state.pos - np.array([0.0, 0.1]), state.vel)
    (a, moved), (b, also) = contain(state, DT), contain(state.to_torch(), DT)
    with unfused():
        c, _ = contain(state, DT)
    assert moved.all()
    assert also.all()
    np.testing.assert_allclose(np.asarray(b.pos), a.pos, atol=1e-12)
    np.testing.assert_allclose(c.pos, a.pos, atol=1e-12)
    tensors = state.to_torch()
    pos = tensors.pos.clone().requires_grad_()
    height = contain(tensors.corrected(pos, tensors.vel), DT)[0].pos[:, 1]
    height.min().backward()  # the lowest node is on the floor, wherever the body was, up to the square of the angle
    assert pos.grad is not None
    assert torch.isfinite(pos.grad).all()
    assert pos.grad.abs().max() < 0.1


def test_modes_are_orthonormal_and_rigid() -> None:
    rng = np.random.default_rng(0)
    for dim, number in ((2, 3), (3, 6)):
        pos, mass = rng.normal(size=(7, dim)), rng.uniform(1.0, 2.0, 7)
        modes = rigid_modes(pos, mass)
        gram = np.einsum("anx,bnx,n->ab", modes, modes, mass / mass.sum())
        np.testing.assert_allclose(gram, np.eye(number), atol=1e-9)
        for mode in modes:
            assert np.abs(pdist(pos + 1e-6 * mode) - pdist(pos)).max() < 1e-10


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bodies_without_inertia_along_an_axis_have_finite_modes(dtype: type[np.floating]) -> None:
    row = 0.3 + np.outer(np.linspace(0, 1, 5), [0.6, 0.5, 0.4])
    for pos in (row, row[:1], row[:, :2], row[:1, :2]):
        modes = rigid_modes(pos.astype(dtype), np.ones(len(pos), dtype))
        assert modes.dtype == dtype
        assert np.isfinite(modes).all()
        assert np.abs(modes).max() < 10


def test_too_many_iterations_mean_no_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(rigid_containment, "nnls", fails)
    state = moving(SQUARE, (0.5, 0.2), (0.0, -1.0))
    state = state.corrected(state.pos - np.array([0.0, 0.098]), state.vel)
    after, moved = contain(state, DT)
    assert moved.all()
    np.testing.assert_allclose(after.pos, state.pos - state.vel * DT)


def test_constant_velocity_keeps_the_shape_and_the_spin_of_a_body() -> None:
    state = first = moving(ROD, (0.5, 0.5), (0.1, 0.0), spin=20.0)
    for _ in range(40):
        state = ConstantVelocity(DT).step(state)
    np.testing.assert_allclose(pdist(state.pos), pdist(ROD), rtol=1e-9)
    arms = [s.pos - s.pos.mean(axis=0) for s in (first, state)]
    momentum = [(arm[:, 0] * s.vel[:, 1] - arm[:, 1] * s.vel[:, 0]).sum() for arm, s in zip(arms, (first, state), strict=True)]
    assert momentum[1] == pytest.approx(momentum[0], rel=1e-9)
    step = ConstantVelocity(DT).step(first).pos - first.pos
    np.testing.assert_allclose(rigid_displacement(first.pos, first.vel, first.mass, DT), step, atol=1e-12)
