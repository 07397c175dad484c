"""Transfers between particles and grid: multilinear kernels, the FLIP/PIC update, advection, and pushing particles out of solids.

All kernels work in two and three dimensions. Positions are in m, velocities in m/s. Arguments named like attributes of ``Grid``, ``Solids`` (both in ``grid``)
or ``solver.Fields`` are these arrays; ``inverse`` is 1 / ``spacing``. ``active`` are the indices of the cells that liquid reaches. Inside kernels, ``fraction``
is the position in a cell, and ``w`` are the 2^dim weights of its corners.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

CONTACT = 0.01
"""Distance that particles keep from solids, in cells."""

LONGEST_MOVE = 1.0
"""Largest distance in cells that a particle moves in one substep: less than half-way through a solid two cells thick."""


@njit(cache=True, error_model="numpy")
@no_type_check
def _locate(x, p, origin, inverse, strides, counts, shift, axis, fraction):
    """Return the index of the lowest sample around a particle, and write the particle's position between samples to ``fraction``.

    Samples lie ``shift`` cells above the nodes along each axis except ``axis``, along which they lie at the nodes.
    """
    base = 0
    for b in range(strides.shape[0]):
        s = (x[p, b] - origin[b]) * inverse - (0.0 if b == axis else shift)
        s = min(max(s, 1.0), counts[b] - 2.001)  # this order gives a valid index even for NaN
        i = int(s)
        fraction[b] = s - i
        base += i * strides[b]
    return base


@njit(cache=True, error_model="numpy")
@no_type_check
def _corner_weights(fraction, weight):
    weight[0] = 1.0
    for b in range(fraction.shape[0]):
        f, half = fraction[b], 1 << b
        for k in range(half):
            weight[k + half] = weight[k] * f
            weight[k] *= 1.0 - f


@njit(cache=True, error_model="numpy")
@no_type_check
def scatter(pos, vel, volume, viscosity, origin, inverse, strides, counts, corners, velocity, weight, density, viscous, touched):
    """Add particles to the grid.

    Args:
        pos, vel: positions and velocities [node, dim] in m and m/s.
        volume: volume of each particle, in cells [node].
        viscosity: kinematic viscosity [node] in m²/s.
        velocity, weight: results; Σ w V v and Σ w V on faces [axis, cell].
        density, viscous: results; Σ w V and Σ w V ν at cell centres [cell].
        touched: result; set to True where any of these changes [cell].
    """
    dim = pos.shape[1]
    fraction, w = np.empty(dim), np.empty(1 << dim)
    for p in range(pos.shape[0]):
        base = _locate(pos, p, origin, inverse, strides, counts, 0.5, -1, fraction)
        _corner_weights(fraction, w)
        for k in range(w.shape[0]):
            c, wv = base + corners[k], w[k] * volume[p]
            density[c] += wv
            viscous[c] += wv * viscosity[p]
            touched[c] = True
        for a in range(dim):
            base = _locate(pos, p, origin, inverse, strides, counts, 0.5, a, fraction)
            _corner_weights(fraction, w)
            for k in range(w.shape[0]):
                c, wv = base + corners[k], w[k] * volume[p]
                weight[a, c] += wv
                velocity[a, c] += wv * vel[p, a]
                touched[c] = True


@njit(cache=True, error_model="numpy")
@no_type_check
def normalize(active, cell_room, face_room, smallest_room, velocity, old, weight, density, viscous):
    """Divide the sums of ``scatter``, in place: momentum by mass, and mass by the open space. Velocities are also copied to ``old``.

    Cells with less open space than ``smallest_room`` are not divided by it. Faces with less are divided by ``smallest_room``.
    """
    for c in active:
        if cell_room[c] >= smallest_room:
            density[c] /= cell_room[c]
            viscous[c] /= cell_room[c]
        for a in range(velocity.shape[0]):
            if weight[a, c] > 0.0:
                velocity[a, c] /= weight[a, c]
                old[a, c] = velocity[a, c]
                weight[a, c] /= max(face_room[a, c], smallest_room)


@njit(cache=True, error_model="numpy")
@no_type_check
def add_impulse(active, impulse, weight, velocity):
    """Add an impulse per mass [dim] in m/s to the velocity of all faces that particles reach."""
    for c in active:
        for a in range(velocity.shape[0]):
            if weight[a, c] > 0.0:
                velocity[a, c] += impulse[a]


@njit(cache=True, error_model="numpy")
@no_type_check
def _distance_and_normal(x, p, origin, inverse, strides, counts, corners, distance, fraction, w, normal):
    """Interpolate the solids' signed distance [cells] at a particle; write its normalised gradient to ``normal``."""
    dim = strides.shape[0]
    base = _locate(x, p, origin, inverse, strides, counts, 0.0, -1, fraction)
    _corner_weights(fraction, w)
    value = 0.0
    for k in range(w.shape[0]):
        value += w[k] * distance[base + corners[k]]
    length = 0.0
    for b in range(dim):
        slope = 0.0
        for k in range(w.shape[0]):
            if k >> b & 1:
                part = 1.0
                for n in range(dim):
                    if n != b:
                        part *= fraction[n] if k >> n & 1 else 1.0 - fraction[n]
                slope += part * (distance[base + corners[k]] - distance[base + corners[k] - strides[b]])
        normal[b] = slope
        length += slope * slope
    length = math.sqrt(length)
    for b in range(dim):
        normal[b] = normal[b] / length if length > 0.0 else 0.0
    return value


@njit(cache=True, error_model="numpy")
@no_type_check
def extend_into_solids(active, origin, spacing, strides, counts, corners, distance, face_distance, weight, velocity):
    """Extrapolate velocities to faces whose centre lies in a solid: that of nearby faces in free space, without the component normal to the solid.

    In the transfers, the liquid then slips along solids of any direction (Batty et al. 2007, section 4.3). Pressure may drive fast flow through the smallest
    openings; that flow then moves no particle.
    """
    dim = strides.shape[0]
    fraction, w, normal, point = np.empty(dim), np.empty(1 << dim), np.empty(dim), np.empty((1, dim))
    around = np.empty(dim)
    new = np.empty((dim, active.shape[0]))
    for n in range(active.shape[0]):
        c = active[n]
        for a in range(dim):
            if face_distance[a, c] > 0.0 or not weight[a, c] > 0.0:
                continue
            rest = c
            for b in range(dim):
                i = rest // strides[b]
                rest -= i * strides[b]
                point[0, b] = origin[b] + (i + (0.0 if b == a else 0.5)) * spacing
            _distance_and_normal(point, 0, origin, 1.0 / spacing, strides, counts, corners, distance, fraction, w, normal)
            for b in range(dim):
                total, count = 0.0, 0
                if b == a:
                    for m in range(2 * dim):
                        face = c + (strides[m // 2] if m % 2 == 0 else -strides[m // 2])
                        if face_distance[a, face] > 0.0 and weight[a, face] > 0.0:
                            total += velocity[a, face]
                            count += 1
                else:
                    for m in range(4):
                        face = c + (strides[b] if m % 2 == 1 else 0) - (strides[a] if m >= 2 else 0)
                        if face_distance[b, face] > 0.0 and weight[b, face] > 0.0:
                            total += velocity[b, face]
                            count += 1
                around[b] = total / count if count > 0 else 0.0
            inward = 0.0
            for b in range(dim):
                inward += around[b] * normal[b]
            new[a, n] = around[a] - inward * normal[a]
    for n in range(active.shape[0]):
        c = active[n]
        for a in range(dim):
            if not face_distance[a, c] > 0.0 and weight[a, c] > 0.0:
                velocity[a, c] = new[a, n]


@njit(cache=True, error_model="numpy")
@no_type_check
def gather(pos, vel, origin, spacing, strides, counts, corners, old, new, shift, weight, pic, h):
    """Move the particles with the grid for a time h, in place.

    With grid velocities interpolated to a particle, v ← (1 − pic) (v + u_new − u_old) + pic u_new. The position moves with u_new by the midpoint rule, and by
    ``shift``; both together by at most ``LONGEST_MOVE``.

    Args:
        pos, vel: positions and velocities of the particles [node, dim].
        old, new: velocities on faces before and after the forces [axis, cell] in m/s.
        shift: displacement on faces [axis, cell] in m.
        weight: weights of faces [axis, cell]; the velocity is known where the weight is positive.
        pic: fraction of the grid's velocity in the new velocity of a particle.
    """
    dim = strides.shape[0]
    inverse = 1.0 / spacing
    fraction, w, move, push = np.empty(dim), np.empty(1 << dim), np.empty(dim), np.empty(dim)
    middle = np.empty((1, dim))
    for p in range(pos.shape[0]):
        for a in range(dim):
            base = _locate(pos, p, origin, inverse, strides, counts, 0.5, a, fraction)
            _corner_weights(fraction, w)
            before = after = correction = 0.0
            for k in range(w.shape[0]):
                c = base + corners[k]
                before += w[k] * old[a, c]
                after += w[k] * new[a, c]
                correction += w[k] * shift[a, c]
            vel[p, a] = (1.0 - pic) * (vel[p, a] + after - before) + pic * after
            move[a] = after
            push[a] = correction
            middle[0, a] = pos[p, a] + 0.5 * h * after
        length = 0.0
        for a in range(dim):
            base = _locate(middle, 0, origin, inverse, strides, counts, 0.5, a, fraction)
            _corner_weights(fraction, w)
            total = known = 0.0
            for k in range(w.shape[0]):
                c = base + corners[k]
                if weight[a, c] > 0.0:
                    total += w[k] * new[a, c]
                    known += w[k]
            if known > 0.0:
                move[a] = total / known
            move[a] = h * move[a] + push[a]
            length += move[a] * move[a]
        longest = LONGEST_MOVE * spacing
        scale = longest / math.sqrt(length) if length > longest * longest else 1.0
        for a in range(dim):
            pos[p, a] += scale * move[a]


@njit(cache=True, error_model="numpy")
@no_type_check
def push_out(pos, vel, origin, spacing, strides, counts, corners, distance):
    """Move particles that are inside a solid or nearer than ``CONTACT`` out along its normal, and remove the inward part of their velocity, in place."""
    dim = strides.shape[0]
    inverse = 1.0 / spacing
    fraction, w, normal = np.empty(dim), np.empty(1 << dim), np.empty(dim)
    for p in range(pos.shape[0]):
        if distance[_locate(pos, p, origin, inverse, strides, counts, 0.0, -1, fraction)] > 2.0:
            continue  # more than a cell away
        for _ in range(3):  # corners need one pass per surface
            room = _distance_and_normal(pos, p, origin, inverse, strides, counts, corners, distance, fraction, w, normal)
            if room >= CONTACT:
                break
            inward = 0.0
            for a in range(dim):
                pos[p, a] += (CONTACT - room) * spacing * normal[a]
                inward += vel[p, a] * normal[a]
            if inward < 0.0:
                for a in range(dim):
                    vel[p, a] -= inward * normal[a]


@njit(cache=True, error_model="numpy")
@no_type_check
def clear(active, strides, velocity, old, shift, weight, density, viscous, touched, liquid, viscous_face):
    """Set the arrays of ``solver.Fields`` to zero in the active cells and on their upper faces, after a substep."""
    dim = strides.shape[0]
    for c in active:
        density[c] = viscous[c] = 0.0
        touched[c] = False
        liquid[c] = 0
        for a in range(dim):
            viscous_face[a, c] = 0
            for face in (c, c + strides[a]):
                velocity[a, face] = old[a, face] = shift[a, face] = weight[a, face] = 0.0
