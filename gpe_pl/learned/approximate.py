"""Approximate levels of skipping: nodes at rest are not computed, or one prediction is repeated for several frames.

These simulators keep their memory between steps in ``State.internal``, so a rollout can stop at any frame and continue.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpe_pl.graphs.neighbors import radius_between
from gpe_pl.graphs.topology import GraphError
from gpe_pl.learned.mean_velocities import islands_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.flow import FollowsNodes
from gpe_pl.rollout.loop import SimulationError, Simulator, sound, step_all
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import Boundary, search_tree
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.state import State, Stress


def approximate(simulator: LearnedSimulator) -> Simulator:
    """Return the simulator with the approximate levels of its ``skips``; the same object if there are none."""
    skips, dt = simulator.skips, simulator.builder.metadata.frame_dt
    runner: Simulator = simulator
    if skips.sleep_after is not None:
        runner = Sleeping(simulator)
    return runner if skips.repeat_frames == 1 else Repeating(runner, dt, skips.repeat_frames)


class Batched(ABC):
    """Base class of simulators that advance several scenes together. ``step`` is derived from ``step_all``."""

    @abstractmethod
    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        """Return the states one frame later. A scene that cannot be advanced has its error instead."""

    def step(self, state: State) -> State:
        return sound(*self.step_all([state]))


@dataclass(frozen=True)
class _Rest:
    """How long nodes have been at rest, and in which surroundings.

    Attributes:
        count: number of predictions in a row for which each node has been at rest [node].
        gravity: gravity [dim] in m/s²; None if it is not known.
        boundary: boundary without a prescribed motion; None if it moves or is not known.
        nodes: positions [node, dim], masses [node, 1] and material parameters [node, param], side by side; None if they are not known.
    """

    count: Tensor
    gravity: Tensor | None = None
    boundary: Boundary | None = None
    nodes: Tensor | None = None

    def of_rows(self, rows: np.ndarray) -> _Rest:
        """Return the counts of other nodes, as ``rollout.flow.FollowsNodes``; nodes that are new or move with an opening have not been at rest."""
        row = torch.from_numpy(rows).to(self.count.device)
        kept = row.clamp(min=0)
        return replace(self, count=torch.where(row >= 0, self.count[kept], 0), nodes=None if self.nodes is None else self.nodes[kept])

    def counts_in(self, state: State, distance: float) -> Tensor:
        """Return the counts [node] in a state; zeros for nodes that somebody changed or moved by more than this distance [m] between steps."""
        if not self.holds_in(state):
            return torch.zeros_like(self.count)
        if self.nodes is None:
            return self.count
        now, dim = _described(state), state.dim
        moved = (now[:, :dim] - self.nodes[:, :dim]).norm(dim=1) > distance
        is_same = (now[:, dim:] == self.nodes[:, dim:]) | (now[:, dim:].isnan() & self.nodes[:, dim:].isnan())
        return torch.where(moved | ~is_same.all(dim=1), 0, self.count)

    def holds_in(self, state: State) -> bool:
        """Return whether gravity and boundary are still those in which nodes came to rest."""
        same_gravity = self.gravity is None or bool((state.gravity == self.gravity).all())
        return same_gravity and (self.boundary is None or _are_equal(self.boundary, state.boundary))


class Sleeping(Batched):
    """Simulator in which islands at rest sleep: their nodes keep their positions and are not computed.

    An island wakes up when a node that is awake, or a wall that moves with a prescribed motion, comes within the radius of the graph, and when a force acts on
    one of its nodes, a given motion moves one, or one gets a velocity. It wakes up when one of its nodes gets another mass or parameter between steps, or is
    moved further than nodes at rest move. All islands wake up when gravity or a boundary without a prescribed motion is changed between steps.

    An island (see ``graphs.islands``) falls asleep if all its nodes have been at rest in the last ``Skips.sleep_after`` predictions.
    ``Skips.rest_step_spacings`` and ``Skips.rest_step_change_spacings`` limit velocities at rest: those at the frame if the model predicts them, otherwise
    mean velocities. Islands sleep as a whole, so no edge connects a sleeping node to one that is awake. For awake nodes, the model gets all nodes that can
    influence them, also sleeping ones. An island that falls asleep loses its momentum. New states contain this loss (``State.lost_impulse``) and the number of
    sleeping nodes (``State.num_asleep``).

    Args:
        simulator: simulator, whose ``skips`` set when islands sleep.

    Raises:
        GraphError: the model reads the stress, or predicts it per strain of the whole scene.
    """

    def __init__(self, simulator: LearnedSimulator) -> None:
        if simulator.builder.spec.reads_stress:
            raise GraphError(
                "rollout.sleep_after: models with graph.stress=true need the stress of all nodes; set rollout.sleep_after=null"
            )
        if simulator.model.settings.get("stress_unit") == "strain" and not simulator.skips.stress:
            raise GraphError(
                "rollout.sleep_after: models with model.stress_unit=strain need the strain of all nodes; set rollout.sleep_after=null"
            )
        self.simulator = simulator
        self.radius, self.dt = simulator.builder.scales.radius, simulator.builder.metadata.frame_dt

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        plans = [self._awake_and_seen(state) for state in states]
        parts = [state.take(seen) for state, (_, seen) in zip(states, plans, strict=True)]
        stepped = iter(step_all(self.simulator, [part for part in parts if part.num_nodes]))
        results: list[State | SimulationError] = []
        for state, part, (awake, seen) in zip(states, parts, plans, strict=True):
            after = next(stepped) if part.num_nodes else part
            results.append(after if isinstance(after, SimulationError) else self._combined(state, after, awake, seen))
        return results

    def _awake_and_seen(self, state: State) -> tuple[Tensor, Tensor]:
        """Return masks [node] of the awake nodes and of all nodes that the graph for their prediction contains."""
        after = self.simulator.skips.sleep_after
        assert after is not None
        is_calm = ((self._rest_of(state) >= after) & self._are_slow(_velocity(state))).cpu().numpy()
        if not is_calm.any():
            everything = torch.ones(state.num_nodes, dtype=torch.bool, device=state.pos.device)
            return everything, everything
        pos = np.ascontiguousarray(state.pos.cpu().numpy())
        is_calm &= ~self._are_near_a_moving_wall(state, pos)
        if state.loads is not None:
            is_calm &= ~_are_loaded(state.loads)
        islands, space = islands_of(state, self.radius), state.periodicity
        awake = _in_the_same_island(~is_calm, islands.label)
        seen = awake.copy()
        if awake.any() and not awake.all():
            reach = self.simulator.num_hops * self.radius
            others = space.from_corner(pos[~awake]) if space else pos[~awake]
            distance, _ = search_tree(pos[awake], space).query(others, distance_upper_bound=reach)
            seen[~awake] = np.isfinite(distance)
            if (
                state.cells is not None or state.rigid_body is not None
            ):  # the graph of a mesh needs all of it, and so does the motion of a rigid body
                seen = _in_the_same_island(seen, islands.label)
        return torch.from_numpy(awake).to(state.pos.device), torch.from_numpy(seen).to(state.pos.device)

    def _are_near_a_moving_wall(self, state: State, pos: np.ndarray) -> np.ndarray:
        """Return a mask [node] of the nodes within the radius of a wall that moves with a prescribed motion."""
        near = np.zeros(len(pos), dtype=bool)
        if state.boundary.motion is not None:
            moves = (state.boundary.vel != 0).any(dim=1)
            walls = np.ascontiguousarray(state.boundary.pos[moves].cpu().numpy())
            near[radius_between(walls, pos, self.radius, state.periodicity)[1]] = True
        return near

    def _are_slow(self, velocity: Tensor) -> Tensor:
        """Return a mask [node] of the nodes that are as slow as nodes at rest, given velocities [node, dim] in m/s."""
        return velocity.norm(dim=1) < self.simulator.skips.rest_step_spacings * self.simulator.builder.metadata.spacing / self.dt

    def _combined(self, state: State, after: State, awake: Tensor, seen: Tensor) -> State:
        """Return the next state, in which awake nodes have moved and all others stay."""
        pos, vel = state.pos.clone(), torch.zeros_like(state.vel)
        moved = awake[seen]
        pos[awake], vel[awake] = after.pos[moved], after.vel[moved]
        at_frame, before, now = None, state.vel, vel
        if after.frame_velocity is not None:
            at_frame = torch.zeros_like(state.vel)
            at_frame[awake] = after.frame_velocity[moved]
            before, now = _velocity(state), at_frame
        least_change = self.simulator.skips.rest_step_change_spacings * self.simulator.builder.metadata.spacing / self.dt
        calm = self._are_slow(now) & ((now - before).norm(dim=1) < least_change)
        known = self._rest_of(state)
        count = torch.where(awake, torch.where(calm, known + 1, 0), known)
        new = state.later(
            self.dt,
            pos,
            vel,
            frame_velocity=at_frame,
            stress=_combined_stress(state, after, awake, moved),
            num_asleep=int((~awake).sum()),
            lost_impulse=float((state.mass * before.norm(dim=1))[~awake].sum()),
        )
        boundary = new.boundary if new.boundary.motion is None else None
        return replace(new, internal=_Rest(count, state.gravity.clone(), boundary, _described(new)))

    def _rest_of(self, state: State) -> Tensor:
        """Return the number of predictions in a row for which each node has been at rest [node]; zeros if its surroundings have changed."""
        if not isinstance(state.internal, _Rest):
            return torch.zeros(state.num_nodes, dtype=torch.int64, device=state.pos.device)
        skips = self.simulator.skips  # nodes at rest move in repeated frames, too
        return state.internal.counts_in(state, skips.repeat_frames * skips.rest_step_spacings * self.simulator.builder.metadata.spacing)


def _described(state: State) -> Tensor:
    """Return positions, masses and parameters of the nodes [node, dim + 1 + param]. Only edits of a state change them between steps."""
    return torch.cat([state.pos, state.mass[:, None], state.material_params], dim=1)


def _are_loaded(loads: Loads) -> np.ndarray:
    """Return a mask [node] of the nodes that their given motion or a force moves."""
    moves = np.zeros(len(loads.prescribed), dtype=bool)
    moves[loads.rows] = (loads.next_positions() != loads.path[0]).any(axis=1)
    return moves if loads.force is None else moves | (loads.force[0] != 0).any(axis=1)


def _are_equal(one: Boundary, other: Boundary) -> bool:
    """Return whether two boundaries are the same, or have the same nodes, shapes and no motion."""
    if one is other:
        return True
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("pos", "vel", "normal", "friction", "restitution")]
    same_nodes = all(a.shape == b.shape and bool((a == b).all()) for a, b in pairs)
    return same_nodes and one.shapes == other.shapes and one.motion is None and other.motion is None


def _velocity(state: State) -> Tensor:
    """Return the velocities that tell whether nodes are at rest [node, dim] in m/s: those at the frame if they are known, else mean ones."""
    return state.vel if state.frame_velocity is None else state.frame_velocity


def _in_the_same_island(chosen: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return a mask [node] of all nodes in islands with a chosen node; ``chosen`` is a mask [node]."""
    has_chosen = np.zeros(label.max(initial=-1) + 1, dtype=bool)
    has_chosen[label[chosen]] = True
    return has_chosen[label]


def _combined_stress(state: State, after: State, awake: Tensor, moved: Tensor) -> Stress | None:
    if after.stress is None:
        return state.stress if not bool(awake.any()) else None
    node = after.stress.node.new_zeros(state.num_nodes, after.stress.node.shape[1]) if state.stress is None else state.stress.node.clone()
    node[awake] = after.stress.node[moved]
    return Stress.of_nodes(node, state.cells)


@dataclass(frozen=True)
class _Repeated:
    """A prediction that is repeated.

    Attributes:
        acceleration: accelerations [node, dim] in m/s².
        frames: number of frames for which it is still to be repeated.
        inner: ``State.internal`` of the simulator that made it.
    """

    acceleration: Tensor
    frames: int
    inner: Any

    def of_rows(self, rows: np.ndarray) -> _Repeated:
        """Return what is repeated for other nodes, as ``rollout.flow.FollowsNodes``; nodes that are new or move with an opening are not accelerated."""
        row = torch.from_numpy(rows).to(self.acceleration.device)
        acceleration = torch.where((row >= 0)[:, None], self.acceleration[row.clamp(min=0)], 0.0)
        inner = self.inner.of_rows(rows) if isinstance(self.inner, FollowsNodes) else None
        return replace(self, acceleration=acceleration, inner=inner)


class Repeating(Batched):
    """Simulator that predicts once in ``frames`` frames and repeats the accelerations in between. Contacts that begin or end in between have no effect,
    and the impulse of an impact acts as often, so the energy can grow.

    Args:
        simulator: simulator that predicts.
        dt: frame interval [s].
        frames: number of frames for which one prediction is used.

    Raises:
        SimulationError: a scene has rigid bodies.
    """

    def __init__(self, simulator: Simulator, dt: float, frames: int) -> None:
        self.simulator, self.dt, self.frames = simulator, dt, frames

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        if any(state.rigid_body is not None for state in states):  # accelerations of a body that turns would have to turn with it
            raise SimulationError("rollout.repeat_frames: cannot be more than 1 in scenes with rigid bodies", reason="input")
        repeated = [s.internal if isinstance(s.internal, _Repeated) else None for s in states]
        asked = [
            replace(s, internal=h.inner if h else s.internal) for s, h in zip(states, repeated, strict=True) if h is None or h.frames == 0
        ]
        answers = iter(step_all(self.simulator, asked))
        results: list[State | SimulationError] = []
        for state, h in zip(states, repeated, strict=True):
            if h is not None and h.frames > 0:
                results.append(self._repeat(state, h))
                continue
            after = next(answers)
            results.append(after if isinstance(after, SimulationError) else self._with_repetition(state, after))
        return results

    def _with_repetition(self, state: State, after: State) -> State:
        acceleration = integrators.acceleration(after.vel, state.vel, self.dt)
        stopped = (after.vel == 0).all(dim=1, keepdim=True)  # sleeping nodes, for example: the stop must not be repeated
        return replace(after, internal=_Repeated(torch.where(stopped, 0.0, acceleration), self.frames - 1, after.internal))

    def _repeat(self, state: State, repeated: _Repeated) -> State:
        pos, vel = integrators.advance(state.pos, state.vel, repeated.acceleration, self.dt)
        at_frame = None if state.frame_velocity is None else state.frame_velocity + (vel - state.vel)
        known = {"frame_velocity": at_frame, "stress": state.stress, "num_asleep": state.num_asleep}
        return state.later(self.dt, pos, vel, **known, internal=replace(repeated, frames=repeated.frames - 1))
