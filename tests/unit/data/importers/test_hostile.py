"""Whatever is wrong with a source: it is refused with the reason, in the trajectory and frame that it concerns, and nothing half done stays behind."""

from __future__ import annotations

import importlib
import json
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gpe_pl.arrays import ArrayError
from gpe_pl.data.importers import ImportFailure, ImportSettings, Refusal, Report, import_dataset
from gpe_pl.data.importers.report import Event
from gpe_pl.data.importers.tfrecord import example, masked_crc, sequence_example
from tests import sources
from tests.sources import DT, motion

WATER = np.full(20, 5)


def convert(tmp_path: Path, format: Any, **settings: Any) -> Report:
    return import_dataset(tmp_path / "data", ImportSettings(format, str(tmp_path / "raw"), "set", **{"holdout": 0.0, **settings}))


def refused(tmp_path: Path, format: Any, message: str, **settings: Any) -> None:
    """The conversion as a whole fails with this message, and leaves nothing."""
    with pytest.raises(ImportFailure, match=message) as caught:
        convert(tmp_path, format, **settings)
    assert len(str(caught.value)) < 1000
    assert not list((tmp_path / "data").rglob("*.h5"))
    assert not list((tmp_path / "data").rglob(".*"))


def only_refusal(report: Report) -> str:
    (event,) = report.refusals
    return str(event)


def unreadable(tmp_path: Path, format: Any) -> str:
    """The refusal of the only trajectory that cannot be read, without writing the others."""
    settings = ImportSettings(format, str(tmp_path / "raw"))
    source = importlib.import_module(f"gpe_pl.data.importers.{format}").open_source(tmp_path / "raw", settings)
    found = []
    for split, items in source.splits.items():
        for item in items:
            try:
                item.load(source.facts)
            except (Refusal, ArrayError) as refusal:
                found.append(str(Event(split, item.name, refusal.frame, str(refusal))))
    (text,) = found
    return text


# --- records -------------------------------------------------------------------------------------------------------------------------------


def test_the_checksum_is_the_one_of_the_standard() -> None:
    unmasked = (masked_crc(b"123456789") - 0xA282EAD8) & 0xFFFFFFFF
    assert (unmasked >> 17 | unmasked << 15) & 0xFFFFFFFF == 0xE3069283  # RFC 3720, B.4 and the usual test string
    for data in (b"", b"\0" * 32, b"\xff" * 32, bytes(range(32))):
        assert struct.pack("<I", masked_crc(data)) == sources.checksum(data)
    assert sources.crc32c(b"\0" * 32) == 0x8A9136AA


def test_every_kind_of_feature_is_read() -> None:
    features = {"text": b"abc", "floats": np.array([1.5, -2.0], np.float32), "integers": np.array([3, -4, 2**40])}
    for packed in (True, False):
        named = sources.named({name: sources.feature(value, packed) for name, value in features.items()})
        read = example(sources.message(1, named))
        assert read["text"] == [b"abc"]
        np.testing.assert_array_equal(read["floats"], features["floats"])
        np.testing.assert_array_equal(read["integers"], features["integers"])
    context, lists = sequence_example(sources.sequence_example({"key": np.array([7])}, {"x": [b"a", b"b"], "y": [np.ones(1, np.float32)]}))
    assert context["key"].tolist() == [7]  # type: ignore[union-attr]
    assert lists["x"] == [[b"a"], [b"b"]]
    assert len(lists["y"]) == 1


@pytest.fixture
def records(tmp_path: Path) -> list[bytes]:
    """Four training records of water, and the description beside them."""
    sources.gns_metadata(tmp_path / "raw", motion())
    return [sources.record(sources.gns_record(motion(seed=k), WATER, k)) for k in range(4)]


def write(tmp_path: Path, *parts: bytes) -> None:
    (tmp_path / "raw" / "train.tfrecord").write_bytes(b"".join(parts))


def test_a_flipped_bit_costs_one_record(tmp_path: Path, records: list[bytes]) -> None:
    bad = bytearray(records[1])
    bad[200] ^= 1
    write(tmp_path, records[0], bytes(bad), *records[2:])
    report = convert(tmp_path, "gns")
    assert "train, record 1: checksum of the" in only_refusal(report)
    assert sum(counts.trajectories for counts in report.splits.values()) == 3


def test_a_flipped_bit_in_a_length_costs_all_that_follows(tmp_path: Path, records: list[bytes]) -> None:
    bad = bytearray(records[2])
    bad[1] ^= 1
    write(tmp_path, *records[:2], bytes(bad), records[3])
    report = convert(tmp_path, "gns")
    assert "record 2: checksum of the length" in only_refusal(report)
    assert report.splits["train"].trajectories == 2


@pytest.mark.parametrize("cut", [5, 100])
def test_a_truncated_file_says_where(tmp_path: Path, records: list[bytes], cut: int) -> None:
    write(tmp_path, *records[:3], records[3][:cut])
    text = only_refusal(convert(tmp_path, "gns"))
    assert "record 3: " in text and "truncated" in text


def test_an_absurd_length_is_not_allocated(tmp_path: Path, records: list[bytes]) -> None:
    length = struct.pack("<Q", 2**60)
    write(tmp_path, *records[:3], length + sources.checksum(length) + b"data")
    assert f"has {2**60} bytes of data, the file has 4 left" in only_refusal(convert(tmp_path, "gns"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xff" * 30, "not a protocol buffer"),
        (b"\x12\xff\xff\xff\xff\x0f", "a field of 4294967295 bytes where 0 are left"),
        (b"", "particle_type is missing"),
        (sources.sequence_example({"particle_type": b""}, {}), "there is no position, expected 2"),
        (
            sources.sequence_example({"particle_type": WATER}, {"position": sources.frames_of(motion())}),
            "particle_type is 1 values of int64|20 values",
        ),
        (sources.sequence_example({"key": np.array([1])}, {"position": sources.frames_of(motion())}), "particle_type is missing"),
        (sources.gns_record(motion(num_nodes=19), WATER), "frame 0: position has 38 numbers, expected 2 for each of the 20"),
        (sources.gns_record(motion(), np.full(20, 8)), "node 0 has type 8; known: 0, 3, 5, 6, 7. Name it with materials={8: …}"),
        (sources.gns_record(motion(), np.full(20, 3)), "has no nodes but boundary nodes"),
        (sources.gns_record(motion(low=0.9, high=1.2), WATER), "is outside the bounds 0 … 1 m"),
    ],
)
def test_a_record_that_cannot_be_used(tmp_path: Path, records: list[bytes], data: bytes, message: str) -> None:
    write(tmp_path, *records[:3], sources.record(data))
    text = unreadable(tmp_path, "gns")
    assert text.startswith("train, record 3")
    assert re.search(message, text), text


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (sources.gns_record(np.broadcast_to(motion()[:1], (10, 20, 2)), WATER), "train, record 3: nothing moves"),
        (sources.gns_record(motion(seed=0), WATER), "train, record 3: has exactly the positions of train, record 0: the same scene twice"),
        (sources.gns_record(motion(), np.full(20, 8)), "train, record 3: node 0 has type 8"),
    ],
)
def test_the_others_are_imported(tmp_path: Path, records: list[bytes], data: bytes, message: str) -> None:
    write(tmp_path, *records[:3], sources.record(data))
    report = convert(tmp_path, "gns")
    assert message in only_refusal(report)
    assert report.splits["train"].trajectories == 3


def test_nan_is_refused_with_frame_and_node(tmp_path: Path, records: list[bytes]) -> None:
    pos = motion(seed=9)
    pos[4, 7, 1] = np.nan
    write(tmp_path, *records[:3], sources.record(sources.gns_record(pos, WATER)))
    report = convert(tmp_path, "gns")
    assert "train, record 3, frame 4: pos: frame 4, node 7 is nan" in only_refusal(report)
    stored = json.loads((tmp_path / "data" / "set" / "imported" / "report.json").read_text())
    assert stored["refusals"] == [{"split": "train", "trajectory": "record 3", "frame": 4, "what": "pos: frame 4, node 7 is nan"}]
    assert "record 3, frame 4" in (tmp_path / "data" / "set" / "imported" / "report.md").read_text()


@pytest.mark.parametrize("node", [2, 15])
def test_nan_beside_a_boundary(tmp_path: Path, records: list[bytes], node: int) -> None:
    pos, types = motion(seed=9), np.where(np.arange(20) < 4, 3, 5)
    pos[:, :4] = pos[0, :4]
    pos[4, node] = np.inf
    write(tmp_path, *records[:3], sources.record(sources.gns_record(pos, types)))
    assert unreadable(tmp_path, "gns") == f"train, record 3, frame 4: pos: frame 4, node {node} is inf"


def test_when_nothing_is_left_the_first_reasons_are_given(tmp_path: Path, records: list[bytes]) -> None:
    write(tmp_path, records[0][:50])
    refused(tmp_path, "gns", "no training trajectory can be used: train, record 0: .*truncated")


def test_without_training_trajectories_nothing_is_written(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    good, types = motion(), np.zeros(20, np.int64)
    bad = good.copy()
    bad[3, 2] = np.nan
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(bad, types)] * 3)
    sources.lagrangebench_h5(tmp_path / "raw" / "valid.h5", [(good, types)])
    refused(tmp_path, "lagrangebench", "no training trajectory can be used: train, 00000, frame 3: .*node 2.*, and 2 more alike$")
    assert not (tmp_path / "data").exists() or not [*(tmp_path / "data").rglob("*.h5")]


# --- descriptions --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": "fast"}, "metadata.json: dt = 'fast', expected a number"),
        ({"dt": -1}, "dt = -1, expected a number of at least"),
        ({"bounds": [[0, 1]]}, r"bounds = \[\[0, 1\]\], expected \[low, high\] of 2 or 3 axes"),
        ({"bounds": [[1, 0], [0, 1]]}, r"bounds = .* expected \[low, high\]"),
        ({"bounds": "box"}, "bounds = 'box'"),
        ({"default_connectivity_radius": None}, "default_connectivity_radius = None"),
        ({"sequence_length": 1e9}, "sequence_length = 1000000000.0, expected an integer"),
    ],
)
def test_a_description_with_a_wrong_value(tmp_path: Path, records: list[bytes], changes: dict[str, Any], message: str) -> None:
    write(tmp_path, *records)
    sources.gns_metadata(tmp_path / "raw", motion(), **changes)
    refused(tmp_path, "gns", message)


@pytest.mark.parametrize(
    ("text", "message"), [("{", "is not JSON"), ("[1]", "expected a JSON object, found list"), ("[" * 10**5, "is not JSON")]
)
def test_a_description_that_is_none(tmp_path: Path, records: list[bytes], text: str, message: str) -> None:
    write(tmp_path, *records)
    (tmp_path / "raw" / "metadata.json").write_text(text)
    refused(tmp_path, "gns", f"metadata.json: {message}")


def test_nothing_there(tmp_path: Path) -> None:
    for format, message in (
        ("gns", "no such file or folder"),
        ("lagrangebench", "no such file or folder"),
        ("meshgraphnets", "no such file or folder"),
        ("dpinet", "no such folder"),
        ("dmcf", "no such file or folder"),
        ("arrays", "no such folder"),
    ):
        refused(tmp_path, format, message)
    (tmp_path / "raw").mkdir()
    for format in ("gns", "lagrangebench", "meshgraphnets", "dpinet", "dmcf", "arrays"):
        refused(tmp_path, format, "raw: holds no ")


def test_a_radius_that_a_periodic_domain_cannot_have_fails_as_a_whole(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw", default_connectivity_radius=0.5)
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(motion(), np.zeros(20, int))])
    refused(tmp_path, "lagrangebench", "radius 0.5 m must be below half the period 1 m of axis x.*connectivity_radius=")


@pytest.mark.parametrize("periodic", [None, [True], [1, 0], "xy"])
def test_a_wrong_periodicity(tmp_path: Path, periodic: Any) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw", periodic_boundary_conditions=periodic)
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(motion(), np.zeros(20, int))])
    refused(tmp_path, "lagrangebench", "periodic_boundary_conditions = .*expected true or false for each of 2 axes")


# --- HDF5 ----------------------------------------------------------------------------------------------------------------------------------


def absurd(group: h5py.Group) -> None:
    del group["position"]
    group.create_dataset("position", shape=(10**6, 10**6, 2), dtype="f4", chunks=(1, 1000, 2))


def external(group: h5py.Group) -> None:
    del group["position"]
    group["position"] = h5py.ExternalLink("/etc/passwd", "/x")


def virtual(group: h5py.Group) -> None:
    del group["position"]
    layout = h5py.VirtualLayout((10, 20, 2), "f4")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (10, 20, 2))
    group.create_virtual_dataset("position", layout)


def replaced(key: str, value: Any) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        del group[key]
        if value is not None:
            group[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (absurd, r"'position' claims 8000000000000 bytes, the file holds 0"),
        (external, "'position' is not an array inside this file"),
        (virtual, "'position' is not an array inside this file"),
        (replaced("position", None), "has no 'position'; there are 'particle_type'"),
        (replaced("position", np.array([b"x", b"y"])), r"'position' is .*S1.*\[2\], expected numbers \[frame, node, dim\]"),
        (replaced("position", motion()[..., :1]), r"position is \[10, 20, 1\] for 20 particle types in 2D"),
        (replaced("position", motion().astype(int)), "'position' is int64"),
        (replaced("particle_type", np.zeros(20)), r"'particle_type' is float64\[20\], expected integers \[node\]"),
        (replaced("particle_type", np.zeros(5, int)), r"position is \[10, 20, 2\] for 5 particle types"),
        (replaced("particle_type", np.full(20, 77)), "node 0 has type 77"),
        (replaced("position", motion()[:2]), "at least 3 frames"),
    ],
)
def test_a_group_that_cannot_be_used(tmp_path: Path, change: Callable[[h5py.Group], None], message: str) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(seed=k), np.zeros(20, int)) for k in range(4)])
    with h5py.File(path, "a") as file:
        change(file["00002"])
    text = unreadable(tmp_path, "lagrangebench")
    assert text.startswith("train, 00002")
    assert re.search(message, text), text


@pytest.mark.parametrize("content", ["truncated", "text", "empty"])
def test_a_damaged_hdf5_file(tmp_path: Path, content: str) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(), np.zeros(20, int))])
    data = path.read_bytes()
    path.write_bytes({"truncated": data[: len(data) // 2], "text": b"hello", "empty": b""}[content])
    refused(tmp_path, "lagrangebench", "train.h5: .*not a readable HDF5 file")


def test_damage_within_an_array(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(seed=k), np.zeros(20, int)) for k in range(4)])
    with h5py.File(path) as file:
        info = file["00001/position"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[info.byte_offset + 20 : info.byte_offset + 60] = b"\x55" * 40
    path.write_bytes(data)
    assert "train, 00001: 'position' is damaged" in unreadable(tmp_path, "lagrangebench")


# --- archives ------------------------------------------------------------------------------------------------------------------------------


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("packed", [False, True])
def test_pickles_are_not_opened_unless_asked_for(tmp_path: Path, packed: bool) -> None:
    trace = tmp_path / "trace"
    sources.gns_metadata(tmp_path / "raw", motion())
    array = np.empty(2, dtype=object)
    array[:] = [Payload(trace), WATER]
    named: dict[str, Any] = {"gns_data" if packed else "simulation_trajectory_0": array}
    np.savez(tmp_path / "raw" / "train.npz", **named)
    refused(tmp_path, "gns", "is an array of Python objects, a pickle, which can run any code.*allow_pickle=true")
    assert not trace.exists()
    with pytest.raises(ImportFailure, match="no (training )?trajectory can be used"):
        convert(tmp_path, "gns", allow_pickle=True)
    assert trace.exists()  # the payload works


def test_pickles_in_own_arrays_are_never_opened(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    array = np.empty(1, dtype=object)
    array[0] = Payload(tmp_path / "trace")
    np.savez(tmp_path / "raw" / "a.npz", pos=array, frame_dt=DT, materials="sand", params_sand=30.0)
    refused(tmp_path, "arrays", "'pos' is an array of Python objects", allow_pickle=True)
    assert not (tmp_path / "trace").exists()


def npy(shape: tuple[int, ...], data: bytes, dtype: str = "<f4") -> bytes:
    """An array file that claims a shape and has other data."""
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    ("member", "message"),
    [
        (npy((10**6, 10**6, 2), b"\0" * 64), r"'pos' claims float32\[1000000, 1000000, 2\], 8000000000000 bytes; the archive has 64"),
        (npy((3,), b"\0" * 12)[:-6], "'pos' claims"),
        (b"hello", "'pos' is damaged"),
        (b"\x93NUMPY\x07\x00" + b"\0" * 100, "has version"),
        (npy((4,), b"ab" * 4, "<U1"), "'pos' claims <U1"),
    ],
)
def test_an_array_file_that_lies(tmp_path: Path, member: bytes, message: str) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(2):
        np.savez(tmp_path / "raw" / f"{k}.npz", pos=motion(seed=k), frame_dt=DT, materials="sand", params_sand=30.0)
    with np.load(tmp_path / "raw" / "0.npz") as arrays:
        others = {name: arrays[name] for name in arrays if name != "pos"}
    np.savez(tmp_path / "raw" / "2.npz", **others)
    with zipfile.ZipFile(tmp_path / "raw" / "2.npz", "a") as archive:
        archive.writestr("pos.npy", member)
    text = unreadable(tmp_path, "arrays")
    assert text.startswith("train, 2.npz: ")
    assert re.search(message, text), text


def test_an_archive_that_blows_up(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    with zipfile.ZipFile(tmp_path / "raw" / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("pos.npy", npy((10**7,), b"\0" * 4 * 10**7))
        for name in ("frame_dt", "materials", "params_sand"):
            archive.writestr(f"{name}.npy", npy((), b"\0" * 4))
    refused(tmp_path, "arrays", "'pos' claims 40000128 bytes, the archive holds ")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pos": motion()[0]}, r"pos: has shape \[20, 2\], expected \[frame, node, dim\]"),
        ({"pos": np.full((5, 4, 2), np.inf)}, "frame 0: pos: frame 0, node 0 is inf"),
        ({"frame_dt": [0.1, 0.2]}, r"frame_dt has shape \[2\], expected one number"),
        ({"frame_dt": -0.1}, "frame_dt=-0.1: must be a positive number of seconds"),
        ({"materials": "mud"}, "materials: node 0 is 'mud'; known: sand"),
        ({"materials": 3}, "materials is int64, expected text"),
        ({"params_sand": np.ones(3)}, r"params\['sand'\]: has shape \[3\], expected \[node 20\]"),
        ({"params_sand": 99.0}, "must be between 0 and 60 deg"),
        ({"params_snow": 5.0}, "params: has sand, snow, needs sand"),
        ({"positions": motion()}, "has an unknown key 'positions'; keys are params_MATERIAL, pos"),
        ({"periodic": [True, False]}, "a periodic axis needs bounds"),
        ({"boundary_normal": [[0, 1]]}, "has boundary arrays but no 'boundary_pos'"),
        ({"boundary_pos": [[0, 1]], "boundary_normal": [[0, 0]]}, "boundary normal: boundary_node 0 has length 0"),
        ({"cells": [[0, 1, 2]]}, "cell 0 has nodes of sand"),
    ],
)
def test_own_arrays_that_do_not_fit(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(4):
        values: dict[str, Any] = {"pos": motion(seed=k), "frame_dt": DT, "materials": "sand", "params_sand": 30.0}
        np.savez(tmp_path / "raw" / f"{k}.npz", **(values | changes if k == 3 else values))
    text = unreadable(tmp_path, "arrays")
    assert text.startswith("train, 3.npz")
    assert re.search(message, text), text


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
        ({"cells": np.full((1, 4, 3), 7, np.int32)}, r"cell 0 has the nodes \[5, 5, 5\]; they must be different ones of the 28 nodes"),
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "4.h5").unlink(), "frame 4: has no 4.h5"),
        (lambda f: (f / "4.h5").write_bytes(b"x"), "frame 4: 4.h5: not a readable HDF5 file"),
        (lambda f: set_arrays(f / "4.h5", shape_quats=np.zeros((2, 4))), "frame 4: has shape_quats: moving walls or grippers"),
        (lambda f: set_arrays(f / "4.h5", positions=np.zeros((7, 3), "f4")), r"frame 4: positions is \[7, 3\], expected \[20, 3\]"),
        (lambda f: set_arrays(f / "0.h5", positions=np.zeros((20, 6), "f4")), r"frame 0: positions is \[20, 6\], expected \[20, 3\]"),
        (lambda f: set_arrays(f / "0.h5", clusters=np.zeros(3, int)), "has clusters, as BoxBath, but only 20 nodes"),
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


# --- DeepLagrangianFluids and DMCF ---------------------------------------------------------------------------------------------------------


def frames(seed: int = 9) -> list[dict[str, Any]]:
    pos = motion(dim=3, seed=seed)
    return sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0))


def with_frame(number: int, **changes: Any) -> list[dict[str, Any]]:
    found = frames()
    found[number] = {k: v for k, v in (found[number] | changes).items() if v is not None}
    return found


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
    """Frames by name of file, without numbers, so that only the files say what follows what; ``static`` goes into the first of each."""
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


# --- one bad trajectory must not end the import of the others ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((motion(seed=9), np.array(6), np.array([0.5, 0.6])), r"material_property has shape \[2\] for 20 nodes"),
        ((motion(seed=9), np.full(20, 6), np.full((20, 2), 0.5)), r"material_property has shape \[20, 2\] for 20 nodes"),
        ((motion(seed=9), [[6], [6, 6]]), "cannot be read \\(ValueError: .*inhomogeneous"),
        ((motion(seed=9), {"a": 1}), "particle_type has type object"),
        ((5, 6), "position has shape"),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_a_tuple_that_cannot_be_used(tmp_path: Path, parts: tuple[Any, ...], message: str, packed: bool) -> None:
    scenes = [(motion(seed=k), np.full(20, 6), np.full(20, 0.5)) for k in range(3)] + [parts]
    sources.gns_metadata(tmp_path / "raw", motion())
    if packed:
        array = np.empty(4, dtype=object)
        array[:] = scenes
        np.savez(tmp_path / "raw" / "train.npz", gns_data=array)
    else:
        sources.gns_npz(tmp_path / "raw" / "train.npz", scenes)
    report = convert(tmp_path, "gns", allow_pickle=True)
    assert report.splits["train"].trajectories == 3
    assert re.search(rf"^train, (gns_data\[3\]|simulation_trajectory_3): {message}", only_refusal(report)), only_refusal(report)


def test_packed_trajectories_that_are_none(tmp_path: Path) -> None:
    sources.gns_metadata(tmp_path / "raw", motion())
    single = np.empty((), dtype=object)
    single[()] = {"a": 1}
    for value in (np.array(5), single):
        np.savez(tmp_path / "raw" / "train.npz", gns_data=value)
        refused(tmp_path, "gns", "train.npz: gns_data is a single (int|dict), expected an array of trajectories", allow_pickle=True)


@pytest.mark.parametrize(
    ("frame_id", "message"),
    [
        (float("nan"), "frame 0: frame_id is nan, expected a number"),
        (sources.msgpack_array(np.arange(3)), r"frame 0: frame_id is \[0, 1, 2\], expected a number"),
        ("x", "frame 0: frame_id is str, expected an array"),
    ],
)
def test_a_frame_number_that_is_none(tmp_path: Path, frame_id: Any, message: str) -> None:
    for k in range(3):
        sources.dmcf(tmp_path / "raw" / f"good{k}.msgpack.zst", frames(k))
    sources.dmcf(tmp_path / "raw" / "scene.msgpack.zst", with_frame(0, frame_id=frame_id))
    report = convert(tmp_path, "dmcf")
    assert report.splits["train"].trajectories == 3
    assert re.search(f"^train, scene, {message}", only_refusal(report)), only_refusal(report)


@pytest.mark.parametrize("error", [ValueError, TypeError, IndexError, KeyError, OverflowError, ZeroDivisionError, AttributeError])
def test_what_no_reader_has_foreseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]) -> None:
    from gpe_pl.data.importers import dmcf

    read = dmcf._frames

    def fails(path: Path) -> list[Any]:
        if path.name == "2.msgpack.zst":
            raise error("no idea")
        return read(path)

    monkeypatch.setattr(dmcf, "_frames", fails)
    for k in range(4):
        sources.dmcf(tmp_path / "raw" / f"{k}.msgpack.zst", frames(k))
    text = only_refusal(convert(tmp_path, "dmcf"))
    assert text.startswith(f"train, 2: cannot be read ({error.__name__}: ") and "no idea" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pos": motion(dim=3, seed=3), "bounds": [[0, 1]] * 3}, r"frame_dt, dimension and periodic axes are"),
        ({"bounds": [[0, 1]] * 2, "periodic": [True, True], "connectivity_radius": 0.5}, "radius 0.5 m must be below half the period"),
        ({"pos": np.array([Path("x")], dtype=object)}, "'pos' is an array of Python objects"),
    ],
)
def test_a_file_that_differs_from_the_others(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(4):
        values: dict[str, Any] = {"pos": motion(seed=k), "frame_dt": DT, "materials": "sand", "params_sand": 30.0}
        np.savez(tmp_path / "raw" / f"{k}.npz", **(values | changes if k == 3 else values))
    report = convert(tmp_path, "arrays")
    assert report.splits["train"].trajectories == 3
    assert re.search(f"^train, 3.npz: .*{message}", only_refusal(report)), only_refusal(report)


def test_bounds_of_other_axes_are_refused_trajectory_by_trajectory(tmp_path: Path) -> None:
    for k in range(4):
        flat = k == 3  # loses its third coordinate
        pos = np.concatenate([motion(seed=k), np.zeros((10, 20, 1), np.float32)], axis=-1) if flat else motion(dim=3, seed=k)
        sources.dmcf(tmp_path / "raw" / f"{k}.msgpack.zst", sources.dmcf_frames(pos, np.gradient(pos, 0.02, axis=0)))
    report = convert(tmp_path, "dmcf", bounds=[(-1.0, 2.0)] * 3)
    assert "has 3 axes, the data have 2" in only_refusal(report)


# --- bombs ---------------------------------------------------------------------------------------------------------------------------------


def test_a_file_that_blows_up_is_not_unpacked(tmp_path: Path) -> None:
    """Of a gigabyte of zeros in 30 kB no more is unpacked than 1032 times the file's size."""
    import tracemalloc

    import zstandard

    (tmp_path / "raw").mkdir()
    path = tmp_path / "raw" / "scene.msgpack.zst"
    compressor, zeros = zstandard.ZstdCompressor(level=3).compressobj(), b"\0" * 10**7
    with open(path, "wb") as file:
        file.write(compressor.compress(b"\x91\xc6" + struct.pack(">I", 10**9)))
        for _ in range(100):
            file.write(compressor.compress(zeros))
        file.write(compressor.flush())
    tracemalloc.start()
    refused(tmp_path, "dmcf", rf"scene.msgpack.zst: unpacks to more than {path.stat().st_size * 1032} bytes")
    assert tracemalloc.get_traced_memory()[1] < 2.5 * path.stat().st_size * 1032
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xdd" + struct.pack(">I", 10**6) + b"\0" * 10**6, "exceeds max_array_len"),
        (b"\x91\xdf" + struct.pack(">I", 10**5) + b"\0" * 10**6, "exceeds max_map_len"),
        (b"\x91\xdb" + struct.pack(">I", 10**6) + b"a" * 10**6, "exceeds max_str_len"),
        (b"\x91\xc9" + struct.pack(">I", 100) + b"\1" + b"a" * 100, "exceeds max_ext_len"),
    ],
)
def test_lists_that_claim_too_much(tmp_path: Path, data: bytes, message: str) -> None:
    import zstandard

    (tmp_path / "raw").mkdir()
    noise = np.random.default_rng(0).bytes(10**4)  # or the file would be refused for its ratio
    content = zstandard.ZstdCompressor().compress(data + noise)
    (tmp_path / "raw" / "scene.msgpack.zst").write_bytes(content)
    refused(tmp_path, "dmcf", f"scene.msgpack.zst: damaged or truncated .*{message}")


# --- descriptions that contradict the data -------------------------------------------------------------------------------------------------


def test_another_number_of_frames_than_described(tmp_path: Path) -> None:
    """The positions themselves say how many there are."""
    sources.gns_metadata(tmp_path / "raw", motion(), sequence_length=50, dim=3)
    data = [sources.record(sources.gns_record(motion(seed=k, num_frames=10 + k), WATER, k)) for k in range(3)]
    write(tmp_path, *data)
    report = convert(tmp_path, "gns")
    assert report.splits["train"].frames == [10, 12]
    assert report.warnings[-3:] == [
        f"train, record {k}: has {10 + k} frames, which were taken; sequence_length = 50 stands for 50 or 51" for k in range(3)
    ]
    assert report.warnings[0] == "dim = 3 in metadata.json, but bounds have 2 axes, which were taken"


@pytest.mark.parametrize("length", [9, 10])
def test_the_number_of_frames_or_one_less(tmp_path: Path, records: list[bytes], length: int) -> None:
    sources.gns_metadata(tmp_path / "raw", motion(), sequence_length=length)
    write(tmp_path, *records)
    assert not any("sequence_length" in w for w in convert(tmp_path, "gns").warnings)


@pytest.mark.parametrize("container", ["tfrecord", "h5"])
def test_meshes_of_another_number_of_frames_than_described(tmp_path: Path, container: str) -> None:
    cloths = [sources.sheet(seed=k, num_frames=12) for k in range(3)]
    sources.mgn_meta(tmp_path / "raw", cloths[0], trajectory_length=8)
    getattr(sources, f"mgn_{container}")(tmp_path / "raw" / f"train.{container}", cloths)
    report = convert(tmp_path, "meshgraphnets")
    assert report.splits["train"].frames == [12, 12]
    name = "record 0" if container == "tfrecord" else "trajectory_0"
    assert f"train, {name}: has 12 frames, which were taken; trajectory_length = 8 stands for 8 or 9" in report.warnings


@pytest.mark.parametrize("stated", ["float32", "float64"])
def test_bytes_of_another_type_than_described(tmp_path: Path, stated: str) -> None:
    """Not read as other numbers in half or twice as many frames."""
    cloths = [sources.sheet(seed=k, num_frames=12) for k in range(3)]
    sources.mgn_meta(tmp_path / "raw", cloths[0])
    meta = json.loads((tmp_path / "raw" / "meta.json").read_text())
    meta["features"]["world_pos"]["dtype"] = stated
    (tmp_path / "raw" / "meta.json").write_text(json.dumps(meta))
    actual = np.float64 if stated == "float32" else np.float32
    sources.mgn_tfrecord(tmp_path / "raw" / "train.tfrecord", [{**c, "world_pos": c["world_pos"].astype(actual)} for c in cloths])
    refused(
        tmp_path,
        "meshgraphnets",
        f"world_pos has (6|24) frames of {stated}, trajectory_length = 12: by a factor of 2 the type may be the wrong",
    )


def test_another_size_than_lagrangebench_describes(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(
        tmp_path / "raw", sequence_length_train=1000, num_trajs_train=400, num_particles_max=19, sequence_length_test=9, num_trajs_test=1
    )
    for name, count in (("train", 3), ("test", 1)):
        scenes = [(motion(seed=10 * count + k), np.zeros(20, int)) for k in range(count)]
        sources.lagrangebench_h5(tmp_path / "raw" / f"{name}.h5", scenes)
    report = convert(tmp_path, "lagrangebench")
    assert report.warnings[0] == "num_trajs_train = 400 in metadata.json, but the file holds 3 trajectories: is it complete?"
    assert not any("num_trajs_test" in w for w in report.warnings)
    assert [w for w in report.warnings if ", 00000: " in w] == [
        "train, 00000: has 10 frames, which were taken; sequence_length_train = 1000 stands for 1000 or 1001",
        "train, 00000: has 20 nodes, num_particles_max = 19",
        "test, 00000: has 20 nodes, num_particles_max = 19",
    ]


@pytest.mark.parametrize("changes", [{"num_trajs_train": "many"}, {"sequence_length_train": 1.5}, {"num_particles_max": True}])
def test_a_count_that_is_none(tmp_path: Path, changes: dict[str, Any]) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw", **changes)
    sources.lagrangebench_h5(tmp_path / "raw" / "train.h5", [(motion(), np.zeros(20, int))])
    refused(tmp_path, "lagrangebench", f"metadata.json: {next(iter(changes))} = .*, expected an integer")


@pytest.mark.parametrize("name", ["viscosity", "m"])
def test_what_changes_with_time_but_is_stored_once(tmp_path: Path, name: str) -> None:
    for k in range(3):
        sources.dmcf(tmp_path / "raw" / f"good{k}.msgpack.zst", frames(k))
    changed = with_frame(6, **{name: sources.msgpack_array(np.full(20, 9.0, np.float32))})
    sources.dmcf(tmp_path / "raw" / "scene.msgpack.zst", changed)
    assert only_refusal(convert(tmp_path, "dmcf")).startswith(f"train, scene, frame 6: {name} changes with time")
