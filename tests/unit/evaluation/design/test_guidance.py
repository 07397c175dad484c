"""The pose of an obstacle: gradients through rollouts equal finite differences, poses stay within their limits, and impossible designs are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.evaluation.design.guidance import Guidance
from gpe_pl.evaluation.design.pose import Obstacle, PoseError, movable
from gpe_pl.evaluation.identification.search import SearchSettings, search
from gpe_pl.geometry.meshing import triangulate
from gpe_pl.geometry.shapes import Box, Polygon, Sphere, Wall, domain_walls
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.boundary import Boundary
from tests import elastic, scenes
from tests.unit.training.test_unroll_gradients import Double, simulator_of, slow, unroll

WALLS = domain_walls(((0.0, 1.0),) * 2, 0.3)
RAMP = Polygon(((0.5, 0.2), (0.7, 0.25), (0.6, 0.4)), 0.3)
BOX = movable(Box((0.5, 0.2), (0.7, 0.3), 0.3))
DISC = Sphere((0.6, 0.3), 0.1, 0.3)


def boundary(shape: Any) -> Boundary:
    return Boundary.sample((*WALLS, shape), scenes.SPACING, 2)


@pytest.fixture(scope="module")
def guidance() -> Guidance:
    """Return a design with a small network in double precision, in whose scene nodes surround the obstacle."""
    builder = scenes.builder(("sand",))
    builder = Double(builder.config, builder.metadata)
    state = replace(slow(scenes.state(high=0.9).to_torch()), boundary=torch_boundary(boundary(RAMP)))
    simulator: LearnedSimulator = simulator_of(
        GPE, builder, [unroll(builder, state, 1).graph], hidden_channels=8, num_message_passing_steps=1
    )
    return Guidance(
        simulator.eval(),
        state,
        builder.metadata,
        Obstacle.of(len(WALLS), boundary(RAMP)),
        (0.02, 0.03, 0.1),
        np.array([0.2, 0.1]),
        3,
        100.0,
    )


def torch_boundary(own: Boundary) -> Boundary:
    return replace(scenes.state(), boundary=own).to_torch().boundary


@pytest.mark.parametrize("averages", [False, True])
def test_gradients_equal_finite_differences(guidance: Guidance, averages: bool) -> None:
    guidance = replace(guidance, simulator=guidance.simulator.configured(mirror_average=averages))
    z, step = np.array([0.6, 0.45, 0.7]), 1e-4
    value, gradient = guidance.misfit_and_gradient(z)
    assert value == pytest.approx(guidance.misfit(z), rel=1e-9)
    for k, direction in enumerate(np.eye(3)):
        difference = (guidance.misfit(z + step * direction) - guidance.misfit(z - step * direction)) / (2 * step)
        assert abs(difference) > 1e-7
        assert gradient[k] == pytest.approx(difference, rel=1e-2)


@pytest.mark.slow
def test_the_search_stays_within_the_limits_and_gains(guidance: Guidance) -> None:
    found = search(guidance, SearchSettings(method="gradient", num_scanned=3, max_evaluations=5))
    assert found.misfit < guidance.misfit([0.5, 0.5, 0.5])
    assert (np.abs(guidance.pose(found.z)) <= np.array(guidance.limits) * (1 + 1e-12)).all()
    only = replace(guidance, limits=(0.0, 0.03, 0.0))
    assert only.unknowns == ("shift y",)
    assert only.pose([1.0]).tolist() == [0.0, 0.03, 0.0]


def test_a_rollout_that_fails_counts_as_failed(guidance: Guidance) -> None:
    broken = replace(guidance, state=replace(guidance.state, vel=guidance.state.vel * 1e15))
    value, gradient = broken.misfit_and_gradient([0.5, 0.5, 0.5])
    assert value == pytest.approx(math.log(100.0)) and not gradient.any()


def test_a_model_without_gradients_of_walls_is_searched_without_them() -> None:
    """Models with the elastic law take walls from shapes."""
    simulator = elastic.simulator()
    state = replace(elastic.bodies(), boundary=torch_boundary(boundary(RAMP)))
    metadata = simulator.builder.metadata
    guidance = Guidance(
        simulator, state, metadata, Obstacle.of(len(WALLS), boundary(RAMP)), (0.02, 0.03, 0.1), np.array([0.2, 0.1]), 2, 100.0
    )
    value, gradient = guidance.misfit_and_gradient([0.5, 0.5, 0.5])
    assert value == pytest.approx(guidance.misfit([0.5, 0.5, 0.5]), rel=1e-6) and np.isnan(gradient).all()
    found = search(guidance, SearchSettings(method="gradient", num_scanned=3, max_evaluations=3, profile_evaluations=0))
    assert found.method == "derivative_free" and "the model has none here" in str(found.check)


@pytest.mark.parametrize("shape", [RAMP, BOX, DISC])
def test_nodes_and_shape_move_together(shape: Any) -> None:
    own = boundary(shape)
    obstacle, pose = Obstacle.of(len(WALLS), own), (0.05, -0.02, 0.0 if shape is DISC else 0.4)
    state = replace(scenes.state(), boundary=own).to_torch()
    moved = obstacle.moved(state, torch.tensor(pose, dtype=torch.float64)).boundary
    there = obstacle.moved_shape(pose)
    nodes, count = obstacle.nodes, len(there.sample(scenes.SPACING)[0])
    assert nodes.sum() == count > 3
    assert there in moved.shapes and shape not in moved.shapes
    np.testing.assert_allclose(there.signed_distance(moved.pos.numpy()[nodes]), 0, atol=1e-9)
    assert (there.signed_distance((moved.pos + 1e-3 * moved.normal).numpy()[nodes]) > 5e-4).all()
    np.testing.assert_array_equal(moved.pos.numpy()[~nodes], own.pos[~nodes])
    again = boundary(there)  # what the scene at this pose has
    np.testing.assert_allclose(moved.pos.numpy(), again.pos, atol=1e-9)
    np.testing.assert_allclose(moved.normal.numpy(), again.normal, atol=1e-6)


def test_poses_that_touch_something_are_refused() -> None:
    own, nothing = boundary(RAMP), np.empty((0, 2))
    obstacle = Obstacle.of(len(WALLS), own)
    obstacle.check_limits((0.05, 0.05, 0.2), own, nothing, scenes.SPACING)
    with pytest.raises(PoseError, match=r"shift, angle: at a shift of \(.*\) m and an angle of 0° the obstacle touches a wall"):
        obstacle.check_limits((0.0, 0.3, 0.0), own, nothing, scenes.SPACING)
    turned = obstacle.moved_shape((0.0, 0.0, 0.75))
    assert isinstance(turned, Polygon)
    beside = obstacle.centre + 0.95 * (np.array(turned.vertices[1:2]) - obstacle.centre)
    assert (RAMP.signed_distance(beside) > 0).all()
    with pytest.raises(PoseError, match="touches the material"):
        obstacle.check_limits((0.0, 0.0, 1.5), own, beside, scenes.SPACING)


def scenery(*shapes: Any) -> Boundary:
    return Boundary.sample((*WALLS, *shapes), scenes.SPACING, 2)


@pytest.mark.parametrize("width", [0.004, 0.05])
@pytest.mark.parametrize("is_moved", [False, True])
def test_narrow_neighbours_are_found(width: float, is_moved: bool) -> None:
    """A spike fits between the points of the moved surface."""
    spike = Polygon(((0.607, 0.312), (0.607 + width / 2, 0.4), (0.607 - width / 2, 0.4)), 0.3)
    own = scenery(*((spike, BOX) if is_moved else (BOX, spike)))
    obstacle = Obstacle.of(len(WALLS), own)
    obstacle.check_limits((0.01, 0.01, 0.0), own, np.empty((0, 2)), scenes.SPACING)
    for shift in (0.012 + scenes.SPACING, 0.012 + 1.15 * scenes.SPACING):
        with pytest.raises(PoseError, match="touches a wall or another obstacle"):
            obstacle.check_limits((0.0, shift, 0.0), own, np.empty((0, 2)), scenes.SPACING)


def test_crossing_plates_without_a_corner_in_the_other_touch() -> None:
    flat, upright = (movable(Box(low, high, 0.3)) for low, high in (((0.4, 0.5), (0.6, 0.501)), ((0.5003, 0.4), (0.5008, 0.6))))
    with pytest.raises(PoseError, match="touches a wall or another obstacle"):
        Obstacle.of(len(WALLS), scenery(flat, upright))
    with pytest.raises(PoseError, match="touches a wall or another obstacle"):
        Obstacle.of(len(WALLS), scenery(DISC, replace(DISC, radius=0.02)))


def test_one_of_two_equal_obstacles_moves() -> None:
    """It is known by its number, not by its shape."""
    own = replace(scenery(DISC), shapes=(*WALLS, DISC, DISC))
    with pytest.raises(PoseError, match="touches a wall or another obstacle"):
        Obstacle.of(len(WALLS), own)
    obstacle = Obstacle(DISC, len(WALLS) + 1, np.array(DISC.center), np.zeros(len(own.pos), bool))
    moved = obstacle.moved(replace(scenes.state(), boundary=own).to_torch(), torch.tensor((0.1, 0.0, 0.0), dtype=torch.float64))
    assert moved.boundary.shapes == (*WALLS, DISC, obstacle.moved_shape((0.1, 0.0, 0.0)))


def test_an_obstacle_turns_about_its_centroid() -> None:
    """Corners that change no outline change no centre."""
    corners = ((0.4, 0.4), (0.6, 0.4), (0.6, 0.5), (0.4, 0.5))
    more = Polygon((corners[0], (0.41, 0.4), (0.42, 0.4), (0.43, 0.4), *corners[1:]), 0.3)
    np.testing.assert_allclose(Obstacle.of(len(WALLS), scenery(more)).centre, (0.5, 0.45), atol=1e-12)
    triangle = Obstacle.of(len(WALLS), scenery(RAMP))
    np.testing.assert_allclose(triangle.centre, np.mean(RAMP.vertices, axis=0), atol=1e-12)


def test_a_plate_that_passes_into_a_mesh_between_its_nodes_is_refused() -> None:
    plate = movable(Box((0.4, 0.5), (0.6, 0.501), 0.3))
    own, (pos, cells) = (
        boundary(plate),
        triangulate([np.array([(0.7, 0.4), (0.9, 0.4), (0.9, 0.6), (0.7, 0.6)])], 0.04, np.random.default_rng(0)),
    )
    pos[:, 1] += 0.5005 - np.unique(pos[:, 1].round(2))[2] - 0.02  # no node is at the height of the plate
    Obstacle.of(len(WALLS), own).check_limits((0.05, 0.0, 0.0), own, pos, 0.04, cells)
    with pytest.raises(PoseError, match="touches the material"):
        Obstacle.of(len(WALLS), own).check_limits((0.15, 0.0, 0.0), own, pos, 0.04, cells)


def test_a_corner_that_touches_between_coarse_poses_is_found() -> None:
    """A square looks the same at all multiples of a right angle; its corners reach farther in between."""
    square = movable(Box((0.45, 0.01), (0.55, 0.11), 0.3))
    own, nothing = boundary(square), np.empty((0, 2))
    with pytest.raises(PoseError, match="the obstacle touches a wall"):
        Obstacle.of(len(WALLS), own).check_limits((0.0, 0.0, math.pi), own, nothing, 0.02)
    higher = movable(Box((0.45, 0.04), (0.55, 0.14), 0.3))
    Obstacle.of(len(WALLS), boundary(higher)).check_limits((0.0, 0.0, math.pi), boundary(higher), nothing, 0.02)


@pytest.mark.parametrize(
    "shape",
    [movable(Box((0.4, 0.0), (0.6, 0.2), 0.3)), Box((0.5, 0.2), (0.7, 0.3), 0.3), Wall((0.0, 1.0), 0.1, (0.0, 0.0), (1.0, 1.0), 0.3)],
)
def test_obstacles_that_cannot_be_moved_are_refused(shape: Any) -> None:
    with pytest.raises(PoseError, match="touches a wall or another obstacle|boxes as polygons can be moved"):
        Obstacle.of(len(WALLS), boundary(shape))
