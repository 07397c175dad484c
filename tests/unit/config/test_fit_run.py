"""Stages of a run of ``fit`` that need no training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gpe_pl.config import fit_run
from gpe_pl.config.datasets import scene_metadata
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.config.fit_run import FitRun
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.material_controls import ControlError, MaterialControls
from gpe_pl.files.run_folder import RunError, claim
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import StressError
from gpe_pl.nn.elastic_bodies import CellError
from gpe_pl.training.run import TrainingSettings
from tests.runs import tiny


@pytest.mark.parametrize(("budget", "is_explained"), [(1.0, True), (None, False)])
def test_a_number_of_steps_that_follows_from_a_budget_is_explained(tmp_path: Path, budget: float | None, is_explained: bool) -> None:
    claim(tmp_path, {"training": {"num_steps": 118}})
    (tmp_path / "metrics.csv").touch()
    run: Any = object.__new__(FitRun)
    run.cfg, run.folder = SimpleNamespace(training=SimpleNamespace(budget_minutes=budget)), tmp_path
    run._config = {"training": {"num_steps": 126}}
    with pytest.raises(RunError, match=r"training.num_steps: 118 there, 126 now") as caught:
        run.claim_folder()
    assert ("follows from training.budget_minutes and the measured time of a step" in str(caught.value)) == is_explained


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        (
            ("law=elastic", "model=gpe"),
            CellError,
            r"model\.elastic=true needs .* a material with cells, such as elastomer; the data set has sand",
        ),
        (("model=gpe", "model.stress=true"), StressError, r"model\.stress=true: the data set stores no stress of sand"),
        (("data=sand", "training.targets=solver"), ConfigError, "the solver mpm cannot continue sand from positions"),
    ],
)
def test_a_model_that_does_not_fit_the_materials_is_refused_before_data_are_generated(
    overrides: tuple[str, ...], error: type[GpeError], message: str, tmp_path: Path
) -> None:
    run = FitRun(tiny(tmp_path / "data", tmp_path / "runs", *overrides), tmp_path / "run")
    with pytest.raises(error, match=message):
        run.prepare_data()
    assert not [*tmp_path.iterdir()]


def test_another_precision_of_products_is_another_run_and_the_default_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(*overrides: str) -> dict[str, Any]:
        run = FitRun(tiny(tmp_path / "data", tmp_path / "runs", *overrides), tmp_path / "run")
        monkeypatch.setattr(FitRun, "_checksums", {})
        return run._trained

    default, medium = trained(), trained("trainer.matmul_precision=medium")
    assert "trainer" not in default and trained("trainer.num_threads=2") == default
    assert medium == default | {"trainer": {"matmul_precision": "medium"}}


@pytest.mark.parametrize(("processes", "expected"), [(1, "auto"), (2, "off")])
def test_steps_of_several_processes_are_measured_without_cuda_graphs(
    processes: int, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = FitRun(tiny(tmp_path / "data", tmp_path / "runs"), tmp_path / "run")
    run.trainer, run.device, run._data, found = replace(run.trainer, devices=processes), "cpu", SimpleNamespace(train_set=None), []  # type: ignore[assignment]
    monkeypatch.setattr(FitRun, "_new_module", lambda self, training: torch.nn.Identity())
    monkeypatch.setattr(FitRun, "batch_size", 2, raising=False)

    def measured(module: Any, data: Any, size: Any, training: TrainingSettings) -> float:
        found.append(training.cuda_graph)
        return 1.0

    monkeypatch.setattr(fit_run, "mean_step_time", measured)
    run._step_time(run.training)
    assert (found, run.training.cuda_graph) == ([expected], "auto")


def test_a_run_of_no_steps_has_none_with_a_time_budget_too(tmp_path: Path) -> None:
    run: Any = object.__new__(FitRun)
    run.training = TrainingSettings(num_steps=0, budget_minutes=1.0)
    run.choose_num_steps()
    assert (run.training.num_steps, run.training.budget_minutes) == (0, None)


@pytest.fixture
def trained_elsewhere(tmp_path: Path) -> Path:
    """A checkpoint of a model that was trained with friction angles from 4° to 10°."""
    run = FitRun(tiny(tmp_path / "data", tmp_path / "runs"), tmp_path / "first")
    builder = GraphBuilder(run.graph, scene_metadata(run.parts[0], "train"))
    simulator = LearnedSimulator(run.new_model(spec=builder.spec), builder)
    simulator.get_buffer("trained_sand")[:, 0] = torch.tensor([4.0, 10.0])
    simulator.save(tmp_path / "first.ckpt")
    return tmp_path / "first.ckpt"


def test_controls_of_a_model_that_starts_with_other_values_are_refused_or_warned_of(
    trained_elsewhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fit_run, "ensure_data", lambda _: tmp_path)
    monkeypatch.setattr(MaterialControls, "prepare", lambda *_: None)
    settings = (f"start_from={trained_elsewhere}", "evaluation.material_controls=true")
    message = "the model was trained with friction_angle of sand from 4 to 10, and the train split of these data has"
    still = FitRun(tiny(tmp_path / "data", tmp_path / "runs", *settings, "training.num_steps=0"), tmp_path / "run")
    with pytest.raises(ControlError, match=message):
        still.prepare_data()
    assert message not in caplog.text
    FitRun(tiny(tmp_path / "data", tmp_path / "runs", *settings), tmp_path / "run").prepare_data()
    assert message in caplog.text
