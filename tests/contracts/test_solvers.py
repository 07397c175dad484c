"""What every ground-truth solver promises. A new solver joins by an entry in ``SOLVERS``."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from gpe_pl.geometry import Box, Polygon, Sphere, domain_walls
from gpe_pl.rollout import SimulationError, Simulator, rollout
from gpe_pl.solvers.mpm import MPM, MPMInternal
from gpe_pl.solvers.scenes import SceneConfig, describe, sample_scene
from gpe_pl.trajectory import Boundary

SCENE = SceneConfig(bounds=((0, 1), (0, 1)), grid_spacing=1 / 24, num_particles=150)
SOLVERS = {"mpm-sand": (MPM(bounds=SCENE.bounds, grid_spacing=SCENE.grid_spacing), "sand", 30.0)}


@pytest.fixture(params=SOLVERS)
def case(request):
    solver, material, value = SOLVERS[request.param]
    return solver, sample_scene(SCENE, material, value, 3)


def run(solver, state, num_steps):
    for _ in range(num_steps):
        state = solver.step(state)
    return state


def arrays(state):
    """Every array of a state, the solver's internal ones included."""
    named = {name: getattr(state, name) for name in ("pos", "vel", "node_type", "mass", "material_params", "gravity")}
    named |= {f"boundary.{name}": getattr(state.boundary, name) for name in ("pos", "vel", "normal", "friction", "restitution")}
    if state.internal is not None:
        named |= {f"internal.{name}": value for name, value in vars(state.internal).items()}
    return named


def assert_same_bytes(a, b):
    a, b = arrays(a), arrays(b)
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].tobytes() == b[name].tobytes(), name


def isolated(state, gravity=(0.0, 0.0)):
    """The same particles without walls, at rest at mid-air."""
    return replace(state, boundary=Boundary.empty(state.dim), gravity=np.asarray(gravity), vel=np.zeros_like(state.vel), internal=None)


def test_is_a_simulator(case):
    assert isinstance(case[0], Simulator)


def test_same_input_gives_same_bytes(case):
    solver, state = case
    assert_same_bytes(run(solver, state, 40), run(solver, state, 40))


def test_restart_equals_run_through(case):
    solver, state = case
    middle = run(solver, state, 25)
    fresh = type(solver)(**{f.name: getattr(solver, f.name) for f in fields(solver)})
    assert_same_bytes(run(fresh, middle, 15), run(solver, state, 40))


def test_internal_state_matters(case):
    """Without its internal part a restart differs, so the test above cannot pass by accident."""
    solver, state = case
    middle = run(solver, state, 40)
    assert not np.array_equal(solver.step(replace(middle, internal=None)).pos, solver.step(middle).pos)


def test_input_is_not_modified(case):
    solver, state = case
    for before in (state, run(solver, state, 20)):
        copies = {name: value.copy() for name, value in arrays(before).items()}
        after = solver.step(before)
        for name, value in arrays(before).items():
            assert value.tobytes() == copies[name].tobytes(), name
        assert not np.array_equal(after.pos, before.pos)
        assert not any(np.shares_memory(a, b) for a, b in zip(arrays(after).values(), (before.pos, before.vel), strict=False))


def test_step_advances_one_frame(case):
    solver, state = case
    after = run(solver, state, 3)
    assert after.time == pytest.approx(3 * solver.frame_dt)
    assert after.num_nodes == state.num_nodes and after.pos.dtype == np.float64


def test_free_fall(case):
    """A free body falls with g t, whatever the substeps are, and stays within their error of the parabola."""
    solver, state = case
    start = isolated(state, (0.3, -9.81))
    after, t = run(solver, start, 10), 10 * solver.frame_dt
    np.testing.assert_allclose(after.vel, np.broadcast_to(start.gravity * t, after.vel.shape), atol=1e-12)
    np.testing.assert_allclose(after.pos, start.pos + start.gravity * t**2 / 2, atol=9.81 * t * solver.solver_dt)


def test_momentum_is_conserved_without_boundary(case):
    solver, state = case
    start = isolated(state)
    middle = start.pos.mean(axis=0)
    start = replace(start, vel=-2.0 * (start.pos - middle) + np.array([0.1, 0.05]))  # implodes and bounces
    momentum = (start.mass[:, None] * start.vel).sum(axis=0)
    scale = (start.mass[:, None] * np.abs(start.vel)).sum()
    after = run(solver, start, 20)
    assert np.abs((after.mass[:, None] * after.vel).sum(axis=0) - momentum).max() < 1e-12 * scale
    assert not np.allclose(after.vel, start.vel, atol=0.1)


def test_translated_scene_gives_translated_result(case):
    """Moving everything by whole cells changes nothing else."""
    solver, state = case
    start = isolated(state)
    start = replace(start, vel=np.sin(7 * start.pos[:, ::-1]))
    shift = np.array([SCENE.grid_spacing, -SCENE.grid_spacing])
    a, b = run(solver, start, 10), run(solver, replace(start, pos=start.pos + shift), 10)
    np.testing.assert_allclose(b.pos, a.pos + shift, atol=1e-9)


def test_order_of_particles_does_not_matter(case):
    solver, state = case
    order = np.random.default_rng(0).permutation(state.num_nodes)
    per_node = ("pos", "vel", "node_type", "mass", "material_params")
    shuffled = replace(state, **{name: getattr(state, name)[order] for name in per_node})
    np.testing.assert_allclose(run(solver, shuffled, 10).pos, run(solver, state, 10).pos[order], atol=1e-9)


def test_empty_state(case):
    solver, state = case
    per_node = ("pos", "vel", "node_type", "mass", "material_params")
    empty = replace(state, **{name: getattr(state, name)[:0] for name in per_node})
    assert run(solver, empty, 2).num_nodes == 0


def poke(state, name, node, value):
    array = np.array(getattr(state, name), dtype=np.float64)
    array[node] = value
    return replace(state, **{name: array})


def internal(state, **changes):
    return replace(MPMInternal.at_rest(state.num_nodes, state.dim), **changes)


HOSTILE = {
    "nan position": ("nan", 5, lambda s: poke(s, "pos", 5, math.nan)),
    "infinite position": ("nan", 6, lambda s: poke(s, "pos", 6, math.inf)),
    "nan velocity": ("nan", 7, lambda s: poke(s, "vel", 7, math.nan)),
    "infinite velocity": ("nan", 8, lambda s: poke(s, "vel", 8, -math.inf)),
    "outside": ("escape", 9, lambda s: poke(s, "pos", 9, 1.5)),
    "far outside": ("escape", 10, lambda s: poke(s, "pos", 10, -1e300)),
    "absurd velocity": ("explosion", 11, lambda s: poke(s, "vel", 11, 1e9)),
    "overflowing velocity": ("nan", 12, lambda s: poke(s, "vel", 12, 1e200)),
    "no mass": ("input", 13, lambda s: poke(s, "mass", 13, 0.0)),
    "parameter out of range": ("input", 14, lambda s: poke(s, "material_params", 14, 90.0)),
    "parameter nan": ("input", 15, lambda s: poke(s, "material_params", 15, math.nan)),
    "unknown material": (
        "input",
        16,
        lambda s: replace(s, node_type=np.where(np.arange(s.num_nodes) == 16, 2, s.node_type).astype(np.uint8)),
    ),
    "wrong dimension": ("input", -1, lambda s: replace(s, pos=np.ones((s.num_nodes, 3)))),
    "missing velocity": ("input", -1, lambda s: replace(s, vel=s.vel[:-1])),
    "nan gravity": ("nan", -1, lambda s: replace(s, gravity=np.array([0.0, math.nan]))),
    "foreign internal state": ("input", -1, lambda s: replace(s, internal={"F": 1})),
    "internal of another size": ("input", -1, lambda s: replace(s, internal=MPMInternal.at_rest(3, 2))),
    "nan deformation": ("nan", 0, lambda s: replace(s, internal=internal(s, deformation=np.full((s.num_nodes, 2, 2), math.nan)))),
    "absurd rotation": (None, None, lambda s: replace(s, internal=internal(s, affine=np.full((s.num_nodes, 2, 2), 1e8)))),
    "absurd deformation": (None, None, lambda s: replace(s, internal=internal(s, deformation=np.full((s.num_nodes, 2, 2), 1e150)))),
    "moving boundary": ("input", -1, lambda s: replace(s, boundary=replace(s.boundary, vel=s.boundary.vel + 1))),
    "bouncing boundary": ("input", -1, lambda s: replace(s, boundary=replace(s.boundary, restitution=s.boundary.restitution + 0.5))),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_input_gives_a_typed_error(case, name):
    """Never a crash, a hang or a silent NaN: an error with a reason and the particle, or a state within the domain."""
    solver, state = case
    reason, node, change = HOSTILE[name]
    if reason is None:
        try:
            after = run(solver, change(state), 3)
        except SimulationError as error:
            assert error.reason in ("nan", "escape", "explosion")
        else:
            assert np.all(np.isfinite(after.pos)) and np.all(np.abs(after.pos - 0.5) <= 0.5 + 1e-12)
        return
    with pytest.raises(SimulationError) as caught:
        solver.step(change(state))
    assert (caught.value.reason, caught.value.node) == (reason, node)


@pytest.mark.parametrize("seed", range(5))
def test_random_particles_stay_in_the_domain(case, seed):
    """Particles thrown anywhere, overlapping and inside obstacles, at up to 10 m/s."""
    solver, state = case
    rng = np.random.default_rng(seed)
    state = replace(state, pos=rng.uniform(0, 1, state.pos.shape), vel=rng.uniform(-10, 10, state.vel.shape))
    after = run(solver, state, 20)
    assert np.all((after.pos >= 0) & (after.pos <= 1)) and np.all(np.isfinite(after.vel))


@pytest.mark.parametrize("magnitude", [1e9, 1e30, 1e200])
def test_absurd_gravity_is_an_explosion(case, magnitude):
    """Whether or not there are particles to name."""
    solver, state = case
    gravity = np.array([0.0, -magnitude])
    with pytest.raises(SimulationError, match="gravity") as caught:
        solver.step(replace(isolated(state), gravity=gravity))
    assert caught.value.reason == "explosion" and 0 <= caught.value.node < state.num_nodes
    if magnitude > 1e9:
        per_node = ("pos", "vel", "node_type", "mass", "material_params")
        empty = replace(isolated(state), **{name: getattr(state, name)[:0] for name in per_node})
        with pytest.raises(SimulationError) as caught:
            solver.step(replace(empty, gravity=gravity))
        assert (caught.value.reason, caught.value.node) == ("explosion", -1)


def test_fall_from_rest_never_jumps_over_an_obstacle(case):
    """Under any gravity that the solver accepts, particles stay above the slab below them."""
    solver, state = case
    slab = Box((-0.5, 0.3), (1.5, 0.3 + 2 * SCENE.grid_spacing), 0.3)
    boundary = Boundary.sample((*domain_walls(SCENE.bounds, 0.3), slab), SCENE.spacing, 2)
    top = slab.high[1]
    pos = np.random.default_rng(0).uniform((0.1, top + 0.01), (0.9, top + 0.05), state.pos.shape)
    start = replace(state, pos=pos, vel=np.zeros_like(pos), boundary=boundary)
    refused = []
    for magnitude in (1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9):
        try:
            assert solver.step(replace(start, gravity=np.array([0.0, -magnitude]))).pos[:, 1].min() >= top - 1e-9, magnitude
        except SimulationError as error:
            assert error.reason == "explosion"
            refused.append(magnitude)
    assert 1e9 in refused and 1e5 not in refused


def thin(name, thickness):
    """An obstacle of one kind with a smallest thickness, around the middle of a grid cell."""
    x, y, half = 0.5 + SCENE.grid_spacing / 2, 0.5 + SCENE.grid_spacing / 2, thickness / 2
    return {
        "flat box": lambda: Box((-0.5, y - half), (1.5, y + half), 0.3),
        "narrow box": lambda: Box((x - half, 0.2), (x + half, 0.8), 0.3),
        "sphere": lambda: Sphere((x, y), half, 0.3),
        "turned slab": lambda: Polygon(((0.2, 0.2), (0.2 + 2**0.5 * thickness, 0.2), (0.8, 0.8 - 2**0.5 * thickness), (0.8, 0.8)), 0.3),
        "triangle": lambda: Polygon(((0.2, y - thickness), (0.8, y - thickness), (0.8, y + thickness)), 0.3),
        "thin arm": lambda: Polygon(((0.2, 0.2), (0.8, 0.2), (0.8, 0.2 + thickness), (0.4, 0.2 + thickness), (0.4, 0.8), (0.2, 0.8)), 0.3),
    }[name]()


def with_obstacle(state, obstacle):
    return replace(state, boundary=Boundary.sample((*domain_walls(SCENE.bounds, 0.3), obstacle), SCENE.spacing, 2))


@pytest.mark.parametrize("name", ["flat box", "narrow box", "sphere", "turned slab", "triangle", "thin arm"])
def test_obstacle_thinner_than_a_cell_is_refused(case, name):
    """By shape and by the thickness that would do."""
    solver, state = case
    for cells in (0.02, 0.5, 0.95):
        with pytest.raises(SimulationError, match=rf"{type(thin(name, 0.1)).__name__}.*at least {SCENE.grid_spacing:g} m thick") as caught:
            solver.step(with_obstacle(state, thin(name, cells * SCENE.grid_spacing)))
        assert caught.value.reason == "input"
    solver.step(with_obstacle(state, thin(name, 1.5 * SCENE.grid_spacing)))


def test_obstacle_between_grid_nodes_is_refused(case):
    solver, state = case
    with pytest.raises(SimulationError, match=r"Sphere.*contains no node of the grid") as caught:
        solver.step(with_obstacle(state, thin("sphere", 1.2 * SCENE.grid_spacing)))
    assert caught.value.reason == "input"
    solver.step(with_obstacle(state, thin("flat box", SCENE.grid_spacing)))  # exactly one cell is enough for a box


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
def test_thinnest_allowed_slab_holds_at_10_m_per_s(case, offset):
    solver, state = case
    low = 0.3 + offset * SCENE.grid_spacing
    slab = Box((-0.5, low), (1.5, low + SCENE.grid_spacing), 0.3)
    rng = np.random.default_rng(0)
    pos = rng.uniform((0.02, 0.5), (0.98, 0.7), state.pos.shape)
    state = with_obstacle(replace(state, pos=pos, vel=np.tile([0.0, -10.0], (state.num_nodes, 1))), slab)
    after = run(solver, state, 40)
    assert after.pos[:, 1].min() >= slab.high[1] - 1e-9 and after.pos[:, 1].min() < 0.45


def test_rollout_names_the_frame_of_a_failure(case):
    solver, state = case
    start = replace(isolated(state), vel=np.tile([60.0, 0.0], (state.num_nodes, 1)))  # leaves through the side that has no wall
    trajectory = rollout(solver, start, 20, describe(SCENE, "sand", solver.frame_dt))
    assert trajectory.termination is not None and trajectory.termination.reason == "escape"
    assert trajectory.termination.frame == trajectory.num_frames > 0


@pytest.mark.parametrize(
    "change",
    [
        {"bounds": ((0, 1), (0, 1), (0, 1))},
        {"bounds": ((0, 1), (0, 1.01))},
        {"bounds": ((0, 1), (1, 0))},
        {"grid_spacing": -1.0},
        {"frame_dt": 0.0},
        {"poisson_ratio": 0.5},
        {"materials": ("fluid",)},
        {"materials": ()},
        {"cfl": 1.5},
        {"misspelt": 1},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(ValueError):
        MPM(**{"bounds": ((0, 1), (0, 1)), "grid_spacing": 1 / 16, **change})
