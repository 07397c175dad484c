"""Results folder of many scenes: a file and pictures per scene, and a table of all. Scenes that have an answer are not computed again."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from matplotlib.figure import Figure

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.answer import (
    FOLDER,
    MODEL,
    SOLVER,
    Answer,
    Value,
    answer_path,
    known_of,
    read_answer,
    read_answers,
    side_by_side,
)
from gpe_pl.evaluation.identification.calibration import Calibration, cross_calibrated
from gpe_pl.evaluation.identification.observations import Observations, ObservationSettings
from gpe_pl.evaluation.identification.pictures import misfit_figure
from gpe_pl.evaluation.identification.scene import SolverError, identify_parameters, solver_bounds, solver_of, trained_bounds
from gpe_pl.evaluation.identification.search import SearchSettings
from gpe_pl.evaluation.identification.shooting import ShootingSettings, started
from gpe_pl.evaluation.identification.unknowns import Bounds, Unknowns, check_bounds, unknowns_of
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.conformal import coverage, fewest_scenes, interval_score
from gpe_pl.rollout.loop import rollout
from gpe_pl.system.progress import progress_bar
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.figures import rollout_figure
from gpe_pl.viz.saving import save_figure

SHOWN_FRAMES = 60
"""Largest number of frames of the picture of observed and fitted motion."""


class MotionError(GpeError, ValueError):
    """Raised for a motion that the calibration is from, or that is not the one of a stored answer."""


@dataclass(frozen=True)
class Task:
    """What to identify in each scene, and how.

    Attributes:
        model: trained model, which also gives the bounds.
        unknowns, per_body, bounds: as in ``identify_parameters``.
        simulators: ``model``, ``solver``, or both.
        observations, shooting, search: settings.
        calibrations: calibration by simulator and name of the unknown.
        calibrated_on: digests of the motions of the calibration (``Observations.digest``).
    """

    model: LearnedSimulator
    unknowns: Sequence[str] | None
    per_body: bool
    bounds: Bounds
    simulators: Sequence[str]
    observations: ObservationSettings
    shooting: ShootingSettings
    search: SearchSettings
    calibrations: Mapping[str, Mapping[str, Calibration]]
    calibrated_on: Collection[str] = ()

    def run(self, name: str, trajectory: Trajectory, folder: Path) -> Iterator[str]:
        """Identify one scene, write the answers and pictures into a folder, and yield lines for readers."""
        model = self.model.on(trajectory.metadata)
        check_bounds(self.bounds, trajectory.metadata)
        observed = Observations.of(trajectory, self.observations)
        preferred = {**trained_bounds(model), **self.bounds}  # models may know more materials than the data set has
        bounds = {name: preferred.get(name, ends) for name, ends in solver_bounds(trajectory.metadata).items()}
        if observed.digest in self.calibrated_on:
            raise MotionError(f"{name}: this motion is one of those that the calibration is from; calibrate on other scenes")
        answers: dict[str, Answer] = {}
        misfit, motion = (folder / FOLDER / f"{name}_{what}.png" for what in ("misfit", "motion"))
        is_drawn = misfit.exists() and motion.exists()
        for kind in self.simulators:
            path = answer_path(folder, name, kind)
            if not path.exists():
                try:
                    simulator = model if kind == MODEL else solver_of(trajectory.metadata)
                except SolverError as error:
                    if len(self.simulators) == 1:
                        raise
                    yield str(error)
                    continue
                with progress_bar(f"{name} {kind}") as on_progress:
                    answer = identify_parameters(
                        simulator, observed, self.unknowns, per_body=self.per_body, bounds=bounds, shooting_settings=self.shooting,
                        search_settings=self.search, calibration=self.calibrations.get(kind), scene=name, on_progress=on_progress,
                    )  # fmt: skip
                answer.write(folder)
                is_drawn = False
            answers[kind] = read_answer(path)
            if answers[kind].observed != observed.digest:
                raise MotionError(
                    f"{path}: is the answer for another motion than that of {name} in the trajectories now; choose another name=… or delete {folder}"
                )
        sought = unknowns_of(observed.completed, self.unknowns, bounds, self.per_body)
        if not is_drawn:
            save_figure(misfit_figure(answers), misfit, dpi=110)
            save_figure(self._motion(trajectory, sought, answers), motion, dpi=110)
        yield from side_by_side(answers)
        yield from (f"{kind}: {answer.gradients}" for kind, answer in answers.items() if answer.gradients)

    def _motion(self, trajectory: Trajectory, sought: Unknowns, answers: Mapping[str, Answer]) -> Figure:
        """Return a figure of the observed motion beside rollouts with the answers."""
        model = self.model.on(trajectory.metadata).configured(clamps_parameters=False)
        first = 0 if sought.needs_start else model.builder.config.history
        number = min(SHOWN_FRAMES, trajectory.num_frames - 1 - first)
        shown: dict[str, Trajectory] = {}
        for kind, answer in answers.items():
            z = np.array([(u.coordinate(v.raw) - u.coordinate(u.low)) / u.range for u, v in zip(sought.items, answer.values, strict=True)])
            if kind == MODEL:
                state = trajectory.state(0).to_torch() if sought.needs_start else model.initial_state(trajectory, first)
                start = started(model, sought, state, torch.from_numpy(z), trajectory.metadata)
                shown[kind] = rollout(model, start, number, trajectory.metadata)
            else:
                run = rollout(solver_of(trajectory.metadata), sought.applied(trajectory.state(0), z), first + number, trajectory.metadata)
                shown[kind] = replace(run, is_prediction=True).frames(first, run.num_frames)
        return rollout_figure(trajectory.frames(first, first + number + 1), shown)


def write_table(folder: Path) -> str:
    """Write ``table.md`` with the answers of all scenes and their errors, and return the summary."""
    answers = {kind: read_answers(folder, kind) for kind in (MODEL, SOLVER)}
    rows = [
        table_row(["scene", "simulator", "unknown", "answer", "stored value", "bound", "rollouts", "processor seconds"]),
        "|" + "---|" * 8,
    ]
    for kind, own in answers.items():
        for answer in own:
            for value in answer.values:
                truth = "" if value.truth is None else f"{value.truth:.4g}"
                cells = [answer.scene, kind, value.label, value.text, truth, value.at_bound, str(answer.num_evaluations)]
                rows.append(table_row([*cells, f"{answer.processor_seconds:.1f}"]))
    summary = _summary(answers)
    replace_text(folder / "table.md", "\n".join([*summary, "", *rows, ""]))
    return "\n".join(summary)


INTERIOR = 0.1
"""True values that are at least this fraction of the range away from the bounds are in the interior."""
HEAD = (
    *(
        "unknown",
        "simulator",
        "calibration",
        "scenes",
        "at a bound",
        "median error",
        "in the interior",
        "median relative error",
        "mean error",
    ),
    *("coverage", "interval score", "processor seconds"),
)


def _summary(answers: Mapping[str, list[Answer]]) -> list[str]:
    """Return a table of errors per unknown and simulator, over scenes with a stored value.

    If a run without calibration has enough scenes, further rows show what a calibration would give. Each half of the scenes is calibrated on the other half. If
    halves are too small, each scene is calibrated on the others. Intervals follow the profiles of the scenes, or all have one width.
    """
    lines = [table_row([*HEAD]), "|" + "---|" * len(HEAD)]
    for kind, own in answers.items():
        for name, known in known_of(own).items():
            found = [
                (answer, value)
                for answer in own
                for value in answer.values
                if value.name.partition("#")[0] == name and value.truth is not None
            ]
            values, level, is_calibrated = [value for _, value in found], found[0][0].level, found[0][0].num_calibration > 0
            given = np.array([[v.coordinate(end) for end in (v.estimate, v.low, v.high)] for v in values])
            rows = {"earlier run" if is_calibrated else "none": given}
            _, place = np.unique([own.scene for own in known], return_inverse=True)
            number, least = int(place.max()) + 1, fewest_scenes(level)
            if not is_calibrated and number > least:
                half, others = (place % 2, "the other half") if number >= 2 * least else (place, "other scenes")
                rows[others] = cross_calibrated(known, half, level)
                rows[f"{others}, one width"] = cross_calibrated(known, half, level, adapts=False)
            num_at_bound = str(sum(bool(value.at_bound) for value in values))
            seconds = f"{median(answer.processor_seconds for answer, _ in found):.1f}"
            truth = np.array([own.truth for own in known])
            for calibration, ends in rows.items():
                numbers = _numbers(ends, truth, values, level)
                lines.append(table_row([name, kind, calibration, str(number), num_at_bound, *numbers, seconds]))
    return lines if len(lines) > 2 else ["no scene has a stored value to compare with"]


def _numbers(found: np.ndarray, truth: np.ndarray, values: Sequence[Value], level: float) -> list[str]:
    """Return errors, coverage and interval score of answers and interval ends [scene, 3] in coordinates, as cells of the table."""
    estimate, low, high = found.T
    plain = np.exp if values[0].is_log else np.asarray
    error = plain(estimate) - plain(truth)
    inside = np.abs(error[[*map(_is_inside, values)]])
    interior = f"{np.median(inside):.3g}" if len(inside) else ""
    relative = f"{np.median(np.abs(error / plain(truth))):.1%}" if (plain(truth) != 0).all() else ""
    score = f"{interval_score(low, high, truth, level).mean():.3g}" + (" (logarithm)" if values[0].is_log else "")
    cells = [f"{np.median(np.abs(error)):.3g}", interior, relative, f"{error.mean():.3g}"]
    return [*cells, f"{coverage(low, high, truth):.0%} of {level:.0%}", score]


def _is_inside(value: Value) -> bool:
    """Return whether the true value, which has to be known, lies in the interior of the range between the bounds."""
    assert value.truth is not None
    (low, high), at = map(value.coordinate, value.bounds), value.coordinate(value.truth)
    return low + INTERIOR * (high - low) <= at <= high - INTERIOR * (high - low)
