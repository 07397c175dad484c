"""Whether a model reads the material, from rows with known numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from gpe_pl.evaluation.material_controls import CONTROLS, SOLVER_ENDS, SOLVER_NEAREST, UNSEEN, label_of
from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.files import sealed
from gpe_pl.reports import sweep_table
from gpe_pl.reports.domain_table import report_domains
from gpe_pl.reports.finished_runs import Run, finished_runs
from gpe_pl.reports.material_table import _errors, _means, _without, material_lines, reads_material, verdict, write_material_figure
from gpe_pl.reports.parameter_curves import axis_label
from gpe_pl.viz import comparison

HARD = np.array([1.0, 2.0, 4.0, 8.0, 3.0, 5.0])
"""Errors of six scenes [1e-3 m²]; those with odd numbers are extrapolated in pairs, so their errors are not used."""


def write_run(
    folder: Path, embedding: str, seed: int, factors: dict[str, float], model: str = "gpe_pl.models.gpe.GPE", data: str = "sand"
) -> None:
    """Write a run whose error in each interpolated scene is that of ``HARD`` with a factor per control."""
    folder.mkdir(parents=True)
    settings = {"_target_": model, "material_embedding": embedding}
    parameters = {"sand": {"seen": [20.0, 30.0]}}
    config = {"seed": seed, "data": {"name": data, "parameters": parameters}, "model": settings, "training": {"num_steps": 10}}
    sealed.write(folder / "config.json", config)
    labels = {control: label_of(LEARNED, control) for control in CONTROLS} | {"own": LEARNED}
    labels |= {"solver": SOLVER_NEAREST, "ends": SOLVER_ENDS, "ballistic": "ballistic"}
    rows = []
    for name, factor in ({"ballistic": 50.0} | factors).items():
        for k, error in enumerate(HARD):
            value = 1e-3 * factor * error * (1 + 0.3 * seed)
            rows.append(Row(labels[name], UNSEEN, 2 * k, "interpolated", 20.5 + k, "rollout_mse", "full", value))
            rows.append(
                Row(labels[name], UNSEEN, 2 * k, "interpolated", 20.5 + k, "rollout_mse", "0.1s", value * (0.5 if name == "own" else 1.0))
            )
            rows.append(Row(labels[name], UNSEEN, 2 * k, "interpolated", 20.5 + k, "rollout_mse", "0.025s", value))
            rows.append(Row(labels[name], UNSEEN, 2 * k + 1, "extrapolated", 50.0 + k, "rollout_mse", "full", 1.0))
    write_rows(folder / "metrics.csv", rows)


READS = {"own": 0.9, "nearest": 1.0, "middle": 2.0, "far": 4.0, "shuffled": 3.0, "solver": 0.2, "ends": 1.5}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    for seed in (0, 1):
        write_run(tmp_path / "affine" / str(seed), "affine", seed, READS)
        write_run(tmp_path / "none" / str(seed), "none", seed, READS | dict.fromkeys(("own", *CONTROLS), 1.2))
    return tmp_path


def test_a_model_reads_the_material_if_its_own_value_is_better_in_the_same_scenes(sweep: Path) -> None:
    runs: dict[Any, list[Run]] = {run.config["model.material_embedding"]: [] for run in finished_runs(sweep)}
    for run in finished_runs(sweep):
        runs[run.config["model.material_embedding"]].append(run)
    for embedding, expected, reads in (("affine", 0.9, True), ("none", 1.0, False)):
        found = reads_material(runs[embedding])
        assert found is not None and found[0] is reads and found[2] == len(HARD)
        assert (found[1].low, found[1].estimate, found[1].high) == pytest.approx((expected,) * 3)  # scenes and seeds are paired
    assert verdict(runs["affine"][:1]).startswith(
        "reads the material: yes (error with own parameters over that with the nearest trained ones: 0.90 ["
    )


def test_an_interval_that_reaches_1_does_not_read(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "affine", 0, READS)
    (run,) = finished_runs(tmp_path)
    nearest = run.rows["model"] == label_of(LEARNED, "nearest")
    run.rows.loc[nearest, "value"] *= np.resize([0.7, 1.0, 1.2, 1.0, 1.5, 1.0], int(nearest.sum()))
    found = reads_material([run])
    assert found is not None and found[1].low < found[1].estimate < 1 < found[1].high and not found[0]
    run.rows.loc[nearest & (run.rows["trajectory"] == 0), "value"] = np.inf  # fails, and counts as ballistic flight
    failed = reads_material([run])
    assert failed is not None and np.isfinite(failed[1].estimate) and failed[1].estimate < found[1].estimate


def test_few_scenes_give_no_verdict(sweep: Path) -> None:
    run = finished_runs(sweep)[0]
    few = replace(run, rows=run.rows[run.rows["trajectory"] < 2 * (len(HARD) - 1)])
    assert verdict([run]).startswith("reads the material: yes ")
    assert verdict([few]).startswith("reads the material: too few scenes (") and "0.90 [0.90, 0.90]" in verdict([few])
    assert "| too few scenes |" in "\n".join(material_lines({("sand", "GPE"): [few]}))


@pytest.mark.slow
def test_the_table_of_a_sweep_has_every_control(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep_table.report_sweep(sweep, finished_runs(sweep))
    text = (sweep / "table.md").read_text()
    rows = {cells[1]: cells for line in text.splitlines() if len(cells := [c.strip() for c in line.strip("|").split("|")]) == 15}
    factors = [READS[name] for name in ("own", *CONTROLS)] + [1.2]
    means = [f"{f * HARD.mean() * 1.15:.3g}" for f in factors] + [f"{READS[name] * HARD.mean():.3g}" for name in ("solver", "ends")]
    farther = [f"{ratio:.2f} [{ratio:.2f}, {ratio:.2f}]" for ratio in (0.9 / READS["middle"], 0.9 / READS["shuffled"])]
    assert rows["affine"] == ["sand", "affine", *means, "0.90 [0.90, 0.90]", "yes", *farther, f"{0.9 * 1.15 / 1.5:.2f}"]
    assert rows["none"][11:14] == ["no", "1.00 [1.00, 1.00]", "1.00 [1.00, 1.00]"]
    assert (sweep / "reads_material.png").stat().st_size > 10_000
    rollouts = [line for line in text.splitlines() if "nearest value" in line]
    assert not rollouts  # controls are no baselines
    assert "yes" in rows["affine"] and "reads the material: yes" in sweep_table.conclusion(sweep / "affine" / "0")


@pytest.mark.slow
def test_tables_of_domains_have_the_controls_of_every_model(tmp_path: Path) -> None:
    write_run(tmp_path / "gpe", "affine", 0, READS)
    write_run(tmp_path / "gns", "feature", 0, READS | {"own": 1.3}, model="gpe_pl.models.gns.GNS")
    report_domains(tmp_path, finished_runs(tmp_path))
    lines = (tmp_path / "table1.md").read_text().splitlines()
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in lines]
    assert [(c[0], c[1], c[11]) for c in cells if len(c) == 15 and c[0] == "sand"] == [("sand", "GNS", "no"), ("sand", "GPE", "yes")]
    table = (tmp_path / "table1.csv").read_text()
    assert "sand,GNS at nearest value,0,test_unseen,rollout_mse" in table and "sand,solver at nearest value,,test_unseen" in table
    assert (tmp_path / "reads_material.png").exists()


def test_a_model_without_the_parameter_is_a_curve_beside_the_model(sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(sweep / "alone", "none", 0, READS, data="snow")
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(comparison, "parameter_figure", lambda curves, *_, **__: drawn.update(curves) or Figure())
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in finished_runs(sweep):
        groups.setdefault((str(run.config["data.name"]), str(run.config["model.material_embedding"])), []).append(run)
    write_material_figure(sweep / "reads_material.png", groups)
    assert {*drawn} == {"sand", "snow"}
    errors = {name: np.median([points[20.5 + k] for k in range(6)]) for name, points in drawn["sand"].items()}
    middle = float(np.median([1e-3 * error * (1 + 0.3 * seed) for error in HARD for seed in (0, 1)]))
    assert errors["trained without the parameter"] == pytest.approx(1.2 * middle)
    assert errors["own value"] == pytest.approx(0.9 * middle) and errors["nearest trained value"] == pytest.approx(middle)
    assert len(drawn["sand"]) == 8 and len(drawn["snow"]) == 7


def test_two_models_of_a_domain_have_their_names_above_their_panels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(tmp_path / "run", "affine", 0, READS)
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(comparison, "parameter_figure", lambda curves, *_, **__: drawn.update(curves) or Figure())
    runs = finished_runs(tmp_path)
    write_material_figure(tmp_path / "reads_material.png", {("sand", "A"): runs, ("sand", "B"): [replace(runs[0])]})
    assert [*drawn] == ["sand, A", "sand, B"]


@pytest.mark.parametrize(
    ("material", "label"),
    [
        ("sand", "friction angle [°]"),
        ("fluid", "kinematic viscosity [m²/s]"),
        ("solid", "Young’s modulus [Pa]"),
        ("snow", "hardening coefficient"),
    ],
)
def test_axes_name_the_parameter_and_its_unit(material: str, label: str) -> None:
    assert axis_label(Run(Path(), {f"data.parameters.{material}.seen": "[1.0]"}, pd.DataFrame())) == label


@pytest.mark.slow
def test_runs_without_controls_have_no_table(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "affine", 0, {"own": 1.0})
    runs = finished_runs(tmp_path)
    assert reads_material(runs) is None and verdict(runs) == "" and material_lines({("sand", "GPE"): runs}) == []
    sweep_table.report(tmp_path / "run")
    assert not (tmp_path / "run" / "reads_material.png").exists() and "reads the material" not in sweep_table.conclusion(tmp_path / "run")


def test_short_horizons_have_ratios_of_their_own(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "affine", 0, READS)
    runs = finished_runs(tmp_path)
    lines = material_lines({("sand", "GPE"): runs})
    header, row = (next(line for line in lines if "own / nearest, 0.025s" in line), lines[-3])
    found = dict(zip(cells_of(header), cells_of(row), strict=True))
    assert found["own / nearest, 0.025s"] == "0.90 [0.90, 0.90]" and found["own / nearest, 0.1s"] == "0.45 [0.45, 0.45]"
    assert found["own / effect, 0.025s"] == "0.60" and found["own / effect, 0.1s"] == "0.30"


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_model_without_the_parameter_has_the_settings_of_the_model(tmp_path: Path) -> None:
    """A sweep of another setting has a model without the parameter for each of its values."""
    for history, factor in ((1, 1.0), (5, 10.0)):
        for embedding in ("affine", "none"):
            folder = tmp_path / str(history) / embedding
            write_run(folder, embedding, 0, READS | {"own": factor * (0.9 if embedding == "affine" else 1.3)})
            config = sealed.read(folder / "config.json", "")
            sealed.write(folder / "config.json", {**config, "graph": {"history": history}})
    groups = {("sand", run.folder.parent.name + run.folder.name): [run] for run in finished_runs(tmp_path)}
    own = {key[1]: _means([_errors(_without(groups, "sand", runs), LEARNED)])[0] for key, runs in groups.items()}
    first, second = (float(np.median(1.3e-3 * factor * HARD.mean())) for factor in (1.0, 10.0))
    assert own == pytest.approx({"1affine": first, "1none": first, "5affine": second, "5none": second})


@pytest.mark.parametrize("shorter", [0, 1])
def test_all_columns_are_means_over_the_same_scenes(tmp_path: Path, shorter: int) -> None:
    """The last scenes have large errors, and one seed lacks them."""
    for seed in (0, 1):
        write_run(tmp_path / str(seed), "affine", seed, READS)
    runs = finished_runs(tmp_path)
    runs[shorter] = replace(runs[shorter], rows=runs[shorter].rows[runs[shorter].rows["trajectory"] < 6])
    mean = HARD[:3].mean()
    lines = material_lines({("sand", "GPE"): runs})
    row, horizons = cells_of(lines[2]), dict(zip(cells_of(lines[6]), cells_of(lines[8]), strict=True))
    assert row[2] == f"{0.9 * 1.15 * mean:.3g}" and row[8:10] == [f"{0.2 * mean:.3g}", f"{1.5 * mean:.3g}"]
    assert row[-1] == f"{0.9 * 1.15 / 1.5:.2f}" and horizons["own / effect, 0.025s"] == row[-1]
