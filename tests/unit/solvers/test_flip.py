"""The parts of the liquid solver: linear algebra, open fractions, kernels, and refusals."""

import itertools
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, Sphere, domain_walls
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import node_code
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.flip import grid as flip_grid
from gpe_pl.solvers.flip.grid import PADDING, make_grid, make_solids
from gpe_pl.solvers.flip.linear import conjugate_gradients, incomplete_cholesky
from gpe_pl.solvers.flip.pressure import surface_distance
from gpe_pl.solvers.flip.solver import Fields
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from tests.particles import block, run, together


def liquid(dim=2, count=200, boundary=None, seed=0):
    """Return particles at random positions in the middle of the unit box, with random velocities."""
    rng = np.random.default_rng(seed)
    return State(
        rng.uniform(0.3, 0.7, (count, dim)),
        rng.normal(size=(count, dim)),
        np.full(count, node_code("fluid"), np.uint8),
        np.full(count, 1000.0 * 0.4**dim / count),
        np.full((count, 1), 0.1),
        boundary if boundary is not None else Boundary.sample(domain_walls(((0.0, 1.0),) * dim, 0.0), 0.1, dim),
        np.array([0.0, -9.81, 0.0][:dim]),
    )


def solver(dim=2, **settings):
    return FLIP(**{"bounds": ((0.0, 1.0),) * dim, "grid_spacing": 1 / 16, **settings})


def sparse(matrix):
    """Return diagonal and strict lower triangle by rows."""
    start: list[int] = [0]
    column: list[int] = []
    value: list[float] = []
    for i, row in enumerate(matrix):
        below = np.flatnonzero(row[:i])
        column.extend(below)
        value.extend(row[below])
        start.append(len(column))
    return np.diag(matrix).copy(), np.array(start), np.array(column, dtype=np.int64), np.array(value, dtype=float)


def laplacian(side):
    """Return the five-point stencil on a square with a fixed edge."""
    line = 2 * np.eye(side) - np.eye(side, k=1) - np.eye(side, k=-1)
    return np.kron(line, np.eye(side)) + np.kron(np.eye(side), line)


@pytest.mark.parametrize("modified", [0.0, 0.97])
def test_conjugate_gradients_solve(modified):
    matrix = laplacian(12)
    right = np.random.default_rng(0).normal(size=len(matrix))
    parts = sparse(matrix)
    x = np.zeros(len(matrix))
    iterations, residual = conjugate_gradients(*parts, right, incomplete_cholesky(*parts, modified), x, 1e-10, 200)
    np.testing.assert_allclose(x, np.linalg.solve(matrix, right), atol=1e-9)
    assert residual <= 1e-10 and np.abs(matrix @ x - right).max() == pytest.approx(residual, abs=1e-12)
    plain = conjugate_gradients(*parts, right, np.ones(len(matrix)) / 1e9, np.zeros(len(matrix)), 1e-10, 200)[0]
    assert iterations < 0.6 * plain


def test_preconditioner_has_the_promised_diagonal_and_row_sums():
    matrix = laplacian(5)
    diagonal, start, column, value = sparse(matrix)
    for modified in (0.0, 1.0):
        pivots = np.diag(1.0 / incomplete_cholesky(diagonal, start, column, value, modified))
        lower = np.tril(matrix, -1)
        product = (pivots + lower) @ np.linalg.inv(pivots) @ (pivots + lower.T)
        if modified == 0.0:
            np.testing.assert_allclose(np.diag(product), diagonal, atol=1e-12)
        else:
            np.testing.assert_allclose(product.sum(axis=1), matrix.sum(axis=1), atol=1e-12)


def test_conjugate_gradients_solve_a_singular_system():
    """A closed space: pressure is known up to a constant."""
    matrix = laplacian(6)
    matrix[np.diag_indices(36)] = -(matrix - np.diag(np.diag(matrix))).sum(axis=1)
    right = np.random.default_rng(0).normal(size=36)
    right -= right.mean()
    parts = sparse(matrix)
    x = np.zeros(36)
    _, residual = conjugate_gradients(*parts, right, incomplete_cholesky(*parts, 0.97), x, 1e-10, 200)
    assert residual <= 1e-10
    np.testing.assert_allclose(matrix @ x, right, atol=1e-9)


def test_conjugate_gradients_report_failure():
    parts = sparse(laplacian(12))
    inverse = incomplete_cholesky(*parts, 0.0)
    iterations, residual = conjugate_gradients(*parts, np.ones(144), inverse, np.zeros(144), 1e-12, 3)
    assert iterations == 3 and residual > 1e-3
    broken = np.ones(144)
    broken[7] = math.nan
    assert conjugate_gradients(*parts, broken, inverse, np.zeros(144), 1e-12, 100)[1] == math.inf


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_are_where_the_shapes_say(dim):
    """Walls on nodes close the faces on them and leave everything inside open; a wall through a cell opens it in part."""
    bounds = ((0.0, 1.0),) * dim
    solids = make_solids(domain_walls(bounds, 0.0), bounds, 1 / 8)
    inner = (slice(PADDING, -PADDING),) * dim
    for axis in range(dim):
        area = solids.area[axis].reshape((8 + 2 * PADDING,) * dim)
        open_faces = [slice(PADDING, -PADDING)] * dim
        open_faces[axis] = slice(PADDING + 1, -PADDING)
        assert np.all(area[tuple(open_faces)] == 1.0)
        assert area.sum() == 7 * 8 ** (dim - 1)
    assert np.all(solids.is_open.reshape((8 + 2 * PADDING,) * dim)[inner]) and solids.is_open.sum() == 8**dim
    raised = make_solids((Box((-9.0,) * dim, (9.0,) * (dim - 1) + (0.53125,), 0.0),), bounds, 1 / 8)
    cell = (PADDING,) * (dim - 1) + (PADDING + 4,)
    np.testing.assert_allclose(raised.area[0].reshape((8 + 2 * PADDING,) * dim)[cell], 0.75, atol=1e-12)


@pytest.mark.parametrize("fraction", [0.05, 0.44, 0.5, 0.6, 0.94])
def test_open_fractions_beside_planes_along_each_axis(fraction):
    """Before, a plane across x left a half of some faces open where it should have left 0.44, and none for 0.05."""
    bounds, cell = ((0.0, 1.0),) * 3, 1 / 8
    for axis in range(3):
        low = np.full(3, -9.0)
        low[axis] = (4 + fraction) * cell
        area = make_solids((Box(tuple(low.tolist()), (9.0,) * 3, 0.0),), bounds, cell).area.reshape(3, *(8 + 2 * PADDING,) * 3)
        for other in {0, 1, 2} - {axis}:
            cut = np.take(area[other], PADDING + 4, axis)[PADDING + 1 : -PADDING, PADDING + 1 : -PADDING]
            np.testing.assert_allclose(cut, fraction, atol=1e-6)


@pytest.mark.parametrize("name", ["ball", "box"])
def test_open_fractions_do_not_depend_on_the_order_of_axes(name):
    bounds = ((0.0, 1.0),) * 3
    middle, half = np.array([0.52, 0.47, 0.41]), np.array([0.2, 0.23, 0.28])

    def area(axes):
        low, high = (tuple(x[list(axes)].tolist()) for x in (middle - half, middle + half))
        shape = Sphere(tuple(middle[list(axes)].tolist()), 0.313, 0.0) if name == "ball" else Box(low, high, 0.0)
        return make_solids((shape,), bounds, 1 / 16).area.reshape(3, *(16 + 2 * PADDING,) * 3)

    expected = area((0, 1, 2))
    for axes in itertools.permutations(range(3)):
        np.testing.assert_allclose(area(axes), expected[list(axes)].transpose(0, *(1 + k for k in axes)), atol=1e-12)


def test_the_thickness_of_obstacles_is_measured_once(monkeypatch):
    """The solver asks for the solids in every step."""
    measured = []

    def thickness(shape):
        measured.append(shape)
        return 1.0

    monkeypatch.setattr(flip_grid, "thickness", thickness)
    bounds = ((0.0, 1.0), (0.0, 1.1))
    for _ in range(3):
        make_solids((Sphere((0.5, 0.5), 0.2, 0.0),), bounds, 1 / 10)
    assert len(measured) == 1


@pytest.mark.parametrize("dim", [2, 3])
def test_open_fractions_of_a_ball(dim):
    """The kernels' room adds up to the volume outside of the ball."""
    bounds = ((0.0, 1.0),) * dim
    solids = make_solids((Sphere((0.5,) * dim, 0.3, 0.0),), bounds, 1 / 32)
    ball = math.pi * 0.3**2 if dim == 2 else 4 / 3 * math.pi * 0.3**3
    assert (1.0 - solids.cell_room).sum() / 32**dim == pytest.approx(ball, rel=0.003)
    assert (1.0 - solids.face_room[0]).sum() / 32**dim == pytest.approx(ball, rel=0.003)


@pytest.mark.parametrize("height", [0.0, 0.2, 0.25, 0.45, 0.6, 0.9])
@pytest.mark.parametrize("dim", [2, 3])
def test_room_beside_a_plane(dim, height):
    """A centre at a distance s of at most one cell has the kernel 1 - (1-s)²/2 in free space; anything less would keep liquid away from solids."""
    bounds = ((0.0, 1.0),) * dim
    solids = make_solids((Box((-9.0,) * dim, (9.0,) * (dim - 1) + (0.5 + height / 8,), 0.0),), bounds, 1 / 8)
    line = (PADDING + 3,) * (dim - 1)
    room = solids.cell_room.reshape((8 + 2 * PADDING,) * dim)[line]
    faces = solids.face_room[-1].reshape((8 + 2 * PADDING,) * dim)[line]
    for k in range(8):
        for values, middle in ((room, 0.5), (faces, 0.0)):
            s = min(1.0, max(-1.0, k + middle - 4 - height))
            assert values[PADDING + k] == pytest.approx(1 - (1 - s) ** 2 / 2 if s >= 0 else (1 + s) ** 2 / 2, abs=0.01)


def test_particles_that_gather_at_a_wall_count():
    """Cells whose centre is solid have the density of their surroundings where the liquid is even, and more where it gathers."""
    flip = solver()
    boundary = Boundary.sample((Box((-9.0, -9.0), (9.0, 0.25 + 0.7 / 16), 0.0),), 0.1, 2)
    even = np.stack(np.meshgrid(np.arange(1, 61) / 64, 0.25 + 0.7 / 16 + (np.arange(12) + 0.5) / 64, indexing="ij"), axis=-1).reshape(-1, 2)
    gathered = np.where(even[:, 1:] < 0.25 + 1.2 / 16, even * [1.0, 0.0] + [0.0, 0.25 + 0.75 / 16], even)
    densities = []
    for pos in (even, gathered):
        fields = Fields.empty(flip.grid)
        mass, ones = np.full(len(pos), 1000.0 / 64**2), np.ones(len(pos))
        flip.rasterize(pos, np.zeros_like(pos), mass, ones, flip.solids(boundary), fields)
        densities.append(fields.density.reshape(flip.grid.counts)[PADDING + 8, PADDING + 4])
    assert densities[0] == pytest.approx(1.0, abs=0.02) and densities[1] > densities[0] + 0.03


def test_surface_distance_of_a_half_space():
    """Inverts the density that a plane surface at distance s gives to a hat kernel."""
    for s in np.linspace(-0.99, 0.99, 9):
        t = np.linspace(-1.0, 1.0, 200001)
        density = np.sum(np.where(t < -s, 1.0 - np.abs(t), 0.0)) * (t[1] - t[0])
        assert surface_distance(density) == pytest.approx(s, abs=1e-3)
    assert surface_distance(0.0) == 1.0 and surface_distance(1.7) == -1.0


@pytest.mark.parametrize("dim", [2, 3])
def test_transfer_conserves_mass_and_momentum(dim):
    flip, state = solver(dim), liquid(dim, boundary=Boundary.empty(dim))
    fields = Fields.empty(flip.grid)
    flip.rasterize(state.pos, state.vel, state.mass, state.material_params[:, 0].copy(), flip.solids(state.boundary), fields)
    volume = state.mass.sum() / 1000.0 * 16**dim
    assert fields.density.sum() == pytest.approx(volume)
    for axis in range(dim):
        assert fields.weight[axis].sum() == pytest.approx(volume)
        momentum = (state.mass / 1000.0 * 16**dim * state.vel[:, axis]).sum()
        assert (fields.weight[axis] * fields.velocity[axis]).sum() == pytest.approx(momentum)


@pytest.mark.parametrize("dim", [2, 3])
def test_viscosity_conserves_momentum_of_a_free_body(dim):
    flip, state = solver(dim, viscosity_tolerance=1e-12), liquid(dim, boundary=Boundary.empty(dim))
    fields = Fields.empty(flip.grid)
    solids = flip.solids(state.boundary)
    active = flip.rasterize(state.pos, state.vel, state.mass, state.material_params[:, 0].copy(), solids, fields)
    before = (fields.weight * fields.velocity).sum(axis=1)
    old = fields.velocity.copy()
    flip.diffuse(active, solids, fields, 0.05)
    np.testing.assert_allclose((fields.weight * fields.velocity).sum(axis=1), before, atol=1e-8)
    assert np.abs(fields.velocity - old).max() > 0.1


def test_fields_are_empty_after_a_substep():
    flip, state = solver(), liquid()
    fields = Fields.empty(flip.grid)
    pos, vel = state.pos.copy(), state.vel.copy()
    flip._advance(pos, vel, state.mass, state.material_params[:, 0].copy(), state.gravity, 5e-3, flip.solids(state.boundary), fields, None)
    for name, value in vars(Fields.empty(flip.grid)).items():
        if name != "island":
            np.testing.assert_array_equal(getattr(fields, name), value, err_msg=name)


def test_separate_bodies_do_not_act_on_each_other():
    """A body that hits the floor changes nothing for one in mid-air, to the last bit of its parabola."""
    flip = solver(frame_dt=0.01)
    lattice = np.stack(np.meshgrid(np.arange(8), np.arange(8), indexing="ij"), axis=-1).reshape(-1, 2) / 32
    pos = np.concatenate([lattice + np.array([0.1, 0.0]), lattice + np.array([0.6, 0.5])])
    state = replace(liquid(count=128), pos=pos, vel=np.zeros_like(pos), mass=np.full(128, 1000.0 / 32**2))
    after = state
    for _ in range(10):
        after = flip.step(after)
    np.testing.assert_allclose(after.pos[64:], state.pos[64:] + 0.5 * 0.1**2 * state.gravity, atol=1e-14)
    assert np.abs(after.pos[:64] - state.pos[:64]).max() < 0.04


@pytest.mark.parametrize("filled", [1.0, 0.5])
@pytest.mark.parametrize("thick", [1, 2, 3])
def test_spaces_that_a_wall_divides_keep_their_volumes(thick, filled):
    """The left one is full and closed. Before, kernels of the particles met in walls of up to two cells, and the density system had no solution."""
    cell, bounds = 1 / 24, ((0.0, 1.0), (0.0, 0.5))
    left, right = 0.5 - (thick // 2) * cell, 0.5 + (thick - thick // 2) * cell
    boundary = Boundary.sample((*domain_walls(bounds, 0.0), Box((left, 0.0), (right, 0.5), 0.0)), 0.1, 2)
    full = block([0.0, 0.0], [left, 0.5], cell / 2, "fluid", gravity=(0.0, -9.81), boundary=boundary, jitter=0.1)
    other = block([right, 0.0], [1.0 - right, 0.5 * filled], cell / 2, "fluid", jitter=0.1, seed=2)
    start = together(("fluid",), full, other)
    after = run(FLIP(bounds=bounds, grid_spacing=cell, frame_dt=0.01), start, 20)
    is_left = np.arange(start.num_nodes) < full.num_nodes
    np.testing.assert_array_equal(after.pos[:, 0] < 0.5, is_left)
    for side in (is_left, ~is_left):
        np.testing.assert_allclose(after.pos[side].mean(axis=0), start.pos[side].mean(axis=0), atol=1e-3)


def test_particles_inside_a_solid_come_out():
    boundary = Boundary.sample((*domain_walls(((0.0, 1.0),) * 2, 0.0), Sphere((0.5, 0.5), 0.15, 0.0)), 0.1, 2)
    state = liquid(boundary=boundary)
    assert np.linalg.norm(state.pos - 0.5, axis=1).min() < 0.05
    after = solver().step(state)
    assert np.linalg.norm(after.pos - 0.5, axis=1).min() > 0.15 - 1e-12


def test_several_viscosities_in_one_scene():
    """Each particle has its own viscosity: when a liquid spreads on the floor, its thin half moves further than its thick half."""
    lattice = np.stack(np.meshgrid(np.arange(16), np.arange(16), indexing="ij"), axis=-1).reshape(-1, 2) / 32 + 1 / 64
    pos = lattice + np.array([0.25, 0.0])
    thick = pos[:, 0] < 0.5
    state = replace(
        liquid(count=256),
        pos=pos,
        vel=np.zeros_like(pos),
        mass=np.full(256, 1000.0 / 32**2),
        material_params=np.where(thick, 1.0, 1e-3)[:, None],
    )
    for _ in range(40):
        state = solver(frame_dt=0.01).step(state)
    assert 0.25 - state.pos[:, 0].min() < 0.5 * (state.pos[:, 0].max() - 0.75)


def test_pressure_that_cannot_be_solved_is_an_error():
    """It names the system, the residual and what to do."""
    state = liquid(count=2000)
    with pytest.raises(SimulationError, match=r"pressure system has a residual of .* after 1 iterations.*frame_dt") as caught:
        solver(max_iterations=1).step(state)
    assert caught.value.reason == "explosion"


def test_failed_step_leaves_no_trace():
    state = liquid(count=2000)
    expected = solver().step(state)
    with pytest.raises(SimulationError):
        solver(max_iterations=1).step(state)
    after = solver().step(state)
    assert after.pos.tobytes() == expected.pos.tobytes() and after.vel.tobytes() == expected.vel.tobytes()


@pytest.mark.parametrize(
    "change",
    [
        {"bounds": ((0, 1),)},
        {"bounds": ((0, 1), (0, 1.01))},
        {"bounds": ((0, 1), (1, 0))},
        {"grid_spacing": -1.0},
        {"frame_dt": 0.0},
        {"materials": ("sand",)},
        {"materials": ()},
        {"cfl": 1.5},
        {"pic": -0.1},
        {"misspelt": 1},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(ValueError):
        solver(**change)


def test_boundaries_that_do_not_fit_are_refused():
    state = liquid()
    for boundary in (
        replace(state.boundary, vel=state.boundary.vel + 1),
        replace(state.boundary, restitution=state.boundary.restitution + 0.5),
        Boundary.empty(3),
    ):
        with pytest.raises(SimulationError) as caught:
            solver().step(replace(state, boundary=boundary))
        assert caught.value.reason == "input"


@pytest.mark.parametrize("seed", range(6))
def test_anything_finite_gives_a_state_in_the_domain_or_a_typed_error(seed):
    """States have few or many particles, clumped or spread, of any mass, viscosity, speed and gravity, some of them inside obstacles."""
    rng = np.random.default_rng(seed)
    dim = 2 + seed % 2
    count = int(rng.integers(1, 300))
    boundary = Boundary.sample((*domain_walls(((0.0, 1.0),) * dim, 0.0), Sphere((0.5,) * dim, 0.2, 0.0)), 0.2, dim)
    state = replace(
        liquid(dim, count, boundary),
        pos=np.clip(rng.random(dim) + rng.normal(size=(count, dim)) * 10.0 ** rng.uniform(-4, 0), 0, 1),
        vel=rng.normal(size=(count, dim)) * 10.0 ** rng.uniform(-2, 2),
        mass=10.0 ** rng.uniform(-6, 3, count),
        material_params=10.0 ** rng.uniform(-6, 1, (count, 1)),
        gravity=rng.normal(size=dim) * 10.0 ** rng.uniform(-1, 2),
    )
    try:
        for _ in range(5):
            state = solver(dim, frame_dt=0.01).step(state)
    except SimulationError as error:
        assert error.reason == "explosion"
    else:
        assert np.all(np.isfinite(state.vel)) and np.all((state.pos >= 0) & (state.pos <= 1))


def test_grid_is_shared():
    assert solver().grid is make_grid(((0.0, 1.0),) * 2, 1 / 16)


@pytest.mark.slow
def test_compile_kernels_leaves_nothing_to_compile():
    """Every kernel has one specialisation, which serves 2D and 3D."""
    script = """
import numpy as np
from numba.core.registry import CPUDispatcher
from gpe_pl.solvers import flip
from tests.unit.solvers.test_flip import liquid, solver
kernels = [f for m in (flip.linear, flip.transfer, flip.pressure, flip.viscosity, flip.islands) for f in vars(m).values() if isinstance(f, CPUDispatcher)]
flip.FLIP(bounds=((0, 1), (0, 1)), grid_spacing=0.25).compile_kernels()
outer = [f for f in kernels if f.signatures]
counts = [len(f.signatures) for f in kernels]
solver(3).step(liquid(3, 3000))
assert len(outer) >= 15 and set(counts) <= {0, 1} and counts == [len(f.signatures) for f in kernels], counts
"""
    child = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=Path(__file__).parents[3], check=False)
    assert child.returncode == 0, child.stderr


@pytest.mark.parametrize("height", [0.3, 0.99])
def test_an_obstacle_thinner_than_a_cell_is_refused(height):
    """Liquid at 10 m/s went through a plate of 0.3 cells on a grid line."""
    cell = 1 / 16
    solver = FLIP(bounds=((0, 1), (0, 1)), grid_spacing=cell)
    plate = Box((0.1, 0.5), (0.9, 0.5 + height * cell), 0.0)
    with pytest.raises(SimulationError, match="m thin; on a grid of spacing 0.0625 m"):
        solver.solids(Boundary.sample((plate,), cell / 2, 2))
