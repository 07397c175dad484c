"""Adds to a graph what ``nn.elastic_bodies`` needs to move bodies within a frame: cells, rest shapes, velocities, walls and corners of obstacles."""

from __future__ import annotations

import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.contacts import corners_near_edges, nearest_walls
from gpe_pl.graphs.features import Scales, from_centre
from gpe_pl.graphs.topology import GraphError, Topology
from gpe_pl.schema import BOUNDARY, RADIUS, FeatureSpec
from gpe_pl.trajectory.state import State


def add_cells(data: HeteroData, topology: Topology, state: State, spec: FeatureSpec, scales: Scales, precision: torch.dtype) -> None:
    """Add the cells of each material of meshes, their rest shape, velocities at the frame, walls and corners to a graph. ``GraphBuilder`` lists the entries.

    Args:
        data: graph of the state.
        topology: its topology.
        state: the state, as tensors.
        spec: channels of the graph.
        scales: units of the data set.
        precision: precision of floating-point values.

    Raises:
        GraphError: cells are surfaces or of several kinds, or walls move.
    """
    device, dim, boundary = state.pos.device, spec.dim, state.boundary
    if boundary.motion is not None or bool((boundary.vel != 0).any()):
        raise GraphError("graph.cells=true needs walls at rest, the walls of this scene move; choose graph.cells=false model.elastic=false")
    data.gravity = (state.gravity[None] * scales.frame_dt**2).to(precision)
    at_frame = state.vel if state.frame_velocity is None else state.frame_velocity
    mesh, islands = topology.mesh, topology.islands
    for material in spec.meshes:
        store, rows = data[material], topology.rows[material]
        pos = state.pos[rows]
        edges = _in_state(topology.edges.get((BOUNDARY, RADIUS, material)), topology.boundary_rows)
        store.wall = nearest_walls(pos, boundary, boundary.shapes, edges, scales.spacing, topology.periodicity).to(precision)
        store.velocity = (torch.cat([state.vel[rows], at_frame[rows]], dim=1) * scales.frame_dt).to(precision)
        store.corner_index, store.corner = torch.empty(0, 2, dtype=torch.int64, device=device), store.velocity.new_empty(0, dim + 1)
        store.body_pos, store.rest_pos = (torch.zeros_like(pos, dtype=precision) for _ in range(2))
        store.cell_index = torch.empty(0, 2**dim, dtype=torch.int64, device=device)
        if mesh is None or islands is None or state.cells is None or not len(rows):
            continue
        now = pos if mesh.shift is None else pos + mesh.shift[rows]
        rest = mesh.rest_pos[rows]
        store.body_pos, store.rest_pos = (from_centre(x, islands.body[material], islands.num_bodies).to(precision) for x in (now, rest))
        cells = _cells(state, rows, material, dim)
        padding = cells[:, -1:].expand(-1, 2**dim - cells.shape[1])
        store.cell_index = torch.cat([cells, padding], dim=1)
        if dim == 2 and not topology.periodicity:
            pairs = corners_near_edges(pos, rest, cells, boundary, scales.spacing, scales.radius)
            store.corner_index, store.corner = pairs[0], pairs[1].to(precision)


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
    if are_surfaces or bool((cells[:, 1:] == cells[:, :-1]).any()):
        raise GraphError(
            f"{material}: graph.cells=true needs {'triangles or quadrilaterals' if dim == 2 else 'tetrahedra or hexahedra'}, "
            f"this mesh {'is a surface' if are_surfaces else 'mixes them'}; choose graph.cells=false model.elastic=false"
        )
    return cells
