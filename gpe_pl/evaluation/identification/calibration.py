"""Calibration of intervals on scenes with known unknowns, so that they have a guaranteed coverage.

An interval contains all values whose misfit is at most a threshold above the smallest one (``profile``), as in intervals from a likelihood ratio. Scenes whose
motion says little about an unknown have a flat curve, and so a wide interval.

A model that answers too low for every scene is corrected by ``truth ≈ a + b · answer``, a line in the coordinate of the unknown. It moves the ends of
intervals, too. It is fitted by repeated medians (Siegel, Biometrika 69, 1982), because some answers are far off, such as those at a bound of the search. Least
squares would let them spoil the correction of all others.

The threshold is split conformal (``metrics.conformal``). The score of a calibration scene is the misfit above the smallest of the answer that would have been
corrected to its true value. Its line is fitted without the scene, so no scene corrects its own answer. Bodies of one scene are not independent, so a scene
counts once, with the largest score of its bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.stats import siegelslopes

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.metrics.conformal import conformal_factor, fewest_scenes

ROUGH = 0.2
"""Threshold without a calibration: mean squared displacements are larger by a fifth. It is right for some models, and wrong for others."""


class FewScenesError(GpeError, ValueError):
    """Raised when calibration scenes are too few."""


@dataclass(frozen=True)
class Known:
    """Answer for an unknown with a known true value, in its coordinate: the value or its logarithm. A scene has several answers if it has several bodies."""

    estimate: float
    truth: float
    profile: Profile
    scene: str


@dataclass(frozen=True)
class Calibration:
    """Correction and intervals of one unknown.

    Attributes:
        offset, slope: the corrected answer is ``offset + slope · answer``.
        threshold: largest misfit above the smallest within an interval. It is infinite if too many calibration scenes have true values beyond the bounds.
        num_scenes: number of calibration scenes; 0 if there was no calibration.
        level: nominal coverage.
    """

    offset: float = 0.0
    slope: float = 1.0
    threshold: float = ROUGH
    num_scenes: int = 0
    level: float = 0.9

    def interval(self, estimate: float, profile: Profile) -> tuple[float, float, float]:
        """Return the corrected answer and the ends of its interval, in the coordinate. They are infinite if the threshold is."""
        ends = profile.within(self.threshold) if np.isfinite(self.threshold) else (-np.inf, np.inf)
        center, low, high = (self.offset + self.slope * end for end in (estimate, *ends))
        return center, low, high


def calibrated(known: Sequence[Known], level: float = 0.9) -> Calibration:
    """Return the calibration from scenes with known truth.

    Raises:
        FewScenesError: there are fewer than ``fewest_scenes(level)``.
    """
    least, number = fewest_scenes(level), len({own.scene for own in known})
    if number < least:
        raise FewScenesError(
            f"{number} calibration scenes; intervals of {100 * level:g} % need at least {least}: identify more scenes with known values"
        )
    scores = _scores(known, lambda own, offset, slope: own.profile.above((own.truth - offset) / slope))
    return Calibration(*_line(known), conformal_factor(scores, level), number, level)


def cross_calibrated(
    known: Sequence[Known], parts: Int[np.ndarray, "scene"], level: float = 0.9, adapts: bool = True
) -> Float64[np.ndarray, "scene 3"]:
    """Return the corrected answer of each scene and the ends of its interval, calibrated on all scenes that are not in its part.

    Args:
        known: the answers.
        parts: number of the part of each answer; those of one scene belong to one part.
        level: nominal coverage.
        adapts: let widths follow each scene's profile. False gives all scenes one width, the quantile of the absolute errors, for comparison.

    Raises:
        FewScenesError: scenes are too few.
    """
    found = np.empty((len(known), 3))
    for part in np.unique(parts):
        others = [own for own, number in zip(known, parts, strict=True) if number != part]
        calibration = calibrated(others, level)
        width = _width(others, level)
        for k in np.flatnonzero(parts == part).tolist():
            center, *ends = calibration.interval(known[k].estimate, known[k].profile)
            found[k] = (center, *ends) if adapts else (center, center - width, center + width)
    return found


def _width(known: Sequence[Known], level: float) -> float:
    """Return the half-width of intervals of one width around corrected answers."""
    return conformal_factor(_scores(known, lambda own, offset, slope: abs(own.truth - offset - slope * own.estimate)), level)


def _scores(known: Sequence[Known], score: Callable[[Known, float, float], float]) -> list[float]:
    """Return the largest score of each scene, a function of an answer and of offset and slope of the line through the other scenes."""
    found = []
    for scene in dict.fromkeys(own.scene for own in known):
        line = _line([own for own in known if own.scene != scene])
        found.append(max(score(own, *line) for own in known if own.scene == scene))
    return found


def _line(known: Sequence[Known]) -> tuple[float, float]:
    """Return offset and slope of the correction. There is none if the true values do not rise with the answers."""
    estimate, truth = (np.array([getattr(own, name) for own in known]) for name in ("estimate", "truth"))
    if np.ptp(estimate) == 0:
        return float(np.mean(truth - estimate)), 1.0
    slope, offset = siegelslopes(truth, estimate)
    return (float(offset), float(slope)) if slope > 0 else (0.0, 1.0)
