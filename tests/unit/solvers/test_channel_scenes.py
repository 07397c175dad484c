"""Random channels: what every scene has, and what impossible settings are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.solvers.channel_scenes import ChannelScene
from gpe_pl.trajectory.openings import openings_fault

TWO = ChannelScene(((0.0, 1.2), (0.0, 0.8)), 0.05, gravity=(0.0, -9.81), connectivity_cells=2.5, changing=0.5)
THREE = ChannelScene(((0.0, 1.2), (0.0, 0.4), (0.0, 0.8)), 0.1, changing=0.5)
VALUES = {"fluid": 0.02}


@pytest.mark.parametrize("scene", [TWO, THREE], ids=["2D", "3D"])
def test_every_channel_has_an_inlet_and_an_outlet(scene: ChannelScene) -> None:
    states = [scene.sample(VALUES, seed) for seed in range(30)]
    speeds, heights = set(), set()
    for state in states:
        inlet, outlet = state.openings
        assert openings_fault(state.openings, scene.dim, 1, 6) is None
        assert inlet.enters
        assert not outlet.drives
        assert inlet.depth >= scene.connectivity_radius - 1e-9
        assert outlet.depth >= scene.connectivity_radius - 1e-9
        assert not outlet.contains(state.pos).any()
        assert inlet.contains(state.pos).sum() == len(inlet.nodes_at_start())
        assert (signed_distance(state.boundary.shapes, state.pos) > 0).all()
        assert cKDTree(state.pos).query(state.pos, k=2)[0][:, 1].min() > 0.4 * scene.spacing
        np.testing.assert_array_equal(state.vel, np.tile(inlet.velocity_at(0.0), (state.num_nodes, 1)))
        assert 0.4 <= inlet.speed_at(0.0) <= 0.8
        assert 0.4 <= inlet.speed_at(9.0) <= 0.8
        assert (inlet.mass, inlet.params) == (1000.0 * scene.spacing**scene.dim, (0.02,))
        speeds.add(bool(inlet.speeds))
        heights.add(round((inlet.high[-1] - inlet.low[-1]) / scene.grid_spacing))
    assert speeds == {False, True}
    assert heights == {2, 3}
    assert {len(state.boundary.shapes) - 2 * scene.dim for state in states} == {0, 1}
    assert len({state.num_nodes for state in states}) > 10


def test_a_channel_depends_on_its_seed_only() -> None:
    first, again, other = (TWO.sample(VALUES, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.pos, again.pos)
    assert first.openings == again.openings
    assert first.openings != other.openings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"bounds": ((0.0, 0.6), (0.0, 0.8))},
            "bounds: the channel is 0.6 m long along x, too short for inlet, outlet and 6 cells between them",
        ),
        ({"inlet_cells": (2, 30)}, "the highest inlet does not fit into bounds"),
        ({"speed": (0.8, 0.4)}, "speed must be"),
    ],
)
def test_impossible_settings_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TWO, **changes)  # type: ignore[arg-type]
