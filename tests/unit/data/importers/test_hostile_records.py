"""Damaged records and descriptions are refused with the reason, and nothing partial stays behind."""

from __future__ import annotations

import json
import re
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import tfrecord
from gpe_pl.data.importers.source import ImportFailure, Refusal
from gpe_pl.data.importers.tfrecord import example, masked_crc, sequence_example
from tests import sources
from tests.refusals import WATER, convert, only_refusal, refused, unreadable, write
from tests.sources import motion

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
    assert list(lists["x"]) == [[b"a"], [b"b"]]
    assert len(list(lists["y"])) == 1


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (sources.message(1, b"\x0a\x00" * 200), "holds 200 features, at most 128"),
        (sources.message(1, b"\x0a\x00" * (tfrecord.MAX_FIELDS + 1)), f"{tfrecord.MAX_FIELDS + 1} fields of one kind"),
        (sources.message(1, sources.message(1, sources.message(1, b"x") * 2)), "several names or values"),
        (sources.message(1, b"\x08\x01"), "a number where a message should be"),
        (b"\x0a" + b"\xff" * 9 + b"\x01", f"a field of {2**64 - 1} bytes where 0 are left"),
        (b"\x0b", "wire type 3 at byte 1"),
        (b"\x80" * 10 + b"\x00", "a number of more than 10 bytes"),
    ],
)
def test_messages_that_are_no_examples(data: bytes, message: str) -> None:
    with pytest.raises(Refusal, match=message):
        example(data)


@pytest.mark.parametrize(
    ("kind", "content", "message"),
    [
        (1, b"\x0a\x00" * 2000, "holds 2000 strings, at most 1024"),
        (3, sources.message(1, b"\x80" * 3), "ends within a number"),
        (3, sources.message(1, b"\xff" * 11 + b"\x00"), "more than 10 bytes"),
    ],
)
def test_features_are_decoded_when_they_are_looked_up(kind: int, content: bytes, message: str) -> None:
    bad = sources.message(1, sources.message(1, b"bad") + sources.message(2, sources.message(kind, content)))
    found = example(sources.message(1, sources.named({"good": sources.feature(b"x", True)}) + bad))
    assert list(found) == ["good", "bad"] and found["good"] == [b"x"]
    with pytest.raises(Refusal, match=message):
        found["bad"]


def test_a_million_tiny_numbers_take_a_moment() -> None:
    """Counted in lines of Python that run, of which there were several for each."""
    numbers = sources.message(1, b"\x01" * 10**6) + b"\x08\x02" * 10**6
    found = example(sources.message(1, sources.message(1, sources.message(1, b"n") + sources.message(2, sources.message(3, numbers)))))
    lines = 0

    def count(frame: Any, event: str, argument: Any) -> Any:
        nonlocal lines
        lines += event == "line"
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        integers = found["n"]
    finally:
        sys.settrace(before)
    assert lines < 100_000
    np.testing.assert_array_equal(integers, np.repeat([1, 2], 10**6))


def test_wrong_frames_cost_one_of_them(tmp_path: Path, records: list[bytes]) -> None:
    bad = sources.sequence_example({"particle_type": WATER.tobytes()}, {"position": [motion()[0].tobytes(), *[b""] * 5]})
    write(tmp_path, *records[:3], sources.record(bad))
    assert "record 3, frame 1: position has 0 numbers" in unreadable(tmp_path, "gns")


def test_a_file_of_empty_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tfrecord, "MAX_TRAJECTORIES", 10)
    (tmp_path / "many").write_bytes(sources.record(b"") * 11)
    with pytest.raises(ImportFailure, match="holds more than 10 records"):
        tfrecord.records(tmp_path / "many")


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


@pytest.mark.slow
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
