"""Computes the next states of scenes, with stresses, from the predictions of a model for a batch of their graphs.

On the CPU and without gradients, NumPy and compiled loops replace ``accelerations`` and ``LearnedSimulator.advance``, because for the small arrays of a scene
most of the time of a PyTorch operation is its overhead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import no_type_check

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.compiled_graph import works_on
from gpe_pl.nn.friction_cone import limit
from gpe_pl.nn.static_friction import LEVEL, keeps_position, supported
from gpe_pl.nn.stores import contents
from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.schema import STICKY
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.cells import mean_over_corners
from gpe_pl.trajectory.rigid_bodies import all_of_bodies, moved_rigidly
from gpe_pl.trajectory.state import State, Stress

Rows = Mapping[str, Tensor]
"""Rows of the nodes of each material in a state."""


def works_on_all(states: list[State], predicted: dict[str, Tensor]) -> bool:
    """Tell whether ``moved`` can process these states and predictions."""
    return all(map(works_on, states)) and not any(values.requires_grad for values in predicted.values())


def moved(
    states: list[State],
    rows: Sequence[Rows],
    predicted: dict[str, Tensor],
    unit: float,
    dt: float,
    contacts: Sequence[WallContacts] = (),
) -> list[State]:
    """Return the states one frame later, given the accelerations that a model predicts.

    Args:
        states: states of the scenes of a batch.
        rows: rows of the nodes of each material in each state.
        predicted: accelerations without gravity for the batch, by material.
        unit: unit of these accelerations [m/s²].
        dt: frame interval [s].
        contacts: contacts of each scene with walls that obey Coulomb's law (``nn.friction_cone``); none if they need not.
    """
    acc = [np.tile(state.gravity.numpy(), (state.num_nodes, 1)) for state in states]
    for scene, own, part in per_scene(predicted, rows):
        _add(part.contiguous().numpy(), own.numpy(), unit, acc[scene])
    for state, a, touching in zip(states, acc, contacts, strict=False):
        limit(a, state.mass.numpy(), state.gravity.numpy(), touching)
    new = []
    for state, a in zip(states, acc, strict=True):
        pos, vel = integrators.advance(state.pos.numpy(), state.vel.numpy(), a, dt)
        values = {}
        if state.velocity_history is not None:
            past = state.velocity_history.numpy()
            values["velocity_history"] = torch.from_numpy(np.concatenate([past[:, 1:], vel[:, None]], axis=1))
        after = state.later(dt, torch.from_numpy(pos), torch.from_numpy(vel), **values)
        new.append(moved_rigidly(state, after, dt))
    return new


def keep_slow(state: State, new: State, contacts: WallContacts, fraction: float, dt: float) -> None:
    """Put nodes that static friction keeps in place back to their old positions, with zero velocity, in the arrays of a new state (see ``nn.static_friction``).

    Args:
        state: state before the step, whose walls are at rest.
        new: state that ``moved`` and ``with_frame_velocity`` returned. Its arrays are changed.
        contacts: contacts of ``state`` with walls.
        fraction: fraction of the speed that gravity gives in one frame, below which a node keeps its position.
        dt: frame interval [s].
    """
    given = None if state.loads is None else (new.pos.clone(), new.vel.clone())
    history = new.vel[:, None] if new.velocity_history is None else new.velocity_history
    at_frame = new.vel if new.frame_velocity is None else new.frame_velocity
    before = (state.pos.numpy(), state.vel.numpy(), contacts.island.numpy(), contacts.is_pushed.numpy(), state.gravity.numpy())
    edges = contacts.at.numpy(), contacts.normal.numpy(), contacts.friction.numpy()
    _keep_slow(*before, *edges, fraction * dt, new.pos.numpy(), new.vel.numpy(), history.numpy(), at_frame.numpy())
    if state.loads is not None and given is not None:  # static friction does not stop nodes whose motion is given
        held = torch.from_numpy(state.loads.prescribed)
        for values, moved_as_given in ((new.pos, given[0]), (new.vel, given[1]), (history[:, -1], given[1]), (at_frame, given[1])):
            values[held] = moved_as_given[held]


def slow_kept(state: State, new: State, contacts: WallContacts, fraction: float, dt: float) -> State:
    """Return the new state, in which nodes that static friction keeps in place have their old positions and zero velocity; rigid bodies as a whole.

    Args:
        state: state before the step.
        new: state after it without static friction.
        contacts: contacts of ``state`` with walls.
        fraction: fraction of the speed that gravity gives in one frame, below which a node keeps its position.
        dt: frame interval [s].
    """
    is_supported = supported(contacts, state.gravity)
    stays = keeps_position(state.vel, new.vel, contacts.island, is_supported, fraction * dt * state.gravity.norm())
    stays = all_of_bodies(stays, state.rigid_body)[:, None]
    new = new.corrected(torch.where(stays, state.pos, new.pos), torch.where(stays, 0.0, new.vel))
    return new if new.frame_velocity is None else replace(new, frame_velocity=torch.where(stays, 0.0, new.frame_velocity))


def advanced(state: State, acc: Tensor, dt: float) -> State:
    """Return the state one frame later under an acceleration [node, dim] in m/s² that includes gravity; ``dt`` is the frame interval [s]."""
    return moved_rigidly(state, state.later(dt, *integrators.advance(state.pos, state.vel, acc, dt)), dt)


def accelerations(states: list[State], rows: Sequence[Rows], predicted: dict[str, Tensor], unit: Tensor) -> list[Tensor]:
    """Return the accelerations [node, dim] of each state in m/s², including gravity; arguments as in ``moved``."""
    acc = [state.gravity.expand_as(state.pos).clone() for state in states]
    for scene, own, part in per_scene(predicted, rows):
        acc[scene][own] += part.double() * unit
    return acc


def with_frame_velocity(states: list[State], rows: Sequence[Rows], predicted: dict[str, Tensor], dt: float) -> list[State]:
    """Return states with the field ``frame_velocity``, if a model predicts velocities at the frame.

    Nodes without a prediction, and those whose motion is given, get their mean velocity.

    Args:
        states: the states one frame later, as ``moved`` returns them.
        rows: rows of the nodes of each material in each state.
        predicted: velocities at the frame for the batch, by material [node, dim] in m/frame.
        dt: frame interval [s].
    """
    if not predicted:
        return states
    at_frame = [state.vel.clone() for state in states]
    for scene, own, part in per_scene(predicted, rows):
        at_frame[scene] = at_frame[scene].index_copy(0, own, part.double() / dt)
    kept = [v if s.loads is None else s.loads.at_prescribed(s.vel, v) for s, v in zip(states, at_frame, strict=True)]
    return [replace(state, frame_velocity=velocity) for state, velocity in zip(states, kept, strict=True)]


def with_stress(states: list[State], rows: Sequence[Rows], predicted: dict[str, Tensor], unit: Tensor, components: int) -> list[State]:
    """Return states with the stresses that a model predicts, also in their cells if they have some.

    Args:
        states: the states one frame later, as ``moved`` returns them.
        rows: rows of the nodes of each material in each state.
        predicted: stresses for the batch, by material [node, component].
        unit: unit of these stresses [Pa].
        components: number of components of a stress.
    """
    node = [state.pos.new_zeros(state.num_nodes, components) for state in states]
    compiled = works_on_all(states, predicted)
    for scene, own, part in per_scene(predicted, rows):
        if compiled:
            _add(part.contiguous().numpy(), own.numpy(), float(unit), node[scene].numpy())
        else:
            node[scene][own] = part.double() * unit
    means = _mean_over_corners if compiled else mean_over_corners
    return [
        replace(state, stress=Stress(n, n.new_empty(0, components) if state.cells is None else means(n, state.cells)))
        for state, n in zip(states, node, strict=True)
    ]


def rows_of(graph: HeteroData) -> Rows:
    """Return the rows of the nodes of each material in the state of a graph."""
    return {name: store["node_id"] for name, store in contents(graph)[0].items() if "node_id" in store}


def per_scene(predicted: dict[str, Tensor], rows: Sequence[Rows]) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield the predictions for a batch, split by scene, as (number of the scene, rows of its state, values of these rows)."""
    for material, values in predicted.items():
        own = [of_scene[material] for of_scene in rows]
        if len(own) == 1:
            yield 0, own[0], values
            continue
        for scene, part in enumerate(values.split([r.shape[0] for r in own])):
            yield scene, own[scene], part


@njit(cache=True, error_model="numpy")
@no_type_check
def _keep_slow(old_pos, old_vel, island, is_pushed, gravity, at, normal, friction, duration, pos, vel, history, at_frame):
    strength = np.sqrt((gravity * gravity).sum())
    speed, rests = duration * strength, np.zeros(len(is_pushed), np.bool_)
    for e in range(len(at)):  # whether the wall bears, as in ``static_friction.bears``
        along = 0.0
        for a in range(len(gravity)):
            along -= normal[e, a] * gravity[a]
        if along > (1 - LEVEL) * strength / np.sqrt(1.0 + min(friction[e], STICKY) ** 2):
            rests[at[e]] = True
    for n in range(pos.shape[0]):
        before, after = 0.0, 0.0
        for a in range(pos.shape[1]):
            before += old_vel[n, a] ** 2
            after += vel[n, a] ** 2
        if not (rests[island[n]] and not is_pushed[island[n]] and before < speed**2 and after < speed**2):
            continue
        for a in range(pos.shape[1]):
            pos[n, a] = old_pos[n, a]
            vel[n, a] = 0.0
            history[n, history.shape[1] - 1, a] = 0.0
            at_frame[n, a] = 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _add(values, rows, unit, total):
    """Add values [row, channel] times a unit to the rows of the total."""
    for k in range(rows.shape[0]):
        for c in range(values.shape[1]):
            total[rows[k], c] += np.float64(values[k, c]) * unit


def _mean_over_corners(values: Tensor, cells: Tensor) -> Tensor:
    """Return ``cells.mean_over_corners`` of values [node, channel]."""
    mean = values.new_empty(cells.shape[0], values.shape[1])
    _write_means(values.numpy(), cells.contiguous().numpy(), mean.numpy())
    return mean


@njit(cache=True, error_model="numpy")
@no_type_check
def _write_means(values, cells, mean):
    for k in range(cells.shape[0]):
        corners = 1
        for c in range(values.shape[1]):
            mean[k, c] = values[cells[k, 0], c]
        for corner in range(1, cells.shape[1]):
            if cells[k, corner] == cells[k, corner - 1]:  # repeats the last corner
                continue
            corners += 1
            for c in range(values.shape[1]):
                mean[k, c] += values[cells[k, corner], c]
        for c in range(values.shape[1]):
            mean[k, c] /= corners
