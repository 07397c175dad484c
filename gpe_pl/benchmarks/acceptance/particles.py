"""Acceptance of models of sand and snow: a column that collapses, a pile at rest, one that is too steep, a ball of snow on a cylinder, and released blocks."""

from __future__ import annotations

from dataclasses import replace
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
    of_size,
    shown,
    tried,
    tried_from_rest,
)
from gpe_pl.metrics import energy_distance
from gpe_pl.trajectory.trajectory import Trajectory

SECONDS = 1.0
COLUMNS, ROWS = 16, 13
RUN_OUT_TOLERANCE = 0.15
OUTER = 0.02
"""Fraction of particles left out on each side where a width is measured, so that single grains do not count."""
MAX_CREEP = 0.1
"""Largest rms displacement of a pile at rest, in spacings per second. The stability suite allows a node this many spacings in 1,000 frames."""
MAX_SINKING = 5.0
"""Largest change of a pile's height [%]."""
BALL_RADIUS, CYLINDER, SPEED = 8, 0.1, 2.0
"""Radius of the ball [spacings] and of the cylinder [m], and speed of the ball [m/s]."""
MAX_IMBALANCE = 5.0
"""Largest deviation from half of the mass on each side [%]."""
OVERLAP = 2.0
"""Largest distance of a deposit from the solver's. It is expressed as the sideways shift [spacings] of the solver's deposit that gives the same distance."""
MAX_SLIDING = 0.5
"""Largest mean speed of a deposit at the end, in spacings per second."""
AT_END = 0.2
"""Time at the end over which motion is measured [s]."""
RELEASED_SECONDS, FALL_TOLERANCE = 0.2, 0.15
"""Duration of the fall of a released block [s], and largest relative difference of its fall from the solver's."""


def column(candidate: Candidate) -> Result:
    """Let a column of sand collapse on a rough floor."""
    spec = candidate.spec
    trials = [tried(candidate, value, scenes.column(spec, value, COLUMNS, ROWS), SECONDS) for value in candidate.values]
    run_outs = [trial.measured(partial(run_out, COLUMNS * candidate.spacing)) for trial in trials]
    checks = [
        near_solver("column: run-out", run_outs, RUN_OUT_TOLERANCE, 0.5 * candidate.spacing, " m"),
        *follows_parameter("column: run-out over friction angle", run_outs, " m"),
        contained("column", trials),
    ]
    return Result(checks, shown(candidate, trials, 0.2, 1.0))


def run_out(width: float, trajectory: Trajectory) -> float:
    """Return how far both sides of a deposit are beyond the column [m], on average; ``width`` is that of the column [m]."""
    low, high = np.quantile(trajectory.pos[-1, :, 0], [OUTER, 1 - OUTER])
    return float(high - low - (1 - 2 * OUTER) * width) / 2


def pile(candidate: Candidate) -> Result:
    """Let a column collapse in the solver, and check whether the pile stays at rest in the model."""
    spec, value = candidate.spec, candidate.values[1]
    state = scenes.column(spec, value, COLUMNS, ROWS)
    settled = advanced(spec.solver, state, 2 * round(SECONDS / spec.solver.frame_dt))
    trial = tried(candidate, value, settled, SECONDS)
    checks = [
        not_above_solver("pile at rest: creep", [trial.measured(creep)], MAX_CREEP, " spacings/s"),
        at_most("pile at rest: change of height", [100 * trial.measured(sinking)[0]], MAX_SINKING, " %"),
        contained("pile at rest", [trial]),
    ]
    return Result(checks, shown(candidate, [trial], 0.0, 0.25, 0.5, 0.75, 1.0))


def slump(candidate: Candidate) -> Result:
    """Let a column collapse in the solver at the highest friction angle. At the lowest one its pile is too steep, and has to flow.

    A model with too much static friction keeps it where it is.
    """
    spec, (lowest, _, highest) = candidate.spec, candidate.values
    settled = advanced(spec.solver, scenes.column(spec, highest, COLUMNS, ROWS), 2 * round(SECONDS / spec.solver.frame_dt))
    steep = replace(settled, material_params=np.full_like(settled.material_params, lowest))
    trial = tried(candidate, lowest, steep, SECONDS)
    checks = [of_size("pile that is too steep: way", [trial.measured(creep)], " spacings/s"), contained("pile that is too steep", [trial])]
    return Result(checks, shown(candidate, [trial], 0.0, 0.25, 0.5, 0.75, 1.0))


def released(candidate: Candidate) -> Result:
    """Release blocks at rest under the ceiling and beside a side wall. Nothing holds them, since the walls have no friction."""
    spec, value = candidate.spec, candidate.values[1]
    starts = [scenes.leaning(spec, value, 8, 4, "ceiling"), scenes.leaning(spec, value, 4, 8, "side")]
    trials = [tried_from_rest(candidate, value, start, RELEASED_SECONDS) for start in starts]
    falls = [trial.measured(fall) for trial in trials]
    checks = [
        near_solver("released under a ceiling, beside a wall: fall", falls, FALL_TOLERANCE, 0.25 * candidate.spacing, " m"),
        contained("released under a ceiling, beside a wall", trials),
    ]
    return Result(checks, shown(candidate, trials, 0.5, 1.0))


def fall(trajectory: Trajectory) -> float:
    """Return how far the centre of mass is below its start at the end [m]."""
    height = centre(trajectory)[:, -1]
    return float(height[0] - height[-1])


def creep(trajectory: Trajectory) -> float:
    """Return the rms displacement over the whole time, in spacings per second."""
    way = trajectory.pos[-1].astype(np.float64) - trajectory.pos[0]
    time = (trajectory.num_frames - 1) * trajectory.metadata.frame_dt
    return float(np.sqrt(np.square(way).sum(axis=-1).mean())) / trajectory.metadata.spacing / time


def sinking(trajectory: Trajectory) -> float:
    """Return the largest relative change of the height of the highest node."""
    low = trajectory.metadata.bounds[-1][0]
    height = trajectory.pos[..., -1].astype(np.float64).max(axis=1) - low
    return float(np.abs(height / height[0] - 1).max())


def ball_on_cylinder(candidate: Candidate) -> Result:
    """Let a ball of snow fall centrally on a cylinder. It must split symmetrically, and its deposit must come to rest."""
    spec, middle = candidate.spec, float(scenes.middle(candidate.spec)[0])
    trials = [
        tried(candidate, value, scenes.ball_over_cylinder(spec, value, BALL_RADIUS, CYLINDER, SPEED), SECONDS) for value in candidate.values
    ]
    halves = [trial.measured(partial(imbalance, middle)) for trial in trials]
    apart = [trial.measured(partial(separation, trial.truth)) for trial in trials]
    checks = [
        not_above_solver("snow on a cylinder: imbalance of left and right", halves, MAX_IMBALANCE, " %"),
        not_above_solver("snow on a cylinder: distance of the deposit from the solver's", apart, OVERLAP, " spacings"),
        not_above_solver("snow on a cylinder: speed at the end", [t.measured(final_speed) for t in trials], MAX_SLIDING, " spacings/s"),
        contained("snow on a cylinder", trials),
    ]
    return Result(checks, shown(candidate, trials, 0.2, 1.0))


def imbalance(middle: float, trajectory: Trajectory) -> float:
    """Return how far the mass right of x = ``middle`` [m] is from one half [%]."""
    return 100 * abs(float(np.average(trajectory.pos[-1, :, 0] > middle, weights=trajectory.mass)) - 0.5)


def separation(truth: Trajectory, trajectory: Trajectory) -> float:
    """Return how far the deposit in the last frame is from the true one, in spacings.

    The energy distance of both is converted into the sideways shift of the true deposit that has the same distance. For small shifts the energy distance grows
    with the square of the shift.
    """
    cloud, mass, spacing = truth.pos[-1].astype(np.float64), truth.mass, truth.metadata.spacing
    beside = cloud + np.eye(cloud.shape[1])[0] * OVERLAP * spacing
    unit = energy_distance(beside, cloud, mass, mass)
    return OVERLAP * float(np.sqrt(energy_distance(trajectory.pos[-1], cloud, mass, mass) / unit))


def final_speed(trajectory: Trajectory) -> float:
    """Return the mean speed of particles over the last ``AT_END`` seconds, in spacings per second."""
    frames = min(trajectory.num_frames - 1, round(AT_END / trajectory.metadata.frame_dt))
    way = np.linalg.norm(trajectory.pos[-1].astype(np.float64) - trajectory.pos[-1 - frames], axis=-1)
    return float(way.mean()) / trajectory.metadata.spacing / (frames * trajectory.metadata.frame_dt)
