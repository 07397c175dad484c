"""Scale of the error of an answer: how much the answers of single windows differ.

Each block of frames has a misfit of its own, with slope g_b at the answer; the mean of all has curvature H. If blocks are independent samples, the answer
has the variance Σ_b (g_b - ḡ)² / (B² H²) (the sandwich estimator, for each unknown alone). The scale says how certain one scene is compared with others.
Calibration on scenes with known answers turns it into an interval.

Source: White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gpe_pl.evaluation.identification.shooting import Shooting

STEP = 0.04
"""Step of the differences, as a fraction of the range between the bounds."""
SMALLEST, LARGEST = 0.005, 0.5
"""Smallest and largest scale, as a fraction of the range. The largest stands for a misfit without a minimum."""


def spread(shooting: Shooting, z: Float64[np.ndarray, "unknown"]) -> Float64[np.ndarray, "unknown"]:
    """Return the scale of each unknown's error at an answer, as a fraction of the range between its bounds."""
    scales = np.empty(len(z))
    for k in range(len(z)):
        center = z.copy()
        center[k] = np.clip(z[k], STEP, 1 - STEP)
        step = STEP * np.eye(len(z))[k]
        before, here, after = (shooting.block_misfits(center + sign * step) for sign in (-1, 0, 1))
        slope, curvature = (after - before) / (2 * STEP), float((after - 2 * here + before).mean()) / STEP**2
        deviation = float(np.sqrt(((slope - slope.mean()) ** 2).sum())) / len(slope)
        scales[k] = np.clip(deviation / curvature, SMALLEST, LARGEST) if curvature > 0 and len(slope) > 1 else LARGEST
    return scales
