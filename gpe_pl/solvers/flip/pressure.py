"""Pressure: the projection onto divergence-free velocities between curved solids and a free surface.

Solids enter by the open fractions A of the faces (Batty, Bertails and Bridson 2007; the finite-volume form of Ng, Min and Gibou 2009). The free surface enters
by the ghost fluid method (Enright et al. 2003): it cuts the line between a liquid and an empty cell at the fraction θ, and pressure is zero there. With the
scaled pressure ``p = h P / (ρ Δ)`` in m/s, the equations of the liquid cells and the update of their faces are ::

    Σ_faces ± A (u - Δp) = 0,    u ← u - Δp,    Δp = p_c - p_n   or   p_c / θ towards an empty cell

The correction of the particle density uses the same matrix (Kugelstadt et al. 2019).

Arguments named like attributes of ``Grid``, ``Solids`` (both in ``grid``) or ``solver.Fields`` are these arrays. ``active`` are the indices of the cells that
liquid reaches. ``unknown`` [cell] has the number of each liquid cell from 1, and 0 elsewhere. ``half`` is ``grid.HALF``.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

SMALLEST_FRACTION = 0.01
"""Lower limit of θ."""


@njit(cache=True, error_model="numpy")
@no_type_check
def surface_distance(density):
    """Return the signed distance to the free surface in cells, negative in the liquid, from the density at a cell centre; exact for axis-aligned planes."""
    if density >= 0.5:
        return math.sqrt(2.0 * max(0.0, 1.0 - density)) - 1.0
    return 1.0 - math.sqrt(2.0 * max(0.0, density))


@njit(cache=True, error_model="numpy")
@no_type_check
def _drop(inside, outside):
    """Return 1/θ of the face between a liquid and an empty cell, from the signed distances inside and outside."""
    return 1.0 / max(SMALLEST_FRACTION, inside / (inside - outside))


@njit(cache=True, error_model="numpy")
@no_type_check
def reach_into_solids(active, strides, area, cell_room, half, density, touched):
    """Mark as touched each open cell whose centre lies in a solid, if a neighbour contains mass and has its centre in free space."""
    for n in active:
        if not density[n] > 0.0 or cell_room[n] < half:
            continue
        for m in range(2 * strides.shape[0]):
            c = n + strides[m // 2] if m % 2 == 0 else n - strides[m // 2]
            if cell_room[c] < half and area[m // 2, max(n, c)] > 0.0:
                touched[c] = True


@njit(cache=True, error_model="numpy")
@no_type_check
def extend_into_solids(active, strides, area, cell_room, half, density, viscous):
    """Extrapolate density and viscosity into cells whose centre lies in a solid.

    Such cells contain few particles. With their own density, which is too low, the correction of the density would draw liquid into them. The new density is
    the mean over the cell's open space and over further open space ``half`` that is filled like the open neighbours. Without the cell's own mass in this mean,
    particles would gather in the cell.
    """
    for c in active:
        if cell_room[c] >= half:
            continue
        opening = total = total_viscous = 0.0
        for k in range(2 * strides.shape[0]):
            other = c + strides[k // 2] if k % 2 == 0 else c - strides[k // 2]
            if cell_room[other] >= half:
                part = area[k // 2, max(c, other)]
                opening += part
                total += part * density[other]
                total_viscous += part * viscous[other]
        if opening > 0.0:
            density[c] = (density[c] + half * total / opening) / (cell_room[c] + half)
            viscous[c] = (viscous[c] + half * total_viscous / opening) / (cell_room[c] + half)


@njit(cache=True, error_model="numpy")
@no_type_check
def liquid_cells(active, is_open, density, unknown):
    """Write the numbers of the liquid cells, from 1, to ``unknown`` [cell], and return the indices of these cells [liquid]."""
    found = np.empty(active.shape[0], dtype=np.int64)
    n = 0
    for c in active:
        if density[c] >= 0.5 and is_open[c]:
            found[n] = c
            n += 1
            unknown[c] = n
    return found[:n].copy()


@njit(cache=True, error_model="numpy")
@no_type_check
def fill_open_faces(liquid, strides, area, weight, velocity, touch):
    """Give open faces of liquid cells that no particle reaches the mean velocity of their neighbours, and the weight ``touch``."""
    dim = strides.shape[0]
    for c in liquid:
        for m in range(2 * dim):
            a = m // 2
            face = c + (strides[a] if m % 2 == 1 else 0)
            if area[a, face] > 0.0 and not weight[a, face] > 0.0:
                total, count = 0.0, 0
                for n in range(2 * dim):
                    other = face + (strides[n // 2] if n % 2 == 0 else -strides[n // 2])
                    if weight[a, other] > touch:
                        total += velocity[a, other]
                        count += 1
                velocity[a, face] = total / count if count > 0 else 0.0
                weight[a, face] = touch


@njit(cache=True, error_model="numpy")
@no_type_check
def pressure_matrix(liquid, unknown, strides, area, density):
    """Return the matrix of the scaled pressure over the liquid cells: diagonal and lower triangle as in ``linear``."""
    dim, n = strides.shape[0], liquid.shape[0]
    diagonal, start = np.zeros(n), np.zeros(n + 1, dtype=np.int64)
    column, value = np.empty(n * dim, dtype=np.int64), np.empty(n * dim)
    entries = 0
    for i in range(n):
        c = liquid[i]
        inside = surface_distance(density[c])
        for a in range(dim):
            s = strides[a]
            low, high = area[a, c], area[a, c + s]
            if low > 0.0:
                j = unknown[c - s] - 1
                if j >= 0:
                    diagonal[i] += low
                    column[entries], value[entries] = j, -low
                    entries += 1
                else:
                    diagonal[i] += low * _drop(inside, surface_distance(density[c - s]))
            if high > 0.0:
                diagonal[i] += high * (1.0 if unknown[c + s] > 0 else _drop(inside, surface_distance(density[c + s])))
        start[i + 1] = entries
    return diagonal, start, column[:entries].copy(), value[:entries].copy()


@njit(cache=True, error_model="numpy")
@no_type_check
def inflow(liquid, strides, area, velocity):
    """Return the sum over the faces of each liquid cell of the inward velocity times the open fraction [m/s]."""
    total = np.zeros(liquid.shape[0])
    for i in range(liquid.shape[0]):
        c = liquid[i]
        for a in range(strides.shape[0]):
            total[i] += area[a, c] * velocity[a, c] - area[a, c + strides[a]] * velocity[a, c + strides[a]]
    return total


@njit(cache=True, error_model="numpy")
@no_type_check
def subtract_gradient(liquid, unknown, strides, area, density, pressure, velocity):
    """Subtract the gradient of the scaled pressure from the velocities on the open faces of the liquid cells."""
    for i in range(liquid.shape[0]):
        c = liquid[i]
        inside = surface_distance(density[c])
        for a in range(strides.shape[0]):
            s = strides[a]
            if area[a, c] > 0.0:
                j = unknown[c - s] - 1
                if j >= 0:
                    velocity[a, c] -= pressure[i] - pressure[j]
                else:
                    velocity[a, c] -= pressure[i] * _drop(inside, surface_distance(density[c - s]))
            if area[a, c + s] > 0.0 and unknown[c + s] == 0:
                velocity[a, c + s] += pressure[i] * _drop(inside, surface_distance(density[c + s]))


@njit(cache=True, error_model="numpy")
@no_type_check
def excess_density(liquid, unknown, strides, is_open, density, largest):
    """Return the relative volume by which each liquid cell should expand, within ``±largest``; cells next to empty ones never contract."""
    dim = strides.shape[0]
    excess = np.empty(liquid.shape[0])
    total = 1
    for _ in range(dim):
        total *= 3
    for i in range(liquid.shape[0]):
        value = min(largest, max(-largest, density[liquid[i]] - 1.0))
        if value < 0.0:
            for k in range(total):
                c, rest = liquid[i], k
                for b in range(dim):
                    c += (rest % 3 - 1) * strides[b]
                    rest //= 3
                if unknown[c] == 0 and is_open[c]:
                    value = 0.0
        excess[i] = value
    return excess
