"""Activations of all edges, and their sums at both ends, in one pass over the edges (on a CPU).

With rows a of the targets, b of the sources and features e of the edges::

    x_k = φ(a_i + b_j + W e_k),  φ(z) = max(z, 0) + p min(z, 0)          edge k from j to i
    T_i = Σ_k x_k over edges into i,   S_j = −Σ_k x_k over edges out of j

No array over all edges is made: values that plain PyTorch writes and reads about ten times per layer stay in the cache. The backward pass recomputes the
activations, which costs less than storing them.
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

from gpe_pl.nn.fused import BLOCK, FASTMATH, plain_gradients


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _add_up(z, a, b, e, w, i, j, k):
    """Return z of edge k, from j to i."""
    for c in range(len(z)):
        z[c] = a[i, c] + b[j, c]
    for q in range(e.shape[1]):
        feature = e[k, q]
        for c in range(len(z)):
            z[c] += feature * w[q, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _forward(a, b, e, w, slope, source, target, at_target, at_source):
    width = a.shape[1]
    z = np.empty(width, a.dtype)
    for k in range(len(source)):
        i, j = target[k], source[k]
        _add_up(z, a, b, e, w, i, j, k)
        for c in range(width):
            x = z[c] if z[c] > 0 else slope * z[c]
            at_target[i, c] += x
            at_source[j, c] -= x


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward(a, b, e, w, slope, source, target, grad_target, grad_source, grad_a, grad_b, grad_e, grad_w, grad_slope):
    width, channels = a.shape[1], e.shape[1]
    z, g, below, total_w = np.empty(width, a.dtype), np.empty(width, a.dtype), np.zeros(width), np.zeros((channels, width))
    block_below, block_w = np.zeros(width, a.dtype), np.zeros((channels, width), a.dtype)
    for k in range(len(source)):
        i, j = target[k], source[k]
        _add_up(z, a, b, e, w, i, j, k)
        for c in range(width):
            x = grad_target[i, c] - grad_source[j, c]
            negative = z[c] <= 0
            block_below[c] += x * z[c] if negative else 0
            g[c] = slope * x if negative else x
            grad_a[i, c] += g[c]
            grad_b[j, c] += g[c]
        for q in range(channels):
            feature = e[k, q]
            for c in range(width):
                block_w[q, c] += feature * g[c]
        if len(grad_e):
            for q in range(channels):
                total = 0.0
                for c in range(width):
                    total += w[q, c] * g[c]
                grad_e[k, q] = total
        if k % BLOCK == BLOCK - 1 or k == len(source) - 1:  # summing within blocks, then over blocks, is at least as accurate as PyTorch
            below += block_below
            total_w += block_w
            block_below[:] = 0
            block_w[:] = 0
    for q in range(channels):
        for c in range(width):
            grad_w[q, c] = total_w[q, c]
    grad_slope[0] = below.sum()


def _plain(
    a: Tensor, b: Tensor, e: Tensor, weight: Tensor, slope: Tensor, edge_index: Tensor, is_joint: bool
) -> tuple[Tensor, Tensor | None]:
    j, i = edge_index
    x = functional.prelu(a[i] + b[j] + functional.linear(e, weight), slope)
    at_target = torch.zeros_like(a).index_add(0, i, x)
    if is_joint:
        return at_target.index_add(0, j, x, alpha=-1), None
    return at_target, torch.zeros_like(b).index_add(0, j, x, alpha=-1)


class _FusedMessages(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, e: Tensor, weight: Tensor, slope: Tensor, edge_index: Tensor, is_joint: bool) -> Any:
        ctx.save_for_backward(a, b, e, weight, slope, edge_index)
        ctx.is_joint = is_joint
        at_target, at_source = torch.zeros_like(a), None if is_joint else torch.zeros_like(b)
        sums = [(at_target if s is None else s).numpy() for s in (at_target, at_source)]
        _forward(*_arrays(a, b, e, weight, slope, edge_index), *sums)
        return at_target, at_source

    @staticmethod
    def backward(ctx: Any, grad_target: Tensor, grad_source: Tensor | None) -> Any:  # type: ignore[override]
        a, b, e, weight, slope, edge_index = ctx.saved_tensors
        if torch.is_grad_enabled():
            plain = partial(_plain, edge_index=edge_index, is_joint=ctx.is_joint)
            return *plain_gradients(plain, [a, b, e, weight, slope], [grad_target, grad_source]), None, None
        grad_a, grad_b, grad_slope = torch.zeros_like(a), torch.zeros_like(b), torch.zeros_like(slope)
        grad_e = torch.zeros_like(e) if ctx.needs_input_grad[2] else e[:0].detach().clone()
        grad_w = e.new_zeros(e.shape[1], a.shape[1])
        grads = [(grad_target if g is None else g).contiguous().numpy() for g in (grad_target, grad_source)]
        out = [g.numpy() for g in (grad_a, grad_b, grad_e, grad_w, grad_slope)]
        _backward(*_arrays(a, b, e, weight, slope, edge_index), *grads, *out)
        return grad_a, grad_b, grad_e if ctx.needs_input_grad[2] else None, grad_w.t(), grad_slope, None, None


def _arrays(a: Tensor, b: Tensor, e: Tensor, weight: Tensor, slope: Tensor, edge_index: Tensor) -> tuple[Any, ...]:
    rows = [t.detach().contiguous().numpy() for t in (a, b, e, weight.t())]
    source, target = edge_index.contiguous().numpy()
    return *rows, slope.detach().numpy()[0], source, target


def fused_messages(
    a: Float[Tensor, "target hidden"],
    b: Float[Tensor, "source hidden"],
    e: Float[Tensor, "edge feature"],
    weight: Float[Tensor, "hidden feature"],
    slope: Float[Tensor, " 1"],
    edge_index: Int64[Tensor, "2 edge"],
    is_joint: bool = False,
) -> tuple[Float[Tensor, "target hidden"], Float[Tensor, "source hidden"] | None]:
    """Return T and S of the module's docstring, on the CPU in single or double precision; differentiable in all arguments but ``edge_index``.

    ``edge_index`` must hold existing rows; nothing is checked.

    Args:
        a: rows of the targets.
        b: rows of the sources.
        e: edge features.
        weight: W.
        slope: p.
        edge_index: source (row 0) and target (row 1) of every edge.
        is_joint: both ends are of one type: return T + S, and None.
    """
    return _FusedMessages.apply(a, b, e, weight, slope, edge_index, is_joint)  # type: ignore[no-untyped-call,return-value]
