"""Export of a trained model as a ``torch.export`` program of one frame, which needs PyTorch but not this package.

The program takes a scene as a dictionary of tensors and returns the changed tensors. The caller searches for neighbours; the program does everything else. In
Python::

    program = torch.export.load("model.pt2").module()
    scene["edges.sand.radius.sand"] = …           pairs within the radius, each once; row 0 source, row 1 target
    moved, predicted = program(scene)             positions and velocity history; accelerations [m/s²] and stress [Pa]
    scene |= moved

The file contains ``description.json``, which lists the tensors with their shapes and units (``torch.export.load`` reads it with ``extra_files``). Numbers of
nodes, edges and islands may change from call to call.
"""

from __future__ import annotations

import copy
import io
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import Dim
from torch_geometric.data import HeteroData

from gpe_pl.files.atomic import replace_bytes
from gpe_pl.graphs.builder import GraphBuilder, from_centre
from gpe_pl.graphs.features import boundary_features, edge_features, history_of, material_features, mesh_features, virtual_features
from gpe_pl.graphs.islands import unwrapped
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.nn.static_friction import is_held
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, CELL, DOWN, MATERIALS, RADIUS, EdgeType, FeatureSpec, grid, level_of
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

Scene = dict[str, Tensor]
"""Tensors of a scene by the names of ``describe``."""

DESCRIPTION = "description.json"
EVERYTHING = Skips(absent_types=False, isolated_nodes=False, edges_at_once=None, sorted_from=None)
"""Skips that do not depend on the values of the scene, because an exported program cannot."""
BOUNDARY_FIELDS = ("pos", "vel", "normal", "friction", "restitution")


@dataclass(frozen=True)
class Input:
    """Description of one tensor of a scene.

    Attributes:
        shape: lengths, or names of lengths that may differ from call to call.
        dtype: ``float64``, ``int64`` or ``bool``.
        unit: unit of the values.
        doc: meaning of the values.
    """

    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    doc: str


class PortableStep(nn.Module):
    """Step of a learned simulator on plain tensors.

    Args:
        simulator: simulator with any model of this package.
    """

    def __init__(self, simulator: LearnedSimulator) -> None:
        super().__init__()
        metadata = simulator.builder.metadata
        self.simulator, self.spec, self.scales = simulator, simulator.builder.spec, simulator.builder.scales
        self.meshes = _meshes(self.spec)
        self.frame_dt, self.periodicity, self.config = metadata.frame_dt, metadata.periodicity, simulator.builder.config

    def forward(self, scene: Scene) -> tuple[Scene, Scene]:
        """Return next positions and velocity history; and acceleration with gravity [m/s²] and stress [Pa] at nodes for which the model predicts one."""
        graph = self.graph(scene)
        predicted = self.simulator(graph)
        is_supported = self.simulator.supported(graph) if self.simulator.static_friction else None
        moved: Scene = {}
        further: Scene = {}
        for material, values in predicted.acceleration.items():
            history = scene[f"velocity_history.{material}"]
            acc = scene["gravity"].expand_as(history[:, -1]) + values.double() * self.simulator.acceleration_std
            before = scene[f"pos.{material}"]
            pos, vel = integrators.advance(before, history[:, -1], acc, self.frame_dt)
            if is_supported is not None:
                speed = self.simulator.slowest(scene["gravity"])
                held = is_held(history[:, -1], vel, graph[material].island, is_supported, speed)[:, None]
                pos, vel = torch.where(held, before, pos), torch.where(held, 0.0, vel)
            moved[f"pos.{material}"] = pos
            moved[f"velocity_history.{material}"] = torch.cat([history[:, 1:], vel[:, None]], dim=1)
            further[f"acceleration.{material}"] = acc
        for material, values in predicted.stress.items():
            further[f"stress.{material}"] = values.double() * self.simulator.stress_std
        return moved, further

    def graph(self, scene: Scene) -> HeteroData:
        """Return the graph that the builder makes of the same state."""
        data = HeteroData()
        for material in self.spec.materials:
            store = data[material]
            store.x = material_features(scene[f"velocity_history.{material}"], scene["gravity"], self.scales).float()
            store.material_params, store.mass = scene[f"material_params.{material}"].float(), scene[f"mass.{material}"].float()
        if self.spec.islands:
            for material, arm in self._arms(scene).items():
                data[material].pos, data[material].island = arm.float(), scene[f"island.{material}"]
            data.island_is_free = scene["island_is_free"]
            data.num_islands = torch.full((1,), scene["island_is_free"].shape[0])
            for m in self.meshes:
                data[m].body = scene[f"body.{m}"]
            data.num_bodies = torch.full((1,), sum(scene[f"body.{m}"].shape[0] for m in self.meshes))  # upper bound
        pos, vel, normal, friction, restitution = (scene[f"boundary.{name}"] for name in BOUNDARY_FIELDS)
        boundary = Boundary(pos, vel, normal, friction, restitution)
        data[BOUNDARY].x = boundary_features(self.config, boundary, self.scales).float()
        self._add_radius_edges(data, scene, boundary)
        self._add_mesh(data, scene)
        return data

    def _arms(self, scene: Scene) -> Scene:
        """Return positions relative to the mean of the island, by material."""
        if self.periodicity:
            return {m: scene[f"arm.{m}"] for m in self.spec.materials}
        pos, island = (torch.cat([scene[f"{name}.{m}"] for m in self.spec.materials]) for name in ("pos", "island"))
        arms = from_centre(pos, island, scene["island_is_free"].shape[0])
        return dict(zip(self.spec.materials, arms.split([scene[f"pos.{m}"].shape[0] for m in self.spec.materials]), strict=True))

    def _edges(self, scene: Scene, relation: EdgeType) -> Tensor:
        return scene[f"edges.{'.'.join(relation)}"]

    def _add_radius_edges(self, data: HeteroData, scene: Scene, boundary: Boundary) -> None:
        pos = {m: scene[f"pos.{m}"] for m in self.spec.materials} | {BOUNDARY: boundary.pos}
        vel = {m: scene[f"velocity_history.{m}"][:, -1] for m in self.spec.materials} | {BOUNDARY: boundary.vel}
        for relation in self.spec.relations:
            source, name, target = relation
            if name != RADIUS:
                continue
            store = data[relation]
            j, i = store.edge_index = self._edges(scene, relation)
            displacement = self.periodicity.shortest(pos[target][i] - pos[source][j])
            relative_velocity = vel[target][i] - vel[source][j]
            normal = boundary.normal[j] if source == BOUNDARY else None
            odd, even = edge_features(self.config.features, displacement, relative_velocity, normal, self.scales)
            store.odd, store.even = odd.float(), even.float()
            store.offset = store.odd[:, : self.spec.dim]

    def _add_mesh(self, data: HeteroData, scene: Scene) -> None:
        """Add virtual nodes, which move as the mean of their children, and the edges of meshes."""
        relations = [r for r in self.spec.relations if r[1] != RADIUS]
        if not relations:
            return
        dim, values, mass = self.spec.dim, dict[str, Tensor](), dict[str, Tensor]()
        for m in self.meshes:
            values[m] = torch.cat([scene[f"pos.{m}"], scene[f"rest_pos.{m}"], scene[f"velocity_history.{m}"].flatten(1)], dim=1)
            mass[m] = scene[f"mass.{m}"][:, None]
        width = next(iter(values.values())).shape[1]
        for level in range(1, self.spec.num_levels + 1):
            name = grid(level)
            size = scene[f"num_nodes.{name}"]
            total, weighted = size.new_zeros(size.shape[0], 1), size.new_zeros(size.shape[0], width)
            for relation in relations:
                if relation[:2] == (name, DOWN):
                    (j, i), child = self._edges(scene, relation), relation[2]
                    total = total.index_add(0, j, mass[child][i])
                    weighted = weighted.index_add(0, j, mass[child][i] * values[child][i])
            mass[name], values[name] = total, weighted / total
            motion = values[name][:, 2 * dim :].unflatten(1, (-1, dim))
            data[name].x = virtual_features(motion, torch.full((size.shape[0],), level), scene["gravity"], self.scales).float()
        for relation in relations:
            source, name, target = relation
            store = data[relation]
            j, i = store.edge_index = self._edges(scene, relation)
            difference = values[target][i] - values[source][j]
            level_of_source = None if name == CELL else torch.full((j.shape[0],), level_of(source))
            odd, even = mesh_features(
                self.config.features, difference[:, :dim], difference[:, dim : 2 * dim], difference[:, -dim:], level_of_source, self.scales
            )
            store.odd, store.even = odd.float(), even.float()


def _meshes(spec: FeatureSpec) -> tuple[str, ...]:
    """Return the materials that are connected along their cells."""
    return tuple(target for _, name, target in spec.relations if name == CELL)


def describe(simulator: LearnedSimulator) -> dict[str, Input]:
    """Return the tensors that a program of this simulator takes, by name."""
    builder, spec, dim = simulator.builder, simulator.builder.spec, simulator.builder.spec.dim
    history = builder.config.history
    inputs = {"gravity": Input((dim,), "float64", "m/s^2", "external acceleration")}
    meshes = _meshes(spec)
    is_periodic = bool(builder.metadata.periodicity)
    positions = "positions, not wrapped into the domain, so that the nodes of a mesh stay together" if is_periodic else "positions"
    for m in spec.materials:
        parameter = MATERIALS[m]
        inputs |= {
            f"pos.{m}": Input((m, dim), "float64", "m", positions),
            f"velocity_history.{m}": Input(
                (m, history, dim), "float64", "m/s", "differences of the last positions divided by frame_dt, oldest first"
            ),
            f"material_params.{m}": Input((m, 1), "float64", parameter.unit, parameter.name),
            f"mass.{m}": Input((m,), "float64", "kg", "mass (per metre of depth in 2D)"),
        }
        if m in meshes:
            inputs[f"rest_pos.{m}"] = Input((m, dim), "float64", "m", "undeformed positions")
        if spec.islands:
            doc = "number of the node's group; edges between materials connect a group"
            inputs[f"island.{m}"] = Input((m,), "int64", "1", doc)
        if spec.islands and m in meshes:
            doc = "number of the node's body, below the number of nodes of meshes; -1 for all nodes if there are no cells"
            inputs[f"body.{m}"] = Input((m,), "int64", "1", doc)
        if spec.islands and is_periodic:
            doc = "position relative to the mean of the node's group, measured along edges; 0 in a group that reaches around the domain"
            inputs[f"arm.{m}"] = Input((m, dim), "float64", "m", doc)
    if spec.islands:
        doc = "whether a group has no edge to the boundary"
        inputs["island_is_free"] = Input(("island",), "bool", "1", doc)
    vector: tuple[int | str, ...] = (BOUNDARY, dim)
    inputs |= {
        "boundary.pos": Input(vector, "float64", "m", "points of walls and obstacles, about one spacing apart"),
        "boundary.vel": Input(vector, "float64", "m/s", "their velocities"),
        "boundary.normal": Input(vector, "float64", "1", "unit normals into free space"),
        "boundary.friction": Input((BOUNDARY,), "float64", "1", "Coulomb coefficient; 1e6 or more is no-slip"),
        "boundary.restitution": Input((BOUNDARY,), "float64", "1", "fraction of the normal velocity that a bounce returns"),
    }
    for level in range(1, spec.num_levels + 1):
        name = grid(level)
        inputs[f"num_nodes.{name}"] = Input(
            (name, 0), "float64", "1", f"no values: its length is the number of virtual nodes of level {level}"
        )
    for relation in spec.relations:
        source, name, target = relation
        doc = f"rows of {source} (row 0) and {target} (row 1)"
        inputs[f"edges.{'.'.join(relation)}"] = Input((2, f"edge.{'.'.join(relation)}"), "int64", "1", doc)
    return inputs


def scene_of(simulator: LearnedSimulator, state: State) -> Scene:
    """Return the tensors that a program of this simulator takes, for a state with velocity history."""
    builder, spec = simulator.builder, simulator.builder.spec
    graph = GraphBuilder(replace(builder.config, trim_boundary=False), builder.metadata)(state)
    pos, rest_pos = (_kept_together(x, state, graph, spec) for x in (state.pos, state.pos if state.rest_pos is None else state.rest_pos))
    scene: Scene = {"gravity": state.gravity} | {f"boundary.{name}": getattr(state.boundary, name) for name in BOUNDARY_FIELDS}
    for m in spec.materials:
        rows, column = graph[m].node_id, builder.metadata.param_names.index(MATERIALS[m].name)
        values = {
            "pos": pos[rows],
            "velocity_history": history_of(state)[rows],
            "material_params": state.material_params[rows, column : column + 1],
            "mass": state.mass[rows],
            "rest_pos": rest_pos[rows],
        }
        if spec.islands:
            values |= {"island": graph[m].island, "arm": graph[m].pos.double()}
        if spec.islands and m in _meshes(spec):
            values["body"] = graph[m].body
        scene |= {f"{name}.{m}": value for name, value in values.items()}
    if spec.islands:
        scene["island_is_free"] = graph.island_is_free
    scene |= {f"num_nodes.{t}": state.pos.new_empty(graph[t].num_nodes, 0) for t in spec.node_types if t.startswith("grid_")}
    scene |= {f"edges.{'.'.join(r)}": graph[r].edge_index for r in spec.relations}
    return {name: scene[name] for name in describe(simulator)}


def _kept_together(pos: Tensor, state: State, graph: HeteroData, spec: FeatureSpec) -> Tensor:
    """Return periodic images of positions that do not tear meshes apart at the seams of the domain."""
    if not state.periodicity:
        return pos
    along_cells = [graph[r[2]].node_id[graph[r].edge_index] for r in spec.relations if r[1] == CELL]
    edges = torch.cat([torch.empty(2, 0, dtype=torch.int64, device=pos.device), *along_cells], dim=1)
    images, _ = unwrapped(np.ascontiguousarray(pos.cpu().numpy()), edges.cpu().numpy(), state.periodicity)
    return torch.from_numpy(images).to(pos.device)


def export_model(simulator: LearnedSimulator, path: Path | str) -> None:
    """Write a simulator's step as a ``torch.export`` program, atomically; ``path`` ends in ``.pt2``.

    Raises:
        ValueError: ``path`` has another file type.
    """
    path = Path(path)
    if path.suffix != ".pt2":
        raise ValueError(f"{path}: an exported program ends in .pt2")
    step = PortableStep(copy.deepcopy(simulator).cpu().eval())
    step.simulator.skips = EVERYTHING
    inputs = describe(simulator)
    example, sizes = _example(inputs)
    dims = {name: Dim(re.sub(r"\W", "_", name)) for name in sizes}
    shapes = {name: {k: dims[n] for k, n in enumerate(i.shape) if isinstance(n, str)} for name, i in inputs.items()}
    with torch.no_grad():
        program = torch.export.export(step, (example,), dynamic_shapes=(shapes,))
    content = io.BytesIO()  # PyTorch's writer aborts the process on a full disk
    torch.export.save(program, content, extra_files={DESCRIPTION: json.dumps(_description(simulator, inputs), indent=1)})
    replace_bytes(path, content.getbuffer())


def _description(simulator: LearnedSimulator, inputs: dict[str, Input]) -> dict[str, Any]:
    """Return what a caller needs to know about a program, as plain values."""
    builder = simulator.builder
    return {
        "model": type(simulator.model).__name__,
        "dataset": builder.metadata.dataset,
        "frame_dt": builder.metadata.frame_dt,
        "spacing": builder.metadata.spacing,
        "connectivity_radius": builder.scales.radius,
        "bounds": builder.metadata.bounds,
        "periodic": builder.metadata.periodic,
        "trained": dict(simulator.described_training()),
        "inputs": {name: asdict(about) for name, about in inputs.items()},
    }


def _example(inputs: dict[str, Input]) -> tuple[Scene, dict[str, int]]:
    """Return an example scene, from which ``torch.export`` traces the operations, and its sizes, all different so that none seems to depend on another."""
    names = dict.fromkeys(n for i in inputs.values() for n in i.shape if isinstance(n, str))
    sizes = {name: 5 + 2 * k for k, name in enumerate(names)}
    random = torch.Generator().manual_seed(0)

    def integers(high: int, *shape: int) -> Tensor:
        return torch.randint(high, shape, generator=random)

    scene: Scene = {}
    for name, about in inputs.items():
        shape = tuple(sizes[n] if isinstance(n, str) else n for n in about.shape)
        if name.startswith("edges."):
            _, source, _, target = name.split(".")
            scene[name] = torch.cat([integers(sizes[source], 1, shape[1]), integers(sizes[target], 1, shape[1])])
        elif name == "island_is_free":
            scene[name] = integers(2, *shape) > 0
        elif about.dtype == "int64":
            group, _, material = name.partition(".")
            scene[name] = integers(sizes[material if group == "body" else group], *shape)
        else:
            scene[name] = 1 + torch.rand(shape, dtype=torch.float64, generator=random)
    return scene, sizes
