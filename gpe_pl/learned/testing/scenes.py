"""Small random scenes: a cloud of particles, or bodies with a mesh, near a corner of a unit box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import Delaunay

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.testing.changes import permuted
from gpe_pl.schema import MESH_MATERIALS, STICKY, node_code, param_names
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

SPACING = 0.05


def metadata(materials: tuple[str, ...] = ("sand",), dim: int = 2, radius: float = 0.12) -> Metadata:
    """Return metadata of a unit box with these materials and this connectivity radius [m]."""
    return Metadata(
        dataset="test",
        materials=materials,
        param_names=param_names(materials),
        frame_dt=0.005,
        spacing=SPACING,
        connectivity_radius=radius,
        bounds=((0.0, 1.0),) * dim,
        gravity=(0.0,) * (dim - 1) + (-9.81,),
    )


def state(
    num_nodes: int = 40,
    materials: tuple[str, ...] = ("sand",),
    history: int = 1,
    seed: int = 0,
    walls: bool = True,
    dim: int = 2,
    low: float = 0.02,
    high: float = 0.45,
) -> State:
    """Return a random cloud of particles near a corner of a unit box.

    Args:
        num_nodes: number of particles.
        materials: materials, which the particles have in turn.
        history: number of past velocities.
        seed: seed of the cloud.
        walls: whether the box has walls.
        dim: dimension of space.
        low, high: range of the positions along each axis [m].
    """
    rng = np.random.default_rng(seed)
    pos = rng.uniform(low, high, (num_nodes, dim))
    past = rng.normal(scale=1.0, size=(num_nodes, history, dim))
    names = param_names(materials)
    node_type = np.array([node_code(materials[k % len(materials)]) for k in range(num_nodes)], dtype=np.uint8)
    params = np.full((num_nodes, len(names)), np.nan)
    for k in range(num_nodes):
        params[k, names.index(param_names((materials[k % len(materials)],))[0])] = rng.uniform(1.0, 40.0)
    sides = [f"{axis}_{side}" for axis in "xyz"[:dim] for side in ("low", "high")]
    shapes = domain_walls(((0.0, 1.0),) * dim, {n: STICKY if k % 2 else 0.3 for k, n in enumerate(sides)}) if walls else ()
    return State(
        pos,
        past[:, -1],
        node_type,
        rng.uniform(0.5, 2.0, num_nodes),
        params,
        Boundary.sample(shapes, SPACING, dim),
        np.array(metadata(materials, dim).gravity),
        past,
    )


def mesh(kind: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points in rest spacings and cells of one body: a ``lattice`` of quadrilaterals, unstructured ``triangles`` or ``tetrahedra``."""
    rng = np.random.default_rng(seed)
    if kind == "lattice":
        number = np.arange(np.prod(shape := tuple(rng.integers(3, 8, 2)))).reshape(shape)
        cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
        return np.argwhere(number >= 0).astype(float), cells
    size: tuple[int, ...] = (5, 7) if kind == "triangles" else (3, 4, 3)
    points = np.argwhere(np.ones(size)) + rng.uniform(-0.3, 0.3, (int(np.prod(size)), len(size)))
    return points, Delaunay(points).simplices.astype(np.int64)


def mesh_state(
    kind: str = "triangles",
    materials: tuple[str, ...] = ("elastomer",),
    num_bodies: int = 2,
    gap: float = 1.5,
    history: int = 1,
    seed: int = 0,
    walls: bool = True,
) -> State:
    """Return a state of strained, moving bodies of ``mesh`` and clouds of all other materials, with nodes in random order.

    Args:
        kind: kind of the mesh, see ``mesh``.
        materials: materials of the scene. Those that can have a mesh are the materials of the bodies, in turn.
        num_bodies: number of bodies, which stand side by side.
        gap: distance between bodies [rest spacings].
        history: number of past velocities.
        seed: seed of the scene.
        walls: whether the box has walls.
    """
    dim, rng = 3 if kind == "tetrahedra" else 2, np.random.default_rng(seed)
    meshes = [m for m in materials if m in MESH_MATERIALS]
    points, cells, edge = [np.empty((0, dim))], [], 1.0
    kinds: list[str] = []
    for k in range(num_bodies):
        x, c = mesh(kind, seed + k)
        x = x - x.min(axis=0)
        x[:, 0] += edge
        x[:, 1:] += 1.0
        edge = x[:, 0].max() + gap
        cells.append(c + len(kinds))
        points.append(x)
        kinds += [meshes[k % len(meshes)]] * len(x)
    rest = SPACING * np.concatenate(points)
    others = [m for m in materials if m not in MESH_MATERIALS]
    s = state(len(kinds) + 15 * len(others), materials, history, seed, walls, dim)
    assert s.velocity_history is not None
    kinds += [others[k % len(others)] for k in range(15 * len(others))]
    pos = s.pos.copy()
    pos[: len(rest)] = rest @ (np.eye(dim) + 0.05 * rng.normal(size=(dim, dim))) + 0.002 * rng.normal(size=rest.shape)
    names = param_names(materials)
    params = np.full((len(kinds), len(names)), np.nan)
    for row, material in enumerate(kinds):
        params[row, names.index(param_names((material,))[0])] = rng.uniform(1.0, 40.0)
    s = replace(
        s,
        pos=pos,
        node_type=np.array([node_code(m) for m in kinds], dtype=np.uint8),
        material_params=params,
        rest_pos=np.concatenate([rest, pos[len(rest) :]]),
        cells=np.concatenate(cells),
    )
    return permuted(s, rng.permutation(s.num_nodes))


def builder(materials: tuple[str, ...] = ("sand",), dim: int = 2, **config: object) -> GraphBuilder:
    """Return a graph builder for the states of this module; ``config`` are settings of ``GraphConfig``."""
    return GraphBuilder(GraphConfig(**{"history": 1, "islands": True, **config}), metadata(materials, dim))  # type: ignore[arg-type]
