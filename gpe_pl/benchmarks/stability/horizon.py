"""Stress tests of long rollouts: whether they stay bounded and at rest, how fast perturbations grow, and whether they can be resumed."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpe_pl.benchmarks.stability.subject import Outcome, Subject, inapplicable, stress_test
from gpe_pl.data.ground_truth import initial_state
from gpe_pl.graphs.features import history_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import displacement
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import Simulator, Start, rollout, rollouts, steps
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Termination, Trajectory

MAX_CORRECTED = 0.01
"""Largest fraction of particle-steps that containment may correct."""
VALID_ERROR = 0.5
"""Root mean square displacement in spacings up to which a prediction is valid."""
PERTURBATION = 1e-6
"""Initial distance of twin rollouts, as a fraction of the domain's longest side."""
STATIC_FRICTION = 0.5
"""Static friction, as a fraction of gravity, in a second rollout of models that have none. Its result is reported and decides nothing."""
AT_REST, RESTING_FRAMES = 0.01, 50
"""Largest speed of a pile at rest, in spacings per frame, and for how many frames. A body that swings is slow in single frames."""
FULL_HORIZON, FULL_REST = 10, 1000
"""Length of test 21, in lengths of a scene, and of test 22, in frames. Shorter runs are no verdict on a model."""
SETTLING = 5
"""Trained horizons within which a scene of the solver has to come to rest."""
MAX_DRIFT, MAX_CHANGE = 0.1, 0.05
"""Largest displacement of a node of a pile at rest [spacings], and largest relative change of its height, where the solver's own are smaller."""


# --- staying bounded ------------------------------------------------------------------------------------------------------------------------


@stress_test(
    21,
    "10 times the trained horizon",
    "contained, nothing skipped: no NaN, no node farther than R outside, speed < 3 × training, E ≤ 2 E₀, < 1 % of particle-steps corrected",
)
def long_horizon(subject: Subject) -> Outcome:
    num_steps = round(max(subject.horizon_factors) * (subject.scenes[0].num_frames - 1))
    starts = [
        Start(subject.simulator.initial_state(truth, subject.history), num_steps, truth.metadata, subject.guard())
        for truth in subject.scenes
    ]
    num_corrected = 0.0

    def count(_: int, __: int, state: State) -> None:
        nonlocal num_corrected
        num_corrected += state.num_corrected

    results = rollouts(Contained(subject.simulator, subject.dt), starts, count)
    fraction = num_corrected / max(1, sum((r.num_frames - 1) * r.num_nodes for r in results))
    energies = [energy(r, subject) for r in results]
    growth = max(float(e.max() / max(e[0], 1e-300)) for e in energies)
    stops = [r.termination for r in results if r.termination is not None]
    valid = [valid_steps(r, truth.frames(subject.history), subject.spacing) for r, truth in zip(results, subject.scenes, strict=True)]
    survived = {f: np.mean([r.num_frames - 1 >= round(f * (t.num_frames - 1)) for r, t in zip(results, subject.scenes, strict=True)])
                for f in subject.horizon_factors}  # fmt: skip
    text = [
        f"alive at {', '.join(f'{f:g}×: {100 * s:.0f} %' for f, s in survived.items())} of {len(results)} scenes",
        f"E ≤ {growth:.3g} E₀",
        f"{100 * fraction:.2g} % corrected",
        f"valid for {np.median(valid):.0f} of {subject.scenes[0].num_frames - 1 - subject.history} frames",
    ]
    text += [f"stopped at frame {s.frame}: {s.reason}" for s in stops[:1]]
    curves = {
        "energy": _middle([e / e[0] for e in energies], num_steps),
        "momentum": _middle([momentum(r) for r in results], num_steps),
        "valid_steps": [float(v) for v in valid],
        "steps_to_failure": [float(r.num_frames) if r.termination is not None else math.inf for r in results],
        "horizons": [float(round(f * (subject.scenes[0].num_frames - 1))) for f in subject.horizon_factors],
    }
    return Outcome(bool(not stops and growth <= 2 and fraction <= MAX_CORRECTED), "; ".join(text), curves)


def energy(trajectory: Trajectory, subject: Subject) -> np.ndarray:
    """Return kinetic energy plus potential energy above the lowest corner of the domain [J], in every frame."""
    mass, gravity = trajectory.mass.astype(np.float64), np.asarray(trajectory.metadata.gravity)
    low = np.array([a for a, _ in trajectory.metadata.bounds])
    high = np.array([b for _, b in trajectory.metadata.bounds])
    bottom = np.where(gravity > 0, high, low)  # position of zero potential energy
    height = -((trajectory.pos.astype(np.float64) - bottom) @ gravity)
    return (mass * (0.5 * np.square(trajectory.vel.astype(np.float64)).sum(axis=-1) + height)).sum(axis=-1)


def momentum(trajectory: Trajectory) -> np.ndarray:
    """Return |Σ m v| / Σ m [m/s] in every frame."""
    mass = trajectory.mass.astype(np.float64)
    return np.linalg.norm(np.einsum("n,fnd->fd", mass / mass.sum(), trajectory.vel.astype(np.float64)), axis=-1)


def valid_steps(prediction: Trajectory, truth: Trajectory, spacing: float) -> int:
    """Return the number of predicted frames before the root mean square displacement from the truth exceeds ``VALID_ERROR`` spacings, or of all of them."""
    count = min(prediction.num_frames, truth.num_frames)
    error = np.square(displacement(prediction.pos[:count], truth.pos[:count], truth.metadata)).sum(axis=-1).mean(axis=-1)
    beyond = np.flatnonzero(~(np.sqrt(error) <= VALID_ERROR * spacing))
    return int(beyond[0]) - 1 if len(beyond) else count - 1


def _middle(curves: list[np.ndarray], num_steps: int, count: int = 200) -> list[float]:
    """Return the median over scenes at evenly spaced frames; infinite where most have failed."""
    padded = [np.concatenate([c, np.full(num_steps + 1 - len(c), np.inf)]) for c in curves]
    frames = np.unique(np.linspace(0, num_steps, count).astype(int))
    return np.quantile(np.stack(padded)[:, frames], 0.5, axis=0, method="inverted_cdf").tolist()


# --- staying at rest ------------------------------------------------------------------------------------------------------------------------


@stress_test(
    22,
    "a pile at rest",
    "from equilibrium, 1,000 steps, with the model's static friction: no node drifts by 0.1 spacings and height changes by < 5 %, or both by at most twice "
    "the solver's; without friction, or with 0.5 if the model has none: reported",
)
def rest(subject: Subject) -> Outcome:
    settled = settle(subject)
    if isinstance(settled, str):
        return inapplicable(settled)
    solver = drift(subject, subject.spec.label_solver, settled)
    limits = max(MAX_DRIFT, 2 * solver.farthest), max(MAX_CHANGE, 2 * solver.change)
    own, build = subject.simulator.static_friction, subject.simulator.builder
    fractions = [own, 0.0 if own else STATIC_FRICTION] if build.spec.islands and build.config.boundary_condition else [0.0]
    still = np.zeros((settled.num_nodes, subject.history, settled.dim))
    start = replace(settled, velocity_history=still, internal=None, stress=None).to_torch()
    found = [drift(subject, Contained(subject.simulator.configured(static_friction=f), subject.dt), start) for f in fractions]
    names = [f"static friction {f:g}" if f else "without static friction" for f in fractions]
    text = "; ".join(f"{name}: {how.text}" for name, how in zip([*names, "solver"], [*found, solver], strict=True))
    return Outcome(bool(found[0].stop is None and found[0].farthest <= limits[0] and found[0].change <= limits[1]), text)


@dataclass(frozen=True)
class Drift:
    """How a pile at rest moves: largest and, at the end, rms displacement [spacings], largest relative change of its height, and where a guard stopped it."""

    farthest: float
    rms: float
    change: float
    stop: Termination | None

    @property
    def text(self) -> str:
        stopped = "" if self.stop is None else f", stopped at frame {self.stop.frame}: {self.stop.reason}"
        return f"farthest {self.farthest:.2g}, rms at the end {self.rms:.2g} spacings, height {100 * self.change:.2g} %{stopped}"


def drift(subject: Subject, simulator: Simulator, settled: State) -> Drift:
    """Measure how a state at rest moves in a simulator."""
    metadata = subject.scenes[0].metadata
    result = rollout(simulator, settled, subject.num_rest_steps, metadata, subject.guard())
    way = np.linalg.norm(result.pos.astype(np.float64) - result.pos[0], axis=-1) / subject.spacing
    up = int(np.argmax(np.abs(metadata.gravity)))
    height = result.pos[..., up].astype(np.float64).max(axis=1) - metadata.bounds[up][0]
    change = float(np.abs(height / height[0] - 1).max())
    return Drift(float(way.max()), float(np.sqrt(np.square(way[-1]).mean())), change, result.termination)


def settle(subject: Subject) -> State | str:
    """Return a state of the solver in which it has come to rest, with all velocities zero; or the reason why there is no such state."""
    slowest = math.inf
    for index in range(len(subject.scenes)):
        start, num_steps = initial_state(subject.spec, "test", index), SETTLING * subject.spec.num_frames
        speeds: list[float] = []
        for state in steps(subject.spec.label_solver, start, num_steps):
            speeds.append(float(np.linalg.norm(state.vel, axis=-1).max()) * subject.dt / subject.spacing)
            if len(speeds) < max(RESTING_FRAMES, subject.spec.num_frames // 2):
                continue
            slowest = min(slowest, max(speeds[-RESTING_FRAMES:]))
            if slowest < AT_REST:
                at_frame = None if state.frame_velocity is None else np.zeros_like(state.frame_velocity)
                return replace(state, vel=np.zeros_like(state.vel), frame_velocity=at_frame)
    return (
        f"the solver's scenes do not come to rest: at best {slowest:.2g} spacings per frame over {RESTING_FRAMES} frames, within "
        f"{SETTLING} times the trained horizon"
    )


# --- forgetting the start -------------------------------------------------------------------------------------------------------------------


@stress_test(23, "growth of a perturbation", "twin rollouts 1e-6 of the domain apart: growth rate ≤ 1.5 times the solver's own")
def perturbation(subject: Subject) -> Outcome:
    num_steps = subject.scenes[0].num_frames - 1 - subject.history
    size = subject.simulator.builder.metadata.longest_side
    own = separation(Contained(subject.simulator, subject.dt), subject.state(0, 0.0), num_steps, subject.spacing, size)
    solver = separation(subject.spec.label_solver, initial_state(subject.spec, "test", 0), num_steps, subject.spacing, size)
    rate, reference = growth_rate(own, subject.spacing), growth_rate(solver, subject.spacing)
    limit = 1.5 * reference if reference > 0 else reference / 1.5
    text = f"{rate:.3g} per frame, solver {reference:.3g}"
    return Outcome(bool(rate <= limit), text, {"model": own.tolist(), "solver": solver.tolist()})


def separation(simulator: Simulator, state: State, num_steps: int, spacing: float, size: float, seed: int = 0) -> np.ndarray:
    """Return the root mean square distance [spacings] in each frame of two rollouts whose initial positions differ by ``PERTURBATION`` times ``size`` [m].

    Args:
        simulator: simulator of both rollouts.
        state: initial state of the first.
        num_steps: length of the rollouts.
        spacing: rest spacing [m].
        size: longest side of the domain [m].
        seed: seed of the random directions in which nodes are displaced.
    """
    noise: Any = np.random.default_rng(seed).normal(size=tuple(state.pos.shape))
    noise *= PERTURBATION * size / np.sqrt(np.square(noise).sum(axis=-1).mean())
    is_torch = isinstance(state.pos, torch.Tensor)
    twin = replace(state, pos=state.pos + (torch.from_numpy(noise) if is_torch else noise))
    found = [PERTURBATION * size / spacing]
    for a, b in zip(steps(simulator, state, num_steps), steps(simulator, twin, num_steps), strict=True):
        distance = np.asarray(a.pos) - np.asarray(b.pos)
        found.append(float(np.sqrt(np.square(distance).sum(axis=-1).mean())) / spacing)
        if not math.isfinite(found[-1]):
            break
    return np.array(found)


def growth_rate(separations: np.ndarray, spacing: float, saturated: float = 0.1) -> float:
    """Return the growth rate per frame: the least-squares slope of log separation, before the separation first exceeds ``saturated`` spacings."""
    beyond = np.flatnonzero(~(separations < saturated))
    count = int(beyond[0]) if len(beyond) else len(separations)
    logs = np.log(np.maximum(separations[: max(count, 2)], 1e-300))
    return float(np.polyfit(np.arange(len(logs)), np.where(np.isfinite(logs), logs, 700.0), 1)[0])


# --- resuming -------------------------------------------------------------------------------------------------------------------------------


@stress_test(24, "resuming", "200 steps = 100, stored, loaded, 100 more: bit for bit; two runs too")
def resuming(subject: Subject) -> Outcome:
    start = subject.state(0, 0.0)
    simulator = Contained(subject.simulator, subject.dt)
    whole = advanced(simulator, start, 200)
    again = advanced(simulator, start, 200)
    half = advanced(simulator, start, 100)
    with tempfile.TemporaryDirectory() as folder:
        subject.simulator.save(Path(folder) / "model.ckpt")
        kept = {"pos": half.pos, "vel": half.vel, "velocity_history": history_of(half), "frame_velocity": half.frame_velocity}
        np.savez(Path(folder) / "state.npz", **{name: values for name, values in kept.items() if values is not None})
        loaded: dict[str, Any] = {name: torch.from_numpy(values) for name, values in np.load(Path(folder) / "state.npz").items()}
        resumed = Contained(LearnedSimulator.from_checkpoint(Path(folder) / "model.ckpt"), subject.dt)
    rest = advanced(resumed, replace(half, **loaded), 100)
    equal = {"resumed": torch.equal(rest.pos, whole.pos), "repeated": torch.equal(again.pos, whole.pos)}
    finite = bool(torch.isfinite(whole.pos).all())
    text = ", ".join(f"{name} {'equal' if is_equal else 'different'}" for name, is_equal in equal.items())
    return Outcome(all(equal.values()) and finite, text)


def advanced(simulator: Simulator, state: State, num_steps: int) -> State:
    """Return the state after some steps without a guard."""
    for after in steps(simulator, state, num_steps):
        state = after
    return state


def max_speed(spec: Any, generate: Callable[..., Trajectory], num_trajectories: int) -> float:
    """Return the largest speed [m/s] in the first training trajectories, from differences of positions over a frame."""
    dt = spec.solver.frame_dt
    found = [generate(spec, "train", k).pos.astype(np.float64) for k in range(min(num_trajectories, spec.num_train))]
    return max(float(np.linalg.norm(np.diff(pos, axis=0), axis=-1).max()) / dt for pos in found)


TESTS = (long_horizon, rest, perturbation, resuming)
