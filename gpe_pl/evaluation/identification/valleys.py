"""Follows the valleys of a misfit to both sides of the answer, for intervals of one unknown among several.

A search varies one unknown mostly while the others are near their best values. Where a change of one unknown makes up for a change of another, its misfits then
rise much faster than the smallest misfit over the others, which intervals are about (profile likelihood). Here one unknown is moved away from the answer step
by step, and the others are searched again at each step, until the misfit is ``FOLLOWED`` above the smallest.

Source: Murphy and van der Vaart, On profile likelihood, J. Am. Stat. Assoc. 95 (2000).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize

from gpe_pl.evaluation.identification.profile import Profile

FOLLOWED = 0.5
"""Misfit above the smallest up to which valleys are followed."""
NUM_STEPS = 6
"""Largest number of steps to each side; each is twice as long as the one before."""
RADIUS = 0.06
"""First radius of the searches of the other unknowns, as a fraction of the range between the bounds."""
TOLERANCE = 2e-3
"""Precision of searches, as a fraction of the range between the bounds."""
LARGEST = 50.0
"""Largest exponent of the misfit above another one."""

Tried = list[tuple[np.ndarray, float]]
"""Numbers from 0 to 1 and misfit of each evaluation."""


def ratio(misfit: float, base: float) -> float:
    """Return the exponential of a misfit above another one: a geometric mean of squared displacements over that of another."""
    return math.exp(min(misfit - base, LARGEST))


def most_evaluations(number: int, evaluations: int) -> int:
    """Return the largest number of evaluations of ``follow_valleys`` for so many unknowns."""
    return 2 * number * NUM_STEPS * evaluations


def follow_valleys(misfit: Callable[[np.ndarray], float], tried: Tried, evaluations: int) -> None:
    """Follow the valley of each unknown to both sides of the answer.

    Args:
        misfit: misfit at numbers from 0 to 1 [unknown], at least two; it appends what it computes to ``tried``.
        tried: results of a search.
        evaluations: largest number of evaluations for each value of an unknown.
    """
    for k in range(len(tried[0][0])):
        for side in (-1, 1):
            _follow(misfit, tried, k, side, evaluations)


def _follow(misfit: Callable[[np.ndarray], float], tried: Tried, k: int, side: int, evaluations: int) -> None:
    answer, _ = _best(tried)
    known = Profile.of(((float(z[k]), value) for z, value in tried), (0.0, 1.0))
    step = max(abs(known.within(FOLLOWED)[max(side, 0)] - answer[k]), TOLERANCE)
    at = answer
    for _ in range(NUM_STEPS):
        value = float(np.clip(at[k] + side * step, 0.0, 1.0))
        if value == at[k]:
            return
        guess = at if at is answer else at + (at - answer) * (value - at[k]) / (at[k] - answer[k])
        found, least = _searched(misfit, tried, np.where(np.arange(len(at)) == k, value, np.clip(guess, 0.0, 1.0)), k, evaluations)
        if least - _best(tried)[1] > FOLLOWED:
            return
        at, step = found, 2 * step


def _searched(misfit: Callable[[np.ndarray], float], tried: Tried, start: np.ndarray, k: int, evaluations: int) -> tuple[np.ndarray, float]:
    """Return the values of all unknowns with the smallest misfit for a value of unknown ``k``, and that misfit."""
    others, base, before = np.arange(len(start)) != k, _best(tried)[1], len(tried)

    def relative(own: Float64[np.ndarray, "other"]) -> float:
        z = start.copy()
        z[others] = np.clip(own, 0.0, 1.0)
        return ratio(misfit(z), base)

    options = {"initial_tr_radius": RADIUS, "final_tr_radius": TOLERANCE, "maxfev": evaluations}
    minimize(relative, start[others], method="COBYQA", bounds=[(0.0, 1.0)] * int(others.sum()), options=options)
    return _best(tried[before:])


def _best(tried: Tried) -> tuple[np.ndarray, float]:
    return min(tried, key=lambda pair: pair[1])
