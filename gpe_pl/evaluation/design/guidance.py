"""Distance of nodes from a target as a function of the pose of an obstacle, with its gradient through the whole rollout.

The misfit is the logarithm of the mean squared distance of all nodes from the target in the last frame. Rollouts are those of the model alone, without
containment, so that the obstacle acts through the boundary nodes that the model sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gpe_pl.evaluation.design.pose import NAMES, Obstacle
from gpe_pl.evaluation.rollout_scores import rollout_scores
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.start_checks import DerivativeError
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata


@dataclass
class Guidance:
    """Misfit of a design as a function of numbers from 0 to 1, one for each part of the pose that may change. 0.5 is the start.

    Attributes:
        simulator: the model.
        state: the scene at the start, as tensors, with velocities at that instant.
        metadata: metadata of the scene.
        obstacle: the obstacle that is moved.
        limits: largest shifts [m] and angle [rad], of both signs; 0 keeps a part of the pose.
        target: point that the nodes should reach [2] in m.
        num_frames: number of frames after which their distance counts.
        failed: squared distance of a rollout that fails [m²].
        num_evaluations, num_gradients: numbers of calls so far.
    """

    simulator: LearnedSimulator
    state: State
    metadata: Metadata
    obstacle: Obstacle
    limits: tuple[float, float, float]
    target: np.ndarray
    num_frames: int
    failed: float
    num_evaluations: int = 0
    num_gradients: int = 0

    @property
    def unknowns(self) -> tuple[str, ...]:
        return tuple(name for name, limit in zip(NAMES, self.limits, strict=True) if limit)

    def pose(self, z: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the pose [3] at numbers from 0 to 1 [unknown]."""
        return self._pose(torch.tensor(np.asarray(z, dtype=np.float64))).numpy()

    def _pose(self, z: Tensor) -> Tensor:
        limits = torch.tensor(self.limits, dtype=torch.float64)
        rows = torch.nonzero(limits).flatten()
        return torch.zeros(3, dtype=torch.float64).index_copy(0, rows, limits[rows] * (2 * z - 1))

    def misfit(self, z: Sequence[float] | np.ndarray) -> float:
        """Return the misfit at numbers from 0 to 1 [unknown]."""
        self.num_evaluations += 1
        with torch.no_grad():
            return float(self._misfit(torch.tensor(np.asarray(z, dtype=np.float64))))

    def misfit_and_gradient(self, z: Sequence[float] | np.ndarray) -> tuple[float, np.ndarray]:
        """Return the misfit and its gradient. The gradient of a rollout that fails is zero, and that of a model without gradients is not a number."""
        self.num_gradients += 1
        at = torch.tensor(np.asarray(z, dtype=np.float64), requires_grad=True)
        with torch.enable_grad():
            misfit = self._misfit(at)
            try:
                gradient = torch.autograd.grad(misfit, at)[0].numpy() if misfit.requires_grad else np.zeros(len(at))
            except DerivativeError:
                gradient = np.full(len(at), np.nan)
        return float(misfit.detach()), gradient

    def _misfit(self, z: Tensor) -> Tensor:
        def last(_: int, frame: int, state: State) -> Tensor | None:
            return squared_distance(state.pos, torch.from_numpy(self.target)) if frame == self.num_frames else None

        moved = self.obstacle.moved(self.state, self._pose(z))
        start = self.simulator.standing(moved, self.metadata)  # velocities before the start depend on what is near the obstacle
        square = rollout_scores(self.simulator, {0: start}, self.num_frames, last).get((0, self.num_frames))
        if square is None or not bool(square < self.failed):
            return torch.tensor(math.log(self.failed), dtype=torch.float64)
        return torch.log(square)


def squared_distance(pos: Tensor, target: Tensor) -> Tensor:
    """Return the mean squared distance of positions [node, dim] from a point [dim]."""
    return (pos - target).square().sum(dim=1).mean()
