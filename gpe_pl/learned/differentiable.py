"""A learned simulator whose states autograd can use."""

from __future__ import annotations

from dataclasses import dataclass

from gpe_pl.learned.approximate import Batched
from gpe_pl.learned.mirror_average import MirrorAverage
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.state import State


@dataclass(frozen=True)
class Differentiable(Batched):
    """A learned simulator whose states can be used in training and for gradients. Those of ``LearnedSimulator.step_all`` can be used for inference only.

    Both make the same steps, also with ``mirror_average``.
    """

    simulator: LearnedSimulator

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        simulator = self.simulator
        if not simulator.mirror_average:
            return simulator.next_states(states)
        average = MirrorAverage.of(simulator.builder, simulator.model)  # kept images would have no gradients, or those of another step
        return average.next_states(simulator.next_states, states)
