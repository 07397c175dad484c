"""Seeded random channels: liquid enters at low x, flows over a floor that may have a sill, and leaves freely at high x. The last axis points up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.geometry.shapes import Box, Shape, domain_walls, signed_distance
from gpe_pl.schema import STICKY, MaterialValues, node_code
from gpe_pl.solvers.scenes import CLEARANCE, LiquidOnGrid, Probability, check_domain, check_ranges, filled_box, floats, parameter_columns
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


@dataclass(frozen=True, config={"extra": "forbid"})
class ChannelScene(LiquidOnGrid):
    """Distribution of channels with an inlet and an outlet.

    Attributes:
        bounds: ``(low, high)`` of the domain along each axis [m].
        grid_spacing: grid spacing of the solver [m].
        particles_per_cell: particles along each axis of a cell; the rest spacing is ``grid_spacing / particles_per_cell``.
        density: density of the liquid [kg/m³].
        gravity: acceleration of gravity [m/s²].
        friction: friction coefficient of all solids; ``schema.STICKY`` is no-slip, 0 is frictionless. The solver ``flip`` does not use it.
        connectivity_cells: recommended connectivity radius in grid cells.
        inlet_cells: range of the height of the inlet, in grid cells; whole numbers are equally frequent.
        speed: range of the speed at which liquid enters [m/s].
        changing: probability that the speed changes linearly, between two drawn speeds.
        change_time: time of such a change, from the start on [s].
        filled_height: range of the height of the liquid in the channel at the start, over that of the inlet. The liquid moves with the speed of the inlet.
        filled_length: range of the fraction of the channel that this liquid fills, from the inlet on.
        sill: probability of a sill, a cell high and two cells long, across the whole channel.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: PositiveFloat
    particles_per_cell: Count = 2
    density: PositiveFloat = 1000.0
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    friction: NonNegativeFloat = STICKY
    connectivity_cells: PositiveFloat = 1.5
    inlet_cells: tuple[Count, Count] = (2, 3)
    speed: tuple[PositiveFloat, PositiveFloat] = (0.4, 0.8)
    changing: Probability = 0.0
    change_time: PositiveFloat = 0.5
    filled_height: tuple[PositiveFloat, PositiveFloat] = (0.5, 1.5)
    filled_length: tuple[NonNegativeFloat, Annotated[float, Field(ge=0, le=1)]] = (0.0, 1.0)
    sill: Probability = 0.5

    def __post_init__(self) -> None:
        check_domain(self.bounds, self.gravity)
        check_ranges(self, "inlet_cells", "speed", "filled_height", "filled_length")
        room = np.diff(np.array(self.bounds), axis=1)[:, 0]
        if min(room) < 4 * self.grid_spacing:
            raise ValueError(f"bounds {self.bounds} must be at least 4 cells of grid_spacing = {self.grid_spacing} wide")
        if room[0] < 2 * self._zone + 6 * self.grid_spacing:
            raise ValueError(f"bounds: the channel is {room[0]:g} m long along x, too short for inlet, outlet and 6 cells between them")
        if self.inlet_cells[1] * self.grid_spacing > room[-1]:
            raise ValueError(f"inlet_cells = {self.inlet_cells}: the highest inlet does not fit into bounds {self.bounds}")

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def max_nodes(self) -> int:
        """Number of nodes that fill the whole domain, for the space that data need on a disk."""
        return math.ceil(float(np.prod([(high - low) / self.spacing for low, high in self.bounds])))

    @property
    def input_files(self) -> dict[str, str]:
        return {}

    @property
    def _zone(self) -> float:
        """Length of inlet and outlet along x [m]: whole cells, at least as long as nodes see each other."""
        return math.ceil(self.connectivity_cells - 1e-6) * self.grid_spacing

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State:
        """Draw a channel. It depends only on configuration, values and seed.

        Args:
            values: kinematic viscosity [m²/s] under the key ``fluid``.
            seed: non-negative integer.

        Returns:
            State at time 0, float64, with an inlet and an outlet.
        """
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        height = self.grid_spacing * int(rng.integers(self.inlet_cells[0], self.inlet_cells[1], endpoint=True))
        first, second = rng.uniform(*self.speed, size=2).tolist()
        speeds = ((0.0, first), (self.change_time, second)) if rng.random() < self.changing else ()
        low, high = np.array(self.bounds).T
        top = np.array([low[0] + self._zone, *high[1:-1], low[-1] + height])
        inlet = Opening(floats(low), floats(top), "x_low", None if speeds else first, speeds=speeds)
        outlet = Opening((float(high[0] - self._zone), *floats(low[1:])), floats(high), "x_high")
        shapes: tuple[Shape, ...] = (*domain_walls(self.bounds, self.friction), *self._sills(rng))
        inside = self._filled(inlet, outlet, shapes, rng)
        node_type = np.full(1, node_code("fluid"), dtype=np.uint8)
        params, names = parameter_columns(values, node_type, self.materials)
        mass, own = self.density * self.spacing**self.dim, tuple(params[0].tolist())
        inlet = replace(inlet, spacing=self.spacing, node_type=int(node_type[0]), mass=mass, params=own)
        pos = np.concatenate([inlet.nodes_at_start(), inside])
        pos = pos[rng.permutation(len(pos))]  # node numbers must not reveal where a particle started
        state = State(
            pos=pos,
            vel=np.tile(inlet.velocity_at(0.0), (len(pos), 1)),
            node_type=np.repeat(node_type, len(pos)),
            mass=np.full(len(pos), inlet.mass),
            material_params=np.repeat(params, len(pos), axis=0),
            boundary=Boundary.sample(shapes, self.spacing, self.dim),
            gravity=np.array(self.gravity, dtype=np.float64),
            param_names=names,
        )
        return state.opened([inlet, outlet])

    def _sills(self, rng: np.random.Generator) -> list[Box]:
        cell, (low, high) = self.grid_spacing, np.array(self.bounds).T
        place = rng.uniform(low[0] + self._zone + 2 * cell, high[0] - self._zone - 3 * cell)
        if rng.random() >= self.sill:
            return []
        corner, size = np.array([place, *(low[1:] - cell)]), np.array([2 * cell, *(high[1:-1] - low[1:-1] + 2 * cell), 2 * cell])
        return [Box(floats(corner), floats(corner + size), self.friction)]  # extends below the floor, so that no water gets under it

    def _filled(self, inlet: Opening, outlet: Opening, shapes: tuple[Shape, ...], rng: np.random.Generator) -> np.ndarray:
        """Return the liquid [node, dim] between inlet and outlet at the start."""
        start, end = inlet.high[0], outlet.low[0]
        last = start + rng.uniform(*self.filled_length) * (end - start)
        floor, ceiling = self.bounds[-1]
        top = min(floor + rng.uniform(*self.filled_height) * (inlet.high[-1] - floor), ceiling)
        points = filled_box([(start, last), *self.bounds[1:-1], (floor, top)], self.spacing, rng)
        if not len(points):
            return points
        kept: np.ndarray = points[signed_distance(shapes, points) > CLEARANCE * self.spacing * (1 - 1e-6)]
        return kept
