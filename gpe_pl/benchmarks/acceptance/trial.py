"""One scene, run by the solver and by a model; and the criteria that compare them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gpe_pl.benchmarks.acceptance.scenes import material_of, values_of
from gpe_pl.benchmarks.half_steps import HalfSteps
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import Check
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Simulator, rollout, steps
from gpe_pl.schema import MATERIALS
from gpe_pl.solvers.scenes import describe
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from gpe_pl.viz.captions import frame_time, parameter_name, parameter_value

FASTER = 5.0
"""A rollout stops at this multiple of the solver's largest speed, or of 1 m/s if the solver is slower."""

MAX_CORRECTED = 0.01
"""Largest fraction of particle-steps in which containment may move a particle back out of a wall."""

SMALLEST_CHANGE = 0.1
"""Smallest change of a quantity over the range of the parameter, as a fraction, that a person would see. Smaller changes are not compared."""


class TrialError(GpeError, RuntimeError):
    """Raised when the solver cannot finish a scene; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """A trained simulator and the data set on which it was trained.

    Attributes:
        name: name of the model.
        simulator: simulator with the weights and settings of its checkpoint, static friction among them.
        spec: data set; its solver is the reference.
    """

    name: str
    simulator: LearnedSimulator
    spec: DatasetSpec

    @property
    def spacing(self) -> float:
        return self.spec.scene.spacing

    @property
    def values(self) -> tuple[float, float, float]:
        """Lowest and highest trained value of the material parameter, and an unseen one between."""
        ((_, trained),) = self.simulator.trained_ranges()
        return values_of(*trained[:, 0].tolist())

    def metadata(self) -> Metadata:
        """Return the metadata of all scenes."""
        solver = self.spec.solver
        return describe(
            self.spec.scene, solver.frame_dt, dataset=self.spec.name, solver=solver.name, solver_version=solver.version,
            config=json.dumps(self.spec.provenance, sort_keys=True),
        )  # fmt: skip

    def described(self, value: float) -> str:
        """Return the material parameter with name and unit, marked as unseen if it is not a trained value."""
        unseen = "" if value in (self.values[0], self.values[2]) else ", unseen"
        parameter = MATERIALS[material_of(self.spec)][0]
        return f"{parameter_name(parameter)} {parameter_value(parameter, value)}{unseen}"


@dataclass(frozen=True)
class Trial:
    """Rollouts of one scene by solver and model, from the frame at which the model starts.

    Attributes:
        value: material parameter.
        truth: rollout of the solver.
        finer: rollout of the solver with half the time step (``HalfSteps``), whose difference from ``truth`` is the solver's own uncertainty.
        model: rollout of the model with containment.
        corrected: fraction of particle-steps that containment corrected; NaN for a model that stopped early.
    """

    value: float
    truth: Trajectory
    finer: Trajectory
    model: Trajectory
    corrected: float

    def measured(self, quantity: Callable[[Trajectory], float]) -> tuple[float, float, float]:
        """Return a quantity of model, solver and finer solver; NaN for a model that stopped early."""
        own = math.nan if self.model.termination is not None else float(quantity(self.model))
        return own, float(quantity(self.truth)), float(quantity(self.finer))


def tried(candidate: Candidate, value: float, start: State, seconds: float) -> Trial:
    """Run a scene by solver and model. The solver starts at ``start``; the model starts some frames later, when the solver has the history that it needs.

    Args:
        candidate: model and its data set.
        value: material parameter of the scene, for the results.
        start: initial state.
        seconds: duration of the compared rollouts [s].

    Raises:
        TrialError: the solver stopped early, so there is nothing to compare with.
    """
    history = candidate.simulator.builder.config.history
    whole, finer = _solved(candidate, start, seconds, history)
    return _trial(candidate, value, whole.frames(history), finer.frames(history), candidate.simulator.initial_state(whole, history))


def tried_from_rest(candidate: Candidate, value: float, start: State, seconds: float) -> Trial:
    """Do the same as ``tried`` for a scene at rest. Both start at ``start``: the model's history is that of nodes that have not moved before."""
    truth, finer = _solved(candidate, start, seconds, 0)
    return _trial(candidate, value, truth, finer, candidate.simulator.standing(start, candidate.metadata()))


def _solved(candidate: Candidate, start: State, seconds: float, history: int) -> tuple[Trajectory, Trajectory]:
    """Return the rollouts of the solver, and of the solver with half its time step, over the duration and the frames of the history before it."""
    solver: Any = candidate.spec.solver
    num_frames, metadata = max(2, round(seconds / solver.frame_dt)), candidate.metadata()
    whole = rollout(solver, start, history + num_frames, metadata)
    finer = rollout(HalfSteps(solver), start, history + num_frames, metadata)
    for run, name in ((whole, "the solver"), (finer, "the solver with half its time step")):
        if run.termination is not None:
            raise TrialError(f"{candidate.spec.name}: {name} stopped early, so there is nothing to compare with: {run.termination.message}")
    return whole, finer


def _trial(candidate: Candidate, value: float, truth: Trajectory, finer: Trajectory, state: State) -> Trial:
    model, corrected = predicted(candidate, state, truth)
    return Trial(value, truth, finer, model, math.nan if model.termination is not None else corrected)


def advanced(solver: Simulator, state: State, num_steps: int) -> State:
    """Return the state after ``num_steps`` steps."""
    for after in steps(solver, state, num_steps):
        state = after
    return state


def predicted(candidate: Candidate, state: State, truth: Trajectory) -> tuple[Trajectory, float]:
    """Return the rollout of the model over the frames of the truth, and the fraction of particle-steps that containment corrected."""
    metadata, num_corrected = truth.metadata, 0.0
    speed = FASTER * max(1.0, float(np.linalg.norm(truth.vel, axis=-1).max()))
    margin = max(high - low for low, high in metadata.bounds)

    def count(_: int, new: State) -> None:
        nonlocal num_corrected
        num_corrected += new.num_corrected

    contained = Contained(candidate.simulator, metadata.frame_dt)
    guard = Guard(speed, metadata.bounds, margin, metadata.spacing)
    model = rollout(contained, state, truth.num_frames - 1, metadata, guard, count)
    return model, num_corrected / max(1, (model.num_frames - 1) * model.num_nodes)


# --- criteria -------------------------------------------------------------------------------------------------------------------------------


def listed(values: Sequence[float]) -> str:
    """Return numbers as text with three significant digits, separated by commas. NaN stands for a rollout that ended early, and becomes ``stopped``."""
    return ", ".join("stopped" if math.isnan(v) else f"{v:.3g}" for v in values)


def _both(model: Sequence[float], solver: Sequence[float], unit: str) -> tuple[str, str]:
    return f"{listed(model)}{unit}", f"{listed(solver)}{unit}"


def at_most(name: str, values: Sequence[float], limit: float, unit: str) -> Check:
    """Return the check ``name`` that no value exceeds ``limit``; both have the unit ``unit``."""
    return Check(name, all(v <= limit for v in values), f"{listed(values)}{unit}", "", f"at most {limit:.3g}{unit}")


def not_above_solver(name: str, values: Sequence[tuple[float, float, float]], limit: float, unit: str) -> Check:
    """Return the check that no value of the model exceeds its limit: ``limit``, or twice the larger value of the two solver runs of the scene if that is more.

    ``values`` has the quantity of model, solver and finer solver in each scene.
    """
    own = [max(solver, finer) for _, solver, finer in values]
    passed = all(model <= max(limit, 2 * most) for (model, _, _), most in zip(values, own, strict=True))
    return Check(name, passed, *_both([model for model, _, _ in values], own, unit), f"at most {limit:.3g}{unit} or twice the solver's")


def near_solver(name: str, values: Sequence[tuple[float, float, float]], tolerance: float, smallest: float, unit: str) -> Check:
    """Return the check that values of the model are near those of the solver in the same scenes.

    Args:
        name: name of the check.
        values: quantity of model, solver and finer solver in each scene.
        tolerance: largest difference as a fraction of the solver's value.
        smallest: difference that always passes, in the unit of the values. A difference of twice that between the two solver runs passes, too.
        unit: unit of the values.
    """
    passed = all(abs(own - solver) <= max(tolerance * abs(solver), smallest, 2 * abs(finer - solver)) for own, solver, finer in values)
    limit = f"within {100 * tolerance:.3g} % of the solver, {smallest:.2g}{unit} or twice the solver's change at half its time step"
    return Check(name, passed, *_both([m for m, _, _ in values], [s for _, s, _ in values], unit), limit)


def follows_parameter(name: str, values: Sequence[tuple[float, float, float]], unit: str) -> list[Check]:
    """Return the check that a quantity changes with the material parameter as the solver's does: in the same order, and by half to twice as much.

    A model that ignores the parameter fails. The check is left out if the solver's values do not rise or fall steadily by more than their uncertainty, or
    change too little to be seen (``SMALLEST_CHANGE``).
    """
    model, solver, finer = (np.array(v) for v in zip(*values, strict=True))
    change = solver[-1] - solver[0]
    in_order = (np.diff(solver) * np.sign(change) > np.abs(solver - finer).max()).all()
    if not in_order or abs(change) < SMALLEST_CHANGE * np.abs(solver).mean():
        return []
    ratio = (model[-1] - model[0]) / change
    passed = bool((np.diff(model) * np.sign(change) > 0).all() and 0.5 <= ratio <= 2)
    order = "rises" if change > 0 else "falls"
    limit = f"{order} with the parameter, by half to twice the solver's change"
    return [Check(name, passed, *_both(model.tolist(), solver.tolist(), unit), limit)]


def of_size(name: str, values: Sequence[tuple[float, float, float]], unit: str) -> Check:
    """Return the check that a quantity is half to twice the solver's in the same scenes."""
    passed = all(0.5 * solver <= own <= 2 * solver for own, solver, _ in values)
    return Check(name, passed, *_both([m for m, _, _ in values], [s for _, s, _ in values], unit), "half to twice the solver's")


def contained(name: str, trials: Sequence[Trial]) -> Check:
    """Return the check that the model does not need containment to stay out of walls."""
    return at_most(f"{name}: particle-steps that containment corrected", [100 * t.corrected for t in trials], 100 * MAX_CORRECTED, " %")


# --- what a scene returns -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shown:
    """One column of a scene's figure: under a ``title``, the solver (``truth``) above and the ``model`` below, at one frame."""

    title: str
    truth: Trajectory
    model: Trajectory
    frame: int


@dataclass(frozen=True)
class Result:
    """Result of a scene: its ``checks``, and the columns of its figure (``shown``)."""

    checks: list[Check]
    shown: list[Shown]

    def figure(self) -> Figure:
        """Draw the figure of the scene."""
        from gpe_pl.benchmarks.acceptance.figures import scene_figure

        return scene_figure(self.shown)


def shown(candidate: Candidate, trials: Sequence[Trial], *fractions: float) -> list[Shown]:
    """Return a column of the figure for each trial and each fraction of its length."""
    columns = []
    for trial in trials:
        for fraction in fractions:
            frame = round(fraction * (trial.truth.num_frames - 1))
            time = frame_time(frame, trial.truth)
            columns.append(Shown(f"{candidate.described(trial.value)}\n{time}", trial.truth, trial.model, frame))
    return columns


def centre(trajectory: Trajectory) -> np.ndarray:
    """Return the centre of mass [frame, dim] in m."""
    mass = trajectory.mass.astype(np.float64)
    return np.einsum("n,fnd->fd", mass / mass.sum(), trajectory.pos.astype(np.float64))
