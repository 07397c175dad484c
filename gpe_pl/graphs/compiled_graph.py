"""``GraphBuilder.graph`` with compiled features: the same graph, raw or already standardised, for states on the CPU that need no gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs import compiled_features
from gpe_pl.graphs.assembly import assembled
from gpe_pl.graphs.features import AHEAD_CHANNELS, GraphConfig, Scales, ahead_features, history_of
from gpe_pl.graphs.standards import Standards
from gpe_pl.graphs.topology import IslandTopology, MeshTopology, Topology
from gpe_pl.schema import BOUNDARY, RADIUS, EdgeType, FeatureSpec, grid
from gpe_pl.system.compiled import is_wanted
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

NO_ROWS = np.empty((0, 0))
NO_LEVEL = np.empty(0)


class Scenes(NamedTuple):
    """The scenes of a state that joins several.

    Attributes:
        gravity: gravity of each scene [scene, dim] in m/s².
        starts: first row of each scene in the store of each material, and the number of rows [scene + 1].
    """

    gravity: np.ndarray
    starts: Mapping[str, np.ndarray]


def works_on(state: State) -> bool:
    """Tell whether the compiled features can process a state of tensors in the present context."""
    if state.pos.device.type != "cpu" or torch.compiler.is_compiling() or not is_wanted():
        return False
    b = state.boundary
    used = (state.pos, state.vel, state.velocity_history, state.frame_velocity, state.mass, state.material_params, state.gravity)
    walls = (b.pos, b.vel, b.normal, b.friction, b.restitution)
    return not torch.is_grad_enabled() or not any(x is not None and x.requires_grad for x in (*used, *walls))


class CompiledGraph:
    """Assembles the graph of one state, which may join several scenes.

    Args:
        config: settings of the graph.
        metadata: metadata of the data set.
        spec: channels of the graph.
        scales: units of features.
        standards: statistics of the features; ``standards.raw`` leaves them as they are.
    """

    def __init__(self, config: GraphConfig, metadata: Metadata, spec: FeatureSpec, scales: Scales, standards: Standards) -> None:
        self.config, self.metadata, self.spec, self.scales = config, metadata, spec, scales
        self.standards, self.precision = standards, standards.precision

    def __call__(self, topology: Topology, state: State, scenes: Scenes | None = None) -> HeteroData:
        """Return the graph of a state whose topology is known. Without ``scenes``, it is one scene."""
        spec = self.spec
        pos, history, mass = (_array(x) for x in (state.pos, history_of(state), state.mass))
        boundary = state.boundary
        rows = {m: r.numpy() for m, r in topology.rows.items()}
        scenes = scenes or Scenes(_array(state.gravity)[None], {m: np.array([0, len(r)]) for m, r in rows.items()})
        stores: dict[str, dict[str, Any]] = {m: self._material(m, topology.rows[m], history, scenes, mass, state) for m in rows}
        rows[BOUNDARY] = np.arange(boundary.pos.shape[0]) if topology.boundary_rows is None else topology.boundary_rows.numpy()
        stores[BOUNDARY] = {"x": self._walls(boundary, rows[BOUNDARY])}
        edges = self._contacts(topology, state, rows)
        for level in range(1, spec.num_levels + 1):
            stores[grid(level)] = {"x": self._empty(spec.node_channels[grid(level)])}
        if topology.mesh is not None:
            virtual, of_mesh = self._mesh(topology, topology.mesh, pos, history, mass, scenes.gravity)
            edges |= of_mesh
            for level, x in enumerate(virtual, start=1):
                stores[grid(level)]["x"] = x
        if topology.islands is not None:
            self._add_islands(stores, topology.islands, topology.rows, pos)
        about: dict[str, Tensor] = {}
        if topology.islands is not None:
            about = {"island_is_held": topology.islands.is_held, "num_islands": torch.tensor([len(topology.islands.is_held)])}
            if spec.meshes:
                about["num_bodies"] = torch.tensor([topology.islands.num_bodies])
        return assembled(stores, {r: edges.get(r) or self._no_edges(r) for r in spec.relations}, about)

    def _new(self, *shape: int) -> np.ndarray:
        return np.empty(shape, self.precision)

    def _empty(self, channels: int) -> Tensor:
        return torch.from_numpy(self._new(0, channels))

    def _no_edges(self, relation: EdgeType) -> dict[str, Tensor]:
        odd = self._empty(self.spec.odd_channels[relation])
        store = {"edge_index": torch.empty(2, 0, dtype=torch.int64), "odd": odd, "even": self._empty(self.spec.even_channels[relation])}
        return store | {"offset": odd[:, : self.spec.dim]} if relation[1] == RADIUS else store

    def _material(self, material: str, rows: Tensor, history: np.ndarray, scenes: Scenes, mass: np.ndarray, state: State) -> dict[str, Any]:
        r, scales = rows.numpy(), self.scales
        num_channels = (history.shape[1] + 1) * self.spec.dim
        x = self._new(len(r), num_channels)  # ``load_features`` adds those of loads
        units, statistics = (scales.velocity, scales.acceleration), self.standards.node[material]
        compiled_features.motion(history, r, scenes.gravity, scenes.starts[material], NO_LEVEL, *units, *statistics, x)
        if scales.numbers:
            mean, inverse = (values[num_channels:] for values in statistics)
            numbers = (np.array(scales.numbers).astype(self.precision) - mean) * inverse
            x = np.concatenate([x, np.tile(numbers, (len(r), 1))], axis=1)
        params = self.standards.of_params(material, _array(state.material_params)[r][:, self.metadata.columns_of(material)])
        unit = self.precision.type(self.standards.mass)
        return {
            "x": torch.from_numpy(x),
            "material_params": torch.from_numpy(np.ascontiguousarray(params)),
            "mass": torch.from_numpy((mass[r] / scales.length_ratio**self.spec.dim).astype(self.precision) / unit),
            "node_id": rows,
        }

    def _walls(self, boundary: Boundary, rows: np.ndarray) -> Tensor:
        x = self._new(len(rows), self.spec.node_channels[BOUNDARY])
        b = (_array(v) for v in (boundary.vel, boundary.normal, boundary.friction, boundary.restitution))
        compiled_features.walls(*b, rows, self.config.boundary_condition, self.scales.velocity, *self.standards.node[BOUNDARY], x)
        return torch.from_numpy(x)

    def _contacts(self, topology: Topology, state: State, rows: dict[str, np.ndarray]) -> dict[EdgeType, dict[str, Tensor]]:
        """Return the stores of the edges within the radius."""
        pos, vel = _array(state.pos), _array(state.vel)
        period, units = np.zeros(3), np.array([self.scales.radius, self.scales.spacing, self.scales.velocity])
        if topology.periodicity:
            period[: self.spec.dim] = topology.periodicity.period
        stores = {}
        for relation, edge_index in topology.edges.items():
            source, name, target = relation
            if name != RADIUS:
                continue
            index, dim = edge_index.numpy(), self.spec.dim
            if source == BOUNDARY:
                b = state.boundary
                there = _array(b.pos), _array(b.vel), rows[BOUNDARY], _array(b.normal)
            else:
                there = pos, vel, rows[source], NO_ROWS
            is_told = self.scales.use == "dimensionless" and self.config.features == "contact"
            channels = dim, self.spec.odd_channels[relation], self.spec.even_channels[relation] - AHEAD_CHANNELS * is_told
            offset, odd, even = (self._new(index.shape[1], c) for c in channels)
            compiled_features.contacts(
                *there, pos, vel, rows[target], index, period, units, self.standards.odd[relation], *self.standards.even[relation],
                offset, odd, even,
            )  # fmt: skip
            if is_told:
                even = np.concatenate([even, self._ahead(there, (pos, vel, rows[target]), index, topology, relation)], axis=1)
            values = zip(("odd", "even", "offset"), (odd, even, offset), strict=True)
            stores[relation] = {"edge_index": edge_index, **{key: torch.from_numpy(value) for key, value in values}}
        return stores

    def _ahead(
        self, source: tuple[np.ndarray, ...], target: tuple[np.ndarray, ...], index: np.ndarray, topology: Topology, relation: EdgeType
    ) -> np.ndarray:
        """Return the standardised ``features.ahead_features`` of the edges of a relation."""
        (pos, vel, rows, normal), (target_pos, target_vel, target_rows) = source, target
        j, i = rows[index[0]], target_rows[index[1]]
        displacement = topology.periodicity.shortest(torch.from_numpy(target_pos[i] - pos[j]))
        velocity = torch.from_numpy(target_vel[i] - vel[j])
        wall = torch.from_numpy(normal[j]) if len(normal) else None
        values = ahead_features(displacement, velocity, wall, self.scales).numpy().astype(self.precision)
        mean, inverse = (of_channel[-AHEAD_CHANNELS:] for of_channel in self.standards.even[relation])
        return (values - mean) * inverse

    def _mesh(
        self, topology: Topology, mesh: MeshTopology, pos: np.ndarray, history: np.ndarray, mass: np.ndarray, gravity: np.ndarray
    ) -> tuple[list[Tensor], dict[EdgeType, dict[str, Tensor]]]:
        """Return the features of virtual nodes by level, and the stores of the edges of meshes."""
        assert mesh.edges is not None
        spec, scales, sizes = self.spec, self.scales, mesh.num_virtual
        shift = NO_ROWS if mesh.shift is None else _array(mesh.shift)
        points, past = compiled_features.points_of_mesh(pos, _array(mesh.rest_pos), history, mass, shift, mesh.descent.numpy(), sum(sizes))
        x = self._new(sum(sizes), spec.node_channels[grid(1)] if sizes else 0)
        if sizes:
            level = np.repeat(np.arange(1.0, len(sizes) + 1), sizes)
            rows, statistics = np.arange(len(past)), self.standards.node[grid(1)]
            starts = np.array([0, len(past)])
            compiled_features.motion(past, rows, gravity, starts, level, scales.velocity, scales.acceleration, *statistics, x)
        relations, counts, num_kinds = mesh.edges.relations, mesh.edges.counts, mesh.edges.num_cell_relations
        total, along_cells = sum(counts), sum(counts[:num_kinds])
        odd, cell_even = self._new(total, spec.odd_channels[relations[0]]), self._new(along_cells, spec.even_channels[relations[0]])
        even = self._new(total - along_cells, spec.even_channels[relations[-1]])
        compiled_features.mesh_edges(
            points, mesh.edges.ends.numpy(), mesh.edges.starts, mesh.edges.levels, scales.spacing, scales.frame_dt,
            *self.standards.of_mesh(relations), odd, cell_even, even,
        )  # fmt: skip
        odds = torch.from_numpy(odd).split(counts)
        evens = torch.from_numpy(cell_even).split(counts[:num_kinds]) + torch.from_numpy(even).split(counts[num_kinds:])
        stores = {r: {"edge_index": topology.edges[r], "odd": o, "even": e} for r, o, e in zip(relations, odds, evens, strict=True)}
        return [*torch.from_numpy(x).split(sizes)], stores

    def _add_islands(self, stores: dict[str, dict[str, Any]], islands: IslandTopology, rows: dict[str, Tensor], pos: np.ndarray) -> None:
        label = islands.label.numpy()
        arm = self._new(*pos.shape)
        if islands.arm is None:
            compiled_features.write_arms(pos, label, len(islands.is_held), arm)
        else:
            arm[:] = islands.arm.numpy()
        for material, r in rows.items():
            own = r.numpy() if len(rows) > 1 else slice(None)  # the only material has all nodes
            stores[material] |= {"pos": torch.from_numpy(arm[own]), "island": torch.from_numpy(label[own])}
        for material, body in islands.body.items():
            stores[material]["body"] = body
            if islands.body_arm is not None:
                stores[material]["body_arm"] = torch.from_numpy(islands.body_arm[material].numpy().astype(self.precision))


def _array(x: Tensor) -> np.ndarray:
    """Return the values of a tensor on the CPU as a contiguous array."""
    return np.ascontiguousarray(x.detach().numpy())
