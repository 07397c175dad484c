"""Quantities of a split are written as a table and drawn over time and over the parameter, and figures also in the formats that were asked for."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gpe_pl.evaluation import split_files
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.evaluation.split_files import SplitFiles
from gpe_pl.metrics.quantities import quantities
from gpe_pl.trajectory.trajectory import Trajectory


def scene_of(truth: Trajectory, prediction: Trajectory) -> PredictedScene:
    return PredictedScene(0, truth, truth, {LEARNED: prediction}, {}, {}, [], None, {})


def written(folder: Path, settings: EvaluationSettings, scenes: list[PredictedScene]) -> list[str]:
    files = SplitFiles(folder, "test", LEARNED, settings)
    for number, scene in enumerate(scenes):
        files.add(scene, ("test", number, "seen", 30.0 + number))
    files.finish()
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
def test_quantities_are_written_and_drawn(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    for other in ("write_pictures", "write_error_curve"):
        monkeypatch.setattr(split_files, other, lambda *_: None)
    truths = [new_trajectory(seed, num_frames=8) for seed in range(2)]
    pos = truths[0].pos.copy()
    pos[1:] = 0.5 * (pos[1:] + pos[:1])
    moved = replace(truths[0], pos=pos)
    settings = EvaluationSettings(["test"], num_pictures=1, quantities=True, export=["svg"])
    found = written(tmp_path, settings, [scene_of(truths[0], moved), scene_of(truths[1], truths[1].frames(0, 4))])
    assert found == ["parity_test.png", "parity_test.svg", "quantities_test.csv", "quantities_test_00.png", "quantities_test_00.svg"]
    table = (tmp_path / "quantities_test.csv").read_text().splitlines()
    rows = [row for row in csv.DictReader(table) if row["quantity"] == "run-out"]
    assert [(row["trajectory"], row["parameter"], row["unit"]) for row in rows] == [("0", "30.0", "m"), ("1", "31.0", "m")]
    for row, trajectory in zip(rows, (truths[0], truths[1]), strict=True):
        assert float(row["ground_truth"]) == quantities(trajectory)["run-out"].value
    assert float(rows[0]["prediction"]) == quantities(moved)["run-out"].value
    assert rows[1]["prediction"] == "nan"  # that rollout stopped early


def test_without_pictures_the_table_is_all(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    truth = new_trajectory(0, num_frames=8)
    settings = EvaluationSettings(["test"], num_pictures=0)
    assert written(tmp_path, settings, [scene_of(truth, truth)]) == []
    assert written(tmp_path, replace(settings, quantities=True), [scene_of(truth, truth)]) == ["quantities_test.csv"]
