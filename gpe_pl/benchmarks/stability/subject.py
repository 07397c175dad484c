"""Subjects and outcomes of stress tests, and the changes of states and graphs that several tests use."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.geometry.shape_values import moved
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing.changes import in_order, to_dtype
from gpe_pl.models.base import Prediction
from gpe_pl.rollout.guard import Guard
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class Subject:
    """A trained simulator with the data that it is tested on.

    Attributes:
        name: name of the model.
        domain: name of the data set.
        simulator: simulator with the weights of its checkpoint.
        spec: data set, whose solver is the reference.
        scenes: ground truth that was not used in training.
        max_speed: largest speed [m/s] in training trajectories.
        is_gating: whether a failure of this model fails the suite.
        peers: all simulators of this domain by name, including this one.
        horizon_factors: lengths of long rollouts, as multiples of the number of frames of a scene.
        num_rest_steps: number of frames over which a pile at rest is observed.
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

    def state(self, scene: int = 0, fraction: float = 0.5) -> State:
        """Return the state after a fraction of a scene's frames, in float64; at the earliest the first state with enough history."""
        truth = self.scenes[scene % len(self.scenes)]
        frame = max(self.history, round(fraction * (truth.num_frames - 1)))
        return self.simulator.initial_state(truth, frame)

    def free_state(self, scene: int = 0, fraction: float = 0.5) -> State:
        """Return the same state without gravity and boundary, in free flight."""
        state = self.state(scene, fraction)
        return in_flight(replace(state, gravity=torch.zeros_like(state.gravity), boundary=no_boundary(state)), self.dt)

    def guard(self) -> Guard:
        """Return the limits of a stable rollout: one connectivity radius outside the domain, and three times the largest speed in training."""
        metadata = self.simulator.builder.metadata
        return Guard(3 * self.max_speed, metadata.bounds, self.simulator.builder.scales.radius, self.spacing)

    def truth_acceleration(self, scene: int, frame: int) -> np.ndarray:
        """Return the acceleration [node, dim] of the ground truth from a frame to the next, in m/s²."""
        velocities = integrators.velocities(self.scenes[scene].pos[frame - 1 : frame + 2].astype(np.float64), self.dt)
        return integrators.acceleration(velocities[1], velocities[0], self.dt)

    @cached_property
    def one_step_rmse(self) -> float:
        """Root mean squared error of one-step accelerations [m/s²], over some frames of all scenes."""
        errors = []
        for number, truth in enumerate(self.scenes):
            for frame in np.linspace(self.history, truth.num_frames - 2, 4).astype(int).tolist():
                state = self.simulator.initial_state(truth, frame)
                predicted = acceleration(self.simulator, state) + state.gravity
                errors.append(np.square(predicted.numpy() - self.truth_acceleration(number, frame)).mean())
        return float(np.sqrt(np.mean(errors)))


@dataclass(frozen=True)
class Outcome:
    """Result of a stress test.

    Attributes:
        passed: whether the criterion holds; None if the test does not apply.
        measured: the measured numbers, or why the test does not apply.
        curves: values over frames, for figures.
    """

    passed: bool | None
    measured: str
    curves: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class StressTest:
    """A stress test: its ``number`` and ``name``, its ``criterion`` in words, and the function ``run`` that tests a subject."""

    number: int
    name: str
    criterion: str
    run: Callable[[Subject], Outcome]

    def __call__(self, subject: Subject) -> Outcome:
        return self.run(subject)


def stress_test(number: int, name: str, criterion: str) -> Callable[[Callable[[Subject], Outcome]], StressTest]:
    """Return a decorator that turns a function into a ``StressTest``."""
    return lambda function: StressTest(number, name, criterion, function)


def inapplicable(reason: str) -> Outcome:
    """Return the outcome of a test that does not apply, with the reason."""
    return Outcome(None, reason)


# --- predictions --------------------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def output(simulator: LearnedSimulator, graph: HeteroData, num_nodes: int) -> Tensor:
    """Return the network's output for a graph, in units of the acceleration scale, in the order of the state's nodes."""
    return in_order(simulator(graph), graph, num_nodes, simulator.builder.spec.dim)


def acceleration(simulator: LearnedSimulator, state: State) -> Tensor:
    """Return accelerations without gravity [m/s²] for a state."""
    return output(simulator, simulator.builder(state), state.num_nodes).double() * simulator.acceleration_std


def largest(values: Iterable[float]) -> float:
    """Return the largest value, or NaN if one is NaN: ``max`` would leave most of these out, and a test would pass."""
    return float(np.max([*values]))


def relative_change(new: Tensor, old: Tensor) -> float:
    """Return ‖new − old‖ / ‖old‖."""
    return float((new - old).norm() / old.norm().clamp(min=torch.finfo(old.dtype).tiny))


# --- the same simulator, state or graph, changed --------------------------------------------------------------------------------------------


class _DoubleBuilder(GraphBuilder):
    """Graph builder with features, masses and lever arms in double precision."""

    precision = torch.float64


class _DoubleSimulator(LearnedSimulator):
    """Simulator that computes in double precision from the same graphs."""

    def forward(self, data: HeteroData) -> Prediction:
        return super().forward(to_dtype(data, torch.float64))


def in_double(simulator: LearnedSimulator) -> LearnedSimulator:
    """Return the simulator with the same weights in double precision, as a reference for rounding errors."""
    twin = _DoubleSimulator(copy.deepcopy(simulator.model), _DoubleBuilder(simulator.builder.config, simulator.builder.metadata))
    twin.load_state_dict(simulator.state_dict())
    for name in ("static_friction", "mirror_average", "least_distance"):
        setattr(twin, name, getattr(simulator, name))
    return twin.double().eval()


def no_boundary(state: State) -> Boundary:
    """Return an empty boundary for a state of tensors."""
    return replace(state, boundary=Boundary.empty(state.dim)).to_torch().boundary


def shifted(state: State, offset: Tensor) -> State:
    """Return the scene translated by an offset, for a single step.

    The prescribed motion of the boundary is not moved, because the graph of the state does not depend on it.
    """
    shapes = tuple(moved(shape, offset.numpy()) for shape in state.boundary.shapes)
    boundary = replace(state.boundary, pos=state.boundary.pos + offset, shapes=shapes)
    rest = None if state.rest_pos is None else state.rest_pos + offset
    return replace(state, pos=state.pos + offset, rest_pos=rest, boundary=boundary)


def in_flight(state: State, dt: float) -> State:
    """Return the state with the velocities that free flight has at the frame [m/s]: the mean over the last frame, plus half of what gravity adds in a frame."""
    return state if state.frame_velocity is None else replace(state, frame_velocity=state.vel + 0.5 * dt * state.gravity)


def with_velocities(state: State, change: Callable[[Tensor], Tensor]) -> State:
    """Return the state with all velocities [..., dim] in m/s changed by a function."""
    history, at_frame = state.velocity_history, state.frame_velocity
    return replace(
        state,
        vel=change(state.vel),
        velocity_history=None if history is None else change(history),
        frame_velocity=None if at_frame is None else change(at_frame),
    )
