"""Benchmark of open channels: outflow, level and mass of trained models over many times their training horizon, beside the solver.

Every scene starts from the same nodes for solver and models. Mean values are those of the second half of the rollout, when the flow of the solver is steady.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.trained import Case, checkpoint_label, fingerprint_of, of_stored_frames, refuse_same_names
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, parameter_values, trajectory_metadata
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.open_scenes import entering, leaving, ledger, level, present
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Start, rollouts
from gpe_pl.schema import Split
from gpe_pl.system.progress import progress_bar
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import TEXT_WIDTH, new_figure

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""
SOLVER, CONTROL = "solver", "ballistic"
NUM_POINTS = 100
"""Number of points of a curve in the results."""
TARGET = 0.05
"""Largest error of outflow and level that counts as small."""
Place = tuple[Split, int]


class ChannelError(GpeError):
    """Raised for data without inlet and outlet, and when the solver stopped; the message names the scene."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        checkpoints: names of shipped models, folders of runs, or files of checkpoints.
        cases: data sets of channels, by label.
        scenes: number of scenes of each split, the first ones of it.
        seconds: length of a rollout [s].
    """

    checkpoints: list[str]
    cases: Annotated[dict[str, Case], Field(min_length=1)]
    scenes: dict[Split, Annotated[int, Field(ge=0)]]
    seconds: Annotated[float, Field(gt=0)]


# --- rollouts -------------------------------------------------------------------------------------------------------------------------------


def run(settings: Settings, specs: dict[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per scene and simulator, and Markdown tables.

    Raises:
        ChannelError: a scene is not open, or the solver stopped.
        SameNameError: two checkpoints have the same name.
        CheckpointError: a checkpoint cannot be read. The records of those before it are kept for the next run.
    """
    parts, records = FinishedParts(folder / PARTS), list[dict[str, Any]]()
    names = [SOLVER, CONTROL, *settings.checkpoints]
    refuse_same_names(settings.checkpoints)
    with progress_bar("simulators") as on_progress:
        for case, spec in specs.items():
            places: list[Place] = [(split, k) for split, count in settings.scenes.items() for k in range(min(count, spec.counts[split]))]
            for number, name in enumerate(names, 1):
                records += _stored(name, case, spec, places, settings.seconds, parts)
                on_progress(number, len(names))
    parts.clear()
    return records, report(records)


def _stored(name: str, case: str, spec: DatasetSpec, places: list[Place], seconds: float, parts: FinishedParts) -> list[dict[str, Any]]:
    model = None if name in (SOLVER, CONTROL) else of_stored_frames(name)
    label = name if model is None else checkpoint_label(name)
    about: dict[str, Any] = {"simulator": name if model is None else fingerprint_of(model), "label": label, "case": case}
    about |= {"data": spec.as_dict(), "scenes": places, "seconds": seconds}
    found = parts.get(about)
    if found is None:
        found = [{"case": case, "simulator": label, **record} for record in channel_records(name, model, spec, places, seconds)]
        parts.put(about, found)
    return found


def channel_records(
    name: str, model: LearnedSimulator | None, spec: DatasetSpec, places: Sequence[Place], seconds: float
) -> Iterator[dict[str, Any]]:
    """Yield a record of each scene.

    Args:
        name: ``SOLVER``, ``CONTROL``, or the name of the model.
        model: the model, if it is one.
        spec: data set of the scenes.
        places: split and number of each scene.
        seconds: length of the rollouts [s].

    Raises:
        ChannelError: a scene is not open, or the solver stopped.
    """
    dt = spec.solver.frame_dt
    num_steps, starts = round(seconds / dt), []
    for split, number in places:
        state, metadata = initial_state(spec, split, number), trajectory_metadata(spec, split, number)
        if not any(opening.enters for opening in state.openings):
            raise ChannelError(f"{spec.name}, {split} {number}: has no inlet; choose a data set of open channels, such as data=channel")
        guard = Guard(bounds=metadata.bounds, margin=metadata.longest_side, spacing=metadata.spacing)
        starts.append(Start(state if model is None else model.standing(state, metadata), num_steps, metadata, guard))
    if name == SOLVER:
        found = rollouts(spec.label_solver, starts)
    else:
        found = rollouts(Contained(BASELINES[CONTROL](dt) if model is None else model, dt), starts)
    for (split, number), rollout in zip(places, found, strict=True):
        if name == SOLVER and rollout.termination is not None:
            raise ChannelError(f"{spec.name}, {split} {number}: the solver stopped, {rollout.termination.message}")
        yield {"split": split, "scene": number, **_about(spec, split, number, rollout), **measured(rollout, num_steps)}


def _about(spec: DatasetSpec, split: Split, number: int, rollout: Trajectory) -> dict[str, Any]:
    values, group = parameter_values(spec, split, number)
    inlet = next(opening for opening in rollout.openings if opening.enters)
    return {
        "viscosity": next(iter(values["fluid"].values())),
        "group": group,
        "speed": _short(inlet.speed_at(0.0)),
        "inlet_height": _short(inlet.high[-1] - inlet.low[-1]),
        "has_sill": len(rollout.boundary.shapes) > 2 * rollout.metadata.dim,
    }


def measured(rollout: Trajectory, num_steps: int) -> dict[str, Any]:
    """Return what a rollout of a channel shows.

    - ``frames``: number of frames that it reached.
    - ``enters``, ``leaves``: mean mass that enters and leaves in the second half [kg/s].
    - ``level``: mean depth between inlet and outlet in the second half [m].
    - ``drift``: change of the level from the third to the last quarter, relative to it.
    - ``unaccounted``: number of nodes that are in the scene at the end without having been there at the start or entered, minus those that are missing.
    - ``time``, ``curve``: times [s], and level at these times [m].

    Means are None if the rollout stopped early.
    """
    inlet = next(opening for opening in rollout.openings if opening.enters)
    outlet = next(opening for opening in rollout.openings if not opening.drives)
    depth = level(rollout, inlet.axis, inlet.high[inlet.axis], outlet.low[outlet.axis])
    count, book, dt = present(rollout).sum(axis=1), ledger(rollout), rollout.metadata.frame_dt
    balance = int(count[-1]) - int(count[0]) - int(entering(rollout).sum()) + int(leaving(rollout).sum())
    frames = np.unique(np.linspace(0, rollout.num_frames - 1, NUM_POINTS).round().astype(int))
    values: dict[str, Any] = dict.fromkeys(("enters", "leaves", "level", "drift"))
    if rollout.termination is None:
        half, quarter = slice(num_steps // 2 + 1, None), 3 * num_steps // 4 + 1
        seconds = (num_steps - num_steps // 2) * dt
        mean, late = float(depth[half].mean()), float(depth[quarter:].mean())
        early = float(depth[num_steps // 2 + 1 : quarter].mean())
        values = {
            "enters": _short(float(book.entered_mass[half].sum()) / seconds),
            "leaves": _short(float(book.left_mass[half].sum()) / seconds),
            "level": _short(mean),
            "drift": _short((late - early) / mean) if mean else 0.0,
        }
    curve = {"time": [_short(t) for t in (frames * dt).tolist()], "curve": [_short(v) for v in depth[frames].tolist()]}
    return {"frames": rollout.num_frames - 1, **values, "unaccounted": balance, **curve}


def _short(value: float) -> float:
    return float(f"{value:.4g}")


# --- tables and figure ----------------------------------------------------------------------------------------------------------------------


def errors(record: dict[str, Any], solver: dict[str, Any]) -> tuple[float, float]:
    """Return the errors of outflow and level, relative to the solver's; infinite if the rollout stopped, or nothing leaves the solver's."""

    def relative(name: str) -> float:
        own, true = record[name], solver[name]
        return own / true - 1 if own is not None and true else 0.0 if own == true else math.inf

    return relative("leaves"), relative("level")


def report(records: list[dict[str, Any]]) -> str:
    """Return a table with all scenes, and one of the largest errors of each simulator."""
    solver = {(r["case"], r["split"], r["scene"]): r for r in records if r["simulator"] == SOLVER}
    names = list(dict.fromkeys(r["simulator"] for r in records))
    head = [
        "scene",
        "viscosity [m²/s]",
        "speed [m/s]",
        "inlet [m]",
        "sill",
        "simulator",
        "frames",
        "in [kg/s]",
        "out [kg/s]",
        "error of outflow",
    ]
    lines = [table_row([*head, "level [m]", "error of level", "drift of level", "nodes unaccounted for"]), "|" + "---|" * (len(head) + 4)]
    worst: dict[str, list[tuple[float, float, float]]] = {}
    for place, reference in solver.items():
        for own in (r for name in names for r in records if (r["case"], r["split"], r["scene"]) == place and r["simulator"] == name):
            about = [
                f"{own['split']} {own['scene']} ({own['group']})",
                f"{own['viscosity']:g}",
                f"{own['speed']:g}",
                f"{own['inlet_height']:g}",
            ]
            outflow, depth = errors(own, reference)
            found = ["–"] * 6 if own["level"] is None else _cells(own, outflow, depth, own["simulator"] == SOLVER)
            about += ["yes" if own["has_sill"] else "no", own["simulator"], str(own["frames"])]
            lines.append(table_row([*about, *found, str(own["unaccounted"])]))
            worst.setdefault(own["simulator"], []).append(
                (abs(outflow), abs(depth), math.inf if own["drift"] is None else abs(own["drift"]))
            )
    lines += [
        "",
        table_row(
            ["simulator", "scenes", "within 5 %", "mean error of outflow", "largest", "mean error of level", "largest", "largest drift"]
        ),
    ]
    lines.append("|" + "---|" * 8)
    for name, values in worst.items():
        outflow, depth, drift = np.array(values).T
        within = int((np.maximum(outflow, depth) <= TARGET).sum())
        shown = [outflow.mean(), outflow.max(), depth.mean(), depth.max(), drift.max()]
        cells = ["–" if name == SOLVER and k < 4 else _percent(v, signed=False) for k, v in enumerate(shown)]
        lines.append(table_row([name, str(len(values)), "–" if name == SOLVER else f"{within} of {len(values)}", *cells]))
    return "\n".join(lines)


def _cells(own: dict[str, Any], outflow: float, depth: float, is_reference: bool) -> list[str]:
    shown = ["–", "–"] if is_reference else [_percent(outflow), _percent(depth)]
    return [f"{own['enters']:.3g}", f"{own['leaves']:.3g}", shown[0], f"{own['level']:.3g}", shown[1], _percent(own["drift"])]


def _percent(value: float, signed: bool = True) -> str:
    return "–" if not math.isfinite(value) else f"{100 * value:+.1f} %" if signed else f"{100 * value:.1f} %"


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw the level of each scene over time."""
    scenes = list(dict.fromkeys((r["case"], r["split"], r["scene"]) for r in records))
    names, columns = list(dict.fromkeys(r["simulator"] for r in records)), 3
    rows = math.ceil(len(scenes) / columns)
    figure = new_figure(TEXT_WIDTH, 0.5 + 1.5 * rows)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
    for panel, place in zip(axes.flat, scenes, strict=False):
        own = [r for r in records if (r["case"], r["split"], r["scene"]) == place]
        for record in own:
            color = "black" if record["simulator"] == SOLVER else PALETTE[names.index(record["simulator"]) - 1]
            panel.plot(record["time"], record["curve"], linewidth=1, color=color, label=record["simulator"])
        first = own[0]
        panel.set_title(f"{first['viscosity']:g} m²/s, {first['speed']:g} m/s{', sill' if first['has_sill'] else ''}", fontsize=6)
        panel.set_ylim(bottom=0)
        panel.tick_params(labelsize=6)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in axes.flat[len(scenes) :]:
        panel.set_axis_off()
    figure.supxlabel("time [s]", fontsize=7)
    figure.supylabel("level [m]", fontsize=7)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=6, frameon=False, ncols=4, loc="outside upper center")
    return {"channel": figure}
