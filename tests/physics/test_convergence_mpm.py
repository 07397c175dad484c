"""How much the solver of elastomers and sand depends on its time step and its grid."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl import dataset
from gpe_pl.geometry import domain_walls
from gpe_pl.trajectory import Boundary
from tests.particles import block
from tests.physics.test_mpm import L0, collapse

pytestmark = pytest.mark.slow

HEIGHT, SIDE, GRAVITY = 0.3, 0.25, 9.81


def bounce(solver, modulus):
    """Height that the centre of a block of elastomer rises to again from a smooth floor, over the height that it fell from rest."""
    dim, spacing = len(solver.bounds), solver.grid_spacing / 2
    down, side = -np.eye(dim)[-1], round(SIDE / spacing) * spacing
    low = (*(0.375,) * (dim - 1), HEIGHT)
    boundary = Boundary.sample(domain_walls(solver.bounds, 0.0), spacing, dim)
    state = block(low, (side,) * dim, spacing, "elastomer", value=modulus, boundary=boundary, gravity=GRAVITY * down)
    fall, heights = np.sqrt(2 * HEIGHT / GRAVITY), []
    for _ in range(round(2.9 * fall / solver.frame_dt)):
        state = solver.step(state)
        heights.append(state.mass @ state.pos[:, -1] / state.mass.sum())
    landing = round(1.8 * fall / solver.frame_dt)
    lowest = int(np.argmin(heights[:landing]))
    assert lowest < landing - 1
    return (max(heights[lowest:]) - HEIGHT - side / 2) / HEIGHT + 1


@pytest.mark.parametrize(("size", "dim"), [("tiny", 2), ("small", 2), ("paper", 2), ("tiny", 3), ("small", 3)])
def test_bounce(size, dim, physics):
    """From the softest to the stiffest material of the data, with the time step of the data and with half of it."""
    spec = dataset("data=elastomer", f"size={size}", f"dimension={dim}")
    solver: Any = spec.solver
    values = spec.parameters["elastomer"]
    every = sorted((*values.seen, *values.extrapolated))
    for modulus in (every[0], values.seen[4], every[-1]) if dim == 2 else (every[0], every[-1]):
        own, half = (bounce(replace(solver, cfl=factor * solver.cfl), modulus) for factor in (1.0, 0.5))
        formula, source = "the same with half the time step", f"Δ = {solver.grid_spacing:.4g} m, cfl = {solver.cfl:g}"
        physics(f"bounce height over drop height, E = {modulus:g} Pa", own, half, 0.03, formula=formula, source=source)


@pytest.mark.parametrize("angle", [20.0, 40.0])
def test_collapse_of_a_column(angle, physics):
    """Of sand twice as high as wide: where its grains lie."""
    own, half = (np.sort(collapse(2.0, angle, duration=1.0, cfl=cfl).pos[:, 0]) / L0 for cfl in (0.5, 0.25))
    formula, source = "the same with half the time step", "10 cells per width, cfl = 0.5"
    for what, of in (("mean", np.mean), ("95 % quantile", lambda x: np.quantile(x, 0.95))):
        physics(f"{what} of the distances over the column's width", of(own), of(half), 0.03, formula=formula, source=source)
