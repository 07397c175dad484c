"""Compiled loops of ``nn.elastic_touch``: forces between nodes of different bodies, and the product of their derivatives with a vector."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

CLOSEST = 1e-9
"""Least distance of two nodes, as a fraction of the thickness, that has a direction."""


@njit(cache=True, error_model="numpy")
@no_type_check
def add_touching_forces(y, pos, velocity, nodes, way, law, first, end, force):
    """Add the forces of some pairs to ``force`` [node, dim]; ``pos`` are the positions at the start of the frame."""
    dim = y.shape[1]
    for p in range(first, end):
        a, b, thickness = nodes[p, 0], nodes[p, 1], law[p, 0]
        square, along = 0.0, 0.0
        for i in range(dim):
            x = way[p, i] + (y[a, i] - pos[a, i]) - (y[b, i] - pos[b, i])
            square += x * x
            along += x * (velocity[a, i] - velocity[b, i])
        distance = max(math.sqrt(square), CLOSEST * thickness)
        depth = 1.0 - distance / thickness
        if depth <= 0.0:
            continue
        along /= distance
        push = law[p, 1] * thickness * (depth * depth - law[p, 2] * depth) - (law[p, 3] - law[p, 4]) * depth * along
        for i in range(dim):
            x = way[p, i] + (y[a, i] - pos[a, i]) - (y[b, i] - pos[b, i])
            value = push * x / distance - law[p, 4] * depth * (velocity[a, i] - velocity[b, i])
            force[a, i] += value
            force[b, i] -= value


@njit(cache=True, error_model="numpy")
@no_type_check
def pull_back_touching(y, pos, velocity, per_mass, nodes, way, law, first, end, to_pos, to_start, to_vel, grad_way, grad_law):
    """Add the product of the forces' derivatives and ``per_mass`` [node, dim] to those by positions, start, velocities, ways and constants."""
    dim = y.shape[1]
    x, w, g = np.empty(dim), np.empty(dim), np.empty(dim)
    for p in range(first, end):
        a, b, thickness = nodes[p, 0], nodes[p, 1], law[p, 0]
        square, along, of_push, of_sliding = 0.0, 0.0, 0.0, 0.0
        for i in range(dim):
            x[i] = way[p, i] + (y[a, i] - pos[a, i]) - (y[b, i] - pos[b, i])
            w[i], g[i] = velocity[a, i] - velocity[b, i], per_mass[a, i] - per_mass[b, i]
            square += x[i] * x[i]
        distance = max(math.sqrt(square), CLOSEST * thickness)
        depth = 1.0 - distance / thickness
        if depth <= 0.0:
            continue
        for i in range(dim):
            along += x[i] * w[i] / distance
            of_push += x[i] * g[i] / distance
            of_sliding += g[i] * w[i]
        stiffness, adhesion, excess, sliding = law[p, 1], law[p, 2], law[p, 3] - law[p, 4], law[p, 4]
        shape = depth * depth - adhesion * depth
        push = stiffness * thickness * shape - excess * depth * along
        of_depth = of_push * (stiffness * thickness * (2.0 * depth - adhesion) - excess * along) - sliding * of_sliding
        of_along = -of_push * excess * depth
        grad_law[p, 0] += of_push * stiffness * shape + of_depth * distance / (thickness * thickness)
        grad_law[p, 1] += of_push * thickness * shape
        grad_law[p, 2] -= of_push * stiffness * thickness * depth
        grad_law[p, 3] -= of_push * depth * along
        grad_law[p, 4] += of_push * depth * along - depth * of_sliding
        for i in range(dim):
            n = x[i] / distance
            # by the unit vector: push g + of_along w, without its part along n
            of_x = (push * (g[i] - of_push * n) + of_along * (w[i] - along * n)) / distance - of_depth * n / thickness
            of_w = of_along * n - sliding * depth * g[i]
            to_pos[a, i] += of_x
            to_pos[b, i] -= of_x
            to_start[a, i] -= of_x
            to_start[b, i] += of_x
            grad_way[p, i] += of_x
            to_vel[a, i] += of_w
            to_vel[b, i] -= of_w


@njit(cache=True, error_model="numpy")
@no_type_check
def soften_touching(nodes, way, law, mass, vel, number, node_start, touch_start, share, approach):
    """Soften pairs in place, as ``elastic_touch.Touching.softened`` does. ``share`` and ``approach`` are its constants."""
    total = np.zeros((mass.shape[0], 2))
    for p in range(nodes.shape[0]):
        square, closing = 0.0, 0.0
        for i in range(way.shape[1]):
            square += way[p, i] ** 2
            closing -= (vel[nodes[p, 0], i] - vel[nodes[p, 1], i]) * way[p, i]
        distance = max(math.sqrt(square), CLOSEST * law[p, 0])
        depth = min(max(1.0 + max(closing / (distance * law[p, 0]), approach) - distance / law[p, 0], 0.0), 1.0)
        adhesion = 2.0 * law[p, 2] if depth > 0.0 else 0.0
        for end in range(2):
            total[nodes[p, end], 0] += law[p, 1] * (4.0 * depth + adhesion)
            total[nodes[p, end], 1] += 2.0 * max(law[p, 3], law[p, 4]) * depth
    for s in range(len(number)):
        for p in range(touch_start[s], touch_start[s + 1]):
            factor, damping = 1.0, 1.0
            for end in range(2):
                n = nodes[p, end]
                if total[n, 0] > 0.0:
                    factor = min(factor, share * number[s] ** 2 * mass[n] / total[n, 0])
                if total[n, 1] > 0.0:
                    damping = min(damping, share * number[s] * mass[n] / total[n, 1])
            law[p, 1] *= factor
            law[p, 3] *= damping
            law[p, 4] *= damping
