"""Constitutive laws in three dimensions: the laws of ``laws_2d``, on tuples.

A tensor is a tuple of its nine entries by rows. A symmetric tensor is a tuple of the six entries of its upper triangle by rows: 00, 01, 02, 11, 12, 22.
"""

from __future__ import annotations

import math
from typing import no_type_check

from numba import njit

from gpe_pl.solvers.materials import COEFFICIENT, ELASTOMER, INTERCEPT, LAMBDA, LARGEST, MAX_HARDENING, MU, SAND, SMALLEST, SNOW, TIP
from gpe_pl.solvers.mpm.laws_2d import SMALLEST_SQUARE, hardening


@njit(cache=True, error_model="numpy")
@no_type_check
def left_cauchy_green(f):
    """Return the symmetric tensor ``F Fᵀ``."""
    return (
        f[0] * f[0] + f[1] * f[1] + f[2] * f[2],
        f[0] * f[3] + f[1] * f[4] + f[2] * f[5],
        f[0] * f[6] + f[1] * f[7] + f[2] * f[8],
        f[3] * f[3] + f[4] * f[4] + f[5] * f[5],
        f[3] * f[6] + f[4] * f[7] + f[5] * f[8],
        f[6] * f[6] + f[7] * f[7] + f[8] * f[8],
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def spectral(b):
    """Return the principal values of a symmetric tensor, in no particular order, and their orthonormal axes (as rows, nine entries).

    This is a closed form in the order of Eberly 2014 ("A robust eigensolver for 3x3 symmetric matrices"). The cubic for the deviator has one well separated
    root, whose axis is a cross product. A two-dimensional problem remains in the plane normal to it. The method works for repeated and tiny principal values.
    """
    q = (b[0] + b[3] + b[5]) / 3.0
    d00, d01, d02, d11, d12, d22 = b[0] - q, b[1], b[2], b[3] - q, b[4], b[5] - q
    square = (d00 * d00 + d11 * d11 + d22 * d22 + 2.0 * (d01 * d01 + d02 * d02 + d12 * d12)) / 6.0
    scale = math.sqrt(square)
    if not scale > 1e-16 * q:
        return (b[0], b[3], b[5]), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    determinant = d00 * (d11 * d22 - d12 * d12) - d01 * (d01 * d22 - d12 * d02) + d02 * (d01 * d12 - d11 * d02)
    r = determinant / (2.0 * square * scale)
    side = 1.0 if r >= 0.0 else -1.0
    r = min(1.0, abs(r))
    # 4x³ - 3x = r has its only root above 1/2 in [cos 30°, 1], where Newton's method converges to rounding in three steps
    x = 0.8660254037844386 + r * (0.1666666666666667 - 0.0326920704511053 * r)
    for _ in range(3):
        x -= (x * (4.0 * x * x - 3.0) - r) / (12.0 * x * x - 3.0)
    root = side * 2.0 * scale * x
    # two rows of D - root I span the plane normal to the axis; the pair with the largest cross product is the most accurate
    a00, a11, a22 = d00 - root, d11 - root, d22 - root
    u0, u1, u2 = d01 * d12 - d02 * a11, d02 * d01 - a00 * d12, a00 * a11 - d01 * d01
    norm = u0 * u0 + u1 * u1 + u2 * u2
    v0, v1, v2 = d01 * a22 - d02 * d12, d02 * d02 - a00 * a22, a00 * d12 - d01 * d02
    other = v0 * v0 + v1 * v1 + v2 * v2
    if other > norm:
        u0, u1, u2, norm = v0, v1, v2, other
    v0, v1, v2 = a11 * a22 - d12 * d12, d12 * d02 - d01 * a22, d01 * d12 - a11 * d02
    other = v0 * v0 + v1 * v1 + v2 * v2
    if other > norm:
        u0, u1, u2, norm = v0, v1, v2, other
    norm = 1.0 / math.sqrt(norm)
    u0, u1, u2 = u0 * norm, u1 * norm, u2 * norm
    if abs(u0) > abs(u1):
        norm = 1.0 / math.sqrt(u0 * u0 + u2 * u2)
        v0, v1, v2 = -u2 * norm, 0.0, u0 * norm
    else:
        norm = 1.0 / math.sqrt(u1 * u1 + u2 * u2)
        v0, v1, v2 = 0.0, u2 * norm, -u1 * norm
    w0, w1, w2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    x0, x1, x2 = d00 * v0 + d01 * v1 + d02 * v2, d01 * v0 + d11 * v1 + d12 * v2, d02 * v0 + d12 * v1 + d22 * v2
    y0, y1, y2 = d00 * w0 + d01 * w1 + d02 * w2, d01 * w0 + d11 * w1 + d12 * w2, d02 * w0 + d12 * w1 + d22 * w2
    vv, vw, ww = v0 * x0 + v1 * x1 + v2 * x2, v0 * y0 + v1 * y1 + v2 * y2, w0 * y0 + w1 * y1 + w2 * y2
    half = 0.5 * (vv - ww)
    radius = math.sqrt(half * half + vw * vw)
    mean = q + 0.5 * (vv + ww)
    values = (q - vv - ww, mean + radius, mean - radius)  # the deviator has no trace
    if radius > 0.0:
        if half >= 0.0:
            cosine = math.sqrt(0.5 + 0.5 * half / radius)
            sine = 0.5 * vw / (radius * cosine)
        else:
            sine = math.sqrt(0.5 - 0.5 * half / radius)
            cosine = 0.5 * vw / (radius * sine)
        v0, v1, v2, w0, w1, w2 = (
            cosine * v0 + sine * w0,
            cosine * v1 + sine * w1,
            cosine * v2 + sine * w2,
            cosine * w0 - sine * v0,
            cosine * w1 - sine * v1,
            cosine * w2 - sine * v2,
        )
    return values, (u0, u1, u2, v0, v1, v2, w0, w1, w2)


@njit(cache=True, error_model="numpy")
@no_type_check
def _isotropic(u, v, w, a):
    """Return the symmetric tensor with principal values u, v and w along the axes."""
    return (
        u * a[0] * a[0] + v * a[3] * a[3] + w * a[6] * a[6],
        u * a[0] * a[1] + v * a[3] * a[4] + w * a[6] * a[7],
        u * a[0] * a[2] + v * a[3] * a[5] + w * a[6] * a[8],
        u * a[1] * a[1] + v * a[4] * a[4] + w * a[7] * a[7],
        u * a[1] * a[2] + v * a[4] * a[5] + w * a[7] * a[8],
        u * a[2] * a[2] + v * a[5] * a[5] + w * a[8] * a[8],
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def _stretched(f, u, v, w, axes):
    """Return F with its principal stretches multiplied by u, v and w."""
    m = _isotropic(u, v, w, axes)
    return (
        m[0] * f[0] + m[1] * f[3] + m[2] * f[6],
        m[0] * f[1] + m[1] * f[4] + m[2] * f[7],
        m[0] * f[2] + m[1] * f[5] + m[2] * f[8],
        m[1] * f[0] + m[3] * f[3] + m[4] * f[6],
        m[1] * f[1] + m[3] * f[4] + m[4] * f[7],
        m[1] * f[2] + m[3] * f[5] + m[4] * f[8],
        m[2] * f[0] + m[4] * f[3] + m[5] * f[6],
        m[2] * f[1] + m[4] * f[4] + m[5] * f[7],
        m[2] * f[2] + m[4] * f[5] + m[5] * f[8],
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def _squared_stretches(f):
    """Return the squared principal stretches with a lower bound, their axes, and F, or its left stretch tensor if the bound took effect."""
    (b1, b2, b3), axes = spectral(left_cauchy_green(f))
    if min(b1, b2, b3) < SMALLEST_SQUARE:
        b1, b2, b3 = max(b1, SMALLEST_SQUARE), max(b2, SMALLEST_SQUARE), max(b3, SMALLEST_SQUARE)
        m = _isotropic(math.sqrt(b1), math.sqrt(b2), math.sqrt(b3), axes)
        f = (m[0], m[1], m[2], m[1], m[3], m[4], m[2], m[4], m[5])
    return b1, b2, b3, axes, f


@njit(cache=True, error_model="numpy")
@no_type_check
def sand(f, volume_correction, lam, mu, slope, intercept=0.0, tip=0.0):
    """Apply the law of sand, as in ``laws_2d``. The cone is ``|dev ε| = k/(2μ) - α (3λ + 2μ)/(2μ) tr ε``.

    Args:
        f: trial elastic deformation gradient.
        volume_correction: volume v of the particle, as in ``laws_2d``.
        lam, mu: Lamé parameters [Pa].
        slope, intercept, tip: slope of the cone, ``|dev ε|`` at ``tr ε = 0``, and ``tr ε`` at the tip, as in ``laws_2d``.

    Returns:
        The return-mapped F, the new v, τ and the stiffness [Pa].
    """
    b1, b2, b3, axes, f = _squared_stretches(f)
    log_1, log_2, log_3 = 0.5 * math.log(b1), 0.5 * math.log(b2), 0.5 * math.log(b3)
    trace = log_1 + log_2 + log_3 + volume_correction
    if trace >= tip:
        stretch, tension = math.exp(tip / 3.0), (lam + 2.0 * mu / 3.0) * tip
        f, tau = (stretch, 0.0, 0.0, 0.0, stretch, 0.0, 0.0, 0.0, stretch), (tension, 0.0, 0.0, tension, 0.0, tension)
        return f, trace - tip, tau, lam + 2.0 * mu
    mean, share = trace / 3.0, volume_correction / 3.0
    dev_1, dev_2, dev_3 = log_1 + share - mean, log_2 + share - mean, log_3 + share - mean
    size, largest_size = math.sqrt(dev_1 * dev_1 + dev_2 * dev_2 + dev_3 * dev_3), -slope * trace + intercept
    if size > largest_size or volume_correction != 0.0:
        factor = min(1.0, largest_size / size) if size > 0.0 else 1.0
        dev_1, dev_2, dev_3 = factor * dev_1, factor * dev_2, factor * dev_3
        f = _stretched(f, math.exp(mean + dev_1 - log_1), math.exp(mean + dev_2 - log_2), math.exp(mean + dev_3 - log_3), axes)
    pressure = (lam + 2.0 * mu / 3.0) * trace
    tau = _isotropic(pressure + 2.0 * mu * dev_1, pressure + 2.0 * mu * dev_2, pressure + 2.0 * mu * dev_3, axes)
    return f, 0.0, tau, lam + 2.0 * mu - min(0.0, pressure + 2.0 * mu * min(dev_1, dev_2, dev_3))


@njit(cache=True, error_model="numpy")
@no_type_check
def snow(f, compaction, lam, mu, xi, smallest, largest, max_hardening):
    """Apply the law of snow; arguments as in ``laws_2d.snow``, with F as ``f``. Return the return-mapped F, the new compaction, τ and the stiffness [Pa]."""
    b1, b2, b3, axes, f = _squared_stretches(f)
    trial_1, trial_2, trial_3 = math.sqrt(b1), math.sqrt(b2), math.sqrt(b3)
    s1, s2, s3 = min(max(trial_1, smallest), largest), min(max(trial_2, smallest), largest), min(max(trial_3, smallest), largest)
    factor = hardening(compaction, xi, max_hardening)
    lam, mu, rest = factor * lam, factor * mu, lam + 2.0 * mu
    volume = s1 * s2 * s3
    if s1 != trial_1 or s2 != trial_2 or s3 != trial_3:
        f = _stretched(f, s1 / trial_1, s2 / trial_2, s3 / trial_3, axes)
        compaction = (1.0 + compaction) * (trial_1 * trial_2 * trial_3 / volume) - 1.0
        factor = hardening(compaction, xi, max_hardening)
    pressure = lam * (volume - 1.0) * volume
    tau = _isotropic(
        2.0 * mu * (s1 - 1.0) * s1 + pressure, 2.0 * mu * (s2 - 1.0) * s2 + pressure, 2.0 * mu * (s3 - 1.0) * s3 + pressure, axes
    )
    longest = max(s1, s2, s3)
    return f, compaction, tau, max(1.0, factor) * rest * max(1.0, longest * longest, volume * volume)


@njit(cache=True, error_model="numpy")
@no_type_check
def elastomer(f, lam, mu):
    """Apply the law of elastomers, ``τ = μ (b - I) + λ log J``. Return F, 0 (no plastic state), τ and the stiffness [Pa]."""
    b = left_cauchy_green(f)
    volume = abs(f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) + f[2] * (f[3] * f[7] - f[4] * f[6]))
    mean = (b[0] + b[3] + b[5]) / 3.0
    if not volume > SMALLEST_SQUARE * mean:  # about where the smallest stretch reaches its bound
        b1, b2, b3, _, f = _squared_stretches(f)
        b, volume = left_cauchy_green(f), math.sqrt(b1 * b2 * b3)
    pressure = lam * math.log(volume)
    tau = (mu * (b[0] - 1.0) + pressure, mu * b[1], mu * b[2], mu * (b[3] - 1.0) + pressure, mu * b[4], mu * (b[5] - 1.0) + pressure)
    # the largest principal value of b is at most mean + √(2/3) |dev b|
    deviator = (b[0] - mean) ** 2 + (b[3] - mean) ** 2 + (b[5] - mean) ** 2 + 2.0 * (b[1] * b[1] + b[2] * b[2] + b[4] * b[4])
    larger = mean + math.sqrt(2.0 / 3.0 * deviator)
    return f, 0.0, tau, max(lam + 2.0 * mu, mu * (1.0 + larger) + max(0.0, lam - pressure))


@njit(cache=True, error_model="numpy")
@no_type_check
def respond(law, f, plastic, constants, p):
    """Apply the law of particle ``p`` to its trial deformation gradient F; arguments as in ``laws_2d``.

    Return the return-mapped F, the new plastic state, τ and the stiffness [Pa]. For an unknown code, F is returned unchanged and the other results are NaN.
    """
    lam, mu = constants[p, LAMBDA], constants[p, MU]
    if law == SAND:
        return sand(f, plastic, lam, mu, constants[p, COEFFICIENT], constants[p, INTERCEPT], constants[p, TIP])
    if law == SNOW:
        xi, smallest, largest, hardest = (
            constants[p, COEFFICIENT],
            constants[p, SMALLEST],
            constants[p, LARGEST],
            constants[p, MAX_HARDENING],
        )
        return snow(f, plastic, lam, mu, xi, smallest, largest, hardest)
    if law == ELASTOMER:
        return elastomer(f, lam, mu)
    nan = math.nan
    return f, nan, (nan, nan, nan, nan, nan, nan), nan
