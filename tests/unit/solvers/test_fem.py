"""The finite element solver as a ``Simulator``: purity, restart, hostile input, and contact beyond the physics tests."""

import itertools
import math
from dataclasses import fields, replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, DistanceGrid, Polygon, Sphere, domain_walls
from gpe_pl.rollout.loop import SimulationError, Simulator
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers import fem as fem_package
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.fem.contact import collect, push_out_nodes, resist_nodes
from gpe_pl.solvers.fem.elements import SMALLEST_RATIO, build_mesh, cauchy_stress, elastic_energy
from gpe_pl.solvers.materials import lame_parameters
from gpe_pl.solvers.solid_scenes import SolidScene
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

SQUARE = ((0.0, 1.0), (0.0, 1.0))
SCENES = {
    "triangle": SolidScene(bounds=SQUARE, cell="triangle", num_cells=120, max_speed=4.0),
    "quad": SolidScene(bounds=SQUARE, cell="quad", num_cells=120, max_speed=4.0),
    "tetrahedron": SolidScene(bounds=(*SQUARE, (0.0, 1.0)), cell="tetrahedron", num_cells=200, gravity=(0.0, 0.0, -9.81), max_speed=4.0),
}
PER_NODE = ("pos", "vel", "node_type", "mass", "material_params", "rest_pos")


@pytest.fixture(params=SCENES, scope="module")
def case(request):
    scene = SCENES[request.param]
    return FEM(bounds=scene.bounds), scene.sample({"solid": 1e6}, 3)


def run(fem, state, num_steps):
    for _ in range(num_steps):
        state = fem.step(state)
    return state


def isolated(state):
    return replace(state, boundary=Boundary.empty(state.dim), gravity=np.zeros(state.dim), vel=np.zeros_like(state.vel))


def assert_same_bytes(a, b):
    for name in ("pos", "vel"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    for name in ("node", "cell"):
        assert getattr(a.stress, name).tobytes() == getattr(b.stress, name).tobytes(), name


def test_is_a_simulator(case):
    fem, _ = case
    assert fem.solver_dt == fem.frame_dt
    assert isinstance(fem, Simulator)


def test_same_input_gives_same_bytes(case):
    fem, state = case
    assert_same_bytes(run(fem, state, 30), run(fem, state, 30))


def test_restart_equals_run_through(case):
    """The state consists of positions and velocities only; a prepared mesh is not part of it."""
    fem, state = case
    middle = run(fem, state, 20)
    assert middle.internal is None
    fresh = FEM(**{f.name: getattr(fem, f.name) for f in fields(fem)})
    fem_package.elements._build_mesh.cache_clear()
    assert_same_bytes(run(fresh, replace(middle, stress=None), 10), run(fem, state, 30))


def test_substeps_are_counted(case):
    """Substeps at rest are as long as ``substep`` allows. With less stiffness they are fewer and longer."""
    fem, state = case
    still = isolated(state)
    assert fem.step(still).num_substeps == math.ceil(fem.frame_dt / fem.substep(still))
    soft = replace(still, material_params=np.full_like(still.material_params, 1e5))
    assert fem.substep(soft) == pytest.approx(math.sqrt(10) * fem.substep(still), rel=1e-9)


def test_input_is_not_modified(case):
    fem, state = case
    before = run(fem, state, 10)
    names = (*PER_NODE, "gravity", "cells")
    copies = {name: getattr(before, name).copy() for name in names}
    after = fem.step(before)
    for name in names:
        assert getattr(before, name).tobytes() == copies[name].tobytes(), name
    assert not np.shares_memory(after.pos, before.pos) and not np.array_equal(after.pos, before.pos)
    assert after.time == pytest.approx(before.time + fem.frame_dt)
    assert after.pos.flags.c_contiguous and after.vel.flags.c_contiguous


def test_order_of_nodes_and_cells_does_not_matter(case):
    fem, state = case
    rng = np.random.default_rng(0)
    nodes, cells = rng.permutation(state.num_nodes), rng.permutation(len(state.cells))
    shuffled = replace(state, cells=state.cells[cells]).take(nodes)
    a, b = run(fem, state, 10), run(fem, shuffled, 10)
    np.testing.assert_allclose(b.pos, a.pos[nodes], atol=1e-9)
    np.testing.assert_allclose(b.stress.cell, a.stress.cell[cells], atol=1e-3)
    np.testing.assert_allclose(b.stress.node, a.stress.node[nodes], atol=1e-3)


def test_translation(case):
    fem, state = case
    start = replace(isolated(state), vel=np.sin(9 * state.pos[:, ::-1]))
    shift = 0.01 * np.arange(1, state.dim + 1)
    moved = replace(start, pos=start.pos + shift, rest_pos=start.rest_pos + 1.0)
    np.testing.assert_allclose(run(fem, moved, 5).pos, run(fem, start, 5).pos + shift, atol=1e-10)


def test_forces_are_the_slope_of_the_energy(case):
    """This also holds for crushed and inverted cells."""
    fem, state = case
    mesh = build_mesh(state.rest_pos, state.cells, state.mass)
    lam, mu = (np.full(len(state.cells), x) for x in lame_parameters(1e6, fem.poisson_ratio))
    rng = np.random.default_rng(0)
    h = 1e-10
    undamped = replace(fem, damping=0.0, frame_dt=h)
    for noise in (0.05, 0.5):
        pos = state.pos + noise * 0.02 * rng.normal(size=state.pos.shape)
        force = undamped.step(replace(isolated(state), pos=pos)).vel * state.mass[:, None] / h
        direction = rng.normal(size=pos.shape)
        step = 1e-7
        slope = (elastic_energy(mesh, pos + step * direction, lam, mu) - elastic_energy(mesh, pos - step * direction, lam, mu)) / (2 * step)
        assert -np.sum(force * direction) == pytest.approx(slope, rel=1e-4)


def test_inverted_body_recovers(case):
    """Every cell turned inside out: a finite state, and never more energy."""
    fem, state = case
    start = isolated(state)
    flip = np.eye(state.dim)
    flip[0, 0] = -0.5
    middle = start.pos.mean(axis=0)
    start = replace(start, pos=middle + (start.pos - middle) @ flip)
    energy = fem.energy(start)
    after = run(replace(fem, bounds=((-9.0, 9.0),) * state.dim, damping=1.0), start, 40)
    assert np.all(np.isfinite(after.pos)) and np.all(np.isfinite(after.stress.cell))
    assert fem.energy(after) < energy


def test_stress_of_a_crushed_cell_is_finite(case):
    _, state = case
    mesh = build_mesh(state.rest_pos, state.cells, state.mass)
    lam, mu = (np.full(len(state.cells), x) for x in lame_parameters(1e6, 0.35))
    for factor in (SMALLEST_RATIO, 0.01, 0.0, -1.0):
        shape = np.eye(state.dim)
        shape[0, 0] = factor
        stress = cauchy_stress(mesh, state.pos @ shape, lam, mu)
        assert np.all(np.isfinite(stress.cell)) and np.all(np.isfinite(stress.node))


def test_rigid_rotation_has_no_stress(case):
    fem, state = case
    turn = np.eye(state.dim)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    after = replace(fem, frame_dt=1e-9, bounds=((-2.0, 2.0),) * state.dim).step(replace(isolated(state), pos=state.pos @ turn.T))
    assert np.abs(after.stress.cell).max() < 1e-6
    assert np.abs(after.vel).max() < 1e-9


def test_stiffness_may_vary_from_node_to_node(case):
    """The stiffer half carries more stress under the same strain."""
    fem, state = case
    left = state.pos[:, 0] < np.median(state.pos[:, 0])
    graded = replace(isolated(state), material_params=np.where(left, 1e6, 4e6)[:, None], pos=1.01 * state.pos)
    after = replace(fem, frame_dt=1e-9, bounds=((-2.0, 2.0),) * state.dim).step(graded)
    assert after.stress is not None
    cell = after.stress.cell[:, 0]
    corners = left[np.asarray(state.cells)]
    uniform = corners.all(axis=1), (~corners).all(axis=1)
    assert cell[uniform[1]].mean() == pytest.approx(4 * cell[uniform[0]].mean(), rel=1e-9)


def test_no_kernel_is_compiled_twice(case):
    """The kernels that ``compile_kernels`` compiles serve every dimension and kind of cell."""
    fem, state = case
    fem.compile_kernels()
    fem.step(state)
    assert len(fem_package._advance_frame.signatures) == 1


def test_empty_state():
    scene = SCENES["triangle"]
    state = scene.sample({"solid": 1e6}, 0)
    empty = state.take(np.arange(0))
    after = run(FEM(bounds=scene.bounds), empty, 2)
    assert after.num_nodes == 0 and after.stress.cell.shape == (0, 4)


# --- contact --------------------------------------------------------------------------------------------------------------------------------


def falling_square(shapes, *, velocity=(0.0, -1.0), damping=0.2, low=(0.4, 0.5)):
    """Return a square of 0.2 m with two by two quads, which has few nodes on its sides."""
    axis = np.linspace(0.0, 0.2, 3)
    pos = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2) + low
    cells = np.array([[k, k + 3, k + 4, k + 1] for k in (0, 1, 3, 4)])
    state = SCENES["quad"].sample({"solid": 1e6}, 0)
    mass = np.bincount(cells.ravel(), np.full(cells.size, 1000.0 * 0.04 / 16))
    return FEM(bounds=SQUARE, damping=damping), replace(
        state, pos=pos, rest_pos=pos.copy(), cells=cells, mass=mass, vel=np.tile(velocity, (9, 1)), node_type=np.full(9, node_code("solid"), np.uint8),
        material_params=np.full((9, 1), 1e6), boundary=Boundary.sample(tuple(shapes), 0.05, 2), stress=None,
    )  # fmt: skip


@pytest.mark.parametrize("shape", ["spike", "box"])
def test_corner_between_nodes_holds_the_edge(shape):
    """An obstacle narrower than the mesh supports the middle of an edge. It does not pass between the nodes or stick out on the inside."""
    obstacle = {
        "spike": Polygon(((0.43, 0.2), (0.47, 0.2), (0.45, 0.4)), STICKY),
        "box": Box((0.44, 0.1), (0.46, 0.4), STICKY),
    }[shape]
    fem, state = falling_square((*domain_walls(SQUARE, 0.5), obstacle))
    tip = np.array([[0.45, 0.4]]) if shape == "spike" else np.array([[0.44, 0.4], [0.46, 0.4]])
    touched = False
    for _ in range(40):
        state = fem.step(state)
        left, right = state.pos[0], state.pos[3]
        edge = right - left
        for x, y in tip:
            t = ((x, y) - left) @ edge / (edge @ edge)
            if 0 < t < 1:
                above = (edge[0] * (y - left[1]) - edge[1] * (x - left[0])) / np.linalg.norm(edge)
                assert above < 1e-4
                touched |= above > -1e-6
    assert touched


def test_sticky_floor_stops_sliding_at_once_and_lets_go():
    fem, state = falling_square(domain_walls(SQUARE, STICKY), velocity=(2.0, -3.0), low=(0.3, 0.002), damping=0.0)
    state = replace(state, gravity=np.zeros(2))
    after = fem.step(state)
    bottom = after.pos[:, 1] < 1e-9
    assert bottom.any() and np.abs(after.vel[bottom]).max() < 1e-12
    assert run(fem, after, 20).pos[:, 1].min() > 1e-3  # no glue: it bounces off


def test_frictionless_floor_keeps_the_speed_along_it():
    fem, state = falling_square(domain_walls(SQUARE, 0.0), velocity=(0.5, -1.0), low=(0.1, 0.01))
    after = run(fem, state, 40)
    assert state.mass @ after.vel[:, 0] / state.mass.sum() == pytest.approx(0.5, abs=1e-9)


def test_node_that_starts_inside_comes_out():
    ball = Sphere((0.4, 0.5), 0.03, 0.3)
    fem, state = falling_square((ball,), velocity=(0.0, 0.0))
    state = replace(state, gravity=np.zeros(2))
    after = fem.step(state)
    assert ball.signed_distance(after.pos).min() >= -1e-12
    assert np.abs(after.vel).max() < 50


def test_a_thin_plate_holds_in_a_large_box_as_a_grid_of_distances_too():
    plate, axes = Box((0.25, 0.35), (0.75, 0.4), 0.4), [0.2 + 0.02 * np.arange(31), 0.3 + 0.02 * np.arange(8)]
    values = plate.signed_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    ends = []
    for shape in (plate, DistanceGrid.from_values((0.2, 0.3), 0.02, values, 0.4)):
        fem, state = falling_square((shape,))
        state = run(replace(fem, bounds=((0.0, 8.0), (0.0, 1.0))), state, 60)
        assert plate.signed_distance(state.pos).min() > -1e-4
        ends.append(state.pos)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-3)


# --- what is refused ------------------------------------------------------------------------------------------------------------------------


STEP = ((0.55, 0.1), (0.8, 0.1), (0.8, 0.3), (0.55, 0.3))
NOTCH = ((0.45, 0.1), (0.8, 0.1), (0.8, 0.5), (0.6, 0.5), (0.6, 0.3), (0.45, 0.3))


def image(state, axes, signs, shapes):
    """Return the state with its axes in another order and some of them reversed, in the unit box and with other shapes."""
    axes, signs = np.array(axes), np.array(signs)
    turns_over = np.linalg.det(np.eye(state.dim)[axes] * signs) < 0
    pos, rest_pos = ((x[:, axes] - 0.5) * signs + 0.5 for x in (state.pos, state.rest_pos))
    # quads then run the other way round, and tetrahedra swap two corners
    cells = state.cells if not turns_over else state.cells[:, ::-1] if state.dim == 2 else state.cells[:, [1, 0, 2, 3]]
    boundary = Boundary.sample(tuple(shapes), 0.05, state.dim)
    return replace(
        state,
        pos=pos,
        rest_pos=rest_pos,
        cells=cells,
        vel=state.vel[:, axes] * signs,
        gravity=state.gravity[axes] * signs,
        boundary=boundary,
    )


@pytest.mark.parametrize(
    ("outline", "velocity", "low"), [(STEP, (1.3, -1.1), (0.33, 0.44)), (NOTCH, (0.9, -2.6), (0.38, 0.47))], ids=["corner", "notch"]
)
def test_the_first_vertex_and_the_axes_do_not_matter(outline, velocity, low):
    """A node meets a vertex to the last bit. Before, the edge that came first in the list acted, and bodies ended up to 0.4 m apart."""
    fem, state = falling_square((Polygon(outline, 0.3),), velocity=velocity, low=low)
    expected = run(fem, state, 40).pos
    for axes, signs in itertools.product([(0, 1), (1, 0)], [(1, 1), (-1, 1)]):
        vertices = (np.array(outline)[:, axes] - 0.5) * signs + 0.5
        vertices = vertices if (axes == (0, 1)) == (signs == (1, 1)) else vertices[::-1]
        for k in range(len(outline)):
            after = run(fem, image(state, axes, signs, [Polygon(tuple(map(tuple, np.roll(vertices, k, axis=0).tolist())), 0.3)]), 40)
            back = np.empty_like(after.pos)
            back[:, axes] = (after.pos - 0.5) * signs + 0.5
            np.testing.assert_allclose(back, expected, atol=1e-9)
    if outline is STEP:
        box = replace(state, boundary=Boundary.sample((Box(STEP[0], STEP[2], 0.3),), 0.05, 2))
        np.testing.assert_allclose(run(fem, box, 40).pos, expected, atol=1e-9)


def test_axes_do_not_matter_at_the_edge_of_a_box():
    """A tetrahedron meets the edge of a box head-on with one corner. Before, it then slid along the face of the first axis."""
    pos = np.array([[0.4375, 0.4, 0.4375], [0.35, 0.6, 0.55], [0.3, 0.45, 0.5], [0.4, 0.5, 0.7]])
    low, high = np.array([0.5, 0.25, 0.25]), np.array([0.75, 0.75, 0.375])
    state = State(
        pos, np.tile((1.0, 0.1, -1.0), (4, 1)), np.full(4, node_code("solid"), np.uint8), np.full(4, 1.0), np.full((4, 1), 1e5), Boundary.empty(3),
        np.zeros(3), rest_pos=pos, cells=np.arange(4)[None],
    )  # fmt: skip
    fem, ends = FEM(bounds=(*SQUARE, (0.0, 1.0))), []
    for axes in itertools.permutations(range(3)):
        box = Box(tuple(low[list(axes)].tolist()), tuple(high[list(axes)].tolist()), 0.0)
        start = image(state, axes, (1, 1, 1), [box])
        ends.append(run(fem, start, 30).pos[:, np.argsort(axes)])
    np.testing.assert_allclose(ends, [ends[0]] * 6, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_nodes_on_an_edge_slide_along_either_face(dim):
    """Rounding in the position of the node changes nothing. A node that moves towards the edge along the bisector stops."""
    box = Box((0.5,) * dim, (0.8,) * dim, 0.0)
    obstacles = collect((box,), (*SQUARE, (0.0, 1.0))[:dim])
    for x, y in itertools.product([0.5, 0.5 + 1e-16, 0.5 - 6e-17], repeat=2):
        pos = np.array([[x, y, 0.65 if dim == 3 else 0.0]])
        for velocity, expected in [
            ((0.7, -0.2), (0.7, -0.2)),
            ((0.2, 0.7), (0.0, 0.7)),
            ((0.7, 0.2), (0.7, 0.0)),
            ((0.5, 0.5), (0.0, 0.0)),
        ]:
            vel = np.array([[*velocity, 0.0]])
            resist_nodes(pos, vel, np.concatenate([pos[0], pos[0]]), 0.05, 1e-4, obstacles)
            np.testing.assert_allclose(vel[0], (*expected, 0.0), atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_nodes_in_a_box_come_out_where_their_velocity_leads(dim):
    """The two nearest faces are equally far from the node."""
    obstacles = collect((Box((0.5,) * dim, (0.8,) * dim, 0.0),), (*SQUARE, (0.0, 1.0))[:dim])
    for velocity, expected in [((-1.0, 0.3), (0.5, 0.52)), ((0.2, -0.1), (0.52, 0.5))]:
        pos = np.array([[0.52, 0.52, 0.65 if dim == 3 else 0.0]])
        push_out_nodes(pos, np.array([[*velocity, 0.0]]), np.concatenate([pos[0], pos[0]]), 0.05, obstacles)
        np.testing.assert_allclose(pos[0, :2], expected, atol=1e-12)


def test_both_faces_of_a_notch_hold():
    obstacles = collect((Polygon(NOTCH, 0.0),), SQUARE)
    pos = np.array([[0.6, 0.3, 0.0]])
    for velocity, expected in [
        ((1.0, -1.0), (0.0, 0.0)),
        ((-1.0, -1.0), (-1.0, 0.0)),
        ((1.0, 1.0), (0.0, 1.0)),
        ((-1.0, 1.0), (-1.0, 1.0)),
    ]:
        vel = np.array([[*velocity, 0.0]])
        resist_nodes(pos, vel, np.concatenate([pos[0], pos[0]]), 0.05, 1e-4, obstacles)
        np.testing.assert_allclose(vel[0], (*expected, 0.0), atol=1e-9)


def poke(state, name, node, value):
    array = np.array(getattr(state, name), dtype=np.float64)
    array[node] = value
    return replace(state, **{name: array})


def with_cells(state, cell, value):
    cells = state.cells.copy()
    cells[cell] = value
    return replace(state, cells=cells)


HOSTILE = {
    "nan position": ("nan", 5, lambda s: poke(s, "pos", 5, math.nan)),
    "infinite position": ("nan", 6, lambda s: poke(s, "pos", 6, math.inf)),
    "nan velocity": ("nan", 7, lambda s: poke(s, "vel", 7, math.nan)),
    "outside": ("escape", 9, lambda s: poke(s, "pos", 9, 1.5)),
    "far outside": ("escape", 10, lambda s: poke(s, "pos", 10, -1e300)),
    "absurd velocity": ("explosion", 11, lambda s: poke(s, "vel", 11, 1e9)),
    "overflowing velocity": ("nan", 12, lambda s: poke(s, "vel", 12, 1e200)),
    "absurd gravity": ("explosion", None, lambda s: replace(s, gravity=s.gravity * 1e12)),
    "nan gravity": ("nan", -1, lambda s: replace(s, gravity=s.gravity * math.nan)),
    "no mass": ("input", 13, lambda s: poke(s, "mass", 13, 0.0)),
    "tiny mass": ("explosion", None, lambda s: poke(s, "mass", 13, 1e-30)),
    "stiffness out of range": ("input", 14, lambda s: poke(s, "material_params", 14, 1.0)),
    "stiffness nan": ("input", 15, lambda s: poke(s, "material_params", 15, math.nan)),
    "other material": (
        "input",
        16,
        lambda s: replace(s, node_type=np.where(np.arange(s.num_nodes) == 16, 0, s.node_type).astype(np.uint8)),
    ),
    "a surface in space": ("input", -1, lambda s: replace(s, cell_dim=s.dim - 1)),
    "no mesh": ("input", -1, lambda s: replace(s, cells=None)),
    "no rest": ("input", -1, lambda s: replace(s, rest_pos=None)),
    "nan rest": ("nan", 3, lambda s: poke(s, "rest_pos", 3, math.nan)),
    "cell of unknown node": ("input", -1, lambda s: with_cells(s, 2, s.num_nodes)),
    "negative node": ("input", -1, lambda s: with_cells(s, 2, -1)),
    "cell with a node twice": ("input", -1, lambda s: with_cells(s, 2, s.cells[2, 0])),
    "inverted at rest": ("input", None, lambda s: with_cells(s, 2, s.cells[2][::-1] if s.dim == 2 else s.cells[2][[1, 0, 2, 3]])),
    "flat at rest": ("input", None, lambda s: replace(s, rest_pos=s.rest_pos * ([1.0] * (s.dim - 1) + [0.0]))),
    "cells of two corners": ("input", -1, lambda s: replace(s, cells=s.cells[:, :2])),
    "cells of floats": ("input", -1, lambda s: replace(s, cells=s.cells.astype(float))),
    "node of no cell": ("input", None, lambda s: replace(s, cells=s.cells[len(s.cells) // 2 :])),
    "wrong dimension": ("input", -1, lambda s: replace(s, pos=np.ones((s.num_nodes, 4)))),
    "missing velocity": ("input", -1, lambda s: replace(s, vel=s.vel[:-1])),
    "moving boundary": ("input", -1, lambda s: replace(s, boundary=replace(s.boundary, vel=s.boundary.vel + 1))),
    "bouncing boundary": ("input", -1, lambda s: replace(s, boundary=replace(s.boundary, restitution=s.boundary.restitution + 0.5))),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_input_gives_a_typed_error(case, name):
    fem, state = case
    reason, node, change = HOSTILE[name]
    with pytest.raises(SimulationError) as caught:
        fem.step(change(state))
    assert caught.value.reason == reason
    assert node is None or caught.value.node == node


@pytest.mark.parametrize("seed", range(4))
def test_scrambled_body_stays_in_the_domain(case, seed):
    """Nodes anywhere, cells inverted, at up to 10 m/s: a finite state or a typed error."""
    fem, state = case
    rng = np.random.default_rng(seed)
    start = replace(state, pos=rng.uniform(0, 1, state.pos.shape), vel=rng.uniform(-10, 10, state.vel.shape))
    try:
        after = run(replace(fem, max_substeps=300), start, 2)
    except SimulationError as error:
        assert error.reason in ("nan", "escape", "explosion")
    else:
        assert np.all((after.pos >= -1e-12) & (after.pos <= 1 + 1e-12)) and np.all(np.isfinite(after.vel))


def test_leaving_through_an_open_side(case):
    fem, state = case
    start = replace(isolated(state), vel=np.full_like(state.vel, 20.0))
    with pytest.raises(SimulationError, match="outside the domain") as caught:
        run(fem, start, 60)
    assert caught.value.reason == "escape" and 0 <= caught.value.node < state.num_nodes


@pytest.mark.parametrize(
    "change",
    [
        {"bounds": ((0.0, 1.0),)},
        {"bounds": ((1.0, 0.0), (0.0, 1.0))},
        {"bounds": ((0.0, math.inf), (0.0, 1.0))},
        {"frame_dt": 0.0},
        {"materials": ("sand",)},
        {"poisson_ratio": 0.5},
        {"damping": -0.1},
        {"cfl": 1.0},
        {"max_substeps": 0},
        {"misspelt": 1},
    ],
)
def test_invalid_settings_are_refused(change):
    with pytest.raises(ValueError):
        FEM(**{"bounds": SQUARE, **change})


def test_meshes_of_many_scenes_are_prepared_once():
    """Training with targets of the solver steps scenes in random order."""
    triangle, cells, mass = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1, 2]]), np.ones(3)
    first, again = ([build_mesh(triangle * (1 + k / 50), cells, mass) for k in range(50)] for _ in range(2))
    assert all(mesh is other for mesh, other in zip(first, again, strict=True))


def test_two_bodies_are_told_once_because_they_pass_through_each_other(caplog: pytest.LogCaptureFixture) -> None:
    square, triangles = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]]), np.array([[0, 1, 2], [0, 2, 3]])
    two = np.concatenate([square, square + np.array([0.3, 0.0])])
    for _ in range(2):
        build_mesh(two, np.concatenate([triangles, triangles + 4]), np.ones(8))
    assert caplog.text.count("the mesh has 2 bodies, which the finite element solver lets pass through each other") == 1
    caplog.clear()
    build_mesh(square, triangles, np.ones(4))
    assert not caplog.text
