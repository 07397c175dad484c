"""The time of a training step over that of its products is measured for a shipped model."""

from __future__ import annotations

import pytest

from gpe_pl.benchmark import _training
from gpe_pl.benchmarks import training_step_ratio
from gpe_pl.benchmarks.training_step_ratio import training_records, training_table
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.training import loop_times
from gpe_pl.training.run import TrainingSettings
from gpe_pl.trajectory.trajectory import Trajectory


@pytest.mark.slow
@pytest.mark.parametrize("push_fraction", [0.0, 0.5])
def test_every_record_has_its_place_in_the_table(push_fraction: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes fall freely here, so that no solver is compiled."""

    def fall(spec: DatasetSpec, split: str, index: int, num_frames: int) -> Trajectory:
        start, metadata = initial_state(spec, split, index), trajectory_metadata(spec, split, index)
        return rollout(Ballistic(spec.solver.frame_dt), start, num_frames - 1, metadata)

    monkeypatch.setattr(training_step_ratio, "generate_trajectory", fall)
    monkeypatch.setattr(training_step_ratio, "NUM_FRAMES", 12)
    monkeypatch.setattr(loop_times, "WARM_UP_STEPS", 2)
    monkeypatch.setattr(loop_times, "STEPS_PER_ROUND", 2)
    specs, settings = {"sand": dataset("data=sand", "size=small")}, {"sand": TrainingSettings(1000, push_fraction=push_fraction)}
    records = training_records(specs, settings, num_rounds=1)
    found = {r["metric"]: r["value"] for r in records}
    assert {r["case"] for r in records} == {"sand"}
    assert found.keys() == {"training_step_time", "training_product_time", "training_step_ratio"}
    assert found["training_step_ratio"] == pytest.approx(found["training_step_time"] / found["training_product_time"])
    assert f"| sand | {1e3 * found['training_step_time']:.1f} |" in training_table(records)


def test_settings_are_those_of_shipped_models() -> None:
    """Solids are trained with a law and without push-forward, sand with it."""
    assert _training("data=fem", "size=small").push_fraction == 0 < _training("data=sand", "size=small").push_fraction
