"""Differences between a step of an exported simulator and that of its model, which decide whether a file is written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from gpe_pl.trajectory.state import State

TOLERANCE = 1e-6
"""Largest difference of a position after one step [m], in scenes whose coordinates are so small that rounding is smaller (see ``tolerance``)."""
ROUNDINGS = 4
"""Number of roundings of the largest coordinate by which a position may differ."""
STRESS_TOLERANCE = 1e-3
"""Largest difference of a stress after one step, in units of the model's stresses (``LearnedSimulator.stress_std``)."""


def tolerance(states: Sequence[State]) -> float:
    """Return the largest difference of a position that is allowed after one step from these states [m]."""
    largest = max(float(state.pos.abs().max()) for state in states)
    return max(TOLERANCE, ROUNDINGS * torch.finfo(torch.float32).eps * largest)


def largest_difference(pairs: Iterable[tuple[Tensor, Tensor]]) -> float:
    """Return the largest difference of two tensors of the same shape, over all pairs; NaN if any value is NaN, and 0 if there are no values."""
    differences = [(a - b).abs().max() for a, b in pairs if a.numel()]
    return float(torch.stack(differences).max()) if differences else 0.0  # unlike Python's max, this one returns NaN


def excess(position: float, stress: float, states: Sequence[State], stress_std: Tensor) -> str | None:
    """Return by how much steps from some states differ, and how much is allowed; None if they differ by no more.

    Args:
        position: largest difference of a position [m].
        stress: largest difference of a stress [Pa].
        states: states from which the steps were made.
        stress_std: unit of the model's stresses [Pa].
    """
    for found, allowed, unit in ((position, tolerance(states), "m"), (stress, STRESS_TOLERANCE * float(stress_std), "Pa")):
        if not found <= allowed:  # also for NaN
            return f"by {found:.3g} {unit}, at most {allowed:.3g} {unit} are allowed"
    return None
