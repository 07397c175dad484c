"""Compiled loops of ``nn.island_momentum``: they remove the rigid part of the accelerations of groups of nodes, on a CPU.

Sums are in double precision.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

NUM_SWEEPS = 12
"""Sweeps of rotations that make a matrix [3, 3] diagonal; they converge quadratically."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def remove_rigid_part(acceleration, mass, pos, group, share, angular, smallest):
    """Subtract a share of the rigid part from accelerations, in place; ``island_momentum`` has the equations.

    Args:
        acceleration: accelerations [node, dim].
        mass: masses [node].
        pos: positions [node, dim].
        group: island or body of each node [node].
        share: share of the rigid part of each group that is removed [group].
        angular: also remove rotations.
        smallest: fraction of the largest principal moment of inertia below which a group does not rotate about an axis.
    """
    num_nodes, dim = acceleration.shape
    count = len(share)
    total, mean, centre = np.zeros(count), np.zeros((count, dim)), np.zeros((count, dim))
    for n in range(num_nodes):
        g = group[n]
        total[g] += mass[n]
        for d in range(dim):
            mean[g, d] += mass[n] * acceleration[n, d]
            centre[g, d] += mass[n] * pos[n, d]
    for g in range(count):
        if total[g] > 0:
            for d in range(dim):
                mean[g, d] /= total[g]
                centre[g, d] /= total[g]
    turn = np.zeros((count, 3))
    if angular:
        _rotations(acceleration, mass, pos, group, share, mean, centre, smallest, turn)
    for n in range(num_nodes):
        g = group[n]
        if share[g] == 0:
            continue
        x, y = pos[n, 0] - centre[g, 0], pos[n, 1] - centre[g, 1]
        z = pos[n, 2] - centre[g, 2] if dim == 3 else 0.0
        acceleration[n, 0] -= share[g] * (mean[g, 0] + (turn[g, 1] * z - turn[g, 2] * y))
        acceleration[n, 1] -= share[g] * (mean[g, 1] + (turn[g, 2] * x - turn[g, 0] * z))
        if dim == 3:
            acceleration[n, 2] -= share[g] * (mean[g, 2] + (turn[g, 0] * y - turn[g, 1] * x))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def replace_rigid_part(acceleration, forces, mass, pos, body, count, are_rigid, only_contacts, smallest):
    """Change accelerations as ``island_momentum.moved_by_contacts``, in place."""
    num_nodes, dim = acceleration.shape
    group, share, change = body.copy(), np.ones(count + 1), acceleration.copy()
    share[count] = 0.0
    for n in range(num_nodes):
        group[n] = body[n] if body[n] >= 0 else count
        if are_rigid:
            for d in range(dim):
                change[n, d] = forces[n, d] - acceleration[n, d]
    rest = change.copy()
    if are_rigid or not only_contacts:
        remove_rigid_part(rest, mass, pos, group, share, True, smallest)
    for n in range(num_nodes):
        if body[n] < 0:
            continue
        for d in range(dim):
            rigid = change[n, d] - rest[n, d]
            if are_rigid:
                acceleration[n, d] += rigid
            elif only_contacts:
                acceleration[n, d] = forces[n, d]
            else:
                acceleration[n, d] += forces[n, d] - rigid


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _rotations(acceleration, mass, pos, group, share, mean, centre, smallest, turn):
    """Write the angular acceleration of each group, about its centre of mass, to ``turn`` [group, 3]."""
    num_nodes, dim = acceleration.shape
    moment, inertia = np.zeros((len(share), 3)), np.zeros((len(share), 3, 3))
    r, a = np.zeros(3), np.zeros(3)
    for n in range(num_nodes):
        g, m = group[n], mass[n]
        if share[g] == 0:
            continue
        for d in range(dim):
            r[d], a[d] = pos[n, d] - centre[g, d], acceleration[n, d] - mean[g, d]
        square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            moment[g, c] += m * (r[d] * a[e] - r[e] * a[d])
            for d in range(3):
                inertia[g, c, d] += m * ((square if c == d else 0.0) - r[c] * r[d])
    for g in range(len(share)):
        if share[g] == 0:
            continue
        if dim == 2:
            turn[g, 2] = moment[g, 2] / inertia[g, 2, 2] if inertia[g, 2, 2] > 0 else 0.0
        else:
            solved = _solved(inertia[g], moment[g], smallest)
            for d in range(3):
                turn[g, d] = solved[d]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _solved(matrix, right, smallest):
    """Return the product of a vector and the pseudo-inverse of a symmetric matrix [3, 3], which becomes diagonal (Jacobi 1846)."""
    axes = np.eye(3)
    for _ in range(NUM_SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2 * matrix[p, q])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1))
                c = 1 / np.sqrt(t * t + 1)
                s = t * c
                for k in range(3):
                    x, y = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = axes[k, p], axes[k, q]
                    axes[k, p], axes[k, q] = c * x - s * y, s * x + c * y
    largest = max(abs(matrix[0, 0]), abs(matrix[1, 1]), abs(matrix[2, 2]))
    found = np.zeros(3)
    for k in range(3):
        if abs(matrix[k, k]) > smallest * largest:
            amount = (axes[0, k] * right[0] + axes[1, k] * right[1] + axes[2, k] * right[2]) / matrix[k, k]
            for d in range(3):
                found[d] += amount * axes[d, k]
    return found
