"""Normals of moving boundaries rotate with the rigid part of each node, which is found from the motion."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary

DT, NUM_FRAMES, SPACING = 0.01, 21, 0.05
TIME = np.linspace(0, 1, NUM_FRAMES)
FLOOR = np.stack([np.arange(0, 1.001, SPACING), np.zeros(21)], axis=1)
UP = np.tile([0.0, 1.0], (len(FLOOR), 1))


def rotation(angle: np.ndarray, dim: int = 2) -> np.ndarray:
    """Return rotations about the origin or the z axis [..., dim, dim]."""
    turn = np.zeros((*np.shape(angle), dim, dim))
    turn[..., range(dim), range(dim)] = 1.0
    turn[..., 0, 0] = turn[..., 1, 1] = np.cos(angle)
    turn[..., 1, 0] = np.sin(angle)
    turn[..., 0, 1] = -turn[..., 1, 0]
    return turn


def still(nodes: np.ndarray) -> np.ndarray:
    return np.broadcast_to(nodes, (NUM_FRAMES, *nodes.shape))


def turned(nodes: np.ndarray, turn: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return positions [frame, node, dim] of nodes that rotate about a point."""
    return centre + np.einsum("fde,ne->fnd", turn, nodes - centre)


def normals(path: np.ndarray, normal: np.ndarray, periodicity: Periodicity | None = None) -> np.ndarray:
    boundary = Boundary.moving(path, normal, DT, **({} if periodicity is None else {"periodicity": periodicity}))
    assert boundary.motion is not None
    return boundary.motion.normal


def disc(centre: tuple[float, float], radius: float, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    angle = 2 * np.pi * np.arange(count) / count
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.array(centre) + radius * normal, normal


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("origin", [0.0, 300.0])
def test_a_piston_that_slides_over_a_floor_turns_nothing(precision: type, origin: float) -> None:
    piston = np.stack([np.full(10, 0.02), SPACING * np.arange(10) + 0.03], axis=1)
    push = np.stack([0.7 * TIME**2, 0 * TIME], axis=1)
    path = origin + np.concatenate([still(FLOOR), piston + push[:, None]], axis=1)
    given = np.concatenate([UP, np.tile([0.6, 0.8], (10, 1))])
    result = normals(path.astype(precision), given)
    assert (result == given.astype(np.float32)).all()


def test_a_disc_that_turns_above_a_floor_turns_its_own_normals_alone() -> None:
    body, normal = disc((0.5, 0.13), 0.1)
    turn = rotation(2.5 * TIME)
    path = np.concatenate([still(FLOOR), turned(body, turn, np.array([0.5, 0.13]))], axis=1)
    result = normals(path, np.concatenate([UP, normal]))
    assert (result[:, : len(FLOOR)] == UP).all()
    np.testing.assert_allclose(result[:, len(FLOOR) :], np.einsum("fde,ne->fnd", turn, normal.astype(np.float32)), atol=1e-12)


@pytest.mark.parametrize("radius", [0.05, 0.08])
def test_a_small_wheel_with_a_hub_turns_as_a_whole_in_a_wide_domain(radius: float) -> None:
    """Rounding that a wide domain allows hides how the hub and its neighbours lie to each other, but not that the wheel takes them along."""
    floor = np.stack([np.linspace(0, 100, 301), np.zeros(301)], axis=1)
    body, normal = disc((50.0, 0.3), radius)
    body, normal = np.concatenate([body[:1] * 0 + [50.0, 0.3], body]), np.concatenate([normal[:1], normal])
    turn = rotation(1.5 * TIME)
    path = np.concatenate([still(floor), turned(body, turn, np.array([50.0, 0.3]))], axis=1)
    result = normals(path, np.concatenate([np.tile([0.0, 1.0], (301, 1)), normal]))
    assert (result[:, :301] == [0.0, 1.0]).all()
    np.testing.assert_allclose(result[:, 301:], np.einsum("fde,ne->fnd", turn, normal.astype(np.float32)), atol=1e-4)


def test_bodies_that_part_later_are_two() -> None:
    """The parts move together; after half of the time, one of them begins to turn. They lie within each other, so distance cannot separate them."""
    body, normal = disc((0.3, 0.3), 0.1)
    other, other_normal = disc((0.32, 0.3), 0.105, 11)
    shift = np.stack([0.4 * TIME, 0.1 * TIME], axis=1)[:, None]
    turn = rotation(2.0 * np.maximum(TIME - 0.5, 0))
    path = np.concatenate([body + shift, turned(other, turn, np.array([0.32, 0.3])) + shift], axis=1)
    order = np.random.default_rng(0).permutation(23)
    result = normals(path[:, order], np.concatenate([normal, other_normal])[order])[:, np.argsort(order)]
    assert (result[:, :12] == normal.astype(np.float32)).all()
    np.testing.assert_allclose(result[:, 12:], np.einsum("fde,ne->fnd", turn, other_normal.astype(np.float32)), atol=1e-12)


def test_single_nodes_do_not_turn() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.2, 0.8, (4, 2))
    path = points + rng.normal(size=(4, 2)) * TIME[:, None, None] + 0.1 * np.sin(np.arange(1, 5)[:, None] * 5 * TIME[:, None, None])
    for count in (1, 4):
        given = np.tile([0.8, -0.6], (count, 1))
        assert (normals(path[:, :count], given) == given.astype(np.float32)).all()


def test_a_wheel_in_space_and_its_axle_that_lies_still() -> None:
    """Nodes on the axis do not move: those of the axle beside the wheel are part of it, those of a post farther along it are not."""
    angle = 2 * np.pi * np.arange(10) / 10
    rim = np.concatenate([np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), np.full(10, z)], axis=1) for z in (0.0, 0.05)])
    axle = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.05]])
    post = np.array([[0.05 * x, 0.05 * y, -0.6] for x in range(-2, 3) for y in range(-2, 3)])
    turn = rotation(3 * TIME, 3)
    path = np.concatenate([turned(np.concatenate([rim, axle]), turn, np.zeros(3)), still(post)], axis=1)
    given = np.random.default_rng(0).normal(size=(len(path[0]), 3))
    given = (given / np.linalg.norm(given, axis=1)[:, None]).astype(np.float32)
    result = normals(path, given)
    np.testing.assert_allclose(result[:, :22], np.einsum("fde,ne->fnd", turn, given[:22]), atol=1e-6)
    np.testing.assert_allclose(result[:, 22:], still(given[22:]), atol=1e-6)


def test_a_row_in_space_turns_as_it_is_swung_but_not_about_itself() -> None:
    rod = np.stack([np.linspace(0, 0.5, 6), np.zeros(6), np.zeros(6)], axis=1)
    turn = rotation(1.2 * TIME, 3)
    across, upright = (np.tile(n, (6, 1)) for n in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    path = turned(rod, turn, np.zeros(3)) + 0.2 * TIME[:, None, None]
    np.testing.assert_allclose(normals(path, across), np.einsum("fde,ne->fnd", turn, across), atol=1e-12)
    np.testing.assert_allclose(normals(path, upright), still(upright), atol=1e-12)


def test_a_body_across_a_seam_is_one() -> None:
    space = Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))
    body, normal = disc((0.02, 0.5), 0.1)
    turn = rotation(1.5 * TIME)
    path = turned(body, turn, np.array([0.02, 0.5])) + np.stack([-0.6 * TIME, 0 * TIME], axis=1)[:, None]
    path[..., 0] %= 1.0
    expected = np.einsum("fde,ne->fnd", turn, normal.astype(np.float32))
    np.testing.assert_allclose(normals(path, normal, space), expected, atol=1e-9)


def test_a_membrane_carries_its_normals() -> None:
    x = np.linspace(0, 1, 41)
    height = 0.1 * np.sin(2 * np.pi * x) * np.sin(2 * TIME)[:, None]
    path = np.stack([np.broadcast_to(x, height.shape), height], axis=-1)
    slope = 0.2 * np.pi * np.cos(2 * np.pi * x) * np.sin(2 * TIME)[:, None]
    expected = np.stack([-slope, np.ones_like(slope)], axis=-1) / np.sqrt(1 + slope**2)[..., None]
    result = normals(path, np.tile([0.0, 1.0], (41, 1)))
    assert (result * expected).sum(axis=-1).min() > np.cos(np.radians(15))
    assert (expected[..., 1]).min() < np.cos(np.radians(25))


def test_normals_of_every_frame_are_taken_as_they_are_given() -> None:
    body, _ = disc((0.5, 0.5), 0.1)
    given = np.random.default_rng(0).normal(size=(NUM_FRAMES, 12, 2))
    result = normals(still(body), given)
    np.testing.assert_allclose(result, given / np.linalg.norm(given, axis=-1, keepdims=True), rtol=1e-12)
    given[3, 7] = 0.0
    with pytest.raises(ArrayError, match="boundary normal: frame 3, boundary_node 7 has length 0"):
        normals(still(body), given)
    with pytest.raises(ArrayError, match=r"boundary normal: has shape \[20, 12, 2\]"):
        normals(still(body), given[1:])
