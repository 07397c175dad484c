"""Seeded scenes of bodies thrown into a box with obstacles, and the ``SceneDistribution`` protocol.

``SceneDistribution.sample`` depends only on configuration, parameter values, seed and the files that the configuration names.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.geometry.body_shapes import MESHED, Body, jittered_lattice, lattice_body
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, check_bounds, domain_walls, signed_distance
from gpe_pl.schema import MATERIALS, STICKY, MaterialValues, node_code, param_names, parameters_by_name, stored_parameters
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

PositiveFloat = Annotated[float, Field(gt=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
ObstacleShapes = Literal["plain", "angular"]

MAX_ATTEMPTS = 200
"""Number of layouts to try before a scene counts as impossible."""

CLEARANCE = 0.25
"""Smallest initial distance between a liquid particle and a solid [spacings]. A lattice with ``JITTER`` that starts half a spacing from a wall keeps it."""

MAX_PLACES = 20
"""Number of places along a wall to try for a body before its layout is given up."""


@runtime_checkable
class SceneDistribution(Protocol):
    """A distribution of initial states."""

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]: ...

    @property
    def gravity(self) -> tuple[float, ...]: ...

    @property
    def materials(self) -> tuple[str, ...]: ...

    @property
    def spacing(self) -> float: ...

    @property
    def connectivity_radius(self) -> float: ...

    @property
    def max_nodes(self) -> int: ...

    @property
    def max_cells(self) -> int: ...

    @property
    def input_files(self) -> dict[str, str]:
        """Files that scenes depend on, keyed by the setting that names them."""
        ...

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State: ...


def describe(scene: SceneDistribution, frame_dt: float, **provenance: Any) -> Metadata:
    """Return the metadata of a scene's trajectories. ``provenance`` sets the fields of ``Metadata`` that the scene does not know, and may replace others."""
    return Metadata(
        **{
            "dataset": "-".join(scene.materials),
            "materials": scene.materials,
            "param_names": param_names(scene.materials),
            "frame_dt": frame_dt,
            "spacing": scene.spacing,
            "connectivity_radius": scene.connectivity_radius,
            "bounds": scene.bounds,
            "gravity": scene.gravity,
            "config": json.dumps({"scene": asdict(scene)}, sort_keys=True),  # type: ignore[call-overload]
            **provenance,
        }
    )


def parameter_columns(
    values: Mapping[str, MaterialValues], node_type: np.ndarray, materials: tuple[str, ...]
) -> tuple[Float[np.ndarray, "node param"], tuple[str, ...]]:
    """Return ``material_params`` and ``param_names`` of a state, the same for all nodes of a material.

    Args:
        values: parameters of each material.
        node_type: codes of the nodes [node].
        materials: materials of the scene.

    Raises:
        ValueError: a material has no such parameter, or lacks one. The message names it.
    """
    given = {material: parameters_by_name(material, values[material]) for material in materials}
    names = param_names(materials, (name for own in given.values() for name in own))
    params = np.full((len(node_type), len(names)), np.nan)
    for material, own in given.items():
        for parameter in stored_parameters(material, names):
            if parameter.name not in own:
                raise ValueError(f"{material} lacks {parameter.name}, which another material has; give it to both or to none")
            params[node_type == node_code(material), names.index(parameter.name)] = own[parameter.name]
    return params, names


# --- drawing and checks that several kinds of scenes share ----------------------------------------------------------------------------------


@runtime_checkable
class Surroundings(Protocol):
    """Settings from which the walls of a scene, and the friction of walls and obstacles, are drawn.

    Attributes:
        bounds: ``(low, high)`` of the domain for each axis [m].
        sticky_probability: probability that a surface is no-slip.
        slip_probability: probability that a surface has no friction.
        coulomb_friction: ``(low, high)`` of the friction coefficients of all other surfaces.
    """

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]: ...

    @property
    def sticky_probability(self) -> float: ...

    @property
    def slip_probability(self) -> float: ...

    @property
    def coulomb_friction(self) -> tuple[float, float]: ...


def check_domain(bounds: tuple[tuple[float, float], ...], gravity: tuple[float, ...]) -> None:
    """Raise ``ValueError`` unless bounds are valid, and gravity is finite and has as many components as bounds has axes."""
    check_bounds(bounds)
    if len(gravity) != len(bounds):
        raise ValueError(f"gravity must have as many components as bounds have axes, got gravity {gravity} and bounds {bounds}")
    if not np.isfinite(gravity).all():
        raise ValueError(f"gravity must be finite, got {gravity}")


def check_ranges(scene: object, *names: str) -> None:
    """Raise ``ValueError`` unless these settings of a scene are ``(low, high)`` with low <= high."""
    for name in names:
        low, high = getattr(scene, name)
        if low > high:
            raise ValueError(f"{name} must be (low, high) with low <= high, got {(low, high)}")


def check_surroundings(scene: Surroundings) -> None:
    """Raise ``ValueError`` unless friction can be drawn from these settings."""
    check_ranges(scene, "coulomb_friction")
    if scene.sticky_probability + scene.slip_probability > 1:
        raise ValueError("sticky_probability and slip_probability must not exceed 1 together")


def draw_friction(scene: Surroundings, rng: np.random.Generator, may_slip: bool = True) -> float:
    """Draw the Coulomb coefficient of a wall or obstacle: no-slip, frictionless (only if it ``may_slip``) or in between."""
    kind, coulomb = rng.random(), rng.uniform(*scene.coulomb_friction)
    if kind < scene.sticky_probability:
        return STICKY
    slips = may_slip and kind < scene.sticky_probability + scene.slip_probability
    return 0.0 if slips else float(coulomb)


def draw_walls(scene: Surroundings, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Draw the walls of the domain, each with its own friction. The floor is never drawn as frictionless."""
    axes = "xyz"[: len(scene.bounds)]
    floor = f"{axes[-1]}_low"  # on a frictionless floor bodies never come to rest
    names = [f"{axis}_{side}" for axis in axes for side in ("low", "high")]
    return domain_walls(scene.bounds, {name: draw_friction(scene, rng, may_slip=name != floor) for name in names})


def draw_velocity(max_speed: float, dim: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the velocity of a body [dim] in m/s. No component is larger than ``max_speed``; the last one is at most a quarter of it upward."""
    return max_speed * np.array([*rng.uniform(-1.0, 1.0, dim - 1), rng.uniform(-1.0, 0.25)])


def filled_box(region: Sequence[tuple[float, float]], spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Fill a box ``(low, high)`` per axis with a jittered lattice of points [point, dim], which begins half of ``spacing`` from the low sides."""
    low, high = np.array(region, float).T
    number = np.floor((high - low) / spacing + 1e-6)
    if np.any(number < 1):
        return np.empty((0, len(low)))
    return low + spacing * (jittered_lattice(np.zeros(len(low)), number - 1, rng) + 0.5)


def floats(values: np.ndarray) -> tuple[float, ...]:
    """Return coordinates as a tuple, which shapes take."""
    return tuple(float(v) for v in values)


class OnGrid:
    """Spacing and radius of particles that start in the cells of a grid."""

    grid_spacing: float
    particles_per_cell: int
    connectivity_cells: float

    @property
    def spacing(self) -> float:
        """Rest spacing of particles in m."""
        return self.grid_spacing / self.particles_per_cell

    @property
    def connectivity_radius(self) -> float:
        """Recommended connectivity radius of a learned simulator in m."""
        return self.connectivity_cells * self.grid_spacing


class LiquidOnGrid(OnGrid):
    """Scenes of particles of a liquid."""

    @property
    def materials(self) -> tuple[str, ...]:
        return ("fluid",)

    @property
    def max_cells(self) -> int:
        return 0


# --- bodies of particles --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, config={"extra": "forbid"})
class BodyScene(OnGrid):
    """Bodies of random shape and material in a box with obstacles.

    Attributes:
        bounds: ``(low, high)`` of the domain along each axis [m]; 2 or 3 axes, gravity along the last.
        materials: materials of the bodies; with several materials, a scene has at least two of them.
        grid_spacing: grid spacing of the solver [m].
        num_particles: number of particles in all bodies together.
        particles_per_cell: particles along each axis of a cell; the rest spacing is ``grid_spacing / particles_per_cell``.
        density: density at rest of each material [kg/m³].
        gravity: acceleration of gravity [m/s²].
        max_bodies: largest number of bodies; the number is uniform in 1 … max_bodies, with several materials in 2 … max_bodies.
        max_obstacles: largest number of obstacles; the number is uniform in 0 … max_obstacles. Obstacles without room are left out.
        obstacle_radius: range of the obstacles' circumscribed radii [m]. The corners of boxes in 3D are 12 % further out.
        obstacle_shapes: ``plain`` selects boxes, balls and, in 2D, convex polygons; ``angular``, in 2D only, selects stars and tilted ramps.
        drop_height: range of the gap between a body and the floor [m]; the gap is larger where obstacles or other bodies are in the way.
        max_speed: largest speed of a body along each axis [m/s]; upward at most a quarter of it.
        resting_probability: probability that a body starts at rest with a flat side at the floor, the ceiling or a side wall.
        sticky_probability: probability that a wall or obstacle is no-slip.
        slip_probability: probability that a side wall, ceiling or obstacle is frictionless; all others obey Coulomb's law.
        coulomb_friction: range of Coulomb coefficients.
        connectivity_cells: recommended connectivity radius in grid cells.
    """

    bounds: tuple[tuple[float, float], ...]
    materials: Annotated[tuple[str, ...], Field(min_length=1)]
    grid_spacing: PositiveFloat
    num_particles: Annotated[int, Field(ge=1)]
    density: dict[str, PositiveFloat]
    particles_per_cell: Annotated[int, Field(ge=1)] = 1
    gravity: tuple[float, ...] = (0.0, -9.81)
    max_bodies: Annotated[int, Field(ge=1)] = 3
    max_obstacles: Annotated[int, Field(ge=0)] = 2
    obstacle_radius: tuple[PositiveFloat, PositiveFloat] = (0.05, 0.15)
    obstacle_shapes: ObstacleShapes = "plain"
    drop_height: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = (0.02, 0.2)
    max_speed: Annotated[float, Field(ge=0)] = 2.0
    resting_probability: Probability = 0.0
    sticky_probability: Probability = 0.25
    slip_probability: Probability = 0.25
    coulomb_friction: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = (0.1, 0.8)
    connectivity_cells: PositiveFloat = 3.75

    def __post_init__(self) -> None:
        check_domain(self.bounds, self.gravity)
        unknown = [m for m in self.materials if m not in MATERIALS]
        if unknown or len(set(self.materials)) < len(self.materials):
            raise ValueError(f"materials must be different ones of {', '.join(MATERIALS)}, got {self.materials}")
        lacking = [m for m in self.materials if m not in self.density]
        if lacking:
            raise ValueError(f"density of {', '.join(lacking)} is missing")
        if strange := [m for m in self.density if m not in MATERIALS]:
            raise ValueError(f"density of {', '.join(strange)}: no material; materials are {', '.join(MATERIALS)}")
        check_ranges(self, "obstacle_radius", "drop_height")
        check_obstacle_shapes(self.obstacle_shapes, self.dim)
        check_surroundings(self)

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def max_nodes(self) -> int:
        return self.num_particles

    @property
    def max_cells(self) -> int:
        """Upper bound of the number of mesh cells: two triangles per particle, or six tetrahedra."""
        return (2 if self.dim == 2 else 6) * self.num_particles if set(self.materials) & set(MESHED) else 0

    @property
    def input_files(self) -> dict[str, str]:
        return {}

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State:
        """Draw a scene.

        Args:
            values: parameters of each material, in the units that ``schema`` gives.
            seed: non-negative integer.

        Returns:
            State at time 0 with exactly ``num_particles`` particles in random order, float64.

        Raises:
            ValueError: the bodies do not fit into the domain.
        """
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        for _ in range(MAX_ATTEMPTS):
            walls, obstacles = draw_walls(self, rng), _obstacles(self, rng)
            bodies = _bodies(self, walls, obstacles, rng)
            if bodies is not None:
                break
        else:
            raise ValueError(
                f"no room for {self.num_particles} particles of spacing {self.spacing:g} m and {self.max_obstacles} obstacles in {self.bounds}; "
                "lower num_particles, max_bodies, max_obstacles or drop_height"
            )
        vel = np.concatenate([np.broadcast_to(_velocity(self, body, rng), body.pos.shape) for body in bodies])
        pos = np.concatenate([body.pos for body in bodies])
        material = np.concatenate([np.full(len(body.pos), node_code(body.material), np.uint8) for body in bodies])
        # node numbers must not reveal where a particle started
        order = rng.permutation(self.num_particles)
        pos, material = pos[order], material[order]
        params, names = parameter_columns(values, material, self.materials)
        mass = np.empty(self.num_particles)
        for name in self.materials:
            mass[material == node_code(name)] = self.density[name] * self.spacing**self.dim
        return State(
            pos=pos,
            vel=vel[order],
            node_type=material,
            mass=mass,
            material_params=params,
            boundary=Boundary.sample((*walls, *obstacles), self.spacing, self.dim),
            gravity=np.array(self.gravity),
            rest_pos=pos.copy() if self.max_cells else None,
            cells=_cells(bodies, order) if self.max_cells else None,
            param_names=names,
        )


def _velocity(config: BodyScene, body: Body, rng: np.random.Generator) -> np.ndarray:
    """Return the initial velocity of a body [dim] in m/s."""
    return np.zeros(config.dim) if body.rests else draw_velocity(config.max_speed, config.dim, rng)


def _cells(bodies: list[Body], order: np.ndarray) -> np.ndarray:
    """Return the cells of all bodies in the node numbers after the permutation ``order``."""
    start = np.cumsum([0, *(len(body.pos) for body in bodies)])
    new_number = np.argsort(order)
    return new_number[np.concatenate([body.cells + first for body, first in zip(bodies, start, strict=False)])]


def _obstacles(config: BodyScene, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Draw obstacles. Balls of ``obstacle_radius`` around their centres stay clear of the walls and of each other; those without room are left out."""
    obstacles: list[Shape] = []
    circles: list[tuple[np.ndarray, float]] = []
    low, high = np.array(config.bounds).T
    gap = 2.0 * config.grid_spacing  # the grid does not resolve narrower gaps
    for _ in range(rng.integers(config.max_obstacles + 1)):
        radius, angle, sides = rng.uniform(*config.obstacle_radius), rng.uniform(0, 2 * math.pi), int(rng.integers(3, 7))
        kind, friction, fraction = rng.integers(3 if config.dim == 2 else 2), draw_friction(config, rng), rng.uniform(0.3, 0.7)
        room_low, room_high = low + radius + gap, high - radius - gap
        if np.any(room_low > room_high):
            continue
        center = rng.uniform(room_low, room_high)
        if any(np.linalg.norm(center - c) < radius + r + gap for c, r in circles):
            continue
        circles.append((center, radius))
        if config.obstacle_shapes == "angular":
            obstacles.append(angular_obstacle(center, radius, friction, rng))
        elif kind == 0:
            half = radius * np.array([math.cos(fraction * math.pi / 2), math.sin(fraction * math.pi / 2), 0.5][: config.dim])
            obstacles.append(Box(floats(center - half), floats(center + half), friction))
        elif kind == 1:
            obstacles.append(Sphere(floats(center), float(radius), friction))
        else:
            turn = angle + 2 * math.pi * np.arange(sides) / sides
            vertices = center + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            obstacles.append(Polygon(tuple((float(x), float(y)) for x, y in vertices), friction))
    return tuple(obstacles)


def check_obstacle_shapes(shapes: ObstacleShapes, dim: int) -> None:
    """Raise ``ValueError`` if obstacles of this kind do not exist in this dimension."""
    if shapes == "angular" and dim != 2:
        raise ValueError("obstacle_shapes='angular' are polygons, which exist in 2D only; use 'plain'")


def angular_obstacle(center: np.ndarray, radius: float, friction: float, rng: np.random.Generator) -> Polygon:
    """Draw a star of four to six points, or a tilted ramp four times as long as thick, within the circle of this centre [m] and radius [m]."""
    angle = rng.uniform(0, 2 * math.pi)
    if rng.random() < 0.5:
        points = 2 * int(rng.integers(4, 7))
        turn, reach = angle + 2 * math.pi * np.arange(points) / points, np.where(np.arange(points) % 2, 0.5, 1.0)
    else:
        half = math.atan2(1.0, 4.0)
        turn, reach = angle + np.array([-half, half, math.pi - half, math.pi + half]), np.ones(4)
    vertices = center + radius * reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return Polygon(tuple((float(x), float(y)) for x, y in vertices), friction)


def _bodies(config: BodyScene, walls: tuple[Shape, ...], obstacles: tuple[Shape, ...], rng: np.random.Generator) -> list[Body] | None:
    """Place the bodies; return None if this layout leaves no room."""
    low, high = np.array(config.bounds).T
    shapes = (*walls, *obstacles)
    several = len(config.materials) > 1  # a scene then has bodies of at least two materials
    number = int(rng.integers(min(2, config.max_bodies) if several else 1, config.max_bodies + 1))
    order = rng.permutation(len(config.materials)) if several else np.zeros(1, dtype=int)
    fraction = rng.dirichlet(np.full(number, 4.0))
    counts = np.diff(np.round(np.concatenate([[0.0], np.cumsum(fraction)]) * config.num_particles)).astype(int)
    up = np.eye(config.dim)[-1]
    clearance = 0.5 * config.spacing
    boxes: list[tuple[np.ndarray, np.ndarray]] = []
    placed = []
    for k, count in enumerate(counts[counts > 0]):
        material = config.materials[order[k % len(order)]]
        if config.resting_probability > 0 and rng.random() < config.resting_probability:
            resting = _at_wall(config, int(count), material, obstacles, boxes, rng)
            if resting is None:
                return None
            placed.append(resting)
            continue
        body = lattice_body(int(count), config.spacing, material, config.dim, rng)
        extent_low, extent_high = body.pos.min(axis=0), body.pos.max(axis=0)
        gap = max(clearance, rng.uniform(*config.drop_height))
        lowest = low + clearance + (gap - clearance) * up - extent_low
        highest = high - clearance - extent_high
        if np.any(lowest > highest):
            return None
        offset = lowest.copy()
        offset[:-1] = [rng.uniform(a, b) for a, b in zip(lowest[:-1], highest[:-1], strict=True)]
        pos = body.pos + offset
        # raise the body until nothing is in the way; it may start above obstacles and other bodies
        for _ in range(math.floor((highest[-1] - lowest[-1]) / config.grid_spacing) + 1):
            box = _box_around(config, pos)
            if not _overlaps(box, boxes) and np.all(signed_distance(shapes, pos) > 0.9 * clearance):
                break
            pos = pos + config.grid_spacing * up
        else:
            return None
        boxes.append(box)
        placed.append(body._replace(pos=pos))
    return placed


_Extent = tuple[np.ndarray, np.ndarray]
"""Lowest and highest corner of a box [dim] in m."""


def _box_around(config: BodyScene, pos: np.ndarray) -> _Extent:
    """Return the box that other bodies must stay clear of."""
    return pos.min(axis=0) - config.grid_spacing, pos.max(axis=0) + config.grid_spacing


def _overlaps(box: _Extent, others: list[_Extent]) -> bool:
    return any(bool(np.all(box[0] < other[1]) and np.all(other[0] < box[1])) for other in others)


def _at_wall(
    config: BodyScene, count: int, material: str, obstacles: tuple[Shape, ...], boxes: list[_Extent], rng: np.random.Generator
) -> Body | None:
    """Place a body with a flat side at a random wall, and add its box to ``boxes``; return None if nothing is found that is clear of others."""
    low, high = np.array(config.bounds).T
    axis, is_high = int(rng.integers(config.dim)), bool(rng.integers(2))
    body = lattice_body(count, config.spacing, material, config.dim, rng, flat=axis)
    pos = body.pos.copy()
    if is_high:
        pos[:, axis] *= -1
    lowest, highest = low + 0.5 * config.spacing - pos.min(axis=0), high - 0.5 * config.spacing - pos.max(axis=0)
    lowest[axis] = highest[axis] = high[axis] if is_high else low[axis]
    if np.any(np.ptp(pos, axis=0) > high - low - config.spacing):
        return None
    cells = body.cells[:, [1, 0, *range(2, config.dim + 1)]] if is_high else body.cells  # a mirror image turns the orientation
    for _ in range(MAX_PLACES):
        moved = pos + rng.uniform(lowest, highest)
        box = _box_around(config, moved)
        is_clear = not obstacles or np.all(signed_distance(obstacles, moved) > 0.45 * config.spacing)
        if is_clear and not _overlaps(box, boxes):
            boxes.append(box)
            return Body(moved, material, cells, rests=True)
    return None
