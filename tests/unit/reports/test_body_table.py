"""Tables of bodies by their material parameter, from rows with known numbers."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from gpe_pl.evaluation.material_controls import SOLVER_ENDS, label_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.reports.body_table import body_lines
from gpe_pl.reports.finished_runs import Run
from gpe_pl.reports.run_archive import COLUMNS

SEEN = "[1e4, 1e6]"
"""Trained moduli [Pa]. From 2e5 Pa, the lower one is farther on the logarithmic scale, and the higher one on the linear scale."""
VALUES = [2e4, 2e4, 9e4, 2e5, 5e5, 8e5]


def run_of(peaks: list[tuple[float, float]], ratios: list[float], seen: str = SEEN) -> Run:
    """A run with, for each scene, the peak stress at its own and at the farthest value, and the ratio of its deformation."""
    rows = []
    for scene, ((own, far), ratio) in enumerate(zip(peaks, ratios, strict=True)):
        key = ("test_unseen", scene, "interpolated", VALUES[scene])
        rows += [
            (LEARNED, *key, "deformation_ratio", "full", ratio),
            (LEARNED, *key, "peak_von_mises", "full", own),
            (label_of(LEARNED, "far"), *key, "peak_von_mises", "full", far),
            (SOLVER_ENDS, *key, "peak_von_mises_ratio", "full", 0.5 if scene else 1.1),
        ]
    order = ["model", "split", "trajectory", "parameter_group", "parameter", "metric", "horizon", "value"]
    table = pd.DataFrame(rows, columns=order)[COLUMNS]
    return Run(Path(), {"data.parameters.elastomer.seen": seen, "data.name": "blocks"}, table)


def cells(lines: list[str], number: int) -> list[list[str]]:
    """The cells of the rows of one of the tables."""
    tables = [block.split("\n") for block in "\n".join(lines).split("\n\n") if "|---|" in block]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in tables[number] if "blocks" in line]


def test_ratios_are_means_over_thirds_of_the_values() -> None:
    lines = body_lines([("blocks", "gpe", [run_of([(1.0, 1.0)] * 6, [1.0, 1.2, 0.8, 2.0, 3.0, 5.0])])])
    rows = cells(lines, 0)
    assert [(row[3], row[4], row[5].split()[0]) for row in rows] == [
        ("2e+04 – 9e+04", "3", "1"),
        ("2e+05 – 5e+05", "2", "2.5"),
        ("8e+05", "1", "5"),
    ]
    assert all(row[6:] == ["–", "–"] for row in rows)


@pytest.mark.parametrize(("own", "counted"), [(2.0, 0), (0.5, 6)])
def test_peaks_rise_from_the_lower_to_the_higher_value(own: float, counted: int) -> None:
    """The farthest value is chosen on the scale of the parameter."""
    higher_is_far = [True, True, True, False, False, False]
    peaks = [(own, 1.0) if is_far else (1.0, own) for is_far in higher_is_far]
    (row,) = cells(body_lines([("blocks", "gpe", [run_of(peaks, [1.0] * 6)])]), 1)
    assert row[2:] == ["1", f"{counted} of 6", "5 of 6"]


def test_seeds_are_counted_together() -> None:
    rising = run_of([(0.5, 1.0)] * 3 + [(1.0, 0.5)] * 3, [1.0] * 6)
    falling = run_of([(1.0, 0.5)] * 3 + [(0.5, 1.0)] * 3, [1.0] * 6)
    (row,) = cells(body_lines([("blocks", "gpe", [rising, falling])]), 1)
    assert row[2:] == ["2", "6 of 12", "5 of 6"]


def test_neither_failed_rollouts_nor_equal_peaks_rise() -> None:
    peaks = [(0.5, float("nan")), (1.0, 1.0), (0.5, 1.0), (1.0, float("nan")), (1.0, 1.0), (1.0, 0.5)]
    (row,) = cells(body_lines([("blocks", "gpe", [run_of(peaks, [1.0] * 6)])]), 1)
    assert row[3] == "2 of 6"


def test_runs_without_bodies_have_no_table() -> None:
    found = run_of([(1.0, 1.0)] * 6, [1.0] * 6)
    found.rows["metric"] = "rollout_mse"
    assert body_lines([("blocks", "gpe", [found])]) == []
    assert "rises" not in "\n".join(body_lines([("blocks", "gpe", [run_of([(1.0, 1.0)] * 6, [1.0] * 6, seen="[]")])]))
