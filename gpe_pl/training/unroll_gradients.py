"""Unrolls with gradients: the errors of several steps in a row are in the loss, and gradients pass through the states between them.

Push-forward (``training.push_forward``) also trains on unrolled states, but its unrolls get no gradients.

Source: Ummenhofer et al. 2020, "Lagrangian Fluid Simulation with Continuous Convolutions", ICLR, section 4, with two steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torch_geometric.data import HeteroData

from gpe_pl.data.training_samples import Unroll
from gpe_pl.graphs.batching import batched
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.base import Prediction
from gpe_pl.rollout.loop import SimulationError


def predictions(simulator: LearnedSimulator, unrolls: Sequence[Unroll]) -> Iterator[tuple[HeteroData, Prediction]]:
    """Yield the batch of training graphs and its prediction for each step of unrolls of equal length.

    A scene leaves the unroll when no graph of its state can be built. If no scene is left, fewer steps are yielded.
    """
    scenes, states, graphs = list(unrolls), [u.state for u in unrolls], [u.graph for u in unrolls]
    for step in range(1, unrolls[0].num_steps + 1):
        batch = batched(graphs)
        predicted = simulator(batch)
        yield batch, predicted
        if step == unrolls[0].num_steps:
            return
        moved = zip(scenes, simulator.moved(states, graphs, predicted), strict=True)
        scenes, states, graphs = [], [], []
        for scene, state in moved:
            try:
                graphs.append(scene.graph_after(simulator.builder, state, step))
            except SimulationError:
                continue
            scenes.append(scene)
            states.append(state)
        if not scenes:
            return
