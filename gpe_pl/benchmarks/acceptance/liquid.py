"""Acceptance of models of liquids: the level of a pool at rest, and the front of a dam break."""

from __future__ import annotations

from functools import partial

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import (
    Candidate,
    Result,
    advanced,
    at_most,
    centre,
    contained,
    follows_parameter,
    near_solver,
    not_above_solver,
    shown,
    tried,
)
from gpe_pl.trajectory.trajectory import Trajectory

SECONDS = 1.0
SURFACE = 0.95
"""Fraction of the particles below the height that counts as the level."""
MAX_LEVEL = 0.25
"""Largest difference of the level from the solver's, in spacings."""
MAX_SLOSH = 0.25
"""Largest sideways motion of the centre of mass of a pool at rest, in spacings."""
MAX_VOLUME = 5.0
"""Largest change of the height of the centre of mass above the lowest particle [%]. It measures the volume: in a vessel with vertical walls, both change by the
same fraction."""
FRONT_SECONDS = 0.3
FRONT_TOLERANCE = 0.15
OUTER = 0.02
"""Fraction of the particles that may be beyond the front, so that single drops do not count."""


def pool_at_rest(candidate: Candidate) -> Result:
    """Let a pool settle in the solver, and check whether it stays level in the model."""
    spec, value = candidate.spec, candidate.values[1]
    state = scenes.pool(spec, value, one_side=False)
    trial = tried(candidate, value, advanced(spec.solver, state, round(SECONDS / spec.solver.frame_dt)), SECONDS)
    own, solver, _ = trial.measured(level)
    checks = [
        at_most("pool at rest: level beside the solver's", [abs(own - solver) / candidate.spacing], MAX_LEVEL, " spacings"),
        not_above_solver("pool at rest: slosh", [trial.measured(slosh)], MAX_SLOSH, " spacings"),
        not_above_solver("pool at rest: change of volume", [trial.measured(volume_change)], MAX_VOLUME, " %"),
        contained("pool at rest", [trial]),
    ]
    return Result(checks, shown(candidate, [trial], 0.0, 0.25, 0.5, 0.75, 1.0))


def level(trajectory: Trajectory) -> float:
    """Return the height of the surface at the end [m]."""
    return float(np.quantile(trajectory.pos[-1, :, -1], SURFACE))


def slosh(trajectory: Trajectory) -> float:
    """Return the largest sideways motion of the centre of mass, in spacings."""
    way = centre(trajectory)[:, :-1]
    return float(np.linalg.norm(way - way[0], axis=-1).max()) / trajectory.metadata.spacing


def volume_change(trajectory: Trajectory) -> float:
    """Return the largest change of the height of the centre of mass above the lowest particle of the first frame [%]."""
    height = centre(trajectory)[:, -1] - float(trajectory.pos[0, :, -1].min())
    return 100 * float(np.abs(height / height[0] - 1).max())


def dam_break(candidate: Candidate) -> Result:
    """Simulate the collapse of a column of liquid at one side of the vessel. Check how far its front runs, against the solver and against the viscosity."""
    spec = candidate.spec
    trials = [tried(candidate, value, scenes.pool(spec, value, one_side=True), FRONT_SECONDS) for value in candidate.values]
    fronts = [trial.measured(partial(front, float(scenes.middle(spec)[0]))) for trial in trials]
    checks = [
        near_solver("dam break: way of the front", fronts, FRONT_TOLERANCE, 0.25 * candidate.spacing, " m"),
        *follows_parameter("dam break: way of the front over viscosity", fronts, " m"),
        contained("dam break", trials),
    ]
    return Result(checks, shown(candidate, trials, 0.5, 1.0))


def front(dam: float, trajectory: Trajectory) -> float:
    """Return how far the front is beyond x = ``dam`` at the end [m]."""
    return float(np.quantile(trajectory.pos[-1, :, 0], 1 - OUTER)) - dam
