"""Rollouts of solvers and models on the scenes of ``runtime_vs_error``: their time, and their distance from the reference."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gpe_pl.metrics import energy_distance
from gpe_pl.rollout.loop import SimulationError, steps
from gpe_pl.solvers.resolution import Resolved
from gpe_pl.system.machine import work_clock
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)

Frame = tuple[np.ndarray, np.ndarray]
"""Positions [node, dim] in m and velocities [node, dim] in m/s."""


@dataclass(frozen=True)
class Start:
    """Start of a simulator.

    Attributes:
        resolved: its state, and the map from its positions to those of the scene's nodes.
        from_start: whether it starts at frame 0, not where all learned models have enough history.
        frames_per_step: number of frames that one step advances.
    """

    resolved: Resolved
    from_start: bool
    frames_per_step: int = 1


def timed(simulator: Any, at: Start, data: Trajectory, kept_from: int) -> tuple[Trajectory, float]:
    """Run from the start ``at`` to the end of the data. Return the rollout from frame ``kept_from`` on, and its computing time over its simulated time.

    The rollout has the nodes of the scene. The first step runs twice and is timed once, so that compilation and first use of memory do not count. Time is
    processor time on a CPU, which counts every thread and depends less on other work, and wall time on a GPU. A failed rollout ends early. Frames within a step
    are interpolated.
    """
    start: Any = at.resolved.state
    dt = data.metadata.frame_dt
    first, every = 0 if at.from_start else kept_from, at.frames_per_step
    wanted = data.num_frames - first
    clock = work_clock(isinstance(start.pos, torch.Tensor) and start.pos.is_cuda)
    frames, seconds, num_steps = [_numpy(start)], 0.0, 0
    try:
        simulator.step(start)
        begun = clock()
        for state in steps(simulator, start, -(-(wanted - 1) // every)):
            seconds += clock() - begun
            num_steps += 1
            pos, vel = _numpy(state)
            if not np.isfinite(pos).all():
                break
            frames += [_between(frames[-1], (pos, vel), k / every) for k in range(1, every)] + [(pos, vel)]
            begun = clock()
    except SimulationError as error:
        log.info("%s stopped: %s", type(simulator).__name__, error)
    pos = np.stack([at.resolved.restrict(p) for p, _ in frames[:wanted]])
    vel = np.stack([(at.resolved.restrict(p + dt * v) - at.resolved.restrict(p)) / dt for p, v in frames[:wanted]])
    trajectory = replace(data, pos=pos, vel=vel, stress=None).frames(min(kept_from - first, len(pos) - 1))
    return trajectory, seconds / max(1, num_steps) / (every * dt)


def _between(before: Frame, after: Frame, fraction: float) -> Frame:
    return before[0] + fraction * (after[0] - before[0]), before[1] + fraction * (after[1] - before[1])


def _numpy(state: State) -> Frame:
    pos, vel = (x.detach().cpu().numpy() if isinstance(x, torch.Tensor) else x for x in (state.pos, state.vel))
    return np.array(pos, dtype=np.float64), np.array(vel, dtype=np.float64)


def squared_error(prediction: Trajectory, truth: Trajectory) -> np.ndarray:
    """Return the mean squared error of every frame [m²], over nodes and axes; infinite for missing frames. Frame 0 may differ between resolutions."""
    error = np.full(truth.num_frames, np.inf)
    count = prediction.num_frames
    error[:count] = np.square(prediction.pos.astype(np.float64) - truth.pos[:count]).mean(axis=(1, 2))
    return error


def distance(prediction: Trajectory, truth: Trajectory) -> float:
    """Return the energy distance [m] of the last frames; infinite if the prediction is shorter."""
    if prediction.num_frames < truth.num_frames:
        return float("inf")
    return energy_distance(prediction.pos[-1], truth.pos[-1], prediction.mass, truth.mass)
