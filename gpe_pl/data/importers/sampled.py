"""Neighbours and motion of nodes in some trajectories of an import."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int64
from scipy.spatial import cKDTree

from gpe_pl.data.free_flight import FreeFlight, free_flights, joined
from gpe_pl.data.importers.source import Facts, walls_at_bounds
from gpe_pl.data.importers.source import joined as with_walls
from gpe_pl.graphs.neighbors import radius_between, radius_pairs
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.trajectory import Trajectory

FRAMES_SAMPLED = 3
"""Number of frames of each sampled trajectory, evenly spread, in which neighbours are counted."""


OUT_OF_SIGHT = 3.0
"""Number of radii beyond which walls that no node comes nearer to are suspects. Walls that have a shape, such as those at bounds, are none: nodes may fly."""
FRAMES_NEAR_WALLS = 20
"""Number of frames of each sampled trajectory, evenly spread, in which distances to walls are measured."""


def degrees_of(trajectory: Trajectory) -> Iterator[tuple[Int64[np.ndarray, " node"], Int64[np.ndarray, " node"]]]:
    """Yield two arrays for each of ``FRAMES_SAMPLED`` frames: the numbers of dynamic neighbours and of boundary neighbours of each dynamic node [node]."""
    m, count = trajectory.metadata, trajectory.num_nodes
    for frame in np.unique(np.linspace(0, trajectory.num_frames - 1, FRAMES_SAMPLED).astype(int)).tolist():
        walls = np.ascontiguousarray(trajectory.boundary.at(frame).pos, dtype=np.float64)
        pos = trajectory.pos[frame].astype(np.float64)
        pairs = radius_pairs(pos, m.connectivity_radius, m.periodicity)
        touching = radius_between(walls, pos, m.connectivity_radius, m.periodicity)[1]
        yield np.bincount(pairs.ravel(), minlength=count), np.bincount(touching, minlength=count)


def about_walls(sample: Sequence[Trajectory]) -> Iterator[str]:
    """Yield a warning about walls that no node comes near in any trajectory, and about gaps between boundary nodes through which nodes could pass unseen."""
    walled = [trajectory for trajectory in sample if len(trajectory.boundary.pos)]
    if not walled:
        return
    distance, radius = min(map(_least_distance, walled)), walled[0].metadata.connectivity_radius
    if distance > OUT_OF_SIGHT * radius and not any(len(trajectory.boundary.shapes) for trajectory in walled):
        yield (
            f"no node of the first trajectories comes nearer to a boundary node than {distance:.4g} m, and models see walls within {radius:.4g} m: "
            "is the unit of length or the place of the walls wrong?"
        )
    gaps = [nearest_distances(t.boundary.pos.astype(np.float64), t.metadata.periodicity) for t in walled if len(t.boundary.pos) > 1]
    if gaps and (gap := float(np.median(np.concatenate(gaps)))) > radius:
        yield (
            f"boundary nodes are {gap:.4g} m from the nearest one (median), farther than the connectivity radius {radius:.4g} m, so nodes pass between them "
            "unseen: sample walls at the spacing of the nodes"
        )


def _least_distance(trajectory: Trajectory) -> float:
    """Return the smallest distance [m] of a node to a boundary node in ``FRAMES_NEAR_WALLS`` frames, evenly spread."""
    m, least = trajectory.metadata, np.inf
    for frame in np.unique(np.linspace(0, trajectory.num_frames - 1, FRAMES_NEAR_WALLS).astype(int)).tolist():
        walls, pos = (values.astype(np.float64) for values in (trajectory.boundary.at(frame).pos, trajectory.pos[frame]))
        if m.periodicity:
            walls, pos = m.periodicity.from_corner(walls), m.periodicity.from_corner(pos)
        tree = cKDTree(walls, boxsize=m.periodicity.period if m.periodicity else None)
        least = min(least, float(tree.query(pos)[0].min()))
    return least


def speed_and_acceleration(sample: Sequence[Trajectory]) -> tuple[float, list[float]]:
    """Return the largest speed [m/s] in some trajectories, and their mean acceleration per axis [m/s²] with gravity."""
    fastest, means = 0.0, []
    for trajectory in sample:
        m, last = trajectory.metadata, trajectory.num_frames - 1
        first, final = (
            integrators.velocities(trajectory.pos[k : k + 2].astype(np.float64), m.frame_dt, m.periodicity)[0] for k in (0, last - 1)
        )
        means.append((final - first).mean(axis=0) / ((last - 1) * m.frame_dt))
        fastest = max(fastest, float(np.linalg.norm(trajectory.vel, axis=-1).max()))
    return fastest, np.mean(means, axis=0).tolist()


def free_flight_of(trajectory: Trajectory, facts: Facts, num_frames: int) -> FreeFlight:
    """Find the groups in free flight of a trajectory in at most ``num_frames`` frames, in the precision of its source.

    Walls at bounds that are not known yet are at those of the trajectory. Without them, nodes that lie on the ground would count as free.
    """
    b, m = trajectory.boundary, trajectory.metadata
    if facts.bounds is None:
        b = with_walls(m.dim, b, walls_at_bounds(replace(facts, bounds=m.bounds, spacing=m.spacing), m.dim))
    arrays = {"pos": trajectory.pos, "mass": trajectory.mass, "boundary_pos": b.pos[None] if b.motion is None else b.motion.pos}
    given = {"cells": trajectory.cells, "prescribed_axes": trajectory.prescribed, "force": trajectory.force}
    arrays |= {name: values for name, values in given.items() if values is not None}
    return joined(free_flights(trajectory.metadata, arrays, num_frames), trajectory.metadata.dim)
