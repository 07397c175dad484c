"""Two linear maps with an activation between them, a block of rows at a time (on a CPU).

For a row x and an optional residual row r::

    z = A x + b,   y = C φ(z) + c + r,   φ(z) = max(z, 0) + p min(z, 0)

A block stays in the cache between its two products, whereas plain PyTorch copies biases and writes and reads all rows in memory five times.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn.fused import FASTMATH, block_size, blocks, plain_gradients


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate(z, bias, slope, first, count, h):
    """Add the bias to rows of z, in place, and write their activations to h."""
    for k in range(count):
        for c in range(z.shape[1]):
            y = z[first + k, c] + bias[c]
            z[first + k, c] = y
            h[k, c] = y if y > 0 else slope * y


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _activate_again(z, slope, first, count, h):
    for k in range(count):
        for c in range(z.shape[1]):
            y = z[first + k, c]
            h[k, c] = y if y > 0 else slope * y


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _finish(y, bias, residual, first, count):
    for k in range(first, first + count):
        for c in range(y.shape[1]):
            if residual is None:
                y[k, c] += bias[c]
            else:
                y[k, c] += bias[c] + residual[k, c]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _backward(z, slope, first, count, g, grad_bias, below):
    """Turn g, the gradient of φ(z), into that of z; sums run within blocks, then over blocks, which is at least as accurate as PyTorch."""
    bias_sum, below_sum = np.zeros_like(z[0]), np.zeros_like(z[0])
    for k in range(count):
        for c in range(z.shape[1]):
            negative = z[first + k, c] <= 0
            below_sum[c] += g[k, c] * z[first + k, c] if negative else 0
            y = slope * g[k, c] if negative else g[k, c]
            g[k, c] = y
            bias_sum[c] += y
    grad_bias += bias_sum
    below += below_sum


def _forward(x: Tensor, weights: tuple[Tensor, ...], residual: Tensor | None, keeps: bool) -> tuple[Tensor, Tensor]:
    """Return y, and with ``keeps`` also z of all rows."""
    weight, bias, slope, out_weight, out_bias = (w.detach() for w in weights)
    weight, out_weight = weight.t().contiguous(), out_weight.t().contiguous()
    num_rows, hidden = len(x), weight.shape[1]
    room = block_size(num_rows)
    y, z, h = x.new_empty(num_rows, out_weight.shape[1]), x.new_empty(num_rows if keeps else room, hidden), x.new_empty(room, hidden)
    of_z, of_h, of_y, b, c, p = z.numpy(), h.numpy(), y.numpy(), bias.numpy(), out_bias.numpy(), slope.numpy()[0]
    r = None if residual is None else residual.detach().contiguous().numpy()
    for first, count in blocks(num_rows):
        at = first if keeps else 0
        torch.mm(x[first : first + count], weight, out=z[at : at + count])
        _activate(of_z, b, p, at, count, of_h)
        torch.mm(h[:count], out_weight, out=y[first : first + count])
        _finish(of_y, c, r, first, count)
    return y, z


def _plain(x: Tensor, weight: Tensor, bias: Tensor, slope: Tensor, out_weight: Tensor, out_bias: Tensor) -> tuple[Tensor]:
    return (functional.linear(functional.prelu(functional.linear(x, weight, bias), slope), out_weight, out_bias),)


class _FusedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, residual: Tensor | None, *weights: Tensor) -> Tensor:
        rows = x.detach().contiguous()
        y, z = _forward(rows, weights, residual, keeps=True)
        ctx.save_for_backward(x, rows, z, *weights)
        return y

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        own, x, z, *weights = ctx.saved_tensors
        if torch.is_grad_enabled():
            grad_own, *others = plain_gradients(_plain, [own, *weights], [grad])
            return grad_own, grad if ctx.needs_input_grad[1] else None, *others
        weight, bias, slope, out_weight, _ = weights
        grad = grad.contiguous()
        grad_weight, grad_out_weight = (torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (weight, out_weight))
        grad_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        grad_bias, below = torch.zeros(2, len(bias), dtype=torch.float64)
        h, g = x.new_empty(2, block_size(len(x)), z.shape[1])
        of_z, of_h, of_g, p = z.numpy(), h.numpy(), g.numpy(), slope.detach().numpy()[0]
        for first, count in blocks(len(x)):
            rows = slice(first, first + count)
            _activate_again(of_z, p, first, count, of_h)
            grad_out_weight.addmm_(grad[rows].t(), h[:count])
            torch.mm(grad[rows], out_weight.detach(), out=g[:count])
            _backward(of_z, p, first, count, of_g, grad_bias.numpy(), below.numpy())
            grad_weight.addmm_(g[:count].t(), x[rows])
            if grad_x is not None:
                torch.mm(g[:count], weight.detach(), out=grad_x[rows])
        grad_residual = grad if ctx.needs_input_grad[1] else None
        grad_slope = below.sum().reshape(1)
        return grad_x, grad_residual, grad_weight, grad_bias.to(bias), grad_slope.to(slope), grad_out_weight, grad.sum(dim=0)


def fused_mlp(
    x: Float[Tensor, "row in"],
    weight: Float[Tensor, "hidden in"],
    bias: Float[Tensor, " hidden"],
    slope: Float[Tensor, " 1"],
    out_weight: Float[Tensor, "out hidden"],
    out_bias: Float[Tensor, " out"],
    residual: Float[Tensor, "row out"] | None = None,
) -> Float[Tensor, "row out"]:
    """Return y of the module's docstring, on the CPU in single or double precision; differentiable.

    The arguments are x, A, b, p, C, c and r, in this order.
    """
    weights = weight, bias, slope, out_weight, out_bias
    if not torch.is_grad_enabled():
        return _forward(x.detach().contiguous(), weights, residual, keeps=False)[0]
    return _FusedMLP.apply(x, residual, *weights)  # type: ignore[no-untyped-call,no-any-return]
