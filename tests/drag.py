"""A simulator with drag, and bodies that it throws, whose parameters can be identified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

DT, ANGLE = 0.01, 31.0
BOUNDS, FLUID_BOUNDS = {"sand.friction_angle": (20.0, 42.5)}, {"fluid.kinematic_viscosity": (1e-3, 1.0)}


@dataclass(frozen=True)
class Drag:
    """A simulator in which the first material parameter slows nodes down: v' = g - rate · parameter · v. It can start anywhere."""

    rate: float = 0.1
    can_restart: bool = True

    def restarted(self, state: State) -> State:
        return state

    def step(self, state: State) -> State:
        column = np.nan_to_num(np.asarray(state.material_params, dtype=np.float64)).sum(axis=1, keepdims=True)
        vel = (state.vel + DT * np.asarray(state.gravity)) / (1 + DT * self.rate * column)
        return state.later(DT, state.pos + DT * vel, vel)


def thrown(values: float | np.ndarray = ANGLE, material: str = "sand", simulator: Drag | None = None, num_frames: int = 40) -> Trajectory:
    """Return two bodies that fly under gravity and drag."""
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 2) * 0.1
    pos = np.concatenate([grid, grid + np.array([1.0, 0.0])])
    name = {"sand": "friction_angle", "fluid": "kinematic_viscosity"}[material]
    still = Trajectory.from_numpy(
        np.repeat(pos[None], 3, axis=0), DT, material, {material: {name: np.broadcast_to(values, 18).copy()}},
        vel=np.broadcast_to([1.0, 0.5], (3, 18, 2)).copy(), bounds=[(-5, 5), (-5, 5)], gravity=[0.0, -9.81], spacing=0.1,
    )  # fmt: skip
    return rollout(simulator or Drag(), still.state(0), num_frames - 1, still.metadata)
