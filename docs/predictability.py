"""How far two solutions of a solver come apart whose starts differ a little: no model can be expected to do better from a start known no better.

``python docs/predictability.py FILE data=elastomer size=small`` writes the mean squared difference [m²] over nodes, axes and the first frames, as in
``rollout_mse``, for scenes with unseen material parameters as comparisons use: all nodes moved by the same small way, or all
started with a slightly other velocity.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, parameter_values, trajectory_metadata
from gpe_pl.files.atomic import replacing
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State

HORIZONS = (20, 50, 100)
SHIFTS = (1e-4, 1e-3)
"""Of positions [m], in a direction of its own for every scene."""
VELOCITIES = (0.01, 0.03)
"""Added along it [m/s]."""


def positions(spec: DatasetSpec, state: State, index: int) -> np.ndarray:
    """Of the nodes in all frames [frame, node, dim]."""
    return rollout(spec.solver, state, spec.num_frames - 1, trajectory_metadata(spec, "test_unseen", index)).pos.astype(np.float64)


def main(file: Path, overrides: list[str]) -> None:
    """Simulate every scene from its start and from starts near it."""
    spec, rng = dataset("data.seed=1", *overrides), np.random.default_rng(0)
    table = []
    for index in range(spec.num_test_unseen):
        state = initial_state(spec, "test_unseen", index)
        (own,) = parameter_values(spec, "test_unseen", index)[0].values()
        parameter = next(iter(own.values()))
        direction = rng.normal(size=len(spec.scene.bounds))
        direction /= np.linalg.norm(direction)
        truth = positions(spec, state, index)
        starts = [("shift [m]", d, replace(state, pos=state.pos + d * direction), d * direction) for d in SHIFTS]
        starts += [("velocity [m/s]", d, replace(state, vel=state.vel + d * direction), 0.0 * direction) for d in VELOCITIES]
        for what, size, start, moved in starts:
            squares = ((positions(spec, start, index) - moved - truth) ** 2).mean(axis=(1, 2))[1:]
            errors = [float(squares[:h].mean()) for h in HORIZONS] + [float(squares.mean())]
            table.append((parameter, what, size, *(f"{e:.4g}" for e in errors)))
    with replacing(file) as part, part.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["parameter", "change", "size", *(f"mse_{h}" for h in HORIZONS), "mse_full"])
        writer.writerows(sorted(table))


if __name__ == "__main__":
    if len(sys.argv) < 2 or not sys.argv[1].endswith(".csv"):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2:])
