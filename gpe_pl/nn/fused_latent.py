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
def _activate(a, b, w, slope, source, target, x):
    for k in range(len(w)):
        i, j = target[k], source[k]
        for c in range(w.shape[1]):
            z = a[i, c] + b[j, c] + w[k, c]
            x[k, c] = z if z > 0 else slope * z


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate_odd(a, b, w, u, slope, source, target, x):
    for k in range(len(w)):
        i, j = target[k], source[k]
        for c in range(w.shape[1]):
            y = a[i, c] + b[j, c] + u[k, c] + w[k, c]
            z = a[j, c] + b[i, c] + u[k, c] - w[k, c]
            x[k, c] = (y if y > 0 else slope * y) - (z if z > 0 else slope * z)


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _update(m, e, source, target, new, at_target, at_source):
    for k in range(len(m)):
        i, j = target[k], source[k]
        for c in range(m.shape[1]):
            new[k, c] = e[k, c] + m[k, c]
            at_target[i, c] += m[k, c]
            at_source[j, c] -= m[k, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _sum(x, source, target, at_target, at_source):
    for k in range(len(x)):
        i, j = target[k], source[k]
        for c in range(x.shape[1]):
            at_target[i, c] += x[k, c]
            at_source[j, c] -= x[k, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _gather_grad(grad_target, grad_source, source, target, g):
    for k in range(len(g)):
        i, j = target[k], source[k]
        for c in range(g.shape[1]):
            g[k, c] = grad_target[i, c] - grad_source[j, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward(a, b, w, slope, source, target, g, grad_a, grad_b, below):
    """Turns g, the gradient of x, into that of z."""
    for k in range(len(w)):
        i, j = target[k], source[k]
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
def _backward_odd(a, b, w, u, slope, source, target, g, even, grad_a, grad_b, below):
    """Turns g, the gradient of x, into that of W e; ``even`` becomes that of V s."""
    for k in range(len(w)):
        i, j = target[k], source[k]
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
class _Block:
    """Some edges: their rows of e and s, their ends, and W e and V s."""

    e: Tensor
    s: Tensor
    source: np.ndarray
    target: np.ndarray
    w: Tensor
    u: Tensor


def _blocks(e: Tensor, s: Tensor, weight: Tensor, even_weight: Tensor, edge_index: Tensor) -> Iterator[_Block]:
    source, target = edge_index.contiguous().numpy()
    buffers = e.new_empty(2, BLOCK, weight.shape[0])
    for first in range(0, len(e), BLOCK):
        last = min(first + BLOCK, len(e))
        w, u = buffers[:, : last - first]
        torch.mm(e[first:last], weight.t(), out=w)
        if s.shape[1]:
            torch.mm(s[first:last], even_weight.t(), out=u)
        else:
            u.zero_()
        yield _Block(e[first:last], s[first:last], source[first:last], target[first:last], w, u)


def _activations(block: _Block, a: Tensor, b: Tensor, slope: Any, is_odd: bool, x: Tensor) -> None:
    ends = block.source, block.target
    if is_odd:
        _activate_odd(a.numpy(), b.numpy(), block.w.numpy(), block.u.numpy(), slope, *ends, x.numpy())
    else:
        _activate(a.numpy(), b.numpy(), block.w.numpy(), slope, *ends, x.numpy())


class _FusedLatent(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, is_odd: bool, a: Tensor, b: Tensor, e: Tensor, s: Tensor, *weights: Tensor) -> Any:
        weight, even_weight, slope, out_weight, out_bias, edge_index = weights
        ctx.is_odd = is_odd
        ctx.save_for_backward(a, b, e, s, *weights)
        a, b, e, s = (t.detach().contiguous() for t in (a, b, e, s))
        weight, even_weight, out_weight, out_bias = (t.detach() for t in (weight, even_weight, out_weight, out_bias))
        p = slope.detach().numpy()[0]
        updates = out_weight.numel() > 0
        at_target, at_source = torch.zeros_like(a), torch.zeros_like(b)
        new = torch.empty_like(e) if updates else e[:0]
        x, m = e.new_empty(2, BLOCK, a.shape[1])
        first = 0
        for block in _blocks(e, s, weight, even_weight, edge_index):
            n = len(block.e)
            _activations(block, a, b, p, is_odd, x[:n])
            ends = block.source, block.target
            if updates:
                torch.mm(x[:n], out_weight.t(), out=m[:n])
                m[:n] += out_bias
                rows = new[first : first + n]
                _update(m[:n].numpy(), block.e.numpy(), *ends, rows.numpy(), at_target.numpy(), at_source.numpy())
            else:
                _sum(x[:n].numpy(), *ends, at_target.numpy(), at_source.numpy())
            first += n
        return at_target, at_source, new

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_target: Tensor, grad_source: Tensor, grad_new: Tensor) -> Any:  # type: ignore[override]
        a, b, e, s, weight, even_weight, slope, out_weight, out_bias, edge_index = ctx.saved_tensors
        a, b, e, s, grad_target, grad_source, grad_new = (t.contiguous() for t in (a, b, e, s, grad_target, grad_source, grad_new))
        p, updates = slope.numpy()[0], out_weight.numel() > 0
        grads = [torch.zeros_like(t) for t in (a, b, s, weight, even_weight, out_weight, out_bias)]
        grad_a, grad_b, grad_s, grad_weight, grad_even_weight, grad_out_weight, grad_out_bias = grads
        grad_e = torch.empty_like(e)
        below = a.new_zeros(a.shape[1])
        x, g, even, grad_m = e.new_empty(4, BLOCK, a.shape[1])
        first = 0
        for block in _blocks(e, s, weight, even_weight, edge_index):
            n = len(block.e)
            rows, ends = slice(first, first + n), (block.source, block.target)
            first += n
            _gather_grad(grad_target.numpy(), grad_source.numpy(), *ends, g[:n].numpy())
            if updates:
                _activations(block, a, b, p, ctx.is_odd, x[:n])
                torch.add(g[:n], grad_new[rows], out=grad_m[:n])
                grad_out_weight.addmm_(grad_m[:n].t(), x[:n])
                grad_out_bias += grad_m[:n].sum(dim=0)
                torch.mm(grad_m[:n], out_weight, out=g[:n])
            values = a.numpy(), b.numpy(), block.w.numpy()
            sums = grad_a.numpy(), grad_b.numpy(), below.numpy()
            if ctx.is_odd:
                _backward_odd(*values, block.u.numpy(), p, *ends, g[:n].numpy(), even[:n].numpy(), *sums)
                grad_even_weight.addmm_(even[:n].t(), block.s)
                if ctx.needs_input_grad[4]:
                    torch.mm(even[:n], even_weight, out=grad_s[rows])
            else:
                _backward(*values, p, *ends, g[:n].numpy(), *sums)
            grad_weight.addmm_(g[:n].t(), block.e)
            if updates:
                torch.addmm(grad_new[rows], g[:n], weight, out=grad_e[rows])
            else:
                torch.mm(g[:n], weight, out=grad_e[rows])
        grad_slope = below.sum().reshape(1)
        return None, grad_a, grad_b, grad_e, grad_s, grad_weight, grad_even_weight, grad_slope, grad_out_weight, grad_out_bias, None


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
) -> tuple[Float[Tensor, "target hidden"], Float[Tensor, "source hidden"], Float[Tensor, "edge state"] | None]:
    """T, S and e' of the module's text, on the CPU in single or double precision; differentiable once in all but ``edge_index``.

    ``edge_index`` must hold rows that exist: nothing is checked.

    Args:
        s: for odd messages, which need both ends of an edge to be of one type: a and b then have the same rows; None for the others.
        out: C, and c if there is one; states then have as many channels as the messages. None: T and S are sums of x, and there is no e'.
    """
    is_odd = s is not None
    even = e.new_empty(len(e), 0) if s is None else s
    c, bias = out if out is not None else (e.new_empty(0, 0), None)
    bias = c.new_zeros(len(c)) if bias is None else bias
    at_target, at_source, new = _FusedLatent.apply(is_odd, a, b, e, even, weight, even_weight, slope, c, bias, edge_index)  # type: ignore[no-untyped-call]
    return at_target, at_source, new if out is not None else None
