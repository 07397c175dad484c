"""Mean velocities over the frames before a start, for scenes without earlier frames.

A state without history has velocities at one instant, and models read means over frames. In free flight the mean over the frame that ends at the start differs
from the velocity there by half of what gravity changes in a frame. A start that ignored this would be half a frame ahead for the whole flight.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.islands import Islands, islands_within
from gpe_pl.graphs.search import walls_of
from gpe_pl.trajectory.cells import cell_edges
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.rigid_bodies import bodies_of
from gpe_pl.trajectory.state import State


def islands_of(state: State, radius: float) -> Islands:
    """Return the islands of a state of tensors: nodes within the radius [m] of each other, in a common cell or of one rigid body."""
    pos = np.ascontiguousarray(state.pos.detach().cpu().numpy())
    cells = np.empty((0, 2), np.int64) if state.cells is None else state.cells.cpu().numpy()
    edges = np.concatenate([cell_edges(cells, len(pos)), _rigid_edges(state)], axis=1)
    return islands_within(radius, pos, walls_of(state, radius), edges, state.periodicity)


def _rigid_edges(state: State) -> np.ndarray:
    """Return pairs of nodes [2, edge] that make each rigid body one island, also where its parts are farther apart than the radius."""
    bodies = [] if state.rigid_body is None else bodies_of(state.rigid_body.cpu())
    pairs = [np.stack([rows[:-1], rows[1:]]) for rows in map(np.asarray, bodies)]
    return np.concatenate([np.empty((2, 0), np.int64), *pairs], axis=1)


def history_at_start(state: State, builder: GraphBuilder) -> Tensor:
    """Return the velocity history of a state without earlier frames [node, history, dim] in m/s, oldest first.

    Nodes of islands that touch no wall, and that no given motion and no opening moves, have flown freely. Others have had their present velocity. So have all
    nodes for models with the elastic law, which starts from velocities at the instant.

    Args:
        state: state of tensors, with velocities at its instant.
        builder: graph builder of the model.
    """
    count = builder.config.history
    if builder.config.cells:
        return state.vel[:, None].repeat(1, count, 1)
    islands = islands_of(state, builder.scales.radius)
    is_free = islands.is_free.copy()
    if state.loads is not None:
        is_free[islands.label[state.loads.rows]] = False
    is_free[islands.label[carried(state.openings, state.pos.detach().cpu().numpy())]] = False
    flies = torch.from_numpy(is_free[islands.label]).to(state.vel.device)
    age = torch.arange(count, 0, -1, dtype=state.vel.dtype, device=state.vel.device) - 0.5
    fallen = flies[:, None, None] * (age * builder.metadata.frame_dt)[:, None] * state.gravity.to(state.vel)
    return state.vel[:, None] - fallen
