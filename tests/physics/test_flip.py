"""The liquid solver compared with analytic results and published experiments; each test states its formula."""

import math
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Bowl, Polygon, Wall, domain_walls
from gpe_pl.schema import node_code
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.flip.solver import Fields
from gpe_pl.solvers.flip.transfer import add_impulse, scatter
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

pytestmark = pytest.mark.slow

DENSITY, GRAVITY = 1000.0, 9.81
DAM_BREAK = Path(__file__).parents[3] / "shared" / "data" / "dam_break_front.csv"


def fill(low, high, spacing, inside=None, *, shapes=(), viscosity=0.1, velocity=None, gravity=GRAVITY, jitter=0.25, seed=0):
    """Fill a box, or the part of it where ``inside(points)`` is true, with liquid; gravity acts down the second axis unless given."""
    dim = len(low)
    counts = [round((b - a) / spacing) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, dim)
    pos = np.asarray(low) + (lattice + 0.5 + np.random.default_rng(seed).uniform(-jitter, jitter, lattice.shape)) * spacing
    pos = pos if inside is None else pos[inside(pos)]
    count = len(pos)
    return State(
        pos,
        np.zeros_like(pos) if velocity is None else velocity(pos),
        np.full(count, node_code("fluid"), np.uint8),
        np.full(count, DENSITY * spacing**dim),
        np.full((count, 1), viscosity),
        Boundary.sample(shapes, spacing, dim),
        np.array([0.0, -gravity, 0.0][:dim]) if isinstance(gravity, float) else np.asarray(gravity, float),
    )


def run(solver, state, num_steps):
    for _ in range(num_steps):
        state = solver.step(state)
    return state


class OnGrid:
    """A state in the solver's arrays during a substep."""

    def __init__(self, solver, state):
        self.state = state
        self.solver, self.grid, self.solids, self.fields = solver, solver.grid, solver.solids(state.boundary), Fields.empty(solver.grid)
        viscosity = np.ascontiguousarray(state.material_params[:, 0])
        self.active = solver.rasterize(state.pos, state.vel, state.mass, viscosity, self.solids, self.fields)
        self.liquid, _ = solver.liquid(self.active, self.solids, self.fields)

    def push(self, impulse):
        add_impulse(self.active, np.asarray(impulse, float), self.fields.weight, self.fields.velocity)

    def project(self, h):
        return self.solver.project(self.liquid, self.solids, self.fields, h)

    def diffuse(self, h):
        self.fields.viscous_face[:] = 0
        self.solver.diffuse(self.active, self.solids, self.fields, h)

    def centers(self, cells):
        index = np.stack(np.unravel_index(cells, self.grid.counts), axis=-1)
        return self.grid.origin + (index + 0.5) * self.grid.spacing

    @property
    def known(self):
        """Faces in free space that particles reach [axis, cell]."""
        return (self.solids.face_distance > 0) & (self.fields.weight > 1e-6)

    @property
    def bulk(self):
        """Liquid cells without empty cells around them."""
        steps = [range(-s, s + 1, s) for s in self.grid.strides]
        around = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, self.grid.dim).sum(axis=1)
        near = self.liquid.cells[:, None] + around
        return self.liquid.cells[np.all((self.fields.liquid[near] > 0) | ~self.solids.is_open[near], axis=1)]

    def relative_density(self):
        """Mass of the particles in the bulk over the space there, relative to the liquid at rest; cells with a solid centre count too."""
        sums, grid = Fields.empty(self.grid), self.grid
        volume = self.state.mass / (DENSITY * grid.spacing**grid.dim)
        scatter(
            self.state.pos, self.state.vel, volume, self.state.material_params[:, 0].copy(), grid.origin, 1.0 / grid.spacing, grid.strides, grid.counts,
            grid.corners, sums.velocity, sums.weight, sums.density, sums.viscous, sums.touched,
        )  # fmt: skip
        return float(sums.density[self.bulk].sum() / self.solids.cell_room[self.bulk].sum())


def unit(dim):
    return ((0.0, 1.0),) * dim


def centered(dim, radius):
    return lambda x: np.linalg.norm(x - 0.5, axis=1) < radius


def turning(x):
    """Return the velocity of a rigid rotation about the middle with 1 rad/s, in 3D about a skew axis."""
    if x.shape[1] == 2:
        return np.stack([0.5 - x[:, 1], x[:, 0] - 0.5], axis=1)
    return np.cross(np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0), x - 0.5)


@pytest.mark.parametrize("dim", [2, 3])
def test_free_fall_is_exact(physics, dim):
    """Every particle of a free body follows the parabola, whatever the substeps."""
    solver = FLIP(bounds=unit(dim), grid_spacing=1 / 16, frame_dt=0.01)
    start = fill((0.3,) * dim, (0.7,) * dim, 1 / 32, velocity=lambda x: np.full_like(x, 0.5))
    after, t = run(solver, start, 20), 0.2
    error = np.abs(after.pos - (start.pos + start.vel * t + start.gravity * t * t / 2)).max()
    physics(
        f"free fall in {dim}D, error of positions", error, 1e-12, kind="at_most", formula="x₀ + v₀ t + g t²/2", source="exact", unit="m"
    )
    error = np.abs(after.vel - start.vel - start.gravity * t).max()
    physics(f"free fall in {dim}D, error of velocities", error, 1e-12, kind="at_most", formula="v₀ + g t", source="exact", unit="m/s")


@pytest.mark.parametrize("dim", [2, 3])
def test_momentum_is_conserved_in_a_collision(physics, dim):
    """Two bodies that meet in mid-air: the centre of mass keeps its velocity, and moves with it."""

    def towards_each_other(x):
        return np.where(x[:, :1] < 0.5, 1.0, -0.8) * np.eye(dim)[0] + 0.2 * np.eye(dim)[1]

    solver = FLIP(bounds=unit(dim), grid_spacing=1 / 16, frame_dt=0.01)
    start = fill((0.2,) * dim, (0.8,) * dim, 1 / 32, lambda x: np.abs(x[:, 0] - 0.5) > 0.05, velocity=towards_each_other, gravity=0.0)
    after = run(solver, start, 15)
    assert np.abs(after.vel - start.vel).max() > 0.5
    physics(
        f"momentum after a collision in {dim}D", np.abs(after.vel.mean(axis=0) - start.vel.mean(axis=0)).max(), 1e-12, kind="at_most",
        formula="Σ m v constant", source="exact", unit="m/s",
    )  # fmt: skip
    moved = after.pos.mean(axis=0) - start.pos.mean(axis=0) - 0.15 * start.vel.mean(axis=0)
    physics(
        f"centre of mass after a collision in {dim}D",
        np.abs(moved).max(),
        1e-12,
        kind="at_most",
        formula="x₀ + v t",
        source="exact",
        unit="m",
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_hydrostatic_pressure(physics, dim):
    """The pressure that one substep of gravity takes in a pool between walls: dP/dy = -ρ g."""
    solver = FLIP(bounds=unit(dim), grid_spacing=1 / 16, pressure_tolerance=1e-9)
    pool = OnGrid(solver, fill((0.0,) * dim, (1.0, 0.5, 1.0)[:dim], 1 / 32, shapes=domain_walls(unit(dim), 0.0)))
    pool.push([0.0, -GRAVITY * 5e-3, 0.0][:dim])
    pressure = pool.project(5e-3)
    height = pool.centers(pool.liquid.cells)[:, 1]
    slope = np.polyfit(height[height < 0.4], pressure[height < 0.4], 1)[0]
    physics(
        f"pressure gradient in a pool in {dim}D",
        slope,
        -DENSITY * GRAVITY,
        0.005,
        formula="dP/dy = -ρ g",
        source="hydrostatics",
        unit="Pa/m",
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_pool_stays_at_rest(physics, dim):
    """After the particles have found their places, nothing moves."""
    bounds, cells = (((0.0, 0.5), (0.0, 0.5)), 32) if dim == 2 else (((0.0, 0.375), (0.0, 0.5), (0.0, 0.375)), 16)
    solver = FLIP(bounds=bounds, grid_spacing=1 / cells, frame_dt=0.01)
    high = tuple(0.3125 if axis == 1 else bounds[axis][1] for axis in range(dim))
    settled = run(solver, fill((0.0,) * dim, high, 0.5 / cells, shapes=domain_walls(bounds, 0.0)), 50)
    after = run(solver, settled, 200 if dim == 2 else 50)
    drift = np.abs(after.pos.mean(axis=0) - settled.pos.mean(axis=0)).max()
    physics(f"drift of a pool at rest in {dim}D", drift, 1e-4, kind="at_most", formula="v = 0", source="hydrostatics", unit="m")
    physics(
        f"largest speed in a pool at rest in {dim}D",
        np.abs(after.vel).max(),
        0.02,
        kind="at_most",
        formula="v = 0",
        source="hydrostatics",
        unit="m/s",
    )


TILTED = Polygon(((-1.0, -1.0), (2.0, -1.0), (2.0, 0.05), (0.45, 0.05), (-1.0, 0.9)), 0.0)
"""A floor that rises to the left at 30 degrees."""


@pytest.mark.parametrize(
    ("name", "dim", "shapes"),
    [
        ("spherical bowl", 2, (Bowl((0.5, 0.5), 0.45, 0.0),)),
        ("spherical bowl", 3, (Bowl((0.5, 0.5, 0.5), 0.45, 0.0),)),
        ("tilted floor", 2, (TILTED, *domain_walls(unit(2), 0.0))),
    ],
)
def test_liquid_rests_on_curved_and_tilted_solids(physics, name, dim, shapes):
    """The test fails for solids of whole cells or with holes in cut cells: the liquid would not come to rest. It also fails for wrong volumes beside solids."""
    cells = 24 if dim == 2 else 16
    solver = FLIP(bounds=unit(dim), grid_spacing=1 / cells, frame_dt=0.01)
    start = fill((0.0,) * dim, (1.0, 0.3125, 1.0)[:dim], 0.5 / cells, lambda x: clearance(shapes, x) > 0.005, shapes=shapes)
    after = run(solver, start, 50)
    speed = math.sqrt((after.vel**2).sum(axis=1).mean())
    physics(f"rms speed at rest, {name} in {dim}D", speed, 0.01, kind="at_most", formula="v = 0", source="hydrostatics", unit="m/s")
    error = after.pos[:, 1].mean() - mean_height(shapes, dim, start.mass.sum() / DENSITY)
    physics(
        f"error of the height of the centre of mass, {name} in {dim}D", abs(error) * cells, 0.05, kind="at_most",
        formula="flat surface, volume Σ m/ρ", source="exact", unit="Δ",
    )  # fmt: skip


def mean_height(shapes, dim, volume):
    """Return the height of the centre of mass of liquid at rest in the unit box, from points that fill it upwards."""
    number = 1000 if dim == 2 else 120
    line = (np.arange(number) + 0.5) / number
    points = np.stack(np.meshgrid(*[line] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return np.sort(points[clearance(shapes, points) > 0, 1])[: round(volume * number**dim)].mean()


def clearance(shapes, x):
    return np.min([shape.signed_distance(x) for shape in shapes], axis=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_projection_keeps_a_rotation_in_a_round_container(physics, dim):
    """A rigid rotation in a full disc or ball flows along its wall everywhere; walls made of whole cells would stop it."""
    change = []
    for cells in (16, 32):
        solver = FLIP(bounds=unit(dim), grid_spacing=1 / cells, pressure_tolerance=1e-9)
        state = fill(
            (0.0,) * dim, (1.0,) * dim, 0.5 / cells, centered(dim, 0.43), shapes=(Bowl((0.5,) * dim, 0.43, 0.0),), velocity=turning
        )
        ball = OnGrid(solver, state)
        before = ball.fields.velocity.copy()
        ball.project(5e-3)
        change.append(np.linalg.norm((ball.fields.velocity - before)[ball.known]) / np.linalg.norm(before[ball.known]))
    physics(
        f"change of a rotation in a round container in {dim}D", change[1], 0.03, kind="at_most",
        formula="u = Ω × r is tangential and free of divergence", source="Batty et al. 2007, section 4",
    )  # fmt: skip
    assert change[1] < 0.7 * change[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_divergence_after_projection(physics, dim):
    """A random velocity field in a round container with a free surface has no divergence after one projection."""
    h = 5e-3
    solver = FLIP(bounds=unit(dim), grid_spacing=1 / 16)
    bowl = Bowl((0.5,) * dim, 0.45, 0.0)
    rng = np.random.default_rng(0)
    state = fill(
        (0.0,) * dim, (1.0, 0.5, 1.0)[:dim], 1 / 32, centered(dim, 0.45), shapes=(bowl,), velocity=lambda x: rng.normal(size=x.shape)
    )
    liquid = OnGrid(solver, state)
    liquid.project(h)
    outflow = np.zeros(len(liquid.liquid.cells))
    for axis, stride in enumerate(liquid.grid.strides):
        flux = liquid.solids.area[axis] * liquid.fields.velocity[axis]
        outflow += flux[liquid.liquid.cells + stride] - flux[liquid.liquid.cells]
    divergence = np.abs(outflow).max() * h / solver.grid_spacing
    physics(
        f"change of a cell's volume in a substep in {dim}D",
        divergence,
        1.01e-6,
        kind="at_most",
        formula="h ∇·u = 0 to the tolerance",
        source="Batty et al. 2007",
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_rotation_survives_the_viscosity_solve(physics, dim):
    """A free disc or ball in rigid rotation has no strain, so viscosity leaves it alone, however strong."""
    solver = FLIP(bounds=unit(dim), grid_spacing=1 / 16, viscosity_tolerance=1e-14)
    ball = OnGrid(solver, fill((0.0,) * dim, (1.0,) * dim, 1 / 32, centered(dim, 0.3), viscosity=10.0, velocity=turning))
    for axis in range(dim):  # the rotation itself instead of its transfer
        face = ball.centers(np.arange(ball.grid.num_cells))
        face[:, axis] -= 0.5 * ball.grid.spacing
        ball.fields.velocity[axis] = turning(face)[:, axis]
    before = ball.fields.velocity.copy()
    ball.diffuse(0.1)
    change = np.abs(ball.fields.velocity - before).max()
    physics(
        f"change of a rotation by viscosity in {dim}D",
        change,
        1e-8,
        kind="at_most",
        formula="ε = 0",
        source="Batty & Bridson 2008, section 3",
        unit="m/s",
    )
    ball.fields.velocity[0] += np.sin(9.0 * ball.centers(np.arange(ball.grid.num_cells))[:, 1])
    before = ball.fields.velocity.copy()
    ball.diffuse(0.1)
    assert np.abs((ball.fields.velocity - before)[ball.known]).max() > 0.1


STOKES = 52.3447
"""λ a² / ν of the slowest Stokes flow in a closed square."""


def stokes_rate(cells, offset=0.0, dt=2e-3, viscosity=0.1):
    """Return the decay rate of the slowest flow in a square with walls ``offset`` cells inside the grid, over the exact rate."""
    low = offset / cells
    size = 1.0 - 2.0 * low

    def swirl(x):
        s, t = np.pi * (x - low).T / size
        return np.stack([np.sin(s) ** 2 * np.sin(2 * t), -np.sin(2 * s) * np.sin(t) ** 2], axis=1)

    walls = tuple(Wall(w.normal, w.offset + low, w.low, w.high, 0.0) for w in domain_walls(unit(2), 0.0))
    solver = FLIP(bounds=unit(2), grid_spacing=1 / cells, pressure_tolerance=1e-8)
    state = fill(
        (0, 0),
        (1, 1),
        0.5 / cells,
        lambda x: np.all(np.abs(x - 0.5) < size / 2, axis=1),
        shapes=walls,
        viscosity=viscosity,
        velocity=swirl,
        gravity=0.0,
    )
    square = OnGrid(solver, state)
    energy = []
    for _ in range(round(0.2 / dt)):
        square.project(dt)
        square.diffuse(dt)
        energy.append((square.fields.weight * square.fields.velocity**2)[square.known].sum())
    half = len(energy) // 2
    rate = -np.polyfit(np.arange(len(energy))[half:] * dt, np.log(energy[half:]), 1)[0] / 2
    return rate / (STOKES * viscosity / size**2)


def implicit(dt, viscosity=0.1):
    """Return the factor by which implicit Euler steps slow the decay."""
    return math.log1p(STOKES * viscosity * dt) / (STOKES * viscosity * dt)


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_stokes_flow_decays(physics, offset):
    """The flow is in a closed no-slip square, with walls on nodes or through the middle of cells."""
    physics(
        f"decay of Stokes flow, walls {offset:g} cells from the nodes", stokes_rate(32, offset) / implicit(2e-3), 1.0, 0.02,
        formula="λ₁ = 52.3447 ν/a²", source="Leriche & Labrosse 2000",
    )  # fmt: skip


def test_order_in_space(physics):
    """Error of the Stokes decay rate with 8, 16 and 32 cells."""
    errors = [1.0 - stokes_rate(cells) / implicit(2e-3) for cells in (8, 16, 32)]
    order = math.log2(errors[1] / errors[2])
    physics(
        "order in Δ, Stokes decay, 16 to 32 cells",
        order,
        1.4,
        kind="at_least",
        formula="log₂ of the ratio of errors",
        source="self-convergence",
    )
    assert errors[0] > errors[1] > errors[2] > 0


def test_order_in_time(physics):
    """Decay rates with dt, dt/2 and dt/4."""
    rates = [stokes_rate(16, dt=dt) for dt in (8e-3, 4e-3, 2e-3)]
    order = math.log2((rates[0] - rates[1]) / (rates[1] - rates[2]))
    physics("order in dt, Stokes decay", order, 0.8, kind="at_least", formula="log₂ of the ratio of differences", source="self-convergence")


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_poiseuille_flow(physics, offset):
    """Between plates, driven along them, in the middle of a long slab: u = g y (H - y) / (2ν)."""
    cells, viscosity, force = 16, 0.5, 1.0
    dx = 0.25 / cells
    low, height = offset * dx, 0.25 - 2 * offset * dx
    bounds = ((0.0, 1.5), (0.0, 0.25))
    walls = tuple(Wall(w.normal, w.offset + low, w.low, w.high, 0.0) for w in domain_walls(bounds, 0.0) if w.normal[1] != 0)
    solver = FLIP(bounds=bounds, grid_spacing=dx)
    state = fill((0.2, 0), (1.3, 0.25), dx / 2, shapes=walls, viscosity=viscosity, gravity=0.0)
    # evenly up to the walls, as liquid is: a lattice cut by them would leave gaps of different width
    state.pos[:, 1] = low + state.pos[:, 1] * height / 0.25
    state.mass[:] *= height / 0.25
    slab = OnGrid(solver, state)
    deviation = steady_profile(slab, force, lambda y: force * (y - low) * (height + low - y) / (2 * viscosity))
    physics(
        f"profile between plates {offset:g} cells from the nodes", deviation, 0.02, kind="at_most", formula="u = g y (H - y) / (2ν)",
        source="Poiseuille", unit="of the largest u",
    )  # fmt: skip


def test_film_flow(physics):
    """A film on a plate with a free surface: u = g y (2H - y) / (2ν)."""
    dx, height, viscosity, force = 1 / 64, 0.25, 0.5, 1.0
    bounds = ((0.0, 3.0), (0.0, 0.5))
    solver = FLIP(bounds=bounds, grid_spacing=dx)
    walls = tuple(w for w in domain_walls(bounds, 0.0) if w.normal[1] > 0)
    film = OnGrid(solver, fill((0.2, 0), (2.8, height), dx / 2, shapes=walls, viscosity=viscosity, gravity=0.0))
    deviation = steady_profile(film, force, lambda y: force * y * (2 * height - y) / (2 * viscosity))
    physics(
        "profile of a film",
        deviation,
        0.02,
        kind="at_most",
        formula="u = g y (2H - y) / (2ν)",
        source="Nusselt film",
        unit="of the largest u",
    )


def steady_profile(body, force, exact):
    """Return the largest deviation from the exact steady profile in the middle of a long body, over the largest exact velocity."""
    duration = 100.0  # hundreds of times longer than diffusion takes
    body.push([force * duration, 0.0])
    body.diffuse(duration)
    cells = body.liquid.cells
    x, y = body.centers(cells).T
    middle = np.abs(x - 0.5 * (x.min() + x.max())) < 2.0 * body.grid.spacing
    expected = exact(y[middle])
    return float(np.abs(body.fields.velocity[0, cells[middle]] - expected).max() / expected.max())


def test_film_of_particles(physics):
    """The same film through whole steps, until it is steady: speed of the particles at the surface, and no-slip at the wall."""
    dx, height, viscosity, force = 1 / 32, 0.25, 0.5, 1.0
    bounds = ((0.0, 2.5), (0.0, 0.5))
    solver = FLIP(bounds=bounds, grid_spacing=dx, frame_dt=0.01)
    walls = tuple(w for w in domain_walls(bounds, 0.0) if w.normal[1] > 0)
    after = run(solver, fill((0.1, 0), (2.3, height), dx / 2, shapes=walls, viscosity=viscosity, gravity=(force, 0.0)), 40)
    middle = np.abs(after.pos[:, 0] - after.pos[:, 0].mean()) < 0.3
    y, u = after.pos[middle, 1], after.vel[middle, 0]
    top = force * height**2 / (2 * viscosity)
    deviation = np.abs(u - force * y * (2 * height - y) / (2 * viscosity)).mean() / top
    physics(
        "mean deviation of particles in a film",
        deviation,
        0.03,
        kind="at_most",
        formula="u = g y (2H - y) / (2ν)",
        source="Nusselt film",
        unit="of the largest u",
    )
