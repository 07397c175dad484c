"""Positions, velocities and accelerations convert into each other without loss."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gpe_pl.trajectory.integrators import acceleration, advance, velocities

coordinates = arrays(np.float64, (3, 4, 2), elements=st.floats(-10, 10, allow_subnormal=False))
time_steps = st.floats(1e-4, 1.0)


@given(coordinates, time_steps)
def test_advance_undoes_acceleration(pos: np.ndarray, dt: float) -> None:
    """Three frames of positions: the acceleration between them, applied to the first two, gives the third."""
    vel = velocities(pos, dt)
    new_pos, new_vel = advance(pos[1], vel[0], acceleration(vel[1], vel[0], dt), dt)
    np.testing.assert_allclose(new_pos, pos[2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(new_vel, vel[1], rtol=0, atol=1e-13 / dt)


@given(coordinates, time_steps)
def test_acceleration_undoes_advance(x: np.ndarray, dt: float) -> None:
    pos, vel, acc = x
    _, new_vel = advance(pos, vel, acc, dt)
    np.testing.assert_allclose(acceleration(new_vel, vel, dt), acc, rtol=0, atol=1e-14 / dt)


def test_symplectic_euler_by_hand() -> None:
    """The new velocity moves the position, not the old one."""
    pos, vel = advance(np.array([1.0]), np.array([2.0]), np.array([-10.0]), 0.1)
    np.testing.assert_allclose((pos[0], vel[0]), (1.1, 1.0))


def test_numpy_equals_torch() -> None:
    pos = np.random.default_rng(0).normal(size=(5, 3, 2))
    tensor = torch.from_numpy(pos)
    np.testing.assert_array_equal(velocities(tensor, 0.01).numpy(), velocities(pos, 0.01))
    for a, b in zip(advance(tensor[0], tensor[1], tensor[2], 0.01), advance(pos[0], pos[1], pos[2], 0.01), strict=True):
        np.testing.assert_array_equal(a.numpy(), b)


def test_inputs_stay_as_they_are() -> None:
    pos, vel, acc = np.ones((3, 4, 2))
    advance(pos, vel, acc, 0.5)
    for array in (pos, vel, acc):
        np.testing.assert_array_equal(array, 1.0)
