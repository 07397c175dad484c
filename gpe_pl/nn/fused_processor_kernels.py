"""Compiled passes of ``nn.fused_processor``: all steps forward, and all steps backward, with the matrix products of PyTorch's BLAS library.

Node states and everything that depends on nodes are matrices [node, width] in one array, ``work``, at offsets that tables give. Parameters are read at their
addresses. Gradients of parameters go to one array, ``grads``.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.nn.fused import FASTMATH
from gpe_pl.nn.matrix_product import gemm
from gpe_pl.nn.pointers import matrix_at

EDGES = 512
"""Number of edges whose gradients are stored at a time, to be multiplied with their features in one product."""
OPTIONS = {"cache": True, "error_model": "numpy"}
REASSOCIATED = {*FASTMATH, "reassoc"}


# Columns of the tables. In ``convs``, messages of a relation in a step: numbers of types, flags, addresses of parameters, offsets of their gradients, offsets
# of matrices, channels of the features, and edges. In ``updates``: the same for a type in a step; ``incoming`` names the relations that send messages to it.
(C_SOURCE, C_TARGET, C_TO_TARGET, C_TO_SOURCE, C_WEIGHT, C_BIAS, C_SLOPE, C_OUT, C_OUT_BIAS) = range(1, 10)
(C_G_WEIGHT, C_G_BIAS, C_G_SLOPE, C_G_OUT, C_G_OUT_BIAS, C_A, C_B, C_AT_TARGET, C_AT_SOURCE, C_G_TARGET, C_G_SOURCE) = range(10, 21)
(C_FEATURES, C_FIRST, C_COUNT) = range(21, 24)
(U_TYPE, U_WEIGHT, U_BIAS, U_SLOPE, U_OUT, U_OUT_BIAS, U_GAIN, U_SHIFT) = range(1, 9)
(U_G_WEIGHT, U_G_BIAS, U_G_SLOPE, U_G_OUT, U_G_OUT_BIAS, U_G_GAIN, U_G_SHIFT) = range(9, 16)
(U_BEFORE, U_AFTER, U_Z, U_ROWS, U_SCALE, U_FIRST, U_COUNT) = range(16, 23)
(I_CONV, I_SUMS, I_G_SUMS, I_PRODUCT, I_DEGREE) = range(5)


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _matrix(values, offset, rows, columns):
    return values[offset : offset + rows * columns].reshape(rows, columns)


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _repeat(row, rows):
    """Write a row [1, width] to all rows. Numba compiles the assignment of an array to an array much longer."""
    for k in range(len(rows)):
        for c in range(rows.shape[1]):
            rows[k, c] = row[0, c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _sum_rows(x, total, result):
    total[:] = 0
    for k in range(len(x)):
        for c in range(x.shape[1]):
            total[c] += x[k, c]
    for c in range(x.shape[1]):
        result[c] = total[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _feature_weight(weight, width, w):
    for q in range(len(w)):
        for c in range(width):
            w[q, c] = weight[c, 2 * width + q] if 2 * width + q < weight.shape[1] else 0


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _send(a, b, f, w, slope, source, target, at_target, at_source, to_target, to_source, channels):
    """Add the activations of all edges at their targets, and subtract them at their sources; ``channels`` has as many entries as an edge has features."""
    x = np.empty(a.shape[1], a.dtype)
    for k in range(len(source)):
        i, j = target[k], source[k]
        for c in range(len(x)):
            z = a[i, c] + b[j, c]
            for q in range(len(channels)):  # its length is known to the compiler, which unrolls the loop
                z += f[k, q] * w[q, c]
            x[c] = z if z > 0 else slope * z
        if to_target:
            for c in range(len(x)):
                at_target[i, c] += x[c]
        if to_source:
            for c in range(len(x)):
                at_source[j, c] -= x[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _return(
    a, b, f, w, slope, source, target, grad_target, grad_source, to_target, to_source, first, count, g, grad_a, grad_b, below, channels
):
    """Write the gradients of z of a block of edges to g, and add them to those of their nodes."""
    x, z, block_below = np.zeros(a.shape[1], a.dtype), np.empty(a.shape[1], a.dtype), np.zeros(a.shape[1], a.dtype)
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(len(x)):
            y = a[i, c] + b[j, c]
            for q in range(len(channels)):
                y += f[first + k, q] * w[q, c]
            z[c] = y
        if to_target and to_source:
            for c in range(len(x)):
                x[c] = grad_target[i, c] - grad_source[j, c]
        elif to_target:
            for c in range(len(x)):
                x[c] = grad_target[i, c]
        else:
            for c in range(len(x)):
                x[c] = -grad_source[j, c]
        for c in range(len(x)):
            block_below[c] += x[c] * min(z[c], 0)
            g[k, c] = x[c] if z[c] > 0 else slope * x[c]
        for c in range(len(x)):
            grad_a[i, c] += g[k, c]
        for c in range(len(x)):
            grad_b[j, c] += g[k, c]
    below += block_below


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _activate(z, slope, y):
    for k in range(len(z)):
        for c in range(z.shape[1]):
            y[k, c] = z[k, c] if z[k, c] > 0 else slope * z[k, c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _activate_back(z, slope, g, y, below):
    """Turn g, the gradient of φ(z), into that of z, and write φ(z) to y."""
    for k in range(len(z)):
        for c in range(z.shape[1]):
            x = z[k, c]
            below[c] += g[k, c] * min(x, 0)
            y[k, c] = x if x > 0 else slope * x
            g[k, c] = g[k, c] if x > 0 else slope * g[k, c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _add(y, bias, h, new):
    for k in range(len(y)):
        for c in range(y.shape[1]):
            new[k, c] = h[k, c] + y[k, c] + bias[c]


@njit(fastmath=REASSOCIATED, **OPTIONS)
@no_type_check
def _normalize(y, bias, gain, shift, eps, h, new, scale):
    """Write h + N(y + bias) to ``new``; y becomes the normalised rows, and ``scale`` what they were multiplied by."""
    width = y.shape[1]
    for k in range(len(y)):
        total = square = y[k, 0] * 0
        for c in range(width):
            y[k, c] += bias[c]
            total += y[k, c]
        mean = total / width
        for c in range(width):
            y[k, c] -= mean
            square += y[k, c] * y[k, c]
        factor = 1 / np.sqrt(square / width + eps)
        scale[k] = factor
        for c in range(width):
            y[k, c] *= factor
            new[k, c] = h[k, c] + y[k, c] * gain[c] + shift[c]


@njit(fastmath=REASSOCIATED, **OPTIONS)
@no_type_check
def _normalize_back(grad, y, scale, gain, out, grad_gain, grad_shift):
    """Write the gradient of the rows before normalisation to ``out``, and add those of weight and bias."""
    width = y.shape[1]
    for k in range(len(y)):
        total = product = y[k, 0] * 0
        for c in range(width):
            g = grad[k, c] * gain[c]
            total += g
            product += g * y[k, c]
        total, product = total / width, product / width
        for c in range(width):
            out[k, c] = scale[k] * (grad[k, c] * gain[c] - total - y[k, c] * product)
        for c in range(width):
            grad_gain[c] += grad[k, c] * y[k, c]
            grad_shift[c] += grad[k, c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def forward(address, convs, updates, incoming, starts, sizes, states, source, target, features, work, scratch, width, eps, channels):
    """Execute all steps.

    Args:
        address: ``gemm_address``.
        convs, updates, incoming: tables.
        starts: first row of each step in ``convs`` and ``updates`` [step + 1, 2].
        sizes: number of nodes of each type.
        states: offset of the states of each type before each step, and after the last [step + 1, type].
        source, target: ends of all edges.
        features: features of all edges; zeros fill up to the largest number of channels.
        work: all matrices.
        scratch: memory for one matrix of the largest type.
        width: number of channels of node states.
        eps: ε of normalisation.
        channels: a tuple with an entry per column of ``features``.
    """
    place, size = work.ctypes.data, work.itemsize
    w, row = np.empty((len(channels), width), work.dtype), np.empty(width, work.dtype)
    for s in range(len(starts) - 1):
        for o in range(starts[s, 0], starts[s + 1, 0]):
            p = convs[o]
            stride, num_target, num_source = 2 * width + p[C_FEATURES], sizes[p[C_TARGET]], sizes[p[C_SOURCE]]
            a, b = _matrix(work, p[C_A], num_target, width), _matrix(work, p[C_B], num_source, width)
            _repeat(matrix_at(p[C_BIAS], 1, width, work), a)
            h_target, h_source = place + size * states[s, p[C_TARGET]], place + size * states[s, p[C_SOURCE]]
            gemm(work, address, 0, 1, num_target, width, width, h_target, width, p[C_WEIGHT], stride, 1, place + size * p[C_A], width)
            gemm(
                work,
                address,
                0,
                1,
                num_source,
                width,
                width,
                h_source,
                width,
                p[C_WEIGHT] + size * width,
                stride,
                0,
                place + size * p[C_B],
                width,
            )
            _feature_weight(matrix_at(p[C_WEIGHT], width, stride, work), width, w)
            at_target, at_source = _matrix(work, p[C_AT_TARGET], num_target, width), _matrix(work, p[C_AT_SOURCE], num_source, width)
            at_target[:] = 0
            at_source[:] = 0
            first, end = p[C_FIRST], p[C_FIRST] + p[C_COUNT]
            _send(
                a, b, features[first:end], w, matrix_at(p[C_SLOPE], 1, 1, work)[0, 0], source[first:end], target[first:end], at_target, at_source,
                p[C_TO_TARGET], p[C_TO_SOURCE], channels,
            )  # fmt: skip
        for o in range(starts[s, 1], starts[s + 1, 1]):
            p = updates[o]
            n = sizes[p[U_TYPE]]
            z, weight = _matrix(work, p[U_Z], n, width), matrix_at(p[U_WEIGHT], width, width, work)
            _repeat(matrix_at(p[U_BIAS], 1, width, work), z)
            for r in range(p[U_FIRST], p[U_FIRST] + p[U_COUNT]):
                q = incoming[r]
                conv, degree = convs[q[I_CONV]], work[q[I_DEGREE] : q[I_DEGREE] + n]
                bias = matrix_at(conv[C_OUT_BIAS], 1, width, work)
                for i in range(width):
                    total = bias[0, 0] * 0
                    for c in range(width):
                        total += weight[i, c] * bias[0, c]
                    row[i] = total
                for k in range(n):
                    for c in range(width):
                        z[k, c] += degree[k] * row[c]
                product = place + size * q[I_PRODUCT]
                gemm(work, address, 0, 0, width, width, width, p[U_WEIGHT], width, conv[C_OUT], width, 0, product, width)
                gemm(work, address, 0, 1, n, width, width, place + size * q[I_SUMS], width, product, width, 1, place + size * p[U_Z], width)
            active, y = _matrix(scratch, 0, n, width), _matrix(work, p[U_ROWS], n, width)
            _activate(z, matrix_at(p[U_SLOPE], 1, 1, work)[0, 0], active)
            gemm(work, address, 0, 1, n, width, width, scratch.ctypes.data, width, p[U_OUT], width, 0, place + size * p[U_ROWS], width)
            before, after = _matrix(work, p[U_BEFORE], n, width), _matrix(work, p[U_AFTER], n, width)
            bias = matrix_at(p[U_OUT_BIAS], 1, width, work)[0]
            if p[U_GAIN]:
                gain, shift = matrix_at(p[U_GAIN], 1, width, work)[0], matrix_at(p[U_SHIFT], 1, width, work)[0]
                _normalize(y, bias, gain, shift, eps, before, after, work[p[U_SCALE] : p[U_SCALE] + n])
            else:
                _add(y, bias, before, after)


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def backward(
    address, convs, updates, incoming, starts, sizes, states, source, target, features, work, scratch, width, channels, of_states, grads
):
    """Execute all steps backward; arguments as in ``forward``.

    Args:
        scratch: memory for four matrices of the largest type.
        of_states: offset in ``work`` of the gradient of the states of each type: of the final ones before, of the initial ones after.
        grads: zeros, to which the gradients of parameters are added.
    """
    place, size, free, of_grads = work.ctypes.data, work.itemsize, scratch.ctypes.data, grads.ctypes.data
    largest = len(scratch) // 4
    w, square = np.empty((len(channels), width), work.dtype), np.empty((width, width), work.dtype)
    of_w, block = np.empty((len(channels), width), work.dtype), np.empty((EDGES, width), work.dtype)
    below, total, other = np.empty(width), np.empty(width), np.empty(width)
    for s in range(len(starts) - 2, -1, -1):
        for o in range(starts[s, 1], starts[s + 1, 1]):
            p = updates[o]
            n, grad_at = sizes[p[U_TYPE]], of_states[p[U_TYPE]]
            grad, y, g, active = (
                _matrix(work, grad_at, n, width), _matrix(scratch, 0, n, width), _matrix(scratch, largest, n, width), _matrix(scratch, 2 * largest, n, width),
            )  # fmt: skip
            if p[U_GAIN]:
                total[:] = 0
                other[:] = 0
                gain = matrix_at(p[U_GAIN], 1, width, work)[0]
                _normalize_back(grad, _matrix(work, p[U_ROWS], n, width), work[p[U_SCALE] : p[U_SCALE] + n], gain, y, total, other)
                for c in range(width):
                    grads[p[U_G_GAIN] + c] = total[c]
                    grads[p[U_G_SHIFT] + c] = other[c]
            else:
                for k in range(n):
                    for c in range(width):
                        y[k, c] = grad[k, c]
            gemm(work, address, 0, 0, n, width, width, free, width, p[U_OUT], width, 0, free + size * largest, width)
            below[:] = 0
            _activate_back(_matrix(work, p[U_Z], n, width), matrix_at(p[U_SLOPE], 1, 1, work)[0, 0], g, active, below)
            grads[p[U_G_SLOPE]] = below.sum()
            gemm(
                work, address, 1, 0, width, width, n, free, width, free + size * 2 * largest, width, 0, of_grads + size * p[U_G_OUT], width
            )
            _sum_rows(y, total, grads[p[U_G_OUT_BIAS] : p[U_G_OUT_BIAS] + width])
            _sum_rows(g, total, grads[p[U_G_BIAS] : p[U_G_BIAS] + width])
            weight, of_weight = matrix_at(p[U_WEIGHT], width, width, work), _matrix(grads, p[U_G_WEIGHT], width, width)
            for r in range(p[U_FIRST], p[U_FIRST] + p[U_COUNT]):
                q = incoming[r]
                conv, degree = convs[q[I_CONV]], work[q[I_DEGREE] : q[I_DEGREE] + n]
                of_g, of_square = free + size * largest, square.ctypes.data
                gemm(
                    work,
                    address,
                    0,
                    0,
                    n,
                    width,
                    width,
                    of_g,
                    width,
                    place + size * q[I_PRODUCT],
                    width,
                    0,
                    place + size * q[I_G_SUMS],
                    width,
                )
                gemm(work, address, 1, 0, width, width, n, of_g, width, place + size * q[I_SUMS], width, 0, of_square, width)
                gemm(
                    work,
                    address,
                    0,
                    1,
                    width,
                    width,
                    width,
                    of_square,
                    width,
                    conv[C_OUT],
                    width,
                    1,
                    of_grads + size * p[U_G_WEIGHT],
                    width,
                )
                gemm(
                    work,
                    address,
                    1,
                    0,
                    width,
                    width,
                    width,
                    p[U_WEIGHT],
                    width,
                    of_square,
                    width,
                    1,
                    of_grads + size * conv[C_G_OUT],
                    width,
                )
                total[:] = 0
                for k in range(n):
                    for c in range(width):
                        total[c] += degree[k] * g[k, c]
                bias, of_bias = matrix_at(conv[C_OUT_BIAS], 1, width, work)[0], grads[conv[C_G_OUT_BIAS] : conv[C_G_OUT_BIAS] + width]
                for i in range(width):
                    for c in range(width):
                        of_weight[i, c] += total[i] * bias[c]
                        of_bias[c] += total[i] * weight[i, c]
        for o in range(starts[s, 0], starts[s + 1, 0]):
            p = convs[o]
            stride, num_target, num_source = 2 * width + p[C_FEATURES], sizes[p[C_TARGET]], sizes[p[C_SOURCE]]
            a, b = _matrix(work, p[C_A], num_target, width), _matrix(work, p[C_B], num_source, width)
            of_a, of_b = _matrix(scratch, 0, num_target, width), _matrix(scratch, largest, num_source, width)
            _feature_weight(matrix_at(p[C_WEIGHT], width, stride, work), width, w)
            grad_target, grad_source = _matrix(work, p[C_G_TARGET], num_target, width), _matrix(work, p[C_G_SOURCE], num_source, width)
            of_a[:] = 0
            of_b[:] = 0
            of_w[:] = 0
            below[:] = 0
            slope, first, end = matrix_at(p[C_SLOPE], 1, 1, work)[0, 0], p[C_FIRST], p[C_FIRST] + p[C_COUNT]
            for start in range(first, end, EDGES):
                count = min(EDGES, end - start)
                _return(
                    a, b, features, w, slope, source, target, grad_target, grad_source, p[C_TO_TARGET], p[C_TO_SOURCE], start, count, block, of_a, of_b,
                    below, channels,
                )  # fmt: skip
                gemm(
                    work, address, 1, 0, len(channels), width, count, features.ctypes.data + size * start * len(channels), len(channels), block.ctypes.data,
                    width, 1, of_w.ctypes.data, width,
                )  # fmt: skip
            of_weight = of_grads + size * p[C_G_WEIGHT]
            h_target, h_source = place + size * states[s, p[C_TARGET]], place + size * states[s, p[C_SOURCE]]
            gemm(work, address, 1, 0, width, width, num_target, free, width, h_target, width, 0, of_weight, stride)
            gemm(
                work,
                address,
                1,
                0,
                width,
                width,
                num_source,
                free + size * largest,
                width,
                h_source,
                width,
                0,
                of_weight + size * width,
                stride,
            )
            whole = _matrix(grads, p[C_G_WEIGHT], width, stride)
            for c in range(width):
                for q in range(p[C_FEATURES]):
                    whole[c, 2 * width + q] = of_w[q, c]
            _sum_rows(of_a, total, grads[p[C_G_BIAS] : p[C_G_BIAS] + width])
            grads[p[C_G_SLOPE]] = below.sum()
            for t, at, n, column in ((p[C_TARGET], 0, num_target, 0), (p[C_SOURCE], largest, num_source, width)):
                gemm(
                    work, address, 0, 0, n, width, width, free + size * at, width, p[C_WEIGHT] + size * column, stride, 1, place + size * of_states[t], width
                )  # fmt: skip
