"""Executes the instructions of a network program in one compiled function, ``run``. ``network_program`` writes the instructions and explains the terms.

The instructions of a segment are executed for a block of rows at a time, so that what one instruction writes is still in the cache when the next one reads it.
Matrices are in one array, ``work``, and weights in another.

The table lists instructions, their arguments, and what they compute. Arguments are the numbers of matrices, the places of weights (W, b, gain, shift, ε, and
the slope of the PReLU φ), and counts. ``column`` is the first of the columns that are read, ``to`` the first that are written, and n the number of columns.
In GATHER_ODD, a and b are columns of one matrix, ``nodes``. An edge has the target i and the source j. ``end`` is 1 for the target, 0 for the source::

    PRODUCT        y x column channels W n to mode          y = x W,  y += x W,  or the latter except in the first such product of a segment
    BIAS           y to b n                                 y += b
    DEGREE         y d b n column                           y += d b, d a column of numbers
    ACTIVATE       y b φ n fills                            y = φ(y + b), with y = 0 if ``fills`` and no product was joined
    NORMALIZE      y h b gain shift ε n adds                h = LayerNorm(y + b),  or h += LayerNorm(y + b)
    RESIDUAL       y h b n                                  h += y + b
    ZERO           y                                        y = 0
    DIVIDE         y d                                      y = y / d, with y = 0 if no product was joined
    MESSAGES       w a column b column n φ T to S to        x = φ(a_i + b_j + w),  T_i += x,  S_j −= x
    GATHER         w a column b column n φ end              w = φ(a_i + b_j + w), or with i and j exchanged if ``end`` is 0
    GATHER_ODD     w nodes a b u n φ                        x = φ(a_i + b_j + u + w),  y = φ(a_j + b_i + u − w),  w = x − y,  u = x + y
    ACTIVATE_ODD   w u b φ n                                w = φ(u + b + w) − φ(u + b − w)
    UPDATE         m e b n                                  m += b,  e += m
    SCATTER        x n T to sign end body body              T_i += sign x, i the end of the edge; not within a body if types of bodies are given
    COUNT          T to sign end body body                  T_i += sign, likewise
"""

from __future__ import annotations

from typing import no_type_check

from numba import njit

from gpe_pl.nn.fused import FASTMATH
from gpe_pl.nn.matrix_product import gemm
from gpe_pl.nn.pointers import matrix_at, row_of

BLOCK = 256
"""Largest number of rows in a block."""
(
    PRODUCT,
    BIAS,
    DEGREE,
    ACTIVATE,
    NORMALIZE,
    RESIDUAL,
    ZERO,
    DIVIDE,
    MESSAGES,
    GATHER,
    GATHER_ODD,
    ACTIVATE_ODD,
    UPDATE,
    SCATTER,
    COUNT,
) = range(15)
SET, ADD, JOIN = 0, 1, 2
"""A product replaces y, is added to it, or is joined: the first joined product of a segment replaces y, later ones are added. One segment joins to one y."""
NONE = -1
"""Number of a matrix or set of rows that an instruction does without."""
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _matrix(work, offset, rows, stride):
    return matrix_at(work.ctypes.data + work.itemsize * offset, rows, stride, work)


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _add_bias(y, column, bias):
    for k in range(len(y)):
        own = row_of(y, k, column, len(bias))
        for c in range(len(bias)):
            own[c] += bias[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _add_degree(y, degree, column, bias):
    for k in range(len(y)):
        d = degree[k, column]
        for c in range(len(bias)):
            y[k, c] += d * bias[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _activate(y, bias, slope):
    for k in range(len(y)):
        for c in range(len(bias)):
            z = y[k, c] + bias[c]
            y[k, c] = z if z > 0 else slope * z


@njit(fastmath={*FASTMATH, "reassoc"}, **OPTIONS)
@no_type_check
def _normalize(h, y, bias, gain, shift, eps, adds):
    n = len(bias)
    for k in range(len(y)):
        total = y[k, 0] * 0
        for c in range(n):
            y[k, c] += bias[c]
            total += y[k, c]
        mean = total / n
        total = y[k, 0] * 0
        for c in range(n):
            total += (y[k, c] - mean) * (y[k, c] - mean)
        factor = 1 / (total / n + eps) ** 0.5
        if adds:
            for c in range(n):
                h[k, c] += (y[k, c] - mean) * factor * gain[c] + shift[c]
        else:
            for c in range(n):
                h[k, c] = (y[k, c] - mean) * factor * gain[c] + shift[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _add_residual(h, y, bias):
    for k in range(len(y)):
        for c in range(len(bias)):
            h[k, c] += y[k, c] + bias[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _messages(ends, a, a_column, b, b_column, w, n, slope, at_target, t_column, at_source, s_column):
    for k in range(len(ends)):
        i, j = ends[k, 1], ends[k, 0]
        own, other, edge = row_of(a, i, a_column, n), row_of(b, j, b_column, n), row_of(w, k, 0, n)
        total, opposite = row_of(at_target, i, t_column, n), row_of(at_source, j, s_column, n)
        for c in range(n):
            z = own[c] + other[c] + edge[c]
            x = z if z > 0 else slope * z
            total[c] += x
            opposite[c] -= x


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _gather(ends, end, a, a_column, b, b_column, w, n, slope):
    for k in range(len(ends)):
        own, other = row_of(a, ends[k, end], a_column, n), row_of(b, ends[k, 1 - end], b_column, n)
        edge = row_of(w, k, 0, n)
        for c in range(n):
            z = own[c] + other[c] + edge[c]
            edge[c] = z if z > 0 else slope * z


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _gather_odd(ends, a, a_column, b, b_column, w, u, n, slope):
    for k in range(len(ends)):
        i, j = ends[k, 1], ends[k, 0]
        a_i, a_j, b_i, b_j = row_of(a, i, a_column, n), row_of(a, j, a_column, n), row_of(b, i, b_column, n), row_of(b, j, b_column, n)
        odd, even = row_of(w, k, 0, n), row_of(u, k, 0, n)
        for c in range(n):
            y = a_i[c] + b_j[c] + even[c] + odd[c]
            z = a_j[c] + b_i[c] + even[c] - odd[c]
            y = y if y > 0 else slope * y
            z = z if z > 0 else slope * z
            odd[c] = y - z
            even[c] = y + z


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _activate_odd(w, u, bias, slope):
    for k in range(len(w)):
        for c in range(len(bias)):
            y = u[k, c] + bias[c] + w[k, c]
            z = u[k, c] + bias[c] - w[k, c]
            w[k, c] = (y if y > 0 else slope * y) - (z if z > 0 else slope * z)


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _update(e, m, bias):
    for k in range(len(m)):
        for c in range(len(bias)):
            message = m[k, c] + bias[c]
            m[k, c] = message
            e[k, c] += message


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _scatter(ends, end, x, n, sums, column, sign, body, first, first_other):
    """Add rows of edges to rows at one of their ends, except edges within one body."""
    for k in range(len(ends)):
        i = ends[k, end]
        if first >= 0 and body[first + i] >= 0 and body[first + i] == body[first_other + ends[k, 1 - end]]:
            continue
        total, edge = row_of(sums, i, column, n), row_of(x, k, 0, n)
        for c in range(n):
            total[c] += sign * edge[c]


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def _count(ends, end, sums, column, sign, body, first, first_other):
    for k in range(len(ends)):
        i = ends[k, end]
        if first >= 0 and body[first + i] >= 0 and body[first + i] == body[first_other + ends[k, 1 - end]]:
            continue
        sums[i, column] += sign


@njit(fastmath=FASTMATH, **OPTIONS)
@no_type_check
def run(address, segments, instructions, offset, stride, is_block, span, height, weights, work, ends, first_edge, body, first_node):
    """Execute all segments.

    Args:
        address: result of ``matrix_product.gemm_address``.
        segments: set of rows, first instruction and end of the instructions of each segment [segment, 3].
        instructions: code, set of rows without which the instruction is skipped, and arguments [instruction, 16].
        offset, stride, is_block: place of each matrix in ``work``, its number of columns, and whether it has only the rows of one block [matrix].
        span: first row and end of the rows of each set [set, 2].
        height: number of rows of each matrix that has all rows of its set [matrix].
        weights: all weights.
        work: all matrices.
        ends: source and target of the edges of all relations [edge, 2].
        first_edge: row in ``ends`` at which the edges of a set of rows start, or ``NONE`` for nodes [set].
        body: body of all nodes, or -1 [node].
        first_node: row in ``body`` at which the nodes of a type start [type].
    """
    of_work, of_weights, bytes_ = work.ctypes.data, weights.ctypes.data, work.itemsize
    for s in range(len(segments)):
        rows = segments[s, 0]
        low, high = span[rows, 0], span[rows, 1]
        if high <= low:
            continue
        step = (high - low + BLOCK - 1) // BLOCK
        step = (high - low + step - 1) // step
        for first in range(low, high, step):
            count, joined = min(step, high - first), False
            some = ends[first_edge[rows] + first : first_edge[rows] + first + count] if first_edge[rows] >= 0 else ends[:0]
            for o in range(segments[s, 1], segments[s, 2]):
                p = instructions[o]
                code = p[0]
                if p[1] >= 0 and span[p[1], 1] <= span[p[1], 0]:
                    continue
                m = p[2]
                if code == COUNT:
                    one, other = (first_node[p[6]], first_node[p[7]]) if p[6] >= 0 else (NONE, NONE)
                    _count(some, p[5], _matrix(work, offset[m], height[m], stride[m]), p[3], p[4], body, one, other)
                    continue
                start = offset[m] if is_block[m] else offset[m] + first * stride[m]
                y = _matrix(work, start, count, stride[m])
                if code == PRODUCT:
                    x = p[3]
                    x_start = (offset[x] if is_block[x] else offset[x] + first * stride[x]) + p[4]
                    adds = p[9] == ADD or (p[9] == JOIN and joined)
                    joined = joined or p[9] == JOIN
                    gemm(
                        work, address, 0, 0, count, p[7], p[5], of_work + bytes_ * x_start, stride[x], of_weights + bytes_ * p[6], p[7],
                        1 if adds else 0, of_work + bytes_ * (start + p[8]), stride[m],
                    )  # fmt: skip
                elif code == BIAS:
                    _add_bias(y, p[3], weights[p[4] : p[4] + p[5]])
                elif code == DEGREE:
                    d = p[3]
                    _add_degree(y, _matrix(work, offset[d] + first * stride[d], count, stride[d]), p[6], weights[p[4] : p[4] + p[5]])
                elif code == ACTIVATE:
                    if p[6] and not joined:
                        y[:] = 0
                    _activate(y, weights[p[3] : p[3] + p[5]], weights[p[4]])
                elif code == NORMALIZE:
                    h = p[3]
                    _normalize(
                        _matrix(work, offset[h] + first * stride[h], count, stride[h]), y, weights[p[4] : p[4] + p[8]],
                        weights[p[5] : p[5] + p[8]], weights[p[6] : p[6] + p[8]], weights[p[7]], p[9],
                    )  # fmt: skip
                elif code == RESIDUAL:
                    h = p[3]
                    _add_residual(_matrix(work, offset[h] + first * stride[h], count, stride[h]), y, weights[p[4] : p[4] + p[5]])
                elif code == ZERO:
                    y[:] = 0
                elif code == DIVIDE:
                    if not joined:
                        y[:] = 0
                    d = p[3]
                    divisor = _matrix(work, offset[d] + first * stride[d], count, stride[d])
                    for k in range(count):
                        for c in range(stride[m]):
                            y[k, c] /= divisor[k, 0]
                elif code == MESSAGES:
                    a, b, t, u = p[3], p[5], p[9], p[11]
                    _messages(
                        some, _matrix(work, offset[a], height[a], stride[a]), p[4], _matrix(work, offset[b], height[b], stride[b]), p[6],
                        y, p[7], weights[p[8]], _matrix(work, offset[t], height[t], stride[t]), p[10],
                        _matrix(work, offset[u], height[u], stride[u]), p[12],
                    )  # fmt: skip
                elif code == GATHER:
                    a, b = p[3], p[5]
                    _gather(
                        some, p[9], _matrix(work, offset[a], height[a], stride[a]), p[4], _matrix(work, offset[b], height[b], stride[b]), p[6],
                        y, p[7], weights[p[8]],
                    )  # fmt: skip
                elif code == GATHER_ODD:
                    a, u = p[3], p[6]
                    of_nodes = _matrix(work, offset[a], height[a], stride[a])
                    _gather_odd(some, of_nodes, p[4], of_nodes, p[5], y, _matrix(work, offset[u], count, stride[u]), p[7], weights[p[8]])
                elif code == ACTIVATE_ODD:
                    u = p[3]
                    _activate_odd(y, _matrix(work, offset[u], count, stride[u]), weights[p[4] : p[4] + p[6]], weights[p[5]])
                elif code == UPDATE:
                    e = p[3]
                    _update(_matrix(work, offset[e] + first * stride[e], count, stride[e]), y, weights[p[4] : p[4] + p[5]])
                elif code == SCATTER:
                    t = p[4]
                    one, other = (first_node[p[8]], first_node[p[9]]) if p[8] >= 0 else (NONE, NONE)
                    _scatter(some, p[7], y, p[3], _matrix(work, offset[t], height[t], stride[t]), p[5], p[6], body, one, other)
