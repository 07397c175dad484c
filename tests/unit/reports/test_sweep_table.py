"""Tables of runs with known numbers."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, MetricsError, Row, read_rows, write_rows
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError
from gpe_pl.reports import sweep_table
from gpe_pl.reports.finished_runs import finished_runs, table_of

ERRORS = {  # of two test scenes; free flight has 2e-3 and 6e-3
    ("negated", 0): [1e-3, 3e-3],
    ("negated", 1): [2e-3, 2e-3],
    ("odd", 0): [8e-3, 8e-3],
    ("directed", 0): [float("inf"), 5e-3],
    ("odd_even", 0): [4e6, 4e6],
}


def write_run(folder: Path, interaction: str, seed: int) -> None:
    folder.mkdir(parents=True)
    model = {"_target_": "gpe_pl.models.gpe.GPE", "interaction": interaction}
    sealed.write(folder / "config.json", {"seed": seed, "data": {"name": "sand"}, "model": model, "training": {"num_steps": 10}})
    groups = ("interpolated", "extrapolated")
    rows = [Row(LEARNED, "test_unseen", k, groups[k], 20.0, "rollout_mse", "full", v) for k, v in enumerate(ERRORS[interaction, seed])]
    rows += [Row("ballistic", "test_unseen", k, groups[k], 20.0, "rollout_mse", "full", v) for k, v in enumerate((2e-3, 6e-3))]
    write_rows(folder / "metrics.csv", [*rows, Row("constant_velocity", "test_unseen", 0, groups[0], 20.0, "rollout_mse", "full", 1.0)])
    log = folder / "log" / "version_0"
    log.mkdir(parents=True)
    (log / "metrics.csv").write_text(f"step,val/one_step_nmse\n9,0.9\n19,{0.2 + 0.2 * seed}\n")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for interaction, seed in ERRORS:
        write_run(tmp_path / interaction / str(seed), interaction, seed)
    return tmp_path


def cells(folder: Path, interaction: str) -> list[list[str]]:
    """Return the row of one variant in each table of ``table.md``, without its intervals."""
    lines = (folder / "table.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith(f"| {interaction} ")]
    return [[" ".join(word for word in cell.split() if word[0] != "[" and word[-1] != "]") for cell in row] for row in rows]


@pytest.mark.slow
def test_errors_are_means_and_factors_over_the_best_trivial_baseline(runs: Path) -> None:
    sweep_table.report_sweep(runs, finished_runs(runs))
    training, rollout, *_ = cells(runs, "negated")
    assert training[1:4] == ["2", "10", "0.3000 (0.2000 – 0.4000)"]
    assert rollout[1:] == ["test_unseen", "2 **2.0×**"]
    assert [row[1:] for row in cells(runs, "negated")[2:]] == [
        ["test_unseen/extrapolated", "2.5 **2.4×**"],
        ["test_unseen/interpolated", "1.5 **1.3×**"],
        ["test_unseen", "0.57"],  # of directed's error of 3.5
    ]
    assert cells(runs, "odd")[1][2] == "8 0.5×"
    assert cells(runs, "odd_even")[1][2] == "4e+09 < 0.01×"
    assert cells(runs, "ballistic")[0][2] == "4"


def set_steps(run: Path, num_steps: int, **model: str) -> None:
    """Give a run another number of steps, and other settings of its model."""
    path = run / "config.json"
    config = json.loads(path.read_text())
    config.pop("sha256", None)
    training = config["training"] | {"num_steps": num_steps, "val_interval": num_steps // 2}
    sealed.write(path, config | {"training": training, "model": config["model"] | model})


def test_steps_that_follow_from_a_budget_are_no_setting(runs: Path) -> None:
    for folder, num_steps in (("negated/0", 1200), ("negated/1", 1300), ("odd/0", 1000)):
        set_steps(runs / folder, num_steps)
    axes, variants = sweep_table.variants_of(finished_runs(runs))
    assert axes == ["model.interaction"] and set(variants) == {(name,) for name, _ in ERRORS}
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert cells(runs, "negated")[0][1:3] == ["2", "1,200 – 1,300"]


def test_steps_in_which_runs_differ_are_a_setting(runs: Path) -> None:
    set_steps(runs / "negated" / "0", 1200, interaction="odd")  # with the seed of another run
    axes, variants = sweep_table.variants_of(finished_runs(runs))
    assert "training.num_steps" in axes and len(variants) == len(ERRORS)


@pytest.mark.slow
def test_variants_of_other_scenes_are_named(runs: Path) -> None:
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert "rows of sand have other scenes" not in (runs / "table.md").read_text()
    path = runs / "odd" / "0" / "metrics.csv"
    write_rows(path, [row for row in read_rows(path) if row.trajectory == 0])
    sweep_table.report_sweep(runs, finished_runs(runs))
    (line,) = (line for line in (runs / "table.md").read_text().splitlines() if "have other scenes" in line)
    assert line.startswith(
        "**rows of sand have other scenes of `test_unseen`: 2 (directed), 2 (negated), 1 (odd), 2 (odd_even); only ratios"
    )


@pytest.mark.slow
def test_failed_rollouts_are_named_beside_what_was_corrected(runs: Path) -> None:
    """Frames after a rollout stopped were not corrected, because there are none."""
    for interaction in ("negated", "directed"):
        path = runs / interaction / "0" / "metrics.csv"
        rows = [replace(row, split="test", parameter_group="") for row in read_rows(path)]
        write_rows(path, [*rows, Row(LEARNED, "test", 0, "", 20.0, "fraction_corrected", "full", 0.0)])
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert [cells(runs, name)[0][-1] for name in ("negated", "directed")] == ["0.000 %", "0.000 %, 1 of 2 failed"]


@pytest.mark.slow
def test_seeds_of_other_scenes_are_compared_in_those_that_all_have(runs: Path) -> None:
    path = runs / "negated" / "1" / "metrics.csv"
    write_rows(path, [row for row in read_rows(path) if row.trajectory == 0])
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert cells(runs, "negated")[1][1:] == ["test_unseen", "1.5 **1.3×**"]
    note = "**negated: of 2 scenes of `test_unseen`, columns have only 1 at full, so columns with other scenes cannot be compared**"
    assert note in (runs / "table.md").read_text().splitlines()


@pytest.mark.slow
def test_without_trivial_models_there_is_no_factor(tmp_path: Path) -> None:
    write_run(tmp_path / "odd", "odd", 0)
    rows = [row for row in read_rows(tmp_path / "odd" / "metrics.csv") if row.model == LEARNED]
    write_rows(tmp_path / "odd" / "metrics.csv", rows)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    assert "×**" not in (tmp_path / "table.md").read_text() and "0.01×" not in (tmp_path / "table.md").read_text()


def test_columns_that_some_trajectories_do_not_reach_are_told(runs: Path) -> None:
    rows = [*read_rows(runs / "odd" / "0" / "metrics.csv")]
    earlier = [replace(row, horizon="0.1s", value=row.value / 4) for row in rows if row.trajectory == 0]
    said = sweep_table.summary(table_of([*rows, *earlier])).splitlines()[-1]
    assert said == "of 2 scenes of `test_unseen`, columns have only 1 at 0.1s, so columns with other scenes cannot be compared"
    assert "cannot be compared" not in sweep_table.summary(table_of(rows))


@pytest.mark.slow
def test_forward_times_are_shown_where_all_variants_have_them(runs: Path) -> None:
    networks = {run.folder.relative_to(runs).as_posix(): sweep_table.network_digest(run) for run in finished_runs(runs)}
    names = [f"{name}/0" for name in ("directed", "negated", "odd", "odd_even")]
    ratios = {name: {"ratio": 1.0 + k / 4, "network": networks[name]} for k, name in enumerate(names)}
    sealed.write(runs / "forward_times.json", ratios)
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert [cells(runs, name)[0][4] for name in ("directed", "negated", "odd", "odd_even")] == ["1.00", "1.25", "1.50", "1.75"]
    sealed.write(runs / "forward_times.json", {key: value for key, value in ratios.items() if key != "odd/0"})
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert cells(runs, "negated")[0][4] == "–"
    for changed in ({"network": "of another model", "ratio": 1.0}, 1.0):  # of runs that were deleted, and as earlier versions wrote it
        sealed.write(runs / "forward_times.json", {**ratios, "odd/0": changed})
        sweep_table.report_sweep(runs, finished_runs(runs))
        assert cells(runs, "negated")[0][4] == "–"


@pytest.mark.slow
def test_failed_rollouts_are_counted(runs: Path) -> None:
    sweep_table.report_sweep(runs, finished_runs(runs))
    _, rollout, *_ = cells(runs, "directed")
    assert rollout[2] == "3.5 **1.1×**, 1 of 2 failed"  # ballistic flight's 2 in the scene that failed, and 5


@pytest.mark.slow
def test_the_csv_has_unseen_values_also_apart(runs: Path) -> None:
    sweep_table.report_sweep(runs, finished_runs(runs))
    with open(runs / "table.csv", newline="") as handle:
        lines = [line for line in csv.DictReader(handle) if line["interaction"] == "negated" and line["seed"] == "0"]
    values = {line["split"]: float(line["value"]) for line in lines if line["metric"] == "rollout_mse"}
    assert values == pytest.approx({"test_unseen": 2e-3, "test_unseen/interpolated": 1e-3, "test_unseen/extrapolated": 3e-3})


@pytest.mark.slow
def test_a_repeated_run_counts_once(runs: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_run(runs / "again", "odd", 0)
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert cells(runs, "odd")[0][1] == "1"
    assert "repeats" in caplog.text


@pytest.mark.parametrize(
    "content", [b"{", b"5", b"\xa1\xff", b"[" * 10**6, b'{"a":' * 70 + b"1" + b"}" * 70, b'{"a": 1' + b"0" * 10**5 + b"}", b'{"seed": 0}']
)
def test_a_damaged_configuration_is_named(runs: Path, content: bytes) -> None:
    path = runs / "negated" / "0" / "config.json"
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"negated/0/config.json: .*; delete the folder"):
        sweep_table.report_sweep(runs, finished_runs(runs))


@pytest.mark.parametrize(
    "change", [{"training": {"num_steps": "many"}}, {"data": {"name": 3}}, {"model": {"_target_": None}}, {"training": {"num_steps": True}}]
)
def test_a_configuration_of_other_types_is_named(runs: Path, change: dict[str, Any]) -> None:
    path = runs / "negated" / "0" / "config.json"
    values = sealed.read(path, "")
    sealed.write(path, values | change)
    with pytest.raises(RunError, match=r"negated/0/config.json: [a-z_.]+ is .*; delete the folder"):
        sweep_table.report_sweep(runs, finished_runs(runs))


@pytest.mark.slow
@pytest.mark.parametrize(
    "content", [b"step,val/one_step_nmse\n9,x\n", b"step,val/one_step_nmse\nlast,0.5\n", b"val/one_step_nmse\n0.5\n", b"\xff\n"]
)
def test_a_damaged_log_of_the_training_is_named(runs: Path, content: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_table, "save_figure", lambda *_, **__: None)
    (runs / "odd" / "0" / "log" / "version_mine").mkdir()
    (runs / "odd" / "0" / "log" / "version_mine" / "metrics.csv").touch()  # of somebody else
    sweep_table.report_sweep(runs, finished_runs(runs))
    (runs / "odd" / "0" / "log" / "version_0" / "metrics.csv").write_bytes(content)
    with pytest.raises(MetricsError, match=r"odd/0/log/version_0/metrics.csv, line \d: damaged \(.*; delete the file"):
        sweep_table.report_sweep(runs, finished_runs(runs))


def test_names_of_files_that_are_shown_are_printable(runs: Path) -> None:
    folder = runs / "odd" / "0"
    (folder / "rollout_\x1b[2K_00.html").touch()
    assert "look at" in sweep_table.conclusion(folder) and "\x1b" not in sweep_table.conclusion(folder)


@pytest.mark.slow
def test_a_parameter_that_training_did_not_have_makes_a_figure(runs: Path) -> None:
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert (runs / "error_by_parameter.png").stat().st_size > 1000


@pytest.mark.slow
def test_stress_is_reported_beside_displacement_and_velocity(runs: Path) -> None:
    path = runs / "negated" / "0" / "metrics.csv"
    values = {"displacement_error": 0.25, "velocity_error": 0.5, "von_mises_error": 0.75, "stress_error": 1.25}
    rows = [Row(LEARNED, "test_unseen", 0, "interpolated", 20.0, metric, "full", value) for metric, value in values.items()]
    write_rows(path, [*read_rows(path), *rows])
    sweep_table.report_sweep(runs, finished_runs(runs))
    found = {row[2]: row[3] for row in cells(runs, "negated") if len(row) == 4}
    assert found == {"displacement": "0.25", "velocity": "0.5", "von mises": "0.75", "stress": "1.25"}
    assert not [row for row in cells(runs, "odd") if len(row) == 4]


@pytest.mark.slow
def test_scenes_without_one_parameter_make_no_figure(runs: Path) -> None:
    for path in runs.glob("*/*/metrics.csv"):
        write_rows(path, [replace(row, parameter=float("nan")) for row in read_rows(path)])
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert (runs / "table.md").exists() and not (runs / "error_by_parameter.png").exists()


@pytest.mark.slow
def test_bodies_have_a_table_of_what_was_measured(runs: Path) -> None:
    """The second scene has no bounce to compare with, and one rollout has failed."""
    path = runs / "negated" / "0" / "metrics.csv"
    values = {"deformation_ratio": [0.5, 1.5], "rotation_error": [3.0, float("inf")], "bounce_height_ratio": [0.25]}
    rows = [
        Row(LEARNED, "test_unseen", k, ("interpolated", "extrapolated")[k], 20.0, metric, "full", value)
        for metric, column in values.items()
        for k, value in enumerate(column)
    ]
    sweep_table.report_sweep(runs, finished_runs(runs))
    assert "deformation" not in (runs / "table.md").read_text()
    write_rows(path, [*read_rows(path), *rows])
    sweep_table.report_sweep(runs, finished_runs(runs))
    text = (runs / "table.md").read_text()
    assert "| deformation, ratio | rotation error [°] | bounce height, ratio |" in text and "strain energy" not in text
    found = {row[1]: row[2:] for row in cells(runs, "negated") if len(row) == 5}
    assert found["test_unseen"] == ["1", "1 of 2 failed, median inf", "0.25"]
    assert found["test_unseen/extrapolated"] == ["1.5", "1 of 1 failed, median inf", "–"]
    assert [row[2:] for row in cells(runs, "odd") if len(row) == 5 and row[1] == "test_unseen"] == [["–", "–", "–"]]


@pytest.mark.slow
def test_many_variants_have_tables_and_no_figure(tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(29):
        monkeypatch.setitem(ERRORS, (f"kind{k}", 0), [1e-3, 2e-3])
        write_run(tmp_path / str(k), f"kind{k}", 0)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    assert "29 variants, but no more than 28 can be told apart in one figure; tables only" in caplog.text
    assert "kind28" in (tmp_path / "table.md").read_text()
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_splits_and_horizons_of_later_variants_are_shown(tmp_path: Path) -> None:
    for interaction in ("negated", "odd"):
        write_run(tmp_path / interaction, interaction, 0)
    rows = [*read_rows(tmp_path / "odd" / "metrics.csv")]
    more = [replace(row, split="test", parameter_group="") for row in rows] + [replace(row, horizon="0.1s") for row in rows]
    write_rows(tmp_path / "odd" / "metrics.csv", [*rows, *more])
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    text = (tmp_path / "table.md").read_text()
    assert "@0.1s" in text
    assert any(line.startswith("| odd | test |") for line in text.splitlines())
    assert not any(line.startswith("| negated | test |") and "[" in line for line in text.splitlines())


@pytest.mark.slow
def test_baselines_of_other_scenes_have_rows_of_their_own(tmp_path: Path) -> None:
    for interaction in ("negated", "odd"):
        write_run(tmp_path / interaction, interaction, 0)
    rows = [*read_rows(tmp_path / "odd" / "metrics.csv")]
    write_rows(tmp_path / "odd" / "metrics.csv", [replace(row, value=100 * row.value) if row.model == "ballistic" else row for row in rows])
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    lines = [line for line in (tmp_path / "table.md").read_text().splitlines() if "| test_unseen |" in line]
    assert [line.split("|")[1].strip() for line in lines if "ballistic" in line] == ["ballistic (negated)", "ballistic (odd)"]
    assert sum("constant_velocity" in line for line in lines) == 1


def test_runs_with_and_without_compilation_are_one_variant(tmp_path: Path) -> None:
    for seed, compile in enumerate(("on", "off")):
        folder = tmp_path / str(seed)
        write_run(folder, "negated", seed)
        config = json.loads((folder / "config.json").read_text())
        del config["sha256"]
        sealed.write(folder / "config.json", {**config, "training": {"num_steps": 10, "compile": compile}})
    axes, variants = sweep_table.variants_of(finished_runs(tmp_path))
    assert (axes, [len(found) for found in variants.values()]) == ([], [2])
