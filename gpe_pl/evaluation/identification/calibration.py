"""Calibration of answers on scenes with known unknowns: a correction of systematic errors, and intervals with a guaranteed coverage.

A model that answers too low for every scene is corrected by ``truth ≈ a + b · estimate``, a line fitted by weighted least squares in the coordinates
of the unknown. Intervals are
split conformal (``metrics.conformal``): scores of calibration scenes come from lines without the scene itself, so no scene corrects its own answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gpe_pl.errors import GpeError
from gpe_pl.metrics.conformal import conformal_factor, conformal_scores, fewest_scenes

NORMAL_90 = 1.645
"""Half-width of the central 90 % of a normal distribution, in standard deviations: intervals without a calibration."""


FLOOR = 3.0
"""Floor of the scales, in medians of the calibration scenes. Scenes with a small scale have no smaller errors.

With a floor of 1, interval scores of 20 scenes of sand and 17 of elastomers were 1.5 and 1.7 times as large. Scenes with a scale far above the median still get
wide intervals.
"""


class FewScenesError(GpeError, ValueError):
    """Raised when calibration scenes are too few."""


class Pairs(NamedTuple):
    """Answers of scenes with a known truth, in coordinates of the unknown: the value or its logarithm."""

    estimate: Float64[np.ndarray, "scene"]
    truth: Float64[np.ndarray, "scene"]
    scale: Float64[np.ndarray, "scene"]


@dataclass(frozen=True)
class Calibration:
    """Correction and interval of one unknown.

    Attributes:
        offset, slope: the corrected answer is ``offset + slope · estimate``.
        factor: half-width of the interval, in units of ``|slope| · √(scale² + floor²)``.
        floor: ``FLOOR`` times the median scale of the calibration scenes. It keeps intervals from becoming narrow where one scene's scale is small by chance.
        num_scenes: number of calibration scenes; 0 if there was no calibration.
        level: nominal coverage.
    """

    offset: float = 0.0
    slope: float = 1.0
    factor: float = NORMAL_90
    floor: float = 0.0
    num_scenes: int = 0
    level: float = 0.9

    def interval(self, estimate: float, scale: float) -> tuple[float, float, float]:
        """Return the corrected answer and the ends of its interval, in coordinates."""
        center, half = self.offset + self.slope * estimate, self.factor * abs(self.slope) * float(np.hypot(scale, self.floor))
        return center, center - half, center + half


def intervals_without_own(pairs: Pairs, level: float = 0.9, adapts: bool = True) -> Float64[np.ndarray, "scene 3"]:
    """Return the corrected answer of each scene and the ends of its interval, calibrated on all other scenes; the arguments are those of ``calibrated``."""
    found = []
    for k, (estimate, _, scale) in enumerate(zip(*pairs, strict=True)):
        others = Pairs(*(np.delete(values, k) for values in pairs))
        found.append(calibrated(others, level, adapts).interval(float(estimate), float(scale) if adapts else 1.0))
    return np.array(found)


def calibrated(pairs: Pairs, level: float = 0.9, adapts: bool = True) -> Calibration:
    """Return the calibration from scenes with known truth.

    Args:
        pairs: answers of at least ``fewest_scenes(level)`` scenes.
        level: nominal coverage.
        adapts: take each scene's scale; False gives all scenes intervals of one width, for comparison.

    Raises:
        FewScenesError: there are too few scenes.
    """
    number, least = len(pairs.estimate), max(4, fewest_scenes(level))
    if number < least:
        raise FewScenesError(
            f"{number} calibration scenes; intervals of {100 * level:g} % need at least {least}: identify more scenes with known values"
        )
    floor = FLOOR * float(np.median(pairs.scale)) if adapts else 0.0
    scale = np.hypot(pairs.scale, floor) if adapts else np.ones(number)
    weight = scale**-2 / (scale**-2).sum()
    slope, offset = np.polyfit(pairs.estimate, pairs.truth, 1, w=1 / scale)
    centered = pairs.estimate - weight @ pairs.estimate
    leverage = weight * (1 + centered**2 / (weight @ centered**2))
    without_own = pairs.truth - (pairs.truth - offset - slope * pairs.estimate) / (1 - leverage)
    factor = conformal_factor(conformal_scores(without_own, pairs.truth, abs(slope) * scale), level)
    return Calibration(float(offset), float(slope), factor, floor, number, level)
