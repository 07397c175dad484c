"""Containment of rigid bodies: the smallest rigid motion after which no node of a body is inside a wall or obstacle.

A small rigid motion moves node i, whose arm from the centre of mass is r, by t + θ × r. Nodes near a surface have the signed distance d and the normal n.
Of all motions with n · (t + θ × r) ≥ −d at each of these nodes, the body takes the one with the least Σ m |t + θ × r|². This is the motion by impulses along
the normals at the nodes that then touch a surface. The impulses only push. It is an impact without rebound and without friction.

The impact adds no kinetic energy, up to the curvature of the nodes' paths within a frame. A body that was outside before the step may also stop there, so the
velocity 0 satisfies the conditions. They are linear, so the nearest velocity that satisfies them is not larger than the velocity before the impact.

Sources: Moreau 1988, "Unilateral contact and dry friction in finite freedom dynamics", for the impact; Lawson and Hanson 1974, "Solving least squares
problems", chapter 23, for the least distance by non-negative least squares.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from array_api_compat import array_namespace, device
from scipy.optimize import nnls

from gpe_pl.geometry.compiled_surfaces import NUM_PASSES
from gpe_pl.geometry.shapes import Shape, outward_normal, signed_distance
from gpe_pl.trajectory.boundary import Array, as_numpy
from gpe_pl.trajectory.rigid_bodies import rigid_displacement, rigid_modes

NEAR = 2.0
"""Nodes take part whose signed distance is at most this many greatest depths: a motion that lifts one end lowers the other."""
NO_MOTION = 1e-9
"""Residual of the least-squares problem, whose right-hand side has the norm 1, below which no motion satisfies the conditions."""


def put_back_body(shapes: tuple[Shape, ...], pos: Array, mass: Array, wrapped: Callable[[Array], Array], tolerance: float) -> Array | None:
    """Return the positions [body_node, dim] in m of a body without nodes inside a wall or obstacle, or None if no small rigid motion leads there.

    Args:
        shapes: walls and obstacles.
        pos: positions [body_node, dim] in m, undivided by the seam of a periodic domain.
        mass: masses [body_node] in kg.
        wrapped: returns positions inside a periodic domain.
        tolerance: depth in m up to which nodes may be inside.
    """
    for _ in range(NUM_PASSES):
        if not bool((signed_distance(shapes, wrapped(pos)) < -tolerance).any()):
            return pos
        motion = _least_motion(shapes, pos, mass, wrapped, tolerance)
        if motion is None:
            return None
        pos = pos + rigid_displacement(pos, motion, mass, 1.0)
    return None if bool((signed_distance(shapes, wrapped(pos)) < -tolerance).any()) else pos


def _least_motion(shapes: tuple[Shape, ...], pos: Array, mass: Array, wrapped: Callable[[Array], Array], tolerance: float) -> Array | None:
    """Return the least displacements [body_node, dim] by a small rigid motion that takes all nodes out, or None if there is none."""
    xp = array_namespace(pos)
    points = wrapped(pos)
    deepest = -xp.min(signed_distance(shapes, points))
    modes = rigid_modes(pos, mass)
    rows, wanted = [], []
    for shape in shapes:
        distance = shape.signed_distance(points)
        near = xp.nonzero(distance <= NEAR * deepest)[0]
        if len(near):
            normal = outward_normal(shape, points[near], step=tolerance)
            rows.append(xp.sum(modes[:, near] * normal, axis=-1).T)
            wanted.append(-distance[near] / deepest)
    matrix, right = xp.concat(rows), xp.concat(wanted)
    touching = _touching(as_numpy(matrix), as_numpy(right))
    if touching is None:
        return None
    chosen = xp.asarray(touching, device=device(pos))
    matrix, right = matrix[chosen], right[chosen]
    amounts = matrix.T @ xp.linalg.solve(matrix @ matrix.T, right[:, None])
    return deepest * xp.sum(amounts[:, :, None] * modes, axis=0)


def _touching(matrix: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Return the rows that hold with equality at the least x with ``matrix`` x ≥ ``right``, or None if no x satisfies this."""
    columns = np.concatenate([matrix.T, right[None]]).astype(np.float64)
    target = np.zeros(len(columns))
    target[-1] = 1.0
    try:
        weights, residual = nnls(columns, target)
    except RuntimeError:  # too many iterations
        return None
    return None if residual < NO_MOTION else np.flatnonzero(weights > 0)
