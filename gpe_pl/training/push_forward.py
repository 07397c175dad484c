"""Training states that a simulator has come to by itself."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch_geometric.data import Batch

from gpe_pl.data.dataset import Start
from gpe_pl.learned_simulator import LearnedSimulator
from gpe_pl.rollout import SimulationError


@torch.no_grad()
def pushed(simulator: LearnedSimulator, starts: Sequence[Start]) -> Batch:
    """Graphs of the states after each start's own steps, all starts at once; where a scene has no graph any more, of the last one that had."""
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
    graphs = [start.graph(simulator.builder, state, step) for start, state, step in zip(starts, states, steps, strict=True)]
    return Batch.from_data_list(graphs)
