"""Walls and rigid obstacles of the material point method: conditions on the grid, and surfaces that particles cannot cross.

Grid nodes inside a shape obey its boundary condition. A particle that still enters a shape is moved to its surface and loses the inward part of its velocity.
Planes, balls, boxes and polygons are exact. Any other shape is sampled at the grid nodes and interpolated multilinearly. This is exact where the shape is
flat, and has an error of up to ``Δ² / 4R`` where its radius of curvature is R.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, Wall, outward_normal, signed_distance
from gpe_pl.geometry.thin_parts import thickness
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import STICKY


class Collider(NamedTuple):
    """Boundary shapes as arrays for the compiled kernels. Grid nodes are numbered in C order.

    Attributes:
        row: row of ``conditions`` for each grid node, -1 in free space.
        conditions: normal and friction of the k-th shape that contains the node [row, k, dim + 1]; friction < 0 marks unused entries.
        distance: signed distance of each grid node to the nearest shape [m].
        planes: normal and offset of each wall [wall, dim + 1].
        balls: centre and radius of each ball [ball, dim + 1] in m.
        boxes: low and high corner of each box [box, 2, dim] in m.
        vertices: vertices of all polygons, counter-clockwise, one polygon after the other [vertex, 2] in m.
        first_vertex: index of the first vertex of each polygon [polygon + 1].
        sampled: signed distance and outward normal of every other shape at each grid node [shape, node, dim + 1].
    """

    row: np.ndarray
    conditions: np.ndarray
    distance: np.ndarray
    planes: np.ndarray
    balls: np.ndarray
    boxes: np.ndarray
    vertices: np.ndarray
    first_vertex: np.ndarray
    sampled: np.ndarray


@lru_cache(maxsize=8)
def collider(shapes: tuple[Shape, ...], origin: tuple[float, ...], spacing: float, counts: tuple[int, ...]) -> Collider:
    """Convert shapes to a ``Collider`` for a grid.

    Args:
        shapes: walls and obstacles.
        origin: position of the first grid node [m].
        spacing: grid spacing [m].
        counts: number of nodes along each axis.

    Raises:
        SimulationError: with reason ``input``, if a shape has another dimension or the grid does not resolve it.
    """
    dim = len(counts)
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    tolerance = 1e-9 * spacing  # a node on a wall belongs to the wall despite rounding
    inside = [_distance(shape, nodes) <= tolerance for shape in shapes]
    depth = np.sum(inside, axis=0) if shapes else np.zeros(len(nodes), dtype=np.int64)
    touched = np.nonzero(depth)[0]
    row = np.full(len(nodes), -1, dtype=np.int64)
    row[touched] = np.arange(len(touched))
    conditions = np.full((len(touched), max(1, int(depth.max())), dim + 1), -1.0)
    filled = np.zeros(len(touched), dtype=np.int64)
    planes, balls, boxes, sampled = [], [], [], []
    vertices: list[tuple[float, float]] = []
    first_vertex = [0]
    for shape, mask in zip(shapes, inside, strict=True):
        if not isinstance(shape, Wall):
            _require_resolved(shape, mask, spacing, dim)
        normal = outward_normal(shape, nodes[mask], 1e-3 * spacing)
        # Where the normal is undefined, as in the middle of a plate, a node has no condition. It holds particles of both sides of a thin plate.
        is_known = (normal != 0).any(axis=-1) | (shape.friction >= STICKY)
        at = row[mask][is_known]
        conditions[at, filled[at]] = np.column_stack([normal[is_known], np.full(len(at), shape.friction)])
        filled[at] += 1
        if isinstance(shape, Wall):
            planes.append([*shape.normal, shape.offset])
        elif isinstance(shape, Sphere):
            balls.append([*shape.center, shape.radius])
        elif isinstance(shape, Box):
            boxes.append([shape.low, shape.high])
        elif isinstance(shape, Polygon):
            vertices.extend(shape.vertices)
            first_vertex.append(len(vertices))
        else:
            distance = np.asarray(shape.signed_distance(nodes))
            sampled.append(np.concatenate([distance[:, None], outward_normal(shape, nodes, 1e-3 * spacing)], axis=-1))
    return Collider(
        row,
        conditions,
        signed_distance(shapes, nodes),
        np.array(planes, dtype=np.float64).reshape(-1, dim + 1),
        np.array(balls, dtype=np.float64).reshape(-1, dim + 1),
        np.array(boxes, dtype=np.float64).reshape(-1, 2, dim),
        np.array(vertices, dtype=np.float64).reshape(-1, 2),
        np.array(first_vertex, dtype=np.int64),
        np.array(sampled, dtype=np.float64).reshape(-1, len(nodes), dim + 1),
    )


def _distance(shape: Shape, nodes: np.ndarray) -> np.ndarray:
    """Return the signed distance [node] in m from nodes [node, dim] to a shape. It is negative inside.

    Raises:
        SimulationError: with reason ``input``, if the shape has another dimension than the nodes.
    """
    dim = nodes.shape[1]
    own = {Wall: "normal", Sphere: "center", Box: "low"}.get(type(shape))
    fits = dim == 2 if isinstance(shape, Polygon) else own is None or len(getattr(shape, own)) == dim
    try:
        distance = shape.signed_distance(nodes) if fits else None
    except (ValueError, IndexError):  # other kinds of shapes do not state their dimension
        distance = None
    if distance is None:
        raise SimulationError(f"a boundary of kind {shape.kind!r} does not have the {dim} axes of the domain", reason="input")
    return np.asarray(distance)


def _require_resolved(shape: Shape, mask: np.ndarray, spacing: float, dim: int) -> None:
    """Refuse obstacles thinner than a cell: a particle in the far half of a thin obstacle would be pushed out at the far side."""
    thin = thickness(shape)
    if thin < spacing * (1 - 1e-6):
        raise SimulationError(
            f"obstacle {shape} is {thin:g} m thin; on a grid of spacing {spacing:g} m it must be at least {spacing:g} m thick",
            reason="input",
        )
    if not np.any(mask):
        raise SimulationError(
            f"obstacle {shape} contains no node of the grid of spacing {spacing:g} m; move it, or make it {math.sqrt(dim) * spacing:g} m thick",
            reason="input",
        )


@njit(cache=True, error_model="numpy")
@no_type_check
def keep_out(pos, vel, collider, counts, origin, inv):
    """Apply ``push_out`` to all particles that may be inside a shape, as the signed distance at their nearest grid node tells; arguments as there."""
    reach = 0.51 * math.sqrt(len(counts)) / inv
    for p in range(pos.shape[0]):
        node = 0
        for axis in range(len(counts)):
            place = (pos[p, axis] - origin[axis]) * inv + 0.5
            node *= counts[axis]
            if place > 0.0:  # for a particle outside the grid or at NaN, any valid index will do
                node += int(min(place, counts[axis] - 0.5))
        if collider.distance[node] < reach:
            push_out(pos, vel, p, collider, counts, origin, inv)


@njit(cache=True, error_model="numpy")
@no_type_check
def push_out(pos, vel, p, collider, counts, origin, inv):
    """Move particle ``p`` out of every shape and remove the inward part of its velocity, in place. Walls come last, so that no particle ends outside them.

    ``counts``, ``origin`` and ``inv`` describe the grid as in ``transfer_2d``.
    """
    solid = len(counts) == 3
    for k in range(collider.sampled.shape[0]):
        depth, nx, ny, nz = _sampled_depth(pos, p, collider.sampled, k, counts, origin, inv)
        if depth > 0.0:
            _project(pos, vel, p, depth, nx, ny, nz, counts)
    for k in range(collider.first_vertex.shape[0] - 1):
        depth, nx, ny = _polygon_depth(pos[p, 0], pos[p, 1], collider.vertices, collider.first_vertex[k], collider.first_vertex[k + 1])
        if depth > 0.0:
            _project(pos, vel, p, depth, nx, ny, 0.0, counts)
    for k in range(collider.boxes.shape[0]):
        depth, axis, side = _box_depth(pos, p, collider.boxes, k, counts)
        if depth > 0.0:
            _project(pos, vel, p, depth, side if axis == 0 else 0.0, side if axis == 1 else 0.0, side if axis == 2 else 0.0, counts)
    balls = collider.balls
    for k in range(balls.shape[0]):
        x, y, z = pos[p, 0] - balls[k, 0], pos[p, 1] - balls[k, 1], pos[p, 2] - balls[k, 2] if solid else 0.0
        r, radius = math.sqrt(x * x + y * y + z * z), balls[k, len(counts)]
        if r < radius:
            nx, ny, nz = (x / r, y / r, z / r) if r > 0.0 else (0.0, 1.0, 0.0)
            _project(pos, vel, p, radius - r, nx, ny, nz, counts)
    planes = collider.planes
    for k in range(planes.shape[0]):
        nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2] if solid else 0.0
        depth = planes[k, len(counts)] - nx * pos[p, 0] - ny * pos[p, 1] - (nz * pos[p, 2] if solid else 0.0)
        if depth > 0.0:
            _project(pos, vel, p, depth, nx, ny, nz, counts)


@njit(cache=True, error_model="numpy")
@no_type_check
def _project(pos, vel, p, depth, nx, ny, nz, counts):
    inward = vel[p, 0] * nx + vel[p, 1] * ny + (vel[p, 2] * nz if len(counts) == 3 else 0.0)
    inward = min(0.0, inward)
    pos[p, 0] += depth * nx
    pos[p, 1] += depth * ny
    vel[p, 0] -= inward * nx
    vel[p, 1] -= inward * ny
    if len(counts) == 3:
        pos[p, 2] += depth * nz
        vel[p, 2] -= inward * nz


@njit(cache=True, error_model="numpy")
@no_type_check
def _sampled_depth(pos, p, sampled, shape, counts, origin, inv):
    """Return the depth of a particle in a sampled shape and the shape's normal there; depth 0 outside the shape or the grid."""
    dim = len(counts)
    first, fx, fy, fz = 0, 0.0, 0.0, 0.0
    for axis in range(dim):
        x = (pos[p, axis] - origin[axis]) * inv
        if not (x >= 0.0 and x < counts[axis] - 1):
            return 0.0, 0.0, 0.0, 0.0
        first, fx, fy, fz = first * counts[axis] + int(x), fy, fz, x - int(x)
    # the fractions are in the last dim of fx, fy and fz
    distance = nx = ny = nz = 0.0
    for i in range(dim - 1):
        for j in range(2):
            for k in range(2):
                node = first + j * counts[dim - 1] + k + (i * counts[1] * counts[2] if dim == 3 else 0)
                w = (fy if j else 1.0 - fy) * (fz if k else 1.0 - fz) * ((fx if i else 1.0 - fx) if dim == 3 else 1.0)
                distance += w * sampled[shape, node, 0]
                nx += w * sampled[shape, node, 1]
                ny += w * sampled[shape, node, 2]
                nz += w * sampled[shape, node, dim] if dim == 3 else 0.0
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if distance >= 0.0 or length == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return -distance, nx / length, ny / length, nz / length


@njit(cache=True, error_model="numpy")
@no_type_check
def _box_depth(pos, p, boxes, box, counts):
    """Return the depth of a particle in a box, and the axis and direction of the nearest face; depth 0 outside."""
    depth, nearest, side = math.inf, 0, 1.0
    for axis in range(len(counts)):
        above, below = pos[p, axis] - boxes[box, 0, axis], boxes[box, 1, axis] - pos[p, axis]
        if above <= 0.0 or below <= 0.0:
            return 0.0, 0, 1.0
        if above < depth:
            depth, nearest, side = above, axis, -1.0
        if below < depth:
            depth, nearest, side = below, axis, 1.0
    return depth, nearest, side


@njit(cache=True, error_model="numpy")
@no_type_check
def _polygon_depth(x, y, vertices, start, stop):
    """Return the depth of a point inside a simple counter-clockwise polygon and the normal of the nearest edge; depth 0 outside."""
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
            # inside, the direction to the nearest point of the surface; on the surface, the normal of the edge
            nx, ny = (-qx / d, -qy / d) if d > 1e-12 * length else (ey / length, -ex / length)
    return (nearest if inside else 0.0), nx, ny
