"""The processes of a data-parallel run: which one this is, and sums and lists over all of them. Without such a run there is one process, rank 0."""

from __future__ import annotations

from typing import TypeVar

import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")


def _is_parallel() -> bool:
    return dist.is_available() and dist.is_initialized()


def rank() -> int:
    """The number of this process, from 0."""
    return dist.get_rank() if _is_parallel() else 0


def num_ranks() -> int:
    """How many processes there are."""
    return dist.get_world_size() if _is_parallel() else 1


def summed(values: Tensor) -> Tensor:
    """The sum over ranks of tensors of one shape; the same bits everywhere. All ranks have to call it."""
    if num_ranks() == 1:
        return values
    total = values.clone()
    dist.all_reduce(total)
    return total


def gathered(value: T) -> list[T]:
    """The values of all ranks, in their order. All ranks have to call it."""
    if num_ranks() == 1:
        return [value]
    values: list[T | None] = [None] * num_ranks()
    dist.all_gather_object(values, value)
    return values  # type: ignore[return-value]
