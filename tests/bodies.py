"""Two bodies that fall, bend and bounce in a known way."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Trajectory

FRAMES, SPACING, DT = 12, 0.05, 0.01


def lattice() -> np.ndarray:
    return SPACING * np.stack(np.meshgrid(np.arange(5), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 2)


def cells() -> np.ndarray:
    number = np.arange(15).reshape(5, 3)
    lower = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:]], axis=-1).reshape(-1, 3)
    return np.concatenate([lower, np.stack([number[:-1, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 3)])


def path(stretch: float = 0.1, bounce: float = 0.5, turned: float = 0.0, length: float = 1.0, time: float = 1.0) -> Trajectory:
    """Two bodies that fall onto the floor, stretch sideways in frames 4 to 8 and bounce.

    Args:
        stretch: largest strain.
        bounce: speed after the contact over that before.
        turned: rotation of both bodies [deg].
        length, time: units.
    """
    phase = np.clip((np.arange(FRAMES) - 4) / 4, 0, 1)
    strain = stretch * np.sin(math.pi * phase)
    fall = np.where(np.arange(FRAMES) < 5, 5 - np.arange(FRAMES), np.maximum(0, np.arange(FRAMES) - 7) * bounce) * SPACING
    rest, angle = lattice(), math.radians(turned)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = rest.mean(axis=0)
    frames = ((rest - middle) * (1 + strain[:, None, None] * [1.0, 0.0])) @ turn.T + middle
    frames = frames + (0.02 + fall[:, None, None]) * [0.0, 1.0]
    pos = np.concatenate([frames + np.array([x, 0.0]) for x in (0.1, 0.6)], axis=1) * length
    bounds = ((0.0, length), (0.0, length))
    made = Trajectory.from_numpy(
        pos, DT * time, "solid", {"solid": 1e6 / length / time**2}, gravity=np.array([0.0, -9.81]) * length / time**2, bounds=bounds,
        boundary=Boundary.sample(domain_walls(bounds, 0.3), SPACING * length, 2), spacing=SPACING * length,
        cells=np.concatenate([cells(), cells() + 15]), rest_pos=np.concatenate([rest, rest]) * length,
    )  # fmt: skip
    return replace(made, metadata=replace(made.metadata, config=json.dumps({"solver": {"poisson_ratio": 0.3}})))
