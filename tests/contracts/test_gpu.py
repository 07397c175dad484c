"""Training and rollouts on a GPU equal those on a CPU up to rounding. Without a GPU all tests are skipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset
from gpe_pl.data.dataset import StartKey, StoredTrajectory, WindowDataset, collated
from gpe_pl.data.ground_truth import generate_trajectory
from gpe_pl.data.noise import Noise
from gpe_pl.fit import fit
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.lookup import model_class
from gpe_pl.rollout.loop import steps
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.optimizer import clip
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import compose

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")

WINDOWS = (1, 4, 8, 12)


@pytest.fixture(scope="module", params=["sand", "fluid", "fem"])
def trajectory(request: pytest.FixtureRequest) -> Trajectory:
    return generate_trajectory(dataset(f"data={request.param}", "size=tiny"), "train", 0, num_frames=25)


def module(trajectory: Trajectory, name: str, model_name: str = "gpe_tuned", **settings: Any) -> tuple[TrainingModule, WindowDataset]:
    cfg = compose("fit", "size=tiny", f"model={model_name}", f"data={name}")
    builder = GraphBuilder(GraphConfig(**cfg.graph), trajectory.metadata)
    torch.manual_seed(0)
    model = model_class(cfg.model["_target_"])(builder.spec, **{key: value for key, value in cfg.model.items() if key != "_target_"})
    for parameter in model.parameters():
        if not parameter.any():  # decoders begin at zero
            torch.nn.init.normal_(parameter, std=0.02)
    simulator = LearnedSimulator(model, builder)
    stored = StoredTrajectory(Path("a"), "0", trajectory.num_frames, trajectory.num_nodes, trajectory)
    windows = WindowDataset([stored], builder, Noise(0.0, 0.0, 0.0), 1.0, 0, bool(cfg.model.get("stress")))
    windows.probability = np.full(len(windows), 1 / len(windows))  # so graphs have weights
    simulator.fit_statistics([windows[k] for k in WINDOWS])
    return TrainingModule(simulator, 100, **{"compile": "off", **settings}), windows


@pytest.mark.parametrize("unrolls", [False, True])
def test_losses_and_gradients_are_the_same(trajectory: Trajectory, unrolls: bool) -> None:
    found = {}
    for device in ("cpu", "cuda"):
        trained, windows = module(trajectory, trajectory.metadata.dataset)
        keys = [StartKey(k, k, 3) for k in WINDOWS] if unrolls else list(WINDOWS)
        samples = trained.to(device).transfer_batch_to_device(collated([windows[key] for key in keys]), torch.device(device), 0)
        loss = trained.loss(samples)
        loss.backward()
        gradient = torch.cat([p.grad.flatten().cpu() for p in trained.parameters() if p.grad is not None])
        found[device] = float(loss.detach()), gradient
    assert found["cuda"][0] == pytest.approx(found["cpu"][0], rel=1e-3)
    assert (found["cuda"][1] - found["cpu"][1]).norm() <= 1e-2 * found["cpu"][1].norm()


@pytest.mark.parametrize("compile", ["off", pytest.param("on", marks=pytest.mark.slow)])
@pytest.mark.parametrize("model_name", ["gpe_tuned", "gpe", "gns", "dpinet", "cconv"])
def test_cuda_graphs_train_as_single_operations(trajectory: Trajectory, model_name: str, compile: str) -> None:
    found = {}
    for cuda_graph in ("off", "auto"):
        how = {"cuda_graph": cuda_graph, "compile": compile if cuda_graph == "auto" else "off"}
        trained, windows = module(trajectory, trajectory.metadata.dataset, model_name, **how)
        optimizer, losses, gradients = torch.optim.SGD(trained.to("cuda").parameters(), lr=1e-3), [], []
        with trained.compiled():
            for step in range(10):
                keys = [WINDOWS[step % 4], WINDOWS[(step + 1 + step // 4) % 4]][: 1 + step % 2]
                samples = trained.transfer_batch_to_device(collated([windows[key] for key in keys]), torch.device("cuda"), 0)
                optimizer.zero_grad()
                loss = trained.loss(samples)
                loss.backward()
                gradients.append(torch.cat([p.grad.flatten().cpu() for p in trained.parameters() if p.grad is not None]))
                clip(trained.parameters(), 1.0)
                optimizer.step()
                losses.append(float(loss.detach()))
            graphs = trained._graphs
            assert (graphs is not None) == (cuda_graph == "auto")
            assert graphs is None or (graphs.works and 1 <= graphs.num_made < 8)
        found[cuda_graph] = losses, gradients
    assert found["auto"][0] == pytest.approx(found["off"][0], rel=1e-3)
    for ours, theirs in zip(found["auto"][1], found["off"][1], strict=True):
        assert (ours - theirs).norm() <= 1e-2 * theirs.norm()


def test_rollouts_are_the_same(trajectory: Trajectory) -> None:
    found = {}
    for device in ("cpu", "cuda"):
        simulator = module(trajectory, trajectory.metadata.dataset)[0].simulator.to(device).eval()
        found[device] = [state.pos.cpu() for state in steps(simulator, simulator.initial_state(trajectory, 8), 10)]
    for ours, theirs in zip(found["cpu"], found["cuda"], strict=True):
        torch.testing.assert_close(theirs, ours, rtol=0.0, atol=1e-4 * trajectory.metadata.spacing)


def test_a_fit_trains_validates_and_evaluates(tmp_path: Path) -> None:
    overrides = ("experiment=smoke", "trainer=gpu", "trainer.num_workers=0", "trainer.progress=false", "evaluation.num_pictures=0")
    fit(compose("fit", *overrides, f"paths.data={tmp_path}/data", f"paths.runs={tmp_path}/runs"))
    assert list(tmp_path.glob("runs/*/metrics.csv"))
