"""Windows of open scenes: where their nodes are before they enter and after they leave, and which nodes a model can learn from."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gpe_pl.errors import GpeError
from gpe_pl.trajectory.trajectory import Trajectory


class OpenScenesError(GpeError, ValueError):
    """Raised for settings of a training that need scenes without inlets and outlets; the message names the setting."""


def check_settings(unroll_steps: int, has_solver_targets: bool, has_augmentation: bool) -> None:
    """Check settings of a training on open scenes.

    Raises:
        OpenScenesError: a setting needs scenes whose nodes stay.
    """
    where = "the data have scenes with inlets and outlets"
    if unroll_steps > 1:
        raise OpenScenesError(f"training.unroll_steps={unroll_steps}: {where}; set unroll_steps=null and push_fraction=0.6")
    if has_solver_targets:
        raise OpenScenesError(f"training.targets=solver: {where}; set targets=trajectory")
    if has_augmentation:
        raise OpenScenesError(f"training.mirror, rotate, quarter_turns and boost_speed: {where}, which are not moved along; leave them off")


def continued(window: Trajectory) -> Float64[np.ndarray, "frame node dim"]:
    """Return the positions [m] of all nodes of a window in all of its frames.

    Before a node enters and after it leaves, it moves with the velocity that it has then. Differences of these positions give the velocity history of
    ``trajectory.living``.
    """
    pos = window.pos.astype(np.float64)
    if window.alive is None:
        return pos
    first, last = window.alive.argmax(axis=0), len(pos) - 1 - window.alive[::-1].argmax(axis=0)
    frames = np.arange(len(pos))[:, None]
    nearest = np.clip(frames, first, last)
    column = np.arange(pos.shape[1])
    way = (frames - nearest)[..., None] * window.metadata.frame_dt * window.vel[nearest, column].astype(np.float64)
    return pos[nearest, column] + way
