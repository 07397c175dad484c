"""Walls and obstacles of the material point solver."""

import numpy as np
import pytest

from gpe_pl.geometry import Box, Polygon, Shape, Sphere, domain_walls, outward_normal, signed_distance
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers.mpm import MPM, _push_out
from gpe_pl.trajectory import Boundary, State

BOUNDS = ((0.0, 1.0), (0.0, 1.0))
SHAPES: dict[str, Shape] = {
    "sphere": Sphere((0.5, 0.5), 0.2, 0.3),
    "box": Box((0.3, 0.4), (0.7, 0.6), 0.3),
    "triangle": Polygon(((0.3, 0.3), (0.7, 0.35), (0.5, 0.7)), 0.3),
    "concave": Polygon(((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.5, 0.4), (0.2, 0.8)), 0.3),
}


def block(low, shape, spacing, velocity, boundary, gravity=(0.0, 0.0), angle=30.0):
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).reshape(-1, 2)
    pos = np.asarray(low) + (lattice + 0.5) * spacing
    count = len(pos)
    vel = np.broadcast_to(np.asarray(velocity, float), pos.shape).copy()
    mass, params = np.full(count, 1600 * spacing**2), np.full((count, 1), angle)
    return State(pos, vel, np.full(count, node_code("sand"), np.uint8), mass, params, boundary, np.asarray(gravity, float))


@pytest.mark.parametrize("name", SHAPES)
def test_push_out_agrees_with_geometry(name):
    """A point inside lands on the surface, along the shortest way, and keeps no velocity into the shape; a point outside is untouched."""
    shape = SHAPES[name]
    collider = MPM(bounds=BOUNDS, grid_spacing=1 / 16)._collider(Boundary.sample((shape,), 0.05, 2))
    rng = np.random.default_rng(0)
    inside = 0
    for point in rng.uniform(0, 1, (500, 2)):
        velocity = rng.normal(size=2)
        x, y, u, v = _push_out(*point, *velocity, collider.planes, collider.discs, collider.vertices, collider.first_vertex)
        depth = -float(shape.signed_distance(point))
        if depth <= 0:
            assert (x, y, u, v) == (*point, *velocity)
            continue
        inside += 1
        moved = np.array([x, y])
        assert np.linalg.norm(moved - point) == pytest.approx(depth, abs=1e-12)
        assert abs(float(shape.signed_distance(moved))) < 1e-12
        normal = (moved - point) / depth
        assert u * normal[0] + v * normal[1] >= -1e-12
    assert inside > 20


@pytest.mark.parametrize("name", SHAPES)
def test_nodes_inside_carry_normal_and_friction(name):
    shape, solver = SHAPES[name], MPM(bounds=BOUNDS, grid_spacing=1 / 16)
    collider = solver._collider(Boundary.sample((shape,), 0.05, 2))
    axis = np.arange(collider.distance.shape[0]) / 16 - 3 / 16
    nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    inside = signed_distance((shape,), nodes) <= 1e-12
    assert inside.any()
    np.testing.assert_array_equal(collider.conditions[..., 0, 2] >= 0, inside)
    expected = outward_normal(shape, nodes[inside], 1e-4)
    got = collider.conditions[inside][:, 0]
    regular = got[:, 2] == shape.friction  # all but those on a medial axis
    assert regular.mean() > 0.7
    cosine = np.sum(got[regular, :2] * expected[regular], axis=-1)
    assert np.median(cosine) == pytest.approx(1.0, abs=1e-6)


def test_walls_lie_on_grid_nodes():
    collider = MPM(bounds=BOUNDS, grid_spacing=1 / 16)._collider(Boundary.sample(domain_walls(BOUNDS, 0.3), 0.05, 2))
    in_wall = collider.conditions[..., 0, 2] >= 0
    assert in_wall[3, 10] and not in_wall[4, 10] and in_wall[19, 10] and not in_wall[18, 10]
    assert np.all(collider.conditions[3, 3, :, 2] >= 0)  # both walls act on the corner node


@pytest.mark.parametrize("name", SHAPES)
def test_nothing_passes_an_obstacle(name):
    """A block shot at an obstacle at 5 m/s never enters it."""
    spacing = 1 / 48
    boundary = Boundary.sample((*domain_walls(BOUNDS, 0.2), SHAPES[name]), spacing, 2)
    state = block((0.42, 0.82), (8, 6), spacing, (0.0, -5.0), boundary)
    solver = MPM(bounds=BOUNDS, grid_spacing=2 * spacing)
    for _ in range(40):
        state = solver.step(state)
        assert signed_distance(boundary.shapes, state.pos).min() > -1e-12
    assert np.ptp(state.pos[:, 0]) > 0.22  # it hit and spread


@pytest.mark.parametrize(("friction", "low", "high"), [(0.0, 0.999, 1.0 + 1e-12), (0.3, 0.1, 0.6), (STICKY, -0.05, 0.05)])
def test_friction_of_the_floor(friction, low, high):
    """A block pressed on the floor slides on, brakes by about mu g t, or stops."""
    spacing = 1 / 32
    boundary = Boundary.sample(domain_walls(BOUNDS, friction), spacing, 2)
    state = block((0.2, 0.0), (8, 4), spacing, (1.0, 0.0), boundary, gravity=(0.0, -9.81), angle=45.0)
    solver = MPM(bounds=BOUNDS, grid_spacing=2 * spacing)
    for _ in range(50):
        state = solver.step(state)
    assert low <= state.vel[:, 0].mean() <= high


def test_coulomb_braking_rate():
    """A flat block on a Coulomb floor decelerates by mu g (within 10 %)."""
    spacing, mu = 1 / 64, 0.2
    boundary = Boundary.sample(domain_walls(BOUNDS, mu), spacing, 2)
    state = block((0.1, 0.0), (24, 4), spacing, (1.0, 0.0), boundary, gravity=(0.0, -9.81), angle=45.0)
    solver = MPM(bounds=BOUNDS, grid_spacing=2 * spacing)
    for _ in range(10):
        state = solver.step(state)
    start = state.vel[:, 0].mean()
    for _ in range(40):
        state = solver.step(state)
    assert (start - state.vel[:, 0].mean()) / 0.2 == pytest.approx(mu * 9.81, rel=0.1)


def test_walls_hold_only_inward():
    """A particle on a wall leaves it freely, also from a sticky one once it is more than a kernel away."""
    spacing = 1 / 32
    boundary = Boundary.sample(domain_walls(BOUNDS, 0.5), spacing, 2)
    state = block((0.4, 0.0), (6, 3), spacing, (0.0, 1.0), boundary)
    after = MPM(bounds=BOUNDS, grid_spacing=2 * spacing).step(state)
    np.testing.assert_allclose(after.vel, state.vel, atol=1e-12)
