"""Checkpoints of a run: the best one, found after the folder moves, and one at interruptions and every few minutes. No file stores output paths."""

from __future__ import annotations

import csv
import math
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger

from gpe_pl.data import sampling
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError, claim
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.training.callbacks import RolloutValidation
from gpe_pl.training.checkpoints import Checkpoints, clearly_worse
from gpe_pl.training.interruption import Interruption
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.run import TrainerSettings, TrainingSettings, train
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.checkpoints import assert_same_checkpoint

STEPS, INTERVAL = 9, 3


class Killed(BaseException):
    """Exception that stands for the end of the process."""


@pytest.fixture
def data(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> Path:
    """Make trajectories for training."""
    root = tmp_path / "grains"
    for split, seeds in (("train", (0, 1)), ("val", (2,))):
        made = [new_trajectory(seed, num_frames=8, num_nodes=12, split=split) for seed in seeds]
        steps = [np.random.default_rng(t.metadata.seed).normal(scale=3e-3, size=t.pos.shape) for t in made]
        moved = [replace(t, pos=(t.pos[0] + np.cumsum(s, axis=0)).astype(np.float32)) for t, s in zip(made, steps, strict=True)]
        write_shard(root / split / "shard-00000.h5", moved)
    sealed.write(root / "statistics.json", {"acceleration_std": 50.0, "data_sha256": split_checksum(root, "train")})
    return root


@pytest.fixture
def errors(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[float]]:
    """Set the result of the validation after each step; later ones are worse."""
    found = {3: [1.0], 6: [2.0], 9: [3.0]}
    steps: list[int] = [0]
    monkeypatch.setattr(RolloutValidation, "_errors", lambda *_: found[steps[-1]])
    plain = RolloutValidation.on_validation_epoch_end

    def on_validation_epoch_end(self: RolloutValidation, trainer: Any, module: Any) -> None:
        steps.append(trainer.global_step)
        plain(self, trainer, module)

    monkeypatch.setattr(RolloutValidation, "on_validation_epoch_end", on_validation_epoch_end)
    return found


@pytest.fixture(autouse=True)
def _signals() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    after = [signal.getsignal(number) for number in numbers]
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
    assert after == before  # training gives them back


def trained(
    root: Path,
    run: Path,
    push_fraction: float = 0.0,
    minutes: float = math.inf,
    at: dict[int, Callable[[], None]] | None = None,
    starts_trained: bool = False,
    warmup_steps: int = 2,
    at_setup: Callable[[], None] = lambda: None,
) -> Path:
    """Train in a folder, or resume; ``at`` acts before steps, ``at_setup`` before anything is restored."""

    class Disturbed(TrainingModule):
        def setup(self, stage: str) -> None:
            self.trainer.log_every_n_steps = 1  # type: ignore[attr-defined]
            at_setup()

        def training_step(self, batch: Any, batch_idx: int) -> torch.Tensor | None:
            (at or {}).get(self.global_step, lambda: None)()
            return super().training_step(batch, batch_idx)

    module_data = TrajectoryDataModule(root, GraphConfig(history=2), Noise(0.0, 0.1), BatchSize(2), seed=1)
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(module_data.builder.spec, num_message_passing_steps=1, hidden_channels=4), module_data.builder)
    simulator.fit_statistics(module_data.statistics_sample(), module_data.parameter_ranges())
    settings = TrainingSettings(
        num_steps=STEPS,
        val_interval=INTERVAL,
        num_val_rollouts=1,
        val_rollout_steps=2,
        warmup_steps=warmup_steps,
        push_fraction=push_fraction,
        push_steps=2,
    )
    module = Disturbed(simulator, STEPS, warmup_steps=warmup_steps, compile="off")
    run.mkdir(parents=True, exist_ok=True)
    trainer = TrainerSettings(progress=False, checkpoint_minutes=minutes)
    return train(module, module_data, settings, trainer, [CSVLogger(run, name="log")], run, starts_trained=starts_trained)


def stop(error: type[BaseException]) -> Callable[[], None]:
    def action() -> None:
        raise error

    return action


def send(number: int) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


def stored(run: Path, name: str = "last") -> dict[str, Any]:
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


def assert_like(run: Path, whole: Path) -> None:
    """Check that two checkpoints have the same content, and the same data about the best one."""
    for name in ("last", "best"):
        assert_same_checkpoint(stored(run, name), stored(whole, name))
    assert stored(run)["callbacks"]["Checkpoints"] == stored(whole)["callbacks"]["Checkpoints"]


@pytest.mark.slow
@pytest.mark.parametrize("stops_at", [None, 2, 7])
def test_a_trained_model_stays_the_best_unless_a_later_one_is(
    stops_at: int | None, data: Path, tmp_path: Path, errors: dict[int, list[float]], caplog: pytest.LogCaptureFixture
) -> None:
    """The validation before the first step has an error of ``start``, and the first of the later ones the lowest of theirs."""
    for name, start, best in (("better", 0.5, 0), ("worse", 1.5, 3)):
        errors[0] = [start]
        if stops_at is not None:
            with pytest.raises(RunError, match="interrupted"):
                trained(data, tmp_path / name, at={stops_at: send(signal.SIGINT)}, starts_trained=True)
        caplog.clear()
        trained(data, tmp_path / name, starts_trained=True)
        assert stored(tmp_path / name, "best")["global_step"] == best
        assert stored(tmp_path / name)["global_step"] == STEPS
        assert stored(tmp_path / name)["callbacks"]["Checkpoints"] == {"best_step": best, "lowest": [min(start, 1.0)]}
        assert ("every validation was clearly worse than the model at the start" in caplog.text) == (best == 0)
    start_weights, averaged = (stored(tmp_path / "better", "best")[key] for key in ("current_model_state", "state_dict"))
    assert all(torch.equal(start_weights[key], value) for key, value in averaged.items())  # no step has changed them


@pytest.mark.slow
@pytest.mark.parametrize(("warmup_steps", "warns"), [(STEPS, False), (STEPS + 1, True)])
def test_a_training_that_ends_within_its_warm_up_says_so(
    warmup_steps: int, warns: bool, data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trained(data, tmp_path, warmup_steps=warmup_steps)
    assert ("before the learning rate has reached training.learning_rate=0.001" in caplog.text) == warns


@pytest.mark.slow
def test_a_run_that_was_moved_knows_its_best_checkpoint(data: Path, tmp_path: Path, errors: dict[int, list[float]]) -> None:
    trained(data, tmp_path / "whole")
    assert stored(tmp_path / "whole", "best")["global_step"] == 3
    with pytest.raises(Killed):
        trained(data, tmp_path / "here" / "run", at={7: stop(Killed)})
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert trained(data, tmp_path / "there" / "run") == tmp_path / "there" / "run" / "checkpoints" / "best.ckpt"
    assert stored(tmp_path / "there" / "run", "best")["global_step"] == 3
    assert_like(tmp_path / "there" / "run", tmp_path / "whole")
    assert stored(tmp_path / "there" / "run")["callbacks"]["Checkpoints"] == {"best_step": 3, "lowest": [1.0]}
    assert not (tmp_path / "here").exists()


@pytest.mark.slow
def test_the_latest_that_is_not_clearly_worse_is_the_best(data: Path, tmp_path: Path, errors: dict[int, list[float]]) -> None:
    errors |= {3: [1.0, 1.0, 1.0], 6: [0.8, 0.9, 1.6], 9: [1.9, 2.0, 2.2]}
    trained(data, tmp_path / "run")
    assert stored(tmp_path / "run", "best")["global_step"] == 6  # 10 % worse, by one scene of three
    assert stored(tmp_path / "run")["callbacks"]["Checkpoints"] == {"best_step": 6, "lowest": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("later", "expected"),
    [
        ([1.1, 2.1, 3.1], True),  # the same difference in every scene
        ([0.9, 1.9, 2.9], False),
        ([1.0, 2.0, 3.0], False),
        ([2.0, 1.8, 2.9], False),  # worse on average, by one scene
        ([math.nan, 1.0, 1.0], True),
        ([0.5], True),  # of other scenes
    ],
)
def test_clearly_worse(later: list[float], expected: bool) -> None:
    assert clearly_worse(later, [1.0, 2.0, 3.0]) is expected


def test_one_scene_has_no_standard_error() -> None:
    assert clearly_worse([1.01], [1.0])
    assert not clearly_worse([1.0], [1.0])


@pytest.mark.slow
def test_slow_drift_is_compared_with_the_lowest(data: Path, tmp_path: Path, errors: dict[int, list[float]]) -> None:
    errors |= {3: [1.0, 1.0], 6: [1.0, 1.4], 9: [1.3, 1.45]}  # the last is not clearly worse than the second, but than the first
    assert not clearly_worse(errors[9], errors[6])
    assert clearly_worse(errors[9], errors[3])
    trained(data, tmp_path / "run")
    assert stored(tmp_path / "run", "best")["global_step"] == 6


@pytest.mark.slow
def test_without_the_best_checkpoint_the_next_validation_makes_one(data: Path, tmp_path: Path, errors: dict[int, list[float]]) -> None:
    with pytest.raises(Killed):
        trained(data, tmp_path / "run", at={7: stop(Killed)})
    (tmp_path / "run" / "checkpoints" / "best.ckpt").unlink()
    trained(data, tmp_path / "run")
    assert stored(tmp_path / "run", "best")["global_step"] == 9


@pytest.mark.slow
@pytest.mark.parametrize("push_fraction", [0.0, 1.0])
def test_a_checkpoint_between_validations_is_as_good_as_any(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, push_fraction: float
) -> None:
    monkeypatch.setattr(sampling, "NUM_LANES", 1)  # every step goes on from the one before
    trained(data, tmp_path / "whole", push_fraction)
    seen: list[int] = []
    with pytest.raises(Killed):
        trained(data, tmp_path / "parts", push_fraction, 1e-9, at={5: stop(Killed)})
    found = stored(tmp_path / "parts")
    assert found["global_step"] == 5  # a step without validation before and after it
    assert bool(found["excursions"]) == bool(push_fraction)
    trained(data, tmp_path / "parts", push_fraction, at={step: partial(seen.append, step) for step in range(STEPS)})
    assert seen == [5, 6, 7, 8]
    assert_like(tmp_path / "parts", tmp_path / "whole")


@pytest.mark.slow
def test_checkpoints_between_validations_come_when_their_time_has_passed(data: Path, tmp_path: Path) -> None:
    saved = []

    def look() -> None:
        with suppress(FileNotFoundError):
            saved.append(stored(tmp_path / "run")["global_step"])

    trained(data, tmp_path / "run", at=dict.fromkeys(range(STEPS), look))
    assert saved == [3, 3, 3, 6, 6, 6]
    shutil.rmtree(tmp_path / "run")
    saved.clear()
    trained(data, tmp_path / "run", minutes=1e-9, at=dict.fromkeys(range(STEPS), look))
    assert saved == [1, 2, 3, 4, 5, 6, 7, 8]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "step", "saved"),
    [
        (signal.SIGTERM, 3, 4),
        (signal.SIGINT, 3, 4),
        (signal.SIGINT, 2, 3),
        (signal.SIGTERM, 8, 9),
    ],
)
def test_an_interrupted_training_is_saved_where_it_is(data: Path, tmp_path: Path, number: int, step: int, saved: int) -> None:
    """If a validation follows the step, training saves after the validation."""
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    with pytest.raises(RunError, match=rf"^interrupted; run the same command again to resume from {last}, step {saved}$"):
        trained(data, tmp_path / "run", at={step: send(number)})
    assert stored(tmp_path / "run")["global_step"] == saved
    trained(data, tmp_path / "run")
    trained(data, tmp_path / "whole")
    assert_like(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_a_second_signal_ends_it_at_once_and_what_is_there_is_named(data: Path, tmp_path: Path) -> None:
    def twice() -> None:
        send(signal.SIGINT)()
        send(signal.SIGINT)()

    with pytest.raises(RunError, match="^interrupted; nothing was saved yet, the same command starts again$"):
        trained(data, tmp_path / "run", at={1: twice})
    assert not (tmp_path / "run" / "checkpoints").exists()
    with pytest.raises(RunError, match=r"^interrupted; run the same command again to resume from .*last.ckpt, step 3$"):
        trained(data, tmp_path / "run", at={4: twice})
    assert stored(tmp_path / "run")["global_step"] == 3


def test_a_second_signal_while_a_checkpoint_is_written_leaves_the_one_before(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = torch.save

    def save(checkpoint: Any, file: Any) -> None:
        plain(checkpoint, file)
        if checkpoint["global_step"] == 5:
            send(signal.SIGINT)()

    monkeypatch.setattr(torch, "save", save)
    with pytest.raises(RunError, match=r"last.ckpt, step 3$"):
        trained(data, tmp_path / "run", at={4: send(signal.SIGINT)})
    assert stored(tmp_path / "run")["global_step"] == 3
    assert sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


def test_signals_that_are_ignored_stay_ignored() -> None:
    """A shell makes its background jobs ignore Ctrl-C, for example."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            interruption.listen()
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) == interruption._note
    finally:
        signal.signal(signal.SIGINT, before)


OTHERS = ["{victim}", "../../victim", "file://{victim}", "memory://victim", "{victim}/chapter.tex"]
PATHS = ["local://{victim}", *(pytest.param(path, marks=pytest.mark.slow) for path in OTHERS)]


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS)
def test_no_path_in_a_checkpoint_is_followed(data: Path, tmp_path: Path, errors: dict[int, list[float]], path: str) -> None:
    """All keys under which Lightning's own callback keeps paths."""
    run, victim = tmp_path / "run", tmp_path / "victim"
    with pytest.raises(Killed):
        trained(data, run, at={4: stop(Killed)})
    victim.mkdir()
    (victim / "chapter.tex").write_text("years of work")
    text = path.format(victim=victim)
    content = stored(run)
    paths: dict[str, Any] = dict.fromkeys(
        ("best_model_path", "last_model_path", "kth_best_model_path", "dirpath", "current_score", "filename"), text
    )
    paths |= {"best_k_models": {text: torch.tensor(0.5)}, "best_model_score": torch.tensor(9.0), "kth_value": torch.tensor(9.0)}
    for key, state in content["callbacks"].items():
        content["callbacks"][key] = state | paths
    for monitor in ("'val/rollout_mse'", "None"):
        rest = "'mode': 'min', 'every_n_train_steps': 0, 'every_n_epochs': 1, 'train_time_interval': None"
        content["callbacks"][f"ModelCheckpoint{{'monitor': {monitor}, {rest}}}"] = paths
    torch.save(content | paths, run / "checkpoints" / "last.ckpt")
    trained(data, run)
    assert (victim / "chapter.tex").read_text() == "years of work"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["grains", "run", "victim"]
    assert sorted(p.name for p in (run / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert stored(run, "best")["global_step"] == 3
    assert str(tmp_path) not in (run / "checkpoints" / "last.ckpt").read_bytes().decode(errors="replace")


@pytest.mark.parametrize("name", ["checkpoints", "log", "metrics.csv", "rollout_test_00.png", ".hydra/config.yaml"])
@pytest.mark.parametrize("target", ["../outside", "{folder}/outside", "missing/../../outside"])
def test_a_link_that_leads_out_of_a_run_folder_is_refused(tmp_path: Path, name: str, target: str) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "run").mkdir()
    link = tmp_path / "run" / name
    link.parent.mkdir(exist_ok=True)
    upwards = "" if target.startswith("{folder}") else "../" * name.count("/")
    link.symlink_to(upwards + target.format(folder=tmp_path))
    with pytest.raises(RunError, match=rf"run/{name}: a link that leads out of its folder"):
        claim(tmp_path / "run", {"seed": 0})
    assert [*(tmp_path / "outside").iterdir()] == []


def test_a_run_folder_may_be_a_link_itself(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "checkpoints").mkdir()
    (tmp_path / "disk" / "again").symlink_to("checkpoints")
    (tmp_path / "run").symlink_to("disk")
    claim(tmp_path / "run", {"seed": 0})
    assert (tmp_path / "disk" / "config.json").exists()


@pytest.mark.slow
def test_checkpoints_that_are_links_are_replaced_not_followed(data: Path, tmp_path: Path) -> None:
    trained(data, tmp_path / "first")
    folder = tmp_path / "run" / "checkpoints"
    folder.mkdir(parents=True)
    for name in ("best", "last"):
        (tmp_path / name).write_text("of someone else")
        (folder / f"{name}.ckpt").symlink_to(tmp_path / name)
    (folder / "last.ckpt").unlink()  # else it would be resumed from
    trained(data, tmp_path / "run")
    assert (tmp_path / "best").read_text() == "of someone else"
    assert not (folder / "best.ckpt").is_symlink()


@pytest.mark.slow
def test_no_loss_is_missing_after_interruptions(data: Path, tmp_path: Path) -> None:
    for step in (1, 4):
        with pytest.raises(RunError, match=f"step {step + 1}$"):
            trained(data, tmp_path / "run", at={step: send(signal.SIGTERM)})
    trained(data, tmp_path / "run")
    rows = [row for k in range(3) for row in csv.DictReader((tmp_path / "run" / "log" / f"version_{k}" / "metrics.csv").open())]
    assert [int(row["step"]) for row in rows if row["train/loss"]] == [*range(STEPS)]


@pytest.mark.slow
def test_an_error_before_anything_is_restored_is_not_blamed_on_the_checkpoint(data: Path, tmp_path: Path) -> None:
    with pytest.raises(Killed):
        trained(data, tmp_path / "run", at={4: stop(Killed)})
    with pytest.raises(RuntimeError, match="^$") as caught:
        trained(data, tmp_path / "run", at_setup=stop(RuntimeError))
    assert caught.type is RuntimeError


STATES: list[dict[str, Any]] = [
    {"lowest": "low", "best_step": 3},
    {"lowest": [1.0]},
    {"lowest": [1], "best_step": 3},
    {"lowest": [1.0], "best_step": 3.0},
]


@pytest.mark.parametrize("state", STATES)
def test_what_are_no_errors_is_refused(tmp_path: Path, state: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError, match="last.ckpt: does not hold step and errors of the best checkpoint"):
        Checkpoints(tmp_path, math.inf, Interruption(), RolloutValidation([], 1)).load_state_dict(state)


def test_an_earlier_version_said_nothing_of_errors(tmp_path: Path) -> None:
    (tmp_path / "best.ckpt").touch()
    checkpoints = Checkpoints(tmp_path, math.inf, Interruption(), RolloutValidation([], 1))
    checkpoints.load_state_dict({"best_score": 1.0, "best_step": 3})
    assert (checkpoints.lowest, checkpoints.best_step) == (None, None)


CONTENTS: dict[str, Any] = {
    "loops": {"fit_loop": 5},
    "optimizer_states": [{"state": {}, "param_groups": []}],
    "lr_schedulers": [{}],
    "callbacks": 5,
    "averaging_state": {"n_averaged": "many"},
    "state_dict": {},
    "skipped": 5,
    "excursions": [1],
}


@pytest.mark.slow
@pytest.mark.parametrize("key", CONTENTS)
def test_wrong_contents_of_a_checkpoint_are_named_in_one_line(data: Path, tmp_path: Path, key: str) -> None:
    with pytest.raises(Killed):
        trained(data, tmp_path / "run", at={4: stop(Killed)})
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    torch.save(stored(tmp_path / "run") | {key: CONTENTS[key]}, last)
    with pytest.raises(CheckpointError, match=rf"^{last}: .*; delete the file, and the same command trains from the start$"):
        trained(data, tmp_path / "run")
