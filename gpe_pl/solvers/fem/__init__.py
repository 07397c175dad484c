"""Explicit finite elements for a deformable solid that falls on rigid obstacles: symplectic Euler with lumped masses, in float64.

One substep of length h, with internal forces f including damping (``elements``), and contact (``contact``)::

    v ← v + h f(x, v) / m + h g / 2,   v ← contact(x, v),   x ← x + h v,   v ← v + h g / 2

Gravity is applied in halves, so that a free body falls along the exact parabola with any substeps. A body at rest on a floor keeps a velocity of h g / 2. The
length h depends on the current state alone. It stays below the stability limit of the present mesh. At its present velocity, no node moves further than half
the smallest height of a cell. Contact of the solid with itself is not computed: a scene holds one body.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, ClassVar, no_type_check

import numpy as np
from numba import njit
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.geometry.shapes import check_bounds
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import MATERIALS, node_code
from gpe_pl.solvers.fem.contact import Obstacles, collect, push_out_corners, push_out_nodes, resist_corners, resist_nodes
from gpe_pl.solvers.fem.elements import (
    Mesh,
    add_quad_forces,
    add_tetrahedron_forces,
    add_triangle_forces,
    build_mesh,
    cauchy_stress,
    elastic_energy,
)
from gpe_pl.solvers.materials import lame_parameters, parameters_of
from gpe_pl.solvers.supported import check_surroundings
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

OK, NOT_FINITE, ESCAPE, TOO_MANY_SUBSTEPS = 0, 1, 2, 3
KINDS = {"triangle": 0, "quad": 1, "tetrahedron": 2}


@dataclass(frozen=True, config={"extra": "forbid"})
class FEM:
    """Finite element solver for the node type ``solid``; a ``Simulator`` of states with ``rest_pos`` and ``cells``.

    Young's modulus, and Poisson's ratio where it is stored, are material parameters of each node; a cell takes the mean of its corners. Inertia comes from
    ``State.mass`` alone, lumped at the nodes. Every step stores the elastic Cauchy stress.

    Attributes:
        bounds: ``(low, high)`` of the domain along each of two or three axes [m].
        frame_dt: time between frames [s].
        materials: ``("solid",)``.
        poisson_ratio: Poisson's ratio, below 0.5, unless the state has a column for it; linear triangles and tetrahedra stiffen from about 0.45 on.
        damping: viscosity, as a fraction of the critical damping of the fastest mode of the mesh. A mode that is n times slower has 1/n of this fraction.
        cfl: substep as a fraction of the largest substep that is proven to be stable.
        max_substeps: largest number of substeps per frame. If a frame needs more, the step fails as an explosion.
    """

    bounds: tuple[tuple[float, float], ...]
    frame_dt: Annotated[float, Field(gt=0, le=1e6)] = 5e-3
    materials: tuple[str, ...] = ("solid",)
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.35
    damping: Annotated[float, Field(ge=0, le=2)] = 0.2
    cfl: Annotated[float, Field(gt=0, lt=1)] = 0.95
    max_substeps: Annotated[int, Field(ge=1)] = 10000

    name: ClassVar[str] = "fem"
    version: ClassVar[str] = "1"
    stores_stress: ClassVar[bool] = True
    has_mesh: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_bounds(self.bounds)
        if self.materials != ("solid",):
            raise ValueError(f"materials must be ('solid',), got {self.materials}")

    @property
    def solver_dt(self) -> float:
        """Upper bound of the substep in s: ``frame_dt``. The actual substep depends on mesh, stiffness and deformation; see ``substep``."""
        return self.frame_dt

    def substep(self, state: State) -> float:
        """Return an upper bound of the substep in s that the solver takes from this state if it is at rest. Errors are those of ``step``."""
        mesh, lam, mu, eta, _ = self._prepare(state)
        pos = _three_dimensional(state.pos)
        stiffest, most_viscous = _add_forces(
            KINDS[mesh.kind],
            pos,
            np.zeros_like(pos),
            mesh.cells,
            mesh.gradient,
            mesh.weight,
            lam,
            mu,
            eta,
            self.damping > 0,
            np.zeros_like(pos),
        )
        return min(self.frame_dt, self.cfl / _critical_rate(mesh.scale * stiffest, mesh.scale * most_viscous))

    def finer(self, factor: int) -> FEM:
        """Return the solver for meshes with ``1 / factor`` of the spacing: ``max_substeps`` is ``factor`` times as large; see ``solvers.finer_solver``."""
        return replace(self, max_substeps=factor * self.max_substeps)

    can_restart: ClassVar[bool] = True

    def restarted(self, state: State) -> State:
        """Return the state without velocity history and stress. A step starts from positions and velocities alone."""
        return replace(state, velocity_history=None, stress=None)

    def step(self, state: State) -> State:
        """Advance one frame.

        Raises:
            SimulationError: with reason ``input`` (arrays, mesh or boundary do not fit the solver), ``nan``, ``escape`` (a node left the domain
                through an open side or started outside) or ``explosion`` (more than ``max_substeps``).
        """
        mesh, lam, mu, eta, obstacles = self._prepare(state)
        pos, vel = _three_dimensional(state.pos), _three_dimensional(state.vel)
        dim = state.dim
        bounds = np.zeros((3, 2))
        bounds[:dim] = self.bounds
        # without cells, limit the motion in one substep to the extent of the domain
        reach = mesh.reach if math.isfinite(mesh.reach) else float(np.max(bounds[:, 1] - bounds[:, 0]))
        status, node, substeps = _advance_frame(
            KINDS[mesh.kind], pos, vel, mesh.cells, mesh.gradient, mesh.weight, lam, mu, eta, mesh.scale, self.damping > 0,
            np.array(state.mass, dtype=np.float64, order="C"), _three_dimensional(state.gravity), bounds, reach, mesh.edges,
            obstacles, self.frame_dt, self.cfl, self.max_substeps,
        )  # fmt: skip
        if status != OK:
            raise self._error(status, node, pos[:, :dim], vel[:, :dim], state.gravity)
        pos, vel = np.array(pos[:, :dim], order="C"), np.array(vel[:, :dim], order="C")
        stress = cauchy_stress(mesh, pos, lam, mu)
        return state.later(self.frame_dt, pos, vel, velocity_history=None, stress=stress, num_substeps=substeps)

    def compile_kernels(self) -> None:
        """Compile every kernel into Numba's disk cache, so that worker processes started later only load them."""
        dim = len(self.bounds)
        middle = np.array([(low + high) / 2 for low, high in self.bounds])
        size = 0.25 * min(high - low for low, high in self.bounds)
        pos = middle + size * np.concatenate([np.zeros((1, dim)), np.eye(dim)])
        count = dim + 1
        self.step(
            State(
                pos, np.zeros_like(pos), np.full(count, node_code("solid"), dtype=np.uint8), np.full(count, size**dim),
                np.full((count, 1), MATERIALS["solid"][0].limits.low), Boundary.empty(dim), np.zeros(dim), rest_pos=pos, cells=np.arange(count)[None],
            )
        )  # fmt: skip

    def energy(self, state: State) -> float:
        """Return the sum of kinetic, gravitational and elastic energy in J (per metre of depth in 2D)."""
        mesh, lam, mu, _, _ = self._prepare(state)
        external = np.sum(state.mass * (np.sum(state.vel**2, axis=1) / 2 - state.pos @ state.gravity))
        return float(external) + elastic_energy(mesh, np.asarray(state.pos), lam, mu)

    def _prepare(self, state: State) -> tuple[Mesh, np.ndarray, np.ndarray, np.ndarray, Obstacles]:
        """Return mesh, Lamé parameters and viscosity of each cell, and obstacles; raise an error that names what does not fit."""
        num_nodes, dim = state.num_nodes, len(self.bounds)
        if state.rest_pos is None or state.cells is None:
            raise SimulationError("the state has no mesh: rest_pos and cells are required", reason="input")
        if state.cell_dim not in (None, dim):
            raise SimulationError(
                f"the mesh is a surface in {dim}D; FEM computes triangles and quadrilaterals in 2D, tetrahedra in 3D", reason="input"
            )
        if state.internal is not None:
            raise SimulationError(f"internal state is of type {type(state.internal).__name__}, expected None", reason="input")
        shapes = {
            "pos": (state.pos, (num_nodes, dim)),
            "vel": (state.vel, (num_nodes, dim)),
            "mass": (state.mass, (num_nodes,)),
            "rest_pos": (state.rest_pos, (num_nodes, dim)),
            "node_type": (state.node_type, (num_nodes,)),
            "gravity": (state.gravity, (dim,)),
        }
        for name, (array, expected) in shapes.items():
            if np.shape(array) != expected:
                raise SimulationError(f"{name} has shape {np.shape(array)}, expected {expected}", reason="input")
            if name != "gravity":
                _require(np.isfinite(array), f"{name} is not finite", reason="nan")
        if not np.all(np.isfinite(state.gravity)):
            raise SimulationError(f"gravity {state.gravity} is not finite", reason="nan")
        _require(np.asarray(state.mass) > 0, "mass is not positive")
        _require(np.asarray(state.node_type) == node_code("solid"), "node_type is not solid")
        parameters = parameters_of(state, "solid", np.arange(num_nodes), self.materials)
        check_surroundings(state, "FEM")
        mesh = build_mesh(state.rest_pos, state.cells, state.mass)
        modulus = parameters["youngs_modulus"][mesh.cells].mean(axis=1)
        ratio = parameters["poisson_ratio"][mesh.cells].mean(axis=1) if "poisson_ratio" in parameters else self.poisson_ratio
        lam_per_modulus, mu_per_modulus = lame_parameters(1.0, ratio)
        lam, mu = lam_per_modulus * modulus, mu_per_modulus * modulus
        # Γ = 2 damping ω at rest, where ω² = scale (2μ + dim λ) and Γ = scale 2η
        eta = self.damping * np.sqrt((2.0 * mu + dim * lam) / mesh.scale)
        return mesh, lam, mu, eta, collect(tuple(state.boundary.shapes), self.bounds)

    def _error(self, status: int, node: int, pos: np.ndarray, vel: np.ndarray, gravity: np.ndarray) -> SimulationError:
        where = "a state without nodes" if node < 0 else f"node {node} at {pos[node].tolist()} m with velocity {vel[node].tolist()} m/s"
        if status == NOT_FINITE:
            return SimulationError(f"{where} is not finite", reason="nan", node=node)
        if status == ESCAPE:
            return SimulationError(f"{where} is outside the domain {self.bounds}", reason="escape", node=node)
        message = (
            f"{where} under gravity {np.asarray(gravity).tolist()} m/s² would need more than {self.max_substeps} substeps in one frame"
        )
        return SimulationError(message, reason="explosion", node=node)


def _require(good: np.ndarray, message: str, reason: str = "input") -> None:
    if not np.all(good):
        node = int(np.argmin(np.reshape(good, (len(good), -1)).all(axis=1)))
        raise SimulationError(f"{message} (node {node})", reason=reason, node=node)


def _three_dimensional(values: np.ndarray) -> np.ndarray:
    """Return a copy [..., 3] of vectors; the third component is zero in 2D."""
    values = np.asarray(values, dtype=np.float64)
    result = np.zeros((*values.shape[:-1], 3))
    result[..., : values.shape[-1]] = values
    return result


@njit(cache=True, error_model="numpy")
@no_type_check
def _add_forces(kind, pos, vel, cells, gradient, weight, lam, mu, eta, damped, force):
    if kind == 0:
        return add_triangle_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force)
    if kind == 1:
        return add_quad_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force)
    return add_tetrahedron_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force)


@njit(cache=True, error_model="numpy")
@no_type_check
def _critical_rate(frequency_squared, damping_rate):
    """Return 1/h of the largest stable substep, with ``h² ω² + 2 h Γ = 4``."""
    return 0.25 * (damping_rate + math.sqrt(damping_rate * damping_rate + 4.0 * frequency_squared))


@njit(cache=True, error_model="numpy")
@no_type_check
def _advance_frame(
    kind, pos, vel, cells, gradient, weight, lam, mu, eta, scale, damped, mass, gravity, bounds, reach, edges,
    obstacles, frame_dt, cfl, max_substeps,
):  # fmt: skip
    """Advance pos and vel in place by one frame; return a status, the node that caused it, and the number of substeps."""
    force, box = np.zeros(pos.shape), np.empty(6)
    touched, gaps = np.full(obstacles.corners.shape[0], -1), np.zeros(obstacles.corners.shape[0])
    weighs = math.sqrt(gravity[0] * gravity[0] + gravity[1] * gravity[1] + gravity[2] * gravity[2])
    remaining, substeps = frame_dt, 0
    while True:
        status, node, speed = _survey(pos, vel, bounds, reach, box)
        if status != OK or remaining <= 0.0:
            return status, node, substeps
        stiffest, most_viscous = _add_forces(kind, pos, vel, cells, gradient, weight, lam, mu, eta, damped, force)
        stable = _critical_rate(scale * stiffest, scale * most_viscous) / cfl
        needed = remaining * max(stable, speed / reach, math.sqrt(weighs / reach)) * (1.0 - 1e-12)
        if needed > max_substeps - substeps:  # compare before rounding, because the number may exceed an integer
            return TOO_MANY_SUBSTEPS, node, substeps
        count = max(1, math.ceil(needed))
        h = remaining / count
        remaining = remaining - h if count > 1 else 0.0
        substeps += 1
        _accelerate(vel, force, mass, gravity, h)
        resist_corners(pos, vel, mass, edges, box, reach, h, obstacles.corners, touched, gaps)
        resist_nodes(pos, vel, box, reach, h, obstacles)
        _drift(pos, vel, gravity, h)
        push_out_corners(pos, mass, edges, obstacles.corners, touched, gaps)
        push_out_nodes(pos, vel, box, reach, obstacles)


@njit(cache=True, error_model="numpy")
@no_type_check
def _accelerate(vel, force, mass, gravity, h):
    """Apply the forces and half of gravity; clear the forces for the next substep."""
    for p in range(vel.shape[0]):
        s = h / mass[p]
        vel[p, 0] += s * force[p, 0] + 0.5 * h * gravity[0]
        vel[p, 1] += s * force[p, 1] + 0.5 * h * gravity[1]
        vel[p, 2] += s * force[p, 2] + 0.5 * h * gravity[2]
        force[p, 0] = force[p, 1] = force[p, 2] = 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _drift(pos, vel, gravity, h):
    """Move the nodes, then apply the other half of gravity."""
    for p in range(pos.shape[0]):
        pos[p, 0] += h * vel[p, 0]
        pos[p, 1] += h * vel[p, 1]
        pos[p, 2] += h * vel[p, 2]
        vel[p, 0] += 0.5 * h * gravity[0]
        vel[p, 1] += 0.5 * h * gravity[1]
        vel[p, 2] += 0.5 * h * gravity[2]


@njit(cache=True, error_model="numpy")
@no_type_check
def _survey(pos, vel, bounds, reach, box):
    """Check that all nodes are finite and in the domain, and set ``box`` to their extent; return status, node at fault (or the fastest) and top speed."""
    x_low = y_low = z_low = math.inf
    x_high = y_high = z_high = -math.inf
    fastest, speed_squared = (0 if pos.shape[0] > 0 else -1), 0.0
    for p in range(pos.shape[0]):
        x, y, z = pos[p, 0], pos[p, 1], pos[p, 2]
        v2 = vel[p, 0] * vel[p, 0] + vel[p, 1] * vel[p, 1] + vel[p, 2] * vel[p, 2]
        if not (v2 < math.inf and abs(x) + abs(y) + abs(z) < math.inf):
            return NOT_FINITE, p, 0.0
        if v2 > speed_squared:
            fastest, speed_squared = p, v2
        x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
        z_low, z_high = min(z_low, z), max(z_high, z)
    box[0], box[1], box[2], box[3], box[4], box[5] = x_low, y_low, z_low, x_high, y_high, z_high
    for axis in range(3):
        # a node counts as escaped when it is further than ``reach`` outside an open side
        if box[axis] < bounds[axis, 0] - reach or box[axis + 3] > bounds[axis, 1] + reach:
            for p in range(pos.shape[0]):
                if pos[p, axis] < bounds[axis, 0] - reach or pos[p, axis] > bounds[axis, 1] + reach:
                    return ESCAPE, p, 0.0
    return OK, fastest, math.sqrt(speed_squared)
