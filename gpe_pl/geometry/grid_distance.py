"""Signed distances at the nodes of a grid, negative inside the solid.

The surface is given by heights of the ground, by triangles or by oriented points. The last axis points up.

All functions describe a grid by the position ``low`` of its first node [m], its ``spacing`` [m] and its numbers of nodes along x, y and z, ``counts``. Arrays
of distances have the shape ``counts``.
"""

from __future__ import annotations

import math
from typing import Literal, no_type_check

import numpy as np
from numba import njit

from gpe_pl.geometry.shapes import MAX_GRID_NODES

Bounds = tuple[tuple[float, float], ...]
Solid = Literal["inside", "outside", "below"]
"""Which side of a surface is solid."""

_BAND = 2
"""Width of the band around a triangle in which distances are exact [cells]. Nodes farther away take the nearest triangle of a neighbouring node."""
SAME_POINT = 1e-7
"""Distance below which corners of triangles are the same point, as a fraction of the size of the mesh. Files have single precision."""
MAX_PAIRS = 2**30
"""Maximum number of pairs of a triangle and a nearby grid node. Computing that many distances takes about half a minute."""


def lattice(bounds: Bounds, spacing: float) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the position of the first node [m] and the number of nodes per axis of the grid that covers the domain.

    Raises:
        ValueError: bounds or spacing are invalid, or the grid would have more than ``MAX_GRID_NODES`` nodes.
    """
    if len(bounds) != 3 or any(not -math.inf < low < high < math.inf for low, high in bounds):
        raise ValueError(f"terrain needs bounds (low, high) with low < high along 3 axes, got {bounds}")
    if not 0 < spacing < math.inf:
        raise ValueError(f"spacing must be positive, got {spacing}")
    counts = tuple(max(1, math.ceil((high - low) / spacing - 1e-6)) + 1 for low, high in bounds)
    if math.prod(counts) > MAX_GRID_NODES:
        raise ValueError(f"a grid of {counts} nodes is too large, at most {MAX_GRID_NODES} together; use a wider spacing than {spacing} m")
    return np.array([low for low, _ in bounds], float), counts


def columns_of(low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Return positions [along x, along y, 2] of the grid's vertical lines in m."""
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(2)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def below_heights(heights: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Return signed distances [m] to the ground, given its heights [along x, along y] in m at the grid's vertical lines."""
    corners = _ground(heights, low, spacing, np.ones((counts[0] - 1, counts[1] - 1), dtype=bool))
    z = low[2] + spacing * np.arange(counts[2])
    return np.where(z < heights[..., None], -1.0, 1.0) * unsigned(corners, low, spacing, counts)


def _ground(heights: np.ndarray, low: np.ndarray, spacing: float, cells: np.ndarray) -> np.ndarray:
    """Return corners [triangle, 3, 3] of the ground's triangles, two in each cell of the mask ``cells`` between vertical lines."""
    place = np.concatenate([columns_of(low, spacing, heights.shape), heights[..., None]], axis=-1)
    a, b, c, d = place[:-1, :-1][cells], place[1:, :-1][cells], place[1:, 1:][cells], place[:-1, 1:][cells]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def mesh_distances(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...], solid: Solid) -> np.ndarray:
    """Return signed distances [m] to triangles [triangle, 3, 3]. With ``solid="below"``, their surface continues beyond its rim at the height of the rim.

    Raises:
        ValueError: with ``solid="below"``, no triangle lies over the domain; or there are more than ``MAX_PAIRS`` pairs of a triangle and a nearby node.
    """
    from scipy.ndimage import distance_transform_edt

    if (count := _num_pairs(corners, low, spacing, counts)) > MAX_PAIRS:
        raise ValueError(
            f"{len(corners)} triangles have together {count:.3g} grid nodes near them, at most {MAX_PAIRS:.3g}; simplify the mesh, or use a wider spacing"
        )
    if solid == "below":
        above, top = _crossings(corners, low, spacing, counts, 2)
        covered = np.isfinite(top)
        if not covered.any():
            raise ValueError("the surface lies nowhere over the domain; check the options fit and up")
        rim = distance_transform_edt(~covered, return_distances=False, return_indices=True)
        top = top[tuple(rim)]
        z = low[2] + spacing * np.arange(counts[2])
        inside = np.where(covered[..., None], enclosed(above, is_oriented(corners)), z < top[..., None])
        full = covered[:-1, :-1] & covered[1:, :-1] & covered[1:, 1:] & covered[:-1, 1:]
        corners = np.concatenate([corners, _ground(top, low, spacing, ~full)])
    else:  # a majority of three rays decides, so that a crack which one ray passes through does no harm
        oriented = is_oriented(corners)
        votes = sum(enclosed(_crossings(corners, low, spacing, counts, axis)[0], oriented).astype(int) for axis in range(3))
        inside = (np.asarray(votes) >= 2) == (solid == "inside")
    return np.where(inside, -1.0, 1.0) * unsigned(corners, low, spacing, counts)


def cloud_distances(points: np.ndarray, normals: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Return signed distances [m] to a point cloud [point, 3] with unit ``normals`` [point, 3] into free space.

    They are weighted means of the distances to the tangent planes of the nearest points.

    Tangent planes are good approximations only near the cloud. Far from it, the result is the distance to the nearest point with the sign of the weighted mean.
    """
    from scipy.spatial import cKDTree

    nodes = low + spacing * np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    number = min(8, len(points))
    tree = cKDTree(points)
    gap = np.median(tree.query(points[:: max(1, len(points) // 1000)], k=number)[0][:, -1])
    distance, near = tree.query(nodes, k=number)
    plane = np.sum((nodes[:, None] - points[near]) * normals[near], axis=-1)
    weight = np.exp(-((distance**2 - distance[:, :1] ** 2) / max(float(gap), 1e-9 * spacing) ** 2))
    mean = np.sum(weight * plane, axis=1) / np.sum(weight, axis=1)
    values = np.where(distance[:, 0] < 2 * max(float(gap), spacing), mean, np.where(mean < 0, -1.0, 1.0) * distance[:, 0])
    return values.reshape(counts)


def unsigned(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Return unsigned distances [m] of grid nodes to the nearest of the triangles [triangle, 3, 3]. They are exact within ``_BAND`` cells of a triangle."""
    triangles = np.ascontiguousarray(corners, dtype=np.float64).reshape(-1, 9)
    distance = np.full(counts, np.inf)
    nearest = np.full(counts, -1, dtype=np.int64)
    origin = np.array(low, dtype=np.float64)
    _near(triangles, origin, float(spacing), _BAND, distance, nearest)
    _spread(triangles, origin, float(spacing), distance, nearest)
    return np.sqrt(distance)


def _num_pairs(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> float:
    """Return the number of pairs of a triangle and a grid node that ``unsigned`` compares.

    These are the nodes in the box around each triangle, extended by ``_BAND`` cells.
    """
    place = (corners - low) / spacing
    last = np.array(counts) - 1.0
    first = np.floor(np.clip(place.min(axis=1) - _BAND, 0.0, last))
    return float((np.floor(np.clip(place.max(axis=1) + _BAND, 0.0, last)) - first + 1).prod(axis=1).sum())


def is_oriented(faces: np.ndarray) -> bool:
    """Tell whether every edge of a face is that of another face in the other direction, as in closed meshes whose faces all look outwards.

    Args:
        faces: corners of triangles [triangle, 3, 3], or ends of segments [segment, 2, 2], whose edges are their ends.
    """
    points = faces.reshape(-1, faces.shape[-1])
    size = max(float(np.ptp(points, axis=0).max(initial=0.0)), 1e-300)
    _, number = np.unique(np.round((points - points.min(axis=0)) / (SAME_POINT * size)), axis=0, return_inverse=True)
    number = number.reshape(faces.shape[:2])
    if faces.shape[1] == 2:
        return bool(np.array_equal(np.sort(number[:, 0]), np.sort(number[:, 1])))
    start, end = number.ravel(), np.roll(number, -1, axis=1).ravel()
    there, back = (a[start != end] * (number.max() + 1) + b[start != end] for a, b in ((start, end), (end, start)))
    return bool(np.array_equal(np.sort(there), np.sort(back)))


def enclosed(crossings: np.ndarray, oriented: bool) -> np.ndarray:
    """Return whether points are inside a surface, given the sums of the signs of its crossings beyond them.

    Where parts of an oriented surface overlap, the sum is 2 or more. Without an orientation only its parity counts, and there such a place is outside.
    """
    return np.asarray(crossings != 0 if oriented else crossings % 2 == 1)


def _crossings(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...], axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum of the signs of the triangles beyond each grid node along an axis, and the last crossing on each line of nodes [m] (-inf: none).

    The sign is that of a triangle's normal along the axis. The sum is odd if the number of triangles is.
    """
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]
    hits = np.zeros([counts[k] for k in order], dtype=np.int64)
    last = np.full(hits.shape[:2], -np.inf)
    _cast(
        np.ascontiguousarray(corners[:, :, order], dtype=np.float64).reshape(-1, 9),
        np.array(low[order], np.float64),
        float(spacing),
        hits,
        last,
    )
    beyond = np.cumsum(hits[..., ::-1], axis=-1)[..., ::-1]
    return np.transpose(beyond, np.argsort(order)), last


@njit(cache=True, error_model="numpy")
@no_type_check
def _to_edge(px, py, pz, ax, ay, az, bx, by, bz):
    """Return the squared distance of p to the segment from a to b."""
    ex, ey, ez, wx, wy, wz = bx - ax, by - ay, bz - az, px - ax, py - ay, pz - az
    length = ex * ex + ey * ey + ez * ez
    t = (ex * wx + ey * wy + ez * wz) / length if length > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return (wx - t * ex) ** 2 + (wy - t * ey) ** 2 + (wz - t * ez) ** 2


@njit(cache=True, error_model="numpy")
@no_type_check
def _to_triangle(px, py, pz, t):
    """Return the squared distance of p to a triangle: to its plane if the foot point lies inside, else to the nearest edge."""
    ux, uy, uz, vx, vy, vz = t[3] - t[0], t[4] - t[1], t[5] - t[2], t[6] - t[0], t[7] - t[1], t[8] - t[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    wx, wy, wz = px - t[0], py - t[1], pz - t[2]
    area = nx * nx + ny * ny + nz * nz
    # barycentric coordinates of the foot point, times area
    b = nx * (wy * vz - wz * vy) + ny * (wz * vx - wx * vz) + nz * (wx * vy - wy * vx)
    c = nx * (uy * wz - uz * wy) + ny * (uz * wx - ux * wz) + nz * (ux * wy - uy * wx)
    if area > 0.0 and b >= 0.0 and c >= 0.0 and b + c <= area:
        return (nx * wx + ny * wy + nz * wz) ** 2 / area
    first = _to_edge(px, py, pz, t[0], t[1], t[2], t[3], t[4], t[5])
    second = _to_edge(px, py, pz, t[3], t[4], t[5], t[6], t[7], t[8])
    third = _to_edge(px, py, pz, t[6], t[7], t[8], t[0], t[1], t[2])
    return min(first, second, third)


@njit(cache=True, error_model="numpy")
@no_type_check
def _node(x, count):
    """Return the index of the node at a place along an axis; clamped to the grid."""
    return int(min(max(x, 0.0), count - 1.0))


@njit(cache=True, error_model="numpy")
@no_type_check
def _near(triangles, origin, spacing, band, distance, nearest):
    """Compute squared distances of the nodes within ``band`` cells of a triangle.

    A triangle outside the grid is compared with the nodes at the rim of the grid.
    """
    nx, ny, nz = distance.shape
    for f in range(len(triangles)):
        t = triangles[f]
        x0, x1 = (min(t[0], t[3], t[6]) - origin[0]) / spacing - band, (max(t[0], t[3], t[6]) - origin[0]) / spacing + band
        y0, y1 = (min(t[1], t[4], t[7]) - origin[1]) / spacing - band, (max(t[1], t[4], t[7]) - origin[1]) / spacing + band
        z0, z1 = (min(t[2], t[5], t[8]) - origin[2]) / spacing - band, (max(t[2], t[5], t[8]) - origin[2]) / spacing + band
        for i in range(_node(x0, nx), _node(x1, nx) + 1):
            for j in range(_node(y0, ny), _node(y1, ny) + 1):
                for k in range(_node(z0, nz), _node(z1, nz) + 1):
                    d = _to_triangle(origin[0] + i * spacing, origin[1] + j * spacing, origin[2] + k * spacing, t)
                    if d < distance[i, j, k]:
                        distance[i, j, k] = d
                        nearest[i, j, k] = f


@njit(cache=True, error_model="numpy")
@no_type_check
def _spread(triangles, origin, spacing, distance, nearest):
    """Fast sweeping: compare every node with the nearest triangles of its neighbours, in two rounds of all eight sweeping orders."""
    nx, ny, nz = distance.shape
    for sweep in range(16):
        di, dj, dk = 1 - 2 * (sweep & 1), 1 - (sweep & 2), 1 - (sweep & 4) // 2
        for a in range(nx):
            i = a if di > 0 else nx - 1 - a
            for b in range(ny):
                j = b if dj > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if dk > 0 else nz - 1 - c
                    tried = nearest[i, j, k]
                    for n in range(1, 8):
                        p, q, r = i - di * (n & 1), j - dj * ((n & 2) >> 1), k - dk * ((n & 4) >> 2)
                        if p < 0 or q < 0 or r < 0 or p >= nx or q >= ny or r >= nz:
                            continue
                        f = nearest[p, q, r]
                        if f < 0 or f == tried or f == nearest[i, j, k]:
                            continue
                        tried = f
                        d = _to_triangle(origin[0] + i * spacing, origin[1] + j * spacing, origin[2] + k * spacing, triangles[f])
                        if d < distance[i, j, k]:
                            distance[i, j, k] = d
                            nearest[i, j, k] = f


@njit(cache=True, error_model="numpy")
@no_type_check
def _cast(triangles, origin, spacing, hits, last):
    """Add the signs of the triangles that cross the line along the third axis between each node and the next one (after the last node: anywhere).

    The last crossing of each line is written to ``last``.

    Lines are moved towards the middle by at most a millionth of a cell. Otherwise they could run through edges of a mesh that is aligned with the grid or
    exactly fills it.
    """
    nx, ny, nz = hits.shape
    for f in range(len(triangles)):
        t = triangles[f]
        ax, ay, az = (t[0] - origin[0]) / spacing, (t[1] - origin[1]) / spacing, (t[2] - origin[2]) / spacing
        bx, by, bz = (t[3] - origin[0]) / spacing, (t[4] - origin[1]) / spacing, (t[5] - origin[2]) / spacing
        cx, cy, cz = (t[6] - origin[0]) / spacing, (t[7] - origin[1]) / spacing, (t[8] - origin[2]) / spacing
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        for i in range(_node(math.floor(min(ax, bx, cx)), nx), _node(math.ceil(max(ax, bx, cx)), nx) + 1):
            x = i + 1.31e-6 * ((nx - 0.93) * 0.5 - i) / nx
            for j in range(_node(math.floor(min(ay, by, cy)), ny), _node(math.ceil(max(ay, by, cy)), ny) + 1):
                y = j + 0.73e-6 * ((ny - 0.89) * 0.5 - j) / ny
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = ((ax - x) * (by - y) - (ay - y) * (bx - x)) / area
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                z = u * az + v * bz + w * cz
                last[i, j] = max(last[i, j], origin[2] + z * spacing)
                if z > 0.0:
                    hits[i, j, _node(math.ceil(z) - 1.0, nz)] += 1 if area > 0.0 else -1
