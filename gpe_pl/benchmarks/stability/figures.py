"""Figures of long rollouts: growth of energy and momentum, valid frames, surviving scenes, and growth of a perturbation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from matplotlib.figure import Figure

from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import TEXT_WIDTH, new_figure

Curves = Mapping[str, Mapping[str, np.ndarray]]


def long_horizon_figure(models: Curves) -> Figure:
    """Draw four panels: median energy over its initial value and median momentum per mass against the frame; valid frames and fraction alive.

    Args:
        models: curves by name of the model. ``energy`` and ``momentum`` are given at evenly spaced frames up to the last of ``horizons``; infinite values, from
            failed scenes, are not drawn. ``valid_steps`` and ``steps_to_failure`` are given for each scene; the latter is infinite if it did not fail.
    """
    figure = new_figure(TEXT_WIDTH, 4.2)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, 2)
    for k, (name, curves) in enumerate(models.items()):
        color, last = PALETTE[k % len(PALETTE)], curves["horizons"].max()
        for panel, key in zip(axes[0], ("energy", "momentum"), strict=True):
            values = np.where(np.isfinite(curves[key]), curves[key], np.nan)
            panel.plot(np.linspace(0, last, len(values)), values, linewidth=1, color=color, label=name)
        scenes = np.arange(1, len(curves["valid_steps"]) + 1) / len(curves["valid_steps"])
        axes[1, 0].plot(scenes, np.sort(curves["valid_steps"])[::-1], "o-", markersize=3, linewidth=1, color=color)
        frames = np.arange(int(last) + 1)
        alive = (curves["steps_to_failure"][:, None] > frames).mean(axis=0)
        axes[1, 1].plot(frames, alive, linewidth=1, color=color)
        for panel in (*axes[0], axes[1, 1]):
            for horizon in curves["horizons"]:
                panel.axvline(horizon, color="0.8", linewidth=0.5, zorder=0)
    axes[0, 0].axhline(2, color="0.5", linewidth=0.8, linestyle="--")
    labels = (
        ("frame", "E / E₀, median"),
        ("frame", "|Σ m v| / Σ m [m/s], median"),
        ("fraction of scenes", "valid frames"),
        ("frame", "fraction of scenes alive"),
    )
    for panel, (x, y) in zip(axes.flat, labels, strict=True):
        panel.set_xlabel(x, fontsize=7)
        panel.set_ylabel(y, fontsize=7)
        panel.tick_params(labelsize=6)
        panel.spines[["top", "right"]].set_visible(False)
    axes[1, 1].set_ylim(-0.05, 1.05)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), fontsize=6, frameon=False, ncols=_columns(models, 150), loc="outside upper center"
    )
    return figure


def perturbation_figure(models: Curves) -> Figure:
    """Draw the distance of twin rollouts in spacings against the frame, for each ``model`` and for the ``solver``, which is the same for all."""
    figure = new_figure(TEXT_WIDTH / 2, 2.6)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    axes.set_yscale("log")
    for k, (name, curves) in enumerate(models.items()):
        if k == 0:
            axes.plot(curves["solver"], color="0.3", linewidth=1.2, label="solver")
        axes.plot(curves["model"], color=PALETTE[k % len(PALETTE)], linewidth=1, label=name)
    axes.set_xlabel("frame", fontsize=7)
    axes.set_ylabel("distance of twins [spacings]", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), fontsize=6, frameon=False, ncols=_columns(models, 70), loc="outside upper center")
    return figure


def _columns(names: Iterable[str], width: int) -> int:
    """Return the number of columns of a legend that is ``width`` letters wide."""
    return min(3, max(1, width // (8 + max(map(len, names), default=0))))
