"""Rollouts with error bands, and with warnings if a scene is unlike those that the model knows."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.bands import LEVEL, Bands, Guarantee
from gpe_pl.learned.ensemble import LearnedEnsemble, combined, members_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.unlike import UnlikeScenes, Watch, trained_limits
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.ensemble import spread
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Simulator, rollout
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

log = logging.getLogger(__name__)

ATTRIBUTES = {"clamp_parameters": "clamps_parameters", "static_friction": "static_friction", "mirror_average": "mirror_average"}
"""Attributes of a simulator that settings of an evaluation change, by setting."""


@dataclass(frozen=True)
class BandedRollout:
    """A rollout with the radii of its error bands.

    Attributes:
        trajectory: predicted frames.
        radius: radii of the bands around the predicted positions [frame, node] in m; None without bands.
        spread: spread of an ensemble's members [frame, node] in m; None for a single model.
        unlike: what is unlike the known scenes, one line per quantity.
    """

    trajectory: Trajectory
    radius: Float[np.ndarray, "frame node"] | None
    spread: Float[np.ndarray, "frame node"] | None
    unlike: list[str]


def roll_out_with_bands(
    simulator: LearnedSimulator | LearnedEnsemble,
    state: State,
    num_steps: int,
    metadata: Metadata,
    bands: Bands | None,
    level: float = LEVEL,
    guarantee: Guarantee = "nodes",
    guard: Guard | None = None,
) -> BandedRollout:
    """Roll a model or an ensemble forward, with error bands, and warn if the scene is unlike those of the calibration.

    Bands promise coverage for rollouts as in calibration: contained in walls if these were, from the frame ``bands.start_frame`` of a scene on, and with the
    same approximate levels of ``LearnedSimulator.skips``; a warning says if start or levels differ. Another warning says if the bands state another
    ``static_friction``, ``mirror_average`` or ``clamp_parameters`` than the simulator has. They state those that calibration changed.

    Args:
        simulator: trained model, or an ensemble.
        state: initial state from ``initial_state`` or ``standing``, which becomes frame 0.
        num_steps: number of frames to add.
        metadata: metadata of the scene.
        bands: bands of the model, as ``bands.read`` returns them; without, the scene is compared with the statistics of the training.
        level: nominal coverage, one of ``bands.LEVELS``.
        guarantee: what the bands promise (see ``bands``).
        guard: stops the rollout at the first state that it rejects.

    Raises:
        ValueError: bands of this level are not stored, or are of another number of members, of frames of another length or of another spacing.
        SceneError: the scene does not fit the model.
    """
    members = members_of(simulator.on(metadata))
    if bands is not None and len(bands.checkpoints) != len(members):
        raise ValueError(
            f"the bands are of {len(bands.checkpoints)} checkpoints, the simulator has {len(members)}; read those of the same checkpoints"
        )
    dt, spreads = metadata.frame_dt, [np.zeros(state.num_nodes)]
    if bands is not None:
        _check_fit(bands, metadata, members[0], state.time)
        _check_settings(bands, members)
    watch = Watch(members[0], num_steps)
    watch.see(0, state)

    def wrapped(member: LearnedSimulator) -> Simulator:
        runner = approximate(member)
        return Contained(runner, dt) if bands is None or bands.containment else runner

    def see(frame: int, new: State) -> None:
        watch.see(frame, new)
        if len(members) > 1:
            spreads.append(np.asarray(spread(new)))

    trajectory = rollout(combined(members, wrapped), state, num_steps, metadata, guard, see)
    own_spread = np.stack(spreads) if len(members) > 1 else None
    if bands is None:
        unlike = UnlikeScenes(trained_limits(members[0]), "training", is_complete=False)
    else:
        unlike = UnlikeScenes(bands.features, "calibration scenes", is_complete=True, spread=bands.spread)
    unlike.add(watch.found, None if own_spread is None else own_spread.mean(axis=1))
    unlike.warn("this rollout")
    radius = None if bands is None else bands.radius(trajectory, own_spread, level, guarantee)
    return BandedRollout(trajectory, radius, own_spread, [line for line, _ in unlike.lines.values()])


def _check_fit(bands: Bands, metadata: Metadata, simulator: LearnedSimulator, start: float) -> None:
    """Raise ``ValueError`` if bands are of frames of another length or of another spacing. Warn if they are of other approximate levels or of rollouts from
    another time [s].
    """
    frame_dt = metadata.frame_dt
    if bands.spacing is not None and not math.isclose(bands.spacing, metadata.spacing, rel_tol=1e-3):
        raise ValueError(
            f"the bands are of nodes {bands.spacing:g} m apart, those of the scene are {metadata.spacing:g} m apart; calibrate with such nodes"
        )
    if not math.isclose(bands.frame_dt, frame_dt, rel_tol=1e-6):
        raise ValueError(
            f"the bands are of frames of {bands.frame_dt:g} s, those of the scene have {frame_dt:g} s; calibrate with such frames"
        )
    prefix = "rollout."
    calibrated = {key.removeprefix(prefix): value for key, value in bands.settings.items() if key.startswith(prefix)}
    if calibrated != (own := simulator.skips.approximations):
        log.warning("error bands promise nothing: the calibration skipped %s, this rollout %s", calibrated or "nothing", own or "nothing")
    if abs(start / frame_dt - bands.start_frame) > 0.5:
        frame = start / frame_dt
        log.warning(
            "error bands promise nothing: the calibration began at frame %d of each scene, this rollout at frame %.3g",
            bands.start_frame,
            frame,
        )


def _check_settings(bands: Bands, members: Sequence[LearnedSimulator]) -> None:
    """Warn if bands state other settings of the evaluation than a member has."""
    for setting, attribute in ATTRIBUTES.items():
        known = bands.settings.get(key := f"evaluation.{setting}")
        other = [own for member in members if (own := getattr(member, attribute)) != known]
        if known is not None and other:
            log.warning(
                "error bands promise nothing: the calibration had %s=%s, this rollout %s", key, str(known).lower(), str(other[0]).lower()
            )
