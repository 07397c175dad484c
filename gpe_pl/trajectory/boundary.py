"""``Boundary``: walls and obstacles as nodes with a boundary condition, and the ``Motion`` that may be prescribed for them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.geometry.repeated_shapes import is_covered, repeated
from gpe_pl.geometry.shapes import Shape, surface_tolerance
from gpe_pl.schema import STICKY
from gpe_pl.trajectory.arrays import ArrayError, numbers, per_node, positive
from gpe_pl.trajectory.kinds import NODE, SCENE, names_of
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

    def take(self, nodes: np.ndarray) -> Motion:
        """Return the motion of some boundary nodes: row numbers, or a mask."""
        return Motion(self.pos[:, nodes], self.vel[:, nodes], self.normal[:, nodes])


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

    pos: Array = field(metadata=NODE)
    vel: Array = field(metadata=NODE)
    normal: Array = field(metadata=NODE)
    friction: Array = field(metadata=NODE)
    restitution: Array = field(metadata=NODE)
    shapes: tuple[Shape, ...] = field(default=(), metadata=SCENE)
    motion: Motion | None = field(default=None, metadata=SCENE)

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
        return replace(replace(self, pos=pos).take(kept), shapes=shapes)

    def take(self, nodes: Array) -> Boundary:
        """Return some of the boundary nodes, with their motion and all shapes: row numbers, or a mask [boundary_node]."""
        values = {name: getattr(self, name)[nodes] for name in names_of(self, NODE)}
        return replace(self, **values, motion=None if self.motion is None else self.motion.take(nodes))

    def to_numpy(self) -> Boundary:
        """The same with NumPy arrays of its own."""
        values: dict[str, Any] = {name: np.array(as_numpy(getattr(self, name))) for name in names_of(self, NODE)}
        return replace(self, **values)

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

    points = np.ascontiguousarray(as_numpy(pos))
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


def check_steps(boundary: Boundary, frame_dt: float, periodicity: Periodicity) -> None:
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


def as_numpy(x: Array) -> np.ndarray:
    """Return an array or tensor as a NumPy array, without a copy where that is possible."""
    return x if isinstance(x, np.ndarray) else x.detach().cpu().numpy()
