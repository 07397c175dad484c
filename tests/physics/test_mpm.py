"""The material point solver compared with analytic results and published experiments, in 2D and 3D."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Bowl, Shape, Sphere, domain_walls, signed_distance
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers.materials import Elastomer, Fluid, Sand, Snow, lame_parameters
from gpe_pl.solvers.mpm import MPM
from gpe_pl.trajectory.boundary import Boundary
from tests.particles import VALUE, block, run, together

pytestmark = pytest.mark.slow

GRAVITY = 9.81
MATERIALS = ("sand", "snow", "elastomer", "fluid")
DIMS = (2, 3)


def unit(dim):
    return ((0.0, 1.0),) * dim


def down(dim):
    """Return the unit vector downward."""
    return np.array([0.0] * (dim - 1) + [-1.0])


def collision(dim, materials):
    """Return two blocks, of the first and the last material, in an off-centre collision without gravity and walls."""
    cell, spacing = (1 / 32, 1 / 64) if dim == 2 else (1 / 16, 1 / 32)
    left = block((0.25, 0.4, 0.4)[:dim], (0.2, 0.2, 0.2)[:dim], spacing, materials[0], velocity=(2.0, 0.3, 0.1)[:dim])
    right = block((0.55, 0.48, 0.37)[:dim], (0.15, 0.25, 0.2)[:dim], spacing, materials[-1], velocity=(-2.0, -0.2, 0.2)[:dim], seed=1)
    solver = MPM(bounds=unit(dim), grid_spacing=cell, materials=materials)
    return solver, together(materials, left, right)


PAIRS = [("sand",), ("snow",), ("elastomer",), ("fluid",), ("sand", "elastomer"), ("sand", "snow"), ("snow", "fluid")]


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("material", MATERIALS)
def test_free_fall(dim, material, physics):
    h, k = 1e-4, 100
    solver = MPM(bounds=unit(dim), grid_spacing=1 / 32, frame_dt=h, materials=(material,))
    assert solver.solver_dt == h
    start = block((0.4,) * dim, (0.2,) * 2 + (0.1,) * (dim - 2), 1 / 64, material, gravity=GRAVITY * down(dim))
    after = run(solver, start, k)
    fall, drop = np.abs(after.vel - GRAVITY * k * h * down(dim)).max(), GRAVITY * h * h * k * (k + 1) / 2
    physics("error of velocity", fall, 0, 1e-12, formula="v = -g k h", source="exact, symplectic Euler", unit="m/s", kind="absolute")
    error = np.abs(after.pos - start.pos - drop * down(dim)).max()
    physics(
        "error of position", error, 0, 1e-12, formula="y = y₀ - g h² k(k+1)/2", source="exact, symplectic Euler", unit="m", kind="absolute"
    )


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("materials", PAIRS, ids="-".join)
def test_linear_momentum(dim, materials, physics):
    solver, state = collision(dim, materials)
    before, scale = state.mass @ state.vel, np.sum(state.mass[:, None] * np.abs(state.vel))
    after = run(solver, state, 30)
    drift = np.abs(after.mass @ after.vel - before).max() / scale
    physics("drift over Σ m |v|", drift, 0, 1e-12, formula="Σ m v = const", source="exact", kind="absolute")
    assert np.abs(after.vel - state.vel).max() > 1.0  # they did collide


def angular_momentum(state, spacing):
    """Return Σ m (x × v + Δ²/4 curl) about the centre of the domain [3 components]; APIC particles carry spin ``ε_ijk C_kj``."""
    x, v, c = np.zeros((3, state.num_nodes)), np.zeros((3, state.num_nodes)), np.zeros((3, 3, state.num_nodes))
    x[: state.dim], v[: state.dim] = state.pos.T - 0.5, state.vel.T
    if state.internal is not None:
        c[: state.dim, : state.dim] = state.internal.affine.transpose(1, 2, 0)
    spin = np.array([c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1]])
    return (np.cross(x, v, axis=0) + spacing**2 / 4 * spin) @ state.mass


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("materials", PAIRS, ids="-".join)
def test_angular_momentum(dim, materials, physics):
    solver, state = collision(dim, materials)
    before = angular_momentum(state, solver.grid_spacing)
    after = angular_momentum(run(solver, state, 30), solver.grid_spacing)
    drift = np.abs(after - before).max() / np.linalg.norm(before)
    physics(
        "relative drift",
        drift,
        0,
        1e-11,
        formula="Σ m (x × v + Δ²/4 ε:C) = const",
        source="Jiang et al. 2015, section 5.3",
        kind="absolute",
    )


def elastic_energy(material, value, state):
    """Return the elastic energy [J], including the hardening of snow."""
    stretch = np.linalg.svd(state.internal.deformation, compute_uv=False)
    volume = state.mass / material.density
    if isinstance(material, Fluid):
        return float(np.sum(volume * material.bulk_modulus / 2 * np.log(stretch).sum(axis=1) ** 2))
    lam, mu = lame_parameters(value if isinstance(material, Elastomer) else material.youngs_modulus, material.poisson_ratio)
    strain = np.log(stretch)
    if isinstance(material, Sand):
        density = mu * np.sum(strain**2, axis=1) + lam / 2 * np.sum(strain, axis=1) ** 2
    elif isinstance(material, Snow):
        hardening = np.minimum(np.exp(-value * state.internal.plastic), material.max_hardening)
        density = hardening * (mu * np.sum((stretch - 1) ** 2, axis=1) + lam / 2 * (np.prod(stretch, axis=1) - 1) ** 2)
    else:
        log_volume = np.sum(strain, axis=1)
        density = mu / 2 * (np.sum(stretch**2, axis=1) - state.dim) - mu * log_volume + lam / 2 * log_volume**2
    return float(np.sum(volume * density))


def energies(solver, state, num_steps):
    """Return kinetic, gravitational and elastic energy [J] in each frame, the initial state first."""
    material, value = solver.constants_of(solver.materials[0]), float(state.material_params[0, 0])
    values = []
    for _ in range(num_steps + 1):
        elastic = 0.0 if state.internal is None else elastic_energy(material, value, state)
        values.append(elastic + float(np.sum(state.mass * (np.sum(state.vel**2, axis=1) / 2 - state.pos @ state.gravity))))
        state = solver.step(state)
    return np.array(values)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("material", MATERIALS)
def test_energy_does_not_grow_in_a_collision(dim, material, physics):
    solver, state = collision(dim, (material,))
    values = energies(solver, state, 30)
    physics("largest over initial", values.max() / values[0], 1.001, formula="kinetic + elastic", source="second law", kind="at_most")
    physics(
        "final over initial",
        values[-1] / values[0],
        0.95,
        formula="kinetic + elastic",
        source="APIC and plasticity dissipate",
        kind="at_most",
    )


@pytest.mark.parametrize("material", MATERIALS)
def test_energy_does_not_grow_in_a_fall(material, physics):
    """Relative to the floor."""
    boundary = Boundary.sample(domain_walls(unit(2), 0.4), 1 / 48, 2)
    state = block((0.3, 0.2), (0.3, 0.3), 1 / 48, material, velocity=(1.0, 0.0), boundary=boundary, gravity=GRAVITY * down(2))
    values = energies(MPM(bounds=unit(2), grid_spacing=1 / 24, materials=(material,)), state, 100)
    physics(
        "largest over initial", values.max() / values[0], 1.001, formula="kinetic + elastic + m g y", source="second law", kind="at_most"
    )


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("angle", [20.0, 30.0, 40.0])
def test_friction_angle_of_the_return_mapping(dim, angle, physics):
    """One compressed particle beyond the cone, read off the deformation that the solver stores; in 3D in triaxial compression."""
    solver = MPM(bounds=unit(dim), grid_spacing=1 / 32, frame_dt=1e-4)
    state = block((0.5,) * dim, (1 / 64,) * dim, 1 / 64, value=angle)
    first = solver.step(state)
    trial = np.array([[0.98, 0.1], [0.0, 0.97]]) if dim == 2 else np.diag([0.8, 1.02, 1.02])
    stored = solver.step(replace(first, internal=replace(first.internal, deformation=trial[None]))).internal.deformation[0]
    strain = np.log(np.linalg.svd(stored, compute_uv=False))
    lam, mu = lame_parameters(solver.sand.youngs_modulus, solver.sand.poisson_ratio)
    tau = 2 * mu * strain + lam * strain.sum()
    realised = math.degrees(math.asin(abs(tau[0] - tau[-1]) / abs(tau[0] + tau[-1])))
    formula = "|τ₁ - τ₂| = sin φ |τ₁ + τ₂|"
    physics("realised friction angle", realised, angle, 1e-6, formula=formula, source="Mohr-Coulomb", unit="°", kind="absolute")


@pytest.mark.parametrize("dim", DIMS)
def test_snow_stretches_stay_in_their_limits(dim, physics):
    solver, state = collision(dim, ("snow",))
    smallest, largest = math.inf, 0.0
    for _ in range(30):
        state = solver.step(state)
        stretch = np.linalg.svd(state.internal.deformation, compute_uv=False)
        smallest, largest = min(smallest, stretch.min()), max(largest, stretch.max())
    source = "Stomakhin et al. 2013, section 7"
    physics(
        "smallest principal stretch",
        smallest,
        1 - solver.snow.critical_compression - 1e-12,
        formula="1 - θ_c",
        source=source,
        kind="at_least",
    )
    physics(
        "largest principal stretch", largest, 1 + solver.snow.critical_stretch + 1e-12, formula="1 + θ_s", source=source, kind="at_most"
    )
    physics("smallest J_P - 1", float(state.internal.plastic.min()), -0.05, formula="compaction", source="it was compacted", kind="at_most")


@pytest.mark.parametrize("material", ["sand", "fluid"])
def test_hydrostatic_column(material, physics):
    """A wide layer between slip walls; the mean over time, because elastic waves hardly decay."""
    height, spacing = 0.25, 1 / 64
    boundary = Boundary.sample(domain_walls(unit(2), 0.0), spacing, 2)
    state = block((0.0, 0.0), (1.0, height), spacing, material, boundary=boundary, gravity=GRAVITY * down(2))
    solver = MPM(bounds=unit(2), grid_spacing=2 * spacing, materials=(material,))
    lam, mu = lame_parameters(solver.sand.youngs_modulus, solver.sand.poisson_ratio) if material == "sand" else (Fluid().bulk_modulus, 0.0)
    stresses = []
    for _ in range(400):
        state = solver.step(state)
        values, vectors = np.linalg.eigh(state.internal.deformation @ state.internal.deformation.transpose(0, 2, 1))
        strain = np.log(values) / 2
        principal = 2 * mu * strain + lam * strain.sum(axis=1, keepdims=True)
        stresses.append(np.sum(vectors[:, 1, :] ** 2 * principal, axis=1))
    tau_yy = np.mean(stresses[40:], axis=0)
    inner = (state.pos[:, 1] > 2 * spacing) & (state.pos[:, 1] < height - 2 * spacing)
    slope, floor = np.polyfit(state.pos[inner, 1], tau_yy[inner], 1)
    weight, source = solver.constants_of(material).density * GRAVITY, "equilibrium"
    physics("vertical stress at the floor", floor, -weight * height, 0.05, formula="-ρ g H", source=source, unit="Pa")
    physics("its gradient", slope, weight, 0.1, formula="ρ g", source=source, unit="Pa/m")


# --- liquid --------------------------------------------------------------------------------------------------------------------------------


def vortex_decay(viscosity, cells, dim=2):
    """Return the decay rate [1/s] of a Taylor-Green vortex between slip walls, extruded in 3D.

    The measurement starts after sound has crossed the box a few times, when the effect of the walls has reached all of the liquid.
    """
    dx, k = 1 / cells, math.pi
    bounds = ((0.0, 1.0), (0.0, 1.0), (0.0, 4 * dx))[:dim]
    boundary = Boundary.sample(domain_walls(bounds, 0.0), dx / 2, dim)
    state = block((0.0,) * dim, tuple(high for _, high in bounds), dx / 2, "fluid", value=viscosity, jitter=0.0, boundary=boundary)

    def mode(pos):
        x, y = pos[:, 0], pos[:, 1]
        flow = np.zeros_like(pos)
        flow[:, 0], flow[:, 1] = np.sin(k * x) * np.cos(k * y), -np.cos(k * x) * np.sin(k * y)
        return flow

    solver = MPM(bounds=bounds, grid_spacing=dx, materials=("fluid",), max_substeps=10**4)
    state, amplitude = replace(state, vel=0.2 * mode(state.pos)), []
    for _ in range(30):
        state = solver.step(state)
        flow = mode(state.pos)
        amplitude.append(np.sum(state.vel * flow) / np.sum(flow**2))
    return -np.polyfit(solver.frame_dt * np.arange(15), np.log(amplitude[15:]), 1)[0]


VORTEX = {"formula": "2 ν π²", "source": "Taylor and Green 1937, exact solution of Navier-Stokes", "unit": "1/s"}


@pytest.mark.parametrize(
    ("viscosity", "cells", "dim"), [(0.1, 32, 2), *(pytest.param(0.5, 32, dim, marks=pytest.mark.long) for dim in (2, 3))]
)
def test_a_vortex_decays_by_the_viscosity(viscosity, cells, dim, physics):
    physics(f"decay rate, {dim}D, ν = {viscosity}", vortex_decay(viscosity, cells, dim), 2 * viscosity * math.pi**2, 0.05, **VORTEX)


def test_the_grids_own_viscosity_falls_with_its_spacing(physics):
    own = [vortex_decay(0.01, cells) / (2 * math.pi**2) - 0.01 for cells in (16, 32)]
    physics("viscosity of the transfers, 32 cells over 16", own[1] / own[0], 0.5, formula="≤ 1/2", source="convergence", kind="at_most")


# --- elastomer -----------------------------------------------------------------------------------------------------------------------------


def bar_frequency(cells, dim=2, cfl=0.5, modulus=1e5):
    """Return frequency [Hz] of the first longitudinal mode of a free bar without lateral contraction, and the fraction of amplitude left after five periods."""
    length, elastomer = 0.5, Elastomer(poisson_ratio=0.0)
    dx, speed = length / cells, math.sqrt(modulus / elastomer.density)
    bounds = ((0.0, (cells + 8) * dx), *((0.0, 12 * dx),) * (dim - 1))
    state = block((4.3 * dx,) * dim, (length, *(4 * dx,) * (dim - 1)), dx / 2, "elastomer", value=modulus, jitter=0.0)
    start = state.pos[:, 0].copy()
    mode = np.cos(math.pi * (start - 4.3 * dx) / length)
    state.vel[:, 0] = 0.01 * speed * mode
    solver = MPM(
        bounds=bounds,
        grid_spacing=dx,
        materials=("elastomer",),
        elastomer=elastomer,
        frame_dt=length / speed / 20,
        cfl=cfl,
        max_substeps=10**5,
    )
    amplitude = []
    for _ in range(200):
        state = solver.step(state)
        amplitude.append((state.pos[:, 0] - start) @ mode)
    q = np.array(amplitude)
    before = np.nonzero(q[:-1] * q[1:] < 0)[0]
    crossings = (before + q[before] / (q[before] - q[before + 1])) * solver.frame_dt
    largest = np.abs(q).reshape(5, -1).max(axis=1)
    return (len(crossings) - 1) / 2 / (crossings[-1] - crossings[0]), largest[-1] / largest[0]


BAR = {"formula": "√(E/ρ) / 2L", "source": "linear elasticity, small amplitude"}


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("modulus", [1e4, 1e6])
def test_bar_frequency(dim, modulus, physics):
    frequency, left = bar_frequency(16, dim, modulus=modulus)
    physics("frequency", frequency, math.sqrt(modulus / 1000), 0.015, unit="Hz", **BAR)
    physics("amplitude left after four periods", left, 0.95, formula="1", source="no damping", kind="at_least")


def test_bar_frequency_converges(physics):
    """Self-convergence of the solver, in space and in time."""
    exact = math.sqrt(1e5 / 1000)
    errors = [abs(bar_frequency(cells)[0] / exact - 1) for cells in (8, 16, 32, 64)]
    for cells, error in zip((8, 16, 32, 64), errors, strict=True):
        physics(f"relative error with {cells} cells", error, 0, 0.016, kind="absolute", **BAR)
    order = float(np.polyfit(np.log([8, 16, 32, 64]), -np.log(errors), 1)[0])
    physics("order in the grid spacing", order, 1.8, formula="error ~ Δ^p", source="bar with 8 to 64 cells", kind="at_least")
    coarse, middle, fine = (bar_frequency(32, cfl=cfl)[0] for cfl in (0.41, 0.205, 0.1025))  # 4, 8 and 16 substeps per frame
    order = math.log2(abs(coarse - middle) / abs(middle - fine))
    physics(
        "order in the time step",
        order,
        1.8,
        formula="difference ~ h^p",
        source="bar with 32 cells, 4 to 16 substeps per frame",
        kind="at_least",
    )


# --- snow ----------------------------------------------------------------------------------------------------------------------------------


def deposit(xi):
    """Return the height [m] below which 95 % of the particles of a snow block stay, 0.8 s after it was thrown at a rough floor at 4 m/s."""
    cell = 1 / 64
    boundary = Boundary.sample(domain_walls(unit(2), STICKY), cell / 2, 2)
    fall = {"velocity": 4.0 * down(2), "gravity": GRAVITY * down(2)}
    state = block((0.35, 0.1), (0.3, 0.4), cell / 2, "snow", value=xi, boundary=boundary, **fall)
    after = run(MPM(bounds=unit(2), grid_spacing=cell, materials=("snow",)), state, 160)
    return float(np.quantile(after.pos[:, 1], 0.95))


@pytest.mark.long
def test_snow_deposit_rises_with_hardening(physics):
    heights = {xi: deposit(xi) for xi in (3.0, 7.0, 10.0, 20.0)}
    for (lower, low), (higher, high) in itertools.pairwise(heights.items()):
        quantity = f"height at ξ = {higher:g} over that at ξ = {lower:g}"
        physics(quantity, high / low, 1.005, formula="monotone", source="Stomakhin et al. 2013, figure 9", kind="at_least")


# --- column collapse -----------------------------------------------------------------------------------------------------------------------

L0 = 0.2


def collapse(aspect, angle, cells_per_width=10, duration=1.6, cfl=0.5):
    """Return the final state of a column of width L0 and height a L0 that collapses beside a slip wall, on a sticky floor."""
    dx = L0 / cells_per_width
    height = math.ceil((aspect * L0 + 0.1) / dx) * dx
    length = math.ceil(L0 * (1 + 2.5 * max(aspect, 1.0) + 1) / dx) * dx
    bounds = ((0.0, length), (0.0, height))
    walls = domain_walls(bounds, {"x_low": 0.0, "x_high": STICKY, "y_low": STICKY, "y_high": 0.0})
    boundary = Boundary.sample(walls, dx / 2, 2)
    state = block((0.0, 0.0), (L0, aspect * L0), dx / 2, value=angle, boundary=boundary, gravity=GRAVITY * down(2))
    solver = MPM(bounds=bounds, grid_spacing=dx, cfl=cfl)
    return run(solver, state, round(duration / solver.frame_dt))


def run_out(state):
    """Return (L - L0)/L0 of the front."""
    return float(state.pos[:, 0].max() / L0 - 1)


ASPECTS, ANGLES = (0.5, 1.0, 2.0, 4.0), (20.0, 30.0, 40.0)
LUBE = "Lube et al. 2005"


@pytest.fixture(scope="module")
def run_outs():
    return {(a, angle): run_out(collapse(a, angle)) for a in ASPECTS for angle in ANGLES}


def test_run_out_falls_with_the_friction_angle(run_outs, physics):
    for a, (low, high) in itertools.product(ASPECTS, itertools.pairwise(ANGLES)):
        ratio = run_outs[a, low] / run_outs[a, high]
        physics(f"ΔL at {low:g}° over {high:g}°, H/L = {a:g}", ratio, 1.1, formula="monotone", source=LUBE, kind="at_least")


def test_run_out_grows_with_the_aspect_ratio(run_outs, physics):
    for angle, (low, high) in itertools.product(ANGLES, itertools.pairwise(ASPECTS)):
        ratio = run_outs[high, angle] / run_outs[low, angle]
        physics(f"ΔL at H/L = {high:g} over {low:g}, {angle:g}°", ratio, 1.3, formula="monotone", source=LUBE, kind="at_least")


@pytest.mark.long
def test_run_out_follows_the_scaling_of_experiments(physics):
    """Sand, here the front on a grid of L0/25 at 40°.

    Tall columns follow within a quarter and with the exponent. The flat one stays shorter and its run-out grows faster with a than in the experiments
    (log-slope 1.3 instead of 1), which a finer grid does not cure: the front is a few grains thick.
    """
    fronts = np.array([run_out(collapse(a, 40.0, cells_per_width=25)) for a in ASPECTS])
    for a, front in zip(ASPECTS[1:], fronts[1:], strict=True):
        formula, expected = ("1.2 a", 1.2 * a) if a < 1.8 else ("1.9 a^(2/3)", 1.9 * a ** (2 / 3))
        physics(f"ΔL/L₀ at a = {a:g}", front, expected, 0.25, formula=formula, source=LUBE)
    slopes = np.diff(np.log(fronts)) / np.diff(np.log(ASPECTS))
    physics("log-slope from a = 0.5 to 1", slopes[0], 1.15, 0.25, formula="1", source=LUBE, kind="absolute")
    physics("log-slope from a = 2 to 4", slopes[2], 0.75, 0.15, formula="2/3", source=LUBE, kind="absolute")


def test_pile_comes_to_rest(physics):
    """A pile on a rough floor."""
    state = collapse(1.0, 30.0, duration=3.0)
    speed = math.sqrt(np.mean(np.sum(state.vel**2, axis=1)))
    physics("rms velocity after 3 s", speed, 1e-3, formula="0", source="dry friction", unit="m/s", kind="at_most")


# --- slope ---------------------------------------------------------------------------------------------------------------------------------


def slip(angle, tilt):
    """Return the displacement in cells of the middle of a layer of 8 cells on a sticky floor after 0.4 s, with gravity tilted by ``tilt`` degrees."""
    dx, cells = 1 / 64, (96, 16)
    bounds = ((0.0, cells[0] * dx), (0.0, cells[1] * dx))
    boundary = Boundary.sample(domain_walls(bounds, {"x_low": 0.0, "x_high": 0.0, "y_low": STICKY, "y_high": 0.0}), dx / 2, 2)
    state = block((8 * dx, 0.0), (80 * dx, 8 * dx), dx / 2, value=angle, boundary=boundary, gravity=GRAVITY * down(2))
    solver = MPM(bounds=bounds, grid_spacing=dx)
    state = run(solver, state, 30)  # settle under normal gravity
    t = math.radians(tilt)
    after = run(solver, replace(state, gravity=GRAVITY * np.array([math.sin(t), -math.cos(t)])), 80)
    middle = (np.abs(state.pos[:, 0] - bounds[0][1] / 2) < 12 * dx) & (state.pos[:, 1] > 4 * dx)
    return float(np.mean(after.pos[middle, 0] - state.pos[middle, 0]) / dx)


@pytest.mark.parametrize("angle", [20.0, 30.0, 40.0])
def test_slope_stays_below_and_flows_above_the_friction_angle(angle, physics):
    """Without dilation simple shear mobilises tan θ = sin φ, so the threshold lies between atan(sin φ) and φ."""
    stays = math.degrees(math.atan(math.sin(math.radians(angle)))) - 3
    source = "infinite slope, Mohr-Coulomb"
    physics(f"slip at {stays:.3g}° in cells", slip(angle, stays), 1.5, formula="0 below atan(sin φ)", source=source, kind="at_most")
    physics(f"slip at {angle + 2:.3g}° in cells", slip(angle, angle + 2), 4, formula="flows above φ", source=source, kind="at_least")


# --- obstacles -----------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("material", MATERIALS)
def test_nothing_passes_a_ball_at_10_m_per_s(dim, material, physics):
    cell = 1 / 32 if dim == 2 else 1 / 24
    shapes: tuple[Shape, ...] = (*domain_walls(unit(dim), 0.3), Sphere((0.5,) * (dim - 1) + (0.3,), 0.15, 0.3))
    boundary = Boundary.sample(shapes, cell / 2, dim)
    start = block(
        (0.4,) * (dim - 1) + (0.55,),
        (0.2,) * dim,
        cell / 2,
        material,
        velocity=10 * down(dim),
        boundary=boundary,
        gravity=GRAVITY * down(dim),
    )
    solver, state, deepest = MPM(bounds=unit(dim), grid_spacing=cell, materials=(material,)), start, math.inf
    for _ in range(30):
        state = solver.step(state)
        deepest = min(deepest, float(signed_distance(shapes, state.pos).min()))
    physics("smallest signed distance", deepest, -1e-9, formula="0", source="rigid ball and walls", unit="m", kind="at_least")
    assert np.abs(state.vel - start.vel).max() > 5.0  # it did hit


def test_nothing_leaves_a_bowl(physics):
    """A shape that the solver knows only by its signed distance."""
    cell = 1 / 24
    bowl = Bowl((0.5, 0.5, 0.5), 0.45, 0.3)
    boundary = Boundary.sample((*domain_walls(unit(3), 0.3), bowl), cell / 2, 3)
    fall = {"velocity": 10 * down(3), "gravity": GRAVITY * down(3)}
    solver, deepest = MPM(bounds=unit(3), grid_spacing=cell), math.inf
    state = block((0.4, 0.4, 0.35), (0.2, 0.2, 0.2), cell / 2, boundary=boundary, **fall)
    for _ in range(30):
        state = solver.step(state)
        deepest = min(deepest, float(bowl.signed_distance(state.pos).min()))
    allowed = -(cell**2) / (4 * bowl.radius)
    physics("smallest signed distance", deepest, allowed, formula="-Δ²/4R of its samples", source="rigid bowl", unit="m", kind="at_least")


def test_largest_speed_of_a_mixed_impact(physics):
    """Sand, snow, elastomer and liquid thrown at a ball and each other at 10 m/s in 3D; nothing gets faster than that, but for the fall."""
    cell = 1 / 16
    boundary = Boundary.sample((*domain_walls(unit(3), 0.3), Sphere((0.5, 0.5, 0.2), 0.15, 0.3)), cell / 2, 3)
    fall = {"velocity": 10 * down(3), "gravity": GRAVITY * down(3), "boundary": boundary}
    blocks = [block((0.07 + 0.22 * k, 0.35, 0.45), (0.1875, 0.25, 0.25), cell / 2, m, **fall) for k, m in enumerate(MATERIALS)]
    state, fastest = together(MATERIALS, *blocks), 0.0
    solver = MPM(bounds=unit(3), grid_spacing=cell, materials=MATERIALS)
    for _ in range(60):
        state = solver.step(state)
        fastest = max(fastest, *(math.sqrt(np.mean(np.sum(state.vel[state.node_type == node_code(m)] ** 2, axis=1))) for m in VALUE))
    limit = math.sqrt(100 + 2 * GRAVITY)
    physics("largest rms velocity of a material", fastest, limit, formula="√(v² + 2 g H)", source="energy", unit="m/s", kind="at_most")
