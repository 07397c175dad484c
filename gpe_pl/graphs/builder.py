"""``State`` → ``HeteroData``: the same function in training and in rollout.

Every graph of a data set carries all its node and edge stores, empty where a frame has none, because PyG's ``Batch`` numbers edges wrongly when a store
is missing from some graphs. Each undirected edge is stored once. There are no edges between boundary nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

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
from gpe_pl.graphs.islands import find_islands, unwrapped
from gpe_pl.graphs.multiscale import MultiscaleGraph, multiscale_graph
from gpe_pl.graphs.neighbors import check_crowding, radius_between, radius_pairs
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, CELL, DOWN, MATERIALS, NODE_TYPES, RADIUS, SAME, EdgeType, FeatureSpec, grid, level_of, node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata


class GraphError(GpeError, ValueError):
    """A state does not fit the data set whose graphs are built; the message says how."""


LARGEST = 1e100
"""Of coordinates [m] and velocities [m/s]: squares of larger ones overflow."""


@dataclass(frozen=True)
class GraphBuilder:
    """Builds the graph of a state.

    Node stores of a material hold ``x``, ``material_params`` (SI), ``mass`` and ``node_id`` (row in the state); ``boundary`` and virtual nodes hold ``x``.
    Edge stores hold ``edge_index`` (row 0 source, row 1 target), ``odd`` and ``even``. Those of ``radius`` also hold
    ``offset``: the displacement over the radius, which standardisation leaves as it is.

    With ``config.islands``, nodes of materials also have ``pos`` [m] and ``island``, and the graph ``island_is_free`` [island] and ``num_islands`` [1].
    ``pos`` counts from the mean of the node's island, and in periodic domains keeps it together; an island that goes around the period has no lever arms, and
    ``pos`` is zero there. Nodes of meshes then have ``body``, which they move with, and the graph ``num_bodies`` [1]: what cells connect, with the nodes of no
    cell beside it. Where there are no cells at all, ``body`` is -1.

    Attributes:
        config: what the graphs are like.
        metadata: of the data set.
        skips: what is left out in building them, which changes no graph.

    Raises:
        PeriodicityError: the neighbour radius is half a period or more.
    """

    config: GraphConfig
    metadata: Metadata
    skips: Skips = field(default_factory=Skips)

    def __post_init__(self) -> None:
        for radius in (self.scales.radius, self.metadata.connectivity_radius):
            self.metadata.periodicity.check_radius(radius)

    @cached_property
    def scales(self) -> Scales:
        return scales_of(self.config, self.metadata)

    @cached_property
    def spec(self) -> FeatureSpec:
        return feature_spec(self.config, self.metadata)

    def __call__(self, state: State) -> HeteroData:
        """Build the graph of a state of float64 tensors.

        Raises:
            GraphError: the state holds a node type that the data set does not have, lacks velocity history, repeats along other axes, or has cells that
                do not fit its nodes.
            SimulationError: a position or velocity is not finite, or so many nodes lie within each other's radius that the material has collapsed.
        """
        if state.pos.dtype != torch.float64:
            raise GraphError(f"positions are {state.pos.dtype}; convert the state with State.to_torch, which makes them float64")
        if state.periodicity.axes != self.metadata.periodicity.axes:
            own, other = (", ".join("xyz"[a] for a in p.axes) or "no axis" for p in (self.metadata.periodicity, state.periodicity))
            raise GraphError(f"state is periodic along {other}, the data set {self.metadata.dataset!r} along {own}")
        history = history_of(state)
        if history.shape[1] != self.config.history:
            raise GraphError(f"state has a history of {history.shape[1]} velocities, the graph needs {self.config.history}")
        bad = ~(torch.cat([state.pos, history.flatten(1)], dim=1).abs() < LARGEST).all(dim=1)
        if bad.any():
            node = int(bad.nonzero()[0])
            is_finite = bool(torch.isfinite(torch.cat([state.pos[node], history[node].flatten()])).all())
            what, reason = ("beyond all measure", "explosion") if is_finite else ("not finite", "nan")
            raise SimulationError(f"node {node} has a position or velocity that is {what}", reason=reason, node=node)
        check_crowding(_array(state.pos), self.scales.radius, self.scales.spacing, state.periodicity)
        rows = {m: self._rows(state, m) for m in self.spec.materials}
        if sum(len(r) for r in rows.values()) != state.num_nodes:
            present = {NODE_TYPES[code] for code in state.node_type.unique().tolist()}
            unknown, known = ", ".join(sorted(present - {*self.spec.materials})), ", ".join(self.spec.materials)
            raise GraphError(f"state has nodes of {unknown}; the data set {self.metadata.dataset!r} has {known}")
        mesh = self._mesh(state) if self._meshes else None

        data = HeteroData()
        for material, r in rows.items():
            store = data[material]
            store.x = self._rounded(material_features(history[r], state.gravity, self.scales))
            column = self.metadata.param_names.index(MATERIALS[material].name)
            store.material_params = state.material_params[r, column : column + 1].float()
            store.mass = self._rounded(state.mass[r])
            store.node_id = r
        self._add_radius_edges(data, state, rows, mesh)
        if mesh is not None:
            self._add_mesh(data, state, rows, mesh)
        elif self._meshes:
            self._add_empty_mesh(data, state)
        if self.config.islands:
            self._add_islands(data, state, rows)
            self._add_bodies(data, state, rows, mesh)
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

    def _add_radius_edges(self, data: HeteroData, state: State, rows: dict[str, Tensor], mesh: MultiscaleGraph | None) -> None:
        """Boundary nodes, and the edges that the radius decides."""
        device = state.pos.device
        pos, vel = {m: state.pos[r] for m, r in rows.items()}, {m: state.vel[r] for m, r in rows.items()}
        points = {m: _array(p) for m, p in pos.items()} | {BOUNDARY: self._points(state)}
        present = {m for m, r in rows.items() if len(r)} | ({BOUNDARY} if len(state.boundary.pos) else set())
        relations = [r for r in self.spec.relations if r[1] == RADIUS]
        edges: dict[EdgeType, Tensor] = {}
        for relation in relations:
            source, _, target = relation
            if self.skips.absent_types and not {source, target} <= present:
                continue
            if source != target:
                pairs = radius_between(points[source], points[target], self.scales.radius, state.periodicity)
            else:
                pairs = radius_pairs(points[source], self.scales.radius, state.periodicity)
                if mesh is not None and source in self._meshes:
                    pairs = pairs[:, mesh.are_in_contact(rows[source].cpu().numpy()[pairs], self.scales.radius)]
            edges[relation] = torch.from_numpy(pairs).to(device)

        boundary = _trim(state.boundary, edges) if self.config.trim_boundary else state.boundary
        data[BOUNDARY].x = self._rounded(boundary_features(self.config, boundary, self.scales))
        pos[BOUNDARY], vel[BOUNDARY] = boundary.pos, boundary.vel
        for relation in relations:
            if relation not in edges:
                self._add_no_edges(data, relation, device)
                continue
            source, _, target = relation
            edge_index = edges[relation]
            chunk = max(1, edge_index.shape[1]) if self.skips.edges_at_once is None else self.skips.edges_at_once
            parts = []
            for j, i in edge_index.split(chunk, dim=1):
                displacement, velocity = state.periodicity.shortest(pos[target][i] - pos[source][j]), vel[target][i] - vel[source][j]
                normal = boundary.normal[j] if source == BOUNDARY else None
                odd, even = edge_features(self.config.features, displacement, velocity, normal, self.scales)
                parts.append((self._rounded(odd), self._rounded(even)))
            store = data[relation]
            store.edge_index = edge_index
            store.odd, store.even = (part[0] if len(part) == 1 else torch.cat(part) for part in zip(*parts, strict=True))
            store.offset = store.odd[:, : self.spec.dim]

    def _points(self, state: State) -> Any:
        """Where the boundary nodes are, as ``radius_between`` takes it."""
        return state.boundary.tree(state.periodicity) if self.skips.static_boundary else _array(state.boundary.pos)

    def _add_no_edges(self, data: HeteroData, relation: EdgeType, device: torch.device) -> None:
        store = data[relation]
        store.edge_index = torch.empty(2, 0, dtype=torch.int64, device=device)
        store.odd = torch.empty(0, self.spec.odd_channels[relation], device=device)
        store.even = torch.empty(0, self.spec.even_channels[relation], device=device)
        if relation[1] == RADIUS:
            store.offset = store.odd[:, : self.spec.dim]

    def _add_islands(self, data: HeteroData, state: State, rows: dict[str, Tensor]) -> None:
        """Groups of nodes that the graph connects, and which of them no edge ties to the boundary.

        What pushes a body from beyond the radius no model can see; held to free fall, it stays stable (docs/results/trials).
        """
        between, touches = [], torch.zeros(state.num_nodes, dtype=torch.bool, device=state.pos.device)
        for source, name, target in self.spec.relations:
            if source == BOUNDARY:
                touches[rows[target][data[source, name, target].edge_index[1]]] = True
            elif source in rows and target in rows:
                j, i = data[source, name, target].edge_index
                between.append(torch.stack([rows[source][j], rows[target][i]]))
        edges = torch.cat(between, dim=1).cpu().numpy()
        islands = find_islands(state.num_nodes, edges, touches.cpu().numpy())
        label = torch.from_numpy(islands.label).to(state.pos.device)
        pos = self._kept_together(state, edges) if state.periodicity else state.pos
        arms = self._rounded(from_centre(pos, label, len(islands.is_free)))  # single precision has no room for where the island is
        for material, r in rows.items():
            data[material].pos = arms[r]
            data[material].island = label[r]
        data.island_is_free = torch.from_numpy(islands.is_free).to(state.pos.device)
        data.num_islands = torch.tensor([len(islands.is_free)], device=state.pos.device)

    def _add_bodies(self, data: HeteroData, state: State, rows: dict[str, Tensor], mesh: MultiscaleGraph | None) -> None:
        """Groups of mesh nodes that move together."""
        if not self._meshes:
            return
        device = state.pos.device
        nodes = torch.cat([rows[m] for m in self._meshes]).cpu().numpy()
        body, num_bodies = np.full(len(nodes), -1), 0
        if mesh is not None:
            names, body = np.unique(
                mesh.moving_bodies(state.node_type.cpu().numpy().astype(np.int64), self.scales.spacing)[nodes], return_inverse=True
            )
            num_bodies = len(names)
        parts = torch.from_numpy(body).to(device).split([len(rows[m]) for m in self._meshes])
        for material, part in zip(self._meshes, parts, strict=True):
            data[material].body = part
        data.num_bodies = torch.tensor([num_bodies], device=device)

    def _rounded(self, values: Tensor) -> Tensor:
        """Values in the network's precision."""
        return values.float()

    @staticmethod
    def _kept_together(state: State, edges: np.ndarray) -> Tensor:
        """Positions that do not tear islands apart at the seams of a periodic domain; all zero where an island goes around it."""
        images, goes_around = unwrapped(_array(state.pos), edges, state.periodicity)
        return torch.from_numpy(np.where(goes_around[:, None], 0.0, images)).to(state.pos.device)

    # --- meshes ---------------------------------------------------------------------------------------------------------------------------

    def _mesh(self, state: State) -> MultiscaleGraph | None:
        """The multi-scale graph of a state's cells, or None where it has none."""
        if state.cells is None or state.cells.shape[0] == 0:
            return None
        if state.rest_pos is None:
            raise GraphError("state has cells but no rest_pos; a mesh needs both, or graph.mesh=false takes its nodes as particles")
        rest_pos, cells = state.rest_pos.cpu().numpy(), state.cells.cpu().numpy()
        mesh = multiscale_graph(rest_pos, cells, self.scales.spacing, self.spec.num_levels, state.periodicity)
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

        values = torch.cat([self._kept_whole(state, mesh), torch.tensor(mesh.rest_pos, device=device), history_of(state).flatten(1)], dim=1)
        above, below = torch.tensor(mesh.descent, device=device)
        above, mass = above - n, state.mass[below][:, None]
        total = mass.new_zeros(sum(sizes), 1).index_add_(0, above, mass)
        mean = values.new_zeros(sum(sizes), values.shape[1]).index_add_(0, above, mass * values[below]) / total
        pos, rest, motion = torch.cat([values, mean]).split([dim, dim, values.shape[1] - 2 * dim], dim=1)
        x = self._rounded(virtual_features(motion[n:].unflatten(1, (-1, dim)), level[n:], state.gravity, scales))
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
                store.edge_index, store.odd, store.even = row[edges[:, chosen]], self._rounded(odd[chosen]), self._rounded(even[chosen])

    def _kept_whole(self, state: State, mesh: MultiscaleGraph) -> Tensor:
        """Positions that do not tear meshes apart at the seams of a periodic domain."""
        if not state.periodicity:
            return state.pos
        pos, goes_around = unwrapped(np.ascontiguousarray(state.pos.cpu().numpy()), mesh.cell_edges, state.periodicity)
        if goes_around.any():
            raise GraphError(f"the mesh of node {int(goes_around.argmax())} goes around the periodic domain, so it has no rest shape")
        return torch.from_numpy(pos).to(state.pos.device)

    def _add_empty_mesh(self, data: HeteroData, state: State) -> None:
        """The stores of a mesh for a state without one."""
        device = state.pos.device
        for k in range(1, self.spec.num_levels + 1):
            data[grid(k)].x = torch.empty(0, self.spec.node_channels[grid(k)], device=device)
        for relation in self.spec.relations:
            if relation[1] != RADIUS:
                self._add_no_edges(data, relation, device)


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().cpu().numpy())


def from_centre(pos: Tensor, island: Tensor, num_islands: int) -> Tensor:
    """Positions counted from the mean of their island."""
    count = pos.new_zeros(num_islands, 1).index_add_(0, island, torch.ones_like(pos[:, :1]))
    centre = pos.new_zeros(num_islands, pos.shape[1]).index_add_(0, island, pos) / count
    return pos - centre[island]


def _trim(boundary: Boundary, edges: dict[EdgeType, Tensor]) -> Boundary:
    """The boundary nodes that have an edge, in order; renumbers the edges in place."""
    used = torch.zeros(len(boundary.pos), dtype=torch.bool, device=boundary.pos.device)
    for (source, _, _), edge_index in edges.items():
        if source == BOUNDARY:
            used[edge_index[0]] = True
    kept = torch.nonzero(used).flatten()
    new_row = torch.cumsum(used, dim=0) - 1
    for relation, edge_index in edges.items():
        if relation[0] == BOUNDARY:
            edges[relation] = torch.stack([new_row[edge_index[0]], edge_index[1]])
    rows = {name: getattr(boundary, name)[kept] for name in ("pos", "vel", "normal", "friction", "restitution")}
    return Boundary(**rows, shapes=boundary.shapes)
