"""Tables of trials from run folders with known numbers."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row, read_rows, write_rows
from gpe_pl.files import sealed
from gpe_pl.reports.finished_runs import finished_runs
from gpe_pl.reports.stride_table import DIFFERENT_STARTS
from gpe_pl.reports.trial_table import compares_settings, report_trials

ERRORS = {  # of two seeds, by domain, model and noise
    ("sand", "GPE", 0.3): [[1e-3, 3e-3], [4e-3, 6e-3]],
    ("sand", "GPE", 1.0): [[2e-3, 2e-3]],
    ("sand", "GNS", 0.3): [[float("inf"), 1e-3]],
    ("sand", "GNS", 1.0): [[7e-3, 7e-3]],
}


def write_run(folder: Path, domain: str, model: str, noise: float, seed: int, errors: list[float]) -> None:
    folder.mkdir(parents=True)
    training = {"velocity_noise_of_change": noise, "num_steps": 1000 + int(noise), "val_interval": 10 + int(noise)}
    config = {"seed": seed, "data": {"name": domain}, "model": {"_target_": f"gpe_pl.models.x.{model}"}, "training": training}
    sealed.write(folder / "config.json", config)
    rows = [Row(LEARNED, "val", k, "seen", 20.0, "rollout_mse", "full", value) for k, value in enumerate(errors)]
    flight = [Row("ballistic", "val", k, "seen", 20.0, "rollout_mse", "full", 20e-3) for k in range(len(errors))]
    write_rows(folder / "metrics.csv", [*rows, *flight])


@pytest.fixture
def trials(tmp_path: Path) -> Path:
    for (domain, model, noise), seeds in ERRORS.items():
        for seed, errors in enumerate(seeds):
            write_run(tmp_path / domain / model / str(noise) / str(seed), domain, model, noise, seed, errors)
    return tmp_path


def test_the_best_setting_of_each_model_is_bold(trials: Path) -> None:
    report_trials(trials, finished_runs(trials))
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in (trials / "trials.md").read_text().splitlines() if "|" in line]
    assert rows[0] == ["domain", "model", "velocity_noise_of_change", "seeds", "one-step nMSE", "val"]
    assert rows[2:] == [
        ["sand", "GNS", "0.3", "1", "–", "10.5 [1, 20], 1 of 2 failed"],
        ["sand", "GNS", "1.0", "1", "–", "**7** [7, 7]"],
        ["sand", "GPE", "0.3", "2", "–", "3.5 [1, 6]"],
        ["sand", "GPE", "1.0", "1", "–", "**2** [2, 2]"],
    ]


def test_repeated_runs_are_no_further_seeds(trials: Path) -> None:
    report_trials(trials, finished_runs(trials))
    before = (trials / "trials.md").read_text()
    shutil.copytree(trials / "sand" / "GPE" / "1.0" / "0", trials / "copy")
    report_trials(trials, finished_runs(trials))
    assert (trials / "trials.md").read_text() == before


def test_no_setting_is_the_best_of_rollouts_that_start_at_different_times(tmp_path: Path) -> None:
    for history, error in ((1, 3e-3), (5, 1e-3)):
        write_run(tmp_path / str(history), "sand", "GPE", 0.3, 0, [error])
        config = json.loads((tmp_path / str(history) / "config.json").read_text())
        config |= {"graph": {"history": history}, "data": {"name": "sand", "solver": {"frame_dt": 0.01}}}
        sealed.write(tmp_path / str(history) / "config.json", {key: value for key, value in config.items() if key != "sha256"})
    report_trials(tmp_path, finished_runs(tmp_path))
    text = (tmp_path / "trials.md").read_text()
    assert DIFFERENT_STARTS.format("0.01 s, 0.05 s") in text
    assert "| 1 [1, 1] |" in text and "**1**" not in text


def test_the_csv_has_a_line_per_run_and_split(trials: Path) -> None:
    report_trials(trials, finished_runs(trials))
    with open(trials / "trials.csv", newline="") as handle:
        lines = list(csv.DictReader(handle))
    assert len(lines) == 5
    failed = next(line for line in lines if line["num_failed"] == "1")
    assert (failed["model"], failed["velocity_noise_of_change"], failed["rollout_mse"]) == ("GNS", "0.3", "inf")


def test_seeds_and_steps_are_not_settings(tmp_path: Path) -> None:
    for model in ("GPE", "GNS"):
        for seed in (0, 1):
            write_run(tmp_path / model / str(seed), "sand", model, 0.3, seed, [1e-3])
    assert not compares_settings(finished_runs(tmp_path))


def test_one_model_with_several_settings_is_an_ablation(tmp_path: Path) -> None:
    for noise in (0.3, 1.0):
        write_run(tmp_path / str(noise), "sand", "GPE", noise, 0, [1e-3])
    assert not compares_settings(finished_runs(tmp_path))
    write_run(tmp_path / "GNS", "sand", "GNS", 0.3, 0, [1e-3])
    assert compares_settings(finished_runs(tmp_path))


def test_another_budget_alone_is_a_setting(tmp_path: Path) -> None:
    for model in ("GPE", "GNS"):
        write_run(tmp_path / model, "sand", model, 0.3, 0, [1e-3])
    longer = tmp_path / "longer"
    write_run(longer, "sand", "GPE", 0.3, 0, [1e-3])
    config = json.loads((longer / "config.json").read_text())
    config["training"]["num_steps"] = 9000
    sealed.write(longer / "config.json", config)
    assert compares_settings(finished_runs(tmp_path))
    report_trials(tmp_path, finished_runs(tmp_path))
    assert "| sand | GPE | 9000 |" in (tmp_path / "trials.md").read_text()


def test_a_table_of_models_does_not_outlive_a_comparison_of_settings(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for model in ("GPE", "GNS"):
        write_run(tmp_path / model, "sand", model, 0.3, 0, [1e-3])
    (tmp_path / "table1.md").write_text("of the two")
    write_run(tmp_path / "trial", "sand", "GPE", 1.0, 0, [1e-3])
    report_trials(tmp_path, finished_runs(tmp_path))
    assert not (tmp_path / "table1.md").exists()
    assert "now compares settings (training.velocity_noise_of_change)" in caplog.text


def table_of(folder: Path) -> list[list[str]]:
    lines = (folder / "trials.md").read_text().splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")][2:]


def test_settings_are_compared_on_the_trajectories_that_all_runs_of_a_domain_have(tmp_path: Path) -> None:
    """The setting with noise 0.3 has half the error in every scene; that with 1.0 lacks the scenes with large errors."""
    write_run(tmp_path / "a", "sand", "GPE", 0.3, 0, [1e-3, 1e-3, 10e-3, float("inf")])
    write_run(tmp_path / "b", "sand", "GPE", 1.0, 0, [2e-3, 2e-3])
    write_run(tmp_path / "c", "sand", "GNS", 0.3, 0, [3e-3, 3e-3, 3e-3, 3e-3])
    write_run(tmp_path / "d", "snow", "GNS", 0.3, 0, [3e-3, 5e-3, 7e-3])
    report_trials(tmp_path, finished_runs(tmp_path))
    assert [row[-1] for row in table_of(tmp_path)] == ["**3** [3, 3]", "**1** [1, 1]", "2 [2, 2]", "**5** [3, 7]"]
    text = (tmp_path / "trials.md").read_text()
    assert "Left out, because not all runs have them: 2 of 4 trajectories of `val` of sand." in text and "of snow" not in text


def test_trajectories_that_all_runs_have_need_no_note(trials: Path) -> None:
    report_trials(trials, finished_runs(trials))
    assert "Left out" not in (trials / "trials.md").read_text()


def test_runs_without_shared_trajectories_have_no_errors_to_compare(tmp_path: Path) -> None:
    for name, noise in (("a", 0.3), ("b", 1.0)):
        write_run(tmp_path / name, "sand", "GPE", noise, 0, [1e-3, 2e-3])
        rows = list(read_rows(tmp_path / name / "metrics.csv"))
        write_rows(tmp_path / name / "metrics.csv", [row for row in rows if row.trajectory == (name == "a")])
    report_trials(tmp_path, finished_runs(tmp_path))
    assert [row[-1] for row in table_of(tmp_path)] == ["–", "–"]
    assert "2 of 2 trajectories of `val` of sand." in (tmp_path / "trials.md").read_text()
