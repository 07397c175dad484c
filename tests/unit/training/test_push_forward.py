"""Push-forward: training continues from states of the simulator's unroll, and the unroll gets no gradient."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import StartKey, WindowDataset, open_split
from gpe_pl.data.sampling import PushForward
from gpe_pl.data.training_samples import UnrollStart
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.topology import Topology
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import node_code
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.push_forward import unrolled
from gpe_pl.training.run import TrainingSettings
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.boundary import BoundaryMotion
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.scenes import assert_equal_graphs


@pytest.fixture
def data(store: Path) -> WindowDataset:
    stored = open_split(store, "train")
    return WindowDataset(stored, GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata))


@pytest.fixture
def simulator(data: WindowDataset) -> LearnedSimulator:
    torch.manual_seed(0)
    return LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder)


def test_a_walk_is_the_simulators_own_rollout(data: WindowDataset, simulator: LearnedSimulator) -> None:
    starts = [data[StartKey(0, 0, 2)], data[StartKey(1, 3, 1)]]
    simulator.train()
    states, steps = unrolled(simulator, starts)
    assert steps == [2, 1] and simulator.training
    for start, state in zip(starts, states, strict=True):
        expected = start.state
        for _ in range(start.num_steps):
            expected = simulator.step(expected)
        assert torch.allclose(state.pos, expected.pos, rtol=0, atol=1e-9)


def test_a_scene_that_falls_apart_on_the_way_ends_where_it_was_whole(
    data: WindowDataset, simulator: LearnedSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, first = simulator.next_states, data[StartKey(0, 0, 2)]

    def fails_later(states: list[State]) -> list[State | SimulationError]:
        return [SimulationError("no") if state.time > first.state.time else new for state, new in zip(states, usual(states), strict=True)]

    monkeypatch.setattr(simulator, "next_states", fails_later)
    (state,), steps = unrolled(simulator, [first])
    assert steps == [1]
    torch.testing.assert_close(state.pos, simulator.step(first.state).pos, rtol=0, atol=1e-6)


def visits(data: WindowDataset, samples: list[tuple[int, int]], lane: int, num_visits: int) -> list[list[UnrollStart]]:
    return [[data[StartKey(sample, window, step, lane)] for sample, window in samples] for step in range(num_visits)]


def test_steps_of_training_move_the_states_on(data: WindowDataset, simulator: LearnedSimulator) -> None:
    """With constant weights, unrolls equal the simulator's rollout. Other lanes have no influence."""
    module = TrainingModule(simulator, num_steps=10)
    lanes = [visits(data, [(0, 0), (1, 3)], 0, 3), visits(data, [(2, 3), (3, 0)], 1, 3)]
    for step in range(3):
        for turn in lanes:
            excursions = copy.deepcopy(module._excursions)
            graph = excursions.graphs(simulator, turn[step])
            states, steps = unrolled(simulator, turn[step])
            assert steps == [step, step]
            expected = [start.graph(data.builder, state, step) for start, state in zip(turn[step], states, strict=True)]
            assert_equal_graphs(graph, batched(expected), rtol=1e-4, atol=1e-4)
            module.loss(turn[step])


def test_liquid_nodes_keep_their_distance_in_steps_of_training_as_in_rollouts(
    new_trajectory: Callable[..., Trajectory], tmp_path: Path
) -> None:
    truth = new_trajectory(materials=("fluid",), param_names=("kinematic_viscosity",))
    truth = replace(
        truth, node_type=np.full_like(truth.node_type, node_code("fluid")), material_params=np.full_like(truth.material_params, 0.1)
    )
    write_shard(tmp_path / "train" / "shard-00000.h5", [truth])
    stored = open_split(tmp_path, "train")
    data = WindowDataset(stored, GraphBuilder(GraphConfig(history=2), truth.metadata))
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder)
    simulator.least_distance = 0.1
    module = TrainingModule(simulator, num_steps=10).train()
    for step in range(3):
        module.loss([data[StartKey(0, 0, step)]])
    (moved,), expected = module._excursions._lanes[0].states, data[StartKey(0, 0, 0)].state
    for _ in range(3):
        expected = simulator.eval().step(expected)
    torch.testing.assert_close(moved.pos, expected.pos, rtol=0, atol=1e-5)
    assert nearest_distances(moved.pos.numpy(), moved.periodicity).min() > 0.07  # without it, nodes come as near as 0.066


def test_at_the_end_of_the_truth_and_after_falling_apart_a_sample_is_at_its_start_again(
    data: WindowDataset, simulator: LearnedSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, last = TrainingModule(simulator, num_steps=10), len(data) - 2
    turns = visits(data, [(0, last)], 0, 4)
    assert turns[3][0].num_steps == 1  # as far as the trajectory goes
    usual = batched([turns[0][0].graph(data.builder, turns[0][0].state, 0)])
    for starts in turns[:2]:
        module.loss(starts)
    assert_equal_graphs(module._excursions.graphs(simulator, turns[2]), usual)

    module._excursions.clear()
    module.loss(turns[0])
    found = GraphBuilder.topology

    def fails_under_way(self: GraphBuilder, state: State) -> Topology:
        if state.time > turns[0][0].state.time:
            raise SimulationError("no")
        return found(self, state)

    monkeypatch.setattr(GraphBuilder, "topology", fails_under_way)
    assert_equal_graphs(module._excursions.graphs(simulator, turns[1]), usual)


def test_a_validation_ends_all_excursions(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, num_steps=10)
    turns = visits(data, [(0, 0)], 0, 3)
    module.loss(turns[0])
    optimizer = torch.optim.SGD(module.parameters(), lr=1e-3)
    module.loss(turns[1]).backward()
    optimizer.step()
    (state,), _ = unrolled(simulator, turns[2])
    expected = batched([turns[2][0].graph(data.builder, state, 2)])
    going_on = copy.deepcopy(module._excursions).graphs(simulator, turns[2])
    assert not torch.equal(going_on["sand"].target, expected["sand"].target)
    module.on_validation_start()
    assert_equal_graphs(module._excursions.graphs(simulator, turns[2]), expected)


def test_an_unroll_gets_no_gradient(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, num_steps=10)
    starts = [data[StartKey(0, 0, 2)]]
    graph = module._excursions.graphs(simulator, starts)
    module._excursions.clear()
    module.training_step(starts, 0).backward()  # type: ignore[union-attr]
    gradients = [p.grad.clone() for p in module.parameters() if p.grad is not None]
    module.zero_grad()
    module.loss(graph).backward()
    assert len(gradients) > 5
    for a, b in zip(gradients, (p.grad for p in module.parameters() if p.grad is not None), strict=True):
        assert torch.equal(a, b)


def test_weights_of_graphs_weigh_their_nodes(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, num_steps=10)
    graphs = [data[0], data[3]]
    losses = [module.loss(batched([g])) for g in graphs]
    for graph, weight in zip(graphs, (0.5, 3.0), strict=True):
        graph.weight = weight
    assert float(module.loss(batched(graphs))) == pytest.approx(float(0.5 * losses[0] + 3.0 * losses[1]) / 2, rel=1e-5)


def test_starts_reach_another_process_as_arrays(data: WindowDataset) -> None:
    start = data[StartKey(0, 0, 2)]
    sent = pickle.dumps(start)
    assert b"torch" not in sent
    received = pickle.loads(sent)
    assert torch.equal(received.truth, start.truth) and received.stress is None and received.about == start.about
    for ours, theirs in ((start.state, received.state), (start.state.boundary, received.state.boundary)):
        for name, value in vars(ours).items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(getattr(theirs, name), value) and getattr(theirs, name).dtype == value.dtype
    assert_equal_graphs(received.graph(data.builder, received.state, 0), start.graph(data.builder, start.state, 0))


def test_the_last_steps_are_unrolled() -> None:
    settings = TrainingSettings(num_steps=10, val_interval=5, push_steps=4)
    assert settings.push_forward is None
    assert replace(settings, push_fraction=0.3).push_forward == PushForward(7, 4)
    assert replace(settings, push_fraction=0.3, push_correction=0.2).push_forward == PushForward(7, 4, 0.2)


def test_walls_that_move_go_on_moving_on_the_way(
    store: Path, new_trajectory: Callable[..., Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first visit knows the walls for one frame only, later ones farther."""
    still = new_trajectory(0, num_frames=6)
    pos = still.boundary.pos + 0.01 * np.arange(6)[:, None, None].astype(np.float32)
    motion = BoundaryMotion(pos, np.ones_like(pos), np.repeat(still.boundary.normal[None], 6, axis=0))
    write_shard(store / "moving" / "shard-00000.h5", [replace(still, boundary=replace(still.boundary, vel=motion.vel[0], motion=motion))])
    data = WindowDataset(stored := open_split(store, "moving"), GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata))
    module = TrainingModule(
        LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder), num_steps=10
    )
    seen: list[torch.Tensor] = []
    plain = UnrollStart.target

    def target(self: UnrollStart, state: State, step: int, dt: float) -> Any:
        seen.append(state.boundary.pos)
        return plain(self, state, step, dt)

    monkeypatch.setattr(UnrollStart, "target", target)
    for starts in visits(data, [(0, 0)], 0, 3):
        module.loss(starts)
    first = data.locate(0)[1]
    assert [torch.equal(p, torch.from_numpy(pos[first + step]).double()) for step, p in enumerate(seen)] == [True, True, True]
