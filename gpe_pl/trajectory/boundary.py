"""``Boundary``: walls and obstacles as nodes with a boundary condition. ``BoundaryMotion``: how those nodes move."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.geometry.repeated_shapes import is_covered, repeated
from gpe_pl.geometry.shape_values import shape_fault
from gpe_pl.geometry.shapes import Shape, surface_tolerance
from gpe_pl.schema import STICKY
from gpe_pl.trajectory.arrays import ArrayError, nearest_distances, numbers, per_node, positive
from gpe_pl.trajectory.kinds import NODE, SCENE, names_of
from gpe_pl.trajectory.rigid_parts import carried_along

Array = Any
"""A NumPy array or a torch tensor."""

UNLIKE = 0.05
"""Relative difference from which velocities of a boundary are not those of its positions."""


@dataclass(frozen=True)
class BoundaryMotion:
    """Prescribed motion of boundary nodes from the current frame on, as NumPy arrays [frame, boundary_node, dim].

    Attributes:
        pos: positions in m.
        vel: velocities in m/s that take the nodes to the next frame.
        normal: unit normals into free space.
    """

    pos: np.ndarray
    vel: np.ndarray
    normal: np.ndarray

    @property
    def num_frames(self) -> int:
        return len(self.pos)

    def frames(self, start: int, stop: int | None = None) -> BoundaryMotion:
        """Return the motion in the frames ``start:stop``."""
        return BoundaryMotion(self.pos[start:stop], self.vel[start:stop], self.normal[start:stop])

    def every(self, stride: int) -> BoundaryMotion:
        """Return every ``stride``-th frame from the first on. A velocity is the mean from its frame to the next returned frame."""
        first = np.arange(0, self.num_frames, stride)
        count = np.minimum(first + stride, self.num_frames) - first
        vel = np.add.reduceat(self.vel, first, axis=0) / count[:, None, None]
        return BoundaryMotion(self.pos[::stride], vel.astype(self.vel.dtype), self.normal[::stride])

    def take(self, nodes: np.ndarray) -> BoundaryMotion:
        """Return the motion of some boundary nodes, given by row numbers or a mask."""
        return BoundaryMotion(self.pos[:, nodes], self.vel[:, nodes], self.normal[:, nodes])


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
        motion: prescribed motion, None if all nodes stay in place; its first frame equals ``pos``, ``vel`` and ``normal``.
    """

    pos: Array = field(metadata=NODE)
    vel: Array = field(metadata=NODE)
    normal: Array = field(metadata=NODE)
    friction: Array = field(metadata=NODE)
    restitution: Array = field(metadata=NODE)
    shapes: tuple[Shape, ...] = field(default=(), metadata=SCENE)
    motion: BoundaryMotion | None = field(default=None, metadata=SCENE)

    @classmethod
    def sample(cls, shapes: tuple[Shape, ...], spacing: float, dim: int, periodicity: Periodicity = NOWHERE) -> Boundary:
        """Return a boundary of nodes on the surfaces of shapes and of their periodic images, about ``spacing`` [m] apart.

        Nodes inside another shape are left out.

        Raises:
            ArrayError: a shape breaks a rule of ``shape_values.shapes_fault``, or ``spacing`` is not positive. The message has the number of the shape.
            SamplingError: there would be too many nodes.
        """
        positive("spacing", spacing, "m")
        for number, shape in enumerate(shapes):
            if wrong := shape_fault(shape, dim):
                raise ArrayError(f"shape {number} ({shape.kind}): {wrong}")
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
        """Return a boundary without nodes."""
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
        """Return a boundary given by points on walls and obstacles. If normals are not known, see ``arrays.estimated_normals``.

        Args:
            pos: positions [boundary_node, dim] in m, about as far apart as particles.
            normal: directions into free space [boundary_node, dim], of any length.
            vel: velocity in m/s of walls that slide along themselves: one for all nodes [dim] or one per node [boundary_node, dim].
            friction: Coulomb coefficient, one for all nodes or one per node; ``schema.STICKY`` is no-slip.
            restitution: fraction of the normal velocity that a bounce returns, one for all nodes or one per node.
            shapes: geometry of all walls, if known; containment and the elastic law use it instead of the points.

        Raises:
            ArrayError: an array has the wrong shape, a number is not finite or out of range, or a normal has length 0. The message names the node.
        """
        pos = numbers("boundary pos", pos, {"boundary_node": None, "dim": None})
        pos = pos.astype(np.result_type(pos, np.float32), copy=False)  # wrapping integers would round the bounds
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
        """Return a boundary with a prescribed motion, such as a gripper, piston or paddle, in the first frame of the motion.

        Args:
            pos: positions [frame, boundary_node, dim] in m, with as many frames as the trajectory.
            normal: directions into free space, of any length. Give those of every frame [frame, boundary_node, dim], or those of the first frame
                [boundary_node, dim]; these turn with the rigid parts found in the motion (``rigid_parts``).
            frame_dt: time between frames [s].
            friction, restitution: as in ``from_numpy``.
            periodicity: axes along which space repeats.

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
        return replace(first, motion=BoundaryMotion(inside, vel, normals)).at(0)

    def inside(self, periodicity: Periodicity) -> Boundary:
        """Return this boundary with its nodes and shapes adapted to a periodic domain; the same object if no axis is periodic. Arrays must be NumPy arrays.

        Nodes are wrapped into the domain. If nodes with the same normal coincide, only one is kept. Nodes inside an image of a shape are left out. Shapes get
        their periodic images.
        """
        if not periodicity:
            return self
        pos, motion = periodicity.wrapped(self.pos), self.motion
        close = 1e-6 * float(periodicity.period[list(periodicity.axes)].min())
        j, i = search_tree(pos, periodicity).query_pairs(close, output_type="ndarray").reshape(-1, 2).T
        same = (self.normal[i] * self.normal[j]).sum(axis=1) > 0.999  # two walls that meet in a corner both keep their node
        if motion is not None:
            same &= (np.abs(periodicity.shortest(motion.pos[:, i] - motion.pos[:, j])) <= close).all(axis=(0, 2))
            same &= ((motion.normal[:, i] * motion.normal[:, j]).sum(axis=2) > 0.999).all(axis=0)
        shapes = repeated(self.shapes, periodicity)
        free = ~is_covered(self.pos, self.normal, self.shapes, shapes)
        kept = np.setdiff1d(np.flatnonzero(free), i[same])
        return replace(replace(self, pos=pos).take(kept), shapes=shapes)

    def take(self, nodes: Array) -> Boundary:
        """Return some of the boundary nodes, with their motion and all shapes; ``nodes`` are row numbers or a mask [boundary_node]."""
        values = {name: getattr(self, name)[nodes] for name in names_of(self, NODE)}
        return replace(self, **values, motion=None if self.motion is None else self.motion.take(nodes))

    def to_numpy(self) -> Boundary:
        """Return a copy with NumPy arrays."""
        values: dict[str, Any] = {name: np.array(as_numpy(getattr(self, name))) for name in names_of(self, NODE)}
        return replace(self, **values)

    def at(self, frame: int, stop: int | None = None) -> Boundary:
        """Return the boundary ``frame`` frames later; the same object if it has no motion.

        Its remaining motion ends before the frame ``stop``, counted from now; None keeps all of it. After the last frame of its motion, the boundary stays in
        place with zero velocity.
        """
        if self.motion is None:
            return self
        xp, motion = array_namespace(self.pos), self.motion.frames(min(frame, self.motion.num_frames - 1), stop)

        def like(x: np.ndarray) -> Array:
            return x if isinstance(self.pos, np.ndarray) else xp.asarray(np.array(x), dtype=self.pos.dtype, device=self.pos.device)

        now = replace(self, pos=like(motion.pos[0]), vel=like(motion.vel[0]), normal=like(motion.normal[0]), motion=motion)
        return now if frame < self.motion.num_frames else replace(now, vel=0.0 * now.vel, motion=None)

    def every(self, stride: int) -> Boundary:
        """Return the boundary with every ``stride``-th frame of its motion; the same object if it has none."""
        return self if self.motion is None else replace(self, motion=self.motion.every(stride)).at(0)

    def tree(self, periodicity: Periodicity) -> Any:
        """Return ``search_tree`` of the positions. It is cached."""
        return self.made_once(periodicity, lambda: search_tree(self.pos, periodicity))

    def made_once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return ``make()``, computed at the first call with this key and then cached with the boundary.

        Changes in place that PyTorch counts, such as ``pos[:, 1] += 0.1``, empty the cache. Others are not seen: those of arrays, through ``pos.data``, and of
        tensors of inference mode.
        """
        versions = [_version(x) for x in (self.pos, self.vel, self.normal)]
        kept: dict[Hashable, Any]
        found, kept = self.__dict__.setdefault("_made", (versions, {}))  # not a field, so neither compared nor stored
        if found != versions:
            kept = {}
            self.__dict__["_made"] = versions, kept
        if key not in kept:
            kept[key] = make()
        return kept[key]


def _version(x: Array) -> int:
    """Return how often a tensor was changed in place; 0 for arrays, and for tensors whose changes are not counted."""
    return 0 if isinstance(x, np.ndarray) or x.is_inference() else int(x._version)


def search_tree(pos: Array, periodicity: Periodicity = NOWHERE) -> Any:
    """Return a k-d tree of positions [node, dim] for neighbour search on the CPU.

    Moving nodes need a new tree in every step, so its options make it quick to build.
    """
    from scipy.spatial import cKDTree

    points = np.ascontiguousarray(as_numpy(pos))
    if not periodicity:
        return cKDTree(points, balanced_tree=False, compact_nodes=False)
    return cKDTree(periodicity.from_corner(points), balanced_tree=False, compact_nodes=False, boxsize=periodicity.period)


def _unit(normal: np.ndarray) -> np.ndarray:
    """Return directions [..., boundary_node, dim] scaled to length 1."""
    length = np.linalg.norm(normal.astype(np.float64), axis=-1, keepdims=True)
    if (length == 0).any():
        *frame, node, _ = np.argwhere(length == 0)[0].tolist()
        where = f"frame {frame[0]}, " if frame else ""
        raise ArrayError(f"boundary normal: {where}boundary_node {node} has length 0; it must point into free space", *frame)
    return np.asarray(normal / length)


def has_nodes_beside_shapes(boundary: Boundary) -> bool:
    """Return whether a boundary has shapes, and nodes that belong to none of them."""
    return bool(boundary.shapes) and bool(nodes_beside_shapes(boundary).any())


def nodes_beside_shapes(boundary: Boundary) -> np.ndarray:
    """Return a mask [boundary_node] of nodes that are farther from the surfaces of all shapes than half the usual distance of nodes."""
    if not boundary.shapes or not len(boundary.pos):
        return np.ones(len(boundary.pos), bool)
    pos = as_numpy(boundary.pos).astype(np.float64)
    distance = np.min([np.abs(shape.signed_distance(pos)) for shape in boundary.shapes], axis=0)
    apart = float(np.median(nearest_distances(pos)))
    return np.asarray(distance > max(0.5 * apart, 1e-3 * float(np.ptp(pos, axis=0).max())))


def check_steps(boundary: Boundary, frame_dt: float, periodicity: Periodicity) -> None:
    """Raise ``ArrayError`` if velocities of the boundary are not those of its positions at ``frame_dt``.

    The same if a boundary node moves by more than half a period between frames, which means that its motion ignores the periodicity.
    """
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
    steps = periodicity.shortest(np.diff(boundary.motion.pos.astype(np.float64), axis=0))
    ratio = np.sum(boundary.motion.vel[:-1] * frame_dt * steps) / max(np.sum(steps**2), np.finfo(float).tiny)
    if steps.any() and abs(ratio - 1) > UNLIKE:
        raise ArrayError(
            f"boundary: its velocities are {ratio:.3g} times those of its positions, whose frames are {frame_dt:g} s apart; pass the same frame_dt to "
            "Boundary.moving"
        )


def as_numpy(x: Array) -> np.ndarray:
    """Return an array or tensor as a NumPy array, without a copy if possible."""
    return x if isinstance(x, np.ndarray) else x.detach().cpu().numpy()
