"""Transfers between particles and grid in 3D, with the arguments of ``transfer_2d``.

A grid node has four numbers, and node ``(i, j, k)`` has the index ``(i n_y + j) n_z + k``.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.solvers.materials import VISCOSITY
from gpe_pl.solvers.mpm import laws_3d
from gpe_pl.solvers.mpm.transfer_2d import weights


@njit(cache=True, error_model="numpy")
@no_type_check
def _matrix(stack, p):
    """Return the p-th 3x3 matrix of an array as a tuple."""
    return (
        stack[p, 0, 0], stack[p, 0, 1], stack[p, 0, 2],
        stack[p, 1, 0], stack[p, 1, 1], stack[p, 1, 2],
        stack[p, 2, 0], stack[p, 2, 1], stack[p, 2, 2],
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
@no_type_check
def _store(stack, p, m):
    stack[p, 0, 0], stack[p, 0, 1], stack[p, 0, 2] = m[0], m[1], m[2]
    stack[p, 1, 0], stack[p, 1, 1], stack[p, 1, 2] = m[3], m[4], m[5]
    stack[p, 2, 0], stack[p, 2, 1], stack[p, 2, 2] = m[6], m[7], m[8]


@njit(cache=True, error_model="numpy")
@no_type_check
def squared_wave_speed(particles):
    """Return the squared speed of the fastest elastic wave in any particle, in m²/s²."""
    squared = 0.0
    for p in range(particles.pos.shape[0]):
        out = laws_3d.respond(particles.law[p], _matrix(particles.deformation, p), particles.plastic[p], particles.constants, p)
        squared = max(squared, out[3] * particles.specific_volume[p])
    return squared


@njit(cache=True, error_model="numpy")
@no_type_check
def deform(particles, stress, h):
    """Deform the particles by ``h ∇v`` and write their Kirchhoff stress [node, 6] in Pa; return the new ``squared_wave_speed``."""
    deformation, gradient, plastic, specific_volume = (
        particles.deformation,
        particles.gradient,
        particles.plastic,
        particles.specific_volume,
    )
    law, constants, squared = particles.law, particles.constants, 0.0
    for p in range(plastic.shape[0]):
        c, f = _matrix(gradient, p), _matrix(deformation, p)
        trial = (
            f[0] + h * (c[0] * f[0] + c[1] * f[3] + c[2] * f[6]),
            f[1] + h * (c[0] * f[1] + c[1] * f[4] + c[2] * f[7]),
            f[2] + h * (c[0] * f[2] + c[1] * f[5] + c[2] * f[8]),
            f[3] + h * (c[3] * f[0] + c[4] * f[3] + c[5] * f[6]),
            f[4] + h * (c[3] * f[1] + c[4] * f[4] + c[5] * f[7]),
            f[5] + h * (c[3] * f[2] + c[4] * f[5] + c[5] * f[8]),
            f[6] + h * (c[6] * f[0] + c[7] * f[3] + c[8] * f[6]),
            f[7] + h * (c[6] * f[1] + c[7] * f[4] + c[8] * f[7]),
            f[8] + h * (c[6] * f[2] + c[7] * f[5] + c[8] * f[8]),
        )
        f, plastic[p], t, stiffness = laws_3d.respond(law[p], trial, plastic[p], constants, p)
        _store(deformation, p, f)
        stress[p, 0], stress[p, 1], stress[p, 2], stress[p, 3], stress[p, 4], stress[p, 5] = t
        squared = max(squared, stiffness * specific_volume[p])
        if constants[p, VISCOSITY] > 0.0:
            viscosity, mean = constants[p, VISCOSITY] / specific_volume[p], (c[0] + c[4] + c[8]) / 3.0
            stress[p, 0] += 2.0 * viscosity * (c[0] - mean)
            stress[p, 1] += viscosity * (c[1] + c[3])
            stress[p, 2] += viscosity * (c[2] + c[6])
            stress[p, 3] += 2.0 * viscosity * (c[4] - mean)
            stress[p, 4] += viscosity * (c[5] + c[7])
            stress[p, 5] += 2.0 * viscosity * (c[8] - mean)
    return squared


@njit(cache=True, error_model="numpy")
@no_type_check
def particles_to_grid(particles, stress, grid, counts, origin, inv, h):
    """Add momentum, impulse of the stress, and mass of the particles to ``grid``, as in ``transfer_2d``."""
    pos, vel, affine, mass, specific_volume = particles.pos, particles.vel, particles.affine, particles.mass, particles.specific_volume
    spacing, stride_x, stride_y = 1.0 / inv, counts[1] * counts[2], counts[2]
    for p in range(pos.shape[0]):
        c = _matrix(affine, p)
        t = stress[p, 0], stress[p, 1], stress[p, 2], stress[p, 3], stress[p, 4], stress[p, 5]
        m = mass[p]
        force = -h * m * specific_volume[p] * 4.0 * inv * inv
        # momentum at a node k cells from the first: q + A (k - f), with A in units of a cell
        a00, a01, a02 = (m * c[0] + force * t[0]) * spacing, (m * c[1] + force * t[1]) * spacing, (m * c[2] + force * t[2]) * spacing
        a10, a11, a12 = (m * c[3] + force * t[1]) * spacing, (m * c[4] + force * t[3]) * spacing, (m * c[5] + force * t[4]) * spacing
        a20, a21, a22 = (m * c[6] + force * t[2]) * spacing, (m * c[7] + force * t[4]) * spacing, (m * c[8] + force * t[5]) * spacing
        x, y, z = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv, (pos[p, 2] - origin[2]) * inv
        i, j, k = int(x - 0.5), int(y - 0.5), int(z - 0.5)
        fx, fy, fz = x - i, y - j, z - k
        wx, wy, wz = weights(fx), weights(fy), weights(fz)
        q0 = m * vel[p, 0] - a00 * fx - a01 * fy - a02 * fz
        q1 = m * vel[p, 1] - a10 * fx - a11 * fy - a12 * fz
        q2 = m * vel[p, 2] - a20 * fx - a21 * fy - a22 * fz
        first = 4 * (i * stride_x + j * stride_y + k)
        for a in range(3):
            for b in range(3):
                w = wx[a] * wy[b]
                r0, r1, r2, r3 = w * (q0 + a00 * a + a01 * b), w * (q1 + a10 * a + a11 * b), w * (q2 + a20 * a + a21 * b), w * m
                d0, d1, d2 = w * a02, w * a12, w * a22
                for n in range(3):
                    w, at = wz[n], first + 4 * (a * stride_x + b * stride_y + n)
                    grid[np.uintp(at)] += w * (r0 + d0 * n)
                    grid[np.uintp(at + 1)] += w * (r1 + d1 * n)
                    grid[np.uintp(at + 2)] += w * (r2 + d2 * n)
                    grid[np.uintp(at + 3)] += w * r3


@njit(cache=True, error_model="numpy")
@no_type_check
def grid_to_particles(particles, grid, counts, origin, inv, h):
    """Interpolate velocities and their gradients from ``grid``, and move the particles, as in ``transfer_2d``."""
    pos, vel, gradient = particles.pos, particles.vel, particles.gradient
    stride_x, stride_y = counts[1] * counts[2], counts[2]
    for p in range(pos.shape[0]):
        x, y, z = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv, (pos[p, 2] - origin[2]) * inv
        i, j, k = int(x - 0.5), int(y - 0.5), int(z - 0.5)
        fx, fy, fz = x - i, y - j, z - k
        wx, wy, wz = weights(fx), weights(fy), weights(fz)
        mz = (-wz[0] * fz, wz[1] * (1.0 - fz), wz[2] * (2.0 - fz))
        first = 4 * (i * stride_x + j * stride_y + k)
        u = v = w = c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
        for a in range(3):
            for b in range(3):
                # sums along z, and their first moments
                s0 = s1 = s2 = m0 = m1 = m2 = 0.0
                for n in range(3):
                    at = first + 4 * (a * stride_x + b * stride_y + n)
                    g0, g1, g2 = grid[np.uintp(at)], grid[np.uintp(at + 1)], grid[np.uintp(at + 2)]
                    s0, s1, s2 = s0 + wz[n] * g0, s1 + wz[n] * g1, s2 + wz[n] * g2
                    m0, m1, m2 = m0 + mz[n] * g0, m1 + mz[n] * g1, m2 + mz[n] * g2
                share = wx[a] * wy[b]
                s0, s1, s2, da, db = share * s0, share * s1, share * s2, a - fx, b - fy
                u, v, w = u + s0, v + s1, w + s2
                c00, c01, c02 = c00 + s0 * da, c01 + s0 * db, c02 + share * m0
                c10, c11, c12 = c10 + s1 * da, c11 + s1 * db, c12 + share * m1
                c20, c21, c22 = c20 + s2 * da, c21 + s2 * db, c22 + share * m2
        scale = 4.0 * inv
        rate = (scale * c00, scale * c01, scale * c02, scale * c10, scale * c11, scale * c12, scale * c20, scale * c21, scale * c22)
        _store(gradient, p, rate)
        vel[p, 0], vel[p, 1], vel[p, 2] = u, v, w
        pos[p, 0], pos[p, 1], pos[p, 2] = pos[p, 0] + h * u, pos[p, 1] + h * v, pos[p, 2] + h * w
