"""How nodes move from frame to frame, and what of it is rounding.

Positions that are rounded to multiples of q have the error q/√12 (rms, evenly spread over ±q/2). An acceleration is (x₂ − 2 x₁ + x₀)/Δt², so its error is

    q/√12 · √(1 + 4 + 1) / Δt² = q / (√2 Δt²)

where q is the distance of neighbouring floating-point numbers, which grows with the distance from the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpe_pl import integrators
from gpe_pl.arrays import FRAMES_AT_ONCE
from gpe_pl.trajectory import Trajectory

Precision = type[np.float16] | type[np.float32] | type[np.float64]
PRECISIONS: tuple[Precision, ...] = (np.float16, np.float32, np.float64)


@dataclass(frozen=True)
class MotionSummary:
    """What is known of a trajectory's motion.

    Attributes:
        low, high: smallest and largest positions [dim] in m.
        frame_dt: time between frames [s].
        precision: the coarsest floating-point type that holds all positions, whatever type they came in.
        acceleration: rms without gravity [m/s²].
        step: the farthest that a node moves between two frames [m]; it arrives in ``frame`` and is ``node``.
    """

    low: np.ndarray
    high: np.ndarray
    frame_dt: float
    precision: Precision
    acceleration: float
    step: float
    frame: int
    node: int

    def rounding(self, precision: Precision, origin: np.ndarray) -> np.ndarray:
        """Error of accelerations [dim] in m/s², rms, where positions are rounded in coordinates with this origin [dim] in m."""
        farthest = np.maximum(np.abs(self.low - origin), np.abs(self.high - origin))
        return np.spacing(farthest.astype(precision)).astype(np.float64) / (math.sqrt(2) * self.frame_dt**2)


def motion_of(trajectory: Trajectory) -> MotionSummary:
    """Measure a trajectory, some frames at a time."""
    m, pos = trajectory.metadata, trajectory.pos
    precisions = list(PRECISIONS)
    squares, farthest = 0.0, (-1.0, 0, 0)
    for start in range(0, trajectory.num_frames - 2, FRAMES_AT_ONCE):
        window = pos[start : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        vel = integrators.velocities(window, m.frame_dt, m.periodicity)
        acc = integrators.acceleration(vel[1:], vel[:-1], m.frame_dt) - np.asarray(m.gravity)
        squares += float(np.sum(acc * acc))
        step = np.linalg.norm(vel, axis=-1) * m.frame_dt
        frame, node = np.unravel_index(step.argmax(), step.shape)
        farthest = max(farthest, (float(step[frame, node]), start + int(frame) + 1, int(node)))
        with np.errstate(over="ignore"):  # what a type cannot hold, it does not hold exactly either
            precisions = [p for p in precisions if (window.astype(p) == window).all()]
    acceleration = math.sqrt(squares / pos[2:].size)
    return MotionSummary(
        pos.min(axis=(0, 1)).astype(np.float64), pos.max(axis=(0, 1)).astype(np.float64), m.frame_dt, precisions[0], acceleration, *farthest
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
