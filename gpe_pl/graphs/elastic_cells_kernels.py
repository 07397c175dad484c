"""Compiled loops of ``graphs.elastic_cells``: positions and velocities of the nodes of bodies, and corners of obstacles near their edges."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.graphs.compiled_features import write_arms


@njit(cache=True, error_model="numpy")
@no_type_check
def write_velocities(vel, at_frame, rows, frame_dt, velocity):
    """Write mean velocities over the last frame and velocities at the frame [m/s], both of some rows, to ``velocity`` [row, 2 dim] in m/frame."""
    dim = vel.shape[1]
    for k in range(rows.shape[0]):
        for a in range(dim):
            velocity[k, a] = vel[rows[k], a] * frame_dt
            velocity[k, dim + a] = at_frame[rows[k], a] * frame_dt


@njit(cache=True, error_model="numpy")
@no_type_check
def write_from_centre(pos, shift, rows, body, num_bodies, body_pos):
    """Write positions relative to the mean of their body to ``body_pos`` [row, dim]; a ``shift`` [node, dim] in m is added if it has rows."""
    num_rows, dim = body_pos.shape
    now = np.empty((num_rows, dim))
    for k in range(num_rows):
        for a in range(dim):
            now[k, a] = pos[rows[k], a] + (shift[rows[k], a] if shift.shape[0] else 0.0)
    write_arms(now, body, num_bodies, body_pos)


@njit(cache=True, error_model="numpy")
@no_type_check
def near_corners(pos, rows, edges, points, corners, square):
    """Return the pairs of an edge [edge, 2] and one of the ``corners`` among ``points`` whose squared distance is below ``square``.

    The result is the numbers of edges and corners [pair, 2], edge by edge.
    """
    found = np.empty((edges.shape[0] * corners.shape[0], 2), np.int64)
    count = 0
    for e in range(edges.shape[0]):
        i, j = rows[edges[e, 0]], rows[edges[e, 1]]
        ax, ay = pos[j, 0] - pos[i, 0], pos[j, 1] - pos[i, 1]
        length = max(ax * ax + ay * ay, 1e-300)
        for c in range(corners.shape[0]):
            dx, dy = points[corners[c], 0] - pos[i, 0], points[corners[c], 1] - pos[i, 1]
            part = min(max((dx * ax + dy * ay) / length, 0.0), 1.0)
            dx, dy = dx - part * ax, dy - part * ay
            if dx * dx + dy * dy < square:
                found[count, 0], found[count, 1] = e, c
                count += 1
    return found[:count]
