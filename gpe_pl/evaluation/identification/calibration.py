"""Calibration of intervals on scenes with known unknowns, so that they have a guaranteed coverage.

An interval contains all values whose misfit is at most a threshold above the smallest one (``profile``), as in intervals from a likelihood ratio. Scenes whose
motion says little about an unknown have a flat curve, and so a wide interval. The threshold is split conformal (``metrics.conformal``): the score of a
calibration scene is the misfit of its true value, above the smallest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.metrics.conformal import conformal_factor, fewest_scenes

ROUGH = 0.2
"""Threshold without a calibration: mean squared displacements are larger by a fifth. It is right for some models, and wrong for others."""


class FewScenesError(GpeError, ValueError):
    """Raised when calibration scenes are too few."""


@dataclass(frozen=True)
class Known:
    """Answer for an unknown with a known true value, in its coordinate: the value or its logarithm."""

    estimate: float
    truth: float
    profile: Profile


@dataclass(frozen=True)
class Calibration:
    """Width of the intervals of one unknown.

    Attributes:
        threshold: largest misfit above the smallest within an interval.
        num_scenes: number of calibration scenes; 0 if there was no calibration.
        level: nominal coverage.
    """

    threshold: float = ROUGH
    num_scenes: int = 0
    level: float = 0.9


def calibrated(known: Sequence[Known], level: float = 0.9) -> Calibration:
    """Return the calibration from scenes with known truth.

    Raises:
        FewScenesError: there are fewer than ``fewest_scenes(level)``.
    """
    least = fewest_scenes(level)
    if len(known) < least:
        raise FewScenesError(
            f"{len(known)} calibration scenes; intervals of {100 * level:g} % need at least {least}: identify more scenes with known values"
        )
    return Calibration(conformal_factor([own.profile.above(own.truth) for own in known], level), len(known), level)


def cross_calibrated(
    known: Sequence[Known], parts: Int[np.ndarray, "scene"], level: float = 0.9, adapts: bool = True
) -> Float64[np.ndarray, "scene 2"]:
    """Return the ends of the interval of each scene, calibrated on all scenes that are not in its part.

    Args:
        known: the scenes.
        parts: number of the part of each scene.
        level: nominal coverage.
        adapts: let widths follow each scene's profile. False gives all scenes one width, the quantile of the absolute errors, for comparison.

    Raises:
        FewScenesError: scenes are too few.
    """
    ends = np.empty((len(known), 2))
    for part in np.unique(parts):
        others = [own for own, number in zip(known, parts, strict=True) if number != part]
        calibration = calibrated(others, level)
        width = conformal_factor([abs(own.truth - own.estimate) for own in others], level)
        for k in np.flatnonzero(parts == part).tolist():
            center = known[k].estimate
            ends[k] = known[k].profile.within(calibration.threshold) if adapts else (center - width, center + width)
    return ends
