"""Exports that cannot be written are refused before any rollout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.rollouts import evaluate
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.learned.simulator import LearnedSimulator


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
