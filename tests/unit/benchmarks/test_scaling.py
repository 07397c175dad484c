"""The benchmark of scaling fits its measurements."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpe_pl.benchmarks import scaling
from gpe_pl.benchmarks.scaling import Settings, figures, run


def test_a_power_law_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scaling, "peak_memory", lambda *_: 1000)
    of_size = [(1e-4 * n**1.5 / 4, 3e-4 * n**1.5 / 4) for n in (30, 60, 120)]  # graph and forward
    of_dimension = [t for pair in of_size for t in pair]
    times = iter(of_dimension * 2)
    monkeypatch.setattr(scaling, "_fastest", lambda *_: next(times))
    settings = Settings(num_nodes=[30, 60, 120], fitted=(30, 120), num_message_passing_steps=2, hidden_channels=8, budget=0.0)
    records, table = run(settings)
    found = {(r["metric"], r["case"]): r["value"] for r in records}
    for dim in (2, 3):
        assert found["scaling_exponent", f"{dim}d"] == pytest.approx(1.5)
        edges = found["num_edges", f"{dim}d, 120"] / found["num_edges", f"{dim}d, 30"]
        assert found["edge_layer_time_ratio", f"{dim}d"] == pytest.approx(8 / edges)
    assert not any(metric == "sorted_time_ratio" for metric, _ in found)  # no scene is large enough
    assert "N^1.500" in table and table.count("| 3D |") == 3
    assert figures(records)["scaling"].axes[0].get_ylabel() == "time of a step [s]"


@pytest.mark.slow
def test_large_scenes_are_also_timed_with_nodes_as_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scaling, "peak_memory", lambda *_: 1000)
    monkeypatch.setattr(scaling, "paired_times", lambda found, _: {name: np.full(3, 2.0 + k) for k, name in enumerate(found)})
    settings = Settings(num_nodes=[5000], dimensions=[2], num_message_passing_steps=1, hidden_channels=8, budget=0.0)
    records, table = run(settings)
    (ratio,) = (r for r in records if r["metric"] == "sorted_time_ratio")
    assert ratio["num_nodes"] == 5000 and ratio["value"] == pytest.approx(2 / 3) and "takes 67 % of the time" in table


def test_steps_of_a_scene_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scaling, "peak_memory", lambda *_: 1000)
    records, _ = run(Settings(num_nodes=[40], dimensions=[3], num_message_passing_steps=1, hidden_channels=8, budget=0.0))
    found = {r["metric"]: r["value"] for r in records}
    assert found["step_time"] == found["graph_time"] + found["forward_time"] and found["graph_time"] > 0
    assert "scaling_exponent" not in found


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"num_nodes": [20, 20]}, "num_nodes: .* the same value twice"),
        ({"dimensions": [2, 2]}, "dimensions: .* the same value twice"),
        ({"fitted": (200, 100)}, "from a smaller to a larger"),
    ],
)
def test_sizes_that_nothing_can_be_fitted_to_are_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Settings(**values)


def test_the_order_of_sizes_does_not_matter() -> None:
    rows = [(10_000, 1.0, 1.0), (200_000, 20.0, 2.0)]
    assert scaling._fit(rows, (10_000, 200_000), 2) == scaling._fit(rows[::-1], (10_000, 200_000), 2)
