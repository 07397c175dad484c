"""Meshes, rollouts and scenes that cannot be used, or only in part."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests import sources
from tests.refusals import convert, frames, refused, unreadable, with_frame
from tests.sources import motion

# --- meshes --------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"features": {"mesh_pos": {}, "velocity": {}, "pressure": {}}},
            "has no world_pos but mesh_pos, pressure, velocity: a field on a still mesh",
        ),
        ({"features": {"world_pos": {}}}, "features lack mesh_pos, cells, node_type"),
        ({"features": [1]}, r"features = \[1\], expected an object"),
        ({"trajectory_length": "long"}, "trajectory_length = 'long', expected an integer"),
        ({"dt": None}, "dt = None does not say how much time passes between frames; pass frame_dt="),
        ({"dt": 0}, "dt = 0 does not say"),
        (
            {"features": {name: {"type": "static", "dtype": "float32", "shape": None} for name in sources.sheet()}},
            "meta.json says dtype 'float32' and shape None",
        ),
    ],
)
def test_a_wrong_description_of_meshes(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    sources.mgn_meta(tmp_path / "raw", sources.sheet(), **changes)
    sources.mgn_tfrecord(tmp_path / "raw" / "train.tfrecord", [sources.sheet()])
    refused(tmp_path, "meshgraphnets", message)


def test_remeshing_is_refused(tmp_path: Path) -> None:
    fields = sources.sheet()
    sources.mgn_meta(tmp_path / "raw", fields)
    meta = json.loads((tmp_path / "raw" / "meta.json").read_text())
    for kind, name in (("dynamic_varlen", "world_pos"), ("dynamic", "cells")):
        changed = {**meta, "features": {**meta["features"], name: {**meta["features"][name], "type": kind}}}
        (tmp_path / "raw" / "meta.json").write_text(json.dumps(changed))
        sources.mgn_tfrecord(tmp_path / "raw" / "train.tfrecord", [fields])
        refused(tmp_path, "meshgraphnets", r"changes with time \(remeshing\)")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": np.full((1, 4, 3), 99, np.int32)}, "cells name node 99, there are 30 nodes"),
        ({"cells": np.full((1, 4, 3), 7.0, np.float32)}, "cells are .*expected integers|cells name node 1088421888"),
        ({"cells": np.full((1, 4, 3), 7, np.int32)}, r"cell 0 has the nodes \[7, 7, 7\]; they must be different ones of the 30 nodes"),
        ({"world_pos": sources.sheet()["world_pos"][:, :7]}, "world_pos, mesh_pos and node_type are|no whole number of 30 × 3 × 4 bytes"),
        ({"world_pos": sources.sheet()["world_pos"][:2]}, "at least 3 frames"),
        ({"node_type": np.full((1, 30, 1), 4, np.int32)}, "node 0 has type 4; known: 0, 1, 3, 6"),
    ],
)
@pytest.mark.parametrize("container", ["tfrecord", "h5"])
def test_a_mesh_that_cannot_be_used(tmp_path: Path, container: str, changes: dict[str, np.ndarray], message: str) -> None:
    good = [sources.sheet(seed=k) for k in range(3)]
    sources.mgn_meta(tmp_path / "raw", good[0])
    getattr(sources, f"mgn_{container}")(tmp_path / "raw" / f"train.{container}", [*good, {**sources.sheet(seed=9), **changes}])
    text = unreadable(tmp_path, "meshgraphnets")
    assert re.search(message, text), text
    assert "not a readable" not in text


# --- DPI-Net -------------------------------------------------------------------------------------------------------------------------------


def rollouts(tmp_path: Path) -> Path:
    for k in range(4):
        pos = motion(dim=3, seed=k)
        sources.dpinet(tmp_path / "raw" / "train" / str(k), pos, np.gradient(pos, 1 / 60, axis=0))
    return tmp_path / "raw" / "train" / "2"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "4.h5").unlink(), "frame 4: has no 4.h5"),
        (lambda f: (f / "4.h5").write_bytes(b"x"), "frame 4: 4.h5: not a readable HDF5 file"),
        (lambda f: set_arrays(f / "4.h5", shape_quats=np.zeros((2, 4))), "has shape_quats in 1 of 10 frames"),
        (
            lambda f: in_all(f, shape_quats=np.zeros((3, 4))),
            "has shape_quats of 3 bodies and 0 scene_params, as none of FluidShake, RiceGrip and RigidFall",
        ),
        (
            lambda f: in_all(f, shape_quats=np.zeros((2, 4)), scene_params=np.zeros(6)),
            "shape_quats has a quaternion of length 0",
        ),
        (
            lambda f: in_all(f, shape_quats=np.zeros((1, 4)), scene_params=np.array([1e300, 0])),
            "has 19 nodes, expected 64 for each of 0 cubes of scene_params",
        ),
        (lambda f: set_arrays(f / "4.h5", positions=np.zeros((7, 3), "f4")), r"frame 4: positions is \[7, 3\], expected \[20, 3\]"),
        (lambda f: set_arrays(f / "0.h5", positions=np.zeros((20, 6), "f4")), r"frame 1: positions is \[20, 3\], expected \[20, 6\]"),
        (lambda f: set_arrays(f / "0.h5", clusters=np.zeros(3, int)), "has clusters in 1 of 10 frames"),
        (lambda f: in_all(f, clusters=np.zeros(3, int)), "has clusters, as BoxBath, but only 20 nodes"),
        (lambda f: [p.unlink() for p in f.iterdir()], "has no 0.h5"),
    ],
)
def test_a_rollout_that_cannot_be_used(tmp_path: Path, change: Callable[[Path], Any], message: str) -> None:
    change(rollouts(tmp_path))
    text = unreadable(tmp_path, "dpinet")
    assert text.startswith("train, train/2")
    assert re.search(message, text), text


def set_arrays(path: Path, **arrays: np.ndarray) -> None:
    with h5py.File(path, "a") as file:
        for name, array in arrays.items():
            if name in file:
                del file[name]
            file[name] = array


def in_all(folder: Path, **arrays: np.ndarray) -> None:
    """Put arrays into every file of a rollout."""
    for path in folder.iterdir():
        set_arrays(path, **arrays)


# --- DeepLagrangianFluids and DMCF ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (with_frame(3, vel=None), "frame 3: vel is missing, expected an array"),
        (
            with_frame(3, pos=sources.msgpack_array(np.zeros((7, 3), "f4"))),
            r"frame 3: pos is \[7, 3\], expected \[20, 3\]; the number of nodes",
        ),
        (with_frame(3, pos={b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [10**9, 3], b"data": b""}), "frame 3: pos claims <f4"),
        (
            with_frame(3, pos={b"nd": True, b"type": "|O", b"kind": b"O", b"shape": [20, 3], b"data": b"\x80\x04."}),
            "frame 3: pos is an array of Python objects",
        ),
        (with_frame(3, pos={b"nd": True, b"type": "nonsense", b"shape": [20, 3], b"data": b""}), "frame 3: pos has type 'nonsense'"),
        (with_frame(3, pos="x"), "frame 3: pos is str, expected an array"),
        (with_frame(3, frame_id=77), "frame 3: frame_id does not follow"),
        (with_frame(0, m=sources.msgpack_array(np.ones(3, "f4"))), r"frame 0: m is \[3\], expected \[20\]"),
        (with_frame(0, box=sources.msgpack_array(np.ones((3, 3), "f4"))), "frame 0: box_normals is missing"),
        ([1, 2, 3], "frame 0: is int, expected a map"),
        ({"a": 1}, "holds dict, expected a list of frames"),
        ([], "has no frames"),
    ],
)
def test_a_scene_that_cannot_be_used(tmp_path: Path, content: Any, message: str) -> None:
    for k in range(3):
        sources.dmcf(tmp_path / "raw" / f"good{k}.msgpack.zst", frames(k))
    sources.dmcf(tmp_path / "raw" / "scene.msgpack.zst", content)
    text = unreadable(tmp_path, "dmcf")
    assert text.startswith("train, scene")
    assert re.search(message, text), text


def of_two_parts(pos: np.ndarray, names: tuple[str, str], **static: np.ndarray) -> dict[str, list[dict[str, Any]]]:
    """Return frames by name of file, without numbers, so that only the files give the order; the first of each part contains ``static``."""
    vel, half = np.gradient(pos, 0.02, axis=0), len(pos) // 2
    parts = [sources.dmcf_frames(x, v, 0, **static) for x, v in ((pos[:half], vel[:half]), (pos[half:], vel[half:]))]
    return {name: [{k: v for k, v in frame.items() if k != "frame_id"} for frame in part] for name, part in zip(names, parts, strict=True)}


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("sim_0001_00", "sim_0001_02"), "0, 2"),
        (("sim_0001_03", "sim_0001_04"), "3, 4"),
        (("sim_0001_0", "sim_0001_00"), "0, 0"),
    ],
)
def test_parts_that_do_not_make_a_scene(tmp_path: Path, names: tuple[str, str], numbers: str) -> None:
    for name, part in of_two_parts(motion(dim=3), names).items():
        sources.dmcf(tmp_path / "raw" / f"{name}.msgpack.zst", part)
    assert f"parts are numbered {numbers}, expected each number once" in unreadable(tmp_path, "dmcf")


def test_parts_of_several_scenes(tmp_path: Path) -> None:
    parts = of_two_parts(motion(dim=3), ("sim_0001_00", "sim_0001_01"))
    for frame in parts["sim_0001_01"]:
        frame["scene_id"] = "other"
    for name, part in parts.items():
        sources.dmcf(tmp_path / "raw" / f"{name}.msgpack.zst", part)
    assert "scene_id is 'other', that of frame 0 'sim'" in unreadable(tmp_path, "dmcf")


def test_walls_that_change_with_time(tmp_path: Path) -> None:
    box, normals = np.random.default_rng(0).uniform(size=(30, 3)).astype(np.float32), np.tile(np.array([0, 1, 0], np.float32), (30, 1))
    parts = of_two_parts(motion(dim=3), ("sim_0001_00", "sim_0001_01"), box=box, box_normals=normals)
    parts["sim_0001_01"][0]["box"] = sources.msgpack_array(box + 0.1)
    for name, part in parts.items():
        sources.dmcf(tmp_path / "raw" / f"{name}.msgpack.zst", part)
    assert "box changes with time" in unreadable(tmp_path, "dmcf")


@pytest.mark.parametrize(
    "damage", [lambda d: d[: len(d) // 2], lambda d: b"hello", lambda d: d[:60] + bytes(b ^ 255 for b in d[60:90]) + d[90:]]
)
def test_a_damaged_scene(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    for k in range(4):
        sources.dmcf(tmp_path / "raw" / f"scene{k}.msgpack.zst", frames(k))
    path = tmp_path / "raw" / "scene3.msgpack.zst"
    path.write_bytes(damage(path.read_bytes()))
    text = unreadable(tmp_path, "dmcf")
    assert text.startswith("train, scene3: scene3.msgpack.zst: damaged or truncated"), text


def test_a_file_that_unpacks_to_more_than_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.data.importers.dmcf.MAX_BYTES", 10_000)
    sources.dmcf(tmp_path / "raw" / "scene.msgpack.zst", [b"\0" * 10**6])
    refused(tmp_path, "dmcf", "unpacks to more than 10000 bytes")


def test_names_in_a_file_cannot_steer_the_terminal(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    with h5py.File(tmp_path / "raw" / "train.h5", "w") as file:
        for k in range(4):
            name = "evil\x1b[2J" if k == 3 else f"{k}"
            file[f"{name}/position"], file[f"{name}/particle_type"] = motion(seed=k), np.full(20, 99 if k == 3 else 0)
    report = convert(tmp_path, "lagrangebench")
    page = (tmp_path / "data" / "set" / "imported" / "report.md").read_text()
    assert report.refusals and "\x1b" not in report.text() + page
    assert "evil\\x1b[2J" in page
