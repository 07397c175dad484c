"""Messages and new latent states of all edges, a block of edges at a time (on a CPU).

With rows a of the targets, b of the sources, latent states e and even features s of the edges, for an edge k from j to i::

    z_k = a_i + b_j + W e_k + V s_k,   z'_k = a_j + b_i − W e_k + V s_k
    x_k = φ(z_k)   or, for odd messages,   x_k = φ(z_k) − φ(z'_k),   φ(z) = max(z, 0) + p min(z, 0)
    m_k = C x_k + c,   T_i = Σ_k m_k over edges into i,   S_j = −Σ_k m_k over edges out of j,   e'_k = e_k + m_k

A block stays in the cache between its two matrix products, whereas plain PyTorch reads and writes every edge in memory about ten times. The backward pass
recomputes the activations.
"""

from __future__ import annotations

from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import njit
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn.fused import FASTMATH, block_size, blocks, plain_gradients


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate(a, b, w, slope, source, target, first, count, x):
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            z = a[i, c] + b[j, c] + w[k, c]
            x[k, c] = z if z > 0 else slope * z


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate_odd(a, b, w, u, slope, source, target, first, count, x):
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            y = a[i, c] + b[j, c] + u[k, c] + w[k, c]
            z = a[j, c] + b[i, c] + u[k, c] - w[k, c]
            x[k, c] = (y if y > 0 else slope * y) - (z if z > 0 else slope * z)


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _update(m, bias, e, source, target, first, count, new, at_target, at_source):
    """Add m + bias to the sums at the ends of a block's edges, and to their states e, in place or into ``new``."""
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(m.shape[1]):
            message = m[k, c] + bias[c]
            if new is None:  # with one array under two names the loop would not be vectorised
                e[first + k, c] += message
            else:
                new[first + k, c] = e[first + k, c] + message
            at_target[i, c] += message
            at_source[j, c] -= message


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _sum(x, source, target, first, count, at_target, at_source):
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(x.shape[1]):
            at_target[i, c] += x[k, c]
            at_source[j, c] -= x[k, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _gather_grad(grad_target, grad_source, source, target, first, count, g):
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(g.shape[1]):
            g[k, c] = grad_target[i, c] - grad_source[j, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _gather_message_grad(grad_target, grad_source, grad_new, source, target, first, count, g, total):
    """Gather the gradients of the messages, which include those of new states. Add their sum over the block to ``total``.

    Summing within blocks, then over blocks, is at least as accurate as PyTorch.
    """
    block_sum = np.zeros_like(g[0])
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(g.shape[1]):
            y = grad_target[i, c] - grad_source[j, c] + grad_new[first + k, c]
            g[k, c] = y
            block_sum[c] += y
    total += block_sum


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward(a, b, w, slope, source, target, first, count, g, grad_a, grad_b, below):
    """Turn g, the gradient of x, into the gradient of z."""
    block_sum = np.zeros_like(g[0])
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            z = a[i, c] + b[j, c] + w[k, c]
            negative = z <= 0
            block_sum[c] += g[k, c] * z if negative else 0
            y = slope * g[k, c] if negative else g[k, c]
            g[k, c] = y
            grad_a[i, c] += y
            grad_b[j, c] += y
    below += block_sum


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward_odd(a, b, w, u, slope, source, target, first, count, g, even, grad_a, grad_b, below):
    """Turn g, the gradient of x, into the gradient of W e; ``even`` becomes the gradient of V s."""
    block_sum = np.zeros_like(g[0])
    for k in range(count):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            y = a[i, c] + b[j, c] + u[k, c] + w[k, c]
            z = a[j, c] + b[i, c] + u[k, c] - w[k, c]
            p = slope * g[k, c] if y <= 0 else g[k, c]
            q = slope * g[k, c] if z <= 0 else g[k, c]
            block_sum[c] += g[k, c] * ((y if y <= 0 else 0) - (z if z <= 0 else 0))
            g[k, c] = p + q
            even[k, c] = p - q
            grad_a[i, c] += p
            grad_b[j, c] += p
            grad_a[j, c] -= q
            grad_b[i, c] -= q
    below += block_sum


class _Layer:
    """Data for all blocks: rows a and b, edge states and features, the first linear map, and buffers for W e, V s and x of one block."""

    def __init__(
        self, a: Tensor, b: Tensor, e: Tensor, s: Tensor | None, weight: Tensor, even_weight: Tensor, slope: Tensor, edge_index: Tensor
    ) -> None:
        self.a, self.b, self.e = (t.detach().contiguous() for t in (a, b, e))
        self.s = None if s is None else s.detach()
        self.weight, self.even_weight = (t.detach().t().contiguous() for t in (weight, even_weight))
        self.slope = slope.detach().numpy()[0]
        self.source, self.target = edge_index.contiguous().numpy()
        self.rows = self.a.numpy(), self.b.numpy()
        self.w, self.u, self.x = e.new_empty(3, block_size(len(e)), weight.shape[0])
        self.arrays = self.w.numpy(), self.u.numpy(), self.x.numpy()

    def multiply(self, first: int, count: int) -> tuple[np.ndarray, ...]:
        """Return W e of a block, and V s if messages are odd."""
        w, u, _ = self.arrays
        torch.mm(self.e[first : first + count], self.weight, out=self.w[:count])
        if self.s is None:
            return (w,)
        torch.mm(self.s[first : first + count], self.even_weight, out=self.u[:count])
        return w, u

    def activate(self, first: int, count: int, products: tuple[np.ndarray, ...]) -> Tensor:
        """Return x of a block."""
        kernel = _activate if self.s is None else _activate_odd
        kernel(*self.rows, *products, self.slope, self.source, self.target, first, count, self.arrays[-1])
        return self.x[:count]


def _forward(
    layer: _Layer, out: tuple[Tensor, Tensor] | None, is_joint: bool, overwrites: bool
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    at_target, at_source = torch.zeros_like(layer.a), None if is_joint else torch.zeros_like(layer.b)
    sums = [(at_target if s is None else s).numpy() for s in (at_target, at_source)]
    ends = layer.source, layer.target
    if out is None:
        for block in blocks(len(layer.e)):
            layer.activate(*block, layer.multiply(*block))
            _sum(layer.arrays[-1], *ends, *block, *sums)
        return at_target, at_source, None
    new = layer.e if overwrites else torch.empty_like(layer.e)
    old, written, weight, bias = layer.e.numpy(), None if overwrites else new.numpy(), out[0].t().contiguous(), out[1].numpy()
    for block in blocks(len(layer.e)):
        x = layer.activate(*block, layer.multiply(*block))
        torch.mm(x, weight, out=layer.w[: len(x)])
        _update(layer.arrays[0], bias, old, *ends, *block, written, *sums)
    return at_target, at_source, new


def _plain(
    a: Tensor, b: Tensor, e: Tensor, s: Tensor | None, weight: Tensor, even_weight: Tensor, slope: Tensor, out_weight: Tensor, out_bias: Tensor,
    edge_index: Tensor, is_joint: bool,
) -> tuple[Tensor, Tensor | None, Tensor | None]:  # fmt: skip
    j, i = edge_index
    w = functional.linear(e, weight)
    if s is None:
        x = functional.prelu(a[i] + b[j] + w, slope)
    else:
        u = functional.linear(s, even_weight)
        x = functional.prelu(a[i] + b[j] + u + w, slope) - functional.prelu(a[j] + b[i] + u - w, slope)
    m = functional.linear(x, out_weight, out_bias) if out_weight.numel() else x
    new = e + m if out_weight.numel() else None
    at_target = torch.zeros_like(a).index_add(0, i, m)
    if is_joint:
        return at_target.index_add(0, j, m, alpha=-1), None, new
    return at_target, torch.zeros_like(b).index_add(0, j, m, alpha=-1), new


class _FusedLatent(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, is_joint: bool, a: Tensor, b: Tensor, e: Tensor, s: Tensor | None, *others: Tensor) -> Any:
        weight, even_weight, slope, out_weight, out_bias, edge_index = others
        ctx.updates, ctx.is_joint = out_weight.numel() > 0, is_joint
        ctx.save_for_backward(a, b, e, s, *others)
        layer = _Layer(a, b, e, s, weight, even_weight, slope, edge_index)
        at_target, at_source, new = _forward(layer, (out_weight.detach(), out_bias.detach()) if ctx.updates else None, is_joint, False)
        return at_target, at_source, layer.e[:0] if new is None else new

    @staticmethod
    def backward(ctx: Any, grad_target: Tensor, grad_source: Tensor | None, grad_new: Tensor) -> Any:  # type: ignore[override]
        a, b, e, s, weight, even_weight, slope, out_weight, out_bias, edge_index = ctx.saved_tensors
        if torch.is_grad_enabled():
            plain = partial(_plain, edge_index=edge_index, is_joint=ctx.is_joint)
            return None, *plain_gradients(plain, ctx.saved_tensors[:-1], [grad_target, grad_source, grad_new]), None
        layer = _Layer(a, b, e, s, weight, even_weight, slope, edge_index)
        ends = layer.source, layer.target
        arriving = [(grad_target if g is None else g).contiguous().numpy() for g in (grad_target, grad_source)]
        grad_a, grad_b, grad_weight, grad_even_weight, grad_out_weight = (
            torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (a, b, weight, even_weight, out_weight)
        )
        grad_out_bias, below = out_bias.new_zeros(len(out_bias), dtype=torch.float64), a.new_zeros(a.shape[1], dtype=torch.float64)
        grad_e, grad_new = torch.empty_like(layer.e), grad_new.contiguous()
        grad_s = torch.empty_like(s, memory_format=torch.contiguous_format) if s is not None and ctx.needs_input_grad[4] else None
        sums = grad_a.numpy(), grad_b.numpy(), below.numpy()
        g, grad_m, even = torch.empty_like(layer.x), torch.empty_like(layer.x), torch.empty_like(layer.x)
        of_x, of_m, of_even, of_new, of_bias = (t.numpy() for t in (g, grad_m, even, grad_new, grad_out_bias))
        for first, count in blocks(len(layer.e)):
            block, rows = (first, count), slice(first, first + count)
            products = layer.multiply(*block)
            if ctx.updates:
                x = layer.activate(*block, products)
                _gather_message_grad(*arriving, of_new, *ends, *block, of_m, of_bias)
                grad_out_weight.addmm_(grad_m[:count].t(), x)
                torch.mm(grad_m[:count], out_weight, out=g[:count])
            else:
                _gather_grad(*arriving, *ends, *block, of_x)
            if s is None or layer.s is None:
                _backward(*layer.rows, *products, layer.slope, *ends, *block, of_x, *sums)
            else:
                _backward_odd(*layer.rows, *products, layer.slope, *ends, *block, of_x, of_even, *sums)
                grad_even_weight.addmm_(even[:count].t(), layer.s[rows])
                if grad_s is not None:
                    torch.mm(even[:count], even_weight, out=grad_s[rows])
            grad_weight.addmm_(g[:count].t(), layer.e[rows])
            if ctx.updates:
                torch.mm(g[:count], weight, out=layer.w[:count])
                torch.add(layer.w[:count], grad_new[rows], out=grad_e[rows])
            else:
                torch.mm(g[:count], weight, out=grad_e[rows])
        return (
            None,
            grad_a,
            grad_b,
            grad_e,
            grad_s,
            grad_weight,
            grad_even_weight,
            below.sum().reshape(1).to(slope),
            grad_out_weight,
            grad_out_bias.to(out_bias),
            None,
        )


def fused_latent(
    a: Float[Tensor, "target hidden"],
    b: Float[Tensor, "source hidden"],
    e: Float[Tensor, "edge state"],
    s: Float[Tensor, "edge even"] | None,
    weight: Float[Tensor, "hidden state"],
    even_weight: Float[Tensor, "hidden even"],
    slope: Float[Tensor, " 1"],
    out: tuple[Float[Tensor, "hidden hidden"], Float[Tensor, " hidden"] | None] | None,
    edge_index: Int64[Tensor, "2 edge"],
    is_joint: bool = False,
    overwrites: bool = False,
) -> tuple[Float[Tensor, "target hidden"], Float[Tensor, "source hidden"] | None, Float[Tensor, "edge state"] | None]:
    """Return T, S and e' of the module's docstring, on the CPU in single or double precision; differentiable in all arguments but ``edge_index``.

    ``edge_index`` must hold existing rows; nothing is checked.

    Args:
        a: rows of the targets.
        b: rows of the sources.
        e: latent edge states.
        s: even edge features for odd messages, None for others. Odd messages need both ends of an edge of one type, so a and b have the same rows.
        weight: W.
        even_weight: V.
        slope: p.
        out: C, and c if there is one; states then have as many channels as the messages. With None, T and S are sums of x, and there is no e'.
        edge_index: source (row 0) and target (row 1) of every edge.
        is_joint: both ends are of one type: return T + S, and None in place of S.
        overwrites: e' may reuse the memory of e if no gradient is needed.
    """
    c, bias = out if out is not None else (e.new_empty(0, 0), None)
    bias = c.new_zeros(len(c)) if bias is None else bias
    if not torch.is_grad_enabled():
        layer = _Layer(a, b, e, s, weight, even_weight, slope, edge_index)
        return _forward(layer, None if out is None else (c.detach(), bias.detach()), is_joint, overwrites)
    at_target, at_source, new = _FusedLatent.apply(is_joint, a, b, e, s, weight, even_weight, slope, c, bias, edge_index)  # type: ignore[no-untyped-call]
    return at_target, at_source, new if out is not None else None
