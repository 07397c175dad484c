"""Compiled loops of ``nn.elastic_motion``: leapfrog substeps of elastic bodies, forward and backward.

Arrays are as in ``elastic_motion.plain_motion``, which computes the same.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.nn.elastic_touch_kernels import add_touching_forces, pull_back_touching
from gpe_pl.trajectory.strain import SMALLEST_RATIO

DEEPEST = 0.3
"""Largest depth of a corner in a body, in lengths of the edge. A deeper one lies in front of another edge."""
HEAVY = 1e9
"""Mass of nodes along axes along which their motion is given, in mean masses. Cells pull at them and do not change their velocity."""
TORN = 4.0
"""Norm of the deformation gradient above which a cell carries no forces. In the material point method, parts of a body that are some cells of the grid apart do
not feel each other. Undeformed cells have 1.4 in 2D and 1.7 in 3D."""
LOG_SMALLEST = math.log(SMALLEST_RATIO)


@njit(cache=True, error_model="numpy")
@no_type_check
def _cofactor_into(f, c):
    """Write the cofactor of f [3, 3] to c; return the determinant."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        c[i, 0] = f[j, 1] * f[k, 2] - f[j, 2] * f[k, 1]
        c[i, 1] = f[j, 2] * f[k, 0] - f[j, 0] * f[k, 2]
        c[i, 2] = f[j, 0] * f[k, 1] - f[j, 1] * f[k, 0]
    return f[0, 0] * c[0, 0] + f[0, 1] * c[0, 1] + f[0, 2] * c[0, 2]


@njit(cache=True, error_model="numpy")
@no_type_check
def _add_cofactor_change(f, d, factor, out):
    """Add ``factor`` times the derivative of the cofactor of f along d."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            out[i, a] += factor * (d[j, b] * f[k, c] - d[j, c] * f[k, b] + f[j, b] * d[k, c] - f[j, c] * d[k, b])


@njit(cache=True, error_model="numpy")
@no_type_check
def _gradient_of(x, nodes, gradient, c, q, f):
    """Write Σ_a (x_a − x_0) ⊗ G_a of a cell to f."""
    dim = f.shape[0]
    f[:] = 0.0
    for a in range(1, nodes.shape[1]):
        for i in range(dim):
            difference = x[nodes[c, a], i] - x[nodes[c, 0], i]
            for j in range(dim):
                f[i, j] += difference * gradient[c, q, a, j]


@njit(cache=True, error_model="numpy")
@no_type_check
def _add_stress(total, nodes, gradient, c, q, factor, p):
    """Add ``factor`` p G_a to each corner a of a cell."""
    dim = p.shape[0]
    for i in range(dim):
        rest = 0.0
        for a in range(1, nodes.shape[1]):
            value = 0.0
            for j in range(dim):
                value += p[i, j] * gradient[c, q, a, j]
            value *= factor
            total[nodes[c, a], i] += value
            rest -= value
        total[nodes[c, 0], i] += rest


@njit(cache=True, error_model="numpy")
@no_type_check
def _multiply(a, b, out):
    """Write a b to out."""
    dim = a.shape[0]
    for i in range(dim):
        for j in range(dim):
            value = 0.0
            for k in range(dim):
                value += a[i, k] * b[k, j]
            out[i, j] = value


@njit(cache=True, error_model="numpy")
@no_type_check
def _twice_strain_rate(f, d, out):
    """Write Fᵀ Ḟ + Ḟᵀ F to out."""
    dim = f.shape[0]
    for i in range(dim):
        for j in range(dim):
            value = 0.0
            for k in range(dim):
                value += f[k, i] * d[k, j] + d[k, i] * f[k, j]
            out[i, j] = value


@njit(cache=True, error_model="numpy")
@no_type_check
def _add_plane_forces(y, velocity, lam, mu, eta, nodes, gradient, volume, first_cell, end_cell, force):
    """Add the forces of some cells to ``force`` [node, 2]."""
    for cell in range(first_cell, end_cell):
        origin = nodes[cell, 0]
        for q in range(volume.shape[1]):
            f00 = f01 = f10 = f11 = d00 = d01 = d10 = d11 = 0.0
            for a in range(1, nodes.shape[1]):
                n, gx, gy = nodes[cell, a], gradient[cell, q, a, 0], gradient[cell, q, a, 1]
                x0, x1 = y[n, 0] - y[origin, 0], y[n, 1] - y[origin, 1]
                f00, f01, f10, f11 = f00 + x0 * gx, f01 + x0 * gy, f10 + x1 * gx, f11 + x1 * gy
                v0, v1 = velocity[n, 0] - velocity[origin, 0], velocity[n, 1] - velocity[origin, 1]
                d00, d01, d10, d11 = d00 + v0 * gx, d01 + v0 * gy, d10 + v1 * gx, d11 + v1 * gy
            ratio = f00 * f11 - f01 * f10
            if ratio > SMALLEST_RATIO:
                first = (lam[cell] * math.log(ratio) - mu[cell]) / ratio
            else:
                first = (lam[cell] * (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) - mu[cell]) / SMALLEST_RATIO
            e00, e11 = 2.0 * eta[cell] * (f00 * d00 + f10 * d10), 2.0 * eta[cell] * (f01 * d01 + f11 * d11)
            e01 = eta[cell] * (f00 * d01 + f10 * d11 + d00 * f01 + d10 * f11)
            m, w = mu[cell], -volume[cell, q]
            p00, p01 = m * f00 + first * f11 + f00 * e00 + f01 * e01, m * f01 - first * f10 + f00 * e01 + f01 * e11
            p10, p11 = m * f10 - first * f01 + f10 * e00 + f11 * e01, m * f11 + first * f00 + f10 * e01 + f11 * e11
            for a in range(1, nodes.shape[1]):
                n, gx, gy = nodes[cell, a], w * gradient[cell, q, a, 0], w * gradient[cell, q, a, 1]
                h0, h1 = p00 * gx + p01 * gy, p10 * gx + p11 * gy
                force[n, 0] += h0
                force[n, 1] += h1
                force[origin, 0] -= h0
                force[origin, 1] -= h1


@njit(cache=True, error_model="numpy")
@no_type_check
def _add_solid_forces(y, velocity, lam, mu, eta, nodes, gradient, volume, first_cell, end_cell, force):
    """Add the forces of some cells to ``force`` [node, 3]."""
    dim = 3
    f, d, c, p, e = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for cell in range(first_cell, end_cell):
        for q in range(volume.shape[1]):
            _gradient_of(y, nodes, gradient, cell, q, f)
            ratio = _cofactor_into(f, c)
            if ratio > SMALLEST_RATIO:
                first = (lam[cell] * math.log(ratio) - mu[cell]) / ratio
            else:
                first = (lam[cell] * (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) - mu[cell]) / SMALLEST_RATIO
            _gradient_of(velocity, nodes, gradient, cell, q, d)
            _twice_strain_rate(f, d, e)
            _multiply(f, e, p)
            for i in range(dim):
                for j in range(dim):
                    p[i, j] = eta[cell] * p[i, j] + mu[cell] * f[i, j] + first * c[i, j]
            _add_stress(force, nodes, gradient, cell, q, -volume[cell, q], p)


@njit(cache=True, error_model="numpy")
@no_type_check
def _wall_contact(distance, along, layer, h):
    """Return the change of a node's normal velocity by its wall, positive in contact, and whether the node stops on the plane of the wall."""
    soft, stop = 0.0, -distance / h - along
    if 0.0 < layer[0] > distance:
        depth = 1.0 - distance / layer[0]
        soft = h * (layer[1] * layer[0] * depth**2 - layer[2] * depth * min(along, 0.0))
    return (stop, True) if stop >= soft else (soft, False)


@njit(cache=True, error_model="numpy")
@no_type_check
def _stop_at_corner(y, velocity, mass, p, mu, a, b, h, contact):
    """Change the velocities of the ends of an edge that a corner would pass; write normal, place, stop and the factors of the ends to ``contact``.

    Without contact, both factors are zero.
    """
    contact[4] = contact[5] = 0.0
    d0, d1 = y[b, 0] - y[a, 0], y[b, 1] - y[a, 1]
    square = d0 * d0 + d1 * d1
    length = math.sqrt(square)
    place = ((p[0] - y[a, 0]) * d0 + (p[1] - y[a, 1]) * d1) / square
    if not 0.0 <= place <= 1.0:
        return
    n0, n1 = d1 / length, -d0 / length
    height = (p[0] - y[a, 0]) * n0 + (p[1] - y[a, 1]) * n1
    v0, v1 = (1.0 - place) * velocity[a, 0] + place * velocity[b, 0], (1.0 - place) * velocity[a, 1] + place * velocity[b, 1]
    along = v0 * n0 + v1 * n1
    excess = along - max(height, 0.0) / h
    if excess <= 0.0 or height <= -DEEPEST * length:
        return
    mass_a, mass_b = min(mass[a, 0], mass[a, 1]), min(mass[b, 0], mass[b, 1])
    inverse = (1.0 - place) ** 2 / mass_a + place**2 / mass_b
    t0, t1 = v0 - along * n0, v1 - along * n1
    tangential = math.sqrt(t0 * t0 + t1 * t1)
    stop = min(1.0, mu * excess / max(tangential, 1e-300))
    c0, c1 = excess * n0 + stop * t0, excess * n1 + stop * t1
    of_a, of_b = (1.0 - place) / (mass_a * inverse), place / (mass_b * inverse)
    velocity[a, 0] -= of_a * c0
    velocity[a, 1] -= of_a * c1
    velocity[b, 0] -= of_b * c0
    velocity[b, 1] -= of_b * c1
    contact[0], contact[1], contact[2], contact[3], contact[4], contact[5] = n0, n1, place, stop, of_a, of_b


@njit(cache=True, error_model="numpy")
@no_type_check
def move_forward(
    pos, vel, forcing, mass, lam, mu, eta, normal, gap, friction, layer, point, point_friction, way, touch, pair, touching, nodes, gradient,
    volume, cell_start, node_start, pair_start, touch_start, number, path, speed_path, pushed, contacts, last_vel,
):  # fmt: skip
    """Integrate all scenes, each with its own number of substeps.

    These arrays are results. Rows after the last substep of a scene stay undefined:

    - ``path`` [substep + 1, node, dim]: positions at the start of each substep, and at the end of the frame.
    - ``speed_path`` [substep + 1, node, dim]: velocities at the start of the frame, then those in the middle of each substep after contact.
    - ``pushed`` [substep, node, dim]: velocities in the middle of each substep before contact.
    - ``contacts`` [substep, pair, 6]: normal, place on the edge, fraction of the tangential velocity that friction stops, and the weights of both ends, as
      ``_stop_at_corner`` writes them.
    - ``last_vel`` [node, dim]: velocities at the end of the frame.

    Arrays with fewer rows than substeps are written again from the first row on; two rows are the fewest.
    """
    dim, kept = pos.shape[1], path.shape[0]
    force = np.empty_like(pos)
    for n in range(pos.shape[0]):
        for i in range(dim):
            path[0, n, i], speed_path[0, n, i] = pos[n, i], vel[n, i]
    for s in range(number.shape[0]):
        h = 1.0 / number[s]
        for k in range(number[s] + 1):
            here, ahead, now = k % kept, (k + 1) % kept, k % pushed.shape[0]
            y, velocity = path[here], speed_path[here]
            force[node_start[s] : node_start[s + 1]] = 0.0
            if dim == 2:
                _add_plane_forces(y, velocity, lam, mu, eta, nodes, gradient, volume, cell_start[s], cell_start[s + 1], force)
            else:
                _add_solid_forces(y, velocity, lam, mu, eta, nodes, gradient, volume, cell_start[s], cell_start[s + 1], force)
            add_touching_forces(y, pos, velocity, touching, way, touch, touch_start[s], touch_start[s + 1], force)
            if k == number[s]:
                for n in range(node_start[s], node_start[s + 1]):
                    for i in range(dim):
                        last_vel[n, i] = velocity[n, i] + 0.5 * h * (force[n, i] / mass[n, i] + forcing[n, i])
                continue
            weight = 0.5 * h if k == 0 else h
            for n in range(node_start[s], node_start[s + 1]):
                along, distance, has_wall = 0.0, gap[n], False
                for i in range(dim):
                    value = velocity[n, i] + weight * (force[n, i] / mass[n, i] + forcing[n, i])
                    pushed[now, n, i] = value
                    speed_path[ahead, n, i] = value
                    along += value * normal[n, i]
                    distance += (y[n, i] - pos[n, i]) * normal[n, i]
                    has_wall |= normal[n, i] != 0.0
                change, is_stopped = _wall_contact(distance, along, layer[n], h)
                if has_wall and change > 0.0:
                    square, after = 0.0, -distance / h if is_stopped else along + change
                    for i in range(dim):
                        square += (pushed[now, n, i] - along * normal[n, i]) ** 2
                    left = 0.0
                    if square > (friction[n] * change) ** 2:
                        left = 1.0 - friction[n] * change / math.sqrt(square)
                    for i in range(dim):
                        speed_path[ahead, n, i] = left * (pushed[now, n, i] - along * normal[n, i]) + after * normal[n, i]
            for pq in range(pair_start[s], pair_start[s + 1]):
                _stop_at_corner(y, speed_path[ahead], mass, point[pq], point_friction[pq], pair[pq, 0], pair[pq, 1], h, contacts[now, pq])
            for n in range(node_start[s], node_start[s + 1]):
                for i in range(dim):
                    path[ahead, n, i] = y[n, i] + h * speed_path[ahead, n, i]


@njit(cache=True, error_model="numpy")
@no_type_check
def _pull_back_plane(
    y, velocity, per_mass, lam, mu, eta, nodes, gradient, volume, first_cell, end_cell, to_pos, to_vel, grad_lam, grad_mu, grad_eta
):
    """Add the product of the forces' derivatives and ``per_mass`` [node, 2] to those by positions, velocities and constants."""
    for cell in range(first_cell, end_cell):
        origin = nodes[cell, 0]
        for q in range(volume.shape[1]):
            f00 = f01 = f10 = f11 = d00 = d01 = d10 = d11 = b00 = b01 = b10 = b11 = 0.0
            for a in range(1, nodes.shape[1]):
                n, gx, gy = nodes[cell, a], gradient[cell, q, a, 0], gradient[cell, q, a, 1]
                x0, x1 = y[n, 0] - y[origin, 0], y[n, 1] - y[origin, 1]
                f00, f01, f10, f11 = f00 + x0 * gx, f01 + x0 * gy, f10 + x1 * gx, f11 + x1 * gy
                v0, v1 = velocity[n, 0] - velocity[origin, 0], velocity[n, 1] - velocity[origin, 1]
                d00, d01, d10, d11 = d00 + v0 * gx, d01 + v0 * gy, d10 + v1 * gx, d11 + v1 * gy
                w0, w1 = per_mass[n, 0] - per_mass[origin, 0], per_mass[n, 1] - per_mass[origin, 1]
                b00, b01, b10, b11 = b00 + w0 * gx, b01 + w0 * gy, b10 + w1 * gx, b11 + w1 * gy
            ratio = f00 * f11 - f01 * f10
            if ratio > SMALLEST_RATIO:
                of_lam, of_mu = math.log(ratio) / ratio, -1.0 / ratio
                first = lam[cell] * of_lam + mu[cell] * of_mu
                second = (lam[cell] / ratio - first) / ratio
            else:
                of_lam = (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) / SMALLEST_RATIO
                of_mu = -1.0 / SMALLEST_RATIO
                first = lam[cell] * of_lam + mu[cell] * of_mu
                second = lam[cell] / SMALLEST_RATIO**2
            w = -volume[cell, q]
            along = f11 * b00 - f10 * b01 - f01 * b10 + f00 * b11
            e00, e11 = 2.0 * (f00 * d00 + f10 * d10), 2.0 * (f01 * d01 + f11 * d11)  # Fᵀ Ḟ + Ḟᵀ F
            e01 = f00 * d01 + f10 * d11 + d00 * f01 + d10 * f11
            r00, r11 = 2.0 * (f00 * b00 + f10 * b10), 2.0 * (f01 * b01 + f11 * b11)  # Fᵀ B + Bᵀ F
            r01 = f00 * b01 + f10 * b11 + b00 * f01 + b10 * f11
            grad_lam[cell] += w * of_lam * along
            grad_mu[cell] += w * (f00 * b00 + f01 * b01 + f10 * b10 + f11 * b11 + of_mu * along)
            grad_eta[cell] += w * 0.5 * (e00 * r00 + 2.0 * e01 * r01 + e11 * r11)
            m, t, eta_w = w * mu[cell], w * second * along, w * eta[cell]
            g = w * first
            p00 = m * b00 + t * f11 + g * b11 + eta_w * (b00 * e00 + b01 * e01 + d00 * r00 + d01 * r01)
            p01 = m * b01 - t * f10 - g * b10 + eta_w * (b00 * e01 + b01 * e11 + d00 * r01 + d01 * r11)
            p10 = m * b10 - t * f01 - g * b01 + eta_w * (b10 * e00 + b11 * e01 + d10 * r00 + d11 * r01)
            p11 = m * b11 + t * f00 + g * b00 + eta_w * (b10 * e01 + b11 * e11 + d10 * r01 + d11 * r11)
            s00, s01 = eta_w * (f00 * r00 + f01 * r01), eta_w * (f00 * r01 + f01 * r11)
            s10, s11 = eta_w * (f10 * r00 + f11 * r01), eta_w * (f10 * r01 + f11 * r11)
            for a in range(1, nodes.shape[1]):
                n, gx, gy = nodes[cell, a], gradient[cell, q, a, 0], gradient[cell, q, a, 1]
                h0, h1 = p00 * gx + p01 * gy, p10 * gx + p11 * gy
                to_pos[n, 0] += h0
                to_pos[n, 1] += h1
                to_pos[origin, 0] -= h0
                to_pos[origin, 1] -= h1
                h0, h1 = s00 * gx + s01 * gy, s10 * gx + s11 * gy
                to_vel[n, 0] += h0
                to_vel[n, 1] += h1
                to_vel[origin, 0] -= h0
                to_vel[origin, 1] -= h1


@njit(cache=True, error_model="numpy")
@no_type_check
def _pull_back_solid(
    y, velocity, per_mass, lam, mu, eta, nodes, gradient, volume, first_cell, end_cell,
    to_pos, to_vel, grad_lam, grad_mu, grad_eta,
):  # fmt: skip
    """Add the product of the forces' derivatives and ``per_mass`` [node, dim] to those by positions, velocities and constants."""
    dim = 3
    f, d, b, c = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    p, e, a = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for cell in range(first_cell, end_cell):
        for q in range(volume.shape[1]):
            _gradient_of(y, nodes, gradient, cell, q, f)
            _gradient_of(velocity, nodes, gradient, cell, q, d)
            _gradient_of(per_mass, nodes, gradient, cell, q, b)
            ratio = _cofactor_into(f, c)
            if ratio > SMALLEST_RATIO:
                of_lam, of_mu = math.log(ratio) / ratio, -1.0 / ratio
                first = lam[cell] * of_lam + mu[cell] * of_mu
                second = (lam[cell] / ratio - first) / ratio
            else:
                of_lam = (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) / SMALLEST_RATIO
                of_mu = -1.0 / SMALLEST_RATIO
                first = lam[cell] * of_lam + mu[cell] * of_mu
                second = lam[cell] / SMALLEST_RATIO**2
            along, stretch, viscous = 0.0, 0.0, 0.0
            _twice_strain_rate(f, d, e)
            _multiply(f, e, a)
            for i in range(dim):
                for j in range(dim):
                    along += c[i, j] * b[i, j]
                    stretch += f[i, j] * b[i, j]
                    viscous += a[i, j] * b[i, j]
            # by F: μ B + cofactor terms + η (B (Fᵀ Ḟ + Ḟᵀ F) + Ḟ (Bᵀ F + Fᵀ B))
            _multiply(b, e, p)
            _twice_strain_rate(f, b, e)
            _multiply(d, e, a)
            for i in range(dim):
                for j in range(dim):
                    p[i, j] = eta[cell] * (p[i, j] + a[i, j]) + mu[cell] * b[i, j] + second * along * c[i, j]
            _add_cofactor_change(f, b, first, p)
            _add_stress(to_pos, nodes, gradient, cell, q, -volume[cell, q], p)
            # by Ḟ: η F (Fᵀ B + Bᵀ F)
            _multiply(f, e, p)
            for i in range(dim):
                for j in range(dim):
                    p[i, j] *= eta[cell]
            _add_stress(to_vel, nodes, gradient, cell, q, -volume[cell, q], p)
            grad_lam[cell] -= volume[cell, q] * of_lam * along
            grad_mu[cell] -= volume[cell, q] * (stretch + of_mu * along)
            grad_eta[cell] -= volume[cell, q] * viscous


@njit(cache=True, error_model="numpy")
@no_type_check
def pull_back(
    grad, grad_last, path, speed_path, pushed, contacts, mass, lam, mu, eta, normal, gap, friction, layer, way, touch, pair, touching, nodes, gradient,
    volume, cell_start, node_start, pair_start, touch_start, number,
    grad_pos, grad_vel, grad_forcing, grad_lam, grad_mu, grad_eta, grad_gap, grad_friction, grad_layer, grad_way, grad_touch,
):  # fmt: skip
    """Propagate the gradients of displacement (``grad``) and last velocity (``grad_last``) to the inputs, substep by substep, last first.

    ``grad_pos`` to ``grad_touch`` are results. ``path``, ``speed_path``, ``pushed`` and ``contacts`` are results of ``move_forward``.
    """
    dim = path.shape[2]
    per_mass, to_pos, to_vel, to_start = np.empty_like(grad), np.empty_like(grad), np.empty_like(grad), np.zeros_like(grad)
    for s in range(number.shape[0]):
        first_node, end_node, h = node_start[s], node_start[s + 1], 1.0 / number[s]
        for n in range(first_node, end_node):
            for i in range(dim):
                grad_pos[n, i] = grad[n, i]
                grad_vel[n, i] = grad_last[n, i]
        for k in range(number[s], -1, -1):
            weight = 0.5 * h if k == 0 or k == number[s] else h
            if k < number[s]:
                for n in range(first_node, end_node):
                    for i in range(dim):
                        grad_vel[n, i] += h * grad_pos[n, i]
                for pq in range(pair_start[s + 1] - 1, pair_start[s] - 1, -1):
                    a, b, contact = pair[pq, 0], pair[pq, 1], contacts[k, pq]
                    n0, n1, place, stop = contact[0], contact[1], contact[2], contact[3]
                    if contact[4] == 0.0 and contact[5] == 0.0:
                        continue
                    g0 = contact[4] * grad_vel[a, 0] + contact[5] * grad_vel[b, 0]
                    g1 = contact[4] * grad_vel[a, 1] + contact[5] * grad_vel[b, 1]
                    along = g0 * n0 + g1 * n1
                    c0, c1 = along * n0 + stop * (g0 - along * n0), along * n1 + stop * (g1 - along * n1)
                    grad_vel[a, 0] -= (1.0 - place) * c0
                    grad_vel[a, 1] -= (1.0 - place) * c1
                    grad_vel[b, 0] -= place * c0
                    grad_vel[b, 1] -= place * c1
            for n in range(first_node, end_node):
                if k < number[s]:
                    along, distance, has_wall = 0.0, gap[n], False
                    for i in range(dim):
                        along += pushed[k, n, i] * normal[n, i]
                        distance += (path[k, n, i] - path[0, n, i]) * normal[n, i]
                        has_wall |= normal[n, i] != 0.0
                    change, is_stopped = _wall_contact(distance, along, layer[n], h)
                    if has_wall and change > 0.0:
                        square, of_normal, of_tangential = 0.0, 0.0, 0.0
                        for i in range(dim):
                            tangential = pushed[k, n, i] - along * normal[n, i]
                            square += tangential**2
                            of_normal += grad_vel[n, i] * normal[n, i]
                            of_tangential += grad_vel[n, i] * tangential
                        of_change, left, swept = 0.0, 0.0, 0.0
                        if square > (friction[n] * change) ** 2:
                            root = math.sqrt(square)
                            left = 1.0 - friction[n] * change / root
                            of_change = -friction[n] * of_tangential / root
                            grad_friction[n] -= change * of_tangential / root
                            swept = friction[n] * change / root * of_tangential / square
                        if is_stopped:
                            of_distance, of_along = -(of_normal + of_change) / h, -of_change
                        else:
                            of_soft = h * (of_normal + of_change)
                            depth, towards = 1.0 - distance / layer[n, 0], min(along, 0.0)
                            of_depth = (2.0 * layer[n, 1] * layer[n, 0] * depth - layer[n, 2] * towards) * of_soft
                            of_distance, of_along = -of_depth / layer[n, 0], of_normal
                            grad_layer[n, 0] += layer[n, 1] * depth**2 * of_soft + of_depth * (1.0 - depth) / layer[n, 0]
                            grad_layer[n, 1] += depth**2 * layer[n, 0] * of_soft
                            if along < 0.0:
                                of_along -= layer[n, 2] * depth * of_soft
                                grad_layer[n, 2] -= depth * along * of_soft
                        for i in range(dim):
                            tangential = pushed[k, n, i] - along * normal[n, i]
                            own = grad_vel[n, i] - of_normal * normal[n, i]
                            grad_vel[n, i] = left * own + swept * tangential + of_along * normal[n, i]
                            grad_pos[n, i] += of_distance * normal[n, i]
                            to_start[n, i] -= of_distance * normal[n, i]
                        grad_gap[n] += of_distance
                for i in range(dim):
                    arriving = weight * grad_vel[n, i]
                    grad_forcing[n, i] += arriving
                    per_mass[n, i] = arriving / mass[n, i]
                    to_pos[n, i] = 0.0
                    to_vel[n, i] = 0.0
            if dim == 2:
                _pull_back_plane(
                    path[k], speed_path[k], per_mass, lam, mu, eta, nodes, gradient, volume, cell_start[s], cell_start[s + 1],
                    to_pos, to_vel, grad_lam, grad_mu, grad_eta,
                )  # fmt: skip
            else:
                _pull_back_solid(
                    path[k], speed_path[k], per_mass, lam, mu, eta, nodes, gradient, volume, cell_start[s], cell_start[s + 1],
                    to_pos, to_vel, grad_lam, grad_mu, grad_eta,
                )  # fmt: skip
            pull_back_touching(
                path[k], path[0], speed_path[k], per_mass, touching, way, touch, touch_start[s], touch_start[s + 1],
                to_pos, to_start, to_vel, grad_way, grad_touch,
            )  # fmt: skip
            for n in range(first_node, end_node):
                for i in range(dim):
                    grad_pos[n, i] += to_pos[n, i]
                    grad_vel[n, i] += to_vel[n, i]
        for n in range(first_node, end_node):
            for i in range(dim):
                grad_pos[n, i] += to_start[n, i] - grad[n, i]
