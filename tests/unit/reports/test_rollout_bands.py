"""What ``docs/rollout_bands.py`` says of the coverage of error bands."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(Path(__file__).parents[3] / "docs" / "rollout_bands.py"))


def evaluations(folder: Path) -> None:
    """Write evaluations of a model whose bands contain 0.9, 0.8 and 0.5 of the nodes, with seen, interpolated and extrapolated parameters."""
    for split, fractions in (("test", {"seen": 0.9}), ("test_unseen", {"interpolated": 0.8, "extrapolated": 0.5})):
        rows = [
            Row(model, split, number, group, 1.0, "fraction_in_bands", horizon, value if model == LEARNED else 0.0)
            for group, value in fractions.items()
            for number in range(3)
            for horizon in ("full", "0.1s")
            for model in (LEARNED, "ballistic")
        ]
        (folder / "runs" / f"snow_{split}").mkdir(parents=True)
        write_rows(folder / "runs" / f"snow_{split}" / "metrics.csv", rows)


def test_a_card_has_the_coverage_once(script: dict[str, Any], tmp_path: Path) -> None:
    evaluations(tmp_path)
    card = tmp_path / "snow.md"
    card.write_text("# snow\n\nnumbers\n\nThe end.\n")
    script["write_card"].__globals__["CARDS"] = tmp_path
    for _ in range(2):  # the second replaces the first
        script["write_card"](tmp_path, "snow")
    first, numbers, coverage, last = card.read_text().split("\n\n")
    assert (first, numbers, last) == ("# snow", "numbers", "The end.\n")
    assert "90 % and 90 % in 3 scenes of the group *seen*" in coverage
    assert "50 % and 50 % in 3 scenes of the group *outside the trained range*" in coverage


def test_horizons_are_in_order_of_time(script: dict[str, Any], tmp_path: Path) -> None:
    evaluations(tmp_path)
    rows = script["rows_of"](tmp_path, "snow")
    assert script["values"](rows, "fraction_in_bands", "interpolated") == {"0.1s": [0.8] * 3, "full": [0.8] * 3}


def test_rows_of_other_models_are_kept(script: dict[str, Any], tmp_path: Path) -> None:
    table = tmp_path / "table.md"
    table.write_text("| model | horizon |\n|---|---|\n| snow | 0.1s |\n| sand | 0.1s |\n| snow | full |\n")
    script["kept_cells"].__globals__["EMBEDDED"] = table
    assert script["kept_cells"](["sand"]) == [["snow", "0.1s"], ["snow", "full"]]
    assert script["kept_cells"](["snow", "sand"]) == []
