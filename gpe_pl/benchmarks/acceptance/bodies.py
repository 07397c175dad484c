"""Acceptance of models of bodies that bend: symmetric blocks that fall flat on a floor or lie on it, at three stiffnesses.

A symmetric body that meets a flat floor keeps its symmetry. It neither turns nor moves sideways, whatever its material. Stiffer bodies deform less.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import (
    Candidate,
    Result,
    Trial,
    at_most,
    centre,
    contained,
    follows_parameter,
    listed,
    near_solver,
    not_above_solver,
    shown,
    tried,
    tried_from_rest,
)
from gpe_pl.learned.verdicts import Check
from gpe_pl.metrics.bodies import Bodies, body_metrics
from gpe_pl.metrics.contact import NEAR, bounce_heights
from gpe_pl.metrics.mirror import mirror_error, mirrors
from gpe_pl.trajectory.trajectory import Trajectory

GAP, SPEED = 0.1, 2.0
"""Height [m] above the floor and downward speed [m/s] at the start."""
SECONDS = {"solid": 0.3, "elastomer": 0.5}
MAX_TILT = 3.0
"""Largest angle [deg] by which a symmetric body may turn."""
MAX_SIDEWAYS = 0.05
"""Largest sideways speed over the speed of impact."""
MAX_MIRROR = 5.0
"""Largest difference of a symmetric body from its mirror image, over the distance that it moves in the ground truth [%]."""
BOUNCE_TOLERANCE = 0.25
DEFORMATION_RATIO = (0.8, 1.25)
"""Range of the rms deformation over the solver's."""
PLACED_SECONDS, MAX_RISE = 0.3, 0.5
"""Duration of the scene of a block on the floor [s], and the largest rise of its centre [spacings]."""
WINDOW = 10
"""Number of frames over which a sideways speed is averaged."""


def dropped(columns: int, rows: int, name: str, candidate: Candidate) -> Result:
    """Drop a block of ``columns`` × ``rows`` squares flat on the floor, and return its checks."""
    seconds = SECONDS[scenes.material_of(candidate.spec)]
    trials = [
        tried(candidate, value, scenes.dropped_block(candidate.spec, value, columns, rows, GAP, SPEED), seconds)
        for value in candidate.values
    ]
    gravity = float(np.abs(candidate.spec.scene.gravity[-1]))
    impact = math.sqrt(SPEED**2 + 2 * gravity * GAP)
    tilts = [t.measured(lambda x: float(_bodies(x).motions[0].tilt.max()))[0] for t in trials]
    sideways = [100 * t.measured(sideways_speed)[0] / impact for t in trials]
    mirror = [t.measured(partial(asymmetry, t.truth))[0] for t in trials]
    checks = [
        at_most(f"{name}: tilt", tilts, MAX_TILT, "°"),
        at_most(f"{name}: sideways speed over impact speed", sideways, 100 * MAX_SIDEWAYS, " %"),
        at_most(f"{name}: mirror error", mirror, MAX_MIRROR, " %"),
        *against_solver(name, trials),
        contained(name, trials),
    ]
    return Result(checks, shown(candidate, trials, 0.2, 0.6))


def placed(columns: int, rows: int, candidate: Candidate) -> Result:
    """Place a block of ``columns`` × ``rows`` squares on the floor, and check that nothing throws it up."""
    trials = [
        tried_from_rest(candidate, value, scenes.placed_block(candidate.spec, value, columns, rows), PLACED_SECONDS)
        for value in candidate.values
    ]
    checks = [not_above_solver("block on the floor: rise", [t.measured(rise) for t in trials], MAX_RISE, " spacings")]
    return Result(checks, shown(candidate, trials, 0.5, 1.0))


def rise(trajectory: Trajectory) -> float:
    """Return the largest height of the centre of mass above its start, in spacings."""
    height = centre(trajectory)[:, -1]
    return float((height - height[0]).max()) / trajectory.metadata.spacing


def _bodies(trajectory: Trajectory) -> Bodies:
    found = Bodies.of(trajectory)
    assert found is not None, "blocks have cells"
    return found


def sideways_speed(trajectory: Trajectory) -> float:
    """Return the largest of the mean sideways speeds of the centre of mass over ``WINDOW`` frames [m/s]."""
    x = centre(trajectory)[:, 0]
    return float(np.abs(x[WINDOW:] - x[:-WINDOW]).max()) / (WINDOW * trajectory.metadata.frame_dt)


def asymmetry(truth: Trajectory, trajectory: Trajectory) -> float:
    """Return the difference of a body from its mirror image, divided by the displacement from the start in the ground truth [%]. Norms are over all frames."""
    (mirror,) = mirrors(truth)
    return 100 * mirror_error(trajectory, truth, mirror, trajectory.num_frames - 1)


def against_solver(name: str, trials: list[Trial]) -> list[Check]:
    """Return the checks of bounce height and deformation against the solver, and of peak stress if solver and model have a stress."""
    bounces = [t.measured(partial(bounce_height, _bodies(t.truth))) for t in trials]
    ratios = [t.measured(partial(deformation_ratio, _bodies(t.truth)))[0] for t in trials]
    has_stress = all(t.truth.stress is not None and t.model.stress is not None for t in trials)
    low, high = DEFORMATION_RATIO
    passed = all(low <= ratio <= high for ratio in ratios)
    return [
        near_solver(f"{name}: bounce height", bounces, BOUNCE_TOLERANCE, 0.25 * trials[0].truth.metadata.spacing, " m"),
        *follows_parameter(f"{name}: bounce height over stiffness", bounces, " m"),
        Check(f"{name}: deformation over the solver's", passed, listed(ratios), "", f"from {low:g} to {high:g}"),
        *(follows_parameter(f"{name}: peak stress over stiffness", [t.measured(peak_stress) for t in trials], " Pa") if has_stress else ()),
    ]


def bounce_height(truth: Bodies, trajectory: Trajectory) -> float:
    """Return the largest rise of the centre of mass after the first contact [m].

    A block is in contact while its gap exceeds the smallest gap in the ground truth by at most ``NEAR`` spacings. Unlike ``metrics.contact``, this sets no
    limit on the smallest gap: the block certainly falls on the floor, but in the material point method its flat side stays up to two spacings away from it.
    """
    own = truth.predicted(trajectory)
    assert own.height is not None, "bodies fall"
    limit = truth.gap.min(axis=0) + NEAR * truth.trajectory.metadata.spacing
    return float(bounce_heights(own.height, own.gap, limit).sum())


def deformation_ratio(truth: Bodies, trajectory: Trajectory) -> float:
    """Return the rms deformation over that of the truth."""
    return body_metrics(truth.predicted(trajectory), truth, trajectory.num_frames - 1)["deformation_ratio"]


def peak_stress(trajectory: Trajectory) -> float:
    """Return the largest von Mises stress at a node after the first frame [Pa]."""
    stress = _bodies(trajectory).von_mises
    assert stress is not None
    return float(stress[1:].max())
