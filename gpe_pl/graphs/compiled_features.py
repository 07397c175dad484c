"""The features of ``features``, compiled for the CPU: one pass over nodes or edges that also standardises.

Values are computed in double precision, rounded to the precision of the output, and then standardised in it: (value − mean) · (1 / std). Raw features have the
mean 0 and 1 / std = 1. In all functions, ``mean`` and ``inverse`` are the mean and 1 / std of the channels of ``out``, and ``velocity_unit`` and
``acceleration_unit`` are those of ``features.Scales``.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.graphs.features import GAP_LIMIT, GAP_SCALE, TINY

ROUNDED_TO_ZERO = 1e-9
"""Components of displacements in meshes below this count as zero, as in ``features``."""


@njit(cache=True, error_model="numpy")
@no_type_check
def motion(history, rows, gravity, starts, level, velocity_unit, acceleration_unit, mean, inverse, out):
    """Write ``features.material_features`` of nodes to ``out`` [row, channel], or ``features.virtual_features`` if ``level`` [row] is not empty.

    ``history`` has the velocities of nodes [node, history, dim] in m/s, and ``rows`` the nodes of each row of ``out``. ``gravity`` [scene, dim] acts on the
    rows of a scene, which begin at ``starts`` [scene + 1].
    """
    num_steps, dim = history.shape[1], history.shape[2]
    per_velocity = 1 / velocity_unit
    for scene in range(gravity.shape[0]):
        for k in range(starts[scene], starts[scene + 1]):
            n = rows[k]
            for a in range(dim):
                out[k, a] = history[n, num_steps - 1, a] * per_velocity
                for s in range(1, num_steps):
                    out[k, s * dim + a] = (history[n, num_steps - s, a] - history[n, num_steps - s - 1, a]) * per_velocity
                out[k, num_steps * dim + a] = gravity[scene, a] / acceleration_unit
            if level.shape[0] > 0:
                out[k, (num_steps + 1) * dim] = level[k]
            for c in range(out.shape[1]):
                out[k, c] = (out[k, c] - mean[c]) * inverse[c]


@njit(cache=True, error_model="numpy")
@no_type_check
def write_arms(pos, label, num_islands, arm):
    """Write positions relative to the mean of their island to ``arm`` [node, dim]."""
    num_nodes, dim = pos.shape
    count, centre = np.zeros(num_islands), np.zeros((num_islands, dim))
    for n in range(num_nodes):
        count[label[n]] += 1.0
        for a in range(dim):
            centre[label[n], a] += pos[n, a]
    for n in range(num_nodes):
        for a in range(dim):
            arm[n, a] = pos[n, a] - centre[label[n], a] / count[label[n]]


@njit(cache=True, error_model="numpy")
@no_type_check
def walls(vel, normal, friction, restitution, rows, with_condition, velocity_unit, mean, inverse, out):
    """Write ``features.boundary_features`` of boundary nodes to ``out`` [row, channel].

    The first four arguments are arrays of a ``Boundary``, and ``rows`` has the boundary node of each row of ``out``. ``with_condition`` is
    ``GraphConfig.boundary_condition``.
    """
    dim = vel.shape[1]
    for k in range(rows.shape[0]):
        n = rows[k]
        for a in range(dim):
            out[k, a] = vel[n, a] / velocity_unit
            if with_condition:
                out[k, dim + a] = normal[n, a]
        if with_condition:
            out[k, 2 * dim] = friction[n] / (1 + friction[n])
            out[k, 2 * dim + 1] = restitution[n]
        for c in range(out.shape[1]):
            out[k, c] = (out[k, c] - mean[c]) * inverse[c]


@njit(cache=True, error_model="numpy")
@no_type_check
def contacts(
    source_pos, source_vel, source_rows, normal, target_pos, target_vel, target_rows, edges, period, units, inverse_odd, mean_even,
    inverse_even, offset, odd, even,
):  # fmt: skip
    """Write ``features.edge_features`` of edges within the radius, and the displacement divided by the radius.

    Args:
        source_pos, source_vel: positions [m] and velocities [m/s] of possible sources.
        source_rows: rows of the sources in these arrays.
        normal: normals of the sources; empty between dynamic nodes.
        target_pos, target_vel, target_rows: the same for targets.
        edges: source and target of each edge, as indices of ``source_rows`` and ``target_rows`` [2, edge].
        period: period of each axis [3] in m; 0 for axes that are not periodic.
        units: radius [m], spacing [m] and unit of velocity [m/s], by which features are divided.
        inverse_odd, mean_even, inverse_even: statistics of the channels.
        offset, odd, even: results [edge, channel].
    """
    dim, is_wall = source_pos.shape[1], normal.shape[0] > 0
    per_radius, per_spacing, per_velocity = 1 / units[0], 1 / units[1], 1 / units[2]
    tiny = (TINY * units[1]) ** 2
    x, v = np.zeros(3), np.zeros(3)
    for k in range(edges.shape[1]):
        j, i = source_rows[edges[0, k]], target_rows[edges[1, k]]
        squared = 0.0
        for a in range(dim):
            d = target_pos[i, a] - source_pos[j, a]
            if period[a] > 0:
                d -= period[a] * np.rint(d / period[a])
            x[a], v[a] = d, (target_vel[i, a] - source_vel[j, a]) * per_velocity
            squared += d * d
            offset[k, a] = d * per_radius
            odd[k, a] = d * per_radius
            odd[k, a] *= inverse_odd[a]
        if even.shape[1] == 0:
            continue
        distance = np.sqrt(squared + tiny)
        per_distance, approach, depth, wall_approach = 1 / distance, 0.0, 0.0, 0.0
        for a in range(dim):
            unit = x[a] * per_distance
            approach += v[a] * unit
            odd[k, dim + a] = unit
            odd[k, dim + a] *= inverse_odd[dim + a]
            odd[k, 2 * dim + a] = v[a]
            odd[k, 2 * dim + a] *= inverse_odd[2 * dim + a]
            if is_wall:
                depth += x[a] * normal[j, a]
                wall_approach += v[a] * normal[j, a]
        even[k, 0] = min(max((distance * per_spacing - 1) / GAP_SCALE, -GAP_LIMIT), GAP_LIMIT)
        even[k, 1] = approach
        even[k, 2] = depth * per_spacing
        even[k, 3] = wall_approach
        for c in range(4):
            even[k, c] = (even[k, c] - mean_even[c]) * inverse_even[c]


@njit(cache=True, error_model="numpy")
@no_type_check
def points_of_mesh(pos, rest_pos, history, mass, shift, descent, num_virtual):
    """Return positions, rest positions and velocities of mesh nodes and of the virtual nodes above them [point, 3 dim], and the histories of the virtual nodes.

    A history has the last velocities [virtual, history, dim]. The values of a virtual node are the means over the mesh nodes below it, weighted by mass.
    ``shift`` and ``descent`` are as in ``MeshTopology``; an empty ``shift`` stands for zero.
    """
    num_nodes, dim = pos.shape
    num_steps = history.shape[1]
    points = np.zeros((num_nodes + num_virtual, 3 * dim))
    past, total = np.zeros((num_virtual, num_steps, dim)), np.zeros(num_virtual)
    for n in range(num_nodes):
        for a in range(dim):
            points[n, a] = pos[n, a] + shift[n, a] if shift.shape[0] > 0 else pos[n, a]
            points[n, dim + a] = rest_pos[n, a]
            points[n, 2 * dim + a] = history[n, num_steps - 1, a]
    for k in range(descent.shape[1]):
        above, below = descent[0, k], descent[1, k]
        if above == num_virtual:  # no virtual node
            continue
        weight = mass[below]
        total[above] += weight
        for c in range(2 * dim):
            points[num_nodes + above, c] += weight * points[below, c]
        for s in range(num_steps):
            for a in range(dim):
                past[above, s, a] += weight * history[below, s, a]
    for above in range(num_virtual):
        for c in range(2 * dim):
            points[num_nodes + above, c] /= total[above]
        for s in range(num_steps):
            for a in range(dim):
                past[above, s, a] /= total[above]
        for a in range(dim):
            points[num_nodes + above, 2 * dim + a] = past[above, num_steps - 1, a]
    return points, past


@njit(cache=True, error_model="numpy")
@no_type_check
def mesh_edges(points, ends, starts, levels, spacing, frame_dt, inverse_odd, mean_even, inverse_even, odd, cell_even, even):
    """Write ``features.mesh_features`` of the edges of meshes.

    Args:
        points: position [m], rest position [m] and velocity [m/s] of all points, see ``points_of_mesh`` [point, 3 dim].
        ends: points at the ends of all edges [2, edge].
        starts: first edge of each relation, and the number of edges [relation + 1].
        levels: level of the sources of each relation; 0 for edges along cells.
        spacing: rest spacing [m].
        frame_dt: frame interval [s].
        inverse_odd, mean_even, inverse_even: statistics of the channels by relation.
        odd: results of all edges [edge, 4 dim], or [edge, dim] without the other channels.
        cell_even, even: results of edges along cells [edge, 3] and of all other edges [edge, 4].
    """
    dim, num_cell_edges = points.shape[1] // 3, cell_even.shape[0]
    x, rest, v = np.zeros(3), np.zeros(3), np.zeros(3)
    for r in range(levels.shape[0]):
        width = spacing * 2.0 ** levels[r]
        per_width, velocity_unit = 1 / width, frame_dt / width
        for k in range(starts[r], starts[r + 1]):
            j, i = ends[0, k], ends[1, k]
            squared, rest_squared = TINY**2, 0.0
            for a in range(dim):
                x[a] = (points[i, a] - points[j, a]) * per_width
                rest[a] = (points[i, dim + a] - points[j, dim + a]) * per_width
                x[a] = 0.0 if abs(x[a]) < ROUNDED_TO_ZERO else x[a]
                rest[a] = 0.0 if abs(rest[a]) < ROUNDED_TO_ZERO else rest[a]
                v[a] = (points[i, 2 * dim + a] - points[j, 2 * dim + a]) * velocity_unit
                squared += x[a] * x[a]
                rest_squared += rest[a] * rest[a]
                odd[k, a] = x[a]
                odd[k, a] *= inverse_odd[r, a]
            if odd.shape[1] == dim:
                continue
            length, rest_length, approach = np.sqrt(squared), np.sqrt(rest_squared), 0.0
            per_length, stretch = 1 / length, length - rest_length
            for a in range(dim):
                unit = x[a] * per_length
                approach += v[a] * unit
                odd[k, dim + a] = v[a]
                odd[k, 2 * dim + a] = rest[a]
                odd[k, 3 * dim + a] = stretch * unit
            for c in range(dim, 4 * dim):
                odd[k, c] *= inverse_odd[r, c]
            row, own = (k, cell_even) if k < num_cell_edges else (k - num_cell_edges, even)
            own[row, 0], own[row, 1], own[row, 2] = stretch, approach, rest_length
            if k >= num_cell_edges:
                own[row, 3] = levels[r]
            for c in range(own.shape[1]):
                own[row, c] = (own[row, c] - mean_even[r, c]) * inverse_even[r, c]
