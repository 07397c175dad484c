"""Stored data read back unchanged, and a damaged file is refused or has the same content."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gpe_pl.benchmarks.faults.checkpoints import PAYLOADS, PLACES, load_damaged, load_hostile
from gpe_pl.benchmarks.faults.stores import content, read_damaged
from gpe_pl.benchmarks.faults.verdict import GOOD
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.strategies import damages, trajectories

same_file = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@given(st.lists(trajectories(), max_size=2))
def test_what_is_stored_comes_back(items: list[Trajectory]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shard-00000.h5"
        write_shard(path, items)
        for k, trajectory in enumerate(items):
            read = read_trajectory(path, f"{k:05d}", verify=True)
            assert read.metadata == trajectory.metadata
            assert content(read) == content(trajectory)
        assert [p.name for p in Path(folder).iterdir()] == ["shard-00000.h5"]


@given(damages())
@same_file
def test_a_damaged_shard_is_refused_or_means_the_same(shard: Path, damage: Callable[[bytes], bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        verdict = read_damaged(shard, damage, Path(folder))
    assert verdict.status in GOOD, verdict


@given(damages())
@same_file
def test_a_damaged_checkpoint_is_refused_or_means_the_same(checkpoint: Path, damage: Callable[[bytes], bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        verdict = load_damaged(checkpoint, damage, Path(folder))
    assert verdict.status in GOOD, verdict


@given(st.sampled_from(PAYLOADS), st.sampled_from(PLACES))
@same_file
def test_code_in_a_checkpoint_never_runs(checkpoint: Path, kind: str, place: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        verdict = load_hostile(checkpoint, kind, place, Path(folder))
    assert verdict.status == "refused", verdict
