"""Frictional contact of mesh nodes with rigid obstacles at rest, by impulses.

In each substep, a node that would enter an obstacle loses just enough normal velocity to arrive on the surface. It also loses tangential velocity by an
impulse of up to μ times the normal one (Coulomb); no-slip obstacles remove all of it. Contact never adds kinetic energy, needs no stiffness, and does not
limit the substep. A node on a convex corner may leave along any of its faces; the corner resists by the normal that takes the least impulse. In a notch,
both faces hold. In 2D, convex corners of polygons and boxes also act on the edges of the mesh between nodes; the two nodes of an edge divide the impulse in
inverse proportion to their masses. Other obstacles sharper than the length of an edge are not resolved: small discs, and edges and corners in 3D.

Kernels treat two dimensions as three dimensions without depth, so one contact law serves both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from gpe_pl.geometry.shapes import Box, DistanceGrid, Polygon, Shape, Sphere, Wall
from gpe_pl.schema import STICKY

FIELD_CELLS = 64
"""Number of cells along the longest axis of the grid on which obstacles without nodes of their own, such as bowls, are sampled."""

TIE = 1e-9
"""Relative difference below which two faces of an obstacle are equally near, or equally easy to leave along. Rounding is smaller."""


class Obstacles(NamedTuple):
    """Boundary shapes as arrays for the compiled kernels. Lengths are in m; friction is the Coulomb coefficient.

    Attributes:
        planes: normal, offset and friction of each wall [wall, 5].
        spheres: centre, radius and friction of each sphere [sphere, 5].
        boxes: low corner, high corner and friction of each box [box, 7]; 3D only.
        polygons: low x, low y, high x, high y and friction of each polygon [polygon, 5]; boxes in 2D are polygons.
        edges: start, vector to the end and 1 / length² of the edges of all polygons, counter-clockwise, one polygon after the other [edge, 5].
        first_edge: index of the first edge of each polygon [polygon + 1].
        corners: x, y and friction of convex polygon vertices [corner, 3].
        fields: signed distances [m] of each shape of any other kind at the nodes of a grid, in C order, one field after the other.
        first_value: index in ``fields`` of the first value of each field [field + 1].
        field_counts: number of nodes of each field along x, y and z [field, 3]; 2 along z in 2D.
        field_grids: low corner, spacing and friction of each field [field, 5].
    """

    planes: np.ndarray
    spheres: np.ndarray
    boxes: np.ndarray
    polygons: np.ndarray
    edges: np.ndarray
    first_edge: np.ndarray
    corners: np.ndarray
    fields: np.ndarray
    first_value: np.ndarray
    field_counts: np.ndarray
    field_grids: np.ndarray


@lru_cache(maxsize=8)
def collect(shapes: tuple[Shape, ...], bounds: tuple[tuple[float, float], ...]) -> Obstacles:
    """Convert shapes to ``Obstacles``; ``bounds`` are ``(low, high)`` of the domain along each axis [m]."""
    dim = len(bounds)
    depth = (0.0,) * (3 - dim)
    low, high = np.array(bounds, dtype=np.float64).T
    planes: list = []
    spheres: list = []
    boxes: list = []
    polygons: list = []
    edges: list = []
    first_edge = [0]
    corners: list = []
    fields: list = []
    field_grids: list = []
    for shape in shapes:
        mu = shape.friction
        if isinstance(shape, Wall):
            planes.append([*shape.normal, *depth, shape.offset, mu])
        elif isinstance(shape, Sphere):
            spheres.append([*shape.center, *depth, shape.radius, mu])
        elif isinstance(shape, Box) and dim == 3:
            boxes.append([*shape.low, *shape.high, mu])
        elif isinstance(shape, (Box, Polygon)):
            outline = _outline(shape)
            polygons.append([*outline.min(axis=0), *outline.max(axis=0), mu])
            before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
            convex = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0
            corners.extend([*corner, mu] for corner in outline[convex])
            edges.extend(np.concatenate([outline, after, 1.0 / np.sum(after**2, axis=1, keepdims=True)], axis=1))
            first_edge.append(len(edges))
        else:
            origin, spacing, distance = _sampled(shape, low, high)
            fields.append(distance if dim == 3 else np.stack([distance, distance], axis=-1))
            field_grids.append([*origin, *depth, spacing, mu])
    return Obstacles(
        _table(planes, 5),
        _table(spheres, 5),
        _table(boxes, 7),
        _table(polygons, 5),
        _table(edges, 5),
        np.array(first_edge, dtype=np.int64),
        _table(corners, 3),
        np.concatenate([np.empty(0), *(field.ravel() for field in fields)]),
        np.cumsum([0, *(field.size for field in fields)]),
        np.array([field.shape for field in fields], dtype=np.int64).reshape(-1, 3),
        _table(field_grids, 5),
    )


def _table(rows: list, width: int) -> np.ndarray:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _outline(shape: Box | Polygon) -> np.ndarray:
    if isinstance(shape, Polygon):
        return np.array(shape.vertices, dtype=np.float64)
    (x0, y0), (x1, y1) = shape.low, shape.high
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64)


def _sampled(shape: Shape, low: np.ndarray, high: np.ndarray) -> tuple[Sequence[float] | np.ndarray, float, np.ndarray]:
    """Return the first node [dim] in m, the spacing [m] and the signed distances [x, y(, z)] in m of a grid.

    A ``DistanceGrid`` keeps its own nodes. Any other shape is sampled over the domain.
    """
    if isinstance(shape, DistanceGrid):
        return shape.origin, shape.spacing, shape.values
    spacing = float(np.max(high - low)) / FIELD_CELLS
    axes = [a + spacing * np.arange(math.ceil((b - a) / spacing - 1e-9) + 1) for a, b in zip(low, high, strict=True)]
    return low, spacing, shape.signed_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))


@njit(cache=True, error_model="numpy")
@no_type_check
def _resist(u, v, w, gap, nx, ny, nz, friction, h):
    """Return the velocity after contact with a surface at distance ``gap`` along the normal n, over a substep h."""
    approach, slowest = u * nx + v * ny + w * nz, -max(gap, 0.0) / h
    if approach >= slowest:
        return u, v, w
    u, v, w = u - approach * nx, v - approach * ny, w - approach * nz
    largest, sliding = friction * (slowest - approach), math.sqrt(u * u + v * v + w * w)
    kept = 0.0 if friction >= STICKY or sliding <= largest else 1.0 - largest / sliding
    return kept * u + slowest * nx, kept * v + slowest * ny, kept * w + slowest * nz


@njit(cache=True, error_model="numpy")
@no_type_check
def _slow(vel, p, gap, nx, ny, nz, friction, h):
    vel[p, 0], vel[p, 1], vel[p, 2] = _resist(vel[p, 0], vel[p, 1], vel[p, 2], gap, nx, ny, nz, friction, h)


@njit(cache=True, error_model="numpy")
@no_type_check
def _push(pos, p, gap, nx, ny, nz):
    if gap < 0.0:
        pos[p, 0] -= gap * nx
        pos[p, 1] -= gap * ny
        pos[p, 2] -= gap * nz


@njit(cache=True, error_model="numpy")
@no_type_check
def _sphere_gap(x, y, z, sphere):
    dx, dy, dz = x - sphere[0], y - sphere[1], z - sphere[2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    if r > 0.0:
        return r - sphere[3], dx / r, dy / r, dz / r
    return -sphere[3], 0.0, 1.0, 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _box_gap(x, y, z, u, v, w, box):
    """Return the signed distance of a box, and the normal along which it resists a node with velocity (u, v, w)."""
    wide, deep, high = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    cx, cy, cz = x - 0.5 * (box[0] + box[3]), y - 0.5 * (box[1] + box[4]), z - 0.5 * (box[2] + box[5])
    qx, qy, qz = abs(cx) - 0.5 * wide, abs(cy) - 0.5 * deep, abs(cz) - 0.5 * high
    sx, sy, sz = math.copysign(1.0, cx), math.copysign(1.0, cy), math.copysign(1.0, cz)
    ax, ay, az = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    r, slack = math.sqrt(ax * ax + ay * ay + az * az), TIE * max(wide, deep, high)
    if r > slack:
        return r, sx * ax / r, sy * ay / r, sz * az / r
    gap = max(qx, qy, qz)
    # of the faces that are equally near, take the one with the largest outward velocity, or the mean of several
    fx = sx * u if qx >= gap - slack else -math.inf
    fy = sy * v if qy >= gap - slack else -math.inf
    fz = sz * w if qz >= gap - slack else -math.inf
    largest = max(fx, fy, fz) - TIE * math.sqrt(u * u + v * v + w * w)
    nx, ny, nz = sx if fx >= largest else 0.0, sy if fy >= largest else 0.0, sz if fz >= largest else 0.0
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return gap, nx / length, ny / length, nz / length


@njit(cache=True, error_model="numpy")
@no_type_check
def _polygon_gap(x, y, u, v, edges, start, stop, slack):
    """Return the signed distance of a polygon, and the normal along which it resists a node with velocity (u, v).

    Two edges whose distances differ by less than ``slack`` [m] are equally near.
    """
    inside = False
    nearest, nearest_square, second, second_square, qx, qy = start, math.inf, start, math.inf, 0.0, 0.0
    for k in range(start, stop):
        px, py, ex, ey = x - edges[k, 0], y - edges[k, 1], edges[k, 2], edges[k, 3]
        if ((py < 0.0) != (py < ey)) and px < ex * py / ey:
            inside = not inside
        dx, dy = _from_edge(x, y, edges, k)
        square = dx * dx + dy * dy
        if square < nearest_square:
            second, second_square = nearest, nearest_square
            nearest, nearest_square, qx, qy = k, square, dx, dy
        elif square < second_square:
            second, second_square = k, square
    distance = math.sqrt(nearest_square)
    gap = -distance if inside else distance
    nx, ny = _edge_normal(qx, qy, gap, edges, nearest, slack)
    if second_square > (distance + slack) * (distance + slack):
        return gap, nx, ny
    is_corner = _is_corner(edges, nearest, second, start, stop)
    if is_corner and gap > slack:  # the vertex is the nearest point of both edges
        return gap, nx, ny
    qx, qy = _from_edge(x, y, edges, second)
    mx, my = _edge_normal(qx, qy, math.copysign(math.sqrt(second_square), gap), edges, second, slack)
    if is_corner or gap < -slack:
        nx, ny = _easier(u, v, nx, ny, mx, my)
    else:
        nx, ny = _in_notch(u, v, nx, ny, mx, my)
    return gap, nx, ny


@njit(cache=True, error_model="numpy")
@no_type_check
def _from_edge(x, y, edges, k):
    """Return the vector from the nearest point of an edge to a point."""
    px, py, ex, ey = x - edges[k, 0], y - edges[k, 1], edges[k, 2], edges[k, 3]
    t = min(1.0, max(0.0, (px * ex + py * ey) * edges[k, 4]))
    return px - t * ex, py - t * ey


@njit(cache=True, error_model="numpy")
@no_type_check
def _edge_normal(dx, dy, gap, edges, k, slack):
    """Return the outward normal at the nearest point of an edge, from the vector (dx, dy) to a point at the signed distance ``gap``."""
    if abs(gap) > slack:
        return dx / gap, dy / gap
    # the direction to the nearest point of an edge is meaningless within rounding of the edge
    inv = math.sqrt(edges[k, 4])
    return edges[k, 3] * inv, -edges[k, 2] * inv


@njit(cache=True, error_model="numpy")
@no_type_check
def _is_corner(edges, j, k, start, stop):
    """Tell whether two edges of a polygon meet in a convex vertex."""
    if j > k:
        j, k = k, j
    if j == start and k == stop - 1:
        j, k = k, j
    elif k != j + 1:
        return False
    return edges[j, 2] * edges[k, 3] - edges[j, 3] * edges[k, 2] > 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _easier(u, v, nx, ny, mx, my):
    """Return the one of two normals along which a velocity leads further out, or their mean if both are equal."""
    difference = u * (mx - nx) + v * (my - ny)
    if abs(difference) > TIE * math.sqrt(u * u + v * v):
        return (mx, my) if difference > 0.0 else (nx, ny)
    length = math.sqrt((nx + mx) ** 2 + (ny + my) ** 2)
    if length > TIE:
        return (nx + mx) / length, (ny + my) / length
    return nx, ny


@njit(cache=True, error_model="numpy")
@no_type_check
def _in_notch(u, v, nx, ny, mx, my):
    """Return the direction of the impulse that keeps a velocity out of two faces; a node that both faces hold stops."""
    a, b = u * nx + v * ny, u * mx + v * my
    if b < a:
        a, b, nx, ny, mx, my = b, a, mx, my, nx, ny
    speed = math.sqrt(u * u + v * v)
    if a < 0.0 and b - a * (nx * mx + ny * my) < -TIE * speed:
        return -u / speed, -v / speed
    return nx, ny


@njit(cache=True, error_model="numpy")
@no_type_check
def _field_gap(x, y, z, field, grid):
    """Interpolate a sampled distance trilinearly, and continue it linearly outside its grid. Return it and the direction of its gradient."""
    inv = 1.0 / grid[3]
    px, py, pz = (x - grid[0]) * inv, (y - grid[1]) * inv, (z - grid[2]) * inv
    i = min(max(int(px), 0), field.shape[0] - 2)
    j = min(max(int(py), 0), field.shape[1] - 2)
    k = min(max(int(pz), 0), field.shape[2] - 2)
    px, py, pz = px - i, py - j, pz - k
    fx, fy, fz = min(max(px, 0.0), 1.0), min(max(py, 0.0), 1.0), min(max(pz, 0.0), 1.0)
    gap = gx = gy = gz = 0.0
    for a in range(2):
        wx, sx = (fx, 1.0) if a == 1 else (1.0 - fx, -1.0)
        for b in range(2):
            wy, sy = (fy, 1.0) if b == 1 else (1.0 - fy, -1.0)
            for c in range(2):
                wz, sz = (fz, 1.0) if c == 1 else (1.0 - fz, -1.0)
                d = field[i + a, j + b, k + c]
                gap += wx * wy * wz * d
                gx += sx * wy * wz * d
                gy += wx * sy * wz * d
                gz += wx * wy * sz * d
    gap += gx * (px - fx) + gy * (py - fy) + gz * (pz - fz)
    length = math.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0.0:
        return gap, gx / length, gy / length, gz / length
    return gap, 0.0, 1.0, 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _field(obstacles, k):
    """Return the values [x, y, z] of field number k."""
    nx, ny, nz = obstacles.field_counts[k]
    return obstacles.fields[obstacles.first_value[k] : obstacles.first_value[k + 1]].reshape((nx, ny, nz))


@njit(cache=True, error_model="numpy")
@no_type_check
def _apart(box, margin, x_low, y_low, z_low, x_high, y_high, z_high):
    """Tell whether two extents are further apart than a margin."""
    if x_low > box[3] + margin or y_low > box[4] + margin or z_low > box[5] + margin:
        return True
    return x_high < box[0] - margin or y_high < box[1] - margin or z_high < box[2] - margin


@njit(cache=True, error_model="numpy")
@no_type_check
def _beyond(box, margin, plane):
    """Tell whether an extent is further in front of a plane than a margin."""
    nearest = -plane[3] - margin
    for axis in range(3):
        nearest += plane[axis] * (box[axis] if plane[axis] > 0.0 else box[axis + 3])
    return nearest > 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def resist_nodes(pos, vel, box, reach, h, obstacles):
    """Slow down nodes that would enter an obstacle in a substep of length ``h`` [s].

    ``box`` [6] has the smallest and the largest coordinates of all nodes [m]. ``reach`` is the largest distance that a node may move in the substep [m].
    """
    for k in range(obstacles.polygons.shape[0]):
        xl, yl, xh, yh, friction = obstacles.polygons[k]
        if _apart(box, reach, xl, yl, 0.0, xh, yh, 0.0):
            continue
        start, stop, slack = obstacles.first_edge[k], obstacles.first_edge[k + 1], TIE * max(xh - xl, yh - yl)
        for p in range(pos.shape[0]):
            x, y = pos[p, 0], pos[p, 1]
            if x > xl - reach and x < xh + reach and y > yl - reach and y < yh + reach:
                gap, nx, ny = _polygon_gap(x, y, vel[p, 0], vel[p, 1], obstacles.edges, start, stop, slack)
                _slow(vel, p, gap, nx, ny, 0.0, friction, h)
    for k in range(obstacles.spheres.shape[0]):
        x, y, z, r, friction = obstacles.spheres[k]
        if _apart(box, reach, x - r, y - r, z - r, x + r, y + r, z + r):
            continue
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _sphere_gap(pos[p, 0], pos[p, 1], pos[p, 2], obstacles.spheres[k])
            if gap < reach:
                _slow(vel, p, gap, nx, ny, nz, friction, h)
    for k in range(obstacles.boxes.shape[0]):
        xl, yl, zl, xh, yh, zh, friction = obstacles.boxes[k]
        if _apart(box, reach, xl, yl, zl, xh, yh, zh):
            continue
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _box_gap(pos[p, 0], pos[p, 1], pos[p, 2], vel[p, 0], vel[p, 1], vel[p, 2], obstacles.boxes[k])
            if gap < reach:
                _slow(vel, p, gap, nx, ny, nz, friction, h)
    for k in range(obstacles.field_grids.shape[0]):
        field, grid = _field(obstacles, k), obstacles.field_grids[k]
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _field_gap(pos[p, 0], pos[p, 1], pos[p, 2], field, grid)
            if gap < reach:
                _slow(vel, p, gap, nx, ny, nz, grid[4], h)
    for k in range(obstacles.planes.shape[0]):
        nx, ny, nz, offset, friction = obstacles.planes[k]
        if _beyond(box, reach, obstacles.planes[k]):
            continue
        for p in range(pos.shape[0]):
            gap = nx * pos[p, 0] + ny * pos[p, 1] + nz * pos[p, 2] - offset
            if gap < reach:
                _slow(vel, p, gap, nx, ny, nz, friction, h)


@njit(cache=True, error_model="numpy")
@no_type_check
def push_out_nodes(pos, vel, box, reach, obstacles):
    """Move nodes inside an obstacle, due to rounding or curved surfaces, to its surface; walls come last, so that no node ends outside them.

    ``box`` and ``reach`` are the values before the nodes moved.
    """
    margin = 2.0 * reach
    for k in range(obstacles.polygons.shape[0]):
        xl, yl, xh, yh, _ = obstacles.polygons[k]
        if _apart(box, margin, xl, yl, 0.0, xh, yh, 0.0):
            continue
        start, stop, slack = obstacles.first_edge[k], obstacles.first_edge[k + 1], TIE * max(xh - xl, yh - yl)
        for p in range(pos.shape[0]):
            x, y = pos[p, 0], pos[p, 1]
            if x > xl and x < xh and y > yl and y < yh:
                gap, nx, ny = _polygon_gap(x, y, vel[p, 0], vel[p, 1], obstacles.edges, start, stop, slack)
                _push(pos, p, gap, nx, ny, 0.0)
    for k in range(obstacles.spheres.shape[0]):
        x, y, z, r, _ = obstacles.spheres[k]
        if _apart(box, margin, x - r, y - r, z - r, x + r, y + r, z + r):
            continue
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _sphere_gap(pos[p, 0], pos[p, 1], pos[p, 2], obstacles.spheres[k])
            _push(pos, p, gap, nx, ny, nz)
    for k in range(obstacles.boxes.shape[0]):
        xl, yl, zl, xh, yh, zh, _ = obstacles.boxes[k]
        if _apart(box, margin, xl, yl, zl, xh, yh, zh):
            continue
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _box_gap(pos[p, 0], pos[p, 1], pos[p, 2], vel[p, 0], vel[p, 1], vel[p, 2], obstacles.boxes[k])
            _push(pos, p, gap, nx, ny, nz)
    for k in range(obstacles.field_grids.shape[0]):
        field, grid = _field(obstacles, k), obstacles.field_grids[k]
        for p in range(pos.shape[0]):
            gap, nx, ny, nz = _field_gap(pos[p, 0], pos[p, 1], pos[p, 2], field, grid)
            _push(pos, p, gap, nx, ny, nz)
    for k in range(obstacles.planes.shape[0]):
        nx, ny, nz, offset, _ = obstacles.planes[k]
        if _beyond(box, margin, obstacles.planes[k]):
            continue
        for p in range(pos.shape[0]):
            _push(pos, p, nx * pos[p, 0] + ny * pos[p, 1] + nz * pos[p, 2] - offset, nx, ny, nz)


@njit(cache=True, error_model="numpy")
@no_type_check
def _facing_edge(x, y, pos, edges, reach):
    """Return the surface edge nearest to a point (-1: none), with gap, position along the edge and normal.

    An edge counts only if the point is less than ``reach`` in front of it or less than half of its length behind it.
    """
    best, gap, along, nx, ny = -1, math.inf, 0.0, 0.0, 0.0
    for e in range(edges.shape[0]):
        a, b = edges[e, 0], edges[e, 1]
        px, py = x - pos[a, 0], y - pos[a, 1]
        ex, ey = pos[b, 0] - pos[a, 0], pos[b, 1] - pos[a, 1]
        square = ex * ex + ey * ey
        t = px * ex + py * ey
        if t <= 0.0 or t >= square:
            continue
        length = math.sqrt(square)
        d = (px * ey - py * ex) / length
        if d < reach and d > -0.5 * length and abs(d) < abs(gap):
            best, gap, along, nx, ny = e, d, t / square, ey / length, -ex / length
    return best, gap, along, nx, ny


@njit(cache=True, error_model="numpy")
@no_type_check
def resist_corners(pos, vel, mass, edges, box, reach, h, corners, touched, gaps):
    """Slow down mesh edges that obstacle corners would cross in a substep of length ``h`` [s]; ``box`` and ``reach`` as in ``resist_nodes``.

    For each corner, the nearest edge within reach (-1: none) and its gap [m] are written to ``touched`` and ``gaps`` [corner].

    Args:
        pos, vel: positions [m] and velocities [m/s] of nodes; the velocities change.
        mass: masses of nodes [kg].
        edges: surface edges [edge, 2], the body on their left.
        corners: as in ``Obstacles``.
    """
    for k in range(corners.shape[0]):
        touched[k] = -1
        x, y = corners[k, 0], corners[k, 1]
        if x < box[0] - reach or x > box[3] + reach or y < box[1] - reach or y > box[4] + reach:
            continue
        e, gap, t, nx, ny = _facing_edge(x, y, pos, edges, reach)
        if e < 0:
            continue
        touched[k], gaps[k] = e, gap
        a, b = edges[e, 0], edges[e, 1]
        u, v = (1.0 - t) * vel[a, 0] + t * vel[b, 0], (1.0 - t) * vel[a, 1] + t * vel[b, 1]
        # the edge moves against its outward normal to retreat
        u_new, v_new, _ = _resist(u, v, 0.0, gap, -nx, -ny, 0.0, corners[k, 2], h)
        share_a, share_b = (1.0 - t) / mass[a], t / mass[b]
        whole = (1.0 - t) * share_a + t * share_b
        vel[a, 0] += share_a / whole * (u_new - u)
        vel[a, 1] += share_a / whole * (v_new - v)
        vel[b, 0] += share_b / whole * (u_new - u)
        vel[b, 1] += share_b / whole * (v_new - v)


@njit(cache=True, error_model="numpy")
@no_type_check
def push_out_corners(pos, mass, edges, corners, touched, gaps):
    """Move edges back onto a corner that has crossed them because they rotated or stretched, after the nodes moved.

    A corner that was inside the body before keeps its depth, because pushing it out would store energy in the cells around it. Arguments are as in
    ``resist_corners``, which writes ``touched`` and ``gaps``.
    """
    for k in range(corners.shape[0]):
        e = touched[k]
        if e < 0:
            continue
        a, b = edges[e, 0], edges[e, 1]
        ex, ey = pos[b, 0] - pos[a, 0], pos[b, 1] - pos[a, 1]
        px, py = corners[k, 0] - pos[a, 0], corners[k, 1] - pos[a, 1]
        square = ex * ex + ey * ey
        t, length = (px * ex + py * ey) / square, math.sqrt(square)
        gap = (px * ey - py * ex) / length - min(gaps[k], 0.0)
        if t <= 0.0 or t >= 1.0 or gap >= 0.0:
            continue
        share_a, share_b = (1.0 - t) / mass[a], t / mass[b]
        step = gap / ((1.0 - t) * share_a + t * share_b) / length
        pos[a, 0] += share_a * step * ey
        pos[a, 1] -= share_a * step * ex
        pos[b, 0] += share_b * step * ey
        pos[b, 1] -= share_b * step * ex
