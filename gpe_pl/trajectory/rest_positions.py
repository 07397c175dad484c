"""Undeformed positions of meshes in coordinates in which float32 holds them."""

from __future__ import annotations

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity

COARSE = 1e-6
"""Distance of neighbouring float32 numbers, as a fraction of the width of all meshes, above which rest positions get another origin."""


def near_origin(rest_pos: np.ndarray, pos: np.ndarray, periodicity: Periodicity) -> np.ndarray:
    """Return rest positions [node, dim] in m, moved along each axis along which they are far from 0 and from all positions.

    Stored rest positions are float32, which is most precise near 0. Only differences of rest positions matter, so they may have an origin of their own. Those
    in the same coordinates as positions keep these: ``Trajectory.seen_from`` moves both, and their difference is the displacement.

    Args:
        rest_pos: undeformed positions [node, dim] in m.
        pos: positions [frame, node, dim] in m.
        periodicity: axes along which space repeats; along these, rest positions move by whole periods.
    """
    rest = rest_pos.astype(np.float64)
    low, high = rest.min(axis=0), rest.max(axis=0)
    width = float((high - low).max())
    if width == 0:
        return rest_pos
    is_apart = (low > pos.max(axis=(0, 1))) | (high < pos.min(axis=(0, 1)))
    is_coarse = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(np.float32)) > COARSE * width
    is_finer = (rest.astype(np.float32) != rest).any(axis=0)
    step = np.full(len(low), 10.0 ** np.ceil(np.log10(width)))
    if periodicity:
        step = np.where(periodicity.period > 0, periodicity.period, step)
    origin = step * np.rint((low + high) / 2 / step)
    return rest - np.where(is_apart & is_coarse & is_finer, origin, 0.0)
