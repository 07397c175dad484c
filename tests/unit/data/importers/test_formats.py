"""Every format is read back as written, with writers that follow only the description of the format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial import Delaunay

from gpe_pl.data.importers import ImportFailure, ImportSettings, Report, import_dataset
from gpe_pl.data.importers.source import natural
from gpe_pl.data.validate import validate
from gpe_pl.schema import STICKY, node_code
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.sources import DT, SPACING, motion

SPLITS = ("train", "valid", "test")
CANYON = Path(__file__).resolve().parents[5] / "shared" / "data" / "canyon.msgpack.zst"


def imported(tmp_path: Path, source: Path, format: Any, **settings: Any) -> tuple[Report, dict[str, list[Trajectory]]]:
    """Return the report, and the trajectories by split, of a conversion without violations."""
    report = import_dataset(tmp_path / "data", ImportSettings(format, str(source), "set", **settings))
    folder = tmp_path / "data" / "set" / "imported"
    assert not [str(v) for v in validate([folder]).violations]
    assert json.loads((folder / "report.json").read_text())["name"] == "set"
    assert {p.name for p in folder.iterdir()} == {"report.json", "report.md", "statistics.json", *report.splits}
    return report, {split: list(iter_trajectories(folder, split)) for split in report.splits}


def assert_stored(trajectory: Trajectory, pos: np.ndarray, dt: float = DT) -> None:
    np.testing.assert_array_equal(trajectory.pos, pos)
    assert trajectory.metadata.frame_dt == pytest.approx(dt)
    np.testing.assert_allclose(trajectory.vel[1:], np.diff(pos.astype(np.float64), axis=0) / dt, rtol=1e-4, atol=1e-4)


# --- DeepMind and its successor ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def particles() -> list[tuple[np.ndarray, np.ndarray]]:
    """Write three scenes with sand, water, goop and boundary nodes at rest; the second lacks goop."""
    scenes = []
    for seed in range(3):
        pos, types = motion(seed=seed), np.array([6] * 10 + [5] * 5 + [3] * 2 + [6 if seed == 1 else 7] * 3)
        pos[:, types == 3] = pos[0, types == 3]
        scenes.append((pos, types))
    return scenes


def check_particles(report: Report, stored: dict[str, list[Trajectory]], scenes: list[tuple[np.ndarray, np.ndarray]]) -> None:
    assert list(stored) == ["train", "val", "test"]
    for (trajectory,), (pos, types) in zip(stored.values(), scenes, strict=True):
        moving = types != 3
        assert_stored(trajectory, pos[:, moving])
        codes = {5: node_code("fluid"), 6: node_code("sand"), 7: node_code("snow")}
        assert trajectory.node_type.tolist() == [codes[t] for t in types[moving]]
        m = trajectory.metadata
        assert m.materials == ("sand", "snow", "fluid")
        assert m.connectivity_radius == 0.15
        assert m.bounds == ((0.0, 1.0), (0.0, 1.0))
        assert m.periodic == (False, False)
        np.testing.assert_array_equal(trajectory.boundary.pos[:2], pos[0, ~moving])
        assert len(trajectory.boundary.shapes) == 4  # walls
        assert np.isnan(trajectory.material_params).sum(axis=1).tolist() == [2] * moving.sum()
    assert report.splits["train"].trajectories == 1
    assert report.splits["train"].frames == [10, 10]
    assert report.splits["train"].nodes == [18, 18]
    assert report.neighbours["mean"] > 1
    assert set(report.materials) == {"sand", "snow", "fluid"}
    assert any("gravity is not in the source" in note for note in report.notes)


def test_gns_records(tmp_path: Path, particles: list[tuple[np.ndarray, np.ndarray]]) -> None:
    sources.gns_metadata(tmp_path / "raw", particles[0][0])
    for name, scene in zip(SPLITS, particles, strict=True):
        sources.gns_tfrecord(tmp_path / "raw" / f"{name}.tfrecord", [scene])
    check_particles(*imported(tmp_path, tmp_path / "raw", "gns"), particles)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True])
def test_gns_archives(tmp_path: Path, particles: list[tuple[np.ndarray, np.ndarray]], packed: bool) -> None:
    sources.gns_metadata(tmp_path / "raw", particles[0][0], sequence_length=10)
    for name, scene in zip(SPLITS, particles, strict=True):
        if packed:
            array = np.empty(1, dtype=object)
            array[0] = scene
            np.savez(tmp_path / "raw" / f"{name}.npz", gns_data=array)
        else:
            sources.gns_npz(tmp_path / "raw" / f"{name}.npz", [scene])
    check_particles(*imported(tmp_path, tmp_path / "raw", "gns", allow_pickle=True), particles)


def test_gns_hdf5_and_its_friction(tmp_path: Path) -> None:
    angles = (20.0, 30.0, 40.0)
    sources.gns_metadata(tmp_path / "raw", motion())
    for k, name in enumerate(SPLITS):
        with h5py.File(tmp_path / "raw" / f"{name}.h5", "w") as file:
            file["trajectory_0/positions"] = motion(seed=k)
            file["trajectory_0/particle_type"] = np.full(20, 6)
            file["trajectory_0/material_property"] = np.full(20, np.tan(np.radians(angles[k])))
    report, stored = imported(tmp_path, tmp_path / "raw", "gns", gravity=[0.0, -9.81])
    for k, (trajectory,) in enumerate(stored.values()):
        assert_stored(trajectory, motion(seed=k))
        np.testing.assert_allclose(trajectory.material_params, angles[k], rtol=1e-5)
        assert trajectory.metadata.gravity == (0.0, -9.81)
    assert report.materials["sand"]["parameters"]["friction_angle"][0] == pytest.approx(20.0)
    assert not any("gravity is not" in note for note in report.notes)


def test_a_type_and_a_property_for_all_particles(tmp_path: Path) -> None:
    pos = motion(dim=3)
    sources.gns_metadata(tmp_path / "raw", pos, sequence_length=len(pos))
    sources.gns_npz(tmp_path / "raw" / "train.npz", [(motion(dim=3, seed=k), 6, np.tan(0.5)) for k in range(3)])
    _, stored = imported(tmp_path, tmp_path / "raw", "gns", allow_pickle=True, walls={})
    (trajectory,) = stored["train"]
    assert_stored(trajectory, pos)
    np.testing.assert_allclose(trajectory.material_params, np.degrees(0.5), rtol=1e-5)
    assert len(trajectory.boundary.pos) == 0


def test_what_a_number_means_can_be_said(tmp_path: Path) -> None:
    pos, types = motion(), np.array([9] * 15 + [6] * 5)
    pos[:, 15:] = pos[0, 15:]
    sources.gns_metadata(tmp_path / "raw", pos)
    sources.gns_tfrecord(tmp_path / "raw" / "train.tfrecord", [(pos, types)])
    report, stored = imported(
        tmp_path, tmp_path / "raw", "gns", materials={9: "elastomer", 6: "boundary"}, parameters={"elastomer": 5e4}, frame_dt=0.02
    )
    (trajectory,) = stored["train"]
    assert_stored(trajectory, pos[:, :15], 0.02)
    assert trajectory.metadata.materials == ("elastomer",)
    assert (trajectory.material_params == 5e4).all()
    assert "frame_dt = 0.02 was given" in report.notes
    assert not [warning for warning in report.warnings if "has no effect" in warning]
    assert (
        "there is no split val and no split test; fit needs train, val and test, or three trajectories of train to take them from"
        in report.warnings
    )


# --- LagrangeBench -------------------------------------------------------------------------------------------------------------------------


def drift(seed: int = 0, dim: int = 2, num_nodes: int = 20) -> np.ndarray:
    """Return positions that leave the unit box through its sides and enter again."""
    pos = motion(seed=seed, dim=dim, num_nodes=num_nodes) + 0.09 * np.arange(10, dtype=np.float32)[:, None, None]
    return pos % np.float32(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_lagrangebench(tmp_path: Path, dim: int) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw", dim)
    (tmp_path / "raw" / "force.py").write_text(f"open({str(tmp_path / 'trace')!r}, 'w')")
    for k, name in enumerate(SPLITS):
        sources.lagrangebench_h5(tmp_path / "raw" / f"{name}.h5", [(drift(seed=k, dim=dim), np.zeros(20, np.int64))])
    report, stored = imported(tmp_path, tmp_path / "raw", "lagrangebench")
    for k, (trajectory,) in enumerate(stored.values()):
        pos, m = drift(seed=k, dim=dim), trajectory.metadata
        np.testing.assert_array_equal(trajectory.pos, pos)
        assert m.frame_dt == pytest.approx(DT)
        assert (m.periodic, m.spacing, m.connectivity_radius) == ((True,) * dim, SPACING, 0.145)
        step = np.diff(pos.astype(np.float64), axis=0)
        np.testing.assert_allclose(trajectory.vel[1:], (step - np.round(step)) / DT, atol=1e-4)
        assert np.abs(trajectory.vel).max() < 20  # through the seam would be 90 m/s
        np.testing.assert_allclose(trajectory.material_params, 0.02, rtol=1e-6)
    assert "force.py is code and was not run" in report.notes
    assert not (tmp_path / "trace").exists()
    assert report.max_speed < 20
    assert not report.repairs


@pytest.mark.slow
def test_lagrangebench_viscosity_is_stored_as_it_is(tmp_path: Path) -> None:
    for value, stored_value in ((1e-7, 1e-7), (50.0, 50.0), (0, 1e-3)):
        raw = tmp_path / f"{value}"
        sources.lagrangebench_metadata(raw, viscosity=value)
        sources.lagrangebench_h5(raw / "train.h5", [(drift(seed=k), np.zeros(20, np.int64)) for k in range(3)])
        report, stored = imported(tmp_path / f"{value}_out", raw, "lagrangebench")
        np.testing.assert_allclose(stored["train"][0].material_params, stored_value, rtol=1e-6)
        assert any("viscosity is 0, which cannot be stored" in note for note in report.notes) == (value == 0)


def test_walls_padding_and_a_lid_that_slides(tmp_path: Path) -> None:
    """A cavity: periodic along x, walls below, a lid above that moves at 3 m/s, and padding."""
    lid_x, count = np.linspace(0, 1, 10, endpoint=False), 20
    lid = np.stack([np.stack([(lid_x + 3.0 * DT * k) % 1.0, np.full(10, 0.95)], axis=1) for k in range(10)])
    floor = np.broadcast_to(np.stack([lid_x, np.full(10, 0.02)], axis=1), (10, 10, 2))
    types = np.array([0] * count + [1] * 10 + [2] * 10 + [-1] * 3)
    for name in SPLITS[:1]:
        sources.lagrangebench_metadata(tmp_path / "raw", periodic_boundary_conditions=[True, False])
        scenes = [np.concatenate([drift(seed=k)[..., :1], motion(seed=k)[..., 1:]], axis=-1) for k in range(3)]
        data = [(np.concatenate([s, floor, lid, np.zeros((10, 3, 2))], axis=1).astype(np.float32), types) for s in scenes]
        sources.lagrangebench_h5(tmp_path / "raw" / f"{name}.h5", data)
    report, stored = imported(tmp_path, tmp_path / "raw", "lagrangebench")
    (trajectory,) = stored["train"]
    b = trajectory.boundary
    assert trajectory.num_nodes == count
    np.testing.assert_allclose(b.pos[:10], floor[0], atol=1e-6)
    np.testing.assert_allclose(b.pos[10:], lid[0], atol=1e-6)
    np.testing.assert_allclose(b.vel, [[0.0, 0.0]] * 10 + [[3.0, 0.0]] * 10, atol=1e-3)
    assert (b.normal[:10, 1] > 0.5).all()
    assert (b.normal[10:, 1] < -0.5).all()
    assert (b.friction == STICKY).all()
    texts = [str(event) for event in report.repairs]
    assert any("3 padding nodes left out" in t for t in texts)
    assert any("10 boundary nodes slide along a periodic axis" in t for t in texts)
    assert {event.split for event in report.repairs} == {"train", "val", "test"}  # by where they went


def test_what_is_assumed_of_the_time_step_is_said(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    description = tmp_path / "raw" / "metadata.json"
    values = json.loads(description.read_text())
    del values["write_every"]
    description.write_text(json.dumps(values))
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(drift(seed=k), np.zeros(20, np.int64)) for k in range(3)])
    report, _ = imported(tmp_path / "out", tmp_path / "raw", "lagrangebench")
    assert any("write_every is not in the source" in note for note in report.notes) and report.frame_dt == values["dt"]


def test_a_description_that_the_data_contradict_is_doubted(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw", dx=10.0, dim=3, bounds=[[0.0, 0.5], [0.0, 1.0]])
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(drift(seed=k), np.zeros(20, np.int64)) for k in range(3)])
    report, _ = imported(tmp_path / "out", tmp_path / "raw", "lagrangebench")
    assert any("nodes spread over" in w and "along x in the first frame, which is periodic with 0.5 m" in w for w in report.warnings)
    assert not any("along y in the first frame" in w for w in report.warnings)
    (spacing,) = (w for w in report.warnings if w.startswith("spacing is stored as 10 m, but nodes are 0.0"))
    assert spacing.endswith("spacing=… or bounds=… may be wrong")
    assert "dim = 3 in metadata.json, but bounds have 2 axes, as the data must" in report.warnings


@pytest.mark.slow
def test_the_force_of_a_dam_break_is_gravity(tmp_path: Path) -> None:
    for case, gravity in (("DB", (0.0, -1.0)), ("RPF", (0.0, 0.0))):
        raw = tmp_path / case
        sources.lagrangebench_metadata(raw, case=case, g_ext_magnitude=1.0, free_slip=True)
        sources.lagrangebench_h5(raw / "train.h5", [(drift(seed=k), np.zeros(20, np.int64)) for k in range(3)])
        report, stored = imported(tmp_path / f"{case}_out", raw, "lagrangebench")
        assert stored["train"][0].metadata.gravity == gravity
        assert any("depends on the place" in note for note in report.notes) == (case == "RPF")


def test_positions_outside_a_periodic_domain_are_folded(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    outside = drift()
    outside[4, 3, 0] -= 1.0
    scenes = [(outside, np.zeros(20, int)), *((drift(seed=k), np.zeros(20, int)) for k in (1, 2))]
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", scenes)
    report, stored = imported(tmp_path, tmp_path / "raw", "lagrangebench")
    np.testing.assert_allclose(stored["train"][0].pos, drift(), atol=1e-6)
    (event,) = report.repairs
    assert (event.trajectory, event.frame) == ("00000", 4)
    assert "positions folded into the periodic domain in 1 frames" in event.what


# --- MeshGraphNets -------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("container", ["tfrecord", "h5"])
@pytest.mark.parametrize("as_boundary", [True, False])
def test_meshgraphnets(tmp_path: Path, container: str, as_boundary: bool) -> None:
    cloths = [sources.sheet(seed=k) for k in range(3)]
    sources.mgn_meta(tmp_path / "raw", cloths[0])
    for name, cloth in zip(SPLITS, cloths, strict=True):
        getattr(sources, f"mgn_{container}")(tmp_path / "raw" / f"{name}.{container}", [cloth])
    report, stored = imported(tmp_path, tmp_path / "raw", "meshgraphnets", materials={3: "boundary"} if as_boundary else None)
    for (trajectory,), cloth in zip(stored.values(), cloths, strict=True):
        handles = cloth["node_type"][0, :, 0] == 3
        moving = ~handles if as_boundary else handles | True
        assert handles.any() and (trajectory.prescribed is None if as_boundary else (trajectory.prescribed == handles[:, None]).all())
        assert_stored(trajectory, cloth["world_pos"][:, moving], 0.02)
        np.testing.assert_array_equal(trajectory.boundary.pos, cloth["world_pos"][0, ~moving])
        assert trajectory.cells is not None and trajectory.rest_pos is not None
        np.testing.assert_array_equal(trajectory.rest_pos[:, :2], cloth["mesh_pos"][0, moving])
        assert not trajectory.rest_pos[:, 2].any()
        cells = [c for c in cloth["cells"][0] if moving[c].all()]
        np.testing.assert_array_equal(np.flatnonzero(moving)[trajectory.cells], cells)
        assert trajectory.cell_dim == 2
        assert trajectory.metadata.materials == ("elastomer",)
    assert any("3 of 40 cells have boundary nodes" in event.what for event in report.repairs) == as_boundary


def test_meshes_in_another_unit_are_told(tmp_path: Path) -> None:
    for k in range(3):
        cloth = sources.sheet(seed=k)
        cloth["mesh_pos"] = 1000 * cloth["mesh_pos"]
        sources.mgn_meta(tmp_path / "raw", cloth)
        sources.mgn_tfrecord(tmp_path / "raw" / f"{SPLITS[k]}.tfrecord", [cloth])
    report, _ = imported(tmp_path, tmp_path / "raw", "meshgraphnets")
    assert any("are their units different?" in warning for warning in report.warnings)


def test_a_mesh_of_tetrahedra(tmp_path: Path) -> None:
    points = np.argwhere(np.ones((3, 4, 3))) + np.random.default_rng(0).uniform(-0.2, 0.2, (36, 3))
    cells = Delaunay(points).simplices
    wave = 0.01 * np.sin(np.arange(8)[:, None] + points.sum(axis=1))
    for k in range(3):
        fields = {
            "world_pos": (SPACING * points + (1 + k) * wave[..., None]).astype(np.float32),
            "mesh_pos": (SPACING * points[None]).astype(np.float32),
            "cells": cells[None].astype(np.int32),
            "node_type": np.zeros((1, len(points), 1), np.int32),
            "stress": np.ones((8, len(points), 1), np.float32),
        }
        sources.mgn_meta(tmp_path / "raw", fields, dt=0)
        sources.mgn_tfrecord(tmp_path / "raw" / f"{SPLITS[k]}.tfrecord", [fields])
    report, stored = imported(tmp_path, tmp_path / "raw", "meshgraphnets", frame_dt=0.1, materials={0: "solid"})
    np.testing.assert_array_equal(stored["train"][0].cells, cells)
    assert stored["train"][0].cell_dim == 3
    assert stored["train"][0].metadata.materials == ("solid",)
    assert "stress of the source is von Mises' only: left out" in report.notes


@pytest.mark.slow
@pytest.mark.parametrize("axes", [2, 3])
def test_a_cloth_of_quadrilaterals(tmp_path: Path, axes: int) -> None:
    """Four corners are no tetrahedron where the mesh lies in a plane."""
    number = np.arange(30).reshape(5, 6)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    for k in range(3):
        cloth = sources.sheet(seed=k) | {"cells": corners[None].astype(np.int32), "node_type": np.zeros((1, 30, 1), np.int32)}
        cloth["mesh_pos"] = np.pad(cloth["mesh_pos"], ((0, 0), (0, 0), (0, axes - 2)))
        sources.mgn_meta(tmp_path / "raw", cloth)
        sources.mgn_tfrecord(tmp_path / "raw" / f"{SPLITS[k]}.tfrecord", [cloth])
    _, stored = imported(tmp_path, tmp_path / "raw", "meshgraphnets")
    np.testing.assert_array_equal(stored["train"][0].cells, corners)
    assert stored["train"][0].cell_dim == 2


def test_a_plate_that_an_actuator_deforms(tmp_path: Path) -> None:
    """An obstacle moves as a boundary, and handles stand still as prescribed nodes of the mesh, as in deforming_plate."""
    points = np.argwhere(np.ones((4, 4, 2))).astype(float)
    cells, press = Delaunay(points + np.random.default_rng(0).uniform(-0.1, 0.1, points.shape)).simplices, np.linspace(0, 0.3, 8)
    kind = np.where(points[:, 0] == 0, 3, 0)
    obstacle = np.array([[1.5, 1.5, 3.0], [2.5, 1.5, 3.0], [1.5, 2.5, 3.0], [2.5, 2.5, 3.0]])
    rest = SPACING * np.concatenate([points, obstacle])
    for k in range(3):
        world = np.repeat(rest[None], 8, axis=0)
        world[:, len(points) :, 2] -= SPACING * (1 + k) * press[:, None]
        world[:, : len(points), 2] -= 0.2 * (1 + k) * SPACING * press[:, None] * (kind == 0)
        fields = {
            "world_pos": world.astype(np.float32),
            "mesh_pos": rest[None].astype(np.float32),
            "cells": cells[None].astype(np.int32),
            "node_type": np.concatenate([kind, np.ones(4, int)])[None, :, None].astype(np.int32),
        }
        sources.mgn_meta(tmp_path / "raw", fields, dt=0)
        sources.mgn_tfrecord(tmp_path / "raw" / f"{SPLITS[k]}.tfrecord", [fields])
    report, stored = imported(tmp_path, tmp_path / "raw", "meshgraphnets", frame_dt=0.1)
    assert not report.refusals and any("4 boundary nodes move" in note for note in report.notes)
    for k, (trajectory,) in enumerate(stored.values()):
        assert len(trajectory.boundary.pos) == 4
        assert trajectory.prescribed is not None and (trajectory.prescribed == (kind == 3)[:, None]).all()
        assert trajectory.cells is not None and len(trajectory.cells) == len(cells)
        for frame in (0, 3, 7):
            boundary = trajectory.state(frame).boundary
            lowered = obstacle * SPACING - [0, 0, SPACING * (1 + k) * press[frame]]
            assert all(np.abs(boundary.pos - point).sum(axis=1).min() < 1e-6 for point in lowered)
            driven = np.abs(boundary.vel).max(axis=1) > 0
            assert driven.sum() == 4 and (boundary.normal[driven, 2] < 0).all()
            np.testing.assert_allclose(boundary.vel[driven, 2], -SPACING * (1 + k) * press[1] / 0.1, rtol=1e-4)


# --- DPI-Net -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_dpinet(tmp_path: Path) -> None:
    rollouts = [sources.rigid(motion(num_nodes=80, dim=3, seed=k), slice(0, 64)) for k in range(4)]
    for k, pos in enumerate(rollouts):
        vel = np.gradient(pos, 1 / 60, axis=0)
        folder = tmp_path / "data_BoxBath" / ("valid" if k == 3 else "train") / str(k % 3)
        sources.dpinet(folder, pos, vel, clusters=np.zeros((1, 1, 1, 64), np.int64))
    report, stored = imported(tmp_path, tmp_path / "data_BoxBath", "dpinet")
    assert [len(t) for t in stored.values()] == [2, 1, 1]  # test from the end of train
    for trajectory, pos in zip((*stored["train"], *stored["test"], *stored["val"]), rollouts, strict=True):
        np.testing.assert_array_equal(trajectory.pos, pos)
        np.testing.assert_allclose(trajectory.vel, np.gradient(pos, 1 / 60, axis=0), rtol=1e-5)
        assert trajectory.metadata.frame_dt == pytest.approx(1 / 60)
        assert trajectory.node_type.tolist() == [node_code("solid")] * 64 + [node_code("fluid")] * 16
        np.testing.assert_array_equal(trajectory.rigid_body, [0] * 64 + [-1] * 16)
        assert trajectory.metadata.gravity == pytest.approx((0.0, -9.8, 0.0))
        assert {s.normal for s in trajectory.boundary.shapes} >= {(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)}  # type: ignore[attr-defined]
    assert any("the source has no test: the last 1 training trajectories" in note for note in report.notes)


def test_dpinet_without_a_bath(tmp_path: Path) -> None:
    for k in range(3):
        pos = motion(dim=3, seed=k)
        sources.dpinet(tmp_path / "data_FluidFall" / "train" / str(k), pos, np.gradient(pos, 1 / 60, axis=0))
    _, stored = imported(tmp_path, tmp_path / "data_FluidFall", "dpinet")
    (trajectory,) = stored["train"]
    assert trajectory.metadata.materials == ("fluid",)
    assert [s.normal for s in trajectory.boundary.shapes] == [(0.0, 1.0, 0.0)]  # type: ignore[attr-defined]


def falling_blobs(gravity: float, dt: float, seed: int = 0) -> np.ndarray:
    """Return positions [frame, node, 3] of two blobs that fall with a given gravity, and of a puddle below them that moves to and fro."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.0, 1.0, 0.0], [2.0, 1.5, 0.0], [1.0, 0.06, 2.0]])
    lattice = SPACING * np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3)
    rest = (places[:, None] + lattice).reshape(-1, 3)
    time, free = dt * np.arange(12)[:, None], np.repeat([True, True, False], 27)
    pos = np.repeat(rest[None], 12, axis=0)
    pos[:, free, 1] += 0.5 * gravity * time**2
    pos[:, ~free, 0] += 0.02 * np.sin(20 * time + rng.uniform(0, 6))
    pos[:, ~free, 1] -= rest[:, 1].min()
    return pos.astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(("real", "settings"), [(-0.1, {}), (-9.8, {}), (-0.1, {"gravity": [0.0, -9.8, 0.0]})])
def test_free_flight_tells_the_gravity_that_dpinet_does_not(tmp_path: Path, real: float, settings: dict[str, Any]) -> None:
    for k in range(4):
        pos = falling_blobs(real, 1 / 60, seed=k)
        sources.dpinet(tmp_path / "raw" / "train" / str(k), pos, np.gradient(pos, 1 / 60, axis=0))
    report, stored = imported(tmp_path, tmp_path / "raw", "dpinet", spacing=SPACING, **settings)
    said = -9.8 if settings else real
    for trajectory in stored["train"]:
        np.testing.assert_allclose(trajectory.metadata.gravity, (0.0, said, 0.0), rtol=0.02)
    np.testing.assert_allclose(report.free_acceleration, (0.0, real, 0.0), rtol=0.02)
    assert f"groups in free flight accelerate by (0, {real:.2g}" in report.text()
    measured = [note for note in report.notes if "gravity is not in the source; (0, -9.8, 0) m/s² is the format's usual one" in note]
    assert len(measured) == (not settings)
    if not settings:
        assert ("which is stored" in measured[0], "confirm it" in measured[0]) == (real == -0.1, real == -9.8)
    doubts = [w for w in report.warnings if w.startswith("gravity is stored as (0, -9.8, 0) m/s², but ")]
    assert len(doubts) == bool(settings)
    assert all("groups in free flight agree on (0, -0.1" in w for w in doubts)


def test_free_flight_tells_the_gravity_of_dmcf_scenes_that_do_not(tmp_path: Path) -> None:
    """The second scene says it, and what a scene says is stored."""
    for k in range(3):
        pos = falling_blobs(-1.5, 0.02, seed=k)
        static = {"grav": np.array([0, -3, 0], np.float32)} if k == 1 else {}
        frames = sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0), 0, **static)
        sources.dmcf(tmp_path / "raw" / "train" / f"sim_{k}.msgpack.zst", frames)
    report, stored = imported(tmp_path, tmp_path / "raw", "dmcf", spacing=SPACING, holdout=0.0)
    gravity = [t.metadata.gravity[1] for t in stored["train"]]
    np.testing.assert_allclose(gravity, (-1.5, -3.0, -1.5), rtol=0.02)
    assert any("groups in free flight accelerate by (0, -1.5" in note for note in report.notes)


# --- DeepLagrangianFluids and DMCF ---------------------------------------------------------------------------------------------------------


def test_dmcf_in_parts(tmp_path: Path) -> None:
    box = np.random.default_rng(0).uniform(size=(30, 3)).astype(np.float32)
    normals = np.tile(np.array([0, 1, 0], np.float32), (30, 1))
    scenes = [motion(num_frames=12, dim=3, seed=k) for k in range(3)]
    for k, (name, pos) in enumerate(zip(SPLITS, scenes, strict=True)):
        vel = np.gradient(pos, 0.02, axis=0)
        for part, start in enumerate((0, 5)):
            stop = (5, 12)[part]
            static = {"box": box, "box_normals": normals} | ({"grav": np.array([0, -5, 0], np.float32)} if k == 0 else {})
            frames = sources.dmcf_frames(pos[start:stop], vel[start:stop], start, **static)
            sources.dmcf(tmp_path / "raw" / name / f"sim_{k:04d}_{part:02d}.msgpack.zst", frames)
    report, stored = imported(tmp_path, tmp_path / "raw", "dmcf")
    for k, ((trajectory,), pos) in enumerate(zip(stored.values(), scenes, strict=True)):
        np.testing.assert_array_equal(trajectory.pos, pos)
        np.testing.assert_allclose(trajectory.vel, np.gradient(pos, 0.02, axis=0), rtol=1e-5)
        np.testing.assert_array_equal(trajectory.boundary.pos, box)
        np.testing.assert_array_equal(trajectory.boundary.normal, normals)
        np.testing.assert_allclose(trajectory.mass, 0.125)
        np.testing.assert_allclose(trajectory.material_params, 0.01, rtol=1e-6)
        assert trajectory.metadata.gravity == pytest.approx((0.0, -5.0 if k == 0 else -9.81, 0.0))
    assert not any("velocities say" in w for w in report.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("numbered", [True, False])
def test_parts_are_joined_by_number(tmp_path: Path, numbered: bool) -> None:
    """16 of them: as text, 10 comes before 2."""
    scenes = [motion(num_frames=32, dim=3, seed=k) for k in range(12)]
    for k, pos in enumerate(scenes):
        vel = np.gradient(pos, 0.02, axis=0)
        for part in range(16):
            frames = sources.dmcf_frames(pos[2 * part : 2 * part + 2], vel[2 * part : 2 * part + 2], 2 * part)
            for frame in frames if not numbered else []:
                del frame["frame_id"]
            sources.dmcf(tmp_path / "raw" / f"sim_{k}_{part}.msgpack.zst", frames)
    report, stored = imported(tmp_path, tmp_path / "raw", "dmcf", holdout=0.0)
    for trajectory, pos in zip(stored["train"], scenes, strict=True):
        np.testing.assert_array_equal(trajectory.pos, pos)
    assert not report.refusals


@pytest.mark.slow
def test_trajectories_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for folder in ("arrays", "groups"):
        (tmp_path / folder).mkdir()
    sources.gns_metadata(tmp_path / "groups", motion())
    with h5py.File(tmp_path / "groups" / "train.h5", "w") as file:
        for k in range(12):
            file[f"traj{k}/positions"], file[f"traj{k}/particle_type"] = motion(seed=k), np.full(20, 6)
            np.savez(tmp_path / "arrays" / f"{k}.npz", pos=motion(seed=k), frame_dt=DT, materials="sand", params_sand=30.0)
    for source, format in (("arrays", "arrays"), ("groups", "gns")):
        _, stored = imported(tmp_path / f"{source}_out", tmp_path / source, format, holdout=0.0)
        for k, trajectory in enumerate(stored["train"]):
            np.testing.assert_array_equal(trajectory.pos, motion(seed=k))


def test_natural_order() -> None:
    names = ["10", "9", "a", "a2b10", "a2b9", "traj1", "traj01", f"traj{'9' * 5000}", "traj10", "²", ""]
    ordered = sorted(names, key=natural)
    assert ordered == ["", "9", "10", "a", "a2b9", "a2b10", "traj01", "traj1", "traj10", f"traj{'9' * 5000}", "²"]


@pytest.mark.slow
def test_a_wrong_frame_dt_is_noticed(tmp_path: Path) -> None:
    for k in range(3):
        pos = motion(dim=3, seed=k)
        sources.dmcf(tmp_path / "raw" / f"sim_{k}_00.msgpack.zst", sources.dmcf_frames(pos, np.gradient(pos, 2.5e-3, axis=0)))
    report, _ = imported(tmp_path, tmp_path / "raw", "dmcf")
    (warning,) = (w for w in report.warnings if "velocities say" in w)
    assert float(warning.split("frame_dt may be ")[1].split(" s")[0]) == pytest.approx(2.5e-3, rel=0.1)
    again, _ = imported(tmp_path / "again", tmp_path / "raw", "dmcf", frame_dt=2.5e-3)
    assert not any("velocities say" in w for w in again.warnings)


def test_two_dimensional_scenes_lose_their_third_coordinate(tmp_path: Path) -> None:
    box = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0.1], [0.5, 0, -0.1]], np.float32)
    normals = np.array([[0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], np.float32)
    for k in range(3):
        pos = np.concatenate([motion(seed=k), np.zeros((10, 20, 1), np.float32)], axis=-1)
        frames = sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0), box=box, box_normals=normals)
        sources.dmcf(tmp_path / "raw" / f"sim_{k}.msgpack.zst", frames)
    report, stored = imported(tmp_path, tmp_path / "raw", "dmcf")
    (trajectory,) = stored["train"]
    np.testing.assert_array_equal(trajectory.pos, motion())
    np.testing.assert_array_equal(trajectory.boundary.pos, box[:2, :2])
    assert trajectory.metadata.gravity == pytest.approx((0.0, -9.81))
    assert "third coordinate never changes" in report.repairs[0].what


@pytest.mark.slow
@pytest.mark.skipif(not CANYON.exists(), reason="needs the outside data")
def test_the_canyon(tmp_path: Path) -> None:
    """A real file, whose content its description gives."""
    report, stored = imported(tmp_path, CANYON, "dmcf")
    (trajectory,) = stored["train"]
    assert trajectory.pos.shape == (13, 1280, 3)
    assert len(trajectory.boundary.pos) == 185_447
    np.testing.assert_allclose(np.ptp(trajectory.boundary.pos, axis=0), [10.05, 2.38, 10.0], atol=0.01)
    np.testing.assert_allclose(trajectory.mass, 0.125)
    np.testing.assert_allclose(trajectory.material_params, 0.01, rtol=1e-6)
    assert report.spacing == pytest.approx(0.05, rel=1e-3)  # the cube of which is the mass of water
    assert report.frame_dt == 0.02
    assert (
        report.warnings[0]
        == "there is no split val and no split test; fit needs train, val and test, or three trajectories of train to take them from"
    )
    assert report.warnings[1].startswith(
        "train, canyon, frame 12: node 130 moves by 0.1146 m in one frame, farther than"
    )  # water that falls fast
    assert len(report.warnings) == 2
    falling = trajectory.pos[:6].mean(axis=1)
    np.testing.assert_allclose(np.diff(falling, 2, axis=0)[:, 1] / 0.02**2, -9.81, rtol=0.03)  # so the time step is right


# --- own arrays ----------------------------------------------------------------------------------------------------------------------------


def test_a_viscosity_of_zero_and_an_empty_split_are_told(tmp_path: Path) -> None:
    (tmp_path / "raw" / "valid").mkdir(parents=True)  # as after a download that failed
    for k in range(4):
        pos = motion(num_frames=12, dim=3, seed=k)
        frames = sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0))
        for frame in frames:
            frame["viscosity"] = sources.msgpack_array(np.zeros(pos.shape[1], np.float32))
        sources.dmcf(tmp_path / "raw" / "train" / f"sim_{k}.msgpack.zst", frames)
    report, stored = imported(tmp_path, tmp_path / "raw", "dmcf", parameters={"fluid": 0.02})
    np.testing.assert_allclose(stored["train"][0].material_params, 0.02, rtol=1e-6)
    assert any("viscosity is 0, which cannot be stored" in note for note in report.notes)
    assert "val: the source has this split, and no trajectory in it; is the source complete?" in report.warnings
    negative = sources.msgpack_array(np.full(pos.shape[1], -0.01, np.float32))
    sources.dmcf(tmp_path / "wrong" / "sim_0.msgpack.zst", [frame | {"viscosity": negative} for frame in frames])
    with pytest.raises(ImportFailure, match="kinematic_viscosity = -0.01"):
        imported(tmp_path / "other", tmp_path / "wrong", "dmcf")
