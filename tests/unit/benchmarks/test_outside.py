"""The suite of other people's physics: published laws, measured fronts, deviations, and what is missing."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.benchmarks.learning_sets.sets import FULL
from gpe_pl.benchmarks.outside import engines, suite
from gpe_pl.benchmarks.outside.experiments import (
    DAM_BREAK_FILE,
    Curve,
    OutsideError,
    deviation,
    drop_radius,
    measured_fronts,
    report,
    run_out,
)
from gpe_pl.benchmarks.trained import SameNameError
from gpe_pl.config.datasets import dataset
from gpe_pl.learned.pretrained import checkpoint_path


def test_run_out_is_that_of_the_published_fit() -> None:
    np.testing.assert_allclose(run_out(np.array([1.0, 8.0])), [1.2, 7.6])


def test_a_drop_spreads_with_the_eighth_root_of_time_and_the_volume_is_conserved_by_units() -> None:
    one = drop_radius(np.array([1.0, 256.0]), 0.01, 0.5, 9.81)
    assert one[1] / one[0] == pytest.approx(2.0)
    assert one[0] == pytest.approx(0.894 * (9.81 * 1e-6 / 1.5) ** 0.125)


def test_deviations_count_only_points_that_the_run_reaches() -> None:
    own = Curve("solver", np.array([0.0, 1.0]), np.array([0.0, 2.0]))
    value, count = deviation(own, Curve("law", np.array([0.5, 1.0, 3.0]), np.array([2.0, 2.0, 9.0])))
    assert value == pytest.approx(0.25) and count == 2
    value, count = deviation(own, Curve("law", np.array([3.0]), np.array([9.0])))
    assert np.isnan(value) and count == 0


def test_a_model_that_ended_early_is_not_compared_with_all_points() -> None:
    def curve(series: str, x: list[float]) -> dict[str, Any]:
        return {"experiment": "droplet", "model": "fluid", "series": series, "x": x, "y": [1.0] * len(x)}

    reference = curve("a law", [1.0, 2.0, 3.0])
    lines = report([curve("solver", [0.0, 4.0]), curve("model", [0.0, 1.5]), reference])
    assert any("| a law | 3 | 0.0 % | 0.0 % (of the 1 points before it ended) |" in line for line in lines)
    lines = report([curve("solver", [0.0, 4.0]), curve("model", [0.0, 4.0]), reference])
    assert any("| a law | 3 | 0.0 % | 0.0 % |" in line for line in lines)


def test_fronts_are_read_by_series_and_in_order(tmp_path: Path) -> None:
    path = tmp_path / DAM_BREAK_FILE
    path.write_text("series,T,Z\na,2,3\nb,0,1\na,1,2\n")
    a, b = measured_fronts(path)
    assert (a.series, a.x.tolist(), a.y.tolist(), b.series) == ("a", [1.0, 2.0], [2.0, 3.0], "b")
    path.write_bytes(b"\xef\xbb\xbfseries,T,Z\r\na,0,1\r\n")  # as spreadsheets write it
    assert measured_fronts(path)[0].y.tolist() == [1.0]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"time,front\n1,2\n", "f.csv: has 0 columns series; expected the columns series, T and Z once each"),
        (b"series;T;Z\na;0;1\n", "has 0 columns series"),
        (b"", "has 0 columns series"),
        (b"series,T,Z,Z\na,0,1,2\n", "has 2 columns Z"),
        (b"series,T,Z\n", "f.csv: has no rows"),
        (b"series,T,Z\na,0,1\na,nan,2\n", "f.csv: line 3: 'a,nan,2': expected a series, and finite numbers T and Z"),
        (b"series,T,Z\na,0\n", "f.csv: line 2: 'a,0': expected"),
        (b"series,T,Z\na,0,x\n", "f.csv: line 2: 'a,0,x': expected"),
        (b"T,Z,series\n1,2\n", "f.csv: line 2: '1,2': expected a series"),
        (b"series,T,Z\na,0," + 200_000 * b"1" + b"\n", "f.csv: is not a table of comma-separated values"),
        (b"series,T,Z\n\xe9,0,1\n", "is not UTF-8"),
    ],
)
def test_damaged_files_of_fronts_are_refused(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "f.csv"
    path.write_bytes(content)
    with pytest.raises(OutsideError, match=says):
        measured_fronts(path)


def test_the_report_names_what_is_missing_and_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        engines.SCENES, "calculix", replace(engines.SCENES["calculix"], label="Engine", remedy="install it", is_missing=lambda: True)
    )
    (tmp_path / "data_FluidFall").mkdir()
    missing = suite.missing_things(tmp_path, suite.Settings({}, experiments=["dam_break"], engines=["calculix"]))
    names = [name for name, _ in missing]
    assert names[0].startswith("measured fronts of dam breaks") and "Engine" in names and "beam" in names and "fluidfall" not in names
    line = Curve("solver", np.array([1.0, 3.0]), np.array([1.0, 3.0]))
    curves = [Curve("law", np.array([2.0]), np.array([4.0])), line, Curve("model", np.array([1.0, 3.0]), np.array([np.nan, np.nan]))]
    records = [{"experiment": "droplet", "model": "m", "series": c.series, "x": c.x.tolist(), "y": c.y.tolist()} for c in curves]
    values = {"model": {FULL: [0.25]}, "ballistic": {FULL: [0.5]}}
    measured = [{"set": "ricegrip", "split": "", "seed": 0, "minutes": 10.0, "values": values}]
    text = suite.report(records, missing, tmp_path, measured)
    assert "| droplet | m | law | 1 | 50.0 % | not measured |" in text
    assert "- Engine: install it" in text
    assert f"suite=learning_sets suite.folder={tmp_path} 'suite.only=[fluidfall]'`" in text and "suite.only=[beam]" not in text
    assert "| ricegrip | full rollout, RMS distance [m] |  | 0.5 (ballistic) | 0.25 | 1 of 1 | 0 |" in text
    assert suite.figures(records).keys() == {"droplet_m"}


def test_models_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("old", "new"):
        (tmp_path / folder).mkdir()
        shutil.copy(checkpoint_path("sand"), tmp_path / folder / "sand.ckpt")
    checkpoints = [str(tmp_path / folder / "sand.ckpt") for folder in ("old", "new")]
    settings = suite.Settings({}, checkpoints=checkpoints)
    with pytest.raises(SameNameError, match="two checkpoints are called sand; copy one of them to a file of another name"):
        suite.run(settings, {"sand": dataset("data=sand", "size=small")}, tmp_path)
