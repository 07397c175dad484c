"""All message-passing steps of a model whose layers read raw edge features, forward and backward as one function (on a CPU).

For node states h of each type, edge features f, and every relation from j to i (parameters differ between steps and relations)::

    x_k = φ(A h_i + B h_j + W f_k + b),   φ(z) = max(z, 0) + p min(z, 0)
    X_i = Σ_k x_k over edges into i,      Y_j = −Σ_k x_k over edges out of j
    t_i = Σ C (X_i + Y_i) + d_i c         over the relations of a type of nodes; d_i is the number of edges into i minus that out of i
    h_i ← h_i + N(R φ(Q t_i + q) + r)     N is a LayerNorm, or the identity

PyTorch would run several hundred small operations per training step, each with a node in the graph of autograd. Here the backward pass is written out, and both
passes are compiled functions (``fused_processor_kernels``). They keep arrays over nodes and no array over edges; the activations of edges are computed again.
As C and Q are linear, Q C is multiplied first, once per relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch._utils import _unflatten_dense_tensors
from torch.nn import functional

from gpe_pl.nn import fused_processor_kernels as kernels
from gpe_pl.nn import matrix_product
from gpe_pl.nn.fused import plain_gradients
from gpe_pl.nn.fused_processor_kernels import C_AT_SOURCE, C_AT_TARGET, C_G_SOURCE, C_G_TARGET


@dataclass(frozen=True)
class Relation:
    """Edges between two types of nodes.

    Attributes:
        source, target: numbers of the types.
        edge_index: source (row 0) and target (row 1) of every edge.
        features: f [edge, feature].
    """

    source: int
    target: int
    edge_index: Tensor
    features: Tensor


class Conv(NamedTuple):
    """Parameters of the messages of a relation, in the order of the fields: [A B W], b, p, C and c of the module's equations."""

    weight: Tensor
    bias: Tensor
    slope: Tensor
    out_weight: Tensor
    out_bias: Tensor


class Update(NamedTuple):
    """Parameters that update the nodes of one type, in the order of the fields: Q, q, p, R and r of the equations; weight and bias of the LayerNorm."""

    weight: Tensor
    bias: Tensor
    slope: Tensor
    out_weight: Tensor
    out_bias: Tensor
    gain: Tensor | None = None
    shift: Tensor | None = None


@dataclass(frozen=True)
class Step:
    """Parameters of one message-passing step.

    Attributes:
        convs: parameters of the relations that send messages in this step, by number of the relation.
        updates: parameters of the types of nodes that are updated, by number of the type.
    """

    convs: dict[int, Conv]
    updates: dict[int, Update]

    @property
    def tensors(self) -> list[Tensor]:
        return [t for group in (*self.convs.values(), *self.updates.values()) for t in group if t is not None]

    def of(self, tensors: list[Tensor]) -> Step:
        """Return a step of the same form whose parameters are the first tensors of the list. They are removed from the list."""

        def taken(group: Any) -> Any:
            return type(group)(*(None if t is None else tensors.pop(0) for t in group))

        return Step({k: taken(c) for k, c in self.convs.items()}, {k: taken(u) for k, u in self.updates.items()})


class _Tables:
    """The steps for one graph as tables of ``nn.fused_processor_kernels``, with the memory for all matrices.

    Args:
        relations, steps, h: as in ``fused_processor``.
    """

    def __init__(self, relations: Sequence[Relation], steps: Sequence[Step], h: Sequence[Tensor]) -> None:
        self.like, self.width, self.steps = h[0], h[0].shape[1], steps
        self.sizes = [rows.shape[0] for rows in h]
        self.size = self.num_grads = 0
        self.convs: list[list[int]] = []
        self.updates: list[list[int]] = []
        self.incoming: list[list[int]] = []
        self.starts = [[0, 0]]
        self._add_edges(relations)
        self.degrees = [{t: self._matrix(self.sizes[t], 1) for t in (r.source, r.target)} for r in relations]
        self.states = [[self._matrix(n) for n in self.sizes]]
        for k, step in enumerate(steps):
            self._add_step(k, step, relations)
        self.of_states = [self._matrix(n) for n in self.sizes]
        self.tensors = h[0].new_empty(self.size)
        self.work = self.tensors.numpy()
        for relation, offsets in zip(relations, self.degrees, strict=True):
            for offset, degree in zip(offsets.values(), _degrees(relation, self.sizes).values(), strict=True):
                self.work[offset : offset + len(degree)] = degree
        self._write(self.states[0], h)
        self.scratch = h[0].new_empty(4 * max(self.sizes) * self.width).numpy()
        self.tables = [
            np.array(rows, np.int64).reshape(len(rows), n) for rows, n in ((self.convs, 24), (self.updates, 23), (self.incoming, 5))
        ]
        self.given = matrix_product.gemm_address(self.work.dtype), *self.tables, *map(np.array, (self.starts, self.sizes, self.states))

    def forward(self, eps: float) -> list[Tensor]:
        """Return the final states."""
        kernels.forward(*self.given, *self.edges, self.work, self.scratch, self.width, eps, self.channels)
        return [self._view(offset, n).clone() for offset, n in zip(self.states[-1], self.sizes, strict=True)]

    def backward(self, grads: Sequence[Tensor]) -> list[Tensor]:
        """Return the gradients of the initial states and of all parameters from those of the final states."""
        self._write(self.of_states, grads)
        result = self.like.new_zeros(self.num_grads)
        offsets = np.array(self.of_states)
        kernels.backward(*self.given, *self.edges, self.work, self.scratch, self.width, self.channels, offsets, result.numpy())
        tensors = [t for step in self.steps for t in step.tensors]
        of_states = [self._view(offset, n).clone() for offset, n in zip(self.of_states, self.sizes, strict=True)]
        return [*of_states, *_unflatten_dense_tensors(result, tensors)]

    def _view(self, offset: int, rows: int) -> Tensor:
        return self.tensors[offset : offset + rows * self.width].view(rows, self.width)

    def _write(self, offsets: list[int], values: Sequence[Tensor]) -> None:
        for offset, rows in zip(offsets, values, strict=True):
            self._view(offset, len(rows)).copy_(rows)

    def _matrix(self, rows: int, columns: int | None = None) -> int:
        """Return the offset of a new matrix."""
        offset = self.size
        self.size += rows * (self.width if columns is None else columns)
        return offset

    def _grads(self, *shapes: Tensor) -> list[int]:
        """Return the offsets of the gradients of parameters."""
        offsets = []
        for shape in shapes:
            offsets.append(self.num_grads)
            self.num_grads += shape.numel()
        return offsets

    def _add_edges(self, relations: Sequence[Relation]) -> None:
        channels = max((r.features.shape[1] for r in relations), default=1)
        counts = [r.edge_index.shape[1] for r in relations]
        self.first_edges = [sum(counts[:k]) for k in range(len(counts))]
        features = self.like.new_zeros(sum(counts), channels)
        for first, count, relation in zip(self.first_edges, counts, relations, strict=True):
            features[first : first + count, : relation.features.shape[1]] = relation.features
        ends = torch.cat([torch.zeros(2, 0, dtype=torch.int64), *(r.edge_index for r in relations)], dim=1).numpy()
        self.edges = ends[0], ends[1], features.numpy()
        self.channels = (0,) * channels

    def _add_step(self, k: int, step: Step, relations: Sequence[Relation]) -> None:
        before, rows = self.states[-1], {}
        for r, conv in step.convs.items():
            relation, edges = relations[r], relations[r].edge_index.shape[1]
            ends, is_joint = (relation.source, relation.target), relation.source == relation.target
            num_source, num_target = (self.sizes[t] for t in ends)
            flags = [int(relation.target in step.updates), int(relation.source in step.updates)]
            places = [self._matrix(num_target), self._matrix(num_source)]
            for _ in range(2):  # sums and their gradients
                at_target = self._matrix(num_target)
                places += [at_target, at_target if is_joint else self._matrix(num_source)]
            channels = relation.features.shape[1]
            rows[r] = len(self.convs)
            addresses = [t.data_ptr() for t in conv]
            self.convs.append([k, *ends, *flags, *addresses, *self._grads(*conv), *places, channels, self.first_edges[r], edges])
        after = [self._matrix(n) if t in step.updates else before[t] for t, n in enumerate(self.sizes)]
        for t, update in step.updates.items():
            first, n = len(self.incoming), self.sizes[t]
            for r, row in rows.items():
                columns = (C_AT_TARGET, C_G_TARGET) if relations[r].target == t else (C_AT_SOURCE, C_G_SOURCE)
                if t in self.degrees[r]:
                    sums = [self.convs[row][column] for column in columns]
                    self.incoming.append([row, *sums, self._matrix(self.width), self.degrees[r][t]])
            there = [0 if x is None else x.data_ptr() for x in update]
            offsets = self._grads(*(x for x in update if x is not None))
            offsets += [0] * (7 - len(offsets))
            own = [before[t], after[t], self._matrix(n), self._matrix(n), self._matrix(n, 1)]
            self.updates.append([k, t, *there, *offsets, *own, first, len(self.incoming) - first])
        self.states.append(after)
        self.starts.append([len(self.convs), len(self.updates)])


def _degrees(relation: Relation, sizes: list[int]) -> dict[int, np.ndarray]:
    """Return d of the nodes of both types, or of the one type that both ends have."""
    source, target = relation.edge_index.numpy()
    out, into = (np.bincount(rows, minlength=sizes[t]) for rows, t in ((source, relation.source), (target, relation.target)))
    is_joint = relation.source == relation.target
    return {relation.source: -out, relation.target: into - out if is_joint else into}


def plain_processor(relations: Sequence[Relation], steps: Sequence[Step], eps: float, h: Sequence[Tensor]) -> list[Tensor]:
    """Do the same as ``fused_processor`` with PyTorch's operations, for comparison and for second derivatives."""
    h = [*h]
    for step in steps:
        total = {t: torch.zeros_like(h[t]) for t in step.updates}
        for r, conv in step.convs.items():
            relation = relations[r]
            j, i = relation.edge_index
            rows = torch.cat([h[relation.target][i], h[relation.source][j], relation.features], dim=1)
            x = functional.prelu(functional.linear(rows, conv.weight, conv.bias), conv.slope)
            message = functional.linear(x, conv.out_weight, conv.out_bias)
            for t, index, sign in ((relation.target, i, 1), (relation.source, j, -1)):
                if t in total:
                    total[t] = total[t].index_add(0, index, message, alpha=sign)
        new = [*h]
        for t, update in step.updates.items():
            y = functional.prelu(functional.linear(total[t], update.weight, update.bias), update.slope)
            y = functional.linear(y, update.out_weight, update.out_bias)
            if update.gain is not None:
                y = functional.layer_norm(y, y.shape[1:], update.gain, update.shift, eps)
            new[t] = h[t] + y
        h = new
    return h


def _given(steps: Sequence[Step], tensors: Sequence[Tensor]) -> list[Step]:
    """Return the steps with other tensors, in the order of ``Step.tensors``."""
    rest = [*tensors]
    return [step.of(rest) for step in steps]


class _FusedProcessor(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, relations: list[Relation], steps: list[Step], eps: float, num_types: int, *tensors: Tensor) -> Any:
        ctx.relations, ctx.steps, ctx.eps, ctx.num_types = relations, steps, eps, num_types
        ctx.save_for_backward(*tensors)
        own = [*map(Tensor.contiguous, tensors)]
        ctx.tables = _Tables(relations, _given(steps, own[num_types:]), own[:num_types])
        return tuple(ctx.tables.forward(eps))  # copies: an output that its own node in autograd's graph holds would never be freed

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:  # type: ignore[override]
        inputs = ctx.saved_tensors  # also checks that they have not changed, as the tables refer to them
        if torch.is_grad_enabled():
            return None, None, None, None, *plain_gradients(partial(_plain, ctx), inputs, grads)
        return None, None, None, None, *ctx.tables.backward(grads)


def _plain(ctx: Any, *tensors: Tensor) -> list[Tensor]:
    return plain_processor(ctx.relations, _given(ctx.steps, tensors[ctx.num_types :]), ctx.eps, tensors[: ctx.num_types])


def fused_processor(relations: Sequence[Relation], steps: Sequence[Step], eps: float, h: Sequence[Tensor]) -> list[Tensor]:
    """Return the states of all types of nodes after all steps, on the CPU in single or double precision; differentiable in states and parameters.

    Every type must be updated in at least one step. Indices must name existing rows; nothing is checked.

    Args:
        relations: edges, whose features are not differentiated.
        steps: parameters of each step.
        eps: ε of all layers of normalisation.
        h: states of each type [node, hidden].
    """
    tensors = [t for step in steps for t in step.tensors]
    return [*_FusedProcessor.apply([*relations], [*steps], eps, len(h), *h, *tensors)]  # type: ignore[no-untyped-call]
