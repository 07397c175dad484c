"""The only place where positions, velocities and accelerations convert into each other.

Symplectic Euler at the frame interval ``dt`` [s] throughout::

    v[t]   = (x[t] - x[t-1]) / dt
    v[t+1] = v[t] + a[t] dt
    x[t+1] = x[t] + v[t+1] dt

so ``acceleration`` of three stored frames, fed back through ``advance``, gives the third frame back. All functions take NumPy arrays or
torch tensors; precision is that of the input, so pass float64 (float32 positions lose small accelerations). Across the seam of a periodic axis a
position changes by the shortest way around.
"""

from typing import Any

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity

Array = Any


def velocities(pos: Array, dt: float, periodicity: Periodicity = NOWHERE) -> Array:
    """Velocities [frame-1, ...] in m/s between consecutive positions [frame, ...] in m."""
    return periodicity.shortest(pos[1:] - pos[:-1]) / dt


def acceleration(vel_next: Array, vel: Array, dt: float) -> Array:
    """Acceleration in m/s² that takes ``vel`` to ``vel_next`` in one frame."""
    return (vel_next - vel) / dt


def advance(pos: Array, vel: Array, acc: Array, dt: float) -> tuple[Array, Array]:
    """One symplectic Euler step: positions in m and velocities in m/s after ``dt``."""
    vel = vel + acc * dt
    return pos + vel * dt, vel
