"""Scenes at another resolution, with a map back to the original nodes: divided for finer solutions, merged or meshed again for coarser ones.

``divided_particles`` and ``divided_mesh`` split particles and cells. ``coarser`` merges particles, and fills outlines of meshes with larger cells. The total
mass is conserved.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, eye_array, vstack
from scipy.spatial import cKDTree

from gpe_pl.geometry.meshing import triangulate
from gpe_pl.trajectory.state import State, Stress

Positions = Float[np.ndarray, "node dim"]

MARKER = 1e-9
"""Mass of a tracer as a fraction of the mass of the divided particle. So light a particle moves with the others and hardly acts on them."""

PARTS: dict[int, tuple[list[tuple[int, ...]], list[tuple[int, ...]]]] = {
    3: ([(0, 1), (1, 2), (2, 0)], [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]),
    4: (
        [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)],
        [(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3), (4, 5, 6, 8), (5, 4, 7, 8), (5, 6, 8, 9), (7, 5, 8, 9)],
    ),
}
"""Edges of a triangle and of a tetrahedron, and its parts of equal volume (Bey 1995), by the number of corners. The middle of an edge has the number of corners
plus the number of the edge."""


@dataclass(frozen=True)
class Divided:
    """A scene at a finer spacing.

    Attributes:
        state: state of the finer scene. Its first nodes are those of the original scene, with the same numbers.
        origin: weights [node, original node] that interpolate values of the original nodes; the rows sum to 1.
    """

    state: State
    origin: csr_array


@dataclass(frozen=True)
class Resolved:
    """A scene at another resolution.

    Attributes:
        state: initial state.
        restrict: function from positions of the nodes of ``state`` [m] to positions of the nodes of the original scene [m].
    """

    state: State
    restrict: Callable[[np.ndarray], np.ndarray]


def coarser(state: State, spacing: float, factor: float = 2.0) -> Resolved:
    """Return the scene with ``factor`` times the spacing between nodes; ``spacing`` is the present one [m].

    Raises:
        ValueError: the mesh has cells that are not triangles in 2D, its scene has already started, or the new mesh would be too coarse.
    """
    if state.cells is None or not len(state.cells):
        return _merged_particles(state, factor * spacing)
    return _remeshed(state, factor * spacing)


# --- particles --------------------------------------------------------------------------------------------------------------------------------


def divided_particles(state: State, spacing: float, factor: int) -> Divided:
    """Divide every particle into ``factor`` parts along each axis, and put a tracer of nearly no mass (``MARKER``) at its position.

    The parts form a lattice. Its axes are those of the particle lattice for materials with cells, and the coordinate axes for all others.

    The tracer of node k has the number k. The parts of all nodes follow, in the order of the nodes.

    Args:
        state: start of a scene.
        spacing: distance of neighbouring particles [m].
        factor: number of parts along each axis.
    """
    dim, count = state.dim, state.num_nodes
    line = (2 * np.arange(factor) + 1 - factor) / (2 * factor)
    shifts = spacing * np.array(list(itertools.product(line, repeat=dim))) @ _lattice_axes(state)
    parts = shifts.shape[1]
    pos = np.concatenate([state.pos, (state.pos[:, None] + shifts).reshape(-1, dim)])
    rows = np.concatenate([np.arange(count), np.repeat(np.arange(count), parts)])
    fraction = np.concatenate([np.full(count, MARKER), np.full(count * parts, (1 - MARKER) / parts)])
    origin = csr_array((np.ones(len(rows)), (np.arange(len(rows)), rows)), shape=(len(rows), count))
    return Divided(_rows(state, rows, pos, fraction * state.mass[rows]), origin)


def _lattice_axes(state: State) -> np.ndarray:
    """Return the axes of the undeformed lattice around each particle [node, axis, dim]; those of space for materials without cells.

    The lattice cells are cut into simplices whose ``dim`` shortest edges have the directions of the lattice.
    """
    axes = np.tile(np.eye(state.dim), (state.num_nodes, 1, 1))
    if state.cells is None or not len(state.cells):
        return axes
    corners = np.asarray(state.pos)[state.cells]
    edges = np.stack([corners[:, b] - corners[:, a] for a, b in itertools.combinations(range(corners.shape[1]), 2)], axis=1)
    length = np.linalg.norm(edges, axis=-1)
    shortest = np.argsort(length, axis=1, kind="stable")[:, : state.dim]
    directions = np.take_along_axis(edges / length[..., None], shortest[..., None], axis=1)
    meshed = np.flatnonzero(np.isin(state.node_type, np.unique(state.node_type[state.cells])))
    axes[meshed] = directions[cKDTree(corners.mean(axis=1)).query(np.asarray(state.pos)[meshed])[1]]
    return axes


def _merged_particles(state: State, size: float) -> Resolved:
    """Merge particles of equal type and parameters within one lattice cell at their centre of mass; ``restrict`` keeps their offsets from it."""
    cell = np.floor(state.pos / size).astype(np.int64)
    kind = np.column_stack([cell, state.node_type, np.nan_to_num(state.material_params, nan=-1.0)])
    _, first, group = np.unique(kind, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    mass = np.bincount(group, state.mass)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(group, state.mass * column) / mass for column in values.T], axis=1)

    pos = mean(state.pos)
    beside = state.pos - pos[group]
    merged = replace(_rows(state, first, pos, mass), vel=mean(state.vel))
    return Resolved(merged, lambda pos: pos[group] + beside)


def _rows(state: State, rows: np.ndarray, pos: np.ndarray, mass: np.ndarray) -> State:
    """Return the particles of these rows with other positions [node, dim] in m and masses [node] in kg."""
    return replace(state.take(rows), pos=pos, mass=mass, velocity_history=None, rest_pos=None, cells=None)


# --- meshes -----------------------------------------------------------------------------------------------------------------------------------


def _check_start(state: State) -> None:
    if state.time > 0:
        raise ValueError(f"the mesh at {state.time:g} s is deformed; only the start of a scene can have another resolution")


def divided_mesh(state: State, factor: int) -> Divided:
    """Divide every cell into ``factor`` ** dim parts of equal volume. Original nodes keep their numbers and positions.

    Part k of cell c has the number ``k num_cells + c``.

    Args:
        state: start of a scene.
        factor: power of 2.

    Raises:
        ValueError: the cells are neither triangles in 2D nor tetrahedra in 3D, or the scene has already started.
    """
    _check_start(state)
    cells = state.cells
    if cells is None or cells.shape[1] != state.dim + 1:
        raise ValueError(
            "only meshes of triangles in 2D and of tetrahedra in 3D can be divided; choose data.scene.cell=triangle or tetrahedron"
        )
    origin: Any = eye_array(state.num_nodes, format="csr")
    for _ in range(round(math.log2(factor))):
        ends, parts = PARTS[cells.shape[1]]
        sides = np.sort(cells[:, ends].reshape(-1, 2), axis=1)
        edges, number = np.unique(sides, axis=0, return_inverse=True)
        count = origin.shape[0]
        local = np.concatenate([cells, count + number.reshape(-1, len(ends))], axis=1)
        cells = np.concatenate([local[:, part] for part in parts])
        rows = np.repeat(np.arange(len(edges)), 2)
        middles = csr_array((np.full(len(rows), 0.5), (rows, edges.ravel())), shape=(len(edges), count))
        origin = csr_array(vstack([origin, middles @ origin]))
    near = np.asarray(origin.argmax(axis=1)).ravel()
    new = _mesh_state(state, near, origin @ state.pos, cells, origin @ state.vel, origin @ _density(state))
    return Divided(replace(new, material_params=origin @ state.material_params), origin)


def _remeshed(state: State, spacing: float) -> Resolved:
    """Fill the outline of the mesh with new triangles; original nodes move with the nearest new triangle."""
    _check_start(state)
    if state.dim != 2 or state.cells is None or state.cells.shape[1] != 3:
        raise ValueError("only meshes of triangles can be meshed again")
    loops = [state.pos[loop] for loop in outline(state.cells)]
    points, cells = triangulate(loops, spacing, np.random.default_rng(0))
    nodes, weights = _locate(points, cells, state.pos)
    near = cKDTree(state.pos).query(points)[1]
    # a velocity field that is linear in space (translation and spin) is reproduced exactly
    linear = np.column_stack([np.ones(state.num_nodes), state.pos])
    field = np.linalg.lstsq(linear, state.vel, rcond=None)[0]
    rest = state.vel - linear @ field
    vel = np.column_stack([np.ones(len(points)), points]) @ field + rest[near]
    return Resolved(
        _mesh_state(state, near, points, cells, vel, _density(state)[near]), lambda pos: np.einsum("nc,ncd->nd", weights, pos[nodes])
    )


def _mesh_state(state: State, near: np.ndarray, pos: np.ndarray, cells: np.ndarray, vel: np.ndarray, density: np.ndarray) -> State:
    """Return a state with another mesh of the same body and the same total mass; a new node takes other values from an old one, ``near`` [node]."""
    mass = density * _lumped_volume(pos, cells)
    components = 4 if state.dim == 2 else 6
    stress = None if state.stress is None else Stress(np.zeros((len(pos), components)), np.zeros((len(cells), components)))
    mass *= state.mass.sum() / mass.sum()
    return replace(state.take(near), pos=pos, vel=vel, mass=mass, velocity_history=None, rest_pos=pos.copy(), cells=cells, stress=stress)


def _density(state: State) -> np.ndarray:
    """Return the density at each node of a mesh [kg/m^dim]."""
    assert state.cells is not None
    return np.asarray(state.mass / _lumped_volume(state.pos, state.cells))


def _lumped_volume(pos: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return for each node the sum of the volumes of its cells, which are simplices [m^dim]."""
    corners = pos[cells]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    return np.bincount(cells.ravel(), np.repeat(volume, cells.shape[1]), minlength=len(pos))


def outline(cells: Int[np.ndarray, "cell 3"]) -> list[list[int]]:
    """Return the closed loops of nodes along edges that belong to one triangle only.

    Raises:
        ValueError: loops touch in a node.
    """
    sides = cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, number, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    once = sides[count[number.ravel()] == 1]
    following = dict(once.tolist())
    if len(following) != len(once):
        raise ValueError("two outlines of the mesh touch in a node")
    loops = []
    while following:
        first, node = following.popitem()
        loop = [first]
        while node != first:
            loop.append(node)
            node = following.pop(node)
        loops.append(loop)
    return loops


def _locate(points: np.ndarray, cells: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes [node, 3] and barycentric weights [node, 3] of a triangle for each wanted point.

    It is the triangle that contains the point or, for a point outside all, the one with the largest smallest weight among those nearby.
    """
    a = points[cells[:, 0]]
    inverse = np.linalg.inv(np.stack([points[cells[:, 1]] - a, points[cells[:, 2]] - a], axis=2))
    num_near = min(12, len(cells))
    near = cKDTree(points[cells].mean(axis=1)).query(wanted, num_near)[1].reshape(len(wanted), num_near)
    local = np.einsum("nkij,nkj->nki", inverse[near], wanted[:, None] - a[near])
    weights = np.concatenate([1 - local.sum(axis=2, keepdims=True), local], axis=2)
    best = np.argmax(weights.min(axis=2), axis=1)
    rows = np.arange(len(wanted))
    return cells[near[rows, best]], weights[rows, best]
