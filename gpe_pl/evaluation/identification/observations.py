"""Observed motion: a trajectory of which some frames or nodes may be missing, and whose positions may have noise."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64, Int
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from gpe_pl.errors import GpeError
from gpe_pl.trajectory.store import digest, stored_arrays, stored_attributes
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)

SMOOTHED_FRAMES, SMOOTHED_ORDER = 11, 3
"""Length and order of the polynomials (Savitzky–Golay) that smooth noisy positions."""


class ObservationError(GpeError, ValueError):
    """Raised when observations are too few or have the wrong shape."""


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class ObservationSettings:
    """Which part of stored trajectories counts as observed.

    Attributes:
        nodes: fraction of the nodes that are observed after the start; the others are drawn at random.
        every: one of so many frames is observed.
        noise: standard deviation of the noise in the positions [m]. Above 0, starting states are smoothed, unless nodes are hidden or frames are few.
        added_noise: standard deviation of noise that is added first [m], to try out what noise does.
        seed: seed of the draws.
    """

    nodes: Annotated[float, Field(gt=0, le=1)] = 1.0
    every: Annotated[int, Field(ge=1)] = 1
    noise: Annotated[float, Field(ge=0)] = 0.0
    added_noise: Annotated[float, Field(ge=0)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Observations:
    """Observed motion of one scene.

    Attributes:
        trajectory: positions in all frames; values that were not observed are ignored. Material parameters that are not sought have to be right.
        seen: observed nodes of each frame [frame, node].
        noise: standard deviation of the noise in the positions [m].

    Raises:
        ObservationError: flags do not fit the trajectory, too few frames are observed, an observed position is not finite, or the scene is open.
    """

    trajectory: Trajectory
    seen: Bool[np.ndarray, "frame node"]
    noise: float = 0.0

    def __post_init__(self) -> None:
        if self.seen.shape != self.trajectory.pos.shape[:2]:
            raise ObservationError(
                f"seen [frame, node] is {list(self.seen.shape)}, the trajectory has {list(self.trajectory.pos.shape[:2])}; give one flag per node and frame"
            )
        if self.trajectory.alive is not None:
            raise ObservationError("nodes enter or leave the scene, which no search follows; observe a scene without openings")
        if len(unknown := np.argwhere(self.seen & ~np.isfinite(self.trajectory.pos).all(axis=2))):
            frame, node = unknown[0]
            raise ObservationError(
                f"frame {frame}, node {node}: is marked as seen, and its position is not a number; set seen to False there"
            )
        if self.seen.any(axis=1).sum() < 2:
            raise ObservationError("fewer than 2 frames have observed nodes; observe more frames")

    @classmethod
    def of(cls, trajectory: Trajectory, settings: ObservationSettings | None = None) -> Observations:
        """Return the observations that settings choose from a complete trajectory; by default everything is observed.

        Hidden nodes and noise depend on the seed and on the motion, so they differ between scenes.
        """
        s = settings or ObservationSettings()
        motion = int(digest({"pos": trajectory.pos}, attributes={})[:16], 16)
        rng, (num_frames, num_nodes) = np.random.default_rng([s.seed, motion]), trajectory.pos.shape[:2]
        seen = np.zeros((num_frames, num_nodes), dtype=bool)
        seen[:: s.every] = rng.permutation(num_nodes) < max(1, round(s.nodes * num_nodes))
        if s.added_noise:
            noisy = trajectory.pos + rng.normal(scale=s.added_noise, size=trajectory.pos.shape).astype(trajectory.pos.dtype)
            trajectory = replace(trajectory, pos=noisy)
        return cls(trajectory, seen, max(s.noise, s.added_noise))

    @property
    def has_hidden_nodes(self) -> bool:
        """Whether some nodes are missing in a frame in which others are observed. Rollouts can then start at the first frames only, which are known."""
        frames = self.seen.any(axis=1)
        return not self.seen[frames].all()

    @cached_property
    def digest(self) -> str:
        """SHA-256 digest of the motion and of what is observed of it."""
        arrays = {**stored_arrays(self.trajectory), "seen": self.seen, "noise": np.array(self.noise)}
        return digest(arrays, stored_attributes(self.trajectory))

    @cached_property
    def frames(self) -> Int[np.ndarray, "observed"]:
        """Frames with observed nodes."""
        return np.flatnonzero(self.seen.any(axis=1))

    @cached_property
    def first_frame(self) -> int:
        """First frame that is known: 0 if nodes are hidden, because the start has to be known then."""
        return 0 if self.has_hidden_nodes else int(self.frames[0])

    @cached_property
    def last_frame(self) -> int:
        return int(self.frames[-1])

    @cached_property
    def completed(self) -> Trajectory:
        """The trajectory from which rollouts start: missing frames are interpolated by cubic splines, noise is smoothed, velocities follow from positions.

        If nodes are hidden, it is the trajectory itself.
        """
        frames, runs = self.frames, _even_runs(self.frames)
        is_complete = len(frames) == self.trajectory.num_frames
        if self.noise and (self.has_hidden_nodes or min(map(len, runs)) <= SMOOTHED_FRAMES):
            why = "some nodes are hidden"
            if not self.has_hidden_nodes:
                why = f"fewer than {SMOOTHED_FRAMES + 1} frames are observed" + (" in a row without a gap" if len(runs) > 1 else "")
            log.warning("observations.noise: rollouts start from the noisy positions as they are, because %s", why)
        if self.has_hidden_nodes or (is_complete and self.noise == 0):
            return self.trajectory
        if self.trajectory.metadata.periodicity:
            raise ObservationError("missing frames and noise are not supported in periodic domains; observe every frame without noise")
        pos: Float64[np.ndarray, "frame node dim"] = self.trajectory.pos.astype(np.float64)
        if self.noise:
            for run in runs:
                if len(run) > SMOOTHED_FRAMES:
                    pos[run] = savgol_filter(pos[run], SMOOTHED_FRAMES, SMOOTHED_ORDER, axis=0)
        known, vel = np.arange(frames[0], frames[-1] + 1), self.trajectory.vel.astype(np.float64)
        if not is_complete:
            pos[known] = CubicSpline(frames, pos[frames], axis=0)(known)
        vel[known] = np.gradient(pos[known], self.trajectory.metadata.frame_dt, axis=0, edge_order=2 if len(known) > 2 else 1)
        return replace(self.trajectory, pos=pos, vel=vel)


def _even_runs(frames: Int[np.ndarray, "observed"]) -> list[Int[np.ndarray, "_"]]:
    """Return observed frames in runs without a gap: neighbours in a run are the smallest interval of all apart."""
    intervals = np.diff(frames)
    return np.split(frames, np.flatnonzero(intervals > intervals.min()) + 1)
