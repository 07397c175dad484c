"""Deformation of rigid bodies."""

from __future__ import annotations

import numpy as np

from gpe_pl.trajectory.rigid_bodies import bodies_of
from gpe_pl.trajectory.trajectory import Trajectory

MAX_COMPARED = 64
"""Maximum number of nodes of a body between which distances are compared; they are spread evenly over its rows."""


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
        pos = trajectory.pos[: num_steps + 1, rows].astype(np.float64)
        pos = pos[:, :1] + space.shortest(pos - pos[:, :1])
        first, second = np.triu_indices(len(rows), 1)
        distances = np.linalg.norm(pos[:, first] - pos[:, second], axis=-1)
        if (size := distances[0].max()) > 0:
            largest = max(largest, float(np.abs(distances[1:] - distances[0]).max() / size))
    return largest
