"""Viscosity: an implicit step of the full viscous stress with a free surface and no-slip solids.

The velocities after a time h minimise, over all faces f and stress samples s (Batty and Bridson 2008), ::

    Σ_f m_f (u_f - u*_f)² / 2  +  h Σ_s w_s ν_s ε_s : ε_s,     ε = (∇u + ∇uᵀ) / 2

The free surface therefore needs no condition, and velocities without strain, such as rigid rotations, do not change. Masses m and weights w are the densities
that the particles give to the grid, so momentum is conserved. Normal strains are sampled at cell centres, shear strains at edges. If one of the two faces in a
difference quotient has a solid centre, the surface of the solid is used instead of that face: velocity is 0 at the fraction θ of the distance. The weight is
multiplied by θ, which gives the finite-volume flux to a wall at that distance.

Arguments named like attributes of ``Grid``, ``Solids`` (both in ``grid``) or ``solver.Fields`` are these arrays. ``active`` are the indices of the cells that
liquid reaches. ``unknown`` [axis, cell] has the number of each face in the system from 1, and 0 elsewhere. ``step`` is h / Δ² in s/m².
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

SMALLEST_FRACTION = 0.1
"""Lower limit of θ."""

SMALLEST_MASS = 1e-6
"""Density below which faces are ignored."""


@njit(cache=True, error_model="numpy")
@no_type_check
def viscous_faces(active, face_distance, weight, unknown):
    """Write the numbers of the faces in free space that particles reach, from 1, to ``unknown`` [axis, cell], and return axes and cells of these faces."""
    dim = weight.shape[0]
    axes, cells = np.empty(dim * active.shape[0], dtype=np.int64), np.empty(dim * active.shape[0], dtype=np.int64)
    n = 0
    for c in active:
        for a in range(dim):
            if face_distance[a, c] > 0.0 and weight[a, c] > SMALLEST_MASS:
                axes[n], cells[n] = a, c
                n += 1
                unknown[a, c] = n
    return axes[:n].copy(), cells[:n].copy()


@njit(cache=True, error_model="numpy")
@no_type_check
def _theta(a, upper, lower, unknown, face_distance):
    """Return the fraction θ of the distance between two faces; 0 if nothing is known, negative if both are solid."""
    if unknown[a, upper] > 0 and unknown[a, lower] > 0:
        return 1.0
    if face_distance[a, upper] > 0.0 and face_distance[a, lower] > 0.0:
        return 0.0  # a face in free space without liquid
    if unknown[a, upper] > 0 or unknown[a, lower] > 0:
        liquid, solid = (upper, lower) if unknown[a, upper] > 0 else (lower, upper)
        inside, outside = face_distance[a, liquid], face_distance[a, solid]
        return min(1.0, max(SMALLEST_FRACTION, inside / (inside - outside)))
    if face_distance[a, upper] > 0.0 or face_distance[a, lower] > 0.0:
        return 0.0
    return -1.0


@njit(cache=True, error_model="numpy")
@no_type_check
def viscosity_system(axes, cells, unknown, strides, is_open, face_distance, weight, viscous, velocity, step):
    """Return the matrix over the viscous faces and its right-hand side m u*.

    Args:
        axes, cells, unknown: results of ``viscous_faces``.
        weight: density of faces [axis, cell].
        viscous: density times kinematic viscosity of cells [cell] in m²/s.
        velocity: velocities on faces [axis, cell] in m/s.
        step: h / Δ² in s/m².
    """
    n, dim = axes.shape[0], strides.shape[0]
    most = 3 * dim  # lower neighbours of a face: one along its own axis, and at most three per other axis
    diagonal, start, right = np.zeros(n), np.zeros(n + 1, dtype=np.int64), np.empty(n)
    column, value = np.empty(n * most, dtype=np.int64), np.empty(n * most)
    entries = 0
    for i in range(n):
        a, c = axes[i], cells[i]
        diagonal[i] += weight[a, c]
        right[i] = weight[a, c] * velocity[a, c]
        sa = strides[a]
        for side in range(2):  # normal strain in the cells below and above the face
            center = c if side == 1 else c - sa
            other = c + sa if side == 1 else c - sa
            theta = _theta(a, c, other, unknown, face_distance)
            if theta > 0.0 and viscous[center] > 0.0:
                k = 2.0 * step * viscous[center] / theta
                diagonal[i] += k
                j = unknown[a, other] - 1
                if 0 <= j < i:
                    column[entries], value[entries] = j, -k
                    entries += 1
        for b in range(dim):
            if b == a:
                continue
            sb = strides[b]
            for side in range(2):  # shear strain at the edges below and above the face
                edge = c if side == 0 else c + sb
                total, count = 0.0, 0
                for k in range(4):
                    around = edge - (sa if k % 2 == 1 else 0) - (sb if k >= 2 else 0)
                    if is_open[around]:
                        total += viscous[around]
                        count += 1
                theta_a = _theta(a, edge, edge - sb, unknown, face_distance)
                theta_b = _theta(b, edge, edge - sa, unknown, face_distance)
                if not total > 0.0 or theta_a == 0.0 or theta_b == 0.0:
                    continue
                fraction = min(theta_a, theta_b) if theta_b > 0.0 else theta_a
                mine = (1.0 if side == 0 else -1.0) / theta_a
                k = step * total / count * fraction * mine
                diagonal[i] += k * mine
                j = unknown[a, edge - sb if side == 0 else edge] - 1
                if 0 <= j < i:
                    column[entries], value[entries] = j, -k * mine
                    entries += 1
                if theta_b > 0.0:
                    j = unknown[b, edge] - 1
                    if 0 <= j < i:
                        column[entries], value[entries] = j, k / theta_b
                        entries += 1
                    j = unknown[b, edge - sa] - 1
                    if 0 <= j < i:
                        column[entries], value[entries] = j, -k / theta_b
                        entries += 1
        start[i + 1] = entries
    return diagonal, start, column[:entries].copy(), value[:entries].copy(), right


@njit(cache=True, error_model="numpy")
@no_type_check
def drag_on_solids(active, strides, area, face_distance, density, viscous, velocity, step):
    """Slow down open faces whose centre lies in a solid, as if all their neighbours were at rest, because the liquid there is next to the wall."""
    dim = strides.shape[0]
    for c in active:
        for a in range(dim):
            below = c - strides[a]
            mass = density[c] + density[below]
            if area[a, c] > 0.0 and not face_distance[a, c] > 0.0 and mass > 0.0:
                velocity[a, c] /= 1.0 + 2.0 * dim * step * (viscous[c] + viscous[below]) / mass
