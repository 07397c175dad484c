"""Metrics of liquids, which do not ask which node is where: spacing, density, volume, centre of mass and spread of the fluid nodes of one frame.

Positions of single nodes differ between two good simulators of a settled pool. Its nodes have to keep their distances all the same: a model whose nodes
cluster has the wrong density, although the root mean square of its position errors is small.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from gpe_pl.schema import node_code
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

UNITS: dict[str, str] = {"spacing_error": "1", "density_error": "1", "volume_error": "1", "centre_error": "m", "spread_error": "1"}
"""Metrics of ``liquid_metrics`` and their units."""
WHOLE = ("centre_error", "spread_error")
"""Metrics that are undefined in periodic domains."""
KERNEL_SPACINGS = 2.0
"""Radius of the kernel that gives densities, in rest spacings."""
NUM_GRIDS = 64
"""Number of grids of boxes over which the volume is averaged. With fewer, that of a lattice depends on where it lies."""
MATERIAL = "fluid"


def liquid_nodes(trajectory: Trajectory) -> Bool[np.ndarray, "node"]:
    """Return a mask [node] of the fluid nodes; none count if there are fewer than two."""
    own: np.ndarray = trajectory.node_type == node_code(MATERIAL)
    return own if own.sum() > 1 else np.zeros_like(own)


def density(pos: Float[np.ndarray, "node dim"], metadata: Metadata) -> Float[np.ndarray, "node"]:
    """Return the density at each node, as the sum of (1 − d/h)³ over the distances d to all nodes within the radius h.

    The kernel is steepest at short distances, so that it sees clusters. Source: Müller et al. 2003, "Particle-based fluid simulation", section 3.5.
    """
    space, radius = metadata.periodicity, KERNEL_SPACINGS * metadata.spacing
    points, box = (space.from_corner(pos), space.period) if space else (pos, None)
    pairs = cKDTree(points, boxsize=box).query_pairs(radius, output_type="ndarray")
    way = space.shortest(pos[pairs[:, 0]] - pos[pairs[:, 1]])
    weight = (1 - np.minimum(1.0, np.linalg.norm(way, axis=1) / radius)) ** 3
    here, there = (np.bincount(ends, weight, len(pos)) for ends in pairs.T)
    return np.asarray(1.0 + here + there)


def volume(pos: Float[np.ndarray, "node dim"], metadata: Metadata) -> float:
    """Return the volume [m^dim] of the boxes with an edge of one rest spacing that contain a node, as the mean over evenly spread places of the boxes.

    At one place alone, nodes near the faces of boxes would make a third of them empty by moves of any size. The places are multiples of powers of the root of
    p^(dim + 1) = p + 1, modulo the edge: Roberts 2018, "The unreasonable effectiveness of quasirandom sequences".
    """
    space, edge, dim = metadata.periodicity, metadata.spacing, metadata.dim
    step = {2: 1.32471795724474602596, 3: 1.22074408460575947536}[dim] ** -np.arange(1.0, dim + 1)
    shifts = edge * ((0.5 + step * np.arange(1, NUM_GRIDS + 1)[:, None]) % 1)
    counts = [len(np.unique(np.floor((space.from_corner(pos + shift) if space else pos + shift) / edge), axis=0)) for shift in shifts]
    return float(np.mean(counts) * edge**dim)


def liquid_metrics(
    pos: Float[np.ndarray, "node dim"], reference: Float[np.ndarray, "node dim"], mass: Float[np.ndarray, "node"], metadata: Metadata
) -> dict[str, float]:
    """Return the metrics of one frame.

    ============= = ========================================================================================================================
    spacing_error 1 |d − d̂| / d̂ with d the median distance of a node to the nearest other one
    density_error 1 mean difference of the densities, both sorted, over the mean density of the reference
    volume_error  1 |V − V̂| / V̂ with V as in ``volume``
    centre_error  m distance of the centres of mass
    spread_error  1 |s − ŝ| / ŝ with s the root mean square distance to the centre of mass
    ============= = ========================================================================================================================

    Args:
        pos, reference: positions of the fluid nodes in prediction and ground truth [node, dim] in m.
        mass: masses [node] in kg.
        metadata: metadata of the ground truth. Centre and spread are left out in periodic domains.
    """
    pos, reference = pos.astype(np.float64), reference.astype(np.float64)
    space = metadata.periodicity

    def relative(own: Any, true: Any) -> float:
        return float(abs(own - true) / true) if true else (float("inf") if own else 0.0)

    sizes = [np.median(nearest_distances(x, space)) for x in (pos, reference)]
    own, true = (np.sort(density(x, metadata)) for x in (pos, reference))
    values = {
        "spacing_error": relative(*sizes),
        "density_error": float(np.abs(own - true).mean() / true.mean()),
        "volume_error": relative(volume(pos, metadata), volume(reference, metadata)),
    }
    if not space:
        fraction = mass.astype(np.float64) / mass.sum(dtype=np.float64)
        centres = [fraction @ x for x in (pos, reference)]
        spreads = [np.sqrt(fraction @ ((x - c) ** 2).sum(axis=1)) for x, c in zip((pos, reference), centres, strict=True)]
        values |= {"centre_error": float(np.linalg.norm(centres[0] - centres[1])), "spread_error": relative(*spreads)}
    return values
