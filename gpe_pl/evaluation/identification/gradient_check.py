"""Check of gradients by finite differences. Gradients through long or chaotic rollouts can have the wrong size, and even the wrong sign."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

STEP = 0.05
"""Step of the central difference, as a fraction of the range between the bounds. With smaller steps, jumps decide that come from neighbours found or lost."""
LARGEST_RATIO = 2.0
"""Lengths of gradient and finite differences may differ by this factor."""
LEAST_COSINE = 0.7
"""Least cosine of the angle between both, 45°. The sum of slopes along one diagonal would not show that the largest ones have the wrong sign."""
ONE_BY_ONE = 6
"""Largest number of unknowns that are checked one by one, with two rollouts each. With more, one diagonal direction is checked."""


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
    """Derivatives of the misfit along some directions, per range between the bounds.

    Attributes:
        gradient: derivatives by automatic differentiation [direction].
        difference: central differences [direction].
    """

    gradient: tuple[float, ...]
    difference: tuple[float, ...]

    @property
    def is_trusted(self) -> bool:
        """Whether both point the same way (``LEAST_COSINE``) and are of similar length (``LARGEST_RATIO``)."""
        gradient, difference = np.array(self.gradient), np.array(self.difference)
        if not np.isfinite(gradient).all() or not gradient.any() or not difference.any():
            return False
        ratio = np.linalg.norm(gradient) / np.linalg.norm(difference)
        cosine = gradient @ difference / (np.linalg.norm(gradient) * np.linalg.norm(difference))
        return bool(cosine >= LEAST_COSINE and 1 / LARGEST_RATIO <= ratio <= LARGEST_RATIO)

    def __str__(self) -> str:
        if np.isnan(self.gradient).any():
            return "gradients cannot be trusted: the model has none here; a derivative-free search takes their place"
        slopes, by_differences = (" / ".join(f"{value:.3g}" for value in values) for values in (self.gradient, self.difference))
        numbers = f"{slopes} by automatic differentiation, {by_differences} by finite differences"
        if self.is_trusted:
            return f"gradients are trusted: the slope of the misfit is {numbers}"
        return f"gradients cannot be trusted: the slope of the misfit is {numbers}; a derivative-free search takes their place, or choose a shorter horizon"


def gradient_check(objective: Objective, z: Sequence[float] | np.ndarray, seed: int = 0) -> GradientCheck:
    """Compare the gradient at numbers from 0 to 1 [unknown] with central differences: along each unknown, or along a random diagonal if there are many.

    Away from the minimum the slope is large compared with rounding, so call it there.
    """
    center = np.clip(np.asarray(z, dtype=np.float64), STEP, 1 - STEP)
    number = len(center)
    directions = np.eye(number) if number <= ONE_BY_ONE else np.random.default_rng(seed).choice([-1.0, 1.0], size=(1, number))
    _, gradient = objective.misfit_and_gradient(center)
    differences = [(objective.misfit(center + STEP * way) - objective.misfit(center - STEP * way)) / (2 * STEP) for way in directions]
    return GradientCheck(tuple((directions @ gradient).tolist()), tuple(differences))
