"""Figures that compare models over domains: errors with intervals, and errors against the material parameter."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from gpe_pl.metrics import Interval
from gpe_pl.viz.captions import as_written
from gpe_pl.viz.coloring import PALETTE, curve_styles
from gpe_pl.viz.film_strip import TEXT_WIDTH, new_figure

MOST_COLUMNS = 3
"""Largest number of panels in a row of ``parameter_figure``."""
LONG_TITLE = 30
"""Number of characters from which a title of a panel has small letters."""


def comparison_figure(intervals: Mapping[str, Mapping[str, Interval]], references: Mapping[str, Mapping[str, float]], label: str) -> Figure:
    """Draw errors with intervals on a logarithmic axis, with a group per domain and a mark per model. Lines across a group mark the references.

    An interval without an upper end runs to the top of the figure. An infinite mark is a triangle at the top.

    Args:
        intervals: intervals by domain and model.
        references: values by name and domain, such as the error of ballistic flight.
        label: label of the vertical axis.
    """
    figure = new_figure(TEXT_WIDTH, 2.6)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    axes.set_yscale("log")
    models = list(dict.fromkeys(m for group in intervals.values() for m in group))
    for k, model in enumerate(models):
        shift = (k - (len(models) - 1) / 2) * 0.6 / max(1, len(models))
        found = [(d + shift, group[model]) for d, group in enumerate(intervals.values()) if model in group]
        x = np.array([p for p, _ in found])
        middle, low, high = np.array([[v.estimate, v.low, v.high] for _, v in found]).T
        color = PALETTE[k % len(PALETTE)]
        finite, open_end = np.isfinite(middle), np.isfinite(middle) & ~np.isfinite(high)
        ends = np.stack([low, np.where(open_end, middle, high)])[:, finite]
        axes.errorbar(
            x[finite], middle[finite], np.abs(ends - middle[finite]), fmt="o", markersize=4, linewidth=1, capsize=2, color=color, label=as_written(model)
        )  # fmt: skip
        top = axes.get_xaxis_transform()
        for place, value in zip(x[open_end], middle[open_end], strict=True):
            axes.annotate(
                "", (place, 1.0), (place, value), top, axes.transData, {"arrowstyle": "->", "color": color, "shrinkA": 0, "shrinkB": 0}
            )
        axes.plot(x[~finite], np.ones((~finite).sum()), "^", markersize=5, color=color, transform=top, clip_on=False)
    for (name, by_domain), style in zip(references.items(), itertools.cycle((":", "--"))):
        places = [(d, by_domain[domain]) for d, domain in enumerate(intervals) if domain in by_domain]
        for k, (d, value) in enumerate(places):
            axes.plot([d - 0.4, d + 0.4], [value] * 2, color="0.5", linestyle=style, linewidth=1, label=None if k else name)
    axes.set_xticks(range(len(intervals)), list(intervals), fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.tick_params(axis="y", which="both", labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, frameon=False, ncols=len(models) + len(references), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def parameter_figure(
    curves: Mapping[str, Mapping[str, Mapping[float, Sequence[float]]]],
    seen: Mapping[str, Sequence[float]],
    label: str,
    parameters: Mapping[str, str] = MappingProxyType({}),
    references: Sequence[str] = (),
) -> Figure:
    """Draw median error over trajectories and seeds against the material parameter, a panel per domain.

    Shading marks the trained range, and triangles at the bottom mark trained values. If there are references, the first model has a broad line below the
    others, so that curves that coincide with it are visible.

    Args:
        curves: errors by domain, model and parameter value. Scenes without one value have NaN (``Row.parameter``) and are left out.
        seen: trained values by domain.
        label: label of the vertical axis.
        parameters: labels of the horizontal axes by domain.
        references: models with dashed or dotted grey lines.

    Raises:
        ValueError: there are more models than can be told apart, or no scene of a domain has one value.
    """
    columns = 2 if len(curves) == 4 else min(len(curves), MOST_COLUMNS)
    rows = -(-len(curves) // columns)
    figure = new_figure(TEXT_WIDTH, 2.4 if rows == 1 else 1.9 * rows + 0.6)
    figure.set_layout_engine("constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    panels = grid.flat[: len(curves)]
    for axes in grid.flat[len(curves) :]:
        axes.remove()
    models = sorted(dict.fromkeys(m for domain in curves.values() for m in domain), key=lambda m: m in references)  # which have no colours
    styles = curve_styles(len(models))
    for axes, (domain, by_model) in zip(panels, curves.items(), strict=True):
        given = [p for points in by_model.values() for p in points]
        values = [p for p in given if np.isfinite(p)]
        if given and not values:
            raise ValueError(f"{domain}: no scene has one value of the parameter; nodes of several materials or values have none")
        axes.set_yscale("log")
        if values and min(values) > 0 and max(values) > 10 * min(values):
            axes.set_xscale("log")
        for k, model in enumerate(models):
            points = sorted((p, float(np.median(v))) for p, v in by_model.get(model, {}).items() if np.isfinite(p))
            points = [p for p in points if np.isfinite(p[1])]
            color, dash = styles[k]
            style, color = (("s--", "d:")[references.index(model) % 2], "0.45") if model in references else (f"o{dash}", color)
            is_broad = k == 0 and bool(references)
            axes.plot(
                [p for p, _ in points],
                [v for _, v in points],
                style,
                markersize=4.5 if is_broad else 2.5,
                linewidth=2.4 if is_broad else 0.8,
                zorder=2 if is_broad else 3 - 0.1 * k,  # without references, the first model is not hidden
                color=color,
                label=as_written(model),
            )
        if trained := list(seen.get(domain, [])):
            axes.axvspan(min(trained), max(trained), color="0.93", zorder=0, label="trained range")
            bottom, foot = [0.025] * len(trained), axes.get_xaxis_transform()
            axes.plot(trained, bottom, "^", color="0.35", transform=foot, markersize=2.5, label="trained values", zorder=1)
        axes.set_title(as_written(domain), fontsize=8 if len(domain) < LONG_TITLE else 6)
        axes.set_xlabel(parameters.get(domain, ""), fontsize=7)
        low, high = np.log10(axes.get_ylim())
        if np.floor(high) - np.ceil(low) < 1:  # at most one power of ten, from which no scale can be read
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(LogFormatterSciNotation(labelOnlyBase=False, minor_thresholds=(np.inf, np.inf)))
        axes.tick_params(which="major", labelsize=6)
        axes.tick_params(which="minor", labelleft=False, labelbottom=False)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(label, fontsize=8)
    entries = {name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=min(len(entries), 4), fontsize=7, frameon=False)
    return figure


@dataclass(frozen=True)
class CostAndError:
    """Content of a panel of ``cost_error_figure``, by label. Pairs are (cost, error); infinite errors are left out.

    Attributes:
        lines: points joined by a line, such as the resolutions of a solver. For every third label, the line between the points is left out.
        marks: separate points. Labels that agree up to the first comma share a colour; marks whose label has a comma are hollow.
        levels: errors of models without a cost, drawn as horizontal lines.
    """

    lines: Mapping[str, Sequence[tuple[float, float]]]
    marks: Mapping[str, Sequence[tuple[float, float]]]
    levels: Mapping[str, float]


def cost_error_figure(panels: Mapping[str, CostAndError], x_label: str, y_label: str) -> Figure:
    """Draw errors against costs on logarithmic axes, in one panel or several.

    Args:
        panels: contents by title.
        x_label: label of the costs.
        y_label: label of the errors.
    """
    figure = new_figure(TEXT_WIDTH, 2.8)
    figure.set_layout_engine("constrained")
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (title, panel) in zip(all_axes, panels.items(), strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        for style, (label, points) in zip(itertools.cycle(("s-", "D", "^")), panel.lines.items(), strict=False):
            shown = sorted(p for p in points if np.isfinite(p[1]))
            axes.plot(
                [c for c, _ in shown], [e for _, e in shown], style, markersize=3.5, linewidth=1, color="0.3", label=as_written(label)
            )
        colors = {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(dict.fromkeys(label.partition(",")[0] for label in panel.marks))}
        for label, points in panel.marks.items():
            shown, color = [p for p in points if np.isfinite(p[1])], colors[label.partition(",")[0]]
            face = "none" if "," in label else color
            x, y = [c for c, _ in shown], [e for _, e in shown]
            axes.plot(
                x, y, "o", markersize=5, markeredgewidth=1.4, color=color, markerfacecolor=face, label=as_written(label), zorder=4
            )  # above lines
        for style, (label, error) in zip(itertools.cycle((":", "--", "-.")), panel.levels.items(), strict=False):
            axes.axhline(error, linestyle=style, linewidth=1, color="0.6", label=label)
        low, high = np.log10(axes.get_xlim())
        axes.set_xlim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))  # whole decades, because labels between them would overlap
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(title, fontsize=8)
        axes.tick_params(which="both", labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    all_axes[0].set_ylabel(y_label, fontsize=8)
    figure.supxlabel(x_label, fontsize=8)  # below all panels, because it is wider than one of several
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, frameon=False, ncols=4, columnspacing=1.0, handlelength=1.6, loc="outside upper center")
    return figure
