"""What openings do after each step of an open scene: they move their nodes, remove nodes that leave, and add nodes that enter.

The time loop calls ``through_openings`` for every simulator. Simulators therefore see the nodes that are in the scene, and no others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.trajectory.boundary import Array, as_numpy
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State


@runtime_checkable
class FollowsNodes(Protocol):
    """``State.internal`` of a simulator that goes on in open scenes. Another one is lost when nodes enter or leave."""

    def of_rows(self, rows: np.ndarray) -> Any:
        """Return the internal state of other nodes: those in these rows [node]; −1 stands for a node at rest that is new or moves with an opening."""
        ...


def through_openings(before: State, after: State) -> State:
    """Return the state after a step, with the nodes that are in the scene now.

    Args:
        before: state before the step.
        after: state that a simulator made of it, with the same nodes.
    """
    new, rows = _prescribed(before, after)
    pos = as_numpy(new.pos)
    leaves = np.any([opening.removes(pos) for opening in after.openings], axis=0)
    known: dict[str, Any] = {name: getattr(after, name) for name in ("num_substeps", "num_corrected", "num_asleep", "lost_impulse")}
    if leaves.any():
        new, rows = replace(new.take(np.flatnonzero(~leaves)), **known), rows[~leaves]
    for opening in after.openings:
        if len(own := opening.entering(before.time, after.time)):
            new = replace(State.joined([new, _entered(new, opening, own)]), next_id=new.next_id + len(own), **known)
            rows = np.append(rows, np.full(len(own), -1))
    return replace(new, internal=after.internal.of_rows(rows)) if isinstance(after.internal, FollowsNodes) else new


def _prescribed(before: State, after: State) -> tuple[State, np.ndarray]:
    """Return the state in which nodes of openings with a speed have moved with it, and the row of each node [node], −1 for these nodes."""
    start, pos, vel = as_numpy(before.pos), np.array(as_numpy(after.pos)), np.array(as_numpy(after.vel))
    moved = np.zeros(len(start), bool)
    for opening in after.openings:
        if opening.speed is not None:
            inside = opening.contains(start)
            pos[inside], vel[inside] = start[inside] + (after.time - before.time) * opening.velocity, opening.velocity
            moved |= inside
    rows = np.where(moved, -1, np.arange(len(moved)))
    if not moved.any():
        return after, rows
    new = after.corrected(_like(after.pos, pos), _like(after.vel, vel))
    if new.frame_velocity is None:
        return new, rows
    at_frame = np.where(moved[:, None], vel, as_numpy(after.frame_velocity))
    return replace(new, frame_velocity=_like(after.vel, at_frame)), rows


def _entered(state: State, opening: Opening, pos: np.ndarray) -> State:
    """Return new nodes of an opening at ``pos`` [node, dim] as a state with the fields of another one."""
    count, velocity = len(pos), np.tile(opening.velocity, (len(pos), 1))
    params = [np.nan if value is None else value for value in opening.params]
    values: dict[str, Any] = {
        "pos": pos,
        "vel": velocity,
        "node_type": np.full(count, opening.node_type),
        "mass": np.full(count, opening.mass),
        "material_params": np.tile(params, (count, 1)),
        "node_id": state.next_id + np.arange(count),
    }
    if state.velocity_history is not None:
        values["velocity_history"] = np.repeat(velocity[:, None], state.velocity_history.shape[1], axis=1)
    if state.frame_velocity is not None:
        values["frame_velocity"] = velocity
    if state.rest_pos is not None:
        values["rest_pos"] = pos
    if state.rigid_body is not None:
        values["rigid_body"] = np.full(count, -1)
    arrays = {name: _like(getattr(state, name), array) for name, array in values.items()}
    return replace(state, **arrays, cells=None if state.cells is None else state.cells[:0])


def _like(array: Array, values: np.ndarray) -> Array:
    """Return values as an array of the type, and on the device, of another."""
    xp = array_namespace(array)
    return xp.astype(xp.asarray(values, device=device(array)), array.dtype)
