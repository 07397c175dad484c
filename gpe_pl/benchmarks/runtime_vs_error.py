"""Run time against error of solvers and learned models: accuracy at equal cost, and cost at equal accuracy.

The reference is the solver at half the spacing at which the data were solved. With finer labels (``data.fine``), the data were themselves solved at a smaller
spacing than that of the nodes. Errors are distances from the reference at the nodes of the scene (``solvers.finer_solver``). Substeps of the reference are half
as long where waves or speeds limit them. A substep that takes a whole frame stays as long. The observed order of convergence is reported. The solver that made
the training data is compared with the reference, too. No model can be expected to have a smaller error than that solver. The protocol follows McGreivy and
Hakim 2024 (arXiv 2407.07218): a solver can always run at a lower resolution, so a fair comparison is at equal cost or at equal accuracy.

Solvers start at frame 0, learned models where they have enough history. The solver at the spacing of the nodes computes this history, also if the labels are of
a finer solver, and its time is part of the models' cost. A model thus gets no positions that are more accurate than what it pays for.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from gpe_pl.benchmarks.cost_and_error import Comparison, Family, Point, break_even, hypervolume, paired_ratio, ratio_at_cost, speed_up
from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.ladder_tables import BALLISTIC, REPEATED, of_own_moduli, section, summary
from gpe_pl.benchmarks.reference_solutions import REFERENCES, ComparisonError, observed_order, stored_reference
from gpe_pl.benchmarks.solver_rungs import DATA, MODULI, NODES, SPACING, STEPS, rungs
from gpe_pl.benchmarks.spent_before import Spent, spent_on
from gpe_pl.benchmarks.timed_rollouts import Start, distance, squared_error, timed
from gpe_pl.benchmarks.trained import (
    Case,
    Labels,
    checkpoint_label,
    fingerprint_of,
    has_scenes_of,
    labels_of,
    model_label,
    runs_in,
    trained_on,
)
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory, initial_state
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import Interval
from gpe_pl.reports.finished_runs import Run
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import Simulator
from gpe_pl.schema import Split
from gpe_pl.solvers.resolution import Resolved
from gpe_pl.system.progress import progress_bar
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison.

    Attributes:
        cases: data sets, by name.
        runs: folders of finished runs. Their models take part in cases with the scenes of their data set and labels as fine as theirs or finer. All learned
            models of a case start where the one with the longest history can.
        factors: factors by which the solver is also run at a coarser spacing than the data.
        step_factors: factors by which the solver's steps may also be longer, at the spacing of the data and at coarser ones.
        soft_factors: factors by which the solver's elastic moduli may also be smaller, where they are constants of the solver (``solver_rungs.softer``).
        repeats: numbers of frames for which predictions are repeated, each a further variant of every model (``Skips.repeat_frames``).
        checkpoints: further models: files, or names of shipped models; each takes part in the case of its data set. Their training time is not known.
        tuning: folders of further runs that were trained to choose settings; the break-even counts their training.
        split, num_trajectories: split and number of the scenes.
        horizons: numbers of frames over which errors are averaged, below the full length, which is always added.
        num_threads: threads of PyTorch; the solvers use one.
        accelerator: device of the models; the solvers run on the CPU.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    runs: list[str]
    factors: list[Annotated[float, Field(gt=1)]] = field(default_factory=lambda: [1.5, 2.0, 3.0])
    step_factors: list[Annotated[int, Field(gt=1)]] = field(default_factory=lambda: [2, 4])
    soft_factors: list[Annotated[float, Field(gt=1)]] = field(default_factory=lambda: [2.0, 4.0])
    repeats: list[Annotated[int, Field(gt=1)]] = field(default_factory=lambda: [2, 4])
    checkpoints: list[str] = field(default_factory=list)
    tuning: list[str] = field(default_factory=list)
    split: Split = "test_unseen"
    num_trajectories: Annotated[int, Field(ge=1)] = 5
    horizons: list[Annotated[int, Field(ge=1)]] = field(default_factory=lambda: [20, 50, 100])
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"

    @property
    def device(self) -> str:
        return "cuda" if self.accelerator == "gpu" else "cpu"


@dataclass(frozen=True)
class Entrant:
    """A learned model that takes part.

    Attributes:
        simulator: the model.
        spent: what it cost before its first rollout.
        teacher: name of the solver whose solutions it was trained on, as in ``solver_rungs``.
    """

    simulator: LearnedSimulator
    spent: Spent
    teacher: str = DATA


def run(settings: Settings, specs: dict[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return records of every simulator in every case, and Markdown: a summary, and a table per case with a section on where learned models lose.

    Scenes that had finished when an earlier run was stopped are not repeated. ``folder`` keeps their records until the suite ends, and the reference solutions
    also afterwards.

    Raises:
        ComparisonError: no model was trained on a data set, two models of a data set have one name, or the solver has no reference solution.
        GenerationError: a reference solution ended early.
    """
    torch.set_num_threads(settings.num_threads)
    records: list[dict[str, Any]] = []
    finished = runs_in(settings.runs)
    entrants = {name: _entrants(finished, spec, settings) for name, spec in specs.items()}
    for name, spec in specs.items():
        if not entrants[name]:
            raise ComparisonError(
                f"{' and '.join([*settings.runs, *settings.checkpoints])}: no finished run that was trained on the data set {spec.name!r} of size "
                f"{spec.size!r}; train with `python -m gpe_pl.fit experiment=table1 size={spec.size}`, or set suite.runs or suite.checkpoints"
            )
    unfit = [
        c for c in settings.checkpoints if not any(label.endswith(f", {checkpoint_label(c)}") for own in entrants.values() for label in own)
    ]
    if unfit:
        log.warning("%s: not compared, trained on none of the data sets of the suite (suite.cases, size)", ", ".join(unfit))
    results: dict[str, Comparison] = {}
    for name, spec in specs.items():
        log.info("%s: %d models", name, len(entrants[name]))
        found = results[name] = compare(spec, entrants[name], settings, folder, name)
        records += [{**record, "seed": spec.seed} for record in _records(name, found.points, found.order)]
    FinishedParts(folder / PARTS).clear()
    sections = [section(name, found, settings.num_trajectories) for name, found in results.items()]
    left_out = (
        [f"Checkpoints that were not compared, because they were trained on none of these data sets: {', '.join(unfit)}."] if unfit else []
    )
    return records, "\n\n".join([summary({name: found.points for name, found in results.items()}), *sections, *left_out])


def _entrants(finished: Sequence[Run], spec: DatasetSpec, settings: Settings) -> dict[str, Entrant]:
    """Return trained simulators, with variants that repeat predictions, and what they cost before, by label."""
    found: dict[str, Entrant] = {}
    tuning = runs_in(settings.tuning)
    for label, (simulator, run) in trained_on(spec, finished, with_strides=True, with_other_labels=True).items():
        found[label] = Entrant(simulator, spent_on(run, finished, tuning), _teacher(labels_of(run, spec), spec))
    for checkpoint in settings.checkpoints:
        simulator = LearnedSimulator.from_checkpoint(checkpoint)
        metadata = simulator.builder.metadata
        fine = int(json.loads(metadata.config).get("fine", 1))
        if has_scenes_of(spec, metadata.dataset, fine) and metadata.spacing == spec.scene.spacing:
            label = f"{model_label(simulator)}, {checkpoint_label(checkpoint)}"
            if label in found:
                raise ComparisonError(
                    f"two models of {spec.name} are called {label}; copy one of the checkpoints to a file of another name"
                )
            found[label] = Entrant(simulator, Spent(math.nan), _teacher(Labels(fine), spec))
    for label, entrant in list(found.items()):
        simulator = entrant.simulator.to(settings.device)
        for repeats in settings.repeats:
            repeating = simulator.configured(skips=replace(simulator.skips, repeat_frames=repeats))
            found[f"{label}{REPEATED} × {repeats}"] = replace(entrant, simulator=repeating)
    return found


def _teacher(labels: Labels, spec: DatasetSpec) -> str:
    """Return the name of the solver that solved the labels, as in ``solver_rungs``."""
    base = DATA if labels.fine == spec.fine else NODES
    return base if labels.softness == 1 else f"{base}, {MODULI}{labels.softness:g}"


def compare(spec: DatasetSpec, entrants: dict[str, Entrant], settings: Settings, folder: Path | None = None, case: str = "") -> Comparison:
    """Run all simulators on the same scenes.

    Args:
        spec: the data set.
        entrants: learned models, by label.
        settings: settings of the comparison.
        folder: folder for finished scenes and reference solutions; None stores neither.
        case: name of the case, for the progress bar.
    """
    first = _first_frame(spec, entrants)
    points: dict[str, Point] = {}
    orders = []
    identity = _identity(spec, entrants, settings)
    parts = None if folder is None else FinishedParts(folder / PARTS)
    with progress_bar(f"{case}: scenes") as on_progress:
        for index in range(settings.num_trajectories):
            on_progress(index, settings.num_trajectories)
            known = {**identity, "index": index}
            scene = parts.get(known) if parts else None
            if scene is None:
                scene = list(_scene(spec, index, first, entrants, settings, None if folder is None else folder / REFERENCES))
                if parts:
                    parts.put(known, scene)
            orders += [_number(record["order"]) for record in scene if "order" in record]
            for record in (r for r in scene if "simulator" in r):
                point = points.setdefault(record["simulator"], Point(record["simulator"], record["family"]))
                point.seconds.append(record["seconds"])
                point.distance.append(_number(record["distance"], math.inf))
                for horizon, error in record["mse"].items():
                    point.mse.setdefault(horizon, []).append(_number(error, math.inf))
        on_progress(settings.num_trajectories, settings.num_trajectories)
    partial = {name: len(point.seconds) for name, point in points.items() if len(point.seconds) < settings.num_trajectories}
    for name, num_scenes in partial.items():
        log.warning("%s: %s is left out, because it has %d of %d scenes", case, name, num_scenes, settings.num_trajectories)
        del points[name]  # means over other scenes do not compare
    rates: dict[int, float] = {spec.fine: points[DATA].cost, 1: points[_nodes(spec)].cost}
    for label, entrant in entrants.items():
        points[label].overhead = entrant.spent.seconds(rates, float(getattr(spec.scene, "num_particles", math.nan)))
        points[label].teacher = entrant.teacher
    return Comparison([*points.values()], float(np.nanmedian(orders)), partial)


def _first_frame(spec: DatasetSpec, entrants: dict[str, Entrant]) -> int:
    """Return the first frame for which all learned models have enough history.

    Raises:
        ComparisonError: scenes end before it.
    """
    needed = {label: e.simulator.stride * e.simulator.builder.config.history for label, e in entrants.items()}
    label = max(needed, key=needed.__getitem__)
    if needed[label] > spec.num_frames - 2:
        raise ComparisonError(
            f"{spec.name}: {label} needs {needed[label]} frames before its first step, and scenes have {spec.num_frames}; "
            "leave its run out of suite.runs, or choose longer scenes (data.num_frames)"
        )
    return needed[label]


def _nodes(spec: DatasetSpec) -> str:
    """Return the name of the solver at the spacing of the nodes."""
    return DATA if spec.fine == 1 else NODES


def _identity(spec: DatasetSpec, entrants: dict[str, Entrant], settings: Settings) -> dict[str, Any]:
    """Return everything that the records of a scene depend on, except its number."""
    models = {label: [fingerprint_of(e.simulator), e.simulator.stride, asdict(e.simulator.skips)] for label, e in entrants.items()}
    keys = ("factors", "step_factors", "soft_factors", "split", "horizons", "num_threads", "accelerator")
    return {"data": spec.as_dict(), "models": models, **{key: getattr(settings, key) for key in keys}}


def _number(value: float | None, missing: float = math.nan) -> float:
    return missing if value is None else value


def _finite(value: float) -> float | None:
    """Return a number that JSON can store; None for NaN and infinity."""
    return value if math.isfinite(value) else None


def _scene(
    spec: DatasetSpec, index: int, first: int, entrants: dict[str, Entrant], settings: Settings, references: Path | None
) -> Iterator[dict[str, Any]]:
    """Run all simulators on one scene, learned models from frame ``first``.

    Yield the observed order, and a record for each simulator. Errors of failed rollouts are None.
    """
    reference = stored_reference(spec, settings.split, index, references)
    yield {"order": _finite(observed_order(spec, settings.split, index, reference))}
    start = initial_state(spec, settings.split, index)
    history = generate_trajectory(replace(spec, fine=1), settings.split, index, num_frames=first + 1)
    truth = reference.frames(first)
    seconds_of: dict[str, float] = {}
    for name, family, simulator, at in _simulators(spec, start, history, entrants, first, settings):
        prediction, seconds = timed(simulator, at, reference, first)
        if family == "learned":
            fraction = first / (reference.num_frames - 1)
            seconds = fraction * seconds_of[_nodes(spec)] + (1 - fraction) * seconds
        seconds_of[name] = seconds
        error = squared_error(prediction, truth)[1:]
        mse = {str(h): float(np.mean(error[:h])) for h in settings.horizons if h < len(error)} | {"full": float(np.mean(error))}
        yield {
            "simulator": name,
            "family": family,
            "seconds": seconds,
            "mse": {horizon: _finite(value) for horizon, value in mse.items()},
            "distance": _finite(distance(prediction, truth)),
        }


# --- simulators -------------------------------------------------------------------------------------------------------------------------------


def _simulators(
    spec: DatasetSpec,
    start: State,
    history: Trajectory,
    entrants: dict[str, Entrant],
    first: int,
    settings: Settings,
) -> Iterator[tuple[str, Family, Simulator, Start]]:
    """Yield the simulators. Solvers start at frame 0, all others at frame ``first`` of ``history``, where all learned models have enough of it."""
    for rung in rungs(spec, start, settings.factors, settings.step_factors, settings.soft_factors):
        yield rung.name, "solver", rung.solver, Start(rung.start, True, rung.frames_per_step)
    dt = spec.solver.frame_dt
    for label, simulator in ((label, entrant.simulator) for label, entrant in entrants.items()):
        seen = history.frames(first % simulator.stride).every(simulator.stride)
        at = Start(Resolved(simulator.initial_state(seen, first // simulator.stride), lambda pos: pos), False, simulator.stride)
        yield label, "learned", Contained(approximate(simulator), simulator.stride * dt), at
    for name, baseline in BASELINES.items():
        state = history.state(first, first)
        yield name.replace("_", " "), "trivial", baseline(dt), Start(Resolved(state, lambda pos: pos), False)


def _records(case: str, points: Sequence[Point], order: float) -> Iterator[dict[str, Any]]:
    yield {"metric": "observed_order", "case": case, "value": order, "unit": "1"}
    solvers = [p for p in points if p.family == "solver"]
    for point in points:
        about = {"case": case, "simulator": point.name, "family": point.family}
        yield {"metric": "time_per_simulated_second", **about, "value": point.cost, "values": _short(point.seconds), "unit": "1"}
        yield {"metric": "energy_distance", **about, "value": float(np.mean(point.distance)), "values": _short(point.distance), "unit": "m"}
        for horizon, values in point.mse.items():
            yield {
                "metric": "rollout_mse",
                **about,
                "horizon": horizon,
                "value": float(np.mean(values)),
                "values": _short(values),
                "unit": "m²",
            }
        yield {"metric": "overhead", **about, "value": point.overhead, "unit": "s"}
        for horizon in point.mse if point.family == "learned" else ():
            ratio = speed_up(point, solvers, horizon)
            yield {"metric": "time_ratio_at_equal_error", **about, "horizon": horizon, "value": ratio, "unit": "1"}
            if (paired := ratio_at_cost(point, solvers, horizon)) is not None:
                yield {"metric": "error_ratio_at_equal_time", **about, "horizon": horizon, **_of_interval(paired)}
            if (paired := ratio_at_cost(point, of_own_moduli(solvers), horizon)) is not None:
                yield {"metric": "error_ratio_at_equal_time_and_moduli", **about, "horizon": horizon, **_of_interval(paired)}
            for teacher in (p for p in solvers if p.name == point.teacher):
                paired = paired_ratio(point.mse[horizon], teacher.mse[horizon])
                yield {"metric": "error_ratio_to_training_data", **about, "horizon": horizon, **_of_interval(paired)}
            yield {
                "metric": "break_even",
                **about,
                "horizon": horizon,
                "value": break_even(point, solvers, horizon, duration=1.0),
                "unit": "s",
            }
    for horizon in points[0].mse:
        worst = max(p.cost for p in points), max(p.error(horizon) for p in points if p.name == BALLISTIC)
        for family in ("solver", "learned"):
            value = hypervolume([p for p in points if p.family == family], horizon, worst)
            yield {"metric": "hypervolume", "case": case, "family": family, "horizon": horizon, "value": value, "unit": "decade²"}


def _short(values: Sequence[float]) -> list[float]:
    """Round to five digits, far below the scatter of times and errors, so that files of results stay small."""
    return [float(f"{value:.5g}") for value in values]


def _of_interval(interval: Interval) -> dict[str, Any]:
    return {"value": interval.estimate, "low": interval.low, "high": interval.high, "unit": "1"}


def points_of(records: Sequence[dict[str, Any]], case: str) -> list[Point]:
    """Return cost and errors of each simulator of a case, from the records of ``results.json``."""
    points: dict[str, Point] = {}
    for r in records:
        if r["case"] == case and "simulator" in r:
            point = points.setdefault(r["simulator"], Point(r["simulator"], r["family"]))
            if r["metric"] == "time_per_simulated_second":
                point.seconds = r["values"]
            elif r["metric"] == "rollout_mse":
                point.mse[r["horizon"]] = r["values"]
            elif r["metric"] == "energy_distance":
                point.distance = r["values"]
            elif r["metric"] == "overhead":
                point.overhead = r["value"]
    return [*points.values()]


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw error against cost, a figure per case."""
    from gpe_pl.viz.comparison import CostAndError, cost_error_figure

    found = {}
    for case in dict.fromkeys(r["case"] for r in records):
        points = points_of(records, case)
        panels = {}
        for horizon in points[0].mse:
            lines: dict[str, list[tuple[float, float]]] = {
                "solver, coarser to the left": [],
                "solver, longer steps or softer": [],
                "solver, both": [],
            }
            marks: dict[str, list[tuple[float, float]]] = {}
            for point in points:
                place = point.cost, point.error(horizon)
                if point.family == "solver":
                    is_coarser, is_changed = SPACING in point.name, STEPS in point.name or MODULI in point.name
                    for label, belongs in zip(lines, (not is_changed, not is_coarser, is_coarser and is_changed), strict=True):
                        if belongs:
                            lines[label].append(place)
                elif point.family == "learned":
                    kind = point.name.partition(" ")[0] + (", repeated" if REPEATED in point.name else "")
                    kind += f", stride{point.name.partition(', stride')[2].partition(',')[0]}" if ", stride" in point.name else ""
                    marks.setdefault(kind, []).append(place)
            levels = {p.name: p.error(horizon) for p in points if p.family == "trivial"}
            panels[f"frames 1 – {horizon}" if horizon != "full" else "all frames"] = CostAndError(
                {label: places for label, places in lines.items() if len(places) > 1}, marks, levels
            )
        found[f"cost_error_{case}".replace(" ", "_")] = cost_error_figure(panels, "computing time per simulated second", "rollout MSE [m²]")
    return found
