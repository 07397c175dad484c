"""Splits by list, by leaving one out, and of a source that has only one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure
from tests import sources
from tests.sources import motion
from tests.unit.data.importers.test_formats import imported


def raw(tmp_path: Path, **counts: int) -> Path:
    """Write rollouts of 5 frames; seeds are numbered over all splits."""
    seed = 0
    for split, count in counts.items():
        for k in range(count):
            pos = motion(num_frames=5, dim=3, seed=seed)
            sources.dpinet(tmp_path / "raw" / split / str(k), pos, np.gradient(pos, 1 / 60, axis=0))
            seed += 1
    return tmp_path / "raw"


def seeds(tmp_path: Path, source: Path, **settings: Any) -> tuple[dict[str, list[int]], str]:
    """Return the seeds of the stored trajectories by split, and the report as text."""
    report, stored = imported(tmp_path, source, "dpinet", **settings)
    known = {motion(num_frames=5, dim=3, seed=seed).tobytes(): seed for seed in range(6)}
    return {split: [known[t.pos.tobytes()] for t in own] for split, own in stored.items()}, report.text()


def test_a_lone_split_becomes_train(tmp_path: Path) -> None:
    found, text = seeds(tmp_path, raw(tmp_path, valid=4))
    assert found == {"train": [0, 1], "val": [3], "test": [2]}
    assert "the source has only val, which became train" in text
    assert "graph.history=1 takes one, and evaluation.start_time=0" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"leave_out": 1}, {"train": [0, 2, 3], "test": [1], "val": [4]}),
        ({"leave_out": 4}, {"train": [0, 1, 2], "test": [4], "val": [3]}),
        ({"splits": {"val": [0], "test": [3, 1]}}, {"train": [2, 4], "val": [0], "test": [3, 1]}),
        ({"splits": {"train": [4], "val": [0], "test": [2]}}, {"train": [4], "val": [0], "test": [2]}),
    ],
)
def test_splits_by_number(tmp_path: Path, settings: dict[str, Any], expected: dict[str, list[int]]) -> None:
    found, _ = seeds(tmp_path, raw(tmp_path, train=3, valid=2), **settings)
    assert found == expected


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"leave_out": 3}, "leave_out: there is no trajectory 3; the source has 0 to 2"),
        ({"splits": {"val": [1], "test": [1]}}, "splits: trajectory 1 is in val and in test"),
        ({"splits": {"val": [1]}, "leave_out": 0}, "give only one of them"),
    ],
)
def test_numbers_that_do_not_fit_are_named(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ImportFailure, match=message):
        seeds(tmp_path, raw(tmp_path, train=3), **settings)


@pytest.mark.parametrize("settings", [{"leave_out": 3}, {"splits": {"val": [0], "test": [3]}}])
def test_no_other_trajectory_stands_in_for_a_damaged_one(tmp_path: Path, settings: dict[str, Any]) -> None:
    source = raw(tmp_path, train=5)
    (source / "train" / "3" / "2.h5").write_bytes(b"cut off")
    with pytest.raises(
        ImportFailure, match=r"no trajectory of test can be used: test, train/3, frame 2: .*; repair or remove it, or choose"
    ):
        seeds(tmp_path, source, **settings)


def test_nor_for_a_damaged_split_of_the_source(tmp_path: Path) -> None:
    source = raw(tmp_path, train=4, valid=1)
    (source / "valid" / "0" / "0.h5").write_bytes(b"")
    with pytest.raises(ImportFailure, match="no trajectory of val can be used"):
        seeds(tmp_path, source)


@pytest.mark.parametrize("format", ["gns", "lagrangebench", "meshgraphnets"])
def test_files_that_are_of_no_split_are_named(tmp_path: Path, format: str) -> None:
    source = tmp_path / "raw"
    if format == "gns":
        sources.gns_metadata(source, motion())
        ending, write = ".tfrecord", lambda path: sources.gns_tfrecord(path, [(motion(seed=k), np.full(20, 6)) for k in range(3)])
    elif format == "lagrangebench":
        sources.lagrangebench_metadata(source, periodic_boundary_conditions=[False, False])
        ending, write = ".h5", lambda path: sources.lagrangebench_h5(path, [(motion(seed=k), np.zeros(20, np.int64)) for k in range(3)])
    else:
        sources.mgn_meta(source, sources.sheet())
        ending, write = ".h5", lambda path: sources.mgn_h5(path, [sources.sheet(seed=k) for k in range(3)])
    for name in ("train", "train10", "train2", "._train"):
        write(source / f"{name}{ending}")
    report, _ = imported(tmp_path, source, format)
    assert f"2 other files were not read, the first is train2{ending}: splits are train, valid" in report.text()
