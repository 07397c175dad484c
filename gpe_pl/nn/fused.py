"""What the passes that are made for a CPU share: when they work, whether they are wanted, and how many rows they take at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

BLOCK = 512
"""Rows at a time: at 128 channels in single precision an array of a block takes 256 KiB, and a handful of them fit a core's second-level cache."""
FASTMATH = {"contract", "nsz", "arcp"}
"""What compiled loops may do with sums and products; not-a-numbers and infinities stay what they are."""
_is_wanted = ContextVar("_is_wanted", default=True)


@contextmanager
def unfused() -> Iterator[None]:
    """Forward passes inside use PyTorch's operations alone, and so do their backward passes: to compare with."""
    token = _is_wanted.set(False)
    try:
        yield
    finally:
        _is_wanted.reset(token)


def works_on(*tensors: Tensor) -> bool:
    """Whether these passes can take the tensors, here and now."""
    if torch.compiler.is_compiling() or torch.is_autocast_enabled("cpu") or not _is_wanted.get():
        return False
    first = tensors[0]
    alike = all(t.device.type == "cpu" and t.dtype == first.dtype for t in tensors)
    return alike and first.dtype in (torch.float32, torch.float64)


def block_size(num_rows: int) -> int:
    """Rows of the largest block."""
    return min(BLOCK, num_rows)


def blocks(num_rows: int) -> Iterator[tuple[int, int]]:
    """First row and number of rows of every block."""
    for first in range(0, num_rows, BLOCK):
        yield first, min(BLOCK, num_rows - first)


def plain_gradients(
    plain: Callable[..., Sequence[Tensor | None]], inputs: Sequence[Tensor | None], grads: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Gradients of what passes compute, by PyTorch's operations: for a backward pass that is itself to be differentiated (``create_graph=True``).

    Args:
        plain: the same results of the same inputs.
        inputs: as they were saved, so that second derivatives find their way back.
        grads: of the results.
    """
    own = [t.view_as(t) if t is not None and t.requires_grad else t for t in inputs]  # one input may have come from another
    wanted = [t for t in own if t is not None and t.requires_grad]
    pairs = [(y, g) for y, g in zip(plain(*own), grads, strict=True) if y is not None and g is not None]
    outputs, arriving = zip(*pairs, strict=True)
    found = iter(torch.autograd.grad(outputs, wanted, arriving, create_graph=True, allow_unused=True))
    return [next(found) if t is not None and t.requires_grad else None for t in own]
