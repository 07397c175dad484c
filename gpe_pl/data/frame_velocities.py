"""Whether stored velocities are those at the frames, from which the elastic law starts, or mean velocities over the last frame."""

from __future__ import annotations

import logging
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpe_pl.trajectory.arrays import velocities_of
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from gpe_pl.learned.simulator import LearnedSimulator

log = logging.getLogger(__name__)

NUM_FRAMES = 50
"""Number of first frames that are compared."""
NUM_SCENES = 3
"""Number of first trajectories of a split that are compared."""
EQUAL = 0.1
"""Difference from mean velocities, as a fraction of that of the velocities at the frames, below which velocities are mean ones."""

ADVICE = (
    "velocities are means over the frame before, which differ from those at the frames by half of what changes in a frame (in free fall g·dt/2); "
    "the elastic law starts from those at the frames: give vel=…"
)


def are_means(trajectory: Trajectory) -> bool:
    """Return whether the velocities of a mesh are differences of positions. Where nothing accelerates, both are the same, and the answer is false."""
    if trajectory.cells is None or not len(trajectory.cells):
        return False
    m, first = trajectory.metadata, trajectory.frames(0, NUM_FRAMES)
    means = velocities_of(first.pos, m.frame_dt, m.periodicity)[1:].astype(np.float64)
    to_frame = 0.5 * np.diff(means, axis=0)  # from a mean to the velocity at the end of its frame
    difference = first.vel[2:] - means[1:]
    return bool(np.square(difference).sum() < EQUAL**2 * np.square(to_frame).sum())


def warn_of_means(simulator: LearnedSimulator, root: Path, split: str) -> None:
    """Warn if a model with the elastic law meets a split whose velocities are mean ones.

    Args:
        simulator: the model.
        root: folder of the data set.
        split: split whose first trajectories are looked at.
    """
    if not simulator.model.settings.get("elastic"):
        return
    if any(map(are_means, islice(iter_trajectories(root, split), NUM_SCENES))):
        log.warning("law=elastic: %s: %s", root, ADVICE)
