"""Training and rollouts of models on open scenes: unrolls whose nodes enter and leave, checkpoints of them, validation, and compiled passes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import lightning as L
import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import StartKey, WindowDataset, collated, open_split
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.open_scenes import present
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import rollout, steps
from gpe_pl.system.compiled import unfused
from gpe_pl.training.callbacks import RolloutValidation
from gpe_pl.training.module import TrainingModule
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Termination
from tests.open_scenes import open_trajectory
from tests.scenes import assert_equal_graphs

KEYS = (StartKey(0, 0, 3), StartKey(1, 8, 3))


@pytest.fixture
def data(tmp_path: Path) -> WindowDataset:
    write_shard(tmp_path / "train" / "shard-00000.h5", [open_trajectory()])
    stored = open_split(tmp_path, "train")
    return WindowDataset(stored, GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata))


@pytest.fixture
def simulator(data: WindowDataset) -> LearnedSimulator:
    torch.manual_seed(0)
    return LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=8), data.builder)


def starts(data: WindowDataset, num_steps: int = 3) -> list[object]:
    return [data[key._replace(num_steps=num_steps)] for key in KEYS]


def test_unrolls_go_through_the_openings(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module = TrainingModule(simulator, 10)
    for num_steps in range(4):
        assert torch.isfinite(module.loss(starts(data, num_steps)))  # type: ignore[arg-type]
    under_way = module._excursions._lanes[0]
    for key, state in zip(KEYS, under_way.states, strict=True):
        expected = data[key].state
        first = expected.num_nodes
        assert state.node_id is not None
        assert expected.node_id is not None
        *_, expected = steps(simulator, expected, 4)
        assert expected.node_id is not None
        assert torch.equal(state.node_id, expected.node_id)
        torch.testing.assert_close(state.pos, expected.pos, rtol=0, atol=1e-7)
        assert state.num_nodes != first


def test_a_checkpoint_goes_on_with_the_nodes_that_are_there(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module, resumed = TrainingModule(simulator, 10), TrainingModule(simulator, 10)
    for num_steps in range(3):
        module.loss(starts(data, num_steps))  # type: ignore[arg-type]
    stored = module._excursions.state_dict()
    resumed._excursions.load_state_dict(stored)
    graphs = [m._excursions.graphs(simulator, starts(data)) for m in (module, resumed)]  # type: ignore[arg-type]
    assert_equal_graphs(*graphs)
    assert graphs[0]["sand"].num_nodes != sum(start.state.num_nodes for start in starts(data))  # type: ignore[attr-defined]


def test_nodes_without_target_have_no_effect_on_the_loss(data: WindowDataset, simulator: LearnedSimulator) -> None:
    module, batch = TrainingModule(simulator, 10), collated([data[3], data[12]])
    store = batch["sand"]  # type: ignore[call-overload]
    loss = module.loss(batch)
    assert store.without_target.any()
    store.target = store.target + torch.where(store.without_target, 1e6, 0.0)[:, None]
    assert torch.equal(module.loss(batch), loss)
    module.validation_step(batch, 0)  # type: ignore[arg-type]
    assert float(module.val_nmse.squared_target) < 1e6


def test_validation_has_metrics_of_open_scenes(simulator: LearnedSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = open_trajectory()
    whole = truth.frames(2)
    short = replace(whole.frames(0, 8), termination=Termination("nan", 8, 0, ""), is_prediction=True)
    assert short.num_nodes < whole.num_nodes
    monkeypatch.setattr("gpe_pl.training.callbacks.rollouts", lambda *_: [whole, short])
    found: dict[str, float] = {}
    module = Mock(spec=L.LightningModule, simulator=simulator, log=lambda name, value, **_: found.update({name: value}))
    RolloutValidation([truth, truth], 22, containment=False).on_validation_epoch_end(Mock(spec=L.Trainer, sanity_checking=False), module)
    assert found.keys() == {"val/rollout_mse", "val/mass_error", "val/outflow_error"}
    assert found["val/mass_error"] == found["val/outflow_error"] == 0.0
    assert found["val/rollout_mse"] == pytest.approx(0.5 * 15 / 22)  # frames that lack count as the side of the domain


def test_compiled_and_plain_passes_agree_in_open_scenes(data: WindowDataset, simulator: LearnedSimulator) -> None:
    simulator.eval()
    truth = data.trajectories[0].whole()
    start = simulator.initial_state(truth, 2)
    fast = rollout(simulator, start, 12, truth.metadata)
    with unfused():
        plain = rollout(simulator, start, 12, truth.metadata)
    assert fast.termination is None
    np.testing.assert_array_equal(present(fast), present(plain))
    assert len({*present(fast).sum(axis=1).tolist()}) > 2
    np.testing.assert_allclose(fast.pos, plain.pos, atol=1e-5)
