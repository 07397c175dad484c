"""Table 1 from run folders with known numbers."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from gpe_pl.config.entry_point import Report
from gpe_pl.evaluation.metric_rows import LEARNED, Row, read_rows, write_rows
from gpe_pl.files import sealed
from gpe_pl.reports import domain_table
from gpe_pl.reports.domain_table import TableError, compares_models, report_domains
from gpe_pl.reports.finished_runs import finished_runs

ERRORS = {
    ("sand", "GPE"): [[1e-3, 3e-3], [2e-3, 2e-3], [8e-3, 8e-3]],  # mean 2, 2 and 8, median 2
    ("sand", "GNS"): [[4e-3, 4e-3]],
    ("sand", "DPINet"): [[20e-3, 20e-3]],
    ("fem", "GPE"): [[5e-3, 5e-3]],
    ("fem", "GNS"): [[float("inf"), 1e-3]],
}
BALLISTIC = {"sand": 30e-3, "fem": 8e-3, "fluid": 1.0, "fluid_2d": 1.0, "fem_3d": 1.0}


def write_run(
    folder: Path, domain: str, model: str, seed: int, errors: list[float], checksum: str | None = None, **trivial: list[float]
) -> None:
    """Write a run; scenes alternate between trained values and others. Trivial models are given as lists, or ballistic flight is the same in all scenes."""
    folder.mkdir(parents=True)
    config = {
        "seed": seed,
        "data": {"name": domain, "parameters": {"solid" if domain == "fem" else domain: {"seen": [20.0]}}},
        "model": {"_target_": f"gpe_pl.models.x.{model}"},
        "training": {"num_steps": 1000},
    }
    sealed.write(folder / "config.json", config if checksum is None else {**config, "data_sha256": {"train": checksum}})
    rows = []
    for name, values in {LEARNED: errors, "ballistic": [BALLISTIC[domain]] * len(errors), **trivial}.items():
        for k, value in enumerate(values):
            group = ("interpolated", "extrapolated")[k % 2]
            rows.append(Row(name, "test_unseen", k, group, 20.0 + k, "rollout_mse", "full", value))
        rows.append(Row(name, "test", 0, "seen", 20.0, "rollout_mse", "full", 1e-3))
    write_rows(folder / "metrics.csv", rows)


@pytest.fixture(autouse=True)
def _without_figures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures, which take a second; one test looks at them."""
    if "figures" not in request.node.name:
        monkeypatch.setattr(domain_table, "_figures", lambda *_: None)


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    for (domain, model), seeds in ERRORS.items():
        for seed, errors in enumerate(seeds):
            write_run(tmp_path / domain / model / str(seed), domain, model, seed, errors)
    return tmp_path


def cells(text: str, domain: str) -> dict[str, str]:
    lines = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    header = next(line for line in lines if line[0] == "domain")
    return dict(zip(header, next(line for line in lines if line[0] == domain), strict=True))


def test_the_table_judges_medians_over_seeds_on_unseen_parameters(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    text = (sweep / "table1.md").read_text()
    sand, fem = cells(text, "sand"), cells(text, "fem")
    assert sand["GPE"].startswith("2 [")
    assert sand["GNS"].startswith("4 [4, 4]")
    assert (
        sand["GPE / best baseline"] == "0.50 [0.25, 2.00]"
    )  # of the medians of [1, 3], [2, 2], [8, 8] over 4, either trajectory, any seeds
    assert sand["DPINet"].startswith("*not learned* (20 ")  # 30 / 20 is less than two
    assert sand["ballistic"] == "30"
    assert sand["paper"] == "0.68"
    assert fem["GPE"].startswith("*not learned* (5 [5, 5])")
    assert fem["GNS"] == "*not learned* (4.5 [1, 8], 1 of 2 failed)"
    assert fem["GPE / best baseline"] == "no model learned"
    assert "1,000 × 3" in text


def test_a_second_table_has_the_medians_over_trajectories(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    text = (sweep / "table1.md").read_text().partition("no comparison uses it.")[2].partition("Training")[0]
    assert cells(text, "sand") == {"domain": "sand", "DPINet": "20", "GNS": "4", "GPE": "2.5", "GPE / best baseline": "0.62"}
    assert cells(text, "fem")["GPE / best baseline"] == "1.11"  # 5 over the median of 1 and ballistic flight's 8


@pytest.mark.parametrize("domain", ["sand", "snow", "elastomer", "fem", "fluid"])
def test_all_domains_are_held_out_on_values_between_trained_ones_and_outside(
    domain: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BALLISTIC, domain, 30e-3)
    write_run(tmp_path / "run", domain, "GPE", 0, [1e-3, 5e-3])
    report_domains(tmp_path, finished_runs(tmp_path))
    assert cells((tmp_path / "table1.md").read_text(), domain)["GPE"] == "3 [1, 5]"


@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_a_failed_rollout_counts_as_ballistic_flight_in_its_scene(tmp_path: Path, domain: str) -> None:
    flight = [70e-3, 10e-3]
    write_run(tmp_path / "GPE", domain, "GPE", 0, [2e-3, 3e-3], ballistic=flight)
    write_run(tmp_path / "GNS", domain, "GNS", 0, [4e-3, float("inf")], ballistic=flight)
    write_run(tmp_path / "DPINet", domain, "DPINet", 0, [12e-3, 13e-3], ballistic=flight)
    report_domains(tmp_path, finished_runs(tmp_path))
    row = cells((tmp_path / "table1.md").read_text(), domain)
    assert row["GNS"] == "7 [4, 10], 1 of 2 failed"
    assert row["GPE / best baseline"] == "0.36 [0.30, 0.50]"  # 2.5 over 7; 3 over 10 and 2 over 4
    assert row["GPE / best baseline, failed = ∞"] == "0.20 [0.17, 0.23]"  # then GNS has not learned


def test_the_best_trivial_baseline_says_what_has_learned(tmp_path: Path) -> None:
    write_run(tmp_path / "GPE", "sand", "GPE", 0, [4e-3, 4e-3], stops_at_walls=[7e-3, 7e-3])
    write_run(tmp_path / "before", "fluid", "GPE", 0, [4e-3, 4e-3])
    report_domains(tmp_path, finished_runs(tmp_path))
    text = (tmp_path / "table1.md").read_text()
    row = cells(text, "sand")
    assert row["GPE"].startswith("*not learned* (4 ") and row["ballistic"] == "30" and row["stops at walls"] == "7"
    assert cells(text, "fluid")["stops at walls"] == "–"  # not evaluated


def test_the_csv_has_every_number_once(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    with open(sweep / "table1.csv", newline="") as handle:
        reader = csv.DictReader(handle)
        assert reader.fieldnames == ["domain", "model", "seed", "split", "metric", "full"]
        rows = list(reader)
    keys = [tuple(r.values())[:-1] for r in rows]
    assert len({*keys}) == len(keys)
    found = {(r["domain"], r["model"], r["seed"], r["split"]): float(r["full"]) for r in rows}
    assert found["sand", "GPE", "0", "test_unseen/interpolated"] == pytest.approx(1e-3)
    assert found["sand", "GPE", "0", "test_unseen"] == pytest.approx((1e-3 + 3e-3) / 2)
    assert found["sand", "ballistic", "", "test_unseen/interpolated"] == pytest.approx(30e-3)


def test_on_other_scenes_the_papers_ratios_are_left_out(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    assert "paper" in cells((sweep / "table1.md").read_text(), "sand")
    for path in sweep.rglob("config.json"):
        config = json.loads(path.read_text())
        sealed.write(path, config | {"evaluation": {"data": {"name": "larger", "scene": {"num_particles": 9}}}})
    report_domains(sweep, finished_runs(sweep))
    text = (sweep / "table1.md").read_text()
    assert "paper" not in text
    assert cells(text, "sand")["GPE / best baseline"] == "0.50 [0.25, 2.00]"


@pytest.mark.slow
def test_figures_are_drawn(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    assert all((sweep / name).stat().st_size > 1000 for name in ("table1.png", "error_by_parameter.png"))


def test_only_sweeps_over_models_or_domains_compare_models(sweep: Path) -> None:
    assert compares_models(finished_runs(sweep))
    assert not compares_models(finished_runs(sweep / "sand" / "GPE"))
    assert not compares_models(finished_runs(sweep / "nothing"))


@pytest.mark.parametrize(
    ("own", "baseline", "cell"),
    [
        ([1e-3, 2e-3], [4e-3, 8e-3], "0.25 [0.25, 0.25]"),
        ([8e-3, 16e-3], [4e-3, 8e-3], "2.00 [2.00, 2.00]"),
        ([20e-3, 20e-3], [5e-3, 10e-3], "2.67 [2.00, 4.00], not learned"),
        ([float("inf"), 1e-3], [4e-3, 4e-3], "3.88 [0.25, 7.50], not learned"),
        ([1e-3, 1e-3], [20e-3, 20e-3], "no baseline learned"),
        ([20e-3, 20e-3], [20e-3, 20e-3], "no model learned"),
    ],
)
def test_a_comparison_that_is_lost_is_said(tmp_path: Path, own: list[float], baseline: list[float], cell: str) -> None:
    write_run(tmp_path / "a", "sand", "GPE", 0, own)
    write_run(tmp_path / "b", "sand", "GNS", 0, baseline)
    report_domains(tmp_path, finished_runs(tmp_path))
    assert cells((tmp_path / "table1.md").read_text(), "sand")["GPE / best baseline"] == cell


@pytest.mark.parametrize(
    ("num_seeds", "num_scenes", "cell"), [(2, 6, "**0.25** [0.25, 0.25]"), (2, 5, "0.25 [0.25, 0.25]"), (1, 6, "0.25 [0.25, 0.25]")]
)
def test_few_seeds_or_scenes_make_no_difference_significant(tmp_path: Path, num_seeds: int, num_scenes: int, cell: str) -> None:
    for seed in range(2):
        write_run(tmp_path / f"a{seed}", "sand", "GPE", seed, [1e-3] * num_scenes)
        if seed < num_seeds:
            write_run(tmp_path / f"b{seed}", "sand", "GNS", seed, [4e-3] * num_scenes)
    report_domains(tmp_path, finished_runs(tmp_path))
    assert cells((tmp_path / "table1.md").read_text(), "sand")["GPE / best baseline"] == cell


def test_what_is_no_training_run_and_what_is_there_twice_is_left_out(sweep: Path, caplog: pytest.LogCaptureFixture) -> None:
    report_domains(sweep, finished_runs(sweep))
    before = (sweep / "table1.md").read_text()
    shutil.copytree(sweep / "sand" / "GPE" / "0", sweep / "sand" / "GPE" / "0 copy")
    evaluation = shutil.copytree(sweep / "sand" / "GPE" / "0", sweep / "evaluated")
    sealed.write(evaluation / "config.json", {"checkpoint": "best.ckpt"})
    report_domains(sweep, finished_runs(sweep))
    assert (sweep / "table1.md").read_text() == before
    assert "0 copy repeats" in caplog.text
    assert "evaluated is not a training run (its configuration lacks data.name, model._target_" in caplog.text


def test_trajectories_that_a_seed_lacks_are_left_out(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "sand", "GPE", 0, [1e-3, 3e-3, 50e-3])
    write_run(tmp_path / "1", "sand", "GPE", 1, [1e-3, 3e-3])
    write_run(tmp_path / "2", "sand", "GNS", 0, [2e-3, 6e-3, 1e-3])
    report_domains(tmp_path, finished_runs(tmp_path))
    row = cells((tmp_path / "table1.md").read_text(), "sand")
    assert row["GPE"].startswith("2 [") and row["GPE / best baseline"] == "0.50 [0.50, 0.50]"


def test_a_run_without_the_held_out_split_does_not_hide_the_others(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "sand", "GPE", 0, [])
    write_run(tmp_path / "1", "sand", "GPE", 1, [2e-3, 2e-3])
    report_domains(tmp_path, finished_runs(tmp_path))
    assert cells((tmp_path / "table1.md").read_text(), "sand")["GPE"].startswith("2 [2, 2]")


def change(folder: Path, part: str, **values: Any) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    sealed.write(path, config | {part: config.get(part, {}) | values})


@pytest.mark.parametrize(("part", "key"), [("training", "num_steps"), ("model", "decoder"), ("evaluation", "clamp_parameters")])
def test_runs_that_differ_in_more_than_the_seed_are_no_seeds(sweep: Path, part: str, key: str) -> None:
    change(sweep / "sand" / "GPE" / "1", part, **{key: 7})
    with pytest.raises(TableError, match=f"GPE on sand differ in {part}.{key}, not in the seed alone"):
        report_domains(sweep, finished_runs(sweep))
    assert not (sweep / "table1.csv").exists()


def test_seeds_trained_for_other_numbers_of_steps_are_refused_and_the_table_stays(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another measurement of step times can cause this. It is a mistake to report, not a trial of settings that replaces the table."""
    report_sweep_of(sweep)
    table = (sweep / "table1.md").read_text()
    change(sweep / "sand" / "GPE" / "1", "training", num_steps=7)
    with pytest.raises(SystemExit):
        report_sweep_of(sweep)
    assert "GPE on sand differ in training.num_steps" in capsys.readouterr().err
    assert (sweep / "table1.md").read_text() == table
    assert not (sweep / "trials.md").exists()


def report_sweep_of(folder: Path) -> None:
    """Report as a command does at the end of its sweep."""
    Report().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}))


def test_the_table_is_printed(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report_sweep_of(sweep)
    assert (sweep / "table1.md").read_text() in capsys.readouterr().out


def test_rollouts_from_different_times_do_not_compare(sweep: Path) -> None:
    for run in finished_runs(sweep / "sand"):
        change(run.folder, "graph", history=1 if "GPE" in run.folder.parts else 5)
    with pytest.raises(TableError, match=r"models on sand start at different times \(frame 1, frame 5: evaluation.start_time"):
        report_domains(sweep, finished_runs(sweep))
    for run in finished_runs(sweep / "sand" / "GPE"):
        change(run.folder, "evaluation", start_frame=5)  # as in runs of earlier versions
    report_domains(sweep, finished_runs(sweep))
    for run in finished_runs(sweep / "sand"):
        change(run.folder, "evaluation", start_time=0.025)
    report_domains(sweep, finished_runs(sweep))


def test_models_held_out_on_other_scenes_do_not_compare(sweep: Path) -> None:
    change(sweep / "sand" / "GNS" / "0", "evaluation", data={"name": "sand_held_out"})
    with pytest.raises(TableError, match=r"models on sand .* different data \(evaluation.data.name\)"):
        report_domains(sweep, finished_runs(sweep))


def test_models_are_compared_on_the_same_trajectories(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_run(tmp_path / "GPE", "sand", "GPE", 0, [1e-3, 3e-3, 5e-3])
    write_run(tmp_path / "GNS", "sand", "GNS", 0, [4e-3, 6e-3, 10e-3])
    rows = list(read_rows(tmp_path / "GNS" / "metrics.csv"))
    write_rows(tmp_path / "GNS" / "metrics.csv", [r for r in rows if r.trajectory != 1])
    report_domains(tmp_path, finished_runs(tmp_path))
    row = cells((tmp_path / "table1.md").read_text(), "sand")
    assert row["GPE"].startswith("3 [") and row["GNS"].startswith("7 [") and row["GPE / best baseline"].startswith("0.43 ")
    assert "sand: compared on the 2 of 3 trajectories" in caplog.text


def test_a_failed_rollout_is_counted(tmp_path: Path) -> None:
    for seed, errors in enumerate([[1e-3, 1e-3], [3e-3, 3e-3], [float("inf"), 1e-3]]):
        write_run(tmp_path / str(seed), "sand", "GPE", seed, errors)
    report_domains(tmp_path, finished_runs(tmp_path))
    row = cells((tmp_path / "table1.md").read_text(), "sand")
    assert row["GPE"] == "3 [1, 30], 1 of 6 failed"


def test_runs_with_other_pictures_are_seeds_all_the_same(sweep: Path) -> None:
    report_domains(sweep, finished_runs(sweep))
    before = (sweep / "table1.md").read_text()
    change(sweep / "sand" / "GPE" / "1", "evaluation", num_pictures=7)
    report_domains(sweep, finished_runs(sweep))
    assert (sweep / "table1.md").read_text() == before


def test_the_csv_has_the_means_over_the_trajectories_that_all_runs_of_a_domain_have(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_run(tmp_path / "GNS", "sand", "GNS", 0, [4e-3, 6e-3, 50e-3, 50e-3], ballistic=[10e-3, 20e-3, 90e-3, 90e-3])
    write_run(tmp_path / "GPE", "sand", "GPE", 0, [1e-3, 3e-3], ballistic=[10e-3, 20e-3])
    write_run(tmp_path / "fem", "fem", "GPE", 0, [1e-3, 3e-3, 5e-3])
    whole = Row(LEARNED, "test_unseen", -1, "", float("nan"), "one_step_nmse", "1", 0.7)
    write_rows(tmp_path / "GNS" / "metrics.csv", [*read_rows(tmp_path / "GNS" / "metrics.csv"), whole])
    report_domains(tmp_path, finished_runs(tmp_path))
    with open(tmp_path / "table1.csv", newline="") as handle:
        found = {(r["domain"], r["model"], r["split"]): float(r["full"]) for r in csv.DictReader(handle) if r["full"]}
    own = {model: found["sand", model, "test_unseen"] for model in ("GPE", "GNS", "ballistic")}
    assert own == pytest.approx({"GPE": 2e-3, "GNS": 5e-3, "ballistic": 15e-3})
    assert found["sand", "GNS", "test_unseen/extrapolated"] == pytest.approx(6e-3)
    assert found["sand", "GNS", "test"] == pytest.approx(1e-3) and found["fem", "GPE", "test_unseen"] == pytest.approx(3e-3)
    assert "sand,GNS,0,test_unseen,one_step_nmse,0.7," in (tmp_path / "table1.csv").read_text()  # of the whole split
    assert "table1.csv: means of sand over the 2 of 4 trajectories of test_unseen that all runs have evaluated" in caplog.text
