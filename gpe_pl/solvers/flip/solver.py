"""``FLIP``: the solver for states of liquid particles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass

from gpe_pl.geometry.shapes import Wall, check_whole_cells, domain_walls, outward_normal, signed_distance
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import NODE_TYPES, node_code
from gpe_pl.solvers.flip import islands, pressure, transfer, viscosity
from gpe_pl.solvers.flip.grid import HALF, Grid, Solids, make_grid, make_solids
from gpe_pl.solvers.flip.linear import conjugate_gradients, incomplete_cholesky
from gpe_pl.solvers.flip.prescribed import Prescribed
from gpe_pl.solvers.materials import parameters_of
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

MATERIAL = "fluid"

TOUCH = 1e-30
"""Weight of faces whose velocity is known although no particle reaches them."""

REFERENCE_TIME = 0.01
"""Time in s to which the fractions ``pic`` and ``evening`` refer, for any length of frames and substeps."""

MODIFIED = 0.97
"""Degree to which the preconditioner of the pressure keeps row sums; see ``incomplete_cholesky``."""

DENSITY_TOLERANCE = 1e-2
"""Largest residual of the density correction, as a fraction of a cell's volume."""

NEAR = 3.0
"""Distance of a cell from solids, in cells, beyond which its particles are inside no solid."""

LARGEST_EXCESS = 0.5
"""Largest relative change of a cell's volume in the density correction of one substep."""


@dataclass(frozen=True)
class Fields:
    """Arrays of the grid during a substep. They are empty before and after it: zero, except for ``island``, whose old labels are not read.

    Attributes:
        velocity: velocities on faces [axis, cell] in m/s.
        old: velocities on faces before the forces [axis, cell] in m/s.
        shift: displacement on faces that corrects the density [axis, cell] in m.
        weight: density around faces, relative to that of the liquid [axis, cell].
        density: density around cell centres, relative to that of the liquid [cell].
        viscous: density times kinematic viscosity [cell] in m²/s.
        touched: whether a particle reaches the cell or its lower faces [cell].
        liquid: number of each liquid cell from 1, else 0 [cell].
        viscous_face: number of each face of the viscous system from 1, else 0 [axis, cell].
        island: label of the connected body of each cell that holds mass [cell].
    """

    velocity: np.ndarray
    old: np.ndarray
    shift: np.ndarray
    weight: np.ndarray
    density: np.ndarray
    viscous: np.ndarray
    touched: np.ndarray
    liquid: np.ndarray
    viscous_face: np.ndarray
    island: np.ndarray

    @classmethod
    def empty(cls, grid: Grid) -> Fields:
        """Return arrays without liquid."""
        faces, cells = (grid.dim, grid.num_cells), grid.num_cells
        return cls(
            np.zeros(faces), np.zeros(faces), np.zeros(faces), np.zeros(faces), np.zeros(cells), np.zeros(cells), np.zeros(cells, np.bool_),
            np.zeros(cells, np.int64), np.zeros(faces, np.int64), np.zeros(cells, np.int64),
        )  # fmt: skip


_idle: dict[tuple[tuple[tuple[float, float], ...], float], Fields] = {}
"""Empty fields of the grid used last, by bounds and spacing, because filling new arrays with zeros would take longer than a substep. A caller takes the fields
out, owns them, and puts them back only after success, so that neither threads nor errors meet fields that are not empty."""


@dataclass(frozen=True)
class Liquid:
    """Liquid cells with the matrix of their pressure.

    Attributes:
        cells: indices of the liquid cells, in the order of ``Fields.liquid`` [liquid].
        is_free: whether a cell belongs to an island that touches no solid [liquid].
        closed: label of the closed space of a cell, -1 if the cell's body has a free surface [liquid].
        matrix: matrix in the form of ``linear``.
        inverse: inverse pivots of its preconditioner [liquid].
    """

    cells: np.ndarray
    is_free: np.ndarray
    closed: np.ndarray
    matrix: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    inverse: np.ndarray


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class FLIP:
    """Solver for incompressible liquid with a free surface by the fluid-implicit-particle method; a ``Simulator``.

    A substep transfers the particles' velocities to a staggered grid (Zhu and Bridson 2005), adds gravity, solves for viscosity and then for pressure, and
    moves the particles with the grid. Solids stop the liquid exactly at their surface. Pressure lets the liquid slip along solids, and viscosity is solved
    with no slip, for any friction coefficient; at a small viscosity the layer at rest has its physical thickness. Bodies of liquid that touch no solid follow
    a parabola exactly. Obstacles and gaps should be at least two cells wide.

    The fraction ``pic`` acts like an additional kinematic viscosity ``Δ²/(6τ)`` with ``τ = -10 ms / ln(1 - pic)``, for any length of substeps: a transfer to
    the grid and back spreads momentum with the variance Δ²/3 along each axis. ``numerical_viscosity`` returns this value. A smaller viscosity of the liquid has
    little effect.

    Attributes:
        bounds: ``(low, high)`` of the domain along each of two or three axes [m]; each extent is a whole multiple of the grid spacing.
        grid_spacing: grid spacing Δ [m]; choose it for about two particles per cell and axis.
        frame_dt: time between frames [s].
        materials: ``("fluid",)``.
        density: density of the liquid [kg/m³]; with the particles' masses it gives their volumes.
        pic: fraction of the grid's velocity in a particle's velocity after 10 ms, which damps motion that the grid does not resolve.
        evening: fraction of the error of the particle density that is corrected in 10 ms, except in bodies that fly freely.
        cfl: number of cells that a particle may cross in one substep.
        max_substeps: largest number of substeps per frame. If a frame needs more, the step fails as an explosion.
        pressure_tolerance: largest relative change of a liquid cell's volume in a substep.
        viscosity_tolerance: largest residual of the viscous system over the largest speed.
        max_iterations: largest number of iterations of each linear solver.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: Annotated[float, Field(gt=0)]
    frame_dt: Annotated[float, Field(gt=0, le=1e6)] = 5e-3
    materials: tuple[str, ...] = (MATERIAL,)
    density: Annotated[float, Field(gt=0)] = 1000.0
    pic: Annotated[float, Field(ge=0, le=1)] = 0.05
    evening: Annotated[float, Field(ge=0, le=1)] = 0.4
    cfl: Annotated[float, Field(gt=0, le=1)] = 1.0
    max_substeps: Annotated[int, Field(ge=1)] = 200
    pressure_tolerance: Annotated[float, Field(gt=0)] = 1e-6
    viscosity_tolerance: Annotated[float, Field(gt=0)] = 1e-6
    max_iterations: Annotated[int, Field(ge=1)] = 2000

    name: ClassVar[str] = "flip"
    version: ClassVar[str] = "2"
    stores_stress: ClassVar[bool] = False
    has_mesh: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_whole_cells(self.bounds, self.grid_spacing)
        if self.materials != (MATERIAL,):
            raise ValueError(f"FLIP simulates materials ({MATERIAL!r},) only, got {self.materials}")

    @property
    def solver_dt(self) -> float:
        """Upper bound of the substep in s: ``frame_dt``."""
        return self.frame_dt

    @property
    def numerical_viscosity(self) -> float:
        """Kinematic viscosity in m²/s that ``pic`` adds to the viscosity of the liquid; infinite for ``pic = 1``, which acts once per substep."""
        rate = math.inf if self.pic == 1 else -math.log1p(-self.pic) / REFERENCE_TIME
        return rate * self.grid_spacing**2 / 6.0

    @property
    def smallest_resolved(self) -> dict[str, float]:
        """``numerical_viscosity`` under the key ``fluid``. Smaller viscosities of the liquid have little effect."""
        return {MATERIAL: self.numerical_viscosity}

    def compile_kernels(self) -> None:
        """Compile every kernel, for 2D and 3D, into Numba's disk cache, so that worker processes started later only load them."""
        bounds = ((0.0, 1.0), (0.0, 1.0))
        boundary = Boundary.sample(domain_walls(bounds, 0.0), 0.25, 2)
        # a cell full of liquid in a corner runs through every part of a step
        state = State(
            np.full((4, 2), 0.1), np.zeros((4, 2)), np.full(4, node_code(MATERIAL), np.uint8), np.full(4, 15.0), np.full((4, 1), 0.1), boundary,
            np.array([0.0, -9.81]),
        )  # fmt: skip
        FLIP(bounds=bounds, grid_spacing=0.25).step(state)

    can_restart: ClassVar[bool] = True

    def restarted(self, state: State) -> State:
        """Return the state without velocity history and stress. A step starts from positions and velocities alone."""
        return replace(state, velocity_history=None, stress=None)

    def finer(self, factor: int) -> FLIP:
        """Return the solver with ``1 / factor`` of the grid spacing, and ``factor`` times as many substeps allowed; see ``solvers.finer_solver``."""
        return replace(self, grid_spacing=self.grid_spacing / factor, max_substeps=factor * self.max_substeps)

    def step(self, state: State) -> State:
        """Advance one frame.

        Raises:
            SimulationError: with reason ``input`` (arrays or boundaries do not fit the solver), ``nan``, ``escape`` (a particle left the domain
                through an open side or started outside) or ``explosion`` (more than ``max_substeps``, or a linear system that could not be solved).
        """
        viscosity_of_node = self._check(state)
        solids = self.solids(state.boundary)
        prescribed = Prescribed.of(state.openings, state.time, self.frame_dt, self.grid, solids) if state.openings else None
        # np.array copies: the kernels work in place, and the caller's arrays must not change
        pos, vel = np.array(state.pos, dtype=np.float64, order="C"), np.array(state.vel, dtype=np.float64, order="C")
        gravity, mass = np.array(state.gravity, dtype=np.float64), np.array(state.mass, dtype=np.float64)
        grid = self.bounds, self.grid_spacing
        fields = _idle.pop(grid, None) or Fields.empty(self.grid)
        remaining, substeps = self.frame_dt, 0
        while remaining > 0.0:
            h = self._substep(pos, vel, gravity, remaining, substeps)
            self._advance(pos, vel, mass, viscosity_of_node, gravity, h, solids, fields, prescribed)
            remaining = remaining - h if h < remaining else 0.0
            substeps += 1
        _idle.clear()
        _idle[grid] = fields
        self._survey(pos, vel)
        self._leave_solids(state.boundary, solids, pos, vel)
        return state.later(self.frame_dt, pos, vel, velocity_history=None, num_substeps=substeps)

    def rasterize(
        self, pos: np.ndarray, vel: np.ndarray, mass: np.ndarray, viscosity_of_node: np.ndarray, solids: Solids, fields: Fields
    ) -> np.ndarray:
        """Transfer the particles to empty ``fields``. Return the active cells, which are those that liquid reaches, in ascending order.

        Args:
            pos, vel: positions [m] and velocities [m/s] of the particles [node, dim].
            mass: masses [kg] [node].
            viscosity_of_node: kinematic viscosities [m²/s] [node].
            solids: open space of the grid.
            fields: arrays of the grid, which get the results.
        """
        grid = self.grid
        volume = mass / (self.density * grid.spacing**grid.dim)
        transfer.scatter(
            pos, vel, volume, viscosity_of_node, grid.origin, 1.0 / grid.spacing, grid.strides, grid.counts, grid.corners,
            fields.velocity, fields.weight, fields.density, fields.viscous, fields.touched,
        )  # fmt: skip
        active = np.flatnonzero(fields.touched)
        transfer.normalize(
            active, solids.cell_room, solids.face_room, HALF, fields.velocity, fields.old, fields.weight, fields.density, fields.viscous
        )
        pressure.reach_into_solids(active, grid.strides, solids.area, solids.cell_room, HALF, fields.density, fields.touched)
        active = np.flatnonzero(fields.touched)
        pressure.extend_into_solids(active, grid.strides, solids.area, solids.cell_room, HALF, fields.density, fields.viscous)
        return active

    def diffuse(self, active: np.ndarray, solids: Solids, fields: Fields, h: float) -> None:
        """Apply viscosity to the grid's velocities for a time h [s]."""
        grid = self.grid
        axes, cells = viscosity.viscous_faces(active, solids.face_distance, fields.weight, fields.viscous_face)
        diagonal, start, column, value, right = viscosity.viscosity_system(
            axes, cells, fields.viscous_face, grid.strides, solids.is_open, solids.face_distance, fields.weight, fields.viscous, fields.velocity,
            h / grid.spacing**2,
        )  # fmt: skip
        u = fields.velocity[axes, cells]
        tolerance = self.viscosity_tolerance * float(np.max(np.abs(u), initial=0.0))
        inverse = incomplete_cholesky(diagonal, start, column, value, 0.0)
        iterations, residual = conjugate_gradients(diagonal, start, column, value, right, inverse, u, tolerance, self.max_iterations)
        self._require_converged("viscosity", iterations, residual, tolerance)
        fields.velocity[axes, cells] = u
        viscosity.drag_on_solids(
            active, grid.strides, solids.area, solids.face_distance, fields.density, fields.viscous, fields.velocity, h / grid.spacing**2
        )

    def project(self, liquid: Liquid, solids: Solids, fields: Fields, h: float, prescribed: Prescribed | None = None) -> np.ndarray:
        """Make the grid's velocities divergence-free; return the pressure [liquid] in Pa that acts over a time h [s]."""
        if prescribed is not None:
            prescribed.impose(fields.touched, fields.velocity, fields.weight)
        pressure.fill_open_faces(liquid.cells, self.grid.strides, solids.area, fields.weight, fields.velocity, TOUCH)
        right = pressure.inflow(liquid.cells, self.grid.strides, solids.area, fields.velocity)
        if prescribed is not None:
            prescribed.add_inflow(fields.liquid, right)
        tolerance = self.pressure_tolerance * self.grid_spacing / h
        return self.density * self.grid_spacing / h * self._correct("pressure", liquid, right, tolerance, solids, fields, fields.velocity)

    def even_out(self, liquid: Liquid, solids: Solids, fields: Fields, h: float) -> None:
        """Write to ``fields.shift`` the displacement that expands cells with too many particles and contracts cells with too few (Kugelstadt et al. 2019).

        It is the part for a substep of length ``h`` [s]. Bodies that fly freely are left out.
        """
        if np.all(liquid.is_free):
            return
        excess = pressure.excess_density(liquid.cells, fields.liquid, self.grid.strides, solids.is_open, fields.density, LARGEST_EXCESS)
        fraction = _in_substep(self.evening, h) * self.grid_spacing
        right = np.where(liquid.is_free, 0.0, fraction * solids.cell_room[liquid.cells] * excess)
        self._correct("density", liquid, right, DENSITY_TOLERANCE * fraction, solids, fields, fields.shift)

    def _correct(
        self, what: str, liquid: Liquid, right: np.ndarray, tolerance: float, solids: Solids, fields: Fields, target: np.ndarray
    ) -> np.ndarray:
        """Subtract from ``target`` on faces the gradient whose divergence is ``right``; return its potential."""
        for label in np.unique(liquid.closed[liquid.closed >= 0]):  # a closed space keeps its volume
            right[liquid.closed == label] -= np.mean(right[liquid.closed == label])
        x = np.zeros(len(right))
        iterations, residual = conjugate_gradients(*liquid.matrix, right, liquid.inverse, x, tolerance, self.max_iterations)
        self._require_converged(what, iterations, residual, tolerance)
        pressure.subtract_gradient(liquid.cells, fields.liquid, self.grid.strides, solids.area, fields.density, x, target)
        return x

    def liquid(self, active: np.ndarray, solids: Solids, fields: Fields) -> tuple[Liquid, np.ndarray]:
        """Number the liquid cells and assemble the matrix of their pressure.

        The second result tells, for each label of ``fields.island``, whether that island touches no solid.
        """
        strides = self.grid.strides
        cells = pressure.liquid_cells(active, solids.is_open, fields.density, fields.liquid)
        is_free, is_closed = islands.find_islands(active, strides, solids.area, fields.density, fields.weight, fields.liquid, fields.island)
        matrix = pressure.pressure_matrix(cells, fields.liquid, strides, solids.area, fields.density)
        inverse = incomplete_cholesky(*matrix, MODIFIED)
        island = fields.island[cells]
        return Liquid(cells, is_free[island], np.where(is_closed[island], island, -1), matrix, inverse), is_free

    @property
    def grid(self) -> Grid:
        """Return the solver's grid."""
        return make_grid(self.bounds, self.grid_spacing)

    def solids(self, boundary: Boundary) -> Solids:
        """Sample the boundary on the solver's grid. Errors are those of ``make_solids``."""
        return make_solids(tuple(boundary.shapes), self.bounds, self.grid_spacing)

    def _advance(
        self, pos: np.ndarray, vel: np.ndarray, mass: np.ndarray, viscosity_of_node: np.ndarray, gravity: np.ndarray, h: float,
        solids: Solids, fields: Fields, prescribed: Prescribed | None,
    ) -> None:  # fmt: skip
        """Advance pos and vel in place by one substep; ``fields`` are empty before and after."""
        grid = self.grid
        if prescribed is not None:
            start, solids = pos.copy(), prescribed.closed(solids)
        active = self.rasterize(pos, vel, mass, viscosity_of_node, solids, fields)
        transfer.add_impulse(active, h * gravity, fields.weight, fields.velocity)
        liquid, is_free = self.liquid(active, solids, fields)
        # viscosity must not see the part of gravity that pressure balances, because it would drag a liquid at rest along the walls
        self.project(liquid, solids, fields, h, prescribed)
        self.diffuse(active, solids, fields, h)
        self.project(liquid, solids, fields, h, prescribed)
        self.even_out(liquid, solids, fields, h)
        transfer.extend_into_solids(
            active, grid.origin, grid.spacing, grid.strides, grid.counts, grid.corners, solids.distance, solids.face_distance, fields.weight,
            fields.velocity,
        )  # fmt: skip
        flying = islands.Flying.select(fields.island[self._cell(pos)], is_free, pos, vel, mass)
        transfer.gather(
            pos, vel, grid.origin, grid.spacing, grid.strides, grid.counts, grid.corners, fields.old, fields.velocity, fields.shift,
            fields.weight, _in_substep(self.pic, h), h,
        )  # fmt: skip
        flying.balance(pos, vel, gravity, h)
        transfer.push_out(pos, vel, grid.origin, grid.spacing, grid.strides, grid.counts, grid.corners, solids.distance)
        if prescribed is not None:
            prescribed.carry(start, pos, vel, h)
        transfer.clear(
            active, grid.strides, fields.velocity, fields.old, fields.shift, fields.weight, fields.density, fields.viscous, fields.touched,
            fields.liquid, fields.viscous_face,
        )  # fmt: skip

    def _leave_solids(self, boundary: Boundary, solids: Solids, pos: np.ndarray, vel: np.ndarray) -> None:
        """Move particles out of the exact shapes, which the grid only interpolates; walls come last, so that no particle ends outside them."""
        near = np.flatnonzero(solids.distance[self._cell(pos)] < NEAR)
        rows = near[signed_distance(boundary.shapes, pos[near]) < 0.0]
        if len(rows) == 0:
            return
        moved, velocity = pos[rows], vel[rows]
        for _ in range(4):  # corners need one pass per surface
            for shape in sorted(boundary.shapes, key=lambda shape: isinstance(shape, Wall)):
                depth = np.maximum(0.0, -shape.signed_distance(moved))[:, None]
                normal = outward_normal(shape, moved, 1e-3 * self.grid_spacing)
                moved += depth * normal
                inward = np.minimum(0.0, np.sum(velocity * normal, axis=1))[:, None]
                velocity -= np.where(depth > 0, inward, 0.0) * normal
        pos[rows], vel[rows] = moved, velocity

    def _cell(self, pos: np.ndarray) -> np.ndarray:
        """Return the cell of each particle [node]."""
        return ((pos - self.grid.origin) / self.grid_spacing).astype(np.int64) @ self.grid.strides

    def _substep(self, pos: np.ndarray, vel: np.ndarray, gravity: np.ndarray, remaining: float, done: int) -> float:
        """Return the duration of the next substep in s; the rest of the frame is divided equally."""
        fastest, speed = self._survey(pos, vel)
        reach = self.cfl * self.grid_spacing
        with np.errstate(over="ignore"):
            fall = float(np.linalg.norm(gravity))
        # neither a particle at constant speed nor one that falls from rest may exceed its reach
        needed = remaining * max(speed / reach, math.sqrt(fall / (2.0 * reach))) * (1.0 - 1e-12)
        if needed > self.max_substeps - done:
            message = f"{_describe(fastest, pos, vel)} under gravity {gravity.tolist()} m/s² would need more than {self.max_substeps} substeps in one frame"
            raise SimulationError(message, reason="explosion", node=fastest)
        return remaining / max(1, math.ceil(needed))

    def _survey(self, pos: np.ndarray, vel: np.ndarray) -> tuple[int, float]:
        """Return the fastest particle and its speed; raise an error that names a particle that is not finite or outside the domain."""
        if len(pos) == 0:
            return -1, 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.einsum("ij,ij->i", vel, vel)
            finite = np.isfinite(square) & np.isfinite(pos.sum(axis=1))
        low, high = np.array(self.bounds).T
        outside = np.any((pos < low - self.grid_spacing) | (pos > high + self.grid_spacing), axis=1)
        for bad, reason, complaint in ((~finite, "nan", "is not finite"), (outside, "escape", f"is outside the domain {self.bounds}")):
            if np.any(bad):
                node = int(np.argmax(bad))
                raise SimulationError(f"{_describe(node, pos, vel)} {complaint}", reason=reason, node=node)
        fastest = int(np.argmax(square))
        return fastest, math.sqrt(square[fastest])

    def _require_converged(self, what: str, iterations: int, residual: float, tolerance: float) -> None:
        if not residual <= tolerance:
            message = (
                f"the {what} system has a residual of {residual:.3g} m/s after {iterations} iterations, above the tolerance of {tolerance:.3g} m/s; "
                "use a shorter frame_dt or a coarser grid, or raise max_iterations or the tolerance"
            )
            raise SimulationError(message, reason="explosion")

    def _check(self, state: State) -> np.ndarray:
        """Return the kinematic viscosity of each particle; raise an error that names what does not fit."""
        num_nodes, dim = state.num_nodes, len(self.bounds)
        shapes = {
            "pos": (state.pos, (num_nodes, dim)),
            "vel": (state.vel, (num_nodes, dim)),
            "mass": (state.mass, (num_nodes,)),
            "node_type": (state.node_type, (num_nodes,)),
            "gravity": (state.gravity, (dim,)),
            "boundary.pos": (state.boundary.pos, (len(state.boundary.pos), dim)),
        }
        for name, (array, expected) in shapes.items():
            if np.shape(array) != expected:
                raise SimulationError(f"{name} has shape {np.shape(array)}, expected {expected}", reason="input")
        check_surroundings(state, "FLIP", computes_open_scenes=True)
        if state.internal is not None:
            raise SimulationError(f"internal state is of type {type(state.internal).__name__}, expected None", reason="input")
        _require(np.isfinite(state.mass), "mass is not finite", reason="nan")
        if not np.all(np.isfinite(state.gravity)):
            raise SimulationError(f"gravity {state.gravity} is not finite", reason="nan")
        _require(np.asarray(state.mass) > 0, "mass is not positive")
        known = np.asarray(state.node_type) == node_code(MATERIAL)
        _require(known, f"node_type is none of the solver's materials {MATERIAL} (codes of {', '.join(NODE_TYPES)})")
        return parameters_of(state, MATERIAL, np.arange(num_nodes), self.materials)["kinematic_viscosity"]


def _in_substep(fraction: float, h: float) -> float:
    """Convert a fraction per ``REFERENCE_TIME`` to a fraction per time h [s]."""
    return float(1.0 - (1.0 - fraction) ** (h / REFERENCE_TIME))


def _require(good: np.ndarray, message: str, reason: str = "input") -> None:
    if not np.all(good):
        node = int(np.argmin(good))
        raise SimulationError(f"{message} (node {node})", reason=reason, node=node)


def _describe(node: int, pos: np.ndarray, vel: np.ndarray) -> str:
    return "a state without nodes" if node < 0 else f"node {node} at {pos[node].tolist()} m with velocity {vel[node].tolist()} m/s"
