"""The card of a shipped model has the numbers of its run, those of its bodies among them."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row
from gpe_pl.learned.simulator import LearnedSimulator


@pytest.fixture(scope="module")
def ship_model() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ship_model", Path(__file__).parents[3] / "docs" / "ship_model.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(metric: str, *values: float, model: str = LEARNED) -> list[Row]:
    return [Row(model, "test_unseen", k, "interpolated", 1e6, metric, "full", value) for k, value in enumerate(values)]


def test_a_card_says_how_bodies_bend(ship_model: ModuleType) -> None:
    errors = [*rows("rollout_mse", 1.0, 2.0), *rows("rollout_mse", 5.0, 10.0, model="ballistic")]
    bodies = [*rows("deformation_ratio", 0.5, 0.7, math.inf), *rows("bounce_height_ratio", 0.9)]
    simulator, settings = LearnedSimulator.from_checkpoint("fem"), {"training": {"num_steps": 10, "batch_size": 2}}
    text = ship_model.card("fem", "python -m gpe_pl.fit", "abc", simulator, [*errors, *bodies], settings)
    assert "have 20 % of the mean error of ballistic flight. Medians over these rollouts" in text
    assert "relative to the ground truth: deformation 0.70, bounce height 0.90." in text
    assert "deformation_ratio" in text.split("```")[1]
    assert ("It is given the form of the solver's elastic law" in text) == simulator.model.settings["elastic"]
    assert "clamp" not in text
    unclamped = {**settings, "evaluation": {"clamp_parameters": False}}
    assert "`evaluation.clamp_parameters=false`" in ship_model.card("fem", "python -m gpe_pl.fit", "abc", simulator, errors, unclamped)
    assert "Medians" not in ship_model.card("fem", "python -m gpe_pl.fit", "abc", simulator, errors, settings)
