"""Copies a graph into the matrices of a network program, and the results back into tensors.

Nodes are renumbered. Nodes with an edge come first if nodes without one are set apart. In large scenes, nodes have the order in which edges first reach them,
so that neighbours are near each other in memory. In the functions, ``kinds`` say what the tensors are, and ``arrays`` have their addresses and sizes.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.nn.network_program_kernels import NONE, OPTIONS
from gpe_pl.nn.pointers import matrix_at


@njit(**OPTIONS)
@no_type_check
def find_wrong_edges(edge_kinds, edge_arrays, num_nodes):
    """Return the number of the first relation with an edge whose source or target does not exist, or ``NONE``; arguments as in ``number_nodes``."""
    for r in range(len(edge_kinds)):
        index = matrix_at(edge_arrays[r, 0], 2, edge_arrays[r, 3], num_nodes)
        for end in range(2):
            limit = num_nodes[edge_kinds[r, end]] - edge_arrays[r, 4 + end]
            for k in range(index.shape[1]):
                if not 0 <= index[end, k] < limit:
                    return r
    return NONE


@njit(**OPTIONS)
@no_type_check
def number_nodes(edge_kinds, edge_arrays, first_node, num_nodes, number, connected, apart, sorts):
    """Number the nodes of every type, those without an edge last if they are set ``apart``.

    Args:
        edge_kinds, edge_arrays: ``kinds`` and ``arrays`` of relations, see ``load_edges``.
        first_node: row in ``number`` at which the nodes of a type start [type].
        num_nodes: number of nodes [type].
        number: result; new number of each node among those of its type [node].
        connected: number of nodes with an edge, or of all nodes if they are not set apart [type]; a result.
        apart: set nodes without an edge apart.
        sorts: number nodes in the order in which edges reach them.
    """
    number[:] = NONE
    connected[:] = 0
    if apart or sorts:
        for r in range(len(edge_kinds)):
            index = matrix_at(edge_arrays[r, 0], 2, edge_arrays[r, 3], number)
            for k in range(index.shape[1]):
                for end in range(2):
                    t = edge_kinds[r, end]
                    node = first_node[t] + edge_arrays[r, 4 + end] + index[end, k]
                    if number[node] < 0:
                        number[node] = connected[t]
                        connected[t] += 1
    for t in range(len(num_nodes)):
        some = number[first_node[t] : first_node[t] + num_nodes[t]]
        last = connected[t]
        if not sorts:
            last = 0
            for k in range(len(some)):
                if some[k] >= 0:
                    some[k] = last
                    last += 1
        for k in range(len(some)):
            if some[k] < 0:
                some[k] = last
                last += 1
        if not apart:
            connected[t] = len(some)


@njit(**OPTIONS)
@no_type_check
def load_nodes(kinds, arrays, number, first_node, work, offset, stride, height):
    """Copy the inputs of nodes into matrices.

    Args:
        kinds: node type, matrix, and number of columns of each input [input, 3].
        arrays: address, number of rows, and number of the first node of each tensor [input, 3].
        number, first_node: see ``number_nodes``.
        work, offset, stride, height: matrices, see ``network_program_kernels.run``.
    """
    for k in range(len(kinds)):
        t, m, columns = kinds[k]
        address, rows, first = arrays[k]
        values = matrix_at(address, rows, columns, work)
        target = matrix_at(work.ctypes.data + work.itemsize * offset[m], height[m], stride[m], work)
        for row in range(rows):
            at = number[first_node[t] + first + row]
            for c in range(columns):
                target[at, c] = values[row, c]


@njit(**OPTIONS)
@no_type_check
def load_edges(kinds, arrays, number, first_node, ends, first_edge, work, offset, stride):
    """Copy the indices and features of edges. Edges of symmetric relations are turned as by ``momentum_conv.orient``.

    Args:
        kinds: for each relation, the node types of source and target, set of rows, matrix, number of odd and of even features, whether edges are turned, and
            matrix for the features of the opposite direction or ``NONE`` [relation, 8].
        arrays: for each relation, the addresses of indices, odd and even features, the number of edges, and the numbers of the first source and target
            [relation, 6].
        number, first_node: see ``number_nodes``.
        ends, first_edge: source and target of all edges; a result. See ``network_program_kernels.run``.
        work, offset, stride: matrices, see ``network_program_kernels.run``.
    """
    filled = np.zeros(len(first_edge), np.int64)
    for r in range(len(kinds)):
        source, target, rows, m, num_odd, num_even, turns, opposite = kinds[r]
        count = arrays[r, 3]
        index = matrix_at(arrays[r, 0], 2, count, number)
        odd, even = matrix_at(arrays[r, 1], count, num_odd, work), matrix_at(arrays[r, 2], count, num_even, work)
        j_first, i_first = first_node[source] + arrays[r, 4], first_node[target] + arrays[r, 5]
        start = filled[rows]  # relations with the same weights have one set of rows
        filled[rows] += count
        y = matrix_at(work.ctypes.data + work.itemsize * (offset[m] + start * stride[m]), count, stride[m], work)
        for k in range(count):
            turned = False
            if turns:
                for c in range(num_odd):
                    if odd[k, c] != 0:
                        turned = odd[k, c] < 0
                        break
            j, i = number[j_first + index[0, k]], number[i_first + index[1, k]]
            edge = first_edge[rows] + start + k
            ends[edge, 0], ends[edge, 1] = (i, j) if turned else (j, i)
            for c in range(num_odd):
                y[k, c] = -odd[k, c] if turned else odd[k, c]
            for c in range(num_even):
                y[k, num_odd + c] = even[k, c]
        if opposite >= 0:
            z = matrix_at(work.ctypes.data + work.itemsize * (offset[opposite] + start * stride[m]), count, stride[m], work)
            for k in range(count):
                for c in range(num_odd + num_even):
                    z[k, c] = -y[k, c] if c < num_odd else y[k, c]


@njit(**OPTIONS)
@no_type_check
def load_bodies(types_, arrays, number, first_node, body):
    """Copy the body of every node of some types. Nodes of other types belong to no body.

    Args:
        types_: node type of each tensor [tensor].
        arrays: address, number of rows, and number of the first node of each tensor [tensor, 3].
        number, first_node: see ``number_nodes``.
        body: result; body by the new number of the node, or ``NONE`` [node].
    """
    body[:] = NONE
    for k in range(len(types_)):
        address, rows, first = arrays[k]
        start = first_node[types_[k]]
        of_rows = matrix_at(address, 1, rows, body)
        for row in range(rows):
            body[start + number[start + first + row]] = of_rows[0, row]


@njit(**OPTIONS)
@no_type_check
def store(kinds, arrays, number, first_node, work, offset, stride):
    """Copy results into tensors, in the original order of nodes.

    Args:
        kinds: type, matrix, and number of columns of each result [result, 3].
        arrays: address, number of rows, and number of the first node of each tensor [result, 3].
        number, first_node: see ``number_nodes``.
        work, offset, stride: matrices, see ``network_program_kernels.run``.
    """
    for k in range(len(kinds)):
        t, m, columns = kinds[k]
        address, rows, first = arrays[k]
        y = matrix_at(address, rows, columns, work)
        for row in range(rows):
            at = offset[m] + number[first_node[t] + first + row] * stride[m]
            for c in range(columns):
                y[row, c] = work[at + c]
