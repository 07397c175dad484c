"""``MPM``, the simulator: settings, checks of the state, and errors that say what is wrong."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass

from gpe_pl.geometry.shapes import check_whole_cells
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import MATERIALS, NODE_TYPES, node_code, param_names
from gpe_pl.solvers.materials import LIMITS, MEMORY, NUM_CONSTANTS, Elastomer, Fluid, Sand, Snow, check_limits
from gpe_pl.solvers.mpm.collider import Collider, collider
from gpe_pl.solvers.mpm.frame import ESCAPE, NOT_FINITE, OK, advance
from gpe_pl.solvers.mpm.particles import Particles
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

PADDING = 3
"""Cells between the domain and the edge of the grid: room for the kernel of a particle on a wall, or one cell behind it."""

UNDEFORMED = 1e-3
"""Relative change of the distance between two nodes of a cell up to which a mesh counts as undeformed: far more than the rounding of stored positions."""

KNOWN = ("sand", "snow", "elastomer", "fluid")
"""Materials that have a law; also the names of the solver's settings that hold their constants."""


@dataclass(frozen=True)
class MPMInternal:
    """What the solver knows about its particles besides position and velocity.

    Attributes:
        deformation: elastic deformation gradient F [node, dim, dim].
        affine: affine part of the velocity that the particle brings to the grid [node, dim, dim] in 1/s, C of APIC.
        gradient: velocity gradient of the grid at the particle [node, dim, dim] in 1/s, by which it deforms.
        plastic: plastic state [node]: the volume correction of sand, ``J_P - 1`` of snow.
        last_substep: length of the substep before [s]; 0 where there is none.
    """

    deformation: np.ndarray
    affine: np.ndarray
    gradient: np.ndarray
    plastic: np.ndarray
    last_substep: np.ndarray = field(default_factory=lambda: np.zeros(()))

    @classmethod
    def at_rest(cls, num_nodes: int, dim: int) -> MPMInternal:
        """Undeformed particles that do not rotate."""
        still = np.zeros((num_nodes, dim, dim))
        return cls(np.tile(np.eye(dim), (num_nodes, 1, 1)), still, still.copy(), np.zeros(num_nodes))


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class MPM:
    """Material point solver; a ``Simulator``.

    How particles are deformed cannot be told from their positions, so a state is either the start of a scene, where nothing is deformed, or one that ``step``
    returned, with its ``internal`` part. Frames of a stored or predicted trajectory after the first one are refused.

    Each step advances one frame by substeps that satisfy ``h (c + |v|_max) <= cfl Δ``, with c the fastest elastic wave in any particle as it is deformed and
    hardened now, ``h² |g| <= cfl Δ / 4`` and ``8 h ν <= Δ²``. They are chosen from the current state alone, so a restart repeats a run-through bit by bit.
    Obstacles must be at least one grid cell thick.

    Attributes:
        bounds: ``(low, high)`` per axis of the domain [m]; whole multiples of the grid spacing apart.
        grid_spacing: Δ [m].
        frame_dt: time between frames [s].
        materials: every material of the data set, which fixes the columns of ``State.material_params``.
        sand, snow, elastomer, fluid: constants of each material, of liquid the usual ones if None. Particles carry mass, so the density tells their volume.
        cfl: fraction of a cell that a wave or a particle may cross in one substep.
        max_substeps: per frame; more means that the state has exploded.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: Annotated[float, Field(gt=0)]
    frame_dt: Annotated[float, Field(gt=0)] = 5e-3
    materials: tuple[str, ...] = ("sand",)
    sand: Sand = field(default_factory=Sand)
    snow: Snow = field(default_factory=Snow)
    elastomer: Elastomer = field(default_factory=Elastomer)
    fluid: Fluid | None = None
    cfl: Annotated[float, Field(gt=0, le=1)] = 0.5
    max_substeps: Annotated[int, Field(ge=1)] = 1000

    name: ClassVar[str] = "mpm"
    version: ClassVar[str] = "6"
    stores_stress: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_whole_cells(self.bounds, self.grid_spacing)
        unknown = [m for m in self.materials if m not in KNOWN]
        if unknown or not self.materials:
            raise ValueError(f"MPM has no law for material {', '.join(unknown) or '(none)'}; known: {', '.join(KNOWN)}")

    @property
    def solver_dt(self) -> float:
        """Largest substep in s: that of particles at rest of the material with the slowest waves."""
        slowest = min(m.smallest_stiffness / m.density for m in (self.constants_of(name) for name in self.materials))
        return min(self.frame_dt, self.cfl * self.grid_spacing / math.sqrt(slowest))

    @property
    def numerical_viscosity(self) -> float:
        """Kinematic viscosity in m²/s that the transfers add to that of liquid in waves of 16 cells, ``Δ²/(256 (τ + h))``.

        τ is the time for which particles keep what the grid does not hold, and h a substep. It is less in longer waves.
        """
        fluid: Fluid = self.fluid or Fluid()
        substep = self.cfl * self.grid_spacing / math.sqrt(fluid.bulk_modulus / fluid.density)
        return self.grid_spacing**2 / (256.0 * (fluid.memory * self.grid_spacing + substep))

    @property
    def smallest_resolved(self) -> dict[str, float]:
        """Smallest parameter of each material that is not below what the grid adds to it."""
        return {"fluid": self.numerical_viscosity} if "fluid" in self.materials else {}

    def constants_of(self, material: str) -> Sand | Snow | Elastomer | Fluid:
        """Of a material by its name."""
        return getattr(self, material) or Fluid()

    def compile_kernels(self) -> None:
        """Compile what this solver's dimension needs and fill Numba's cache on disk, so that worker processes started afterwards only load it."""
        material, dim = self.materials[0], len(self.bounds)
        params = np.full((1, len(param_names(self.materials))), LIMITS[material].low)
        middle = np.array([[(low + high) / 2 for low, high in self.bounds]])
        code = np.array([node_code(material)], dtype=np.uint8)
        self.step(State(middle, np.zeros((1, dim)), code, np.ones(1), params, Boundary.empty(dim), np.zeros(dim)))

    def step(self, state: State) -> State:
        """Advance one frame.

        Raises:
            SimulationError: with reason ``input`` (arrays or obstacles that do not fit the solver, or no ``internal`` where it is needed), ``nan``,
                ``escape`` (a particle left the domain through an open side or started outside) or ``explosion`` (more than ``max_substeps``).
        """
        check_surroundings(state, "MPM")
        internal = state.internal if state.internal is not None else MPMInternal.at_rest(state.num_nodes, len(self.bounds))
        particles = self._particles(state, internal)
        if state.internal is None:
            self._require_undeformed(state)
        origin = tuple(low - PADDING * self.grid_spacing for low, _ in self.bounds)
        counts = tuple(round((high - low) / self.grid_spacing) + 1 + 2 * PADDING for low, high in self.bounds)
        status, node, num_substeps, last_substep = advance(
            particles,
            self._collider(state.boundary, origin, counts),
            np.asarray(state.gravity, dtype=np.float64),
            np.asarray(self.bounds),
            np.asarray(origin),
            counts,
            self.grid_spacing,
            self.frame_dt,
            self.cfl,
            self.max_substeps,
            float(internal.last_substep),
        )
        if status != OK:
            raise self._error(status, node, particles.pos, particles.vel, state.gravity)
        return replace(
            state,
            pos=particles.pos,
            vel=particles.vel,
            velocity_history=None,
            time=state.time + self.frame_dt,
            num_substeps=num_substeps,
            internal=MPMInternal(particles.deformation, particles.affine, particles.gradient, particles.plastic, np.array(last_substep)),
        )

    def _require_undeformed(self, state: State) -> None:
        remedy = "start at frame 0 of a scene, or step on from the state that the solver returned"
        if state.time > 0:
            message = (
                f"the state at {state.time:g} s has no internal part (how its particles are deformed), which MPM cannot find out; {remedy}"
            )
            raise SimulationError(message, reason="input")
        if state.rest_pos is not None and state.cells is not None:
            stretch, node = _largest_stretch(np.asarray(state.pos), np.asarray(state.rest_pos), np.asarray(state.cells))
            if stretch > UNDEFORMED:
                message = (
                    f"the state has no internal part, but its cells are stretched or compressed by up to {100 * stretch:.3g} % against rest_pos "
                    f"(node {node}); {remedy}"
                )
                raise SimulationError(message, reason="input", node=node)

    def _collider(self, boundary: Boundary, origin: tuple[float, ...], counts: tuple[int, ...]) -> Collider:
        return collider(tuple(boundary.shapes), origin, self.grid_spacing, counts)

    def _particles(self, state: State, internal: object) -> Particles:
        """The particles in the form that the kernels take, or an error that names what does not fit."""
        num_nodes, dim = state.num_nodes, len(self.bounds)
        names = param_names(self.materials)
        shapes = {
            "pos": (state.pos, (num_nodes, dim)),
            "vel": (state.vel, (num_nodes, dim)),
            "mass": (state.mass, (num_nodes,)),
            "node_type": (state.node_type, (num_nodes,)),
            "material_params": (state.material_params, (num_nodes, len(names))),
            "gravity": (state.gravity, (dim,)),
        }
        if not isinstance(internal, MPMInternal):
            raise SimulationError(f"internal state is of type {type(internal).__name__}, expected MPMInternal or None", reason="input")
        shapes["internal.deformation"] = (internal.deformation, (num_nodes, dim, dim))
        shapes["internal.affine"] = (internal.affine, (num_nodes, dim, dim))
        shapes["internal.gradient"] = (internal.gradient, (num_nodes, dim, dim))
        shapes["internal.plastic"] = (internal.plastic, (num_nodes,))
        for name, (array, expected) in shapes.items():
            if np.shape(array) != expected:
                raise SimulationError(f"{name} has shape {np.shape(array)}, expected {expected}", reason="input")
            if name not in ("material_params", "gravity"):
                self._require(np.isfinite(array), f"{name} is not finite", reason="nan")
        if not np.all(np.isfinite(state.gravity)):
            raise SimulationError(f"gravity {state.gravity} is not finite", reason="nan")
        self._require(np.asarray(state.mass) > 0, "mass is not positive")
        law, specific_volume, constants = np.empty(num_nodes, dtype=np.int64), np.empty(num_nodes), np.empty((num_nodes, NUM_CONSTANTS))
        known = np.zeros(num_nodes, dtype=bool)
        for name in self.materials:
            chosen = np.asarray(state.node_type) == node_code(name)
            material, parameter = self.constants_of(name), MATERIALS[name]
            values = np.asarray(state.material_params, dtype=np.float64)[:, names.index(parameter.name)]
            check_limits(name, values[chosen], np.flatnonzero(chosen))
            law[chosen], specific_volume[chosen] = material.law, 1.0 / material.density
            constants[chosen] = material.constants(values[chosen], dim)
            known |= chosen
        self._require(known, f"node_type is none of the solver's materials {', '.join(self.materials)} (codes of {', '.join(NODE_TYPES)})")
        # np.array copies: the kernels work in place and the caller's arrays must not change
        changing = (state.pos, state.vel, internal.deformation, internal.affine, internal.plastic)
        pos, vel, deformation, affine, plastic = (np.array(x, dtype=np.float64, order="C") for x in changing)
        gradient = np.array(internal.gradient, dtype=np.float64, order="C") if np.any(constants[:, MEMORY] > 0) else affine
        mass = np.array(state.mass, dtype=np.float64)
        return Particles(pos, vel, deformation, affine, gradient, plastic, mass, specific_volume, law, constants)

    @staticmethod
    def _require(good: np.ndarray, message: str, reason: str = "input") -> None:
        if not np.all(good):
            node = int(np.argmin(np.reshape(good, (len(good), -1)).all(axis=1)))
            raise SimulationError(f"{message} (node {node})", reason=reason, node=node)

    def _error(self, status: int, node: int, pos: np.ndarray, vel: np.ndarray, gravity: np.ndarray) -> SimulationError:
        if node < 0:
            where = "a state without nodes"
        else:
            where = f"node {node} at {pos[node].tolist()} m with velocity {vel[node].tolist()} m/s"
        if status == NOT_FINITE:
            return SimulationError(f"{where} is not finite", reason="nan", node=node)
        if status == ESCAPE:
            return SimulationError(f"{where} is outside the domain {self.bounds}", reason="escape", node=node)
        message = (
            f"{where} under gravity {np.asarray(gravity).tolist()} m/s² would need more than {self.max_substeps} substeps in one frame"
        )
        return SimulationError(message, reason="explosion", node=node)


def _largest_stretch(pos: np.ndarray, rest_pos: np.ndarray, cells: np.ndarray) -> tuple[float, int]:
    """Largest relative change of a distance between two nodes of a cell, and one of the nodes."""
    pairs = np.concatenate([cells[:, pair] for pair in itertools.combinations(range(cells.shape[1]), 2)])
    rest, now = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (rest_pos, pos))
    change = np.abs(now - rest) / np.where(rest > 0, rest, math.inf)
    if len(change) == 0:
        return 0.0, -1
    worst = int(np.argmax(change))
    return float(change[worst]), int(pairs[worst, 0])
