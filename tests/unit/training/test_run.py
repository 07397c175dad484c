"""The folder of a run: its owner, and models that another run may use."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.utilities import rank_zero_only

from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError, claim, without_orphans, without_tables
from gpe_pl.training.callbacks import RolloutValidation
from gpe_pl.training.checkpoints import Checkpoints
from gpe_pl.training.interruption import Interruption
from gpe_pl.training.parallel import end_later_processes
from gpe_pl.training.run import TrainerSettings, _said_how_to_continue, adopt, set_up
from gpe_pl.trajectory.store import StoreError

CONFIG: dict[str, Any] = {"seed": 0, "model": {"depth": 3}, "training": {"batch_size": 2}}
BY_NODES = {**CONFIG, "batching": {"max_nodes": 500}}


def finished(folder: Path, config: dict[str, Any]) -> Path:
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "best.ckpt").write_bytes(b"weights")
    (folder / "metrics.csv").touch()
    sealed.write(folder / "config.json", {**config, "evaluation": {"splits": ["test"]}})
    return folder


@pytest.mark.parametrize(("there", "now"), [(CONFIG, BY_NODES), (BY_NODES, CONFIG), (BY_NODES, {**CONFIG, "batching": {"max_nodes": 400}})])
def test_batches_of_another_kind_make_another_run(tmp_path: Path, there: dict[str, Any], now: dict[str, Any]) -> None:
    folder = finished(tmp_path / "there", there)
    assert adopt(tmp_path / "there", now, tmp_path / "now") is None
    with pytest.raises(RunError, match=r"another configuration \(batching"):
        claim(folder, {**now, "evaluation": {"splits": ["test"]}})


@pytest.mark.parametrize(("now", "is_kept"), [(CONFIG, True), (BY_NODES, False)])
def test_logs_of_an_earlier_run_are_not_those_of_the_next(tmp_path: Path, now: dict[str, Any], is_kept: bool) -> None:
    """Somebody deleted its checkpoints, so that the folder is free."""
    claim(tmp_path, CONFIG)
    (tmp_path / "log" / "version_0").mkdir(parents=True)
    (tmp_path / "tensorboard").mkdir()
    (tmp_path / "run_id").write_text("0123abcd")
    claim(tmp_path, now)
    assert {(tmp_path / name).exists() for name in ("log", "tensorboard", "run_id")} == {is_kept}


@pytest.mark.parametrize("config", [CONFIG, BY_NODES])
def test_the_same_configuration_is_the_same_run(tmp_path: Path, config: dict[str, Any]) -> None:
    folder = finished(tmp_path / "there", config)
    claim(folder, {**config, "evaluation": {"splits": ["test"]}})
    taken = adopt(tmp_path / "there", config, tmp_path / "now")
    assert taken is not None and taken.read_bytes() == b"weights"


def test_what_data_and_sizes_offer_is_no_part_of_a_run(tmp_path: Path) -> None:
    """New settings there must not make other runs of those that are finished."""
    offered = {
        "data": {"name": "sand", "comparison": {"velocity_noise_of_change": 1.0}, "larger": {"scene": {"max_bodies": 6}}},
        "size": {"name": "tiny", "comparison": {"budget_minutes": 1.0, "seeds": "0,1"}},
    }
    now = without_tables({**CONFIG, **offered})
    assert now == {**CONFIG, "data": {"name": "sand"}, "size": {"name": "tiny", "comparison": {"budget_minutes": 1.0}}}
    folder = finished(tmp_path / "there", now)
    for config in (now, {**CONFIG, **offered}):
        claim(folder, {**config, "evaluation": {"splits": ["test"]}})
    assert adopt(tmp_path / "there", now, tmp_path / "now") is not None


@pytest.mark.parametrize("deleted", ["folder", "config.json", None])
def test_files_written_after_a_deletion_are_removed(tmp_path: Path, deleted: str | None) -> None:
    """A run whose description alone is gone keeps its files."""
    run = tmp_path / "run"
    claim(run, CONFIG)
    with pytest.raises(OSError, match="failed"), without_orphans(run):
        if deleted == "folder":
            shutil.rmtree(run)
        elif deleted is not None:
            (run / deleted).unlink()
        (run / "checkpoints").mkdir(parents=True)
        (run / "checkpoints" / "last.ckpt").touch()
        raise OSError("failed")
    assert run.exists() == (deleted != "folder")
    if deleted == "folder":
        claim(run, CONFIG)  # not refused


def test_of_processes_started_together_one_takes_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finished(tmp_path / "there", CONFIG)
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    assert adopt(tmp_path / "there", CONFIG, tmp_path / "now") is not None  # the lookup itself ends no process
    assert not (tmp_path / "now").exists()
    with pytest.raises(SystemExit):
        end_later_processes()


def fail_as(module: str, error: Exception) -> None:
    """Raise an error in a function of another module."""
    exec("def fail(error):\n    raise error", code := {"__name__": module})
    code["fail"](error)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. "),
            r"RunError: a process of trainer.num_workers has ended \(RuntimeError: DataLoader worker .*; if memory is short, lower "
            r"trainer.num_workers; nothing was saved yet, the same command starts again",
        ),
        (
            StoreError(
                "Caught StoreError in DataLoader worker process 0.\nOriginal Traceback:\n  File x\ngpe_pl.trajectory.store.StoreError: shard-0.h5: damaged\n"
            ),
            "StoreError: shard-0.h5: damaged",
        ),
        (StoreError("shard-0.h5: damaged"), "StoreError: shard-0.h5: damaged"),
        (RuntimeError("shapes differ"), "RuntimeError: shapes differ"),
    ],
)
def test_errors_of_workers_are_one_line(tmp_path: Path, error: Exception, message: str) -> None:
    checkpoints = Checkpoints(tmp_path, math.inf, Interruption(), RolloutValidation([], 1))
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False)
    with pytest.raises(type(error)) as caught, _said_how_to_continue(checkpoints, trainer):
        fail_as("torch.utils.data.dataloader", error)
    assert re.fullmatch(message, f"{caught.type.__name__}: {caught.value}")


def test_a_gpu_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert TrainerSettings(accelerator="auto").device == "cpu"
    with pytest.raises(RunError, match="trainer.accelerator=gpu: PyTorch finds no GPU here; choose trainer=cpu"):
        set_up(TrainerSettings(accelerator="gpu"))


def test_the_precision_of_products_is_set() -> None:
    try:
        assert set_up(TrainerSettings(matmul_precision="medium")) == "cpu"
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision("highest")
