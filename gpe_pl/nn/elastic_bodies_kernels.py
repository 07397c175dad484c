"""The motion of elastic bodies over a frame in one compiled call, for rollouts on a CPU: what ``elastic_bodies`` computes with PyTorch's operations.

It keeps no substeps for a backward pass. Sums are in double precision.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.nn.elastic_kernels import HEAVY, LOG_SMALLEST, TORN, move_forward
from gpe_pl.nn.elastic_touch_kernels import soften_touching
from gpe_pl.trajectory.strain import HEXAHEDRON, POINTS_TO_CORNERS, SMALLEST_RATIO

KEPT = 2
"""Number of substeps in memory."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def move_bodies(
    constants, acceleration, gravity, mass, held, body_pos, velocity, wall_normal, wall_gap, friction, wall_layer, corner_index, corner,
    corner_friction, touching, way, touch, nodes, gradient, volume, rate, cell_start, node_start, length, units, limits, softer, moved,
    at_end, stress,
):  # fmt: skip
    """Compute the motion of the bodies of one material in all scenes of a graph.

    Args:
        constants: λ, μ and η of nodes [node, 3], see ``elastic_motion.Constants``.
        acceleration: accelerations without gravity by all but cells and walls [node, dim].
        gravity: gravity of each scene [scene, dim] in m/frame².
        mass: masses [node].
        held: axes along which nodes keep their velocity [node, dim], or without rows if there are none.
        body_pos, velocity, corner_index, corner: entries of the graph, see ``graphs.builder``.
        wall_normal, wall_gap, friction, wall_layer: of the walls of nodes, see ``elastic_motion.Walls``; zeros stand for no layer.
        corner_friction: Coulomb coefficient of each corner [pair].
        touching, way, touch: pairs of nodes of different bodies, see ``elastic_touch.Touching``.
        nodes, gradient, volume, rate: of cells, see ``elastic_motion.Cells``.
        cell_start, node_start: first cell and node of each scene, and their numbers [scene + 1].
        length: mean length of the cells of each scene [scene], see ``elastic_motion.Cells``.
        units: units of accelerations, of length, and of stresses.
        limits: largest number of substeps, length of a substep as a fraction of the largest one that is stable, and two constants of ``soften_touching``.
        softer: factors of the law of unstable scenes, see ``elastic_motion.SOFTER``.
        moved: accelerations without gravity that move the nodes as far [node, dim]; a result.
        at_end: velocities at the end of the frame [node, dim] in m/frame; a result.
        stress: Cauchy stress at the end of the frame [node, component], or without rows; a result.
    """
    num_nodes, dim = acceleration.shape
    acceleration_unit, spacing, stress_unit = units
    pos, vel, forcing, weights = (
        np.empty((num_nodes, dim)),
        np.empty((num_nodes, dim)),
        np.empty((num_nodes, dim)),
        np.empty((num_nodes, dim)),
    )
    normal, gap, layer = np.empty((num_nodes, dim)), np.empty(num_nodes), np.zeros((num_nodes, 3))
    for s in range(len(node_start) - 1):
        for n in range(node_start[s], node_start[s + 1]):
            gap[n] = max(wall_gap[n], 0.0)
            for a in range(dim):
                pos[n, a], vel[n, a], normal[n, a] = body_pos[n, a], velocity[n, dim + a], wall_normal[n, a]
                forcing[n, a], weights[n, a] = acceleration[n, a] * acceleration_unit + gravity[s, a], mass[n]
                if len(held) and held[n, a]:
                    forcing[n, a], weights[n, a] = 0.0, HEAVY
            if len(held) and held[n].any():
                normal[n] = 0.0  # walls do not move a held node
    point = np.empty((len(corner), dim))
    for k in range(len(corner)):
        for a in range(dim):
            point[k, a] = pos[corner_index[k, 0], a] + corner[k, a]
    lam, mu, eta = _of_cells(constants, spacing ** (2 - dim), nodes)
    number = np.empty(len(node_start) - 1, np.int64)
    for s in range(len(number)):
        number[s] = _soften(pos, lam, mu, eta, nodes, gradient, rate, cell_start[s], cell_start[s + 1], limits[0], limits[1])
    pair_start, touch_start = _first_of_scenes(corner_index, node_start), _first_of_scenes(touching, node_start)
    path, speed_path, pushed = np.empty((KEPT, num_nodes, dim)), np.empty((KEPT, num_nodes, dim)), np.empty((KEPT, num_nodes, dim))
    contacts, soft = np.zeros((KEPT, len(corner), 6)), np.empty_like(touch)
    first, level, is_done = (lam.copy(), mu.copy(), eta.copy()), np.zeros(len(number), np.int64), False
    while not is_done:
        for s in range(len(number)):
            for n in range(node_start[s], node_start[s + 1]):
                layer[n, 0], layer[n, 1] = wall_layer[n, 0], min(wall_layer[n, 1], 0.5 * float(number[s]) ** 2)
                layer[n, 2] = min(wall_layer[n, 2], 0.5 * number[s])
        soft[:] = touch
        soften_touching(touching, way, soft, mass, vel, number, node_start, touch_start, limits[2], limits[3])
        move_forward(
            pos, vel, forcing, weights, lam, mu, eta, normal, gap, friction, layer, point, corner_friction, way, soft, corner_index, touching, nodes,
            gradient, volume, cell_start, node_start, pair_start, touch_start, number, path, speed_path, pushed, contacts, at_end,
        )  # fmt: skip
        is_done = True
        for s in range(len(number)):
            is_longest = number[s] == int(limits[0])
            if is_longest and level[s] + 1 == len(softer):
                continue
            first_node, end = node_start[s], node_start[s + 1]
            if length[s] and _is_unstable(pos, vel, forcing, layer, path[number[s] % KEPT], at_end, length[s], number[s], first_node, end):
                is_done, level[s], number[s] = False, level[s] + int(is_longest), int(limits[0])
                for cell in range(cell_start[s], cell_start[s + 1]):
                    factor = softer[level[s]]
                    lam[cell], mu[cell], eta[cell] = first[0][cell] * factor, first[1][cell] * factor, first[2][cell] * factor
    for s in range(len(number)):
        last = path[number[s] % KEPT]
        for n in range(node_start[s], node_start[s + 1]):
            for a in range(dim):
                way = last[n, a] - pos[n, a]
                moved[n, a] = (way - velocity[n, a] - gravity[s, a]) / acceleration_unit
                pos[n, a] += way
    if len(stress):
        _write_stress(pos, lam, mu, nodes, gradient, volume, stress_unit, stress)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _is_unstable(pos, vel, forcing, layer, last, at_end, length, number, first_node, end_node):
    """Tell whether the substeps of the scene of these nodes were too long, see ``elastic_motion._unstable``."""
    before = pushed = after = thickest = 0.0
    for n in range(first_node, end_node):
        v = f = w = x = 0.0
        for a in range(pos.shape[1]):
            v, f, w, x = v + vel[n, a] ** 2, f + forcing[n, a] ** 2, w + at_end[n, a] ** 2, x + (last[n, a] - pos[n, a]) ** 2
        if not math.isfinite(w) or not math.isfinite(x):
            return True
        before, pushed, after, thickest = max(before, v), max(pushed, f), max(after, w, x), max(thickest, layer[n, 0])
    return math.sqrt(after) > math.sqrt(before) + math.sqrt(pushed) + number * (length + thickest)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _first_of_scenes(pairs, node_start):
    """Return the first of the pairs of nodes of each scene, and their number [scene + 1]. The pairs are in the order of the scenes."""
    start, scene = np.zeros(len(node_start), np.int64), 0
    for k in range(len(pairs)):
        while pairs[k, 0] >= node_start[scene + 1]:
            scene += 1
            start[scene] = k
    start[scene + 1 :] = len(pairs)
    return start


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _of_cells(of_node, modulus, nodes):
    """Return λ, μ and η of each cell in the unit ``modulus``, the means over its corners."""
    corners, found = nodes.shape[1], np.zeros((3, len(nodes)))
    for cell in range(len(nodes)):
        for k in range(3):
            for a in range(corners):
                found[k, cell] += of_node[nodes[cell, a], k] * modulus / corners
    return found[0], found[1], found[2]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _deformation(pos, nodes, gradient, cell, q, f):
    """Write the deformation gradient at a quadrature point to f [3, 3]; return its determinant. In 2D, f is that of plane strain."""
    dim = pos.shape[1]
    f[:] = 0.0
    f[2, 2] = 1.0 if dim == 2 else 0.0
    for a in range(1, nodes.shape[1]):
        for i in range(dim):
            difference = pos[nodes[cell, a], i] - pos[nodes[cell, 0], i]
            for j in range(dim):
                f[i, j] += difference * gradient[cell, q, a, j]
    minor0, minor1 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1], f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
    return f[0, 0] * minor0 + f[0, 1] * minor1 + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _soften(pos, lam, mu, eta, nodes, gradient, rate, first, end, most, stable):
    """Soften cells of a scene that need more than ``most`` substeps, and torn cells, in place; return the number of substeps. See ``Cells.substeps``."""
    dim, largest, f = pos.shape[1], 0.0, np.empty((3, 3))
    for cell in range(first, end):
        for q in range(gradient.shape[1]):
            _deformation(pos, nodes, gradient, cell, q, f)
            norm = 0.0
            for i in range(dim):
                for j in range(dim):
                    norm += f[i, j] * f[i, j]
            if norm > TORN**2:
                lam[cell] = mu[cell] = eta[cell] = 0.0
        stiffness, damping = -math.inf, -math.inf
        for q in range(gradient.shape[1]):
            ratio = max(_deformation(pos, nodes, gradient, cell, q, f), SMALLEST_RATIO)
            change = (lam[cell] * math.log(ratio) - mu[cell]) / ratio
            second, square = (lam[cell] / ratio - change) / ratio, 0.0
            for i in range(dim):
                for j in range(dim):
                    square += f[i, j] * f[i, j] / dim
            bound = max(abs(change) * math.sqrt(square), second * square ** (dim - 1) + abs(change))
            stiffness, damping = max(stiffness, mu[cell] + bound), max(damping, 2.0 * eta[cell] * square * dim)
        frequency, damping = max(stiffness, 0.0) * rate[cell], damping * rate[cell]
        needed = 0.25 * (damping + math.sqrt(damping * damping + 4.0 * frequency)) / stable
        largest = max(largest, min(needed, most))
        excess = min(max(needed / most, 1.0), 1e15)
        lam[cell], mu[cell], eta[cell] = lam[cell] / excess**2, mu[cell] / excess**2, eta[cell] / excess
    return max(math.ceil(largest - 1e-9), 1)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _write_stress(pos, lam, mu, nodes, gradient, volume, unit, stress):
    """Write the Cauchy stress at nodes in a unit to ``stress``, see ``elastic_motion.cauchy_stress``."""
    dim, (num_nodes, components) = pos.shape[1], stress.shape
    total, whole, f = np.zeros((num_nodes, components)), np.zeros(num_nodes), np.empty((3, 3))
    rows, columns = (
        (np.array([0, 0, 1, 2]), np.array([0, 1, 1, 2])) if dim == 2 else (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
    )
    num_points, corners = volume.shape[1], nodes.shape[1]
    own, at_corner = np.empty((num_points, components)), np.empty(components)
    for cell in range(len(nodes)):
        size = 0.0
        for q in range(num_points):
            ratio = _deformation(pos, nodes, gradient, cell, q, f)
            safe = max(ratio, SMALLEST_RATIO)
            volumetric = lam[cell] * math.log(safe) - mu[cell]
            if not ratio > SMALLEST_RATIO:
                volumetric = (lam[cell] * (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) - mu[cell]) * ratio / SMALLEST_RATIO
            size += volume[cell, q]
            for k in range(components):
                i, j, left = rows[k], columns[k], 0.0
                for m in range(3):
                    left += f[i, m] * f[j, m]
                own[q, k] = (mu[cell] * left + (volumetric if i == j else 0.0)) / safe
        for a in range(corners):
            if a == 0 or corners == HEXAHEDRON:  # the corners of other cells have the same stress
                at_corner[:] = 0.0
                for q in range(num_points):
                    weight = size * POINTS_TO_CORNERS[a, q] if corners == HEXAHEDRON else volume[cell, q]
                    for k in range(components):
                        at_corner[k] += weight * own[q, k]
            n = nodes[cell, a]
            whole[n] += size
            for k in range(components):
                total[n, k] += at_corner[k]
    for n in range(num_nodes):
        for k in range(components):
            stress[n, k] = total[n, k] / whole[n] / unit if whole[n] > 0.0 else 0.0
