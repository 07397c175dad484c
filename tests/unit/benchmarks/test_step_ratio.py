"""The time of a rollout step over that of its products is measured for a shipped model."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gpe_pl.benchmarks import step_ratio
from gpe_pl.benchmarks.step_ratio import StepError, step_records, step_table
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.learned.simulator import LearnedSimulator
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


@pytest.mark.slow
def test_every_record_has_its_place_in_the_table(sand: DatasetSpec) -> None:
    records = step_records({"sand": sand}, num_rounds=1)
    found = {r["metric"]: r["value"] for r in records}
    metrics = {"step_time", "product_time", "step_ratio", "step_speedup_vs_plain", "step_speedup_vs_gns"}
    assert {r["case"] for r in records} == {"sand"} and found.keys() == metrics
    assert found["step_ratio"] == pytest.approx(found["step_time"] / found["product_time"])
    assert f"| sand | {1e3 * found['step_time']:.2f} |" in step_table(records)


def test_other_networks_have_the_weights_or_the_size_of_the_model(sand: DatasetSpec) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    others = step_ratio._others(simulator)
    graph = simulator.standardizer(simulator.builder(step_ratio.start_of(simulator, sand)[0]))
    with torch.inference_mode():
        found, expected = (s.model(graph).acceleration["sand"] for s in (others["plain"], simulator))
    assert others["plain"].model.settings["implementation"] == "plain"
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    for key in ("num_message_passing_steps", "hidden_channels"):
        assert others["gns"].model.settings[key] == simulator.model.settings[key]


def test_a_rollout_that_stops_is_not_timed(sand: DatasetSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(**limits: Any) -> step_ratio.Guard:
        return guard(**{**limits, "max_speed": 1e-9})

    guard = step_ratio.Guard
    monkeypatch.setattr(step_ratio, "Guard", slow)
    with pytest.raises(StepError, match="stopped"):
        step_records({"sand": sand}, num_rounds=1)
