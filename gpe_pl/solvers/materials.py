"""Constitutive laws of the material point method, compiled with Numba in float64.

A law is a function from the trial deformation gradient of one particle to its return-mapped deformation gradient and its Kirchhoff stress. ``LAWS``
holds for each material the integer code under which ``respond`` calls the law, and the map from the stored material parameter to the coefficient
that the law takes. All laws here are isotropic, so they act on the principal values of the left Cauchy-Green tensor ``b = F Fᵀ``; an isotropic
function of a symmetric 2x2 tensor with principal values f₁ >= f₂ is ::

    f(b) = (f₁ + f₂)/2 I + (f₁ - f₂)/2 [[c, s], [s, -c]],   (c, s) = (cos 2θ, sin 2θ)

with θ the principal angle, so neither a singular value decomposition nor an angle is ever computed.

Numba's disk cache watches each file by itself: after editing a law, delete ``solvers/__pycache__``, or kernels elsewhere keep the old law.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from numba import njit

SAND = 0

SMALLEST_STRETCH = 1e-4
"""Principal stretches below this are treated as this: the logarithmic strain of a flattened particle stays finite."""

_SMALLEST_SQUARE = SMALLEST_STRETCH**2


@dataclass(frozen=True)
class Law:
    """How the solver refers to a material.

    Attributes:
        code: integer that selects the law in ``respond``.
        coefficient: map from the stored material parameter [node] and the dimension to the coefficient of the law [node].
    """

    code: int
    coefficient: Callable[[np.ndarray, int], np.ndarray]


def drucker_prager_coefficient(friction_angle: np.ndarray, dim: int) -> np.ndarray:
    """Slope α of the Drucker-Prager cone in ``|dev ε| = -α (dλ + 2μ)/(2μ) tr ε``.

    In plane strain α = sin φ / √2 makes the law Mohr-Coulomb, ``|τ₁ - τ₂| = -sin φ (τ₁ + τ₂)``; in 3D the cone passes through the triaxial
    compression corners, α = √(2/3) 2 sin φ / (3 - sin φ) (Klar et al. 2016, section 5).

    Args:
        friction_angle: φ [node] in degrees.
        dim: 2 or 3.
    """
    sine = np.sin(np.deg2rad(friction_angle))
    return sine / math.sqrt(2.0) if dim == 2 else math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)


LAWS: dict[str, Law] = {"sand": Law(SAND, drucker_prager_coefficient)}
"""Materials that the material point method can simulate."""


def lame_parameters(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """First Lamé parameter λ and shear modulus μ in Pa (plane strain in 2D)."""
    shear = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    first = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return first, shear


@njit(cache=True, error_model="numpy")
@no_type_check
def left_cauchy_green(f00, f01, f10, f11):
    """Principal values of ``F Fᵀ``, larger first, and the direction ``(cos 2θ, sin 2θ)`` of the larger one."""
    b00, b01, b11 = f00 * f00 + f01 * f01, f00 * f10 + f01 * f11, f10 * f10 + f11 * f11
    half_difference = 0.5 * (b00 - b11)
    radius = math.sqrt(half_difference * half_difference + b01 * b01)
    larger = 0.5 * (b00 + b11) + radius
    determinant = f00 * f11 - f01 * f10
    # det²/b₁ instead of mean - radius: no cancellation when the particle is flat
    smaller = determinant * determinant / larger if larger > 0.0 else 0.0
    if radius > 0.0:
        return larger, smaller, half_difference / radius, b01 / radius
    return larger, smaller, 1.0, 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def drucker_prager(f00, f01, f10, f11, volume_correction, alpha, lam, mu):
    """Hencky elasticity with a Drucker-Prager return mapping without dilation, in plane strain (Klar et al. 2016, sections 5 and 6.3).

    ``ε = log σ + v/2`` are the principal logarithmic strains, where ``v`` is the volume that the particle gained while it was in tension and must
    lose again before it can bear pressure. In expansion (``tr ε >= 0``) the particle is stress-free. Otherwise the deviatoric strain is
    scaled back to the cone ``|dev ε| = -α (2λ + 2μ)/(2μ) tr ε`` at constant volume, and ``τ = 2μ ε + λ tr ε``.

    Args:
        f00, f01, f10, f11: trial elastic deformation gradient.
        volume_correction: v of the particle.
        alpha: slope of the cone, see ``drucker_prager_coefficient``.
        lam, mu: Lamé parameters [Pa].

    Returns:
        The four entries of the return-mapped F, the new v, and τ₀₀, τ₀₁, τ₁₁ [Pa]. A trial F that is not finite gives a stress that is not finite; the
        rotation of a degenerate one is dropped.
    """
    larger, smaller, c, s = left_cauchy_green(f00, f01, f10, f11)
    degenerate = smaller < _SMALLEST_SQUARE
    square_1, square_2 = max(larger, _SMALLEST_SQUARE), max(smaller, _SMALLEST_SQUARE)
    strain_1 = 0.5 * (math.log(square_1) + volume_correction)
    strain_2 = 0.5 * (math.log(square_2) + volume_correction)
    trace = strain_1 + strain_2
    # ratio = new principal stretch / trial one
    if trace >= 0.0:
        strain_1, strain_2, correction = 0.0, 0.0, trace
        ratio_1, ratio_2 = 1.0 / math.sqrt(square_1), 1.0 / math.sqrt(square_2)
        changed = True
    else:
        correction = 0.0
        ratio_1 = ratio_2 = 1.0
        changed = degenerate
        if volume_correction != 0.0:
            ratio_1 = ratio_2 = math.exp(0.5 * volume_correction)
            changed = True
        deviator = 0.5 * (strain_1 - strain_2)  # |dev ε| / √2
        largest_deviator = -alpha * (lam + mu) / mu * trace / math.sqrt(2.0)
        if deviator > largest_deviator:
            strain_1, strain_2 = 0.5 * trace + largest_deviator, 0.5 * trace - largest_deviator
            factor = math.exp(largest_deviator - deviator)
            ratio_1, ratio_2 = ratio_1 * factor, ratio_2 / factor
            changed = True
    if changed:
        if degenerate:  # the rotation is undefined: F becomes the left stretch tensor
            ratio_1, ratio_2 = ratio_1 * math.sqrt(square_1), ratio_2 * math.sqrt(square_2)
            f00, f01, f10, f11 = 1.0, 0.0, 0.0, 1.0
        mean, half = 0.5 * (ratio_1 + ratio_2), 0.5 * (ratio_1 - ratio_2)
        m00, m01, m11 = mean + half * c, half * s, mean - half * c
        f00, f01, f10, f11 = m00 * f00 + m01 * f10, m00 * f01 + m01 * f11, m01 * f00 + m11 * f10, m01 * f01 + m11 * f11
    pressure_part, shear_part = (lam + mu) * (strain_1 + strain_2), mu * (strain_1 - strain_2)
    return f00, f01, f10, f11, correction, pressure_part + shear_part * c, shear_part * s, pressure_part - shear_part * c


@njit(cache=True, error_model="numpy")
@no_type_check
def respond(code, f00, f01, f10, f11, plastic, coefficient, lam, mu):
    """Apply the law with this code; arguments and results as in ``drucker_prager``. An unknown code gives NaN."""
    if code == SAND:
        return drucker_prager(f00, f01, f10, f11, plastic, coefficient, lam, mu)
    nan = math.nan
    return nan, nan, nan, nan, nan, nan, nan, nan
