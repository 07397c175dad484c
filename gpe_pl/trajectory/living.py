"""Arrays of open scenes: a trajectory has a column for every node that is ever in the scene, and a state has the nodes that are in it now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State


def living(
    state: State, alive: Bool[np.ndarray, "frame node"], vel: Float[np.ndarray, "frame node dim"], openings: Sequence[Opening]
) -> State:
    """Return the nodes of a state that are in the scene in the last frame of ``alive``, with the openings and with their columns as identities.

    Before a node entered, its velocity history has the velocity with which it entered.

    Args:
        state: state of all columns of a trajectory.
        alive: mask of the frames from the first one up to that of the state.
        vel: velocities at these frames [m/s].
        openings: inlets and outlets.
    """
    if state.velocity_history is not None:
        window = alive[-1 - state.velocity_history.shape[1] :]
        entered = len(alive) - len(window) + window.argmax(axis=0)  # frame in which a node entered, or the first of the window
        entry = vel[entered, np.arange(state.num_nodes)].astype(np.float64)
        past = np.where(window[:-1].T[:, :, None], state.velocity_history, entry[:, None])
        state = replace(state, velocity_history=past, vel=past[:, -1])
    nodes = np.flatnonzero(alive[-1])
    known = np.flatnonzero(alive.any(axis=0))
    return replace(state.take(nodes), openings=tuple(openings), node_id=nodes, next_id=int(known[-1]) + 1 if len(known) else 0)


def columns(
    ids: Sequence[Int[np.ndarray, " _"]], frames: Sequence[np.ndarray]
) -> tuple[np.ndarray, Bool[np.ndarray, "frame node"], Int[np.ndarray, " node"]]:
    """Return values by column [frame, node, …], the mask of the columns that are in the scene [frame, node], and the identity of each column [node].

    Where a node is not in the scene, its value is that of the nearest frame in which it is.

    Args:
        ids: identities of the nodes in each frame.
        frames: values of these nodes in each frame [node, …].
    """
    known = np.unique(np.concatenate(ids))
    alive = np.zeros((len(ids), len(known)), bool)
    values = np.zeros((len(ids), len(known), *frames[0].shape[1:]), frames[0].dtype)
    for frame, (own, rows) in enumerate(zip(ids, frames, strict=True)):
        place = np.searchsorted(known, own)
        alive[frame, place], values[frame, place] = True, rows
    return held(values, alive), alive, known


def order_of_entry(
    alive: Bool[np.ndarray, "frame node"], pos: Float[np.ndarray, "frame node dim"], stride: int, openings: Sequence[Opening]
) -> Int[np.ndarray, " node"]:
    """Return the numbers of the columns of a trajectory in the order in which a rollout with ``stride`` times longer frames numbers the nodes.

    In each frame, nodes of the first inlet enter before those of the second.

    Args:
        alive, pos: frames of the trajectory.
        stride: number of its frames in a longer one.
        openings: its inlets and outlets. Inlets do not overlap.
    """
    count = alive.shape[1]
    first = alive.argmax(axis=0)
    entry = pos[first, np.arange(count)]
    inlet = np.zeros(count, np.int64)
    for number, opening in enumerate(openings):
        inlet[opening.contains(entry) & (first > 0)] = number
    return np.lexsort((np.arange(count), inlet, -(-first // stride)))


def held(values: np.ndarray, alive: Bool[np.ndarray, "frame node"]) -> np.ndarray:
    """Return values [frame, node, …] in which a node that is not in the scene has the value of the nearest frame in which it is."""
    first, last = alive.argmax(axis=0), len(alive) - 1 - alive[::-1].argmax(axis=0)
    nearest = np.clip(np.arange(len(alive))[:, None], first, last)
    return np.asarray(values[nearest, np.arange(values.shape[1])])
