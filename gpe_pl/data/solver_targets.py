"""Training targets for states that no stored trajectory contains: the solver's step from there.

Noise and unrolls lead away from the true trajectory. The usual target leads back to it within a step, which no physical force does: a body that swings has
restoring forces, and a strain that noise causes changes the motion. The target here is the true acceleration, plus the difference between two steps of the
solver: one from the deviating state, one from the true state. Both steps start from positions and velocities only, without the solver's internal state, so
errors due to its absence cancel to first order. Without a deviation the target is that of the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from gpe_pl.rollout.loop import Restartable, SimulationError
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.reflection import Reflection
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class SolverTargets:
    """A solver, and the frames of a true trajectory from which an unroll deviates.

    A learned simulator knows the mean velocity since the frame before; a solver needs the velocity at the frame. The deviating state gets the true velocity at
    the frame plus the deviation of the mean velocity.

    Attributes:
        solver: solver of the data set.
        scene: true state at the start of the unroll.
        pos: true positions in m, from the frame before the start on [num_steps + 3, node, dim].
        vel: true velocities at the frames in m/s, from the start on [num_steps + 1, node, dim].
        stress: true stress of nodes in Pa, from the frame after the start on [num_steps + 1, node, component]; None if the data have none.
        frame_dt: frame interval [s].
        reflection: converts between coordinates of the data set and of the unroll, which may be its mirror image.
    """

    solver: Restartable
    scene: State
    pos: Float64[np.ndarray, "frame node dim"]
    vel: Float64[np.ndarray, "start node dim"]
    stress: np.ndarray | None
    frame_dt: float
    reflection: Reflection

    @classmethod
    def of(cls, solver: Restartable, trajectory: Trajectory, first: int, reflection: Reflection) -> SolverTargets:
        """Return the targets of unrolls from frame ``first`` of a part of a stored trajectory to the last frame but one of this part."""
        pos = trajectory.pos[first - 1 :].astype(np.float64)
        vel = trajectory.vel[first:-1].astype(np.float64)
        stress = None if trajectory.stress is None else trajectory.stress.node[first + 1 :]
        return cls(solver, trajectory.state(first), pos, vel, stress, trajectory.metadata.frame_dt, reflection)

    def target(self, state: State, step: int) -> tuple[Tensor, Tensor | None] | None:
        """Return acceleration without gravity [node, dim] in m/s² and stress after the step [node, component] in Pa, or None if the solver refuses a state.

        Args:
            state: state that the unroll has reached, as torch tensors.
            step: number of steps of the unroll so far.
        """
        where, dt = state.periodicity, self.frame_dt
        pos, mean = self.reflection.point(state.pos.cpu().numpy()), self.reflection.vector(state.vel.cpu().numpy())
        before, after = integrators.velocities(self.pos[step : step + 3], dt, where)
        try:
            own = state.frame_velocity
            at_frame = self.vel[step] + mean - before if own is None else self.reflection.vector(own.cpu().numpy())
            here = self._step(pos, at_frame, step)
            there = self._step(self.pos[step + 1], self.vel[step], step)
        except SimulationError:
            return None
        after_here = integrators.velocities(np.stack([pos, here.pos]), dt, where)[0]
        true = integrators.velocities(np.stack([self.pos[step + 1], there.pos]), dt, where)[0]
        vel = after + after_here - true
        acceleration = self.reflection.vector(integrators.acceleration(vel, mean, dt) - np.asarray(self.scene.gravity))
        target = torch.from_numpy(acceleration).to(state.pos.device)
        if self.stress is None or here.stress is None or there.stress is None:
            return target, None
        after_step = self.reflection.tensor(self.stress[step] + here.stress.node - there.stress.node)
        return target, torch.from_numpy(after_step).to(state.pos.device)

    def _step(self, pos: np.ndarray, vel: np.ndarray, step: int) -> State:
        start = replace(self.scene, pos=pos, vel=vel, time=self.scene.time + step * self.frame_dt, boundary=self.scene.boundary.at(step))
        return self.solver.step(self.solver.restarted(start))
