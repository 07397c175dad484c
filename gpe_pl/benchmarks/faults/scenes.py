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
from gpe_pl.rollout.loop import Simulator, Start, frames, step_scenes
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Termination

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
    """Move a third of the particles behind the surface of obstacles, at most as deep as particles are apart."""
    shapes = [shape for shape in state.boundary.shapes if shape.kind != "wall"]
    on_obstacle = np.flatnonzero(np.min([np.abs(shape.signed_distance(state.boundary.pos)) for shape in shapes], axis=0) < 1e-6)
    chosen = rng.permutation(state.num_nodes)[: max(1, state.num_nodes // 3)]
    node = rng.choice(on_obstacle, size=len(chosen))
    spacing = float(np.median(nearest_distances(state.pos)))
    depth = spacing * rng.uniform(0.0, 1.0, (len(chosen), 1))
    return _changed(state, "pos", chosen, state.boundary.pos[node] - depth * state.boundary.normal[node])


Change = Callable[[State, np.random.Generator], State]
INSIDE = "particles inside obstacles"

CHANGES: dict[str, Change] = {
    "no particle": lambda s, rng: s.take(np.empty(0, np.int64)),
    "one particle": lambda s, rng: s.take(rng.integers(s.num_nodes, size=1)),
    "two particles": lambda s, rng: s.take(np.sort(rng.permutation(s.num_nodes)[:2])),
    "overlapping bodies": lambda s, rng: twice(s, rng.normal(scale=1e-3, size=s.dim)),
    "bodies in one place": lambda s, rng: twice(s, np.zeros(s.dim)),
    "all particles in one place": lambda s, rng: replace(s, pos=np.broadcast_to(s.pos[:1], s.pos.shape).copy()),
    INSIDE: _inside,
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
STEPPED = {"all particles in one place", INSIDE, "a particle outside the domain", "a velocity of 1e6 m/s"}
"""Changes that a guard would reject before the first step. It checks only the states after it, so that the solver or model has to step."""


def simulated(spec: DatasetSpec, name: str, learned: bool, seed: int, folder: Path) -> Verdict:
    """Run some steps of a scene with the change ``name``, by the data set's solver or, if ``learned``, by a model with random weights. Return the verdict."""
    state = CHANGES[name](_scene(spec, seed, name == INSIDE), np.random.default_rng(seed))
    metadata = trajectory_metadata(spec, "test", 0)
    return verdict_of(
        lambda: _rolled_out(spec, state, metadata, learned, name in STEPPED),
        lambda states: name not in WRONG and all(map(_is_finite, states)),
    )


def _scene(spec: DatasetSpec, seed: int, has_obstacle: bool) -> State:
    """Return the start of a test scene, the first from number ``seed`` on that has an obstacle if it needs one."""
    count = spec.counts["test"]
    starts = (initial_state(spec, "test", (seed + k) % count) for k in range(count))
    return next(s for s in starts if not has_obstacle or any(shape.kind != "wall" for shape in s.boundary.shapes))


def _rolled_out(spec: DatasetSpec, state: State, metadata: Metadata, learned: bool, must_step: bool) -> list[State]:
    """Return the states after each step. The limits and containment are those of rollouts of users (``scenes.rollouts.predicted``)."""
    guard = Guard(bounds=metadata.bounds, margin=metadata.longest_side, spacing=metadata.spacing)
    simulator: Simulator = spec.solver
    if learned:
        model = small_model(metadata)
        simulator, state = Contained(model, metadata.frame_dt), model.standing(state, metadata)
    if must_step:
        items = step_scenes(simulator, {0: state}, {0: NUM_STEPS}, {0: guard.of(state)})
    else:
        items = frames(simulator, [Start(state, NUM_STEPS, metadata, guard)])
    states = []
    for _, _, item in items:
        if isinstance(item, Termination):
            raise Stopped(f"{item.reason}: {item.message}")
        states.append(item)
    return states


def small_model(metadata: Metadata) -> LearnedSimulator:
    """Return a learned simulator with random weights and a history of two velocities."""
    torch.manual_seed(0)
    build = GraphBuilder(GraphConfig(history=2, islands=True), metadata)
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()


def _is_finite(state: State) -> bool:
    return bool(np.isfinite(as_numpy(state.pos)).all() and np.isfinite(as_numpy(state.vel)).all())


def faults(specs: dict[str, DatasetSpec], num_seeds: int) -> list[Fault]:
    """Return every change of ``num_seeds`` scenes of each data set, for its solver and for a learned simulator."""
    return [
        Fault(f"scene, {name}", f"{domain}, {'model' if learned else 'solver'}, seed {seed}", partial(simulated, spec, name, learned, seed))
        for domain, spec in specs.items()
        for learned in (False, True)
        for name in CHANGES
        for seed in range(num_seeds)
    ]
