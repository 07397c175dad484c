"""Processes of a data-parallel run: the rank of this process, and sums and lists over all ranks. Any other run has one process, rank 0."""

from __future__ import annotations

from typing import TypeVar

import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")


def _is_parallel() -> bool:
    return dist.is_available() and dist.is_initialized()


def rank() -> int:
    """Return the rank of this process, counted from 0."""
    return dist.get_rank() if _is_parallel() else 0


def num_ranks() -> int:
    """Return the number of processes of the run."""
    return dist.get_world_size() if _is_parallel() else 1


def summed(values: Tensor) -> Tensor:
    """Sum tensors of one shape over all ranks. Every rank must call it and gets the same bits."""
    if num_ranks() == 1:
        return values
    total = values.clone()
    dist.all_reduce(total)
    return total


def gathered(value: T) -> list[T]:
    """Return the values of all ranks in rank order. Every rank must call it."""
    if num_ranks() == 1:
        return [value]
    values: list[T | None] = [None] * num_ranks()
    dist.all_gather_object(values, value)
    return values  # type: ignore[return-value]
