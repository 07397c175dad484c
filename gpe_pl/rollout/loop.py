"""``Simulator``, the protocol shared by solvers and learned models, and the time loop, ``step_scenes``: ``rollout`` collects
its frames with a guard, ``steps`` yields its states without one.

A guard looks at every new state. When it finds a state that cannot be trusted, the rollout stops there, keeps the good frames and says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.errors import GpeError
from gpe_pl.geometry.shape_values import shapes_fault
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.schema import NODE_TYPES
from gpe_pl.trajectory.boundary import Motion
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory
from gpe_pl.trajectory.values import faults, size_conflicts


@runtime_checkable
class Simulator(Protocol):
    """Anything that advances a state by one frame of ``Metadata.frame_dt``."""

    def step(self, state: State) -> State: ...


@runtime_checkable
class BatchSimulator(Simulator, Protocol):
    """A simulator that advances several scenes at once for less than the sum of their costs."""

    def step_all(self, states: list[State]) -> list[State | SimulationError]: ...


class SimulationError(GpeError, RuntimeError):
    """A solver refused to go on; carries the particle that shows the failure (-1: none in particular) and a reason code."""

    def __init__(self, message: str, *, reason: str = "solver", node: int = -1) -> None:
        super().__init__(message)
        self.reason, self.node = reason, node


@dataclass(frozen=True)
class Replay:
    """The oracle: a simulator that steps through a stored trajectory."""

    trajectory: Trajectory

    def step(self, state: State) -> State:
        frame = round((state.time - self.trajectory.start_time) / self.trajectory.metadata.frame_dt) + 1
        return self.trajectory.state(frame)


CROWDING_LIMIT = 32
"""Nodes in the space that one of them has at rest beyond which a cloud has collapsed, unless it was as dense at the start."""
FINEST = 0.01
"""Of a spacing: nodes that are closer at the start lie on top of each other."""
TUNNEL_DEPTH = 0.25
"""Of a spacing: a path between two frames that goes deeper through a wall or obstacle than this has not gone around it."""
MAX_PATH_SAMPLES = 4096
"""Of a path: those of ways longer than as many eighths of a spacing lie farther apart."""
SUSPECTS_AT_ONCE = 1000
"""Nodes whose paths are sampled as finely as that of the fastest of them."""


@dataclass(frozen=True)
class Guard:
    """Limits beyond which a state is not trusted.

    Attributes:
        max_speed: m/s.
        bounds: ``(low, high)`` per axis of the region that nodes may not leave by more than ``margin`` [m].
        spacing: rest spacing [m] of nodes, for recognising clouds that collapse and nodes that went through an obstacle within one frame, or are deeper in
            one than ``margin``; 0 does neither.
        max_crowding: nodes in the space that one of them has at rest.
    """

    max_speed: float = math.inf
    bounds: tuple[tuple[float, float], ...] = ()
    margin: float = 0.0
    spacing: float = 0.0
    max_crowding: int = CROWDING_LIMIT

    def __post_init__(self) -> None:
        sound = self.max_speed > 0 and self.margin >= 0 and 0 <= self.spacing < math.inf  # what is not a number is neither
        if not (sound and all(low < high for low, high in self.bounds)):
            raise ValueError(f"guard limits must be positive, and bounds (low, high), got {self}")

    def check(self, state: State, frame: int, before: State | None = None) -> Termination | None:
        """The first violated limit of a state, or None; ``before`` is the state one frame earlier."""
        if state.num_nodes == 0:
            return None
        found = self._not_finite(state, frame) or self._escape(state, frame) or self._explosion(state, frame)
        if found is None and self.spacing > 0:
            found = self._clustering(state, frame) or self._tunnelling(before, state, frame)
        return found

    def _not_finite(self, state: State, frame: int) -> Termination | None:
        xp = array_namespace(state.pos)
        finite = xp.all(xp.isfinite(state.pos) & xp.isfinite(state.vel), axis=-1)
        if bool(xp.all(finite)):
            return None
        node = int(xp.argmax(xp.astype(~finite, xp.int8)))
        return Termination("nan", frame, node, f"frame {frame}: node {node} has a position or velocity that is not finite")

    def _escape(self, state: State, frame: int) -> Termination | None:
        xp = array_namespace(state.pos)
        for axis, (low, high) in enumerate(self.bounds):
            outside = xp.maximum(low - state.pos[:, axis], state.pos[:, axis] - high)
            if float(xp.max(outside)) > self.margin:
                node = int(xp.argmax(outside))
                return Termination("escape", frame, node, f"frame {frame}: node {node} is {float(outside[node]):.3g} m outside the domain")
        return None

    def _explosion(self, state: State, frame: int) -> Termination | None:
        if not math.isfinite(self.max_speed):
            return None
        xp = array_namespace(state.pos)
        speed = xp.sqrt(xp.sum(state.vel * state.vel, axis=-1))
        if float(xp.max(speed)) <= self.max_speed:
            return None
        node = int(xp.argmax(speed))
        text = f"frame {frame}: node {node} moves at {float(speed[node]):.3g} m/s, limit {self.max_speed:.3g} m/s"
        return Termination("explosion", frame, node, text)

    def _clustering(self, state: State, frame: int) -> Termination | None:
        counts = crowding(_numpy(state.pos), self.spacing)
        if counts.max() <= self.max_crowding:
            return None
        node = int(np.argmax(counts))
        text = f"frame {frame}: node {node} shares a box as wide as the spacing with {counts.max() - 1} others, limit {self.max_crowding}"
        return Termination("clustering", frame, node, text)

    def _tunnelling(self, before: State | None, state: State, frame: int) -> Termination | None:
        """Nodes deeper in a wall or obstacle than ``margin``, and those that were and are outside of all shapes, but not between the two frames."""
        shapes, end = state.boundary.shapes, _numpy(state.pos)
        if not shapes:
            return None
        depth = -signed_distance(shapes, end)
        node = int(np.argmax(depth))
        if 0 < self.margin < depth[node]:
            return Termination("tunnelling", frame, node, f"frame {frame}: node {node} is {depth[node]:.3g} m deep in a wall or obstacle")
        if before is None:
            return None
        start = _numpy(before.pos)
        way = state.periodicity.shortest(end - start)
        length, clearance = np.linalg.norm(way, axis=-1), signed_distance(shapes, start)
        tolerance = TUNNEL_DEPTH * self.spacing
        suspects = np.flatnonzero((length > clearance) & (length > 2 * tolerance) & (clearance > -tolerance) & (depth < tolerance))
        suspects = suspects[np.argsort(length[suspects])]
        deepest = np.zeros(len(end))
        for some in np.array_split(suspects, max(1, len(suspects) // SUSPECTS_AT_ONCE)):
            count = min(MAX_PATH_SAMPLES, math.ceil(float(length[some].max(initial=0.0)) / (0.5 * tolerance)))
            for share in np.arange(1, count) / max(1, count):
                deepest[some] = np.maximum(deepest[some], -signed_distance(shapes, start[some] + share * way[some]))
        node = int(np.argmax(deepest))
        if not deepest[node] > tolerance:
            return None
        text = f"frame {frame}: node {node} went {deepest[node]:.3g} m deep through a wall or obstacle within one frame"
        return Termination("tunnelling", frame, node, text)

    def of(self, start: State) -> Guard:
        """The same for a rollout from a state, which may be finer in places: clouds collapse where twice as many are in one place as in the finest."""
        if self.spacing == 0 or start.num_nodes == 0 or self._not_finite(start, 0) is not None:
            return self
        pos = _numpy(start.pos)
        if crowding(pos, FINEST * self.spacing).max() > self.max_crowding:
            return self
        return replace(self, max_crowding=max(self.max_crowding, 2 * int(crowding(pos, self.spacing).max())))


def crowding(pos: np.ndarray, width: float) -> np.ndarray:
    """For every node [node], how many there are in its box of a grid of this width [m]; two boxes very rarely count as one."""
    primes = np.array([73_856_093, 19_349_663, 83_492_791])[: pos.shape[1]]  # spatial hash [Teschner et al. 2003]; products may overflow
    _, box, counts = np.unique(np.floor(pos / width).astype(np.int64) @ primes, return_inverse=True, return_counts=True)
    return counts[box]


def unsound(state: State, metadata: Metadata) -> Termination | None:
    """The first array or shape of a state that breaks its rule (``schema.FIELDS``, ``shape_values.shapes_fault``), or None.

    Nothing could be told from what follows it.
    """
    b, has_mesh = state.boundary, state.cells is not None and state.rest_pos is not None
    nodes = {
        "node_type": state.node_type,
        "mass": state.mass,
        "material_params": state.material_params,
        "pos": state.pos[None],
        "vel": state.vel[None],
        **({"rest_pos": state.rest_pos, "cells": state.cells} if has_mesh else {}),
    }
    conditions = {"boundary_friction": b.friction, "boundary_restitution": b.restitution}
    walls = {"boundary_pos": b.pos[None], "boundary_vel": b.vel[None], "boundary_normal": b.normal[None], **conditions}
    m = b.motion
    path = {} if m is None else {"boundary_pos": m.pos, "boundary_vel": m.vel, "boundary_normal": m.normal, **conditions}
    for part in (nodes, walls, path):
        arrays = {key: _numpy(value) for key, value in part.items()}
        for conflict in size_conflicts(arrays, metadata.dim, len(metadata.param_names)):
            return Termination("input", 0, -1, conflict)
        for fault in faults(arrays, NODE_TYPES, metadata.materials, metadata.param_names):
            reason = {"pos": "nan", "vel": "nan", "material_params": "material"}.get(fault.field, "input")
            return Termination(reason, 0, fault.index("node"), str(fault))
    for name, values in (("gravity", state.gravity), ("velocity_history", state.velocity_history)):
        if values is not None and not np.isfinite(_numpy(values)).all():
            return Termination("nan", 0, -1, f"{name} is not finite")
    if (wrong := shapes_fault(b.shapes, metadata.periodicity)) is not None:
        return Termination("input", 0, -1, wrong)
    return None


def step_all(simulator: Simulator, states: list[State]) -> list[State | SimulationError]:
    """One step of every state, together if the simulator can; errors of single scenes are returned, so that the others go on."""
    if not states:
        return []
    if isinstance(simulator, BatchSimulator):
        return simulator.step_all(states)
    return [_step(simulator, state) for state in states]


def _step(simulator: Simulator, state: State) -> State | SimulationError:
    try:
        return simulator.step(state)
    except SimulationError as error:
        return error


@runtime_checkable
class GroundTruth(Protocol):
    """What tells a ground-truth solver from other simulators: the name and version under which its results are stored, and which scenes it computes."""

    name: ClassVar[str]
    version: ClassVar[str]

    @property
    def frame_dt(self) -> float: ...

    @property
    def materials(self) -> tuple[str, ...]: ...


def unfit(simulator: Simulator, metadata: Metadata) -> Termination | None:
    """Why the frames of a solver are not those that the metadata describe, or None: it would step by another time, or read the parameters of others."""
    if not isinstance(simulator, GroundTruth):
        return None
    solver, wrong = f"the solver {simulator.name}", ""
    if not math.isclose(simulator.frame_dt, metadata.frame_dt, rel_tol=1e-6):
        wrong = f"{solver} has frame_dt = {simulator.frame_dt:g} s, the scene {metadata.frame_dt:g} s"
    elif tuple(simulator.materials) != metadata.materials:
        wrong = f"{solver} has the materials {', '.join(simulator.materials)}, the scene {', '.join(metadata.materials)}, in this order"
    return Termination("input", 0, -1, f"{wrong}; give the solver those of the scene") if wrong else None


@dataclass(frozen=True)
class Start:
    """Where a rollout begins and ends.

    Attributes:
        state: becomes frame 0.
        num_steps: frames to add.
        metadata: of the scene; describes the result.
        guard: stops the rollout at the first state that cannot be trusted; if that is the first of all, the frame of the termination is 0. A start with
            values that break the rules of ``schema.FIELDS`` is never trusted.
    """

    state: State
    num_steps: int
    metadata: Metadata
    guard: Guard | None = None


def frames(simulator: Simulator, starts: Sequence[Start]) -> Iterator[tuple[int, int, State | Termination]]:
    """Step all scenes side by side and yield (scene, frame, new state), or a ``Termination`` as a scene's last item. Holds one state per scene."""
    live, num_steps, guards = dict[int, State](), dict[int, int](), dict[int, Guard]()
    for scene, start in enumerate(starts):
        guard = None if start.guard is None else start.guard.of(start.state)
        impossible = (
            unfit(simulator, start.metadata)
            or unsound(start.state, start.metadata)
            or (None if guard is None else guard.check(start.state, 0))
        )
        if impossible is not None:
            yield scene, 0, impossible
            continue
        live[scene], num_steps[scene] = start.state, start.num_steps
        if guard is not None:
            guards[scene] = guard
    yield from step_scenes(simulator, live, num_steps, guards)


def steps(simulator: Simulator, state: State, num_steps: int) -> Iterator[State]:
    """Yield the states after each step of one scene, without a guard.

    Raises:
        SimulationError: a step failed; names the frame.
    """
    for _, _, item in step_scenes(simulator, {0: state}, {0: num_steps}):
        if isinstance(item, Termination):
            raise SimulationError(item.message, reason=item.reason, node=item.node)
        yield item


def step_scenes(
    simulator: Simulator, states: Mapping[int, State], num_steps: Mapping[int, int], guards: Mapping[int, Guard] | None = None
) -> Iterator[tuple[int, int, State | Termination]]:
    """Yield what ``frames`` yields, for scenes that need no check of their start. This is the time loop: everything that advances a scene calls it.

    Args:
        simulator: steps all scenes together if it can.
        states: start of each scene, by its number.
        num_steps: frames to add to each scene.
        guards: of scenes that have one.
    """
    live, frame = dict(states), 0
    while True:
        frame += 1
        live = {scene: state for scene, state in live.items() if frame <= num_steps[scene]}
        if not live:
            return
        for scene, item in zip(list(live), step_all(simulator, list(live.values())), strict=True):
            stop = _termination(item, frame, (guards or {}).get(scene), live[scene])
            if stop is None:
                live[scene] = cast(State, item)
            else:
                del live[scene]
            yield scene, frame, stop or cast(State, item)


def _termination(item: State | SimulationError, frame: int, guard: Guard | None, before: State) -> Termination | None:
    if isinstance(item, SimulationError):
        return Termination(item.reason, frame, item.node, f"frame {frame}: {item}")
    return None if guard is None else guard.check(item, frame, before)


def rollouts(simulator: Simulator, starts: Sequence[Start], on_frame: Callable[[int, int, State], Any] | None = None) -> list[Trajectory]:
    """``rollout`` of several scenes side by side; a learned simulator advances them in one pass of its model.

    Args:
        simulator: solver, learned model, baseline or ``Replay``.
        starts: one per scene.
        on_frame: called with scene, frame number and state.

    Returns:
        One trajectory per start.
    """
    is_prediction = not isinstance(simulator, GroundTruth)
    recordings = [_Recording(start, is_prediction) for start in starts]
    for scene, frame, item in frames(simulator, starts):
        recordings[scene].add(item)
        if on_frame is not None and isinstance(item, State):
            on_frame(scene, frame, item)
    return [recording.trajectory() for recording in recordings]


class _Recording:
    """The frames of one scene so far, as arrays of its own."""

    def __init__(self, start: Start, is_prediction: bool) -> None:
        self.start, self.is_prediction = start, is_prediction
        self.pos: list[np.ndarray] = []
        self.vel: list[np.ndarray] = []
        self.stress: list[Stress | None] = []
        self.motion: list[Motion] = []
        self.termination: Termination | None = None
        self.add(start.state)

    def add(self, item: State | Termination) -> None:
        if isinstance(item, Termination):
            self.termination = item
            return
        self.pos.append(_numpy(item.pos))
        self.vel.append(_numpy(item.vel))
        if self.start.state.boundary.motion is not None:
            b = item.boundary
            self.motion.append(Motion(*(np.array(_numpy(x)) for x in (b.pos, b.vel, b.normal))))
        self.stress.append(None if item.stress is None else Stress(_numpy(item.stress.node), _numpy(item.stress.cell)))

    def trajectory(self) -> Trajectory:
        state = self.start.state
        known = [stress for stress in self.stress if stress is not None]
        has_stress = len(known) == len(self.stress)
        motion = Motion(*(np.stack([getattr(m, name) for m in self.motion]) for name in ("pos", "vel", "normal"))) if self.motion else None
        return Trajectory(
            self.start.metadata,
            np.stack(self.pos),
            np.stack(self.vel),
            _numpy(state.node_type),
            _numpy(state.mass),
            _numpy(state.material_params),
            replace(state.boundary.to_numpy(), motion=motion),
            rest_pos=None if state.rest_pos is None else _numpy(state.rest_pos),
            cells=None if state.cells is None else _numpy(state.cells),
            cell_dim=state.cell_dim,
            stress=Stress(np.stack([s.node for s in known]), np.stack([s.cell for s in known])) if has_stress else None,
            termination=self.termination,
            start_time=state.time,
            is_prediction=self.is_prediction,
        )


def rollout(
    simulator: Simulator,
    state: State,
    num_steps: int,
    metadata: Metadata,
    guard: Guard | None = None,
    on_frame: Callable[[int, State], Any] | None = None,
) -> Trajectory:
    """Roll a simulator forward and collect the frames.

    Args:
        simulator: solver, learned model, baseline or ``Replay``.
        state: initial state, which becomes frame 0.
        num_steps: frames to add.
        metadata: of the scene; describes the result.
        guard: stops the rollout at the first state that cannot be trusted.
        on_frame: called with frame number and state (progress, sinks, watchers).

    Returns:
        Up to ``num_steps + 1`` frames; fewer if it stopped early, with the reason in ``termination``.
    """
    see = None if on_frame is None else lambda _, frame, item: on_frame(frame, item)
    return rollouts(simulator, [Start(state, num_steps, metadata, guard)], see)[0]


def share_outside(trajectory: Trajectory, tolerance: float = 0.0) -> float:
    """Fraction of particle-frames more than ``tolerance`` [m] inside a wall or obstacle."""
    if not trajectory.boundary.shapes or trajectory.pos.size == 0:
        return 0.0
    distance = signed_distance(trajectory.boundary.shapes, trajectory.pos.astype(np.float64))
    return float(np.mean(distance < -tolerance))


def _numpy(x: Any) -> np.ndarray:
    return np.array(x) if isinstance(x, np.ndarray) else x.detach().cpu().numpy().copy()
