"""The material point method: quadratic B-spline MLS-MPM with APIC transfers, explicit, in float64.

Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC). One substep of length h, with grid spacing Δ and ``D = Δ²/4``::

    F_p ← (1 + h C_p) F_p, return-mapped;  τ_p = Kirchhoff stress
    m_i v_i = Σ_p w_ip [m_p v_p + (m_p C_p - h V_p τ_p / D) (x_i - x_p)],   m_i = Σ_p w_ip m_p
    v_i ← boundary conditions (v_i + h g)
    v_p = Σ_i w_ip v_i,   C_p = Σ_i w_ip v_i (x_i - x_p)ᵀ / D,   x_p ← x_p + h v_p

The domain's low corner is a grid node, three cells inside the grid, so walls lie exactly on nodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, ClassVar, no_type_check

import numpy as np
from numba import njit
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass

from gpe_pl.geometry import Box, Polygon, Shape, Sphere, Wall, outward_normal, signed_distance
from gpe_pl.rollout import SimulationError
from gpe_pl.schema import MATERIALS, NODE_TYPES, STICKY, node_code, param_names
from gpe_pl.solvers import materials as laws
from gpe_pl.trajectory import Boundary, State

PADDING = 3
"""Cells between the domain and the edge of the grid: room for the kernel of a particle on a wall, or one cell behind it."""

OK, NOT_FINITE, ESCAPE, TOO_MANY_SUBSTEPS = 0, 1, 2, 3


@dataclass(frozen=True)
class MPMInternal:
    """What the solver knows about its particles besides position and velocity.

    Attributes:
        deformation: elastic deformation gradient F [node, dim, dim].
        affine: APIC velocity gradient C [node, dim, dim] in 1/s.
        plastic: plastic state [node]; the volume correction of sand.
    """

    deformation: np.ndarray
    affine: np.ndarray
    plastic: np.ndarray

    @classmethod
    def at_rest(cls, num_nodes: int, dim: int) -> MPMInternal:
        """Undeformed particles that do not rotate."""
        return cls(np.tile(np.eye(dim), (num_nodes, 1, 1)), np.zeros((num_nodes, dim, dim)), np.zeros(num_nodes))


@dataclass(frozen=True)
class _Collider:
    """Boundary shapes in the form that the kernels take.

    Attributes:
        conditions: [node_x, node_y, k, 3] normal and friction of the k-th shape that holds the grid node; friction < 0: none.
        distance: signed distance of each grid node [node_x, node_y] in m.
        planes: [wall, 3] normal and offset.
        discs: [disc, 3] centre and radius.
        vertices: [vertex, 2] of all polygons, counter-clockwise, one after the other.
        first_vertex: [polygon + 1] where each polygon starts.
    """

    conditions: np.ndarray
    distance: np.ndarray
    planes: np.ndarray
    discs: np.ndarray
    vertices: np.ndarray
    first_vertex: np.ndarray


@lru_cache(maxsize=8)
def _collider(shapes: tuple[Shape, ...], origin: tuple[float, ...], spacing: float, counts: tuple[int, ...]) -> _Collider:
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    tolerance = 1e-9 * spacing  # a node on a wall belongs to the wall whatever the rounding
    inside = [shape.signed_distance(nodes) <= tolerance for shape in shapes]
    overlap = int(np.max(np.sum(inside, axis=0))) if shapes else 0
    conditions = np.full((*counts, max(1, overlap), 3), -1.0)
    filled = np.zeros(counts, dtype=np.int64)
    planes, discs, vertices, first_vertex = [], [], [], [0]
    for shape, mask in zip(shapes, inside, strict=True):
        if not isinstance(shape, Wall):
            _require_resolved(shape, mask, spacing)
        at = np.nonzero(mask)
        normal = outward_normal(shape, nodes[at], 1e-3 * spacing)
        # deep inside a shape, where no direction leads out, the node sticks
        friction = np.where(np.sum(normal * normal, axis=-1) > 0, shape.friction, STICKY)
        conditions[(*at, filled[at])] = np.concatenate([normal, friction[:, None]], axis=-1)
        filled[at] += 1
        if isinstance(shape, Wall):
            planes.append([*shape.normal, shape.offset])
        elif isinstance(shape, Sphere):
            discs.append([*shape.center, shape.radius])
        else:
            corners = _corners(shape)
            vertices.extend(corners)
            first_vertex.append(first_vertex[-1] + len(corners))
    return _Collider(
        conditions,
        signed_distance(shapes, nodes),
        np.array(planes, dtype=np.float64).reshape(-1, 3),
        np.array(discs, dtype=np.float64).reshape(-1, 3),
        np.array(vertices, dtype=np.float64).reshape(-1, 2),
        np.array(first_vertex, dtype=np.int64),
    )


def _require_resolved(shape: Shape, mask: np.ndarray, spacing: float) -> None:
    """Refuse an obstacle that particles could pass: a particle in the nearer half of a cell-thick obstacle is pushed back, not out at the far side."""
    thickness = _thickness(shape)
    if thickness < spacing * (1 - 1e-6):
        raise SimulationError(
            f"obstacle {shape} is {thickness:g} m thin; on a grid of spacing {spacing:g} m it must be at least {spacing:g} m thick",
            reason="input",
        )
    if not np.any(mask):
        raise SimulationError(
            f"obstacle {shape} contains no node of the grid of spacing {spacing:g} m; move it, or make it {math.sqrt(2) * spacing:g} m thick",
            reason="input",
        )


def _thickness(shape: Shape) -> float:
    """Smallest thickness in m: diameter, shortest side, or shortest way through a polygon from the middle of an edge along its inward normal."""
    if isinstance(shape, Sphere):
        return 2.0 * shape.radius
    if isinstance(shape, Box):
        return min(high - low for low, high in zip(shape.low, shape.high, strict=True))
    vertices = np.array(_corners(shape), dtype=np.float64)
    before, after = vertices - np.roll(vertices, 1, axis=0), np.roll(vertices, -1, axis=0) - vertices
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    straight = np.abs(turn) <= 1e-9 * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    a = vertices[~straight]  # vertices along a straight edge do not divide it
    edge = np.roll(a, -1, axis=0) - a
    tangent = edge / np.linalg.norm(edge, axis=1)[:, None]
    thickness = math.inf
    for k, middle in enumerate(a + edge / 2):
        inward = np.array([-tangent[k, 1], tangent[k, 0]])
        # every other edge in this edge's frame: its ends' distances along the edge and into the polygon
        along, depth = (a - middle) @ tangent[k], (a - middle) @ inward
        for j in range(len(a)):
            n = (j + 1) % len(a)
            if j != k and along[j] != along[n] and min(along[j], along[n]) <= 0.0 <= max(along[j], along[n]):
                hit = depth[j] + (depth[n] - depth[j]) * along[j] / (along[j] - along[n])
                if hit > 0.0:
                    thickness = min(thickness, float(hit))
    return thickness


def _corners(shape: Shape) -> list[tuple[float, float]]:
    if isinstance(shape, Polygon):
        return list(shape.vertices)
    if isinstance(shape, Box):
        (x0, y0), (x1, y1) = shape.low, shape.high
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    raise SimulationError(f"MPM cannot collide with a shape of kind {shape.kind!r}", reason="input")


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class MPM:
    """Material point solver; a ``Simulator``.

    Each step advances one frame by substeps that satisfy ``h (c + |v|_max) <= cfl Δ``, with c the elastic wave speed, and ``h² |g| <= cfl Δ / 4``. They are
    chosen from the current state alone, so a restart repeats a run-through bit by bit. Obstacles must be at least one grid cell thick.

    Attributes:
        bounds: ``(low, high)`` per axis of the domain [m]; whole multiples of the grid spacing apart.
        grid_spacing: Δ [m].
        frame_dt: time between frames [s].
        materials: every material of the data set, which fixes the columns of ``State.material_params``.
        youngs_modulus: [Pa]; for sand a numerical choice, stiff enough to keep c well above the speeds of the flow.
        poisson_ratio: below 0.5.
        density: mass per volume at rest [kg/m³].
        cfl: fraction of a cell that a wave or a particle may cross in one substep.
        max_substeps: per frame; more means that the state has exploded.
    """

    bounds: tuple[tuple[float, float], ...]
    grid_spacing: Annotated[float, Field(gt=0)]
    frame_dt: Annotated[float, Field(gt=0)] = 5e-3
    materials: tuple[str, ...] = ("sand",)
    youngs_modulus: Annotated[float, Field(gt=0)] = 5e5
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.2
    density: Annotated[float, Field(gt=0)] = 1600.0
    cfl: Annotated[float, Field(gt=0, le=1)] = 0.5
    max_substeps: Annotated[int, Field(ge=1)] = 1000

    name: ClassVar[str] = "mpm"
    version: ClassVar[str] = "1"

    def __post_init__(self) -> None:
        if len(self.bounds) != 2:
            raise ValueError(f"only dimension=2 is supported, got bounds of {len(self.bounds)} axes")
        for axis, (low, high) in enumerate(self.bounds):
            cells = (high - low) / self.grid_spacing
            if not (math.isfinite(cells) and cells > 0.5 and abs(cells - round(cells)) < 1e-6 * cells):
                raise ValueError(
                    f"bounds[{axis}] = ({low}, {high}) must span a whole number of grid cells of {self.grid_spacing} m, got {cells:g}"
                )
        unknown = [m for m in self.materials if m not in laws.LAWS]
        if unknown or not self.materials:
            raise ValueError(f"MPM has no law for material {', '.join(unknown) or '(none)'}; known: {', '.join(laws.LAWS)}")

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves in m/s: √((λ + 2μ)/ρ)."""
        lam, mu = laws.lame_parameters(self.youngs_modulus, self.poisson_ratio)
        return math.sqrt((lam + 2.0 * mu) / self.density)

    @property
    def solver_dt(self) -> float:
        """Largest substep in s."""
        return min(self.frame_dt, self.cfl * self.grid_spacing / self.wave_speed)

    def step(self, state: State) -> State:
        """Advance one frame.

        Raises:
            SimulationError: with reason ``input`` (arrays or obstacles that do not fit the solver), ``nan``, ``escape`` (a particle left the domain
                through an open side or started outside) or ``explosion`` (more than ``max_substeps``).
        """
        internal = state.internal if state.internal is not None else MPMInternal.at_rest(state.num_nodes, state.dim)
        code, coefficient = self._check(state, internal)
        collider = self._collider(state.boundary)
        # np.array copies: the kernel works in place and the caller's arrays must not change
        pos, vel = np.array(state.pos, dtype=np.float64, order="C"), np.array(state.vel, dtype=np.float64, order="C")
        deformation, affine, plastic = (
            np.array(x, dtype=np.float64, order="C") for x in (internal.deformation, internal.affine, internal.plastic)
        )
        lam, mu = laws.lame_parameters(self.youngs_modulus, self.poisson_ratio)
        status, node = _advance_frame(
            pos, vel, deformation, affine, plastic, code, coefficient,
            np.asarray(state.mass, dtype=np.float64), np.asarray(state.gravity, dtype=np.float64), self.density, lam, mu, self.wave_speed,
            np.asarray(self.bounds), np.asarray(self._origin), self.grid_spacing,
            collider.conditions, collider.distance, collider.planes, collider.discs, collider.vertices, collider.first_vertex,
            self.frame_dt, self.cfl, self.max_substeps,
        )  # fmt: skip
        if status != OK:
            raise self._error(status, node, pos, vel, state.gravity)
        return replace(
            state,
            pos=pos,
            vel=vel,
            velocity_history=None,
            time=state.time + self.frame_dt,
            internal=MPMInternal(deformation, affine, plastic),
        )

    @property
    def _origin(self) -> tuple[float, ...]:
        return tuple(low - PADDING * self.grid_spacing for low, _ in self.bounds)

    def _collider(self, boundary: Boundary) -> _Collider:
        if np.any(np.asarray(boundary.vel) != 0) or np.any(np.asarray(boundary.restitution) != 0):
            raise SimulationError("MPM supports only boundaries at rest and without restitution", reason="input")
        counts = tuple(round((high - low) / self.grid_spacing) + 1 + 2 * PADDING for low, high in self.bounds)
        return _collider(tuple(boundary.shapes), self._origin, self.grid_spacing, counts)

    def _check(self, state: State, internal: object) -> tuple[np.ndarray, np.ndarray]:
        """Law code and coefficient per particle, or an error that names what does not fit."""
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
        shapes["internal.plastic"] = (internal.plastic, (num_nodes,))
        for name, (array, expected) in shapes.items():
            if np.shape(array) != expected:
                raise SimulationError(f"{name} has shape {np.shape(array)}, expected {expected}", reason="input")
            if name not in ("material_params", "gravity"):
                self._require(np.isfinite(array), f"{name} is not finite", reason="nan")
        if not np.all(np.isfinite(state.gravity)):
            raise SimulationError(f"gravity {state.gravity} is not finite", reason="nan")
        self._require(np.asarray(state.mass) > 0, "mass is not positive")
        code, coefficient = np.empty(num_nodes, dtype=np.int64), np.empty(num_nodes)
        known = np.zeros(num_nodes, dtype=bool)
        for material in self.materials:
            chosen = np.asarray(state.node_type) == node_code(material)
            parameter = MATERIALS[material]
            values = np.asarray(state.material_params, dtype=np.float64)[:, names.index(parameter.name)]
            in_range = (values >= parameter.low) & (values <= parameter.high)
            self._require(in_range | ~chosen, f"{parameter.name} is outside [{parameter.low:g}, {parameter.high:g}] {parameter.unit}")
            code[chosen] = laws.LAWS[material].code
            coefficient[chosen] = laws.LAWS[material].coefficient(values[chosen], dim)
            known |= chosen
        self._require(known, f"node_type is none of the solver's materials {', '.join(self.materials)} (codes of {', '.join(NODE_TYPES)})")
        return code, coefficient

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


def compile_kernels() -> None:
    """Compile every kernel and fill Numba's cache on disk, so that worker processes started afterwards only load it."""
    solver = MPM(bounds=((0.0, 1.0), (0.0, 1.0)), grid_spacing=0.25)
    state = State(
        np.full((1, 2), 0.5), np.zeros((1, 2)), np.array([node_code("sand")], dtype=np.uint8), np.ones(1), np.full((1, 1), 30.0),
        Boundary.empty(2), np.array([0.0, -9.81]),
    )  # fmt: skip
    solver.step(state)


@njit(cache=True, error_model="numpy")
@no_type_check
def _advance_frame(
    pos, vel, deformation, affine, plastic, code, coefficient, mass, gravity, density, lam, mu, wave_speed, bounds, origin, spacing,
    conditions, distance, planes, discs, vertices, first_vertex, frame_dt, cfl, max_substeps,
):  # fmt: skip
    """Advance pos, vel, deformation, affine and plastic in place by one frame; returns a status and the node that caused it."""
    inv = 1.0 / spacing
    grid = np.zeros((conditions.shape[0], conditions.shape[1], 3))
    remaining, substeps = frame_dt, 0
    # a particle at rest may fall by no more than a quarter of cfl cells, so with its speed it moves at most 1.25 cfl cells
    fall_rate = 2.0 * math.sqrt(math.hypot(gravity[0], gravity[1]) / (cfl * spacing))
    while True:
        status, node, speed, x_low, x_high, y_low, y_high = _survey(pos, vel, bounds, spacing)
        if status != OK or remaining <= 0.0:
            return status, node
        needed = max(remaining * (wave_speed + speed) / (cfl * spacing), remaining * fall_rate) * (1.0 - 1e-12)
        if needed > max_substeps - substeps:  # before it is rounded: an integer may not hold it
            return TOO_MANY_SUBSTEPS, node
        count = max(1, math.ceil(needed))
        h = remaining / count
        remaining = remaining - h if count > 1 else 0.0
        substeps += 1
        i_low, i_high = int((x_low - origin[0]) * inv - 0.5), int((x_high - origin[0]) * inv - 0.5) + 3
        j_low, j_high = int((y_low - origin[1]) * inv - 0.5), int((y_high - origin[1]) * inv - 0.5) + 3
        for i in range(i_low, i_high):
            for j in range(j_low, j_high):
                grid[i, j, 0] = grid[i, j, 1] = grid[i, j, 2] = 0.0
        _particles_to_grid(pos, vel, deformation, affine, plastic, code, coefficient, mass, density, lam, mu, origin, inv, h, grid)
        _move_grid(grid, conditions, gravity, h, i_low, i_high, j_low, j_high)
        _grid_to_particles(pos, vel, affine, origin, spacing, h, grid, distance, planes, discs, vertices, first_vertex)


@njit(cache=True, error_model="numpy")
@no_type_check
def _survey(pos, vel, bounds, spacing):
    """Check that every particle can be indexed; status, node at fault (or the fastest), largest speed and extent of the particles."""
    x_low = y_low = math.inf
    x_high = y_high = -math.inf
    fastest, speed_squared = (0 if pos.shape[0] > 0 else -1), 0.0
    # a particle may be up to a cell outside an open side before it counts as escaped
    left, right, bottom, top = bounds[0, 0] - spacing, bounds[0, 1] + spacing, bounds[1, 0] - spacing, bounds[1, 1] + spacing
    for p in range(pos.shape[0]):
        x, y = pos[p, 0], pos[p, 1]
        v2 = vel[p, 0] * vel[p, 0] + vel[p, 1] * vel[p, 1]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(v2)):
            return NOT_FINITE, p, 0.0, 0.0, 0.0, 0.0, 0.0
        if x < left or x > right or y < bottom or y > top:
            return ESCAPE, p, 0.0, 0.0, 0.0, 0.0, 0.0
        x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
        if v2 > speed_squared:
            fastest, speed_squared = p, v2
    if pos.shape[0] == 0:
        x_low = x_high = bounds[0, 0]
        y_low = y_high = bounds[1, 0]
    return OK, fastest, math.sqrt(speed_squared), x_low, x_high, y_low, y_high


@njit(cache=True, error_model="numpy")
@no_type_check
def _weights(f):
    """Quadratic B-spline weights of three nodes; ``f`` in [0.5, 1.5) is the distance from the first, in cells."""
    return 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2


@njit(cache=True, error_model="numpy")
@no_type_check
def _particles_to_grid(pos, vel, deformation, affine, plastic, code, coefficient, mass, density, lam, mu, origin, inv, h, grid):
    spacing = 1.0 / inv
    for p in range(pos.shape[0]):
        c00, c01, c10, c11 = affine[p, 0, 0], affine[p, 0, 1], affine[p, 1, 0], affine[p, 1, 1]
        f00, f01, f10, f11 = deformation[p, 0, 0], deformation[p, 0, 1], deformation[p, 1, 0], deformation[p, 1, 1]
        f00, f01, f10, f11, plastic[p], t00, t01, t11 = laws.respond(
            code[p],
            f00 + h * (c00 * f00 + c01 * f10),
            f01 + h * (c00 * f01 + c01 * f11),
            f10 + h * (c10 * f00 + c11 * f10),
            f11 + h * (c10 * f01 + c11 * f11),
            plastic[p],
            coefficient[p],
            lam,
            mu,
        )
        deformation[p, 0, 0], deformation[p, 0, 1], deformation[p, 1, 0], deformation[p, 1, 1] = f00, f01, f10, f11
        m = mass[p]
        force = -h * m / density * 4.0 * inv * inv
        # momentum at a node k cells from the first: q + A (k - f), with A in units of a cell
        a00, a01 = (m * c00 + force * t00) * spacing, (m * c01 + force * t01) * spacing
        a10, a11 = (m * c10 + force * t01) * spacing, (m * c11 + force * t11) * spacing
        x, y = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv
        i, j = int(x - 0.5), int(y - 0.5)
        fx, fy = x - i, y - j
        wx, wy = _weights(fx), _weights(fy)
        q0, q1 = m * vel[p, 0] - a00 * fx - a01 * fy, m * vel[p, 1] - a10 * fx - a11 * fy
        for k in range(3):
            for n in range(3):
                w = wx[k] * wy[n]
                grid[i + k, j + n, 0] += w * (q0 + a00 * k + a01 * n)
                grid[i + k, j + n, 1] += w * (q1 + a10 * k + a11 * n)
                grid[i + k, j + n, 2] += w * m


@njit(cache=True, error_model="numpy")
@no_type_check
def _move_grid(grid, conditions, gravity, h, i_low, i_high, j_low, j_high):
    """Momenta to velocities, gravity, and the boundary conditions of the nodes inside walls and obstacles."""
    for i in range(i_low, i_high):
        for j in range(j_low, j_high):
            m = grid[i, j, 2]
            if m <= 0.0:
                continue
            u, v = grid[i, j, 0] / m + h * gravity[0], grid[i, j, 1] / m + h * gravity[1]
            for k in range(conditions.shape[2]):
                nx, ny, friction = conditions[i, j, k, 0], conditions[i, j, k, 1], conditions[i, j, k, 2]
                if friction < 0.0:
                    break
                if friction >= STICKY:
                    u = v = 0.0
                    continue
                inward = u * nx + v * ny
                if inward < 0.0:
                    u, v = u - inward * nx, v - inward * ny
                    sliding = math.sqrt(u * u + v * v)
                    if sliding > 0.0:
                        kept = max(0.0, 1.0 + friction * inward / sliding)
                        u, v = u * kept, v * kept
            grid[i, j, 0], grid[i, j, 1] = u, v


@njit(cache=True, error_model="numpy")
@no_type_check
def _grid_to_particles(pos, vel, affine, origin, spacing, h, grid, distance, planes, discs, vertices, first_vertex):
    inv = 1.0 / spacing
    for p in range(pos.shape[0]):
        x, y = (pos[p, 0] - origin[0]) * inv, (pos[p, 1] - origin[1]) * inv
        i, j = int(x - 0.5), int(y - 0.5)
        fx, fy = x - i, y - j
        wx, wy = _weights(fx), _weights(fy)
        u = v = c00 = c01 = c10 = c11 = 0.0
        for k in range(3):
            for n in range(3):
                w = wx[k] * wy[n]
                gu, gv = w * grid[i + k, j + n, 0], w * grid[i + k, j + n, 1]
                u += gu
                v += gv
                c00 += gu * (k - fx)
                c01 += gu * (n - fy)
                c10 += gv * (k - fx)
                c11 += gv * (n - fy)
        scale = 4.0 * inv
        affine[p, 0, 0], affine[p, 0, 1], affine[p, 1, 0], affine[p, 1, 1] = scale * c00, scale * c01, scale * c10, scale * c11
        x_new, y_new = pos[p, 0] + h * u, pos[p, 1] + h * v
        # node (i+1, j+1) is the nearest one, at most 0.71 cells away, and by the choice of substeps the particle moved at most 1.25 cells
        if distance[i + 1, j + 1] < 2.0 * spacing:
            x_new, y_new, u, v = _push_out(x_new, y_new, u, v, planes, discs, vertices, first_vertex)
        pos[p, 0], pos[p, 1], vel[p, 0], vel[p, 1] = x_new, y_new, u, v


@njit(cache=True, error_model="numpy")
@no_type_check
def _push_out(x, y, u, v, planes, discs, vertices, first_vertex):
    """Move a particle that is inside a shape to its surface and remove the inward part of its velocity; walls last, so that they always hold."""
    for k in range(first_vertex.shape[0] - 1):
        depth, nx, ny = _polygon_depth(x, y, vertices, first_vertex[k], first_vertex[k + 1])
        if depth > 0.0:
            x, y, u, v = _project(x, y, u, v, depth, nx, ny)
    for k in range(discs.shape[0]):
        dx, dy = x - discs[k, 0], y - discs[k, 1]
        r = math.sqrt(dx * dx + dy * dy)
        if r < discs[k, 2]:
            nx, ny = (dx / r, dy / r) if r > 0.0 else (0.0, 1.0)
            x, y, u, v = _project(x, y, u, v, discs[k, 2] - r, nx, ny)
    for k in range(planes.shape[0]):
        depth = planes[k, 2] - planes[k, 0] * x - planes[k, 1] * y
        if depth > 0.0:
            x, y, u, v = _project(x, y, u, v, depth, planes[k, 0], planes[k, 1])
    return x, y, u, v


@njit(cache=True, error_model="numpy")
@no_type_check
def _project(x, y, u, v, depth, nx, ny):
    inward = min(0.0, u * nx + v * ny)
    return x + depth * nx, y + depth * ny, u - inward * nx, v - inward * ny


@njit(cache=True, error_model="numpy")
@no_type_check
def _polygon_depth(x, y, vertices, start, stop):
    """Depth of a point inside a simple counter-clockwise polygon and the normal of the nearest edge; depth 0 outside."""
    inside = False
    nearest, nx, ny = math.inf, 0.0, 1.0
    for k in range(start, stop):
        after = k + 1 if k + 1 < stop else start
        ax, ay = vertices[k, 0], vertices[k, 1]
        ex, ey = vertices[after, 0] - ax, vertices[after, 1] - ay
        px, py = x - ax, y - ay
        if ((vertices[after, 1] > y) != (ay > y)) and px < ex * py / ey:
            inside = not inside
        length = math.sqrt(ex * ex + ey * ey)
        t = min(1.0, max(0.0, (px * ex + py * ey) / (length * length)))
        qx, qy = px - t * ex, py - t * ey
        d = math.sqrt(qx * qx + qy * qy)
        if d < nearest:
            nearest = d
            # from inside, the way out leads to the nearest point of the surface; on the surface, along the edge's normal
            nx, ny = (-qx / d, -qy / d) if d > 1e-12 * length else (ey / length, -ex / length)
    return (nearest if inside else 0.0), nx, ny
