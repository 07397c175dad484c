"""Acceptance of all models: a body in free flight falls with g and keeps its sideways momentum."""

from __future__ import annotations

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import Candidate, Result, at_most, centre, tried
from gpe_pl.trajectory.trajectory import Trajectory

SECONDS = 0.1
MAX_DRIFT = 1.0
"""Largest change of momentum that gravity does not explain, over the change that gravity causes [%]."""


def free_flight(candidate: Candidate) -> Result:
    """Throw a body in the middle of the domain and compare its momentum with that of free fall."""
    spec, value = candidate.spec, candidate.values[1]
    own, _, _ = tried(candidate, value, scenes.thrown(spec, value), SECONDS).measured(drift)
    return Result([at_most("free flight: drift of momentum", [own], MAX_DRIFT, " % of gravity's")], [])


def drift(trajectory: Trajectory) -> float:
    """Return the change of momentum that gravity does not explain between the first and the last frame, over the change that gravity causes [%]."""
    dt, gravity = trajectory.metadata.frame_dt, np.asarray(trajectory.metadata.gravity)
    velocity = np.diff(centre(trajectory), axis=0) / dt
    change = velocity[-1] - velocity[0]
    expected = gravity * (len(velocity) - 1) * dt
    return 100 * float(np.linalg.norm(change - expected) / np.linalg.norm(expected))
