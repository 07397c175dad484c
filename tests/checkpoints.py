"""Comparison of two training checkpoints."""

from __future__ import annotations

from typing import Any

import torch

from gpe_pl.benchmarks.faults.runs import SAVED


def assert_same_checkpoint(a: dict[str, Any], b: dict[str, Any]) -> None:
    """Compare everything that does not depend on the location of a checkpoint, bit for bit."""
    assert_equal({key: a[key] for key in SAVED if key in a}, {key: b[key] for key in SAVED if key in b})  # an average is optional


def assert_equal(a: Any, b: Any, path: str = "") -> None:
    """Compare nested values with tensors, bit for bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            assert_equal(a[key], b[key], f"{path}.{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), path
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{path}[{k}]")
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype, path
        assert a.numpy().tobytes() == b.numpy().tobytes(), path
    else:
        assert a == b, path
