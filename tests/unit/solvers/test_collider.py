"""Walls and obstacles of the material point solver."""

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, domain_walls, outward_normal, signed_distance
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import STICKY
from gpe_pl.solvers.mpm import MPM
from gpe_pl.solvers.mpm.collider import collider, push_out
from gpe_pl.trajectory.boundary import Boundary
from tests.particles import block, run

BOUNDS = ((0.0, 1.0), (0.0, 1.0))


def grid_of(shape: Shape, dim: int) -> DistanceGrid:
    """Return the shape as a sampled grid."""
    axis = np.linspace(-0.25, 1.25, 49)
    nodes = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1)
    return DistanceGrid.from_values((-0.25,) * dim, axis[1] - axis[0], shape.signed_distance(nodes), shape.friction)


SHAPES: dict[str, Shape] = {
    "sphere": Sphere((0.5, 0.5), 0.2, 0.3),
    "box": Box((0.3, 0.4), (0.7, 0.6), 0.3),
    "triangle": Polygon(((0.3, 0.3), (0.7, 0.35), (0.5, 0.7)), 0.3),
    "concave": Polygon(((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.5, 0.4), (0.2, 0.8)), 0.3),
    "bowl": Bowl((0.5, 0.5), 0.4, 0.3),
    "grid": grid_of(Sphere((0.5, 0.5), 0.2, 0.3), 2),
    "ball": Sphere((0.5, 0.5, 0.5), 0.2, 0.3),
    "brick": Box((0.3, 0.4, 0.35), (0.7, 0.6, 0.7), 0.3),
    "round bowl": Bowl((0.5, 0.5, 0.5), 0.4, 0.3),
    "solid grid": grid_of(Sphere((0.5, 0.5, 0.5), 0.2, 0.3), 3),
}
SAMPLED = ("bowl", "grid", "round bowl", "solid grid")
CELLS = 16


def axes(name):
    return 3 if name in ("ball", "brick", "round bowl", "solid grid") else 2


def prepared(shapes, dim):
    """Return the collider on a grid that reaches 3 cells beyond the unit box, and the arguments that place the grid."""
    origin, counts = np.full(dim, -3 / CELLS), (CELLS + 7,) * dim
    return collider(shapes, tuple(origin), 1 / CELLS, counts), counts, origin, float(CELLS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_push_out_agrees_with_geometry(name):
    """A point inside lands on the surface, along the shortest way, and keeps no velocity into the shape; a point outside is untouched."""
    shape, dim = SHAPES[name], axes(name)
    # of a sampled shape, within the error of linear interpolation on a curved surface
    tolerance = 2 / CELLS**2 if name in SAMPLED else 1e-12
    arguments = prepared((shape,), dim)
    rng = np.random.default_rng(0)
    inside = 0
    for point in rng.uniform(0, 1, (500, dim)):
        pos, vel = point[None].copy(), rng.normal(size=(1, dim))
        before = vel.copy()
        push_out(pos, vel, 0, *arguments)
        depth = -float(shape.signed_distance(point))
        if depth <= tolerance:
            if depth <= -tolerance:
                assert np.array_equal(pos[0], point) and np.array_equal(vel, before)
            continue
        if name in SAMPLED and depth > 0.1:  # around the centre, where there is no direction
            continue
        inside += 1
        moved = pos[0]
        assert np.linalg.norm(moved - point) == pytest.approx(depth, abs=tolerance)
        assert abs(float(shape.signed_distance(moved))) < tolerance
        assert vel[0] @ (moved - point) >= -1e-12
    assert inside > 10


@pytest.mark.parametrize("name", SHAPES)
def test_nodes_inside_carry_normal_and_friction(name):
    shape, dim = SHAPES[name], axes(name)
    prepared_shape, counts, origin, _ = prepared((shape,), dim)
    axis = origin[0] + np.arange(counts[0]) / CELLS
    nodes = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    inside = shape.signed_distance(nodes) <= 1e-12
    assert inside.any()
    np.testing.assert_array_equal(prepared_shape.row >= 0, inside)
    expected = outward_normal(shape, nodes[inside], 1e-4)
    got = prepared_shape.conditions[prepared_shape.row[inside], 0]
    regular = got[:, dim] == shape.friction  # all but those on a medial axis
    assert regular.mean() > 0.7
    cosine = np.sum(got[regular, :dim] * expected[regular], axis=-1)
    assert np.median(cosine) == pytest.approx(1.0, abs=1e-6)


def test_walls_lie_on_grid_nodes():
    walls, counts, _, _ = prepared(domain_walls(BOUNDS, 0.3), 2)
    row = walls.row.reshape(counts)
    assert row[3, 10] >= 0 > row[4, 10] and row[19, 10] >= 0 > row[18, 10]
    assert np.all(walls.conditions[row[3, 3], :, 2] >= 0)  # both walls act on the corner node


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_nothing_passes_an_obstacle(name):
    """A block shot at an obstacle at 5 m/s never enters it: not at all, or by no more than its samples allow."""
    dim, spacing = axes(name), 1 / 48
    tolerance = 2 * (2 * spacing) ** 2 / (4 * 0.2) if name in SAMPLED else 1e-12  # twice: a grid was sampled itself
    shapes = (*domain_walls(((0.0, 1.0),) * dim, 0.2), SHAPES[name])
    low, size = (0.42,) * (dim - 1) + (0.72,), (8 * spacing,) * (dim - 1) + (6 * spacing,)
    fall = (0.0,) * (dim - 1) + (-5.0,)
    state = block(low, size, spacing, velocity=fall, boundary=Boundary.sample(shapes, spacing, dim), jitter=0.0)
    solver = MPM(bounds=((0.0, 1.0),) * dim, grid_spacing=2 * spacing)
    for _ in range(40):
        state = solver.step(state)
        assert signed_distance(shapes, state.pos).min() > -tolerance
    assert np.ptp(state.pos[:, 0]) > 0.2  # it hit and spread


@pytest.mark.parametrize(("friction", "low", "high"), [(0.0, 0.999, 1.0 + 1e-12), (0.3, 0.1, 0.6), (STICKY, -0.05, 0.05)])
def test_friction_of_the_floor(friction, low, high):
    """A block pressed on the floor slides on, brakes by about mu g t, or stops."""
    spacing = 1 / 32
    boundary = Boundary.sample(domain_walls(BOUNDS, friction), spacing, 2)
    state = block(
        (0.2, 0.0),
        (8 * spacing, 4 * spacing),
        spacing,
        value=45.0,
        velocity=(1.0, 0.0),
        boundary=boundary,
        gravity=(0.0, -9.81),
        jitter=0.0,
    )
    solver = MPM(bounds=BOUNDS, grid_spacing=2 * spacing)
    state = run(solver, state, 50)
    assert low <= state.vel[:, 0].mean() <= high


def test_coulomb_braking_rate():
    """A flat block on a Coulomb floor decelerates by mu g (within 10 %)."""
    spacing, mu = 1 / 64, 0.2
    boundary = Boundary.sample(domain_walls(BOUNDS, mu), spacing, 2)
    state = block(
        (0.1, 0.0),
        (24 * spacing, 4 * spacing),
        spacing,
        value=45.0,
        velocity=(1.0, 0.0),
        boundary=boundary,
        gravity=(0.0, -9.81),
        jitter=0.0,
    )
    solver = MPM(bounds=BOUNDS, grid_spacing=2 * spacing)
    state = run(solver, state, 10)
    start = state.vel[:, 0].mean()
    state = run(solver, state, 40)
    assert (start - state.vel[:, 0].mean()) / 0.2 == pytest.approx(mu * 9.81, rel=0.1)


def test_walls_hold_only_inward():
    """A particle on a wall leaves it freely, also from a sticky one once it is more than a kernel away."""
    spacing = 1 / 32
    boundary = Boundary.sample(domain_walls(BOUNDS, 0.5), spacing, 2)
    state = block((0.4, 0.0), (6 * spacing, 3 * spacing), spacing, velocity=(0.0, 1.0), boundary=boundary, jitter=0.0)
    after = MPM(bounds=BOUNDS, grid_spacing=2 * spacing).step(state)
    np.testing.assert_allclose(after.vel, state.vel, atol=1e-12)


def test_a_grid_of_distances_thinner_than_a_cell_is_refused():
    axis = -0.25 + 0.025 * np.arange(61)
    nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)

    def plate(thickness):
        solid = Box((0.2, 0.37), (0.8, 0.37 + thickness), 0.3)
        return DistanceGrid.from_values((-0.25, -0.25), 0.025, solid.signed_distance(nodes), 0.3)

    with pytest.raises(SimulationError, match=r"DistanceGrid.* is 0.06.* m thin; .* must be at least 0.1 m thick"):
        collider((plate(0.06),), (0.0, 0.0), 0.1, (11, 11))
    collider((plate(0.1),), (0.0, 0.0), 0.1, (11, 11))


@pytest.mark.parametrize("kind", [Box, Polygon])
@pytest.mark.parametrize("material", ["elastomer", "snow", "sand", "fluid"])
def test_a_block_slides_over_a_plate_of_two_cells(material, kind):
    """Grid nodes in the middle of the plate feel the particles of both sides, and have no normal."""
    top, thickness = 6 / 16, 2 / 16
    low, high = (0.0, top - thickness), (1.0, top)
    plate = Box(low, high, 0.0) if kind is Box else Polygon((low, (1.0, low[1]), high, (0.0, top)), 0.0)
    solver = MPM(BOUNDS, 1 / CELLS, 0.01, materials=(material,))
    state = block((0.2, top), (0.3, 0.2), 1 / 32, material, velocity=(1.0, 0.0), boundary=Boundary.sample((plate,), 1 / 32, 2))
    after = run(solver, state, 15)
    assert np.average(after.vel[:, 0], weights=after.mass) == pytest.approx(1.0, abs=1e-3)


def test_the_middle_of_a_plate_has_no_normal_whatever_the_rounding():
    for height in 0.04 * np.arange(1, 9):
        middle = np.array([[0.5, height]])
        assert (outward_normal(Box((0.0, height - 0.04), (1.0, height + 0.04), 0.0), middle, 1e-3 * 0.04) == 0).all()
