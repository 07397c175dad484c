"""Ratios that grew by half against a file of earlier ones are named. No test asserts a time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.benchmarks import performance
from gpe_pl.benchmarks.performance import PerformanceError, Settings, comparison, ratios_in, rollout_records, table
from gpe_pl.benchmarks.trained import Case
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.trajectory import Trajectory


def record(case: str, ratio: float, metric: str = "step_ratio") -> list[dict[str, Any]]:
    names = performance.TIMES[metric]
    values = {names[0]: ratio * 1e-3, names[1]: 1e-3, metric: ratio}
    return [{"metric": name, "case": case, "value": value, "unit": "s"} for name, value in values.items()]


NOW = [*record("sand", 4.0), *record("fem", 4.4), *record("sand", 3.0, "training_step_ratio"), *record("new", 9.0)]


def test_ratios_that_grew_by_half_are_named_with_the_way_to_renew_the_file(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    before = [*record("sand", 2.0), *record("fem", 3.0), *record("sand", 2.0, "training_step_ratio")]
    path.write_text(json.dumps({"records": before}))
    lines = list(comparison(NOW, ratios_in(str(path)), "FILE"))
    assert lines == [
        "rollout step of sand: 4.0 times its products, 2.0 in FILE: grew by 100 %",
        "training step of sand: 3.0 times its products, 2.0 in FILE: grew by 50 %",
        "rollout step of new: FILE has no such ratio",
        "2 of 4 ratios grew by half or more; if the new times are right, renew the file with "
        "`python docs/embed_results.py runs/benchmark/performance performance`",
    ]


def test_ratios_that_did_not_grow_are_not_named(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"records": NOW}))
    assert list(comparison(NOW, ratios_in(str(path)), "FILE")) == ["no ratio grew by half against FILE"]


def test_a_missing_file_is_not_compared_with(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.json")
    assert ratios_in(missing) is None and ratios_in(None) is None
    assert next(comparison(NOW, None, missing)).startswith(f"{missing}: not found in ")
    assert list(comparison(NOW, None, None)) == []


@pytest.mark.parametrize("content", ["", "[]", '{"records": [{"metric": "step_ratio"}]}', "{}"])
def test_a_damaged_file_is_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(content)
    with pytest.raises(PerformanceError, match=r"results\.json: does not hold results of this suite .*set suite\.reference=null"):
        ratios_in(str(path))


def test_the_table_has_a_row_per_ratio() -> None:
    text = table(NOW)
    assert "| rollout step | sand | 4.00 | 1.00 | 4.0 |" in text and "| training step | sand | 3.00 | 1.00 | 3.0 |" in text


def test_an_unknown_case_of_several_scenes_is_named() -> None:
    with pytest.raises(PerformanceError, match=r"suite\.several=snow: must be one of the cases sand"):
        performance.run(Settings({"sand": Case([])}, "snow"), {"sand": dataset("data=sand", "size=small")}, {})


@pytest.mark.slow
def test_several_scenes_are_rolled_out_together(monkeypatch: pytest.MonkeyPatch) -> None:
    def fall(spec: DatasetSpec, split: str, index: int, num_frames: int) -> Trajectory:
        start = initial_state(spec, split, index)
        return rollout(Ballistic(spec.solver.frame_dt), start, num_frames - 1, trajectory_metadata(spec, split, index))

    monkeypatch.setattr(performance, "generate_trajectory", fall)
    records = rollout_records("sand", dataset("data=sand", "size=small", "data.num_test=2"), num_scenes=3, num_rounds=1)
    found = {r["metric"]: r["value"] for r in records}
    assert {r["case"] for r in records} == {"sand, 3 scenes"}
    assert found["step_ratio"] == pytest.approx(found["step_time"] / found["product_time"])
