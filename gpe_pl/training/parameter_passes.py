"""Passes over all parameters of a model in one call: norm and scaling of gradients, Adam, and moving averages (on a CPU).

PyTorch's functions for lists of tensors spend microseconds on each tensor. A model of this package has a hundred or more small ones, for which that is longer
than the arithmetic takes. The kernels here read the addresses of all tensors. They work on contiguous tensors of one precision, single or double. PyTorch does
not notice what kernels write, so the functions that change tensors increase PyTorch's version counters of these tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import torch
from numba import carray, njit
from torch import Tensor
from torch.autograd.graph import increment_version

from gpe_pl.nn.fused import FASTMATH
from gpe_pl.nn.pointers import pointer


def are_covered(*lists: Sequence[Tensor]) -> bool:
    """Tell whether the kernels can process these lists of tensors."""
    kinds = {(t.dtype, t.device.type, t.is_contiguous()) for tensors in lists for t in tensors}
    return len(kinds) <= 1 and kinds <= {(torch.float32, "cpu", True), (torch.float64, "cpu", True)}


def norm(tensors: Sequence[Tensor]) -> float:
    """Return the norm of all values of all tensors, summed in double precision."""
    return float(np.sqrt(_square(*_places(tensors), _like(tensors))))


def scale(tensors: Sequence[Tensor], factor: float) -> None:
    """Multiply all tensors by a factor, in place."""
    _scale(*_places(tensors), _like(tensors), factor)


def pull(tensors: Sequence[Tensor], towards: Sequence[Tensor], weight: float) -> None:
    """Move tensors towards others of the same shapes, in place: x ← x + weight (y − x)."""
    _pull(*_places(tensors), _addresses(towards), _like(tensors), weight)
    _mark_as_changed(tensors)


def adam(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    steps: Sequence[Tensor],
    learning_rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Apply a step of Adam to all parameters, in place.

    Args:
        parameters: parameters θ.
        gradients: their gradients g.
        means: moving averages of g.
        squares: moving averages of g².
        steps: number of steps of each parameter, in single precision; it is raised by one.
        learning_rate, betas, eps: as in ``torch.optim.Adam``.
    """
    lists = (_addresses(values) for values in (gradients, means, squares, steps))
    _adam(*_places(parameters), *lists, _like(parameters), learning_rate, *betas, eps)
    _mark_as_changed(parameters)


def _mark_as_changed(tensors: Sequence[Tensor]) -> None:
    for tensor in tensors:
        increment_version(tensor)


def _addresses(tensors: Sequence[Tensor]) -> np.ndarray:
    return np.array([t.data_ptr() for t in tensors], np.int64)


def _places(tensors: Sequence[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([t.numel() for t in tensors], np.int64), _addresses(tensors)


def _like(tensors: Sequence[Tensor]) -> np.ndarray:
    """Return an empty array of the precision of the tensors, from which the kernels take their type."""
    return np.empty(0, np.float64 if tensors and tensors[0].dtype == torch.float64 else np.float32)


@njit(cache=True, error_model="numpy", fastmath=FASTMATH | {"reassoc"})
@no_type_check
def _square(sizes, addresses, like):
    total = 0.0
    for k in range(len(sizes)):
        x, part = carray(pointer(addresses[k]), sizes[k], like.dtype), 0.0
        for c in range(sizes[k]):
            part += np.float64(x[c]) * np.float64(x[c])
        total += part
    return total


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _scale(sizes, addresses, like, factor):
    factor = like.dtype.type(factor)
    for k in range(len(sizes)):
        x = carray(pointer(addresses[k]), sizes[k], like.dtype)
        for c in range(sizes[k]):
            x[c] *= factor


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _pull(sizes, addresses, others, like, weight):
    weight = like.dtype.type(weight)
    for k in range(len(sizes)):
        x = carray(pointer(addresses[k]), sizes[k], like.dtype)
        y = carray(pointer(others[k]), sizes[k], like.dtype)
        for c in range(sizes[k]):
            x[c] += weight * (y[c] - x[c])


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
@no_type_check
def _adam(sizes, addresses, gradients, means, squares, steps, like, learning_rate, beta, beta_square, eps):
    number = like.dtype.type
    keep, keep_square = number(beta), number(beta_square)
    add, add_square, small = number(1 - beta), number(1 - beta_square), number(eps)
    for k in range(len(sizes)):
        step = carray(pointer(steps[k]), 1, np.float32)
        step[0] += 1
        rate = number(learning_rate / (1 - beta ** step[0]))
        root = number(1 / np.sqrt(1 - beta_square ** step[0]))
        x = carray(pointer(addresses[k]), sizes[k], like.dtype)
        g = carray(pointer(gradients[k]), sizes[k], like.dtype)
        m = carray(pointer(means[k]), sizes[k], like.dtype)
        v = carray(pointer(squares[k]), sizes[k], like.dtype)
        for c in range(sizes[k]):
            m[c] = keep * m[c] + add * g[c]
            v[c] = keep_square * v[c] + add_square * g[c] * g[c]
            x[c] -= rate * m[c] / (np.sqrt(v[c]) * root + small)
