"""Compiled loop over the substeps of one frame. The same code serves 2D and 3D.

``counts``, the number of grid nodes along each axis, is a tuple, so that kernels know the dimension at compile time.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.schema import STICKY
from gpe_pl.solvers.materials import MEMORY, VISCOSITY
from gpe_pl.solvers.mpm import smoothing, transfer_2d, transfer_3d
from gpe_pl.solvers.mpm.collider import keep_out
from gpe_pl.solvers.mpm.prescribed import carry, impose

OK, NOT_FINITE, ESCAPE, TOO_MANY_SUBSTEPS = 0, 1, 2, 3


@njit(cache=True, error_model="numpy")
@no_type_check
def advance(particles, collider, motion, gravity, bounds, origin, counts, spacing, frame_dt, cfl, max_substeps, last_substep):
    """Advance the particles in place by one frame.

    Positions follow velocities half a substep later, so gravity acts over the mean of a substep and the one before. A body in free flight then stays on its
    parabola although substeps change. Particles deform over the time for which they have moved, which is the previous substep.

    Args:
        particles: all particles.
        collider: walls and obstacles.
        motion: motion that openings prescribe, a ``Prescribed``.
        gravity: acceleration of gravity [dim] in m/s².
        bounds: ``(low, high)`` of the domain per axis [m].
        origin, counts, spacing: position of the first grid node [m], number of nodes per axis, and grid spacing [m].
        frame_dt: time of a frame [s].
        cfl: largest fraction of a cell that a wave or a particle may cross in a substep.
        max_substeps: largest number of substeps.
        last_substep: length of the substep before this frame [s]; 0 if there was none.

    Returns:
        A status such as ``OK``, the node that caused a failure (otherwise the fastest node), the number of substeps, and the length of the last one [s].
    """
    inv, dim, gravity_squared = 1.0 / spacing, len(counts), 0.0
    for axis in range(dim):
        gravity_squared += gravity[axis] * gravity[axis]
    # a particle at rest may fall by at most a quarter of cfl cells, so together with its velocity it moves at most 1.25 cfl cells
    fall_rate = 2.0 * math.sqrt(math.sqrt(gravity_squared) / (cfl * spacing))
    # viscosity must not reverse the sign of the local rate of deformation (see ``transfer_2d.deform``)
    diffusion_rate, remembers = 0.0, False
    for p in range(particles.pos.shape[0]):
        diffusion_rate = max(diffusion_rate, 8.0 * inv * inv * particles.constants[p, VISCOSITY])
        remembers = remembers or particles.constants[p, MEMORY] > 0.0
    grid, active = np.zeros((collider.distance.shape[0], dim + 1)), np.zeros((3, 2), dtype=np.int64)
    flat, stress = grid.reshape(-1), np.empty((particles.pos.shape[0], 3 * dim - 3))
    remaining, substeps = frame_dt, 0
    remainder = smoothing.Remainder(
        np.empty(particles.vel.shape), np.empty(particles.affine.shape), np.empty(particles.vel.shape), np.empty(particles.mass.shape),
        np.zeros(grid.shape if remembers else (0, dim + 1)), np.zeros(stress.shape),
    )  # fmt: skip
    squared = transfer_2d.squared_wave_speed(particles) if dim == 2 else transfer_3d.squared_wave_speed(particles)
    carry(particles, motion, 0.0)
    while True:
        status, node, speed = _survey(particles.pos, particles.vel, bounds, origin, counts, spacing, active)
        if status != OK or remaining <= 0.0:
            return status, node, substeps, last_substep
        speed = max(speed, motion.fastest)  # an opening may be faster than what comes to it
        needed = max(remaining * (math.sqrt(squared) + speed) / (cfl * spacing), remaining * fall_rate, remaining * diffusion_rate) * (
            1.0 - 1e-12
        )
        if not needed <= max_substeps - substeps:  # compare before rounding, because the number may exceed an integer
            return TOO_MANY_SUBSTEPS, node, substeps, last_substep
        count = max(1, math.ceil(needed))
        h = remaining / count
        remaining = remaining - h if count > 1 else 0.0
        substeps += 1
        if remembers:
            _clear(remainder.grid, active, counts)
            smoothing.set_aside(particles, remainder, active, counts, origin, inv, h)
        _clear(grid, active, counts)
        if dim == 2:
            squared = transfer_2d.deform(particles, stress, last_substep)
            transfer_2d.particles_to_grid(particles, stress, flat, counts, origin, inv, h)
        else:
            squared = transfer_3d.deform(particles, stress, last_substep)
            transfer_3d.particles_to_grid(particles, stress, flat, counts, origin, inv, h)
        gravity_time = 0.5 * (h + last_substep) if last_substep > 0.0 else h
        impose(grid, motion, gravity, gravity_time)
        _move_grid(grid, collider, gravity, gravity_time, active, counts)
        last_substep = h
        if dim == 2:
            transfer_2d.grid_to_particles(particles, flat, counts, origin, inv, h)
        else:
            transfer_3d.grid_to_particles(particles, flat, counts, origin, inv, h)
        if remembers:
            smoothing.give_back(particles, remainder, counts, inv, h)
        carry(particles, motion, frame_dt - remaining)
        keep_out(particles.pos, particles.vel, collider, counts, origin, inv)


@njit(cache=True, error_model="numpy")
@no_type_check
def _survey(pos, vel, bounds, origin, counts, spacing, active):
    """Check that every particle can be indexed; return a status, the node at fault (or the fastest) and the largest speed [m/s].

    Write to ``active`` the half-open ranges of grid nodes that the particles reach along x, y and z. In 2D the first row is unused, and the last two are x
    and y.
    """
    dim = len(counts)
    fastest, speed_squared = (0 if pos.shape[0] > 0 else -1), 0.0
    for p in range(pos.shape[0]):
        squared = 0.0
        for axis in range(dim):
            squared += vel[p, axis] * vel[p, axis]
        if not squared < math.inf:
            return NOT_FINITE, p, 0.0
        if squared > speed_squared:
            fastest, speed_squared = p, squared
    active[0, 0], active[0, 1] = 0, 1
    for axis in range(dim):
        low, high = math.inf, -math.inf
        # a particle counts as escaped when it is more than one cell outside an open side
        lowest, highest = bounds[axis, 0] - spacing, bounds[axis, 1] + spacing
        for p in range(pos.shape[0]):
            x = pos[p, axis]
            if not (x >= lowest and x <= highest):
                return (ESCAPE if math.isfinite(x) else NOT_FINITE), p, 0.0
            low, high = min(low, x), max(high, x)
        if pos.shape[0] == 0:
            low = high = bounds[axis, 0]
        row, inv = axis + 3 - dim, 1.0 / spacing
        active[row, 0], active[row, 1] = int((low - origin[axis]) * inv - 0.5), int((high - origin[axis]) * inv - 0.5) + 3
    return OK, fastest, math.sqrt(speed_squared)


@njit(cache=True, error_model="numpy")
@no_type_check
def _clear(grid, active, counts):
    dim = len(counts)
    for i in range(active[0, 0], active[0, 1]):
        for j in range(active[1, 0], active[1, 1]):
            row = (i * counts[dim - 2] + j) * counts[dim - 1]
            for node in range(row + active[2, 0], row + active[2, 1]):
                for c in range(dim + 1):
                    grid[node, c] = 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _move_grid(grid, collider, gravity, h, active, counts):
    """Turn momenta into velocities, add gravity, and apply the boundary conditions of the nodes inside walls and obstacles."""
    dim = len(counts)
    for i in range(active[0, 0], active[0, 1]):
        for j in range(active[1, 0], active[1, 1]):
            row = (i * counts[dim - 2] + j) * counts[dim - 1]
            for node in range(row + active[2, 0], row + active[2, 1]):
                if grid[node, dim] > 0.0:
                    inverse = 1.0 / grid[node, dim]
                    for axis in range(dim):
                        grid[node, axis] = grid[node, axis] * inverse + h * gravity[axis]
                    if collider.row[node] >= 0:
                        _obey(grid, node, collider.conditions, collider.row[node], counts)


@njit(cache=True, error_model="numpy")
@no_type_check
def _obey(grid, node, conditions, row, counts):
    """Apply the boundary condition of each shape that contains a grid node.

    A no-slip shape stops the node. Any other shape removes the inward part of the velocity and applies Coulomb friction to the rest.
    """
    dim = len(counts)
    for k in range(conditions.shape[1]):
        friction = conditions[row, k, dim]
        if friction < 0.0:
            break
        inward = 0.0
        for axis in range(dim):
            inward += grid[node, axis] * conditions[row, k, axis]
        if friction >= STICKY:
            kept = 0.0
        elif inward < 0.0:
            sliding = 0.0
            for axis in range(dim):
                grid[node, axis] -= inward * conditions[row, k, axis]
                sliding += grid[node, axis] * grid[node, axis]
            kept = max(0.0, 1.0 + friction * inward / math.sqrt(sliding)) if sliding > 0.0 else 0.0
        else:
            continue
        for axis in range(dim):
            grid[node, axis] *= kept
