"""Initial states of the acceptance scenes. Domain, spacing and gravity are those of a data set."""

from __future__ import annotations

import math
from typing import Any, Literal, cast

import numpy as np

from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.geometry.body_shapes import JITTER, integer_lattice
from gpe_pl.geometry.shapes import Bowl, Shape, Sphere, domain_walls, signed_distance
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers.fluid_scenes import FluidScene
from gpe_pl.solvers.scenes import BodyScene, floats
from gpe_pl.solvers.solid_scenes import SolidScene, lumped_masses
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State, Stress

COULOMB = 0.3
"""Friction coefficient of walls below bodies of meshes."""


def material_of(spec: DatasetSpec) -> str:
    """Return the material of a data set that has only one."""
    (material,) = spec.scene.materials
    return material


def density_of(spec: DatasetSpec) -> float:
    """Return the density at rest of the only material [kg/m³]."""
    density: Any = cast(SolidScene | FluidScene | BodyScene, spec.scene).density
    return float(density[material_of(spec)] if isinstance(density, dict) else density)


def start(spec: DatasetSpec, value: float, pos: np.ndarray, vel: Any, shapes: tuple[Shape, ...], cells: np.ndarray | None = None) -> State:
    """Return an undeformed initial state of one material.

    Args:
        spec: data set.
        value: material parameter.
        pos: positions [node, dim] in m.
        vel: velocity of all nodes [dim], or of each [node, dim], in m/s.
        shapes: walls and obstacles.
        cells: triangles of a mesh [cell, corner].
    """
    dim, material = pos.shape[1], material_of(spec)
    stress, mass = None, np.full(len(pos), density_of(spec) * spec.scene.spacing**dim)
    if cells is not None and material == "solid":
        mass, stress = lumped_masses(pos, cells, density_of(spec)), Stress(np.zeros((len(pos), 4)), np.zeros((len(cells), 4)))
    return State(
        pos=pos,
        vel=np.broadcast_to(np.asarray(vel, float), pos.shape).copy(),
        node_type=np.full(len(pos), node_code(material), dtype=np.uint8),
        mass=mass,
        material_params=np.full((len(pos), 1), float(value)),
        boundary=Boundary.sample(shapes, spec.scene.spacing, dim),
        gravity=np.array(spec.scene.gravity, dtype=float),
        rest_pos=None if cells is None else pos.copy(),
        cells=cells,
        stress=stress,
    )


def middle_of_floor(spec: DatasetSpec) -> np.ndarray:
    """Return the point [dim] in the middle of the floor."""
    return np.array([*((low + high) / 2 for low, high in spec.scene.bounds[:-1]), spec.scene.bounds[-1][0]])


def middle(spec: DatasetSpec) -> np.ndarray:
    """Return the centre of the domain [dim]."""
    return np.array([(low + high) / 2 for low, high in spec.scene.bounds])


# --- bodies of meshes, in 2D ----------------------------------------------------------------------------------------------------------------


def block(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes [node, 2] and triangles [cell, 3] of a rectangle of unit squares.

    Nodes are symmetric about the vertical axis, and so are diagonals for an even number of columns. Node ``(i, j)`` has number ``i (rows + 1) + j``.
    """
    nodes = integer_lattice(np.zeros(2, int), np.array([columns, rows])).astype(float)
    triangles = []
    for i in range(columns):
        for j in range(rows):
            a, b, c, d = (k * (rows + 1) + m for k, m in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
            triangles += [(a, b, c), (a, c, d)] if 2 * i < columns else [(a, b, d), (b, c, d)]
    return nodes, np.array(triangles)


def dropped_block(spec: DatasetSpec, value: float, columns: int, rows: int, gap: float, speed: float) -> State:
    """Return a block of ``columns`` × ``rows`` squares over the middle of the floor, ``gap`` [m] above it, that moves down at ``speed`` [m/s]."""
    nodes, cells = block(columns, rows)
    pos = middle_of_floor(spec) + spec.scene.spacing * (nodes - [columns / 2, 0]) + [0, gap]
    return start(spec, value, pos, (0.0, -speed), domain_walls(spec.scene.bounds, COULOMB), cells)


def placed_block(spec: DatasetSpec, value: float, columns: int, rows: int) -> State:
    """Return a block of ``columns`` × ``rows`` squares at rest, half a spacing above the middle of the floor."""
    return dropped_block(spec, value, columns, rows, 0.5 * spec.scene.spacing, 0.0)


# --- particles in 2D ------------------------------------------------------------------------------------------------------------------------


def disc(radius: int, rng: np.random.Generator) -> np.ndarray:
    """Return jittered lattice points [point, 2] within a radius, in spacings; the right half mirrors the left."""
    lattice = integer_lattice(np.full(2, -radius), np.full(2, radius)) + 0.5
    left = lattice[(lattice[:, 0] < 0) & (np.linalg.norm(lattice, axis=1) <= radius)]
    left = left + rng.uniform(-JITTER, JITTER, left.shape)
    return np.concatenate([left, left * [-1, 1]])


def column(spec: DatasetSpec, value: float, columns: int, rows: int) -> State:
    """Return a symmetric column of ``columns`` (an even number) × ``rows`` particles at rest in the middle of a rough floor."""
    lattice = integer_lattice(np.zeros(2, int), np.array([columns - 1, rows - 1])) + 0.5
    left = lattice[lattice[:, 0] < columns / 2] + np.random.default_rng(0).uniform(-JITTER, JITTER, (columns * rows // 2, 2))
    both = np.concatenate([left, left * [-1, 1] + [columns, 0]])
    pos = middle_of_floor(spec) + spec.scene.spacing * (both - [columns / 2, 0])
    return start(spec, value, pos, np.zeros(2), domain_walls(spec.scene.bounds, STICKY))


def leaning(spec: DatasetSpec, value: float, columns: int, rows: int, wall: Literal["ceiling", "side"]) -> State:
    """Return a block of ``columns`` × ``rows`` particles at rest under the ceiling, or beside the left wall at mid-height. Walls have no friction."""
    lattice = integer_lattice(np.zeros(2, int), np.array([columns - 1, rows - 1])) + 0.5
    block = spec.scene.spacing * (lattice + np.random.default_rng(0).uniform(-JITTER, JITTER, lattice.shape))
    size, (low, high) = spec.scene.spacing * np.array([columns, rows]), np.array(spec.scene.bounds).T
    corner = np.array([low[0], middle(spec)[1]]) if wall == "side" else np.array([middle(spec)[0] - size[0] / 2, high[1] - size[1]])
    return start(spec, value, corner + block, np.zeros(2), domain_walls(spec.scene.bounds, 0.0))


def ball_over_cylinder(spec: DatasetSpec, value: float, radius: int, cylinder: float, speed: float) -> State:
    """Return a symmetric ball that falls centrally on a cylinder.

    Args:
        spec: data set.
        value: material parameter.
        radius: radius of the ball in spacings.
        cylinder: radius of the cylinder [m]; its axis is 3 radii above the floor.
        speed: downward speed of the ball [m/s].
    """
    centre = middle_of_floor(spec) + np.array([0, 3 * cylinder])
    above = cylinder + (radius + 2) * spec.scene.spacing
    pos = centre + [0, above] + spec.scene.spacing * disc(radius, np.random.default_rng(0))
    shapes: tuple[Shape, ...] = (*domain_walls(spec.scene.bounds, STICKY), Sphere(floats(centre), cylinder, STICKY))
    return start(spec, value, pos, (0.0, -speed), shapes)


# --- liquids --------------------------------------------------------------------------------------------------------------------------------


def vessel(spec: DatasetSpec) -> tuple[Shape, ...]:
    """Return the solids of a data set of liquid without obstacles: the walls of the domain, and the bowl if the scene has one."""
    scene = cast(FluidScene, spec.scene)
    walls = domain_walls(scene.bounds, scene.friction)
    if scene.scene != "bowl":
        return walls
    narrowest = min(high - low for low, high in scene.bounds)
    return (*walls, Bowl(floats(middle(spec)), narrowest / 2 - scene.grid_spacing, scene.friction))


def pool(spec: DatasetSpec, value: float, one_side: bool) -> State:
    """Return jittered particles of liquid at rest that fill the vessel from below. With ``one_side`` they fill its left half only, as before a dam breaks."""
    scene, shapes = cast(FluidScene, spec.scene), vessel(spec)
    low, high = np.array(scene.bounds).T
    count = np.floor((high - low) / scene.spacing + 1e-6).astype(int)
    sites = low + scene.spacing * (integer_lattice(np.zeros(len(low), int), count - 1) + 0.5)
    sites = sites[signed_distance(shapes, sites) > 0.5 * scene.spacing * (1 - 1e-6)]
    if one_side:
        sites = sites[sites[:, 0] < middle(spec)[0]]
    number = min(scene.num_particles, int(0.8 * len(sites)))
    rng = np.random.default_rng(0)
    chosen = rng.permutation(sites)  # so that the highest layer, which may be incomplete, is not filled from one side
    chosen = chosen[np.argsort(chosen[:, -1].round(9), kind="stable")[:number]]
    pos = chosen + scene.spacing * rng.uniform(-JITTER, JITTER, chosen.shape)
    return start(spec, value, pos, np.zeros(len(low)), shapes)


# --- all domains ----------------------------------------------------------------------------------------------------------------------------


def thrown(spec: DatasetSpec, value: float) -> State:
    """Return a body in free flight in the middle of the domain, which moves up and sideways."""
    dim, spacing = len(spec.scene.bounds), spec.scene.spacing
    shapes = vessel(spec) if isinstance(spec.scene, FluidScene) else domain_walls(spec.scene.bounds, COULOMB)
    vel = np.array([0.5, *[0.0] * (dim - 2), 1.0])
    if material_of(spec) in ("solid", "elastomer"):
        nodes, cells = block(10, 8)
        return start(spec, value, middle(spec) + spacing * (nodes - [5, 4]), vel, shapes, cells)
    reach = 2 if dim == 3 else 7
    lattice = integer_lattice(np.full(dim, -reach), np.full(dim, reach)).astype(float)
    ball = lattice[np.linalg.norm(lattice, axis=1) <= reach]
    ball = ball + np.random.default_rng(0).uniform(-JITTER, JITTER, ball.shape)
    return start(spec, value, middle(spec) + spacing * ball, vel, shapes)


def values_of(low: float, high: float) -> tuple[float, float, float]:
    """Return the lowest and highest trained value of a material parameter and an unseen one between, which is the geometric mean."""
    return low, math.sqrt(low * high), high
