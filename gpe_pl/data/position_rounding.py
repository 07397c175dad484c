"""Motion of nodes from frame to frame, and the error of accelerations due to rounding of positions.

Positions that are rounded to multiples of q have the error q/√12 (rms, uniform in ±q/2). An acceleration is (x₂ − 2 x₁ + x₀)/Δt², so its error is

    q/√12 · √(1 + 4 + 1) / Δt² = q / (√2 Δt²)

For floating-point positions, q is the distance of neighbouring numbers, which grows with the distance from the origin. The positions of some sources are
multiples of a coarser step, such as the last digit in a text file or the pixel of a camera. This module calls that step the distance of marks, like the marks
on a ruler; q is then that distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.arrays import FRAMES_AT_ONCE
from gpe_pl.trajectory.trajectory import Metadata

Precision = type[np.float16] | type[np.float32] | type[np.float64]
PRECISIONS: tuple[Precision, ...] = (np.float16, np.float32, np.float64)

ROUNDING_FRACTION = 0.1
"""Largest acceptable rounding error of accelerations, as a fraction of the accelerations. At this limit, a hundredth of their variance is rounding, which no
model can learn."""


ENOUGH_CHANGES = 100
"""Fewest non-zero velocity changes from which marks are inferred; with fewer, multiples could be chance."""

CHANGES_PER_WINDOW = 20_000
"""Maximum number of velocity changes that are sampled from each part of the frames."""

OFF_MARK = 0.1
"""A second difference of positions counts as a multiple of the distance of marks if it deviates by at most this fraction of the distance, due to rounding."""

ON_MARKS = 0.99
"""Fraction of second differences that must be multiples of the distance of marks. A node that crosses the seam of a periodic domain may give another value."""


def rounding_to(step: np.ndarray, frame_dt: float) -> np.ndarray:
    """Return the rms error of accelerations [dim] in m/s² if positions are rounded to multiples of ``step`` [dim] in m."""
    return step / (math.sqrt(2) * frame_dt**2)


def rounding_of(farthest: np.ndarray, frame_dt: float, precision: Precision = np.float32) -> np.ndarray:
    """Return the rms error of accelerations [dim] in m/s² if positions at most ``farthest`` [dim] in m from the origin are rounded to a precision."""
    return rounding_to(np.spacing(np.abs(farthest).astype(precision)).astype(np.float64), frame_dt)


def rounding_fault(rounding: float, acceleration: float, where: str = "in float32") -> str:
    """Describe a rounding error of accelerations that is too large; empty if it is acceptable.

    Args:
        rounding: rms error of accelerations due to rounding of positions [m/s²].
        acceleration: rms acceleration of the data [m/s²].
        where: how positions are rounded, for the message.
    """
    if rounding <= ROUNDING_FRACTION * acceleration:
        return ""
    return f"positions {where} round accelerations by {rounding:.3g} m/s², those of the data are {acceleration:.3g} m/s² rms"


def marks(changes: np.ndarray, rounding: float) -> float:
    """Return the distance of marks [m]: the coarsest step of which coordinates are multiples. Return 0 if it is not coarser than floating-point numbers.

    Second differences of coordinates on marks are multiples of this step. They have both signs, because rounding has no direction, unlike gravity.

    Args:
        changes: second differences of coordinates from frame to frame [change] in m.
        rounding: distance of neighbouring floating-point numbers [m].
    """
    changes = changes[np.abs(changes) > 16 * rounding]
    if len(changes) < ENOUGH_CHANGES or (changes > 0).all() or (changes < 0).all():
        return 0.0
    step = float(np.abs(changes).min())
    step = float(np.median(np.abs(changes)[np.abs(changes) < 1.5 * step]))
    multiples = changes / step
    return step if (np.abs(multiples - np.rint(multiples)) < OFF_MARK).mean() > ON_MARKS else 0.0


@dataclass(frozen=True)
class MotionSummary:
    """Summary of a trajectory's motion.

    Attributes:
        low, high: smallest and largest positions [dim] in m.
        frame_dt: time between frames [s].
        precision: coarsest floating-point type that represents all positions exactly, independent of the array's type.
        is_whole: whether all positions are whole numbers.
        marks: distance of marks [dim] in m (see ``marks``); 0 if there are none coarser than ``precision``.
        acceleration: rms per component of accelerations without gravity [m/s²].
        mean_acceleration: mean acceleration without gravity [dim] in m/s².
        step: largest displacement of a node between two frames [m].
        frame: frame in which this displacement ends.
        node: node of this displacement.
    """

    low: np.ndarray
    high: np.ndarray
    frame_dt: float
    precision: Precision
    is_whole: bool
    marks: np.ndarray
    acceleration: float
    mean_acceleration: np.ndarray
    step: float
    frame: int
    node: int

    def rounding(self, precision: Precision, origin: np.ndarray) -> np.ndarray:
        """Return the rms error of accelerations [dim] in m/s² if positions are rounded to a precision in coordinates with this origin [dim] in m."""
        return rounding_of(np.maximum(np.abs(self.low - origin), np.abs(self.high - origin)), self.frame_dt, precision)

    @property
    def rounding_to_marks(self) -> np.ndarray:
        """Rms error of accelerations [dim] in m/s² due to rounding to marks."""
        return rounding_to(self.marks, self.frame_dt)

    def with_gravity(self, change: np.ndarray) -> MotionSummary:
        """Return the summary for another gravity. ``change`` [dim] is the new gravity minus the old one in m/s²."""
        squares = self.acceleration**2 + float(np.mean(change * (change - 2 * self.mean_acceleration)))
        return replace(self, acceleration=math.sqrt(max(squares, 0.0)), mean_acceleration=self.mean_acceleration - change)


def motion_of(m: Metadata, pos: np.ndarray) -> MotionSummary:
    """Measure the motion of a trajectory of at least 3 frames, a part of the frames at a time.

    Args:
        m: metadata of the trajectory.
        pos: positions [frame, node, dim] in m.
    """
    precisions, is_whole = list(PRECISIONS), True
    squares, total, farthest = 0.0, np.zeros(pos.shape[2]), (-1.0, 0, 0)
    changes: list[np.ndarray] = []
    for start in range(0, len(pos) - 2, FRAMES_AT_ONCE):
        window = pos[start : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        vel = integrators.velocities(window, m.frame_dt, m.periodicity)
        acc = integrators.acceleration(vel[1:], vel[:-1], m.frame_dt)
        every = acc.reshape(-1, pos.shape[2]) * m.frame_dt**2
        changes.append(every[:: -(-len(every) // CHANGES_PER_WINDOW)])
        acc = acc - np.asarray(m.gravity)
        squares += float(np.sum(acc * acc))
        total += acc.sum(axis=(0, 1))
        step = np.linalg.norm(vel, axis=-1) * m.frame_dt
        frame, node = np.unravel_index(step.argmax(), step.shape)
        farthest = max(farthest, (float(step[frame, node]), start + int(frame) + 1, int(node)))
        with np.errstate(over="ignore"):  # an overflow counts as not exact
            precisions = [p for p in precisions if (window.astype(p) == window).all()]
        is_whole &= bool((window == np.rint(window)).all())
    low, high = pos.min(axis=(0, 1)).astype(np.float64), pos.max(axis=(0, 1)).astype(np.float64)
    rounding = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(precisions[0])).astype(np.float64)
    return MotionSummary(
        low=low,
        high=high,
        frame_dt=m.frame_dt,
        precision=precisions[0],
        is_whole=is_whole,
        marks=np.array([marks(column, float(q)) for column, q in zip(np.concatenate(changes).T, rounding, strict=True)]),
        acceleration=math.sqrt(squares / pos[2:].size),
        mean_acceleration=total / (pos[2:].size / pos.shape[2]),
        step=farthest[0],
        frame=farthest[1],
        node=farthest[2],
    )


def better_origin(motions: list[MotionSummary], tolerance: float) -> np.ndarray:
    """Choose an origin [dim] in m of stored positions at which float32 rounds accelerations less.

    The origin is 0 unless the positions of a trajectory are finer than float32 and their rounding error exceeds ``tolerance`` [m/s²] along an axis where a
    new origin helps. It is then a round number near the middle of all positions along every axis where that more than halves the largest coordinate.
    """
    low, high = np.min([m.low for m in motions], axis=0), np.max([m.high for m in motions], axis=0)
    nowhere, digits = np.zeros(len(low)), -math.ceil(math.log10((high - low).max()))
    middle = np.array([round(float(x), digits) for x in (low + high) / 2])
    helps = np.maximum(np.abs(low - middle), np.abs(high - middle)) < 0.5 * np.maximum(np.abs(low), np.abs(high))
    for m in motions:
        if m.precision is np.float64 and ((m.rounding(np.float32, nowhere) > tolerance) & helps).any():
            return np.where(helps, middle, 0.0)
    return nowhere
