"""Scenes at another resolution, for studies of a solver's convergence, with a map back to the original nodes.

Particles are divided into 2^dim children, or merged with their neighbours; mass is conserved. Meshes get divided cells, or their outline is meshed again with
longer edges. ``Resolved.restrict`` returns the positions of the original nodes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from gpe_pl.geometry.meshing import triangulate
from gpe_pl.trajectory.state import State, Stress

Positions = Float[np.ndarray, "node dim"]


@dataclass(frozen=True)
class Resolved:
    """A scene at another resolution.

    Attributes:
        state: initial state.
        restrict: function from positions of the nodes of ``state`` [m] to positions of the nodes of the original scene [m].
    """

    state: State
    restrict: Callable[[np.ndarray], np.ndarray]


def finer(state: State, spacing: float) -> Resolved:
    """Return the scene with half the spacing between nodes; ``spacing`` is the present one [m].

    Raises:
        ValueError: the mesh has cells that are not triangles in 2D, or its scene has already started.
    """
    return _divided_particles(state, spacing) if state.cells is None or not len(state.cells) else _divided_triangles(state)


def coarser(state: State, spacing: float, factor: float = 2.0) -> Resolved:
    """Return the scene with ``factor`` times the spacing between nodes; ``spacing`` is the present one [m].

    Raises:
        ValueError: the mesh has cells that are not triangles in 2D, its scene has already started, or the new mesh would be too coarse.
    """
    if state.cells is None or not len(state.cells):
        return _merged_particles(state, factor * spacing)
    return _remeshed(state, factor * spacing)


# --- particles --------------------------------------------------------------------------------------------------------------------------------


def _divided_particles(state: State, spacing: float) -> Resolved:
    dim, count = state.dim, state.num_nodes
    shifts = spacing / 4 * np.array(list(itertools.product((-1, 1), repeat=dim)))
    children = len(shifts)
    pos = (state.pos[:, None] + shifts).reshape(-1, dim)
    rows = np.repeat(np.arange(count), children)
    return Resolved(_rows(state, rows, pos, state.mass[rows] / children), lambda pos: pos.reshape(count, children, dim).mean(axis=1))


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


# --- triangles --------------------------------------------------------------------------------------------------------------------------------


def _check_triangles(state: State) -> None:
    if state.dim != 2 or state.cells is None or state.cells.shape[1] != 3:
        raise ValueError("only meshes of triangles can be divided or meshed again")
    if state.time > 0:
        raise ValueError(f"the mesh at {state.time:g} s is deformed; only the start of a scene can have another resolution")


def _divided_triangles(state: State) -> Resolved:
    """Divide every triangle into four; the original nodes come first and keep their numbers."""
    _check_triangles(state)
    count, cells = state.num_nodes, state.cells
    assert cells is not None
    sides = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, number = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = (count + number.reshape(-1, 3)).T
    a, b, c = cells.T
    divided = np.concatenate([np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])

    def with_middles(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[edges].mean(axis=1)])

    ends = np.concatenate([np.arange(count), edges[:, 0]])
    new = _mesh_state(state, ends, with_middles(state.pos), divided, with_middles(state.vel))
    return Resolved(replace(new, material_params=with_middles(state.material_params)), lambda pos: pos[:count])


def _remeshed(state: State, spacing: float) -> Resolved:
    """Fill the outline of the mesh with new triangles; original nodes move with the nearest new triangle."""
    _check_triangles(state)
    assert state.cells is not None
    loops = [state.pos[loop] for loop in outline(state.cells)]
    points, cells = triangulate(loops, spacing, np.random.default_rng(0))
    nodes, weights = _locate(points, cells, state.pos)
    near = cKDTree(state.pos).query(points)[1]
    # a velocity field that is linear in space (translation and spin) is reproduced exactly
    linear = np.column_stack([np.ones(state.num_nodes), state.pos])
    field = np.linalg.lstsq(linear, state.vel, rcond=None)[0]
    rest = state.vel - linear @ field
    vel = np.column_stack([np.ones(len(points)), points]) @ field + rest[near]
    return Resolved(_mesh_state(state, near, points, cells, vel), lambda pos: np.einsum("nc,ncd->nd", weights, pos[nodes]))


def _mesh_state(state: State, near: np.ndarray, pos: np.ndarray, cells: np.ndarray, vel: np.ndarray) -> State:
    """Return a state with another mesh of the same body and the same total mass; a new node takes other values from an old one, ``near`` [node]."""
    corners = pos[cells]
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2
    share = np.bincount(cells.ravel(), np.repeat(area / 3, 3), minlength=len(pos))
    stress = None if state.stress is None else Stress(np.zeros((len(pos), 4)), np.zeros((len(cells), 4)))
    mass = share / share.sum() * state.mass.sum()
    return replace(state.take(near), pos=pos, vel=vel, mass=mass, velocity_history=None, rest_pos=pos.copy(), cells=cells, stress=stress)


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
