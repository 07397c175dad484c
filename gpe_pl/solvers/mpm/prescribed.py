"""Grid nodes and particles that move with openings.

The grid nodes inside an opening with a speed have its velocity. Those next to its faces act as a frictionless wall that moves with it: they push what lies on
it, and let go what moves away. The particles that are in it at the beginning of a frame move with it until the end of the frame, and do not deform. An opening
without a grid node moves its particles, but pushes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from gpe_pl.trajectory.openings import Opening

ON_FACE = 1e-6
"""Fraction of a cell by which a grid node may be beside an opening, because of rounding."""


class Prescribed(NamedTuple):
    """Motion of a frame that openings prescribe; arrays without rows if none has a speed.

    Attributes:
        grid: indices of the grid nodes in openings [node].
        least, most: limits of their velocities along each axis [node, dim] in m/s; infinite where the opening sets none.
        rows: rows of the particles in openings [particle].
        start: their positions at the beginning of the frame [particle, dim] in m.
        velocity: their velocities [particle, dim] in m/s.
        fastest: largest speed of an opening [m/s].
    """

    grid: np.ndarray
    least: np.ndarray
    most: np.ndarray
    rows: np.ndarray
    start: np.ndarray
    velocity: np.ndarray
    fastest: float


def prescribed(
    openings: Sequence[Opening],
    times: tuple[float, float],
    pos: np.ndarray,
    origin: tuple[float, ...],
    counts: tuple[int, ...],
    spacing: float,
) -> Prescribed:
    """Return what openings prescribe in a frame. Where they overlap, the last one counts, as in ``rollout.flow``.

    Args:
        openings: openings of the scene.
        times: beginning and end of the frame [s].
        pos: positions of all particles at its beginning [particle, dim] in m.
        origin, counts, spacing: position of the first grid node [m], number of nodes per axis, and grid spacing [m].
    """
    limits_of_node, velocity_of_particle, fastest, dim = dict[int, np.ndarray](), dict[int, np.ndarray](), 0.0, len(counts)
    for opening in openings:
        if opening.drives:
            velocity = opening.mean_velocity(*times)
            nodes, limits = _limits(opening, velocity, origin, counts, spacing)
            limits_of_node |= zip(nodes.tolist(), limits, strict=True)
            velocity_of_particle |= dict.fromkeys(np.flatnonzero(opening.contains(pos)).tolist(), velocity)
            fastest = max(fastest, float(np.linalg.norm(velocity)))
    grid, rows = (np.array(list(own), dtype=np.int64) for own in (limits_of_node, velocity_of_particle))
    limits = np.array(list(limits_of_node.values())).reshape(-1, 2, dim)
    velocity = np.array(list(velocity_of_particle.values())).reshape(-1, dim)
    return Prescribed(grid, limits[:, 0].copy(), limits[:, 1].copy(), rows, pos[rows], velocity, fastest)


def _limits(
    opening: Opening, velocity: np.ndarray, origin: tuple[float, ...], counts: tuple[int, ...], spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the grid nodes [node] in the box of an opening and on its faces, and the limits of their velocities [node, 2, dim] in m/s."""
    inside, is_first, is_last = [], [], []
    for axis, count in enumerate(counts):
        line = origin[axis] + spacing * np.arange(count)
        own = np.flatnonzero((line >= opening.low[axis] - ON_FACE * spacing) & (line <= opening.high[axis] + ON_FACE * spacing))
        inside.append(own)
        is_first.append(own == own.min(initial=count))
        is_last.append(own == own.max(initial=-1))
    nodes = np.ravel_multi_index(np.meshgrid(*inside, indexing="ij"), counts).reshape(-1)
    first, last = (np.stack(np.meshgrid(*own, indexing="ij"), axis=-1).reshape(-1, len(counts)) for own in (is_first, is_last))
    is_within = ~np.any(first | last, axis=1, keepdims=True)
    return nodes, np.stack([np.where(last | is_within, velocity, -np.inf), np.where(first | is_within, velocity, np.inf)], axis=1)


@njit(cache=True, error_model="numpy")
@no_type_check
def impose(grid, motion, gravity, h):
    """Change the momenta of grid nodes in openings such that their velocities are within the limits when gravity has acted for a time h [s].

    Args:
        grid: momentum and mass of each grid node [grid node, dim + 1].
        motion: ``Prescribed``.
        gravity: acceleration of gravity [dim] in m/s².
        h: time [s].
    """
    dim = len(gravity)
    for k in range(motion.grid.shape[0]):
        node = motion.grid[k]
        mass = grid[node, dim]
        if mass > 0.0:  # no mass times no limit would be NaN
            for axis in range(dim):
                gain = h * gravity[axis]
                least, most = mass * (motion.least[k, axis] - gain), mass * (motion.most[k, axis] - gain)
                grid[node, axis] = min(max(grid[node, axis], least), most)


@njit(cache=True, error_model="numpy")
@no_type_check
def carry(particles, motion, elapsed):
    """Move the particles of openings to where they are at a time ``elapsed`` [s] after the beginning of the frame. They do not deform."""
    dim = motion.start.shape[1]
    for k in range(motion.rows.shape[0]):
        p = motion.rows[k]
        for i in range(dim):
            particles.pos[p, i] = motion.start[k, i] + elapsed * motion.velocity[k, i]
            particles.vel[p, i] = motion.velocity[k, i]
            for j in range(dim):
                particles.affine[p, i, j] = particles.gradient[p, i, j] = 0.0
