"""All message-passing steps of a model whose layers read raw edge features, forward and backward as one function (on a CPU).

For node states h of each type, edge features f, and every relation from j to i (parameters differ between steps and relations)::

    x_k = φ(A h_i + B h_j + W f_k + b),   φ(z) = max(z, 0) + p min(z, 0)
    X_i = Σ_k x_k over edges into i,      Y_j = −Σ_k x_k over edges out of j
    t_i = Σ C (X_i + Y_i) + d_i c         over the relations of a type of nodes; d_i is the number of edges into i minus that out of i
    h_i ← h_i + N(R φ(Q t_i + q) + r)     N is a LayerNorm, or the identity

PyTorch would run several hundred small operations per training step, each with a node in the graph of autograd. Here the backward pass is written out. It keeps
arrays over nodes and no array over edges; the activations of edges are computed again. As C and Q are linear, Q C is multiplied first, once per relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn.fused import FASTMATH, plain_gradients

EDGES = 512
"""Number of edges in a block of the backward pass, whose gradients are multiplied by their features together."""
OPTIONS = {"cache": True, "error_model": "numpy"}


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
    """Parameters of the messages of a relation: [A B W], b, p, C and c."""

    weight: Tensor
    bias: Tensor
    slope: Tensor
    out_weight: Tensor
    out_bias: Tensor


class Update(NamedTuple):
    """Parameters of the update of a type of nodes: Q, q, p, R and r, then weight and bias of the LayerNorm, or None."""

    weight: Tensor
    bias: Tensor
    slope: Tensor
    out_weight: Tensor
    out_bias: Tensor
    gain: Tensor | None = None
    shift: Tensor | None = None


@dataclass(frozen=True)
class Step:
    """A step: parameters of the relations that send messages in it, and of the types of nodes that are updated, by their numbers."""

    convs: dict[int, Conv]
    updates: dict[int, Update]

    @property
    def tensors(self) -> list[Tensor]:
        return [t for group in (*self.convs.values(), *self.updates.values()) for t in group if t is not None]

    def of(self, tensors: list[Tensor]) -> Step:
        """Return the same step with other tensors, which are removed from the front of the list."""

        def taken(group: Any) -> Any:
            return type(group)(*(None if t is None else tensors.pop(0) for t in group))

        return Step({k: taken(c) for k, c in self.convs.items()}, {k: taken(u) for k, u in self.updates.items()})


# --- compiled loops ------------------------------------------------------------------------------------------------------------------------


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


@njit(fastmath={*FASTMATH, "reassoc"}, **OPTIONS)
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


@njit(fastmath={*FASTMATH, "reassoc"}, **OPTIONS)
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


# --- forward and backward ------------------------------------------------------------------------------------------------------------------


class _Edges:
    """Arrays of a relation: ends, features, a tuple with an entry per feature, and d of both ends, or of the one type that both have."""

    def __init__(self, relation: Relation, num_nodes: list[int]) -> None:
        self.source, self.target = relation.edge_index.contiguous().numpy()
        self.features = relation.features.detach().contiguous()
        self.channels = (0,) * self.features.shape[1]
        j, i = relation.edge_index
        into, out = torch.bincount(i, minlength=num_nodes[relation.target]), torch.bincount(j, minlength=num_nodes[relation.source])
        self.is_joint = relation.source == relation.target
        self.degrees = {relation.source: -out, relation.target: into - out if self.is_joint else into}


@dataclass
class _Sent:
    """Rows A h + b and B h of a relation, and the sums of its messages by type: both ends if they differ."""

    a: Tensor
    b: Tensor
    sums: dict[int, Tensor]


@dataclass
class _Updated:
    """Values of an update that its backward pass needs.

    Attributes:
        incoming: relations with messages to the type.
        degrees: a column of ones, then d of each incoming relation.
        products: Q C of each incoming relation.
        z: argument of φ.
        rows: normalised rows, and their factors; empty without normalisation.
    """

    incoming: list[int]
    degrees: Tensor
    products: list[Tensor]
    z: Tensor
    rows: Tensor
    scale: Tensor


class _Processor:
    """The steps for one graph. Nodes of each type are a list entry."""

    def __init__(self, relations: Sequence[Relation], steps: Sequence[Step], eps: float, h: Sequence[Tensor]) -> None:
        self.relations, self.steps, self.eps = relations, steps, eps
        self.edges = [_Edges(r, [len(rows) for rows in h]) for r in relations]
        self.states = [[rows.detach().contiguous() for rows in h]]
        self.sent: list[dict[int, _Sent]] = []
        self.updated: list[dict[int, _Updated]] = []

    def forward(self) -> list[Tensor]:
        for step in self.steps:
            h = self.states[-1]
            sent = {r: self._send(r, conv, h, step) for r, conv in step.convs.items()}
            new, updated = [*h], {}
            for t, update in step.updates.items():
                new[t], updated[t] = self._update(t, update, h[t], sent, step)
            self.states.append(new)
            self.sent.append(sent)
            self.updated.append(updated)
        return self.states[-1]

    def _send(self, r: int, conv: Conv, h: list[Tensor], step: Step) -> _Sent:
        relation, edges = self.relations[r], self.edges[r]
        a_weight, b_weight, w = _parts(conv)
        a, b = torch.addmm(conv.bias, h[relation.target], a_weight.t()), torch.mm(h[relation.source], b_weight.t())
        sums = {t: torch.zeros_like(a if t == relation.target else b) for t in edges.degrees if t in step.updates}
        ends = [sums.get(t) for t in (relation.target, relation.source)]
        arrays = [(a if x is None else x).numpy() for x in ends]  # not written to if absent
        there = [x is not None for x in ends]
        _send(
            a.numpy(), b.numpy(), edges.features.numpy(), w.numpy(), conv.slope.numpy()[0], edges.source, edges.target, *arrays, *there, edges.channels
        )  # fmt: skip
        return _Sent(a, b, sums)

    def _update(self, t: int, update: Update, h: Tensor, sent: dict[int, _Sent], step: Step) -> tuple[Tensor, _Updated]:
        incoming = [r for r, s in sent.items() if t in s.sums]
        degrees = torch.stack([torch.ones_like(h[:, 0]), *(self.edges[r].degrees[t].to(h.dtype) for r in incoming)], dim=1)
        rows = torch.stack([update.bias, *(torch.mv(update.weight, step.convs[r].out_bias) for r in incoming)])
        z = torch.mm(degrees, rows)
        products = [torch.mm(update.weight, step.convs[r].out_weight) for r in incoming]
        for r, product in zip(incoming, products, strict=True):
            z.addmm_(sent[r].sums[t], product.t())
        active = torch.empty_like(z)
        _activate(z.numpy(), update.slope.numpy()[0], active.numpy())
        y, new, bias = torch.mm(active, update.out_weight.t()), torch.empty_like(h), update.out_bias.numpy()
        scale = h.new_empty(len(h))
        if update.gain is None or update.shift is None:
            _add(y.numpy(), bias, h.numpy(), new.numpy())
            return new, _Updated(incoming, degrees, products, z, y[:0], scale)
        _normalize(y.numpy(), bias, update.gain.numpy(), update.shift.numpy(), self.eps, h.numpy(), new.numpy(), scale.numpy())
        return new, _Updated(incoming, degrees, products, z, y, scale)

    def backward(self, grads: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Return the gradients of the initial states and of all parameters from those of the final states, which are overwritten."""
        of_parameters: list[list[Tensor]] = []
        for k in range(len(self.steps) - 1, -1, -1):
            step, sent, updated, h = self.steps[k], self.sent[k], self.updated[k], self.states[k]
            of_sums: dict[tuple[int, int], Tensor] = {}
            of_out = {r: [torch.zeros_like(conv.out_weight), torch.zeros_like(conv.out_bias)] for r, conv in step.convs.items()}
            of_updates = [
                g
                for t, update in step.updates.items()
                for g in self._update_back(t, update, updated[t], sent, step, grads[t], of_sums, of_out)
            ]
            of_convs = [g for r, conv in step.convs.items() for g in (*self._send_back(r, conv, sent[r], h, of_sums, grads), *of_out[r])]
            of_parameters.append(of_convs + of_updates)
        return grads, [g for part in reversed(of_parameters) for g in part]

    def _update_back(
        self,
        t: int,
        update: Update,
        kept: _Updated,
        sent: dict[int, _Sent],
        step: Step,
        grad: Tensor,
        of_sums: dict[tuple[int, int], Tensor],
        of_out: dict[int, list[Tensor]],
    ) -> list[Tensor]:
        """Return the gradients of an update's parameters, write those of the sums of messages, and add those of C and c."""
        width = grad.shape[1]
        norm: list[Tensor] = []
        if update.gain is None:
            y = grad
        else:
            y = torch.empty_like(grad)
            totals = grad.new_zeros(2, width, dtype=torch.float64)
            _normalize_back(grad.numpy(), kept.rows.numpy(), kept.scale.numpy(), update.gain.numpy(), y.numpy(), *totals.numpy())
            norm = [*totals.to(grad.dtype)]
        g, active, below = torch.mm(y, update.out_weight), torch.empty_like(kept.z), np.zeros(width)
        _activate_back(kept.z.numpy(), update.slope.numpy()[0], g.numpy(), active.numpy(), below)
        of_rows = torch.mm(kept.degrees.t(), g)
        of_weight = torch.zeros_like(update.weight)
        for k, (r, product) in enumerate(zip(kept.incoming, kept.products, strict=True), start=1):
            conv = step.convs[r]
            of_sums[r, t] = torch.mm(g, product)
            of_product = torch.mm(g.t(), sent[r].sums[t])
            of_weight.addmm_(of_product, conv.out_weight.t()).addr_(of_rows[k], conv.out_bias)
            of_out[r][0].addmm_(update.weight.t(), of_product)
            of_out[r][1].addmv_(update.weight.t(), of_rows[k])
        slope = grad.new_tensor([below.sum()])
        return [of_weight, of_rows[0], slope, torch.mm(y.t(), active), y.sum(dim=0), *norm]

    def _send_back(
        self, r: int, conv: Conv, sent: _Sent, h: list[Tensor], of_sums: dict[tuple[int, int], Tensor], grads: list[Tensor]
    ) -> list[Tensor]:
        """Return the gradients of [A B W], b and p, and add those of the node states to ``grads``."""
        relation, edges = self.relations[r], self.edges[r]
        a_weight, b_weight, w = _parts(conv)
        of_a, of_b, of_w = torch.zeros_like(sent.a), torch.zeros_like(sent.b), torch.zeros_like(w)
        below, ends = np.zeros(sent.a.shape[1]), [of_sums.get((r, t)) for t in (relation.target, relation.source)]
        arrays, there = [(sent.a if x is None else x).numpy() for x in ends], [x is not None for x in ends]
        block = sent.a.new_empty(min(EDGES, len(edges.source)), sent.a.shape[1])
        given = (
            *(sent.a.numpy(), sent.b.numpy(), edges.features.numpy(), w.numpy(), conv.slope.numpy()[0], edges.source, edges.target),
            *arrays, *there,
        )  # fmt: skip
        results = block.numpy(), of_a.numpy(), of_b.numpy(), below, edges.channels
        for first in range(0, len(edges.source), EDGES):
            count = min(EDGES, len(edges.source) - first)
            _return(*given, first, count, *results)
            of_w.addmm_(edges.features[first : first + count].t(), block[:count])
        width = len(a_weight)
        of_weight = torch.empty_like(conv.weight, memory_format=torch.contiguous_format)
        torch.mm(of_a.t(), h[relation.target], out=of_weight[:, :width])
        torch.mm(of_b.t(), h[relation.source], out=of_weight[:, width : 2 * width])
        of_weight[:, 2 * width :] = of_w.t()
        grads[relation.target].addmm_(of_a, a_weight)
        grads[relation.source].addmm_(of_b, b_weight)
        return [of_weight, of_a.sum(dim=0), of_a.new_tensor([below.sum()])]


def _parts(conv: Conv) -> tuple[Tensor, Tensor, Tensor]:
    """Return A, B, and W transposed."""
    width = len(conv.weight)
    return conv.weight[:, :width], conv.weight[:, width : 2 * width], conv.weight[:, 2 * width :].t().contiguous()


def plain_processor(relations: Sequence[Relation], steps: Sequence[Step], eps: float, h: Sequence[Tensor]) -> list[Tensor]:
    """Return the result of ``fused_processor`` by PyTorch's operations, for comparison and for second derivatives."""
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
        ctx.processor = _Processor(relations, _given(steps, [t.detach() for t in tensors[num_types:]]), eps, tensors[:num_types])
        # other tensors than those that the processor keeps: an output that its own node in autograd's graph holds would never be freed
        return tuple(states.detach() for states in ctx.processor.forward())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:  # type: ignore[override]
        if torch.is_grad_enabled():
            return None, None, None, None, *plain_gradients(partial(_plain, ctx), ctx.saved_tensors, grads)
        of_states, of_parameters = ctx.processor.backward([g.clone(memory_format=torch.contiguous_format) for g in grads])
        return None, None, None, None, *of_states, *of_parameters


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
