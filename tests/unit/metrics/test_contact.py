"""Contact of bodies with walls: gaps, times and bounces of motions with known answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.metrics.contact import FARTHEST, NEAR, bounce_heights, boundary_gaps, contact_limits, contact_times, in_first_contact
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Trajectory

LIMIT = np.array([0.0])


def column(*values: float) -> np.ndarray:
    return np.array(values, float)[:, None]


def test_contact_times_are_interpolated() -> None:
    """From 1 above to 1 below the limit takes half a frame, then one whole, then a quarter."""
    assert contact_times(column(1, -1, -1, 3), LIMIT, 0.1)[0] == pytest.approx(0.1 * (0.5 + 1 + 0.25))
    assert contact_times(column(1, 2, 1), LIMIT, 0.1)[0] == 0
    assert contact_times(column(-1, -1, -2), LIMIT, 0.1)[0] == pytest.approx(0.2)


def test_nothing_touches_without_a_boundary() -> None:
    limit = contact_limits(column(np.inf, np.inf), 1.0)
    assert limit[0] == -np.inf
    assert contact_times(column(np.inf, np.inf), limit, 0.1)[0] == 0
    assert not in_first_contact(column(np.inf, np.inf), limit).any()
    assert contact_times(column(0.1, 0.1), limit, 0.1)[0] == 0  # the ground truth never touched


def test_limits_follow_the_closest_approach_of_the_ground_truth() -> None:
    gap = np.stack([[5.0, 0.1], [9.0, 2 * FARTHEST * 0.1], [5.0, 0.0]])
    np.testing.assert_allclose(contact_limits(gap.T, 0.1), [0.1 + NEAR * 0.1, -np.inf, NEAR * 0.1])


def test_the_first_contact_ends_when_the_body_lets_go() -> None:
    gap = np.stack([[1, 0, -1, 2, -1], [2, 2, 0, 0, 0]], axis=1).astype(float)
    found = in_first_contact(gap, np.zeros(2))
    assert found.T.tolist() == [[False, True, True, False, False], [False, False, True, True, True]]


def test_a_bounce_is_the_largest_rise_after_contact() -> None:
    """The fall from 9 to 10 before the contact is no bounce; the rise from 1 to 4 is larger than that from 0.5 to 2."""
    height = column(9, 10, 2, 1, 4, 0.5, 2)
    gap = column(8, 9, 0, -1, 3, 0, 1)
    assert bounce_heights(height, gap, LIMIT)[0] == pytest.approx(3)
    assert bounce_heights(height, gap + 20, LIMIT)[0] == 0
    assert bounce_heights(height[:4], gap[:4], LIMIT)[0] == 0


def test_heights_before_the_contact_do_not_count() -> None:
    """A body that is thrown from a low place against the ceiling."""
    assert bounce_heights(column(1, 5, 4, 4.5), column(3, 0, 1, 1), LIMIT)[0] == pytest.approx(0.5)


def falling(num_frames: int = 4, boundary: Boundary | None = None) -> Trajectory:
    """A square that falls by 0.1 m per frame, from 0.5 m above the floor."""
    square = np.array([[0.4, 0.5], [0.5, 0.5], [0.5, 0.6], [0.4, 0.6]])
    pos = square - 0.1 * np.arange(num_frames)[:, None, None] * np.array([0.0, 1.0])
    bounds = ((0.0, 1.0), (0.0, 1.0))
    walls = Boundary.sample(domain_walls(bounds, 0.3), 0.1, 2) if boundary is None else boundary
    return Trajectory.from_numpy(pos, 0.1, "sand", {"sand": 30.0}, bounds=bounds, boundary=walls, spacing=0.1)


def test_gaps_are_distances_to_shapes_or_to_boundary_nodes() -> None:
    bodies = [np.array([0, 1]), np.array([2, 3])]
    expected = np.array([[0.4, 0.4], [0.4, 0.4], [0.3, 0.4], [0.2, 0.3]])  # the nearest side is 0.4 away
    trajectory = falling()
    np.testing.assert_allclose(boundary_gaps(trajectory, bodies), expected, atol=1e-7)
    nodes_only = replace(trajectory, boundary=replace(trajectory.boundary, shapes=()))
    np.testing.assert_allclose(boundary_gaps(nodes_only, bodies), expected, atol=1e-7)
    assert np.isinf(boundary_gaps(replace(trajectory, boundary=Boundary.empty(2)), bodies)).all()


def test_gaps_end_at_nodes_beside_shapes_too() -> None:
    trajectory = falling()
    pos = trajectory.pos[0, :1] - [0.0, 0.05]
    own = trajectory.boundary
    table = Boundary.from_numpy(np.concatenate([own.pos, pos]), np.concatenate([own.normal, [[0.0, 1.0]]]), friction=0.3, shapes=own.shapes)
    gaps = boundary_gaps(replace(trajectory, boundary=table), [np.array([0])])
    np.testing.assert_allclose(gaps[0], 0.05, atol=1e-6)


def test_gaps_follow_a_moving_boundary() -> None:
    """A piston that falls as fast as the body keeps its distance."""
    nodes = np.stack([np.linspace(0.3, 0.6, 4), np.full(4, 0.4)], axis=-1)
    path = nodes - 0.1 * np.arange(4)[:, None, None] * np.array([0.0, 1.0])
    piston = Boundary.moving(path, np.tile([0.0, 1.0], (4, 1)), 0.1)
    np.testing.assert_allclose(boundary_gaps(falling(boundary=piston), [np.arange(2)]), np.full((4, 1), 0.1), atol=1e-7)


def test_a_clamp_at_a_wall_is_no_contact() -> None:
    """Nodes of the clamp, and of the cells at the clamp, do not count; the free end does."""
    rest = 0.1 * np.stack(np.meshgrid(np.arange(5), np.arange(2), indexing="ij"), axis=-1).reshape(-1, 2)
    cells = [[2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1] for k in range(4)]
    bounds = ((0.0, 2.0), (-0.35, 1.0))
    fallen = rest - np.array([0.0, 0.1]) * (rest[:, :1] > 0.35)
    pos = np.stack([rest, fallen, fallen])
    values: dict[str, Any] = {
        "cells": cells,
        "bounds": bounds,
        "spacing": 0.1,
        "boundary": Boundary.sample(domain_walls(bounds, 0.3), 0.1, 2),
    }
    material = ("elastomer", {"elastomer": 1e5})
    loose = Trajectory.from_numpy(pos, 0.01, *material, **values)
    clamped = Trajectory.from_numpy(pos, 0.01, *material, prescribed=rest[:, 0] == 0, **values)
    body = [np.arange(10)]
    assert boundary_gaps(loose, body)[:, 0] == pytest.approx([0, 0, 0], abs=1e-6)
    assert boundary_gaps(clamped, body)[:, 0] == pytest.approx([0.2, 0.2, 0.2], abs=1e-6)  # the second cell begins at 0.2
    assert (boundary_gaps(clamped, [np.arange(4)]) == np.inf).all()
    assert boundary_gaps(clamped, [np.arange(8, 10)])[:, 0] == pytest.approx([0.35, 0.25, 0.25], abs=1e-6)
