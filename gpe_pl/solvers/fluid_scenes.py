"""Seeded random scenes of liquid: a spherical bowl, a dam break, and a canyon with a waterfall. The last axis points up."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy.spatial import cKDTree

from gpe_pl.geometry.body_shapes import jittered_lattice
from gpe_pl.geometry.canyon import canyon
from gpe_pl.geometry.grid_distance import Bounds, Solid
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Shape, domain_walls, signed_distance
from gpe_pl.geometry.terrain import Fit, Up, read_terrain
from gpe_pl.schema import STICKY, MaterialValues, node_code
from gpe_pl.solvers.scenes import (
    CLEARANCE,
    MAX_ATTEMPTS,
    LiquidOnGrid,
    check_domain,
    check_ranges,
    draw_velocity,
    filled_box,
    floats,
    parameter_columns,
)
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True, config={"extra": "forbid"})
class TerrainOptions:
    """Options ``fit``, ``up``, ``solid`` and ``relief`` of ``geometry.terrain.read_terrain``, which describes them."""

    fit: Fit = "contain"
    up: Up = "z"
    solid: Solid | Literal["auto"] = "auto"
    relief: PositiveFloat | None = None


@dataclass(frozen=True, config={"extra": "forbid"})
class FluidScene(LiquidOnGrid):
    """Distribution of scenes with liquid.

    Attributes:
        scene: ``bowl``: liquid falls in a closed sphere (2D: circle), one cell away from the nearest walls. ``dam_break``: a column collapses from one side
            of a box. ``canyon``: a reservoir runs down a river bed and over a waterfall (3D).
        bounds: ``(low, high)`` of the domain along each axis [m].
        grid_spacing: grid spacing of the solver [m].
        num_particles: exact number of particles in every scene.
        particles_per_cell: particles along each axis of a cell; the rest spacing is ``grid_spacing / particles_per_cell``.
        density: density of the liquid [kg/m³].
        gravity: acceleration of gravity [m/s²].
        friction: friction coefficient of all solids; ``schema.STICKY`` is no-slip, 0 is frictionless. The solver ``flip`` does not use it.
        connectivity_cells: recommended connectivity radius in grid cells.
        max_bodies: largest number of bodies in the bowl; the number is uniform in 1 … max_bodies.
        max_speed: largest speed of a body in the bowl along each axis [m/s]; upward at most a quarter of it.
        column_aspect: range of height / width of the column of the dam break.
        max_obstacles: largest number of boxes on the floor of the dam break; the number is uniform in 0 … max_obstacles. Boxes without room are left out.
        terrain: mesh, point cloud or height map that replaces the random canyon, as a path relative to the working directory.
        terrain_options: options for reading that file.
        reservoir: region ``(low, high)`` along each axis [m] where the water of the canyon starts. Water fills it from its low x and its lowest free place
            on. The default is the reservoir of the random canyon or, with a terrain file, the third of the domain at low x.
    """

    scene: Literal["bowl", "dam_break", "canyon"]
    bounds: tuple[tuple[float, float], ...]
    grid_spacing: PositiveFloat
    num_particles: Annotated[int, Field(ge=1)]
    particles_per_cell: Annotated[int, Field(ge=1)] = 2
    density: PositiveFloat = 1000.0
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    friction: NonNegativeFloat = STICKY
    connectivity_cells: PositiveFloat = 1.5
    max_bodies: Annotated[int, Field(ge=1)] = 2
    max_speed: NonNegativeFloat = 1.0
    column_aspect: tuple[PositiveFloat, PositiveFloat] = (0.5, 2.0)
    max_obstacles: Annotated[int, Field(ge=0)] = 0
    terrain: str | None = None
    terrain_options: TerrainOptions = TerrainOptions()
    reservoir: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        check_domain(self.bounds, self.gravity)
        if self.scene == "canyon" and self.dim != 3:
            raise ValueError(f"scene='canyon' needs bounds of 3 axes, got {self.bounds}")
        if self.scene != "canyon" and (self.terrain is not None or self.reservoir is not None):
            raise ValueError(f"terrain and reservoir belong to scene='canyon', not to scene={self.scene!r}")
        if self.reservoir is not None and (len(self.reservoir) != self.dim or any(not high > low for low, high in self.reservoir)):
            raise ValueError(f"reservoir must be (low, high) with low < high along {self.dim} axes, got {self.reservoir}")
        check_ranges(self, "column_aspect")
        narrowest = min(high - low for low, high in self.bounds)
        if narrowest < 4 * self.grid_spacing:
            raise ValueError(f"bounds {self.bounds} must be at least 4 cells of grid_spacing = {self.grid_spacing} wide")

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def max_nodes(self) -> int:
        """Largest number of dynamic nodes of a scene."""
        return self.num_particles

    @property
    def input_files(self) -> dict[str, str]:
        return {} if self.terrain is None else {"terrain": self.terrain}

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State:
        """Draw a scene. It depends only on configuration, values, seed and the content of the terrain file, if any.

        Args:
            values: kinematic viscosity [m²/s] under the key ``fluid``.
            seed: non-negative integer.

        Returns:
            State at time 0 with exactly ``num_particles`` particles in random order, float64.

        Raises:
            ValueError: the liquid does not fit, or the terrain cannot be used.
        """
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        shapes, pos, vel = {"bowl": _bowl, "dam_break": _dam_break, "canyon": _canyon}[self.scene](self, rng)
        node_type = np.full(self.num_particles, node_code("fluid"), dtype=np.uint8)
        params, names = parameter_columns(values, node_type, self.materials)
        order = rng.permutation(self.num_particles)  # node numbers must not reveal where a particle started
        return State(
            pos=np.ascontiguousarray(pos[order]),
            vel=np.ascontiguousarray(vel[order]),
            node_type=node_type,
            mass=np.full(self.num_particles, self.density * self.spacing**self.dim),
            material_params=params,
            boundary=Boundary.sample(shapes, self.spacing, self.dim),
            gravity=np.array(self.gravity, dtype=np.float64),
            param_names=names,
        )


Sampled = tuple[tuple[Shape, ...], np.ndarray, np.ndarray]
"""Solids, positions [node, dim] and velocities [node, dim]."""


def _bowl(config: FluidScene, rng: np.random.Generator) -> Sampled:
    low, high = np.array(config.bounds).T
    center, radius = (low + high) / 2, float(np.min(high - low)) / 2 - config.grid_spacing
    bowl = Bowl(floats(center), radius, config.friction)
    room = {2: math.pi, 3: 4 / 3 * math.pi}[config.dim] * max(0.0, radius - config.spacing) ** config.dim
    for _ in range(MAX_ATTEMPTS if config.num_particles * config.spacing**config.dim < room else 0):
        number = int(rng.integers(1, config.max_bodies + 1))
        fraction = rng.dirichlet(np.full(number, 4.0))
        counts = np.diff(np.round(np.concatenate([[0.0], np.cumsum(fraction)]) * config.num_particles)).astype(int)
        bodies = [_body(int(count), config, rng) for count in counts[counts > 0]]
        placed = _placed(bodies, bowl, config, rng)
        if placed is not None:
            vel = [np.broadcast_to(draw_velocity(config.max_speed, config.dim, rng), body.shape) for body in placed]
            return (*domain_walls(config.bounds, config.friction), bowl), np.concatenate(placed), np.concatenate(vel)
    raise ValueError(
        f"no room for {config.num_particles} particles of spacing {config.spacing:g} m in up to {config.max_bodies} bodies in a bowl of radius {radius:g} m; "
        "lower num_particles, grid_spacing or max_bodies"
    )


def _placed(bodies: list[np.ndarray], bowl: Bowl, config: FluidScene, rng: np.random.Generator) -> list[np.ndarray] | None:
    """Place the bodies at random in the bowl, one cell away from each other; return None if this fails."""
    placed: list[np.ndarray] = []
    center = np.array(bowl.center)
    for body in bodies:
        reach = bowl.radius - float(np.max(np.linalg.norm(body, axis=-1)))
        if reach <= config.spacing:
            return None
        for _ in range(10):
            body_pos = body + center + reach * rng.uniform(-1.0, 1.0, config.dim)
            inside = np.all(bowl.signed_distance(body_pos) > config.spacing)
            if inside and all(cKDTree(other).query(body_pos)[0].min() > config.grid_spacing for other in placed):
                placed.append(body_pos)
                break
        else:
            return None
    return placed


def _body(count: int, config: FluidScene, rng: np.random.Generator) -> np.ndarray:
    """Return ``count`` points [count, dim] of a jittered lattice that fill a ball or a randomly turned box around the origin."""
    dim = config.dim
    gauge: Callable[[np.ndarray], np.ndarray]
    if rng.random() < 0.5:
        longest = 1.0

        def gauge(x: np.ndarray) -> np.ndarray:
            return np.linalg.norm(x, axis=-1)
    else:
        stretch = np.exp(rng.uniform(-0.25, 0.25, dim))
        stretch = stretch / np.prod(stretch) ** (1 / dim)
        longest = float(stretch.max())

        def gauge(x: np.ndarray) -> np.ndarray:
            return np.max(np.abs(x) / stretch, axis=-1)

    reach = math.ceil(0.75 * longest * count ** (1 / dim)) + 2
    points = jittered_lattice(np.full(dim, -reach), np.full(dim, reach), rng) + rng.uniform(-0.5, 0.5, dim)
    kept = points[np.argsort(gauge(points), kind="stable")[:count]]
    rotation, upper = np.linalg.qr(rng.normal(size=(dim, dim)))
    return config.spacing * kept @ (rotation * np.sign(np.diag(upper))).T


def _dam_break(config: FluidScene, rng: np.random.Generator) -> Sampled:
    """Place a column at the low or high side along x; in 3D it spans the whole width."""
    low, high = np.array(config.bounds).T
    room = high - low
    face = config.num_particles * config.spacing**config.dim / float(np.prod(room[1:-1]))  # width times height
    # leave a rim of one spacing, because the lattice seldom divides the domain
    widest, tallest = 0.8 * room[0], room[-1] - config.spacing
    least, most = max(config.column_aspect[0], face / widest**2), min(config.column_aspect[1], tallest**2 / face)
    if least > most:
        raise ValueError(
            f"no room for a column of {config.num_particles} particles of spacing {config.spacing:g} m with "
            f"column_aspect {config.column_aspect} in {config.bounds}; lower num_particles, or change column_aspect or bounds"
        )
    aspect, mirrored = math.exp(rng.uniform(math.log(least), math.log(most))), bool(rng.random() < 0.5)
    width = math.sqrt(face / aspect)
    points = filled_box(config.bounds, config.spacing, rng)
    gauge = np.maximum((points[:, 0] - low[0]) / width, (points[:, -1] - low[-1]) / (aspect * width))
    if len(points) < config.num_particles:
        raise ValueError(
            f"{config.num_particles} particles of spacing {config.spacing:g} m do not fit into {config.bounds}, at most {len(points)}"
        )
    pos = points[np.argsort(gauge, kind="stable")[: config.num_particles]]
    shapes: tuple[Shape, ...] = (*domain_walls(config.bounds, config.friction), *_obstacles(config, float(pos[:, 0].max()), rng))
    if mirrored:
        pos[:, 0] = low[0] + high[0] - pos[:, 0]
        shapes = tuple(_mirrored(shape, float(low[0] + high[0])) if isinstance(shape, Box) else shape for shape in shapes)
    return shapes, pos, np.zeros_like(pos)


def _mirrored(box: Box, twice_middle: float) -> Box:
    return Box((twice_middle - box.high[0], *box.low[1:]), (twice_middle - box.low[0], *box.high[1:]), box.friction, box.restitution)


def _obstacles(config: FluidScene, start: float, rng: np.random.Generator) -> list[Box]:
    """Place boxes on the floor beyond x = ``start``, two cells away from the liquid, from each other and from the walls that they do not stand on."""
    low, high = np.array(config.bounds).T
    gap, boxes = 2.0 * config.grid_spacing, list[Box]()
    for _ in range(rng.integers(config.max_obstacles + 1)):
        size = np.maximum(gap, rng.uniform(0.1, 0.25, config.dim) * np.min(high - low))
        corner = np.array([start + gap, *(low[1:] + gap)])
        room = high - gap - size - corner
        fraction = rng.random(config.dim)
        if np.any(room < 0):
            continue
        corner = corner + fraction * room
        corner[-1], size[-1] = low[-1] - gap, size[-1] + gap  # extends below the floor, so that no water gets under it
        if any(np.all(corner < np.array(b.high) + gap) and np.all(corner + size > np.array(b.low) - gap) for b in boxes):
            continue
        boxes.append(Box(floats(corner), floats(corner + size), config.friction))
    return boxes


def _canyon(config: FluidScene, rng: np.random.Generator) -> Sampled:
    """Fill the reservoir from its headwall and its lowest place on, to the same fraction of its length and height."""
    bounds = config.bounds
    if config.terrain is None:
        made = canyon(int(rng.integers(2**32)), bounds, config.grid_spacing, config.friction)
        terrain, region = made.terrain, config.reservoir or made.reservoir
    else:
        path = Path(config.terrain)
        stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else (0, 0)
        terrain = _read(str(path.absolute()), stamp, bounds, config.grid_spacing, config.terrain_options, config.friction)
        first, last = bounds[0]
        region = config.reservoir or ((first, first + (last - first) / 3), *bounds[1:])
    shapes: tuple[Shape, ...] = (*domain_walls(bounds, config.friction), terrain)
    inside = [(max(a, low), min(b, high)) for (a, b), (low, high) in zip(region, bounds, strict=True)]
    points = filled_box(inside, config.spacing, rng)
    points = points[signed_distance(shapes, points) > CLEARANCE * config.spacing * (1 - 1e-6)]
    if len(points) < config.num_particles:
        raise ValueError(
            f"{config.num_particles} particles of spacing {config.spacing:g} m do not fit into the reservoir {region}, at most {len(points)}; "
            "lower num_particles or grid_spacing, or give a larger reservoir"
        )
    corner = np.array([region[0][0], points[:, -1].min()])
    extent = np.array([region[0][1], region[-1][1]]) - corner
    gauge = np.max((points[:, [0, -1]] - corner) / extent, axis=-1)
    pos = points[np.argsort(gauge, kind="stable")[: config.num_particles]]
    return shapes, pos, np.zeros_like(pos)


@functools.lru_cache(maxsize=4)
def _read(path: str, stamp: tuple[int, int], bounds: Bounds, spacing: float, options: TerrainOptions, friction: float) -> DistanceGrid:
    """Call ``read_terrain``, once per content of the file (``stamp``) instead of once per scene."""
    return read_terrain(path, bounds, spacing, friction=friction, **asdict(options))  # type: ignore[call-overload]
