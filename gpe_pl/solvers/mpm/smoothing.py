"""Smoothing of particle velocities by a transfer to the grid and back, and the part of the lost velocity that particles keep.

The grid holds fewer numbers than the particles, so a transfer to it and back smooths their velocities. APIC applies this filter in every substep, so its loss
of energy per second grows without bound as substeps get shorter. Here the remainder of the filter, ``s - G P s`` with the velocity and the affine part of all
particles in ``s``, decays at a rate r, so that the loss per second has a limit::

    γ_p = 1 / (1 + h r_p),   r_p = 1 / (MEMORY Δ) + SHOCK |∇v + ∇vᵀ| / 2
    u_i = Σ_p γ_p w_ip m_p [v_p + C_p (x_i - x_p)] / Σ_p γ_p w_ip m_p                                                   (P)
    k_p = γ_p (v_p - Σ_i w_ip u_i),   K_p = γ_p (C_p - Σ_i w_ip u_i (x_i - x_p)ᵀ / D)                                   (G)
    v_p ← v'_p + k_p,   C_p ← C'_p + K_p + h/2 (M - Mᵀ),   M = (v'_p - v_p) k_pᵀ / D - C_p K_pᵀ

v' and C' come from the grid after the forces. The remainder of a rigid motion is zero, and the remainder of all particles has no linear and no angular
momentum. Particles move with the grid, by ``h v'``, although their velocity is ``v' + k``. M compensates the torque that follows from this; it is local and
the same in all inertial frames.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from gpe_pl.solvers.materials import MEMORY
from gpe_pl.solvers.mpm import transfer_2d, transfer_3d
from gpe_pl.solvers.mpm.particles import Particles

SHOCK = 0.2
"""Increase of the rate r per rate of deformation. This damping keeps strong shocks stable (von Neumann and Richtmyer 1950)."""


class Remainder(NamedTuple):
    """Work arrays that are allocated once and reused in every substep.

    Attributes:
        vel, affine: k and K of the particles [node, dim] in m/s and [node, dim, dim] in 1/s.
        before: velocities before the substep [node, dim] in m/s.
        mass: ``γ m`` [node] in kg.
        grid: momentum and mass weighted with γ, then u and mass [grid node, dim + 1].
        no_stress: zeros that stand for the stress in the transfers.
    """

    vel: np.ndarray
    affine: np.ndarray
    before: np.ndarray
    mass: np.ndarray
    grid: np.ndarray
    no_stress: np.ndarray


@njit(cache=True, error_model="numpy")
@no_type_check
def set_aside(particles, remainder, active, counts, origin, inv, h):
    """Compute the remainders k and K of a substep of length ``h`` [s]. Call it before the substep changes the particles.

    On entry, ``remainder.grid`` must be zero within ``active``.
    """
    dim = len(counts)
    grid, flat, kept, rest = remainder.grid, remainder.grid.reshape(-1), remainder.vel, remainder.affine
    for p in range(kept.shape[0]):
        squared = 0.0
        for i in range(dim):
            kept[p, i] = remainder.before[p, i] = particles.vel[p, i]
            for j in range(dim):
                squared += (particles.gradient[p, i, j] + particles.gradient[p, j, i]) ** 2
        remainder.mass[p] = particles.mass[p] / (1.0 + h * (inv / particles.constants[p, MEMORY] + 0.5 * SHOCK * math.sqrt(squared)))
    travelling = Particles(
        particles.pos, kept, particles.deformation, particles.affine, rest, particles.plastic, remainder.mass, particles.specific_volume,
        particles.law, particles.constants,
    )  # fmt: skip
    if dim == 2:
        transfer_2d.particles_to_grid(travelling, remainder.no_stress, flat, counts, origin, inv, 0.0)
    else:
        transfer_3d.particles_to_grid(travelling, remainder.no_stress, flat, counts, origin, inv, 0.0)
    for i in range(active[0, 0], active[0, 1]):
        for j in range(active[1, 0], active[1, 1]):
            row = (i * counts[dim - 2] + j) * counts[dim - 1]
            for node in range(row + active[2, 0], row + active[2, 1]):
                if grid[node, dim] > 0.0:
                    for axis in range(dim):
                        grid[node, axis] /= grid[node, dim]
    if dim == 2:
        transfer_2d.grid_to_particles(travelling, flat, counts, origin, inv, 0.0)
    else:
        transfer_3d.grid_to_particles(travelling, flat, counts, origin, inv, 0.0)
    for p in range(kept.shape[0]):
        fraction = remainder.mass[p] / particles.mass[p]
        for i in range(dim):
            kept[p, i] = fraction * (particles.vel[p, i] - kept[p, i])
            for j in range(dim):
                rest[p, i, j] = fraction * (particles.affine[p, i, j] - rest[p, i, j])


@njit(cache=True, error_model="numpy")
@no_type_check
def give_back(particles, remainder, counts, inv, h):
    """Add the remainders k and K to the particles after the transfer from the grid. ``particles.affine`` must still have the values before the substep."""
    dim = len(counts)
    vel, affine, gradient, kept, rest, before = (
        particles.vel, particles.affine, particles.gradient, remainder.vel, remainder.affine, remainder.before,
    )  # fmt: skip
    turned = np.zeros((dim, dim))
    for p in range(vel.shape[0]):
        for i in range(dim):
            for j in range(i):
                turn = 4.0 * inv * inv * ((vel[p, i] - before[p, i]) * kept[p, j] - (vel[p, j] - before[p, j]) * kept[p, i])
                for k in range(dim):
                    turn -= affine[p, i, k] * rest[p, j, k] - affine[p, j, k] * rest[p, i, k]
                turned[i, j], turned[j, i] = 0.5 * h * turn, -0.5 * h * turn
        for i in range(dim):
            vel[p, i] += kept[p, i]
            for j in range(dim):
                affine[p, i, j] = gradient[p, i, j] + rest[p, i, j] + turned[i, j]
