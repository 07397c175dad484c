"""Symplectic Euler: the only module that converts positions, velocities and accelerations into each other.

All functions use the frame interval ``dt`` [s]::

    v[t]   = (x[t] - x[t-1]) / dt
    v[t+1] = v[t] + a[t] dt
    x[t+1] = x[t] + v[t+1] dt

If you pass the ``acceleration`` of three stored frames to ``advance``, you get the third frame. Functions take NumPy arrays or torch tensors and keep their
precision. Pass float64, as float32 positions lose small accelerations. Along a periodic axis, a position changes by the shortest way around.
"""

from typing import Any

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity

Array = Any


def velocities(pos: Array, dt: float, periodicity: Periodicity = NOWHERE) -> Array:
    """Return velocities [frame-1, ...] in m/s between consecutive positions [frame, ...] in m."""
    return periodicity.shortest(pos[1:] - pos[:-1]) / dt


def acceleration(vel_next: Array, vel: Array, dt: float) -> Array:
    """Return the acceleration in m/s² that takes ``vel`` to ``vel_next`` in one frame."""
    return (vel_next - vel) / dt


def advance(pos: Array, vel: Array, acc: Array, dt: float) -> tuple[Array, Array]:
    """Return positions in m and velocities in m/s after one symplectic Euler step of ``dt`` [s] under the acceleration ``acc`` [m/s²]."""
    vel = vel + acc * dt
    return pos + vel * dt, vel
