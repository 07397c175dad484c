"""Meshes of bodies: triangles and quadrilaterals of outlines in 2D, tetrahedra of bodies given by a signed distance in 3D.

Every mesh is a pair ``(points [node, dim], cells [cell, corner])``. Each cell is positively oriented, every node is used, and faces match. The flattest cell
limits the time step of an explicit solver, so the last step is always an optimisation of the cells' shapes.

* Triangles: evenly spaced nodes on the outline, a hexagonal lattice inside, Delaunay triangulation, and centroidal patch smoothing (Chen & Holst 2011).
* Quadrilaterals: triangles of a square lattice of twice the spacing are merged in pairs where this makes a good quadrilateral. Each merged pair is then split
  into four quadrilaterals, and each remaining triangle into three.
* Tetrahedra: cells of a body-centred cubic lattice inside the body. Their surface is then moved onto the surface of the body.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import Delaunay, QhullError

from gpe_pl.errors import GpeError

Loop = np.ndarray
"""A closed polyline [point, 2]: the outer one counter-clockwise, holes clockwise."""

Distance = Callable[[np.ndarray], np.ndarray]
"""Signed distance [point] of points [point, 3], negative inside."""

CORNER = math.radians(30.0)
"""Angle [rad]. A point where an outline turns more than this is a corner, which the mesh keeps."""

ATTEMPTS = 8
"""Number of random lattices to try before a body counts as too fine for the spacing."""

SMALLEST_QUALITY = 0.25
"""Smallest accepted mean ratio of the worst cell (see ``shape_quality``)."""

TETRAHEDRA_PER_CUBE = 9.44
"""Number of cells of a body-centred cubic lattice in a cube as wide as the lattice's mean edge."""


class MeshingError(GpeError, ValueError):
    """Raised when details of a body are too fine for the spacing."""


# --- meshes in the plane --------------------------------------------------------------------------------------------------------------------


def triangulate(loops: list[Loop], spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mesh an outline with holes by triangles with edges of about ``spacing`` [m].

    Raises:
        MeshingError: details of the outline are finer than the spacing.
    """
    outline = [_resample(loop, spacing) for loop in loops]
    for _ in range(ATTEMPTS):
        found = _triangles(outline, _lattice(outline, spacing, rng, hexagonal=True), smooth=12)
        if found is not None:
            points, cells = found
            points = optimise_shapes(points, cells, _is_on_outline(points, outline))
            if shape_quality(points, cells).min() > SMALLEST_QUALITY:
                return points, cells
    raise MeshingError(f"no triangles of {spacing:g} m follow this outline; use a smaller spacing")


def quadrangulate(loops: list[Loop], spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mesh an outline with holes by quadrilaterals with edges of about ``spacing`` [m].

    Raises:
        MeshingError: details of the outline are finer than the spacing.
    """
    fine = [_resample(loop, spacing, multiple=2) for loop in loops]
    outline = [loop[::2] for loop in fine]
    for _ in range(ATTEMPTS):
        found = _triangles(outline, _lattice(outline, 2 * spacing, rng, hexagonal=False), smooth=1)
        if found is None:
            continue
        points, cells = found
        points, cells = _split(points, _without_ears(points, cells), outline, fine)
        points = optimise_shapes(points, cells, _is_on_outline(points, fine), iterations=60)
        if shape_quality(points, cells).min() > SMALLEST_QUALITY:
            return points, cells
    raise MeshingError(f"no quadrilaterals of {spacing:g} m follow this outline; use a smaller spacing")


def _resample(loop: Loop, spacing: float, multiple: int = 1) -> Loop:
    """Place evenly spaced points on a loop and keep its corners. The number of edges between two corners is divisible by ``multiple``."""
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], np.sum(before * after, axis=1))
    corners = np.nonzero(np.abs(turn) > CORNER)[0]
    start = int(corners[0]) if len(corners) else 0
    closed = np.concatenate([np.roll(loop, -start, axis=0), loop[start : start + 1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    stops = [*(corners - start), len(loop)] if len(corners) else [0, len(loop)]
    pieces = []
    for a, b in itertools.pairwise(stops):
        smallest = 1 if len(stops) > 2 else 3
        count = multiple * max(smallest, round((along[b] - along[a]) / (spacing * multiple)))
        at = along[a] + (along[b] - along[a]) * np.arange(count) / count
        pieces.append(np.stack([np.interp(at, along, closed[:, k]) for k in range(2)], axis=-1))
    return np.concatenate(pieces)


def _inside(points: np.ndarray, loops: list[Loop]) -> np.ndarray:
    """Return a mask [point] of the points [point, 2] inside the outer loop and outside all holes, by the even-odd rule."""
    crossings = np.zeros(len(points), dtype=int)
    for loop in loops:
        a, b = loop, np.roll(loop, -1, axis=0)
        above = (a[:, 1] > points[:, 1:]) != (b[:, 1] > points[:, 1:])
        rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
        crossings += np.sum(above & (points[:, :1] < a[:, 0] + (b - a)[:, 0] * (points[:, 1:] - a[:, 1]) / rise), axis=1)
    return crossings % 2 == 1


def _distance(points: np.ndarray, loops: list[Loop]) -> np.ndarray:
    """Return distances [point] of points [point, 2] to the nearest loop."""
    nearest = np.full(len(points), math.inf)
    for loop in loops:
        edge = np.roll(loop, -1, axis=0) - loop
        offset = points[:, None] - loop
        t = np.clip(np.sum(offset * edge, axis=-1) / np.sum(edge * edge, axis=-1), 0.0, 1.0)
        nearest = np.minimum(nearest, np.sqrt(np.min(np.sum((offset - t[..., None] * edge) ** 2, axis=-1), axis=1)))
    return nearest


def _lattice(loops: list[Loop], spacing: float, rng: np.random.Generator, hexagonal: bool) -> np.ndarray:
    """Return points [point, 2] of a randomly turned and shifted lattice inside an outline, more than 0.62 spacings away from it."""
    low, high = loops[0].min(axis=0), loops[0].max(axis=0)
    middle, reach = (low + high) / 2, math.ceil(0.5 * float(np.linalg.norm(high - low)) / spacing * 1.2) + 1
    index = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1.0)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    if hexagonal:
        index = np.stack([index[:, 0] + 0.5 * (index[:, 1] % 2), math.sqrt(0.75) * index[:, 1]], axis=-1)
    angle = rng.uniform(0, math.pi / 2)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = middle + spacing * (index + rng.uniform(-0.5, 0.5, 2) + rng.uniform(-1e-3, 1e-3, index.shape)) @ turn.T
    points = points[np.all((points > low) & (points < high), axis=1)]
    points = points[_inside(points, loops)]
    return points[_distance(points, loops) > 0.62 * spacing]


def _triangles(loops: list[Loop], inner: np.ndarray, smooth: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return Delaunay triangles of the points on the loops, which come first, and of inner points, which are smoothed.

    Returns None if the surface of the triangles differs from the loops, or a point belongs to no triangle.
    """
    rim = np.concatenate(loops)
    points = np.concatenate([rim, inner])
    cells = np.empty((0, 3), dtype=np.int64)
    for k in range(smooth + 1):
        try:
            cells = Delaunay(points).simplices.astype(np.int64)
        except (QhullError, ValueError):
            return None
        cells = cells[_inside(points[cells].mean(axis=1), loops)]
        area = _signed_volumes(points, cells)
        cells[area < 0] = cells[area < 0][:, ::-1]
        cells = cells[np.abs(area) > 1e-6 * np.mean(np.abs(area))]
        if k < smooth:  # move inner points to the weighted mean of the surrounding centroids
            weight, pull = np.zeros(len(points)), np.zeros_like(points)
            area = np.repeat(_signed_volumes(points, cells), 3)
            np.add.at(weight, cells.ravel(), area)
            np.add.at(pull, cells.ravel(), area[:, None] * np.repeat(points[cells].mean(axis=1), 3, axis=0))
            free = np.arange(len(points)) >= len(rim)
            free &= weight > 0
            points[free] = pull[free] / weight[free][:, None]
    first, expected = 0, set()
    for loop in loops:
        index = first + np.arange(len(loop))
        expected |= {frozenset(edge) for edge in zip(index.tolist(), np.roll(index, -1).tolist(), strict=True)}
        first += len(loop)
    if {frozenset(face) for face in surface_faces(cells).tolist()} != expected or len(np.unique(cells)) != len(points):
        return None
    return points, cells


def _is_on_outline(points: np.ndarray, loops: list[Loop]) -> np.ndarray:
    """Return a mask [node] of the nodes that lie on the loops, found by position."""
    rim = {point.tobytes() for loop in loops for point in np.ascontiguousarray(loop)}
    return np.array([point.tobytes() in rim for point in np.ascontiguousarray(points)])


def _without_ears(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Divide triangles that alone fill a wide angle of the outline, by flipping their inner edge so that it ends in that angle."""
    cells = cells.copy()
    owners: dict[frozenset[int], list[int]] = {}
    for number, cell in enumerate(cells.tolist()):
        for k in range(3):
            owners.setdefault(frozenset((cell[k], cell[k - 1])), []).append(number)
    flipped: set[int] = set()
    for number, cell in enumerate(cells.tolist()):
        inner = [edge for edge in (frozenset((cell[k], cell[k - 1])) for k in range(3)) if len(owners[edge]) == 2]
        if len(inner) != 1:
            continue
        tip = next(n for n in cell if n not in inner[0])
        k = cell.index(tip)
        right, left = cell[(k + 1) % 3], cell[(k + 2) % 3]
        a, b = points[right] - points[tip], points[left] - points[tip]
        other = next(c for c in owners[inner[0]] if c != number)
        if np.dot(a, b) < -0.5 * np.linalg.norm(a) * np.linalg.norm(b) and not flipped & {number, other}:  # wider than 120 degrees
            far = next(n for n in cells[other].tolist() if n not in inner[0])
            cells[number], cells[other] = (tip, right, far), (tip, far, left)
            flipped |= {number, other}
    return cells


def _split(points: np.ndarray, cells: np.ndarray, outline: list[Loop], fine: list[Loop]) -> tuple[np.ndarray, np.ndarray]:
    """Merge pairs of triangles where this makes a good quadrilateral, and split every cell into quadrilaterals around its centre."""
    pairs: dict[tuple[int, int], list[int]] = {}
    for number, cell in enumerate(cells.tolist()):
        for k in range(3):
            pairs.setdefault((min(cell[k], cell[k - 1]), max(cell[k], cell[k - 1])), []).append(number)
    joined = [(a, b, edge) for edge, owners in pairs.items() if len(owners) == 2 for a, b in [owners]]
    shapes = []
    for a, b, edge in joined:
        across = [next(n for n in cells[c].tolist() if n not in edge) for c in (a, b)]
        turned = cells[a].tolist()
        k = turned.index(across[0])
        shapes.append([across[0], turned[(k + 1) % 3], across[1], turned[(k + 2) % 3]])
    quality = shape_quality(points, np.array(shapes, dtype=np.int64).reshape(-1, 4))
    merged, polygons = np.zeros(len(cells), dtype=bool), []
    for k in np.argsort(-quality, kind="stable"):
        a, b, _ = joined[k]
        if quality[k] > 0.6 and not (merged[a] or merged[b]):
            merged[[a, b]] = True
            polygons.append(shapes[k])
    polygons += cells[~merged].tolist()
    # The middle of an edge on the outline is a point of the fine outline.
    middles: dict[tuple[int, int], np.ndarray] = {}
    first = 0
    for coarse, loop in zip(outline, fine, strict=True):
        for k in range(len(coarse)):
            i, j = first + k, first + (k + 1) % len(coarse)
            middles[min(i, j), max(i, j)] = loop[2 * k + 1]
        first += len(coarse)
    nodes, of_edge, quads = list(points), {}, []
    for polygon in polygons:
        center = len(nodes)
        nodes.append(points[polygon].mean(axis=0))
        edges = []
        for i, j in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
            key = (min(i, j), max(i, j))
            if key not in of_edge:
                of_edge[key] = len(nodes)
                nodes.append(middles.get(key, (points[i] + points[j]) / 2))
            edges.append(of_edge[key])
        quads += [[polygon[k], edges[k], center, edges[k - 1]] for k in range(len(polygon))]
    return np.array(nodes), np.array(quads, dtype=np.int64)


# --- tetrahedra -----------------------------------------------------------------------------------------------------------------------------


def tetrahedralise(distance: Distance, reach: float, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mesh a body by tetrahedra. The body's edges and corners are rounded at the scale of ``spacing``.

    Args:
        distance: signed distance of the body, at least near its surface.
        reach: half the width of a cube around the origin that contains the body [m].
        spacing: mean edge length [m].
        rng: random numbers that turn and shift the lattice.

    Raises:
        MeshingError: the body is thinner than about two spacings somewhere.
    """
    for _ in range(ATTEMPTS):
        points, cells = _cubic_lattice(reach, spacing, rng)
        depth = -distance(points[cells].mean(axis=1))
        volume = np.sum(_signed_volumes(points, cells[depth > 0]))
        # Peeling removes about as much volume at the surface as this threshold adds.
        cells = _largest_part(_peeled(cells[depth > -0.15 * spacing]))
        if len(cells) == 0:
            continue
        points, cells = _compact(points, cells)
        surface = np.unique(surface_faces(cells))
        points = _pull_to_surface(points, cells, surface, distance, spacing)
        if shape_quality(points, cells).min() > SMALLEST_QUALITY and np.sum(_signed_volumes(points, cells)) > 0.7 * volume:
            return points, cells
    raise MeshingError(f"no tetrahedra of {spacing:g} m fill this body; use a smaller spacing")


def _cubic_lattice(reach: float, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return Delaunay tetrahedra of a randomly turned and shifted body-centred cubic lattice that covers a cube."""
    width = spacing / ((8 * math.sqrt(0.75) + 6) / 14)
    count = math.ceil(math.sqrt(3.0) * reach / width) + 1
    index = np.stack(np.meshgrid(*[np.arange(-count, count + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.concatenate([index, index + 0.5])
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = width * (index + rng.uniform(-0.5, 0.5, 3)) @ turn.T
    points = points[np.all(np.abs(points) < reach + 1.5 * width, axis=1)]
    # Delaunay triangulation can cut each octahedron of the lattice in several equally good ways. Small random shifts choose one.
    cells = Delaunay(points + 1e-4 * width * rng.uniform(-1, 1, points.shape)).simplices.astype(np.int64)
    volume = _signed_volumes(points, cells)
    cells[volume < 0] = cells[volume < 0][:, [1, 0, 2, 3]]
    return points, cells[np.abs(volume) > 0.5 * width**3 / 12]


def _peeled(cells: np.ndarray) -> np.ndarray:
    """Remove cells with two or more surface faces. Such cells would become flat when their nodes move onto a smooth surface."""
    while len(cells):
        faces = np.sort(np.concatenate([np.delete(cells, k, axis=1) for k in range(4)]), axis=1)
        _, which, times = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
        open_faces = np.sum((times[which.ravel()] == 1).reshape(4, -1), axis=0)
        if not np.any(open_faces > 1):
            break
        cells = cells[open_faces <= 1]
    return cells


def _largest_part(cells: np.ndarray) -> np.ndarray:
    """Return the cells of the largest part that is connected through faces."""
    if len(cells) == 0:
        return cells
    faces = np.sort(np.concatenate([np.delete(cells, k, axis=1) for k in range(4)]), axis=1)
    owner = np.tile(np.arange(len(cells)), 4)
    order = np.lexsort(faces.T)
    same = np.all(faces[order][1:] == faces[order][:-1], axis=1)
    a, b = owner[order][:-1][same], owner[order][1:][same]
    part = np.arange(len(cells))
    while True:
        lowest = part.copy()
        np.minimum.at(lowest, a, part[b])
        np.minimum.at(lowest, b, part[a])
        if np.array_equal(lowest, part):
            break
        part = lowest
    return cells[part == np.argmax(np.bincount(part))]


def _compact(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, cells = np.unique(cells, return_inverse=True)
    return points[used], cells.reshape(-1, 4)


def _pull_to_surface(points: np.ndarray, cells: np.ndarray, surface: np.ndarray, distance: Distance, spacing: float) -> np.ndarray:
    """Move nodes so that the cells have good shapes and the surface nodes lie on the surface of the body."""

    def misfit(at: np.ndarray) -> tuple[float, np.ndarray]:
        gap, slope = distance(at[surface]) / spacing, np.zeros_like(at)
        slope[surface] = 2 * gap[:, None] * _gradient(distance, at[surface], spacing) / spacing
        return float(np.sum(gap**2)), slope

    points = optimise_shapes(points, cells, np.zeros(len(points), dtype=bool), iterations=80, penalty=misfit)
    for _ in range(3):
        points[surface] -= distance(points[surface])[:, None] * _gradient(distance, points[surface], spacing)
    fixed = np.zeros(len(points), dtype=bool)
    fixed[surface] = True
    return optimise_shapes(points, cells, fixed)


def _gradient(distance: Distance, points: np.ndarray, spacing: float) -> np.ndarray:
    """Return unit vectors [point, 3] away from the body."""
    step = 1e-4 * spacing
    slope = np.stack([distance(points + step * e) - distance(points - step * e) for e in np.eye(3)], axis=-1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-300)


# --- shapes of cells ------------------------------------------------------------------------------------------------------------------------


def _signed_volumes(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return volumes (areas in 2D) of simplices [cell], negative for inverted ones."""
    dim = points.shape[1]
    corners = points[cells]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / math.factorial(dim)


def surface_faces(cells: np.ndarray) -> np.ndarray:
    """Return faces [face, corner] that belong to only one of the triangles or tetrahedra ``cells`` [cell, corner]."""
    faces = np.concatenate([np.delete(cells, k, axis=1) for k in range(cells.shape[1])])
    _, first, times = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[times == 1]]


def _simplices(cells: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return simplices that measure the shapes of cells, and the inverse edge matrix of the ideal simplex.

    A quadrilateral is measured by the triangles at its four corners, which are right-angled in the ideal case.
    """
    if dim == 3:
        ideal = np.array([[1.0, 0.0, 0.0], [0.5, math.sqrt(0.75), 0.0], [0.5, math.sqrt(1 / 12), math.sqrt(2 / 3)]])
        return cells, np.linalg.inv(ideal)
    if cells.shape[1] == 3:
        return cells, np.linalg.inv(np.array([[1.0, 0.0], [0.5, math.sqrt(0.75)]]))
    corners = np.stack([cells[:, [k, (k + 1) % 4, (k + 3) % 4]] for k in range(4)], axis=1)
    return corners.reshape(-1, 3), np.eye(2)


def shape_quality(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the mean ratio of each cell [cell]: 1 for a regular simplex or a square, 0 for a flat cell, negative for an inverted one (Knupp 2001).

    The mean ratio is ``d det(A)^(2/d) / |A|²`` with A the map from the ideal cell. For a quadrilateral it is the value at the worst corner.
    """
    dim = points.shape[1]
    simplices, inverse = _simplices(cells, dim)
    edges = inverse @ (points[simplices][:, 1:] - points[simplices][:, :1])
    determinant = np.linalg.det(edges)
    ratio = dim * np.sign(determinant) * np.abs(determinant) ** (2 / dim) / np.sum(edges**2, axis=(1, 2))
    return ratio.reshape(len(cells), -1).min(axis=1)


def optimise_shapes(
    points: np.ndarray,
    cells: np.ndarray,
    fixed: np.ndarray,
    iterations: int = 30,
    penalty: Callable[[np.ndarray], tuple[float, np.ndarray]] | None = None,
) -> np.ndarray:
    """Return positions of the nodes [node, dim] that minimise ``Σ q^-dim`` plus a penalty, with the mean ratios q of ``shape_quality``.

    The determinant is regularised, ``(det + √(det² + δ²))/2``, so that inverted cells are turned back (Escobar et al. 2003). The sum runs over the cells, and
    over the four corners of each quadrilateral.

    Args:
        points: positions of the nodes [node, dim].
        cells: corners of the cells [cell, corner].
        fixed: mask of nodes that do not move [node].
        iterations: maximum number of iterations of L-BFGS-B.
        penalty: function of the positions that returns an additional cost and its gradient [node, dim]. The cost is multiplied by 20.
    """
    points = np.array(points)
    if np.all(fixed) or len(cells) == 0:
        return points
    dim = points.shape[1]
    simplices, inverse = _simplices(cells, dim)
    scale = float(np.mean(np.abs(np.linalg.det(inverse @ (points[simplices][:, 1:] - points[simplices][:, :1]))))) ** (1 / dim)
    origin, delta = points.mean(axis=0), 0.02

    def cost(free: np.ndarray) -> tuple[float, np.ndarray]:
        at = (points - origin) / scale
        at[~fixed] = free.reshape(-1, dim)
        corners = at[simplices]
        edges = inverse @ (corners[:, 1:] - corners[:, :1])
        cofactor = _cofactor(edges)
        determinant = np.sum(edges[:, 0] * cofactor[:, 0], axis=1)
        root = np.sqrt(determinant**2 + delta**2)
        bounded = (determinant + root) / 2
        square = np.sum(edges**2, axis=(1, 2)) / dim
        distortion = square**dim / bounded**2
        # d distortion / d edges
        slope = 2 * distortion[:, None, None] * (edges / square[:, None, None] - cofactor / root[:, None, None])
        pull = inverse.T @ slope
        gradient = np.zeros_like(at)
        for k in range(dim):
            gradient += np.stack([np.bincount(simplices[:, k + 1], pull[:, k, axis], len(at)) for axis in range(dim)], axis=-1)
        total = pull.sum(axis=1)
        gradient -= np.stack([np.bincount(simplices[:, 0], total[:, axis], len(at)) for axis in range(dim)], axis=-1)
        value = float(np.sum(distortion))
        if penalty is not None:
            extra, slope = penalty(origin + scale * at)
            value, gradient = value + 20.0 * extra, gradient + 20.0 * scale * slope
        return value, gradient[~fixed].ravel()

    start = ((points - origin) / scale)[~fixed].ravel()
    best = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations, "maxcor": 10})
    points[~fixed] = origin + scale * best.x.reshape(-1, dim)
    return points


def _cofactor(matrices: np.ndarray) -> np.ndarray:
    """Return derivatives of determinants with respect to the matrices' entries [matrix, dim, dim]."""
    if matrices.shape[-1] == 2:
        return np.stack([matrices[:, 1, ::-1] * [1, -1], matrices[:, 0, ::-1] * [-1, 1]], axis=1)
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
