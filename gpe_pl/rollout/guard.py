"""``Guard``: limits beyond which a rollout stops, and the check of its initial state."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import no_type_check

import numpy as np
from array_api_compat import array_namespace
from numba import njit

from gpe_pl.geometry.compiled_distance import has_compiled_distance
from gpe_pl.geometry.compiled_surfaces import are_near
from gpe_pl.geometry.shape_values import shapes_fault
from gpe_pl.geometry.shapes import Shape, signed_distance
from gpe_pl.schema import LARGEST, NODE_TYPES
from gpe_pl.trajectory.boundary import as_numpy
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Termination
from gpe_pl.trajectory.values import faults, size_conflicts

CROWDING_LIMIT = 32
"""A rollout stops with the reason ``clustering`` if more nodes than this share a cell of side ``spacing``. ``Guard.of`` raises this limit for starts that are
nearly as dense."""
FINEST = 0.01
"""Nodes that share a cell of this width count as coincident [rest spacings]. If too many nodes of a start coincide, its limit on crowding is not raised."""
TUNNEL_DEPTH = 0.25
"""Depth in a wall or obstacle up to which a path between two frames does not count as going through it [rest spacings]."""
MAX_PATH_SAMPLES = 4096
"""Maximum number of samples of a path. Paths longer than this many eighths of a spacing are sampled more coarsely."""
NUM_BISECTIONS = 20
"""Number of bisections that find where the path of a node crosses a surface."""
SUSPECTS_AT_ONCE = 1000
"""Number of nodes whose paths are sampled together. All have as many samples as the fastest of them needs."""


@dataclass(frozen=True)
class Guard:
    """Limits beyond which a rollout stops.

    Attributes:
        max_speed: maximum speed of nodes [m/s].
        bounds: ``(low, high)`` per axis of the domain [m].
        margin: distance [m] by which nodes may leave the bounds, and depth [m] that they may have in a wall or obstacle. 0 switches the limit of the depth off.
        spacing: rest spacing of nodes [m]. It is needed to detect clouds that collapse, nodes that pass through an obstacle within one frame, and nodes too
            deep in one; 0 switches these checks off.
        max_crowding: maximum number of nodes in a cell of side ``spacing``.
    """

    max_speed: float = math.inf
    bounds: tuple[tuple[float, float], ...] = ()
    margin: float = 0.0
    spacing: float = 0.0
    max_crowding: int = CROWDING_LIMIT

    def __post_init__(self) -> None:
        sound = self.max_speed > 0 and self.margin >= 0 and 0 <= self.spacing < math.inf  # NaN fails all comparisons
        if not (sound and all(low < high for low, high in self.bounds)):
            raise ValueError(f"guard limits must be positive, and bounds (low, high), got {self}")

    def check(self, state: State, frame: int, before: State | None = None) -> Termination | None:
        """Return the reason why a rollout has to stop at a state, or None if no limit is violated.

        Args:
            state: new state.
            frame: its frame number, for the result.
            before: the state one frame earlier, to detect paths through obstacles; None skips this.
        """
        if state.num_nodes == 0:
            return None
        if not self._is_far_from_limits(state):
            found = self._not_finite(state, frame) or self._escape(state, frame) or self._explosion(state, frame)
            if found is None and self.spacing > 0:
                found = self._clustering(state, frame)
            if found is not None:
                return found
        return self._tunnelling(before, state, frame) if self.spacing > 0 else None

    def _is_far_from_limits(self, state: State) -> bool:
        """Tell in one compiled pass whether no node can be beyond a limit of its own. If not, the checks one by one find the limit and the node."""
        low, high = self._box
        pos, vel = (np.ascontiguousarray(as_numpy(x), np.float64) for x in (state.pos, state.vel))
        within: bool = _within(pos, vel, low, high, self.max_speed**2, self.spacing, self.max_crowding)
        others = [x for x in (state.frame_velocity, state.stress.node if state.stress is not None else None) if x is not None]
        return within and all(bool(np.isfinite(as_numpy(x)).all()) for x in others)

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [axis] of the box that nodes may not leave [m]."""
        bounds = np.array(self.bounds or ((-math.inf, math.inf),) * 3, dtype=np.float64)
        return bounds[:, 0] - self.margin, bounds[:, 1] + self.margin

    def _not_finite(self, state: State, frame: int) -> Termination | None:
        xp = array_namespace(state.pos)
        finite = xp.all(xp.isfinite(state.pos) & xp.isfinite(state.vel), axis=-1)
        if state.frame_velocity is not None:
            finite = finite & xp.all(xp.isfinite(state.frame_velocity), axis=-1)
        if state.stress is not None:
            finite = finite & xp.all(xp.isfinite(state.stress.node), axis=-1)
        if bool(xp.all(finite)):
            return None
        node = int(xp.argmax(xp.astype(~finite, xp.int8)))
        return _stopped("nan", frame, state, node, "has a position, velocity or stress that is not finite")

    def _escape(self, state: State, frame: int) -> Termination | None:
        xp = array_namespace(state.pos)
        for axis, (low, high) in enumerate(self.bounds):
            outside = xp.maximum(low - state.pos[:, axis], state.pos[:, axis] - high)
            if float(xp.max(outside)) > self.margin:
                node = int(xp.argmax(outside))
                return _stopped("escape", frame, state, node, f"is {float(outside[node]):.3g} m outside the domain")
        return None

    def _explosion(self, state: State, frame: int) -> Termination | None:
        if not math.isfinite(self.max_speed):
            return None
        xp = array_namespace(state.pos)
        speed = xp.sqrt(xp.sum(state.vel * state.vel, axis=-1))
        if float(xp.max(speed)) <= self.max_speed:
            return None
        node = int(xp.argmax(speed))
        return _stopped("explosion", frame, state, node, f"moves at {float(speed[node]):.3g} m/s, limit {self.max_speed:.3g} m/s")

    def _clustering(self, state: State, frame: int) -> Termination | None:
        counts = crowding(as_numpy(state.pos), self.spacing)
        if counts.max() <= self.max_crowding:
            return None
        node = int(np.argmax(counts))
        text = f"shares a box as wide as the spacing with {counts.max() - 1} others, limit {self.max_crowding}"
        return _stopped("clustering", frame, state, node, text)

    def _tunnelling(self, before: State | None, state: State, frame: int) -> Termination | None:
        """Find nodes deeper than ``margin`` in a wall or obstacle, and nodes that passed through one: outside in both frames, but inside on the way."""
        shapes, end = state.boundary.shapes, as_numpy(state.pos)
        if not shapes or self._is_far_from_tunnelling(before, state):
            return None
        distance = signed_distance(shapes, end)
        node = int(np.argmin(distance))
        if 0 < self.margin < -distance[node]:
            return _stopped("tunnelling", frame, state, node, f"is {-distance[node]:.3g} m deep in a wall or obstacle")
        if before is None:
            return None
        start, tolerance = _starts(before, state), TUNNEL_DEPTH * self.spacing
        way = state.periodicity.shortest(end - start)
        length = np.sqrt(np.einsum("nd,nd->n", way, way))
        if not length.max() > 2 * tolerance:
            return None
        clearance, depth = signed_distance(shapes, start), -distance
        suspects = np.flatnonzero((length > clearance) & (length > 2 * tolerance) & (clearance > -tolerance) & (depth < tolerance))
        suspects = suspects[np.argsort(length[suspects])]
        deepest = np.zeros(len(end))
        for some in np.array_split(suspects, max(1, len(suspects) // SUSPECTS_AT_ONCE)):
            count = min(MAX_PATH_SAMPLES, math.ceil(float(length[some].max(initial=0.0)) / (0.5 * tolerance)))
            deepest[some] = _depth_through(shapes, start[some], way[some], count, tolerance)
        node = int(np.argmax(deepest))
        if not deepest[node] > tolerance:
            return None
        return _stopped("tunnelling", frame, state, node, f"went {deepest[node]:.3g} m deep through a wall or obstacle within one frame")

    def _is_far_from_tunnelling(self, before: State | None, state: State) -> bool:
        """Tell in one compiled pass whether no node can have tunnelled: none is deep in a shape, and none has moved farther than through a thin wall."""
        shapes = state.boundary.shapes
        if state.periodicity or not has_compiled_distance(shapes):
            return False
        pos = np.ascontiguousarray(as_numpy(state.pos), np.float64)
        start = pos if before is None else np.ascontiguousarray(_starts(before, state), np.float64)
        deepest = self.margin if self.margin > 0 else math.inf
        return are_near(shapes, start, pos, 2 * TUNNEL_DEPTH * self.spacing, deepest)

    def of(self, start: State) -> Guard:
        """Return the guard for a rollout from a state, which may be denser than usual.

        ``max_crowding`` is raised to twice the number of nodes in the densest cell of the state, if that is more. The guard is returned unchanged if more than
        ``max_crowding`` nodes coincide (see ``FINEST``), if ``spacing`` is 0, or if the state is empty or not finite.
        """
        if self.spacing == 0 or start.num_nodes == 0 or self._not_finite(start, 0) is not None:
            return self
        pos = as_numpy(start.pos)
        if crowding(pos, FINEST * self.spacing).max() > self.max_crowding:
            return self
        return replace(self, max_crowding=max(self.max_crowding, 2 * int(crowding(pos, self.spacing).max())))


def _stopped(reason: str, frame: int, state: State, row: int, what: str) -> Termination:
    """Return the reason for a stop that the node in a row shows."""
    node = state.identity(row)
    return Termination(reason, frame, node, f"frame {frame}: node {node} {what}")


def _starts(before: State, state: State) -> np.ndarray:
    """Return the position of each node one frame earlier [node, dim] in m. Nodes that entered in between have their present position."""
    if state.node_id is None or before.node_id is None:
        return as_numpy(before.pos)
    start, earlier, now = np.array(as_numpy(state.pos)), as_numpy(before.node_id), as_numpy(state.node_id)
    was_there = np.isin(now, earlier)
    start[was_there] = as_numpy(before.pos)[np.searchsorted(earlier, now[was_there])]
    return start


def _depth_through(shapes: tuple[Shape, ...], start: np.ndarray, way: np.ndarray, count: int, tolerance: float) -> np.ndarray:
    """Return the largest depth [m] in shapes of the straight ways that go through one; 0 for other ways.

    A way goes through if it is deeper than ``tolerance`` and leaves by a face that is turned by more than 90° from the one where it enters. Other ways cut a
    corner, around which a node may have moved between the frames. A way that is inside several times has to go through once.

    Args:
        shapes: walls and obstacles.
        start: starts [node, dim] in m.
        way: displacements [node, dim] in m.
        count: number of parts into which ways are divided.
        tolerance: depth [m].
    """
    if count < 2:
        return np.zeros(len(start))
    depth = np.stack([-signed_distance(shapes, start + k / count * way) for k in range(1, count)])
    deep = np.flatnonzero(depth.max(axis=0) > tolerance)
    found, inside = np.zeros(len(start)), np.zeros((len(deep), count + 1), bool)
    inside[:, 1:-1] = depth[:, deep].T > 0
    change = np.diff(inside.astype(np.int8), axis=1)
    # of each stretch inside: number of its way, the sample before it, its last sample
    (number, before), (_, last) = np.nonzero(change == 1), np.nonzero(change == -1)
    enters, leaves = (
        _normals_at_surface(shapes, start[deep[number]], way[deep[number]], out / count, within / count)
        for out, within in ((before, before + 1), (last + 1, last))
    )
    deepest = np.array([depth[a:b, deep[k]].max() for k, a, b in zip(number, before, last, strict=True)])
    through = (np.einsum("nd,nd->n", enters, leaves) < 0) & (deepest > tolerance)
    np.maximum.at(found, deep[number[through]], deepest[through])
    return found


def _normals_at_surface(shapes: tuple[Shape, ...], start: np.ndarray, way: np.ndarray, out: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Return the normals [node, dim] where ways cross the surface of shapes, between fractions [node] of the way that are out of and within a shape."""
    for _ in range(NUM_BISECTIONS):
        middle = 0.5 * (out + within)
        is_within = signed_distance(shapes, start + middle[:, None] * way) < 0
        out, within = np.where(is_within, out, middle), np.where(is_within, middle, within)
    at = start + within[:, None] * way
    ways = 1e-4 * np.linalg.norm(way, axis=1).min(initial=1.0) * np.eye(start.shape[1])
    difference = np.stack([signed_distance(shapes, at + step) - signed_distance(shapes, at - step) for step in ways], axis=1)
    return np.asarray(difference / ways[0, 0])


@njit(cache=True, error_model="numpy")
@no_type_check
def _within(pos, vel, low, high, squared_speed, spacing, max_crowding):
    """Return whether all nodes are finite, between ``low`` and ``high``, not too fast, and surely not too many in a cell of side ``spacing``.

    Cells that share an entry of a small table count as one, so their number of nodes is at least that of each of them.
    """
    num_nodes, dim = pos.shape
    size = 64
    while size < 4 * num_nodes:
        size *= 2
    crowd = np.zeros(size if spacing > 0 else 1, np.int32)
    for n in range(num_nodes):
        squared, key = 0.0, np.int64(0)
        for a in range(dim):
            x, v = pos[n, a], vel[n, a]
            if not (low[a] <= x <= high[a] and abs(x) < math.inf):
                return False
            squared += v * v
            if spacing > 0:
                place = x / spacing
                if not abs(place) < 2.0**53:
                    return False
                key = key * 92_837_111 + np.int64(math.floor(place))
        if not (squared <= squared_speed and squared < math.inf):
            return False
        if spacing > 0:
            entry = (key ^ (key >> 17)) & (size - 1)
            crowd[entry] += 1
            if crowd[entry] > max_crowding:
                return False
    return True


def crowding(pos: np.ndarray, width: float) -> np.ndarray:
    """Return for every node [node] the number of nodes in its cell of a grid of this width [m].

    Cells are told apart by a hash value. Very rarely, two cells have the same value and count as one.
    """
    primes = np.array([73_856_093, 19_349_663, 83_492_791])[: pos.shape[1]]  # spatial hash [Teschner et al. 2003]; products may overflow
    _, box, counts = np.unique(np.floor(pos / width).astype(np.int64) @ primes, return_inverse=True, return_counts=True)
    return counts[box]


def unsound(state: State, metadata: Metadata) -> Termination | None:
    """Return the reason why a rollout cannot start: the first array or shape of the initial state that breaks its rule. Return None if there is none.

    The rules are those of ``schema.FIELDS`` and ``shape_values.shapes_fault``. Gravity, velocity history and velocities at the frame must have their shapes, be
    finite and be at most ``schema.LARGEST``.
    """
    b, has_mesh = state.boundary, state.cells is not None and state.rest_pos is not None
    nodes = {
        "node_type": state.node_type,
        "mass": state.mass,
        "material_params": state.material_params,
        "pos": state.pos[None],
        "vel": state.vel[None],
        **({"rest_pos": state.rest_pos, "cells": state.cells} if has_mesh else {}),
    }
    conditions = {"boundary_friction": b.friction, "boundary_restitution": b.restitution}
    walls = {"boundary_pos": b.pos[None], "boundary_vel": b.vel[None], "boundary_normal": b.normal[None], **conditions}
    m = b.motion
    path = {} if m is None else {"boundary_pos": m.pos, "boundary_vel": m.vel, "boundary_normal": m.normal, **conditions}
    for part in (nodes, walls, path):
        arrays = {key: as_numpy(value) for key, value in part.items()}
        for conflict in size_conflicts(arrays, metadata.dim, len(metadata.param_names)):
            return Termination("input", 0, -1, conflict)
        for fault in faults(arrays, NODE_TYPES, metadata.materials, metadata.param_names):
            reason = {"pos": "nan", "vel": "nan", "material_params": "material"}.get(fault.field, "input")
            return Termination(reason, 0, fault.index("node"), str(fault))
    num_nodes, dim = len(state.pos), metadata.dim
    for name, shape in {"gravity": (dim,), "velocity_history": (num_nodes, -1, dim), "frame_velocity": (num_nodes, dim)}.items():
        values = getattr(state, name)
        if values is None:
            continue
        if values.ndim != len(shape) or any(size not in (-1, found) for size, found in zip(shape, values.shape, strict=True)):
            wanted = ", ".join("any" if size == -1 else str(size) for size in shape)
            return Termination("input", 0, -1, f"{name} has the shape {tuple(values.shape)}, must be ({wanted})")
        if not (np.abs(as_numpy(values)) <= LARGEST).all():  # also finds NaN
            return Termination("nan", 0, -1, f"{name} is not finite or too large")
    if (wrong := shapes_fault(b.shapes, metadata.periodicity)) is not None:
        return Termination("input", 0, -1, wrong)
    return None
