"""Pictures of an answer: the misfit over each unknown, and observed beside fitted motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from gpe_pl.evaluation.identification.answer import Answer, Value

COLORS = {"model": "tab:blue", "solver": "tab:orange"}
FEW_DECADES = 50
"""Ratio of the bounds below which a logarithmic axis also has ticks between powers of ten."""


def misfit_figure(answers: Mapping[str, Answer]) -> Figure:
    """Return a figure with a panel per unknown: the misfits that the search tried, the answers with their intervals, and the stored value if there is one."""
    first = next(iter(answers.values()))
    figure = Figure(figsize=(4.2 * len(first.values), 3.4), layout="constrained")
    for k, (value, axes) in enumerate(zip(first.values, np.ravel(figure.subplots(1, len(first.values))), strict=True)):
        for name, answer in answers.items():
            _draw(axes, answer, k, COLORS.get(name, "black"))
        if value.truth is not None:
            axes.axvline(value.truth, color="black", linestyle=":", label="stored value")
        if value.is_log:
            axes.set_xscale("log")
            if value.bounds[1] < FEW_DECADES * value.bounds[0]:  # powers of ten alone could be a single tick
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(xlabel=f"{value.label} [{value.unit}]", ylabel="misfit above the smallest")
        axes.legend(fontsize=8)
    return figure


def _draw(axes: Axes, answer: Answer, k: int, color: str) -> None:
    value: Value = answer.values[k]
    tried = sorted((row[k], row[-1] - answer.misfit) for row in answer.tried)
    axes.plot(*zip(*tried, strict=True), "o-" if len(answer.values) == 1 else "o", color=color, markersize=3, linewidth=1)
    axes.axvspan(value.low, value.high, color=color, alpha=0.15)
    axes.axvline(value.estimate, color=color, label=f"{answer.simulator}: {value.short}")
