"""Trajectories that are left out, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.data.damage import damage
from gpe_pl.trajectory.trajectory import Trajectory

DT = 0.01


def flying(speed: float, num_frames: int = 12) -> Trajectory:
    """Return two nodes that cross a domain of 1 m, periodic along x, at a speed [m/s]."""
    pos = np.tile([[0.1, 0.2], [0.1, 0.4]], (num_frames, 1, 1))
    pos[:, 1, 0] += speed * DT * np.arange(num_frames)
    pos[..., 0] %= 1.0
    found = Trajectory.from_numpy(
        pos, DT, "sand", {"sand": 30.0}, bounds=[(0, 1), (0, 1)], gravity=[0.0, 0.0], spacing=0.1, connectivity_radius=0.3
    )
    return replace(found, metadata=replace(found.metadata, periodic=(True, False)))


@pytest.mark.parametrize("speed", [15.0, -15.0])
def test_a_node_whose_direction_is_unknown_in_longer_frames(speed: float) -> None:
    trajectory = flying(speed)
    assert damage(trajectory) is None
    assert damage(trajectory, stride=3) is None
    found = "with data.stride=4, node 1 moves by half or more of the period of 1 m along x in a frame, first in frame 4"
    assert damage(trajectory, stride=4) == found
