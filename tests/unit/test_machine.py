"""Rates are rates, and the memory of a function is its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gpe_pl.machine import copy_rate, gemm_rate, peak_memory


def filling(num_bytes: int) -> Callable[[], int]:
    return lambda: int(np.ones(num_bytes, dtype=np.uint8)[-1])


def failing() -> Callable[[], int]:
    raise RuntimeError("no")


def test_rates_are_positive() -> None:
    assert gemm_rate(64, 8, "cpu") > 0 and copy_rate("cpu", 2**16) > 0


@pytest.mark.slow
def test_memory_is_what_a_function_takes() -> None:
    small, large = peak_memory(filling, 10**6), peak_memory(filling, 3 * 10**8)
    assert 0.9 * 3e8 < large < 1.5 * 3e8 and small < 1e8


@pytest.mark.slow
def test_a_function_that_fails_says_so() -> None:
    with pytest.raises(MemoryError, match="failing ended without an answer"):
        peak_memory(failing)
