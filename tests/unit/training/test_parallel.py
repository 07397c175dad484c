"""Several processes train like one: the loss is a mean over all nodes, a type may be absent in one process, and weights stay equal."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger
from torch import nn
from torch_geometric.data import Batch, HeteroData

from gpe_pl.data import sampling
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.dataset import Samples
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize, Sampling
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import node_code, param_names
from gpe_pl.system import ranks
from gpe_pl.training.module import MAX_IN_ROW, TrainingError, TrainingModule
from gpe_pl.training.parallel import SummedGradients, end_later_processes, sum_gradients
from gpe_pl.training.run import TrainerSettings, TrainingSettings, train
from gpe_pl.trajectory.store import StoreError, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes
from tests.ranks import as_launched, on_ranks

MATERIALS = ("sand", "snow")


def test_gradients_are_summed_and_what_a_rank_lacks_is_zero(tmp_path: Path) -> None:
    def gradients(rank: int) -> list[np.ndarray | None]:
        both, only_here, only_there, nowhere = (nn.Parameter(torch.zeros(2, 3)) for _ in range(4))
        both.grad = torch.full((2, 3), 1.0 + rank)
        (only_there if rank else only_here).grad = torch.full((2, 3), 5.0)
        sum_gradients([both, only_here, only_there, nowhere])
        return [None if p.grad is None else p.grad.numpy() for p in (both, only_here, only_there, nowhere)]

    for both, only_here, only_there, nowhere in on_ranks(tmp_path, gradients):
        assert (both == 3).all() and both.shape == (2, 3)
        assert (only_here == 5).all() and (only_there == 5).all()
        assert nowhere is None  # the optimiser leaves it alone, as in one process


def graph(num_nodes: int, present: tuple[str, ...], seed: int) -> HeteroData:
    """Return a graph with the types of both materials and nodes of some."""
    state = scenes.state(num_nodes, present, seed=seed)
    if present != MATERIALS:  # a column per parameter of all materials
        names = param_names(MATERIALS)
        params = np.full((num_nodes, len(names)), np.nan)
        params[:, names.index(param_names(present)[0])] = state.material_params[:, 0]
        state = replace(state, material_params=params)
    made = scenes.builder(MATERIALS, history=1)(state.to_torch())
    for m in MATERIALS:
        made[m].target = torch.randn(made[m].x.shape[0], 2, generator=torch.Generator().manual_seed(seed))
    made.trajectory, made.frame = seed, seed
    return made


def module() -> TrainingModule:
    build = scenes.builder(MATERIALS, history=1)
    torch.manual_seed(0)
    return TrainingModule(LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8), build), num_steps=10)


def test_the_loss_is_the_mean_over_the_nodes_of_all_ranks(tmp_path: Path) -> None:
    """One rank has many nodes of both materials, the other few, and no snow."""
    parts = [[graph(40, MATERIALS, 1), graph(22, MATERIALS, 2)], [graph(9, ("sand",), 3)]]

    def step(graphs: list[HeteroData]) -> tuple[float, TrainingModule]:
        m = module()
        loss = m.loss(Batch.from_data_list(graphs))
        loss.backward()
        return float(loss.detach()), m

    def on_rank(rank: int) -> tuple[float, list[np.ndarray | None], int]:
        loss, m = step(parts[rank])
        num_absent = sum(p.grad is None for p in m.parameters())
        sum_gradients(m.parameters())
        return loss, [None if p.grad is None else p.grad.numpy() for p in m.parameters()], num_absent

    loss, whole = step([g for part in parts for g in part])
    per_rank = on_ranks(tmp_path, on_rank)
    assert per_rank[0][2] == sum(p.grad is None for p in whole.parameters()) < per_rank[1][2]
    assert sum(part for part, *_ in per_rank) == pytest.approx(loss, rel=1e-6)
    for _, gradients, _ in per_rank:
        for p, there, first in zip(whole.parameters(), gradients, per_rank[0][1], strict=True):
            assert (p.grad is None) == (there is None)
            if p.grad is not None:
                assert there is not None and first is not None and there.tobytes() == first.tobytes()
                np.testing.assert_allclose(there, p.grad.numpy(), rtol=1e-5, atol=1e-6 * float(p.grad.abs().max()))


# --- whole runs ----------------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def mixed(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> Path:
    """Make trajectories of sand with snow and of sand alone, of 8 to 30 nodes."""
    names = param_names(MATERIALS)

    def trajectory(seed: int, num_nodes: int, with_snow: bool, split: str) -> Trajectory:
        made = new_trajectory(seed, num_frames=8, num_nodes=num_nodes, split=split, materials=MATERIALS, param_names=names)
        node_type, params = np.array(made.node_type), np.full((num_nodes, len(names)), np.nan, np.float32)
        node_type[::2] = node_code("snow") if with_snow else node_code("sand")
        for material, value in (("sand", 30.0), ("snow", 8.0)):
            params[node_type == node_code(material), names.index(param_names((material,))[0])] = value
        pos = made.pos[0] + np.cumsum(np.random.default_rng(seed).normal(scale=3e-3, size=made.pos.shape), axis=0)
        return replace(made, pos=pos.astype(np.float32), node_type=node_type, material_params=params)

    root = tmp_path / "mixed"
    sizes = [(8, False), (30, True), (14, False), (21, True)]
    write_shard(root / "train" / "shard-00000.h5", [trajectory(k, n, snow, "train") for k, (n, snow) in enumerate(sizes)])
    write_shard(root / "val" / "shard-00000.h5", [trajectory(10 + k, n, snow, "val") for k, (n, snow) in enumerate(sizes[:3])])
    sealed.write(root / "statistics.json", {"acceleration_std": 50.0, "data_sha256": split_checksum(root, "train")})
    return root


SETTINGS = TrainingSettings(
    num_steps=20, batch_size=3, val_interval=10, num_val_rollouts=3, val_rollout_steps=3, warmup_steps=2, compile="off"
)


class Recorded(TrainingModule):
    """Module that records the input of each step: windows and the number of nodes of each material."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.steps: list[tuple[list[tuple[int, int]], dict[str, int]]] = []
        self.losses: list[float] = []

    def training_step(self, batch: Samples, batch_idx: int) -> torch.Tensor | None:
        loss = super().training_step(batch, batch_idx)
        assert loss is not None
        if isinstance(batch, list):
            num_nodes = {m: sum(int((start.state.node_type == node_code(m)).sum()) for start in batch) for m in MATERIALS}
        else:
            num_nodes = {m: batch[m].x.shape[0] for m in MATERIALS}
        self.steps.append((list(self._windows), num_nodes))
        self.losses.append(float(ranks.summed(loss.detach())))
        return loss


def trained(root: Path, run: Path, rank: int, num_ranks: int, size: BatchSize, num_steps: int = 20, late: bool = False) -> dict[str, Any]:
    """Return the weights and the input of each step of this rank."""
    kind: Sampling = "activity" if late else "uniform"
    data = TrajectoryDataModule(root, GraphConfig(history=2), Noise(0.0, 0.1), size, seed=1, sampling=kind)
    torch.manual_seed(5 + rank)  # ranks start from the weights of the first
    simulator = LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=2, hidden_channels=8), data.builder)
    simulator.fit_statistics(data.statistics_sample(), data.parameter_ranges())
    module = Recorded(simulator, SETTINGS.num_steps, warmup_steps=SETTINGS.warmup_steps, compile="off")
    settings = replace(SETTINGS, num_steps=num_steps, push_fraction=0.5 if late else 0.0, push_steps=3)
    run.mkdir(exist_ok=True)
    seen: dict[str, Any] = {"steps": module.steps, "losses": module.losses}
    try:
        train(module, data, settings, TrainerSettings(devices=num_ranks, progress=False), [CSVLogger(run, name="log")], run)
        end_later_processes()
    finally:
        seen["weights"] = {k: v.numpy() for k, v in module.simulator.state_dict().items()}
        (run / f"seen_{rank}.pickle").write_bytes(pickle.dumps(seen))
    return seen


def trained_on_ranks(root: Path, run: Path, size: BatchSize, num_steps: int = 20, late: bool = False) -> list[dict[str, Any]]:
    as_launched(run / "ranks", lambda rank: trained(root, run, rank, 2, size, num_steps, late))
    return [pickle.loads((run / f"seen_{rank}.pickle").read_bytes()) for rank in range(2)]


def checkpoint(run: Path, name: str) -> dict[str, Any]:
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


@pytest.mark.parametrize(
    ("size", "late"),
    [
        pytest.param(BatchSize(3), False, marks=pytest.mark.long),
        pytest.param(BatchSize(3, max_nodes=64), False, marks=pytest.mark.long),
        pytest.param(BatchSize(3), True, marks=pytest.mark.long, id="push-forward"),
        pytest.param(BatchSize(3, max_nodes=64), True, marks=pytest.mark.slow, id="push-forward by nodes"),
    ],
)
def test_two_processes_train_like_one(mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: BatchSize, late: bool) -> None:
    monkeypatch.setattr(sampling, "NUM_LANES", 2)
    one = trained(mixed, tmp_path / "one", 0, 1, size, late=late)
    two = trained_on_ranks(mixed, tmp_path / "two", size, late=late)
    nodes = np.array([[sum(count.values()) for _, count in rank["steps"]] for rank in two])
    assert nodes.shape == (2, 20) and (nodes[0] != nodes[1]).any()
    snow = np.array([[count["snow"] for _, count in rank["steps"]] for rank in two])
    assert ((snow == 0).sum(axis=0) == 1).any()  # a material that only one rank has
    for k, (windows, _) in enumerate(one["steps"]):  # together they take what one process takes
        assert sorted(two[0]["steps"][k][0] + two[1]["steps"][k][0]) == sorted(windows)
    for name, weight in two[0]["weights"].items():
        assert weight.tobytes() == two[1]["weights"][name].tobytes(), name
        np.testing.assert_allclose(weight, one["weights"][name], rtol=0, atol=1e-6, err_msg=name)
    assert two[0]["losses"] == two[1]["losses"] == pytest.approx(one["losses"], rel=1e-5)
    for name in ("last", "best"):
        a, b = (checkpoint(tmp_path / run, name) for run in ("one", "two"))
        assert a["global_step"] == b["global_step"]
        for key, weight in a["state_dict"].items():  # the averaged ones
            torch.testing.assert_close(b["state_dict"][key], weight, rtol=0, atol=1e-6)
    scores = [list(checkpoint(tmp_path / run, "best")["callbacks"].values()) for run in ("one", "two")]
    values = [[error for c in callbacks for error in c.get("lowest", [])] for callbacks in scores]
    assert values[0] and values[1] == pytest.approx(values[0], rel=1e-4)


@pytest.mark.slow
def test_two_processes_resume_where_they_stopped(mixed: Path, tmp_path: Path) -> None:
    whole = trained_on_ranks(mixed, tmp_path / "whole", BatchSize(3))
    trained_on_ranks(mixed, tmp_path / "parts", BatchSize(3), num_steps=10)
    rest = trained_on_ranks(mixed, tmp_path / "parts", BatchSize(3))
    for before, after in zip(whole, rest, strict=True):
        assert after["steps"] == before["steps"][10:]
        assert after["losses"] == before["losses"][10:]
        for name, weight in before["weights"].items():
            assert weight.tobytes() == after["weights"][name].tobytes(), name


@pytest.mark.slow
def test_two_processes_stop_and_save_together_when_one_is_interrupted(mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The interruption comes in the middle of unrolls, of which each process has some."""
    monkeypatch.setattr(sampling, "NUM_LANES", 2)
    whole = trained_on_ranks(mixed, tmp_path / "whole", BatchSize(3), late=True)
    plain = Recorded.training_step

    def training_step(self: Recorded, batch: Samples, batch_idx: int) -> torch.Tensor | None:
        if self.global_step == 14 and ranks.rank() == 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return plain(self, batch, batch_idx)

    def interrupted(rank: int) -> None:
        with pytest.raises(SystemExit if rank else RunError):
            trained(mixed, tmp_path / "parts", rank, 2, BatchSize(3), late=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recorded, "training_step", training_step)
        as_launched(tmp_path / "parts" / "ranks", interrupted)
    last = checkpoint(tmp_path / "parts", "last")
    assert last["global_step"] == 15
    assert all(len(scenes) == 3 for scenes in last["excursions"].values()) and last["excursions"].keys() == {0, 1}
    rest = trained_on_ranks(mixed, tmp_path / "parts", BatchSize(3), late=True)
    for before, after in zip(whole, rest, strict=True):
        assert after["losses"] == before["losses"][15:]
        for name, weight in before["weights"].items():
            assert weight.tobytes() == after["weights"][name].tobytes(), name


def test_numbers_that_go_bad_on_one_rank_are_skipped_on_all_and_stop_all(mixed: Path, tmp_path: Path) -> None:
    def on_rank(rank: int) -> str:
        m = module()
        m._windows = [(3 + rank, 17)]
        m._trainer = SimpleNamespace(global_step=4)  # type: ignore[assignment]
        loss = torch.tensor(float("nan") if rank else 1.0)
        for _ in range(MAX_IN_ROW - 1):
            m._skip("loss", float(ranks.summed(loss)))
        with pytest.raises(TrainingError) as caught:
            m._skip("loss", float(ranks.summed(loss)))
        return str(caught.value)

    messages = on_ranks(tmp_path, on_rank)
    assert messages[0] == messages[1]
    assert "step 4: the loss is nan for (trajectory, frame) = (3, 17), (4, 17)" in messages[0]


@pytest.mark.slow
@pytest.mark.parametrize("clip", [1.0, None])
def test_a_loss_that_overflows_changes_no_weight_though_its_gradient_is_finite(tmp_path: Path, clip: float | None) -> None:
    """Its square is beyond single precision, its gradient is not. Ranks compute gradients nevertheless, because they wait for each other's."""

    def on_rank(rank: int) -> tuple[bool, bool]:
        m, data = module(), graph(12, MATERIALS, rank)
        m._trainer = SimpleNamespace(global_step=4, log_every_n_steps=50)  # type: ignore[assignment]
        if rank:
            data["sand"].target[0] = 1e25
        loss = m.training_step(Batch.from_data_list([data]), 0)
        assert loss is not None
        loss.backward()
        sum_gradients(m.parameters())
        is_finite = all(bool(p.grad.isfinite().all()) for p in m.parameters() if p.grad is not None)
        m.configure_gradient_clipping(m.configure_optimizers()["optimizer"], clip)
        return is_finite, all(p.grad is None for p in m.parameters())

    assert on_ranks(tmp_path, on_rank) == [(True, True), (True, True)]


@pytest.mark.slow
def test_a_process_that_ends_is_reported_in_one_line_with_where_to_resume(
    mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Recorded.training_step

    def training_step(self: Recorded, batch: Samples, batch_idx: int) -> torch.Tensor | None:
        if self.global_step == 12 and ranks.rank() == 1:
            raise RuntimeError("no memory")
        return plain(self, batch, batch_idx)

    def on_rank(rank: int) -> str:
        with pytest.raises(RuntimeError) as caught:
            trained(mixed, tmp_path / "run", rank, 2, BatchSize(3))
        return f"{caught.type.__name__}: {caught.value}"

    monkeypatch.setattr(Recorded, "training_step", training_step)
    first, second = as_launched(tmp_path / "run" / "ranks", on_rank)
    assert second == "RuntimeError: no memory"
    assert first.startswith("RunError: the connection to the other processes of the training failed (RuntimeError: ")
    assert first.endswith(f"run the same command again to resume from {tmp_path}/run/checkpoints/last.ckpt, step 10")
    assert "\n" not in first


def test_processes_that_were_started_end_before_lightning_notices() -> None:
    """Lightning kills the main process if a process in its list fails."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    strategy = SummedGradients()
    watched = [process]
    strategy._launcher = SimpleNamespace(procs=watched)  # type: ignore[assignment]
    strategy.on_exception(RuntimeError())
    assert process.returncode == -signal.SIGKILL and watched == []


@pytest.mark.slow
def test_a_second_training_on_several_devices_is_refused(mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lightning would start no processes for it, and wait for them."""
    monkeypatch.setattr(SummedGradients, "has_started_processes", True)
    with pytest.raises(RunError, match=r"trainer.devices=2: this Python process has already trained on several devices; start each"):
        trained(mixed, tmp_path / "run", 0, 2, BatchSize(3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "message"),
    [(BatchSize(1), r"training.batch_size=1: too small for 2"), (BatchSize(3, 59), r"max_nodes=59: .*of up to 30 nodes")],
)
def test_batches_too_small_for_all_ranks_are_refused(mixed: Path, tmp_path: Path, size: BatchSize, message: str) -> None:
    def on_rank(_: int) -> None:
        data = TrajectoryDataModule(mixed, GraphConfig(history=2), Noise(0.0, 0.1), size, seed=1)
        data.trainer = SimpleNamespace(global_step=0)  # type: ignore[assignment]
        with pytest.raises(StoreError, match=message):
            data.train_dataloader()

    on_ranks(tmp_path / "ranks", on_rank)
