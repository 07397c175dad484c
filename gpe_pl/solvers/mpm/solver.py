"""``MPM``, the material point simulator: settings, checks of the state, and errors that say what is wrong."""

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
from gpe_pl.solvers.materials import MEMORY, NUM_CONSTANTS, Elastomer, Fluid, Sand, Snow, parameters_of
from gpe_pl.solvers.mpm.collider import Collider, collider
from gpe_pl.solvers.mpm.frame import ESCAPE, NOT_FINITE, OK, advance
from gpe_pl.solvers.mpm.particles import Particles
from gpe_pl.solvers.mpm.prescribed import prescribed
from gpe_pl.solvers.mpm.restart import gradients
from gpe_pl.solvers.mpm.stress import cauchy_stress
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State, Stress

PADDING = 3
"""Number of cells between the domain and the edge of the grid, for the kernel of a particle up to one cell behind a wall."""

UNDEFORMED = 1e-3
"""Relative change of the distances within a cell up to which a mesh counts as undeformed; it far exceeds the rounding of stored positions."""

KNOWN = ("sand", "snow", "elastomer", "fluid")
"""Materials that have a law, and names of the settings that hold their constants."""


@dataclass(frozen=True)
class MPMInternal:
    """State of the solver's particles besides position and velocity.

    Attributes:
        deformation: elastic deformation gradient F [node, dim, dim].
        affine: affine part of the velocity that the particle transfers to the grid, C of APIC [node, dim, dim] in 1/s.
        gradient: velocity gradient of the grid at the particle, by which it deforms [node, dim, dim] in 1/s.
        plastic: plastic state [node]: the volume correction of sand and fluid, ``J_P - 1`` of snow, 0 of elastomers.
        last_substep: length of the previous substep [s]; 0 if none.
    """

    deformation: np.ndarray
    affine: np.ndarray
    gradient: np.ndarray
    plastic: np.ndarray
    last_substep: np.ndarray = field(default_factory=lambda: np.zeros(()))

    @classmethod
    def at_rest(cls, num_nodes: int, dim: int) -> MPMInternal:
        """Return the state of undeformed particles that do not rotate."""
        still = np.zeros((num_nodes, dim, dim))
        return cls(np.tile(np.eye(dim), (num_nodes, 1, 1)), still, still.copy(), np.zeros(num_nodes))

    def of_rows(self, rows: np.ndarray) -> MPMInternal:
        """Return the state of the particles in these rows [node]; −1 stands for an undeformed particle. Open scenes call it (``rollout.flow``)."""
        rest, known = self.at_rest(len(rows), self.deformation.shape[-1]), rows >= 0
        for name in ("deformation", "affine", "gradient", "plastic"):
            getattr(rest, name)[known] = getattr(self, name)[rows[known]]
        return replace(rest, last_substep=self.last_substep)


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class MPM:
    """Material point solver; a ``Simulator``.

    Positions do not tell how particles are deformed. A state must therefore be either the start of a scene, where nothing is deformed, or a state that ``step``
    returned, with its ``internal`` part. Later frames of a stored or predicted trajectory are refused.

    Each step advances one frame by substeps that satisfy ``h (c + |v|_max) <= cfl Δ``, ``h² |g| <= cfl Δ / 4`` and ``8 h ν <= Δ²``. Here c is the speed of the
    fastest elastic wave at the present deformation and hardening. Substeps depend on the current state alone, so a restart repeats a run bit by bit.
    Obstacles must be at least one grid cell thick. Particles in openings with a speed are undeformed, and move with it; see ``mpm.prescribed``.

    Attributes:
        bounds: ``(low, high)`` of the domain along each axis [m]; each extent is a whole multiple of the grid spacing.
        grid_spacing: grid spacing Δ [m].
        frame_dt: time between frames [s].
        materials: every material of the data set; they determine the columns of ``State.material_params`` in a state without ``param_names``.
        sand, snow, elastomer, fluid: constants of each material; None selects the defaults of liquid. The density gives the volume of a particle of given mass.
            Parameters with a column in ``State.material_params`` have the values there.
        cfl: fraction of a cell that a wave or a particle may cross in one substep.
        max_substeps: largest number of substeps per frame. If a frame needs more, the step fails as an explosion.
        stress: states that ``step`` returns have the Cauchy stress of the particles; see ``mpm.stress``. Not in open scenes. ``rollout`` keeps it if the first
            state has one, too; that of undeformed particles is zero.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: Annotated[float, Field(gt=0)]
    frame_dt: Annotated[float, Field(gt=0, le=1e6)] = 5e-3
    materials: tuple[str, ...] = ("sand",)
    sand: Sand = field(default_factory=Sand)
    snow: Snow = field(default_factory=Snow)
    elastomer: Elastomer = field(default_factory=Elastomer)
    fluid: Fluid | None = None
    cfl: Annotated[float, Field(gt=0, le=1)] = 0.5
    max_substeps: Annotated[int, Field(ge=1)] = 1000
    stress: Annotated[bool, Field(strict=True)] = False

    name: ClassVar[str] = "mpm"
    version: ClassVar[str] = "6"
    has_mesh: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_whole_cells(self.bounds, self.grid_spacing)
        unknown = [m for m in self.materials if m not in KNOWN]
        if unknown or not self.materials:
            raise ValueError(f"MPM has no law for material {', '.join(unknown) or '(none)'}; known: {', '.join(KNOWN)}")

    @property
    def stores_stress(self) -> bool:
        """Whether states that ``step`` returns have a stress."""
        return self.stress

    @property
    def solver_dt(self) -> float:
        """Largest substep in s: that of particles at rest, of the material with the slowest waves."""
        slowest = min(m.smallest_stiffness / m.density for m in (self.constants_of(name) for name in self.materials))
        return min(self.frame_dt, self.cfl * self.grid_spacing / math.sqrt(slowest))

    @property
    def numerical_viscosity(self) -> float:
        """Kinematic viscosity in m²/s that the transfers add to the viscosity of a liquid, for waves of 16 cells: ``Δ²/(256 (τ + h))``.

        τ is the time for which particles keep a velocity that the grid does not represent, and h a substep. Longer waves get less.
        """
        fluid: Fluid = self.fluid or Fluid()
        substep = self.cfl * self.grid_spacing / math.sqrt(fluid.bulk_modulus / fluid.density)
        return self.grid_spacing**2 / (256.0 * (fluid.memory * self.grid_spacing + substep))

    @property
    def smallest_resolved(self) -> dict[str, float]:
        """``numerical_viscosity`` under the key ``fluid``, if the solver has this material. Smaller viscosities of the liquid have little effect."""
        return {"fluid": self.numerical_viscosity} if "fluid" in self.materials else {}

    def constants_of(self, material: str) -> Sand | Snow | Elastomer | Fluid:
        """Return the constants of a material, given its name."""
        return getattr(self, material) or Fluid()

    def compile_kernels(self) -> None:
        """Compile the kernels for this solver's dimension into Numba's disk cache, so that worker processes started later only load them."""
        material, dim = self.materials[0], len(self.bounds)
        params = np.full((1, len(param_names(self.materials))), MATERIALS[material][0].limits.low)
        middle = np.array([[(low + high) / 2 for low, high in self.bounds]])
        code = np.array([node_code(material)], dtype=np.uint8)
        self.step(State(middle, np.zeros((1, dim)), code, np.ones(1), params, Boundary.empty(dim), np.zeros(dim)))

    def step(self, state: State) -> State:
        """Advance one frame.

        Raises:
            SimulationError: with reason ``input`` (arrays or obstacles do not fit the solver, or ``internal`` is needed and missing), ``nan``,
                ``escape`` (a particle left the domain through an open side or started outside) or ``explosion`` (more than ``max_substeps``).
        """
        check_surroundings(state, "MPM", computes_open_scenes=True)
        if self.stress and state.openings:
            raise SimulationError("MPM stores no stress in scenes with inlets and outlets; set stress=false", reason="input")
        internal = state.internal if state.internal is not None else MPMInternal.at_rest(state.num_nodes, len(self.bounds))
        particles = self._particles(state, internal)
        if state.internal is None:
            self._require_undeformed(state)
        origin = tuple(low - PADDING * self.grid_spacing for low, _ in self.bounds)
        counts = tuple(round((high - low) / self.grid_spacing) + 1 + 2 * PADDING for low, high in self.bounds)
        status, node, num_substeps, last_substep = advance(
            particles,
            self._collider(state.boundary, origin, counts),
            prescribed(state.openings, (state.time, state.time + self.frame_dt), particles.pos, origin, counts, self.grid_spacing),
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
        internal = MPMInternal(particles.deformation, particles.affine, particles.gradient, particles.plastic, np.array(last_substep))
        stress = Stress.of_nodes(cauchy_stress(particles, float(last_substep)), state.cells) if self.stress else None
        return state.later(
            self.frame_dt, particles.pos, particles.vel, velocity_history=None, num_substeps=num_substeps, internal=internal, stress=stress
        )

    def finer(self, factor: int) -> MPM:
        """Return the solver with ``1 / factor`` of the grid spacing, and ``factor`` times as many substeps allowed; see ``solvers.finer_solver``."""
        return replace(self, grid_spacing=self.grid_spacing / factor, max_substeps=factor * self.max_substeps)

    @property
    def can_restart(self) -> bool:
        """Whether all materials are elastomers. The other materials remember plastic flow, which positions do not tell."""
        return set(self.materials) == {"elastomer"}

    def restarted(self, state: State) -> State:
        """Return a state whose ``internal`` part is computed from positions and velocities of its mesh; see ``mpm.restart``.

        Raises:
            SimulationError: with reason ``input``, if a particle is no elastomer or the state has no cells.
        """
        self._require(np.asarray(state.node_type) == node_code("elastomer"), "only elastomers can be restarted from their positions")
        if state.rest_pos is None or state.cells is None or not len(state.cells):
            raise SimulationError("a state without cells cannot be restarted from its positions; give it its internal part", reason="input")
        pos, vel, rest_pos, cells = (np.asarray(x) for x in (state.pos, state.vel, state.rest_pos, state.cells))
        deformation, gradient = gradients(pos, rest_pos, cells), gradients(vel, pos, cells)
        internal = MPMInternal(deformation, gradient, gradient.copy(), np.zeros(len(pos)))
        return replace(state, velocity_history=None, internal=internal)

    def _require_undeformed(self, state: State) -> None:
        remedy = "start at frame 0 of a scene, or step on from the state that the solver returned"
        if state.time > 0:
            message = f"the state at {state.time:g} s has no internal part, so MPM does not know how its particles are deformed; {remedy}"
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
        """Return the particles as arrays for the compiled kernels; raise an error that names what does not fit."""
        num_nodes, dim = state.num_nodes, len(self.bounds)
        shapes = {
            "pos": (state.pos, (num_nodes, dim)),
            "vel": (state.vel, (num_nodes, dim)),
            "mass": (state.mass, (num_nodes,)),
            "node_type": (state.node_type, (num_nodes,)),
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
            if name != "gravity":
                self._require(np.isfinite(array), f"{name} is not finite", reason="nan")
        if not np.all(np.isfinite(state.gravity)):
            raise SimulationError(f"gravity {state.gravity} is not finite", reason="nan")
        self._require(np.asarray(state.mass) > 0, "mass is not positive")
        law, specific_volume, constants = np.empty(num_nodes, dtype=np.int64), np.empty(num_nodes), np.empty((num_nodes, NUM_CONSTANTS))
        known = np.zeros(num_nodes, dtype=bool)
        for name in self.materials:
            chosen, material = np.flatnonzero(np.asarray(state.node_type) == node_code(name)), self.constants_of(name)
            law[chosen], specific_volume[chosen] = material.law, 1.0 / material.density
            constants[chosen] = material.constants(parameters_of(state, name, chosen, self.materials), dim)
            known[chosen] = True
        self._require(known, f"node_type is none of the solver's materials {', '.join(self.materials)} (codes of {', '.join(NODE_TYPES)})")
        # np.array copies: the kernels work in place, and the caller's arrays must not change
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
    """Return the largest relative change of a distance between two nodes of a cell, and one of the two nodes."""
    pairs = np.concatenate([cells[:, pair] for pair in itertools.combinations(range(cells.shape[1]), 2)])
    rest, now = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (rest_pos, pos))
    change = np.abs(now - rest) / np.where(rest > 0, rest, math.inf)
    if len(change) == 0:
        return 0.0, -1
    worst = int(np.argmax(change))
    return float(change[worst]), int(pairs[worst, 0])
