"""Builder of graphs: turns a ``State`` into a ``HeteroData``, in two steps. Training, rollouts and exported programs use the same builder.

``GraphBuilder.topology`` finds the indices of nodes and edges with NumPy. ``GraphBuilder.graph`` computes features from these indices and the state, with
tensor operations alone, so that ``torch.export`` can trace it.

All graphs of a data set have the same node and edge stores. A store is empty if a frame has no such nodes or edges; PyG's ``Batch`` would number edges wrongly
if it were missing. Each undirected edge is stored once. There are no edges between boundary nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs import compiled_graph, joined
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.compiled_graph import CompiledGraph
from gpe_pl.graphs.elastic_cells import add_cells
from gpe_pl.graphs.features import (
    GraphConfig,
    Scales,
    boundary_features,
    edge_features,
    feature_spec,
    from_centre,
    history_of,
    material_features,
    mesh_features,
    scales_of,
    virtual_features,
)
from gpe_pl.graphs.load_features import add_loads
from gpe_pl.graphs.neighbors import Points, are_below, check_crowding
from gpe_pl.graphs.search import as_array, find_topology, rows_of
from gpe_pl.graphs.standards import Standards, raw
from gpe_pl.graphs.stress_features import add_stress
from gpe_pl.graphs.topology import GraphError as GraphError
from gpe_pl.graphs.topology import IslandTopology, MeshTopology, Topology
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, CELL, DOWN, NODE_TYPES, RADIUS, SAME, EdgeType, FeatureSpec, grid, level_of
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

EdgeFeatures = tuple[Tensor, Tensor]
"""Odd [edge, odd channel] and even [edge, even channel] features of the edges of a relation."""

LARGEST = 1e100
"""Largest coordinate [m] and velocity [m/s]: squares of larger ones overflow."""


@dataclass(frozen=True)
class GraphBuilder:
    """Builds the graph of a state.

    Node stores of a material hold ``x``, ``material_params`` (in the units of ``schema.MATERIALS``), ``mass`` [kg] and ``node_id`` (row in the state);
    ``boundary`` and virtual nodes hold ``x``. Edge stores contain ``edge_index`` (row 0 source, row 1 target), ``odd`` and ``even``. Those of ``radius`` edges
    also contain ``offset``: the displacement divided by the radius. Standardisation does not change it.

    With ``config.islands``, nodes of materials also have ``pos`` [m] and ``island``, and the graph has ``island_is_held`` [island] and ``num_islands`` [1].
    ``pos`` is relative to the mean position of the node's island. In periodic domains, images are chosen so that an island is in one piece. In an island that
    wraps around the domain this is impossible, and ``pos`` is zero.

    With ``config.islands`` and ``config.mesh``, nodes of meshes also have ``body``, and the graph has ``num_bodies`` [1]. A body consists of the nodes that
    cells connect, and of nodes without a cell beside them. ``body`` is -1 in a scene without cells. In periodic domains these nodes also have ``body_arm`` [m],
    the position relative to the mean of the body, since an island may wrap around the domain while its bodies do not.

    With ``config.cells``, the graph has ``gravity`` [1, dim] in m/frame², and nodes of meshes have:

    - ``body_pos`` and ``rest_pos``: present and undeformed positions relative to the mean of the body [m], in one piece in periodic domains
    - ``velocity``: mean velocity over the last frame, then velocity at the frame [node, 2 dim] in m/frame
    - ``wall``: normal, distance [m] and friction of the plane of the nearest wall [node, dim + 2]; zero without a wall within the radius
    - ``relief``: how much farther this wall seems to be, because it is sharp or thin there [node] in m (see ``geometry.relief``); zero
      in scenes without shapes, such as mirror images, and without ``reads_relief``
    - ``rest_gap``: distance of the undeformed node from walls [node] in m; infinite where it is not known, and without ``reads_relief``
    - ``corner_index`` [pair, 2] and ``corner`` [pair, dim + 1], for each pair of an edge of a body and a nearby corner of an obstacle: the nodes at the ends of
      the edge; the vector from the first of them to the corner [m] and the friction of the corner. Empty in 3D
    - ``touch_index`` and ``touch``: pairs of nodes of different bodies within ``schema.TOUCH_REACH`` and the radius [pair, 2], and the vector from the second
      to the first [pair, dim] in m
    - ``cell_index``: corners of each cell [cell, 2^dim]; simplices repeat the last one
    - ``attached_index``: the same for cells that attach nodes without a cell to the body beside them, for simplices outside of periodic domains

    In data sets with loads, nodes of materials also have ``prescribed`` [node] and ``load`` [node, dim] (see ``load_features``).

    Attributes:
        config: settings of the graph.
        metadata: metadata of the data set.
        skips: levels of skipping. Those that act here are exact, so they do not change the graph.
        reference: metadata of the data set whose scales are the units of all others, with ``config.scales`` other than ``one``; None for ``metadata``.
        reads_relief: whether ``relief`` is computed. It takes time, and only models with an elastic layer of walls read it.
        precision: floating-point type of ``x``, ``odd``, ``even``, ``mass`` and ``pos``.

    Raises:
        PeriodicityError: the connectivity radius is half a period or more.
    """

    config: GraphConfig
    metadata: Metadata
    skips: Skips = field(default_factory=Skips)
    reference: Metadata | None = None
    reads_relief: bool = True
    precision: ClassVar[torch.dtype] = torch.float32

    def __post_init__(self) -> None:
        for radius in (self.scales.radius, self.metadata.connectivity_radius):
            self.metadata.periodicity.check_radius(radius)

    @cached_property
    def scales(self) -> Scales:
        return scales_of(self.config, self.metadata, self.reference)

    def at(self, spacing: float, frame_dt: float) -> GraphBuilder:
        """Return the builder for scenes of another rest spacing [m] and frame interval [s]; the connectivity radius follows the spacing."""
        known = self.reference or self.metadata
        if (spacing, frame_dt) == (self.metadata.spacing, self.metadata.frame_dt):
            return self
        radius = known.connectivity_radius * spacing / known.spacing
        return replace(self, metadata=replace(known, spacing=spacing, frame_dt=frame_dt, connectivity_radius=radius), reference=known)

    @cached_property
    def spec(self) -> FeatureSpec:
        return feature_spec(self.config, self.metadata)

    def __call__(self, state: State) -> HeteroData:
        """Build the graph of a state of float64 tensors.

        Raises:
            GraphError, MeshError, SimulationError: as ``topology``.
        """
        return self.graph(self.topology(state), state)

    def topology(self, state: State) -> Topology:
        """Search for the nodes and edges of the graph of a state of float64 tensors.

        Raises:
            GraphError: the state has a node type that the data set does not have, has another number of past velocities, has other periodic axes, has cells
                that do not fit its nodes, lacks a stress that the graph reads, or is not float64.
            MeshError: a cell has a node that does not exist, or a rest position is not finite.
            SimulationError: a position or velocity is not finite or beyond ``LARGEST``, or so many nodes lie within each other's radius that the material has
                collapsed.
        """
        points = self._checked(state)
        rows = rows_of(state, self.spec.materials)
        if sum(len(r) for r in rows.values()) != state.num_nodes:
            present = {NODE_TYPES[code] for code in state.node_type.unique().tolist()}
            unknown, known = ", ".join(sorted(present - {*self.spec.materials})), ", ".join(self.spec.materials)
            raise GraphError(
                f"state has nodes of {unknown}; the data set {self.metadata.dataset!r} has {known}; take a model that was trained on {unknown}"
            )
        return find_topology(state, points, rows, self.config, self.spec, self.scales, self.skips)

    def topology_or_error(self, state: State) -> Topology | SimulationError:
        """Return the topology of a state, or the error if its graph cannot be built."""
        try:
            return self.topology(state)
        except SimulationError as error:
            return error

    def _checked(self, state: State) -> Points:
        """Check that a state fits the data set and can have a graph; return its positions."""
        if state.pos.dtype != torch.float64:
            raise GraphError(f"positions are {state.pos.dtype}; convert the state with State.to_torch, which makes them float64")
        if state.periodicity.axes != self.metadata.periodicity.axes:
            own, other = (", ".join("xyz"[a] for a in p.axes) or "no axis" for p in (self.metadata.periodicity, state.periodicity))
            raise GraphError(
                f"state is periodic along {other}, the data set {self.metadata.dataset!r} along {own}; make the state with the same periodic axes"
            )
        if state.loads is not None and state.loads.force is not None and "force" not in self.spec.loads:
            raise GraphError("state has nodal forces, and the data set has none, so that a model would ignore them; leave them out")
        if self.spec.reads_stress and state.stress is None:
            raise GraphError(
                "graph.stress=true: the state has no stress; give that of the first frame, zeros for a body at rest and undeformed"
            )
        history = history_of(state)
        if history.shape[1] != self.config.history:
            raise GraphError(
                f"state has a history of {history.shape[1]} velocities, the graph needs {self.config.history}; "
                "make the state with initial_state of the simulator"
            )
        pos, motion = as_array(state.pos), as_array(history)
        if not (are_below(pos.ravel(), LARGEST) and are_below(motion.ravel(), LARGEST)):
            values = np.concatenate([pos, motion.reshape(len(pos), -1)], axis=1)
            node = int(np.argmin((np.abs(values) < LARGEST).all(axis=1)))
            what, reason = ("beyond all measure", "explosion") if np.isfinite(values[node]).all() else ("not finite", "nan")
            raise SimulationError(f"node {node} has a position or velocity that is {what}", reason=reason, node=node)
        points = Points(pos, self.scales.radius, state.periodicity)
        check_crowding(points, self.scales.spacing)
        return points

    # --- features of indices and state; torch.export traces what follows, so lengths are symbols and no branch depends on values ---------------

    def graph(self, topology: Topology, state: State, standards: Standards | None = None) -> HeteroData:
        """Return the graph of a state whose topology is known.

        Args:
            topology: topology of the state.
            state: state of float64 tensors; with ``standards``, it must satisfy ``compiled_graph.works_on``.
            standards: statistics with which features are standardised; None leaves them as they are.
        """
        if standards is not None or (compiled_graph.works_on(state) and (topology.mesh is None or topology.mesh.edges is not None)):
            data = self._compiled(standards or self._raw)(topology, state)
            return self._with_stress_and_loads(self._with_cells(data, topology, state), topology, state, standards)
        data, history, boundary = HeteroData(), history_of(state), state.boundary
        for material, r in topology.rows.items():
            store = data[material]
            store.x = self._rounded(material_features(history[r], state.gravity, self.scales))
            store.material_params = state.material_params[r][:, self.metadata.columns_of(material)].float()
            store.mass = self._rounded(state.mass[r] / self.scales.length_ratio**self.spec.dim)
            store.node_id = r
        if topology.boundary_rows is not None:
            boundary = _part(boundary, topology.boundary_rows)
        data[BOUNDARY].x = self._rounded(boundary_features(self.config, boundary, self.scales))
        features = self._radius_features(topology, state, boundary)
        levels = [grid(level) for level in range(1, self.spec.num_levels + 1)]
        virtual = [torch.empty(0, self.spec.node_channels[name], dtype=self.precision, device=state.pos.device) for name in levels]
        if topology.mesh is not None:
            virtual, of_mesh = self._mesh_features(topology, topology.mesh, state)
            features |= of_mesh
        for name, x in zip(levels, virtual, strict=True):
            data[name].x = x
        for relation in self.spec.relations:
            self._add_edges(data, relation, topology.edges.get(relation), features.get(relation), state.pos.device)
        if topology.islands is not None:
            islands, num_islands = topology.islands, topology.islands.is_held.shape[0]
            arm = (
                from_centre(state.pos, islands.label, num_islands)
                if islands.arm is None
                else _with_gradient(islands.arm, state.pos, islands)
            )
            arm = self._rounded(arm)  # single precision has no room for where the island is
            for material, r in topology.rows.items():
                data[material].pos, data[material].island = arm[r], islands.label[r]
            data.island_is_held, data.num_islands = islands.is_held, torch.full((1,), num_islands, device=arm.device)
            for material, body in islands.body.items():
                data[material].body = body
                if islands.body_arm is not None:
                    own = islands.body_arm[material]
                    if state.pos.requires_grad and islands.num_bodies:
                        change = from_centre(state.pos[topology.rows[material]], body, islands.num_bodies)
                        own = own + change - change.detach()
                    data[material].body_arm = self._rounded(own)
            if self.spec.meshes:
                data.num_bodies = torch.full((1,), islands.num_bodies, device=arm.device)
        return self._with_stress_and_loads(self._with_cells(data, topology, state), topology, state)

    def _with_stress_and_loads(self, data: HeteroData, topology: Topology, state: State, standards: Standards | None = None) -> HeteroData:
        if self.spec.reads_stress:
            add_stress(data, topology, state, self.spec, standards, self.precision)
        if self.spec.loads:
            add_loads(data, topology, state, self.spec, self.scales, standards, self.precision)
        return data

    def _with_cells(self, data: HeteroData, topology: Topology, state: State) -> HeteroData:
        if self.spec.cells:
            add_cells(data, topology, state, self.spec, self.scales, self.precision, self.reads_relief)
        return data

    def batch(self, topologies: Sequence[Topology], states: Sequence[State], standards: Standards | None = None) -> HeteroData:
        """Return ``batching.batched`` of the graphs of several states. One pass computes the features of all scenes where ``joined.covers`` them.

        Args:
            topologies: topologies of the states.
            states: the states; each is as in ``graph``.
            standards: as in ``graph``.
        """
        if joined.covers(topologies, states, self.spec):
            return joined.joined_graph(self._compiled(standards or self._raw), topologies, states)
        return batched([self.graph(topology, state, standards) for topology, state in zip(topologies, states, strict=True)])

    def _compiled(self, standards: Standards) -> CompiledGraph:
        return CompiledGraph(self.config, self.metadata, self.spec, self.scales, standards)

    @cached_property
    def _raw(self) -> Standards:
        return raw(self.spec, np.dtype(str(self.precision).removeprefix("torch.")))

    def _rounded(self, values: Tensor) -> Tensor:
        return values.to(self.precision)

    def _add_edges(
        self, data: HeteroData, relation: EdgeType, edge_index: Tensor | None, features: EdgeFeatures | None, device: torch.device
    ) -> None:
        """Add the store of a relation, empty where there are no edges."""
        if edge_index is None or features is None:
            edge_index = torch.empty(2, 0, dtype=torch.int64, device=device)
            channels = self.spec.odd_channels[relation], self.spec.even_channels[relation]
            features = (
                torch.empty(0, channels[0], dtype=self.precision, device=device),
                torch.empty(0, channels[1], dtype=self.precision, device=device),
            )
        store = data[relation]
        store.edge_index, (store.odd, store.even) = edge_index, features
        if relation[1] == RADIUS:
            store.offset = store.odd[:, : self.spec.dim]

    def _radius_features(self, topology: Topology, state: State, boundary: Boundary) -> dict[EdgeType, EdgeFeatures]:
        pos = {m: state.pos[r] for m, r in topology.rows.items()} | {BOUNDARY: boundary.pos}
        vel = {m: state.vel[r] for m, r in topology.rows.items()} | {BOUNDARY: boundary.vel}
        features = {}
        for relation, edge_index in topology.edges.items():
            source, name, target = relation
            if name != RADIUS:
                continue
            at_once = self.skips.edges_at_once
            parts = []
            for j, i in (edge_index,) if at_once is None else edge_index.split(at_once, dim=1):
                displacement, velocity = topology.periodicity.shortest(pos[target][i] - pos[source][j]), vel[target][i] - vel[source][j]
                normal = boundary.normal[j] if source == BOUNDARY else None
                odd, even = edge_features(self.config.features, displacement, velocity, normal, self.scales)
                parts.append((self._rounded(odd), self._rounded(even)))
            odd, even = (part[0] if len(part) == 1 else torch.cat(part) for part in zip(*parts, strict=True))
            features[relation] = odd, even
        return features

    def _mesh_features(self, topology: Topology, mesh: MeshTopology, state: State) -> tuple[list[Tensor], dict[EdgeType, EdgeFeatures]]:
        """Return the features of virtual nodes by level, and the features of mesh edges by relation.

        A virtual node has the mass-weighted mean position and velocity of the mesh nodes below it.
        """
        dim, sizes = self.spec.dim, mesh.num_virtual
        pos = state.pos if mesh.shift is None else state.pos + mesh.shift
        values = torch.cat([pos, mesh.rest_pos, history_of(state).flatten(1)], dim=1)
        mean = _means_below(mesh, values, state.mass)
        level = _levels(range(1, len(sizes) + 1), sizes, mean.device)
        motion = mean[:, 2 * dim :].unflatten(1, (-1, dim))
        x = self._rounded(virtual_features(motion, level, state.gravity, self.scales))

        now, above = (torch.cat([v[:, : 2 * dim], v[:, -dim:]], dim=1) for v in (values, mean))  # position, rest position, velocity
        points = {m: now[topology.rows[m]] for m in self.spec.meshes}
        points |= {grid(k): part for k, part in enumerate(above.split(sizes), start=1)}
        features: dict[EdgeType, EdgeFeatures] = {}
        for name in (CELL, DOWN, SAME):
            relations = [relation for relation in topology.edges if relation[1] == name]
            if not relations:
                continue
            difference = torch.cat([points[r[2]][topology.edges[r][1]] - points[r[0]][topology.edges[r][0]] for r in relations])
            counts = [topology.edges[r].shape[1] for r in relations]
            level_of_source = None if name == CELL else _levels([level_of(r[0]) for r in relations], counts, mean.device)
            displacement, rest, velocity = difference.split(dim, dim=1)
            odd, even = mesh_features(self.config.features, displacement, rest, velocity, level_of_source, self.scales)
            parts = zip(self._rounded(odd).split(counts), self._rounded(even).split(counts), strict=True)
            features |= dict(zip(relations, parts, strict=True))
        return [*x.split(sizes)], features


def _with_gradient(arm: Tensor, pos: Tensor, islands: IslandTopology) -> Tensor:
    """Return lever arms that a search has found, with gradients with respect to positions. Arms of islands that wrap around a periodic domain get none."""
    if not pos.requires_grad:
        return arm
    num_islands = islands.is_held.shape[0]
    is_whole = torch.zeros(num_islands, dtype=torch.bool, device=pos.device)
    is_whole[islands.label[(arm != 0).any(dim=1)]] = True
    change = from_centre(pos, islands.label, num_islands)
    return arm + torch.where(is_whole[islands.label, None], change - change.detach(), 0.0)


def _means_below(mesh: MeshTopology, values: Tensor, mass: Tensor) -> Tensor:
    """Return the mass-weighted means of values [node, channel] over the nodes below each virtual node."""
    (above, below), num_virtual = mesh.descent, sum(mesh.num_virtual)
    weight = mass[below][:, None]
    total = mass.new_zeros(num_virtual + 1, 1).index_add_(0, above, weight)  # the last row is for nodes without a virtual node
    mean = values.new_zeros(num_virtual + 1, values.shape[1]).index_add_(0, above, weight * values[below]) / total
    return mean[:num_virtual]


def _levels(levels: Iterable[int], counts: Iterable[int], device: torch.device) -> Tensor:
    """Return a tensor that repeats each level by its count."""
    parts = [torch.full((n,), level, device=device) for level, n in zip(levels, counts, strict=True)]
    return torch.cat([torch.empty(0, dtype=torch.int64, device=device), *parts])


def _part(boundary: Boundary, rows: Tensor) -> Boundary:
    """Return some of the boundary nodes."""
    kept = {name: getattr(boundary, name)[rows] for name in ("pos", "vel", "normal", "friction", "restitution")}
    return Boundary(**kept, shapes=boundary.shapes)
