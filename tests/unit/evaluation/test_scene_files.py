"""Exports that cannot be written are refused before any rollout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.errors import GpeError
from gpe_pl.evaluation import scene_files
from gpe_pl.evaluation.predictions import Predictor
from gpe_pl.evaluation.rollouts import evaluate
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.export.onnx_network import OnnxError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Trajectory


@pytest.mark.parametrize(
    ("model", "settings", "message"),
    [
        ("elastomer", {"export": ["model"]}, "evaluation.export: exported programs have no cells; .*; or leave model out"),
        ("sand", {"export": ["model"], "mirror_average": True}, "evaluation.export: exported programs do not average over mirror images"),
        ("sand", {"export": ["page"], "mirror_average": True}, "mirror"),
    ],
)
def test_exports_are_checked_first_with_the_settings_of_the_evaluation(
    model: str, settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    simulator = LearnedSimulator.from_checkpoint(model)
    with pytest.raises(GpeError, match=message):
        evaluate(simulator, tmp_path / "no data", EvaluationSettings(**settings), tmp_path / "run", "GPE")
    assert not (tmp_path / "run").exists()


def test_a_network_that_differs_ends_an_evaluation_before_its_rollouts(
    new_trajectory: Callable[..., Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("onnx", "onnxruntime", "onnxscript"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    scenes = [new_trajectory(num_frames=frames, seed=2) for frames in (3, 7, 7)]  # the first is too short for a model with two velocities
    write_shard(tmp_path / "data" / "test" / "shard-00000.h5", scenes)
    builder = GraphBuilder(GraphConfig(history=2), scenes[0].metadata)
    simulator = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder).eval()

    def refuse(simulator: LearnedSimulator, path: Path, states: list[State]) -> float:
        assert len(states) == 2  # at the start and in the middle of the second scene
        raise OnnxError("another network")

    def fail(*_: Any) -> None:
        pytest.fail("rolled out before the model was written")

    monkeypatch.setattr(scene_files, "export_network", refuse)
    monkeypatch.setattr(Predictor, "scenes", fail)
    with pytest.raises(OnnxError, match="another network"):
        evaluate(simulator, tmp_path / "data", EvaluationSettings(["test"], num_pictures=2, export=["onnx"]), tmp_path / "run", "GPE")
