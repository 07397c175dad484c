"""Training states that a simulator has come to by itself.

A step of training predicts what the simulator needs for a step of its own, so the way on is free: every batch of states is trained on, moved on by that
prediction, and waits until its turn comes again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.data.dataset import Start
from gpe_pl.graphs.batching import batched
from gpe_pl.learned_simulator import LearnedSimulator
from gpe_pl.rollout import SimulationError
from gpe_pl.trajectory import State


@dataclass
class Excursion:
    """A batch under way: its samples, where each of them is, and after how many steps of its own."""

    samples: list[int]
    states: list[State]
    steps: list[int]
    graphs: list[HeteroData]


class Excursions:
    """All batches that a simulator is under way with, one per lane (see ``PushForward``).

    What they hold is never stored. After ``clear`` they are walked again from their starts, with the weights of the day; a run that clears them whenever it
    saves a checkpoint goes on from it as it would have anyway.
    """

    def __init__(self) -> None:
        self._lanes: dict[int, Excursion] = {}

    def clear(self) -> None:
        self._lanes.clear()

    def graphs(self, simulator: LearnedSimulator, starts: Sequence[Start]) -> HeteroData:
        """Graphs of the states after each start's own steps. A scene that has come to nothing, or to the end of the truth, is at its start again."""
        samples = [start.sample for start in starts]
        under_way = self._lanes.get(starts[0].lane)
        if under_way is None or under_way.samples != samples:
            under_way = Excursion(samples, *walked(simulator, starts), [])
        under_way.graphs = []
        for k, start in enumerate(starts):
            graph = _graph(simulator, start, under_way.states[k], under_way.steps[k])
            if graph is None:
                under_way.states[k], under_way.steps[k] = start.state, 0
                graph = start.graph(simulator.builder, start.state, 0)
            under_way.graphs.append(graph)
        self._lanes[starts[0].lane] = under_way
        return batched(under_way.graphs)

    @torch.no_grad()
    def move_on(self, simulator: LearnedSimulator, lane: int, acceleration: dict[str, Tensor]) -> None:
        """One step further, with what was predicted for the graphs."""
        under_way = self._lanes[lane]
        under_way.states = simulator.moved(under_way.states, under_way.graphs, acceleration)
        under_way.steps = [step + 1 for step in under_way.steps]
        under_way.graphs = []


def _graph(simulator: LearnedSimulator, start: Start, state: State, step: int) -> HeteroData | None:
    if step > start.own_steps:
        return None
    try:
        return start.graph(simulator.builder, state, step)
    except SimulationError:
        return None


@torch.no_grad()
def walked(simulator: LearnedSimulator, starts: Sequence[Start]) -> tuple[list[State], list[int]]:
    """States after each start's own steps, all starts at once, and how many steps they made: fewer where a scene has no graph any more."""
    states, steps = [start.state for start in starts], [0] * len(starts)
    going = [k for k, start in enumerate(starts) if start.own_steps]
    was_training = simulator.training
    simulator.eval()
    try:
        while going:
            new = simulator.next_states([states[k] for k in going])
            for k, state in zip(going, new, strict=True):
                if not isinstance(state, SimulationError):
                    states[k], steps[k] = state, steps[k] + 1
            going = [
                k for k, state in zip(going, new, strict=True) if not isinstance(state, SimulationError) and steps[k] < starts[k].own_steps
            ]
    finally:
        simulator.train(was_training)
    return states, steps
