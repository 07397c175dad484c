"""Checks of the weights and statistics in a checkpoint, by their names."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor


def check_sizes(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor], optional: str) -> None:
    """Check that weights have the names, shapes and types of others, and store as many values as their shapes say.

    Args:
        weights: tensors of a checkpoint. Additional names are left to ``load_state_dict``.
        expected: state of the simulator that the checkpoint describes; values are not read, so it may be on the device ``meta``.
        optional: name that may be missing.

    Raises:
        ValueError: a tensor differs or is missing; the message names it.
    """
    for name, value in weights.items():
        if name in expected and value.shape != expected[name].shape:
            raise ValueError(f"size mismatch for {name}: {tuple(value.shape)} instead of {tuple(expected[name].shape)}")
        if name in expected and value.is_floating_point() != expected[name].is_floating_point():
            raise ValueError(f"{name} is of type {value.dtype}")
        if value.untyped_storage().nbytes() < value.numel() * value.element_size():
            raise ValueError(f"{name} has fewer values than its shape says")
    if missing := expected.keys() - weights.keys() - {optional}:
        raise ValueError(f"Missing key {min(missing)}")


def check_statistics(state: Mapping[str, Tensor]) -> None:
    """Check the values in the state of a simulator: all are numbers, scales are positive, and ranges are not reversed.

    Ranges are named ``trained_…``, with the lowest values in row 0 and the highest in row 1. A property that no training scene has is from inf to -inf
    in ``trained_scene``.

    Raises:
        ValueError: a value breaks these rules; the message names its tensor.
    """
    for name, values in state.items():
        is_range = name.startswith("trained_")  # unlimited before training
        if bool(values.isnan().any()) or not (is_range or bool(values.isfinite().all())):
            raise ValueError(f"{name} has values that are not finite")
        is_scale = name in ("acceleration_std", "stress_std") or (name.startswith("standardizer.") and name.endswith(("std", "mass")))
        if is_scale and not bool((values > 0).all()):
            raise ValueError(f"{name} has values that are not positive")
        if is_range:
            low, high = values
            is_ordered = low <= high
            if name == "trained_scene":
                is_ordered |= low.isposinf() & high.isneginf()
            if not bool(is_ordered.all()):
                raise ValueError(f"the lowest value of {name} is above the highest")
