"""Mirror symmetry: whether a symmetric scene stays symmetric, and whether the mirror image of any scene moves like the scene itself, mirrored.

The planes of symmetric scenes are vertical, pass through the centre of mass and are normal to an axis along which there is no gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree

from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.trajectory.boundary import nodes_beside_shapes
from gpe_pl.trajectory.cells import bodies, cell_edges
from gpe_pl.trajectory.reflection import Reflection, without_gravity
from gpe_pl.trajectory.trajectory import Trajectory

CLOSE = 0.01
"""Tolerance for mirror symmetry: of positions in rest spacings, and of velocities as a fraction of the largest one."""


@dataclass(frozen=True)
class Mirror:
    """A plane that maps a scene onto itself.

    Attributes:
        axis: axis normal to the plane.
        offset: position of the plane along the axis [m].
        partner: for each node, the number of the node at the place of its mirror image.
    """

    axis: int
    offset: float
    partner: Int64[np.ndarray, "node"]

    def image(self, pos: Float[np.ndarray, "*axes dim"]) -> Float[np.ndarray, "*axes dim"]:
        """Return the mirror images of positions [m]."""
        return Reflection.at(self.axis, self.offset, pos.shape[-1]).point(pos)


def mirrors(truth: Trajectory) -> list[Mirror]:
    """Return the vertical planes about which a scene is symmetric.

    A scene is symmetric if its first frame equals its mirror image in positions, velocities, masses and materials, in the bodies that meshes and rigid bodies
    make of its nodes, and in the rest shapes of meshes; if given motions and forces do in all frames; and if the walls and obstacles near nodes of any frame
    do, with their friction and restitution. Mesh cells themselves are not compared, because the diagonals of a lattice of triangles are rarely symmetric:
    nodes of one cell need partners in one body that are as far apart at rest. The list is empty in periodic domains, and if the boundary moves or has nodes
    that belong to no shape.
    """
    metadata, boundary = truth.metadata, truth.boundary
    if any(metadata.periodic) or boundary.motion is not None or boundary.vel.any() or nodes_beside_shapes(boundary).any():
        return []
    pos, vel = truth.pos.astype(np.float64), truth.vel[0].astype(np.float64)
    weight = truth.mass.astype(np.float64) / truth.mass.sum(dtype=np.float64)
    close, fastest = CLOSE * metadata.spacing, np.abs(vel).max(initial=0.0)
    found = []
    for axis in without_gravity(metadata.gravity):
        mirror = Mirror(axis, float(weight @ pos[0, :, axis]), np.arange(truth.num_nodes))
        distance, partner = cKDTree(pos[0]).query(mirror.image(pos[0]))
        if not (distance <= close).all() or len(np.unique(partner)) < len(partner):
            continue
        opposite = vel[partner] * np.where(np.arange(metadata.dim) == axis, -1.0, 1.0)
        same = np.abs(vel - opposite).max() <= CLOSE * fastest and (truth.node_type == truth.node_type[partner]).all()
        same = same and np.allclose(truth.mass, truth.mass[partner], rtol=1e-3)
        same = same and np.allclose(truth.material_params, truth.material_params[partner], rtol=1e-3, equal_nan=True)
        with_partners = Mirror(axis, mirror.offset, partner)
        same = same and _has_mirrored_bodies(truth, partner)
        if same and _has_mirrored_surroundings(truth, pos, with_partners) and _has_mirrored_loads(truth, with_partners):
            found.append(with_partners)
    return found


def _has_mirrored_bodies(truth: Trajectory, partner: np.ndarray) -> bool:
    """Tell whether the partners of a rigid body's or of a mesh's nodes are those of one body, too, and of a mesh with the same shape at rest."""
    if truth.rigid_body is not None and not _are_mapped(truth.rigid_body, partner):
        return False
    if truth.cells is None:
        return True
    edges, label = cell_edges(truth.cells.astype(np.int64), truth.num_nodes), np.full(truth.num_nodes, -1)
    for number, nodes in enumerate(bodies(truth.cells, truth.num_nodes)):
        label[nodes] = number
    if not _are_mapped(label, partner):
        return False
    if truth.rest_pos is None:
        return True
    rest = truth.rest_pos.astype(np.float64)
    own, opposite = (np.linalg.norm(rest[start] - rest[end], axis=1) for start, end in (edges, partner[edges]))
    return bool(np.abs(own - opposite).max(initial=0.0) <= CLOSE * truth.metadata.spacing)


def _are_mapped(body: np.ndarray, partner: np.ndarray) -> bool:
    """Tell whether all nodes of a body have partners in one body, whose number is another or the same. Nodes with −1 belong to none."""
    pairs = np.unique(np.stack([body, body[partner]]), axis=1)
    return len(pairs.T) == len(np.unique(body)) and bool(((pairs[0] < 0) == (pairs[1] < 0)).all())


def _has_mirrored_surroundings(truth: Trajectory, pos: np.ndarray, mirror: Mirror) -> bool:
    """Tell whether the nodes of all frames are as far from the surfaces of each friction and restitution as their mirror images, within the radius."""
    shapes, most = truth.boundary.shapes, truth.metadata.connectivity_radius
    for kind in {(shape.friction, shape.restitution) for shape in shapes}:
        alike = tuple(shape for shape in shapes if (shape.friction, shape.restitution) == kind)
        near, there = (np.minimum(signed_distance(alike, x), most) for x in (pos, mirror.image(pos)))
        if np.abs(near - there).max() > CLOSE * truth.metadata.spacing:
            return False
    return True


def _has_mirrored_loads(truth: Trajectory, mirror: Mirror) -> bool:
    """Tell whether given motions and forces equal their mirror images in all frames."""
    held, force, partner = truth.prescribed, truth.force, mirror.partner
    if held is not None:
        pos = truth.pos.astype(np.float64)
        distance = np.abs(pos - mirror.image(pos)[:, partner])[:, held]
        if (held != held[partner]).any() or distance.max(initial=0.0) > CLOSE * truth.metadata.spacing:
            return False
    if force is None:
        return True
    opposite = force[:, partner] * np.where(np.arange(truth.metadata.dim) == mirror.axis, -1.0, 1.0)
    return bool(np.abs(force - opposite).max(initial=0.0) <= CLOSE * np.abs(force).max(initial=0.0))


def mirror_error(prediction: Trajectory, truth: Trajectory, mirror: Mirror, num_steps: int) -> float:
    """Return ‖x − Mx‖ / ‖x̂ − x̂(0)‖ over frames 1 to ``num_steps``, with x the prediction, Mx its mirror image and x̂ the ground truth."""
    pos, true = (t.pos[: num_steps + 1].astype(np.float64) for t in (prediction, truth))
    return _relative(pos[1:] - mirror.image(pos[1:])[:, mirror.partner], true[1:] - true[0])


def equivariance_error(prediction: Trajectory, mirrored: Trajectory) -> float:
    """Return ‖x − y‖ / ‖x − x(0)‖ over all frames, with x a rollout of a simulator and y that of the same simulator in ``rollout.mirrored.Mirrored``.

    It is zero if the simulator moves the mirror image of a scene like the scene itself, mirrored. It is infinite if one of the rollouts stopped earlier.
    """
    if prediction.num_frames != mirrored.num_frames:
        return math.inf
    space = prediction.metadata.periodicity
    pos, other = (t.pos.astype(np.float64) for t in (prediction, mirrored))
    way = np.cumsum(space.shortest(np.diff(pos, axis=0)), axis=0)  # a node may have moved by more than half a period
    return _relative(space.shortest(pos - other), way)


def _relative(error: np.ndarray, reference: np.ndarray) -> float:
    size, scale = float(np.linalg.norm(error)), float(np.linalg.norm(reference))
    return size / scale if scale > 0 else (0.0 if size == 0 else math.inf)
