"""Network programs: a network as a list of instructions, which one compiled call executes in a rollout on a CPU.

A model writes its layers with the methods of ``NetworkProgram``. ``Executable`` runs the program, with the loops of ``network_program_kernels``. Weights are
copied when the program is written, so write it again when they change. These terms are used:

- A *set of rows* is the nodes of a type, those of them with or without an edge, or the edges of a relation. Its number of rows differs from graph to graph.
- A *matrix* has the rows of one set, or scratch memory for one block of rows. Sets, matrices and weights are named by their number in the program.
- A *segment* is a list of instructions that is executed for one block of the rows of a set after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gpe_pl.nn import matrix_product
from gpe_pl.nn import network_program_kernels as kernels
from gpe_pl.nn.network_program_io import find_wrong_edges, load_bodies, load_edges, load_nodes, number_nodes, store
from gpe_pl.nn.network_program_kernels import BLOCK, NONE, SET, run

NUM_ARGUMENTS = 14
ALIGNED = 16
"""Matrices begin at multiples of this number of elements."""


@dataclass(frozen=True)
class NodeType:
    """A type of nodes: its number, and the numbers of its sets of rows: every node, nodes with an edge (``connected``), and nodes without (``isolated``)."""

    number: int
    every: int
    connected: int
    isolated: int


@dataclass
class NetworkProgram:
    """A network as a list of instructions.

    Methods that add an instruction take the numbers of matrices (``y``, ``x``, …); a pair is a matrix and a column in it. ``network_program_kernels`` has the
    equations. With ``needs``, an instruction is skipped if this set of rows is empty.

    Args:
        dtype: precision of all matrices.

    Attributes:
        node_types: types of nodes by name.
        relations: number of the set of rows of each relation.
    """

    dtype: torch.dtype
    node_types: dict[str, NodeType] = field(default_factory=dict)
    relations: dict[Any, int] = field(default_factory=dict)
    num_sets: int = 0
    matrices: list[tuple[int, int]] = field(default_factory=list)
    instructions: list[list[int]] = field(default_factory=list)
    segments: list[tuple[int, int, int]] = field(default_factory=list)
    weights: list[np.ndarray] = field(default_factory=list)
    num_weights: int = 0

    # --- rows, matrices and weights ---------------------------------------------------------------------------------------------------------

    def node_type(self, name: str) -> NodeType:
        """Add a type of nodes, with new sets of rows, and return it."""
        first = self.new_set(), self.new_set(), self.new_set()
        self.node_types[name] = NodeType(len(self.node_types), *first)
        return self.node_types[name]

    def new_set(self) -> int:
        """Add a set of rows, and return its number."""
        self.num_sets += 1
        return self.num_sets - 1

    def matrix(self, rows: int, columns: int) -> int:
        """Add a matrix and return its number. Its rows are those of the set ``rows``, or with ``NONE`` those of one block."""
        self.matrices.append((rows, max(columns, 1)))
        return len(self.matrices) - 1

    def weight(self, values: Tensor) -> int:
        """Add weights, and return the index at which they start in the array of all weights."""
        flat = values.detach().to(self.dtype).contiguous().numpy().ravel()
        self.weights.append(flat)
        self.num_weights += len(flat)
        return self.num_weights - len(flat)

    @contextmanager
    def segment(self, rows: int) -> Iterator[None]:
        """Add a segment for the set ``rows``. It consists of the instructions that are added inside this context."""
        first = len(self.instructions)
        yield
        if len(self.instructions) > first:
            self.segments.append((rows, first, len(self.instructions)))

    def _add(self, code: int, *arguments: int, needs: int = NONE) -> None:
        self.instructions.append([code, needs, *arguments, *[0] * (NUM_ARGUMENTS - len(arguments))])

    # --- instructions of rows, see ``network_program_kernels`` --------------------------------------------------------------------------------

    def product(self, y: int, x: int, weight: Tensor, mode: int = SET, column: int = 0, to: int = 0, needs: int = NONE) -> None:
        """Write y[:, to:] = x[:, column:] Wᵀ, for a weight W [out, in] as PyTorch stores it."""
        out, channels = weight.shape
        if channels:
            self._add(kernels.PRODUCT, y, x, column, channels, self.weight(weight.t()), out, to, mode, needs=needs)
        elif mode == SET:
            self._add(kernels.ZERO, y, needs=needs)

    def bias(self, y: int, bias: Tensor, column: int = 0, needs: int = NONE) -> None:
        """Add a bias to the columns of y from ``column`` on."""
        self._add(kernels.BIAS, y, column, self.weight(bias), len(bias), needs=needs)

    def degree(self, y: int, degree: int, column: int, bias: Tensor, needs: int = NONE) -> None:
        """Add a bias to y, times the number in a column of the matrix ``degree``."""
        self._add(kernels.DEGREE, y, degree, self.weight(bias), len(bias), column, needs=needs)

    def activate(self, y: int, bias: Tensor, slope: Tensor, needs: int = NONE, fills: bool = False) -> None:
        """Replace y by the PReLU of y plus a bias. With ``fills``, y counts as zero if no product was joined to it."""
        self._add(kernels.ACTIVATE, y, self.weight(bias), self.weight(slope), len(bias), int(fills), needs=needs)

    def normalize(self, h: int, y: int, bias: Tensor, norm: torch.nn.LayerNorm, adds: bool) -> None:
        """Write the LayerNorm of y plus a bias to h, or add it to h if ``adds``."""
        eps = self.weight(torch.tensor([norm.eps], dtype=torch.float64))
        self._add(
            kernels.NORMALIZE,
            y,
            h,
            self.weight(bias),
            self.weight(norm.weight),
            self.weight(norm.bias),
            eps,
            len(bias),
            int(adds),
        )

    def residual(self, h: int, y: int, bias: Tensor) -> None:
        """Add matrix y plus a bias to matrix h."""
        self._add(kernels.RESIDUAL, y, h, self.weight(bias), len(bias))

    def zero(self, y: int) -> None:
        """Set y to zero."""
        self._add(kernels.ZERO, y)

    def divide(self, y: int, divisor: int) -> None:
        """Divide the rows of y by the first column of ``divisor``. y counts as zero if no product was joined to it."""
        self._add(kernels.DIVIDE, y, divisor)

    # --- instructions of edges; ends are 1 for the target and 0 for the source ---------------------------------------------------------------

    def messages(self, w: int, width: int, slope: Tensor, target: tuple[int, int], source: tuple[int, int], at_target: tuple[int, int], at_source: tuple[int, int]) -> None:  # fmt: skip  # noqa: E501
        """Compute messages from a (at the target), b (at the source) and w (of the edge). Add them to sums at the target and subtract them at the source."""
        self._add(kernels.MESSAGES, w, *target, *source, width, self.weight(slope), *at_target, *at_source)

    def gather(self, w: int, width: int, slope: Tensor, own: tuple[int, int], other: tuple[int, int], end: int = 1) -> None:
        """Replace w by the PReLU of the sum of a (at ``end``), b (at the other end) and w."""
        self._add(kernels.GATHER, w, *own, *other, width, self.weight(slope), end)

    def gather_odd(self, w: int, u: int, width: int, slope: Tensor, nodes: int, a: int, b: int) -> None:
        """Compute the activations of an edge in both directions. Replace w by their difference and u by their sum."""
        self._add(kernels.GATHER_ODD, w, nodes, a, b, u, width, self.weight(slope))

    def activate_odd(self, w: int, u: int, bias: Tensor, slope: Tensor) -> None:
        """Replace w by the difference of the activations of u plus w and u minus w, each with a bias."""
        self._add(kernels.ACTIVATE_ODD, w, u, self.weight(bias), self.weight(slope), len(bias))

    def update(self, m: int, e: int, bias: Tensor) -> None:
        """Add a bias to the messages m, and add the messages to the edge states e."""
        self._add(kernels.UPDATE, m, e, self.weight(bias), len(bias))

    def scatter(self, x: int, width: int, sums: tuple[int, int], sign: int, end: int, bodies: tuple[int, int] = (NONE, NONE)) -> None:
        """Add the rows of edges, times ``sign``, to sums at one end. If the types of nodes at both ends are given, edges within one body are left out."""
        self._add(kernels.SCATTER, x, width, *sums, sign, end, *bodies)

    def count(self, degree: tuple[int, int], sign: int, end: int, bodies: tuple[int, int] = (NONE, NONE)) -> None:
        """Add ``sign`` at one end of each edge, in a column of ``degree``; ``bodies`` as in ``scatter``."""
        self._add(kernels.COUNT, *degree, sign, end, *bodies)


class Tables(NamedTuple):
    """Inputs and results of a program, as one integer table per kind with a row per tensor.

    Two such objects describe a call: one says what the tensors are and stays the same, the other has their addresses and sizes. ``network_program_io``
    documents the columns of both.

    Attributes:
        nodes: features of nodes.
        edges: edges of relations and their features.
        bodies: body of each node.
        results: results at nodes.
    """

    nodes: np.ndarray
    edges: np.ndarray
    bodies: np.ndarray
    results: np.ndarray


class Executable:
    """A program that is ready to run. Its matrices stay in memory between calls.

    Args:
        program: the program.
        kinds: what the tensors of each input and result are, as the arguments ``kinds`` of ``network_program_io``.
    """

    def __init__(self, program: NetworkProgram, kinds: Tables) -> None:
        self.kinds = kinds
        self.instructions = np.array(program.instructions, np.int64).reshape(-1, NUM_ARGUMENTS + 2)
        self.segments = np.array(program.segments, np.int64).reshape(-1, 3)
        self.weights = np.concatenate(program.weights)
        self.rows = np.array([rows for rows, _ in program.matrices], np.int64)
        self.stride = np.array([columns for _, columns in program.matrices], np.int64)
        self.is_block = self.rows == NONE
        self.sets = np.array([[t.every, t.connected, t.isolated] for t in program.node_types.values()], np.int64).reshape(-1, 3)
        self.address = matrix_product.gemm_address(self.weights.dtype)
        self._free: list[np.ndarray] = []

    def __call__(self, tensors: Tables, num_nodes: np.ndarray, size: np.ndarray, apart: bool, sorts: bool) -> int | None:
        """Run the program and return None. If an edge names a node that does not exist, return the number of its relation and run nothing.

        Args:
            tensors: addresses and sizes of the inputs and results, as the arguments ``arrays`` of ``network_program_io``. The memory must stay allocated. Sizes
                are not checked.
            num_nodes: number of nodes of each type.
            size: number of rows of each set of all nodes of a type, and of each relation. Those of nodes with or without an edge are ignored: the call counts
                them.
            apart: leave nodes without an edge out of message passing.
            sorts: sort nodes in memory by the order in which edges reach them.
        """
        height = np.where(self.is_block, BLOCK, size[self.rows])
        length = (height * self.stride + ALIGNED - 1) // ALIGNED * ALIGNED
        offset, needed = np.cumsum(length) - length, int(length.sum())
        try:
            work = self._free.pop()  # each thread that runs the program takes its own
        except IndexError:
            work = self.weights[:0]
        if len(work) < needed:
            work = np.empty(needed + needed // 4, self.weights.dtype)
        wrong = _run(
            self.address, self.segments, self.instructions, offset, self.stride, self.is_block, height, self.weights, work, size, num_nodes,
            self.sets, *self.kinds, *tensors, apart, sorts,
        )  # fmt: skip
        self._free.append(work)
        return None if wrong == NONE else wrong


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _run(
    address, segments, instructions, offset, stride, is_block, height, weights, work, size, num_nodes, sets, node_kinds, edge_kinds, body_kinds,
    result_kinds, nodes, edges, bodies, results, apart, sorts,
):  # fmt: skip
    wrong = find_wrong_edges(edge_kinds, edges, num_nodes)
    if wrong != NONE:
        return wrong
    num_sets, first_node = len(size), np.cumsum(num_nodes) - num_nodes
    number, connected = np.empty(num_nodes.sum(), np.int64), np.empty(len(num_nodes), np.int64)
    number_nodes(edge_kinds, edges, first_node, num_nodes, number, connected, apart, sorts)
    span = np.zeros((num_sets, 2), np.int64)
    for k in range(num_sets):
        span[k, 1] = size[k]
    for t in range(len(num_nodes)):
        span[sets[t, 1], 1] = connected[t]
        span[sets[t, 2], 0], span[sets[t, 2], 1] = connected[t], num_nodes[t]
    first_edge, num_edges = np.full(num_sets, NONE), 0
    for r in range(len(edge_kinds)):
        rows = edge_kinds[r, 2]
        if first_edge[rows] == NONE:
            first_edge[rows] = num_edges
            num_edges += size[rows]
    ends = np.empty((num_edges, 2), np.int64)
    body = np.empty(len(number) if len(bodies) else 0, np.int64)
    load_nodes(node_kinds, nodes, number, first_node, work, offset, stride, height)
    load_edges(edge_kinds, edges, number, first_node, ends, first_edge, work, offset, stride)
    load_bodies(body_kinds, bodies, number, first_node, body)
    run(address, segments, instructions, offset, stride, is_block, span, height, weights, work, ends, first_edge, body, first_node)
    store(result_kinds, results, number, first_node, work, offset, stride)
    return NONE
