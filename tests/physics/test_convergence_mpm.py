"""Dependence of the material point solver on its time step and grid."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl import dataset
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.trajectory.boundary import Boundary
from tests.particles import block, run
from tests.physics.test_convergence_flip import effective_viscosity
from tests.physics.test_mpm import L0, collapse

pytestmark = pytest.mark.slow

HEIGHT, SIDE, GRAVITY = 0.3, 0.25, 9.81


def bounce(solver, modulus, spacing):
    """Return the rebound height of the centre of an elastomer block on a smooth floor, over the height of its fall from rest."""
    dim = len(solver.bounds)
    down, side = -np.eye(dim)[-1], round(SIDE / spacing) * spacing
    low = (*(0.375,) * (dim - 1), HEIGHT)
    boundary = Boundary.sample(domain_walls(solver.bounds, 0.0), spacing, dim)
    state = block(low, (side,) * dim, spacing, "elastomer", value=modulus, jitter=0.0, boundary=boundary, gravity=GRAVITY * down)
    fall, heights = np.sqrt(2 * HEIGHT / GRAVITY), []
    for _ in range(round(2.9 * fall / solver.frame_dt)):
        state = solver.step(state)
        heights.append(state.mass @ state.pos[:, -1] / state.mass.sum())
    landing = round(1.8 * fall / solver.frame_dt)
    lowest = int(np.argmin(heights[:landing]))
    assert lowest < landing - 1
    return (max(heights[lowest:]) - HEIGHT - side / 2) / HEIGHT + 1


FEW_PARTICLES = ("mixed", "tiny", 3)
"""Data with five particles across a body, whose time step determines how gradually the floor stops the lowest particles."""

CASES = [(data, size, dim) for data in ("elastomer", "mixed") for size, dim in (("tiny", 2), ("small", 2), ("tiny", 3), ("small", 3))]
QUICK = [("elastomer", "tiny", 2), ("mixed", "tiny", 2), ("mixed", "tiny", 3)]
"""Data of which the test takes a few seconds."""


@pytest.mark.parametrize(
    ("data", "size", "dim"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.long) for case in [*CASES, ("elastomer", "paper", 2)]],
)
def test_bounce(data, size, dim, physics):
    """Materials of the data, from the softest to the stiffest, bounce alike with the time step of the data and with half of it."""
    spec: Any = dataset(f"data={data}", f"size={size}", f"dimension={dim}")
    solver, tolerance = replace(spec.solver, materials=("elastomer",)), 0.1 if (data, size, dim) == FEW_PARTICLES else 0.03
    values = spec.parameters["elastomer"]
    every = sorted((*values.seen, *values.extrapolated))
    for modulus in (every[0], values.seen[4], every[-1]) if dim == 2 else (every[0], every[-1]):
        own, half = (bounce(replace(solver, cfl=factor * solver.cfl), modulus, spec.scene.spacing) for factor in (1.0, 0.5))
        formula, source = "the same with half the time step", f"Δ = {solver.grid_spacing:.4g} m, cfl = {solver.cfl:g}"
        physics(f"bounce height over drop height, E = {modulus:g} Pa", own, half, tolerance, formula=formula, source=source)


def settled_height(solver, hardening, spacing):
    """Return the height [m] of the centre of a snow block after it was thrown at a rough floor."""
    dim = len(solver.bounds)
    down, low = -np.eye(dim)[-1], (*(0.375,) * (dim - 1), 0.25)
    boundary = Boundary.sample(domain_walls(solver.bounds, 0.3), spacing, dim)
    fall = {"velocity": down, "boundary": boundary, "gravity": GRAVITY * down}
    after = run(solver, block(low, (SIDE,) * dim, spacing, "snow", value=hardening, **fall), round(0.6 / solver.frame_dt))
    return after.mass @ after.pos[:, -1] / after.mass.sum()


@pytest.mark.parametrize(("size", "dim"), [("tiny", 2), ("small", 2), ("tiny", 3)])
def test_settled_snow(size, dim, physics):
    """The softest and the hardest snow of the data settle equally high with the time step of the data and with half of it."""
    spec: Any = dataset("data=snow", f"size={size}", f"dimension={dim}")
    solver, values = spec.solver, spec.parameters["snow"].extrapolated
    for hardening in (min(values), max(values)):
        own, half = (settled_height(replace(solver, cfl=factor * solver.cfl), hardening, spec.scene.spacing) for factor in (1.0, 0.5))
        formula, source = "the same with half the time step", f"Δ = {solver.grid_spacing:.4g} m, cfl = {solver.cfl:g}"
        physics(f"height of the centre of settled snow, ξ = {hardening:g}", own, half, 0.03, formula=formula, source=source, unit="m")


@pytest.mark.parametrize(
    ("size", "dim"), [("tiny", 2), *(pytest.param(*case, marks=pytest.mark.long) for case in (("small", 2), ("paper", 2), ("tiny", 3)))]
)
def test_effective_viscosity_of_liquid_under_snow(size, dim, physics):
    """The effective viscosity of the data's thinnest liquid is the nominal one plus that of the grid. Shorter steps do not raise it."""
    spec: Any = dataset("data=snow_on_liquid", f"size={size}", f"dimension={dim}")
    solver = replace(spec.solver, materials=("fluid",))
    viscosity, own = min(spec.parameters["fluid"].extrapolated), solver.numerical_viscosity
    whole, half = (effective_viscosity(replace(solver, cfl=factor * solver.cfl), viscosity, 0.3) for factor in (1.0, 0.5))
    source = f"Δ = {solver.grid_spacing:.4g} m, ν_grid = Δ²/(256 (τ + h)) = {own:.3g} m²/s"
    physics(f"effective viscosity at ν = {viscosity:g} m²/s", whole, viscosity + own, 0.2, formula="ν + ν_grid", source=source, unit="m²/s")
    formula, source = "the same with half the time step", f"Δ = {solver.grid_spacing:.4g} m, cfl = {solver.cfl:g}"
    physics("the same against half the time step", whole, half, 0.03, formula=formula, source=source, unit="m²/s")


@pytest.mark.parametrize("angle", [20.0, 40.0])
def test_collapse_of_a_column(angle, physics):
    """The grains of a sand column twice as high as wide end at the same distances with half the time step."""
    own, half = (np.sort(collapse(2.0, angle, duration=1.0, cfl=cfl).pos[:, 0]) / L0 for cfl in (0.5, 0.25))
    formula, source = "the same with half the time step", "10 cells per width, cfl = 0.5"
    for what, of in (("mean", np.mean), ("95 % quantile", lambda x: np.quantile(x, 0.95))):
        physics(f"{what} of the distances over the column's width", of(own), of(half), 0.03, formula=formula, source=source)
