"""Statistics of a train split, which scale training noise and figures. They are stored in the folder of the data set."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.schema import MATERIALS
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.store import read_trajectory, trajectory_names
from gpe_pl.trajectory.trajectory import Trajectory

STATISTICS_FILE = "statistics.json"

FRAMES_AT_ONCE = 2048
"""Number of frames converted to float64 at a time. Public data have trajectories of tens of thousands of frames, which would fill the memory."""


def shard_moments(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the path of a shard as text, and sums over its trajectories, from which ``combined`` computes statistics."""
    sums: dict[str, Any] = {"velocity": [0, 0.0], "acceleration": [0, 0.0], "params": None, "nodes": 0, "frames": 0, "trajectories": 0}
    for name in trajectory_names(path):
        trajectory = read_trajectory(path, name)
        for key, values in motion(trajectory):
            sums[key][0] += values.size
            sums[key][1] += float(np.sum(values * values))
        params = _scaled(trajectory)
        finite = np.isfinite(params)
        values = np.where(finite, params, 0.0)
        triple = np.stack([finite.sum(axis=0), values.sum(axis=0), (values * values).sum(axis=0)])
        sums["params"] = triple if sums["params"] is None else sums["params"] + triple
        sums["param_names"] = trajectory.metadata.param_names
        sums["nodes"] += trajectory.num_nodes
        sums["frames"] += trajectory.num_frames
        sums["trajectories"] += 1
    return str(path), sums


def acceleration_std(trajectories: Iterable[Trajectory]) -> float:
    """Return the root mean square per component of accelerations without gravity [m/s²]."""
    sums = [(float(np.sum(v * v)), v.size) for t in trajectories for key, v in motion(t) if key == "acceleration"]
    power, count = np.sum(sums, axis=0)
    return math.sqrt(power / max(1, count))


def motion(trajectory: Trajectory) -> Iterator[tuple[str, np.ndarray]]:
    """Yield velocities [m/s] and accelerations without gravity [m/s²] by name, for a part of the frames at a time.

    Nodes whose motion is given along all axes are left out, and nodes of open scenes while they are not in the scene.
    """
    dt = trajectory.metadata.frame_dt
    for start in range(0, max(1, trajectory.num_frames - 2), FRAMES_AT_ONCE):
        pos = trajectory.pos[start : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        vel = integrators.velocities(pos, dt, trajectory.metadata.periodicity)
        if trajectory.prescribed is not None:
            vel = vel[:, trajectory.is_predicted]
        acc = integrators.acceleration(vel[1:], vel[:-1], dt) - np.asarray(trajectory.metadata.gravity)
        first = 1 if start else 0
        if trajectory.alive is None:
            yield "velocity", vel[first:]
            yield "acceleration", acc
            continue
        alive = trajectory.alive[start : start + FRAMES_AT_ONCE + 2][:, trajectory.is_predicted]
        stays = alive[1:] & alive[:-1]
        yield "velocity", vel[first:][stays[first:]]
        yield "acceleration", acc[stays[1:] & stays[:-1]]


def _scaled(trajectory: Trajectory) -> np.ndarray:
    """Return material parameters [node, param]; natural logarithms of those with a logarithmic scale."""
    scale = {p.name: p.scale for own in MATERIALS.values() for p in own}
    columns = trajectory.material_params.astype(np.float64).T
    return np.stack([np.log(c) if scale[n] == "log" else c for n, c in zip(trajectory.metadata.param_names, columns, strict=True)], axis=-1)


def combined(moments: list[dict[str, Any]]) -> dict[str, Any]:
    """Compute statistics from the sums that ``shard_moments`` returns for each shard.

    The statistics are the root mean squares per component of velocities [m/s] and accelerations without gravity [m/s²], the mean and standard deviation of each
    material parameter on its scale in ``schema``, and the numbers of trajectories, frames and nodes.
    """
    moments, rms = [m for m in moments if m["trajectories"]], {}
    for key in ("velocity", "acceleration"):
        rms[key] = math.sqrt(math.fsum(m[key][1] for m in moments) / sum(m[key][0] for m in moments))
    count, total, square = np.sum([m["params"] for m in moments], axis=0)
    mean = total / np.maximum(count, 1)
    std = np.sqrt(np.maximum(square / np.maximum(count, 1) - mean * mean, 0.0))
    parameters = {p.name: p for own in MATERIALS.values() for p in own}
    return {
        "velocity_std": rms["velocity"],
        "acceleration_std": rms["acceleration"],
        "material_params": {
            n: {"mean": float(m), "std": float(s), "scale": parameters[n].scale}
            for n, m, s in zip(moments[0]["param_names"], mean, std, strict=True)
        },
        **{f"num_{key}": sum(m[key] for m in moments) for key in ("trajectories", "frames", "nodes")},
    }
