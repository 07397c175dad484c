"""Check of gradients by finite differences. Gradients through long or chaotic rollouts can have the wrong size, and even the wrong sign."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

STEP = 0.05
"""Step of the central difference, as a fraction of the range between the bounds. With smaller steps, jumps decide that come from neighbours found or lost."""
LARGEST_RATIO = 2.0
"""Gradient and finite difference may differ by this factor."""


@runtime_checkable
class Objective(Protocol):
    """A misfit as a function of numbers from 0 to 1, such as ``Shooting`` or ``design.Guidance``."""

    @property
    def simulator(self) -> Any: ...

    @property
    def unknowns(self) -> Sized: ...

    def misfit(self, z: Sequence[float] | np.ndarray) -> float:
        """Return the misfit at numbers from 0 to 1 [unknown]."""
        ...

    def misfit_and_gradient(self, z: Sequence[float] | np.ndarray) -> tuple[float, np.ndarray]:
        """Return the misfit and its gradient [unknown]."""
        ...


@dataclass(frozen=True)
class GradientCheck:
    """Derivative of the misfit along one direction, per range between the bounds.

    Attributes:
        gradient: derivative by automatic differentiation.
        difference: central difference.
    """

    gradient: float
    difference: float

    @property
    def is_trusted(self) -> bool:
        """Whether both have the same sign, and differ by at most the factor ``LARGEST_RATIO``."""
        if not np.isfinite(self.gradient) or self.gradient * self.difference <= 0:
            return False
        return 1 / LARGEST_RATIO <= self.gradient / self.difference <= LARGEST_RATIO

    def __str__(self) -> str:
        if np.isnan(self.gradient):
            return "gradients cannot be trusted: the model has none here; a derivative-free search takes their place"
        numbers = f"{self.gradient:.3g} by automatic differentiation, {self.difference:.3g} by finite differences"
        if self.is_trusted:
            return f"gradients are trusted: the slope of the misfit is {numbers}"
        return f"gradients cannot be trusted: the slope of the misfit is {numbers}; a derivative-free search takes their place, or choose a shorter horizon"


def gradient_check(objective: Objective, z: Sequence[float] | np.ndarray, seed: int = 0) -> GradientCheck:
    """Compare the gradient at numbers from 0 to 1 [unknown] with a central difference along a random diagonal direction.

    Away from the minimum the slope is large compared with rounding, so call it there.
    """
    center = np.clip(np.asarray(z, dtype=np.float64), STEP, 1 - STEP)
    direction = np.random.default_rng(seed).choice([-1.0, 1.0], size=len(center)) if len(center) > 1 else np.ones(1)
    _, gradient = objective.misfit_and_gradient(center)
    before, after = (objective.misfit(center + sign * STEP * direction) for sign in (-1, 1))
    return GradientCheck(float(gradient @ direction), (after - before) / (2 * STEP))
