"""After containment no node is inside a wall or obstacle, velocities are still differences of positions, and every correction is counted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import (
    Bowl,
    Box,
    DistanceGrid,
    Polygon,
    Shape,
    Sphere,
    domain_walls,
    outward_normal,
    signed_distance,
    surface_tolerance,
)
from gpe_pl.rollout import containment
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.containment import Contained, contain
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.state import State
from tests import scenes

DT = 0.01
WALLS = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3)
TOLERANCE = surface_tolerance(WALLS)
OBSTACLES = (
    Sphere((0.3, 0.4), 0.1, 0.3),
    Box((0.6, 0.2), (0.8, 0.35), 0.3),
    Polygon(((0.5, 0.6), (0.8, 0.65), (0.6, 0.85)), 0.3),
)
HOUSES = (Box((0.4, -0.1), (0.6, 0.1), 0.3), Sphere((0.0, 0.5), 0.1, 0.3), Polygon(((0.9, 0.0), (1.1, 0.0), (1.0, 0.3)), 0.3))
"""Obstacles that intersect a wall."""
WEDGES = (Sphere((0.2, 0.1), 0.1, 0.3), Sphere((0.41, 0.1), 0.11, 0.3), Box((0.6, 0.0), (0.8, 0.1), 0.3), Box((0.7, 0.1), (0.9, 0.2), 0.3))
"""Obstacles that touch a wall or each other."""


def moved(shapes: tuple[Shape, ...], before: np.ndarray, after: np.ndarray, history: int = 0, dim: int = 2, spacing: float = 0.1) -> State:
    """Return the state after a step from one set of positions to another."""
    s = scenes.state(len(before), history=history or 1, walls=False, dim=dim)
    vel = (after - before) / DT
    past = None
    if history:
        assert s.velocity_history is not None
        past = np.concatenate([s.velocity_history[:, :-1], vel[:, None]], axis=1)
    boundary = Boundary.sample(shapes, spacing, dim)
    return replace(s, pos=after, vel=vel, velocity_history=past, boundary=boundary)


def steps_from_free_space(
    shapes: tuple[Shape, ...], length: float, count: int = 3000, seed: int = 0, dim: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    before = rng.uniform(0, 1, (4 * count, dim))
    before = before[signed_distance(shapes, before) > 0][:count]
    return before, before + rng.normal(scale=length, size=before.shape)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("length", [0.01, 0.05, 0.3])
@pytest.mark.parametrize(
    "shapes", [WALLS, WALLS + OBSTACLES, WALLS + HOUSES, WALLS + WEDGES], ids=["walls", "obstacles", "houses", "wedges"]
)
def test_no_node_is_inside_afterwards(shapes: tuple[Shape, ...], length: float, backend: str) -> None:
    before, after = steps_from_free_space(shapes, length)
    state = moved(shapes, before, after, history=2)
    result, corrected = contain(state.to_torch() if backend == "torch" else state, DT)
    pos, vel, mask = (np.asarray(x) for x in (result.pos, result.vel, corrected))
    assert 10 < mask.sum() < len(before)
    assert signed_distance(shapes, pos).min() >= -TOLERANCE
    np.testing.assert_array_equal(mask, signed_distance(shapes, after) < -TOLERANCE)
    np.testing.assert_array_equal(pos[~mask], after[~mask])
    np.testing.assert_allclose(vel, (pos - before) / DT, rtol=1e-9, atol=1e-9)
    history = np.asarray(result.velocity_history)
    np.testing.assert_array_equal(history[:, -1], vel)
    np.testing.assert_array_equal(history[:, 0], state.velocity_history[:, 0])  # type: ignore[index]


def test_numpy_and_torch_agree() -> None:
    state = moved(WALLS + OBSTACLES, *steps_from_free_space(WALLS + OBSTACLES, 0.05))
    (a, mask), (b, torch_mask) = contain(state, DT), contain(state.to_torch(), DT)
    np.testing.assert_allclose(b.pos, a.pos, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(torch_mask, mask)
    assert isinstance(b.pos, torch.Tensor)
    assert b.velocity_history is None


GRID = DistanceGrid.from_values((0.0, 0.0), 0.1, np.add.outer(0.4 - np.linspace(0, 1, 11), np.linspace(0, 0.5, 11)), 0.3)


@pytest.mark.parametrize("shapes", [WALLS + OBSTACLES, WALLS + WEDGES, (Bowl((0.5, 0.5), 0.4, 0.3),), (*WALLS, GRID)])
@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("length", [0.05, 0.3])
def test_the_compiled_pass_equals_the_plain_one(shapes: tuple[Shape, ...], backend: str, length: float) -> None:
    before, after = steps_from_free_space(shapes, length, count=500)
    state = moved(shapes, before, after, history=2)
    state = state.to_torch() if backend == "torch" else state
    found, mask = contain(state, DT)
    with unfused():
        expected, expected_mask = contain(state, DT)
    np.testing.assert_array_equal(mask, expected_mask)
    assert np.asarray(mask).any()
    for name in ("pos", "vel", "velocity_history"):
        assert type(getattr(found, name)) is type(getattr(expected, name))
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12)


def test_the_compiled_pass_wraps_nodes_into_a_periodic_domain() -> None:
    space = Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))
    state = moved((Box((-0.1, 0.4), (0.05, 0.6), 0.3),), np.array([[-0.12, 0.5]]), np.array([[-0.09, 0.5]]))
    state = replace(state, periodicity=space)
    found, _ = contain(state, DT)
    with unfused():
        expected, _ = contain(state, DT)
    assert 0 <= float(found.pos[0, 0]) < 1
    np.testing.assert_allclose(found.pos, expected.pos, rtol=0, atol=1e-12)


def test_a_node_comes_back_along_the_normal() -> None:
    before = np.array([[0.5, 0.02], [0.5, 0.52], [0.02, 0.98]])
    after = np.array([[0.53, -0.04], [0.53, 0.56], [-0.03, 1.05]])
    result, corrected = contain(moved(WALLS, before, after), DT)
    np.testing.assert_allclose(result.pos, [[0.53, 0.0], [0.53, 0.56], [0.0, 1.0]], atol=1e-12)
    np.testing.assert_array_equal(corrected, [True, False, True])
    np.testing.assert_allclose(result.vel[0], [3.0, -2.0], atol=1e-9)
    disc, _ = contain(moved((Sphere((0.5, 0.5), 0.2, 0.3),), np.array([[0.5, 0.71]]), np.array([[0.56, 0.58]])), DT)
    np.testing.assert_allclose(disc.pos, [[0.62, 0.66]], atol=1e-6)


def test_corners_of_a_box_in_three_dimensions() -> None:
    walls = domain_walls(((0.0, 1.0),) * 3, 0.3)
    before, after = steps_from_free_space(walls, 0.5, count=500, dim=3)
    result, corrected = contain(moved(walls, before, after, dim=3), DT)
    assert (signed_distance(walls, after) < 0).sum() == corrected.sum()
    np.testing.assert_allclose(result.pos, np.clip(after, 0, 1), atol=1e-9)


def test_a_node_that_finds_no_way_out_returns_to_where_it_was() -> None:
    """Exactly in the middle of a disc no direction leads out."""
    before, after = np.array([[0.0, 0.3]]), np.zeros((1, 2))
    result, corrected = contain(moved((Sphere((0.0, 0.0), 0.2, 0.3),), before, after, history=2), DT)
    np.testing.assert_allclose(result.pos, before, atol=1e-12)
    np.testing.assert_allclose(result.vel, 0.0, atol=1e-9)
    assert corrected.all()


@pytest.mark.parametrize("shapes", [(), WALLS])
def test_nothing_inside_gives_the_same_object(shapes: tuple[Shape, ...]) -> None:
    for depth in (0.0, 0.5 * TOLERANCE):
        state = moved(shapes, np.array([[0.5, 0.1]]), np.array([[0.5, -depth]]))
        for s in (state, state.to_torch()):
            result, corrected = contain(s, DT)
            assert result is s
            assert not corrected.any()
    empty = moved(shapes, np.empty((0, 2)), np.empty((0, 2)))
    assert contain(empty, DT)[0] is empty


def test_the_state_before_is_left_as_it_is() -> None:
    state = moved(WALLS, *steps_from_free_space(WALLS, 0.3), history=2)
    arrays = {k: v.copy() for k, v in vars(state).items() if isinstance(v, np.ndarray)}
    contain(state, DT)
    for key, value in arrays.items():
        np.testing.assert_array_equal(getattr(state, key), value)


@dataclass(frozen=True)
class Moves:
    """Simulator that moves every node by its velocity."""

    def step(self, state: State) -> Any:
        return replace(state, pos=state.pos + DT * state.vel)


def cave(length: float) -> tuple[Shape, ...]:
    """Return walls, a disc, a box and a polygon, in units of the domain's size."""
    corners = ((0.5, 0.6), (0.8, 0.65), (0.6, 0.85))
    return (
        *domain_walls(((0.0, length), (0.0, length)), 0.3),
        Sphere((0.3 * length, 0.4 * length), 0.1 * length, 0.3),
        Box((0.6 * length, 0.2 * length), (0.8 * length, 0.35 * length), 0.3),
        Polygon(tuple((x * length, y * length) for x, y in corners), 0.3),
    )


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**-20, 2.0**20, 1e-6, 1e6])
def test_containment_is_the_same_in_any_unit_of_length(scale: float) -> None:
    before, after = steps_from_free_space(cave(1.0), 0.05, count=1000)
    after[:3] = [[0.5, -2e-6], [0.5, -0.5e-6], [0.9, -1e-3]]
    expected, corrected = contain(moved(cave(1.0), before, after), DT)
    result, also = contain(moved(cave(scale), scale * before, scale * after, spacing=0.1 * scale), DT)
    np.testing.assert_array_equal(also, corrected)
    assert corrected[:3].tolist() == [True, False, True]
    if np.log2(scale).is_integer():
        np.testing.assert_array_equal(result.pos, scale * expected.pos)
        np.testing.assert_array_equal(result.vel, scale * expected.vel)
    else:
        np.testing.assert_allclose(result.pos, scale * expected.pos, rtol=0, atol=1e-6 * scale)


@pytest.mark.parametrize("scale", [2.0**-40, 1e-9, 1e6])
def test_nodes_on_edges_of_walls_are_kept_in_any_unit_of_length(scale: float) -> None:
    """Walls share their edges; nodes inside an obstacle go."""
    expected = Boundary.sample(cave(1.0), 0.1, 2)
    assert len(Boundary.sample(cave(scale), 0.1 * scale, 2).pos) == len(expected.pos)
    house: tuple[Shape, ...] = (*domain_walls(((0.0, scale), (0.0, scale)), 0.3), Box((0.4 * scale, 0.0), (0.6 * scale, 0.2 * scale), 0.3))
    floor = Boundary.sample(house, 0.01 * scale, 2)
    assert signed_distance(house, floor.pos).min() > -1e-9 * scale


def test_contained_states_know_how_many_nodes_were_corrected() -> None:
    contained = Contained(Moves(), DT)
    pos = np.array([[0.5, 0.5], [0.5, 0.025], [0.025, 0.5], [0.5, 0.9]])
    state = moved(WALLS, pos, pos)
    state = replace(state, vel=np.array([[0.0, 0.0], [0.0, -1.0], [-1.0, 0.0], [0.0, 0.0]]))
    counts = []
    for _ in range(6):
        state = contained.step(state)
        counts.append(state.num_corrected)
    # the third step would end 5 mm inside: it goes only half as far, and that speed is lost on the wall in the fourth
    assert counts == [0, 0, 2, 2, 0, 0]


def test_nodes_whose_motion_is_given_are_not_corrected() -> None:
    pos = np.array([[0.5, -0.02], [0.3, -0.02], [0.5, 0.5]])
    state = moved(WALLS, pos, pos)
    held = np.array([[True, True], [True, False], [False, False]])  # the second is free to rise
    found, corrected = contain(replace(state, loads=Loads(held, pos[None, :2])), DT)
    assert corrected.tolist() == [False, True, False]
    np.testing.assert_array_equal(found.pos[[0, 2]], pos[[0, 2]])
    assert found.pos[1, 1] >= 0


@pytest.mark.parametrize("shapes", [WALLS, WALLS + OBSTACLES + HOUSES, WALLS + WEDGES], ids=["walls", "obstacles", "wedges"])
def test_shapes_that_nothing_is_in_are_skipped_without_a_difference(shapes: tuple[Shape, ...]) -> None:
    before, after = steps_from_free_space(shapes, 0.05, count=500)
    state = moved(shapes, before, after)
    result, corrected = contain(state, DT)
    everywhere = after[corrected]
    for _ in range(4):
        for shape in shapes:
            depth = np.maximum(-shape.signed_distance(everywhere), 0.0)
            everywhere = everywhere + depth[:, None] * outward_normal(shape, everywhere, step=1e-6)
    caught = (signed_distance(shapes, everywhere) < -TOLERANCE) | containment._are_between(shapes, everywhere, TOLERANCE)
    assert corrected.sum() > 20
    np.testing.assert_array_equal(
        result.pos[corrected], np.where(caught[:, None], after[corrected] - state.vel[corrected] * DT, everywhere)
    )


def test_walls_without_shapes_are_named(caplog: pytest.LogCaptureFixture) -> None:
    """They hold no node, and no node is counted."""
    containment._warn_of_points.cache_clear()
    floor = Boundary.from_numpy(np.stack([np.linspace(0, 1, 21), np.zeros(21)], axis=1), np.tile([0.0, 1.0], (21, 1)))
    state = State(np.array([[0.5, 0.01]]), np.array([[0.0, -1.0]]), np.zeros(1, np.uint8), np.ones(1), np.ones((1, 1)), floor, np.zeros(2))
    contained = Contained(ConstantVelocity(0.1), 0.1)
    for _ in range(2):
        after = contained.step(state)
    assert after.pos[0, 1] < 0 and after.num_corrected == 0
    assert len([m for m in caplog.messages if "nodes that cross them are neither put back nor counted" in m]) == 1


@pytest.mark.parametrize("backend", ["compiled", "numpy", "torch"])
@pytest.mark.parametrize("height", [0.0, 0.001, 0.003, 0.02])
@pytest.mark.parametrize("stacked", [False, True])
def test_no_node_gets_under_a_box_that_stands_on_something(height: float, stacked: bool, backend: str) -> None:
    """Both surfaces are there at distance zero, so the signed distance alone calls this free."""
    walls = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.0)
    shapes: tuple[Shape, ...] = (*walls, Box((0.4, 0.0), (0.7, 0.3), 0.0))
    if stacked:
        shapes, height = (*walls, Box((0.4, -0.1), (0.7, 0.2), 0.0), Box((0.4, 0.2), (0.7, 0.5), 0.0)), 0.2 + height
    pos, vel = np.array([[0.3, height]]), np.array([[0.5, 0.0]])
    boundary = Boundary.sample(shapes, 0.05, 2)
    state = State(pos, vel, np.zeros(1, np.uint8), np.ones(1), np.ones((1, 1)), boundary, np.zeros(2))
    contained = Contained(ConstantVelocity(0.05), 0.05)
    if backend == "torch":
        state = state.to_torch()
    for _ in range(12):
        if backend == "compiled":
            state = contained.step(state)
        else:
            with unfused():
                state = contained.step(state)
    assert float(state.pos[0, 0]) <= 0.4 + 1e-6
    assert abs(float(state.vel[0, 0])) < 1e-6


def test_a_node_at_the_foot_of_a_box_is_free() -> None:
    walls = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.0)
    boundary = Boundary.sample((*walls, Box((0.4, 0.0), (0.7, 0.3), 0.0)), 0.05, 2)
    for x in (0.4, 0.39, 0.7):
        state = State(np.array([[x, 0.0]]), np.zeros((1, 2)), np.zeros(1, np.uint8), np.ones(1), np.ones((1, 1)), boundary, np.zeros(2))
        assert contain(state, 0.05)[0] is state
