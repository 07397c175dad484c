"""Horizons of an evaluation. They are times after the start of a rollout, so that models with frames of different lengths are compared at the same times."""

from __future__ import annotations

import math
from collections.abc import Sequence

FULL = "full"
"""Horizon at the last frame of the ground truth."""


def labels(seconds: Sequence[float], frame_dt: float) -> dict[int, str]:
    """Return a dictionary of the labels of horizons, whose keys are their numbers of frames.

    A horizon is at the frame nearest to the time, but at least at frame 1. Its label is the time of that frame: with frames of 0.02 s, the horizon 0.25 s
    becomes ``0.24s``. Times with the same nearest frame become one horizon.

    Args:
        seconds: times after the start [s].
        frame_dt: time between frames [s].
    """
    return {n: f"{n * frame_dt:.6g}s" for n in (max(1, round(time / frame_dt)) for time in seconds)}


def time_of(label: str) -> float:
    """Return the number by which labels are sorted: the time [s] in a label, infinity for ``full``, and the number of frames for labels of earlier versions.

    Raises:
        ValueError: the text is no label.
    """
    if label == FULL:
        return math.inf
    time = float(label) if label.isdecimal() else float(label.removesuffix("s")) if label.endswith("s") else math.nan
    if not 0 < time < math.inf:
        raise ValueError(f"horizon is {label!r}, must be a time such as 0.1s, a number of frames, or {FULL}")
    return time
