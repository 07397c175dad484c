"""Effective against nominal viscosity of ``data=fluid``, on the grid of every size."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl import dataset
from tests.physics.test_flip import fill, run

pytestmark = pytest.mark.slow


def effective_viscosity(solver, viscosity, decay):
    """Return the viscosity [m²/s] from the decay of a weak shear wave of 16 cells inside a free body, by a factor ``exp(-decay)`` or more."""
    dx, dim, wave = solver.grid_spacing, len(solver.bounds), 2 * math.pi / (16 * solver.grid_spacing)
    solver = replace(solver, bounds=(*((0.0, 32 * dx),) * 2, *((0.0, 6 * dx),) * (dim - 2)))

    def shear(x):
        flow = np.zeros_like(x)
        flow[:, 0] = 1e-3 * np.sin(wave * (x[:, 1] - 16 * dx))
        return flow

    low, high = (*(2 * dx,) * 2, *(dx,) * (dim - 2)), (*(30 * dx,) * 2, *(5 * dx,) * (dim - 2))
    start = fill(low, high, dx / 2, viscosity=viscosity, gravity=0.0, velocity=shear)
    rate = (viscosity + solver.numerical_viscosity) * wave**2
    num_frames = max(2, round(decay / (rate * solver.frame_dt)))
    after = run(solver, start, num_frames)
    middle = np.all(np.abs(start.pos[:, :2] - 16 * dx) < 8 * dx, axis=1)
    amplitudes = [(x.vel[middle, 0] * np.sin(wave * (x.pos[middle, 1] - 16 * dx))).sum() for x in (start, after)]
    return math.log(amplitudes[0] / amplitudes[1]) / (num_frames * solver.frame_dt * wave**2)


@pytest.mark.parametrize(
    ("size", "dim"),
    [("tiny", 2), ("tiny", 3), *(pytest.param(*case, marks=pytest.mark.long) for case in (("small", 2), ("paper", 2), ("paper", 3)))],
)
def test_effective_viscosity(size, dim, physics):
    """The nominal one and the grid's own add up; 3D is small and tiny on the same grid."""
    spec = dataset("data=fluid", f"size={size}", f"dimension={dim}")
    solver: Any = spec.solver
    seen = spec.parameters["fluid"].seen
    for viscosity in (seen[0], seen[3], seen[6]) if dim == 2 else (seen[0],):
        measured = effective_viscosity(solver, viscosity, 0.5 if dim == 2 else 0.1)
        expected, own = viscosity + solver.numerical_viscosity, solver.numerical_viscosity
        source = f"Δ = {solver.grid_spacing:.4g} m, ν_grid = Δ²/(6τ) = {own:.3g} m²/s"
        physics(f"effective viscosity at ν = {viscosity:g} m²/s", measured, expected, 0.2, formula="ν + ν_grid", source=source, unit="m²/s")
