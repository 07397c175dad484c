"""Contacts of the islands of scenes with walls, from topologies or from graphs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.features import boundary_values
from gpe_pl.graphs.topology import Topology
from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.schema import BOUNDARY, FeatureSpec
from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.state import State


def of_topology(state: State, topology: Topology, dt: float) -> WallContacts:
    """Return the contacts of a state on the CPU whose walls are at rest, in the frame of ``dt`` [s] that begins with it."""
    assert topology.islands is not None
    boundary, label = state.boundary, topology.islands.label
    at, walls = [label[:0]], [label[:0]]
    for relation, (j, i) in topology.edges.items():
        if relation[0] == BOUNDARY:
            at.append(label[topology.rows[relation[2]]][i])
            walls.append(j if topology.boundary_rows is None else topology.boundary_rows[j])
    wall = torch.cat(walls)
    normal, friction = torch.as_tensor(boundary.normal)[wall], torch.as_tensor(boundary.friction)[wall]
    others = _others(state, label, len(topology.islands.is_held), dt)
    return WallContacts(label, *others, torch.cat(at), normal, friction, torch.zeros_like(wall, dtype=torch.bool))


def of_graph(state: State, graph: HeteroData, spec: FeatureSpec, dt: float) -> WallContacts:
    """Return the contacts of a state, given its graph, whose features are not standardised, and whose boundary nodes have a boundary condition."""
    island = torch.empty(state.num_nodes, dtype=torch.int64, device=state.pos.device)
    for material in spec.materials:
        island[graph[material].node_id] = graph[material].island
    vel, normal, friction = boundary_values(graph[BOUNDARY].x, spec.dim)
    edges = [(graph[relation].edge_index, graph[relation[2]].island) for relation in spec.relations if relation[0] == BOUNDARY]
    at = torch.cat([island[:0], *(of_node[i] for (_, i), of_node in edges)])
    wall = torch.cat([island[:0], *(j for (j, _), _ in edges)])
    others = _others(state, island, graph.island_is_held.shape[0], dt)
    return WallContacts(island, *others, at, normal[wall], friction[wall], (vel != 0).any(dim=1)[wall])


class _Others(NamedTuple):
    others_act: Tensor
    is_pushed: Tensor


def _others(state: State, island: Tensor, count: int, dt: float) -> _Others:
    """Return masks of the islands on which forces, given motion or openings act, and of those that given motion or openings move in the present frame."""
    nothing = torch.zeros(count, dtype=torch.bool, device=island.device)
    if not state.openings and state.loads is None:
        return _Others(nothing, nothing)
    pos, is_moved = as_numpy(state.pos), np.zeros(state.num_nodes, bool)
    for opening in state.openings:
        if opening.drives and opening.mean_velocity(state.time, state.time + dt).any():
            is_moved |= opening.contains(pos)
    acted_on = carried(state.openings, pos)
    if (loads := state.loads) is not None:
        is_moved[loads.rows] |= (loads.next_positions() != loads.path[0]).any(axis=1)
        acted_on[loads.rows] = True
        if loads.force is not None:
            acted_on |= (loads.force[0] != 0).any(axis=1)

    def islands(of_node: np.ndarray) -> Tensor:
        return nothing.index_fill(0, island[torch.from_numpy(np.flatnonzero(of_node)).to(island.device)], True)

    return _Others(islands(acted_on), islands(is_moved))
