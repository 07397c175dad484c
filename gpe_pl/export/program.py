"""Export of a trained model as a ``torch.export`` program that advances a scene by one frame. The program needs PyTorch but not this package.

The program takes a scene as a dictionary of tensors. It returns the changed tensors and the predictions. The caller gives the topology of the graph: edges,
and islands and virtual nodes if the model uses them. The program does everything else of a step. It does not contain: rollouts of this package move nodes that
enter a wall or an obstacle out again (``rollout.containment``), and a caller of the program has to. In Python::

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

import torch
from torch import Tensor, nn
from torch.export import Dim

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.graphs.features import history_of
from gpe_pl.graphs.topology import IslandTopology, MeshTopology, Topology, descent_of
from gpe_pl.learned.least_distance import LeastDistanceError
from gpe_pl.learned.next_states import accelerations
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.nn.elastic_bodies import CellError
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, DOWN, EdgeType, grid, node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

Scene = dict[str, Tensor]
"""Tensors of a scene by the names of ``describe``."""

DESCRIPTION = "description.json"
EVERYTHING = Skips(absent_types=False, isolated_nodes=False, edges_at_once=None, sorted_from=None)
"""Levels of skipping in an exported program. It always executes the same operations, so levels that leave some out for some scenes are off."""
BOUNDARY_FIELDS = ("pos", "vel", "normal", "friction", "restitution")


@dataclass(frozen=True)
class Input:
    """Description of one tensor of a scene.

    Attributes:
        shape: length of each axis, or its name if the length may differ from call to call.
        dtype: ``float64``, ``int64`` or ``bool``.
        unit: unit of the values.
        doc: meaning of the values.
    """

    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    doc: str


class ExportedStep(nn.Module):
    """One step of a learned simulator, from plain tensors to plain tensors.

    Graph features, model and integration are those of the simulator. The topology of the graph is an input.

    Args:
        simulator: simulator with any model of this package.
    """

    def __init__(self, simulator: LearnedSimulator) -> None:
        super().__init__()
        self.simulator = simulator

    def forward(self, scene: Scene) -> tuple[Scene, Scene]:
        """Return two dictionaries: the changed tensors, and what the model predicts.

        The changed tensors are positions and velocity histories. The predictions are accelerations with gravity, before static friction [m/s²], and stresses
        [Pa] of the materials that have one.
        """
        simulator, state, topology = self.simulator, self.state(scene), self.topology(scene)
        graph = simulator.builder.graph(topology, state)
        predicted = simulator(graph)
        (acc,) = accelerations([state], [topology.rows], predicted.acceleration, simulator.acceleration_std)
        new = simulator.integrated(state, graph, acc)
        moved: Scene = {}
        further: Scene = {}
        for material, r in topology.rows.items():
            moved |= {f"pos.{material}": new.pos[r], f"velocity_history.{material}": history_of(new)[r]}
            further[f"acceleration.{material}"] = acc[r]
        for material, values in predicted.stress.items():
            further[f"stress.{material}"] = values.double() * simulator.stress_std
        return moved, further

    def state(self, scene: Scene) -> State:
        """Return the state of a scene, whose nodes are in the order of their materials.

        The state has no periodic axes, so positions are not wrapped into the domain.
        """
        materials, metadata = self.simulator.builder.spec.materials, self.simulator.builder.metadata

        def joined(name: str) -> Tensor:
            return torch.cat([scene[f"{name}.{m}"] for m in materials])

        def columns(material: str) -> Tensor:
            own = scene[f"material_params.{material}"]
            every = own.new_full((own.shape[0], len(metadata.param_names)), torch.nan)
            return every.index_copy(1, torch.tensor(metadata.columns_of(material)), own)

        history = joined("velocity_history")
        pos, vel, normal, friction, restitution = (scene[f"boundary.{name}"] for name in BOUNDARY_FIELDS)
        return State(
            pos=joined("pos"),
            vel=history[:, -1],
            node_type=torch.cat([torch.full(scene[f"mass.{m}"].shape, node_code(m)) for m in materials]),
            mass=joined("mass"),
            material_params=torch.cat([columns(m) for m in materials]),
            boundary=Boundary(pos, vel, normal, friction, restitution),
            gravity=scene["gravity"],
            velocity_history=history,
        )

    def topology(self, scene: Scene) -> Topology:
        """Return the topology of a scene from its tensors of edges, islands and virtual nodes."""
        builder, spec = self.simulator.builder, self.simulator.builder.spec
        rows: Scene = {}
        num_nodes = 0
        for m in spec.materials:
            first, num_nodes = num_nodes, num_nodes + scene[f"pos.{m}"].shape[0]
            rows[m] = torch.arange(first, num_nodes)
        edges = {relation: scene[f"edges.{'.'.join(relation)}"] for relation in spec.relations}
        mesh = self._mesh(scene, rows, edges) if spec.meshes else None
        islands = self._islands(scene) if spec.islands else None
        return Topology(rows, edges, None, mesh, islands, builder.metadata.periodicity)

    def _mesh(self, scene: Scene, rows: dict[str, Tensor], edges: dict[EdgeType, Tensor]) -> MeshTopology:
        """Return the virtual nodes of a scene. The edges to children determine which mesh nodes lie below each of them."""
        spec = self.simulator.builder.spec
        sizes = tuple(scene[f"num_nodes.{grid(level)}"].shape[0] for level in range(1, spec.num_levels + 1))
        descent = []
        for m in spec.meshes:
            parents, below, num_below = list[Tensor](), m, rows[m].shape[0]
            for level, size in enumerate(sizes, start=1):
                j, i = edges[grid(level), DOWN, below]
                parents.append(torch.full((num_below,), size).scatter(0, i, j))
                below, num_below = grid(level), size
            above, node = descent_of(parents, sizes)
            descent.append(torch.stack([above, rows[m][node]]))
        rest_pos = [scene[f"{'rest_pos' if m in spec.meshes else 'pos'}.{m}"] for m in spec.materials]
        return MeshTopology(sizes, torch.cat(descent, dim=1), torch.cat(rest_pos))

    def _islands(self, scene: Scene) -> IslandTopology:
        spec = self.simulator.builder.spec
        body = {m: scene[f"body.{m}"] for m in spec.meshes}
        num_bodies = sum(b.shape[0] for b in body.values())
        label = torch.cat([scene[f"island.{m}"] for m in spec.materials])
        arm, body_arm = None, None
        if self.simulator.builder.metadata.periodicity:
            arm, body_arm = torch.cat([scene[f"arm.{m}"] for m in spec.materials]), {m: scene[f"body_arm.{m}"] for m in spec.meshes}
        no_island_is_held = torch.zeros(scene["num_islands"].shape[0], dtype=torch.bool, device=label.device)
        return IslandTopology(label, no_island_is_held, body, num_bodies, arm, body_arm)


def describe(simulator: LearnedSimulator) -> dict[str, Input]:
    """Return the tensors that a program of this simulator takes, by name."""
    builder, spec, dim = simulator.builder, simulator.builder.spec, simulator.builder.spec.dim
    history = builder.config.history
    inputs = {"gravity": Input((dim,), "float64", "m/s^2", "external acceleration")}
    is_periodic = bool(builder.metadata.periodicity)
    positions = "positions, not wrapped into the domain, so that the nodes of a mesh stay together" if is_periodic else "positions"
    for m in spec.materials:
        own = spec.parameters[m]
        inputs |= {
            f"pos.{m}": Input((m, dim), "float64", "m", positions),
            f"velocity_history.{m}": Input(
                (m, history, dim), "float64", "m/s", "differences of the last positions divided by frame_dt, oldest first"
            ),
            f"material_params.{m}": Input((m, len(own)), "float64", ", ".join(p.unit for p in own), ", ".join(p.name for p in own)),
            f"mass.{m}": Input((m,), "float64", "kg", "mass (per metre of depth in 2D)"),
        }
        if m in spec.meshes:
            inputs[f"rest_pos.{m}"] = Input((m, dim), "float64", "m", "undeformed positions")
        if spec.islands:
            doc = "number of the node's group; edges between materials connect a group"
            inputs[f"island.{m}"] = Input((m,), "int64", "1", doc)
        if spec.islands and m in spec.meshes:
            doc = "number of the node's body, below the number of nodes of meshes; -1 for all nodes if there are no cells"
            inputs[f"body.{m}"] = Input((m,), "int64", "1", doc)
        if spec.islands and is_periodic:
            doc = "position relative to the mean of the node's group, measured along edges; 0 in a group that reaches around the domain"
            inputs[f"arm.{m}"] = Input((m, dim), "float64", "m", doc)
        if spec.islands and is_periodic and m in spec.meshes:
            doc = "position relative to the mean of the node's body, measured along edges of cells; 0 for all nodes if there are no cells"
            inputs[f"body_arm.{m}"] = Input((m, dim), "float64", "m", doc)
    if spec.islands:
        inputs["num_islands"] = Input(("island", 0), "float64", "1", "no values: its length is the number of groups")
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


class RigidBodyError(GpeError, ValueError):
    """Raised for scenes with rigid bodies, whose nodes an exported program would move one by one."""


def refuse_rigid_bodies(rigid_body: Any) -> None:
    """Raise ``RigidBodyError`` if a node belongs to a rigid body. ``rigid_body`` is that of a state or trajectory [node], or None."""
    if rigid_body is not None and bool((rigid_body >= 0).any()):
        raise RigidBodyError(
            f"exported programs and pages do not move rigid bodies as a whole, and this scene has {len({*rigid_body.tolist()} - {-1})}; "
            "roll it out with this package, or leave model and page out of evaluation.export"
        )


class OpenSceneError(GpeError, ValueError):
    """Raised for scenes with inlets or outlets, which exported programs and pages do not have."""


def refuse_openings(state: State) -> None:
    """Raise ``OpenSceneError`` if a state has inlets or outlets."""
    if state.openings:
        raise OpenSceneError(
            f"exported programs and pages have no inlets and outlets, and this scene has {len(state.openings)}; roll it out with this package"
        )


def refuse_loads(state: State) -> None:
    """Raise ``NodeLoadError`` if a state has prescribed nodes or forces."""
    if state.loads is not None:
        raise NodeLoadError("exported programs and pages have no prescribed nodes and no forces; roll the scene out with this package")


def scene_of(simulator: LearnedSimulator, state: State) -> Scene:
    """Return the tensors that a program of this simulator takes, for a state with velocity history.

    Raises:
        RigidBodyError: the state has rigid bodies.
        OpenSceneError: the state has inlets or outlets.
    """
    refuse_rigid_bodies(state.rigid_body)
    refuse_openings(state)
    refuse_loads(state)
    builder, spec = simulator.builder, simulator.builder.spec
    topology = replace(builder, config=replace(builder.config, trim_boundary=False)).topology(state)
    mesh, islands = topology.mesh, topology.islands
    pos, rest_pos = state.pos, state.pos if state.rest_pos is None else state.rest_pos
    sizes = [0] * spec.num_levels
    if mesh is not None:
        pos, rest_pos, sizes = pos if mesh.shift is None else pos + mesh.shift, mesh.rest_pos, [*mesh.num_virtual]
    scene: Scene = {"gravity": state.gravity} | {f"boundary.{name}": getattr(state.boundary, name) for name in BOUNDARY_FIELDS}
    for m, rows in topology.rows.items():
        values = {
            "pos": pos[rows],
            "velocity_history": history_of(state)[rows],
            "material_params": state.material_params[rows][:, builder.metadata.columns_of(m)],
            "mass": state.mass[rows],
            "rest_pos": rest_pos[rows],
        }
        if islands is not None:
            values["island"] = islands.label[rows]
            if islands.arm is not None:
                values["arm"] = islands.arm[rows]
            if m in islands.body:
                values["body"] = islands.body[m]
            if islands.body_arm is not None and m in islands.body_arm:
                values["body_arm"] = islands.body_arm[m]
        scene |= {f"{name}.{m}": value for name, value in values.items()}
    if islands is not None:
        scene["num_islands"] = state.pos.new_empty(len(islands.is_held), 0)
    scene |= {f"num_nodes.{grid(level)}": state.pos.new_empty(size, 0) for level, size in enumerate(sizes, start=1)}
    none = torch.empty(2, 0, dtype=torch.int64, device=state.pos.device)
    scene |= {f"edges.{'.'.join(relation)}": topology.edges.get(relation, none) for relation in spec.relations}
    return {name: scene[name] for name in describe(simulator)}


class NodeLoadError(GpeError, ValueError):
    """Raised for a simulator that reads prescribed nodes, forces or stresses, which an exported program does not take."""


class MirrorAverageError(GpeError, ValueError):
    """Raised for a simulator that averages over mirror images, which an exported program does not."""


def check_exportable(simulator: LearnedSimulator) -> None:
    """Raise an error for a simulator whose step a program does not have.

    Raises:
        CellError: the model needs the cells of meshes, which a program does not take.
        MirrorAverageError: the simulator averages over mirror images, which a program does not.
        LeastDistanceError: the simulator keeps a least distance of liquid nodes, which a program does not.
        NodeLoadError: the data set of the simulator has prescribed nodes or forces, or the model reads the stress, which a program does not take.
    """
    if simulator.mirror_average:
        raise MirrorAverageError(
            "exported programs do not average over mirror images; choose evaluation.mirror_average=false to export the model without"
        )
    if simulator.least_distance:
        raise LeastDistanceError(
            "exported programs keep no least distance; set least_distance of the simulator to 0 to export the model without"
        )
    if simulator.builder.spec.cells:
        raise CellError("exported programs have no cells; export a model with model.elastic=false graph.cells=false")
    if simulator.builder.spec.loads:
        raise NodeLoadError("exported programs take neither prescribed nodes nor forces; export a model of data without them")
    if simulator.builder.spec.reads_stress:
        raise NodeLoadError("exported programs do not read a stress; export a model with graph.stress=false")


def export_model(simulator: LearnedSimulator, path: Path | str) -> None:
    """Write a simulator's step as a ``torch.export`` program to ``path``, which ends in ``.pt2``. The file appears complete or not at all.

    Raises:
        ValueError: ``path`` has another file type.
        CellError, MirrorAverageError, LeastDistanceError, NodeLoadError: as ``check_exportable`` raises them.
    """
    path = Path(path)
    check_exportable(simulator)
    if path.suffix != ".pt2":
        raise ValueError(f"{path}: an exported program ends in .pt2")
    step = ExportedStep(copy.deepcopy(simulator).cpu().eval())
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
    """Return an example scene and its sizes. ``torch.export`` traces the operations on this scene.

    All sizes are different, so that none seems to depend on another.
    """
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
        elif about.dtype == "int64":
            group, _, material = name.partition(".")
            scene[name] = integers(sizes[material if group == "body" else group], *shape)
        else:
            scene[name] = 1 + torch.rand(shape, dtype=torch.float64, generator=random)
    return scene, sizes
