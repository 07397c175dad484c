"""What a model cost before its first rollout."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.benchmarks.spent_before import Simulated, Spent, spent_on, training_seconds
from gpe_pl.files import sealed
from gpe_pl.learned.pretrained import BEST, fingerprint
from gpe_pl.reports.finished_runs import Run, table_of


def run_in(folder: Path, num_steps: int = 100, budget: float = 10.0, settings: dict[str, Any] | None = None) -> Run:
    """A run whose steps took half a second."""
    (folder / BEST).parent.mkdir(parents=True)
    (folder / BEST).write_text(folder.name)
    sealed.write(folder / "step_times.json", {"sand tiny GPE 1": 0.5})
    config = {"data.name": "sand", "size.name": "tiny", "model._target_": "gpe_pl.models.gpe.GPE", "training.num_steps": num_steps}
    config |= {"data.num_train": 10, "data.num_frames": 101, "data.solver.frame_dt": 0.005, "data.scene.num_particles": 150}
    return Run(folder, config | {"size.comparison.budget_minutes": budget} | (settings or {}), table_of([]))


def test_training_took_its_steps_at_the_step_time_of_its_sweep(tmp_path: Path) -> None:
    config = {"data.name": "sand", "size.name": "tiny", "model._target_": "gpe_pl.models.gpe.GPE", "training.num_steps": 100}
    config |= {"size.comparison.budget_minutes": 1}
    sweep = tmp_path / "sweep"
    sweep.mkdir()
    trained = Run(sweep / "seed=0", config, table_of([]))
    assert math.isnan(training_seconds(trained))
    times = {"sand tiny GPE 1": 0.5, "sand tiny GPE 2": 0.1, "sand tiny GPE 3": 0.7, "sand small GPE 1": 0.55, "sand tiny GNS 1": 0.58}
    sealed.write(sweep / "step_times.json", times)
    assert training_seconds(trained) == 50.0  # 70 s were more than it had


def test_a_run_that_is_no_sweep_has_step_times_of_its_own(tmp_path: Path) -> None:
    assert training_seconds(run_in(tmp_path / "one")) == 50.0
    assert training_seconds(run_in(tmp_path / "longer", budget=0.5)) == 50.0  # its budget was another than that of comparisons


def test_trainings_that_a_model_started_from_and_tuning_count_too(tmp_path: Path) -> None:
    first = run_in(tmp_path / "first", 100)
    second = run_in(tmp_path / "second", 60, settings={"start_from": fingerprint(first.folder), "data.fine": 2, "data.num_train": 4})
    trial = run_in(tmp_path / "trial", 20)
    coarse, fine = (simulated[0] for simulated in (spent_on(run, [first, second]).data for run in (first, second)))
    assert (replace(coarse, name=""), replace(fine, name="")) == (Simulated(1, 150.0, 5.0), Simulated(2, 150.0, 2.0))
    assert spent_on(first, [first, second]) == Spent(50.0, (coarse,))
    assert spent_on(second, [second, first]) == Spent(80.0, (fine, coarse))
    assert spent_on(second, [second], tuning=[trial, first]) == Spent(90.0, (fine, coarse))
    assert math.isnan(spent_on(second, [second]).training)


def test_data_cost_what_their_solver_takes() -> None:
    spent = Spent(80.0, (Simulated(2, 150.0, 2.0), Simulated(1, 150.0, 5.0)))
    assert spent.seconds({2: 10.0, 1: 1.0}, 150.0) == pytest.approx(80 + 20 + 5)
    assert spent.seconds({2: 10.0, 1: 1.0}, 300.0) == pytest.approx(80 + 12.5)
    assert spent.seconds({2: 10.0, 1: 1.0}, math.nan) == pytest.approx(105)
    assert math.isnan(spent.seconds({1: 1.0}, 150.0))


def test_data_sets_of_equal_size_are_two(tmp_path: Path) -> None:
    first = run_in(tmp_path / "first", 100)
    second = run_in(tmp_path / "second", 60, settings={"start_from": fingerprint(first.folder), "data.name": "steep"})
    third = run_in(tmp_path / "third", 60, settings={"start_from": fingerprint(second.folder)})
    assert [data.seconds for data in spent_on(third, [first, second]).data] == [5.0, 5.0]
