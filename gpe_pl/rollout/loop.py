"""``Simulator``, the protocol of solvers and learned models, and ``step_scenes``, the time loop.

``rollout`` collects the frames of the loop, with a guard. ``steps`` yields its states, without one. A guard checks every new state. If it rejects a state, the
rollout stops, keeps the frames before and stores the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.rollout.flow import through_openings
from gpe_pl.rollout.guard import Guard, unsound
from gpe_pl.trajectory.boundary import BoundaryMotion, as_numpy
from gpe_pl.trajectory.living import columns
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory


@runtime_checkable
class Simulator(Protocol):
    """Protocol of solvers and learned models: anything that advances a state by one frame of ``Metadata.frame_dt``."""

    def step(self, state: State) -> State: ...


@runtime_checkable
class BatchSimulator(Simulator, Protocol):
    """A simulator that can advance several scenes together, which is faster than one after the other."""

    def step_all(self, states: list[State]) -> list[State | SimulationError]: ...


@runtime_checkable
class Restartable(Simulator, Protocol):
    """A solver that can continue from the positions and velocities of a frame, without its internal state."""

    @property
    def can_restart(self) -> bool:
        """Whether all its materials can be restarted."""
        ...

    def restarted(self, state: State) -> State:
        """Return a state from which ``step`` can continue. Only positions and velocities of ``state`` describe its motion.

        Raises:
            SimulationError: a material of the state cannot be restarted, or the state lacks the cells that a restart needs.
        """
        ...


class SimulationError(GpeError, RuntimeError):
    """Raised when a simulator cannot compute the next state.

    Attributes:
        reason: reason code.
        node: node that shows the failure, or -1 if no single node does.
    """

    def __init__(self, message: str, *, reason: str = "solver", node: int = -1) -> None:
        super().__init__(message)
        self.reason, self.node = reason, node


SCALES = (("frame_dt", "s", 1e-6), ("spacing", "m", 0.01))
"""Attributes that a simulator may have, and that are then those of the scene's metadata: name, unit and relative tolerance."""


@dataclass(frozen=True)
class Replay:
    """A simulator that returns the frames of a stored trajectory, chosen by the time of the state. After the last frame, ``step`` raises ``IndexError``.

    States of an open scene have the nodes of the stored frame, so they have no openings that would change them.
    """

    trajectory: Trajectory

    def step(self, state: State) -> State:
        frame = round((state.time - self.trajectory.start_time) / self.trajectory.metadata.frame_dt) + 1
        return replace(self.trajectory.state(frame), openings=())


def sound(after: State | SimulationError) -> State:
    """Return a state that ``step_all`` returned for a scene, or raise the error that it returned instead."""
    if isinstance(after, SimulationError):
        raise after
    return after


def step_all(simulator: Simulator, states: list[State]) -> list[State | SimulationError]:
    """Return the next state of every scene, computed together if the simulator can. Errors of single scenes are returned, so that the others continue."""
    if not states:
        return []
    together = getattr(simulator, "step_all", None)  # a test for the protocol would take longer than a step of a baseline
    if together is not None:
        return cast(BatchSimulator, simulator).step_all(states)
    return [_step(simulator, state) for state in states]


def _step(simulator: Simulator, state: State) -> State | SimulationError:
    try:
        return simulator.step(state)
    except SimulationError as error:
        return error


@runtime_checkable
class GroundTruth(Protocol):
    """Protocol of ground-truth solvers.

    Unlike other simulators, they have a name and version, which are stored with results, and they know which scenes they can compute.
    """

    name: ClassVar[str]
    version: ClassVar[str]

    @property
    def frame_dt(self) -> float: ...

    @property
    def materials(self) -> tuple[str, ...]: ...


def unfit(simulator: Simulator, metadata: Metadata) -> Termination | None:
    """Return the reason why a simulator cannot compute a scene: another frame interval or spacing, or a solver for other materials. None means that it can."""
    for layer in _layers(simulator):
        for name, unit, tolerance in SCALES:
            own, there = getattr(layer, name, None), getattr(metadata, name)
            if own is not None and not math.isclose(own, there, rel_tol=tolerance):
                return _unlike(f"{_named(layer)} has {name} = {own:g} {unit}, the scene {there:g} {unit}")
    if isinstance(simulator, GroundTruth) and tuple(simulator.materials) != metadata.materials:
        own, there = ", ".join(simulator.materials), ", ".join(metadata.materials)
        return _unlike(f"{_named(simulator)} has the materials {own}, the scene {there}, in this order")
    return None


def _layers(simulator: Any) -> Iterator[Any]:
    """Yield the simulators inside a simulator, such as the one inside containment or the members of an ensemble, and then the simulator."""
    inner = getattr(simulator, "simulator", None)
    for part in (*getattr(simulator, "members", ()), *(() if inner is None else (inner,))):
        yield from _layers(part)
    yield simulator


def _named(simulator: Any) -> str:
    if isinstance(simulator, GroundTruth):
        return f"the solver {simulator.name}"
    return type(simulator).__name__ if hasattr(simulator, "simulator") else "the model"


def _unlike(difference: str) -> Termination:
    return Termination("input", 0, -1, f"{difference}; both must be the same")


@dataclass(frozen=True)
class Start:
    """Start and length of a rollout.

    Attributes:
        state: initial state, which becomes frame 0.
        num_steps: number of frames to add.
        metadata: metadata of the scene, which also describe the result.
        guard: stops the rollout at the first state that it rejects. A termination at frame 0 concerns the initial state. Initial values that break the rules of
            ``schema.FIELDS`` also stop a rollout that has no guard.
    """

    state: State
    num_steps: int
    metadata: Metadata
    guard: Guard | None = None


def frames(simulator: Simulator, starts: Sequence[Start]) -> Iterator[tuple[int, int, State | Termination]]:
    """Advance all scenes together, and yield (scene, frame, new state) for each step of each.

    The last item of a scene that stops early has a ``Termination`` instead of a state. Only one state per scene is kept in memory.
    """
    live, num_steps, guards = dict[int, State](), dict[int, int](), dict[int, Guard]()
    for scene, start in enumerate(starts):
        if not isinstance(start.num_steps, Integral) or start.num_steps < 0:
            raise ValueError(f"num_steps={start.num_steps}: must be a whole number of at least 0")
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
        SimulationError: a step failed; the message names the frame.
    """
    for _, _, item in step_scenes(simulator, {0: state}, {0: num_steps}):
        if isinstance(item, Termination):
            raise SimulationError(item.message, reason=item.reason, node=item.node)
        yield item


def step_scenes(
    simulator: Simulator, states: Mapping[int, State], num_steps: Mapping[int, int], guards: Mapping[int, Guard] | None = None
) -> Iterator[tuple[int, int, State | Termination]]:
    """Yield the items of ``frames`` without checking the initial states. This is the only time loop: everything that advances scenes calls it.

    Args:
        simulator: simulator, which advances all scenes together if it can.
        states: initial state of each scene, by its number.
        num_steps: number of frames to add to each scene.
        guards: guards of scenes that have one.
    """
    live, frame = dict(states), 0
    while True:
        frame += 1
        live = {scene: state for scene, state in live.items() if frame <= num_steps[scene]}
        if not live:
            return
        for scene, item in zip(list(live), step_all(simulator, list(live.values())), strict=True):
            if isinstance(item, State) and item.openings:
                item = through_openings(live[scene], item)
            stop = _termination(item, frame, (guards or {}).get(scene), live[scene])
            if stop is None:
                live[scene] = cast(State, item)
            else:
                del live[scene]
            yield scene, frame, stop or cast(State, item)


def _termination(item: State | SimulationError, frame: int, guard: Guard | None, before: State) -> Termination | None:
    if isinstance(item, SimulationError):
        node = item.node if item.node < 0 else before.identity(item.node)
        which = "" if node == item.node else f" (node {node} of the whole rollout)"
        return Termination(item.reason, frame, node, f"frame {frame}: {item}{which}")
    return None if guard is None else guard.check(item, frame, before)


def rollouts(simulator: Simulator, starts: Sequence[Start], on_frame: Callable[[int, int, State], Any] | None = None) -> list[Trajectory]:
    """Roll several scenes out together. A learned simulator advances them in one pass of its model.

    Args:
        simulator: solver, learned model, baseline or ``Replay``.
        starts: one start per scene.
        on_frame: called with scene, frame number and state.

    Returns:
        One trajectory per start, as ``rollout`` returns it.
    """
    is_prediction = not isinstance(simulator, GroundTruth)
    recordings = [_Recording(start, is_prediction) for start in starts]
    for scene, frame, item in frames(simulator, starts):
        recordings[scene].add(item)
        if on_frame is not None and isinstance(item, State):
            on_frame(scene, frame, item)
    return [recording.trajectory() for recording in recordings]


class _Recording:
    """Collects the frames of one scene as NumPy arrays."""

    def __init__(self, start: Start, is_prediction: bool) -> None:
        self.start, self.is_prediction = start, is_prediction
        self.pos: list[np.ndarray] = []
        self.vel: list[np.ndarray] = []
        self.frame_velocity: list[np.ndarray | None] = []
        self.stress: list[Stress | None] = []
        self.motion: list[BoundaryMotion] = []
        self.ids: list[np.ndarray] = []
        self.entered: list[State] = []
        self.force: list[np.ndarray] = []
        self.termination: Termination | None = None
        self.add(start.state)

    def add(self, item: State | Termination) -> None:
        if isinstance(item, Termination):
            self.termination = item
            return
        self.pos.append(_numpy(item.pos))
        self.vel.append(_numpy(item.vel))
        self.frame_velocity.append(None if item.frame_velocity is None else _numpy(item.frame_velocity))
        if self.start.state.boundary.motion is not None:
            b = item.boundary
            self.motion.append(BoundaryMotion(*(np.array(_numpy(x)) for x in (b.pos, b.vel, b.normal))))
        if item.node_id is not None:
            self._note_identities(item)
        if item.loads is not None and item.loads.force is not None:
            self.force.append(np.array(item.loads.force[0]))
        self.stress.append(None if item.stress is None else Stress(_numpy(item.stress.node), _numpy(item.stress.cell)))

    def _note_identities(self, state: State) -> None:
        """Keep the identities of the nodes, and the nodes that were not in the scene before, which differ only in what never changes."""
        ids = _numpy(state.node_id)
        known = self.ids[-1] if self.ids else ids[:0]
        new = np.flatnonzero(~np.isin(ids, known))
        if len(new) or not self.entered:
            self.entered.append(replace(state.take(new), frame_velocity=None))  # not every state has one, and none is needed
        self.ids.append(ids)

    def _velocities(self) -> list[np.ndarray]:
        """Return the velocities at the frames if the simulator knows them, otherwise the mean velocities over the frames before."""
        first, *others = self.frame_velocity
        known = [at_frame for at_frame in others if at_frame is not None]
        if not known or len(known) < len(others):
            return self.vel
        return [self.vel[0] if first is None else first, *known]

    def trajectory(self) -> Trajectory:
        state, alive = self.start.state, None
        if self.ids:
            state = State.joined(self.entered) if len(self.entered) > 1 else self.entered[0]
            state = state.take(np.argsort(_numpy(state.node_id)))  # as in ``columns``
            (pos, alive, _), (vel, _, _) = columns(self.ids, self.pos), columns(self.ids, self._velocities())
        else:
            pos, vel = np.stack(self.pos), np.stack(self._velocities())
        known = [stress for stress in self.stress if stress is not None]
        has_stress = len(known) == len(self.stress)
        motion = (
            BoundaryMotion(*(np.stack([getattr(m, name) for m in self.motion]) for name in ("pos", "vel", "normal")))
            if self.motion
            else None
        )
        return Trajectory(
            _with_gravity(self.start.metadata, state),
            pos,
            vel,
            _numpy(state.node_type),
            _numpy(state.mass),
            _numpy(state.material_params),
            replace(self.start.state.boundary.to_numpy(), motion=motion),
            rest_pos=None if state.rest_pos is None else _numpy(state.rest_pos),
            cells=None if state.cells is None else _numpy(state.cells),
            cell_dim=state.cell_dim,
            rigid_body=None if state.rigid_body is None else _numpy(state.rigid_body),
            prescribed=None if state.loads is None or not state.loads.prescribed.any() else state.loads.prescribed,
            force=np.stack(self.force) if self.force else None,
            stress=Stress(np.stack([s.node for s in known]), np.stack([s.cell for s in known])) if has_stress else None,
            termination=self.termination,
            alive=alive,
            openings=self.start.state.openings,
            start_time=self.start.state.time,
            is_prediction=self.is_prediction,
        )


def _with_gravity(metadata: Metadata, state: State) -> Metadata:
    """Return the metadata with the gravity of the state, which may have another than its scene."""
    gravity = as_numpy(state.gravity)
    if gravity.shape != (metadata.dim,) or np.allclose(gravity, metadata.gravity, rtol=1e-6, atol=0.0):  # other shapes end the rollout
        return metadata
    return replace(metadata, gravity=tuple(gravity.tolist()))


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
        num_steps: number of frames to add.
        metadata: metadata of the scene, which also describe the result. Its gravity is that of the state.
        guard: stops the rollout at the first state that it rejects.
        on_frame: called with frame number and state.

    Returns:
        ``num_steps + 1`` frames; fewer if the rollout stopped early, with the reason in ``termination``.
    """
    see = None if on_frame is None else lambda _, frame, item: on_frame(frame, item)
    return rollouts(simulator, [Start(state, num_steps, metadata, guard)], see)[0]


def fraction_outside(trajectory: Trajectory, tolerance: float = 0.0) -> float:
    """Return the fraction of positions, over all frames and nodes, that lie more than ``tolerance`` [m] inside a wall or obstacle."""
    if not trajectory.boundary.shapes or trajectory.pos.size == 0:
        return 0.0
    pos = trajectory.pos if trajectory.alive is None else trajectory.pos[trajectory.alive]
    distance = signed_distance(trajectory.boundary.shapes, pos.astype(np.float64))
    return float(np.mean(distance < -tolerance))


def _numpy(x: Any) -> np.ndarray:
    return np.array(as_numpy(x))
