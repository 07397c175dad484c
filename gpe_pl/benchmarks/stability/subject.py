"""What a stress test is given, what it answers, and the changes of states and graphs that several of them make."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.base import Prediction
from gpe_pl.rollout.loop import Guard
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class Subject:
    """A trained simulator in the domain that it was trained in.

    Attributes:
        name: of the model.
        domain: of the data set.
        simulator: with its checkpoint's weights.
        spec: of the data set, whose solver is the reference.
        scenes: ground truth that was not trained on.
        max_speed: largest speed [m/s] in training trajectories.
        is_gating: whether a failure of this one fails the suite.
        peers: the simulators of this domain, by name, this one included.
        horizon_factors: lengths of long rollouts over the trained horizon, which is the number of frames of a scene.
        num_rest_steps: frames that a pile at rest is watched.
    """

    name: str
    domain: str
    simulator: LearnedSimulator
    spec: DatasetSpec
    scenes: Sequence[Trajectory]
    max_speed: float
    is_gating: bool = False
    peers: dict[str, LearnedSimulator] = field(default_factory=dict)
    horizon_factors: Sequence[float] = (1.0, 3.0, 10.0)
    num_rest_steps: int = 1000

    @property
    def history(self) -> int:
        return self.simulator.builder.config.history

    @property
    def dt(self) -> float:
        return self.simulator.builder.metadata.frame_dt

    @property
    def spacing(self) -> float:
        return self.simulator.builder.metadata.spacing

    @property
    def acceleration_std(self) -> float:
        return self.simulator.acceleration_std.item()

    def state(self, scene: int = 0, share: float = 0.5) -> State:
        """The state after a share of a scene's frames, float64."""
        truth = self.scenes[scene % len(self.scenes)]
        frame = max(self.history, round(share * (truth.num_frames - 1)))
        return self.simulator.initial_state(truth, frame)

    def free_state(self, scene: int = 0, share: float = 0.5) -> State:
        """The same without gravity and boundary."""
        state = self.state(scene, share)
        return replace(state, gravity=torch.zeros_like(state.gravity), boundary=no_boundary(state))

    def guard(self) -> Guard:
        """Limits of a stable rollout: no node leaves the domain by more than the radius, none is thrice as fast as any in training."""
        metadata = self.simulator.builder.metadata
        return Guard(3 * self.max_speed, metadata.bounds, self.simulator.builder.scales.radius, self.spacing)

    def truth_acceleration(self, scene: int, frame: int) -> np.ndarray:
        """Acceleration [node, dim] of the ground truth from a frame to the next, m/s²."""
        velocities = integrators.velocities(self.scenes[scene].pos[frame - 1 : frame + 2].astype(np.float64), self.dt)
        return integrators.acceleration(velocities[1], velocities[0], self.dt)

    @cached_property
    def one_step_rmse(self) -> float:
        """Root mean square error [m/s²] of an acceleration over some frames of all scenes."""
        errors = []
        for number, truth in enumerate(self.scenes):
            for frame in np.linspace(self.history, truth.num_frames - 2, 4).astype(int).tolist():
                state = self.simulator.initial_state(truth, frame)
                predicted = acceleration(self.simulator, state) + state.gravity
                errors.append(np.square(predicted.numpy() - self.truth_acceleration(number, frame)).mean())
        return float(np.sqrt(np.mean(errors)))


@dataclass(frozen=True)
class Outcome:
    """What a test found.

    Attributes:
        passed: whether the criterion holds; None where the test does not apply.
        measured: the numbers, or why it does not apply.
        curves: over frames, for figures.
    """

    passed: bool | None
    measured: str
    curves: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class StressTest:
    """A numbered test with its criterion."""

    number: int
    name: str
    criterion: str
    run: Callable[[Subject], Outcome]

    def __call__(self, subject: Subject) -> Outcome:
        return self.run(subject)


def stress_test(number: int, name: str, criterion: str) -> Callable[[Callable[[Subject], Outcome]], StressTest]:
    """Make a function a ``StressTest``."""
    return lambda function: StressTest(number, name, criterion, function)


def inapplicable(reason: str) -> Outcome:
    """The outcome of a test that does not apply, and why."""
    return Outcome(None, reason)


# --- predictions --------------------------------------------------------------------------------------------------------------------------


def in_order(predicted: Prediction, graph: HeteroData, num_nodes: int, dim: int) -> Tensor:
    """Predicted accelerations in the order of the state's nodes."""
    values = [*predicted.acceleration.values()]
    out = torch.full((num_nodes, dim), float("nan"), dtype=values[0].dtype if values else torch.float64)
    for material, value in predicted.acceleration.items():
        out[graph[material].node_id] = value
    return out


@torch.no_grad()
def output(simulator: LearnedSimulator, graph: HeteroData, num_nodes: int) -> Tensor:
    """What the network says about a graph, in units of the acceleration scale, in the order of the state's nodes."""
    return in_order(simulator(graph), graph, num_nodes, simulator.builder.spec.dim)


def acceleration(simulator: LearnedSimulator, state: State) -> Tensor:
    """Accelerations without gravity [m/s²] of a state."""
    return output(simulator, simulator.builder(state), state.num_nodes).double() * simulator.acceleration_std


def relative_change(new: Tensor, old: Tensor) -> float:
    """‖new − old‖ / ‖old‖."""
    return float((new - old).norm() / old.norm().clamp(min=torch.finfo(old.dtype).tiny))


# --- the same simulator, state or graph, changed --------------------------------------------------------------------------------------------


class _DoubleBuilder(GraphBuilder):
    """Features, masses and lever arms in double precision."""

    def _rounded(self, values: Tensor) -> Tensor:
        return values


class _DoubleSimulator(LearnedSimulator):
    """Computes in double precision from the same graphs."""

    def forward(self, data: HeteroData) -> Prediction:
        return super().forward(to_dtype(data, torch.float64))


def in_double(simulator: LearnedSimulator) -> LearnedSimulator:
    """The same weights in double precision: the oracle of rounding."""
    twin = _DoubleSimulator(copy.deepcopy(simulator.model), _DoubleBuilder(simulator.builder.config, simulator.builder.metadata))
    twin.load_state_dict(simulator.state_dict())
    return twin.double().eval()


def to_dtype(data: HeteroData, dtype: torch.dtype) -> HeteroData:
    """The same graph with all floating-point features in another precision."""
    out = data.clone()
    for store in out.stores:
        for key, value in store.items():
            if isinstance(value, Tensor) and value.is_floating_point():
                store[key] = value.to(dtype)
    return out


def no_boundary(state: State) -> Boundary:
    """An empty boundary for a state of tensors."""
    return replace(state, boundary=Boundary.empty(state.dim)).to_torch().boundary


def permuted(state: State, order: Any) -> State:
    """The same state with its nodes in another order, or some of them (then without its mesh)."""
    history = state.velocity_history
    whole = len(order) == state.num_nodes
    cells = None
    if whole and state.cells is not None:
        cells = torch.argsort(torch.as_tensor(order))[state.cells] if isinstance(state.cells, Tensor) else np.argsort(order)[state.cells]
    return replace(
        state,
        rest_pos=None if state.rest_pos is None or not whole else state.rest_pos[order],
        cells=cells,
        pos=state.pos[order],
        vel=state.vel[order],
        node_type=state.node_type[order],
        mass=state.mass[order],
        material_params=state.material_params[order],
        velocity_history=None if history is None else history[order],
        stress=None,
    )


def shifted(state: State, offset: Tensor) -> State:
    """The scene somewhere else; shapes stay, which graphs do not see."""
    boundary = replace(state.boundary, pos=state.boundary.pos + offset)
    rest = None if state.rest_pos is None else state.rest_pos + offset
    return replace(state, pos=state.pos + offset, rest_pos=rest, boundary=boundary)


def with_velocities(state: State, history: Tensor) -> State:
    """The state with another velocity history [node, history, dim]."""
    return replace(state, vel=history[:, -1], velocity_history=history)


def joined(a: State, b: State) -> State:
    """The nodes of two states in one, with the boundary of the first."""
    names = ["pos", "vel", "node_type", "mass", "material_params", "velocity_history"]
    values: dict[str, Any] = {name: torch.cat([getattr(a, name), getattr(b, name)]) for name in names}
    if a.cells is not None and b.cells is not None and a.rest_pos is not None and b.rest_pos is not None:
        values |= {"rest_pos": torch.cat([a.rest_pos, b.rest_pos]), "cells": torch.cat([a.cells, b.cells + a.num_nodes])}
    return replace(a, **values, stress=None)
