"""The benchmark of data-parallel training reports its measurements."""

from __future__ import annotations

import pytest

from gpe_pl.benchmarks import parallel
from gpe_pl.benchmarks.parallel import ParallelError, Settings, run


def test_throughput_and_speed_up_follow_from_the_times(monkeypatch: pytest.MonkeyPatch) -> None:
    times = {1: [(2.0, 0.0), (9.0, 0.0), (2.0, 0.0)], 4: [(0.8, 0.1), (0.8, 0.2), (0.9, 0.3)]}
    monkeypatch.setattr(parallel, "step_times", lambda _, number: times[number])
    records, table = run(Settings(num_processes=[1, 4], num_graphs=4, num_nodes=1000))
    found = {(r["metric"], r["case"]): r["value"] for r in records}
    assert found["throughput", "1"] == 2000 and found["throughput", "4"] == 5000
    assert found["speedup", "1"] == 1 and found["speedup", "4"] == 2.5
    assert found["exchange_time", "4"] == 0.2
    assert "| 4 | 5,000 | 2.50 | 62 | 800.0 | 200.0 |" in table


def test_processes_without_a_graph_are_refused() -> None:
    with pytest.raises(ParallelError, match="suite.num_graphs=4: too few for 5 processes"):
        run(Settings(num_processes=[1, 5]))


@pytest.mark.long
def test_steps_of_one_and_of_two_processes_are_timed() -> None:
    settings = Settings(num_graphs=3, num_nodes=40, num_edges=200, num_message_passing_steps=1, hidden_channels=8, num_steps=2)
    for number in (1, 2):
        times = parallel.step_times(settings, number)
        assert len(times) == 2 and all(0 < exchange < step for step, exchange in times)
