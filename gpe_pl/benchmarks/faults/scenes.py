"""Faults of scenes that no generator draws: empty scenes, coincident bodies, particles in obstacles, absurd values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpe_pl.benchmarks.faults.verdict import Fault, Verdict, verdict_of
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.errors import GpeError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

NUM_STEPS = 3


class Stopped(GpeError):
    """Raised when a guard stops a rollout; the message has reason, frame and node."""


def twice(state: State, offset: np.ndarray) -> State:
    """Return the state with a copy of every body at an offset."""
    rest_pos = None if state.rest_pos is None else state.rest_pos + offset
    return State.joined([state, replace(state, pos=state.pos + offset, rest_pos=rest_pos)])


def _changed(state: State, name: str, chosen: np.ndarray, value: Any) -> State:
    array = np.array(getattr(state, name), dtype=np.float64)
    array[chosen] = value
    return replace(state, **{name: array})  # type: ignore[arg-type]


def _inside(state: State, rng: np.random.Generator) -> State:
    """Move a third of the particles behind the surface of walls and obstacles."""
    chosen = rng.permutation(state.num_nodes)[: max(1, state.num_nodes // 3)]
    wall = rng.integers(len(state.boundary.pos), size=len(chosen))
    depth = rng.uniform(0.0, 0.2, (len(chosen), 1))
    return _changed(state, "pos", chosen, state.boundary.pos[wall] - depth * state.boundary.normal[wall])


Change = Callable[[State, np.random.Generator], State]

CHANGES: dict[str, Change] = {
    "no particle": lambda s, rng: s.take(np.empty(0, np.int64)),
    "one particle": lambda s, rng: s.take(rng.integers(s.num_nodes, size=1)),
    "two particles": lambda s, rng: s.take(np.sort(rng.permutation(s.num_nodes)[:2])),
    "overlapping bodies": lambda s, rng: twice(s, rng.normal(scale=1e-3, size=s.dim)),
    "bodies in one place": lambda s, rng: twice(s, np.zeros(s.dim)),
    "all particles in one place": lambda s, rng: replace(s, pos=np.broadcast_to(s.pos[:1], s.pos.shape).copy()),
    "particles inside obstacles": _inside,
    "a particle outside the domain": lambda s, rng: _changed(s, "pos", rng.integers(s.num_nodes, size=1), 10.0),
    "a position not finite": lambda s, rng: _changed(s, "pos", rng.integers(s.num_nodes, size=1), rng.choice([np.nan, np.inf])),
    "a velocity not finite": lambda s, rng: _changed(s, "vel", rng.integers(s.num_nodes, size=1), rng.choice([np.nan, -np.inf])),
    "a velocity of 1e6 m/s": lambda s, rng: _changed(s, "vel", rng.integers(s.num_nodes, size=1), 1e6),
    "no mass": lambda s, rng: _changed(s, "mass", rng.integers(s.num_nodes, size=1), 0.0),
    "negative mass": lambda s, rng: _changed(s, "mass", rng.integers(s.num_nodes, size=1), -1.0),
    "a material parameter not finite": lambda s, rng: _changed(s, "material_params", rng.integers(s.num_nodes, size=1), np.nan),
    "an impossible material parameter": lambda s, rng: _changed(s, "material_params", rng.integers(s.num_nodes, size=1), -1e30),
}
WRONG = {
    "a position not finite",
    "a velocity not finite",
    "negative mass",
    "no mass",
    "a material parameter not finite",
    "an impossible material parameter",
}
"""Changes that have no sound result."""


def simulated(spec: DatasetSpec, name: str, learned: bool, seed: int, folder: Path) -> Verdict:
    """Run some steps of a scene with the change ``name``, by the data set's solver or, if ``learned``, by a model with random weights. Return the verdict."""
    state = CHANGES[name](initial_state(spec, "test", seed % spec.counts["test"]), np.random.default_rng(seed))
    metadata = trajectory_metadata(spec, "test", 0)
    return verdict_of(lambda: _rolled_out(spec, state, metadata, learned), lambda result: name not in WRONG and _is_finite(result))


def _rolled_out(spec: DatasetSpec, state: State, metadata: Metadata, learned: bool) -> Trajectory:
    guard = Guard(max_speed=1e4, bounds=metadata.bounds, margin=0.1, spacing=metadata.spacing)
    if not learned:
        result = rollout(spec.solver, state, NUM_STEPS, metadata, guard)
    else:
        simulator = small_model(metadata)
        result = rollout(Contained(simulator, metadata.frame_dt), simulator.standing(state, metadata), NUM_STEPS, metadata, guard)
    if result.termination is not None:
        raise Stopped(f"{result.termination.reason}: {result.termination.message}")
    return result


def small_model(metadata: Metadata) -> LearnedSimulator:
    """Return a learned simulator with random weights and a history of two velocities."""
    torch.manual_seed(0)
    build = GraphBuilder(GraphConfig(history=2, islands=True), metadata)
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()


def _is_finite(result: Trajectory) -> bool:
    return bool(np.isfinite(result.pos).all() and np.isfinite(result.vel).all())


def faults(specs: dict[str, DatasetSpec], num_seeds: int) -> list[Fault]:
    """Return every change of ``num_seeds`` scenes of each data set, for its solver and for a learned simulator."""
    return [
        Fault(f"scene, {name}", f"{domain}, {'model' if learned else 'solver'}, seed {seed}", partial(simulated, spec, name, learned, seed))
        for domain, spec in specs.items()
        for learned in (False, True)
        for name in CHANGES
        for seed in range(num_seeds)
    ]
