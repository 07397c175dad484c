"""Several simulators as one: the mean of their rollouts, and its spread.

Each member rolls out its own trajectory from the common start. The state of the ensemble has the mean positions and velocities. The members' own states are its
``internal`` memory, so a rollout can stop at any frame and continue. Where the motion is chaotic, members end in different places, and their mean is smoother
than each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from array_api_compat import array_namespace

from gpe_pl.rollout.loop import SimulationError, Simulator, step_all
from gpe_pl.trajectory.boundary import Array
from gpe_pl.trajectory.rigid_bodies import moved_rigidly
from gpe_pl.trajectory.state import State, Stress


@dataclass(frozen=True)
class _Members:
    """The states of the members at one frame, and their mean positions [node, dim] in m."""

    states: tuple[State, ...]
    mean: Array


@dataclass(frozen=True)
class Ensemble:
    """Simulators whose mean is the prediction.

    Every member advances all scenes by one pass of its model. Members have different weights, so they run one after the other.

    Attributes:
        members: simulators with the same frame interval, wrapped as for their own rollouts, for example with containment.
    """

    members: tuple[Simulator, ...]

    def step(self, state: State) -> State:
        (after,) = self.step_all([state])
        if isinstance(after, SimulationError):
            raise after
        return after

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        """Return the mean states one frame later. A scene in which a member fails has the error of the first that does."""
        if any(state.openings for state in states):
            raise SimulationError(
                "an ensemble cannot predict open scenes, because its members would lose the nodes that enter", reason="input"
            )
        before = [self._states_of(state) for state in states]
        columns = [step_all(member, [own[k] for own in before]) for k, member in enumerate(self.members)]
        return [self._combined(state, items) for state, items in zip(states, zip(*columns, strict=True), strict=True)]

    def _states_of(self, state: State) -> tuple[State, ...]:
        if not isinstance(state.internal, _Members):
            return (state,) * len(self.members)
        mean = state.internal.mean
        if state.pos is not mean and not bool((state.pos == mean).all()):
            raise SimulationError(
                "positions were changed after an ensemble had predicted them, which its members would not see; change the simulators of the members, "
                "or drop State.internal to start all members from this state",
                reason="input",
            )
        return state.internal.states

    def _combined(self, before: State, items: tuple[State | SimulationError, ...]) -> State | SimulationError:
        for k, item in enumerate(items):
            if isinstance(item, SimulationError):
                return SimulationError(f"member {k + 1} of {len(items)}: {item}", reason=item.reason, node=item.node)
        states = tuple(item for item in items if isinstance(item, State))
        mean = _rigid(before, mean_state(states))
        return replace(mean, internal=_Members(states, mean.pos))


def _rigid(before: State, mean: State) -> State:
    """Return a mean state in which each rigid body has the shape of the state before, at the place nearest to the mean of its nodes."""
    dt = mean.time - before.time
    if before.rigid_body is None or dt <= 0:
        return mean
    way = before.periodicity.shortest(mean.pos - before.pos)
    is_free = (before.rigid_body < 0)[:, None]
    rigid = moved_rigidly(before, replace(mean, vel=way / dt), dt)
    xp = array_namespace(mean.pos)
    return mean.corrected(rigid.pos, xp.where(is_free, mean.vel, rigid.vel))


def mean_state(states: Sequence[State]) -> State:
    """Return the mean of states of one scene at the same time. Along periodic axes, images near the first state are averaged. Counts are means, too."""
    first = states[0]
    pos = first.pos + _mean([first.periodicity.shortest(state.pos - first.pos) for state in states])
    stress = [state.stress for state in states if state.stress is not None]
    return replace(
        first,
        pos=first.periodicity.wrapped(pos),
        vel=_mean([state.vel for state in states]),
        velocity_history=_mean_of_all([state.velocity_history for state in states]),
        frame_velocity=_mean_of_all([state.frame_velocity for state in states]),
        stress=Stress(_mean([s.node for s in stress]), _mean([s.cell for s in stress])) if len(stress) == len(states) else None,
        num_corrected=sum(state.num_corrected for state in states) / len(states),
        num_asleep=sum(state.num_asleep for state in states) / len(states),
        lost_impulse=sum(state.lost_impulse for state in states) / len(states),
    )


def spread(state: State) -> Array | None:
    """Return the spread of an ensemble's members around their mean [node] in m, or None for a state that no ensemble predicted.

    The spread is √(Σ_k |x_k - x̄|² / (K - 1)) with K members.
    """
    if not isinstance(state.internal, _Members):
        return None
    states = state.internal.states
    xp = array_namespace(state.pos)
    mean = mean_state(states).pos
    square = sum(xp.sum(state.periodicity.shortest(own.pos - mean) ** 2, axis=1) for own in states)
    return xp.sqrt(square / max(1, len(states) - 1))


def _mean(values: Sequence[Array]) -> Array:
    total: Any = sum(values[1:], start=values[0])
    return total / len(values)


def _mean_of_all(values: Sequence[Array | None]) -> Array | None:
    known = [value for value in values if value is not None]
    return _mean(known) if len(known) == len(values) else None
