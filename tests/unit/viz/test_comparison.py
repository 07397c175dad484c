"""Figures that compare models over domains."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.metrics import Interval
from gpe_pl.viz.comparison import comparison_figure, parameter_figure
from gpe_pl.viz.coverage import CoverageCurves, coverage_figure

NEVER = float("inf")


def test_models_with_failed_rollouts_are_in_the_picture() -> None:
    intervals = {
        "sand": {"GNS": Interval(3.0, 2.0, NEVER), "GPE": Interval(1.0, 0.5, 2.0)},
        "fem": {"GNS": Interval(NEVER, 4.0, NEVER), "GPE": Interval(2.0, 1.0, 3.0)},
    }
    (axes,) = comparison_figure(intervals, {"ballistic": {"sand": 5.0, "fem": 6.0}, "stops at walls": {"fem": 7.0}}, "error").axes
    (arrow,) = axes.texts
    assert arrow.arrow_patch is not None
    assert arrow.xyann[1] == 3.0 and arrow.xy[1] == 1.0  # from the mark to the top
    flat = {
        line.get_label(): line.get_ydata()[0] for line in axes.lines if not line.get_label().startswith("_") and len(line.get_ydata()) == 2
    }
    assert {name: flat[name] for name in ("ballistic", "stops at walls")} == {"ballistic": 5.0, "stops at walls": 7.0}
    triangles = [line for line in axes.lines if line.get_marker() == "^"]
    assert [len(np.asarray(line.get_xdata())) for line in triangles] == [1, 0]  # GNS on fem


def test_every_model_has_its_own_line() -> None:
    curves = {"sand": {f"m{k}": {20.0: [1.0], 30.0: [2.0]} for k in range(12)}}
    (axes,) = parameter_figure(curves, {}, "error").axes
    lines = [line for line in axes.lines if str(line.get_label()).startswith("m")]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 12
    with pytest.raises(ValueError, match="29 curves, but no more than 28 can be told apart"):
        parameter_figure({"sand": {f"m{k}": {20.0: [1.0]} for k in range(29)}}, {}, "error")


def test_coverage_below_the_usual_range_is_in_the_picture() -> None:
    bad = CoverageCurves(3, np.full((2, 4), 0.2), np.ones(4), np.ones(4))
    figure = coverage_figure({"seen": bad}, [0.5, 0.9], 0.9, 0.1, {2: "0.2 s", 3: "0.3 s"})
    for axes in figure.axes[:2]:
        assert axes.get_ylim()[0] < 20.0
