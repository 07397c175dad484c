"""Messages and the new latent state of all edges, a block of edges at a time (on a CPU).

With rows a of the targets, b of the sources, latent states e and even features s of the edges, for an edge k from j to i::

    z_k = a_i + b_j + W e_k + V s_k,   z'_k = a_j + b_i − W e_k + V s_k
    x_k = φ(z_k)   or, for odd messages,   x_k = φ(z_k) − φ(z'_k),   φ(z) = max(z, 0) + p min(z, 0)
    m_k = C x_k + c,   T_i = Σ_k m_k over edges into i,   S_j = −Σ_k m_k over edges out of j,   e'_k = e_k + m_k

A block stays in the cache between its two matrix products, where plain PyTorch reads and writes every edge in memory about ten times. The backward pass
computes the activations again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import njit
from torch import Tensor

BLOCK = 512
"""Edges at a time: at 128 channels in single precision an array of a block takes 256 KiB, and a handful of them fit a core's second-level cache."""
FASTMATH = {"contract", "nsz", "arcp"}


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate(a, b, w, slope, source, target, first, x):
    for k in range(len(w)):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            z = a[i, c] + b[j, c] + w[k, c]
            x[k, c] = z if z > 0 else slope * z


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate_odd(a, b, w, u, slope, source, target, first, x):
    for k in range(len(w)):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            y = a[i, c] + b[j, c] + u[k, c] + w[k, c]
            z = a[j, c] + b[i, c] + u[k, c] - w[k, c]
            x[k, c] = (y if y > 0 else slope * y) - (z if z > 0 else slope * z)


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _update(m, bias, e, source, target, first, at_target, at_source):
    """Adds m + bias to the states e of a block, and to the sums at its ends."""
    for k in range(len(m)):
        i, j = target[first + k], source[first + k]
        for c in range(m.shape[1]):
            message = m[k, c] + bias[c]
            e[k, c] += message
            at_target[i, c] += message
            at_source[j, c] -= message


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _sum(x, source, target, first, at_target, at_source):
    for k in range(len(x)):
        i, j = target[first + k], source[first + k]
        for c in range(x.shape[1]):
            at_target[i, c] += x[k, c]
            at_source[j, c] -= x[k, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _gather_grad(grad_target, grad_source, source, target, first, g):
    for k in range(len(g)):
        i, j = target[first + k], source[first + k]
        for c in range(g.shape[1]):
            g[k, c] = grad_target[i, c] - grad_source[j, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _gather_message_grad(grad_target, grad_source, grad_new, source, target, first, g, total):
    """Gradients of the messages, which also reach the new states, and their sum in ``total``."""
    for k in range(len(g)):
        i, j = target[first + k], source[first + k]
        for c in range(g.shape[1]):
            y = grad_target[i, c] - grad_source[j, c] + grad_new[k, c]
            g[k, c] = y
            total[c] += y


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward(a, b, w, slope, source, target, first, g, grad_a, grad_b, below):
    """Turns g, the gradient of x, into that of z."""
    for k in range(len(w)):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            z = a[i, c] + b[j, c] + w[k, c]
            negative = z <= 0
            below[c] += g[k, c] * z if negative else 0
            y = slope * g[k, c] if negative else g[k, c]
            g[k, c] = y
            grad_a[i, c] += y
            grad_b[j, c] += y


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward_odd(a, b, w, u, slope, source, target, first, g, even, grad_a, grad_b, below):
    """Turns g, the gradient of x, into that of W e; ``even`` becomes that of V s."""
    for k in range(len(w)):
        i, j = target[first + k], source[first + k]
        for c in range(w.shape[1]):
            y = a[i, c] + b[j, c] + u[k, c] + w[k, c]
            z = a[j, c] + b[i, c] + u[k, c] - w[k, c]
            p = slope * g[k, c] if y <= 0 else g[k, c]
            q = slope * g[k, c] if z <= 0 else g[k, c]
            below[c] += g[k, c] * ((y if y <= 0 else 0) - (z if z <= 0 else 0))
            g[k, c] = p + q
            even[k, c] = p - q
            grad_a[i, c] += p
            grad_b[j, c] += p
            grad_a[j, c] -= q
            grad_b[i, c] -= q


@dataclass(frozen=True)
class _Layer:
    """What all blocks of a layer share: rows a and b, edges, and the first linear map."""

    a: Tensor
    b: Tensor
    e: Tensor
    s: Tensor | None
    weight: Tensor
    even_weight: Tensor
    slope: Tensor
    edge_index: Tensor

    def blocks(self) -> Iterator[_Block]:
        """Edges ``BLOCK`` at a time, their W e and V s multiplied."""
        source, target = self.edge_index.contiguous().numpy()
        weight, even_weight = self.weight.t(), self.even_weight.t()
        w, u, x = self.e.new_empty(3, BLOCK, self.weight.shape[0])
        rows = [None] * -(-len(self.e) // BLOCK) if self.s is None else self.s.split(BLOCK)
        for number, (e, s) in enumerate(zip(self.e.split(BLOCK), rows, strict=False)):  # of no edges, ``split`` makes one part
            n = len(e)
            if n < BLOCK:
                w, u, x = w[:n], u[:n], x[:n]
            torch.mm(e, weight, out=w)
            if s is not None:
                torch.mm(s, even_weight, out=u)
            yield _Block(e, s, (source, target, number * BLOCK), w, u, x)

    def activate(self, block: _Block) -> None:
        """Fills ``block.x``."""
        a, b, w, p, x = self.a.numpy(), self.b.numpy(), block.w.numpy(), self.slope.numpy()[0], block.x.numpy()
        if self.s is None:
            _activate(a, b, w, p, *block.ends, x)
        else:
            _activate_odd(a, b, w, block.u.numpy(), p, *block.ends, x)


@dataclass(frozen=True)
class _Block:
    """Some edges: their rows of e and s, their ends and the number of the first, W e, V s, and room for as many rows."""

    e: Tensor
    s: Tensor | None
    ends: tuple[np.ndarray, np.ndarray, int]
    w: Tensor
    u: Tensor
    x: Tensor


def _forward(layer: _Layer, out: tuple[Tensor, Tensor] | None, overwrites: bool) -> tuple[Tensor, Tensor, Tensor | None]:
    at_target, at_source = torch.zeros_like(layer.a), torch.zeros_like(layer.b)
    new = None if out is None else layer.e if overwrites else torch.empty_like(layer.e)
    states = iter(() if new is None else new.split(BLOCK))
    for block in layer.blocks():
        layer.activate(block)
        sums = at_target.numpy(), at_source.numpy()
        if out is None:
            _sum(block.x.numpy(), *block.ends, *sums)
            continue
        weight, bias = out
        state = next(states)
        if not overwrites:
            state.copy_(block.e)
        m = torch.mm(block.x, weight.t(), out=block.w)
        _update(m.numpy(), bias.numpy(), state.numpy(), *block.ends, *sums)
    return at_target, at_source, new


class _FusedLatent(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, e: Tensor, s: Tensor | None, *others: Tensor) -> Any:
        weight, even_weight, slope, out_weight, out_bias, edge_index = others
        ctx.is_odd, ctx.updates = s is not None, out_weight.numel() > 0
        ctx.save_for_backward(a, b, e, s, *others)
        layer = _layer(a, b, e, s, weight, even_weight, slope, edge_index)
        at_target, at_source, new = _forward(layer, (out_weight.detach(), out_bias.detach()) if ctx.updates else None, False)
        return at_target, at_source, layer.e[:0] if new is None else new

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_target: Tensor, grad_source: Tensor, grad_new: Tensor) -> Any:  # type: ignore[override]
        a, b, e, s, weight, even_weight, slope, out_weight, out_bias, edge_index = ctx.saved_tensors
        layer = _layer(a, b, e, s, weight, even_weight, slope, edge_index)
        arriving = grad_target.contiguous().numpy(), grad_source.contiguous().numpy()
        p = slope.numpy()[0]
        grad_a, grad_b, grad_weight, grad_even_weight, grad_out_weight, grad_out_bias = (
            torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (a, b, weight, even_weight, out_weight, out_bias)
        )
        grad_e = torch.empty_like(layer.e)
        grad_s = torch.empty_like(layer.s) if layer.s is not None and ctx.needs_input_grad[3] else None
        below = e.new_zeros(a.shape[1])
        sums = grad_a.numpy(), grad_b.numpy(), below.numpy()
        g, grad_m, even = e.new_empty(3, BLOCK, a.shape[1])
        blocks, of_e = layer.blocks(), grad_e.split(BLOCK)
        of_new = grad_new.contiguous().split(BLOCK) if ctx.updates else [None] * len(of_e)
        of_s = [None] * len(of_e) if grad_s is None else grad_s.split(BLOCK)
        for block, grad_e_rows, grad_new_rows, grad_s_rows in zip(blocks, of_e, of_new, of_s, strict=False):
            n = len(block.e)
            if n < BLOCK:
                g, grad_m, even = g[:n], grad_m[:n], even[:n]
            if grad_new_rows is None:
                _gather_grad(*arriving, *block.ends, g.numpy())
            else:
                layer.activate(block)
                _gather_message_grad(*arriving, grad_new_rows.numpy(), *block.ends, grad_m.numpy(), grad_out_bias.numpy())
                grad_out_weight.addmm_(grad_m.t(), block.x)
                torch.mm(grad_m, out_weight, out=g)
            values = layer.a.numpy(), layer.b.numpy(), block.w.numpy()
            if block.s is None:
                _backward(*values, p, *block.ends, g.numpy(), *sums)
            else:
                _backward_odd(*values, block.u.numpy(), p, *block.ends, g.numpy(), even.numpy(), *sums)
                grad_even_weight.addmm_(even.t(), block.s)
                if grad_s_rows is not None:
                    torch.mm(even, even_weight, out=grad_s_rows)
            grad_weight.addmm_(g.t(), block.e)
            torch.mm(g, weight, out=grad_e_rows)
            if grad_new_rows is not None:
                grad_e_rows += grad_new_rows
        grads = grad_weight, grad_even_weight, below.sum().reshape(1), grad_out_weight, grad_out_bias
        return grad_a, grad_b, grad_e, grad_s, *grads, None


def _layer(
    a: Tensor, b: Tensor, e: Tensor, s: Tensor | None, weight: Tensor, even_weight: Tensor, slope: Tensor, edge_index: Tensor
) -> _Layer:
    s = None if s is None else s.detach().contiguous()
    a, b, e = (t.detach().contiguous() for t in (a, b, e))
    return _Layer(a, b, e, s, weight.detach(), even_weight.detach(), slope.detach(), edge_index)


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
    overwrites: bool = False,
) -> tuple[Float[Tensor, "target hidden"], Float[Tensor, "source hidden"], Float[Tensor, "edge state"] | None]:
    """T, S and e' of the module's text, on the CPU in single or double precision; differentiable once in all but ``edge_index``.

    ``edge_index`` must hold rows that exist: nothing is checked.

    Args:
        s: for odd messages, which need both ends of an edge to be of one type: a and b then have the same rows; None for the others.
        out: C, and c if there is one; states then have as many channels as the messages. None: T and S are sums of x, and there is no e'.
        overwrites: e' may take the place of e in memory, where no gradient is asked for.
    """
    c, bias = out if out is not None else (e.new_empty(0, 0), None)
    bias = c.new_zeros(len(c)) if bias is None else bias
    if not torch.is_grad_enabled():
        layer = _layer(a, b, e, s, weight, even_weight, slope, edge_index)
        return _forward(layer, None if out is None else (c.detach(), bias.detach()), overwrites)
    at_target, at_source, new = _FusedLatent.apply(a, b, e, s, weight, even_weight, slope, c, bias, edge_index)  # type: ignore[no-untyped-call]
    return at_target, at_source, new if out is not None else None
