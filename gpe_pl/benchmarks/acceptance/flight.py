"""Acceptance of all models: a body in free flight falls with g and keeps its sideways momentum."""

from __future__ import annotations

import math

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import Candidate, Result, at_most, centre, tried
from gpe_pl.trajectory.trajectory import Trajectory

SECONDS = 0.1
MAX_DRIFT = 1.0
"""Largest difference of momentum from that of free fall in any step, over the change that gravity causes [%]."""


def free_flight(candidate: Candidate) -> Result:
    """Throw a body in the middle of the domain and compare its momentum with the solver's, which is that of free fall."""
    spec, value = candidate.spec, candidate.values[1]
    trial = tried(candidate, value, scenes.thrown(spec, value), SECONDS)
    own = math.nan if trial.model.termination is not None else drift(trial.model, trial.truth)
    return Result([at_most("free flight: drift of momentum", [own], MAX_DRIFT, " % of gravity's")], [])


def drift(model: Trajectory, truth: Trajectory) -> float:
    """Return the largest difference of the momentum from that of the truth in any step, over the change of momentum that gravity causes in all steps [%]."""
    dt = truth.metadata.frame_dt
    apart = np.diff(centre(model) - centre(truth), axis=0) / dt
    caused = float(np.linalg.norm(truth.metadata.gravity)) * len(apart) * dt
    return 100 * float(np.linalg.norm(apart, axis=-1).max()) / caused
