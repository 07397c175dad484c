"""Preconditioned conjugate gradients for sparse symmetric positive (semi-)definite systems, shared by pressure and viscosity.

A matrix is stored as its ``diagonal`` and its strict lower triangle by rows: row i has ``value[k]`` in column ``column[k] < i`` for k in
``start[i] … start[i + 1]``.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
@no_type_check
def incomplete_cholesky(diagonal, start, column, value, modified):
    """Return the inverse pivots 1/d of the preconditioner ``(D + L) D⁻¹ (D + Lᵀ)``, with L the strict lower triangle of the matrix.

    With ``modified = 0`` the preconditioner has the diagonal of the matrix. With ``modified = 1`` it has the row sums of the matrix, if the graph of the matrix
    has no triangles: MIC(0) of Gustafsson 1978. Values just below 1 are safer. A pivot below a quarter of the diagonal is replaced by the diagonal (Bridson
    2015, section 5.3).
    """
    n = diagonal.shape[0]
    inverse, below = np.empty(n), np.zeros(n)
    for k in range(column.shape[0]):
        below[column[k]] += value[k]
    for i in range(n):
        pivot = diagonal[i]
        for k in range(start[i], start[i + 1]):
            j, a = column[k], value[k]
            pivot -= a * (a + modified * (below[j] - a)) * inverse[j]
        inverse[i] = 1.0 / (pivot if pivot >= 0.25 * diagonal[i] else diagonal[i])
    return inverse


@njit(cache=True, error_model="numpy")
@no_type_check
def _multiply(diagonal, start, column, value, x, out):
    """Write the product with x to ``out``; return its inner product with x."""
    total = 0.0
    for i in range(x.shape[0]):
        xi = x[i]
        row = 0.0
        for k in range(start[i], start[i + 1]):
            row += value[k] * x[column[k]]
            out[column[k]] += value[k] * xi
        out[i] = diagonal[i] * xi + row
        total += xi * (diagonal[i] * xi + 2.0 * row)
    return total


@njit(cache=True, error_model="numpy")
@no_type_check
def _precondition(start, column, value, inverse, r, z, above):
    """Solve ``(D + L) D⁻¹ (D + Lᵀ) z = r``; return the inner product of r and z. ``above`` is scratch space."""
    n = r.shape[0]
    for i in range(n):
        total = r[i]
        for k in range(start[i], start[i + 1]):
            total -= value[k] * z[column[k]]
        z[i] = total * inverse[i]
        above[i] = 0.0
    product = 0.0
    for i in range(n - 1, -1, -1):
        zi = z[i] - above[i] * inverse[i]
        z[i] = zi
        product += r[i] * zi
        for k in range(start[i], start[i + 1]):
            above[column[k]] += value[k] * zi
    return product


@njit(cache=True, error_model="numpy")
@no_type_check
def conjugate_gradients(diagonal, start, column, value, right, inverse, x, tolerance, max_iterations):
    """Solve the system with the right-hand side ``right``, in place from the first guess ``x``, until the largest residual is at most ``tolerance``.

    ``inverse`` is the result of ``incomplete_cholesky``. Return the number of iterations, at most ``max_iterations``, and the largest residual, which may
    exceed the tolerance then.
    """
    n = x.shape[0]
    r, z, s, q, above = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    _multiply(diagonal, start, column, value, x, q)
    worst = 0.0
    for i in range(n):
        r[i] = right[i] - q[i]
        worst = max(worst, abs(r[i])) if math.isfinite(r[i]) else math.inf
        s[i] = 0.0
    iterations, rho_old = 0, 1.0
    while worst > tolerance and iterations < max_iterations and math.isfinite(worst):
        rho = _precondition(start, column, value, inverse, r, z, above)
        beta = rho / rho_old if iterations > 0 else 0.0
        rho_old = rho
        for i in range(n):
            s[i] = z[i] + beta * s[i]
        curvature = _multiply(diagonal, start, column, value, s, q)
        if not curvature > 0.0:
            break
        alpha = rho / curvature
        worst = 0.0
        for i in range(n):
            x[i] += alpha * s[i]
            r[i] -= alpha * q[i]
            worst = max(worst, abs(r[i])) if math.isfinite(r[i]) else math.inf
        iterations += 1
    return iterations, worst
