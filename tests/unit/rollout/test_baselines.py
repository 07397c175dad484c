"""The trivial baselines: free fall that sticks, and straight motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, domain_walls, signed_distance
from gpe_pl.rollout.baselines import Ballistic, ConstantVelocity, StopsAtWalls
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from tests import scenes

DT, G = 0.01, -9.81
SCENE = replace(scenes.metadata(), frame_dt=DT)
WALLS: tuple[Shape, ...] = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3)
OBSTACLES: tuple[Shape, ...] = (
    Sphere((0.3, 0.3), 0.15, 0.3),
    Box((0.6, -0.1), (0.8, 0.2), 0.3),
    Polygon(((0.5, 0.6), (0.8, 0.65), (0.6, 0.85)), 0.3),
)


def state(pos: np.ndarray, vel: np.ndarray, shapes: tuple[Shape, ...] = (), spacing: float = 0.1) -> State:
    s = scenes.state(len(pos), walls=False)
    return replace(s, pos=pos, vel=vel, velocity_history=None, boundary=Boundary.sample(shapes, spacing, 2))


def cloud(shapes: tuple[Shape, ...], count: int = 500) -> State:
    rng = np.random.default_rng(0)
    pos = rng.uniform(size=(4 * count, 2))
    pos = pos[signed_distance(shapes, pos) > 0.01][:count]
    return state(pos, rng.normal(scale=2.0, size=pos.shape), shapes)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_constant_velocity(backend: str) -> None:
    start = cloud(WALLS)
    result = rollout(ConstantVelocity(DT), start.to_torch() if backend == "torch" else start, 30, SCENE)
    for k in (1, 30):
        np.testing.assert_allclose(result.pos[k], start.pos + k * DT * start.vel, atol=1e-12)
        np.testing.assert_array_equal(result.vel[k], start.vel)
    assert (result.pos[30] < 0).any()  # walls are ignored


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("at_rest", [False, True])
def test_ballistic_is_free_fall_where_nothing_is_in_the_way(backend: str, at_rest: bool) -> None:
    start = cloud(())
    start = replace(start, vel=np.zeros_like(start.vel)) if at_rest else start
    result = rollout(Ballistic(DT), start.to_torch() if backend == "torch" else start, 40, SCENE)
    for k in (1, 7, 40):
        fall = np.array([0.0, G])
        np.testing.assert_allclose(result.vel[k], start.vel + k * DT * fall, atol=1e-11)
        np.testing.assert_allclose(result.pos[k], start.pos + k * DT * start.vel + DT**2 * fall * k * (k + 1) / 2, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("shapes", [WALLS, WALLS + OBSTACLES], ids=["walls", "obstacles"])
def test_ballistic_never_enters_a_wall_and_sticks_where_it_touches(shapes: tuple[Shape, ...], backend: str) -> None:
    start = cloud(shapes)
    result = rollout(Ballistic(DT), start.to_torch() if backend == "torch" else start, 120, SCENE)
    distance = signed_distance(shapes, result.pos)
    assert distance.min() >= 0
    at_rest = (result.vel == 0).all(axis=-1)
    assert at_rest[-1].all()  # after 1.2 s everything has landed
    assert distance[-1].max() < 1e-6
    assert not at_rest[0].any()
    landed = at_rest.argmax(axis=0)
    for node, frame in enumerate(landed):
        assert (result.pos[frame:, node] == result.pos[frame, node]).all()
        assert (result.vel[frame:, node] == 0).all()


def test_ballistic_stops_on_its_path() -> None:
    start = state(np.array([[0.2, 0.03]]), np.array([[2.0, -4.0]]), WALLS)
    after = Ballistic(DT).step(start)
    velocity = np.array([2.0, -4.0 + G * DT])
    time = -0.03 / velocity[1]
    np.testing.assert_allclose(after.pos[0], [0.2 + 2.0 * time, 0.0], atol=1e-9)
    np.testing.assert_array_equal(after.vel, 0.0)
    assert after.time == pytest.approx(DT)


def test_a_node_at_rest_on_a_wall_stays_there() -> None:
    shapes = WALLS + OBSTACLES
    start = state(np.array([[0.5, 0.0], [0.0, 0.7], [0.5, 1.0], [0.3, 0.45]]), np.zeros((4, 2)), shapes)
    result = rollout(Ballistic(DT), start, 10, SCENE)
    np.testing.assert_array_equal(result.pos[-1], start.pos)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_constant_velocity_stops_at_walls(backend: str) -> None:
    shapes = WALLS + OBSTACLES
    start = cloud(shapes)
    assert start.gravity[1] == G  # which it knows nothing of
    result = rollout(StopsAtWalls(DT), start.to_torch() if backend == "torch" else start, 120, SCENE)
    distance = signed_distance(shapes, result.pos)
    assert distance.min() >= 0
    at_rest = (result.vel == 0).all(axis=-1)
    frame = np.arange(121)[:, None, None]
    free = np.where(at_rest[:, :, None], result.pos, start.pos + frame * DT * start.vel)
    np.testing.assert_allclose(result.pos, free, atol=1e-12)
    assert at_rest[-1].mean() > 0.9 and distance[-1][at_rest[-1]].max() < 1e-6
    for node, landed in enumerate(at_rest.argmax(axis=0)):
        if at_rest[-1, node]:
            assert (result.pos[landed:, node] == result.pos[landed, node]).all()


def test_constant_velocity_stops_on_its_path() -> None:
    after = StopsAtWalls(DT).step(state(np.array([[0.2, 0.03], [0.2, 0.03]]), np.array([[2.0, -4.0], [2.0, 4.0]]), WALLS))
    np.testing.assert_allclose(after.pos, [[0.2 + 2.0 * 0.03 / 4.0, 0.0], [0.22, 0.07]], atol=1e-9)
    np.testing.assert_array_equal(after.vel, [[0.0, 0.0], [2.0, 4.0]])


@pytest.mark.parametrize("length", [2.0**-20, 1e-3, 1e6])
@pytest.mark.parametrize("time", [2.0**-12, 1.0, 1e4])
@pytest.mark.parametrize("baseline", [Ballistic, StopsAtWalls])
def test_baselines_are_the_same_in_any_unit(baseline: type, length: float, time: float) -> None:
    """Nodes that rest on a surface within rounding stay there, others fall, whatever the unit."""
    shapes: tuple[Shape, ...] = (*domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3), Sphere((0.3, 0.3), 0.15, 0.3))
    scaled: tuple[Shape, ...] = (
        *domain_walls(((0.0, length), (0.0, length)), 0.3),
        Sphere((0.3 * length, 0.3 * length), 0.15 * length, 0.3),
    )
    pos = np.array([[0.2, 0.9], [0.5, 1e-8], [0.3, 0.45 + 1e-8], [0.8, 1e-4], [0.6, 0.5]])
    vel = np.array([[0.5, -1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [9.0, 0.0]])
    start = state(pos, vel, shapes)
    other = replace(state(length * pos, length / time * vel, scaled, spacing=0.1 * length), gravity=start.gravity * length / time**2)
    expected = rollout(baseline(DT), start, 30, SCENE)
    result = rollout(baseline(time * DT), other, 30, replace(SCENE, frame_dt=time * DT))
    np.testing.assert_allclose(result.pos / length, expected.pos, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(expected.pos[-1, 1:3], pos[1:3])
    if baseline is Ballistic:
        assert expected.pos[-1, 3, 1] == pytest.approx(0.0, abs=1e-9)


def test_ballistic_of_no_nodes() -> None:
    assert Ballistic(DT).step(state(np.empty((0, 2)), np.empty((0, 2)), WALLS)).pos.shape == (0, 2)
