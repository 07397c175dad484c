"""``State``, ``Trajectory`` and ``Metadata``: the only contract between solvers and learners."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity, PeriodicityError
from gpe_pl.geometry.repeated_shapes import is_covered, repeated
from gpe_pl.geometry.shape_values import moved
from gpe_pl.geometry.shapes import Shape, surface_tolerance
from gpe_pl.schema import BOUNDARY, MATERIALS, STICKY, node_code, param_names
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.arrays import (
    RADIUS_SPACINGS,
    ArrayError,
    checked_bounds,
    checked_cells,
    checked_materials,
    flags,
    numbers,
    per_node,
    positive,
    typical_spacing,
    velocities_of,
)
from gpe_pl.trajectory.rigid_parts import carried_along

Array = Any
"""A NumPy array or a torch tensor."""


@dataclass(frozen=True)
class Motion:
    """Prescribed motion of boundary nodes, from the present frame on: NumPy arrays [frame, boundary_node, dim].

    Attributes:
        pos: positions in m.
        vel: velocities in m/s with which the nodes go on to the next frame.
        normal: unit normals into free space.
    """

    pos: np.ndarray
    vel: np.ndarray
    normal: np.ndarray

    @property
    def num_frames(self) -> int:
        return len(self.pos)

    def frames(self, start: int, stop: int | None = None) -> Motion:
        """That of the frames ``start:stop``."""
        return Motion(self.pos[start:stop], self.vel[start:stop], self.normal[start:stop])


@dataclass(frozen=True)
class Boundary:
    """Dense boundary nodes with their boundary condition, and the geometry they were sampled from.

    Attributes:
        pos: positions [boundary_node, dim] in m.
        vel: velocities [boundary_node, dim] in m/s.
        normal: unit normals [boundary_node, dim] into free space.
        friction: Coulomb coefficient [boundary_node]; ``schema.STICKY`` or more is no-slip.
        restitution: fraction of the normal velocity that a bounce returns [boundary_node].
        shapes: analytic geometry, for signed distances.
        motion: where the nodes go, if they move; its first frame is what ``pos``, ``vel`` and ``normal`` say.
    """

    pos: Array
    vel: Array
    normal: Array
    friction: Array
    restitution: Array
    shapes: tuple[Shape, ...] = ()
    motion: Motion | None = None

    @classmethod
    def sample(cls, shapes: tuple[Shape, ...], spacing: float, dim: int, periodicity: Periodicity = NOWHERE) -> Boundary:
        """Sample shapes, and their images in periodic domains, into nodes at most ``spacing`` [m] apart; nodes that lie inside another shape are left out."""
        shapes = repeated(tuple(shapes), periodicity)
        pos, normal, friction, restitution = [np.empty((0, dim))], [np.empty((0, dim))], [np.empty(0)], [np.empty(0)]
        rounding = 1e-3 * surface_tolerance(shapes)
        for shape in shapes:
            p, n = shape.sample(spacing)
            for other in shapes:
                if other is not shape:
                    keep = other.signed_distance(p) > -rounding
                    p, n = p[keep], n[keep]
            pos.append(p)
            normal.append(n)
            friction.append(np.full(len(p), shape.friction))
            restitution.append(np.full(len(p), shape.restitution))
        x = np.concatenate(pos)
        sampled = cls(x, np.zeros_like(x), np.concatenate(normal), np.concatenate(friction), np.concatenate(restitution), tuple(shapes))
        return sampled.inside(periodicity)

    @classmethod
    def empty(cls, dim: int) -> Boundary:
        """No boundary at all."""
        return cls.sample((), 1.0, dim)

    @classmethod
    def from_numpy(
        cls,
        pos: Array,
        normal: Array,
        *,
        vel: Array = 0.0,
        friction: Array = STICKY,
        restitution: Array = 0.0,
        shapes: tuple[Shape, ...] = (),
    ) -> Boundary:
        """Walls and obstacles that are known by points on them; see ``arrays.estimated_normals`` where normals are not known.

        Args:
            pos: positions [boundary_node, dim] in m, about as far apart as particles.
            normal: directions into free space [boundary_node, dim]; of any length.
            vel: velocity in m/s, one for all [dim] or one per node, for walls that slide along themselves.
            friction: Coulomb coefficient, one for all or one per node; ``schema.STICKY`` is no-slip.
            restitution: fraction of the normal velocity that a bounce returns, one for all or one per node.
            shapes: the geometry behind the points, if it is known; containment and pictures use it.

        Raises:
            ArrayError: an array of another shape, a number that is not finite or out of range; names the node.
        """
        pos = numbers("boundary pos", pos, {"boundary_node": None, "dim": None})
        normal = numbers("boundary normal", normal, dict(zip(("boundary_node", "dim"), pos.shape, strict=True)))
        vel = per_node("boundary vel", vel, pos.shape, "boundary_node")
        friction, restitution = (
            per_node(f"boundary {name}", value, pos.shape[:1], "boundary_node", low=0.0, high=high)
            for name, value, high in (("friction", friction, np.inf), ("restitution", restitution, 1.0))
        )
        return cls(pos, vel, _unit(normal).astype(np.float32), friction, restitution, shapes)

    @classmethod
    def moving(
        cls,
        pos: Array,
        normal: Array,
        frame_dt: float | int,
        *,
        friction: Array = STICKY,
        restitution: Array = 0.0,
        periodicity: Periodicity = NOWHERE,
    ) -> Boundary:
        """Walls and obstacles that move in a prescribed way, as grippers, pistons and paddles do, in the first of their frames.

        Args:
            pos: positions [frame, boundary_node, dim] in m, of as many frames as the trajectory.
            normal: directions into free space, of any length: in the first frame [boundary_node, dim], from where they turn as the rigid parts do that the
                motion shows (``rigid_parts``), or in every frame [frame, boundary_node, dim].
            frame_dt: seconds between frames.
            friction, restitution: as in ``from_numpy``.
            periodicity: where space repeats.

        Raises:
            ArrayError: as ``from_numpy``.
        """
        pos = numbers("boundary pos", pos, {"frame": None, "boundary_node": None, "dim": None})
        given = np.ndim(normal) == 3
        if given:
            normal = numbers("boundary normal", normal, dict(zip(("frame", "boundary_node", "dim"), pos.shape, strict=True)))
        now = normal[0] if given else normal
        first = cls.from_numpy(periodicity.wrapped(pos[0].astype(np.float64)), now, friction=friction, restitution=restitution)
        steps = periodicity.shortest(np.diff(pos.astype(np.float64), axis=0))
        path = np.concatenate([first.pos[None], first.pos + np.cumsum(steps, axis=0)])  # continuous, also across seams
        vel = np.concatenate([steps, steps[-1:]]) / positive("frame_dt", frame_dt, "seconds")
        normals = _unit(normal) if given else carried_along(path, np.asarray(first.normal, np.float64), periodicity)
        inside = np.stack([periodicity.wrapped(frame) for frame in path])
        return replace(first, motion=Motion(inside, vel, normals)).at(0)

    def inside(self, periodicity: Periodicity) -> Boundary:
        """The same, of NumPy arrays, in a periodic domain: nodes are inside, those that meet at a seam exist once and those within an image of a shape not at
        all, and shapes know their images.
        """
        if not periodicity:
            return self
        pos, motion = periodicity.wrapped(self.pos), self.motion
        close = 1e-6 * float(periodicity.period[list(periodicity.axes)].min())
        j, i = search_tree(pos, periodicity).query_pairs(close, output_type="ndarray").reshape(-1, 2).T
        same = (self.normal[i] * self.normal[j]).sum(axis=1) > 0.999  # two walls meet in a corner, where each has its node
        if motion is not None:
            same &= (np.abs(periodicity.shortest(motion.pos[:, i] - motion.pos[:, j])) <= close).all(axis=(0, 2))
            same &= ((motion.normal[:, i] * motion.normal[:, j]).sum(axis=2) > 0.999).all(axis=0)
        shapes = repeated(self.shapes, periodicity)
        free = ~is_covered(self.pos, self.normal, self.shapes, shapes)
        kept = np.setdiff1d(np.flatnonzero(free), i[same])
        if motion is not None:
            motion = Motion(motion.pos[:, kept], motion.vel[:, kept], motion.normal[:, kept])
        pos, vel, normal, friction, restitution = (x[kept] for x in (pos, self.vel, self.normal, self.friction, self.restitution))
        return Boundary(pos, vel, normal, friction, restitution, shapes, motion)

    def to_numpy(self) -> Boundary:
        """The same with NumPy arrays of its own."""
        pos, vel, normal, friction, restitution = (
            np.array(_numpy(x)) for x in (self.pos, self.vel, self.normal, self.friction, self.restitution)
        )
        return Boundary(pos, vel, normal, friction, restitution, self.shapes, self.motion)

    def at(self, frame: int, stop: int | None = None) -> Boundary:
        """The boundary so many frames later, with its motion up to the frame ``stop``; the same object if it does not move.

        Where its motion ends it stays and is still.
        """
        if self.motion is None:
            return self
        xp, motion = array_namespace(self.pos), self.motion.frames(min(frame, self.motion.num_frames - 1), stop)

        def like(x: np.ndarray) -> Array:
            return x if isinstance(self.pos, np.ndarray) else xp.asarray(np.array(x), dtype=self.pos.dtype, device=self.pos.device)

        now = replace(self, pos=like(motion.pos[0]), vel=like(motion.vel[0]), normal=like(motion.normal[0]), motion=motion)
        return now if frame < self.motion.num_frames else replace(now, vel=0.0 * now.vel, motion=None)

    def tree(self, periodicity: Periodicity) -> Any:
        """``search_tree`` of the positions, built once: a boundary stays where it is, or becomes another one in the next frame."""
        kept: dict[Periodicity, Any] = self.__dict__.setdefault("_trees", {})  # no field: no part of equality or of what is stored
        if periodicity not in kept:
            kept[periodicity] = search_tree(self.pos, periodicity)
        return kept[periodicity]


def search_tree(pos: Array, periodicity: Periodicity = NOWHERE) -> Any:
    """A k-d tree of positions [node, dim] for neighbour search on the CPU: quick to build, so that moving nodes can have a new one in every step."""
    from scipy.spatial import cKDTree

    points = np.ascontiguousarray(_numpy(pos))
    if not periodicity:
        return cKDTree(points, balanced_tree=False, compact_nodes=False)
    return cKDTree(periodicity.from_corner(points), balanced_tree=False, compact_nodes=False, boxsize=periodicity.period)


def _unit(normal: np.ndarray) -> np.ndarray:
    """Directions [..., boundary_node, dim] of length 1."""
    length = np.linalg.norm(normal.astype(np.float64), axis=-1, keepdims=True)
    if (length == 0).any():
        *frame, node, _ = np.argwhere(length == 0)[0].tolist()
        where = f"frame {frame[0]}, " if frame else ""
        raise ArrayError(f"boundary normal: {where}boundary_node {node} has length 0; it must point into free space", *frame)
    return np.asarray(normal / length)


def _check_steps(boundary: Boundary, frame_dt: float, periodicity: Periodicity) -> None:
    """Refuse nodes that move by more than half a period between frames: they cross a seam that their motion does not know."""
    if boundary.motion is None:
        return
    for axis in periodicity.axes:
        step = np.abs(boundary.motion.vel[..., axis]) * frame_dt
        if (step > 0.5001 * periodicity.period[axis]).any():
            frame, node = np.unravel_index(int(step.argmax()), step.shape)
            raise ArrayError(
                f"boundary: boundary_node {node} moves by {step[frame, node]:.4g} m along {'xyz'[axis]} after frame {frame}, more than half the period "
                f"{periodicity.period[axis]:.4g} m; pass periodicity=Periodicity(bounds, periodic) and the same frame_dt to Boundary.moving",
                int(frame),
            )


def _numpy(x: Array) -> np.ndarray:
    return x if isinstance(x, np.ndarray) else x.detach().cpu().numpy()


@dataclass(frozen=True)
class Stress:
    """Cauchy stress of a mesh in Pa; in a ``Trajectory`` with a leading axis of frames.

    Attributes:
        node: [node, component], averaged from the cells around each node; zero at nodes of no cell.
        cell: [cell, component]. Components are xx, xy, yy, zz in plane strain and xx, xy, xz, yy, yz, zz in 3D.
    """

    node: Array
    cell: Array

    @property
    def node_von_mises(self) -> Array:
        return von_mises(self.node)

    @property
    def cell_von_mises(self) -> Array:
        return von_mises(self.cell)


def von_mises(stress: Array) -> Array:
    """Von Mises stress √(3/2 s:s) [...] in Pa, with s the deviator of stresses [..., component] ordered as in ``Stress``."""
    xp = array_namespace(stress)
    zero = xp.zeros_like(stress[..., 0])
    if stress.shape[-1] == 4:
        (xx, xy, yy, zz), (xz, yz) = (stress[..., k] for k in range(4)), (zero, zero)
    else:
        xx, xy, xz, yy, yz, zz = (stress[..., k] for k in range(6))
    normal = ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2
    return xp.sqrt(normal + 3 * (xy**2 + xz**2 + yz**2))


@dataclass(frozen=True)
class State:
    """Everything a ``Simulator`` needs to know at one instant; arrays of one backend.

    Attributes:
        pos: positions of the dynamic nodes [node, dim] in m.
        vel: velocities [node, dim] in m/s.
        node_type: codes of ``schema.NODE_TYPES`` [node].
        mass: [node] in kg.
        material_params: [node, param], columns named by ``Metadata.param_names``, NaN where not applicable.
        boundary: boundary nodes and their conditions.
        gravity: external acceleration [dim] in m/s².
        velocity_history: the last velocities [node, history, dim], oldest first, the last one equal to ``vel``; None for solvers.
        time: seconds since the start.
        rest_pos: undeformed positions [node, dim] in m, where there is a mesh; nodes of no cell have their initial position.
        cells: nodes of each mesh cell [cell, corner]; one with fewer corners than others repeats its last.
        cell_dim: dimension of the cells, 2 for surfaces in 3D; None: that of space. See ``cells.kinds_of``.
        stress: of the mesh, where the solver computes it.
        num_substeps: that a solver took to come here from the frame before.
        num_corrected: nodes that containment put back in coming here from the frame before.
        num_asleep: nodes that a simulator left alone in coming here from the frame before.
        lost_impulse: momentum [kg m/s], in sum of magnitudes, that it took from them.
        internal: opaque part of a solver (deformation gradient, …), carried so that a restart equals a run-through. Stored frames lack it.
        periodicity: axes along which space repeats.
    """

    pos: Array
    vel: Array
    node_type: Array
    mass: Array
    material_params: Array
    boundary: Boundary
    gravity: Array
    velocity_history: Array | None = None
    time: float = 0.0
    rest_pos: Array | None = None
    cells: Array | None = None
    stress: Stress | None = None
    cell_dim: int | None = None
    num_substeps: int = 0
    num_corrected: int = 0
    num_asleep: int = 0
    lost_impulse: float = 0.0
    internal: Any = None
    periodicity: Periodicity = NOWHERE

    @property
    def num_nodes(self) -> int:
        return self.pos.shape[0]

    @property
    def dim(self) -> int:
        return self.pos.shape[1]

    def to_torch(self, device: Any = "cpu") -> State:
        """The same state as float64 tensors on a device (``internal`` is dropped: it belongs to a solver)."""
        import torch

        def tensor(x: Array) -> Any:
            if isinstance(x, np.ndarray):  # a copy: stored arrays may be read-only
                x = torch.from_numpy(x.astype(np.float64 if np.issubdtype(x.dtype, np.floating) else np.int64))
            return x.to(device, torch.float64 if x.is_floating_point() else torch.int64)

        b = self.boundary
        boundary = replace(b, **{name: tensor(getattr(b, name)) for name in ("pos", "vel", "normal", "friction", "restitution")})
        arrays = {name: tensor(getattr(self, name)) for name in ("pos", "vel", "node_type", "mass", "material_params", "gravity")}
        for name in ("velocity_history", "rest_pos", "cells"):
            value = getattr(self, name)
            arrays[name] = None if value is None else tensor(value)
        stress = None if self.stress is None else Stress(tensor(self.stress.node), tensor(self.stress.cell))
        return replace(self, **arrays, boundary=boundary, stress=stress, internal=None)


@dataclass(frozen=True)
class Metadata:
    """What is known about a trajectory besides its arrays. Lengths in m, times in s.

    Attributes:
        dataset: name of the data set.
        materials: every material that occurs anywhere in the data set (fixes the node types of all its graphs).
        param_names: column names of ``material_params``.
        frame_dt: time between stored frames.
        solver_dt: largest solver substep, 0 where there is none.
        spacing: rest spacing of neighbouring nodes.
        connectivity_radius: neighbour radius that sees what the solver's kernel sees.
        bounds: ``(low, high)`` per axis of the domain.
        periodic: per axis.
        gravity: external acceleration [m/s²].
        seed: seed of the scene, -1 where unknown.
        split: split that the trajectory belongs to.
        parameter_group: whether the material parameter is among the trained values (``seen``), between or outside them.
        solver, solver_version, config: provenance; ``config`` is JSON.
    """

    dataset: str
    materials: tuple[str, ...]
    param_names: tuple[str, ...]
    frame_dt: float
    spacing: float
    connectivity_radius: float
    bounds: tuple[tuple[float, float], ...]
    gravity: tuple[float, ...]
    periodic: tuple[bool, ...] = ()
    solver_dt: float = 0.0
    seed: int = -1
    split: str = ""
    parameter_group: str = "seen"
    solver: str = ""
    solver_version: str = ""
    config: str = "{}"

    def __post_init__(self) -> None:
        object.__setattr__(self, "materials", tuple(self.materials))
        object.__setattr__(self, "param_names", tuple(self.param_names))
        object.__setattr__(self, "bounds", tuple((float(a), float(b)) for a, b in self.bounds))
        object.__setattr__(self, "gravity", tuple(float(g) for g in self.gravity))
        object.__setattr__(self, "periodic", tuple(bool(p) for p in self.periodic) or (False,) * len(self.bounds))

    @property
    def dim(self) -> int:
        return len(self.bounds)

    @property
    def longest_side(self) -> float:
        """Extent of the domain [m] along its longest axis."""
        return max(high - low for low, high in self.bounds)

    @cached_property
    def periodicity(self) -> Periodicity:
        return Periodicity(self.bounds, self.periodic)

    def violations(self) -> Iterator[tuple[str, str]]:
        """Fields that describe no scene, each with what is wrong with it. Files may hold anything, so whoever reads one asks."""
        unknown = [name for name in self.materials if name not in MATERIALS]
        if unknown or not self.materials:
            yield "materials", f"names {unknown or 'nothing'}; known: {', '.join(MATERIALS)}"
        elif len(set(self.materials)) < len(self.materials):
            yield "materials", "names a material twice"
        elif self.param_names != param_names(self.materials):
            yield "param_names", f"is {self.param_names}, expected {param_names(self.materials)} for {self.materials}"
        for key in ("frame_dt", "spacing", "connectivity_radius"):
            if not 0 < getattr(self, key) < math.inf:
                yield key, f"is {getattr(self, key)}, must be positive"
        if not 0 <= self.solver_dt <= self.frame_dt * (1 + 1e-9):
            yield "solver_dt", f"is {self.solver_dt} s, must lie between 0 and frame_dt = {self.frame_dt} s"
        if self.dim not in (2, 3):
            yield "bounds", f"has {self.dim} axes, must have 2 or 3"
        for axis, (low, high) in enumerate(self.bounds):
            if not -math.inf < low < high < math.inf:
                yield "bounds", f"axis {axis}: low {low} must be below high {high}, both finite"
        for key in ("gravity", "periodic"):
            if len(getattr(self, key)) != self.dim:
                yield key, f"has {len(getattr(self, key))} components in {self.dim}D"
        if len(self.periodic) == self.dim:
            try:
                self.periodicity.check_radius(self.connectivity_radius)
            except PeriodicityError as error:
                yield "connectivity_radius", str(error)
        if not all(map(math.isfinite, self.gravity)):
            yield "gravity", f"is {self.gravity}, must be finite"


@dataclass(frozen=True)
class Termination:
    """Why a rollout stopped early: reason code, the first frame that is not good, and the node that shows it (-1: none in particular)."""

    reason: str
    frame: int
    node: int
    message: str


@dataclass(frozen=True)
class Trajectory:
    """Frames of one scene; NumPy arrays.

    Attributes:
        metadata: provenance and physical constants.
        pos, vel: [frame, node, dim] in m and m/s.
        node_type, mass: [node].
        material_params: [node, param].
        boundary: boundary nodes in the first frame; those that move have a motion of as many frames.
        rest_pos, cells, cell_dim: reference configuration of meshes, as in ``State``.
        stress: of the mesh in every frame.
        termination: set when a rollout stopped before its last frame.
        start_time: of the first frame, in s since the start of the scene.
        is_prediction: whether a rollout of anything but a ground-truth solver made it.
    """

    metadata: Metadata
    pos: np.ndarray
    vel: np.ndarray
    node_type: np.ndarray
    mass: np.ndarray
    material_params: np.ndarray
    boundary: Boundary
    rest_pos: np.ndarray | None = None
    cells: np.ndarray | None = None
    stress: Stress | None = None
    cell_dim: int | None = None
    termination: Termination | None = field(default=None, compare=False)
    start_time: float = field(default=0.0, compare=False)
    is_prediction: bool = field(default=False, compare=False)

    @classmethod
    def from_numpy(
        cls,
        pos: Array,
        frame_dt: float | int,
        materials: str | Sequence[str],
        params: Mapping[str, Array],
        *,
        vel: Array | None = None,
        mass: Array = 1.0,
        bounds: Array | None = None,
        periodic: Array | None = None,
        gravity: Array | None = None,
        spacing: float | int | None = None,
        connectivity_radius: float | int | None = None,
        boundary: Boundary | None = None,
        cells: Array | Mapping[str, Array] | None = None,
        rest_pos: Array | None = None,
        dataset: str = "arrays",
        split: str = "train",
    ) -> Trajectory:
        """A trajectory of your own arrays, checked.

        ``data.importers.save_dataset`` writes many of them as a data set that ``python -m gpe_pl.fit data=imported`` trains on.

        Args:
            pos: positions [frame, node, dim] in m of at least 3 frames. Along periodic axes they are folded into the domain. What is not float32 or
                float16 stays in double precision until it is stored.
            frame_dt: time between frames [s].
            materials: material of all nodes, or of each; names of ``schema.MATERIALS``.
            params: the parameter of each material that occurs, in the unit that ``schema.MATERIALS`` gives it: one value, or one per node of the trajectory.
            vel: velocities [frame, node, dim] in m/s; None takes the differences of positions. Models learn from positions only.
            mass: of all nodes or of each [kg]; only ratios matter to a model.
            bounds: ``(low, high)`` of the domain per axis [m]; None takes the extremes of all positions. Periodic axes need them.
            periodic: per axis whether space repeats; None: nowhere.
            gravity: external acceleration [dim] in m/s²; None: zero, and models learn it as any other force.
            spacing: rest spacing of neighbours [m]; None takes the median distance to the nearest node in the first frame.
            connectivity_radius: neighbour radius [m] that sees what acts on a node; None takes ``arrays.RADIUS_SPACINGS`` spacings.
            boundary: walls and obstacles, for example ``Boundary.sample(domain_walls(bounds, friction), spacing, dim)`` or ``Boundary.from_numpy(…)``.
                In periodic domains its nodes are folded like others, those that meet at a seam become one, and shapes have images.
            cells: nodes of each cell [cell, corner] of meshes of elastomers and solids, or such arrays by kind, ``{"quadrilateral": …, "triangle": …}``, where
                there are several or, with four corners in 3D, the shape does not tell quadrilaterals from tetrahedra. Kinds are those of
                ``schema.CELL_KINDS``, corners in VTK's order.
            rest_pos: undeformed positions [node, dim] of meshes in m; None takes those of the first frame.
            dataset, split: where the trajectory belongs; ``save_dataset`` overrides both.

        Raises:
            ArrayError: an argument that does not fit; names it, and frame and node where there is one.
        """
        pos = numbers("pos", pos, {"frame": None, "node": None, "dim": None})
        pos = pos.astype(np.float32 if pos.dtype in (np.float16, np.float32) else np.float64, copy=False)
        num_frames, num_nodes, dim = pos.shape
        if num_frames < 3 or num_nodes < 1 or dim not in (2, 3):
            raise ArrayError(f"pos [frame, node, dim] is {list(pos.shape)}: at least 3 frames, 1 node, and 2 or 3 dimensions are needed")
        frame_dt = positive("frame_dt", frame_dt, "seconds")
        boundary = Boundary.empty(dim) if boundary is None else boundary
        if boundary.pos.shape[1:] != (dim,):
            raise ArrayError(f"boundary: its positions are {list(boundary.pos.shape)}, expected [boundary_node, {dim}]")
        if boundary.motion is not None and boundary.motion.num_frames != num_frames:
            raise ArrayError(f"boundary: its motion has {boundary.motion.num_frames} frames, pos has {num_frames}")
        way = boundary.pos if boundary.motion is None else boundary.motion.pos.reshape(-1, dim)
        repeats = flags("periodic", periodic, dim)
        bounds = checked_bounds(bounds, repeats, pos, way)
        periodicity = Periodicity(bounds, repeats)
        _check_steps(boundary, frame_dt, periodicity)
        boundary = boundary.inside(periodicity)
        if periodicity:
            pos = np.stack([periodicity.wrapped(frame.astype(np.float64)).astype(pos.dtype) for frame in pos])
        codes, columns, names = checked_materials(materials, params, num_nodes)
        spacing = positive("spacing", typical_spacing(pos[0].astype(np.float64), periodicity) if spacing is None else spacing, "m")
        radius = positive("connectivity_radius", RADIUS_SPACINGS * spacing if connectivity_radius is None else connectivity_radius, "m")
        periodicity.check_radius(radius)
        vel = velocities_of(pos, frame_dt, periodicity) if vel is None else vel
        shape = {"frame": num_frames, "node": num_nodes, "dim": dim}
        gravity = numbers("gravity", np.zeros(dim) if gravity is None else gravity, {"dim": dim})
        cell_dim = None
        if cells is not None:
            cells, cell_dim = checked_cells(cells, codes, dim)
            rest_pos = numbers("rest_pos", pos[0] if rest_pos is None else rest_pos, {"node": num_nodes, "dim": dim}).astype(pos.dtype)
        elif rest_pos is not None:
            raise ArrayError("rest_pos: only meshes have rest positions; pass cells too, or leave it out")
        return cls(
            Metadata(
                dataset, names, param_names(names), frame_dt, spacing, radius, bounds, tuple(map(float, gravity)),
                periodicity.periodic, split=split, solver="import", solver_version="1",
            ),
            pos,
            numbers("vel", vel, shape).astype(np.float32, copy=False),
            codes,
            per_node("mass", mass, (num_nodes,), low=float(np.finfo(np.float32).tiny)),
            columns,
            boundary,
            rest_pos=rest_pos,
            cells=cells,
            cell_dim=cell_dim,
        )  # fmt: skip

    @property
    def num_frames(self) -> int:
        return self.pos.shape[0]

    @property
    def num_nodes(self) -> int:
        return self.pos.shape[1]

    def state(self, frame: int, history: int = 0) -> State:
        """The state at a frame.

        With ``history`` > 0 the velocities are those of a learned simulator: differences of the last ``history + 1`` stored positions in
        float64. Without it they are the stored ones.

        Raises:
            IndexError: ``frame`` is out of range, or lacks ``history`` frames before it.
        """
        if not history <= frame < self.num_frames:
            raise IndexError(f"frame {frame} with history {history} is outside the {self.num_frames} frames of this trajectory")
        gravity = np.asarray(self.metadata.gravity)
        pos, vel, past = self.pos[frame].astype(np.float64), self.vel[frame].astype(np.float64), None
        if history:
            window = self.pos[frame - history : frame + 1].astype(np.float64)
            past = np.ascontiguousarray(integrators.velocities(window, self.metadata.frame_dt, self.metadata.periodicity).swapaxes(0, 1))
            vel = past[:, -1]
        rest_pos = None if self.rest_pos is None else self.rest_pos.astype(np.float64)
        stress = None if self.stress is None else Stress(self.stress.node[frame], self.stress.cell[frame])
        return State(
            pos, vel, self.node_type, self.mass, self.material_params, self.boundary.at(frame), gravity, past,
            self.start_time + frame * self.metadata.frame_dt, rest_pos, self.cells, stress, self.cell_dim, periodicity=self.metadata.periodicity,
        )  # fmt: skip

    def seen_from(self, origin: np.ndarray) -> Trajectory:
        """The same in coordinates whose origin is at ``origin`` [dim] in m; stored positions should be near theirs, since float32 is fine near 0 only."""
        b, m = self.boundary, self.metadata
        rest_pos = self.rest_pos
        if rest_pos is not None:  # only their differences matter, so they may have an origin of their own already
            rest_pos = np.where(np.abs(rest_pos - origin).max(axis=0) < np.abs(rest_pos).max(axis=0), rest_pos - origin, rest_pos)
        bounds = tuple((low - x, high - x) for (low, high), x in zip(m.bounds, origin.tolist(), strict=True))
        motion = None if b.motion is None else replace(b.motion, pos=b.motion.pos - origin)
        boundary = replace(b, pos=b.pos - origin, shapes=tuple(moved(shape, -origin) for shape in b.shapes), motion=motion)
        return replace(self, metadata=replace(m, bounds=bounds), pos=self.pos - origin, boundary=boundary, rest_pos=rest_pos)

    def frames(self, start: int, stop: int | None = None) -> Trajectory:
        """The frames ``start:stop`` as a trajectory of their own."""
        stress = None if self.stress is None else Stress(self.stress.node[start:stop], self.stress.cell[start:stop])
        first, _, _ = slice(start, stop).indices(self.num_frames)
        return replace(
            self,
            pos=self.pos[start:stop],
            vel=self.vel[start:stop],
            boundary=self.boundary.at(start, stop),
            stress=stress,
            start_time=self.start_time + first * self.metadata.frame_dt,
        )

    def with_moving_boundary(self) -> Trajectory:
        """For pictures and other programs: boundary nodes that move in a prescribed way as further nodes, of type ``boundary``, after the others.

        The same object if none does.
        """
        motion = self.boundary.motion
        if motion is None:
            return self
        moves = (motion.pos != motion.pos[0]).any(axis=(0, 2))
        count, still = int(moves.sum()), ~moves

        def extended(values: np.ndarray, more: Any) -> np.ndarray:
            return np.concatenate([values, np.broadcast_to(more, (count, *values.shape[1:])).astype(values.dtype)])

        b, way, stress = self.boundary, motion.frames(0, self.num_frames), self.stress
        if stress is not None:
            stress = Stress(np.pad(stress.node, ((0, 0), (0, count), (0, 0))), stress.cell)
        return replace(
            self,
            pos=np.concatenate([self.pos, way.pos[:, moves].astype(self.pos.dtype)], axis=1),
            vel=np.concatenate([self.vel, way.vel[:, moves].astype(self.vel.dtype)], axis=1),
            node_type=extended(self.node_type, node_code(BOUNDARY)),
            mass=extended(self.mass, 0.0),
            material_params=extended(self.material_params, np.nan),
            boundary=Boundary(b.pos[still], b.vel[still], b.normal[still], b.friction[still], b.restitution[still], b.shapes),
            rest_pos=None if self.rest_pos is None else np.concatenate([self.rest_pos, motion.pos[0, moves].astype(self.rest_pos.dtype)]),
            stress=stress,
        )
