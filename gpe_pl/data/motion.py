"""How nodes move from frame to frame, and what of it is rounding.

Positions that are rounded to multiples of q have the error q/√12 (rms, evenly spread over ±q/2). An acceleration is (x₂ − 2 x₁ + x₀)/Δt², so its error is

    q/√12 · √(1 + 4 + 1) / Δt² = q / (√2 Δt²)

where q is the distance of neighbouring floating-point numbers, which grows with the distance from the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gpe_pl import integrators
from gpe_pl.arrays import FRAMES_AT_ONCE
from gpe_pl.trajectory import Metadata

Precision = type[np.float16] | type[np.float32] | type[np.float64]
PRECISIONS: tuple[Precision, ...] = (np.float16, np.float32, np.float64)

ROUNDING_SHARE = 0.1
"""Share of the accelerations that rounding may be: a hundredth of their variance, which no model can learn."""


def rounding_of(farthest: np.ndarray, frame_dt: float, precision: Precision = np.float32) -> np.ndarray:
    """Error of accelerations [dim] in m/s², rms, where positions as far as ``farthest`` [dim] in m from the origin are rounded to a precision."""
    return np.spacing(np.abs(farthest).astype(precision)).astype(np.float64) / (math.sqrt(2) * frame_dt**2)


def rounding_fault(rounding: float, acceleration: float, precision: Precision = np.float32) -> str:
    """What to say where rounding is too large a part of the accelerations, both rms in m/s²; empty where it is not."""
    if rounding <= ROUNDING_SHARE * acceleration:
        return ""
    return (
        f"positions in {precision.__name__} round accelerations by {rounding:.3g} m/s², those of the data are {acceleration:.3g} m/s² rms"
    )


@dataclass(frozen=True)
class MotionSummary:
    """What is known of a trajectory's motion.

    Attributes:
        low, high: smallest and largest positions [dim] in m.
        frame_dt: time between frames [s].
        precision: the coarsest floating-point type that holds all positions, whatever type they came in.
        acceleration: rms without gravity [m/s²].
        mean_acceleration: mean without gravity [dim] in m/s².
        step: the farthest that a node moves between two frames [m]; it arrives in ``frame`` and is ``node``.
    """

    low: np.ndarray
    high: np.ndarray
    frame_dt: float
    precision: Precision
    acceleration: float
    mean_acceleration: np.ndarray
    step: float
    frame: int
    node: int

    def rounding(self, precision: Precision, origin: np.ndarray) -> np.ndarray:
        """Error of accelerations [dim] in m/s², rms, where positions are rounded in coordinates with this origin [dim] in m."""
        return rounding_of(np.maximum(np.abs(self.low - origin), np.abs(self.high - origin)), self.frame_dt, precision)

    def with_gravity(self, change: np.ndarray) -> MotionSummary:
        """The same with another gravity, which differs by ``change`` [dim] in m/s²."""
        squares = self.acceleration**2 + float(np.mean(change * (change - 2 * self.mean_acceleration)))
        return replace(self, acceleration=math.sqrt(max(squares, 0.0)), mean_acceleration=self.mean_acceleration - change)


def motion_of(m: Metadata, pos: np.ndarray) -> MotionSummary:
    """Measure the motion of a trajectory with these metadata and positions [frame, node, dim] of 3 frames or more, some frames at a time."""
    precisions = list(PRECISIONS)
    squares, total, farthest = 0.0, np.zeros(pos.shape[2]), (-1.0, 0, 0)
    for start in range(0, len(pos) - 2, FRAMES_AT_ONCE):
        window = pos[start : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        vel = integrators.velocities(window, m.frame_dt, m.periodicity)
        acc = integrators.acceleration(vel[1:], vel[:-1], m.frame_dt) - np.asarray(m.gravity)
        squares += float(np.sum(acc * acc))
        total += acc.sum(axis=(0, 1))
        step = np.linalg.norm(vel, axis=-1) * m.frame_dt
        frame, node = np.unravel_index(step.argmax(), step.shape)
        farthest = max(farthest, (float(step[frame, node]), start + int(frame) + 1, int(node)))
        with np.errstate(over="ignore"):  # what a type cannot hold, it does not hold exactly either
            precisions = [p for p in precisions if (window.astype(p) == window).all()]
    return MotionSummary(
        low=pos.min(axis=(0, 1)).astype(np.float64),
        high=pos.max(axis=(0, 1)).astype(np.float64),
        frame_dt=m.frame_dt,
        precision=precisions[0],
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
