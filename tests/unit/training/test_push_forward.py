"""Where a simulator comes to by itself, training goes on from there; what it did on the way gets no gradient."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch_geometric.data import Batch

from gpe_pl.data.dataset import Start, WindowDataset, open_split
from gpe_pl.data.sampling import PushForward
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned_simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout import SimulationError
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.push_forward import pushed
from gpe_pl.training.run import TrainingSettings
from gpe_pl.trajectory import State
from tests.scenes import assert_equal_graphs


@pytest.fixture
def data(store: Path) -> WindowDataset:
    stored = open_split(store, "train")
    return WindowDataset(stored, GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata))


@pytest.fixture
def simulator(data: WindowDataset) -> LearnedSimulator:
    torch.manual_seed(0)
    return LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder)


def test_it_is_the_simulators_own_rollout(data: WindowDataset, simulator: LearnedSimulator) -> None:
    starts = [data[0, 0, 2], data[1, 3, 1]]
    graphs = []
    for start in starts:
        state = start.state
        for _ in range(start.own_steps):
            state = simulator.step(state)
        graphs.append(start.graph(data.builder, state, start.own_steps))
    simulator.train()
    assert_equal_graphs(pushed(simulator, starts), Batch.from_data_list(graphs), rtol=1e-5, atol=1e-5)
    assert simulator.training


def test_its_loss_has_a_gradient_of_one_step(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, num_steps=10)
    starts = [data[0, 0, 2]]
    graph = module.graphs(starts)
    module.training_step(starts, 0).backward()  # type: ignore[union-attr]
    gradients = [p.grad.clone() for p in module.parameters() if p.grad is not None]
    module.zero_grad()
    module.loss(graph).backward()
    assert len(gradients) > 5
    for a, b in zip(gradients, (p.grad for p in module.parameters() if p.grad is not None), strict=True):
        assert torch.equal(a, b)


def test_a_scene_that_falls_apart_on_the_way_ends_where_it_was_whole(
    data: WindowDataset, simulator: LearnedSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, first = simulator.next_states, data[0, 0, 2]

    def fails_later(states: list[State]) -> list[State | SimulationError]:
        return [SimulationError("no") if state.time > first.state.time else new for state, new in zip(states, usual(states), strict=True)]

    monkeypatch.setattr(simulator, "next_states", fails_later)
    after = first.graph(data.builder, simulator.step(first.state), 1)
    assert_equal_graphs(pushed(simulator, [first]), Batch.from_data_list([after]), rtol=1e-5, atol=1e-5)


def test_weights_of_graphs_weigh_their_nodes(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, num_steps=10)
    graphs = [data[0], data[3]]
    losses = [module.loss(Batch.from_data_list([g])) for g in graphs]
    for graph, weight in zip(graphs, (0.5, 3.0), strict=True):
        graph.weight = weight
    assert float(module.loss(Batch.from_data_list(graphs))) == pytest.approx(float(0.5 * losses[0] + 3.0 * losses[1]) / 2, rel=1e-5)


def test_a_start_can_be_moved(data: WindowDataset) -> None:
    moved: Start = data[0, 0, 2].to("cpu")
    assert moved.own_steps == 2 and torch.equal(moved.truth, data[0, 0, 2].truth)


def test_settings_of_older_runs_are_known_again() -> None:
    old = TrainingSettings(num_steps=10, val_interval=5)
    assert not {"sampling", "push_share", "push_steps"} & old.as_dict().keys()
    assert old.push_forward is None
    new = TrainingSettings(num_steps=10, val_interval=5, sampling="activity", push_share=0.3, push_steps=4)
    assert {k: new.as_dict()[k] for k in ("sampling", "push_share", "push_steps")} == {
        "sampling": "activity",
        "push_share": 0.3,
        "push_steps": 4,
    }
    assert new.push_forward == PushForward(7, 4)
