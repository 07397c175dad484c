"""Figures for print: rollouts as film strips, error over time, validation loss over training, cost over the number of nodes.

Every function returns a ``Figure``. Save it with ``figure.savefig(path, dpi=300)``. Figures have their own Agg canvas and do not use pyplot, so they can be
made in threads and without a display, and are freed like other objects.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.captions import as_written, pictured
from gpe_pl.viz.coloring import PALETTE, ColorBy, Coloring, curve_styles
from gpe_pl.viz.film_strip import evenly_spaced_frames, film_strip, new_figure

Numbers = Sequence[int | float] | np.ndarray

FIRST_DECADES = 6
"""Number of decades that an axis of errors shows below the lowest final error; free fall starts at rounding errors of 1e-14 m²."""

COLUMN_WIDTH = 3.4
"""Width [inch] of a figure in one column of a paper."""


def rollout_figure(
    ground_truth: Trajectory, predictions: Mapping[str, Trajectory], num_columns: int = 6, color: ColorBy = "error"
) -> Figure:
    """Draw a rollout as a film strip: ground truth in the top row, one row per prediction below, time to the right, materials at the bottom.

    Args:
        ground_truth: first trajectory, which sets the times, evenly spaced from its first to its last frame. If it is a prediction, its row is called
            ``prediction``.
        predictions: rollouts from frame 0 of the ground truth, by the name of their row. A rollout that stopped early shows its reason in
            place of the missing frames.
        num_columns: number of times; fewer if there are fewer frames.
        color: ``error`` is the distance of predicted particles from the ground truth; others as in ``Coloring``.

    Raises:
        ValueError: ``num_columns`` is not positive, no trajectory has the values for ``color``, or a prediction has the name of the first row.
    """
    rows = pictured(ground_truth, predictions)
    frames = evenly_spaced_frames(ground_truth.num_frames, num_columns)
    coloring = Coloring(color, list(rows.values()), frames, next(iter(rows.values())))
    # A name may be longer than its row is high.
    return film_strip([(name.replace(" ", "\n"), trajectory) for name, trajectory in rows.items()], frames, coloring)


def parameter_strip(scenes: Sequence[tuple[str, Trajectory, Trajectory]], num_columns: int = 5) -> Figure:
    """Draw a scene at several values of its material parameters. Each value has a row of the solver above a row of the model; time is to the right.

    Colours are the stress if all rows have one, else the materials if there are several, else the height at the start.

    Args:
        scenes: caption of the values, run of the solver, rollout of the model.
        num_columns: number of times; fewer if there are fewer frames.
    """
    rows = [
        (f"{who}\n{caption}", trajectory.with_moving_boundary().with_absent_hidden())
        for caption, *pair in scenes
        for who, trajectory in zip(("solver", "model"), pair, strict=True)
    ]
    trajectories = [trajectory for _, trajectory in rows]
    frames = evenly_spaced_frames(scenes[0][1].num_frames, num_columns)
    has_stress = all(trajectory.stress is not None for trajectory in trajectories)
    by: ColorBy = "von_mises" if has_stress else "material" if len(trajectories[0].metadata.materials) > 1 else "height"
    return film_strip(rows, frames, Coloring(by, trajectories, frames))


def error_curve_figure(
    curves: Mapping[str, Sequence[Float[np.ndarray, "_"]]],
    frame_dt: float,
    quantiles: tuple[float, float] = (0.1, 0.9),
    label: str = "position MSE [m²]",
) -> Figure:
    """Draw error against time on a logarithmic axis: the median over the trajectories that reach each time, and a band between two quantiles.

    Infinite errors (failed rollouts) leave the axes at the top, and errors far below the final error of every curve leave them at the bottom. Frame 0, the
    shared start, is not drawn.

    Args:
        curves: per-frame errors [frame] of the trajectories (``metrics.per_frame_mse``), of any lengths, by the name of the simulator.
        frame_dt: time between frames [s].
        quantiles: edges of the band.
        label: label of the vertical axis.
    """
    figure = new_figure(COLUMN_WIDTH, 2.5)
    axes = _plain_axes(figure)
    bands = {}
    for name, errors in curves.items():
        table = np.full((len(errors), max(map(len, errors)) - 1), np.nan)
        for row, values in zip(table, errors, strict=True):
            row[: len(values) - 1] = values[1:]
        # Use order statistics, because interpolation between infinities gives NaN.
        low, high = np.nanquantile(table, quantiles, axis=0, method="inverted_cdf")
        bands[name] = np.stack([low, np.nanmedian(table, axis=0), high])
    ceiling = _set_log_limits(axes, np.concatenate([b.ravel() for b in bands.values()]))
    ends = [band[1, -1] for band in bands.values() if 0 < band[1, -1] < np.inf]
    if ends:  # the first errors may be mere rounding
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 10.0**-FIRST_DECADES * min(ends)))
    for (name, band), (color, dash) in zip(bands.items(), curve_styles(len(bands)), strict=True):
        time = frame_dt * np.arange(1, band.shape[1] + 1)
        low, middle, high = np.where(band > 0, np.minimum(band, ceiling), np.nan)
        axes.fill_between(time, low, high, color=color, alpha=0.18, linewidth=0)
        axes.plot(time, middle, color=color, linestyle=dash, linewidth=1.4, label=as_written(name))
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.set_xlim(left=0)
    count = max((len(errors) for errors in curves.values()), default=0)
    title = f"median and {quantiles[0]:.0%} – {quantiles[1]:.0%}\nof {count} trajectories" if count > 1 else "one trajectory"
    axes.legend(fontsize=7, frameon=False, handlelength=2.2, title=title, title_fontsize=6.5, alignment="left")
    return figure


WINDOWS = {"first seventh": (0.0, 1 / 7), "last five sevenths": (2 / 7, 1.0)}
"""Parts of a training that ``validation_loss_figure`` shows side by side: those of the paper's figure 4, as fractions of all steps."""
WINDOW_VALUES = 3
"""Number of validations in the first of ``WINDOWS`` from which the figure shows the two apart."""


def validation_loss_figure(curves: Mapping[str, Sequence[tuple[Numbers, Numbers]]], label: str = "validation loss") -> Figure:
    """Draw validation loss against training step on a logarithmic axis: every seed thin, their median thick.

    Curves with many values fill two panels, the two ``WINDOWS`` of training, each with its own range of losses. For the median, seeds that were validated at
    different steps are interpolated in the logarithm, over the steps that all of them cover.

    Args:
        curves: one ``(steps, values)`` for each seed, by label. Values that are not finite count as infinite.
        label: label of the vertical axis.

    Raises:
        ValueError: the steps of a seed do not increase, or there are more curves than can be told apart.
    """
    runs = {name: [_clean(*seed) for seed in seeds] for name, seeds in curves.items()}
    every = [seed for seeds in runs.values() for seed in seeds]
    end = max(steps[-1] for steps, _ in every)
    dense = all((steps <= WINDOWS["first seventh"][1] * end).sum() >= WINDOW_VALUES for steps, _ in every)
    windows = WINDOWS if dense else {"": (0.0, 1.0)}
    figure = new_figure(COLUMN_WIDTH * len(windows), 2.5)
    for index, (title, (begin, stop)) in enumerate(windows.items()):
        axes = _plain_axes(figure, (1, len(windows), index + 1))
        inside = np.concatenate([values[(steps >= begin * end) & (steps <= stop * end)] for steps, values in every])
        _draw_losses(axes, runs, _set_log_limits(axes, inside))
        axes.set_xlabel("training step", fontsize=8)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_title(f"{title} (steps {begin * end:,.0f} to {stop * end:,.0f})" if title else "", fontsize=8)
        axes.set_xlim(begin * end, stop * end or None)
    figure.axes[0].set_ylabel(label, fontsize=8)
    figure.axes[0].legend(fontsize=7, frameon=False, handlelength=1.4)
    return figure


def _draw_losses(axes: Axes, runs: Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]], ceiling: float) -> None:
    """Draw seeds and medians; ``ceiling`` stands for infinity."""
    for (name, seeds), (color, dash) in zip(runs.items(), curve_styles(len(runs)), strict=True):
        for steps, values in seeds:
            axes.plot(steps, np.minimum(values, ceiling), color=color, linewidth=0.5, alpha=0.45)
        start, stop = max(s[0] for s, _ in seeds), min(s[-1] for s, _ in seeds)
        common = np.unique(np.concatenate([s for s, _ in seeds]))
        common = common[(common >= start) & (common <= stop)]
        middle = np.exp(np.median([_log_at(common, s, v) for s, v in seeds], axis=0))
        axes.plot(common, np.minimum(middle, ceiling), color=color, linestyle=dash, linewidth=1.6, label=as_written(name))


def _log_at(at: np.ndarray, steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return interpolated logarithms. They are infinite next to an infinite value, so that a median of few seeds is no mean with a made-up number."""
    is_finite = np.isfinite(values)
    logs = np.interp(at, steps, np.log(np.where(is_finite, values, 1.0)))
    return np.where(np.interp(at, steps, np.where(is_finite, 0.0, 1.0)) > 0, np.inf, logs)


def _clean(steps: Numbers, values: Numbers) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.asarray(steps, float), np.asarray(values, float)
    if x.shape != y.shape or x.ndim != 1 or len(x) == 0 or (np.diff(x) <= 0).any():
        raise ValueError(f"each seed needs increasing steps and as many values, got {x.shape} and {y.shape}")
    return x, np.where(np.isfinite(y), y, np.inf)


def _plain_axes(figure: Figure, place: tuple[int, int, int] = (1, 1, 1)) -> Axes:
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot(*place)
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_linewidth(0.6)
    axes.tick_params(which="both", labelsize=7, width=0.5)
    axes.grid(True, axis="y", color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    return axes


def _set_log_limits(axes: Axes, values: np.ndarray) -> float:
    """Fit a logarithmic axis to the positive finite values; return the value above the top at which to draw infinity."""
    positive = values[np.isfinite(values) & (values > 0)]
    low, high = (positive.min(), positive.max()) if positive.size else (1e-1, 1.0)
    margin = np.clip((high / low) ** 0.1, 1.05, 1.5)  # small for a small range, in which curves are close to each other
    axes.set_ylim(low / margin, high * margin)
    return float(high * 10)


def scaling_figure(
    left: Mapping[str, Mapping[int, float]], left_label: str, right: Mapping[str, Mapping[int, float]], right_label: str
) -> Figure:
    """Draw two quantities against the number of nodes on logarithmic axes, a curve per name, and a line of slope one.

    Args:
        left: values of the left axes, by name and number of nodes.
        left_label: label of the left axis, with the unit.
        right: values of the right axes, by name and number of nodes.
        right_label: label of the right axis, with the unit.
    """
    figure = new_figure(2 * COLUMN_WIDTH, 2.6)
    figure.set_layout_engine("constrained")
    for axes, curves, label in zip(figure.subplots(1, 2), (left, right), (left_label, right_label), strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        for k, (name, values) in enumerate(curves.items()):
            axes.plot([*values], [*values.values()], "o-", markersize=3, linewidth=1, color=PALETTE[k % len(PALETTE)], label=name)
        if curves:
            first = next(iter(curves.values()))
            ends = np.array([min(first), max(first)], dtype=float)
            axes.plot(ends, first[min(first)] * ends / ends[0], ":", linewidth=1, color="0.5", label="∝ N")
        axes.set_xlabel("nodes", fontsize=8)
        axes.set_ylabel(label, fontsize=8)
        axes.tick_params(which="both", labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=7, frameon=False)
    return figure
