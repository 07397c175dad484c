"""Models that read the stress of the present frame: in graphs, rollouts, training windows, push-forward and checkpoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import StartKey, UnrollKey, WindowDataset, open_split
from gpe_pl.export.program import NodeLoadError, export_model
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.topology import GraphError
from gpe_pl.learned.approximate import Sleeping
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.system.compiled import unfused
from gpe_pl.training.push_forward import Excursions
from gpe_pl.training.unroll_gradients import predictions
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.bodies import cells, lattice
from tests.contracts.test_learned_simulator import builder_of, learned

DT, FRAMES, FRAME = 0.01, 8, 2


def body(forced: bool = False) -> Trajectory:
    """Return a mesh that swings, with a stress at its nodes and, if wanted, forces on them."""
    time, rest = DT * np.arange(FRAMES)[:, None], lattice() + 0.3
    pos = np.repeat(rest[None], FRAMES, axis=0)
    pos[..., 1] += 0.02 * np.sin(20 * time) * (rest[:, 0] - 0.3) / 0.2
    stress = 1e4 * np.sin(20 * time)[..., None] * (1 + np.arange(15 * 4).reshape(15, 4))
    return Trajectory.from_numpy(
        pos, DT, "elastomer", {"elastomer": 1e5}, cells=cells(), mass=0.01, spacing=0.05, bounds=((0.0, 1.0), (0.0, 1.0)), stress=stress,
        force=0.01 * np.ones(pos.shape) if forced else None,
    )  # fmt: skip


def simulator(whole: Trajectory, **settings: Any) -> LearnedSimulator:
    """Return a simulator that reads the stress, with random weights."""
    made = learned(builder_of(whole, mesh=True, islands=True, stress=True), **{"stress": True, **settings})
    torch.manual_seed(1)
    with torch.no_grad():
        for p in made.parameters():
            if not p.any():
                p.normal_(std=0.1)
    made.acceleration_std.fill_(10.0)
    made.stress_std.fill_(1e5)
    role = made.standardizer.node["elastomer"]
    role.std[-4 - 2 * bool(whole.force is not None) :].fill_(1e5)  # type: ignore[index,union-attr]
    return made


def true_stress(whole: Trajectory) -> np.ndarray:
    assert whole.stress is not None
    return whole.stress.node


def with_stress(state: Any, factor: float) -> Any:
    """Return a state whose stress is multiplied by a factor."""
    return replace(state, stress=replace(state.stress, node=factor * state.stress.node, cell=factor * state.stress.cell))


def windows(tmp_path: Path, made: LearnedSimulator, whole: Trajectory, **settings: Any) -> WindowDataset:
    (tmp_path / "train").mkdir(exist_ok=True)
    write_shard(tmp_path / "train" / "shard-00000.h5", [whole])
    return WindowDataset(open_split(tmp_path, "train"), made.builder, stress=True, **settings)


@pytest.mark.parametrize("forced", [False, True])
def test_graphs_have_the_stress_between_motion_and_loads(forced: bool) -> None:
    whole = body(forced)
    made = simulator(whole)
    state = made.initial_state(whole, FRAME)
    topology = made.builder.topology(state)
    x, motion = made.builder.graph(topology, state)["elastomer"].x, (made.builder.config.history + 1) * 2
    assert x.shape[1] == motion + 4 + 2 * forced == made.builder.spec.node_channels["elastomer"]
    np.testing.assert_array_equal(x[:, motion : motion + 4], true_stress(whole)[FRAME])
    with unfused():
        torch.testing.assert_close(made.builder.graph(topology, state)["elastomer"].x, x, rtol=1e-6, atol=1e-6)
    standardised = made.builder.graph(topology, state, made.standardizer.standards())["elastomer"].x
    torch.testing.assert_close(standardised, made.standardizer(made.builder.graph(topology, state))["elastomer"].x, rtol=1e-5, atol=1e-6)


def test_a_rollout_starts_with_the_true_stress_and_goes_on_with_its_own() -> None:
    whole = body()
    made = simulator(whole)
    start = made.initial_state(whole, FRAME)
    found = rollout(made, start, 3, whole.metadata)
    assert found.termination is None and found.stress is not None
    np.testing.assert_array_equal(found.stress.node[0], true_stress(whole)[FRAME])
    state = start
    for k in range(1, 4):  # equal to single steps, each from the stress that the step before predicted
        state = made.step(state)
        np.testing.assert_allclose(found.pos[k], state.pos, atol=1e-6)
        assert state.stress is not None
        np.testing.assert_allclose(found.stress.node[k], state.stress.node, rtol=1e-5)
    assert not torch.allclose(made.step(with_stress(start, 2.0)).pos, made.step(start).pos, atol=1e-7)
    after = made.step(start)
    assert not torch.allclose(made.step(with_stress(after, 2.0)).pos, made.step(after).pos, atol=1e-7)


def test_scenes_together_move_as_alone() -> None:
    whole = body()
    made = simulator(whole)
    states = [made.initial_state(whole, frame) for frame in (FRAME, FRAME + 1)]
    for alone, together in zip(map(made.step, states), made.step_all(states), strict=True):
        torch.testing.assert_close(together.pos, alone.pos, rtol=0, atol=1e-9)  # type: ignore[union-attr]


def test_a_rollout_decodes_the_stress_even_if_it_should_skip_it() -> None:
    whole = body()
    made = simulator(whole)
    made.skips = Skips(stress=True)
    assert not made.skips.stress and made.step(made.initial_state(whole, FRAME)).stress is not None


def test_a_checkpoint_keeps_the_setting(tmp_path: Path) -> None:
    whole = body()
    made = simulator(whole)
    made.save(tmp_path / "a.ckpt")
    loaded = LearnedSimulator.from_checkpoint(tmp_path / "a.ckpt")
    assert loaded.builder.config.stress and loaded.builder.spec.reads_stress
    state = made.initial_state(whole, FRAME)
    torch.testing.assert_close(loaded.step(state).pos, made.step(state).pos, rtol=0, atol=0)


def test_training_windows_have_the_true_stress(tmp_path: Path) -> None:
    whole = body()
    made = simulator(whole)
    graph = windows(tmp_path, made, whole)[0]["elastomer"]
    np.testing.assert_array_equal(graph.x[:, -4:], true_stress(whole)[FRAME].astype(np.float32))
    np.testing.assert_array_equal(graph.stress_target, true_stress(whole)[FRAME + 1].astype(np.float32))


def test_push_forward_reads_the_stress_that_the_model_predicted(tmp_path: Path) -> None:
    whole = body()
    made = simulator(whole)
    start = windows(tmp_path, made, whole)[StartKey(0, 0, 2)]
    one, two = made.step(start.state), made.step(made.step(start.state))
    own = Excursions()
    graphs = own.graphs(made, [start])
    torch.testing.assert_close(graphs["elastomer"].x[:, -4:].double(), two.stress.node, rtol=1e-5, atol=1e-2)  # type: ignore[union-attr]
    assert not torch.allclose(one.stress.node, two.stress.node, rtol=1e-3)  # type: ignore[union-attr]
    made.train()
    own.move_on(made, start.lane, made(graphs))
    resumed = Excursions()
    resumed.load_state_dict(own.state_dict())
    stored = own.state_dict()[start.lane][start.sample]
    three = made.eval().step(two)
    torch.testing.assert_close(stored["node_stress"], three.stress.node, rtol=1e-5, atol=1e-2)  # type: ignore[union-attr]


def test_unrolls_with_gradients_read_the_predicted_stress(tmp_path: Path) -> None:
    whole = body()
    made = simulator(whole)
    unroll = windows(tmp_path, made, whole, unroll_steps=2)[UnrollKey(0, 0)]
    made.train()
    (_, first), (batch, second) = predictions(made, [unroll])
    read, predicted = batch["elastomer"].x[:, -4:], first.stress["elastomer"] * made.stress_std
    torch.testing.assert_close(read.double(), predicted.double(), rtol=1e-5, atol=1e-2)
    assert read.requires_grad and second.acceleration["elastomer"].requires_grad


def test_what_lacks_a_stress_is_refused(tmp_path: Path) -> None:
    whole = body()
    made = simulator(whole)
    with pytest.raises(GraphError, match="the model predicts no stress.*model.stress=true"):
        simulator(whole, stress=False)
    with pytest.raises(GraphError, match="stores no stress of elastomer; set graph.stress=false"):
        builder_of(replace(whole, metadata=replace(whole.metadata, stress_materials=())), stress=True).spec  # noqa: B018
    with pytest.raises(GraphError, match="the state has no stress; give that of the first frame"):
        made.step(replace(made.initial_state(whole, FRAME), stress=None))
    with pytest.raises(GraphError, match="sleep_after: models with graph.stress=true"):
        Sleeping(made)
    with pytest.raises(NodeLoadError, match="do not read a stress"):
        export_model(made, tmp_path / "a.pt2")


def test_graphs_without_the_setting_are_as_before() -> None:
    assert not GraphConfig().stress
    whole = body()
    assert builder_of(whole, mesh=True).spec.node_channels["elastomer"] == 6
