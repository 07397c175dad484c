"""Signed distance to several shapes in one compiled pass over the points. The results equal those of the shapes' methods ``signed_distance``.

A step of a rollout needs such distances several times, for a few hundred points each, where separate NumPy operations would cost more than the arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, no_type_check

import numpy as np
from numba import njit

_WALL, _SPHERE, _BOWL, _BOX, _POLYGON, _GRID = range(6)
_MOST_KEPT = 256
"""Number of tuples of shapes whose packed form is cached."""


class Packed(NamedTuple):
    """Shapes as arrays, for the compiled pass.

    Attributes:
        kinds: code of each shape's kind, such as ``_WALL`` [shape].
        starts: index in ``numbers`` at which the values of each shape start, and the total number of values [shape + 1].
        numbers: values that define the shapes, such as centres and radii, one shape after the other.
        others: shapes of kinds that the compiled pass does not cover.
        extent: largest ``Shape.extent`` [m].
    """

    kinds: np.ndarray
    starts: np.ndarray
    numbers: np.ndarray
    others: tuple[Any, ...]
    extent: float


def compiled_distance(shapes: tuple[Any, ...], points: np.ndarray) -> np.ndarray:
    """Return the signed distance [point] in m of points [point, dim], negative inside any of the shapes; +inf without shapes."""
    packed = packed_shapes(shapes)
    distance = np.empty(len(points))
    _nearest(np.ascontiguousarray(points), packed.kinds, packed.starts, packed.numbers, distance)
    for shape in packed.others:
        distance = np.minimum(distance, shape.signed_distance(points))
    return distance


def has_compiled_distance(shapes: tuple[Any, ...]) -> bool:
    """Tell whether the numbers of all these shapes are known, so that compiled loops can use them."""
    return not packed_shapes(shapes).others


def _wall(shape: Any) -> list[float]:
    axis = int(np.argmax(np.abs(shape.normal)))
    return [float(axis), float(shape.normal[axis]), float(shape.offset)]


def _round(shape: Any) -> list[float]:
    return [float(shape.radius), *map(float, shape.center)]


def _box(shape: Any) -> list[float]:
    low, high = np.asarray(shape.low, float), np.asarray(shape.high, float)
    return [*((low + high) / 2).tolist(), *((high - low) / 2).tolist()]


def _polygon(shape: Any) -> list[float]:
    return [float(x) for vertex in shape.vertices for x in vertex]


def _distance_grid(shape: Any) -> np.ndarray:
    return np.concatenate([[shape.spacing], shape.counts, shape.origin, shape.values.ravel()])


_NUMBERS: dict[str, tuple[int, Callable[[Any], Any]]] = {
    "wall": (_WALL, _wall),
    "sphere": (_SPHERE, _round),
    "bowl": (_BOWL, _round),
    "box": (_BOX, _box),
    "polygon": (_POLYGON, _polygon),
    "distance_grid": (_GRID, _distance_grid),
}
_kept: dict[int, tuple[tuple[Any, ...], Packed]] = {}


def packed_shapes(shapes: tuple[Any, ...]) -> Packed:
    """Return the numbers of shapes, made once per tuple: all states of a rollout have the same one."""
    found = _kept.get(id(shapes))
    if found is not None and found[0] is shapes:
        return found[1]
    known = [shape for shape in shapes if shape.kind in _NUMBERS]
    parts = [np.asarray(_NUMBERS[shape.kind][1](shape), float) for shape in known]
    packed = Packed(
        np.array([_NUMBERS[shape.kind][0] for shape in known], dtype=np.int64),
        np.cumsum([0, *map(len, parts)]),
        np.concatenate([np.empty(0), *parts]),
        tuple(shape for shape in shapes if shape.kind not in _NUMBERS),
        max((shape.extent for shape in shapes), default=0.0),
    )
    if len(_kept) >= _MOST_KEPT:
        _kept.clear()
    _kept[id(shapes)] = shapes, packed
    return packed


@njit(cache=True, error_model="numpy")
@no_type_check
def _nearest(points, kinds, starts, numbers, distance):
    for n in range(points.shape[0]):
        distance[n] = nearest_of(points[n], kinds, starts, numbers)


@njit(cache=True, error_model="numpy")
@no_type_check
def nearest_of(x, kinds, starts, numbers):
    """Return the signed distance of a point [dim] to the nearest of the shapes."""
    nearest = math.inf
    for s in range(kinds.shape[0]):
        d = distance_to(x, s, kinds, starts, numbers)
        if d < nearest or math.isnan(d):
            nearest = d
    return nearest


@njit(cache=True, error_model="numpy")
@no_type_check
def distance_to(x, s, kinds, starts, numbers):
    """Return the signed distance of a point [dim] to shape number s."""
    first = starts[s]
    if kinds[s] == _WALL:
        return x[int(numbers[first])] * numbers[first + 1] - numbers[first + 2]
    if kinds[s] == _BOX:
        return _of_box(x, numbers, first)
    if kinds[s] == _POLYGON:
        return _of_polygon(x, numbers, first, starts[s + 1])
    if kinds[s] == _GRID:
        return _of_grid(x, numbers, first)
    d = _of_sphere(x, numbers, first)
    return -d if kinds[s] == _BOWL else d


@njit(cache=True, error_model="numpy")
@no_type_check
def write_normal(x, s, kinds, starts, numbers, step, normal):
    """Write the ``shapes.outward_normal`` of shape number s at a point [dim] to ``normal``."""
    normal[:] = 0.0
    if kinds[s] == _WALL:
        normal[int(numbers[starts[s]])] = numbers[starts[s] + 1]
        return
    near, squared = x.copy(), 0.0
    for a in range(x.shape[0]):
        near[a] = x[a] + step
        ahead = distance_to(near, s, kinds, starts, numbers)
        near[a] = x[a] - step
        normal[a] = ahead - distance_to(near, s, kinds, starts, numbers)
        near[a] = x[a]
        squared += normal[a] * normal[a]
    if squared > 0.0:
        length = math.sqrt(squared)
        for a in range(x.shape[0]):
            normal[a] /= length


@njit(cache=True, error_model="numpy")
@no_type_check
def _of_sphere(x, numbers, first):
    squared = 0.0
    for a in range(x.shape[0]):
        d = x[a] - numbers[first + 1 + a]
        squared += d * d
    return math.sqrt(squared) - numbers[first]


@njit(cache=True, error_model="numpy")
@no_type_check
def _of_box(x, numbers, first):
    dim, squared, deepest = x.shape[0], 0.0, -math.inf
    for a in range(dim):
        q = abs(x[a] - numbers[first + a]) - numbers[first + dim + a]
        if math.isnan(q):
            return q
        squared += max(q, 0.0) ** 2
        deepest = max(q, deepest)
    return math.sqrt(squared) + min(deepest, 0.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def _of_polygon(x, numbers, first, end):
    squared, inside = math.inf, False
    for k in range(first, end, 2):
        following = k + 2 if k + 2 < end else first
        ax, ay = numbers[k], numbers[k + 1]
        bx, by = numbers[following], numbers[following + 1]
        ex, ey, wx, wy = bx - ax, by - ay, x[0] - ax, x[1] - ay
        t = min(max((wx * ex + wy * ey) / (ex * ex + ey * ey), 0.0), 1.0)
        dx, dy = wx - t * ex, wy - t * ey
        d = dx * dx + dy * dy
        squared = d if d < squared or math.isnan(d) else squared
        if (ay > x[1]) != (by > x[1]) and wx < ex * wy / (ey if ey != 0 else 1.0):
            inside = not inside
    return -math.sqrt(squared) if inside else math.sqrt(squared)


@njit(cache=True, error_model="numpy")
@no_type_check
def _of_grid(x, numbers, first):
    """Return the multilinear interpolation in the nearest cell, continued linearly outside the grid."""
    dim, spacing = x.shape[0], numbers[first]
    upper, beyond, cell = np.empty(3), np.empty(3), np.empty(3, np.int64)
    for a in range(dim):
        count = numbers[first + 1 + a]
        place = (x[a] - numbers[first + 1 + dim + a]) / spacing
        if math.isnan(place):
            return math.nan
        nearest = min(max(place, 0.0), count - 1.0)
        cell[a] = int(min(math.floor(nearest), count - 2.0))
        upper[a], beyond[a] = nearest - cell[a], place - nearest
    distance, change = 0.0, np.zeros(3)
    for corner in range(2**dim):
        index = 0
        for a in range(dim):
            index = index * int(numbers[first + 1 + a]) + cell[a] + (corner >> (dim - 1 - a) & 1)
        value = numbers[first + 1 + 2 * dim + index]
        weight = 1.0
        for a in range(dim):
            is_upper = corner >> (dim - 1 - a) & 1
            weight *= upper[a] if is_upper else 1 - upper[a]
            others = 1.0
            for b in range(dim):
                if b != a:
                    others *= upper[b] if corner >> (dim - 1 - b) & 1 else 1 - upper[b]
            change[a] += (value if is_upper else -value) * others
        distance += value * weight
    outside = 0.0
    for a in range(dim):
        outside += change[a] * beyond[a]
    return distance + outside
