"""Points inside meshes, to find obstacles that pass between the nodes of a body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

DEPTH = 0.02
"""Smallest barycentric coordinate of a point that counts as inside a cell. What only touches a body is outside, and so is a point on a face of cells."""


def in_mesh(
    points: Float[np.ndarray, "point dim"], pos: Float[np.ndarray, "node dim"], cells: Int[np.ndarray, "cell corner"]
) -> Bool[np.ndarray, " point"]:
    """Return which points lie in cells of a mesh of triangles, convex quadrilaterals or tetrahedra.

    Args:
        points: points in m.
        pos: nodes of the mesh in m.
        cells: corners of each cell; a triangle among quadrilaterals repeats its last one.
    """
    inside = np.zeros(len(points), bool)
    simplices = _simplices(cells, pos.shape[1])
    if not len(simplices) or not len(points):
        return inside
    corners = pos[simplices]  # [simplex, corner, dim]
    centre = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max()
    near = cKDTree(centre).query_ball_point(points, reach)
    point = np.repeat(np.arange(len(points)), [len(found) for found in near])
    simplex = np.concatenate([np.asarray(found, np.int64) for found in near])
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    weights = np.einsum("sij,sj->si", np.linalg.inv(edges)[simplex], points[point] - corners[simplex, 0])
    smallest = np.minimum(weights.min(axis=1, initial=np.inf), 1 - weights.sum(axis=1))
    inside[point[smallest > DEPTH]] = True
    return inside


def _simplices(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return cells as triangles or tetrahedra [simplex, dim + 1]."""
    if cells.shape[1] == dim + 1:
        return cells
    both = np.concatenate([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
    return both[both[:, 1] != both[:, 2]]
