"""What a finished run is asked for later is computed without training again."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.fit import fit
from gpe_pl.training.module import TrainingModule
from tests.runs import tiny

STEPS = ("training.num_steps=6", "training.val_interval=2", "training.warmup_steps=2")


@pytest.mark.slow
def test_quantities_can_be_asked_for_afterwards(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    value = fit(tiny(tiny_data, tmp_path, *STEPS))
    metrics = (tmp_path / "fit" / "metrics.csv").read_bytes()
    monkeypatch.setattr(TrainingModule, "training_step", lambda *_: pytest.fail("trains again"))
    for _ in range(2):
        assert fit(tiny(tiny_data, tmp_path, *STEPS, "evaluation.quantities=true")) == value
        assert {p.name for p in (tmp_path / "fit").glob("quantities_*.csv")} == {"quantities_test.csv", "quantities_test_unseen.csv"}
    assert (tmp_path / "fit" / "metrics.csv").read_bytes() == metrics
