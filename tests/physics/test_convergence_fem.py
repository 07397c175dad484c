"""Excess stiffness of a beam in ``FEM`` against the number of cells across."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.physics.test_fem import DENSITY, body, lattice, stiffness

pytestmark = pytest.mark.slow

RATIO, THICKNESS, MODULUS, POISSON = 8, 0.02, 1e6, 0.35


def bending_frequency(kind, across):
    """Return the first bending frequency [Hz] of a free beam with this number of cells across, from the solver's forces."""
    dim = 3 if kind == "tetrahedron" else 2
    points, cells = lattice(kind, (RATIO * across, *(across,) * (dim - 1)), (RATIO * THICKNESS, *(THICKNESS,) * (dim - 1)))
    state = body(points, cells, MODULUS)
    matrix, mass = stiffness(state, POISSON), np.sqrt(np.repeat(state.mass, dim))
    num_rigid = 3 * (dim - 1)
    squares = eigh((matrix + matrix.T) / 2 / np.outer(mass, mass), eigvals_only=True, subset_by_index=[0, num_rigid])
    return math.sqrt(squares[num_rigid]) / (2 * math.pi)  # after the rigid motions


def frequency_of_thick_beam(plane_strain):
    """Return the frequency [Hz] of a thick beam in plane strain, or of a bar with a square cross-section."""
    modulus, poisson = (MODULUS / (1 - POISSON**2), POISSON / (1 - POISSON)) if plane_strain else (MODULUS, POISSON)
    r = 1 / RATIO
    correction = 1 + 6.585 * (1 + 0.0752 * poisson + 0.8109 * poisson**2) * r**2 - 0.868 * r**4
    correction -= (
        8.34 * (1 + 0.2023 * poisson + 2.173 * poisson**2) * r**4 / (1 + 6.338 * (1 + 0.1408 * poisson + 1.536 * poisson**2) * r**2)
    )
    return math.sqrt(modulus / (0.9465 * DENSITY * correction)) / (RATIO**2 * THICKNESS)


@pytest.mark.parametrize(
    ("kind", "tolerances"),
    [
        ("triangle", {2: 0.25, 4: 0.08, 8: 0.025}),
        pytest.param("quad", {2: 0.08, 4: 0.03, 8: 0.015}, marks=pytest.mark.long),
        ("tetrahedron", {1: 0.9, 2: 0.35, 4: 0.1}),
    ],
    ids=["triangle", "quad", "tetrahedron"],
)
def test_bending_frequency(kind, tolerances, physics):
    expected, errors = frequency_of_thick_beam(plane_strain=kind != "tetrahedron"), {}
    for across, tolerance in tolerances.items():
        measured = bending_frequency(kind, across)
        errors[across] = measured / expected - 1
        formula = f"{100 * errors[across]:+.1f} % from the free beam, length over thickness {RATIO}"
        source = "ASTM E1876" if kind == "tetrahedron" else "ASTM E1876, plane strain"
        physics(f"bending frequency, {across} cells across", measured, expected, tolerance, formula=formula, source=source, unit="Hz")
    physics("error, 2 over 4 cells across", errors[2] / errors[4], 2.5, formula="error ~ Δ²", source="convergence", kind="at_least")
