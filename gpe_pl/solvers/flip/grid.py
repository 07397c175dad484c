"""The staggered grid, and the space that rigid boundaries leave open in it.

Cells are numbered in C order. One index addresses a cell, its lower face along each axis, its lower edge in each plane of axes and its lowest node. Every
quantity is therefore an array over cells, and a neighbour is one stride away. Velocity components are defined on the faces, pressure and density at cell
centres, shear stress at edges (nodes in 2D), and signed distances of solids at nodes. Lengths are in cells.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gpe_pl.geometry.shapes import Shape, signed_distance
from gpe_pl.geometry.thin_parts import thickness
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.solvers.flip import transfer

PADDING = 3
"""Number of cells between the domain and the edge of the grid, for the kernels of a particle up to one cell outside."""

FAR = 1e3
"""Largest signed distance in cells; it also stands for infinity, in a domain without solids."""

SMALLEST_OPENING = 1e-3
"""Open fraction below which a face counts as closed."""

POINTS_PER_CELL = 4
"""Number of points along each axis of a cell that measure the free space around it."""

CELLS_AT_ONCE = 10_000
"""Number of cells that are filled with points at a time; this takes about 50 MB."""

HALF = 0.5
"""Open fraction of the kernel around a cell's centre below which the centre counts as solid."""


@dataclass(frozen=True)
class Grid:
    """Geometry of the grid.

    Attributes:
        counts: number of cells along each axis, padding included.
        strides: index difference of neighbours along each axis [dim].
        corners: index differences from a cell to its 2^dim corners; bit b of the corner's number belongs to axis b.
        origin: position of the lowest node [dim] in m.
        spacing: grid spacing Δ in m.
    """

    counts: np.ndarray
    strides: np.ndarray
    corners: np.ndarray
    origin: np.ndarray
    spacing: float

    @property
    def num_cells(self) -> int:
        return int(np.prod(self.counts))

    @property
    def dim(self) -> int:
        return len(self.counts)


@dataclass(frozen=True)
class Solids:
    """Open space that boundaries leave, in arrays over all cells.

    Attributes:
        distance: signed distance of nodes [cell] in cells, positive in free space.
        face_distance: signed distance of face centres [axis, cell] in cells; not positive for closed faces.
        area: open fraction of faces [axis, cell]; exactly 0 for closed faces.
        is_open: whether a cell has an open face [cell].
        cell_room: integral over free space of the kernel around each cell centre [cell]; 1 away from solids.
        face_room: integral over free space of the kernel around each face centre [axis, cell].
    """

    distance: np.ndarray
    face_distance: np.ndarray
    area: np.ndarray
    is_open: np.ndarray
    cell_room: np.ndarray
    face_room: np.ndarray


@lru_cache(maxsize=8)
def make_grid(bounds: tuple[tuple[float, float], ...], spacing: float) -> Grid:
    """Make the grid of a domain. The low corner of the domain is a node, and ``PADDING`` cells surround the domain."""
    counts = np.array([round((high - low) / spacing) + 2 * PADDING for low, high in bounds])
    strides = np.array([int(np.prod(counts[axis + 1 :])) for axis in range(len(counts))])
    corners = np.array([sum(int(s) for b, s in enumerate(strides) if k >> b & 1) for k in range(1 << len(counts))])
    return Grid(counts, strides, corners, np.array([low - PADDING * spacing for low, _ in bounds]), spacing)


@lru_cache(maxsize=4)
def make_solids(shapes: tuple[Shape, ...], bounds: tuple[tuple[float, float], ...], spacing: float) -> Solids:
    """Return the space that shapes leave open on the grid of a domain.

    Raises:
        SimulationError: with reason ``input``, if an obstacle is thinner than a cell.
    """
    for shape in shapes:
        if (thin := thickness(shape)) < spacing * (1 - 1e-6):
            message = f"obstacle {shape} is {thin:g} m thin; on a grid of spacing {spacing:g} m it must be at least that thick"
            raise SimulationError(message, reason="input")
    grid = make_grid(bounds, spacing)
    dim, counts = grid.dim, grid.counts
    # there is one more layer of nodes than of cells, so that every cell has all its corners
    lines = [o + spacing * np.arange(n + 1) for o, n in zip(grid.origin, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    distance = np.clip(signed_distance(shapes, nodes) / spacing, -FAR, FAR)
    distance[np.abs(distance) < 1e-9] = 0.0  # a node on a wall, despite rounding

    def corner(bits: tuple[int, ...]) -> np.ndarray:
        return distance[tuple(slice(bit, bit + n) for bit, n in zip(bits, counts, strict=True))]

    def corners(free: list[int]) -> list[np.ndarray]:
        """Return the values at the corners of the cell's lower facet along the free axes, the last axis fastest."""
        return [
            corner(tuple(dict(zip(free, bits, strict=True)).get(b, 0) for b in range(dim)))
            for bits in itertools.product((0, 1), repeat=len(free))
        ]

    others = [[b for b in range(dim) if b != axis] for axis in range(dim)]
    area = np.stack([_open_fraction(corners(axes)) for axes in others])
    cell_room, face_room = _rooms(shapes, grid, np.stack(corners(list(range(dim)))))
    area[area < SMALLEST_OPENING] = 0.0
    # a cell with a solid centre gets its density from open neighbours with a free centre; without such a neighbour it is closed
    free = cell_room >= HALF
    reaches = [(area[k] > 0) & np.roll(free, 1, k) | (np.roll(area[k], -1, k) > 0) & np.roll(free, -1, k) for k in range(dim)]
    closed = ~free & ~np.any(reaches, axis=0)
    for axis in range(dim):
        area[axis][closed | np.roll(closed, 1, axis)] = 0.0
    is_open = np.any([(a > 0) | (np.roll(a, -1, axis) > 0) for axis, a in enumerate(area)], axis=0)
    face_distance = np.stack([np.mean(corners(axes), axis=0) for axes in others])
    face_distance[area == 0] = np.minimum(face_distance[area == 0], 0.0)
    return Solids(
        np.ascontiguousarray(distance[tuple(slice(0, n) for n in counts)]).ravel(),
        face_distance.reshape(dim, -1),
        area.reshape(dim, -1),
        is_open.ravel(),
        np.ascontiguousarray(cell_room).ravel(),
        face_room.reshape(dim, -1),
    )


def _open_fraction(corners: list[np.ndarray]) -> np.ndarray:
    """Return the fraction of a segment or square in free space from signed distances of its corners, the last axis fastest; exact for planes along axes.

    A square is sliced along the axis with the smaller difference of distances. Equal differences take the mean of both ways. So the order of axes does not
    matter.
    """
    if len(corners) == 2:
        return _open_part(*corners)
    a, b, c, d = corners
    along_first, along_last = np.abs((c - a) + (d - b)), np.abs((b - a) + (d - c))
    across, down = _open_slices(a, b, c, d), _open_slices(a, c, b, d)
    equal = np.abs(along_last - along_first) <= 1e-9
    return np.where(equal, 0.5 * (across + down), np.where(along_last > along_first, across, down))


def _open_slices(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, slices: int = 8) -> np.ndarray:
    """Return the mean open part of segments from the side a-c of a square to its side b-d, by midpoints."""
    total = np.zeros_like(a)
    for k in range(slices):
        t = (k + 0.5) / slices
        total += _open_part((1 - t) * a + t * c, (1 - t) * b + t * d)
    return total / slices


def _open_part(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the fraction of a segment in free space from the signed distances of its ends."""
    high = np.maximum(a, b)
    return np.where(high > 0, high / np.where(high > 0, high - np.minimum(np.minimum(a, b), 0.0), 1.0), 0.0)


def _rooms(shapes: tuple[Shape, ...], grid: Grid, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``cell_room`` and ``face_room`` of ``Solids`` from the signed distances of the corners of cells [corner, …].

    Cells that a surface may cut are filled with a fine lattice of points, which are weighted with the particle kernel. Evenly spread particles therefore have
    density 1 also next to solids of any direction.
    """
    dim, points = grid.dim, POINTS_PER_CELL
    reach = 0.5 * dim**0.5  # every point of a cell is within this distance of a corner
    whole = np.min(corners, axis=0) > reach
    cut = np.argwhere(~whole & (np.max(corners, axis=0) > -reach))
    offsets = (np.stack(np.meshgrid(*[np.arange(points)] * dim, indexing="ij"), axis=-1).reshape(-1, dim) + 0.5) / points
    cell_room, viscous, touched = np.zeros(grid.num_cells), np.zeros(grid.num_cells), np.zeros(grid.num_cells, np.bool_)
    velocity, face_room = np.zeros((dim, grid.num_cells)), np.zeros((dim, grid.num_cells))
    for first in range(0, len(cut), CELLS_AT_ONCE):
        pos = grid.origin + grid.spacing * (cut[first : first + CELLS_AT_ONCE, None] + offsets).reshape(-1, dim)
        free = np.clip(0.5 + points * signed_distance(shapes, pos) / grid.spacing, 0.0, 1.0) / points**dim
        transfer.scatter(
            pos, np.zeros_like(pos), free, np.zeros(len(pos)), grid.origin, 1.0 / grid.spacing, grid.strides, grid.counts, grid.corners,
            velocity, face_room, cell_room, viscous, touched,
        )  # fmt: skip
    hats, sides = whole.astype(np.float64), [whole.astype(np.float64)] * dim
    for axis in range(dim):
        hats = _around_centers(hats, axis)
        sides = [_around_faces(x, axis) if k == axis else _around_centers(x, axis) for k, x in enumerate(sides)]
    return np.minimum(hats + cell_room.reshape(hats.shape), 1.0), np.minimum(np.stack(sides) + face_room.reshape(dim, *hats.shape), 1.0)


def _around_centers(x: np.ndarray, axis: int) -> np.ndarray:
    """Integrate a quantity that is constant in cells against a hat of half-width 1 around cell centres, along one axis."""
    return 0.75 * x + 0.125 * (np.roll(x, 1, axis) + np.roll(x, -1, axis))


def _around_faces(x: np.ndarray, axis: int) -> np.ndarray:
    """Integrate as ``_around_centers``, around lower faces."""
    return 0.5 * (x + np.roll(x, 1, axis))
