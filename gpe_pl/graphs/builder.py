"""``State`` → ``HeteroData``: the same function in training and in rollout.

Every graph of a data set carries all its node and edge stores, empty where a frame has none, because PyG's ``Batch`` numbers edges wrongly when a store
is missing from some graphs. Each undirected edge is stored once. There are no edges between boundary nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

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
    mesh_features,
    scales_of,
    virtual_features,
)
from gpe_pl.graphs.islands import islands_within
from gpe_pl.graphs.multiscale import MultiscaleGraph, multiscale_graph
from gpe_pl.graphs.neighbors import check_crowding, radius_between, radius_pairs
from gpe_pl.rollout import SimulationError
from gpe_pl.schema import BOUNDARY, CELL, DOWN, MATERIALS, NODE_TYPES, RADIUS, SAME, EdgeType, FeatureSpec, grid, level_of, node_code
from gpe_pl.trajectory import Metadata, State


class GraphError(GpeError, ValueError):
    """A state does not fit the data set whose graphs are built; the message says how."""


@dataclass(frozen=True)
class GraphBuilder:
    """Builds the graph of a state.

    Node stores of a material hold ``x``, ``material_params`` (SI), ``mass`` and ``node_id`` (row in the state); ``boundary`` and virtual nodes hold ``x``.
    Edge stores hold ``edge_index`` (row 0 source, row 1 target), ``odd`` and ``even``. Those of ``radius`` also hold
    ``offset``: the displacement over the radius, which standardisation leaves as it is.

    With ``config.islands``, nodes of materials also have ``pos`` [m] and ``island``, and the graph ``island_is_free`` [island] and ``num_islands`` [1].
    """

    config: GraphConfig
    metadata: Metadata

    def __post_init__(self) -> None:
        if any(self.metadata.periodic):
            raise GraphError(f"data set {self.metadata.dataset!r} has periodic axes, which the graph builder does not support")

    @cached_property
    def scales(self) -> Scales:
        return scales_of(self.config, self.metadata)

    @cached_property
    def spec(self) -> FeatureSpec:
        return feature_spec(self.config, self.metadata)

    def __call__(self, state: State) -> HeteroData:
        """Build the graph of a state of float64 tensors.

        Raises:
            GraphError: the state holds a node type that the data set does not have, lacks velocity history, or has cells that do not fit its nodes.
            SimulationError: a position or velocity is not finite, or so many nodes lie within each other's radius that the material has collapsed.
        """
        if state.pos.dtype != torch.float64:
            raise GraphError(f"positions are {state.pos.dtype}; convert the state with State.to_torch, which makes them float64")
        history = history_of(state)
        if history.shape[1] != self.config.history:
            raise GraphError(f"state has a history of {history.shape[1]} velocities, the graph needs {self.config.history}")
        bad = ~torch.isfinite(torch.cat([state.pos, history.flatten(1)], dim=1)).all(dim=1)
        if bad.any():
            node = int(bad.nonzero()[0])
            raise SimulationError(f"node {node} has a position or velocity that is not finite", reason="nan", node=node)
        check_crowding(state.pos.cpu().numpy(), self.scales.radius, self.scales.spacing)
        rows = {m: self._rows(state, m) for m in self.spec.materials}
        if sum(len(r) for r in rows.values()) != state.num_nodes:
            present = {NODE_TYPES[code] for code in state.node_type.unique().tolist()}
            unknown, known = ", ".join(sorted(present - {*self.spec.materials})), ", ".join(self.spec.materials)
            raise GraphError(f"state has nodes of {unknown}; the data set {self.metadata.dataset!r} has {known}")
        mesh = self._mesh(state) if self._meshes else None

        data = HeteroData()
        for material, r in rows.items():
            store = data[material]
            store.x = material_features(history[r], state.gravity, self.scales)
            column = self.metadata.param_names.index(MATERIALS[material].name)
            store.material_params = state.material_params[r, column : column + 1].float()
            store.mass = state.mass[r].float()
            store.node_id = r
        self._add_boundary(data, state, rows, mesh)
        if mesh is not None:
            self._add_mesh(data, state, rows, mesh)
        elif self._meshes:
            self._add_empty_mesh(data, state)
        if self.config.islands:
            self._add_islands(data, state, rows)
        return data

    @cached_property
    def _meshes(self) -> tuple[str, ...]:
        """Materials that are connected along their cells."""
        return tuple(source for source, name, _ in self.spec.relations if name == CELL)

    def _rows(self, state: State, material: str) -> Tensor:
        if len(self.metadata.materials) == 1 and bool((state.node_type == node_code(material)).all()):
            return torch.arange(state.num_nodes, device=state.pos.device)
        return torch.nonzero(state.node_type == node_code(material)).flatten()

    # --- edges within a radius ------------------------------------------------------------------------------------------------------------

    def _add_boundary(self, data: HeteroData, state: State, rows: dict[str, Tensor], mesh: MultiscaleGraph | None) -> None:
        """Boundary nodes, and the edges that the radius decides."""
        pos = {m: state.pos[r] for m, r in rows.items()} | {BOUNDARY: state.boundary.pos}
        vel = {m: state.vel[r] for m, r in rows.items()} | {BOUNDARY: state.boundary.vel}
        numpy_pos = {t: np.ascontiguousarray(p.detach().cpu().numpy()) for t, p in pos.items()}
        edges: dict[EdgeType, Tensor] = {}
        for relation in self.spec.relations:
            source, name, target = relation
            if name != RADIUS:
                continue
            if source != target:
                pairs = radius_between(numpy_pos[source], numpy_pos[target], self.scales.radius)
            else:
                pairs = radius_pairs(numpy_pos[source], self.scales.radius)
                if mesh is not None and source in self._meshes:
                    pairs = pairs[:, mesh.are_in_contact(rows[source].cpu().numpy()[pairs], self.scales.radius)]
            edges[relation] = torch.from_numpy(pairs).to(state.pos.device)

        boundary_x, normal = boundary_features(state.boundary, self.scales), state.boundary.normal
        if self.config.trim_boundary:
            kept = self._trim(edges, boundary_x.shape[0])
            boundary_x, normal = boundary_x[kept], normal[kept]
            pos[BOUNDARY], vel[BOUNDARY] = pos[BOUNDARY][kept], vel[BOUNDARY][kept]
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
                self.scales,
            )
            store.offset = store.odd[:, : self.spec.dim]

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

    def _add_islands(self, data: HeteroData, state: State, rows: dict[str, Tensor]) -> None:
        """Groups of nodes that the graph connects, and which of them no edge ties to the boundary.

        What pushes a body from beyond the radius no model can see; held to free fall, it stays stable (docs/results/trials).
        """
        cells = [torch.empty(2, 0, dtype=torch.int64), *(rows[m][data[m, CELL, m].edge_index].cpu() for m in self._meshes)]
        pos, boundary = (np.ascontiguousarray(p.cpu().numpy()) for p in (state.pos, state.boundary.pos))
        islands = islands_within(self.scales.radius, pos, boundary, torch.cat(cells, dim=1).numpy())
        label = torch.from_numpy(islands.label).to(state.pos.device)
        for material, r in rows.items():
            data[material].pos = state.pos[r].float()
            data[material].island = label[r]
        data.island_is_free = torch.from_numpy(islands.is_free).to(state.pos.device)
        data.num_islands = torch.tensor([len(islands.is_free)], device=state.pos.device)

    # --- meshes ---------------------------------------------------------------------------------------------------------------------------

    def _mesh(self, state: State) -> MultiscaleGraph | None:
        """The multi-scale graph of a state's cells, or None where it has none."""
        if state.cells is None or state.cells.shape[0] == 0:
            return None
        if state.rest_pos is None:
            raise GraphError("state has cells but no rest_pos; a mesh needs both, or graph=particles takes its nodes as particles")
        rest_pos, cells = state.rest_pos.cpu().numpy(), state.cells.cpu().numpy()
        mesh = multiscale_graph(rest_pos, cells, self.scales.spacing, self.spec.num_levels)
        kinds = state.node_type[state.cells]
        codes = torch.tensor([node_code(m) for m in self._meshes], device=kinds.device)
        wrong = (kinds != kinds[:, :1]).any(dim=1) | ~torch.isin(kinds[:, 0], codes)
        if wrong.any():
            cell = int(wrong.nonzero()[0])
            found = ", ".join(sorted({NODE_TYPES[code] for code in kinds[cell].tolist()}))
            raise GraphError(f"cell {cell} has nodes of {found}; a cell is of one material, and meshes are of {', '.join(self._meshes)}")
        return mesh

    def _add_mesh(self, data: HeteroData, state: State, rows: dict[str, Tensor], mesh: MultiscaleGraph) -> None:
        """Cell edges, virtual nodes and the edges between levels.

        A virtual node moves as the mass-weighted mean of the mesh nodes below it, which is that of its children.
        """
        spec, scales, dim, n = self.spec, self.scales, self.spec.dim, mesh.num_nodes
        device = state.pos.device
        level = torch.tensor(mesh.level, device=device)
        sizes = np.bincount(mesh.level, minlength=spec.num_levels + 1)[1:].tolist()
        row = torch.empty_like(level)  # of each point in its store
        for r in rows.values():
            row[r] = torch.arange(len(r), device=device)
        row[n:] = torch.cat([torch.arange(size, device=device) for size in sizes]) if sizes else row[n:]

        values = torch.cat([state.pos, cast(Tensor, state.rest_pos), history_of(state).flatten(1)], dim=1)
        above, below = torch.tensor(mesh.descent, device=device)
        above, mass = above - n, state.mass[below][:, None]
        total = mass.new_zeros(sum(sizes), 1).index_add_(0, above, mass)
        mean = values.new_zeros(sum(sizes), values.shape[1]).index_add_(0, above, mass * values[below]) / total
        pos, rest, motion = torch.cat([values, mean]).split([dim, dim, values.shape[1] - 2 * dim], dim=1)
        x = virtual_features(motion[n:].unflatten(1, (-1, dim)), level[n:], state.gravity, scales)
        for k, part in enumerate(x.split(sizes), start=1):
            data[grid(k)].x = part

        for name, pairs in ((CELL, mesh.cell_edges), (DOWN, mesh.down_edges), (SAME, mesh.same_edges)):
            edge_level = mesh.level[pairs[0]]
            j, i = edges = torch.tensor(pairs, device=device)
            odd, even = mesh_features(
                self.config.features,
                pos[i] - pos[j],
                rest[i] - rest[j],
                motion[i, -dim:] - motion[j, -dim:],
                None if name == CELL else level[j],
                scales,
            )
            for relation in spec.relations:
                source, relation_name, target = relation
                if relation_name != name:
                    continue
                chosen: Any = slice(None)
                if name != CELL:
                    chosen = slice(*np.searchsorted(edge_level, [level_of(source), level_of(source) + 1]))
                if target in self._meshes and len(self._meshes) > 1:
                    is_target = state.node_type[i[chosen]] == node_code(target)
                    chosen = torch.arange(len(i), device=device)[chosen][is_target]
                store = data[relation]
                store.edge_index, store.odd, store.even = row[edges[:, chosen]], odd[chosen], even[chosen]

    def _add_empty_mesh(self, data: HeteroData, state: State) -> None:
        """The stores of a mesh for a state without one."""
        device = state.pos.device
        for k in range(1, self.spec.num_levels + 1):
            data[grid(k)].x = torch.empty(0, self.spec.node_channels[grid(k)], device=device)
        for relation in self.spec.relations:
            if relation[1] != RADIUS:
                store = data[relation]
                store.edge_index = torch.empty(2, 0, dtype=torch.int64, device=device)
                store.odd = torch.empty(0, self.spec.odd_channels[relation], device=device)
                store.even = torch.empty(0, self.spec.even_channels[relation], device=device)
