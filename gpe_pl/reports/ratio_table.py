"""Lines of a sweep's table that compare the errors of its variants scene by scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_ratio
from gpe_pl.reports.finished_runs import Run, rollout_errors, shared_table, shared_trajectories, starts_of
from gpe_pl.reports.material_table import FEWEST_SCENES
from gpe_pl.viz.coloring import MOST_CURVES

FEWEST_SEEDS = 2
"""Training seeds of each model that a significant ratio needs. One seed says nothing about the spread between seeds."""
SPLITS = ("test", "test_unseen")
SCENES = ("data.", "evaluation.data")
"""Prefixes of keys on which the scenes of an evaluation depend. Variants that differ in them have other scenes."""
NOTE = (
    "Mean rollout MSE divided by that of the first row, on the same trajectories, with a 95 % bootstrap interval over trajectories and seeds. Below 1, errors "
    f"are smaller than in the first row. Bold where the interval excludes 1 and there are at least {FEWEST_SEEDS} seeds of both and {FEWEST_SCENES} "
    "trajectories. A failed rollout counts as ballistic flight."
)


def ratio_lines(axes: Sequence[str], variants: dict[tuple[str, ...], list[Run]], horizons: Sequence[str]) -> list[str]:
    """Return a Markdown table of the errors of variants over those of the first; empty for one variant, or if they were evaluated in different scenes.

    Args:
        axes: configuration keys in which the variants differ.
        variants: runs by their values of these keys.
        horizons: horizons of the columns.
    """
    runs_of_all = [run for runs in variants.values() for run in runs]
    if not 2 <= len(variants) <= MOST_CURVES or any(axis.startswith(SCENES) for axis in axes) or len(starts_of(runs_of_all)) > 1:
        return []
    first, *others = variants
    header = [*(axis.rpartition(".")[2] for axis in axes), "split", *(f"@{h}" for h in horizons)]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for split in SPLITS:
        rows = [[*first, split, *["1" for _ in horizons]]]
        for key in others:
            rows.append([*key, split, *(ratio_cell(variants[key], variants[first], split, h) for h in horizons)])
        if any(cell != "–" for row in rows[1:] for cell in row[-len(horizons) :]):
            lines += map(table_row, rows)
    return ["", *lines, "", NOTE] if len(lines) > 2 else []


def ratio_cell(runs: list[Run], reference: list[Run], split: str, horizon: str) -> str:
    """Return the ratio of the mean errors of two models over their common trajectories, with its interval; a dash if there are none."""
    own, other = (rollout_errors(of, split, horizon) for of in (runs, reference))
    shared = shared_trajectories(own, other)
    if not (own and other and shared):
        return "–"
    return ratio_text(shared_table(own, shared), shared_table(other, shared), np.mean)


def ratio_text(own: np.ndarray, other: np.ndarray, statistic: Callable[..., Any]) -> str:
    """Return the ratio of a statistic of two tables of errors [seed, trajectory] with its interval; bold if it is significant."""
    if all(np.isinf(statistic(table, axis=(-2, -1))) for table in (own, other)):
        return "both failed"
    ratio = bootstrap_ratio(own, other, statistic=statistic)
    enough = min(len(own), len(other)) >= FEWEST_SEEDS and own.shape[1] >= FEWEST_SCENES
    estimate = f"**{ratio.estimate:.2f}**" if enough and (ratio.low > 1 or ratio.high < 1) else f"{ratio.estimate:.2f}"
    return f"{estimate} [{ratio.low:.2f}, {ratio.high:.2f}]"
