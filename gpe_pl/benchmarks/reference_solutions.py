"""Reference solutions of scenes: a solver at half the spacing at which the data were solved. They are stored, because they take most of the time of a suite."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.benchmarks.solver_rungs import coarser_solver
from gpe_pl.benchmarks.timed_rollouts import Start, timed
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory, initial_state, parameter_values, scene_seed
from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.schema import Split
from gpe_pl.solvers.finer_solver import FACTORS, Refinable
from gpe_pl.solvers.resolution import coarser
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

REFERENCES = "references"
"""Subfolder of the results for reference solutions. Delete it to compute them again."""
NAME = "00000"
FRAMES_OF_ORDER = 20


class ComparisonError(GpeError, ValueError):
    """Raised when a model or a reference solution is missing; the message says which."""


def stored_reference(spec: DatasetSpec, split: Split, index: int, folder: Path | None) -> Trajectory:
    """Return the reference solution of a scene, from a file in ``folder`` if there is one. Otherwise compute it, and store it if a folder is given.

    A file belongs to one solver with its settings and version, one scene, and the number of frames.

    Raises:
        ComparisonError: the solver has no solution at half the spacing.
        GenerationError: the solution ended early.
        StoreError: the file is damaged.
    """
    if not isinstance(spec.solver, Refinable) or 2 * spec.fine not in FACTORS:
        raise ComparisonError(
            f"{spec.name}: the solver {spec.solver.name} has no solution at 1/{2 * spec.fine} of the spacing to compare with"
        )
    finer = _with_labels(spec, 2 * spec.fine)
    if folder is None:
        return generate_trajectory(finer, split, index)
    scene = {"split": split, "index": index, "seed": scene_seed(spec, split, index), "values": parameter_values(spec, split, index)[0]}
    path = folder / f"{sealed.checksum({**finer.provenance, **scene, 'num_frames': spec.num_frames})[:16]}.h5"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_shard(path, [generate_trajectory(finer, split, index)], [NAME])
    return read_trajectory(path, NAME, verify=True)


def _with_labels(spec: DatasetSpec, fine: int) -> DatasetSpec:
    settings: dict[str, Any] = {"fine": fine}
    return replace(spec, **settings)


def observed_order(spec: DatasetSpec, split: Split, index: int, reference: Trajectory) -> float:
    """Return the observed order P = log₂ (|u_2h − u_h| / |u_h − u_{h/2}|) over the first frames; NaN if there is no rollout with spacing 2h.

    h is the spacing at which the data were solved. ``reference`` is the solution at h / 2.
    """
    few = generate_trajectory(spec, split, index, num_frames=min(FRAMES_OF_ORDER, spec.num_frames - 1) + 1)
    if spec.fine > 1:
        coarse = generate_trajectory(_with_labels(spec, spec.fine // 2), split, index, num_frames=few.num_frames)
    else:
        solver = coarser_solver(spec, 2.0)
        try:
            resolved = coarser(initial_state(spec, split, index), spec.scene.spacing, 2.0)
        except ValueError:
            return math.nan
        if solver is None:
            return math.nan
        coarse, _ = timed(solver, Start(resolved, True), few, 0)
    if coarse.num_frames < few.num_frames:
        return math.nan
    first = np.sqrt(np.mean(np.square(few.pos.astype(np.float64) - reference.pos[: few.num_frames])))
    second = np.sqrt(np.mean(np.square(coarse.pos - few.pos)))
    return float(np.log2(second / first))
