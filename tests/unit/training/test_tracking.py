"""Runs in W&B: their location, the user's settings, and a missing network."""

from __future__ import annotations

import csv
import errno
import logging
import sys
from pathlib import Path
from typing import Any, ClassVar

import pytest
import wandb
from lightning.pytorch import loggers as lightning_loggers
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image

from gpe_pl.files.atomic import FullDiskError
from gpe_pl.files.run_folder import RUN_ID
from gpe_pl.training import tracking
from gpe_pl.training.tracking import LoggerSettings, TrackingError, publish, run_id


class Recorder(Logger):
    """Stand-in for ``WandbLogger``; in modes that fail it ends with ``error``."""

    name, version = "recorder", 0
    modes: ClassVar[list[str]] = []
    error: ClassVar[Exception | None] = None
    fails: ClassVar[tuple[str, ...]] = ("online",)

    def __init__(self, run: str, mode: str, **_: Any) -> None:
        super().__init__()
        self.run, self.mode = run, mode

    def log_metrics(self, *_: Any) -> None: ...

    def log_hyperparams(self, *_: Any) -> None:
        Recorder.modes.append(self.mode)
        if self.mode in Recorder.fails and Recorder.error is not None:
            raise Recorder.error


@pytest.fixture(autouse=True)
def recorder(monkeypatch: pytest.MonkeyPatch) -> type[Recorder]:
    monkeypatch.setattr(lightning_loggers, "WandbLogger", Recorder)
    monkeypatch.setattr(Recorder, "modes", [])
    monkeypatch.setattr(Recorder, "error", None)
    monkeypatch.setattr(Recorder, "fails", ("online",))
    monkeypatch.setattr(tracking, "has_key", lambda: True)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return Recorder


@pytest.mark.parametrize(
    ("setting", "environment", "mode"),
    [(None, None, "online"), (None, "offline", "offline"), ("online", "offline", "online"), (None, "disabled", "disabled")],
)
def test_the_setting_goes_before_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: Any, environment: str | None, mode: str
) -> None:
    if environment is not None:
        monkeypatch.setenv("WANDB_MODE", environment)
    LoggerSettings("wandb", mode=setting).loggers(tmp_path, "run", {})
    assert Recorder.modes == [mode]


def test_a_mode_that_wandb_does_not_have_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "of")
    with pytest.raises(TrackingError, match="WANDB_MODE=of: W&B has no such mode; it must be one of online, offline, disabled"):
        LoggerSettings("wandb")
    assert LoggerSettings("wandb", mode="offline").mode == "offline" and LoggerSettings("csv").mode is None


@pytest.mark.parametrize(
    ("name", "folder", "run"),
    [
        ("sand", "runs/sand", "sand"),
        ("sand", "runs/sand/seed=0", "seed=0"),
        ("study/first", "runs/study/first/model=gns/seed=1", "model=gns/seed=1"),
        ("sand", "sand/runs/sand/seed=0", "seed=0"),
        ("runs", "runs/runs/seed=0", "seed=0"),
        ("sand", "elsewhere", "sand"),
    ],
)
def test_a_run_of_a_sweep_is_named_after_its_own_part(tmp_path: Path, name: str, folder: str, run: str) -> None:
    (tmp_path / folder).mkdir(parents=True)
    *_, logger = LoggerSettings("wandb", mode="offline").loggers(tmp_path / folder, name, {})
    assert isinstance(logger, Recorder) and logger.run == run


def test_only_the_first_process_makes_an_identifier(tmp_path: Path, recorder: type[Recorder], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    LoggerSettings("wandb", mode="offline").loggers(tmp_path, "name", {})
    assert not (tmp_path / RUN_ID).exists()


def test_without_a_network_a_run_is_kept_offline(tmp_path: Path, recorder: type[Recorder], caplog: pytest.LogCaptureFixture) -> None:
    recorder.error = wandb.errors.CommError("no route")
    *_, logger = LoggerSettings("wandb").loggers(tmp_path, "run", {})
    assert recorder.modes == ["online", "offline"]
    assert isinstance(logger, Recorder) and logger.mode == "offline"
    assert "W&B: no route; this run is kept offline" in caplog.text


def test_offline_is_not_tried_again(tmp_path: Path, recorder: type[Recorder]) -> None:
    recorder.error, recorder.fails = wandb.errors.CommError("disk"), ("online", "offline")
    with pytest.raises(TrackingError, match="disk"):
        LoggerSettings("wandb").loggers(tmp_path, "run", {})
    assert recorder.modes == ["online", "offline"]


def test_what_wandb_refuses_is_one_line(tmp_path: Path, recorder: type[Recorder]) -> None:
    recorder.error = wandb.errors.UsageError("API key must be 40 characters")
    with pytest.raises(TrackingError, match="API key must be 40 characters; logger.mode=offline"):
        LoggerSettings("wandb").loggers(tmp_path, "run", {})


@pytest.mark.parametrize("content", [b"../../x", b"", b"\xff\xfe", b"a" * 10**6, b"a b", b"\x1b[2K"])
def test_an_identifier_that_could_be_a_path_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "run_id").write_bytes(content)
    with pytest.raises(TrackingError, match=r"run_id: holds .*, which is not the identifier of a run; delete the file"):
        run_id(tmp_path)


def test_every_start_of_a_run_is_to_be_uploaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    class Run:
        settings: ClassVar = wandb.Settings(mode="offline")
        summary: ClassVar[dict[str, float]] = {}

        def log(self, _: Any) -> None: ...

        def finish(self) -> None: ...

    folders = [tmp_path / "wandb" / f"offline-run-2026010{k}_000000-{run_id(tmp_path)}" for k in (1, 2)]
    for folder in (*folders, tmp_path / "wandb" / "offline-run-20260103_000000-another"):
        folder.mkdir(parents=True)
    logger = Recorder("run", "offline")
    monkeypatch.setattr(logger, "experiment", Run(), raising=False)
    with caplog.at_level(logging.WARNING):
        publish([logger], tmp_path, {"test/rollout_mse@full": 1.0})
    assert f"wandb sync {folders[0]} {folders[1]}`" in caplog.text


def test_tensorboard_has_losses_of_every_start_and_results_with_figures(tmp_path: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator", reason="tensorboard is not installed")
    for step in (0, 1):  # the second as if the run had been resumed
        *_, logger = LoggerSettings("tensorboard").loggers(tmp_path, "run", {})
        logger.log_metrics({"train/loss": 0.5}, step=step)
        logger.finalize("success")
    Image.new("RGB", (8, 8)).save(tmp_path / "rollout_test_00.png")
    publish([logger], tmp_path, {"test/rollout_mse@full": 0.25})
    found = events.EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0}).Reload()
    assert [event.step for event in found.Scalars("train/loss")] == [0, 1]
    assert found.Scalars("test/rollout_mse@full")[0].value == 0.25
    assert found.Tags()["images"] == ["rollout_test_00"]


def test_a_missing_tensorboard_is_said_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(TrackingError, match=r"pip install 'gpe_pl\[tensorboard\]'"):
        LoggerSettings("tensorboard").loggers(tmp_path, "run", {})


@pytest.mark.parametrize("room", [0, 10, 60])
def test_a_log_for_which_there_is_no_room_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    (log,) = LoggerSettings().loggers(tmp_path, "run", {})
    log.log_metrics({"train/loss": 0.5}, step=0)
    path = tmp_path / "log" / "version_0" / "metrics.csv"
    before = path.read_bytes()

    def write(self: csv.DictWriter[str], rows: Any) -> None:  # a part of a line, as a disk that fills up takes it
        self.writer.writerow(["0.0012345678"[:room]])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(csv.DictWriter, "writerows", write)
        with pytest.raises(FullDiskError, match="metrics.csv: cannot be written, there is no room"):
            log.log_metrics({"train/loss": 0.25, "val/one_step_nmse": 0.1}, step=50)
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    log.save()
    with path.open(newline="") as file:
        assert [row["train/loss"] for row in csv.DictReader(file)] == ["0.5", "0.25"]
