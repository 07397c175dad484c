"""Points that end inside shapes, and the nearest surface of points near shapes, in one compiled pass each.

``rollout.containment`` and ``graphs.contacts`` compute the same with the methods of the shapes, for shapes and arrays that these passes do not cover.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit

from gpe_pl.geometry.compiled_distance import distance_to, nearest_of, packed_shapes, write_normal

NUM_PASSES = 4
"""Number of passes over all shapes that bring a point out of them: corners need a pass per surface."""
FACING = -0.9
"""A point on the surfaces of two shapes is between them, as under a box that stands on the floor, if the product of their normals is below this."""


def put_back(
    shapes: tuple[Any, ...], pos: np.ndarray, vel: np.ndarray, dt: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return positions [node, dim] without nodes deeper than ``tolerance`` [m] in a shape or between two, as ``containment.contain``; None without such nodes.

    Args:
        shapes: shapes that ``packed_shapes`` knows.
        pos: positions after a step [node, dim] in m.
        vel: velocities of the step [node, dim] in m/s.
        dt: frame interval [s].
        tolerance: allowed depth [m].

    Returns:
        Positions, velocities, and a mask [node] of the nodes that changed.
    """
    packed, inside = packed_shapes(shapes), np.empty(len(pos), np.bool_)
    if not _find_inside(pos, packed.kinds, packed.starts, packed.numbers, tolerance, inside):
        return None
    new_pos, new_vel = pos.copy(), vel.copy()
    _put_back(vel, dt, packed.kinds, packed.starts, packed.numbers, tolerance, inside, new_pos, new_vel)
    return new_pos, new_vel, inside


@njit(cache=True, error_model="numpy")
@no_type_check
def _find_inside(pos, kinds, starts, numbers, tolerance, inside):
    """Mark the points deeper than ``tolerance`` in a shape, and those between two; return their number."""
    count, normals = 0, np.empty((kinds.shape[0], pos.shape[1]))
    for n in range(pos.shape[0]):
        distance = nearest_of(pos[n], kinds, starts, numbers)
        inside[n] = distance < -tolerance or (distance <= tolerance and _is_between(pos[n], kinds, starts, numbers, tolerance, normals))
        count += inside[n]
    return count


@njit(cache=True, error_model="numpy")
@no_type_check
def _is_between(x, kinds, starts, numbers, tolerance, normals):
    """Return whether a point is on the surfaces of two shapes that face each other; ``normals`` [shape, dim] is overwritten."""
    count = 0
    for s in range(kinds.shape[0]):
        if abs(distance_to(x, s, kinds, starts, numbers)) <= tolerance:
            write_normal(x, s, kinds, starts, numbers, tolerance, normals[count])
            for k in range(count):
                product = 0.0
                for a in range(x.shape[0]):
                    product += normals[k, a] * normals[count, a]
                if product < FACING:
                    return True
            count += 1
    return False


@njit(cache=True, error_model="numpy")
@no_type_check
def _put_back(vel, dt, kinds, starts, numbers, tolerance, inside, new_pos, new_vel):
    dim = new_pos.shape[1]
    x, normal, normals = np.empty(dim), np.empty(dim), np.empty((kinds.shape[0], dim))
    for n in range(new_pos.shape[0]):
        if not inside[n]:
            continue
        for a in range(dim):
            x[a] = new_pos[n, a]
        for _ in range(NUM_PASSES):
            if not nearest_of(x, kinds, starts, numbers) < 0.0:
                break
            for s in range(kinds.shape[0]):
                depth = -distance_to(x, s, kinds, starts, numbers)
                if depth > 0.0:
                    write_normal(x, s, kinds, starts, numbers, tolerance, normal)
                    for a in range(dim):
                        x[a] += depth * normal[a]
        is_caught = nearest_of(x, kinds, starts, numbers) < -tolerance or _is_between(x, kinds, starts, numbers, tolerance, normals)
        for a in range(dim):
            if is_caught:
                x[a] = new_pos[n, a] - vel[n, a] * dt
            new_vel[n, a] = vel[n, a] + (x[a] - new_pos[n, a]) / dt
            new_pos[n, a] = x[a]


def are_near(shapes: tuple[Any, ...], start: np.ndarray, end: np.ndarray, farthest: float, deepest: float) -> bool:
    """Tell whether all points moved at most ``farthest`` [m] from start to end [point, dim], and ended at most ``deepest`` [m] deep in shapes."""
    packed = packed_shapes(shapes)
    found: bool = _are_near(start, end, packed.kinds, packed.starts, packed.numbers, farthest * farthest, deepest)
    return found


@njit(cache=True, error_model="numpy")
@no_type_check
def _are_near(start, end, kinds, starts, numbers, square, deepest):
    for n in range(end.shape[0]):
        moved = 0.0
        for a in range(end.shape[1]):
            moved += (end[n, a] - start[n, a]) ** 2
        if not (moved <= square and -nearest_of(end[n], kinds, starts, numbers) <= deepest):
            return False
    return True


def write_nearest_surfaces(
    shapes: tuple[Any, ...], pos: np.ndarray, rows: np.ndarray, is_near: np.ndarray, step: float, most_friction: float, found: np.ndarray
) -> None:
    """Write normal, distance [m] and friction of the nearest shape of some points to ``found`` [row, dim + 2], and zeros for other points.

    Args:
        shapes: shapes that ``packed_shapes`` knows, at least one.
        pos: positions [point, dim] in m.
        rows: points of the results [row].
        is_near: mask [row] of the points to look at.
        step: step of the differences that give the normals [m].
        most_friction: upper limit of the friction.
        found: the results.
    """
    packed = packed_shapes(shapes)
    friction = np.array([min(shape.friction, most_friction) for shape in shapes])
    _write_nearest_surfaces(pos, rows, is_near, packed.kinds, packed.starts, packed.numbers, friction, step, found)


@njit(cache=True, error_model="numpy")
@no_type_check
def _write_nearest_surfaces(pos, rows, is_near, kinds, starts, numbers, friction, step, found):
    dim = pos.shape[1]
    normal = np.empty(dim)
    for k in range(rows.shape[0]):
        found[k] = 0.0
        if not is_near[k]:
            continue
        x = pos[rows[k]]
        chosen, least = 0, distance_to(x, 0, kinds, starts, numbers)
        for s in range(1, kinds.shape[0]):
            d = distance_to(x, s, kinds, starts, numbers)
            if d < least:
                chosen, least = s, d
        write_normal(x, chosen, kinds, starts, numbers, step, normal)
        for a in range(dim):
            found[k, a] = normal[a]
        found[k, dim], found[k, dim + 1] = least, friction[chosen]
