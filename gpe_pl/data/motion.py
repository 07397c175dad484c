"""How nodes move from frame to frame, and what of it is rounding.

Positions that are rounded to multiples of q have the error q/√12 (rms, evenly spread over ±q/2). An acceleration is (x₂ − 2 x₁ + x₀)/Δt², so its error is

    q/√12 · √(1 + 4 + 1) / Δt² = q / (√2 Δt²)

where q is the distance of neighbouring floating-point numbers, which grows with the distance from the origin, or of the marks on which a source has its
positions: a text file's last digit, a camera's pixels.
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

ROUNDING_SHARE = 0.1
"""Share of the accelerations that rounding may be: a hundredth of their variance, which no model can learn."""


ENOUGH_CHANGES = 100
"""Changes of velocity that tell marks from chance."""

CHANGES_PER_WINDOW = 20_000

OFF_MARK = 0.1
"""Fraction of the distance of marks by which second differences of positions on them may miss a multiple, for the rounding of floating-point numbers."""

ON_MARKS = 0.99
"""Fraction of changes that are such multiples; a node that crosses a seam may make another one."""


def rounding_to(step: np.ndarray, frame_dt: float) -> np.ndarray:
    """Error of accelerations [dim] in m/s², rms, where positions are rounded to multiples of ``step`` [dim] in m."""
    return step / (math.sqrt(2) * frame_dt**2)


def rounding_of(farthest: np.ndarray, frame_dt: float, precision: Precision = np.float32) -> np.ndarray:
    """Error of accelerations [dim] in m/s², rms, where positions as far as ``farthest`` [dim] in m from the origin are rounded to a precision."""
    return rounding_to(np.spacing(np.abs(farthest).astype(precision)).astype(np.float64), frame_dt)


def rounding_fault(rounding: float, acceleration: float, where: str = "in float32") -> str:
    """What to say where rounding of positions, ``where`` they are so, is too large a part of the accelerations, both rms in m/s²; empty where it is not."""
    if rounding <= ROUNDING_SHARE * acceleration:
        return ""
    return f"positions {where} round accelerations by {rounding:.3g} m/s², those of the data are {acceleration:.3g} m/s² rms"


def marks(changes: np.ndarray, rounding: float) -> float:
    """Distance [m] of the marks on which coordinates lie, 0 where there are none that floating-point numbers do not explain.

    Coordinates on marks have second differences that are multiples of their distance, of both signs: rounding has no direction, which gravity has.

    Args:
        changes: second differences from frame to frame [change] in m.
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
    """What is known of a trajectory's motion.

    Attributes:
        low, high: smallest and largest positions [dim] in m.
        frame_dt: time between frames [s].
        precision: the coarsest floating-point type that holds all positions, whatever type they came in.
        marks: distance of the marks on which positions lie [dim] in m, 0 where there are none coarser than ``precision``.
        acceleration: rms without gravity [m/s²].
        mean_acceleration: mean without gravity [dim] in m/s².
        step: the farthest that a node moves between two frames [m]; it arrives in ``frame`` and is ``node``.
    """

    low: np.ndarray
    high: np.ndarray
    frame_dt: float
    precision: Precision
    marks: np.ndarray
    acceleration: float
    mean_acceleration: np.ndarray
    step: float
    frame: int
    node: int

    def rounding(self, precision: Precision, origin: np.ndarray) -> np.ndarray:
        """Error of accelerations [dim] in m/s², rms, where positions are rounded in coordinates with this origin [dim] in m."""
        return rounding_of(np.maximum(np.abs(self.low - origin), np.abs(self.high - origin)), self.frame_dt, precision)

    @property
    def rounding_to_marks(self) -> np.ndarray:
        """Error of accelerations [dim] in m/s², rms, that a source's marks leave."""
        return rounding_to(self.marks, self.frame_dt)

    def with_gravity(self, change: np.ndarray) -> MotionSummary:
        """The same with another gravity, which differs by ``change`` [dim] in m/s²."""
        squares = self.acceleration**2 + float(np.mean(change * (change - 2 * self.mean_acceleration)))
        return replace(self, acceleration=math.sqrt(max(squares, 0.0)), mean_acceleration=self.mean_acceleration - change)


def motion_of(m: Metadata, pos: np.ndarray) -> MotionSummary:
    """Measure the motion of a trajectory with these metadata and positions [frame, node, dim] of 3 frames or more, some frames at a time."""
    precisions = list(PRECISIONS)
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
        with np.errstate(over="ignore"):  # what a type cannot hold, it does not hold exactly either
            precisions = [p for p in precisions if (window.astype(p) == window).all()]
    low, high = pos.min(axis=(0, 1)).astype(np.float64), pos.max(axis=(0, 1)).astype(np.float64)
    rounding = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(precisions[0])).astype(np.float64)
    return MotionSummary(
        low=low,
        high=high,
        frame_dt=m.frame_dt,
        precision=precisions[0],
        marks=np.array([marks(column, float(q)) for column, q in zip(np.concatenate(changes).T, rounding, strict=True)]),
        acceleration=math.sqrt(squares / pos[2:].size),
        mean_acceleration=total / (pos[2:].size / pos.shape[2]),
        step=farthest[0],
        frame=farthest[1],
        node=farthest[2],
    )


def better_origin(motions: list[MotionSummary], tolerance: float) -> np.ndarray:
    """The origin [dim] in m that stored positions need so that float32 rounds accelerations by no more than ``tolerance`` [m/s²].

    A round number near the middle of all positions, along axes where this helps positions that are finer than float32; 0 along the others.
    """
    low, high = np.min([m.low for m in motions], axis=0), np.max([m.high for m in motions], axis=0)
    nowhere, digits = np.zeros(len(low)), -math.ceil(math.log10((high - low).max()))
    middle = np.array([round(float(x), digits) for x in (low + high) / 2])
    helps = np.maximum(np.abs(low - middle), np.abs(high - middle)) < 0.5 * np.maximum(np.abs(low), np.abs(high))
    for m in motions:
        if m.precision is np.float64 and ((m.rounding(np.float32, nowhere) > tolerance) & helps).any():
            return np.where(helps, middle, 0.0)
    return nowhere
