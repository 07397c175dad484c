"""Variants of a sweep are compared scene by scene, with the first row as the reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.files import sealed
from gpe_pl.reports.finished_runs import finished_runs
from gpe_pl.reports.ratio_table import NOTE, ratio_text
from gpe_pl.reports.sweep_table import report_sweep

NUM_SCENES = 8
HARD = np.geomspace(1e-4, 1e-1, NUM_SCENES)
"""Errors that differ far more between scenes than between variants."""


def write_run(folder: Path, interaction: str, seed: int, errors: np.ndarray, name: str = "sand", start_time: float | None = None) -> None:
    folder.mkdir(parents=True)
    config = {
        "seed": seed,
        "data": {"name": name, "solver": {"frame_dt": 0.005}},
        "model": {"_target_": "gpe_pl.models.gpe.GPE", "interaction": interaction},
        "graph": {"history": 5},
        "training": {"num_steps": 10},
        "evaluation": {"start_time": start_time},
    }
    sealed.write(folder / "config.json", config)
    pairs = [(model, k, value) for model, values in ((LEARNED, errors), ("ballistic", 10 * HARD)) for k, value in enumerate(values)]
    write_rows(folder / "metrics.csv", [Row(model, "test", k, "seen", 20.0, "rollout_mse", "full", value) for model, k, value in pairs])


def ratios(folder: Path) -> dict[str, str]:
    """Return the last column of the table of ratios by variant; empty if there is no such table."""
    report_sweep(folder, finished_runs(folder))
    before, _, _ = (folder / "table.md").read_text().partition(NOTE)
    if NOTE not in (folder / "table.md").read_text():
        return {}
    lines = before.strip().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[len(lines) - lines[::-1].index("") :]]
    assert rows[0] == ["interaction", "split", "@full"]
    return {row[0]: row[-1] for row in rows[2:]}


def test_a_ratio_of_two_failures_is_no_number() -> None:
    failed, fine = np.array([[1e-3, np.inf]]), np.array([[1e-3, 2e-3]])
    assert ratio_text(5 * failed, failed, np.mean) == "both failed"
    assert ratio_text(fine, fine, np.mean).startswith("1.00 ")
    assert ratio_text(failed, fine, np.mean).startswith("inf ")


def test_scenes_are_paired(tmp_path: Path) -> None:
    """Intervals of the errors overlap, those of the ratio do not reach 1."""
    for seed in (0, 1):
        write_run(tmp_path / f"a{seed}", "directed", seed, HARD)
        write_run(tmp_path / f"b{seed}", "negated", seed, (0.79 + 0.02 * seed) * HARD)
        write_run(tmp_path / f"c{seed}", "odd", seed, HARD[::-1])
    found = ratios(tmp_path)
    assert found["directed"] == "1"
    assert found["negated"] == "**0.80** [0.79, 0.81]"
    low, high = (float(x) for x in found["odd"].removeprefix("1.00 [").removesuffix("]").split(","))
    assert low < 0.2 and high > 2


def test_one_seed_is_not_significant_and_a_failed_rollout_counts_as_ballistic_flight(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "directed", 0, HARD)
    write_run(tmp_path / "b", "negated", 0, 0.5 * HARD)
    failed = 0.5 * HARD
    failed[-1] = np.inf
    write_run(tmp_path / "c", "odd", 0, failed)
    found = ratios(tmp_path)
    assert found["negated"] == "0.50 [0.50, 0.50]"
    expected = (0.5 * HARD[:-1].sum() + 10 * HARD[-1]) / HARD.sum()
    assert found["odd"].startswith(f"{expected:.2f} [")


@pytest.mark.parametrize("other", [{"name": "snow"}, {"start_time": 0.3}])
def test_different_scenes_have_no_ratio(other: dict[str, str | float], tmp_path: Path) -> None:
    write_run(tmp_path / "a", "directed", 0, HARD)
    write_run(tmp_path / "b", "negated", 0, HARD, **other)  # type: ignore[arg-type]
    assert ratios(tmp_path) == {}
    only = tmp_path / "only"
    write_run(only / "a", "directed", 0, HARD)
    assert ratios(only) == {}
