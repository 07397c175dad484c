from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib._pylab_helpers import Gcf

from gpe_pl.viz.figures import error_curve_figure, parameter_strip, rollout_figure, validation_loss_figure


def pixels(figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def colourful(image) -> np.ndarray:
    """Return the pixels of a picture that show particles, not paper or grey lines."""
    return np.ptp(image, axis=-1) > 20


@pytest.mark.slow
def test_rollout_figure_has_a_panel_per_time_and_row(ground_truth, prediction):
    figure = rollout_figure(ground_truth, {"GPE": prediction, "GNS": prediction}, num_columns=4)
    assert len(figure.axes) == 3 * 4 + 1  # and the colour bar
    assert len(rollout_figure(ground_truth, {"GPE": prediction}, 4, color="height").axes) == 2 * 4
    assert len(rollout_figure(ground_truth, {}, 4).axes) == 4
    texts = [t.get_text() for t in figure.texts]
    assert {"$t$ = 0.00 s", "0.22 s", "ground\ntruth", "GPE", "GNS"} <= set(texts)


@pytest.mark.slow
def test_parameter_strip_has_the_model_below_the_solver(ground_truth, prediction):
    figure = parameter_strip([("20°", ground_truth, prediction), ("25°\n(unseen)", prediction, ground_truth)], num_columns=3)
    assert len(figure.axes) == 4 * 3
    assert [text.get_text() for text in figure.texts][:4] == ["solver\n20°", "model\n20°", "solver\n25°\n(unseen)", "model\n25°\n(unseen)"]


def test_few_frames_give_few_columns(ground_truth):
    assert len(rollout_figure(ground_truth.frames(0, 3), {}, num_columns=6).axes) == 3


@pytest.mark.slow
@pytest.mark.parametrize("color", ["error", "height"])
def test_every_panel_shows_particles(ground_truth, prediction, color):
    figure = rollout_figure(ground_truth, {"GPE": prediction}, num_columns=3, color=color)
    shown = colourful(pixels(figure))
    height, width = shown.shape
    for axes in figure.axes[:6]:
        x0, y0, x1, y1 = axes.get_position().extents
        assert shown[int((1 - y1) * height) : int((1 - y0) * height), int(x0 * width) : int(x1 * width)].sum() > 30


def test_particles_are_where_the_trajectory_says(ground_truth, dim):
    if dim == 3:
        pytest.skip("perspective")
    figure = rollout_figure(ground_truth, {}, num_columns=2)
    for axes, frame in zip(figure.axes, (0, -1), strict=True):
        np.testing.assert_allclose(axes.collections[0].get_offsets(), ground_truth.pos[frame])
        low, high = axes.get_ylim()
        assert low < 0 and high > 1 and axes.get_aspect() == 1


def test_error_colours_grow_with_the_error(ground_truth, prediction, dim):
    if dim == 3:
        pytest.skip("3D sorts colours by depth")
    axes = rollout_figure(ground_truth, {"GPE": prediction}, num_columns=2).axes[3]
    brightness = axes.collections[0].get_facecolor()[:, :3].sum(axis=1)
    error = np.linalg.norm(prediction.pos[-1] - ground_truth.pos[-1], axis=-1)
    assert brightness[error.argmax()] > brightness[error.argmin()] + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0123, 0.0234, 0.123])
def test_the_label_of_the_error_bar_is_within_the_figure(ground_truth, size):
    moved = replace(ground_truth, pos=ground_truth.pos + np.float32(size / 2**0.5), is_prediction=True)
    figure = rollout_figure(ground_truth, {"GPE": moved})
    figure.canvas.draw()
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "position error [m]"
    assert bar.get_tightbbox().x1 <= figure.bbox.x1


def test_a_stopped_rollout_says_so(ground_truth, stopped):
    figure = rollout_figure(ground_truth, {"GPE": stopped}, num_columns=3)
    notes = [t.get_text() for t in figure.axes[5].texts]
    assert notes == ["stopped at 0.14 s\n(explosion)"]
    pixels(figure)


def test_figures_leave_global_state_alone(ground_truth):
    before = {key: value for key, value in mpl.rcParams.items() if key != "backend"}
    pixels(rollout_figure(ground_truth, {}, num_columns=2))
    assert {key: value for key, value in mpl.rcParams.items() if key != "backend"} == before
    assert not Gcf.figs  # pyplot knows of no figure


def test_error_curve_is_the_median_over_trajectories():
    curves = [s * np.arange(6.0) for s in (1, 1, 3, 30)]
    figure = error_curve_figure({"GPE": curves, "GNS": [10 * c for c in curves]}, frame_dt=0.5)
    (axes,) = figure.axes
    line = axes.lines[0]
    np.testing.assert_allclose(line.get_xdata(), 0.5 * np.arange(1, 6))
    np.testing.assert_allclose(line.get_ydata(), 2 * np.arange(1, 6))
    assert axes.get_yscale() == "log" and len(axes.collections) == 2
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["GPE", "GNS"]
    assert axes.get_legend().get_title().get_text() == "median and 10% – 90%\nof 4 trajectories"
    (only,) = error_curve_figure({"GPE": curves[:1]}, 1.0).axes
    assert only.get_legend().get_title().get_text() == "one trajectory"
    assert (pixels(figure) < 250).any()


def test_failed_trajectories_leave_the_top_of_the_error_curve():
    curves = [np.array([0, 1, np.inf, np.inf]), np.array([0, 1, 2, np.inf]), np.array([0, 1, 2, np.inf])]
    (axes,) = error_curve_figure({"GPE": curves}, 1.0).axes
    median = axes.lines[0].get_ydata()
    np.testing.assert_allclose(median[:2], [1, 2])
    assert median[2] > axes.get_ylim()[1]


def test_rounding_does_not_stretch_the_axis():
    fall, learned = np.array([0, 1e-14, 1e-9, 1e-2]), np.array([0, 1e-6, 1e-5, 1e-4])
    (axes,) = error_curve_figure({"learned": [learned], "ballistic": [fall]}, 1.0).axes
    assert 1e-11 < axes.get_ylim()[0] < 1e-9 and axes.get_ylim()[1] > 1e-2
    (axes,) = error_curve_figure({"exact": [np.full(4, 1e-14)], "ballistic": [fall]}, 1.0).axes
    assert axes.get_ylim()[0] < 1e-14


def test_coinciding_curves_are_both_seen():
    (axes,) = error_curve_figure({name: [np.arange(5.0)] for name in ("learned", "ballistic", "constant velocity")}, 1.0).axes
    assert len({line.get_linestyle() for line in axes.lines}) == len({line.get_color() for line in axes.lines}) == 3


def test_error_curves_of_different_length_count_as_long_as_they_last():
    curves = [np.array([0.0, 1, 1]), np.array([0.0, 3, 3, 5, 5]), np.array([0.0, 2, 2, np.inf, np.inf])]
    (axes,) = error_curve_figure({"GPE": curves}, 1.0).axes
    np.testing.assert_allclose(axes.lines[0].get_ydata()[:2], [2, 2])
    assert len(axes.lines[0].get_ydata()) == 4
    assert axes.lines[0].get_ydata()[2] > axes.get_ylim()[1]  # the median of 5 and infinity


def test_validation_loss_shows_every_seed_and_their_median():
    steps = np.array([0, 10, 20])
    seeds = [(steps, [4.0, 2.0, 1.0]), (steps, [8.0, 4.0, 2.0]), (steps, [16.0, np.nan, np.inf])]
    (axes,) = validation_loss_figure({"odd": seeds, "directed": seeds}).axes
    assert len(axes.lines) == 2 * (3 + 1)
    median = axes.lines[3]
    np.testing.assert_allclose(median.get_ydata(), [8, 4, 2])
    assert median.get_linewidth() > 2 * axes.lines[0].get_linewidth()


def test_validation_loss_of_seeds_with_different_steps_uses_the_common_range():
    seeds = [([0, 10, 20], [1.0, 1.0, 1.0]), ([5, 15], [100.0, 100.0])]
    (axes,) = validation_loss_figure({"odd": seeds}).axes
    np.testing.assert_allclose(axes.lines[2].get_xdata(), [5, 10, 15])
    np.testing.assert_allclose(axes.lines[2].get_ydata(), 10)


def test_validation_losses_with_many_values_show_the_start_and_the_end_of_training_apart():
    steps = np.arange(1, 29) * 100
    first, last = validation_loss_figure({"odd": [(steps, 100.0 / steps)], "directed": [(steps, 200.0 / steps)]}).axes
    assert first.get_xlim() == pytest.approx((0, 400))
    assert last.get_xlim() == pytest.approx((800, 2800))
    assert [axes.get_title() for axes in (first, last)] == ["first seventh (steps 0 to 400)", "last five sevenths (steps 800 to 2,800)"]
    assert first.get_ylim()[1] > 2.0  # the largest loss of the first seventh
    assert last.get_ylim()[0] < 100 / 2800
    assert last.get_ylim()[1] < 1.0  # the range of its own window, in which curves of the end can be told apart


def test_curves_that_are_close_fill_their_panel():
    steps = np.arange(1, 4) * 100
    (axes,) = validation_loss_figure({"odd": [(steps, [1.0, 1.2, 1.4])], "directed": [(steps, [2.0, 1.9, 1.8])]}).axes
    low, high = axes.get_ylim()
    assert 0.9 < low < 1.0 and 2.0 < high < 2.2


def test_no_two_curves_look_alike():
    (axes,) = error_curve_figure({str(k): [np.ones(3)] for k in range(20)}, 1.0).axes
    assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == 20
    with pytest.raises(ValueError, match="told apart"):
        error_curve_figure({str(k): [np.ones(3)] for k in range(40)}, 1.0)


def test_the_median_of_a_good_seed_and_one_that_diverged_is_no_number_between():
    steps = np.arange(0, 1000, 100)
    good, diverged = np.geomspace(1.0, 0.02, 10), np.where(steps < 400, 0.9, np.nan)
    (axes,) = validation_loss_figure({"odd": [(steps, good), (steps + 1, diverged)]}).axes
    at, median = axes.lines[2].get_data()
    assert (np.asarray(median)[np.asarray(at) > 400] > axes.get_ylim()[1]).all()
    assert (np.asarray(median)[np.asarray(at) <= 301] < 1.0).all()
