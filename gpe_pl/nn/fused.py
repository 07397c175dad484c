"""Shared parts of the fused passes for CPUs: when they work, whether they are enabled, and the number of rows in a block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from gpe_pl.system.compiled import is_wanted
from gpe_pl.system.compiled import unfused as unfused

BLOCK = 512
"""Number of rows in a block. At 128 channels in single precision an array takes 256 KiB, and a few of them fit a core's second-level cache."""
FASTMATH = {"contract", "nsz", "arcp"}
"""Optimisations of sums and products that compiled loops may apply; NaN and infinity are preserved."""


def works_on(*tensors: Tensor) -> bool:
    """Tell whether the fused passes can process these tensors in the present context."""
    if torch.compiler.is_compiling() or torch.is_autocast_enabled("cpu") or not is_wanted():
        return False
    first = tensors[0]
    alike = all(t.device.type == "cpu" and t.dtype == first.dtype for t in tensors)
    return alike and first.dtype in (torch.float32, torch.float64)


def block_size(num_rows: int) -> int:
    """Return the number of rows of the largest block."""
    return min(BLOCK, num_rows)


def blocks(num_rows: int) -> Iterator[tuple[int, int]]:
    """Yield first row and number of rows of every block."""
    for first in range(0, num_rows, BLOCK):
        yield first, min(BLOCK, num_rows - first)


def plain_gradients(
    plain: Callable[..., Sequence[Tensor | None]], inputs: Sequence[Tensor | None], grads: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Return gradients of a fused pass by PyTorch's operations, for a backward pass that is itself differentiated (``create_graph=True``).

    Args:
        plain: function that returns the same results from the same inputs with PyTorch's operations.
        inputs: the saved inputs, to which second derivatives are propagated.
        grads: gradients of the results.
    """
    own = [t.view_as(t) if t is not None and t.requires_grad else t for t in inputs]  # one input may depend on another
    wanted = [t for t in own if t is not None and t.requires_grad]
    pairs = [(y, g) for y, g in zip(plain(*own), grads, strict=True) if y is not None and g is not None]
    outputs, arriving = zip(*pairs, strict=True)
    found = iter(torch.autograd.grad(outputs, wanted, arriving, create_graph=True, allow_unused=True))
    return [next(found) if t is not None and t.requires_grad else None for t in own]
