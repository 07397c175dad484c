"""What enters, leaves and stays in rollouts of open scenes: accounts of nodes, mass and momentum, and levels of liquids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from gpe_pl.trajectory.living import held
from gpe_pl.trajectory.trajectory import Trajectory

UNITS: dict[str, str] = {"mass_error": "1", "outflow_error": "1"}
"""Metrics of ``open_metrics`` and their units."""


def present(trajectory: Trajectory) -> Bool[np.ndarray, "frame node"]:
    """Return the mask of the nodes that are in the scene, also for closed scenes."""
    return np.ones(trajectory.pos.shape[:2], bool) if trajectory.alive is None else trajectory.alive


def places(trajectory: Trajectory) -> Float[np.ndarray, "frame node dim"]:
    """Return the positions [m]. Before a node enters and after it has left, its place is that of the nearest frame in which it is in the scene."""
    return trajectory.pos if trajectory.alive is None else held(trajectory.pos, trajectory.alive)


def entering(trajectory: Trajectory) -> Int[np.ndarray, " frame"]:
    """Return how many nodes entered with each frame. None enters with the first."""
    return _changes(trajectory, 1).sum(axis=1)


def leaving(trajectory: Trajectory) -> Int[np.ndarray, " frame"]:
    """Return how many nodes left with each frame. None leaves with the first."""
    return _changes(trajectory, -1).sum(axis=1)


def _changes(trajectory: Trajectory, sign: int) -> Bool[np.ndarray, "frame node"]:
    alive = present(trajectory).astype(np.int8)
    return np.diff(alive, axis=0, prepend=alive[:1]) == sign


@dataclass(frozen=True)
class Ledger:
    """Mass [kg] and momentum [kg m/s] of each frame, and what entered and left with it.

    What is there now is what was there a frame earlier, plus what entered, less what left. For momentum, forces change what stays, too. A node takes out the
    momentum that it had in its last frame.

    Attributes:
        mass, entered_mass, left_mass: per frame [frame].
        momentum, entered_momentum, left_momentum: per frame [frame, dim].
    """

    mass: Float[np.ndarray, " frame"]
    entered_mass: Float[np.ndarray, " frame"]
    left_mass: Float[np.ndarray, " frame"]
    momentum: Float[np.ndarray, "frame dim"]
    entered_momentum: Float[np.ndarray, "frame dim"]
    left_momentum: Float[np.ndarray, "frame dim"]

    @property
    def forces(self) -> Float[np.ndarray, "frame dim"]:
        """Impulse [kg m/s] of all forces on the nodes that stayed, from the frame before to each frame; 0 in the first."""
        change = np.diff(self.momentum, axis=0, prepend=self.momentum[:1])
        return change - self.entered_momentum + self.left_momentum


def ledger(trajectory: Trajectory) -> Ledger:
    """Return the account of mass and momentum of a trajectory."""
    mass, vel = trajectory.mass.astype(np.float64), trajectory.vel.astype(np.float64)
    alive, enters, leaves = present(trajectory), _changes(trajectory, 1), _changes(trajectory, -1)
    before = np.concatenate([vel[:1], vel[:-1]])
    sums = [np.einsum("fn,n->f", mask, mass) for mask in (alive, enters, leaves)]
    momenta = [np.einsum("fn,n,fnd->fd", mask, mass, own) for mask, own in ((alive, vel), (enters, vel), (leaves, before))]
    return Ledger(sums[0], sums[1], sums[2], momenta[0], momenta[1], momenta[2])


def level(trajectory: Trajectory, axis: int, low: float, high: float) -> Float[np.ndarray, " frame"]:
    """Return the mean depth [m] of what is between two places along an axis: its volume over the area of the ground.

    A node has the volume of a cell of the rest spacing. The ground is as wide as the domain along horizontal axes other than ``axis``. The last axis points up.

    Args:
        trajectory: rollout.
        axis: horizontal axis.
        low, high: places along it [m].
    """
    m = trajectory.metadata
    x = trajectory.pos[..., axis]
    count = (present(trajectory) & (x >= low) & (x < high)).sum(axis=1)
    area = (high - low) * float(np.prod([b - a for k, (a, b) in enumerate(m.bounds[:-1]) if k != axis]))
    return count * m.spacing**m.dim / area


def open_metrics(prediction: Trajectory, ground_truth: Trajectory, num_steps: int) -> dict[str, float]:
    """Return the metrics of an open scene up to a frame.

    ============= = ========================================================================================================
    mass_error    1 |M − M̂| / M̂ with M the mass in the scene at the last frame
    outflow_error 1 |Q − Q̂| / Q̂ with Q the mass that has left up to then; infinite if Q̂ is 0 and Q is not
    ============= = ========================================================================================================

    Args:
        prediction, ground_truth: rollouts of the same scene.
        num_steps: number of frames after the start.
    """

    def relative(own: float, true: float) -> float:
        return abs(own - true) / true if true else (0.0 if own == true else float("inf"))

    own, true = (ledger(t.frames(0, num_steps + 1)) for t in (prediction, ground_truth))
    return {
        "mass_error": relative(float(own.mass[-1]), float(true.mass[-1])),
        "outflow_error": relative(float(own.left_mass.sum()), float(true.left_mass.sum())),
    }
