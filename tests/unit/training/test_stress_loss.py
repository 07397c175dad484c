"""Relative errors of stress: a scene with small stresses counts as much as one with large ones."""

from __future__ import annotations

import pytest
import torch

from gpe_pl.graphs.batching import batched
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.training.loss_terms import LEAST_STRESS, StressLoss, stress_error
from gpe_pl.training.module import TrainingModule
from tests import scenes

GRAPH = torch.tensor([0, 0, 1])


@pytest.mark.parametrize(("loss", "expected"), [("square", 0.01 / 3 * (2 + 100**2)), ("relative", 0.01)])
def test_every_graph_counts_alike_with_relative_errors(loss: StressLoss, expected: float) -> None:
    target = torch.tensor([[1.0, -1.0], [-1.0, 1.0], [100.0, 100.0]])
    assert float(stress_error(1.1 * target, target, loss, GRAPH).mean()) == pytest.approx(expected, rel=1e-3)


def test_errors_of_tiny_stresses_are_limited() -> None:
    target = torch.zeros(3, 2)
    error = stress_error(target + LEAST_STRESS, target, "relative", GRAPH)
    torch.testing.assert_close(error, torch.ones(3, 2))


def test_the_loss_of_a_batch_is_the_mean_of_the_losses_of_its_scenes() -> None:
    build = scenes.builder(("solid",))
    graphs = [scenes.graph(("solid",), torch.float32) for _ in range(2)]
    for graph, pressure in zip(graphs, (0.01, 10.0), strict=True):
        graph["solid"].target = torch.ones(graph["solid"].num_nodes, 2)
        graph["solid"].stress_target = torch.full((graph["solid"].num_nodes, 4), pressure)
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8, stress=True), build)
    simulator.fit_statistics([batched(graphs)])
    module = TrainingModule(simulator, num_steps=10, stress_loss="relative", stress_weight=100.0, compile="off")
    both = module.loss(batched(graphs))
    torch.testing.assert_close(both, torch.stack([module.loss(batched([graph])) for graph in graphs]).mean())
    square = TrainingModule(simulator, num_steps=10, stress_weight=100.0, compile="off")
    assert float(square.loss(batched(graphs))) < float(both)
