"""The outcome of an evaluation in one line per split."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from gpe_pl.evaluation.metric_rows import Row
from gpe_pl.reports.finished_runs import Run, table_of
from gpe_pl.reports.outcome import means, outcomes


def run(learned: list[float], flight: list[float], **fractions: float) -> Run:
    rows = [
        Row(model, "test", k, "seen", 30.0, "rollout_mse", "full", value)
        for model, values in (("learned", learned), ("ballistic", flight))
        for k, value in enumerate(values)
    ]
    rows += [Row("learned", "test", 0, "seen", 30.0, metric, "full", value) for metric, value in fractions.items()]
    return Run(Path("run"), {}, table_of(rows))


@pytest.mark.parametrize(
    ("made", "line"),
    [
        (run([1.0, 3.0], [10.0, 14.0]), "test: full-horizon error 6 times below free flight; 0 of 2 rollouts failed"),
        (
            run([2.0, math.inf], [10.0, 14.0]),
            "test: full-horizon error 1.5 times below free flight; 1 of 2 rollouts failed, and count as free flight",
        ),
        (run([math.inf, math.inf], [10.0, 14.0], fraction_outside_at_end=1.0), "test: all 2 rollouts failed"),
        (
            run([math.inf, 2.0], [10.0, 14.0], fraction_outside_at_end=1.0),  # of the failed one
            "test: full-horizon error 2 times below free flight; 1 of 2 rollouts failed, and count as free flight",
        ),
        (run([30.0], [10.0]), "test: full-horizon error 3 times ABOVE free flight, so the model is of no use here; 0 of 1 rollouts failed"),
        (
            run([1.0], [2.0], fraction_corrected=0.02, fraction_outside_at_end=0.001),
            "test: full-horizon error 2 times below free flight; 0 of 1 rollouts failed; containment corrected 2 % of the particle-steps; "
            "0.1 % of the nodes end in walls",
        ),
        (run([1.0], [2.0], fraction_corrected=0.002), "test: full-horizon error 2 times below free flight; 0 of 1 rollouts failed"),
    ],
)
def test_a_split_has_a_line(made: Run, line: str) -> None:
    assert list(outcomes(made)) == [line]


def test_means_count_failures_as_tables_do() -> None:
    found = means(run([2.0, math.inf], [10.0, 14.0], fraction_corrected=0.25))
    assert found == {"test/num_failed": 1.0, "test/rollout_mse@full": 8.0, "test/fraction_corrected@full": 0.25}
    assert means(run([2.0, math.inf], []))["test/rollout_mse@full"] == math.inf


def test_without_free_flight_there_is_no_line() -> None:
    assert list(outcomes(run([1.0], []))) == []
