"""Acceptance scenes are symmetric, undeformed and within the data set's spacing, so that solvers accept them and symmetry can be measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from gpe_pl.benchmarks.acceptance import bodies, particles, scenes
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.rollout.guard import unsound
from gpe_pl.solvers.scenes import describe
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests.conftest import make_trajectory


def sound(spec: DatasetSpec, state: State) -> bool:
    """Tell whether a start obeys the rules of stored fields, and all nodes are in free space."""
    metadata = describe(spec.scene, spec.solver.frame_dt)
    return unsound(state, metadata) is None and bool((signed_distance(state.boundary.shapes, state.pos) > 0).all())


def is_mirrored(pos: np.ndarray, axis: float) -> bool:
    """Tell whether a cloud equals its mirror image about x = ``axis``."""
    image = pos * [-1, 1] + [2 * axis, 0]
    return np.allclose(pos[np.lexsort(pos.round(9).T)], image[np.lexsort(image.round(9).T)], atol=1e-9)


@pytest.mark.parametrize("name", ["fem", "elastomer"])
def test_a_dropped_block_is_symmetric_down_to_its_cells(name: str) -> None:
    spec = dataset(f"data={name}", "size=small")
    state = scenes.dropped_block(spec, 1e6, 8, 3, gap=0.1, speed=2.0)
    assert sound(spec, state) and state.cells is not None
    mirrored = np.arange(9 * 4).reshape(9, 4)[::-1].ravel()
    assert np.allclose(state.pos[mirrored], state.pos * [-1, 1] + [1, 0])
    cells = {frozenset(cell) for cell in state.cells.tolist()}
    assert {frozenset(mirrored[[*cell]].tolist()) for cell in cells} == cells
    a, b, c = state.pos[state.cells].swapaxes(0, 1)
    assert (np.linalg.det(np.stack([b - a, c - a], axis=-1)) > 0).all()  # none is inverted
    assert state.mass.sum() == pytest.approx(1000 * 24 * spec.scene.spacing**2 if name == "fem" else 1000 * 36 * spec.scene.spacing**2)
    assert np.isclose(state.pos[:, 1].min(), 0.1) and (state.vel == [0, -2]).all()


def test_columns_and_balls_are_symmetric_and_seeded() -> None:
    spec = dataset("data=sand", "size=small")
    column = scenes.column(spec, 30.0, 6, 4)
    ball = scenes.ball_over_cylinder(spec, 30.0, 4, 0.1, 2.0)
    for state in (column, ball):
        assert sound(spec, state) and is_mirrored(state.pos, 0.5)
    assert column.num_nodes == 24
    assert np.array_equal(column.pos, scenes.column(spec, 40.0, 6, 4).pos)  # the parameter alone differs


@pytest.mark.parametrize(("wall", "columns", "rows"), [("ceiling", 8, 4), ("side", 4, 8)])
def test_a_leaning_block_touches_a_wall_without_friction(wall: Literal["ceiling", "side"], columns: int, rows: int) -> None:
    spec = dataset("data=snow", "size=small")
    state = scenes.leaning(spec, 7.0, columns, rows, wall)
    (left, _), (low, high) = spec.scene.bounds
    gap = high - state.pos[:, 1].max() if wall == "ceiling" else state.pos[:, 0].min() - left
    assert sound(spec, state) and state.num_nodes == columns * rows and not state.vel.any()
    assert 0 < gap < 0.6 * spec.scene.spacing and not state.boundary.friction.any()
    assert state.pos[:, 1].min() - low > 0.3 * (high - low), "room to fall"


def test_a_released_block_falls_by_how_far_its_centre_sinks() -> None:
    made = make_trajectory(num_frames=3, num_nodes=4)
    up = np.eye(made.metadata.dim)[-1]

    def moved(*heights: float) -> Trajectory:
        return replace(made, pos=(made.pos[:1] + np.array(heights)[:, None, None] * up).astype(made.pos.dtype))

    assert particles.fall(moved(0.0, -0.2, -0.5)) == pytest.approx(0.5, rel=1e-5)
    assert bodies.rise(moved(0.0, 0.3, -0.1)) == pytest.approx(0.3 / made.metadata.spacing, rel=1e-5)


@pytest.mark.parametrize("scene", ["bowl", "dam_break"])
def test_liquid_fills_its_vessel_from_below(scene: str) -> None:
    spec = dataset("data=fluid", "size=tiny", f"scene={scene}")
    pool, dam = scenes.pool(spec, 0.1, one_side=False), scenes.pool(spec, 0.1, one_side=True)
    middle = scenes.middle(spec)[0]
    for state in (pool, dam):
        assert sound(spec, state)
    assert dam.pos[:, 0].max() < middle + 0.25 * spec.scene.spacing < pool.pos[:, 0].max()
    assert pool.pos[:, -1].max() < dam.pos[:, -1].max()  # as much liquid on one side stands higher
    assert abs(pool.pos[:, 0].mean() - middle) < 0.2 * spec.scene.spacing  # the highest layer is incomplete and random


@pytest.mark.parametrize("name", ["sand", "snow", "elastomer", "fluid", "fem"])
def test_a_thrown_body_is_far_from_all_walls(name: str) -> None:
    spec = dataset(f"data={name}", "size=small")
    state = scenes.thrown(spec, 1.0 if name == "fluid" else 30.0)
    assert sound(spec, state)
    way = 0.1 * np.linalg.norm(state.vel[0])
    assert signed_distance(state.boundary.shapes, state.pos).min() > way + spec.scene.connectivity_radius
