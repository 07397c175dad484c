"""The time of a rollout step over that of its products is measured for a shipped model."""

from __future__ import annotations

from typing import Any

import pytest

from gpe_pl.benchmarks import step_ratio
from gpe_pl.benchmarks.step_ratio import StepError, step_records, step_table
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.trajectory import Trajectory


@pytest.fixture
def sand(monkeypatch: pytest.MonkeyPatch) -> DatasetSpec:
    """The data set of the shipped sand, whose scenes fall freely here, so that no solver is compiled."""

    def fall(spec: DatasetSpec, split: str, index: int, num_frames: int) -> Trajectory:
        return rollout(
            Ballistic(spec.solver.frame_dt), initial_state(spec, split, index), num_frames - 1, trajectory_metadata(spec, split, index)
        )

    monkeypatch.setattr(step_ratio, "generate_trajectory", fall)
    return dataset("data=sand", "size=small")


def test_every_record_has_its_place_in_the_table(sand: DatasetSpec) -> None:
    records = step_records({"sand": sand}, num_rounds=1)
    found = {r["metric"]: r["value"] for r in records}
    assert {r["case"] for r in records} == {"sand"} and found.keys() == {"step_time", "product_time", "step_ratio"}
    assert found["step_ratio"] == pytest.approx(found["step_time"] / found["product_time"])
    assert f"| sand | {1e3 * found['step_time']:.2f} |" in step_table(records)


def test_a_rollout_that_stops_is_not_timed(sand: DatasetSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(**limits: Any) -> step_ratio.Guard:
        return guard(**{**limits, "max_speed": 1e-9})

    guard = step_ratio.Guard
    monkeypatch.setattr(step_ratio, "Guard", slow)
    with pytest.raises(StepError, match="stopped"):
        step_records({"sand": sand}, num_rounds=1)
