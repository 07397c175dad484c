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
    was, pos = as_numpy(before.pos), as_numpy(new.pos)
    leaves = np.any([opening.removes(was, pos, before.time, after.time) for opening in after.openings], axis=0)
    known: dict[str, Any] = {name: getattr(after, name) for name in ("num_substeps", "num_corrected", "num_asleep", "lost_impulse")}
    if leaves.any():
        new, rows = replace(new.take(np.flatnonzero(~leaves)), **known), rows[~leaves]
    for opening in after.openings:
        if len(own := opening.entering(before.time, after.time)):
            entered = _entered(new, opening, own, before.time, after.time)
            new = replace(State.joined([new, entered]), next_id=new.next_id + len(own), **known)
            rows = np.append(rows, np.full(len(own), -1))
    return replace(new, internal=after.internal.of_rows(rows)) if isinstance(after.internal, FollowsNodes) else new


def _prescribed(before: State, after: State) -> tuple[State, np.ndarray]:
    """Return the state in which nodes of openings with a speed have moved with it, and the row of each node [node], −1 for these nodes.

    Their velocity is the mean one over the frame if the state has a velocity history, else that at the frame.
    """
    start, pos, vel = as_numpy(before.pos), np.array(as_numpy(after.pos)), np.array(as_numpy(after.vel))
    moved, at_frame = np.zeros(len(start), bool), None if after.frame_velocity is None else np.array(as_numpy(after.frame_velocity))
    for opening in after.openings:
        if opening.drives:
            inside, mean, now = opening.contains(start), opening.mean_velocity(before.time, after.time), opening.velocity_at(after.time)
            pos[inside], vel[inside] = start[inside] + (after.time - before.time) * mean, now if after.velocity_history is None else mean
            moved |= inside
            if at_frame is not None:
                at_frame[inside] = now
    rows = np.where(moved, -1, np.arange(len(moved)))
    if not moved.any():
        return after, rows
    new = after.corrected(_like(after.pos, pos), _like(after.vel, vel))
    return new if at_frame is None else replace(new, frame_velocity=_like(after.vel, at_frame)), rows


def _entered(state: State, opening: Opening, pos: np.ndarray, start: float, end: float) -> State:
    """Return new nodes of an opening at ``pos`` [node, dim] as a state with the fields of another one. They entered between two times [s].

    Their velocity is that of other nodes of the opening (see ``_prescribed``), and they had it all the time before.
    """
    count, at_end = len(pos), np.tile(opening.velocity_at(end), (len(pos), 1))
    velocity = at_end if state.velocity_history is None else np.tile(opening.mean_velocity(start, end), (count, 1))
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
        values["frame_velocity"] = at_end
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
