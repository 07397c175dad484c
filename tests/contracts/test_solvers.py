"""The contract of every ground-truth solver.

A new solver joins with an entry in ``SOLVERS``: a solver and an initial state in the unit box whose bodies are about to hit something.
"""

import math
import re
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import Shape, Sphere, domain_walls
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import SimulationError, Simulator, rollout
from gpe_pl.schema import MATERIALS, NODE_TYPES, MaterialParameter, param_names
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.materials import Elastomer, Snow, check_limits
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.solid_scenes import SolidScene
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, write_shard
from tests.particles import block, run, together
from tests.scenes import metadata

CELL = 1 / 24


def mpm(dim: int, *materials: str) -> tuple[MPM, State]:
    """Return a block of each material side by side, falling on a floor with a ball."""
    bounds = ((0.0, 1.0),) * dim
    shapes: tuple[Shape, ...] = (*domain_walls(bounds, 0.3), Sphere((0.4,) * (dim - 1) + (0.1,), 0.08, 0.5))
    boundary = Boundary.sample(shapes, CELL / 2, dim)
    width, gravity = 0.6 / len(materials), (0.0,) * (dim - 1) + (-9.81,)
    blocks = [
        block(
            (0.1 + 0.8 * k / len(materials), *(0.35,) * (dim - 2), 0.2),
            (width, *((CELL * 3,) if dim == 3 else ()), 0.15),
            CELL / 2,
            material,
            velocity=(*(0.0,) * (dim - 1), -1.0),
            boundary=boundary,
            gravity=gravity,
            seed=k,
        )
        for k, material in enumerate(materials)
    ]
    return MPM(bounds=bounds, grid_spacing=CELL, materials=materials), together(materials, *blocks)


def flip(dim: int) -> tuple[FLIP, State]:
    """Return a block of liquid that falls on a floor with a ball."""
    bounds = ((0.0, 1.0),) * dim
    boundary = Boundary.sample((*domain_walls(bounds, 0.0), Sphere((0.4,) * (dim - 1) + (0.2,), 0.15, 0.0)), CELL, dim)
    gravity = (0.0,) * (dim - 1) + (-9.81,)
    velocity = (0.0,) * (dim - 1) + (-1.0,)
    liquid = block(
        (0.2,) * (dim - 1) + (0.45,), (0.5,) + (0.25,) * (dim - 1), CELL, "fluid", velocity=velocity, boundary=boundary, gravity=gravity
    )
    return FLIP(bounds=bounds, grid_spacing=2 * CELL), liquid


def fem(dim: int) -> tuple[FEM, State]:
    """Return a solid that falls on a floor with a ball."""
    bounds = ((0.0, 1.0),) * dim
    gravity = (0.0,) * (dim - 1) + (-9.81,)
    scene = SolidScene(bounds=bounds, cell="triangle" if dim == 2 else "tetrahedron", num_cells=150, gravity=gravity, num_obstacles=(0, 0))
    state = scene.sample({"solid": 1e6}, 1)
    low = np.array((0.4,) * (dim - 1) + (0.3,)) - state.pos.min(axis=0)
    boundary = Boundary.sample((*domain_walls(bounds, 0.3), Sphere((0.5,) * (dim - 1) + (0.15,), 0.12, 0.5)), CELL, dim)
    velocity = np.array((0.0,) * (dim - 1) + (-1.0,))
    return FEM(bounds=bounds), replace(state, pos=state.pos + low, vel=np.tile(velocity, (state.num_nodes, 1)), boundary=boundary)


SOLVERS: dict[str, Callable[[], tuple[Simulator, State]]] = {
    "mpm-sand": lambda: mpm(2, "sand"),
    "mpm-mixed": lambda: mpm(2, "sand", "snow", "elastomer", "fluid"),
    "mpm-3d": lambda: mpm(3, "sand", "snow", "elastomer", "fluid"),
    "flip": lambda: flip(2),
    "flip-3d": lambda: flip(3),
    "fem": lambda: fem(2),
    "fem-3d": lambda: fem(3),
}


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.slow if "3d" in name else ()) for name in SOLVERS]
)  # they take long to compile
def case(request):
    return SOLVERS[request.param]()


def arrays(state):
    """Return every array of a state, including the solver's internal ones."""
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


def isolated(state, gravity=None):
    """Return the same particles without walls, at rest in mid-air."""
    gravity = np.zeros(state.dim) if gravity is None else np.asarray(gravity)
    return replace(state, boundary=Boundary.empty(state.dim), gravity=gravity, vel=np.zeros_like(state.vel), internal=None)


def test_is_a_simulator(case):
    assert isinstance(case[0], Simulator)


@pytest.mark.slow
def test_same_input_gives_same_bytes(case):
    solver, state = case
    assert_same_bytes(run(solver, state, 40), run(solver, state, 40))


def test_restart_equals_run_through(case):
    solver, state = case
    middle = run(solver, state, 25)
    fresh = type(solver)(**{f.name: getattr(solver, f.name) for f in fields(solver)})
    assert_same_bytes(run(fresh, middle, 15), run(solver, state, 40))


def from_a_file(part, folder):
    write_shard(folder / "part.h5", [part])
    return read_trajectory(folder / "part.h5", "00000", verify=True)


@pytest.mark.parametrize("way", ["frame", "first frame of a part", "first frame of a stored part", "stored frames"])
def test_stored_frame_is_continued_or_refused(case, way, tmp_path):
    """A stored frame has positions and velocities only. Solvers that need more refuse it; others continue as if they had not stopped."""
    solver, state = case
    whole = rollout(solver, state, 30, metadata(solver.materials, state.dim))
    if way == "stored frames":
        write_shard(tmp_path / "whole.h5", [whole.frames(4)])
        middle = read_trajectory(tmp_path / "whole.h5", "00000", frames=slice(16, None)).state(0)
    else:
        part = {"frame": lambda: whole, "first frame of a part": lambda: whole.frames(20)}.get(
            way, lambda: from_a_file(whole.frames(20), tmp_path)
        )()
        middle = part.state(20 if way == "frame" else 0)
    assert middle.internal is None and middle.time == pytest.approx(20 * solver.frame_dt)
    rest = rollout(solver, middle, 10, whole.metadata)
    if solver.name == "mpm":
        assert rest.num_frames == 1 and rest.termination is not None
        assert rest.termination.reason == "input" and "the state at 0.1 s has no internal part" in rest.termination.message
    elif "stored" in way:
        np.testing.assert_allclose(rest.pos, whole.pos[20:], atol=1e-4 * CELL)  # in single precision
    else:
        np.testing.assert_array_equal(rest.pos, whole.pos[20:])
        np.testing.assert_array_equal(rest.vel, whole.vel[20:])


def test_what_another_simulator_moved_is_not_as_deformed_as_before(case):
    """A solver that needs to know how particles are deformed refuses what a baseline made of its state."""
    solver, state = case
    moved = Ballistic(solver.frame_dt).step(run(solver, state, 5))
    if solver.name == "mpm":
        with pytest.raises(SimulationError, match="has no internal part"):
            solver.step(moved)
    else:
        solver.step(moved)


def moving_later(boundary):
    """Return a boundary that is at rest in the first frame and then rises."""
    lift = np.eye(boundary.pos.shape[1])[-1] * np.array([0.0, 0.0, 0.01])[:, None, None]
    return Boundary.moving(boundary.pos + lift, boundary.normal, 5e-3, friction=boundary.friction)


SURROUNDINGS = {
    "does not compute periodic domains; the scene repeats along x": lambda s: replace(
        s, periodicity=Periodicity(((0.0, 1.0),) * s.dim, (True, *(False,) * (s.dim - 1)))
    ),
    "supports only boundaries at rest": lambda s: replace(s, boundary=replace(moving_later(s.boundary), shapes=s.boundary.shapes)),
    "does not compute rigid bodies": lambda s: replace(s, rigid_body=np.arange(s.num_nodes) % 2 - 1),
    "takes walls and obstacles from the shapes of the boundary": lambda s: replace(s, boundary=replace(s.boundary, shapes=())),
}


@pytest.mark.parametrize("message", SURROUNDINGS)
def test_surroundings_that_a_solver_would_leave_out_are_refused(case, message):
    solver, state = case
    with pytest.raises(SimulationError, match=message) as caught:
        solver.step(SURROUNDINGS[message](state))
    assert caught.value.reason == "input"


def test_a_boundary_with_a_motion_that_never_moves_is_at_rest(case):
    solver, state = case
    b = state.boundary
    still = replace(Boundary.moving(np.stack([b.pos] * 3), b.normal, solver.frame_dt, friction=b.friction), shapes=b.shapes)
    assert still.motion is not None
    np.testing.assert_array_equal(solver.step(replace(state, boundary=still)).pos, solver.step(state).pos)


def test_frames_are_those_that_the_metadata_describe(case):
    """A solver with another frame interval, or with materials in another order, would fill a trajectory with what it is not."""
    solver, state = case
    about = metadata(solver.materials, state.dim)
    other_order = solver.materials[::-1] if len(solver.materials) > 1 else ("elastomer",)
    others = {
        "has frame_dt = 0.005 s, the scene 0.01 s": replace(about, frame_dt=0.01),
        "has the materials .*, the scene .*, in this order": metadata(other_order, state.dim),
    }
    for message, other in others.items():
        stop = rollout(solver, state, 2, other).termination
        assert stop is not None and (stop.reason, stop.frame) == ("input", 0) and re.search(message, stop.message), stop
    assert rollout(solver, state, 2, about).termination is None


def test_a_parameter_outside_the_limits_is_refused(case):
    """Imported data may have any parameter; a solver that is given them names node, material and value."""
    solver, state = case
    node, params = state.num_nodes // 2, state.material_params.copy()
    material = NODE_TYPES[int(state.node_type[node])]
    name = MATERIALS[material][0].name
    column = param_names(tuple(NODE_TYPES[code] for code in np.unique(state.node_type))).index(name)
    params[node, column] = 1e12
    message = rf"^node {node}: {name} of {material} is 1e\+12.*, outside .*, the limits of the solvers$"
    with pytest.raises(SimulationError, match=message) as caught:
        solver.step(replace(state, material_params=params))
    assert (caught.value.reason, caught.value.node) == ("input", node)


@pytest.mark.parametrize("end", ["low", "high"])
@pytest.mark.parametrize(("material", "parameter"), [(m, p) for m, own in MATERIALS.items() for p in own])
def test_a_parameter_at_the_limits_is_accepted_again_from_a_file(material: str, parameter: MaterialParameter, end: str) -> None:
    """Water has the smallest viscosity that is allowed; the store rounds it to single precision, and solvers compute in double."""
    value = getattr(parameter.limits, end)
    stored = np.array([value], np.float32).astype(np.float64)
    check_limits(material, parameter, stored, np.arange(1))
    for beyond in (value * (1 - 1e-6), value * (1 + 1e-6)):
        if not parameter.limits.low <= beyond <= parameter.limits.high:
            with pytest.raises(SimulationError, match="the limits of the solvers"):
                check_limits(material, parameter, np.array([beyond]), np.arange(1))


FURTHER = {
    "sand": {"cohesion": 0.0},
    "snow": {"critical_compression": Snow().critical_compression, "critical_stretch": Snow().critical_stretch},
    "elastomer": {"poisson_ratio": Elastomer().poisson_ratio},
    "solid": {"poisson_ratio": FEM(bounds=((0.0, 1.0),) * 2).poisson_ratio},
}


def with_further(state: State, further: dict[str, float]) -> State:
    """Return the state with columns of further parameters of its material."""
    material = NODE_TYPES[int(state.node_type[0])]
    columns = [state.material_params[:, 0], *(np.full(state.num_nodes, value) for value in further.values())]
    return replace(state, material_params=np.stack(columns, axis=1), param_names=param_names((material,), further))


@pytest.mark.parametrize("material", FURTHER)
def test_stored_parameters_replace_the_settings(material: str) -> None:
    """Stored values of the settings give the same motion; other values give another one."""
    solver: Simulator
    if material == "solid":
        scene = SolidScene(bounds=((0.0, 1.0),) * 2, cell="triangle", num_cells=60, max_speed=4.0)
        solver, state = FEM(bounds=scene.bounds), scene.sample({"solid": 1e6}, 3)
        assert state.cells is not None
        state = replace(state, pos=0.5 + 0.95 * (state.pos - 0.5))
    else:
        solver, state = mpm(2, material)
    num_steps = 1 if material == "solid" else 8
    expected = run(solver, state, num_steps)
    same = run(solver, with_further(state, FURTHER[material]), num_steps)
    rounding = 1e-12 if material == "solid" else 0.0  # a cell takes the mean of its corners
    np.testing.assert_allclose(same.pos, expected.pos, rtol=0, atol=rounding)
    np.testing.assert_allclose(same.vel, expected.vel, rtol=0, atol=rounding * 1e3)
    other = {name: {"cohesion": 2e3}.get(name, 0.8 * value) for name, value in FURTHER[material].items()}
    assert np.abs(run(solver, with_further(state, other), num_steps).pos - expected.pos).max() > 1e-9
    wrong = with_further(state, dict.fromkeys(FURTHER[material], -1.0))
    with pytest.raises(SimulationError, match=f"node 0: {next(iter(FURTHER[material]))} of {material} is -1.*, outside"):
        solver.step(wrong)


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
    start = isolated(state, (0.3, *(0.0,) * (state.dim - 2), -9.81))
    after, t = run(solver, start, 10), 10 * solver.frame_dt
    np.testing.assert_allclose(after.vel, np.broadcast_to(start.gravity * t, after.vel.shape), atol=9.81 * solver.solver_dt)
    np.testing.assert_allclose(after.pos, start.pos + start.gravity * t**2 / 2, atol=9.81 * t * solver.solver_dt)


def test_free_flight_has_constant_acceleration(case):
    """Second differences of positions, from which models learn, equal g to rounding, though substeps change as the body gets faster."""
    solver, state = case
    start = isolated(state, (0.0,) * (state.dim - 1) + (-98.1,))
    start.vel[:, -1] = 5.0
    positions, substeps = [start.pos], set()
    for _ in range(12):
        start = solver.step(start)
        positions.append(start.pos)
        substeps.add(start.num_substeps)
    if solver.name == "mpm":
        assert len(substeps) > 1  # otherwise this test could not fail
    mean = np.mean(positions, axis=1)
    expected = np.broadcast_to(start.gravity, mean[2:].shape)
    np.testing.assert_allclose(np.diff(mean, 2, axis=0) / solver.frame_dt**2, expected, atol=1e-8)


def test_translated_scene_gives_translated_result(case):
    """Moving everything by whole cells changes nothing else."""
    solver, state = case
    start = isolated(state)
    start = replace(start, vel=np.sin(7 * start.pos[:, ::-1]))
    shift = getattr(solver, "grid_spacing", CELL) * np.array([1.0, *(0.0,) * (state.dim - 2), 2.0])
    a, b = run(solver, start, 10), run(solver, replace(start, pos=start.pos + shift), 10)
    np.testing.assert_allclose(b.pos, a.pos + shift, atol=1e-9)


def test_order_of_particles_does_not_matter(case):
    solver, state = case
    order = np.random.default_rng(0).permutation(state.num_nodes)
    shuffled = state.take(order)
    np.testing.assert_allclose(run(solver, shuffled, 10).pos, run(solver, state, 10).pos[order], atol=1e-9)


def emptied(state):
    return state.take(np.arange(0))


def test_empty_state(case):
    solver, state = case
    assert run(solver, emptied(state), 2).num_nodes == 0


def poke(state, name, node, value):
    array = np.array(getattr(state, name), dtype=np.float64)
    array[node] = value
    return replace(state, **{name: array})


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
    "parameter out of range": ("input", 14, lambda s: poke(s, "material_params", 14, -1.0)),
    "parameter nan": ("input", 15, lambda s: poke(s, "material_params", 15, math.nan)),
    "unknown material": ("input", 16, lambda s: replace(s, node_type=poke(s, "node_type", 16, 99).node_type.astype(np.uint8))),
    "wrong dimension": ("input", -1, lambda s: replace(s, pos=np.ones((s.num_nodes, 5 - s.dim)))),
    "missing velocity": ("input", -1, lambda s: replace(s, vel=s.vel[:-1])),
    "nan gravity": ("nan", -1, lambda s: replace(s, gravity=np.full(s.dim, math.nan))),
    "foreign internal state": ("input", -1, lambda s: replace(s, internal={"F": 1})),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_input_gives_a_typed_error(case, name):
    """Never a crash, a hang or a silent NaN: an error with a reason and the particle."""
    solver, state = case
    reason, node, change = HOSTILE[name]
    with pytest.raises(SimulationError) as caught:
        solver.step(change(state))
    assert (caught.value.reason, caught.value.node) == (reason, node)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_random_particles_stay_in_the_domain(case, seed):
    """Particles thrown anywhere, overlapping and inside obstacles, at up to 10 m/s."""
    solver, state = case
    rng = np.random.default_rng(seed)
    state = replace(state, pos=rng.uniform(0, 1, state.pos.shape), vel=rng.uniform(-10, 10, state.vel.shape))
    try:
        after = run(solver, state, 20)
    except SimulationError as error:  # a mesh with its nodes thrown anywhere explodes
        assert state.cells is not None and error.reason == "explosion"
        return
    assert np.all((after.pos >= 0) & (after.pos <= 1)) and np.all(np.isfinite(after.vel))


@pytest.mark.parametrize("magnitude", [1e9, 1e30, 1e200])
def test_absurd_gravity_is_an_explosion(case, magnitude):
    """Whether or not there are particles to name."""
    solver, state = case
    gravity = np.array([0.0] * (state.dim - 1) + [-magnitude])
    with pytest.raises(SimulationError, match="gravity|outside") as caught:
        solver.step(isolated(state, gravity))
    assert caught.value.reason in ("explosion", "escape") and 0 <= caught.value.node < state.num_nodes
    if magnitude > 1e9:
        with pytest.raises(SimulationError) as caught:
            solver.step(emptied(isolated(state, gravity)))
        assert (caught.value.reason, caught.value.node) == ("explosion", -1)


def test_rollout_names_the_frame_of_a_failure(case):
    solver, state = case
    start = isolated(state)
    start.vel[:, 0] = 60.0  # leaves through the side that has no wall
    trajectory = rollout(solver, start, 20, metadata(solver.materials, state.dim))
    assert trajectory.termination is not None and trajectory.termination.reason == "escape"
    assert trajectory.termination.frame == trajectory.num_frames > 0
