"""The card of a shipped model has the numbers of its run, those of its bodies among them."""

from __future__ import annotations

import importlib.util
import json
import math
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.learned.pretrained import checkpoint_path, fingerprint
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


@pytest.mark.slow
def test_the_last_checkpoint_is_shipped_with_its_own_evaluations(
    ship_model: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ship_model, "FOLDER", tmp_path)
    last, evaluation = tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path / "evaluation"
    for folder in (last.parent, evaluation):
        folder.mkdir(parents=True)
    shutil.copy(checkpoint_path("snow"), last)
    (tmp_path / "run" / "config.json").write_text(json.dumps({"training": {"num_steps": 10, "batch_size": 2}}))
    write_rows(evaluation / "metrics.csv", [*rows("rollout_mse", 1.0), *rows("rollout_mse", 4.0, model="ballistic")])
    with pytest.raises(ValueError, match="name folders with evaluations"):
        ship_model.shipped(last, "new", "abc", "python -m gpe_pl.fit")
    config = {"checkpoint": "last.ckpt (sha256 0123456789ab)", "evaluation": {}}
    (evaluation / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="evaluates last.ckpt .*, not last.ckpt"):
        ship_model.shipped(last, "new", "abc", "python -m gpe_pl.fit", str(evaluation))
    (evaluation / "config.json").write_text(json.dumps({**config, "checkpoint": fingerprint(last)}))
    ship_model.shipped(last, "new", "abc", "python -m gpe_pl.fit", str(evaluation))
    text, weights = (tmp_path / "new.md").read_text(), LearnedSimulator.from_checkpoint("snow").state_dict()
    assert "weights after the last step" in text and "have 25 % of the mean error" in text
    assert all(bool((weights[k] == v).all()) for k, v in LearnedSimulator.from_checkpoint(tmp_path / "new.ckpt").state_dict().items())


def test_a_card_judges_as_tables_do(ship_model: ModuleType) -> None:
    """A failed rollout counts as ballistic flight, and the reference is the best trivial baseline."""

    def card(*errors: Row) -> str:
        simulator, settings = LearnedSimulator.from_checkpoint("fem"), {"training": {"num_steps": 10, "batch_size": 2}}
        text: str = ship_model.card("fem", "python -m gpe_pl.fit", "abc", simulator, [*errors], settings)
        return text

    failed = card(*rows("rollout_mse", 1e-4, math.inf, 1e-4, 1e-4), *rows("rollout_mse", *[9e-3] * 4, model="ballistic"))
    assert "have 26 % of the mean error of ballistic flight. 1 of 4 failed and count as ballistic flight." in failed
    poor = [*rows("rollout_mse", 4e-3), *rows("rollout_mse", 9e-3, model="ballistic"), *rows("rollout_mse", 5e-3, model="stops_at_walls")]
    assert "have 80 % of the mean error of nodes that stop at walls: comparisons would call it *not learned*." in card(*poor)
