"""Shapes of walls and obstacles with their signed distances. Solvers, containment and pictures use the same shapes.

``Shape.signed_distance(points)`` is in m, positive in free space and negative inside the wall or obstacle. ``Shape.sample(spacing)`` places boundary nodes on
the surface. All shapes take NumPy arrays or torch tensors [..., dim].
"""

from __future__ import annotations

import base64
import binascii
import itertools
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.errors import GpeError
from gpe_pl.geometry.compiled_distance import compiled_distance, packed_shapes

Array = Any


ON_SURFACE = 1e-6
"""A point this close to a boundary, as a fraction of the boundary's extent, lies on its surface. About ten rounding errors of a float32 position."""


MOST_SAMPLED = 10_000_000
"""Maximum number of boundary nodes on one surface."""


class SamplingError(GpeError, ValueError):
    """Raised when a surface would have more than ``MOST_SAMPLED`` boundary nodes, which do not fit into memory."""


@runtime_checkable
class Shape(Protocol):
    """A rigid boundary with its boundary condition."""

    kind: ClassVar[str]

    @property
    def friction(self) -> float:
        """Coulomb friction coefficient."""
        ...

    @property
    def restitution(self) -> float:
        """Fraction of the normal velocity that a bounce returns, 0 to 1."""
        ...

    @property
    def extent(self) -> float:
        """Largest side of the bounding box [m]."""
        ...

    def signed_distance(self, points: Array) -> Array:
        """Return signed distances [...] of points [..., dim] in m, negative inside the solid."""
        ...

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [node, dim] in m and unit normals [node, dim] into free space of boundary nodes about ``spacing`` [m] apart."""
        ...


def _like(values: Sequence[float] | np.ndarray, points: Array) -> Array:
    """Convert ``values`` to the array library, precision and device of ``points``."""
    return array_namespace(points).asarray(values, dtype=points.dtype, device=device(points))


def _largest_side(low: Sequence[float], high: Sequence[float]) -> float:
    return max(b - a for a, b in zip(low, high, strict=True))


def _norm(x: Array) -> Array:
    xp = array_namespace(x)
    return xp.sqrt(xp.sum(x * x, axis=-1))


def _segment(start: np.ndarray, end: np.ndarray, spacing: float) -> np.ndarray:
    """Return points from ``start`` to ``end``, end excluded, no further apart than ``spacing``."""
    count = max(1, _count(float(np.linalg.norm(end - start)) / spacing - 1e-9))
    return start + (end - start) * (np.arange(count) / count)[:, None]


def _count(nodes: float | int) -> int:
    """Round a number of nodes up; raises ``SamplingError`` above ``MOST_SAMPLED``."""
    if not nodes <= MOST_SAMPLED:
        raise SamplingError(
            f"a wall or obstacle would have {nodes:.3g} boundary nodes, at most {MOST_SAMPLED} are made; choose a larger spacing"
        )
    return math.ceil(nodes)


def _grid(low: list[float], high: list[float], spacing: float) -> np.ndarray:
    """Return points [point, len(low)] of a regular grid over an axis-aligned face, corners included."""
    counts = [_count((b - a) / spacing - 1e-9) for a, b in zip(low, high, strict=True)]
    _count(math.prod(counts))
    axes = [np.linspace(a, b, max(2, count + 1)) for a, b, count in zip(low, high, counts, strict=True)]
    return np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=-1)


def _directions(dim: int, radius: float, spacing: float) -> np.ndarray:
    """Return unit vectors [point, dim] to points of a circle or sphere of this ``radius`` [m], which are about ``spacing`` [m] apart."""
    if dim == 2:
        count = max(6, _count(2 * math.pi * radius / spacing))
        angle: np.ndarray = 2 * math.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # golden-angle spiral: near-uniform density on the sphere
    count = max(12, _count(4 * math.pi * (radius / spacing) ** 2))
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=-1)


@dataclass(frozen=True)
class Wall:
    """A plane wall that closes one side of the domain. Free space is where ``normal · x > offset``.

    Attributes:
        normal: unit normal into free space, along one axis.
        offset: position of the plane along the normal [m].
        low, high: corners of the domain [m]; the wall is sampled between them.
        friction, restitution: as in ``Shape``.
    """

    normal: tuple[float, ...]
    offset: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "wall"

    @property
    def extent(self) -> float:
        return _largest_side(self.low, self.high)

    def signed_distance(self, points: Array) -> Array:
        axis = int(np.argmax(np.abs(self.normal)))
        return points[..., axis] * self.normal[axis] - self.offset

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        axis = int(np.argmax(np.abs(self.normal)))
        others = [k for k in range(len(self.normal)) if k != axis]
        face = _grid([self.low[k] for k in others], [self.high[k] for k in others], spacing)
        pos = np.empty((len(face), len(self.normal)))
        pos[:, others] = face
        pos[:, axis] = self.offset * self.normal[axis]
        return pos, np.broadcast_to(np.asarray(self.normal, float), pos.shape).copy()


@dataclass(frozen=True)
class Sphere:
    """A solid disc (2D) or ball (3D), given by ``center`` [m] and ``radius`` [m]; ``friction`` and ``restitution`` as in ``Shape``."""

    center: tuple[float, ...]
    radius: float
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "sphere"

    @property
    def extent(self) -> float:
        return 2.0 * self.radius

    def signed_distance(self, points: Array) -> Array:
        return _norm(points - _like(self.center, points)) - self.radius

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        normal = _directions(len(self.center), self.radius, spacing)
        return np.asarray(self.center) + self.radius * normal, normal


@dataclass(frozen=True)
class Bowl:
    """A closed spherical (2D: circular) container with ``center`` [m] and ``radius`` [m]. Everything outside of it is solid; other fields as in ``Shape``."""

    center: tuple[float, ...]
    radius: float
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "bowl"

    @property
    def extent(self) -> float:
        return 2.0 * self.radius

    def signed_distance(self, points: Array) -> Array:
        return self.radius - _norm(points - _like(self.center, points))

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        outward = _directions(len(self.center), self.radius, spacing)
        return np.asarray(self.center) + self.radius * outward, -outward


@dataclass(frozen=True)
class Box:
    """A solid box along the axes between the corners ``low`` and ``high`` [m]; ``friction`` and ``restitution`` as in ``Shape``."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "box"

    @property
    def extent(self) -> float:
        return _largest_side(self.low, self.high)

    def signed_distance(self, points: Array) -> Array:
        xp = array_namespace(points)
        low, high = _like(self.low, points), _like(self.high, points)
        q = xp.abs(points - (low + high) / 2) - (high - low) / 2
        zero = xp.zeros_like(q)
        return _norm(xp.maximum(q, zero)) + xp.minimum(xp.max(q, axis=-1), zero[..., 0])

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        dim = len(self.low)
        pos, normals = [], []
        for axis in range(dim):
            others = [k for k in range(dim) if k != axis]
            face = _grid([self.low[k] for k in others], [self.high[k] for k in others], spacing)
            for side, value in ((-1.0, self.low[axis]), (1.0, self.high[axis])):
                points = np.empty((len(face), dim))
                points[:, others] = face
                points[:, axis] = value
                normal = np.zeros_like(points)
                normal[:, axis] = side
                pos.append(points)
                normals.append(normal)
        # Faces share the nodes on edges and corners. Such a node has the mean normal of its faces.
        points, which = np.unique(np.concatenate(pos), axis=0, return_inverse=True)
        normal = np.zeros_like(points)
        np.add.at(normal, which.ravel(), np.concatenate(normals))
        return points, normal / _norm(normal)[:, None]


def _require_simple(vertices: np.ndarray) -> None:
    """Raise ``ValueError`` if an edge of the outline [vertex, 2] has no length, or if two edges touch at another point than their common vertex."""
    count, shortest = len(vertices), 1e-12 * float(np.max(np.ptp(vertices, axis=0)))
    edges = np.roll(vertices, -1, axis=0) - vertices
    for k in range(count):
        if np.linalg.norm(edges[k]) <= shortest:
            raise ValueError(f"polygon vertices {k} and {(k + 1) % count} coincide at {vertices[k].tolist()}")

    def side(k: int, point: np.ndarray) -> float:
        """Return the side of edge k on which the point lies: left (1), right (-1) or on its line (0)."""
        x, y = point - vertices[k]
        return float(np.sign(edges[k, 0] * y - edges[k, 1] * x))

    def holds(k: int, point: np.ndarray) -> bool:
        along = float(np.dot(point - vertices[k], edges[k]))
        return side(k, point) == 0 and 0 <= along <= float(np.dot(edges[k], edges[k]))

    for i in range(count):
        for j in range(i + 1, count):
            a, b, c, d = vertices[i], vertices[(i + 1) % count], vertices[j], vertices[(j + 1) % count]
            if j == i + 1 or (i == 0 and j == count - 1):  # neighbours share a vertex; neither may contain the other's far end
                far_i, far_j = (a, d) if j == i + 1 else (b, c)
                crosses = holds(i, far_j) or holds(j, far_i)
            else:
                crosses = side(i, c) * side(i, d) < 0 and side(j, a) * side(j, b) < 0
                crosses = crosses or holds(i, c) or holds(i, d) or holds(j, a) or holds(j, b)
            if crosses:
                raise ValueError(
                    f"polygon edges {i} ({a.tolist()} to {b.tolist()}) and {j} ({c.tolist()} to {d.tolist()}) intersect; the outline must be simple"
                )


@dataclass(frozen=True)
class Polygon:
    """A solid simple polygon (2D) with ``vertices`` in counter-clockwise order [m]; ``friction`` and ``restitution`` as in ``Shape``.

    Raises:
        ValueError: there are fewer than 3 vertices, edges touch or have no length, or the vertices run clockwise.
    """

    vertices: tuple[tuple[float, float], ...]
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "polygon"

    def __post_init__(self) -> None:
        v = np.asarray(self.vertices, float)
        if v.ndim != 2 or v.shape[0] < 3 or v.shape[1] != 2:
            raise ValueError(f"a polygon needs at least 3 vertices [x, y], got {self.vertices}")
        _require_simple(v)
        x, y = v[:, 0], v[:, 1]
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) <= 0:
            raise ValueError(f"polygon vertices must run counter-clockwise and enclose an area, got {self.vertices}")

    @property
    def extent(self) -> float:
        x, y = zip(*self.vertices, strict=True)
        return _largest_side((min(x), min(y)), (max(x), max(y)))

    def signed_distance(self, points: Array) -> Array:
        xp = array_namespace(points)
        squared = inside = None
        count = len(self.vertices)
        for k in range(count):
            a, b = self.vertices[k], self.vertices[(k + 1) % count]
            ex, ey = b[0] - a[0], b[1] - a[1]
            wx, wy = points[..., 0] - a[0], points[..., 1] - a[1]
            t = xp.clip((wx * ex + wy * ey) / (ex * ex + ey * ey), 0.0, 1.0)
            d2 = (wx - t * ex) ** 2 + (wy - t * ey) ** 2
            crosses = ((a[1] > points[..., 1]) != (b[1] > points[..., 1])) & (wx < ex * wy / (ey if ey != 0 else 1.0))
            squared = d2 if squared is None else xp.minimum(squared, d2)
            inside = crosses if inside is None else inside ^ crosses
        return xp.where(inside, -xp.sqrt(squared), xp.sqrt(squared))

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        pos, normals = [], []
        vertices = np.asarray(self.vertices, float)
        for a, b in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
            points = _segment(a, b, spacing)
            edge = (b - a) / np.linalg.norm(b - a)
            pos.append(points)
            normals.append(np.broadcast_to(np.array([edge[1], -edge[0]]), points.shape))
        return np.concatenate(pos), np.concatenate(normals)


MAX_GRID_NODES = 2**24
"""Maximum number of nodes of a ``DistanceGrid``. A file with more is refused before anything is unpacked."""


@dataclass(frozen=True)
class DistanceGrid:
    """A solid of any shape, given by signed distances at the nodes of a regular grid.

    Distances are interpolated multilinearly between the nodes and extrapolated linearly outside the grid.

    Attributes:
        origin: position of the first node [m].
        spacing: distance of neighbouring nodes along each axis [m].
        counts: number of nodes along each axis, at least 2.
        encoded: the distances [m] as base64 text of zlib-compressed bytes. The bytes are little-endian float32 in C order, rearranged so that all first
            bytes come before all second bytes, and so on. ``from_values`` creates it.
        friction, restitution: as in ``Shape``.

    Raises:
        ValueError: a size is invalid, sizes do not fit together, or ``encoded`` is damaged.
    """

    origin: tuple[float, ...]
    spacing: float
    counts: tuple[int, ...]
    encoded: str = field(repr=False)
    friction: float
    restitution: float = 0.0
    kind: ClassVar[str] = "distance_grid"

    def __post_init__(self) -> None:
        if len(self.counts) not in (2, 3) or len(self.origin) != len(self.counts):
            raise ValueError(f"a distance grid needs 2 or 3 axes, got origin {self.origin} and counts {self.counts}")
        if not all(isinstance(n, int) and n >= 2 for n in self.counts) or math.prod(self.counts) > MAX_GRID_NODES:
            raise ValueError(f"counts of a distance grid must be 2 or more and {MAX_GRID_NODES} together at most, got {self.counts}")
        if not 0 < self.spacing < math.inf or not all(map(math.isfinite, self.origin)):
            raise ValueError(
                f"spacing and origin of a distance grid must be finite and spacing positive, got {self.spacing} and {self.origin}"
            )
        object.__setattr__(self, "_values", _decode(self.encoded, self.counts))  # not a field, so that equality, hash and asdict ignore it

    @classmethod
    def from_values(
        cls, origin: Sequence[float] | np.ndarray, spacing: float, values: np.ndarray, friction: float, restitution: float = 0.0
    ) -> DistanceGrid:
        """Create a grid from signed distances ``values`` [node along x, node along y(, node along z)] in m, rounded to about 1/4096 of ``spacing``.

        The other arguments are fields of the class.

        Raises:
            ValueError: an axis has fewer than 2 nodes, there are too many nodes, values are not finite, or there are not 2 or 3 axes.
        """
        values = np.asarray(values, np.float64)
        if not np.isfinite(values).all():
            raise ValueError("signed distances must be finite")
        if values.size > MAX_GRID_NODES:
            raise ValueError(f"a distance grid has at most {MAX_GRID_NODES} nodes, got {values.shape}; use a wider spacing")
        quantum = 2.0 ** (math.floor(math.log2(spacing)) - 12)  # short mantissas compress well
        rounded = (np.round(values / quantum) * quantum).astype("<f4")
        planes = rounded.reshape(-1, 1).view(np.uint8).T
        encoded = base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")
        return cls(tuple(float(x) for x in origin), float(spacing), values.shape, encoded, float(friction), float(restitution))

    @property
    def values(self) -> np.ndarray:
        """Signed distances at the nodes [m], read-only float32 of shape ``counts``."""
        return self._values  # type: ignore[attr-defined, no-any-return]

    @property
    def extent(self) -> float:
        return self.spacing * (max(self.counts) - 1)

    def signed_distance(self, points: Array) -> Array:
        return self.interpolated(points)[0]

    def interpolated(self, points: Array) -> tuple[Array, Array]:
        """Return interpolated signed distances [...] of points [..., dim] in m and their gradients [..., dim]."""
        xp = array_namespace(points)
        dim, values = len(self.counts), _like(self.values.ravel(), points)
        place = (points - _like(self.origin, points)) / self.spacing
        nearest = xp.minimum(xp.maximum(place, xp.zeros_like(place)), _like([n - 1.0 for n in self.counts], points))
        cell = xp.minimum(xp.floor(nearest), _like([n - 2.0 for n in self.counts], points))
        upper = nearest - cell
        cell = xp.astype(xp.where(cell == cell, cell, xp.zeros_like(cell)), xp.int64)  # a NaN position still gives NaN, through the weights
        distance = xp.zeros_like(place[..., 0])
        slope = [xp.zeros_like(distance) for _ in range(dim)]
        for corner in itertools.product((0, 1), repeat=dim):
            index = xp.zeros_like(cell[..., 0])
            for axis in range(dim):
                index = index * self.counts[axis] + cell[..., axis] + corner[axis]
            value = values[index]
            weight = [upper[..., axis] if corner[axis] else 1 - upper[..., axis] for axis in range(dim)]
            distance = distance + value * math.prod(weight)
            for axis in range(dim):
                others = math.prod(weight[k] for k in range(dim) if k != axis)
                slope[axis] = slope[axis] + (value if corner[axis] else -value) * others
        gradient = xp.stack(slope, axis=-1)
        return distance + xp.sum(gradient * (place - nearest), axis=-1), gradient / self.spacing

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes on the part of the surface inside the grid. Every point of this part has a node within ``spacing`` [m]."""
        points = self.surface_points(spacing)
        if len(points) == 0:
            return points, points.copy()
        gradient = self.interpolated(points)[1]
        # In 2D, half of the spacing limits the gaps. In 3D, 0.8 gives the density of a square lattice and a fifth more.
        keep = _thin(points, gradient / np.maximum(_norm(gradient), 1e-9)[:, None], (0.5 if len(self.counts) == 2 else 0.8) * spacing)
        return points[keep], np.asarray(outward_normal(self, points[keep], 0.5 * min(spacing, self.spacing)))

    def surface_points(self, spacing: float) -> np.ndarray:
        """Return points [point, dim] on the surface, at most about one grid cell and about a third of ``spacing`` apart."""
        dim = len(self.counts)
        corners = [
            self.values[tuple(slice(c, n - 1 + c) for c, n in zip(corner, self.counts, strict=True))]
            for corner in itertools.product((0, 1), repeat=dim)
        ]
        # A multilinear function has a zero in a cell only if the values at the corners differ in sign.
        cells = np.argwhere((np.minimum.reduce(corners) <= 0) & (np.maximum.reduce(corners) > 0))
        if len(cells) == 0:
            return np.empty((0, dim))
        parts = max(1, math.ceil(3 * self.spacing / spacing))
        inner = np.stack(np.meshgrid(*[(np.arange(parts) + 0.5) / parts] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
        low = np.asarray(self.origin)
        high = low + self.spacing * (np.asarray(self.counts) - 1)
        found = []
        chunk = max(1, 2**20 // len(inner))
        for start in range(0, len(cells), chunk):
            points = low + self.spacing * (cells[start : start + chunk, None] + inner).reshape(-1, dim)
            distance, gradient = self.interpolated(points)
            steepness = np.maximum(_norm(gradient), 0.1)
            points = points[np.abs(distance) <= 0.5 * math.sqrt(dim) * self.spacing / parts * steepness]
            for _ in range(5):  # Newton's method along the gradient
                distance, gradient = self.interpolated(points)
                points = np.clip(points - gradient * (distance / np.maximum(_norm(gradient) ** 2, 0.01))[:, None], low, high)
            found.append(points[np.abs(self.signed_distance(points)) < 0.01 * spacing])
        return np.concatenate(found)


def _decode(encoded: str, counts: tuple[int, ...]) -> np.ndarray:
    """Decode ``DistanceGrid.encoded``; never unpacks more bytes than ``counts`` requires."""
    size = 4 * math.prod(counts)
    unpack = zlib.decompressobj()
    try:
        data = unpack.decompress(base64.b64decode(encoded.encode("ascii"), validate=True), size + 1)
    except (binascii.Error, UnicodeEncodeError, zlib.error) as error:
        raise ValueError(f"the distances of a distance grid are damaged: {error}") from None
    if len(data) != size or not unpack.eof or unpack.unused_data:
        raise ValueError(f"the distances of a distance grid do not fit its counts {counts}")
    values = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(4, -1).T).view("<f4").reshape(counts).astype(np.float32, copy=False)
    if not np.isfinite(values).all():
        raise ValueError("the distances of a distance grid are not all finite")
    values.setflags(write=False)
    return values


def _thin(points: np.ndarray, normals: np.ndarray, distance: float) -> np.ndarray:
    """Return indices of a maximal subset of points that are at least ``distance`` [m] apart, chosen in order.

    Points on the other side of a thin sheet, with an opposite normal, do not exclude each other.
    """
    from scipy.spatial import cKDTree

    tree, free, kept = cKDTree(points), np.ones(len(points), dtype=bool), []
    for k, point in enumerate(points):
        if free[k]:
            kept.append(k)
            near = np.asarray(tree.query_ball_point(point, distance))
            free[near[normals[near] @ normals[k] > -0.5]] = False
    return np.array(kept, dtype=np.int64)


def signed_distance(shapes: tuple[Shape, ...], points: Array) -> Array:
    """Return the signed distance [m] to the nearest of several shapes, negative inside any of them; +inf without shapes."""
    if isinstance(points, np.ndarray) and points.ndim == 2 and points.dtype == np.float64:
        return compiled_distance(shapes, points)
    xp = array_namespace(points)
    if points.ndim == 2 and points.dtype == xp.float64 and str(device(points)) == "cpu" and not getattr(points, "requires_grad", False):
        return xp.asarray(compiled_distance(shapes, np.asarray(points)))
    distance = xp.full(points.shape[:-1], math.inf, dtype=points.dtype, device=device(points))
    for shape in shapes:
        distance = xp.minimum(distance, shape.signed_distance(points))
    return distance


def surface_tolerance(shapes: tuple[Shape, ...]) -> float:
    """Return the distance [m] below which a point counts as on a surface: ``ON_SURFACE`` times the largest shape's extent, so that units do not matter."""
    return ON_SURFACE * packed_shapes(shapes).extent


def outward_normal(shape: Shape, points: Array, step: float) -> Array:
    """Return unit vectors [..., dim] into free space: gradients of the signed distance by central differences of ``step`` [m].

    They are zero where the gradient vanishes up to rounding, as in the middle of a plate.
    """
    xp = array_namespace(points)
    if isinstance(shape, Wall):
        return xp.zeros_like(points) + _like(shape.normal, points)
    columns = []
    for axis in range(points.shape[-1]):
        offset = _like([step if k == axis else 0.0 for k in range(points.shape[-1])], points)
        columns.append(shape.signed_distance(points + offset) - shape.signed_distance(points - offset))
    gradient = xp.stack(columns, axis=-1)
    length = _norm(gradient)
    is_known = length > 1e-6 * step
    return xp.where(is_known[..., None], gradient / xp.where(is_known, length, xp.ones_like(length))[..., None], xp.zeros_like(gradient))


def check_bounds(bounds: tuple[tuple[float, float], ...]) -> None:
    """Raise ``ValueError`` unless bounds are finite ``(low, high)`` with low < high along 2 or 3 axes."""
    if len(bounds) not in (2, 3):
        raise ValueError(f"bounds must have 2 or 3 axes, got {bounds}")
    for axis, (low, high) in enumerate(bounds):
        if not (math.isfinite(high - low) and low < high):
            raise ValueError(f"bounds[{axis}] = ({low}, {high}) must be finite with low < high")


def check_whole_cells(bounds: tuple[tuple[float, float], ...], spacing: float) -> None:
    """Raise ``ValueError`` unless bounds are valid and span a whole number of grid cells of ``spacing`` [m] along each axis."""
    check_bounds(bounds)
    for axis, (low, high) in enumerate(bounds):
        cells = (high - low) / spacing
        if not (math.isfinite(cells) and cells > 0.5 and abs(cells - round(cells)) < 1e-6 * cells):
            raise ValueError(f"bounds[{axis}] = ({low}, {high}) must span a whole number of grid cells of {spacing} m, got {cells:g}")


def domain_walls(bounds: tuple[tuple[float, float], ...], friction: dict[str, float] | float) -> tuple[Wall, ...]:
    """Create the walls of a box-shaped domain.

    Args:
        bounds: ``(low, high)`` per axis [m].
        friction: one Coulomb coefficient, or one for each wall by name (``x_low``, ``x_high``, ``y_low``, …), else ``ValueError`` is raised.
    """
    names = [f"{'xyz'[axis]}_{side}" for axis in range(len(bounds)) for side in ("low", "high")]
    each = friction if isinstance(friction, dict) else dict.fromkeys(names, friction)
    if {*each} != {*names}:
        raise ValueError(f"friction is given for {', '.join(each) or 'no wall'}; give one for each of {', '.join(names)}")
    low, high = tuple(b[0] for b in bounds), tuple(b[1] for b in bounds)
    walls = []
    for axis in range(len(bounds)):
        for sign, name in zip((1.0, -1.0), names[2 * axis : 2 * axis + 2], strict=True):
            normal = tuple(sign if k == axis else 0.0 for k in range(len(bounds)))
            walls.append(Wall(normal, low[axis] if sign > 0 else -high[axis], low, high, each[name]))
    return tuple(walls)
