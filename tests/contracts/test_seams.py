"""Seams of periodic domains: positions on a bound or within rounding of it, walls that end there, and obstacles that reach across."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from gpe_pl.data.importers import ImportSettings, import_dataset
from gpe_pl.data.validate import validate
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import Repeated, repeated
from gpe_pl.geometry.shape_values import moved, shape_from_dict, shape_to_dict
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, domain_walls, outward_normal
from gpe_pl.graphs.neighbors import radius_pairs
from gpe_pl.rollout.containment import contain
from gpe_pl.rollout.loop import fraction_outside
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory

SPACING = 0.05
CHANNEL = Periodicity(((0.1, 0.9), (0.0, 0.4)), (True, False))


@st.composite
def places(draw: Any, dtype: type) -> tuple[Periodicity, np.ndarray]:
    """Return the bounds, positions up to three floating-point numbers beside them, whole periods away, and random positions, in this precision."""
    low = draw(st.sampled_from([0.0, 0.1, -0.5, 1 / 3]) | st.floats(-1e3, 1e3))
    length = draw(st.sampled_from([1.0, 0.8, 0.7, 1.1]) | st.floats(0.01, 100)) * max(1.0, 0.01 * abs(low))
    space = Periodicity(((low, low + length), (0.0, 1.0)), (True, False))
    low, high = space.bounds[0]
    values = [low, high, *(low + k * length for k in (-3, -1, 2, 5)), low + draw(st.floats(-2.0, 3.0)) * length]
    x: np.ndarray = np.array(values, dtype)
    for _ in range(3):
        x = np.concatenate([x, np.nextafter(x, dtype(np.inf)), np.nextafter(x, dtype(-np.inf))])
    return space, np.stack([x, np.full_like(x, 0.5)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_wrapped_is_inside_and_the_same_place(dtype: Any, backend: str) -> None:
    @given(places(dtype))
    def check(drawn: tuple[Periodicity, np.ndarray]) -> None:
        space, pos = drawn
        low, high = (dtype(bound) for bound in space.bounds[0])
        array = torch.from_numpy if backend == "torch" else np.asarray
        inside = np.asarray(space.wrapped(array(pos)))
        assert inside.dtype == dtype
        assert ((inside[:, 0] >= low) & (inside[:, 0] < high)).all()
        np.testing.assert_array_equal(inside[:, 1], pos[:, 1])
        np.testing.assert_array_equal(np.asarray(space.wrapped(array(inside))), inside)
        was_inside = (pos[:, 0] >= low) & (pos[:, 0] < high)
        np.testing.assert_array_equal(inside[was_inside], pos[was_inside])
        rounding = 8 * np.finfo(dtype).eps * (np.abs(pos[:, 0]) + abs(low) + abs(high))
        apart = np.abs(space.shortest(inside.astype(np.float64) - pos))[:, 0]
        assert (apart <= rounding).all()
        corner = np.asarray(space.from_corner(array(pos)))[:, 0]
        assert ((corner >= 0) & (corner < space.period[0])).all()
        radius_pairs(pos.astype(np.float64), 0.1 * space.period[0], space)

    check()


@given(places(np.float64))
def test_a_node_on_a_bound_has_its_neighbours_on_both_sides(drawn: tuple[Periodicity, np.ndarray]) -> None:
    space, _ = drawn
    low, high = space.bounds[0]
    step = 0.05 * (high - low)
    for at in (low, high, np.nextafter(low, -np.inf), np.nextafter(high, np.inf)):
        pairs = radius_pairs(np.array([[at, 0.5], [low + step, 0.5], [high - step, 0.5]]), 1.5 * step, space)
        assert {frozenset(pair) for pair in pairs.T.tolist()} == {frozenset({0, 1}), frozenset({0, 2})}


# --- boundary nodes --------------------------------------------------------------------------------------------------------------------


def fluid(boundary: Boundary, space: Periodicity = CHANNEL, num_frames: int = 5) -> Trajectory:
    rng = np.random.default_rng(0)
    low, high = np.array(space.bounds).T
    pos = rng.uniform(low + 0.01, high - 0.01, (30, len(low))) + 1e-3 * np.arange(num_frames)[:, None, None]
    return Trajectory.from_numpy(
        pos,
        0.01,
        "fluid",
        {"fluid": 1e-3},
        bounds=space.bounds,
        periodic=space.periodic,
        spacing=SPACING,
        connectivity_radius=0.12,
        boundary=boundary,
    )


@pytest.mark.parametrize("knows", [True, False])
def test_walls_along_a_periodic_axis_have_each_node_once(knows: bool) -> None:
    walls = domain_walls(CHANNEL.bounds, 0.5)[2:]
    made = Boundary.sample(walls, SPACING, 2, CHANNEL) if knows else Boundary.sample(walls, SPACING, 2)
    boundary = fluid(made).boundary
    assert len(boundary.pos) == 2 * 16
    for height in (0.0, 0.4):
        x = np.sort(boundary.pos[np.isclose(boundary.pos[:, 1], height), 0])
        np.testing.assert_allclose(x, 0.1 + SPACING * np.arange(16), atol=1e-12)


def test_where_two_periodic_axes_meet_there_is_one_node() -> None:
    space = Periodicity(((0.0, 1.0),) * 3, (True, True, False))
    boundary = Boundary.sample(domain_walls(space.bounds, 0.5)[4:], 0.25, 3, space)
    assert len(boundary.pos) == 2 * 4 * 4
    assert (boundary.pos[:, :2] < 1.0).all()


def test_corners_keep_the_nodes_of_both_walls() -> None:
    space = Periodicity(((0.0, 1.0),) * 3, (True, False, False))
    boundary = Boundary.sample(domain_walls(space.bounds, 0.5)[2:], 0.25, 3, space)
    corner = np.isclose(boundary.pos, [0.0, 0.0, 0.0]).all(axis=1)
    assert {tuple(n) for n in boundary.normal[corner]} == {(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)}


def test_a_lid_with_both_its_ends_is_closed_at_the_seam() -> None:
    x = np.linspace(0.1, 0.9, 17)
    way = np.stack([x + 0.3 * np.arange(5)[:, None], np.full((5, 17), 0.4)], axis=-1)
    boundary = fluid(Boundary.moving(way, np.tile([0.0, -1.0], (17, 1)), 0.01, periodicity=CHANNEL)).boundary
    assert boundary.motion is not None
    assert len(boundary.pos) == boundary.motion.pos.shape[1] == boundary.motion.normal.shape[1] == 16
    np.testing.assert_allclose(boundary.motion.vel, np.broadcast_to([30.0, 0.0], (5, 16, 2)), rtol=1e-9)


# --- signed distances --------------------------------------------------------------------------------------------------------------------


def grid(origin: np.ndarray) -> DistanceGrid:
    """Return a ball of radius 0.1 as a distance grid."""
    axes = 0.02 * np.arange(16)
    points = np.stack(np.meshgrid(*[axes] * len(origin), indexing="ij"), axis=-1)
    return DistanceGrid.from_values(tuple(origin.tolist()), 0.02, np.linalg.norm(points - 0.15, axis=-1) - 0.1, 0.3)


SHAPES: list[Shape] = [
    Sphere((0.86, 0.2), 0.12, 0.3),
    Box((0.8, 0.1), (1.0, 0.2), 0.3),
    Polygon(((0.8, 0.05), (1.05, 0.1), (0.95, 0.15), (0.9, 0.3)), 0.3),
    grid(np.array([0.75, 0.05])),
    Sphere((0.12, 0.3, 0.02), 0.1, 0.3),
    Box((0.0, 0.1, -0.1), (0.2, 0.3, 0.2), 0.3),
]


def domain(shape: Shape) -> Periodicity:
    dim = len(shape.sample(SPACING)[0][0])
    return CHANNEL if dim == 2 else Periodicity(((0.1, 0.9), (0.0, 0.4), (0.0, 0.6)), (True, False, True))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.kind}{len(shape.sample(SPACING)[0][0])}")
def test_an_obstacle_across_a_seam_has_its_other_part_on_the_other_side(shape: Shape) -> None:
    space, rng = domain(shape), np.random.default_rng(0)
    (here,) = repeated((shape,), space)
    low, high = np.array(space.bounds).T
    points = rng.uniform(low, high, (4000, len(low)))
    steps = [(-1, 0, 1) if repeats else (0,) for repeats in space.periodic]
    images = np.array(list(itertools.product(*steps))) * space.period
    every = np.stack([shape.signed_distance(points + image) for image in images])
    expected = every.min(axis=0)
    assert ((every[~(images != 0).any(axis=1)][0] > 0) & (expected < 0)).any(), "an inside that only images have"
    inside_grid = np.abs(expected) < 0.04 if isinstance(shape, DistanceGrid) else np.full(len(points), True)
    np.testing.assert_allclose(here.signed_distance(points)[inside_grid], expected[inside_grid], atol=1e-12)
    single = torch.from_numpy(points.astype(np.float32))
    np.testing.assert_allclose(here.signed_distance(single)[inside_grid], expected[inside_grid], atol=1e-5)
    for shift in images:
        np.testing.assert_allclose(here.signed_distance(points + shift), here.signed_distance(points), atol=1e-12)

    boundary = Boundary.sample((shape,), 0.03, len(low), space)
    np.testing.assert_array_equal(space.wrapped(boundary.pos), boundary.pos)
    np.testing.assert_allclose(here.signed_distance(boundary.pos), 0.0, atol=2e-3 if isinstance(shape, DistanceGrid) else 1e-9)
    along = here.signed_distance(boundary.pos + 1e-4 * boundary.normal)
    assert (along > 0).all()

    assert shape_from_dict(json.loads(json.dumps(shape_to_dict(here)))) == here
    by = np.arange(1.0, 1.0 + len(low))
    np.testing.assert_allclose(moved(here, by).signed_distance(points + by), here.signed_distance(points), atol=1e-9)


@pytest.mark.parametrize("center", [(0.9, 0.2), (0.5, 0.2), (0.98, 0.2)])
def test_a_grid_over_the_domain_has_the_distances_of_its_solid(center: tuple[float, float]) -> None:
    """The centre of the grid is not that of the solid. The solid may end beyond the last nodes, or be stored at both seams."""
    space = Periodicity(((0.0, 1.0), (0.0, 0.4)), (True, False))
    ball, axes = Sphere(center, 0.08, 0.3), [-0.01 + 0.01 * np.arange(103), -0.01 + 0.01 * np.arange(43)]
    (exact,), nodes = repeated((ball,), space), np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = np.random.default_rng(0).uniform((0.0, 0.0), (1.0, 0.4), (4000, 2))
    for solid in (ball, exact):
        (grid,) = repeated((DistanceGrid.from_values((-0.01, -0.01), 0.01, solid.signed_distance(nodes), 0.3),), space)
        found, true = grid.signed_distance(points), exact.signed_distance(points)
        assert (found > true - 2e-3).all(), "nothing is solid that is free"
        if center[0] < 0.98 or solid is exact:
            assert (found < true + 2e-3 + 0.05 * np.maximum(true, 0.0)).all()
        place = torch.tensor(points[:50], requires_grad=True)
        grid.signed_distance(place).sum().backward()
        assert place.grad is not None and torch.isfinite(place.grad).all()


def test_a_container_across_a_seam_is_open_on_both_sides() -> None:
    (bowl,) = repeated((Bowl((0.15, 0.2), 0.15, 0.3),), CHANNEL)
    assert bowl.signed_distance(np.array([[0.2, 0.2], [0.85, 0.2]])).min() > 0
    assert bowl.signed_distance(np.array([[0.5, 0.2]])).max() < 0


def test_a_plate_around_the_domain_has_no_seam() -> None:
    plate = Box((0.1, 0.1), (0.9, 0.2), 0.3)
    boundary = Boundary.sample((plate,), SPACING, 2, CHANNEL)
    (here,) = boundary.shapes
    np.testing.assert_allclose(here.signed_distance(np.array([[0.1, 0.18], [0.9, 0.18], [0.5, 0.18]])), -0.02, atol=1e-12)
    np.testing.assert_allclose(outward_normal(here, np.array([[0.1, 0.18]]), 1e-4), [[0.0, 1.0]], atol=1e-9)
    assert set(np.round(boundary.pos[:, 1], 9)) == {0.1, 0.2}


FLOORS = {
    "even": ((0.1, -0.1), (0.9, -0.1), (0.9, 0.1), (0.5, 0.2), (0.1, 0.1)),
    "with a step at the seam": ((0.1, -0.1), (0.9, -0.15), (0.9, 0.05), (0.6, 0.2), (0.1, 0.1)),
    "of other corners first": ((0.9, 0.1), (0.5, 0.2), (0.1, 0.1), (0.1, -0.1), (0.9, -0.1)),
}


@pytest.mark.parametrize("knows", [True, False])
@pytest.mark.parametrize("corners", FLOORS.values(), ids=FLOORS)
def test_a_polygon_from_seam_to_seam_has_no_face_there(corners: Any, knows: bool) -> None:
    """Its depth at the seam is that of its adjacent image, and no boundary node lies inside. If its ends differ, a step remains."""
    floor = Polygon(corners, 0.3)
    (here,) = repeated((floor,), CHANNEL)
    long = [Polygon(tuple((x + shift, y) for x, y in corners), 0.3) for shift in (-0.8, 0.0, 0.8)]
    rng = np.random.default_rng(0)
    points = rng.uniform([0.1, -0.05], [0.9, 0.3], (500, 2))
    inside = np.min([image.signed_distance(points) for image in long], axis=0) < 0
    distance = here.signed_distance(points)
    np.testing.assert_array_equal(distance < 0, inside)
    # the nearest place on the surface: by brute force, of the outline that no image covers
    outline = np.concatenate([image.sample(5e-4)[0] for image in long])
    outline = outline[np.min([image.signed_distance(outline) for image in long], axis=0) > -1e-9]
    on_seam = np.abs((outline[:, 0] - 0.1) / 0.8 - np.round((outline[:, 0] - 0.1) / 0.8)) < 1e-9
    ends = [sorted(y for x, y in corners if x == end) for end in (0.1, 0.9)]
    common = max(ends[0][0], ends[1][0]), min(ends[0][1], ends[1][1])
    outline = outline[~(on_seam & (outline[:, 1] > common[0] + 1e-9) & (outline[:, 1] < common[1] - 1e-9))]
    nearest = cKDTree(outline).query(points)[0]
    np.testing.assert_allclose(np.abs(distance), nearest, atol=5e-4)
    np.testing.assert_allclose(here.signed_distance(points + np.array([0.8, 0.0])), distance, atol=1e-12)

    made = Boundary.sample((floor,), 0.05, 2, CHANNEL) if knows else Boundary.sample((floor,), 0.05, 2).inside(CHANNEL)
    np.testing.assert_allclose(here.signed_distance(made.pos), 0.0, atol=1e-9)
    in_front = here.signed_distance(made.pos + 1e-4 * made.normal)
    assert (in_front[~np.isclose(made.pos[:, 0], 0.1)] > 0.99e-4).all() and (in_front > -1e-4).all()
    seam = np.isclose(made.pos[:, 0], 0.1) & (np.abs(made.normal[:, 0]) > 0.99)
    assert seam.any() == (ends[0] != ends[1])


def test_what_enters_the_part_behind_a_seam_is_put_back_and_counted() -> None:
    sphere = Sphere((0.86, 0.2), 0.12, 0.3)
    trajectory = fluid(Boundary.sample((sphere,), 0.03, 2))
    assert [type(s) for s in trajectory.boundary.shapes] == [Repeated]
    state = trajectory.state(0)
    pos = state.pos.copy()
    pos[:] = [0.5, 0.05]
    pos[0] = [0.13, 0.2]  # 0.07 m behind the middle, across the seam
    vel = np.zeros_like(pos)
    state = State(**{**vars(state), "pos": pos, "vel": vel})
    after, corrected = contain(state, 0.01)
    assert corrected.tolist() == [True] + [False] * (len(pos) - 1)
    np.testing.assert_allclose(after.pos[0], [0.18, 0.2], atol=1e-4)
    assert fraction_outside(Trajectory(**{**vars(trajectory), "pos": np.broadcast_to(pos, (3, *pos.shape))})) == 1 / len(pos)


def test_what_is_put_back_across_a_seam_stays_inside() -> None:
    sphere = Sphere((0.86, 0.2), 0.05, 0.3)
    state = fluid(Boundary.sample((sphere,), 0.03, 2)).state(0)
    pos = np.tile([0.5, 0.05], (len(state.pos), 1))
    pos[0] = [0.895, 0.2]  # the surface is at 0.91, beyond the upper bound
    after, _ = contain(State(**{**vars(state), "pos": pos, "vel": np.zeros_like(pos)}), 0.01)
    np.testing.assert_allclose(after.pos[0], [0.11, 0.2], atol=1e-4)
    np.testing.assert_allclose(after.vel[0], [1.5, 0.0], atol=0.02)


# --- files -------------------------------------------------------------------------------------------------------------------------------


def test_a_lid_whose_motion_does_not_know_the_seam_is_refused() -> None:
    way = np.stack([0.1 + (np.arange(16) * 0.05 + 0.02 * np.arange(5)[:, None]) % 0.8, np.full((5, 16), 0.4)], axis=-1)
    with pytest.raises(
        ArrayError, match=r"boundary_node 15 moves by 0\.78 m along x after frame \d, more than half the period 0\.8 m; pass periodicity="
    ):
        fluid(Boundary.moving(way, np.tile([0.0, -1.0], (16, 1)), 0.01))
    fluid(Boundary.moving(way, np.tile([0.0, -1.0], (16, 1)), 0.01, periodicity=CHANNEL))


@pytest.mark.slow
@pytest.mark.parametrize("normals", [True, False])
def test_a_lid_in_a_file_slides_on_across_the_seam_of_that_file(tmp_path: Path, normals: bool) -> None:
    """The file gives the periodic axes, not the command line."""
    num_frames, dt, x = 12, 0.01, np.arange(0.025, 1.0, SPACING)
    time = dt * np.arange(num_frames)[:, None]
    lid = np.stack([(x + 1.0 * time) % 1.0, np.full((num_frames, len(x)), 0.5)], axis=-1)
    block = np.stack(np.meshgrid(x, np.arange(0.05, 0.46, SPACING)), axis=-1).reshape(-1, 2)
    (tmp_path / "raw" / "train").mkdir(parents=True)
    for k in range(3):
        wave = 0.004 * np.stack([np.sin(30 * time + 6 * block[:, 0] + k), np.cos(25 * time + 6 * block[:, 0])], axis=-1)
        given: dict[str, Any] = {"boundary_normal": np.tile([0.0, -1.0], (len(x), 1))} if normals else {}
        np.savez(
            tmp_path / "raw" / "train" / f"{k}.npz", pos=(block + wave) % [1.0, 9.0], frame_dt=dt, materials="fluid", params_fluid=1e-2,
            bounds=[[0.0, 1.0], [0.0, 0.6]], periodic=[True, False], boundary_pos=lid, **given,
        )  # fmt: skip
    import_dataset(tmp_path / "data", ImportSettings("arrays", str(tmp_path / "raw"), "lid"))
    folder = tmp_path / "data" / "lid" / "imported"
    trajectory = next(iter_trajectories(folder, "train"))
    motion = trajectory.boundary.motion
    assert motion is not None
    np.testing.assert_allclose(motion.vel, np.broadcast_to([1.0, 0.0], motion.vel.shape), atol=1e-4)
    assert (motion.normal[..., 1] < -0.9).all()
    assert (motion.pos[..., 0] < 1.0).all()
    assert not validate([folder]).violations
