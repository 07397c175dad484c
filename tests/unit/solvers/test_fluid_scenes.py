"""Scenes of liquid: exact counts, free space around every particle, reproducibility, and errors with a reason."""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.spatial import cKDTree

from gpe_pl.geometry.shape_values import shape_from_dict, shape_to_dict
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, domain_walls, signed_distance
from gpe_pl.geometry.terrain_files import TerrainError
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers.fluid_scenes import CLEARANCE, FluidScene, TerrainOptions
from gpe_pl.trajectory.state import State

EARTH_2D = (0.0, -9.81)


def box(*size: float) -> tuple[tuple[float, float], ...]:
    return tuple((0.0, s) for s in size)


SCENES = {
    "bowl 2D": FluidScene("bowl", box(1.0, 1.0), 1 / 24, 300, gravity=EARTH_2D),
    "bowl 3D": FluidScene("bowl", box(1.0, 1.0, 1.0), 1 / 10, 600),
    "dam break 2D": FluidScene("dam_break", box(1.0, 1.0), 1 / 20, 300, gravity=EARTH_2D, max_obstacles=2),
    "dam break 3D": FluidScene("dam_break", box(1.0, 0.4, 0.8), 1 / 15, 500, max_obstacles=2),
    "canyon": FluidScene("canyon", box(2.0, 1.0, 1.0), 1 / 12, 400),
}


@functools.cache
def sampled(scene: FluidScene, viscosity: float, seed: int) -> State:
    return scene.sample({"fluid": viscosity}, seed)


each_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())


@each_scene
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_state_is_complete(scene: FluidScene, seed: int) -> None:
    state = sampled(scene, 0.05, seed)
    assert state.pos.shape == state.vel.shape == (scene.num_particles, scene.dim)
    assert state.pos.dtype == state.vel.dtype == np.float64
    assert state.num_nodes == scene.max_nodes
    assert np.all(state.node_type == node_code("fluid"))
    np.testing.assert_allclose(state.mass, 1000.0 * scene.spacing**scene.dim)
    np.testing.assert_array_equal(state.material_params, np.full((scene.num_particles, 1), 0.05))
    np.testing.assert_array_equal(state.gravity, scene.gravity)
    assert np.all(state.boundary.friction == STICKY)


@pytest.mark.slow
@each_scene
@pytest.mark.parametrize("seed", range(3))
def test_particles_are_free_and_evenly_spread(scene: FluidScene, seed: int) -> None:
    state = sampled(scene, 0.05, seed)
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0.99 * CLEARANCE * scene.spacing
    gaps = cKDTree(state.pos).query(state.pos, k=2)[0][:, 1] / scene.spacing
    assert gaps.min() > 0.45
    assert gaps.max() < 1.6
    # a cell inside the liquid holds particles_per_cell ** dim of them
    around = [len(n) for n in cKDTree(state.pos).query_ball_point(state.pos, 2 * scene.spacing)]
    volume = {2: 4 * math.pi, 3: 32 / 3 * math.pi}[scene.dim]
    assert np.quantile(around, 0.9) == pytest.approx(volume, rel=0.2)


@each_scene
def test_boundary_nodes_lie_on_their_shapes(scene: FluidScene) -> None:
    boundary = sampled(scene, 0.05, 0).boundary
    assert len(boundary.pos) > 50
    distance = np.min([np.abs(shape.signed_distance(boundary.pos)) for shape in boundary.shapes], axis=0)
    assert distance.max() < 0.1 * scene.spacing
    assert signed_distance(boundary.shapes, boundary.pos).min() > -0.01 * scene.spacing
    for shape in boundary.shapes:
        assert shape_from_dict(shape_to_dict(shape)) == shape


@pytest.mark.slow
@each_scene
def test_scenes_are_reproducible_and_differ(scene: FluidScene) -> None:
    first, again, other = sampled(scene, 0.05, 1), scene.sample({"fluid": 0.05}, 1), sampled(scene, 0.05, 2)
    for name in ("pos", "vel", "mass"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    np.testing.assert_array_equal(first.boundary.pos, again.boundary.pos)
    assert first.boundary.shapes == again.boundary.shapes
    assert not np.array_equal(first.pos, other.pos)
    np.testing.assert_array_equal(scene.sample({"fluid": 1.0}, 1).pos, first.pos)  # the same scene for every viscosity


@each_scene
def test_order_does_not_tell_the_place(scene: FluidScene) -> None:
    state = sampled(scene, 0.05, 2)
    for axis in range(scene.dim):
        rank = np.argsort(np.argsort(state.pos[:, axis]))
        assert abs(np.corrcoef(rank, np.arange(len(rank)))[0, 1]) < 0.2


def test_attributes_for_metadata() -> None:
    scene = FluidScene("bowl", box(1.0, 1.0, 1.0), 0.1, 10, particles_per_cell=2, connectivity_cells=1.5)
    assert scene.spacing == pytest.approx(0.05)
    assert scene.connectivity_radius == pytest.approx(0.15)
    assert scene.materials == ("fluid",)
    assert scene.dim == 3
    assert scene.gravity == (0.0, 0.0, -9.81)


def test_values_of_a_file_give_the_same_scene() -> None:
    """Hydra passes values as lists, integers and nested dictionaries."""
    values = dataclasses.asdict(SCENES["canyon"])  # type: ignore[call-overload]
    values["bounds"] = [[0, 2], [0, 1], [0, 1]]
    values["terrain_options"] = {"fit": "contain", "up": "z", "solid": "auto", "relief": None}
    again = TypeAdapter(FluidScene).validate_python(values)
    assert again == SCENES["canyon"]
    assert hash(again) == hash(SCENES["canyon"])


# --- bowl ---------------------------------------------------------------------------------------------------------------------------------


def test_bowl_of_the_paper() -> None:
    """About 4,000 liquid particles and 3,000 boundary nodes."""
    scene = FluidScene("bowl", box(1.0, 1.0, 1.0), 1 / 18, 4000)
    for seed in range(3):
        state = scene.sample({"fluid": 0.1}, seed)
        assert state.num_nodes == 4000
        assert 2800 < len(state.boundary.pos) < 3300
        bowl = state.boundary.shapes[-1]
        assert isinstance(bowl, Bowl)
        np.testing.assert_allclose(np.linalg.norm(state.boundary.pos - 0.5, axis=-1), bowl.radius, atol=1e-12)
        np.testing.assert_allclose(state.boundary.normal, (0.5 - state.boundary.pos) / bowl.radius, atol=1e-12)
        assert bowl.radius == pytest.approx(0.5 - 1 / 18)
        assert set(state.boundary.shapes[:-1]) == set(domain_walls(scene.bounds, STICKY))


def bodies_of(state: State) -> list[np.ndarray]:
    """Return the indices of particles that share a velocity."""
    _, label = np.unique(state.vel, axis=0, return_inverse=True)
    return [np.flatnonzero(label.ravel() == k) for k in range(label.max() + 1)]


@pytest.mark.parametrize(("name", "cells"), [("bowl 2D", 24), ("bowl 3D", 16)])
def test_bodies_vary_in_number_place_shape_and_velocity(name: str, cells: int) -> None:
    scene = dataclasses.replace(SCENES[name], max_bodies=3, max_speed=2.0, grid_spacing=1 / cells)  # type: ignore[type-var]
    states = [scene.sample({"fluid": 0.05}, seed) for seed in range(12)]
    assert {len(bodies_of(s)) for s in states} == {1, 2, 3}
    for state in states:
        bodies = bodies_of(state)
        assert np.all(np.abs(state.vel) <= 2.0)
        assert np.all(state.vel[:, -1] <= 0.5)
        for k, body in enumerate(bodies):
            for other in bodies[:k]:
                assert cKDTree(state.pos[body]).query(state.pos[other])[0].min() > scene.grid_spacing
    roundness = [
        np.linalg.norm(s.pos[b] - s.pos[b].mean(0), axis=-1).max() / len(b) ** (1 / scene.dim) for s in states for b in bodies_of(s)
    ]
    assert max(roundness) > 1.2 * min(roundness)  # boxes reach farther out than balls
    centers = np.array([s.pos.mean(0) for s in states])
    assert np.all(centers.std(0) > 0.01)


# --- dam break ----------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dam break 2D", "dam break 3D"])
def test_column_stands_on_the_floor_at_a_side(name: str) -> None:
    scene, aspects, sides = SCENES[name], [], set()
    length = scene.bounds[0][1]
    for seed in range(12):
        state = sampled(scene, 0.05, seed)
        low, high = state.pos.min(0), state.pos.max(0)
        assert low[-1] < scene.spacing
        assert min(low[0], length - high[0]) < scene.spacing
        sides.add(bool(low[0] < scene.spacing))
        size = high - low + 0.6 * scene.spacing
        if scene.dim == 3:
            assert low[1] < scene.spacing
            assert high[1] > scene.bounds[1][1] - 1.5 * scene.spacing
        assert np.prod(size) == pytest.approx(scene.num_particles * scene.spacing**scene.dim, rel=0.2)
        aspects.append(size[-1] / size[0])
        assert np.all(state.vel == 0)
    assert sides == {True, False}
    assert min(aspects) > 0.5 * 0.8
    assert max(aspects) < 2.0 * 1.25
    assert max(aspects) > 1.5 * min(aspects)


@pytest.mark.parametrize("name", ["dam break 2D", "dam break 3D"])
def test_obstacles_stand_on_the_floor_clear_of_the_liquid(name: str) -> None:
    scene = SCENES[name]
    gap, found = 2 * scene.grid_spacing, set()
    for seed in range(12):
        state = sampled(scene, 0.05, seed)
        boxes = [shape for shape in state.boundary.shapes if isinstance(shape, Box)]
        found.add(len(boxes))
        for obstacle in boxes:
            assert obstacle.signed_distance(state.pos).min() > 0.99 * gap
            assert obstacle.low[-1] < 0 < obstacle.high[-1]
            assert all(lo >= b[0] + 0.99 * gap for lo, b in zip(obstacle.low[:-1], scene.bounds, strict=False))
            assert all(hi <= b[1] - 0.99 * gap for hi, b in zip(obstacle.high, scene.bounds, strict=True))
    assert max(found) >= 1
    assert max(found) <= 2


# --- canyon -------------------------------------------------------------------------------------------------------------------------------


def test_canyon_water_starts_above_the_fall_in_the_reservoir() -> None:
    for seed in range(3):
        state = sampled(SCENES["canyon"], 0.05, seed)
        rock = state.boundary.shapes[-1]
        assert isinstance(rock, DistanceGrid)
        assert state.pos[:, 0].min() < 0.1
        assert state.pos[:, 0].max() < 0.8
        assert state.pos[:, 2].min() > 0.35
        nodes = state.boundary.pos[np.abs(rock.signed_distance(state.boundary.pos)) < 1e-6]
        assert (nodes[:, 2] < 0.25).any()  # the pool
        # below the water is rock, not air
        lowest = state.pos[state.pos[:, 2] < state.pos[:, 2].min() + 0.2 / 12]
        assert np.all(rock.signed_distance(lowest - (0.0, 0.0, 1 / 6)) < 0)


@pytest.mark.slow
def test_canyon_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.linspace(0, 1, 30)
    heights = np.broadcast_to(1 - x, (20, 30)) + 0.8 * np.abs(np.linspace(-1, 1, 20))[:, None]
    np.save(tmp_path / "valley.npy", heights)
    monkeypatch.chdir(tmp_path)
    options = TerrainOptions(fit="stretch", relief=0.8)
    scene = dataclasses.replace(SCENES["canyon"], terrain="valley.npy", terrain_options=options, num_particles=150)  # type: ignore[type-var]
    state = scene.sample({"fluid": 0.05}, 0)
    assert state.num_nodes == 150
    assert state.pos[:, 0].max() < 2 / 3 + 1e-9
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0
    region = ((1.0, 1.8), (0.2, 0.8), (0.0, 0.9))
    lower = dataclasses.replace(scene, reservoir=region).sample({"fluid": 0.05}, 0)  # type: ignore[type-var]
    assert np.all((lower.pos > np.array(region)[:, 0]) & (lower.pos < np.array(region)[:, 1]))
    assert lower.boundary.shapes == state.boundary.shapes
    np.save(tmp_path / "valley.npy", np.concatenate([heights, heights]))  # another file under the same name is read anew
    assert scene.sample({"fluid": 0.05}, 0).boundary.shapes != state.boundary.shapes
    with pytest.raises(ValueError, match="missing.obj: no such file"):
        dataclasses.replace(scene, terrain="missing.obj").sample({"fluid": 0.05}, 0)  # type: ignore[type-var]


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "valley.obj").write_text("v 0 0 0")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    scene = dataclasses.replace(SCENES["canyon"], terrain=str(tmp_path / "valley.obj"))  # type: ignore[type-var]
    with pytest.raises(TerrainError, match=r"valley\.obj: needs the package trimesh.*gpe_pl\[terrain\]"):
        scene.sample({"fluid": 0.05}, 0)


def test_canyon_from_a_mesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    x, y = np.meshgrid(np.linspace(0, 40, 41), np.linspace(0, 20, 21), indexing="ij")
    z = 12 - 0.25 * x + 0.06 * (y - 10) ** 2
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    trimesh.Trimesh(np.stack([x, y, z], -1).reshape(-1, 3), faces, process=False).export(tmp_path / "valley.ply")
    scene = dataclasses.replace(SCENES["canyon"], terrain=str(tmp_path / "valley.ply"), num_particles=300)  # type: ignore[type-var]
    state = scene.sample({"fluid": 0.05}, 3)
    assert signed_distance(state.boundary.shapes, state.pos).min() > 0
    deepest = state.pos[np.argmin(state.pos[:, 2])]
    assert abs(deepest[1] - 0.5) < 0.25  # in the valley's bottom


# --- wrong input --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene": "pond"}, "bowl"),
        ({"bounds": box(1.0)}, "2 or 3 axes"),
        ({"gravity": EARTH_2D}, "as many components"),
        ({"gravity": (0.0, 0.0, float("nan"))}, "finite"),
        ({"bounds": ((0.0, 1.0), (1.0, 1.0), (0.0, 1.0))}, "low < high"),
        ({"bounds": ((0.0, 1.0), (0.0, float("inf")), (0.0, 1.0))}, "low < high"),
        ({"bounds": box(1.0, 1.0), "gravity": EARTH_2D, "scene": "canyon"}, "needs bounds of 3 axes"),
        ({"terrain": "a.obj"}, "belong to scene='canyon'"),
        ({"scene": "canyon", "reservoir": box(1.0, 1.0)}, "reservoir"),
        ({"column_aspect": (2.0, 1.0)}, "column_aspect"),
        ({"grid_spacing": 0.3}, "at least 4 cells"),
        ({"grid_spacing": 0.0}, "grid_spacing"),
        ({"num_particles": 0}, "num_particles"),
        ({"friction": -1.0}, "friction"),
        ({"terrain_options": {"fit": "squeeze"}}, "fit"),
        ({"terrian": "a.obj"}, "terrian"),
    ],
)
def test_wrong_configurations_are_refused(change: dict[str, Any], message: str) -> None:
    sound: dict[str, Any] = {"scene": "bowl", "bounds": box(1.0, 1.0, 1.0), "grid_spacing": 0.1, "num_particles": 50}
    FluidScene(**sound)
    with pytest.raises((ValidationError, ValueError), match=message):
        FluidScene(**(sound | change))


@pytest.mark.parametrize(
    ("name", "number", "message"),
    [
        ("bowl 3D", 20_000, "no room for 20000 particles .* bowl of radius"),
        ("dam break 2D", 1500, "no room for a column of 1500"),
        ("dam break 3D", 100_000, "no room for a column|do not fit"),
        ("canyon", 20_000, "do not fit into the reservoir .* at most"),
    ],
)
def test_too_much_liquid_is_refused(name: str, number: int, message: str) -> None:
    scene = dataclasses.replace(SCENES[name], num_particles=number)  # type: ignore[type-var]
    with pytest.raises(ValueError, match=message):
        scene.sample({"fluid": 0.05}, 0)
