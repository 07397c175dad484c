"""The part of the topology of a scene with meshes that does not change with time. It is computed once and cached by the content of the mesh's arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numba import njit
from torch import Tensor

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.graphs.features import Scales
from gpe_pl.graphs.islands import image_shifts
from gpe_pl.graphs.multiscale import MAX_CACHED, MultiscaleGraph, multiscale_graph
from gpe_pl.graphs.topology import GraphError, MeshEdges, MeshTopology
from gpe_pl.schema import CELL, DOWN, NODE_TYPES, RADIUS, EdgeType, FeatureSpec, level_of, node_code
from gpe_pl.system.compiled import is_wanted
from gpe_pl.trajectory.cells import pair_keys
from gpe_pl.trajectory.state import State


@dataclass(frozen=True, eq=False)
class MeshParts:
    """The part of the topology of a scene with meshes that is the same in all frames.

    Attributes:
        mesh: the multi-scale graph.
        edges: ``edge_index`` of each relation of meshes, as rows of node stores.
        at_rest: virtual nodes and their edges; in periodic domains without the shifts of a frame.
        body: body that each node of the materials with meshes moves with, by material.
        num_bodies: number of these bodies.
        joints: pairs of nodes that belong to one body: those with a common cell, and nodes without a cell with the node beside them.
        cell_keys: sorted ``pair_keys`` of the edges along cells.
    """

    mesh: MultiscaleGraph
    edges: dict[EdgeType, Int64[Tensor, "2 _"]]
    at_rest: MeshTopology
    body: dict[str, Int64[Tensor, " _"]]
    num_bodies: int
    joints: Int64[np.ndarray, "2 joint"]
    cell_keys: Int64[np.ndarray, " cell_edge"]

    def contacts(self, pairs: Int64[np.ndarray, "2 pair"], radius: float) -> Int64[np.ndarray, "2 contact"]:
        """Return those of the given pairs of near nodes that are contacts, see ``MultiscaleGraph.are_in_contact``."""
        if not is_wanted():
            return pairs[:, self.mesh.are_in_contact(pairs, radius)]
        contacts: np.ndarray = _contacts(pairs, self.mesh.body, self.mesh.rest_pos, self.cell_keys, (2 * radius) ** 2)
        return contacts

    def topology(self, pos: Float64[np.ndarray, "node dim"], periodicity: Periodicity) -> MeshTopology:
        """Return the virtual nodes of a frame, with the shifts that keep meshes in one piece in a periodic domain.

        Raises:
            GraphError: a mesh wraps around a periodic domain.
        """
        if not periodicity:
            return self.at_rest
        shifts, goes_around = image_shifts(pos, self.joints, periodicity)
        if goes_around.any():
            raise GraphError(f"the mesh of node {int(goes_around.argmax())} goes around the periodic domain, so it has no rest shape")
        return replace(self.at_rest, shift=torch.from_numpy(shifts))


def mesh_parts(state: State, spec: FeatureSpec, scales: Scales) -> MeshParts | None:
    """Return the ``MeshParts`` of a state, or None if the state has no mesh.

    Raises:
        GraphError: the cells do not fit the nodes.
        MeshError: a cell has a node that does not exist, or a rest position is not finite.
    """
    if not spec.meshes or state.cells is None or state.cells.shape[0] == 0:
        return None
    if state.rest_pos is None:
        raise GraphError("state has cells but no rest_pos; a mesh needs both, or graph.mesh=false takes its nodes as particles")
    rest_pos, cells, kinds = (np.ascontiguousarray(x.cpu().numpy()) for x in (state.rest_pos, state.cells, state.node_type))
    mesh = multiscale_graph(rest_pos, cells, scales.spacing, spec.num_levels, state.periodicity)
    settings = spec.materials, spec.relations, spec.num_levels, scales.spacing, state.periodicity
    return _parts(mesh, cells.tobytes(), cells.shape, kinds.tobytes(), *settings)


@lru_cache(maxsize=MAX_CACHED)
@torch.inference_mode(False)  # a rollout may be the first to ask, and training the next
def _parts(
    mesh: MultiscaleGraph,
    cells: bytes,
    shape: tuple[int, int],
    kinds: bytes,
    materials: tuple[str, ...],
    relations: tuple[EdgeType, ...],
    num_levels: int,
    spacing: float,
    periodicity: Periodicity,
) -> MeshParts:
    kind, meshes = np.frombuffer(kinds, np.int64), tuple(r[0] for r in relations if r[1] == CELL)
    _check_cells(np.frombuffer(cells, np.int64).reshape(shape), kind, meshes)
    num_virtual = np.bincount(mesh.level, minlength=num_levels + 1)[1:]
    row = np.empty(len(mesh.level), np.int64)  # of each point in its store
    for m in materials:
        own = kind == node_code(m)
        row[: mesh.num_nodes][own] = np.arange(own.sum())
    row[mesh.num_nodes :] = np.concatenate([np.arange(0), *map(np.arange, num_virtual)])
    ends = dict(_ends(mesh, kind, relations, meshes))
    moves_with, bonds = mesh.moving_bodies(kind, spacing, periodicity)
    body, num_bodies = _bodies(moves_with, kind, meshes)
    at_rest = MeshTopology(
        tuple(num_virtual.tolist()),
        torch.from_numpy(np.stack([mesh.descent[0] - mesh.num_nodes, mesh.descent[1]])),
        torch.tensor(mesh.rest_pos),
        edges=MeshEdges(tuple(ends), tuple(e.shape[1] for e in ends.values()), torch.from_numpy(np.concatenate([*ends.values()], axis=1))),
    )
    edges = {relation: torch.from_numpy(row[e]) for relation, e in ends.items()}
    joints = np.concatenate([mesh.cell_edges, bonds], axis=1)
    return MeshParts(mesh, edges, at_rest, body, num_bodies, joints, np.sort(pair_keys(mesh.cell_edges, mesh.num_nodes)))


def _check_cells(cells: np.ndarray, kind: np.ndarray, meshes: tuple[str, ...]) -> None:
    kinds = kind[cells]
    wrong = (kinds != kinds[:, :1]).any(axis=1) | ~np.isin(kinds[:, 0], [node_code(m) for m in meshes])
    if wrong.any():
        cell = int(wrong.argmax())
        found = ", ".join(sorted({NODE_TYPES[code] for code in kinds[cell].tolist()}))
        raise GraphError(f"cell {cell} has nodes of {found}; a cell is of one material, and meshes are of {', '.join(meshes)}")


def _ends(
    mesh: MultiscaleGraph, kind: np.ndarray, relations: tuple[EdgeType, ...], meshes: tuple[str, ...]
) -> Iterator[tuple[EdgeType, np.ndarray]]:
    """Yield each relation of meshes with its edges [2, edge] between points of the multi-scale graph."""
    for relation in relations:
        source, name, target = relation
        if name == RADIUS:
            continue
        chosen = mesh.cell_edges
        if name != CELL:
            chosen, level = mesh.down_edges if name == DOWN else mesh.same_edges, level_of(source)
            chosen = chosen[:, slice(*np.searchsorted(mesh.level[chosen[0]], [level, level + 1]))]
        if target in meshes and len(meshes) > 1:
            chosen = chosen[:, kind[chosen[1]] == node_code(target)]
        yield relation, chosen


def _bodies(moves_with: np.ndarray, kind: np.ndarray, meshes: tuple[str, ...]) -> tuple[dict[str, Tensor], int]:
    """Return the body that each mesh node moves with, by material, and the number of bodies."""
    rows = [np.flatnonzero(kind == node_code(m)) for m in meshes]
    names, body = np.unique(moves_with[np.concatenate(rows)], return_inverse=True)
    parts = torch.from_numpy(body).split([len(r) for r in rows])
    return dict(zip(meshes, parts, strict=True)), len(names)


@njit(cache=True, error_model="numpy")
@no_type_check
def _contacts(pairs, body, rest_pos, cell_keys, far):
    num_nodes, dim = rest_pos.shape
    kept = np.empty(pairs.shape[1], np.int64)
    number = 0
    for k in range(pairs.shape[1]):
        j, i = pairs[0, k], pairs[1, k]
        is_contact = body[j] != body[i]
        if not is_contact:
            squared = 0.0
            for a in range(dim):
                d = rest_pos[i, a] - rest_pos[j, a]
                squared += d * d
            if squared > far:
                key = min(i, j) * num_nodes + max(i, j)
                place = np.searchsorted(cell_keys, key)
                is_contact = place == len(cell_keys) or cell_keys[place] != key
        if is_contact:
            kept[number] = k
            number += 1
    found = np.empty((2, number), np.int64)
    for k in range(number):
        found[0, k], found[1, k] = pairs[0, kept[k]], pairs[1, kept[k]]
    return found
