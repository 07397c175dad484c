"""Transfers between particles and grid in 2D.

``grid`` holds three numbers for each node, one after the other: momentum or velocity, then mass. Node ``(i, j)`` has the index ``i n_y + j``. Indices are
unsigned, which saves the test for negative ones. Kernels also take ``particles`` (``Particles``), their Kirchhoff ``stress`` [node, 3] in Pa, the number of
grid nodes along each axis ``counts``, the position of the first grid node ``origin`` [m], the inverse of the grid spacing ``inv`` [1/m] and the substep ``h``
[s].

Stresses have a separate pass, so that the processor overlaps the slow logarithms, roots and divisions of several particles. For sand, a particle needs at least
450 floating-point operations and 400 bytes from the second-level cache in each substep. With two operations per cycle at 3 GHz, the arithmetic takes 75 ns,
longer than the memory access.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.solvers.materials import VISCOSITY
from gpe_pl.solvers.mpm import laws_2d


@njit(cache=True, error_model="numpy")
@no_type_check
def weights(f):
    """Return the quadratic B-spline weights of three nodes; ``f`` in [0.5, 1.5) is the distance from the first, in cells."""
    return 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2


@njit(cache=True, error_model="numpy")
@no_type_check
def squared_wave_speed(particles):
    """Return the squared speed of the fastest elastic wave in any particle, in m²/s²."""
    squared = 0.0
    for p in range(particles.pos.shape[0]):
        f = particles.deformation[p]
        out = laws_2d.respond(particles.law[p], f[0, 0], f[0, 1], f[1, 0], f[1, 1], particles.plastic[p], particles.constants, p)
        squared = max(squared, out[8] * particles.specific_volume[p])
    return squared


@njit(cache=True, error_model="numpy")
@no_type_check
def deform(particles, stress, h):
    """Deform the particles by ``h ∇v`` and write their Kirchhoff stress [node, 3] in Pa; return the new ``squared_wave_speed``.

    Viscosity ν adds ``2 ρ ν dev ∇v``, symmetrised and in plane strain. The next transfer removes the fraction ``8 h ν / Δ²`` of this rate of deformation, for
    any positions.
    """
    deformation, gradient, plastic, specific_volume = (
        particles.deformation,
        particles.gradient,
        particles.plastic,
        particles.specific_volume,
    )
    law, constants, squared = particles.law, particles.constants, 0.0
    for p in range(plastic.shape[0]):
        c00, c01, c10, c11 = gradient[p, 0, 0], gradient[p, 0, 1], gradient[p, 1, 0], gradient[p, 1, 1]
        f00, f01, f10, f11 = deformation[p, 0, 0], deformation[p, 0, 1], deformation[p, 1, 0], deformation[p, 1, 1]
        f00, f01, f10, f11, plastic[p], stress[p, 0], stress[p, 1], stress[p, 2], stiffness = laws_2d.respond(
            law[p],
            f00 + h * (c00 * f00 + c01 * f10),
            f01 + h * (c00 * f01 + c01 * f11),
            f10 + h * (c10 * f00 + c11 * f10),
            f11 + h * (c10 * f01 + c11 * f11),
            plastic[p],
            constants,
            p,
        )
        deformation[p, 0, 0], deformation[p, 0, 1], deformation[p, 1, 0], deformation[p, 1, 1] = f00, f01, f10, f11
        squared = max(squared, stiffness * specific_volume[p])
        if constants[p, VISCOSITY] > 0.0:
            viscosity, mean = constants[p, VISCOSITY] / specific_volume[p], (c00 + c11) / 3.0
            stress[p, 0] += 2.0 * viscosity * (c00 - mean)
            stress[p, 1] += viscosity * (c01 + c10)
            stress[p, 2] += 2.0 * viscosity * (c11 - mean)
    return squared


@njit(cache=True, error_model="numpy")
@no_type_check
def particles_to_grid(particles, stress, grid, counts, origin, inv, h):
    """Add momentum, impulse of the stress, and mass of the particles to ``grid``, the second line of the equations in ``gpe_pl.solvers.mpm``."""
    pos, vel, affine, mass, specific_volume = particles.pos, particles.vel, particles.affine, particles.mass, particles.specific_volume
    spacing, stride = 1.0 / inv, counts[1]
    for p in range(pos.shape[0]):
        c00, c01, c10, c11 = affine[p, 0, 0], affine[p, 0, 1], affine[p, 1, 0], affine[p, 1, 1]
        t00, t01, t11 = stress[p, 0], stress[p, 1], stress[p, 2]
        m = mass[p]
        force = -h * m * specific_volume[p] * 4.0 * inv * inv
        # momentum at a node k cells from the first: q + A (k - f), with A in units of a cell
        a00, a01 = (m * c00 + force * t00) * spacing, (m * c01 + force * t01) * spacing
        a10, a11 = (m * c10 + force * t01) * spacing, (m * c11 + force * t11) * spacing
        x, y = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv
        i, j = int(x - 0.5), int(y - 0.5)
        fx, fy = x - i, y - j
        wx, wy = weights(fx), weights(fy)
        q0, q1 = m * vel[p, 0] - a00 * fx - a01 * fy, m * vel[p, 1] - a10 * fx - a11 * fy
        first = 3 * (i * stride + j)
        for k in range(3):
            w = wx[k]
            r0, r1, r2, d0, d1 = w * (q0 + a00 * k), w * (q1 + a10 * k), w * m, w * a01, w * a11
            for n in range(3):
                w, at = wy[n], first + 3 * (k * stride + n)
                grid[np.uintp(at)] += w * (r0 + d0 * n)
                grid[np.uintp(at + 1)] += w * (r1 + d1 * n)
                grid[np.uintp(at + 2)] += w * r2


@njit(cache=True, error_model="numpy")
@no_type_check
def grid_to_particles(particles, grid, counts, origin, inv, h):
    """Interpolate velocities and their gradients from ``grid``, and move the particles, the fourth line of the equations in ``gpe_pl.solvers.mpm``."""
    pos, vel, gradient = particles.pos, particles.vel, particles.gradient
    stride = counts[1]
    for p in range(pos.shape[0]):
        x, y = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv
        i, j = int(x - 0.5), int(y - 0.5)
        fx, fy = x - i, y - j
        wx, wy = weights(fx), weights(fy)
        mx, my = (-wx[0] * fx, wx[1] * (1.0 - fx), wx[2] * (2.0 - fx)), (-wy[0] * fy, wy[1] * (1.0 - fy), wy[2] * (2.0 - fy))
        first = 3 * (i * stride + j)
        u = v = c00 = c01 = c10 = c11 = 0.0
        for k in range(3):
            # sums along y, and their first moments
            s0 = s1 = m0 = m1 = 0.0
            for n in range(3):
                at = first + 3 * (k * stride + n)
                g0, g1 = grid[np.uintp(at)], grid[np.uintp(at + 1)]
                s0, s1, m0, m1 = s0 + wy[n] * g0, s1 + wy[n] * g1, m0 + my[n] * g0, m1 + my[n] * g1
            u, v = u + wx[k] * s0, v + wx[k] * s1
            c00, c01, c10, c11 = c00 + mx[k] * s0, c01 + wx[k] * m0, c10 + mx[k] * s1, c11 + wx[k] * m1
        scale = 4.0 * inv
        gradient[p, 0, 0], gradient[p, 0, 1], gradient[p, 1, 0], gradient[p, 1, 1] = scale * c00, scale * c01, scale * c10, scale * c11
        pos[p, 0], pos[p, 1], vel[p, 0], vel[p, 1] = pos[p, 0] + h * u, pos[p, 1] + h * v, u, v
