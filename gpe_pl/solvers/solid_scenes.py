"""Seeded random scenes of one meshed solid that falls on obstacles. The last axis points up.

A scene has one body because the finite element solver does not compute contact between meshes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.geometry.bodies import random_outline, random_solid
from gpe_pl.geometry.meshing import TETRAHEDRA_PER_CUBE, MeshingError, quadrangulate, tetrahedralise, triangulate
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, signed_distance
from gpe_pl.schema import MaterialValues, node_code
from gpe_pl.solvers.scenes import (
    MAX_ATTEMPTS,
    ObstacleShapes,
    angular_obstacle,
    check_domain,
    check_obstacle_shapes,
    check_ranges,
    check_surroundings,
    draw_friction,
    draw_velocity,
    draw_walls,
    floats,
    parameter_columns,
)
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State, Stress

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]

MAX_BODIES = 20
"""Number of bodies to try before the mesh counts as too coarse."""


@dataclass(frozen=True, config={"extra": "forbid"})
class SolidScene:
    """Distribution of scenes with one solid body of random shape.

    Attributes:
        bounds: ``(low, high)`` of the domain along each axis [m].
        cell: kind of mesh cell; tetrahedra in 3D, the others in 2D.
        num_cells: approximate number of cells in every scene.
        body_size: edge of the square (3D: cube) that has the area (volume) of the body [m].
        density: density at rest [kg/m³].
        gravity: acceleration of gravity [m/s²].
        num_obstacles: range of the number of obstacles. Obstacles without room are left out.
        obstacle_radius: range of the obstacles' circumscribed radii [m].
        obstacle_shapes: ``plain`` selects boxes, balls and, in 2D, irregular polygons; ``angular``, in 2D only, selects stars and tilted ramps.
        obstacle_height: fraction of the domain's height below which obstacles have their centres.
        drop_height: range of the gap between the body and the floor [m]; the gap is larger where obstacles are in the way.
        max_speed: largest speed of the body along each axis [m/s]; upward at most a quarter of it.
        max_spin: largest angular velocity [rad/s].
        sticky_probability: probability that a wall or obstacle is no-slip.
        slip_probability: probability that a side wall, ceiling or obstacle is frictionless; all others obey Coulomb's law.
        coulomb_friction: range of Coulomb coefficients.
        boundary_spacing: distance of neighbouring boundary nodes in mesh spacings.
        connectivity_cells: recommended connectivity radius in mesh spacings; choose more than the distance that a body moves in one frame.
    """

    bounds: tuple[tuple[float, float], ...]
    cell: Literal["triangle", "quad", "tetrahedron"]
    num_cells: Annotated[int, Field(ge=50)]
    body_size: PositiveFloat = 0.25
    density: PositiveFloat = 1000.0
    gravity: tuple[float, ...] = (0.0, -9.81)
    num_obstacles: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (1, 3)
    obstacle_radius: tuple[PositiveFloat, PositiveFloat] = (0.06, 0.15)
    obstacle_shapes: ObstacleShapes = "plain"
    obstacle_height: Probability = 0.5
    drop_height: tuple[NonNegativeFloat, NonNegativeFloat] = (0.05, 0.3)
    max_speed: NonNegativeFloat = 2.0
    max_spin: NonNegativeFloat = 5.0
    sticky_probability: Probability = 0.1
    slip_probability: Probability = 0.2
    coulomb_friction: tuple[NonNegativeFloat, NonNegativeFloat] = (0.1, 0.8)
    boundary_spacing: PositiveFloat = 1.0
    connectivity_cells: PositiveFloat = 2.0

    def __post_init__(self) -> None:
        axes = 3 if self.cell == "tetrahedron" else 2
        if len(self.bounds) != axes or len(self.gravity) != axes:
            raise ValueError(f"cell={self.cell} needs bounds and gravity of {axes} axes, got {len(self.bounds)} and {len(self.gravity)}")
        check_domain(self.bounds, self.gravity)
        check_ranges(self, "num_obstacles", "obstacle_radius", "drop_height")
        check_obstacle_shapes(self.obstacle_shapes, self.dim)
        check_surroundings(self)

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def materials(self) -> tuple[str, ...]:
        return ("solid",)

    @property
    def input_files(self) -> dict[str, str]:
        return {}

    @property
    def spacing(self) -> float:
        """Edge length of the mesh in m if equal regular cells filled the body; the mean edge is up to 4 % longer."""
        per_unit = {"triangle": 4 / math.sqrt(3), "quad": 1.0, "tetrahedron": TETRAHEDRA_PER_CUBE}[self.cell]
        return self.body_size * float((per_unit / self.num_cells) ** (1 / self.dim))

    @property
    def connectivity_radius(self) -> float:
        return self.connectivity_cells * self.spacing

    @property
    def max_cells(self) -> int:
        """Upper estimate of the number of cells."""
        return math.ceil((1.25 if self.dim == 3 else 1.1) * self.num_cells)

    @property
    def max_nodes(self) -> int:
        """Upper estimate of the number of nodes. In 2D it follows from Euler's formula and the longest outlines; in 3D it was measured."""
        if self.cell == "tetrahedron":
            return math.ceil(0.2 * self.num_cells + 1.7 * self.num_cells ** (2 / 3))
        outline = 7.5 * self.body_size / self.spacing
        return math.ceil((1.0 if self.cell == "quad" else 0.5) * self.max_cells + outline / 2 + 1)

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State:
        """Draw a scene.

        Args:
            values: Young's modulus [Pa] under the key ``solid``, or several parameters by name.
            seed: non-negative integer.

        Returns:
            State at time 0 in float64, undeformed and free of stress.

        Raises:
            ValueError: the body does not fit into the domain, or the mesh is too coarse for it (``MeshingError``).
        """
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        body, cells = _body(self, rng)
        for _ in range(MAX_ATTEMPTS):
            shapes = (*draw_walls(self, rng), *_obstacles(self, rng))
            placed = _placed(self, body, shapes, rng)
            if placed is not None:
                break
        else:
            raise ValueError(
                f"no room for a body of {self.body_size:g} m and {self.num_obstacles[1]} obstacles in {self.bounds}; lower body_size, num_obstacles "
                "or drop_height"
            )
        mass = lumped_masses(placed, cells, self.density)
        count = len(placed)
        node_type = np.full(count, node_code("solid"), dtype=np.uint8)
        params, names = parameter_columns(values, node_type, self.materials)
        components = 4 if self.dim == 2 else 6
        return State(
            pos=placed,
            vel=_velocity(self, placed, mass, rng),
            node_type=node_type,
            mass=mass,
            material_params=params,
            boundary=Boundary.sample(shapes, self.boundary_spacing * self.spacing, self.dim),
            gravity=np.array(self.gravity, dtype=np.float64),
            rest_pos=placed.copy(),
            cells=cells,
            stress=Stress(np.zeros((count, components)), np.zeros((len(cells), components))),
            param_names=names,
        )


def _body(config: SolidScene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and cells of a random, randomly turned body around the origin. Bodies that are too thin for the spacing are rejected."""
    for attempt in range(MAX_BODIES):
        try:
            points, cells = _mesh(config, rng)
            break
        except MeshingError:
            if attempt == MAX_BODIES - 1:
                raise
    turn, _ = np.linalg.qr(rng.normal(size=(config.dim, config.dim)))
    turn[:, 0] *= np.linalg.det(turn)  # a rotation, not a reflection
    return config.body_size * points @ turn.T, cells


def _mesh(config: SolidScene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    spacing = config.spacing / config.body_size
    if config.cell == "tetrahedron":
        return tetrahedralise(*random_solid(rng), spacing, rng)
    return (triangulate if config.cell == "triangle" else quadrangulate)(random_outline(rng), spacing, rng)


def lumped_masses(points: np.ndarray, cells: np.ndarray, density: float) -> np.ndarray:
    """Return masses [node] in kg: each cell's mass, divided equally among its corners."""
    corners = points[cells]
    if cells.shape[1] == 4 and points.shape[1] == 2:
        a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        volume = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    else:
        volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / math.factorial(points.shape[1])
    return np.bincount(cells.ravel(), np.repeat(density * volume / cells.shape[1], cells.shape[1]), minlength=len(points))


def _obstacles(config: SolidScene, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Draw obstacles in the lower part of the domain, clear of the walls and of each other. Obstacles without room are left out."""
    obstacles: list[Shape] = []
    taken: list[tuple[np.ndarray, float]] = []
    low, high = np.array(config.bounds).T
    gap = 2.0 * config.spacing
    for _ in range(rng.integers(config.num_obstacles[0], config.num_obstacles[1] + 1)):
        radius, friction = float(rng.uniform(*config.obstacle_radius)), draw_friction(config, rng)
        room_low, room_high = low + radius + gap, high - radius - gap
        room_high[-1] = min(room_high[-1], max(room_low[-1], low[-1] + config.obstacle_height * (high - low)[-1]))
        if np.any(room_low > room_high):
            continue
        center = rng.uniform(room_low, room_high)
        make = angular_obstacle if config.obstacle_shapes == "angular" else _obstacle
        shape = make(center, radius, friction, rng)
        if all(np.linalg.norm(center - c) >= radius + r + gap for c, r in taken):
            taken.append((center, radius))
            obstacles.append(shape)
    return tuple(obstacles)


def _obstacle(center: np.ndarray, radius: float, friction: float, rng: np.random.Generator) -> Shape:
    kind = int(rng.integers(4))
    if kind == 0:
        half = rng.uniform(0.4, 1.0, len(center))
        half *= radius / np.linalg.norm(half)
        return Box(floats(center - half), floats(center + half), friction)
    if kind == 1 or len(center) == 3:
        return Sphere(floats(center), radius, friction)
    corners = int(rng.integers(3, 9))
    angle = 2 * math.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners) + rng.random()) / corners
    reach = radius * rng.uniform(0.6, 1.0, corners)
    vertices = center + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return Polygon(tuple((float(x), float(y)) for x, y in vertices), friction)


def _placed(config: SolidScene, body: np.ndarray, shapes: tuple[Shape, ...], rng: np.random.Generator) -> np.ndarray | None:
    """Return node positions above the floor in free space, or None if this layout leaves no room."""
    low, high = np.array(config.bounds).T
    up = np.eye(config.dim)[-1]
    clearance = 0.5 * config.spacing
    lowest = low - body.min(axis=0) + clearance
    lowest[-1] += max(0.0, rng.uniform(*config.drop_height) - clearance)
    highest = high - body.max(axis=0) - clearance
    if np.any(lowest > highest):
        return None
    offset = lowest.copy()
    offset[:-1] = [rng.uniform(a, b) for a, b in zip(lowest[:-1], highest[:-1], strict=True)]
    pos = body + offset
    for _ in range(math.floor((highest[-1] - lowest[-1]) / config.spacing) + 1):
        if np.all(signed_distance(shapes, pos) > 0.9 * clearance):
            return pos
        pos = pos + config.spacing * up
    return None


def _velocity(config: SolidScene, pos: np.ndarray, mass: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw velocities [node, dim] in m/s of a rigid motion: any horizontal direction, mostly downward, with a spin about the centre of mass."""
    dim = config.dim
    middle = draw_velocity(config.max_speed, dim, rng)
    arm = pos - mass @ pos / mass.sum()
    if dim == 2:
        return middle + rng.uniform(-config.max_spin, config.max_spin) * np.stack([-arm[:, 1], arm[:, 0]], axis=-1)
    axis = rng.normal(size=3)
    return middle + np.cross(rng.uniform(0, config.max_spin) * axis / np.linalg.norm(axis), arm)
