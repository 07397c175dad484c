"""Stress tests of inputs unlike training: materials, values that are not finite, wrong types, other time steps."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from gpe_pl.benchmarks.stability.subject import Outcome, Subject, acceleration, no_boundary, relative_change, stress_test, with_velocities
from gpe_pl.errors import GpeError
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import SimulationError, Simulator, Start, rollout, rollouts, step_all
from gpe_pl.schema import BOUNDARY, node_code
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

NUM_STEPS = 20


@dataclass(frozen=True)
class Spoiled:
    """Simulator whose result of one frame is replaced.

    Attributes:
        simulator: the undisturbed simulator.
        frame: number of the frame, counted from the start of the rollout.
        num_nodes: number of nodes of the scene; results of other scenes are not replaced.
        spoil: function of the state before the step and the result, which returns the replacement.
        dt: time between frames [s].
        start: time at the start of the rollout [s].
    """

    simulator: Simulator
    frame: int
    num_nodes: int
    spoil: Callable[[State, State], State]
    dt: float
    start: float

    def step(self, state: State) -> State:
        new = self.simulator.step(state)
        is_now = round((new.time - self.start) / self.dt) == self.frame and state.num_nodes == self.num_nodes
        return self.spoil(state, new) if is_now else new


@stress_test(
    17,
    "material parameters",
    "a tenth of the smallest and ten times the largest trained one: finite and flagged; ±∞ and NaN: refused with the node's number; missing: refused",
)
def materials(subject: Subject) -> Outcome:
    simulator, state = subject.simulator, subject.state()
    found = []
    for end, factor in ((0, 0.1), (1, 10.0)):
        params = state.material_params.clone()
        for material, trained in simulator.trained_ranges():
            rows = torch.nonzero(state.node_type == node_code(material)).flatten()
            params[rows[:, None], simulator.builder.metadata.columns_of(material)] = factor * trained[end]
        scaled = replace(state, material_params=params)
        finite = bool(torch.isfinite(acceleration(simulator, scaled)).all())
        found.append(finite and bool(simulator.untrained_parameters(scaled)))
    refused = 0
    for value in (np.inf, -np.inf, np.nan):
        truth = subject.scenes[0]
        params = truth.material_params.copy()
        params[3] = value
        refused += _raises(partial(simulator.initial_state, replace(truth, material_params=params), subject.history), "node 3 ")
    lacking = replace(truth.metadata, param_names=())
    refused += _raises(partial(simulator.initial_state, replace(truth, material_params=params[:, :0], metadata=lacking), subject.history))
    return Outcome(all(found) and refused == 4, f"{sum(found)} of 2 finite and flagged, {refused} of 4 refused")


def _raises(call: Callable[[], Any], text: str = "") -> bool:
    try:
        call()
    except GpeError as error:
        return text in str(error)
    return False


@stress_test(
    18,
    "values that are not finite",
    "NaN or ∞ in one node: found within a step, with frame and node; another scene of the batch does not change",
)
def not_finite(subject: Subject) -> Outcome:
    simulator, state, other = subject.simulator, subject.state(), subject.state(1, 0.3)
    problems = []
    guard = Guard(1e6, ((-1e6, 1e6),) * state.dim)
    for value in (np.nan, np.inf):
        pos = state.pos.clone()
        pos[5] = value
        metadata = subject.scenes[0].metadata

        def spoil(_: State, new: State, pos: Any = pos) -> State:
            return replace(new, pos=pos)

        spoiled = Spoiled(simulator, 2, state.num_nodes, spoil, subject.dt, state.time)
        stop = rollout(spoiled, state, 4, metadata, guard).termination
        if stop is None or (stop.reason, stop.frame, stop.node) != ("nan", 2, 5):
            problems.append(f"{value}: {stop}")
        both = step_all(simulator, [replace(state, pos=pos), other])
        if not isinstance(both[0], SimulationError) or isinstance(both[1], SimulationError):
            problems.append(f"{value} in a batch is not named")
        elif relative_change(both[1].pos, simulator.step(other).pos) > 1e-6:
            problems.append(f"{value} changes the other scene")
    return Outcome(not problems, "; ".join(problems) or "frame and node named, other scene unchanged")


@stress_test(
    19,
    "types",
    "unknown node type and integer positions: a typed error; single precision and strided arrays: the same result or a typed error",
)
def types(subject: Subject) -> Outcome:
    simulator, state = subject.simulator, subject.state()
    truth = subject.scenes[0]
    reference = acceleration(simulator, subject.simulator.initial_state(truth, subject.history))
    strange = state.node_type.clone()
    strange[2] = node_code(BOUNDARY)
    results = {
        "unknown type": _raises(lambda: simulator.step(replace(state, node_type=strange))),
        "integer positions": _raises(lambda: simulator.step(replace(state, pos=(1000 * state.pos).long()))),
        "single precision": _raises(lambda: simulator.step(replace(state, pos=state.pos.float()))),
        "strided": _same(subject, replace(truth, pos=np.asfortranarray(truth.pos)), reference),
        "double": _same(subject, replace(truth, pos=truth.pos.astype(np.float64)), reference),
    }
    bad = [name for name, is_right in results.items() if not is_right]
    return Outcome(not bad, f"wrong: {', '.join(bad)}" if bad else f"{len(results)} of {len(results)} right")


def _same(subject: Subject, trajectory: Trajectory, reference: torch.Tensor) -> bool:
    try:
        return torch.equal(acceleration(subject.simulator, subject.simulator.initial_state(trajectory, subject.history)), reference)
    except GpeError:
        return True


@stress_test(
    20,
    "time steps and speeds × 2, 5, 10",
    "another frame interval: a typed error; such speeds: 20 steps without NaN, no farther than twice the way of free flight; max|v|Δt/R is reported",
)
def large_steps(subject: Subject) -> Outcome:
    simulator, truth, state = subject.simulator, subject.scenes[0], subject.state()
    refused, texts, bounded = 0, [], True
    assert state.velocity_history is not None
    for factor in (2.0, 5.0, 10.0):
        other = replace(truth, metadata=replace(truth.metadata, frame_dt=factor * truth.metadata.frame_dt))
        refused += _raises(partial(simulator.initial_state, other, subject.history))
        fast = replace(with_velocities(state, partial(operator.mul, factor)), boundary=no_boundary(state))
        speed, time = float(fast.vel.norm(dim=1).max()), NUM_STEPS * subject.dt
        result = rollouts(simulator, [Start(fast, NUM_STEPS, truth.metadata, Guard())])[0]
        way = np.linalg.norm(result.pos[-1] - result.pos[0], axis=-1).max() / (speed * time + 0.5 * float(state.gravity.norm()) * time**2)
        sound = result.termination is None and bool(way <= 2)
        bounded = bounded and sound
        texts.append(
            f"{speed * subject.dt / simulator.builder.scales.radius:.2g} ({f'{way:.2g}' if result.termination is None else 'stopped'})"
        )
    return Outcome(refused == 3 and bounded, f"{refused} of 3 refused; max|v|Δt/R (way / free flight) {', '.join(texts)}")


TESTS = (materials, not_finite, types, large_steps)
