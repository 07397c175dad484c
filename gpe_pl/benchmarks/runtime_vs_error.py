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

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from gpe_pl.benchmarks.cost_and_error import (
    WINNING_HORIZONS,
    Family,
    Point,
    break_even,
    cost_at_error,
    error_at_cost,
    front,
    hypervolume,
    paired_ratio,
    ratio_at_cost,
    winners,
)
from gpe_pl.benchmarks.solver_rungs import DATA, MODULI, NODES, SPACING, STEPS, coarser_solver, rungs
from gpe_pl.benchmarks.spent_before import Spent, spent_on
from gpe_pl.benchmarks.trained import Case, runs_in, trained_on
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory, initial_state
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import Interval, bootstrap_interval, energy_distance
from gpe_pl.reports.finished_runs import Run
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import SimulationError, Simulator, steps
from gpe_pl.schema import Split
from gpe_pl.solvers.finer_solver import FinerSolver, Refinable
from gpe_pl.solvers.resolution import Resolved, coarser
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

Frame = tuple[np.ndarray, np.ndarray]
"""Positions [node, dim] in m and velocities [node, dim] in m/s."""

BALLISTIC = "ballistic"
REPEATED = ", repeated predictions"


class ComparisonError(GpeError, ValueError):
    """Raised when a model or a reference solution is missing; the message says which."""


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison.

    Attributes:
        cases: data sets, by name.
        runs: folders of finished runs; their models take part in the case whose data set they were trained on.
        factors: factors by which the solver is also run at a coarser spacing than the data.
        step_factors: factors by which the solver's steps may also be longer, at the spacing of the data and at coarser ones.
        soft_factors: factors by which the solver's elastic moduli may also be smaller, where they are constants of the solver (``solver_rungs.softer``).
        repeats: numbers of frames for which predictions are repeated, each a further variant of every model (``Skips.repeat_frames``).
        tuning: folders of further runs that were trained to choose settings; the break-even counts their training.
        split, num_trajectories: split and number of the scenes.
        horizons: numbers of frames over which errors are averaged; the full length is always added.
        num_threads: threads of PyTorch; the solvers use one.
        accelerator: device of the models; the solvers run on the CPU.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    runs: list[str]
    factors: list[Annotated[float, Field(gt=1)]] = field(default_factory=lambda: [1.5, 2.0, 3.0])
    step_factors: list[Annotated[int, Field(gt=1)]] = field(default_factory=lambda: [2, 4])
    soft_factors: list[Annotated[float, Field(gt=1)]] = field(default_factory=lambda: [2.0, 4.0])
    repeats: list[Annotated[int, Field(gt=1)]] = field(default_factory=lambda: [2, 4])
    tuning: list[str] = field(default_factory=list)
    split: Split = "test_unseen"
    num_trajectories: Annotated[int, Field(ge=1)] = 5
    horizons: list[Annotated[int, Field(ge=1)]] = field(default_factory=lambda: [20, 50, 100])
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1
    accelerator: Literal["cpu", "gpu"] = "cpu"

    @property
    def device(self) -> str:
        return "cuda" if self.accelerator == "gpu" else "cpu"


def run(settings: Settings, specs: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """Return records of every simulator in every case, and a Markdown table per case with a section on where learned models lose.

    Raises:
        ComparisonError: no finished run was trained on a data set, or the reference solution failed.
    """
    torch.set_num_threads(settings.num_threads)
    records: list[dict[str, Any]] = []
    parts = []
    finished = runs_in(settings.runs)
    for name, spec in specs.items():
        models = _models(finished, spec, settings)
        if not models:
            raise ComparisonError(
                f"{' and '.join(settings.runs)}: no finished run that was trained on the data set {spec.name!r} of size {spec.size!r}; train with "
                f"`python -m gpe_pl.fit experiment=table1 size={spec.size}` or set suite.runs"
            )
        log.info("%s: %d models", name, len(models))
        points, order = compare(spec, models, settings)
        records += [{**record, "seed": spec.seed} for record in _records(name, points, order)]
        parts.append(_section(name, points, order, settings.num_trajectories))
    return records, "\n\n".join(parts)


def _models(finished: Sequence[Run], spec: DatasetSpec, settings: Settings) -> dict[str, tuple[LearnedSimulator, Spent]]:
    """Return trained simulators, with variants that repeat predictions, and what they cost before, by label."""
    found, tuning = {}, runs_in(settings.tuning)
    for label, (simulator, run) in trained_on(spec, finished, with_strides=True).items():
        spent = spent_on(run, finished, tuning)
        found[label] = simulator.to(settings.device), spent
        for repeats in settings.repeats:
            repeating = simulator.configured(skips=replace(simulator.skips, repeat_frames=repeats))
            found[f"{label}{REPEATED} × {repeats}"] = repeating, spent
    return found


def compare(spec: DatasetSpec, models: dict[str, tuple[LearnedSimulator, Spent]], settings: Settings) -> tuple[list[Point], float]:
    """Run all simulators on the same scenes; return their points and the solver's observed order of convergence."""
    first = max(simulator.stride * simulator.builder.config.history for simulator, _ in models.values())
    nodes = DATA if spec.fine == 1 else NODES
    points: dict[str, Point] = {}
    orders = []
    for index in range(settings.num_trajectories):
        data = generate_trajectory(spec, settings.split, index)
        start = initial_state(spec, settings.split, index)
        reference = _reference(spec, start, data)
        orders.append(_order(spec, start, data, reference))
        truth = reference.frames(first)
        history = data if spec.fine == 1 else generate_trajectory(replace(spec, fine=1), settings.split, index, num_frames=first + 1)
        for name, family, simulator, at in _simulators(spec, start, history, models, first, settings):
            point = points.setdefault(name, Point(name, family))
            prediction, seconds = _timed(simulator, at, data, first)
            if family == "learned":
                fraction = first / (data.num_frames - 1)
                seconds = fraction * points[nodes].seconds[-1] + (1 - fraction) * seconds
            point.seconds.append(seconds)
            error = _squared_error(prediction, truth)[1:]
            for horizon in (*(h for h in settings.horizons if h <= len(error)), None):
                point.mse.setdefault("full" if horizon is None else str(horizon), []).append(float(np.mean(error[:horizon])))
            point.distance.append(_distance(prediction, truth))
    rates: dict[int, float] = {spec.fine: points[DATA].cost, 1: points[nodes].cost}
    for label, (_, spent) in models.items():
        points[label].overhead = spent.seconds(rates, float(getattr(spec.scene, "num_particles", math.nan)))
    return [*points.values()], float(np.nanmedian(orders))


# --- simulators -------------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Restricted:
    """Start of a simulator.

    Attributes:
        resolved: its state, and the map from its positions to those of the scene's nodes.
        from_start: whether it starts at frame 0, not where all learned models have enough history.
        frames_per_step: number of frames that one step advances.
    """

    resolved: Resolved
    from_start: bool
    frames_per_step: int = 1


def _simulators(
    spec: DatasetSpec,
    start: State,
    history: Trajectory,
    models: dict[str, tuple[LearnedSimulator, Spent]],
    first: int,
    settings: Settings,
) -> Iterator[tuple[str, Family, Simulator, _Restricted]]:
    """Yield the simulators. Solvers start at frame 0, all others at frame ``first`` of ``history``, where all learned models have enough of it."""
    for rung in rungs(spec, start, settings.factors, settings.step_factors, settings.soft_factors):
        yield rung.name, "solver", rung.solver, _Restricted(rung.start, True, rung.frames_per_step)
    dt = spec.solver.frame_dt
    for label, (simulator, _) in models.items():
        seen = history.frames(first % simulator.stride).every(simulator.stride)
        at = _Restricted(Resolved(simulator.initial_state(seen, first // simulator.stride), lambda pos: pos), False, simulator.stride)
        yield label, "learned", Contained(approximate(simulator), simulator.stride * dt), at
    for name, baseline in BASELINES.items():
        state = history.state(first, first)
        yield name.replace("_", " "), "trivial", baseline(dt), _Restricted(Resolved(state, lambda pos: pos), False)


def _reference(spec: DatasetSpec, start: State, data: Trajectory) -> Trajectory:
    """Run the solver at half the spacing of the data's, seen at the nodes of the scene."""
    if not isinstance(spec.solver, Refinable):
        raise ComparisonError(f"{spec.name}: the solver {spec.solver.name} has no solution at a finer spacing to compare with")
    solver = FinerSolver(spec.solver.finer(2 * spec.fine), 2 * spec.fine, spec.scene.spacing)
    prediction, _ = _timed(solver, _Restricted(Resolved(start, lambda pos: pos), True), data, 0)
    if prediction.num_frames < data.num_frames:
        raise ComparisonError(f"{spec.name}: the reference solution failed after {prediction.num_frames - 1} frames")
    return prediction


def _order(spec: DatasetSpec, start: State, data: Trajectory, reference: Trajectory, num_frames: int = 20) -> float:
    """Return the observed order P = log₂ (|u_2h − u_h| / |u_h − u_{h/2}|) over the first frames; NaN if there is no rollout with spacing 2h.

    h is the spacing at which the data were solved.
    """
    is_fine = spec.fine > 1
    solver = spec.refined(spec.fine // 2) if is_fine else coarser_solver(spec, 2.0)
    try:
        resolved = Resolved(start, lambda pos: pos) if is_fine else coarser(start, spec.scene.spacing, 2.0)
    except ValueError:
        return float("nan")
    if solver is None:
        return float("nan")
    few = data.frames(0, min(num_frames, data.num_frames - 1) + 1)
    coarse, _ = _timed(solver, _Restricted(resolved, True), few, 0)
    if coarse.num_frames < few.num_frames:
        return float("nan")
    first = np.sqrt(np.mean(np.square(few.pos.astype(np.float64) - reference.pos[: few.num_frames])))
    second = np.sqrt(np.mean(np.square(coarse.pos - few.pos)))
    return float(np.log2(second / first))


def _timed(simulator: Any, at: _Restricted, data: Trajectory, kept_from: int) -> tuple[Trajectory, float]:
    """Run from the start ``at`` to the end of the data. Return the rollout from frame ``kept_from`` on, and its computing time over its simulated time.

    The rollout has the nodes of the scene. The first step runs twice and is timed once, so that compilation and first use of memory do not count. Time is
    processor time on a CPU, which counts every thread and depends less on other work, and wall time on a GPU. A failed rollout ends early. Frames within a step
    are interpolated.
    """
    start: Any = at.resolved.state
    dt = data.metadata.frame_dt
    first, every = 0 if at.from_start else kept_from, at.frames_per_step
    wanted = data.num_frames - first
    clock = time.perf_counter if isinstance(start.pos, torch.Tensor) and start.pos.is_cuda else time.process_time
    frames, seconds, num_steps = [_numpy(start)], 0.0, 0
    try:
        simulator.step(start)
        begun = clock()
        for state in steps(simulator, start, -(-(wanted - 1) // every)):
            if isinstance(state.pos, torch.Tensor) and state.pos.is_cuda:
                torch.cuda.synchronize()
            seconds += clock() - begun
            num_steps += 1
            pos, vel = _numpy(state)
            if not np.isfinite(pos).all():
                break
            frames += [_between(frames[-1], (pos, vel), k / every) for k in range(1, every)] + [(pos, vel)]
            begun = clock()
    except SimulationError as error:
        log.info("%s stopped: %s", type(simulator).__name__, error)
    pos = np.stack([at.resolved.restrict(p) for p, _ in frames[:wanted]])
    vel = np.stack([(at.resolved.restrict(p + dt * v) - at.resolved.restrict(p)) / dt for p, v in frames[:wanted]])
    trajectory = replace(data, pos=pos, vel=vel, stress=None).frames(kept_from - first)
    return trajectory, seconds / max(1, num_steps) / (every * dt)


def _between(before: Frame, after: Frame, fraction: float) -> Frame:
    return before[0] + fraction * (after[0] - before[0]), before[1] + fraction * (after[1] - before[1])


def _numpy(state: State) -> Frame:
    pos, vel = (x.detach().cpu().numpy() if isinstance(x, torch.Tensor) else x for x in (state.pos, state.vel))
    return np.array(pos, dtype=np.float64), np.array(vel, dtype=np.float64)


def _squared_error(prediction: Trajectory, truth: Trajectory) -> np.ndarray:
    """Return the mean squared error of every frame [m²], over nodes and axes; infinite for missing frames. Frame 0 may differ between resolutions."""
    error = np.full(truth.num_frames, np.inf)
    count = prediction.num_frames
    error[:count] = np.square(prediction.pos.astype(np.float64) - truth.pos[:count]).mean(axis=(1, 2))
    return error


def _distance(prediction: Trajectory, truth: Trajectory) -> float:
    if prediction.num_frames < truth.num_frames:
        return float("inf")
    return energy_distance(prediction.pos[-1], truth.pos[-1], prediction.mass, truth.mass)


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
            ratio = cost_at_error(solvers, point.error(horizon), horizon) / point.cost
            yield {"metric": "time_ratio_at_equal_error", **about, "horizon": horizon, "value": ratio, "unit": "1"}
            if (paired := ratio_at_cost(point, solvers, horizon)) is not None:
                yield {"metric": "error_ratio_at_equal_time", **about, "horizon": horizon, **_of_interval(paired)}
            if (paired := ratio_at_cost(point, _of_own_moduli(solvers), horizon)) is not None:
                yield {"metric": "error_ratio_at_equal_time_and_moduli", **about, "horizon": horizon, **_of_interval(paired)}
            for data in (p for p in solvers if p.name == DATA):
                paired = paired_ratio(point.mse[horizon], data.mse[horizon])
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


def _points(records: Sequence[dict[str, Any]], case: str) -> list[Point]:
    """Read the points that ``_records`` wrote."""
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


def _section(case: str, points: Sequence[Point], order: float, num_trajectories: int) -> str:
    horizons = [*points[0].mse]
    solvers = [p for p in points if p.family == "solver"]
    header = ["", "time per simulated second", *(f"MSE @{h}" for h in horizons), "energy distance [mm]"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    best = {DATA, NODES} | {p.name for h in horizons for p in front(solvers, h)}
    shown = [p for p in points if p.family != "solver" or p.name in best]
    for point in sorted(shown, key=lambda p: (("solver", "learned", "trivial").index(p.family), -p.cost)):
        cells = [_interval(point.mse[h], 1e3) for h in horizons]
        lines.append(table_row([point.name, f"{point.cost:.3g}", *cells, f"{1e3 * np.mean(point.distance):.3g}"]))
    note = (
        f"{num_trajectories} scenes. MSE ×1e-3 [m²] to the solver at half the spacing of the data's, whose observed order of convergence is "
        f"{order:.1f} (positions, first 20 frames): mean and 95 % interval over scenes. `{DATA}` is the error in the "
        "training data. Times: processor time of one core, warm, neighbour search and features included. Those of learned models include the solver "
        "that computes the frames before their first."
    )
    if len(shown) < len(points):
        note += f" Of the solvers, {len(points) - len(shown)} are only in `results.json`: at each horizon, another one is at least as fast and as accurate."
    lost = ["", *_ratios(points, horizons), "", "**Where the learned models lose**: time of a solver of the same error over theirs", ""]
    lost += [table_row(["", *(f"@{h}" for h in horizons)]), "|" + "---|" * (1 + len(horizons))]
    for point in (p for p in points if p.family == "learned"):
        lost.append(table_row([point.name, *(_against(point, solvers, h) for h in horizons)]))
    lost += [
        "",
        "**Break-even**: seconds of simulation after which tuning, training and their data have paid off, against a solver of the same error",
        "",
    ]
    after = {p.name: [break_even(p, solvers, h, duration=1.0) for h in horizons] for p in points if p.family == "learned"}
    if np.isinf([*after.values()]).all():
        lost.append("Never, for any of the models.")
    else:
        lost += [table_row(["", *(f"@{h}" for h in horizons)]), "|" + "---|" * (1 + len(horizons))]
        lost += [table_row([name, *map(_pays_off, values)]) for name, values in after.items()]
    return "\n".join([f"### {case}", "", *lines, "", note, "", "**At equal error**", "", *verdicts(points, horizons), *lost])


def _ratios(points: Sequence[Point], horizons: Sequence[str]) -> Iterator[str]:
    """Yield a table of learned models against the solvers at equal time and against the solver of their data, and who wins."""
    solvers = [p for p in points if p.family == "solver"]
    data = next((p for p in solvers if p.name == DATA), None)
    yield from (
        "**At equal time**: error over that of a solver of the same cost, and over that of the training data's solver at its own cost",
        "",
    )
    yield table_row(["", "against", *(f"@{h}" for h in horizons)])
    yield "|" + "---|" * (2 + len(horizons))
    for point in (p for p in points if p.family == "learned"):
        at_cost = [ratio_at_cost(point, solvers, h) for h in horizons]
        yield table_row([point.name, "solver of the same cost", *map(_ratio, at_cost)])
        if (hard := _of_own_moduli(solvers)) != solvers:
            at_cost = [ratio_at_cost(point, hard, h) for h in horizons]
            yield table_row([point.name, "the same, moduli of the data", *map(_ratio, at_cost)])
        if data is not None:
            yield table_row([point.name, "solver of the data", *(_ratio(paired_ratio(point.mse[h], data.mse[h])) for h in horizons)])
    winning = winners(points, horizons)
    rule = f"A model wins if the 95 % interval over paired scenes lies below 1 at equal time, at {WINNING_HORIZONS} horizons or more."
    yield from ("", f"{rule} {'**' + ', '.join(winning) + '** wins.' if winning else 'None does.'}")
    if (hard := _of_own_moduli(solvers)) != solvers:
        winning = winners([*hard, *(p for p in points if p.family == "learned")], horizons)
        found = f"{', '.join(winning)} would win" if winning else "none would win, either"
        yield from ("", f"If the solver had to keep the elastic moduli of the data, {found}.")


def _of_own_moduli(solvers: Sequence[Point]) -> list[Point]:
    """Return the solvers whose elastic moduli are those of the data."""
    return [p for p in solvers if MODULI not in p.name]


def _ratio(interval: Interval | None) -> str:
    if interval is None:
        return "every solver costs more"
    text = f"{interval.estimate:.2f} [{interval.low:.2f}, {interval.high:.2f}]"
    return f"**{text}**" if interval.high < 1 else text


def _pays_off(seconds: float) -> str:
    return "never" if math.isinf(seconds) else "not known" if math.isnan(seconds) else f"{seconds:.3g}"


def _against(point: Point, solvers: Sequence[Point], horizon: str) -> str:
    """Return the table cell that compares a model with the solvers at equal error; below 1 the model is slower."""
    needed = cost_at_error(solvers, point.error(horizon), horizon)
    if needed <= point.cost:
        return f"{needed / point.cost:.2g}"
    if np.isinf(needed):
        return "**more accurate than every solver that was run**"
    if point.error(horizon) > front(solvers, horizon)[0].error(horizon):
        return "cheaper and less accurate than every solver that was run"
    return f"**{needed / point.cost:.2g}**"


def verdicts(points: Sequence[Point], horizons: Sequence[str]) -> Iterator[str]:
    """Yield one line per horizon: whether a learned model lies below the solvers' front, or what the nearest model lacks."""
    solvers = [p for p in points if p.family == "solver"]
    learned = [p for p in points if p.family == "learned"]
    for horizon in horizons:
        comparable = [p for p in learned if p.error(horizon) <= front(solvers, horizon)[0].error(horizon)]
        gain = {p.name: cost_at_error(solvers, p.error(horizon), horizon) / p.cost for p in comparable}
        if not gain:
            yield f"- @{horizon}: {_none_as_accurate(learned, front(solvers, horizon)[0], horizon)}"
            continue
        nearest = max(comparable, key=lambda p: gain[p.name])
        if gain[nearest.name] > 1:
            ahead = [name for name, value in gain.items() if value > 1]
            yield f"- @{horizon}: **below the solver's curve**: {', '.join(ahead)}."
            continue
        error = error_at_cost(solvers, nearest.cost, horizon)
        yield (
            f"- @{horizon}: no learned model passes below the solver's curve. Nearest is {nearest.name}: it would have to be "
            f"{_rounded(1 / gain[nearest.name])} times faster, or {_rounded(nearest.error(horizon) / error)} times more accurate at its cost."
        )


def _none_as_accurate(learned: Sequence[Point], cheapest: Point, horizon: str) -> str:
    nearest = min(learned, key=lambda p: p.error(horizon))
    return (
        f"no learned model is as accurate as the cheapest of the solvers ({cheapest.name}). Nearest is {nearest.name}: it would have to be "
        f"{_rounded(nearest.error(horizon) / cheapest.error(horizon))} times more accurate and {_rounded(nearest.cost / cheapest.cost)} times faster."
    )


def _rounded(factor: float) -> str:
    """Format with two digits; from a million on, with an exponent."""
    return f"{float(f'{factor:.2g}'):g}"


def _interval(values: list[float], scale: float) -> str:
    if not np.isfinite(values).all():
        return f"{int((~np.isfinite(values)).sum())} of {len(values)} failed"
    i = bootstrap_interval(np.array([values]) * scale, statistic=np.mean)
    return f"{i.estimate:.3g} [{i.low:.3g}, {i.high:.3g}]"


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw error against cost, a figure per case."""
    from gpe_pl.viz.comparison import CostAndError, cost_error_figure

    found = {}
    for case in dict.fromkeys(r["case"] for r in records):
        points = _points(records, case)
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
