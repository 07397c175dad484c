"""How much too stiff a beam of ``FEM`` is, by the number of cells across."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.physics.test_fem import DENSITY, body, lattice, stiffness

pytestmark = pytest.mark.slow

RATIO, THICKNESS, MODULUS, POISSON = 8, 0.02, 1e6, 0.35


def bending_frequency(kind, across):
    """First bending frequency [Hz] of a free beam with so many cells across, from the solver's own forces."""
    points, cells = lattice(kind, (RATIO * across, across), (RATIO * THICKNESS, THICKNESS))
    state = body(points, cells, MODULUS)
    matrix, mass = stiffness(state, POISSON), np.sqrt(np.repeat(state.mass, 2))
    squares = eigh((matrix + matrix.T) / 2 / np.outer(mass, mass), eigvals_only=True, subset_by_index=[0, 3])
    return math.sqrt(squares[3]) / (2 * math.pi)  # the first three are rigid motions


def frequency_of_thick_beam():
    """In plane strain [Hz]."""
    modulus, poisson, r = MODULUS / (1 - POISSON**2), POISSON / (1 - POISSON), 1 / RATIO
    correction = 1 + 6.585 * (1 + 0.0752 * poisson + 0.8109 * poisson**2) * r**2 - 0.868 * r**4
    correction -= (
        8.34 * (1 + 0.2023 * poisson + 2.173 * poisson**2) * r**4 / (1 + 6.338 * (1 + 0.1408 * poisson + 1.536 * poisson**2) * r**2)
    )
    return math.sqrt(modulus / (0.9465 * DENSITY * correction)) / (RATIO**2 * THICKNESS)


@pytest.mark.parametrize(
    ("kind", "tolerances"), [("triangle", (0.25, 0.08, 0.025)), ("quad", (0.08, 0.03, 0.015))], ids=["triangle", "quad"]
)
def test_bending_frequency(kind, tolerances, physics):
    expected, errors = frequency_of_thick_beam(), []
    for across, tolerance in zip((2, 4, 8), tolerances, strict=True):
        measured = bending_frequency(kind, across)
        errors.append(measured / expected - 1)
        formula, source = f"{100 * errors[-1]:+.1f} % from the free beam, length over thickness {RATIO}", "ASTM E1876, plane strain"
        physics(f"bending frequency, {across} cells across", measured, expected, tolerance, formula=formula, source=source, unit="Hz")
    physics("error, 2 over 4 cells across", errors[0] / errors[1], 2.5, formula="error ~ Δ²", source="convergence", kind="at_least")
