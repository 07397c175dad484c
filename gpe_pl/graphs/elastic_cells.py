"""Adds to a graph what ``nn.elastic_bodies`` needs to move bodies within a frame: cells, rest shapes, velocities, walls, corners of obstacles, other bodies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.geometry.compiled_distance import has_compiled_distance
from gpe_pl.geometry.compiled_surfaces import write_nearest_surfaces
from gpe_pl.geometry.relief import REACH, SOFT, reliefs
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.graphs import elastic_cells_kernels
from gpe_pl.graphs.compiled_graph import NO_ROWS, works_on
from gpe_pl.graphs.contacts import (
    MOST_FRICTION,
    NORMAL_STEP,
    beside_first_node,
    convex_corners,
    corners_near_edges,
    nearest_walls,
    oriented_edges,
)
from gpe_pl.graphs.features import Scales, from_centre
from gpe_pl.graphs.search import as_array
from gpe_pl.graphs.topology import GraphError, Topology
from gpe_pl.schema import BOUNDARY, RADIUS, TOUCH_REACH, FeatureSpec
from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.state import State

NO_EDGES = np.empty((0, 2), np.int64)
PROBED, FARTHEST = 1.5, 4.0
"""Largest distance from a wall at which its relief is computed, and largest one of nodes that have a relief, in rest spacings."""
WITHOUT_RELIEF = ("wall", "bowl")
"""Shapes that are nowhere sharper than a flat wall."""
TOUCHING = 0.1
"""Depth in rest spacings up to which an undeformed node touches a wall instead of being in it."""
ATTACHED, FLATTEST, MOST_NEAR = 1.8, 0.1, 40
"""Distance in rest spacings of the nodes to which loose nodes are attached, least volume of such a cell over that of a box of its longest edge, and the number
of nearest nodes that are tried."""


def add_cells(
    data: HeteroData, topology: Topology, state: State, spec: FeatureSpec, scales: Scales, precision: torch.dtype, reads_relief: bool
) -> None:
    """Add the cells of each material of meshes, their rest shape, velocities, and what they may touch to a graph. ``GraphBuilder`` lists the entries.

    Args:
        data: graph of the state.
        topology: its topology.
        state: the state, as tensors.
        spec: channels of the graph.
        scales: units of the data set.
        precision: precision of floating-point values.
        reads_relief: whether the relief of walls is computed; otherwise it is zero.

    Raises:
        GraphError: cells are surfaces or of several kinds, or walls move.
    """
    dim, boundary = spec.dim, state.boundary
    if boundary.motion is not None or boundary.made_once("moves", lambda: bool((boundary.vel != 0).any())):
        raise GraphError("graph.cells=true needs walls at rest, the walls of this scene move; choose graph.cells=false model.elastic=false")
    data.gravity = (state.gravity[None] * scales.frame_dt**2).to(precision)
    compiled = works_on(state)
    for material in spec.meshes:
        at_rest = _at_rest(topology, state, material, dim, precision, scales.spacing)
        entries = (_entries_in_compiled_loops if compiled else _entries)(topology, state, material, at_rest, scales, precision)
        wall = entries["wall"]
        entries["relief"] = _reliefs(state, topology.rows[material], wall, scales.spacing) if reads_relief else wall.new_zeros(len(wall))
        entries["rest_gap"] = (
            _rest_gaps(topology, state, material, scales.spacing).to(wall) if reads_relief else torch.full_like(wall[:, 0], torch.inf)
        )
        touching = _touching(topology, state, material, TOUCH_REACH * scales.spacing, precision)
        own = {"cell_index": at_rest.cell_index, "attached_index": at_rest.attached_index, "rest_pos": at_rest.pos}
        data[material].update({**own, **entries, **touching})


def _touching(topology: Topology, state: State, material: str, reach: float, precision: torch.dtype) -> dict[str, Tensor]:
    """Return the pairs of nodes of different bodies within ``reach`` and the radius, and the vector from the second to the first of each."""
    edges, rows = topology.edges.get((material, RADIUS, material)), topology.rows[material]
    if edges is None or topology.islands is None or not edges.shape[1]:
        return {"touch_index": rows.new_empty(0, 2), "touch": state.pos.new_empty(0, state.pos.shape[1], dtype=precision)}
    body = topology.islands.body[material].to(rows.device)
    first, second = edges[:, body[edges[0]] != body[edges[1]]]
    way = topology.periodicity.shortest(state.pos[rows[first]] - state.pos[rows[second]])
    near = way.square().sum(dim=1) < reach**2
    return {"touch_index": torch.stack([first[near], second[near]], dim=1), "touch": way[near].to(precision)}


def _entries(
    topology: Topology, state: State, material: str, at_rest: _AtRest, scales: Scales, precision: torch.dtype
) -> dict[str, Tensor]:
    """Return the entries of a material that change from frame to frame."""
    rows, mesh, islands = topology.rows[material], topology.mesh, topology.islands
    at_frame = state.vel if state.frame_velocity is None else state.frame_velocity
    pos, dim = state.pos[rows], state.pos.shape[1]
    entries = {
        "wall": _walls(topology, state, material, scales).to(precision),
        "velocity": (torch.cat([state.vel[rows], at_frame[rows]], dim=1) * scales.frame_dt).to(precision),
        "body_pos": torch.zeros_like(pos, dtype=precision),
    }
    if mesh is not None and islands is not None and len(at_rest.cell_index):
        now = pos if mesh.shift is None else pos + mesh.shift[rows]
        entries["body_pos"] = from_centre(now, islands.body[material], islands.num_bodies).to(precision)
    ends, corner = pos.new_empty(0, 2, dtype=torch.int64), pos.new_empty(0, dim + 1)
    if len(at_rest.surface) and not topology.periodicity:
        ends, corner = corners_near_edges(pos, at_rest.surface, state.boundary, scales.spacing, scales.radius)
    return entries | {"corner_index": ends, "corner": corner.to(precision)}


def _entries_in_compiled_loops(
    topology: Topology, state: State, material: str, at_rest: _AtRest, scales: Scales, precision: torch.dtype
) -> dict[str, Tensor]:
    """Return ``_entries`` of a state for which ``compiled_graph.works_on`` is true."""
    pos, vel, rows = as_array(state.pos), as_array(state.vel), topology.rows[material].numpy()
    at_frame = vel if state.frame_velocity is None else as_array(state.frame_velocity)
    (num_rows, dim), dtype, boundary, mesh, islands = (
        (len(rows), pos.shape[1]),
        at_rest.dtype,
        state.boundary,
        topology.mesh,
        topology.islands,
    )
    velocity, body_pos = np.empty((num_rows, 2 * dim), dtype), np.zeros((num_rows, dim), dtype)
    elastic_cells_kernels.write_velocities(vel, at_frame, rows, scales.frame_dt, velocity)
    if mesh is not None and islands is not None and len(at_rest.cell_index):
        shift = NO_ROWS if mesh.shift is None else as_array(mesh.shift)
        elastic_cells_kernels.write_from_centre(pos, shift, rows, islands.body[material].numpy(), islands.num_bodies, body_pos)
    if boundary.shapes and has_compiled_distance(boundary.shapes):
        is_near, wall = np.zeros(num_rows, np.bool_), np.empty((num_rows, dim + 2), dtype)
        touching = topology.edges.get((BOUNDARY, RADIUS, material))
        if touching is not None:
            is_near[touching[1].numpy()] = True
        write_nearest_surfaces(boundary.shapes, pos, rows, is_near, NORMAL_STEP * scales.spacing, MOST_FRICTION, wall)
        walls = torch.from_numpy(wall)
    else:
        walls = _walls(topology, state, material, scales).to(precision)
    ends, corner = np.empty((0, 2), np.int64), np.empty((0, dim + 1), dtype)
    if len(at_rest.surface) and not topology.periodicity:
        corners, points = convex_corners(boundary, scales.spacing), as_array(boundary.pos)
        pairs = elastic_cells_kernels.near_corners(pos, rows, at_rest.surface, points, corners, scales.radius**2)
        if len(pairs):
            ends = at_rest.surface[pairs[:, 0]]
            corner = beside_first_node(pos[rows[ends[:, 0]]], boundary, corners[pairs[:, 1]]).astype(dtype)
    found = {"velocity": velocity, "body_pos": body_pos, "corner_index": ends, "corner": corner}
    return {"wall": walls} | {name: torch.from_numpy(values) for name, values in found.items()}


def _walls(topology: Topology, state: State, material: str, scales: Scales) -> Tensor:
    edges = _in_state(topology.edges.get((BOUNDARY, RADIUS, material)), topology.boundary_rows)
    return nearest_walls(
        state.pos[topology.rows[material]], state.boundary, state.boundary.shapes, edges, scales.spacing, topology.periodicity
    )


def _reliefs(state: State, rows: Tensor, wall: Tensor, spacing: float) -> Tensor:
    """Return how much farther the wall of each node seems to be, because it is sharp or thin there [node] in m; see ``geometry.relief``.

    A node farther than ``PROBED`` from a wall has the relief of the point in front of it at this distance, since it may reach it within the frame. Beyond
    ``FARTHEST``, deep in a solid, and in scenes without shapes there is none.
    """
    boundary, dim = state.boundary, state.pos.shape[1]
    relief = wall.new_zeros(len(rows))
    obstacles = boundary.made_once("obstacles", lambda: tuple(shape for shape in boundary.shapes if shape.kind not in WITHOUT_RELIEF))
    if not obstacles:
        return relief
    pos, (normal, distance) = as_numpy(state.pos[rows]), np.split(as_numpy(wall[:, : dim + 1]).astype(float), [dim], axis=1)
    beyond = np.maximum(distance - PROBED * spacing, 0.0)
    near = (normal != 0).any(axis=1) & (-REACH * spacing < distance[:, 0]) & (distance[:, 0] < FARTHEST * spacing)
    points = pos[near] - beyond[near] * normal[near]
    beside = signed_distance(obstacles, points) < (REACH + SOFT) * spacing  # farther away the kernel meets no obstacle
    near[near] = beside
    found = reliefs(boundary.shapes, points[beside], np.minimum(distance[near, 0], PROBED * spacing), spacing)
    relief[torch.from_numpy(near).to(relief.device)] = torch.from_numpy(found).to(relief)
    return relief


@torch.inference_mode(False)  # a rollout may be the first to ask, and training the next
def _rest_gaps(topology: Topology, state: State, material: str, spacing: float) -> Tensor:
    """Return how far the undeformed nodes [node] are from walls [m]; infinite without cells, and where the undeformed shape reaches into a wall.

    Rest positions count as those of the scene. The result is kept with the mesh for as long as the boundary is the same, and has no gradient.
    """
    rows, mesh, boundary = topology.rows[material], topology.mesh, state.boundary
    if mesh is None or state.cells is None or not len(rows) or not len(boundary.pos):
        return state.pos.new_full((len(rows),), torch.inf)
    now = boundary.made_once("version", object)
    kept: dict[str, tuple[object, Tensor]] = mesh.__dict__.setdefault("_rest_gaps", {})  # not a field, so neither compared nor stored
    if material not in kept or kept[material][0] is not now:
        pos = as_numpy(mesh.rest_pos[rows])
        if boundary.shapes:
            gap = signed_distance(boundary.shapes, pos)
        else:  # planes of the nearest boundary nodes
            nearest = boundary.tree(topology.periodicity).query(pos)[1]
            way = topology.periodicity.shortest(pos - as_numpy(boundary.pos)[nearest])
            gap = (way * as_numpy(boundary.normal)[nearest]).sum(axis=1)
        at_wall = gap > -TOUCHING * spacing  # also a body that lies on the floor, up to rounding
        kept[material] = now, torch.from_numpy(np.where(at_wall, np.maximum(gap, 0.0), np.inf)).to(state.pos.device)
    return kept[material][1]


@dataclass(frozen=True)
class _AtRest:
    """What the bodies of a material have in all frames.

    Attributes:
        pos: undeformed positions relative to the mean of the body [node, dim] in m; zero without cells.
        cell_index: corners of each cell [cell, 2^dim].
        attached_index: the same for the cells that attach loose nodes.
        surface: nodes of the edges at the surface of bodies in 2D, the body on the left [edge, 2]; empty in 3D.
        dtype: precision of the entries.
    """

    pos: Tensor
    cell_index: Tensor
    attached_index: Tensor
    surface: np.ndarray
    dtype: Any


@torch.inference_mode(False)  # a rollout may be the first to ask, and training the next
def _at_rest(topology: Topology, state: State, material: str, dim: int, precision: torch.dtype, spacing: float) -> _AtRest:
    """Return what bodies have in all frames. It is kept with the virtual nodes of the mesh, which are the same object in all frames of a scene.

    Raises:
        GraphError: cells are surfaces or of several kinds.
    """
    rows, mesh, islands, device = topology.rows[material], topology.mesh, topology.islands, state.pos.device
    dtype = np.dtype(str(precision).removeprefix("torch."))
    if mesh is None or islands is None or state.cells is None or not len(rows):
        no_cells = torch.empty(0, 2**dim, dtype=torch.int64, device=device)
        return _AtRest(torch.zeros(len(rows), dim, dtype=precision, device=device), no_cells, no_cells, NO_EDGES, dtype)

    def make() -> _AtRest:
        cells, rest = _cells(state, rows, material, dim), mesh.rest_pos[rows]
        padding = cells[:, -1:].expand(-1, 2**dim - cells.shape[1])
        surface = oriented_edges(rest, cells) if dim == 2 else NO_EDGES
        centred = from_centre(rest, islands.body[material], islands.num_bodies).to(precision)
        attached = cells.new_empty(0, 2**dim)
        if cells.shape[1] == dim + 1 and not topology.periodicity:
            found = attaching_cells(as_numpy(rest), as_numpy(cells), as_numpy(islands.body[material]), ATTACHED * spacing)
            attached = torch.from_numpy(np.concatenate([found, found[:, -1:].repeat(2**dim - dim - 1, axis=1)], axis=1)).to(device)
        return _AtRest(centred, torch.cat([cells, padding], dim=1), attached, surface, dtype)

    kept: dict[Any, _AtRest] = mesh.__dict__.setdefault("_cells_at_rest", {})  # not a field, so neither compared nor stored
    key = material, state.cell_dim, precision
    if key not in kept:
        kept[key] = make()
    return kept[key]


def attaching_cells(
    rest_pos: Float64[np.ndarray, "node dim"], cells: Int64[np.ndarray, "cell corner"], body: Int64[np.ndarray, " node"], reach: float
) -> Int64[np.ndarray, "more corner"]:
    """Return simplices that attach nodes without a cell to the body beside them. Without cells such nodes would fly away from it.

    A simplex joins a loose node with nodes of cells of the same body within ``reach`` [m]. Those with the largest volume for their size are taken. A node
    without enough such neighbours stays loose.
    """
    dim, in_cells = rest_pos.shape[1], np.zeros(len(rest_pos), bool)
    in_cells[cells] = True
    own, found = np.nonzero(in_cells)[0], []
    for node in np.nonzero(~in_cells & (body >= 0))[0]:
        distance = np.linalg.norm(rest_pos[own] - rest_pos[node], axis=1)
        distance[body[own] != body[node]] = np.inf
        nearest = np.argsort(distance, kind="stable")[:MOST_NEAR]
        near = own[nearest[distance[nearest] < reach]]
        choices = np.array([*combinations(near.tolist(), dim)], dtype=np.int64).reshape(-1, dim)
        edges = rest_pos[choices] - rest_pos[node]
        quality = np.abs(np.linalg.det(edges)) / np.linalg.norm(edges, axis=2).max(axis=1, initial=1e-300) ** dim
        best = max(quality.max(initial=0.0) * (1.0 - 1e-6), FLATTEST)
        # all of the best, so that the order of nodes does not matter, and mirror images are alike
        found += [[node, *choice] for choice in choices[quality > best]]
    return np.array(found, dtype=np.int64).reshape(-1, dim + 1)


def _in_state(edge_index: Tensor | None, boundary_rows: Tensor | None) -> Tensor | None:
    """Return edges from boundary nodes with the rows of the state's boundary nodes."""
    if edge_index is None or boundary_rows is None:
        return edge_index
    return torch.stack([boundary_rows[edge_index[0]], edge_index[1]])


def _cells(state: State, rows: Tensor, material: str, dim: int) -> Tensor:
    """Return the cells of a material [cell, corner] as rows of its store."""
    assert state.cells is not None
    row = torch.full((state.num_nodes,), -1, dtype=torch.int64, device=rows.device)
    row[rows] = torch.arange(len(rows), device=rows.device)
    cells: Tensor = row[state.cells.long()]
    cells = cells[(cells >= 0).all(dim=1)]
    are_surfaces = state.cell_dim not in (None, dim)
    if are_surfaces or cells.shape[1] not in (dim + 1, 2**dim) or bool((cells[:, 1:] == cells[:, :-1]).any()):
        raise GraphError(
            f"{material}: graph.cells=true needs {'triangles or quadrilaterals' if dim == 2 else 'tetrahedra or hexahedra'}, "
            f"this mesh {'is a surface or has lines' if are_surfaces else 'mixes them or has others'}; choose graph.cells=false model.elastic=false"
        )
    return cells
