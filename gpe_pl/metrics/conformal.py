"""Split conformal intervals: interval widths from errors on calibration scenes, with a guaranteed coverage of new scenes.

An interval is ``estimate ± factor · scale``. The scale says how uncertain one estimate is relative to others, for example the spread of an ensemble. The
factor is a quantile of the scores ``|truth - estimate| / scale`` of calibration scenes. The guarantee needs one assumption only: calibration scenes and the new
scene are exchangeable, so they come from the same distribution, and none of them was used for training. A poor scale makes intervals wide but not wrong.

The scene is the unit that is exchangeable. Nodes of a scene depend on each other, so a thousand nodes of one scene are not a thousand calibration pairs. Two
factors respect this:

- ``conformal_factor`` takes one score per scene. A new scene's score is within the factor with a probability of at least ``level``.
- ``conformal_factor_of_nodes`` takes the scores of all nodes of each scene. The expected fraction of a new scene's nodes that are within the factor is at least
  ``level``.

Sources: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World (2005); Angelopoulos et al., Conformal risk control, ICLR 2024, for nodes; Gneiting
and Raftery, Strictly proper scoring rules, J. Am. Stat. Assoc. 102 (2007), for the interval score.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float
from scipy.stats import betabinom

Values = Sequence[float] | np.ndarray


def conformal_scores(estimate: Values, truth: Values, scale: Values | float = 1.0) -> Float[np.ndarray, "*axes"]:
    """Return the scores ``|truth - estimate| / scale`` [...]. The score of an estimate that is not finite is infinite.

    Args:
        estimate, truth: estimates and true values, in the same unit.
        scale: positive scales in this unit; one for all or one for each.

    Raises:
        ValueError: the shapes differ, a true value is not finite, or a scale is not positive.
    """
    estimate, truth, scale = (np.asarray(values, dtype=np.float64) for values in (estimate, truth, scale))
    if estimate.shape != truth.shape or scale.shape not in ((), truth.shape):
        raise ValueError(
            f"estimate, truth and scale have the shapes {estimate.shape}, {truth.shape} and {scale.shape}; give them one shape"
        )
    if not np.isfinite(truth).all():
        raise ValueError("truth has values that are not finite; leave these scenes out")
    if not (scale > 0).all():
        raise ValueError("scale has values that are not positive; add a small constant to it")
    with np.errstate(invalid="ignore"):
        scores = np.abs(truth - estimate) / scale
    return np.where(np.isfinite(estimate) & np.isfinite(scores), scores, math.inf)


def fewest_scenes(level: float) -> int:
    """Return the number of calibration scenes below which every interval of this level is infinite: 9 for 0.9, and 19 for 0.95.

    Raises:
        ValueError: the level is not between 0 and 1.
    """
    _check_level(level)
    return math.ceil(level / (1 - level) - 1e-9)


def conformal_factor(scores: Values, level: float) -> float:
    """Return the ⌈(n + 1) level⌉-th smallest of the scores of n calibration scenes; infinite with fewer than ``fewest_scenes``.

    Args:
        scores: one score per scene, as from ``conformal_scores``.
        level: nominal coverage, such as 0.9.

    Raises:
        ValueError: a score is NaN or negative, or the level is not between 0 and 1.
    """
    _check_level(level)
    ordered = np.sort(_checked_scores(scores))
    rank = math.ceil((len(ordered) + 1) * level - 1e-9)  # (9 + 1) 0.9 may exceed 9 by rounding
    return float(ordered[rank - 1]) if rank <= len(ordered) else math.inf


def conformal_factor_of_nodes(scores: Sequence[np.ndarray], level: float) -> float:
    """Return the smallest factor f for which ``(Σ_s u_s(f) + 1) / (n + 1) ≤ 1 - level``, where u_s is the fraction of scene s's nodes with scores above f.

    It is infinite with fewer than ``fewest_scenes`` scenes. Each scene counts the same, however many nodes it has.

    Args:
        scores: scores of the nodes of each scene [scene][node].
        level: nominal coverage, such as 0.9.

    Raises:
        ValueError: a score is NaN or negative, a scene has no nodes, or the level is not between 0 and 1.
    """
    _check_level(level)
    if any(np.size(part) == 0 for part in scores):
        raise ValueError("a calibration scene has no nodes; leave it out")
    allowed = (1 - level) * (len(scores) + 1) - 1
    if allowed < -1e-9:
        return math.inf
    values = np.concatenate([_checked_scores(part) for part in scores])
    weight = np.concatenate([np.full(np.size(part), 1 / np.size(part)) for part in scores])
    order = np.argsort(values, kind="stable")
    above = weight.sum() - np.cumsum(weight[order])  # of the nodes after each
    return float(values[order][np.argmax(above <= allowed + 1e-9)])


def conformal_interval(estimate: Values, scale: Values | float, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends ``estimate ∓ factor · scale`` of intervals, in the unit of the estimates."""
    center, width = np.asarray(estimate, dtype=np.float64), factor * np.asarray(scale, dtype=np.float64)
    return center - width, center + width


def coverage(low: Values, high: Values, truth: Values) -> float:
    """Return the fraction of true values that lie in their intervals ``[low, high]``."""
    low, high, truth = (np.asarray(values, dtype=np.float64) for values in (low, high, truth))
    return float(np.mean((low <= truth) & (truth <= high)))


def interval_score(low: Values, high: Values, truth: Values, level: float) -> Float[np.ndarray, "*axes"]:
    """Return the interval scores [...]; smaller is better.

    With α = 1 - level, the score is ``(high - low) + 2/α max(low - truth, 0) + 2/α max(truth - high, 0)``, in the unit of the values. It rewards narrow
    intervals, and punishes those that miss the truth. Its expectation is smallest for the quantiles α/2 and 1 - α/2 of the true distribution.

    Raises:
        ValueError: the level is not between 0 and 1.
    """
    _check_level(level)
    low, high, truth = (np.asarray(values, dtype=np.float64) for values in (low, high, truth))
    missed = np.maximum(low - truth, 0) + np.maximum(truth - high, 0)
    return cast(np.ndarray, (high - low) + 2 / (1 - level) * missed)


def chance_range(num_calibration: int, num_test: int, level: float, probability: float = 0.9) -> tuple[float, float]:
    """Return the range in which the observed coverage of exact intervals lies with a probability, if scenes are exchangeable and scores are continuous.

    With few scenes, observed coverage varies by chance, because both the calibration scenes and the test scenes are drawn. The number of covered test
    scenes has a beta-binomial distribution with parameters k and n + 1 - k, where n is ``num_calibration`` and k = ⌈(n + 1) level⌉.

    Args:
        num_calibration, num_test: numbers of calibration and test scenes.
        level: nominal coverage.
        probability: probability of the range.

    Raises:
        ValueError: ``num_calibration`` is below ``fewest_scenes(level)``, or ``num_test`` is not positive.
    """
    if num_calibration < fewest_scenes(level) or num_test < 1:
        raise ValueError(f"{num_calibration} calibration and {num_test} test scenes: at least {fewest_scenes(level)} and 1 are needed")
    k = math.ceil((num_calibration + 1) * level - 1e-9)
    number = betabinom(num_test, k, num_calibration + 1 - k)
    low, high = number.ppf([(1 - probability) / 2, (1 + probability) / 2])
    return float(low) / num_test, float(high) / num_test


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise ValueError(f"a level lies between 0 and 1, got {level}")


def _checked_scores(scores: Values) -> np.ndarray:
    values = np.asarray(scores, dtype=np.float64).ravel()
    if np.isnan(values).any() or (values < 0).any():
        raise ValueError("scores must be at least 0, and not NaN")
    return values
