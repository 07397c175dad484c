"""``Simulator``, the protocol shared by solvers and learned models, and ``rollout``, the only time loop.

A guard looks at every new state. When it finds a state that cannot be trusted, the rollout stops there, keeps the good frames and says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.errors import GpeError
from gpe_pl.geometry import signed_distance
from gpe_pl.trajectory import Boundary, Metadata, State, Stress, Termination, Trajectory


@runtime_checkable
class Simulator(Protocol):
    """Anything that advances a state by one frame of ``Metadata.frame_dt``."""

    def step(self, state: State) -> State: ...


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
        frame = round(state.time / self.trajectory.metadata.frame_dt) + 1
        return self.trajectory.state(frame)


@dataclass(frozen=True)
class Guard:
    """Limits beyond which a state is not trusted.

    Attributes:
        max_speed: m/s.
        bounds: ``(low, high)`` per axis of the region that nodes may not leave by more than ``margin`` [m].
    """

    max_speed: float = math.inf
    bounds: tuple[tuple[float, float], ...] = ()
    margin: float = 0.0

    def __post_init__(self) -> None:
        if self.max_speed <= 0 or self.margin < 0:
            raise ValueError(f"guard limits must be positive, got {self}")

    def check(self, state: State, frame: int) -> Termination | None:
        """The first violated limit of a state, or None."""
        if state.num_nodes == 0:
            return None
        xp = array_namespace(state.pos)
        finite = xp.all(xp.isfinite(state.pos) & xp.isfinite(state.vel), axis=-1)
        if not bool(xp.all(finite)):
            node = int(xp.argmax(xp.astype(~finite, xp.int8)))
            return Termination("nan", frame, node, f"frame {frame}: node {node} has a position or velocity that is not finite")
        for axis, (low, high) in enumerate(self.bounds):
            outside = xp.maximum(low - state.pos[:, axis], state.pos[:, axis] - high)
            if float(xp.max(outside)) > self.margin:
                node = int(xp.argmax(outside))
                return Termination("escape", frame, node, f"frame {frame}: node {node} is {float(outside[node]):.3g} m outside the domain")
        if math.isfinite(self.max_speed):
            speed = xp.sqrt(xp.sum(state.vel * state.vel, axis=-1))
            if float(xp.max(speed)) > self.max_speed:
                node = int(xp.argmax(speed))
                return Termination(
                    "explosion",
                    frame,
                    node,
                    f"frame {frame}: node {node} moves at {float(speed[node]):.3g} m/s, limit {self.max_speed:.3g} m/s",
                )
        return None


def states(simulator: Simulator, state: State, num_steps: int, guard: Guard | None = None) -> Iterator[State | Termination]:
    """Yield ``num_steps`` successive states, or fewer and then a ``Termination``. Holds one state at a time."""
    for frame in range(1, num_steps + 1):
        try:
            state = simulator.step(state)
        except SimulationError as error:
            yield Termination(error.reason, frame, error.node, f"frame {frame}: {error}")
            return
        if guard is not None:
            stop = guard.check(state, frame)
            if stop is not None:
                yield stop
                return
        yield state


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
    pos, vel, stress, termination = [_numpy(state.pos)], [_numpy(state.vel)], [state.stress], None
    for frame, item in enumerate(states(simulator, state, num_steps, guard), start=1):
        if isinstance(item, Termination):
            termination = item
            break
        pos.append(_numpy(item.pos))
        vel.append(_numpy(item.vel))
        stress.append(item.stress)
        if on_frame is not None:
            on_frame(frame, item)
    b = state.boundary
    pos_b, vel_b, normal, friction, restitution = (_numpy(x) for x in (b.pos, b.vel, b.normal, b.friction, b.restitution))
    boundary = Boundary(pos_b, vel_b, normal, friction, restitution, b.shapes)
    return Trajectory(
        metadata,
        np.stack(pos),
        np.stack(vel),
        _numpy(state.node_type),
        _numpy(state.mass),
        _numpy(state.material_params),
        boundary,
        rest_pos=None if state.rest_pos is None else _numpy(state.rest_pos),
        cells=None if state.cells is None else _numpy(state.cells),
        stress=_stacked(stress),
        termination=termination,
    )


def _stacked(frames: list[Stress | None]) -> Stress | None:
    """The stresses of all frames; None unless every frame has them."""
    known = [stress for stress in frames if stress is not None]
    if len(known) < len(frames):
        return None
    return Stress(np.stack([_numpy(s.node) for s in known]), np.stack([_numpy(s.cell) for s in known]))


def share_outside(trajectory: Trajectory, tolerance: float = 0.0) -> float:
    """Fraction of particle-frames more than ``tolerance`` [m] inside a wall or obstacle."""
    if not trajectory.boundary.shapes or trajectory.pos.size == 0:
        return 0.0
    distance = signed_distance(trajectory.boundary.shapes, trajectory.pos.astype(np.float64))
    return float(np.mean(distance < -tolerance))


def _numpy(x: Any) -> np.ndarray:
    return np.array(x) if isinstance(x, np.ndarray) else x.detach().cpu().numpy().copy()
