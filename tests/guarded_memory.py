"""Runs compiled networks in memory with guard zones.

Every matrix, input, result and weight lies between zones whose bytes are all 0xFF, which is NaN, or −1 for integers. What is not an input holds the same bytes
at first. A read outside, or before anything was written, therefore makes results NaN. A write outside changes a zone.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from gpe_pl.nn import network_program

ZONE = 64
"""Length of a zone [element]."""


class GuardedArray:
    """An array between guard zones.

    Args:
        size: number of elements.
        dtype: type of the elements.
        address: memory of which the array is a copy, or None for an array that has not been written.
    """

    def __init__(self, size: int, dtype: Any, address: int | None = None) -> None:
        self.memory = np.empty(size + 2 * ZONE, dtype)
        self.memory.view(np.uint8)[:] = 0xFF
        self.values = self.memory[ZONE : ZONE + size]
        if address is not None and size:
            self.values[:] = array_at(address, size, dtype)
        self.before = None if address is None else self.memory.tobytes()

    @property
    def address(self) -> int:
        return int(self.values.ctypes.data)

    def check(self) -> None:
        """Fail if a zone was written, or an input."""
        assert self.before is None or self.before == self.memory.tobytes(), "an input was written"
        assert (self.memory[:ZONE].view(np.uint8) == 0xFF).all() and (self.memory[-ZONE:].view(np.uint8) == 0xFF).all(), "written outside"


def array_at(address: int, size: int, dtype: Any) -> np.ndarray:
    """Return the array at an address."""
    memory = (ctypes.c_byte * (size * np.dtype(dtype).itemsize)).from_address(address)
    return np.frombuffer(memory, dtype)


@contextmanager
def guarded() -> Iterator[list[int]]:
    """Run compiled networks in guarded memory inside this block. The list gets the number of guarded matrices of each run."""
    runs: list[int] = []
    run = network_program._run

    def guarded_run(
        address: int, segments: Any, instructions: Any, offset: Any, stride: Any, is_block: Any, height: Any, weights: Any, work: Any, size: Any,
        num_nodes: Any, sets: Any, node_kinds: Any, edge_kinds: Any, body_kinds: Any, result_kinds: Any, nodes: Any, edges: Any, bodies: Any,
        results: Any, *rest: Any,
    ) -> Any:  # fmt: skip
        real, inputs, outputs = work.dtype, [], []

        def copied(at: int, count: int, dtype: Any) -> int:
            inputs.append(GuardedArray(count, dtype, at))
            return inputs[-1].address

        weights = np.ascontiguousarray(weights)
        copied(weights.ctypes.data, len(weights), real)
        own_weights = inputs[-1].values
        nodes = np.array(
            [(copied(a, n * kind[2], real), n, first) for (a, n, first), kind in zip(nodes.tolist(), node_kinds.tolist(), strict=True)],
            np.int64,
        )
        edges = np.array(
            [
                (copied(e[0], 2 * e[3], np.int64), copied(e[1], e[3] * kind[4], real), copied(e[2], e[3] * kind[5], real), *e[3:])
                for e, kind in zip(edges.tolist(), edge_kinds.tolist(), strict=True)
            ],
            np.int64,
        )
        bodies = np.array([(copied(a, n, np.int64), n, first) for a, n, first in bodies.tolist()], np.int64)
        own_results = []
        for (at, n, first), kind in zip(results.tolist(), result_kinds.tolist(), strict=True):
            outputs.append((GuardedArray(n * kind[2], real), at))
            own_results.append((outputs[-1][0].address, n, first))
        length = height * stride
        own_offset = np.cumsum(length + ZONE) - length
        own_work = GuardedArray(int((length + ZONE).sum()), real)
        is_zone = np.ones(len(own_work.values), bool)
        for first, count in zip(own_offset.tolist(), length.tolist(), strict=True):
            is_zone[first : first + count] = False
        wrong = run(
            address, segments, instructions, own_offset, stride, is_block, height, own_weights, own_work.values, size, num_nodes, sets,
            node_kinds, edge_kinds, body_kinds, result_kinds, nodes.reshape(-1, 3), edges.reshape(-1, 6), bodies.reshape(-1, 3),
            np.array(own_results, np.int64).reshape(-1, 3), *rest,
        )  # fmt: skip
        for array in (*inputs, own_work, *(array for array, _ in outputs)):
            array.check()
        assert (own_work.values[is_zone].view(np.uint8) == 0xFF).all(), "written between matrices"
        for array, at in outputs:
            if len(array.values):
                array_at(at, len(array.values), real)[:] = array.values
        runs.append(len(length))
        return wrong

    with mock.patch.object(network_program, "_run", guarded_run):
        yield runs
