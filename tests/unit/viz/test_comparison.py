"""Figures that compare models over domains."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgba

from gpe_pl.metrics import Interval
from gpe_pl.viz.coloring import REFERENCE
from gpe_pl.viz.comparison import CostAndError, comparison_figure, cost_error_figure, parameter_figure
from gpe_pl.viz.coverage import CoverageCurves, coverage_figure
from gpe_pl.viz.quantities import courses_figure, parity_figure

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


def test_scenes_without_one_parameter_are_left_out_of_the_figure() -> None:
    nan = float("nan")
    (axes,) = parameter_figure({"sand": {"GPE": {300.0: [2.0], nan: [5.0], 20.0: [1.0]}}}, {}, "error").axes
    assert axes.lines[0].get_xdata().tolist() == [20.0, 300.0] and axes.get_xscale() == "log"
    with pytest.raises(ValueError, match="mixed: no scene has one value of the parameter"):
        parameter_figure({"mixed": {"GPE": {nan: [1.0]}, "GNS": {nan: [2.0]}}}, {}, "error")


def test_each_domain_has_a_panel_with_its_trained_range() -> None:
    curves = {f"d{k}": {"own": {1.0: [1.0], 3.0: [2.0]}, "nearest": {1.0: [1.0], 3.0: [2.0]}, "solver": {1.0: [0.1]}} for k in range(5)}
    figure = parameter_figure(curves, {domain: [1.5, 2.0, 2.5] for domain in curves}, "error", references=["solver"])
    assert [axes.get_title() for axes in figure.axes] == [*curves]
    assert len({axes.get_position().y0 for axes in figure.axes}) == 2  # rows
    for axes in figure.axes:
        (shading,) = axes.patches
        assert (shading.get_x(), shading.get_width()) == (1.5, 1.0)
        own, nearest = (line for line in axes.lines if line.get_label() in ("own", "nearest"))
        assert (
            own.get_linewidth() > 2 * nearest.get_linewidth() and own.get_zorder() < nearest.get_zorder()
        )  # coinciding curves are visible
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"own", "nearest", "solver", "trained range", "trained values"}


@pytest.mark.parametrize("highest", [0.006, 60.0])
def test_the_axis_of_errors_has_two_labels_or_more(highest: float) -> None:
    figure = parameter_figure({"sand": {"GPE": {20.0: [0.002], 30.0: [highest]}}}, {}, "error")
    figure.draw_without_rendering()
    (axes,) = figure.axes
    low, high = axes.get_ylim()
    shown = [label for label in axes.yaxis.get_majorticklabels() if low <= label.get_position()[1] <= high and label.get_text()]
    assert len(shown) >= 2


def test_coverage_below_the_usual_range_is_in_the_picture() -> None:
    bad = CoverageCurves(3, np.full((2, 4), 0.2), np.ones(4), np.ones(4))
    figure = coverage_figure({"seen": bad}, [0.5, 0.9], 0.9, 0.1, {2: "0.2 s", 3: "0.3 s"})
    for axes in figure.axes[:2]:
        assert axes.get_ylim()[0] < 20.0


def test_every_level_of_costs_and_errors_has_its_line() -> None:
    levels = {"ballistic": 3.0, "stops at walls": 2.0, "constant velocity": 1.0}
    (axes,) = cost_error_figure({"sand": CostAndError({"solver": [(1.0, 2.0)]}, {"$a_b$ model": [(2.0, 1.0)]}, levels)}, "s", "m²").axes
    flat = {str(line.get_label()): (line.get_linestyle(), line.get_ydata()[0]) for line in axes.lines}
    assert [flat[name][1] for name in levels] == [3.0, 2.0, 1.0] and len({flat[name][0] for name in levels}) == 3
    assert r"\$a_b\$ model" in flat, "not as mathematics"


def test_courses_are_drawn_over_the_time_in_the_scene() -> None:
    energy = np.array([3.0, 2.0, 1.0])
    figure = courses_figure({"energy": ("J", {"ground truth": energy, "learned": energy[:2]})}, 0.25, 0.1, "begins at 0.25 s")
    truth, learned = figure.axes[0].lines
    np.testing.assert_allclose(np.asarray(truth.get_xdata(), float), [0.35, 0.45, 0.55])
    np.testing.assert_allclose(np.asarray(learned.get_xdata(), float), [0.35, 0.45])


def test_colours_of_a_parity_figure_have_one_scale() -> None:
    heights = [(1e6, 1.0, 1.1), (3e6, 2.0, 2.1), (5e6, 3.0, 3.1)]
    numbers = {"height": ("m", heights), "peak stress": ("Pa", [(value, true, np.nan) for value, true, _ in heights])}
    figure = parity_figure(numbers, "Young's modulus [Pa]", "solids")
    bar = figure.axes[-1]
    assert bar.get_ylim() == pytest.approx((1e6, 5e6))
    colors = figure.axes[0].collections[0].get_facecolors()
    np.testing.assert_allclose(colors, colormaps["viridis"]([0.0, 0.5, 1.0]))


def test_scenes_without_a_parameter_are_visible_in_a_parity_figure() -> None:
    numbers = {"run-out": ("m", [(30.0, 1.0, 1.1), (np.nan, 2.0, 2.1), (40.0, 3.0, 2.9)])}
    figure = parity_figure(numbers, "friction angle [deg]", "3 scenes")
    colors = figure.axes[0].collections[0].get_facecolors()
    np.testing.assert_allclose(colors[1], to_rgba(REFERENCE))
    assert colors[:, 3].tolist() == [1.0, 1.0, 1.0]
    legend = figure.axes[0].get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["several values or none"]
