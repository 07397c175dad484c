"""Deformation of rigid bodies."""

from __future__ import annotations

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.trajectory.rigid_bodies import bodies_of
from gpe_pl.trajectory.trajectory import Trajectory

MAX_COMPARED = 64
"""Maximum number of nodes of a body between which distances are compared; they are spread evenly over its rows."""
FRAMES_AT_ONCE = 100
"""Number of frames that are compared at a time, to save memory."""


def rigid_deformation(trajectory: Trajectory, num_steps: int) -> float:
    """Return the largest change of a distance inside a rigid body over frames 1 to ``num_steps``, relative to the size of the body.

    The size of a body is its largest distance in frame 0. Bodies of one node, or of nodes at one place, do not deform. In periodic domains, bodies must be
    narrower than half a period.
    """
    assert trajectory.rigid_body is not None
    largest, space = 0.0, trajectory.metadata.periodicity
    for rows in bodies_of(trajectory.rigid_body):
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, MAX_COMPARED).astype(int))]
        if len(rows) < 2:
            continue
        before = _distances(trajectory.pos[:1, rows], space)
        for start in range(1, num_steps + 1, FRAMES_AT_ONCE) if before.max() > 0 else ():
            after = _distances(trajectory.pos[start : min(start + FRAMES_AT_ONCE, num_steps + 1), rows], space)
            largest = max(largest, float(np.abs(after - before).max() / before.max()))
    return largest


def _distances(pos: np.ndarray, space: Periodicity) -> np.ndarray:
    """Return the distances [frame, pair] in m between all nodes of a body, given their positions [frame, node, dim]."""
    arm = space.shortest(pos.astype(np.float64) - pos[:, :1])
    first, second = np.triu_indices(pos.shape[1], 1)
    return np.asarray(np.linalg.norm(arm[:, first] - arm[:, second], axis=-1))
