"""Obstacles that bodies can touch, for ``nn.elastic_bodies``: the plane of the nearest wall of each node, and corners of obstacles near edges of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import Shape, outward_normal
from gpe_pl.trajectory.boundary import Boundary, as_numpy

BEHIND = 0.1
"""A node deeper than this below the plane of a boundary node lies beside that face, not behind it [rest spacings]. The plane is then the last choice."""
BLUNTEST = 0.42
"""A boundary node is a corner if the mean of the unit vectors to its neighbours is longer than this. The length is the cosine of half the corner's angle, so
the angle is below 130°. On a disc with a radius of three spacings the length is 0.17."""
MOST_FRICTION = 1e6
"""Largest Coulomb coefficient."""
OPPOSITE = -1.5
"""A neighbour of a boundary node is on the other face of a thin plate if the cosines of its direction and of its normal with the node's normal add up to less.
At the tip of an obstacle with any angle they add up to at least −√2."""
TINY = 1e-300
NORMAL_STEP = 1e-4
"""Step of the differences of distances that give normals [rest spacings]."""


def nearest_walls(
    pos: Float64[Tensor, "node dim"],
    boundary: Boundary,
    shapes: Sequence[Shape],
    edge_index: Int64[Tensor, "2 edge"] | None,
    spacing: float,
    periodicity: Periodicity,
) -> Float64[Tensor, "node _"]:
    """Return normal, distance [m] and friction [node, dim + 2] of the nearest wall of each node. Nodes without an edge to the boundary have zeros.

    Shapes give exact values. Without shapes, the wall is the plane through the nearest boundary node.

    Args:
        pos: positions of nodes [m].
        boundary: boundary nodes.
        shapes: the shapes that the boundary nodes sample, where they are now; empty if unknown.
        edge_index: edges from boundary nodes (row 0) to nodes (row 1); None if there are none.
        spacing: rest spacing of nodes [m].
        periodicity: axes along which distances take the shortest way.
    """
    num_nodes, dim = pos.shape
    wall = pos.new_zeros(num_nodes, dim + 2)
    if edge_index is None or not edge_index.shape[1]:
        return wall
    if shapes:
        rows = torch.unique(edge_index[1])
        wall[rows] = _nearest_shapes(pos[rows], shapes, spacing)
        return wall
    source, target = edge_index
    displacement, normal = periodicity.shortest(pos[target] - boundary.pos[source]), boundary.normal[source].to(pos.dtype)
    height = (displacement * normal).sum(dim=1)
    square = displacement.square().sum(dim=1)
    square = square + torch.where(height < -BEHIND * spacing, 2 * square.max() + 1.0, 0.0)  # last choice: the node is beside that face
    least = square.new_full((num_nodes,), torch.inf).scatter_reduce_(0, target, square, "amin")
    count = len(square)
    edge = torch.where(square == least[target], torch.arange(count, device=pos.device), count)
    nearest = edge.new_full((num_nodes,), count).scatter_reduce_(0, target, edge, "amin")
    rows = torch.nonzero(nearest < count).flatten()
    chosen = nearest[rows]
    friction = boundary.friction[source[chosen]].clamp(max=MOST_FRICTION).to(pos.dtype)
    wall[rows] = torch.cat([normal[chosen], height[chosen, None], friction[:, None]], dim=1)
    return wall


def _nearest_shapes(pos: Tensor, shapes: Sequence[Shape], spacing: float) -> Tensor:
    """Return normal, distance and friction [node, dim + 2] of the nearest shape of each node."""
    points = as_numpy(pos)
    distance = np.stack([shape.signed_distance(points) for shape in shapes])
    nearest = distance.argmin(axis=0)
    found = np.empty((len(points), points.shape[1] + 2))
    found[:, -2] = distance[nearest, np.arange(len(points))]
    for number in np.unique(nearest):
        own = nearest == number
        found[own, :-2] = outward_normal(shapes[number], points[own], NORMAL_STEP * spacing)
        found[own, -1] = min(shapes[number].friction, MOST_FRICTION)
    wall = torch.from_numpy(found).to(pos.device)
    along = (wall[:, :-2] * _displaced(pos)).sum(dim=1, keepdim=True)
    return torch.cat([wall[:, :-2], wall[:, -2:-1] + along, wall[:, -1:]], dim=1)


def _displaced(pos: Tensor) -> Tensor:
    """Return zeros with the derivative of the positions, since distances from shapes are computed without one. Planes and corners stay where they are."""
    return pos - pos.detach()


def corners_near_edges(
    pos: Float64[Tensor, "node 2"], edges: Int64[np.ndarray, "edge 2"], boundary: Boundary, spacing: float, radius: float
) -> tuple[Int64[Tensor, "pair 2"], Float64[Tensor, "pair 3"]]:
    """Return the pairs of a convex corner of an obstacle and an edge on the surface of a body, in 2D, whose distance is below ``radius``.

    Args:
        pos: positions of the nodes of bodies [m].
        edges: nodes of the edges, see ``oriented_edges``.
        boundary: boundary nodes.
        spacing: rest spacing [m].
        radius: largest distance of a corner from an edge [m].

    Returns:
        For each pair the nodes at the ends of the edge, with the body on the left of the edge; and the vector from the first of these nodes to the corner [m]
        with the friction of the corner.
    """
    corner = convex_corners(boundary, spacing)
    where, point = as_numpy(pos), as_numpy(boundary.pos)[corner]
    first, along = where[edges[:, 0]], where[edges[:, 1]] - where[edges[:, 0]]
    way = point[None] - first[:, None]
    part = (way * along[:, None]).sum(axis=2) / np.maximum((along**2).sum(axis=1), TINY)[:, None]
    away = way - np.clip(part, 0.0, 1.0)[..., None] * along[:, None]
    edge, which = np.nonzero((away**2).sum(axis=2) < radius**2)
    ends = edges[edge]
    values = beside_first_node(where[ends[:, 0]], boundary, corner[which])
    nodes, corners = torch.from_numpy(ends).to(pos.device), torch.from_numpy(values).to(pos)
    return nodes, torch.cat([corners[:, :2] - _displaced(pos)[nodes[:, 0]], corners[:, 2:]], dim=1)


def beside_first_node(
    first: Float64[np.ndarray, "pair 2"], boundary: Boundary, corner: Int64[np.ndarray, " pair"]
) -> Float64[np.ndarray, "pair 3"]:
    """Return the way from the first nodes of edges to corners [m], and the friction of the corners, which are given as rows of the boundary."""
    friction = np.minimum(as_numpy(boundary.friction)[corner], MOST_FRICTION)
    return np.concatenate([as_numpy(boundary.pos)[corner] - first, friction[:, None]], axis=1)


def oriented_edges(rest_pos: Float64[Tensor, "node 2"], cells: Int64[Tensor, "cell corner"]) -> Int64[np.ndarray, "edge 2"]:
    """Return the edges of ``surface_edges`` with the body on the left of each.

    Args:
        rest_pos: positions of nodes at rest [m].
        cells: corners of the cells.
    """
    corners = cells.cpu().numpy()
    edges, owner = surface_edges(corners)
    x, y = as_numpy(rest_pos)[corners].transpose(2, 0, 1)
    area = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
    return np.where((area < 0)[owner, None], edges[:, ::-1], edges)  # the corners of some cells, and of mirror images, go round clockwise


def convex_corners(boundary: Boundary, spacing: float) -> np.ndarray:
    """Return the rows of boundary nodes in 2D that are convex corners. The result is cached with the boundary."""

    def find() -> np.ndarray:
        return _convex_corners(as_numpy(boundary.pos), as_numpy(boundary.normal).astype(np.float64), spacing)

    found: np.ndarray = boundary.made_once(("corners", spacing), find)
    return found


def _convex_corners(pos: np.ndarray, normal: np.ndarray, spacing: float) -> np.ndarray:
    from scipy.spatial import cKDTree

    if not len(pos):
        return np.empty(0, dtype=np.int64)
    pairs = cKDTree(pos).query_pairs(1.5 * spacing, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    way = pos[both[:, 1]] - pos[both[:, 0]]
    distance = np.linalg.norm(way, axis=1)
    apart = distance > 1e-6 * spacing  # walls share the nodes of their corners
    unit = way / np.maximum(distance, TINY)[:, None]
    apart &= ((unit + normal[both[:, 1]]) * normal[both[:, 0]]).sum(axis=1) > OPPOSITE
    total = np.zeros_like(pos)
    np.add.at(total, both[apart, 0], unit[apart])
    mean = total / np.maximum(np.bincount(both[apart, 0], minlength=len(pos)), 1)[:, None]
    is_convex = (mean * normal).sum(axis=1) < -0.1  # the neighbours are on the side of the solid; 0 at the end of a straight line
    return np.flatnonzero((np.linalg.norm(mean, axis=1) > BLUNTEST) & is_convex)


@lru_cache(maxsize=64)
def _surface_edges(data: bytes, num_corners: int) -> tuple[Int64[np.ndarray, "edge 2"], Int64[np.ndarray, " edge"]]:
    cells = np.frombuffer(data, dtype=np.int64).reshape(-1, num_corners)
    edges = np.concatenate([np.stack([cells[:, k], cells[:, (k + 1) % num_corners]], axis=1) for k in range(num_corners)])
    owner = np.tile(np.arange(len(cells)), num_corners)
    real = edges[:, 0] != edges[:, 1]
    edges, owner = edges[real], owner[real]
    _, first, times = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    own = np.sort(first[times == 1])
    own = own[_neighbours_apart(edges[own])]
    return edges[own], owner[own]


def _neighbours_apart(edges: np.ndarray) -> np.ndarray:
    """Return the numbers of the edges in the order of sets: no two edges of a set share a node, and each set takes as many of the remaining edges as it can."""
    sets: list[tuple[set[int], list[int]]] = []
    for number, ends in enumerate(edges.tolist()):
        nodes, numbers = next((own for own in sets if own[0].isdisjoint(ends)), (set(), []))
        if not numbers:
            sets.append((nodes, numbers))
        nodes.update(ends)
        numbers.append(number)
    return np.array([number for _, numbers in sets for number in numbers], dtype=np.int64)


def surface_edges(cells: np.ndarray) -> tuple[Int64[np.ndarray, "edge 2"], Int64[np.ndarray, " edge"]]:
    """Return the edges that belong to only one plane cell, each in the direction of the cell's corners, and the number of that cell. Results are cached.

    Edges that share a node are far apart in the list, so that ``nn.elastic_motion`` can compute contacts of successive edges together.
    """
    if not len(cells):
        return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64)
    cells = np.ascontiguousarray(cells, dtype=np.int64)
    return _surface_edges(cells.tobytes(), cells.shape[1])
