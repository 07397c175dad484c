"""Invalid sources are refused with the reason, for the trajectory and frame that it concerns, and nothing partial stays behind."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import sources
from tests.refusals import WATER, convert, frames, only_refusal, refused, with_frame, write
from tests.sources import DT, motion

# --- one bad trajectory must not end the import of the others ------------------------------------------------------------------------------


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_file_that_blows_up_is_not_unpacked(tmp_path: Path) -> None:
    """At most 1032 times the size of a file is unpacked; this one has a gigabyte of zeros in 30 kB."""
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


@pytest.mark.slow
@pytest.mark.parametrize("length", [9, 10])
def test_the_number_of_frames_or_one_less(tmp_path: Path, records: list[bytes], length: int) -> None:
    sources.gns_metadata(tmp_path / "raw", motion(), sequence_length=length)
    write(tmp_path, *records)
    assert not any("sequence_length" in w for w in convert(tmp_path, "gns").warnings)


@pytest.mark.slow
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
    """The bytes are not read as other numbers in half or twice as many frames."""
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
