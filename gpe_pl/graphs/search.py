"""Search for the topology of a graph, with NumPy and SciPy: neighbours within the radius, the multi-scale graph of meshes, islands and bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpe_pl.graphs.features import GraphConfig, Scales, from_centre
from gpe_pl.graphs.islands import find_islands, image_shifts
from gpe_pl.graphs.multiscale import MultiscaleGraph, multiscale_graph
from gpe_pl.graphs.neighbors import radius_between, radius_pairs
from gpe_pl.graphs.topology import GraphError, IslandTopology, MeshTopology, Topology
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, CELL, DOWN, NODE_TYPES, RADIUS, SAME, EdgeType, FeatureSpec, level_of, node_code
from gpe_pl.trajectory.state import State

Rows = dict[str, Tensor]
"""Rows of each material's nodes in the state."""


def rows_of(state: State, materials: tuple[str, ...]) -> Rows:
    """Return the rows of each material's nodes in the state."""
    if len(materials) == 1 and bool((state.node_type == node_code(materials[0])).all()):
        return {materials[0]: torch.arange(state.num_nodes, device=state.pos.device)}
    return {m: torch.nonzero(state.node_type == node_code(m)).flatten() for m in materials}


def find_topology(state: State, rows: Rows, config: GraphConfig, spec: FeatureSpec, scales: Scales, skips: Skips) -> Topology:
    """Return the topology of a state of float64 tensors.

    Args:
        state: state whose node types the data set has.
        rows: rows of each material's nodes in the state.
        config: settings of the graph.
        spec: node types and relations of the graph.
        scales: connectivity radius and rest spacing.
        skips: tell whether to search between absent node types, and whether to keep the search tree of the boundary.

    Raises:
        GraphError: the cells do not fit the nodes, or a mesh wraps around a periodic domain.
        MeshError: a cell has a node that does not exist, or a rest position is not finite.
        SimulationError: there are more neighbours than memory can hold.
    """
    multiscale = _multiscale(state, spec, scales)
    edges = _radius_edges(state, rows, multiscale, spec, scales, skips)
    boundary_rows = _trimmed(edges, len(state.boundary.pos), state.pos.device) if config.trim_boundary else None
    mesh = None
    if multiscale is not None:
        edges |= _mesh_edges(state, rows, multiscale, spec)
        mesh = _mesh(state, multiscale, spec)
    islands = _islands(state, rows, edges, multiscale, spec, scales) if config.islands else None
    return Topology(rows, edges, boundary_rows, mesh, islands, state.periodicity)


# --- edges within a radius ----------------------------------------------------------------------------------------------------------------


def _radius_edges(
    state: State, rows: Rows, mesh: MultiscaleGraph | None, spec: FeatureSpec, scales: Scales, skips: Skips
) -> dict[EdgeType, Tensor]:
    """Return the edges of ``radius`` relations, without relations of absent node types. Boundary nodes are numbered as in the state."""
    walls: Any = state.boundary.tree(state.periodicity) if skips.static_boundary else as_array(state.boundary.pos)
    points = {m: as_array(state.pos[r]) for m, r in rows.items()} | {BOUNDARY: walls}
    present = {m for m, r in rows.items() if len(r)} | ({BOUNDARY} if len(state.boundary.pos) else set())
    edges: dict[EdgeType, Tensor] = {}
    for relation in spec.relations:
        source, name, target = relation
        if name != RADIUS or (skips.absent_types and not {source, target} <= present):
            continue
        if source != target:
            pairs = radius_between(points[source], points[target], scales.radius, state.periodicity)
        else:
            pairs = radius_pairs(points[source], scales.radius, state.periodicity)
            if mesh is not None and source in spec.meshes:
                pairs = pairs[:, mesh.are_in_contact(rows[source].cpu().numpy()[pairs], scales.radius)]
        edges[relation] = torch.from_numpy(pairs).to(state.pos.device)
    return edges


def _trimmed(edges: dict[EdgeType, Tensor], num_boundary: int, device: torch.device) -> Tensor:
    """Return the boundary nodes that have an edge, in order; renumber the edges in place."""
    used = torch.zeros(num_boundary, dtype=torch.bool, device=device)
    for (source, _, _), edge_index in edges.items():
        if source == BOUNDARY:
            used[edge_index[0]] = True
    new_row = torch.cumsum(used, dim=0) - 1
    for relation, edge_index in edges.items():
        if relation[0] == BOUNDARY:
            edges[relation] = torch.stack([new_row[edge_index[0]], edge_index[1]])
    return torch.nonzero(used).flatten()


# --- meshes -------------------------------------------------------------------------------------------------------------------------------


def _multiscale(state: State, spec: FeatureSpec, scales: Scales) -> MultiscaleGraph | None:
    """Return the multi-scale graph of a state's cells, or None if the state has no mesh."""
    if not spec.meshes or state.cells is None or state.cells.shape[0] == 0:
        return None
    if state.rest_pos is None:
        raise GraphError("state has cells but no rest_pos; a mesh needs both, or graph.mesh=false takes its nodes as particles")
    rest_pos, cells = state.rest_pos.cpu().numpy(), state.cells.cpu().numpy()
    mesh = multiscale_graph(rest_pos, cells, scales.spacing, spec.num_levels, state.periodicity)
    kinds = state.node_type[state.cells]
    codes = torch.tensor([node_code(m) for m in spec.meshes], device=kinds.device)
    wrong = (kinds != kinds[:, :1]).any(dim=1) | ~torch.isin(kinds[:, 0], codes)
    if wrong.any():
        cell = int(wrong.nonzero()[0])
        found = ", ".join(sorted({NODE_TYPES[code] for code in kinds[cell].tolist()}))
        raise GraphError(f"cell {cell} has nodes of {found}; a cell is of one material, and meshes are of {', '.join(spec.meshes)}")
    return mesh


def _mesh(state: State, mesh: MultiscaleGraph, spec: FeatureSpec) -> MeshTopology:
    device, shift = state.pos.device, None
    if state.periodicity:
        shifts, goes_around = image_shifts(as_array(state.pos), mesh.cell_edges, state.periodicity)
        if goes_around.any():
            raise GraphError(f"the mesh of node {int(goes_around.argmax())} goes around the periodic domain, so it has no rest shape")
        shift = torch.from_numpy(shifts).to(device)
    above, below = torch.tensor(mesh.descent, device=device)
    descent = torch.stack([above - mesh.num_nodes, below])
    return MeshTopology(_num_virtual(mesh, spec), descent, torch.tensor(mesh.rest_pos, device=device), shift)


def _num_virtual(mesh: MultiscaleGraph, spec: FeatureSpec) -> tuple[int, ...]:
    return tuple(np.bincount(mesh.level, minlength=spec.num_levels + 1)[1:].tolist())


def _mesh_edges(state: State, rows: Rows, mesh: MultiscaleGraph, spec: FeatureSpec) -> dict[EdgeType, Tensor]:
    """Return the edges along cells, to children and between virtual nodes of one level."""
    device = state.pos.device
    row = torch.empty(len(mesh.level), dtype=torch.int64, device=device)  # of each point in its store
    for r in rows.values():
        row[r] = torch.arange(len(r), device=device)
    sizes = _num_virtual(mesh, spec)
    if sizes:
        row[mesh.num_nodes :] = torch.cat([torch.arange(size, device=device) for size in sizes])
    edges: dict[EdgeType, Tensor] = {}
    for name, pairs in ((CELL, mesh.cell_edges), (DOWN, mesh.down_edges), (SAME, mesh.same_edges)):
        edge_level, points = mesh.level[pairs[0]], torch.tensor(pairs, device=device)
        for relation in spec.relations:
            source, relation_name, target = relation
            if relation_name != name:
                continue
            chosen = points
            if name != CELL:
                chosen = points[:, slice(*np.searchsorted(edge_level, [level_of(source), level_of(source) + 1]))]
            if target in spec.meshes and len(spec.meshes) > 1:
                chosen = chosen[:, state.node_type[chosen[1]] == node_code(target)]
            edges[relation] = row[chosen]
    return edges


# --- islands and bodies -------------------------------------------------------------------------------------------------------------------


def _islands(
    state: State, rows: Rows, edges: dict[EdgeType, Tensor], mesh: MultiscaleGraph | None, spec: FeatureSpec, scales: Scales
) -> IslandTopology:
    """Return the connected groups of nodes of the graph (islands), and which of them have no edge to the boundary.

    A model has no input from walls beyond the radius. It therefore lets an island without edges to the boundary fall freely, which improves stability
    (docs/results/trials).
    """
    device = state.pos.device
    between = [torch.empty(2, 0, dtype=torch.int64, device=device)]
    touches = torch.zeros(state.num_nodes, dtype=torch.bool, device=device)
    for (source, _, target), (j, i) in edges.items():
        if source == BOUNDARY:
            touches[rows[target][i]] = True
        elif source in rows and target in rows:
            between.append(torch.stack([rows[source][j], rows[target][i]]))
    pairs = torch.cat(between, dim=1).cpu().numpy()
    islands = find_islands(state.num_nodes, pairs, touches.cpu().numpy())
    label, arm = torch.from_numpy(islands.label).to(device), None
    if state.periodicity:
        shift, goes_around = image_shifts(as_array(state.pos), pairs, state.periodicity)
        whole = torch.from_numpy(np.where(goes_around[:, None], 0.0, as_array(state.pos) + shift)).to(device)
        arm = from_centre(whole, label, len(islands.is_free))
    body, num_bodies = _bodies(state, rows, mesh, spec, scales)
    return IslandTopology(label, torch.from_numpy(islands.is_free).to(device), body, num_bodies, arm)


def _bodies(state: State, rows: Rows, mesh: MultiscaleGraph | None, spec: FeatureSpec, scales: Scales) -> tuple[Rows, int]:
    """Return the body that each mesh node moves with, by material, and the number of bodies."""
    if mesh is None:
        return {m: torch.full_like(rows[m], -1) for m in spec.meshes}, 0
    nodes = torch.cat([rows[m] for m in spec.meshes]).cpu().numpy()
    moves_with = mesh.moving_bodies(state.node_type.cpu().numpy().astype(np.int64), scales.spacing)[nodes]
    names, body = np.unique(moves_with, return_inverse=True)
    parts = torch.from_numpy(body).to(state.pos.device).split([len(rows[m]) for m in spec.meshes])
    return dict(zip(spec.meshes, parts, strict=True)), len(names)


def as_array(x: Tensor) -> np.ndarray:
    """Return the values of a tensor as a contiguous array."""
    return np.ascontiguousarray(x.detach().cpu().numpy())
