"""Search for the unknowns with the smallest misfit, within their bounds.

A scan along each unknown gives the start, and the picture of the misfit. Then SciPy's bounded optimisers continue: L-BFGS-B with gradients, and without them
Brent's method for one unknown and COBYQA for several. They minimise the exponential of the misfit, a geometric mean of squared displacements: it is smooth
where a simulator is exact. Bounds are bounds of the optimiser; nothing is clamped within the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass
from scipy.optimize import minimize, minimize_scalar

from gpe_pl.evaluation.identification.gradient_check import GradientCheck, Objective, gradient_check
from gpe_pl.evaluation.identification.valleys import TOLERANCE, follow_valleys, most_evaluations, ratio
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.system.progress import Progress

GRADIENT, DERIVATIVE_FREE = "gradient", "derivative_free"
ALL_AT_ONCE = 4
"""From this number of unknowns on, the search starts in the middle, without a scan, and follows no valleys."""


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class SearchSettings:
    """How to search.

    Attributes:
        method: ``gradient``; ``derivative_free``; or ``auto``: derivative-free for one unknown, which needs few rollouts, otherwise gradients if the check by
            finite differences trusts them. ``gradient`` is checked too, and falls back in the same way.
        num_scanned: number of values at which each unknown is scanned.
        max_evaluations: largest number of further rollouts of all windows.
        profile_evaluations: with two or three unknowns, largest number of rollouts of all windows for each value of one at which the others are searched again
            (see ``valleys``); 0 leaves this out, and intervals can be too narrow.
    """

    method: Literal["auto", "gradient", "derivative_free"] = "auto"
    num_scanned: Annotated[int, Field(ge=3)] = 9
    max_evaluations: Annotated[int, Field(ge=1)] = 60
    profile_evaluations: Annotated[int, Field(ge=0)] = 12


@dataclass
class Found:
    """Result of a search.

    Attributes:
        z: numbers from 0 to 1 [unknown].
        misfit: misfit there.
        method: ``gradient`` or ``derivative_free``.
        check: check of gradients, if there was one.
        tried: numbers from 0 to 1 and misfit of every evaluation.
        is_unfinished: whether the search stopped at ``SearchSettings.max_evaluations``.
    """

    z: Float64[np.ndarray, "unknown"]
    misfit: float
    method: str
    check: GradientCheck | None
    tried: list[tuple[np.ndarray, float]] = field(default_factory=list)
    is_unfinished: bool = False


def search(objective: Objective, settings: SearchSettings | None = None, on_progress: Progress | None = None) -> Found:
    """Return the unknowns with the smallest misfit among all that were tried."""
    s, number = settings or SearchSettings(), len(objective.unknowns)
    tried: list[tuple[np.ndarray, float]] = []
    follows = bool(s.profile_evaluations) and 1 < number < ALL_AT_ONCE
    total = s.max_evaluations + (s.num_scanned * number if number < ALL_AT_ONCE else 1)
    total += most_evaluations(number, s.profile_evaluations) if follows else 0

    def note(z: np.ndarray, misfit: float) -> float:
        tried.append((np.array(z, dtype=np.float64), misfit))
        if on_progress is not None:
            on_progress(min(len(tried), total), total)
        return misfit

    def misfit(z: np.ndarray) -> float:
        return note(z, objective.misfit(np.clip(z, 0.0, 1.0)))

    start, width = _scanned(misfit, number, s.num_scanned)
    num_scanned = len(tried)
    base = min(value for _, value in tried)

    def relative(z: np.ndarray) -> float:
        return ratio(misfit(z), base)

    check = None
    if isinstance(objective.simulator, LearnedSimulator) and (s.method == GRADIENT or (s.method == "auto" and number > 1)):
        check = gradient_check(objective, start + np.where(start < 0.5, width, -width))
    method = GRADIENT if check is not None and check.is_trusted else DERIVATIVE_FREE
    if method == GRADIENT:

        def with_gradient(z: np.ndarray) -> tuple[float, np.ndarray]:
            value, gradient = objective.misfit_and_gradient(z)
            relative_value = ratio(note(z, value), base)
            return relative_value, relative_value * gradient

        options = {"maxfun": s.max_evaluations, "ftol": 1e-6, "gtol": 1e-4}
        result = minimize(with_gradient, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * number, options=options)
    elif number == 1:
        bounds = (max(0.0, start[0] - width), min(1.0, start[0] + width))
        options = {"xatol": TOLERANCE, "maxiter": s.max_evaluations}
        result = minimize_scalar(lambda z: relative(np.array([z])), bounds=bounds, method="bounded", options=options)
    else:
        options = {"initial_tr_radius": width, "final_tr_radius": TOLERANCE, "maxfev": s.max_evaluations}
        result = minimize(relative, start, method="COBYQA", bounds=[(0.0, 1.0)] * number, options=options)
    is_unfinished = not result.success and len(tried) - num_scanned >= s.max_evaluations
    if follows:
        follow_valleys(misfit, tried, s.profile_evaluations)
    z, least = min(tried, key=lambda pair: (pair[1], float(np.abs(pair[0] - 0.5).max())))
    return Found(np.clip(z, 0.0, 1.0), least, method, check, tried, is_unfinished)


def _scanned(misfit: Callable[[np.ndarray], float], number: int, num_scanned: int) -> tuple[np.ndarray, float]:
    """Return the start of the search, and the distance of scanned values: each unknown is scanned in turn, the others at the best values so far.

    Of equal misfits, the value nearest to the middle is the best, as the unknown may have no effect.
    """
    z = np.full(number, 0.5)
    if number >= ALL_AT_ONCE:
        misfit(z)
        return z, 0.25
    values = np.linspace(0.0, 1.0, num_scanned)
    for k in range(number):
        candidates = [np.concatenate([z[:k], [value], z[k + 1 :]]) for value in values]
        z = min(candidates, key=lambda candidate: (misfit(candidate), abs(candidate[k] - 0.5)))
    return z, float(values[1])
