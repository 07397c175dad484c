"""Faults of trajectories whose values are valid, for which they are left out of training and evaluation."""

from __future__ import annotations

import numpy as np

from gpe_pl.data.statistics import FRAMES_AT_ONCE
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.trajectory import Trajectory

MAX_JUMP, MIN_RATIO = 2.0, 10.0
"""A node that moves more than MAX_JUMP connectivity radii in one frame, and more than MIN_RATIO times as far as in the frame before or after, marks corrupt
data."""


def damage(trajectory: Trajectory, stride: int = 1) -> str | None:
    """Return why nothing can be learned from a trajectory whose values are valid, with frame and node if there is one. None means that it can be used.

    Args:
        trajectory: trajectory with all stored frames.
        stride: number of stored frames in a frame of the model.
    """
    pos, metadata = trajectory.pos, trajectory.metadata
    if trajectory.num_nodes == 0:
        return "it has no nodes"
    if trajectory.alive is not None and (fault := _open_fault(trajectory, trajectory.alive)) is not None:
        return fault
    bounds = np.array(metadata.bounds)
    width = np.ptp(bounds, axis=1)
    low, high = (
        limits.astype(pos.dtype) for limits in (bounds[:, 0] - width, bounds[:, 1] + width)
    )  # converting positions instead would copy a long trajectory
    near = (pos >= low) & (pos <= high)
    if not near.all():
        frame, node = np.argwhere(~near)[0, :2]
        return f"the position of node {node} in frame {frame} lies outside the domain by more than its width"
    return _too_fast(trajectory, stride) or _jump(trajectory)


def _open_fault(trajectory: Trajectory, alive: np.ndarray) -> str | None:
    """Return why nothing can be learned from an open scene; None if it can be used."""
    if not alive.any(axis=1).all():
        return f"no node is in the scene in frame {int(alive.any(axis=1).argmin())}"
    if trajectory.stress is not None:
        return "its nodes enter and leave, and some have a stress"
    return None


def _too_fast(trajectory: Trajectory, stride: int) -> str | None:
    """Describe the first node that moves by half a period or more within ``stride`` stored frames, so that its direction is not known."""
    space = trajectory.metadata.periodicity
    if stride == 1 or not space or trajectory.num_frames <= stride:
        return None
    way = np.zeros(trajectory.pos.shape)
    np.cumsum(space.shortest(np.diff(trajectory.pos.astype(np.float64), axis=0)), axis=0, out=way[1:])
    for axis in space.axes:
        fast = np.abs(way[stride:, :, axis] - way[:-stride, :, axis]) >= 0.5 * space.period[axis]
        if fast.any():
            frame, node = np.argwhere(fast)[0]
            period = f"the period of {space.period[axis]:.3g} m along {'xyz'[axis]}"
            return f"with data.stride={stride}, node {node} moves by half or more of {period} in a frame, first in frame {frame + stride}"
    return None


def _jump(trajectory: Trajectory) -> str | None:
    """Describe the first node that moves farther than ``MAX_JUMP`` radii between two frames, but hardly moves before or after them; None if there is none.

    A node that is really fast is fast for several frames. A single corrupt frame would give the largest acceleration of the data set and distort its scale.
    """
    limit = MAX_JUMP * trajectory.metadata.connectivity_radius
    for start in range(0, trajectory.num_frames - 1, FRAMES_AT_ONCE):
        first = max(0, start - 1)
        pos = trajectory.pos[first : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        way = np.linalg.norm(integrators.velocities(pos, 1.0, trajectory.metadata.periodicity), axis=-1)
        before, after = np.full_like(way, np.inf), np.full_like(way, np.inf)
        before[1:], after[:-1] = way[:-1], way[1:]
        jumps = np.argwhere((way > limit) & (np.minimum(before, after) < way / MIN_RATIO))
        if len(jumps):
            frame, node = jumps[0]
            where = f"between frames {first + frame} and {first + frame + 1}"
            return f"node {node} jumps by {way[frame, node]:.3g} m {where}"
    return None
