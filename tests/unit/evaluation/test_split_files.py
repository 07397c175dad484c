"""Quantities of a split are written as a table and drawn over time and over the parameter, and figures also in the formats that were asked for."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from gpe_pl.evaluation import split_files
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.evaluation.split_files import SplitFiles
from gpe_pl.metrics.quantities import quantities
from gpe_pl.schema import param_names
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz import quantities as viz


def scene_of(truth: Trajectory, prediction: Trajectory) -> PredictedScene:
    return PredictedScene(0, truth, truth, {LEARNED: prediction}, {}, {}, [], None, {})


def written(folder: Path, settings: EvaluationSettings, scenes: list[PredictedScene]) -> list[str]:
    files = SplitFiles(folder, "test", LEARNED, settings)
    for number, scene in enumerate(scenes):
        files.add(scene, ("test", number, "seen", 30.0 + number))
    files.write_quantities()
    files.draw()
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


def drifting(parameter: float, material: str = "sand", **values: Any) -> Trajectory:
    pos = 0.5 + np.cumsum(np.random.default_rng(0).normal(scale=0.01, size=(6, 10, 2)), axis=0)
    about = {"bounds": [(0, 1)] * 2, "spacing": 0.1, "gravity": [0, -9.81], **values}
    return Trajectory.from_numpy(pos, 0.05, material, {material: parameter}, **about)


def drawn(folder: Path, monkeypatch: pytest.MonkeyPatch, scenes: list[tuple[Trajectory, float]]) -> tuple[dict[str, Any], str, str]:
    """Return what the parity figure of scenes shows: numbers, label and title. Each scene comes with its parameter."""
    for other in ("write_pictures", "write_error_curve"):
        monkeypatch.setattr(split_files, other, lambda *_: None)
    shown: list[Any] = []
    whole = viz.parity_figure

    def noted(*values: Any) -> Figure:
        shown.append(values)
        return whole(*values)

    monkeypatch.setattr(viz, "parity_figure", noted)
    files = SplitFiles(folder, "test", LEARNED, EvaluationSettings(["test"], num_pictures=1, quantities=True))
    for number, (truth, parameter) in enumerate(scenes):
        files.add(scene_of(truth, truth), ("test", number, "seen", parameter))
    files.draw()
    return shown[0]


@pytest.mark.slow
def test_quantities_that_only_some_scenes_have_keep_their_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prescribed = np.arange(10) < 2
    scenes = [(drifting(30.0), 30.0), (drifting(35.0, prescribed=prescribed), 35.0), (drifting(40.0), 40.0)]
    numbers, label, _ = drawn(tmp_path, monkeypatch, scenes)
    found = {name: [parameter for parameter, *_ in own] for name, (_, own) in numbers.items()}
    assert [35.0] in found.values() and [30.0, 35.0, 40.0] in found.values()
    assert label == "friction angle [deg]"


@pytest.mark.slow
def test_the_parameter_is_that_of_the_material_that_occurs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("sand", "fluid")
    columns = param_names(names)

    def of_both(value: float, material: str) -> Trajectory:
        own = drifting(value, material)
        params = np.full((10, len(columns)), np.nan, np.float32)
        params[:, columns.index(own.metadata.param_names[0])] = value
        return replace(own, metadata=replace(own.metadata, materials=names, param_names=columns), material_params=params)

    liquids = [(of_both(value, "fluid"), value) for value in (1e-3, 2e-3)]
    _, label, title = drawn(tmp_path, monkeypatch, liquids)
    assert label == "kinematic viscosity [m^2/s]"
    assert title == "test, 2 scenes of fluid, kinematic viscosity 0.001 … 0.002 m²/s"
    _, label, title = drawn(tmp_path, monkeypatch, [*liquids, (of_both(30.0, "sand"), 30.0)])
    assert (label, title) == ("material parameter", "test, 3 scenes of fluid, sand")


def test_without_pictures_the_table_is_all(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    truth = new_trajectory(0, num_frames=8)
    settings = EvaluationSettings(["test"], num_pictures=0)
    assert written(tmp_path, settings, [scene_of(truth, truth)]) == []
    assert written(tmp_path, replace(settings, quantities=True), [scene_of(truth, truth)]) == ["quantities_test.csv"]
