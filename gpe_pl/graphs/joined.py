"""The batch of the graphs of several scenes in one pass of the compiled features, without a graph for each scene.

The scenes become one large scene: their nodes, boundary nodes, edges and islands are renumbered and joined. The result equals ``batching.batched`` of the
graphs of the scenes, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.compiled_graph import CompiledGraph, Scenes, works_on
from gpe_pl.graphs.topology import IslandTopology, Topology
from gpe_pl.nn.stores import contents
from gpe_pl.schema import BOUNDARY, EdgeType, FeatureSpec
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

OF_BOUNDARY = ("pos", "vel", "normal", "friction", "restitution")
UNUSED = ("cells", "rest_pos", "frame_velocity", "loads", "rigid_body", "node_id")
"""Fields of states that features of joined scenes do not read. Some scenes may have them and others not."""


def covers(topologies: Sequence[Topology], states: Sequence[State], spec: FeatureSpec) -> bool:
    """Tell whether ``joined_graph`` can make the batch of these scenes: they have no meshes and no loads, read no stress, and have one periodicity."""
    if (
        spec.cells
        or spec.loads
        or spec.reads_stress
        or any(t.mesh is not None or t.periodicity != topologies[0].periodicity for t in topologies)
    ):
        return False
    return all(map(works_on, states))


def joined_graph(compiled: CompiledGraph, topologies: Sequence[Topology], states: Sequence[State]) -> HeteroData:
    """Return the batch of the graphs of several states.

    Args:
        compiled: computes features.
        topologies: topologies of the states.
        states: states that ``covers`` accepts.
    """
    num_nodes, num_boundary = [s.num_nodes for s in states], [s.boundary.pos.shape[0] for s in states]
    trimmed = [t.boundary_rows for t in topologies]
    counts = {m: [t.rows[m].shape[0] for t in topologies] for m in topologies[0].rows}
    counts[BOUNDARY] = [n if rows is None else rows.shape[0] for n, rows in zip(num_boundary, trimmed, strict=True)]
    starts = {t: np.array([0, *accumulate(own)]) for t, own in counts.items()}
    boundary_rows = None
    if any(rows is not None for rows in trimmed):
        boundary_rows = _shifted(
            [torch.arange(n) if rows is None else rows for n, rows in zip(num_boundary, trimmed, strict=True)], num_boundary
        )
    islands = [t.islands for t in topologies if t.islands is not None]
    topology = Topology(
        {m: _shifted([t.rows[m] for t in topologies], num_nodes) for m in topologies[0].rows},
        _joined_edges(topologies, starts),
        boundary_rows,
        None,
        _joined_islands(islands) if islands else None,
        topologies[0].periodicity,
    )
    gravity = np.stack([s.gravity.detach().numpy() for s in states])
    data = compiled(topology, _joined_state(states), Scenes(gravity, starts))
    nodes, _ = contents(data)
    for node_type, store in nodes.items():
        own = counts.get(node_type, [0] * len(states))
        store["batch"] = torch.from_numpy(np.repeat(np.arange(len(states)), own))
        if node_type in topology.rows:
            store["node_id"] = torch.cat([t.rows[node_type] for t in topologies])
            if islands:
                store["island"] = torch.cat([i.label[t.rows[node_type]] for i, t in zip(islands, topologies, strict=True)])
    if islands:
        data.num_islands = torch.tensor([len(i.is_held) for i in islands])
        if compiled.spec.meshes:
            data.num_bodies = torch.tensor([i.num_bodies for i in islands])
    return data


def _joined_state(states: Sequence[State]) -> State:
    walls: dict[str, Any] = {name: torch.cat([getattr(s.boundary, name) for s in states]) for name in OF_BOUNDARY}
    unused: dict[str, Any] = dict.fromkeys(UNUSED)
    nodes = State.joined([replace(s, **unused) for s in states])
    return replace(nodes, boundary=Boundary(**walls))


def _joined_edges(topologies: Sequence[Topology], starts: dict[str, np.ndarray]) -> dict[EdgeType, Tensor]:
    joined: dict[EdgeType, Tensor] = {}
    for relation in dict.fromkeys(r for t in topologies for r in t.edges):
        first = torch.from_numpy(np.stack([starts[relation[0]], starts[relation[2]]]))
        parts = [t.edges[relation] + first[:, k, None] for k, t in enumerate(topologies) if relation in t.edges]
        joined[relation] = torch.cat(parts, dim=1)
    return joined


def _joined_islands(islands: Sequence[IslandTopology]) -> IslandTopology:
    label = _shifted([i.label for i in islands], [len(i.is_held) for i in islands])
    body = {m: torch.cat([i.body[m] for i in islands]) for m in islands[0].body}
    arms = [i.arm for i in islands if i.arm is not None]
    body_arms = [i.body_arm for i in islands if i.body_arm is not None]
    body_arm = {m: torch.cat([own[m] for own in body_arms]) for m in body_arms[0]} if body_arms else None
    return IslandTopology(label, torch.cat([i.is_held for i in islands]), body, 0, torch.cat(arms) if arms else None, body_arm)


def _shifted(parts: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
    """Return indices of several scenes as indices of one, in which the rows of a scene follow those of the scenes before it."""
    return torch.cat([part + start for part, start in zip(parts, accumulate(sizes, initial=0), strict=False)])
