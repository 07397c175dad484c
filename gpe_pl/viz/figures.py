"""Figures for print: rollouts as film strips, error over time, validation loss over training.

Every function returns a ``Figure`` with its own Agg canvas. Nothing touches pyplot, so figures can be made in threads and without a
display, and are collected like any other object; save one with ``figure.savefig(path, dpi=300)``.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from gpe_pl.trajectory import Trajectory
from gpe_pl.viz.panel import COLOR_MAPS, INK, PALETTE, ColorBy, Panel, color_scale, view

Numbers = Sequence[int | float] | np.ndarray

TEXT_WIDTH = 7.0
"""Width [inch] of a figure that spans both columns of a paper."""

COLUMN_WIDTH = 3.4


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def rollout_figure(
    ground_truth: Trajectory, predictions: Mapping[str, Trajectory], num_columns: int = 6, color: ColorBy = "error"
) -> Figure:
    """Film strip of a rollout: time runs to the right, the ground truth is the top row, each prediction has a row below.

    Args:
        ground_truth: sets the times, evenly spaced from its first to its last frame.
        predictions: rollouts from frame 0 of the ground truth, by the name of their row. One that stopped early says so in
            place of its missing frames.
        num_columns: number of times; fewer if there are fewer frames.
        color: ``error`` colours predicted particles by their distance from the ground truth, ``height`` all particles by
            where they started.
    """
    if num_columns < 1:
        raise ValueError(f"num_columns must be positive, got {num_columns}")
    predictions = dict(predictions)
    frames = np.unique(np.round(np.linspace(0, ground_truth.num_frames - 1, num_columns)).astype(int)).tolist()
    rows = {"ground truth": ground_truth, **predictions}
    scale = color_scale(ground_truth, predictions, frames, color)
    has_bar = color == "error" and bool(predictions)

    low, high = view(ground_truth)
    aspect = (high[1] - low[1]) / (high[0] - low[0]) if len(low) == 2 else 0.9
    left, right, top, gap = 0.34, 0.62 if has_bar else 0.04, 0.22, 0.05  # inch
    panel_width = (TEXT_WIDTH - left - right - gap * (len(frames) - 1)) / len(frames)
    panel_height = panel_width * aspect
    height = top + len(rows) * (panel_height + gap)
    figure = _figure(TEXT_WIDTH, height)

    def rectangle(row: int, column: int) -> tuple[float, float, float, float]:
        x, y = left + column * (panel_width + gap), height - top - (row + 1) * panel_height - row * gap
        return x / TEXT_WIDTH, y / height, panel_width / TEXT_WIDTH, panel_height / height

    for i, (name, trajectory) in enumerate(rows.items()):
        for j, frame in enumerate(frames):
            box = rectangle(i, j)
            panel = Panel(figure, box, ground_truth, color, scale)
            panel.show_frame(trajectory, ground_truth, frame, color)
            if i == 0:
                time = frame * ground_truth.metadata.frame_dt
                text = f"$t$ = {time:.2f} s" if j == 0 else f"{time:.2f} s"
                figure.text(box[0] + box[2] / 2, box[1] + box[3] + 0.05 / height, text, ha="center", va="bottom", fontsize=8, color=INK)
        label = name.replace(" ", "\n")  # a row may be lower than its name is long
        figure.text(left / 2 / TEXT_WIDTH, box[1] + box[3] / 2, label, rotation=90, ha="center", va="center", fontsize=8, color=INK)
    if has_bar:
        bottom, first = rectangle(len(rows) - 1, 0)[1], rectangle(1, 0)
        axes = figure.add_axes((1 - (right - 0.1) / TEXT_WIDTH, bottom, 0.08 / TEXT_WIDTH, first[1] + first[3] - bottom))
        bar = figure.colorbar(ScalarMappable(scale, COLOR_MAPS[color]), cax=axes, extend="max")
        bar.set_label("position error [m]", fontsize=7, color=INK)
        bar.ax.tick_params(labelsize=6.5, width=0.5, length=2)
        bar.outline.set_linewidth(0.5)
    return figure


def error_curve_figure(
    curves: Mapping[str, Sequence[Float[np.ndarray, "frame"]]],
    frame_dt: float,
    quantiles: tuple[float, float] = (0.1, 0.9),
    label: str = "position MSE [m²]",
) -> Figure:
    """Error against time on a logarithmic axis: median over trajectories, and a band between two quantiles.

    Infinite errors (rollouts that failed) leave the top of the axes. Frame 0, the shared start, is not drawn.

    Args:
        curves: per-frame errors of the trajectories (``metrics.per_frame_mse``), by the name of the simulator.
        frame_dt: time between frames [s].
        quantiles: edges of the band.
        label: of the vertical axis.

    Raises:
        ValueError: trajectories of one simulator differ in length.
    """
    figure = _figure(COLUMN_WIDTH, 2.5)
    axes = _plain_axes(figure)
    bands = {}
    for name, errors in curves.items():
        if len({len(e) for e in errors}) != 1:
            raise ValueError(f"{name}: error curves must exist and have one length, got {sorted({len(e) for e in errors})}")
        table = np.stack([np.asarray(e, float)[1:] for e in errors])
        # Order statistics: interpolation between infinities is not a number.
        bands[name] = np.quantile(table, [quantiles[0], 0.5, quantiles[1]], axis=0, method="inverted_cdf")
    ceiling = _set_log_limits(axes, np.concatenate([b.ravel() for b in bands.values()]))
    for (name, band), (color, dash) in zip(bands.items(), _styles(len(bands)), strict=True):
        time = frame_dt * np.arange(1, band.shape[1] + 1)
        low, middle, high = np.where(band > 0, np.minimum(band, ceiling), np.nan)
        axes.fill_between(time, low, high, color=color, alpha=0.18, linewidth=0)
        axes.plot(time, middle, color=color, linestyle=dash, linewidth=1.4, label=name)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.set_xlim(left=0)
    axes.legend(fontsize=7, frameon=False, handlelength=1.4)
    return figure


def validation_loss_figure(curves: Mapping[str, Sequence[tuple[Numbers, Numbers]]], label: str = "validation loss") -> Figure:
    """Validation loss against training step on a logarithmic axis: every seed thin, their median thick.

    Seeds that were validated at different steps are interpolated, in the logarithm, for the median, over the steps that all of them cover.

    Args:
        curves: per label, one ``(steps, values)`` for each seed. Values that are not finite count as infinite.
        label: of the vertical axis.
    """
    figure = _figure(COLUMN_WIDTH, 2.5)
    axes = _plain_axes(figure)
    runs = {name: [_clean(*seed) for seed in seeds] for name, seeds in curves.items()}
    ceiling = _set_log_limits(axes, np.concatenate([values for seeds in runs.values() for _, values in seeds]))
    for (name, seeds), (color, dash) in zip(runs.items(), _styles(len(runs)), strict=True):
        for steps, values in seeds:
            axes.plot(steps, np.minimum(values, ceiling), color=color, linewidth=0.5, alpha=0.45)
        start, stop = max(s[0] for s, _ in seeds), min(s[-1] for s, _ in seeds)
        common = np.unique(np.concatenate([s for s, _ in seeds]))
        common = common[(common >= start) & (common <= stop)]
        logs = np.stack([np.interp(common, s, np.log(np.minimum(v, ceiling))) for s, v in seeds])
        axes.plot(common, np.exp(np.median(logs, axis=0)), color=color, linestyle=dash, linewidth=1.6, label=name)
    axes.set_xlabel("training step", fontsize=8)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_ylabel(label, fontsize=8)
    axes.set_xlim(left=0)
    axes.legend(fontsize=7, frameon=False, handlelength=1.4)
    return figure


def _clean(steps: Numbers, values: Numbers) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.asarray(steps, float), np.asarray(values, float)
    if x.shape != y.shape or x.ndim != 1 or len(x) == 0 or (np.diff(x) <= 0).any():
        raise ValueError(f"each seed needs increasing steps and as many values, got {x.shape} and {y.shape}")
    return x, np.where(np.isfinite(y), y, np.inf)


def _styles(count: int) -> list[tuple[str, str]]:
    """Colour and line style of every curve: colours first, then the same colours dashed and dotted."""
    styles = [(color, dash) for dash in ("-", "--", ":", "-.") for color in PALETTE]
    if count > len(styles):
        raise ValueError(f"{count} curves, but no more than {len(styles)} can be told apart in one figure")
    return styles[:count]


def _plain_axes(figure: Figure) -> Axes:
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_linewidth(0.6)
    axes.tick_params(which="both", labelsize=7, width=0.5)
    axes.grid(True, axis="y", color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    return axes


def _set_log_limits(axes: Axes, values: np.ndarray) -> float:
    """Fit a logarithmic axis to the positive finite values; return the value at which to draw infinity, above the top."""
    positive = values[np.isfinite(values) & (values > 0)]
    low, high = (positive.min(), positive.max()) if positive.size else (1e-1, 1.0)
    axes.set_ylim(low / 1.5, high * 1.5)
    return float(high * 10)
