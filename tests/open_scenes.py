"""Open scenes for tests: two inlets with different material parameters, one of them with a speed that changes its sign, and an outlet."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

DT, SPACING, BOUNDS, GRAVITY = 0.05, 0.1, ((0.0, 1.0), (0.0, 1.0)), (0.0, -2.0)
SAND = node_code("sand")
STEADY = Opening((0.0, 0.5), (0.2, 0.7), "x_low", 1.0, SPACING, SAND, 2.0, (30.0,))
TURNING = Opening((0.4, 0.8), (0.7, 1.0), "y_high", None, SPACING, SAND, 3.0, (40.0,), ((0.0, 0.8), (0.4, 0.8), (0.8, -0.8)))
OUTLET = Opening((0.0, -0.5), (1.0, 0.2), "y_low")
OPENINGS = (STEADY, TURNING, OUTLET)


def open_state() -> State:
    """Return the state of the scene at the start: what is in the inlets."""
    inlets = [opening for opening in OPENINGS if opening.enters]
    pos = [opening.nodes_at_start() for opening in inlets]

    def of_inlets(values: list[Any]) -> np.ndarray:
        return np.concatenate([np.full((len(own), *np.shape(value)), value) for own, value in zip(pos, values, strict=True)])

    state = State(
        np.concatenate(pos), of_inlets([o.velocity_at(0.0) for o in inlets]), of_inlets([o.node_type for o in inlets]).astype(np.uint8),
        of_inlets([o.mass for o in inlets]), of_inlets([o.params for o in inlets]).astype(float),
        Boundary.sample(domain_walls(BOUNDS, 0.0), SPACING, 2), np.array(GRAVITY), param_names=("friction_angle",),
    )  # fmt: skip
    return state.opened(OPENINGS)


def open_trajectory(num_frames: int = 25, split: str = "train") -> Trajectory:
    """Return nodes that leave the inlets and then fall freely, in the precision of stored data."""
    metadata = Metadata(
        "open", ("sand",), ("friction_angle",), DT, SPACING, 0.25, BOUNDS, GRAVITY, split=split, solver="ballistic", solver_version="1"
    )
    start = open_state()  # with a history, velocities are the means over frames, which the baseline continues
    exact = rollout(Ballistic(DT), replace(start, velocity_history=np.asarray(start.vel)[:, None]), num_frames - 1, metadata)
    return replace(exact, pos=exact.pos.astype(np.float32), vel=exact.vel.astype(np.float32), is_prediction=False)
