"""Search for the topology of a graph, with NumPy: neighbours within the radius, the multi-scale graph of meshes, islands and bodies."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gpe_pl.graphs.features import GraphConfig, Scales, from_centre
from gpe_pl.graphs.islands import find_islands, image_shifts
from gpe_pl.graphs.mesh_topology import MeshParts, mesh_parts
from gpe_pl.graphs.neighbors import Points, radius_between, radius_pairs
from gpe_pl.graphs.topology import IslandTopology, MeshTopology, Topology
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import BOUNDARY, MATERIALS, RADIUS, EdgeType, FeatureSpec, node_code
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.state import State

Rows = dict[str, Tensor]
"""Rows of each material's nodes in the state."""


def rows_of(state: State, materials: tuple[str, ...]) -> Rows:
    """Return the rows of each material's nodes in the state."""
    kinds = as_array(state.node_type)
    if len(materials) == 1 and bool((kinds == node_code(materials[0])).all()):
        return {materials[0]: torch.arange(state.num_nodes, device=state.pos.device)}
    return {m: torch.from_numpy(np.flatnonzero(kinds == node_code(m))).to(state.pos.device) for m in materials}


def find_topology(
    state: State, points: Points, rows: Rows, config: GraphConfig, spec: FeatureSpec, scales: Scales, skips: Skips
) -> Topology:
    """Return the topology of a state of float64 tensors.

    Args:
        state: state whose node types the data set has.
        points: positions of its nodes.
        rows: rows of each material's nodes in the state.
        config: settings of the graph.
        spec: node types and relations of the graph.
        scales: connectivity radius and rest spacing.
        skips: levels of skipping; ``static_boundary`` keeps the sorted boundary nodes for later states.

    Raises:
        GraphError: the cells do not fit the nodes, or a mesh wraps around a periodic domain.
        MeshError: a cell has a node that does not exist, or a rest position is not finite.
        SimulationError: there are more neighbours than memory can hold.
    """
    device, space = state.pos.device, state.periodicity
    parts = mesh_parts(state, spec, scales)
    pairs = radius_pairs(points, scales.radius, space)
    if parts is not None:
        pairs = parts.contacts(pairs, scales.radius)
    walls = radius_between(walls_of(state, scales.radius, skips.static_boundary), points, scales.radius, space)
    held = np.empty(0, np.int64) if state.loads is None else state.loads.rows
    if state.openings:
        held = np.concatenate([held, np.flatnonzero(carried(state.openings, points.pos))])
    boundary_rows = None
    if config.trim_boundary:
        walls, boundary_rows = _trimmed(walls, state.boundary.pos.shape[0])
    numbers = {m: r.cpu().numpy() for m, r in rows.items()}
    edges = {
        relation: torch.from_numpy(own).to(device) for relation, own in _by_relation(pairs, walls, numbers, state.num_nodes, spec).items()
    }
    mesh, islands = None, None
    if parts is not None:
        edges |= {relation: edge_index.to(device) for relation, edge_index in parts.edges.items()}
        mesh = parts.topology(points.pos, space).to(device)
    if config.islands:
        islands = _islands(points, pairs, held, parts, mesh, numbers, spec).to(device)
    rows_of_boundary = None if boundary_rows is None else torch.from_numpy(boundary_rows).to(device)
    return Topology(rows, edges, rows_of_boundary, mesh, islands, space)


# --- edges within a radius ----------------------------------------------------------------------------------------------------------------


def walls_of(state: State, radius: float, once: bool = True) -> Points:
    """Return positions of a state's boundary nodes, sorted for searches within a radius [m]. With ``once``, states with the same boundary share the result."""
    boundary, space = state.boundary, state.periodicity

    def sort() -> Points:
        return Points(as_array(boundary.pos), radius, space)

    found: Points = boundary.made_once((radius, space), sort) if once else sort()
    return found


def _trimmed(walls: np.ndarray, num_boundary: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges from walls with boundary nodes numbered among those that have an edge, and these boundary nodes in order."""
    used = np.zeros(num_boundary, dtype=bool)
    used[walls[0]] = True
    new_row = np.cumsum(used) - 1
    return np.stack([new_row[walls[0]], walls[1]]), np.flatnonzero(used)


def _by_relation(
    pairs: np.ndarray, walls: np.ndarray, rows: dict[str, np.ndarray], num_nodes: int, spec: FeatureSpec
) -> dict[EdgeType, np.ndarray]:
    """Return the edges of ``radius`` relations between present node types, as rows of node stores.

    Args:
        pairs: pairs of nodes of the state, the lower one first.
        walls: pairs of a boundary node and a node of the state.
        rows: rows of each material's nodes in the state.
        num_nodes: number of nodes of the state.
        spec: relations of the graph.
    """
    present = [m for m in MATERIALS if m in rows and len(rows[m])]
    if len(present) == 1:
        (only,) = present
        return {(only, RADIUS, only): pairs, (BOUNDARY, RADIUS, only): walls}
    kind, row = np.empty(num_nodes, np.int64), np.empty(num_nodes, np.int64)
    for k, m in enumerate(present):
        kind[rows[m]], row[rows[m]] = k, np.arange(len(rows[m]))
    (j, i), wall_kind = pairs, kind[walls[1]]
    swapped = kind[j] > kind[i]
    j, i = np.where(swapped, i, j), np.where(swapped, j, i)
    code, edges = kind[j] * len(present) + kind[i], dict[EdgeType, np.ndarray]()
    for relation in spec.relations:
        source, name, target = relation
        if name != RADIUS or target not in present or (source != BOUNDARY and source not in present):
            continue
        if source == BOUNDARY:
            own = np.flatnonzero(wall_kind == present.index(target))
            edges[relation] = np.stack([walls[0][own], row[walls[1][own]]])
        else:
            own = np.flatnonzero(code == present.index(source) * len(present) + present.index(target))
            edges[relation] = np.stack([row[j[own]], row[i[own]]])
    return edges


# --- islands and bodies -------------------------------------------------------------------------------------------------------------------


def _islands(
    points: Points,
    pairs: np.ndarray,
    held: np.ndarray,
    parts: MeshParts | None,
    mesh: MeshTopology | None,
    rows: dict[str, np.ndarray],
    spec: FeatureSpec,
) -> IslandTopology:
    """Return the connected groups of nodes of the graph (islands).

    A model has no input from walls beyond the radius. It therefore lets an island fall freely that has no edges to the boundary and that nothing holds, which
    improves stability (docs/results/trials).

    Args:
        points: nodes.
        pairs: pairs of nodes with an edge within the radius.
        held: nodes that a given motion or an opening moves.
        parts: meshes of the scene.
        mesh: the virtual nodes of the frame, with the shifts of the meshes.
        rows: rows of each material's nodes in the state.
        spec: node types of the graph.
    """
    is_held_node = np.zeros(len(points), dtype=bool)
    is_held_node[held] = True
    if parts is not None:
        pairs = np.concatenate([pairs, parts.joints], axis=1)  # a body is in one island
    islands, arm = find_islands(len(points), pairs, is_held_node), None
    if points.periodicity:
        shift, goes_around = image_shifts(points.pos, pairs, points.periodicity)
        whole = np.where(goes_around[:, None], 0.0, points.pos + shift)
        arm = from_centre(torch.from_numpy(whole), torch.from_numpy(islands.label), len(islands.is_free))
    label, is_held = torch.from_numpy(islands.label), torch.from_numpy(~islands.is_free)
    if parts is None or mesh is None:
        no_arms = (
            {m: torch.zeros(len(rows[m]), points.pos.shape[1], dtype=torch.float64) for m in spec.meshes} if points.periodicity else None
        )
        return IslandTopology(label, is_held, {m: torch.full((len(rows[m]),), -1) for m in spec.meshes}, 0, arm, no_arms)
    body_arm = None
    if mesh.shift is not None:
        whole = points.pos + mesh.shift.cpu().numpy()
        body_arm = {m: from_centre(torch.from_numpy(whole[rows[m]]), body, parts.num_bodies) for m, body in parts.body.items()}
    return IslandTopology(label, is_held, parts.body, parts.num_bodies, arm, body_arm)


def as_array(x: Tensor) -> np.ndarray:
    """Return the values of a tensor as a contiguous array."""
    return np.ascontiguousarray(x.detach().cpu().numpy())
