"""``State`` → ``HeteroData``: the same function in training and in rollout.

Every graph of a data set carries all its node and edge stores, empty where a frame has none, because PyG's ``Batch`` numbers edges wrongly when a store
is missing from some graphs. Each undirected edge is stored once. There are no edges between boundary nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.graphs.features import (
    GraphConfig,
    Scales,
    boundary_features,
    edge_features,
    feature_spec,
    history_of,
    material_features,
    scales_of,
)
from gpe_pl.graphs.neighbors import radius_between, radius_pairs
from gpe_pl.schema import BOUNDARY, MATERIALS, NODE_TYPES, FeatureSpec, node_code
from gpe_pl.trajectory import Metadata, State


class GraphError(GpeError, ValueError):
    """A state does not fit the data set whose graphs are built; the message says how."""


@dataclass(frozen=True)
class GraphBuilder:
    """Builds the graph of a state.

    Node stores of a material hold ``x``, ``material_params`` (SI), ``mass`` and ``node_id`` (row in the state); ``boundary`` holds ``x``. Edge stores
    hold ``edge_index`` (row 0 source, row 1 target), ``odd`` and ``even``.
    """

    config: GraphConfig
    metadata: Metadata

    def __post_init__(self) -> None:
        if any(self.metadata.periodic):
            raise GraphError(f"data set {self.metadata.dataset!r} has periodic axes, which the graph builder does not support")

    @property
    def scales(self) -> Scales:
        return scales_of(self.config, self.metadata)

    @property
    def spec(self) -> FeatureSpec:
        return feature_spec(self.config, self.metadata)

    def __call__(self, state: State) -> HeteroData:
        """Build the graph of a state of float64 tensors.

        Raises:
            GraphError: the state holds a node type that the data set does not have, or lacks velocity history.
        """
        scales, spec = self.scales, self.spec
        history = history_of(state)
        if history.shape[1] != self.config.history:
            raise GraphError(f"state has a history of {history.shape[1]} velocities, the graph needs {self.config.history}")
        rows = {m: self._rows(state, m) for m in spec.materials}
        if sum(len(r) for r in rows.values()) != state.num_nodes:
            present = {NODE_TYPES[code] for code in state.node_type.unique().tolist()}
            unknown, known = ", ".join(sorted(present - {*spec.materials})), ", ".join(spec.materials)
            raise GraphError(f"state has nodes of {unknown}; the data set {self.metadata.dataset!r} has {known}")

        pos = {m: state.pos[r] for m, r in rows.items()}
        vel = {m: state.vel[r] for m, r in rows.items()}
        pos[BOUNDARY], vel[BOUNDARY] = state.boundary.pos, state.boundary.vel
        numpy_pos = {t: np.ascontiguousarray(p.detach().cpu().numpy()) for t, p in pos.items()}

        edges: dict[tuple[str, str, str], Tensor] = {}
        for relation in spec.relations:
            source, _, target = relation
            if source == target:
                pairs = radius_pairs(numpy_pos[source], scales.radius)
            else:
                pairs = radius_between(numpy_pos[source], numpy_pos[target], scales.radius)
            edges[relation] = torch.from_numpy(pairs).to(state.pos.device)

        boundary_x, normal = boundary_features(state.boundary, scales), state.boundary.normal
        if self.config.trim_boundary:
            kept = self._trim(edges, boundary_x.shape[0])
            boundary_x, normal = boundary_x[kept], normal[kept]
            pos[BOUNDARY], vel[BOUNDARY] = pos[BOUNDARY][kept], vel[BOUNDARY][kept]

        data = HeteroData()
        for material, r in rows.items():
            store = data[material]
            store.x = material_features(history[r], state.gravity, scales)
            column = self.metadata.param_names.index(MATERIALS[material].name)
            store.material_params = state.material_params[r, column : column + 1].float()
            store.mass = state.mass[r].float()
            store.node_id = r
        data[BOUNDARY].x = boundary_x
        for relation, edge_index in edges.items():
            source, _, target = relation
            j, i = edge_index
            store = data[relation]
            store.edge_index = edge_index
            store.odd, store.even = edge_features(
                self.config.features,
                pos[target][i] - pos[source][j],
                vel[target][i] - vel[source][j],
                normal[j] if source == BOUNDARY else None,
                scales,
            )
        return data

    def _rows(self, state: State, material: str) -> Tensor:
        if len(self.metadata.materials) == 1 and bool((state.node_type == node_code(material)).all()):
            return torch.arange(state.num_nodes, device=state.pos.device)
        return torch.nonzero(state.node_type == node_code(material)).flatten()

    @staticmethod
    def _trim(edges: dict[tuple[str, str, str], Tensor], num_boundary: int) -> Tensor:
        """Keep the boundary nodes that have an edge, in order, and renumber the edges in place; returns the kept rows."""
        sources = [e[0] for (s, _, _), e in edges.items() if s == BOUNDARY]
        device = sources[0].device
        used = torch.zeros(num_boundary, dtype=torch.bool, device=device)
        for s in sources:
            used[s] = True
        kept = torch.nonzero(used).flatten()
        new_row = torch.cumsum(used, dim=0) - 1
        for relation, edge_index in edges.items():
            if relation[0] == BOUNDARY:
                edges[relation] = torch.stack([new_row[edge_index[0]], edge_index[1]])
        return kept
