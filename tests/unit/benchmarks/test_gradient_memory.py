"""The memory of gradients grows far less than the length of rollouts."""

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


@pytest.mark.long
def test_a_gradient_keeps_no_graph_of_each_frame() -> None:
    """With all graphs, 60 frames of this scene take about 200 MB."""
    records, _ = run(Settings(CASES, {"sand": "sand"}, lengths=[160]), {"sand": dataset(*CASES["sand"].overrides)})
    (memory,) = (r["value"] for r in records if r["metric"] == "gradient_memory")
    assert 0 < memory < 150e6
