"""Positions far from 0 in coordinates in which float32 holds them."""

from __future__ import annotations

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity

COARSE = 1e-6
"""Distance of neighbouring float32 numbers, as a fraction of the width of all nodes, above which positions need another origin."""


def coarse_axes(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Tell for each axis whether neighbouring float32 numbers are too far apart (``COARSE``) for positions from ``low`` to ``high`` [dim] in m."""
    width = (high - low).max()
    return np.asarray(np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(np.float32)) > COARSE * width)


def round_middle(low: np.ndarray, high: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """Return the multiple of a power of ten, or of a period that is not 0, nearest to the middle of ``low`` and ``high``; all [dim] in m."""
    step = np.where(periods > 0, periods, 10.0 ** np.ceil(np.log10((high - low).max())))
    return np.asarray(step * np.rint((low + high) / 2 / step))


def near_origin(rest_pos: np.ndarray, pos: np.ndarray, periodicity: Periodicity) -> np.ndarray:
    """Return rest positions [node, dim] in m, moved along each axis along which they are far from 0 and from all positions.

    Stored rest positions are float32, which is most precise near 0. Differences of rest positions matter, so they may have an origin of their own; only the
    layer of walls of the elastic law takes their distance from walls. Those
    in the same coordinates as positions keep these: ``Trajectory.seen_from`` moves both, and their difference is the displacement.

    Args:
        rest_pos: undeformed positions [node, dim] in m.
        pos: positions [frame, node, dim] in m.
        periodicity: axes along which space repeats; along these, rest positions move by whole periods.
    """
    rest = rest_pos.astype(np.float64)
    low, high = rest.min(axis=0), rest.max(axis=0)
    if (low == high).all():
        return rest_pos
    is_apart = (low > pos.max(axis=(0, 1))) | (high < pos.min(axis=(0, 1)))
    is_coarse = coarse_axes(low, high)
    is_finer = (rest.astype(np.float32) != rest).any(axis=0)
    periods = periodicity.period if periodicity else np.zeros(len(low))
    return rest - np.where(is_apart & is_coarse & is_finer, round_middle(low, high, periods), 0.0)
