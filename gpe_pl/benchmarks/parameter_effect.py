"""Benchmark of material parameters: how much they change the ground truth, compared with half the time step of the solver.

One scene is simulated from the same initial positions and velocities with its own, unseen value, with other values, and with half the time step. A split of
values into trained and unseen ones can tell models apart only if the truth changes more from an unseen value to the nearest trained one than it changes with
the time step. A start with rounded positions tells whether scenes are chaotic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.half_steps import HalfSteps
from gpe_pl.benchmarks.trained import Case
from gpe_pl.data.control_runs import HIGHEST, LOWEST, TrainedValues, Values, scene_values, with_values
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, parameter_values
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import Interval, bootstrap_interval, bootstrap_ratio
from gpe_pl.rollout.loop import SimulationError, Simulator, steps
from gpe_pl.system.progress import progress_bar
from gpe_pl.system.workers import pool, results
from gpe_pl.trajectory.state import State
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import TEXT_WIDTH, new_figure

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""

SPLIT = "test_unseen"
TOLD = 10.0
"""A split can tell models apart if the nearest trained value changes the ground truth at least this many times as much as half the time step."""
DIGITS = 4
NUM_POINTS = 50
"""Number of points of a curve in the results."""

Horizon = Annotated[int, Field(ge=1)] | Literal["full"]

CHANGES = {
    "range": "lowest against highest trained value",
    "lowest": "lowest trained value",
    "highest": "highest trained value",
    "nearest": "nearest trained value",
    "half_step": "half the time step",
    "rounded": "initial positions rounded to float32",
}
"""Changes of a scene by key, in words. ``range`` compares two changed scenes with each other; all others are compared with the unchanged scene."""

GROUPS = ("below", "between", "above")
"""Groups of unseen values: below, between or above the trained ones."""


class EffectError(GpeError):
    """Raised when a scene cannot be simulated, or a data set has no unseen values; the message names it."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by label.
        num_scenes: number of scenes per data set, the first ones of its split ``test_unseen``.
        horizons: numbers of frames over which changes are averaged; ``full`` is the length of a scene.
        num_workers: number of processes, each of which simulates one scene.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    num_scenes: Annotated[int, Field(ge=1)] = 20
    horizons: Annotated[list[Horizon], Field(min_length=1)] = field(default_factory=lambda: [20, 50, 100, "full"])
    num_workers: Annotated[int, Field(ge=1)] = 1


# --- one scene ------------------------------------------------------------------------------------------------------------------------------


def trained_values(spec: DatasetSpec, index: int) -> dict[str, Values]:
    """Return the lowest and highest trained values, and those nearest to a scene's own, by key of ``CHANGES``."""
    trained = TrainedValues(spec)
    return {"lowest": trained.end(LOWEST), "highest": trained.end(HIGHEST), "nearest": trained.nearest(scene_values(spec, SPLIT, index))}


def recorded(values: Values) -> dict[str, Any]:
    """Return values as records have them: a number for a material with one parameter, several by name."""
    return {material: dict(own) if len(own) > 1 else next(iter(own.values())) for material, own in values.items()}


def positions(solver: Simulator, state: State, num_frames: int) -> np.ndarray:
    """Return positions [frame, node, dim] in m of the frames after the initial state."""
    return np.stack([np.array(later.pos) for later in steps(solver, state, num_frames)])


def scene_changes(spec: DatasetSpec, index: int) -> dict[str, list[float]]:
    """Return the mean squared change [m²] over nodes and axes of each frame after the start, for each of ``CHANGES``.

    Raises:
        EffectError: a simulation stopped early.
    """
    start, num_frames = initial_state(spec, SPLIT, index), spec.num_frames - 1
    names = spec.param_names
    try:
        own = positions(spec.label_solver, start, num_frames)
        others = {}
        for name, values in trained_values(spec, index).items():
            others[name] = positions(spec.label_solver, with_values(start, names, values), num_frames)
        others["half_step"] = positions(HalfSteps(spec.label_solver), start, num_frames)
        rounded = replace(start, pos=np.asarray(start.pos).astype(np.float32).astype(np.float64))
        others["rounded"] = positions(spec.label_solver, rounded, num_frames)
    except SimulationError as error:
        raise EffectError(
            f"{spec.name} {spec.size}, scene {index} of {SPLIT}: {error}; leave the data set out, or change its scenes"
        ) from error
    pairs = {name: (pos, own) for name, pos in others.items()} | {"range": (others["lowest"], others["highest"])}
    return {name: ((pairs[name][0] - pairs[name][1]) ** 2).mean(axis=(1, 2)).tolist() for name in CHANGES}


def stored_changes(spec: DatasetSpec, index: int, parts: FinishedParts) -> dict[str, list[float]]:
    """Return ``scene_changes``. They are read from ``parts`` if an earlier, stopped run of the suite has stored them there; otherwise they are stored."""
    identity = {"data": spec.as_dict(), "scene": index}
    stored = parts.get(identity)
    if stored is None:
        stored = [scene_changes(spec, index)]
        parts.put(identity, stored)
    return dict(stored[0])


def group_of(value: float, seen: Sequence[float]) -> str:
    """Return which of ``GROUPS`` a value is in."""
    return "below" if value < min(seen) else "above" if value > max(seen) else "between"


# --- all scenes -----------------------------------------------------------------------------------------------------------------------------


def run(settings: Settings, specs: dict[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per scene and horizon and one per mean curve, and Markdown tables.

    Raises:
        EffectError: a data set has no scenes with unseen values, or a simulation stopped early.
    """
    parts = FinishedParts(folder / PARTS)
    for label, spec in specs.items():
        if spec.num_test_unseen < 1:
            raise EffectError(f"suite.cases.{label}: the data set has no scenes with unseen values; set data.num_test_unseen")
        spec.label_solver.compile_kernels()
    jobs = [(label, index) for label, spec in specs.items() for index in range(min(settings.num_scenes, spec.num_test_unseen))]
    found: dict[tuple[str, int], dict[str, list[float]]] = {}
    with progress_bar("scenes") as on_progress, pool(settings.num_workers) as executor:
        arguments = [(specs[label], label, index, parts) for label, index in jobs]
        for done, (label, index, changes) in enumerate(results(executor, _job, arguments), start=1):
            found[label, index] = changes
            on_progress(done, len(jobs))
    records = [record for label, index in jobs for record in _scene_records(label, specs[label], index, found[label, index], settings)]
    records += [record for label, spec in specs.items() for record in _curves(label, spec, [found[job] for job in jobs if job[0] == label])]
    parts.clear()
    return records, report(records)


def _job(spec: DatasetSpec, label: str, index: int, parts: FinishedParts) -> tuple[str, int, dict[str, list[float]]]:
    return label, index, stored_changes(spec, index, parts)


def _scene_records(label: str, spec: DatasetSpec, index: int, changes: dict[str, list[float]], settings: Settings) -> list[dict[str, Any]]:
    values, _ = parameter_values(spec, SPLIT, index)
    material, choices = next(iter(spec.parameters.items()))
    own = next(iter(values[material].values()))
    about = {"case": label, "scene": index, "values": recorded(values), "group": group_of(own, choices.seen)}
    records = []
    for horizon in settings.horizons:
        last = spec.num_frames - 1 if horizon == "full" else horizon
        if last < spec.num_frames:
            means = {name: _short(float(np.mean(curve[:last]))) for name, curve in changes.items()}
            records.append({**about, "horizon": horizon, "seconds": _short(last * spec.solver.frame_dt), "unit": "m^2", **means})
    return records


def _curves(label: str, spec: DatasetSpec, scenes: Sequence[dict[str, list[float]]]) -> list[dict[str, Any]]:
    """Return the means over scenes at evenly spaced frames."""
    frames = np.unique(np.linspace(1, spec.num_frames - 1, NUM_POINTS).round().astype(int))
    times = [_short(frame * spec.solver.frame_dt) for frame in frames]
    means = {name: np.mean([scene[name] for scene in scenes], axis=0)[frames - 1] for name in CHANGES}
    return [
        {"case": label, "curve": name, "time": times, "change": [_short(v) for v in mean], "unit": "m^2"} for name, mean in means.items()
    ]


def _short(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


# --- tables and figure ----------------------------------------------------------------------------------------------------------------------


def _table(records: Sequence[dict[str, Any]], name: str) -> np.ndarray:
    """Return one change of all scenes as ``bootstrap_interval`` takes it [1, scene]."""
    return np.array([[record[name] for record in records]])


def ratio(records: Sequence[dict[str, Any]]) -> Interval:
    """Return the ratio of mean changes over scenes: nearest trained value over half the time step."""
    return bootstrap_ratio(_table(records, "nearest"), _table(records, "half_step"), statistic=np.mean)


def report(records: list[dict[str, Any]]) -> str:
    """Return a table of changes over whole scenes, and a table of their ratio at every horizon."""
    scenes = [record for record in records if "curve" not in record]
    lines = [
        "Change of the ground truth, ×1e-3 [m²]: mean squared distance of positions over frames, nodes, axes and scenes, with the 95 % bootstrap interval over "
        "scenes. Whole scenes with unseen values.",
        "",
        table_row(["data", "scenes", "time [s]", *CHANGES.values()]),
        "|" + "---|" * (3 + len(CHANGES)),
    ]
    for label, members in groupby(scenes, lambda r: r["case"]):
        own = [r for r in members if r["horizon"] == "full"]
        if own:
            cells = [_interval(bootstrap_interval(_table(own, name), statistic=np.mean), 1e3) for name in CHANGES]
            lines.append(table_row([label, str(len(own)), f"{own[0]['seconds']:g}", *cells]))
    horizons = list(dict.fromkeys(record["horizon"] for record in scenes))
    lines += [
        "",
        "Change by the nearest trained value over change by half the time step, with the 95 % bootstrap interval over scenes, for averages over the first "
        f"frames. Ratios below {TOLD:g} are bold: there, the split cannot tell a model that reads the material from one that does not.",
        "",
        table_row(["data", "unseen values", "scenes", *(f"{h} frames" if h != "full" else "whole scenes" for h in horizons)]),
        "|" + "---|" * (3 + len(horizons)),
    ]
    for label in dict.fromkeys(record["case"] for record in scenes):
        for group in ("all", *GROUPS):
            chosen = [r for r in scenes if r["case"] == label and group in ("all", r["group"])]
            if chosen:
                at = {h: [r for r in chosen if r["horizon"] == h] for h in horizons}
                number = max(map(len, at.values()))
                lines.append(table_row([label, _values(group, chosen), str(number), *(_ratio(at[h]) for h in horizons)]))
    return "\n".join(lines)


def _values(group: str, records: Sequence[dict[str, Any]]) -> str:
    """Return the name of a group and the values in it."""
    first = (next(iter(record["values"].values())) for record in records)
    values = sorted({next(iter(value.values())) if isinstance(value, dict) else value for value in first})
    return group if group == "all" else f"{group}: {', '.join(f'{v:g}' for v in values)}"


def _interval(i: Interval, scale: float) -> str:
    return f"{scale * i.estimate:.3g} [{scale * i.low:.3g}, {scale * i.high:.3g}]"


def _ratio(records: Sequence[dict[str, Any]]) -> str:
    if not records:
        return "–"
    found = ratio(records)
    text = f"{found.estimate:.3g} [{found.low:.3g}, {found.high:.3g}]"
    return text if found.estimate >= TOLD else f"**{text}**"


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw the mean changes of each data set over time."""
    curves = [record for record in records if "curve" in record]
    labels = list(dict.fromkeys(record["case"] for record in curves))
    columns = min(5, len(labels))
    rows = math.ceil(len(labels) / columns)
    figure = new_figure(TEXT_WIDTH, 0.5 + 1.7 * rows)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for panel, label in zip(axes.flat, labels, strict=False):
        for record in (r for r in curves if r["case"] == label and r["curve"] not in ("lowest", "highest")):
            color = PALETTE[list(CHANGES).index(record["curve"]) % len(PALETTE)]
            panel.plot(record["time"], record["change"], linewidth=1, color=color, label=CHANGES[record["curve"]])
        panel.set_title(label, fontsize=7)
        panel.set_yscale("log")
        panel.set_ylim(1e-16, 1e-1)
        panel.tick_params(labelsize=6)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in axes.flat[len(labels) :]:
        panel.set_axis_off()
    figure.supxlabel("time [s]", fontsize=7)
    figure.supylabel("mean squared change [m²]", fontsize=7)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=6, frameon=False, ncols=2, loc="outside upper center")
    return {"parameter_effect": figure}
