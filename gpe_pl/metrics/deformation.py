"""Deformation of bodies: the part of a body's motion that its best rigid motion does not explain, and the elastic energy in its cells.

With X the rest positions and x the positions of one body relative to its centre of mass, and m the masses of its nodes::

    R = argmin Σ m |x - R X|² over rotations,   u = Rᵀ x - X

u is the deformation field in the frame of the body. It is zero for every rigid motion. R is a proper rotation, so a mirror image counts as deformed.

Source: Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A 32 (1976), with masses as weights.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gpe_pl.schema import CELL_KINDS, MESH_MATERIALS, node_code
from gpe_pl.trajectory.cells import kinds_of, mean_over_corners
from gpe_pl.trajectory.strain import deformation_gradients, lame_parameters, neo_hookean_density, shape_gradients
from gpe_pl.trajectory.trajectory import Metadata, Trajectory


@dataclass(frozen=True)
class BodyMotion:
    """Motion of one body, split into its best rigid motion and the rest.

    Attributes:
        centre: centre of mass [frame, dim] in m.
        rotation: rotation R from the undeformed body [frame, dim, dim].
        field: deformation field u [frame, node, dim] in m, in the frame of the body.
        mass: masses [node] in kg.
    """

    centre: Float[np.ndarray, "frame dim"]
    rotation: Float[np.ndarray, "frame dim dim"]
    field: Float[np.ndarray, "frame node dim"]
    mass: Float[np.ndarray, "node"]

    @property
    def rms_deformation(self) -> Float[np.ndarray, "frame"]:
        """Root mean square of u over the mass of the body [m]."""
        return np.sqrt(np.einsum("n,fnd,fnd->f", self.mass / self.mass.sum(), self.field, self.field))

    @property
    def tilt(self) -> Float[np.ndarray, "frame"]:
        """Angle by which the body has turned since it was undeformed [deg], from 0 to 180."""
        return rotation_angle(self.rotation)


def body_motion(
    rest_pos: Float[np.ndarray, "node dim"], pos: Float[np.ndarray, "frame node dim"], mass: Float[np.ndarray, "node"]
) -> BodyMotion:
    """Return the motion of one body.

    In a frame whose positions are not finite, every result is NaN. A folded or inverted body is a deformed body. If it has no unique best rotation, such as
    a body shrunk to a point, the rms deformation is still unique.

    Args:
        rest_pos: undeformed positions [m].
        pos: positions [m].
        mass: masses [kg].
    """
    pos, rest_pos, mass = pos.astype(np.float64), rest_pos.astype(np.float64), mass.astype(np.float64)
    pos = np.where(np.isfinite(pos).all(axis=(1, 2), keepdims=True), pos, np.nan)
    weight = mass / mass.sum()
    centre, rest = np.einsum("n,fnd->fd", weight, pos), rest_pos - weight @ rest_pos
    arm = pos - centre[:, None]
    moment = np.einsum("n,fni,nj->fij", weight, arm, rest)
    # Scaled to 1, so that the rotation is the same in all units. Frames that are not finite get any rotation here.
    size = np.abs(moment).max(axis=(1, 2), keepdims=True, initial=0.0)
    good = np.isfinite(size)
    left, _, right = np.linalg.svd(np.where(good, moment / np.where(good & (size > 0), size, 1.0), np.eye(pos.shape[2])))
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[:, None]  # the smallest singular value makes up for a reflection
    rotation = np.where(good, left @ right, np.nan)
    return BodyMotion(centre, rotation, arm @ rotation - rest, mass)


def rotation_angle(rotation: Float[np.ndarray, "*axes dim dim"]) -> Float[np.ndarray, "*axes"]:
    """Return the angle of rotations in 2D or 3D [deg], from 0 to 180, without loss of precision for small angles."""
    dim = rotation.shape[-1]
    sine = np.linalg.norm(rotation - rotation.swapaxes(-1, -2), axis=(-2, -1)) / np.sqrt(8)
    cosine = (np.trace(rotation, axis1=-2, axis2=-1) - (dim - 2)) / 2
    return np.degrees(np.arctan2(sine, cosine))


def strain_energy(trajectory: Trajectory) -> Float[np.ndarray, "frame"] | None:
    """Return the elastic energy in all mesh cells [J] (per metre of depth in 2D), by the law of the solvers (``trajectory.strain``).

    A cell takes the mean of Young's modulus and Poisson's ratio over its corners, as the finite element solver does. Poisson's ratio is a material parameter,
    or a setting of the solver in the metadata. Crushed and inverted cells have a large, finite energy. The material point solver keeps a deformation gradient
    per particle, so its own energy differs from that of the cells between its particles. In a periodic domain, a cell must be smaller than half of it.

    Returns:
        None without a mesh, for lines, surfaces in 3D and wedges, and where Young's modulus or Poisson's ratio is not known.
    """
    if trajectory.cells is None or trajectory.rest_pos is None or not len(trajectory.cells):
        return None
    dim, cells = trajectory.metadata.dim, trajectory.cells.astype(np.int64)
    modulus, poisson_ratio = (mean_over_corners(values, cells) for values in _elastic_constants(trajectory))
    kinds = kinds_of(cells, trajectory.cell_dim, dim)
    solid = [code for code, (own_dim, corners) in enumerate(CELL_KINDS.values()) if own_dim == dim and corners in (dim + 1, 2**dim)]
    if trajectory.cell_dim not in (None, dim) or not (np.isin(kinds, solid) & np.isfinite(modulus) & np.isfinite(poisson_ratio)).all():
        return None
    lam, mu = lame_parameters(modulus, poisson_ratio)
    energy = np.zeros(trajectory.num_frames)
    rest = trajectory.rest_pos.astype(np.float64)
    for code in np.unique(kinds):
        chosen = kinds == code
        corners = cells[chosen, : list(CELL_KINDS.values())[code][1]]
        gradient, volume = shape_gradients(_whole(rest[corners], trajectory.metadata))
        volume = np.abs(volume)  # corners in the reverse order describe the same cell
        for frame in range(trajectory.num_frames):
            deformation = deformation_gradients(_whole(trajectory.pos[frame, corners].astype(np.float64), trajectory.metadata), gradient)
            energy[frame] += np.sum(neo_hookean_density(deformation, lam[chosen], mu[chosen]) * volume)
    return energy


def _whole(corners: Float[np.ndarray, "cell corner dim"], metadata: Metadata) -> Float[np.ndarray, "cell corner dim"]:
    """Return the corners of cells beside the first of each, also of cells that a seam of the domain divides."""
    if not any(metadata.periodic):
        return corners
    first = corners[:, :1]
    return first + metadata.periodicity.shortest(corners - first)


def _elastic_constants(trajectory: Trajectory) -> tuple[Float[np.ndarray, "node"], Float[np.ndarray, "node"]]:
    """Return Young's modulus [Pa] and Poisson's ratio of each node; NaN where they are not known."""
    metadata, unknown = trajectory.metadata, np.full(trajectory.num_nodes, np.nan)
    columns = dict(zip(metadata.param_names, trajectory.material_params.T.astype(np.float64), strict=True))
    modulus, poisson_ratio = columns.get("youngs_modulus", unknown), columns.get("poisson_ratio", unknown).copy()
    for material in {*MESH_MATERIALS} & {*metadata.materials}:
        poisson_ratio[np.isnan(poisson_ratio) & (trajectory.node_type == node_code(material))] = _poisson_ratio(metadata.config, material)
    return modulus, poisson_ratio


def _poisson_ratio(config: str, material: str) -> float:
    """Return Poisson's ratio in the settings of the solver that made a trajectory; NaN if it is not there, as in imported data."""
    try:
        solver = json.loads(config)["solver"]
        return float(solver.get(material, solver)["poisson_ratio"])
    except (ValueError, KeyError, TypeError, AttributeError):
        return float("nan")
