"""A stress of any material is stored, trained on and predicted; data without one have no stress channels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.data.importers import save_dataset
from gpe_pl.evaluation.predictions import start_of
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.rollouts import rollout_metrics
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import rollouts
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory
from tests.sources import DT, motion

SAND = np.arange(20) % 3 == 0


def stressed(seed: int = 0, has_stress: bool = True) -> Trajectory:
    """Return sand without stress and a fluid with one; the fluid's pressure is its height."""
    pos = motion(seed=seed)
    stress = np.zeros((*pos.shape[:2], 4))
    stress[:, ~SAND] = np.array([-1.0, 0.0, -1.0, -1.0]) * pos[:, ~SAND, 1:]
    kinds = np.where(SAND, "sand", "fluid").tolist()
    return Trajectory.from_numpy(pos, DT, kinds, {"sand": 30.0, "fluid": 1e-3}, spacing=0.1, stress=stress if has_stress else None)


def test_a_stress_is_stored_trained_on_and_predicted(tmp_path: Path) -> None:
    save_dataset(tmp_path, "mine", train=[stressed(k) for k in range(3)])
    folder = tmp_path / "mine" / "imported"
    (stored,) = iter_trajectories(folder, "train")
    assert stored.metadata.with_stress == ("fluid",)
    assert stored.stress is not None
    np.testing.assert_allclose(stored.stress.node[:, ~SAND, 0], -stored.pos[:, ~SAND, 1], rtol=1e-6)
    build = GraphBuilder(GraphConfig(history=2), stored.metadata)
    assert build.spec.stress_channels == {"fluid": 4}
    windows = WindowDataset(open_split(folder, "train"), build, stress=True)
    graph = windows[3]
    assert graph["fluid"].stress_target.shape == (int((~SAND).sum()), 4)
    assert "stress_target" not in graph["sand"]
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8, stress=True), build).eval()
    simulator.fit_statistics([graph])
    assert float(simulator.stress_std) == pytest.approx(float(graph["fluid"].stress_target.square().mean().sqrt()))
    (predicted,) = rollouts(simulator, [start_of(simulator, 0, stored, stored)])
    assert predicted.stress is not None
    assert predicted.stress.node.shape == stored.stress.node.shape
    assert (predicted.stress.node[1:, ~SAND] != 0).all() and (predicted.stress.node[:, SAND] == 0).all()
    assert "stress_error" in {r.metric for r in rollout_metrics(predicted, stored, ["full"])}


def test_without_a_stress_there_are_no_channels(tmp_path: Path) -> None:
    report = save_dataset(tmp_path, "some", train=[stressed(0), stressed(1, has_stress=False), stressed(2), stressed(3)])
    assert [event.what for event in report.refusals] == ["has no stress, which other trajectories have; give it to all or to none"]
    solid = Trajectory.from_numpy(motion(), DT, "solid", {"solid": 1e6})
    assert GraphBuilder(GraphConfig(), solid.metadata).spec.stress_channels == {}


@pytest.mark.slow
def test_trajectories_without_a_stress_do_not_count_for_the_splits(tmp_path: Path) -> None:
    """They would fill a shard, and be those that are held out."""
    train = [stressed(k, has_stress=k < 8) for k in range(20)]
    report = save_dataset(tmp_path, "some", holdout=0.2, train=train)
    assert len(report.refusals) == 12
    assert [len([*iter_trajectories(Path(report.folder), split)]) for split in ("train", "val", "test")] == [4, 2, 2]


def test_a_stress_of_another_shape_is_refused() -> None:
    pos = motion()
    with pytest.raises(ArrayError, match=r"stress: has shape \[10, 20, 6\], expected \[frame 10, node 20, component 4\]"):
        Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, stress=np.zeros((10, 20, 6)))


def test_a_rollout_from_frame_0_has_the_stored_velocities_as_history() -> None:
    trajectory = stressed()
    build = GraphBuilder(GraphConfig(history=3), trajectory.metadata)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    start = start_of(simulator, 0, trajectory, trajectory)
    assert start.num_steps == trajectory.num_frames - 1
    history = start.state.velocity_history
    assert history is not None
    assert torch.equal(history, torch.from_numpy(trajectory.vel[0].astype(np.float64))[:, None].expand(-1, 3, -1))
