"""Seeded random scenes: bodies of granular or soft material that fall and fly about in a box with obstacles.

``sample_scene`` is a pure function of configuration, material, parameter value and seed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.geometry import Box, Polygon, Shape, Sphere, domain_walls, signed_distance
from gpe_pl.schema import STICKY, node_code, param_names
from gpe_pl.trajectory import Boundary, Metadata, State

PositiveFloat = Annotated[float, Field(gt=0)]
Probability = Annotated[float, Field(ge=0, le=1)]

MAX_ATTEMPTS = 200
"""Layouts to try before a scene counts as impossible."""

JITTER = 0.25
"""Largest displacement from the seeding lattice per axis, in spacings; a plain lattice would crack along its rows when it spreads."""


@dataclass(frozen=True, config={"extra": "forbid"})
class SceneConfig:
    """Distribution of scenes.

    Attributes:
        bounds: ``(low, high)`` per axis of the domain [m].
        grid_spacing: of the solver [m].
        num_particles: in all bodies together.
        particles_per_cell: along each axis; the rest spacing is ``grid_spacing / particles_per_cell``.
        density: at rest [kg/m³].
        gravity: [m/s²].
        max_bodies: the number of bodies is uniform in 1 … max_bodies.
        max_obstacles: the number of obstacles is uniform in 0 … max_obstacles.
        obstacle_radius: range of their circumscribed radii [m].
        drop_height: range of the gap between a body and the floor [m].
        max_speed: of a body along each axis [m/s]; upward at most a quarter of it.
        sticky_probability: of a wall or obstacle to be no-slip.
        slip_probability: of a side wall, ceiling or obstacle to be frictionless; all others obey Coulomb's law.
        coulomb_friction: range of Coulomb coefficients.
        connectivity_cells: recommended connectivity radius in grid cells.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: PositiveFloat
    num_particles: Annotated[int, Field(ge=1)]
    particles_per_cell: Annotated[int, Field(ge=1)] = 2
    density: PositiveFloat = 1600.0
    gravity: tuple[float, ...] = (0.0, -9.81)
    max_bodies: Annotated[int, Field(ge=1)] = 3
    max_obstacles: Annotated[int, Field(ge=0)] = 2
    obstacle_radius: tuple[PositiveFloat, PositiveFloat] = (0.05, 0.15)
    drop_height: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = (0.02, 0.2)
    max_speed: Annotated[float, Field(ge=0)] = 2.0
    sticky_probability: Probability = 0.25
    slip_probability: Probability = 0.25
    coulomb_friction: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = (0.1, 0.8)
    connectivity_cells: PositiveFloat = 1.5

    def __post_init__(self) -> None:
        if len(self.bounds) != 2 or len(self.gravity) != 2:
            raise ValueError(f"only dimension=2 is supported, got bounds of {len(self.bounds)} axes and gravity of {len(self.gravity)}")
        if any(not high > low for low, high in self.bounds):
            raise ValueError(f"bounds must be (low, high) with low < high, got {self.bounds}")
        for name in ("obstacle_radius", "drop_height", "coulomb_friction"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} must be (low, high) with low <= high, got {(low, high)}")
        if self.sticky_probability + self.slip_probability > 1:
            raise ValueError("sticky_probability and slip_probability must not exceed 1 together")

    @property
    def spacing(self) -> float:
        """Rest spacing of particles in m."""
        return self.grid_spacing / self.particles_per_cell


def describe(scene: SceneConfig, material: str, frame_dt: float, **provenance: Any) -> Metadata:
    """Metadata of scenes with this configuration; ``provenance`` takes the other fields of ``Metadata``."""
    return Metadata(
        **{
            "dataset": material,
            "materials": (material,),
            "param_names": param_names((material,)),
            "frame_dt": frame_dt,
            "spacing": scene.spacing,
            "connectivity_radius": scene.connectivity_cells * scene.grid_spacing,
            "bounds": scene.bounds,
            "gravity": scene.gravity,
            "config": json.dumps({"scene": asdict(scene)}, sort_keys=True),
            **provenance,
        }
    )


def sample_scene(config: SceneConfig, material: str, value: float, seed: int) -> State:
    """Draw a scene.

    Args:
        config: distribution to draw from.
        material: of all bodies.
        value: of its material parameter, in the unit that ``schema`` gives.
        seed: non-negative integer.

    Returns:
        State at time 0 with exactly ``config.num_particles`` particles in random order, float64.

    Raises:
        ValueError: the bodies do not fit into the domain.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    for _ in range(MAX_ATTEMPTS):
        shapes = (*_walls(config, rng), *_obstacles(config, rng))
        pos = _bodies(config, shapes, rng)
        if pos is not None:
            break
    else:
        raise ValueError(
            f"no room for {config.num_particles} particles of spacing {config.spacing:g} m and {config.max_obstacles} obstacles in {config.bounds}; "
            "lower num_particles, max_bodies, max_obstacles or drop_height"
        )
    vel = np.concatenate([np.broadcast_to(_velocity(config, rng), body.shape) for body in pos])
    # labels must not tell where a particle started
    order = rng.permutation(config.num_particles)
    count, dim = config.num_particles, len(config.bounds)
    return State(
        pos=np.concatenate(pos)[order],
        vel=vel[order],
        node_type=np.full(count, node_code(material), dtype=np.uint8),
        mass=np.full(count, config.density * config.spacing**dim),
        material_params=np.full((count, 1), float(value)),
        boundary=Boundary.sample(shapes, config.spacing, dim),
        gravity=np.array(config.gravity),
    )


def _friction(config: SceneConfig, rng: np.random.Generator, may_slip: bool = True) -> float:
    kind, coulomb = rng.random(), rng.uniform(*config.coulomb_friction)
    if kind < config.sticky_probability:
        return STICKY
    slips = may_slip and kind < config.sticky_probability + config.slip_probability
    return 0.0 if slips else float(coulomb)


def _walls(config: SceneConfig, rng: np.random.Generator) -> tuple[Shape, ...]:
    names = [f"{axis}_{side}" for axis in "xyz"[: len(config.bounds)] for side in ("low", "high")]
    floor = f"{'xyz'[len(config.bounds) - 1]}_low"  # on a frictionless floor sand slides for ever and no pile comes to rest
    return domain_walls(config.bounds, {name: _friction(config, rng, may_slip=name != floor) for name in names})


def _obstacles(config: SceneConfig, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Boxes, discs and convex polygons whose circumscribed circles stay clear of the walls and of each other."""
    obstacles: list[Shape] = []
    circles: list[tuple[np.ndarray, float]] = []
    low, high = np.array(config.bounds).T
    gap = 2.0 * config.grid_spacing  # narrower gaps are invisible to the grid
    for _ in range(rng.integers(config.max_obstacles + 1)):
        radius, angle, sides = rng.uniform(*config.obstacle_radius), rng.uniform(0, 2 * math.pi), int(rng.integers(3, 7))
        kind, friction, share = rng.integers(3), _friction(config, rng), rng.uniform(0.3, 0.7)
        room_low, room_high = low + radius + gap, high - radius - gap
        if np.any(room_low > room_high):
            continue
        center = rng.uniform(room_low, room_high)
        if any(np.linalg.norm(center - c) < radius + r + gap for c, r in circles):
            continue
        circles.append((center, radius))
        if kind == 0:
            half = radius * np.array([math.cos(share * math.pi / 2), math.sin(share * math.pi / 2)])
            obstacles.append(Box(_floats(center - half), _floats(center + half), friction))
        elif kind == 1:
            obstacles.append(Sphere(_floats(center), float(radius), friction))
        else:
            turn = angle + 2 * math.pi * np.arange(sides) / sides
            vertices = center + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            obstacles.append(Polygon(tuple((float(x), float(y)) for x, y in vertices), friction))
    return tuple(obstacles)


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _bodies(config: SceneConfig, shapes: tuple[Shape, ...], rng: np.random.Generator) -> list[np.ndarray] | None:
    """Particle positions of each body, or None where this layout leaves no room."""
    low, high = np.array(config.bounds).T
    number = int(rng.integers(1, config.max_bodies + 1))
    share = rng.dirichlet(np.full(number, 4.0))
    counts = np.diff(np.round(np.concatenate([[0.0], np.cumsum(share)]) * config.num_particles)).astype(int)
    boxes: list[tuple[np.ndarray, np.ndarray]] = []
    placed = []
    for count in counts[counts > 0]:
        body = _body(int(count), config.spacing, rng)
        extent_low, extent_high = body.min(axis=0), body.max(axis=0)
        gap = max(0.5 * config.spacing, rng.uniform(*config.drop_height))
        clearance = 0.5 * config.spacing
        lowest = np.array([low[0] + clearance, low[1] + gap]) - extent_low
        highest = high - clearance - extent_high
        if np.any(lowest > highest):
            return None
        body = body + np.array([rng.uniform(lowest[0], highest[0]), lowest[1]])
        # rise until nothing is in the way: bodies also start above obstacles and above each other
        for _ in range(math.floor((highest[1] - lowest[1]) / config.grid_spacing) + 1):
            box = (body.min(axis=0) - config.grid_spacing, body.max(axis=0) + config.grid_spacing)
            overlaps = any(np.all(box[0] < other[1]) and np.all(other[0] < box[1]) for other in boxes)
            if not overlaps and np.all(signed_distance(shapes, body) > 0.9 * clearance):
                break
            body = body + np.array([0.0, config.grid_spacing])
        else:
            return None
        boxes.append(box)
        placed.append(body)
    return placed


def _velocity(config: SceneConfig, rng: np.random.Generator) -> np.ndarray:
    """Velocity of a body [dim] in m/s: any horizontal direction, mostly downward."""
    return config.max_speed * np.array([rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 0.25)])


def _body(count: int, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """``count`` points [count, dim] of a jittered lattice that fill a randomly turned rectangle, disc or convex polygon around the origin.

    Every shape is a level set of a gauge, so the points of smallest gauge are the wanted number of points in the shape of the right size.
    """
    gauge = _gauge(rng)
    reach = math.ceil(2.0 * math.sqrt(count)) + 2
    lattice = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    points = lattice + rng.uniform(-JITTER, JITTER, lattice.shape) + rng.uniform(-0.5, 0.5, 2)
    kept = points[np.argsort(gauge(points), kind="stable")[:count]]
    turn = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return spacing * kept @ rotation.T


def _gauge(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A random convex shape as the factor [points] by which it must be scaled to reach each point [points, 2]."""
    kind = rng.integers(3)
    if kind == 0:
        stretch = math.sqrt(rng.uniform(1.0, 2.5))
        return lambda x: np.max(np.abs(x) / np.array([stretch, 1.0 / stretch]), axis=-1)
    if kind == 1:
        return lambda x: np.linalg.norm(x, axis=-1)
    sides = int(rng.integers(3, 8))
    angle = 2 * math.pi * (np.arange(sides) + rng.uniform(-0.2, 0.2, sides)) / sides
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return lambda x: np.max(x @ normals.T, axis=-1)
