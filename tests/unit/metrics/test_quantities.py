"""Quantities of motions whose energy, momentum, run-out and bounce are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.metrics.quantities import quantities
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Trajectory

DT, GRAVITY = 0.01, 10.0


def moving(
    pos: np.ndarray, gravity: tuple[float, ...] = (0.0, -GRAVITY), periodic: tuple[bool, ...] = (), half: float = 10.0
) -> Trajectory:
    bounds = [(-half, half)] * pos.shape[2]
    about: dict[str, Any] = {"gravity": gravity[: pos.shape[2]], "bounds": bounds, "spacing": 0.1, "connectivity_radius": 0.3}
    found = Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, mass=2.0, **about)
    return replace(found, metadata=replace(found.metadata, periodic=periodic))


def falling(num_frames: int = 51) -> np.ndarray:
    """Return four nodes that are thrown upward at 1 m/s, fall, and rise to half the height of their fall."""
    time = DT * np.arange(num_frames)
    height = 1.0 * time - GRAVITY / 2 * time**2
    return np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]]) + np.stack([0.5 * time, height], axis=1)[:, None]


def test_free_flight_keeps_its_energy_and_has_the_momentum_of_its_velocity() -> None:
    found = quantities(moving(falling()))
    total = found["kinetic energy"].over_time + found["potential energy"].over_time
    fall = np.ptp(found["potential energy"].over_time)
    assert np.ptp(total) < 0.06 * fall  # velocities are those between two frames
    np.testing.assert_allclose(found["momentum"].over_time[0], 8.0 * np.hypot(0.5, 1.0 - GRAVITY / 2 * DT), rtol=1e-5)
    assert "peak stress" not in found and "elastic energy" not in found


def test_a_bounce_is_the_rise_after_the_fall_and_not_the_throw_before_it() -> None:
    assert quantities(moving(falling()))["bounce height"].value == 0.0
    height = np.concatenate([[0.0, 0.5, 1.0, 0.6, 0.2, 0.3, 0.5, 0.4, 0.6, 0.1]])
    pos = np.zeros((10, 3, 2)) + np.stack([np.arange(3.0), np.zeros(3)], axis=1)
    pos[..., 1] += height[:, None]
    assert quantities(moving(pos))["bounce height"].value == pytest.approx(0.4)


@pytest.mark.parametrize("dim", [2, 3])
def test_run_out_leaves_the_farthest_twentieth_out(dim: int) -> None:
    pos = np.zeros((3, 40, dim))
    pos[:, :, 1] = np.linspace(0, 1, 40)
    pos[2, :, 0] = 0.1 * np.arange(40) / 39
    pos[2, 38:, 0] = 5.0
    gravity = (0.0, -GRAVITY, 0.0)
    out = quantities(moving(pos, gravity))["run-out"]
    assert out.over_time[0] == 0.0
    assert out.value == out.over_time[-1] == pytest.approx(0.1 * 37 / 39, rel=1e-5)


def test_without_gravity_there_is_no_height() -> None:
    assert {*quantities(moving(falling(), (0.0, 0.0)))} == {"kinetic energy", "momentum", "run-out"}


def test_crossing_the_seam_of_a_periodic_domain_is_no_jump() -> None:
    time = DT * np.arange(5)
    pos = np.zeros((5, 2, 2)) + np.array([[9.9, 0.0], [9.9, 1.0]])
    pos[..., 0] += 10.0 * time[:, None]
    wrapped = np.where(pos >= 10.0, pos - 20.0, pos)
    plain, found = quantities(moving(pos, half=20.0)), quantities(moving(wrapped, periodic=(True, False)))
    np.testing.assert_allclose(found["momentum"].over_time, plain["momentum"].over_time, rtol=1e-4)
    assert found["run-out"].value == pytest.approx(plain["run-out"].value, rel=1e-4)


@pytest.mark.parametrize(("width", "is_there"), [(9.0, True), (11.0, False), (20.0, False)])
def test_run_out_needs_material_that_is_narrower_than_half_of_a_periodic_domain(width: float, is_there: bool) -> None:
    pos = np.zeros((3, 40, 2))
    pos[..., 0] = (np.linspace(5.0, 5.0 + width, 40, endpoint=False) + 10.0) % 20.0 - 10.0
    pos[..., 1] = 0.1 * np.arange(40)
    orders = (np.arange(40), np.random.default_rng(0).permutation(40))
    found = [quantities(moving(pos[:, order], periodic=(True, False))) for order in orders]
    assert [("run-out" in own) for own in found] == [is_there, is_there]
    if is_there:
        assert found[0]["run-out"].value == pytest.approx(found[1]["run-out"].value)


def test_peak_stress_is_the_largest_of_all_nodes_and_frames() -> None:
    trajectory = moving(falling(6))
    node = np.zeros((6, 4, 4), np.float32)
    node[3, 2, 0] = 7.0  # uniaxial, so this is the von Mises stress
    found = quantities(replace(trajectory, stress=Stress(node, np.zeros((6, 0, 4), np.float32))))["peak stress"]
    assert found.value == pytest.approx(7.0)
    assert found.over_time.argmax() == 2


FIRST = np.array([[True, True], [False, False], [False, False]])
"""Mask of the first node."""


def test_deflection_is_the_way_of_the_node_farthest_from_rest() -> None:
    pos = np.zeros((4, 3, 2)) + np.stack([np.arange(3.0), np.zeros(3)], axis=1)
    pos[2, 2] += (0.3, -0.4)
    found = quantities(replace(moving(pos, (0.0, 0.0)), prescribed=FIRST, rest_pos=pos[0]))["deflection"]
    assert found.over_time.tolist() == pytest.approx([0.0, 0.5, 0.0]) and found.value == pytest.approx(0.5)
    assert quantities(replace(moving(pos), prescribed=FIRST))["deflection"].value == pytest.approx(0.5)


@pytest.mark.parametrize("gravity", [(0.0, -GRAVITY), (1e-9, -GRAVITY), (4.0, -3.0)])
def test_run_out_is_across_gravity_in_any_direction(gravity: tuple[float, float]) -> None:
    down = np.array(gravity) / np.linalg.norm(gravity)
    across, time = np.array([-down[1], down[0]]), np.arange(4.0)[:, None, None]
    pos = np.zeros((4, 20, 2)) + 0.01 * time * down + 0.1 * (time - 1) * across  # all nodes move alike, 0.1 m across in a frame
    assert quantities(moving(pos, gravity))["run-out"].value == pytest.approx(0.2, rel=1e-5)


def test_a_body_that_moves_over_a_seam_is_not_strained() -> None:
    grid = 0.05 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    triangles = np.array([c for j in range(3) for i in range(3) for a in [4 * j + i] for c in ([a, a + 1, a + 4], [a + 1, a + 5, a + 4])])
    way = 0.02 * np.arange(40)[:, None, None] * np.array([1.0, 0.0])
    own: dict[str, Any] = {"cells": triangles, "prescribed": np.arange(16) < 4, "bounds": ((0, 1), (0, 1)), "periodic": (True, False)}
    for first in (0.5, 0.95):  # the second is divided from the beginning
        body = Trajectory.from_numpy(
            (grid + np.array([first, 0.3]) + way) % 1.0,
            0.005,
            "elastomer",
            {"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": 0.3}},
            **own,
        )
        found = quantities(body)
        assert found["elastic energy"].over_time.max() < 1e-6  # a cell of this body has 0.1 J at a strain of a hundredth
        assert found["deflection"].value == pytest.approx(0.78, rel=1e-5)
        assert found["run-out"].over_time[0] < 0.15
