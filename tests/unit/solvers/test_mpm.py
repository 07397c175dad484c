"""The material point solver: settings, absurd states, thin obstacles, several materials on one grid."""

import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, Polygon, Sphere, domain_walls
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import MATERIALS, node_code, param_names
from gpe_pl.solvers.mpm import MPM, MPMInternal
from gpe_pl.trajectory.boundary import Boundary
from tests.particles import VALUE, block, run, together

ALL = ("sand", "snow", "elastomer", "fluid")
CELL = 1 / 24


def bounds(dim):
    return ((0.0, 1.0),) * dim


def closed(dim, *obstacles, friction=0.3):
    """Return walls on all sides, and obstacles."""
    return Boundary.sample((*domain_walls(bounds(dim), friction), *obstacles), CELL / 2, dim)


def scene(dim, material, value=None, speed=0.0):
    """Return a small block that moves down at ``speed`` [m/s]."""
    down, size = np.array([0.0] * (dim - 1) + [-1.0]), (0.25, 0.2) if dim == 2 else (0.125, 0.125, 0.125)
    low = (0.4,) * (dim - 1) + (0.1,)
    return block(low, size, CELL / 2, material, value=value, boundary=closed(dim), velocity=speed * down, gravity=9.81 * down)


@pytest.mark.parametrize(
    "change",
    [
        {"bounds": ((0, 1),)},
        {"bounds": ((0, 1),) * 4},
        {"bounds": ((0, 1), (0, 1.01))},
        {"bounds": ((0, 1), (1, 0))},
        {"grid_spacing": -1.0},
        {"frame_dt": 0.0},
        {"sand": {"poisson_ratio": 0.5}},
        {"sand": {"density": 0.0}},
        {"snow": {"critical_compression": 1.0}},
        {"snow": {"max_hardening": 0.5}},
        {"elastomer": {"youngs_modulus": 1e5}},  # a parameter of each particle
        {"materials": ("solid",)},
        {"fluid": {"bulk_modulus": 0.0}},
        {"materials": ()},
        {"cfl": 1.5},
        {"misspelt": 1},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(ValueError):
        MPM(**{"bounds": ((0, 1), (0, 1)), "grid_spacing": 1 / 16, **change})


def internal(state, **changes):
    return replace(MPMInternal.at_rest(state.num_nodes, state.dim), **changes)


def filled(state, value):
    return np.full((state.num_nodes, state.dim, state.dim), value)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", ALL)
@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("input", lambda s: replace(s, internal=MPMInternal.at_rest(3, s.dim))),
        ("nan", lambda s: replace(s, internal=internal(s, deformation=filled(s, math.nan)))),
        ("input", lambda s: replace(s, boundary=replace(s.boundary, vel=s.boundary.vel + 1))),
        ("input", lambda s: replace(s, boundary=replace(s.boundary, restitution=s.boundary.restitution + 0.5))),
        ("input", lambda s: replace(s, boundary=Boundary.empty(5 - s.dim), gravity=np.zeros(5 - s.dim))),
        ("input", lambda s: replace(s, boundary=replace(s.boundary, shapes=(Sphere((0.5,) * (5 - s.dim), 0.2, 0.3),)))),
        ("input", lambda s: replace(s, boundary=replace(s.boundary, shapes=domain_walls(bounds(5 - s.dim), 0.3)))),
        (None, lambda s: replace(s, internal=internal(s, affine=filled(s, 1e8)))),
        (None, lambda s: replace(s, internal=internal(s, affine=filled(s, -1e150)))),
        (None, lambda s: replace(s, internal=internal(s, deformation=filled(s, 1e150)))),
        (None, lambda s: replace(s, internal=internal(s, deformation=filled(s, 0.0)))),
        (None, lambda s: replace(s, internal=internal(s, deformation=filled(s, 1.0)))),
        (None, lambda s: replace(s, internal=internal(s, deformation=-internal(s).deformation))),
        (None, lambda s: replace(s, internal=internal(s, plastic=np.full(s.num_nodes, 1e300)))),
        (None, lambda s: replace(s, internal=internal(s, plastic=np.full(s.num_nodes, -1e300)))),
    ],
)
def test_absurd_internal_state_or_boundary(dim, material, reason, change):
    """A typed error, or a finite state within the domain."""
    solver, state = MPM(bounds=bounds(dim), grid_spacing=CELL, materials=(material,)), scene(dim, material)
    if reason is not None:
        with pytest.raises(SimulationError) as caught:
            solver.step(change(state))
        assert caught.value.reason == reason
        return
    try:
        after = run(solver, change(state), 3)
    except SimulationError as error:
        assert error.reason in ("nan", "escape", "explosion")
    else:
        assert np.all(np.isfinite(after.pos)) and np.all(np.abs(after.pos - 0.5) <= 0.5 + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("speed", [10.0, 100.0])
@pytest.mark.parametrize(
    ("material", "value"), [(m, v) for m in ALL for v in (MATERIALS[m][0].limits.low, VALUE[m], MATERIALS[m][0].limits.high)]
)
def test_stable_for_every_parameter(dim, speed, material, value):
    """After an impact at 10 m/s, the body is within the domain and no faster than before. At 100 m/s, a typed error is also allowed."""
    assert_stable(material, scene(dim, material, value, speed), speed, 40 if dim == 2 else 15)


@pytest.mark.parametrize(
    ("material", "further"),
    [
        ("sand", {"cohesion": 2e4}),
        ("snow", {"critical_compression": 0.2, "critical_stretch": 0.2}),
        ("snow", {"critical_compression": 1e-3, "critical_stretch": 1e-3}),
        ("elastomer", {"poisson_ratio": 0.49}),
    ],
)
def test_stable_at_the_limits_of_further_parameters(material, further):
    state = scene(2, material, VALUE[material], 10.0)
    columns = [state.material_params[:, 0], *(np.full(state.num_nodes, value) for value in further.values())]
    state = replace(state, material_params=np.stack(columns, axis=1), param_names=param_names((material,), further))
    assert_stable(material, state, 10.0, 40)


def assert_stable(material, state, speed, num_frames):
    solver, fastest = MPM(bounds=bounds(state.dim), grid_spacing=CELL, materials=(material,), frame_dt=2e-3, max_substeps=2000), 0.0
    try:
        for _ in range(num_frames):
            state = solver.step(state)
            fastest = max(fastest, math.sqrt(np.mean(np.sum(state.vel**2, axis=1))))
    except SimulationError:
        assert speed > 10.0
        return
    assert np.all(np.abs(state.pos - 0.5) <= 0.5) and np.all(np.isfinite(state.internal.deformation))
    assert fastest <= speed + 1.0  # it falls a little before it hits


@pytest.mark.parametrize("dim", [2, 3])
def test_materials_far_apart_do_not_see_each_other(dim):
    """Blocks that share no grid node move as each does alone, when every frame is one substep."""
    solver = MPM(bounds=bounds(dim), grid_spacing=CELL, materials=ALL, frame_dt=1e-4)
    place = (0.3,) * (dim - 1)
    blocks = [block((0.02 + 0.27 * k, *place), (0.125,) * dim, CELL / 2, m, boundary=closed(dim)) for k, m in enumerate(ALL)]
    for b in blocks:
        b.vel[:] = -5.0 * (b.pos - b.pos.mean(axis=0))  # implode
    mixed = run(solver, together(ALL, *blocks), 30)
    for material, start in zip(ALL, blocks, strict=True):
        alone = run(replace(solver, materials=(material,)), start, 30)
        np.testing.assert_allclose(mixed.pos[mixed.node_type == node_code(material)], alone.pos, atol=1e-13)
        assert np.abs(alone.vel - start.vel).max() > 0.05


def test_stiffest_particle_sets_the_substeps():
    """One stiff particle far away changes the substeps, and so the rounding, of all others; a soft one does not."""
    solver = MPM(bounds=bounds(2), grid_spacing=CELL, materials=("elastomer",))
    state = scene(2, "elastomer", 1e5, 1.0)

    def beside(value):
        one = block((0.05, 0.8), (CELL / 2,) * 2, CELL / 2, "elastomer", value=value, velocity=(0.0, -1.0), gravity=(0.0, -9.81))
        return run(solver, together(("elastomer",), state, one), 20).pos[:-1]

    alone = run(solver, state, 20).pos
    np.testing.assert_array_equal(beside(1e3), alone)
    assert not np.array_equal(beside(1e8), alone)


def test_extra_arrays_of_the_state_are_carried():
    state = scene(2, "elastomer")
    mesh = replace(state, rest_pos=state.pos, cells=np.zeros((1, 4), np.int64))
    after = MPM(bounds=bounds(2), grid_spacing=CELL, materials=("elastomer",)).step(mesh)
    assert after.cells is mesh.cells and after.rest_pos is mesh.rest_pos


def meshed(dim):
    """Return a block of elastomer at rest with one cell, and its solver."""
    state = scene(dim, "elastomer")
    cells = np.array([[0, 1, 20, 21]] if dim == 2 else [[0, 1, 20]])
    return MPM(bounds=bounds(dim), grid_spacing=CELL, materials=("elastomer",)), replace(state, rest_pos=state.pos.copy(), cells=cells)


@pytest.mark.parametrize("dim", [2, 3])
def test_deformed_mesh_without_internal_state_is_refused(dim):
    """A mesh that was moved or turned as a whole, or changed by rounding or less than a thousandth, counts as undeformed."""
    solver, state = meshed(dim)
    turn = np.eye(dim)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    middle = state.pos.mean(axis=0)
    for pos in (state.pos + 0.01, middle + (state.pos - middle) @ turn.T, state.pos.astype(np.float32), 1.0005 * state.pos):
        solver.step(replace(state, pos=pos))
    squeezed = replace(state, pos=state.pos * np.array([1.0] * (dim - 1) + [0.9]))
    with pytest.raises(
        SimulationError, match=r"cells are stretched or compressed by up to .* % against rest_pos .*start at frame 0"
    ) as caught:
        solver.step(squeezed)
    assert caught.value.reason == "input" and caught.value.node in state.cells
    solver.step(replace(squeezed, internal=internal(state)))


def bounce(dim, modulus, cfl):
    """Return the rebound height of a block's centre, over the height of its fall."""
    height, spacing, bottom = 0.1, CELL / 2, np.eye(dim)[-1]
    low = (0.4,) * (dim - 1) + (height,)
    state = block(
        low, (8 * spacing,) * dim, spacing, "elastomer", value=modulus, boundary=closed(dim, friction=0.0), gravity=-9.81 * bottom
    )
    solver, heights = MPM(bounds=bounds(dim), grid_spacing=CELL, materials=("elastomer",), cfl=cfl), []
    for _ in range(75):
        state = solver.step(state)
        heights.append(state.mass @ state.pos[:, -1] / state.mass.sum())
    assert state.pos[:, -1].min() > 0.01  # it has left the floor
    middle = height + 4 * spacing
    return (max(heights[np.argmin(heights) :]) - middle) / height + 1


@pytest.mark.parametrize("modulus", [2e4, 1e6])
def test_bounce_does_not_depend_on_the_time_step(modulus):
    """Substeps of a quarter of the length lose as much energy, from the softest to the stiffest elastomer of the data."""
    assert bounce(2, modulus, 0.125) == pytest.approx(bounce(2, modulus, 0.5), rel=0.03)


def settled_height(hardening, cfl):
    """Return the height [m] of the centre of a snow block with one particle per cell, after a fall."""
    state = block((0.3, 0.25), (0.25, 0.25), CELL, "snow", value=hardening, velocity=(0.0, -1.0), boundary=closed(2), gravity=(0.0, -9.81))
    after = run(MPM(bounds=bounds(2), grid_spacing=CELL, materials=("snow",), cfl=cfl), state, 120)
    return after.mass @ after.pos[:, 1] / after.mass.sum()


def test_how_snow_settles_does_not_depend_on_the_time_step():
    assert settled_height(3.0, 0.125) == pytest.approx(settled_height(3.0, 0.5), rel=0.03)


def test_viscosity_does_not_depend_on_the_time_step():
    """A shear wave of 16 cells in a free body of liquid decays by its viscosity and the grid's own, which shorter substeps do not raise."""
    nominal, wave, amplitude = 6e-3, 2 * math.pi / (16 * CELL), []
    solver = MPM(bounds=((0.0, 32 * CELL),) * 2, grid_spacing=CELL, materials=("fluid",))
    state = block((2 * CELL,) * 2, (28 * CELL,) * 2, CELL, "fluid", value=nominal)
    state.vel[:, 0] = 1e-3 * np.sin(wave * state.pos[:, 1])
    for cfl in (0.5, 0.125):
        after = run(replace(solver, cfl=cfl), state, 28)
        amplitude.append(
            (after.vel[:, 0] * np.sin(wave * after.pos[:, 1])).sum() / (state.vel[:, 0] * np.sin(wave * state.pos[:, 1])).sum()
        )
    coarse, fine = -np.log(amplitude) / (28 * solver.frame_dt * wave**2)
    assert fine == pytest.approx(coarse, rel=0.05)
    assert coarse == pytest.approx(nominal + solver.numerical_viscosity, rel=0.1)


# --- obstacles -----------------------------------------------------------------------------------------------------------------------------


def thin(name, thickness):
    """Return an obstacle of one kind with a smallest thickness, around the middle of a grid cell."""
    x, y, half = 0.5 + CELL / 2, 0.5 + CELL / 2, thickness / 2
    return {
        "flat box": lambda: Box((-0.5, y - half), (1.5, y + half), 0.3),
        "narrow box": lambda: Box((x - half, 0.2), (x + half, 0.8), 0.3),
        "sphere": lambda: Sphere((x, y), half, 0.3),
        "turned slab": lambda: Polygon(((0.2, 0.2), (0.2 + 2**0.5 * thickness, 0.2), (0.8, 0.8 - 2**0.5 * thickness), (0.8, 0.8)), 0.3),
        "triangle": lambda: Polygon(((0.2, y - thickness), (0.8, y - thickness), (0.8, y + thickness)), 0.3),
        "thin arm": lambda: Polygon(((0.2, 0.2), (0.8, 0.2), (0.8, 0.2 + thickness), (0.4, 0.2 + thickness), (0.4, 0.8), (0.2, 0.8)), 0.3),
        "plate": lambda: Box((-0.5, -0.5, y - half), (1.5, 1.5, y + half), 0.3),
        "ball": lambda: Sphere((x, y, y), half, 0.3),
    }[name]()


SOLVER = {dim: MPM(bounds=bounds(dim), grid_spacing=CELL) for dim in (2, 3)}


def with_obstacle(obstacle, dim):
    return replace(scene(dim, "sand"), boundary=closed(dim, obstacle))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flat box", "narrow box", "sphere", "turned slab", "triangle", "thin arm", "plate", "ball"])
def test_obstacle_thinner_than_a_cell_is_refused(name):
    """The error names the shape and the smallest thickness that the grid resolves."""
    dim = 3 if name in ("plate", "ball") else 2
    for cells in (0.02, 0.5, 0.95):
        with pytest.raises(SimulationError, match=rf"{type(thin(name, 0.1)).__name__}.*at least {CELL:g} m thick") as caught:
            SOLVER[dim].step(with_obstacle(thin(name, cells * CELL), dim))
        assert caught.value.reason == "input"
    SOLVER[dim].step(with_obstacle(thin(name, 1.8 * CELL), dim))


def test_obstacle_between_grid_nodes_is_refused():
    with pytest.raises(SimulationError, match=r"Sphere.*contains no node of the grid") as caught:
        SOLVER[2].step(with_obstacle(thin("sphere", 1.2 * CELL), 2))
    assert caught.value.reason == "input"
    SOLVER[2].step(with_obstacle(thin("flat box", CELL), 2))  # exactly one cell is enough for a box


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
def test_thinnest_allowed_slab_holds_at_10_m_per_s(dim, offset):
    low = 0.3 + offset * CELL
    slab = Box((-0.5,) * (dim - 1) + (low,), (1.5,) * (dim - 1) + (low + CELL,), 0.3)
    start = block((0.25,) * (dim - 1) + (0.5,), (0.5,) * (dim - 1) + (0.1,), CELL, velocity=(0.0,) * (dim - 1) + (-10.0,))
    state, lowest = replace(start, boundary=closed(dim, slab)), math.inf
    for _ in range(20):
        state = SOLVER[dim].step(state)
        lowest = min(lowest, state.pos[:, -1].min())
    assert slab.high[-1] - 1e-9 <= lowest < slab.high[-1] + CELL / 2


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_fall_from_rest_never_jumps_over_an_obstacle(dim):
    """Under any gravity that the solver accepts, particles stay above the slab below them."""
    slab = Box((-0.5,) * (dim - 1) + (0.3,), (1.5,) * (dim - 1) + (0.3 + 2 * CELL,), 0.3)
    top = slab.high[-1]
    start = block((0.1,) * (dim - 1) + (top + 0.01,), (0.8,) * (dim - 1) + (CELL,), CELL)
    refused = []
    for magnitude in (1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9):
        state = replace(start, boundary=closed(dim, slab), gravity=np.array([0.0] * (dim - 1) + [-magnitude]))
        try:
            assert SOLVER[dim].step(state).pos[:, -1].min() >= top - 1e-9, magnitude
        except SimulationError as error:
            assert error.reason == "explosion"
            refused.append(magnitude)
    assert 1e9 in refused and 1e5 not in refused
