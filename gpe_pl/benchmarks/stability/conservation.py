"""Stress tests of momentum and energy in scenes without external forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gpe_pl.benchmarks.stability.subject import Outcome, Subject, acceleration, in_double, inapplicable, stress_test
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gns import GNS
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout, steps
from gpe_pl.trajectory.state import State

NUM_STEPS = 300


def momentum_residual(simulator: LearnedSimulator, state: State) -> float:
    """Return |Σ m a| / Σ m |a| of the accelerations without gravity."""
    a, m = acceleration(simulator, state), state.mass[:, None]
    return float((m * a).sum(dim=0).norm() / (m * a).norm(dim=1).sum())


def angular_residual(simulator: LearnedSimulator, state: State) -> float:
    """Return |Σ r × m a| / Σ |r| m |a| about the centre of mass."""
    a, m = acceleration(simulator, state), state.mass[:, None]
    r = state.pos - (m * state.pos).sum(dim=0) / m.sum()
    moment = _cross(r, m * a).sum(dim=0)
    return float(moment.norm() / (r.norm(dim=1) * (m * a).norm(dim=1)).sum())


def _cross(r: Tensor, f: Tensor) -> Tensor:
    return torch.linalg.cross(r, f) if r.shape[1] == 3 else r[:, :1] * f[:, 1:] - r[:, 1:] * f[:, :1]


def _exact(subject: Subject) -> tuple[bool, bool]:
    """Tell whether linear and angular momentum are exact by construction.

    With an elastic law, cells turn bodies within a frame, so the angular momentum of the mean velocities over frames is not exact.
    """
    settings = subject.simulator.description()["settings"]
    island = settings.get("island_momentum", "ignored")
    return settings.get("decoder") == "pair" or island != "ignored", island == "angular" and not settings.get("elastic")


@stress_test(8, "linear momentum", "pair head or exact islands: |ΣF|/Σ|F| < 50 ε √N per step; drift over 300 steps / total impulse < 1e-6")
def linear_momentum(subject: Subject) -> Outcome:
    if not _exact(subject)[0]:
        return inapplicable("node decoder without exact momentum of islands; see test 10")
    state = subject.free_state()
    residual = momentum_residual(subject.simulator, state)
    limit = 50 * torch.finfo(torch.float32).eps * state.num_nodes**0.5
    impulse, start = 0.0, (state.mass[:, None] * state.vel).sum(dim=0)
    now = state
    for new in steps(subject.simulator, state, NUM_STEPS):
        impulse += float((state.mass[:, None] * (new.vel - now.vel)).norm(dim=1).sum())
        now = new
    drift = float(((state.mass[:, None] * now.vel).sum(dim=0) - start).norm()) / impulse
    return Outcome(residual < limit and drift < 1e-6, f"residual {residual:.1e} (limit {limit:.1e}), drift {drift:.1e}")


@stress_test(9, "angular momentum", "central head or exact islands: |Σ r×F|/Σ|r||F| < 1e-12 in float64")
def angular_momentum(subject: Subject) -> Outcome:
    if not _exact(subject)[1]:
        return inapplicable("neither a central head nor exact angular momentum of islands, or cells turn bodies within a frame")
    residual = angular_residual(in_double(subject.simulator), subject.free_state())
    single = angular_residual(subject.simulator, subject.free_state())
    return Outcome(residual < 1e-12, f"{residual:.1e} in float64, {single:.1e} in float32")


@stress_test(10, "momentum residual of a node head", "|ΣF|/Σ|F| of a free scene ≤ that of GNS")
def node_head(subject: Subject) -> Outcome:
    own = momentum_residual(subject.simulator, subject.free_state())
    others = [s for s in subject.peers.values() if isinstance(s.model, GNS)]
    if isinstance(subject.simulator.model, GNS):
        return inapplicable(f"this is GNS: {own:.2g}")
    if not others:
        return inapplicable(f"no GNS was trained in this domain; {own:.2g}")
    theirs = min(momentum_residual(s, replace(subject, simulator=s).free_state()) for s in others)
    return Outcome(own <= theirs, f"{own:.2g}, GNS {theirs:.2g}")


@stress_test(
    11, "energy of a closed scene", "no gravity, no walls: E_kin grows by at most 1 % within 100 steps, and never beyond twice the first"
)
def closed_energy(subject: Subject) -> Outcome:
    state = subject.free_state()
    energy = []
    mass = state.mass[:, None]
    trajectory = rollout(
        subject.simulator,
        state,
        NUM_STEPS,
        subject.scenes[0].metadata,
        Guard(max_speed=100 * subject.max_speed),
        on_frame=lambda _, s: energy.append(float((0.5 * mass * s.vel.square()).sum())),
    )
    stop = trajectory.termination
    start = float((0.5 * mass * state.vel.square()).sum())
    series = np.array([start, *energy]) / max(start, 1e-300)
    growth = max((series[k : k + 101].max() / max(series[k], 1e-300) for k in range(len(series))), default=1.0) - 1
    text = f"grows by {100 * growth:.3g} % within 100 steps, at most to {series.max():.3g} E₀"
    if stop is not None:
        return Outcome(False, f"{text}; stopped at frame {stop.frame}: {stop.reason}")
    elastic = [m for m in ("elastomer", "solid") if m in subject.simulator.builder.spec.materials]
    if elastic:
        return Outcome(
            bool(series.max() <= 2), f"{text}; {elastic[0]} may turn elastic energy into kinetic, so only the second part applies"
        )
    return Outcome(bool(growth <= 0.01 and series.max() <= 2), text)


TESTS = (linear_momentum, angular_momentum, node_head, closed_energy)
