"""Constitutive laws in plane strain, compiled with Numba in float64.

A law takes the trial deformation gradient F of one particle and returns its return-mapped F, plastic state, Kirchhoff stress τ and stiffness. The stiffness
is an upper bound of the density at rest times the squared speed of the fastest elastic wave. It follows from the second derivative of the energy along the
principal axes, ``∂²ψ/∂(log σᵢ)² - ∂ψ/∂(log σᵢ)``. All laws are isotropic, so they act on the principal values of the left Cauchy-Green tensor ``b = F Fᵀ``.
An isotropic function of a symmetric 2x2 tensor with principal values f₁ >= f₂ is ::

    f(b) = (f₁ + f₂)/2 I + (f₁ - f₂)/2 [[c, s], [s, -c]],   (c, s) = (cos 2θ, sin 2θ)

with θ the principal angle, so neither a singular value decomposition nor an angle is computed. Only b matters to the laws, so a law may drop the rotation of
F. It does so for a flat particle, where the rotation is undefined.
"""

from __future__ import annotations

import math
from typing import no_type_check

from numba import njit

from gpe_pl.solvers.materials import COEFFICIENT, ELASTOMER, INTERCEPT, LAMBDA, LARGEST, MAX_HARDENING, MU, SAND, SMALLEST, SNOW, TIP

SMALLEST_STRETCH = 1e-4
"""Lower bound of the principal stretches; it keeps the logarithmic strain of a flattened particle finite."""

SMALLEST_SQUARE = SMALLEST_STRETCH**2


@njit(cache=True, error_model="numpy")
@no_type_check
def left_cauchy_green(f00, f01, f10, f11):
    """Return the principal values of ``F Fᵀ``, larger first, and the direction ``(cos 2θ, sin 2θ)`` of the larger one, from the four entries of F."""
    b00, b01, b11 = f00 * f00 + f01 * f01, f00 * f10 + f01 * f11, f10 * f10 + f11 * f11
    half_difference = 0.5 * (b00 - b11)
    radius = math.sqrt(half_difference * half_difference + b01 * b01)
    larger = 0.5 * (b00 + b11) + radius
    determinant = f00 * f11 - f01 * f10
    # det²/b₁ instead of mean - radius: avoids cancellation when the particle is flat
    smaller = determinant * determinant / larger if larger > 0.0 else 0.0
    if radius > 0.0:
        inverse = 1.0 / radius
        return larger, smaller, half_difference * inverse, b01 * inverse
    return larger, smaller, 1.0, 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _isotropic(first, second, c, s):
    """Return the entries 00, 01 and 11 of the symmetric tensor with these principal values."""
    mean, half = 0.5 * (first + second), 0.5 * (first - second)
    return mean + half * c, half * s, mean - half * c


@njit(cache=True, error_model="numpy")
@no_type_check
def _stretched(f00, f01, f10, f11, ratio_1, ratio_2, c, s, flat, square_1, square_2):
    """Multiply the principal stretches of F by ratios; for a flat particle, return the left stretch tensor with stretches ``ratio √square``."""
    if flat:
        ratio_1, ratio_2 = ratio_1 * math.sqrt(square_1), ratio_2 * math.sqrt(square_2)
        f00, f01, f10, f11 = 1.0, 0.0, 0.0, 1.0
    m00, m01, m11 = _isotropic(ratio_1, ratio_2, c, s)
    return m00 * f00 + m01 * f10, m00 * f01 + m01 * f11, m01 * f00 + m11 * f10, m01 * f01 + m11 * f11


@njit(cache=True, error_model="numpy")
@no_type_check
def _hencky(f00, f01, f10, f11):
    """Compute the logarithmic strain ``log(b) / 2``; return F (its left stretch tensor if flat), ``log |det F|``, and entries 00 and 01 of the deviator."""
    b00, b01, b11 = f00 * f00 + f01 * f01, f00 * f10 + f01 * f11, f10 * f10 + f11 * f11
    half_difference, mean = 0.5 * (b00 - b11), 0.5 * (b00 + b11)
    determinant = f00 * f11 - f01 * f10
    inverse = 1.0 / mean
    x = (half_difference * half_difference + b01 * b01) * (inverse * inverse)
    if x < 1e-3 and determinant > 0.01:
        # distortion is nearly always small: (log b₁ - log b₂)/4 = atanh(√x)/2, and the series of atanh(√x)/√x to rounding
        scale = 0.5 * inverse * (1.0 + x * (1.0 / 3.0 + x * (1.0 / 5.0 + x * (1.0 / 7.0 + x * (1.0 / 9.0)))))
        return f00, f01, f10, f11, math.log(determinant), scale * half_difference, scale * b01
    larger, smaller, c, s = left_cauchy_green(f00, f01, f10, f11)
    if smaller < SMALLEST_SQUARE:
        larger, smaller = max(larger, SMALLEST_SQUARE), SMALLEST_SQUARE
        f00, f01, f10, f11 = _stretched(f00, f01, f10, f11, 1.0, 1.0, c, s, True, larger, smaller)
    log_1, log_2 = 0.5 * math.log(larger), 0.5 * math.log(smaller)
    deviator = 0.5 * (log_1 - log_2)
    return f00, f01, f10, f11, log_1 + log_2, deviator * c, deviator * s


@njit(cache=True, error_model="numpy")
@no_type_check
def sand(f00, f01, f10, f11, volume_correction, lam, mu, slope, intercept=0.0, tip=0.0):
    """Apply the law of sand: Hencky elasticity with a Drucker-Prager return mapping without dilation (Klar et al. 2016, sections 5 and 6.3).

    ``ε = log σ + v/2`` are the principal logarithmic strains. ``v`` is the volume that the particle gained in tension and must lose before it can bear
    pressure. With ``τ = 2μ ε + λ tr ε``, the cone ``|dev τ| = k - α tr τ`` is ``|dev ε| = k/(2μ) - α (2λ + 2μ)/(2μ) tr ε``. Beyond its tip,
    ``tr ε = k/(α (2λ + 2μ))``, the strain becomes that of the tip. This is stress-free without cohesion (k = 0). Otherwise the deviatoric strain is scaled
    back to the cone at constant volume.

    Args:
        f00, f01, f10, f11: trial elastic deformation gradient.
        volume_correction: volume v of the particle.
        lam, mu: Lamé parameters [Pa].
        slope: slope of the cone, ``α (2λ + 2μ)/(2μ)``.
        intercept: ``|dev ε|`` of the cone at ``tr ε = 0``, ``k/(2μ)``.
        tip: ``tr ε`` at the tip; infinite for a cylinder, which has a slope of 0.

    Returns:
        The four entries of the return-mapped F, the new v, τ₀₀, τ₀₁, τ₁₁ and the stiffness [Pa]. If the trial F is not finite, neither is the stress.
    """
    f00, f01, f10, f11, trace, e0, e1 = _hencky(f00, f01, f10, f11)
    trace += volume_correction
    if trace >= tip:
        stretch, tension = math.exp(0.5 * tip), (lam + mu) * tip
        return stretch, 0.0, 0.0, stretch, trace - tip, tension, 0.0, tension, lam + 2.0 * mu
    deviator = math.sqrt(e0 * e0 + e1 * e1)  # |dev ε| / √2
    largest = -slope * trace * math.sqrt(0.5) + intercept * math.sqrt(0.5)
    if deviator > largest:
        inverse = 1.0 / deviator
        shrunk, kept = math.exp(largest - deviator), largest * inverse  # ratio of the larger stretch to the trial one
        m00, m01, m11 = _isotropic(shrunk, 1.0 / shrunk, e0 * inverse, e1 * inverse)
        f00, f01, f10, f11 = m00 * f00 + m01 * f10, m00 * f01 + m01 * f11, m01 * f00 + m11 * f10, m01 * f01 + m11 * f11
        e0, e1, deviator = kept * e0, kept * e1, largest
    if volume_correction != 0.0:
        grown = math.exp(0.5 * volume_correction)
        f00, f01, f10, f11 = grown * f00, grown * f01, grown * f10, grown * f11
    pressure = (lam + mu) * trace
    t00, t01, t11 = pressure + 2.0 * mu * e0, 2.0 * mu * e1, pressure - 2.0 * mu * e0
    return f00, f01, f10, f11, 0.0, t00, t01, t11, lam + 2.0 * mu - (pressure - 2.0 * mu * deviator)


@njit(cache=True, error_model="numpy")
@no_type_check
def hardening(compaction, xi, largest):
    """Return the factor on snow's elastic moduli, ``exp(-ξ c)`` with ``c = J_P - 1`` (``compaction``), at most ``largest``.

    Source: Stomakhin et al. 2013, equation 2.
    """
    return math.exp(min(-xi * compaction, math.log(largest)))


@njit(cache=True, error_model="numpy")
@no_type_check
def snow(f00, f01, f10, f11, compaction, lam, mu, xi, smallest, largest, max_hardening):
    """Apply the law of snow: fixed-corotated elasticity with hardening and clamped principal stretches (Stomakhin et al. 2013, sections 4 and 7).

    ``τ = 2μ (F - R) Fᵀ + λ (J - 1) J`` with both moduli multiplied by ``hardening`` of the plastic state before the return mapping. The length of the substep
    was chosen for that state.

    Args:
        f00, f01, f10, f11: trial elastic deformation gradient.
        compaction: ``J_P - 1``, with J_P the volume ratio of the plastic deformation.
        lam, mu: Lamé parameters [Pa] before any compaction.
        xi: hardening coefficient ξ.
        smallest, largest: limits of the elastic principal stretches, ``1 - θ_c`` and ``1 + θ_s``.
        max_hardening: largest factor on the moduli.

    Returns:
        The four entries of the return-mapped F, the new ``J_P - 1``, τ₀₀, τ₀₁, τ₁₁ and the stiffness [Pa].
    """
    larger, smaller, c, s = left_cauchy_green(f00, f01, f10, f11)
    flat = smaller < SMALLEST_SQUARE
    square_1, square_2 = max(larger, SMALLEST_SQUARE), max(smaller, SMALLEST_SQUARE)
    factor = hardening(compaction, xi, max_hardening)
    trial_1, trial_2 = math.sqrt(square_1), math.sqrt(square_2)
    stretch_1, stretch_2 = min(max(trial_1, smallest), largest), min(max(trial_2, smallest), largest)
    lam, mu, rest = factor * lam, factor * mu, lam + 2.0 * mu
    volume = stretch_1 * stretch_2
    if stretch_1 != trial_1 or stretch_2 != trial_2 or flat:
        f00, f01, f10, f11 = _stretched(f00, f01, f10, f11, stretch_1 / trial_1, stretch_2 / trial_2, c, s, flat, square_1, square_2)
        compaction = (1.0 + compaction) * (trial_1 * trial_2 / volume) - 1.0
        factor = hardening(compaction, xi, max_hardening)
    pressure = lam * (volume - 1.0) * volume
    t00, t01, t11 = _isotropic(
        2.0 * mu * (stretch_1 - 1.0) * stretch_1 + pressure, 2.0 * mu * (stretch_2 - 1.0) * stretch_2 + pressure, c, s
    )
    return f00, f01, f10, f11, compaction, t00, t01, t11, max(1.0, factor) * rest * max(1.0, stretch_1 * stretch_1, volume * volume)


@njit(cache=True, error_model="numpy")
@no_type_check
def elastomer(f00, f01, f10, f11, lam, mu):
    """Apply the law of elastomers: neo-Hookean elasticity, ``τ = μ (b - I) + λ log J`` (Bonet & Wood 2008, equation 6.28).

    Args:
        f00, f01, f10, f11: deformation gradient.
        lam, mu: Lamé parameters [Pa].

    Returns:
        The four entries of F, 0 (no plastic state), τ₀₀, τ₀₁, τ₁₁ and the stiffness [Pa].
    """
    larger, smaller, c, s = left_cauchy_green(f00, f01, f10, f11)
    if smaller < SMALLEST_SQUARE:
        larger, smaller = max(larger, SMALLEST_SQUARE), SMALLEST_SQUARE
        f00, f01, f10, f11 = _stretched(f00, f01, f10, f11, 1.0, 1.0, c, s, True, larger, smaller)
    log_volume = 0.5 * math.log(larger * smaller)
    pressure = lam * log_volume
    t00, t01, t11 = _isotropic(mu * (larger - 1.0) + pressure, mu * (smaller - 1.0) + pressure, c, s)
    return f00, f01, f10, f11, 0.0, t00, t01, t11, max(lam + 2.0 * mu, mu * (1.0 + larger) + lam * max(0.0, 1.0 - log_volume))


@njit(cache=True, error_model="numpy")
@no_type_check
def respond(law, f00, f01, f10, f11, plastic, constants, p):
    """Apply the law of particle ``p`` to its trial deformation gradient. For an unknown code, all results are NaN.

    Args:
        law: code of the law: ``materials.SAND``, ``SNOW`` or ``ELASTOMER``.
        f00, f01, f10, f11: trial deformation gradient.
        plastic: plastic state: the volume correction of sand, ``J_P - 1`` of snow.
        constants: constants of all particles [node, constant], in the columns that ``materials`` names.
        p: row of the particle.

    Returns:
        The four entries of the return-mapped F, the new plastic state, τ₀₀, τ₀₁, τ₁₁ and the stiffness [Pa].
    """
    lam, mu = constants[p, LAMBDA], constants[p, MU]
    if law == SAND:
        return sand(f00, f01, f10, f11, plastic, lam, mu, constants[p, COEFFICIENT], constants[p, INTERCEPT], constants[p, TIP])
    if law == SNOW:
        xi, smallest, largest, hardest = (
            constants[p, COEFFICIENT],
            constants[p, SMALLEST],
            constants[p, LARGEST],
            constants[p, MAX_HARDENING],
        )
        return snow(f00, f01, f10, f11, plastic, lam, mu, xi, smallest, largest, hardest)
    if law == ELASTOMER:
        return elastomer(f00, f01, f10, f11, lam, mu)
    nan = math.nan
    return nan, nan, nan, nan, nan, nan, nan, nan, nan
