"""Models of several scales are compared with specialists at each spacing and frame interval."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row, read_rows, write_rows
from gpe_pl.files import sealed
from gpe_pl.reports.domain_table import TableError
from gpe_pl.reports.finished_runs import finished_runs
from gpe_pl.reports.tables import write_tables

SCENES = 3


def write_run(folder: Path, use: str, factor: float, stride: int, error: float, failed: bool = False) -> None:
    """Write a run whose error grows from scene to scene; a failed rollout counts as ballistic flight, whose error is 1."""
    folder.mkdir(parents=True)
    several = use != "one"
    data = {
        "name": f"sand_{1.0 if several else factor}",
        "stride": 1 if several else stride,
        "scene": {"grid_spacing": 0.02 * (1.0 if several else factor)},
        "solver": {"frame_dt": 0.005},
        "scales": {"spacing_factors": [0.5, 2.0], "strides": [1, 4]} if several else None,
    }
    config = {
        "seed": 0,
        "data": data,
        "graph": {"scales": use},
        "model": {"_target_": "gpe_pl.models.gpe.GPE"},
        "training": {"num_steps": 10},
        "evaluation": {"data": {"spacing_factor": factor, "stride": stride}},
    }
    sealed.write(folder / "config.json", config)
    rows = []
    for k in range(SCENES):
        for horizon in ("0.1s", "full"):
            value = float("inf") if failed and k == 0 else error * (k + 1)
            rows.append(Row(LEARNED, "test", k, "seen", 20.0, "rollout_mse", horizon, value))
            rows.append(Row("ballistic", "test", k, "seen", 20.0, "rollout_mse", horizon, 1.0))
    write_rows(folder / "metrics.csv", rows)


def test_each_scale_has_a_line_with_ratios_to_its_specialist(tmp_path: Path) -> None:
    for factor in (0.5, 1.0):
        for stride in (1, 2):
            write_run(tmp_path / f"one {factor} {stride}", "one", factor, stride, 1e-3)
            write_run(tmp_path / f"told {factor} {stride}", "dimensionless", factor, stride, 1.25e-3)
            write_run(tmp_path / f"not {factor} {stride}", "dimensional", factor, stride, 4e-3, failed=factor == stride == 1)
    write_tables(tmp_path, finished_runs(tmp_path))
    lines = (tmp_path / "scales.md").read_text().splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:6] if "---" not in line]
    assert table[0][:4] == ["spacing [mm]", "frame [ms]", "in training", "specialist at 0.1s [1e-3 m²]"]
    assert table[0][4:] == ["several scales at 0.1s", "without features at 0.1s", "failed"]
    told, without = "1.25 [1.25, 1.25]", "4.00 [4.00, 4.00]"
    assert table[1] == ["10", "5", "both", "2", told, without, "0 / 0 / 0"]
    assert table[2] == ["10", "10", "spacing", "2", told, without, "0 / 0 / 0"]
    assert table[3][:5] == ["20", "5", "frame", "2", told] and table[3][6] == "0 / 0 / 1"
    assert float(table[3][5].split()[0]) > 100  # one rollout counts as free flight
    assert table[4][:5] == ["20", "10", "neither", "2", told]


def test_a_scale_without_a_specialist_is_not_compared(tmp_path: Path) -> None:
    write_run(tmp_path / "one", "one", 0.5, 1, 1e-3)
    for stride in (1, 2):
        write_run(tmp_path / f"told {stride}", "dimensionless", 0.5, stride, 1e-3)
    write_tables(tmp_path, finished_runs(tmp_path))
    assert "| 10 | 10 | spacing | not measured | not measured |" in (tmp_path / "scales.md").read_text()


def test_other_sweeps_have_no_such_table(tmp_path: Path) -> None:
    for stride in (1, 2):
        write_run(tmp_path / str(stride), "one", 1.0, stride, 1e-3)
    write_tables(tmp_path, finished_runs(tmp_path))
    assert not (tmp_path / "scales.md").exists()


def test_runs_without_a_common_instant_are_compared_over_their_full_length(tmp_path: Path) -> None:
    write_run(tmp_path / "one", "one", 1.0, 1, 1e-3)
    write_run(tmp_path / "told", "dimensionless", 1.0, 1, 1.25e-3)
    for name in ("one", "told"):
        rows = read_rows(tmp_path / name / "metrics.csv")
        write_rows(tmp_path / name / "metrics.csv", [row for row in rows if row.horizon == "full"])
    write_tables(tmp_path, finished_runs(tmp_path))
    header, _, line, *_ = (tmp_path / "scales.md").read_text().splitlines()
    assert "specialist at full [1e-3 m²]" in header
    assert "1.25 [1.25, 1.25]" in line


def change(folder: Path, part: str, **values: Any) -> None:
    config = sealed.read(folder / "config.json", "")
    sealed.write(folder / "config.json", config | {part: config[part] | values})


@pytest.mark.parametrize(
    ("part", "values", "axis"),
    [
        ("data", {"name": "snow"}, "data.name"),
        ("model", {"_target_": "gpe_pl.models.gns.GNS"}, "model._target_"),
        ("training", {"num_steps": 20}, "training.num_steps"),
    ],
)
def test_runs_of_other_domains_models_or_settings_are_no_seeds(tmp_path: Path, part: str, values: dict[str, Any], axis: str) -> None:
    for name, use in (("one", "one"), ("other", "one"), ("told", "dimensionless")):
        write_run(tmp_path / name, use, 1.0, 1, 1e-3)
    change(tmp_path / "other", part, **values)
    with pytest.raises(TableError, match=f"graph.scales=one at 20 mm and 5 ms differ in {axis}, not in the seed alone"):
        write_tables(tmp_path, finished_runs(tmp_path))
    assert not (tmp_path / "scales.md").exists()


@pytest.mark.parametrize(
    ("part", "values"), [("model", {"_target_": "gpe_pl.models.gns.GNS"}), ("data", {"solver": {"frame_dt": 0.005, "law": "snow"}})]
)
def test_a_specialist_of_another_model_or_material_does_not_compare(tmp_path: Path, part: str, values: dict[str, Any]) -> None:
    write_run(tmp_path / "one", "one", 1.0, 1, 1e-3)
    write_run(tmp_path / "told", "dimensionless", 1.0, 1, 1e-3)
    change(tmp_path / "one", part, **values)
    with pytest.raises(TableError, match="models of one scale and of several scales differ in"):
        write_tables(tmp_path, finished_runs(tmp_path))
