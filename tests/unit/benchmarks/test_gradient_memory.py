"""The memory of gradients hardly grows with the length of rollouts."""

from __future__ import annotations

import pytest

from gpe_pl.benchmarks import gradient_memory
from gpe_pl.benchmarks.gradient_memory import ModelError, Settings, run
from gpe_pl.benchmarks.trained import Case
from gpe_pl.config.datasets import dataset

CASES = {"sand": Case(["data=sand", "size=small"])}


def test_every_case_needs_a_model() -> None:
    with pytest.raises(ModelError, match="suite.models: names snow; name a model for each of the cases sand"):
        Settings(CASES, {"snow": "snow"})


def test_ratios_are_relative_to_the_first_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        gradient_memory, "peak_memory", lambda _function, _checkpoint, _trajectory, length, _number: 10_000_000 + 20_000 * length
    )
    records, table = run(Settings(CASES, {"sand": "sand"}, lengths=[5, 10]), {"sand": dataset(*CASES["sand"].overrides)})
    found = {(r["metric"], r["case"]): r["value"] for r in records}
    assert found["gradient_memory", "sand, 10"] == 10_200_000
    assert found["gradient_memory_ratio", "sand, 10"] == pytest.approx(10.2 / 10.1)
    assert found["num_rollouts", "sand, 5"] == found["num_rollouts", "sand, 10"] == 2
    assert "| 2 | 10 | 10 | 1.01 |" in table


@pytest.mark.slow
def test_a_gradient_through_more_frames_takes_hardly_more_memory() -> None:
    settings = Settings(CASES, {"sand": "sand"}, lengths=[20, 160])
    records, _ = run(settings, {"sand": dataset(*CASES["sand"].overrides)})
    (ratio,) = (r["value"] for r in records if r["metric"] == "gradient_memory_ratio" and r["case"] == "sand, 160")
    assert ratio < 1.5
