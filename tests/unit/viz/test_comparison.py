"""Figures that compare models over domains."""

from __future__ import annotations

import numpy as np

from gpe_pl.metrics import Interval
from gpe_pl.viz.comparison import comparison_figure

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
