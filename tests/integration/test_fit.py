"""``fit`` from start to end: exact resuming, finished runs, separate folders, early stops at bad numbers, and reports of sweeps."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data import sampling
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.noise import NoiseError
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.metric_rows import read_rows, write_rows
from gpe_pl.evaluation.settings import StartError
from gpe_pl.files.run_folder import RunError, claim
from gpe_pl.fit import fit
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.reports.finished_runs import Run, finished_runs, table_of, validation_curve
from gpe_pl.reports.sweep_table import report_sweep
from gpe_pl.system.progress import Progress
from gpe_pl.training import callbacks
from gpe_pl.training.module import TrainingError, TrainingModule
from gpe_pl.trajectory.store import StoreError, write_shard
from tests.checkpoints import assert_equal, assert_same_checkpoint
from tests.runs import tiny

STEPS = ("training.num_steps=6", "training.val_interval=2", "training.warmup_steps=2")
PLAIN = ("training.push_fraction=0",)
LATE = ("training.sampling=activity", "training.push_fraction=0.5", "training.push_steps=3")

UNROLLED = ("recipe=authors", "model=cconv", "graph.history=1", "training.batch_size=3")


class Killed(BaseException):
    """Exception that stands for the end of the process."""


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[float]]:
    """Return training losses by step, one for each time that the step was taken."""
    seen: dict[int, list[float]] = {}
    plain = TrainingModule.training_step

    def training_step(self: TrainingModule, batch: Any, batch_idx: int) -> torch.Tensor:
        loss = plain(self, batch, batch_idx)
        assert loss is not None
        seen.setdefault(self.global_step, []).append(loss.item())
        return loss

    monkeypatch.setattr(TrainingModule, "training_step", training_step)
    return seen


def interrupt(patch: pytest.MonkeyPatch, step: int, error: type[BaseException]) -> None:
    """Let training raise when it reaches this step."""
    plain = TrainingModule.loss

    def loss(self: TrainingModule, batch: Any) -> torch.Tensor:
        if self.global_step == step:
            raise error
        return plain(self, batch)

    patch.setattr(TrainingModule, "loss", loss)


def checkpoint(cfg: DictConfig, name: str = "last") -> dict[str, Any]:
    return torch.load(Path(cfg.paths.runs) / cfg.name / "checkpoints" / f"{name}.ckpt", weights_only=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("killed_at", "saved", "late"),
    [
        pytest.param(1, 0, PLAIN, marks=pytest.mark.long),
        (5, 4, LATE),
        pytest.param(5, 4, PLAIN, marks=pytest.mark.long),
        (3, 2, UNROLLED),
        (5, 5, (*LATE, "trainer.checkpoint_minutes=1e-9")),  # between validations
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    tiny_data: Path,
    tmp_path: Path,
    losses: dict[int, list[float]],
    monkeypatch: pytest.MonkeyPatch,
    killed_at: int,
    saved: int,
    late: tuple[str, ...],
) -> None:
    monkeypatch.setattr(sampling, "NUM_LANES", 1)  # every late step goes on from the one before
    whole = tiny(tiny_data, tmp_path, "name=whole", *STEPS, *late)
    value = fit(whole)
    expected = {step: taken[0] for step, taken in losses.items()}
    assert sorted(expected) == list(range(6))
    losses.clear()

    parts = tiny(tiny_data, tmp_path, "name=parts", *STEPS, *late)
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, killed_at, Killed)
        with pytest.raises(Killed):
            fit(parts)
    assert (tmp_path / "parts" / "checkpoints" / "last.ckpt").exists() == (saved > 0)
    assert not (tmp_path / "parts" / "metrics.csv").exists()
    assert fit(parts) == value
    again = [step for step in range(6) if len(losses[step]) == 2]
    assert again == list(range(saved, killed_at))  # only what came after the last checkpoint is done again
    assert {step: set(taken) for step, taken in losses.items()} == {step: {loss} for step, loss in expected.items()}
    for name in ("last", "best"):
        a, b = checkpoint(whole, name), checkpoint(parts, name)
        assert_same_checkpoint(a, b)
    curves = [[v.tolist() for v in validation_curve(Run(tmp_path / name, {}, table_of([])))] for name in ("whole", "parts")]
    assert curves[0] == curves[1]
    assert curves[0][0] == [2, 4, 6]
    assert (tmp_path / "whole" / "metrics.csv").read_bytes() == (tmp_path / "parts" / "metrics.csv").read_bytes()


@pytest.mark.slow
def test_the_papers_recipe_trains_without_average_and_clipping(
    tiny_data: Path, tmp_path: Path, losses: dict[int, list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights are those of the last step, after steps along whole gradients, and walls stop nothing in the rollouts that choose them."""
    clips = []
    configure = TrainingModule.configure_gradient_clipping

    def clipping(self: TrainingModule, optimizer: Any, gradient_clip_val: float | None = None, **rest: Any) -> None:
        clips.append(gradient_clip_val)
        configure(self, optimizer, gradient_clip_val, **rest)

    monkeypatch.setattr(TrainingModule, "configure_gradient_clipping", clipping)
    contained = []
    monkeypatch.setattr(callbacks, "Contained", lambda *args: contained.append(args))
    cfg = tiny(tiny_data, tmp_path, "name=paper", "recipe=paper", "graph.history=1")
    fit(cfg)
    assert clips == [None, None] and not contained
    saved = checkpoint(cfg)
    assert "averaging_state" not in saved
    assert saved["lr_schedulers"][0]["base_lrs"] == [5e-5]
    assert saved["lr_schedulers"][0]["_last_lr"] == pytest.approx([1e-6])
    written = json.loads((tmp_path / "paper" / "config.json").read_text())
    assert written["training"]["position_noise_of_domain"] == 5e-4 and written["training"]["gradient_clip"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("training.unroll_steps=2",), r"^training: unroll_steps=2: not together with push_fraction=0.6; set push_fraction=0$"),
        (("training.unroll_steps=2", "training.targets=solver", *PLAIN), r"not together with targets=solver; set targets=trajectory$"),
        (("training.unroll_steps=0",), r"^training.unroll_steps=0: "),
        (("training.neighbor_weight=-1",), r"^training.neighbor_weight=-1: "),
        (("training.loss=cube",), r"^training.loss='cube': "),
    ],
)
def test_settings_of_the_loss_that_do_not_fit_are_refused(tmp_path: Path, overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        fit(tiny(tmp_path / "data", tmp_path, *overrides))
    assert not (tmp_path / "data").exists()


def test_a_noise_of_metres_is_refused_before_data_are_generated(tmp_path: Path) -> None:
    cfg = tiny(tmp_path / "data", tmp_path, "recipe=paper", "training.position_noise_of_domain=0.3")
    with pytest.raises(
        NoiseError,
        match=r"^training.position_noise_of_domain=0.3 moves nodes by 0.3 m, which is 14.4 spacings .* at most 0.0104167$",
    ):
        fit(cfg)
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_progress_counts_the_steps_of_the_whole_training(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, notes = list[tuple[int, int]](), list[str]()

    @contextmanager
    def bar(_: str, note: Callable[[], str]) -> Iterator[Progress]:
        def on_progress(done: int, total: int) -> None:
            shown.append((done, total))
            notes.append(note())

        yield on_progress

    monkeypatch.setattr(callbacks, "progress_bar", bar)
    cfg = tiny(tiny_data, tmp_path, *STEPS, "trainer.progress=true", "training.push_fraction=0")
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, 5, Killed)
        with pytest.raises(Killed):
            fit(cfg)
    assert shown == [(step, 6) for step in range(6)]
    shown.clear()
    fit(cfg)
    assert shown == [(step, 6) for step in (4, 5, 6)]
    assert re.fullmatch(r"loss \d[\d.e-]*", notes[-1])


@pytest.mark.slow
def test_worker_processes_change_no_weight(tiny_data: Path, tmp_path: Path) -> None:
    configs = [tiny(tiny_data, tmp_path, f"name=workers{n}", f"trainer.num_workers={n}", *STEPS) for n in (0, 2)]
    values = [fit(cfg) for cfg in configs]
    assert values[0] == values[1]
    assert_equal(*(checkpoint(cfg)["state_dict"] for cfg in configs))


@pytest.mark.slow
def test_the_seed_matters_and_nothing_else_is_random(tiny_data: Path, tmp_path: Path) -> None:
    configs = [tiny(tiny_data, tmp_path, f"name=run{k}", f"seed={seed}") for k, seed in enumerate((0, 0, 1))]
    values = [fit(cfg) for cfg in configs]
    assert values[0] == values[1] != values[2]


@pytest.mark.slow
def test_a_run_killed_while_evaluating_trains_no_further(tiny_data: Path, tmp_path: Path, losses: dict[int, list[float]]) -> None:
    cfg = tiny(tiny_data, tmp_path)
    value = fit(cfg)
    (tmp_path / "fit" / "metrics.csv").unlink()
    losses.clear()
    assert fit(cfg) == value
    assert not losses


@pytest.mark.slow
def test_a_finished_run_is_left_as_it_is(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = tiny(tiny_data, tmp_path)
    value = fit(cfg)
    files = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.rglob("*") if p.is_file()}
    assert not [p for p in files if p.name.startswith(("error_curve", "rollout_test"))]  # evaluation.num_pictures=0
    monkeypatch.setattr(TrajectoryDataModule, "__init__", lambda *_, **__: pytest.fail("opened the data"))
    assert fit(cfg) == value
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.rglob("*") if p.is_file()} == files


@pytest.mark.slow
def test_a_failed_rollout_counts_in_a_search_as_in_tables(tiny_data: Path, tmp_path: Path) -> None:
    cfg = tiny(tiny_data, tmp_path, "evaluation.splits=[test]")
    value = fit(cfg)
    metrics = tmp_path / "fit" / "metrics.csv"
    rows = list(read_rows(metrics))
    judged = [r for r in rows if (r.metric, r.horizon) == ("rollout_mse", "full")]
    learned, flight = ([r.value for r in judged if r.model == name] for name in ("learned", "ballistic"))
    assert value == pytest.approx(np.mean(learned))
    failed = next(r for r in judged if r.model == "learned")
    write_rows(metrics, [replace(r, value=math.inf) if r is failed else r for r in rows])
    assert fit(cfg) == pytest.approx(np.mean([flight[0], *learned[1:]]))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("model.interaction=odd", r"model.interaction: 'negated' there, 'odd' now"),
        ("seed=4", r"seed: 0 there, 4 now"),
        ("training.learning_rate=0.5", r"training.learning_rate: 0.001 there, 0.5 now"),
        ("evaluation.containment=false", r"evaluation.containment: True there, False now"),
    ],
)
def test_another_config_in_the_same_folder_is_refused(tiny_data: Path, tmp_path: Path, override: str, message: str) -> None:
    cfg = tiny(tiny_data, tmp_path, "model.interaction=negated")
    (tmp_path / "fit" / "checkpoints").mkdir(parents=True)
    claim(tmp_path / "fit", _claimed(cfg))
    (tmp_path / "fit" / "checkpoints" / "last.ckpt").touch()
    with pytest.raises(RunError, match=message) as caught:
        fit(tiny(tiny_data, tmp_path, "model.interaction=negated", override))
    assert str(tmp_path / "fit") in str(caught.value)
    assert not (tmp_path / "fit" / "log").exists()


def _claimed(cfg: DictConfig) -> dict[str, Any]:
    from omegaconf import OmegaConf

    values: Any = OmegaConf.to_container(cfg, resolve=True)
    del values["evaluation"]["quantities"]  # changes no metric
    return {k: values[k] for k in ("seed", "size", "data", "graph", "batching", "model", "training", "evaluation")}


@pytest.mark.slow
def test_a_folder_in_which_nothing_was_saved_is_free(tiny_data: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="a start at frame 11 needs"):
        fit(tiny(tiny_data, tmp_path, "graph.history=11"))
    assert fit(tiny(tiny_data, tmp_path)) > 0
    (tmp_path / "fit" / "config.json").write_text("{")
    with pytest.raises(RunError, match="config.json: unreadable"):
        fit(tiny(tiny_data, tmp_path))


@pytest.fixture
def _sigint() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)  # Lightning leaves it ignored


@pytest.mark.usefixtures("_sigint")
def test_ctrl_c_says_how_to_go_on(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt(monkeypatch, 3, KeyboardInterrupt)
    with pytest.raises(RunError, match=r"interrupted; run the same command again to resume from .*last.ckpt"):
        fit(tiny(tiny_data, tmp_path, *STEPS))
    assert (tmp_path / "fit" / "checkpoints" / "last.ckpt").exists()


@pytest.mark.slow
def test_bad_data_stops_the_run_and_keeps_the_last_good_checkpoint(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One material parameter that is not finite reaches the loss only when its trajectory is drawn."""
    cfg = tiny(tiny_data, tmp_path, *STEPS, "training.num_steps=60")
    plain = TrainingModule.training_step

    def training_step(self: TrainingModule, batch: Any, batch_idx: int) -> torch.Tensor | None:
        if self.global_step == 4:  # from now on
            data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
            stored = data.train_set.trajectories[1]
            params = np.full_like(stored.cached.material_params, np.nan)
            data.train_set.trajectories[1] = replace(stored, cached=replace(stored.cached, material_params=params))
        return plain(self, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", training_step)
    with pytest.raises(
        TrainingError,
        match=r"step \d+: the loss is nan for \(trajectory, frame\) = .*\(1, \d+\), as in \d+ other batches since .*last good checkpoint is kept",
    ) as caught:
        fit(cfg)
    step = int(str(caught.value).split(":")[0].removeprefix("step "))
    assert 6 <= step < 50
    kept = checkpoint(cfg)
    assert kept["global_step"] == step // 2 * 2
    assert all(torch.isfinite(w).all() for k in ("state_dict", "current_model_state") for w in kept[k].values())
    assert not (tmp_path / "fit" / "metrics.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("push_fraction", [0.0, 0.6])
def test_one_corrupted_batch_does_not_end_a_run(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, push_fraction: float
) -> None:
    """The batch is named and changes nothing: weights and moments stay those of the step before."""
    plain = TrainingModule.training_step
    weights: dict[int, list[torch.Tensor]] = {}

    def training_step(self: TrainingModule, batch: Any, batch_idx: int) -> Any:
        weights[self.global_step] = [p.detach().clone() for p in self.parameters()]
        if self.global_step == 4:
            if push_fraction:
                batch[0].truth[-1] = torch.nan
            else:
                for material in self.simulator.builder.spec.materials:
                    batch[material].target[0] = torch.nan
        return plain(self, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", training_step)
    fit(tiny(tiny_data, tmp_path, *STEPS, f"training.push_fraction={push_fraction}"))
    (warning,) = [r.message for r in caplog.records if "without this batch" in r.message]
    assert re.match(r"step 4: the loss is nan for \(trajectory, frame\) = \(\d+, \d+\), ", warning)
    assert all(torch.equal(a, b) for a, b in zip(weights[4], weights[5], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(weights[3], weights[4], strict=True))
    assert checkpoint(tiny(tiny_data, tmp_path, *STEPS))["global_step"] == 6


@pytest.mark.slow
def test_a_position_that_is_not_finite_stops_the_run_and_is_named(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trajectory is read from disk, and was spoiled after training had checked all trajectories."""
    plain, spoiled = TrajectoryDataModule.train_dataloader, tmp_path / "shard-00000.h5"

    def train_dataloader(self: TrajectoryDataModule) -> Any:
        stored = self.train_set.trajectories[1]
        assert stored.cached is not None
        pos = stored.cached.pos.copy()
        pos[8, 7] = np.nan
        write_shard(spoiled, [replace(stored.cached, pos=pos)], ["00001"])
        self.train_set.trajectories[1] = replace(stored, path=spoiled, cached=None)
        return plain(self)

    monkeypatch.setattr(TrajectoryDataModule, "train_dataloader", train_dataloader)
    with pytest.raises(StoreError, match="shard-00000.h5:00001: field 'pos': frame 8, node 7, dim 0 and 1 more: not finite"):
        fit(tiny(tiny_data, tmp_path, "training.num_steps=40", "training.val_interval=40"))


@pytest.mark.slow
def test_metrics_hold_the_model_and_the_baselines(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path, "evaluation.num_pictures=1"))
    rows = list(read_rows(tmp_path / "fit" / "metrics.csv"))
    for split, groups in (("test", {"seen"}), ("test_unseen", {"interpolated", "extrapolated"})):
        mse = [r for r in rows if r.split == split and r.metric == "rollout_mse"]
        assert {r.model for r in mse} == {"learned", "ballistic", "stops_at_walls", "constant_velocity"}
        assert {r.horizon for r in mse} == {"0.025s", "full"}
        assert {r.parameter_group for r in mse} == groups
        assert all(np.isfinite(r.value) and r.value >= 0 and np.isfinite(r.parameter) for r in mse)
        assert (tmp_path / "fit" / f"error_curve_{split}.png").stat().st_size > 1000
        for suffix in ("png", "gif", "html"):
            assert (tmp_path / "fit" / f"rollout_{split}_00.{suffix}").stat().st_size > 1000
    extra = {r.metric for r in rows if r.model == "learned"}
    assert {"one_step_nmse", "fraction_outside_uncontained", "fraction_corrected", "momentum_error"} <= extra
    ballistic = {(r.split, r.trajectory): r.value for r in rows if (r.model, r.metric, r.horizon) == ("ballistic", "rollout_mse", "full")}
    assert len(ballistic) == 3
    assert len(set(ballistic.values())) == 3


@pytest.mark.slow
@pytest.mark.parametrize("targets", [pytest.param("trajectory", marks=pytest.mark.long), "solver"])
def test_a_model_of_every_second_frame_is_compared_at_the_same_times(tiny_data: Path, tmp_path: Path, targets: str) -> None:
    elastomer = [] if targets == "trajectory" else ["data=elastomer"]
    shared = [
        *elastomer,
        "graph.history=1",
        "evaluation.start_time=0.02",
        "evaluation.horizons=[0.02,0.03]",
        "evaluation.material_controls=true",
    ]
    at: dict[int, dict[str, dict[Any, float]]] = {}
    for stride in (1, 2):
        settings = [*shared, f"data.stride={stride}", f"training.targets={targets}", "training.push_fraction=0.5", f"name=every_{stride}"]
        fit(tiny(tiny_data, tmp_path, *settings))
        rows = list(read_rows(tmp_path / f"every_{stride}" / "metrics.csv"))
        assert {r.horizon for r in rows if r.metric == "final_mse"} == {"0.02s", "0.03s", "full"}
        for model in ("constant_velocity", "solver at nearest value", "learned"):
            own = {
                (r.split, r.trajectory, r.horizon): r.value
                for r in rows
                if (r.model, r.metric) == (model, "final_mse") and r.horizon != "full"
            }
            at.setdefault(stride, {})[model] = own
    assert at[1]["solver at nearest value"] == pytest.approx(at[2]["solver at nearest value"], rel=1e-6)
    for model, errors in at[2].items():
        assert errors.keys() == at[1][model].keys() and errors, model
    simulator = LearnedSimulator.from_checkpoint(tmp_path / "every_2")
    assert simulator.stride == 2 and simulator.builder.metadata.frame_dt == pytest.approx(0.01)


def test_evaluated_data_with_other_frames_are_refused_before_training(tiny_data: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"evaluation.data: frames of 0.005 s, those of the training have 0.01 s; choose another evaluation.data.stride"
    ):
        fit(tiny(tiny_data, tmp_path, "data.stride=2", "+evaluation.data.stride=1"))
    assert not (tmp_path / "fit").exists()


@pytest.mark.slow
def test_models_with_other_histories_are_judged_on_the_same_frames(tiny_data: Path, tmp_path: Path) -> None:
    judged = []
    for history in (1, 3):
        fit(
            tiny(
                tiny_data,
                tmp_path,
                f"graph.history={history}",
                "evaluation.start_time=0.015",
                "evaluation.splits=[test]",
                f"name=h{history}",
            )
        )
        judged.append([r for r in read_rows(tmp_path / f"h{history}" / "metrics.csv") if r.model == "ballistic"])
    assert judged[0] == judged[1] and judged[0]
    with pytest.raises(StartError, match="start_time=0.005: graph.history=3 needs"):
        fit(tiny(tiny_data, tmp_path, "graph.history=3", "evaluation.start_time=0.005", "name=early"))
    assert not (tmp_path / "early").exists()


@pytest.mark.slow
def test_what_containment_corrects_is_looked_at_where_asked_for(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path, "evaluation.num_uncontained=1"))
    rows = list(read_rows(tmp_path / "fit" / "metrics.csv"))
    assert [(r.split, r.trajectory) for r in rows if r.metric == "fraction_outside_uncontained"] == [("test", 0), ("test_unseen", 0)]
    assert [(r.split, r.trajectory) for r in rows if r.metric == "fraction_corrected"] == [
        ("test", 0),
        ("test_unseen", 0),
        ("test_unseen", 1),
    ]


@pytest.mark.slow
def test_a_trained_model_is_evaluated_again_without_training(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tiny(tiny_data, tmp_path, "name=first")
    fit(first)
    other = tiny(tiny_data, tmp_path, "name=other", "reuse=first", "seed=1")
    fit(other)  # no such model there: trains its own
    assert len(list((tmp_path / "other" / "log").iterdir())) == 1
    again = tiny(tiny_data, tmp_path, "name=again", "reuse=first", "evaluation.splits=[test_unseen]")
    monkeypatch.setattr(TrajectoryDataModule, "__init__", None)  # nothing of the training data is read
    fit(again)
    assert not (tmp_path / "again" / "log").exists()
    assert_equal(checkpoint(again, "best")["state_dict"], checkpoint(first, "best")["state_dict"])
    before, now = (
        {
            (r.trajectory, r.metric, r.horizon): r.value
            for r in read_rows(tmp_path / name / "metrics.csv")
            if r.model == "learned" and r.split == "test_unseen"
        }
        for name in ("first", "again")
    )
    assert now == pytest.approx(before, rel=1e-9)


@pytest.mark.slow
def test_training_starts_from_another_runs_model(tiny_data: Path, tmp_path: Path) -> None:
    first = tiny(tiny_data, tmp_path, "name=first")
    fit(first)
    start = f"start_from={tmp_path / 'first'}"
    still = ("training.learning_rate=1e-30", "training.final_learning_rate=1e-30")
    again = tiny(tiny_data, tmp_path, "name=again", start, "seed=1", *still)
    fit(again)
    own, before = (LearnedSimulator.from_checkpoint(tmp_path / name).state_dict() for name in ("again", "first"))
    for name, value in before.items():
        torch.testing.assert_close(own[name], value, rtol=1e-6, atol=1e-12)
    digest = json.loads((tmp_path / "again" / "config.json").read_text())["start_from"]
    assert digest.startswith("best.ckpt (sha256 ")
    with pytest.raises(RunError, match=f"start_from: '{re.escape(digest)}' there, None now"):
        fit(tiny(tiny_data, tmp_path, "name=again", "seed=1", *still))
    shutil.move(tmp_path / "first", tmp_path / "moved")
    fit(tiny(tiny_data, tmp_path, "name=again", f"start_from={tmp_path / 'moved'}", "seed=1", *still))  # the same model, wherever it lies


@pytest.mark.slow
def test_a_model_of_sand_starts_and_adapts_to_snow(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path, "name=sand"))
    sand = LearnedSimulator.from_checkpoint(tmp_path / "sand").model.state_dict()
    snow = ("data=snow", f"start_from={tmp_path / 'sand'}")
    for name, overrides in (("zero", ("training.num_steps=0",)), ("early", ("training.early_layers=0", "training.learning_rate=0.1"))):
        fit(tiny(tiny_data, tmp_path, f"name={name}", *snow, *overrides))
        model = LearnedSimulator.from_checkpoint(tmp_path / name).model
        same = {key for key, value in model.state_dict().items() if torch.equal(value, sand[key.replace("snow", "sand")])}
        changed = {key.split(".")[0] for key in model.state_dict() if key not in same}
        assert changed == ({"material_embedding"} if name == "zero" else {"material_embedding", "node_encoder", "edge_encoder"})
        assert {r.split for r in read_rows(tmp_path / name / "metrics.csv")} == {"test", "test_unseen"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("start_from=nowhere", "nowhere: no such checkpoint; give the folder of a run"),
        ("start_from=3", "start_from=3: must be null, the folder of a run"),
        ("start_from=snow", "another one; choose .*model.num_message_passing_steps=4 model.hidden_channels=64"),
        ("training.early_layers=1", "training.early_layers=1: the other layers stay as they are; needs start_from"),
        ("training.num_steps=0", "training.num_steps=0: there is nothing to evaluate; needs start_from"),
    ],
)
def test_a_start_that_does_not_fit_is_refused(tiny_data: Path, tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(GpeError, match=message):
        fit(tiny(tiny_data, tmp_path, override))
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.slow
def test_a_trained_checkpoint_holds_the_averaged_weights(tiny_data: Path, tmp_path: Path) -> None:
    cfg = tiny(tiny_data, tmp_path, *STEPS)
    fit(cfg)
    best = checkpoint(cfg, "best")
    simulator = LearnedSimulator.from_checkpoint(tmp_path / "fit" / "checkpoints" / "best.ckpt")
    weights = {f"simulator.{k}": v for k, v in simulator.state_dict().items()}
    assert_equal(weights, best["state_dict"])
    assert any(not torch.equal(best["state_dict"][k], best["current_model_state"][k]) for k in weights)
    assert float(simulator.acceleration_std) != 1.0


@pytest.mark.slow
def test_a_sweep_ends_with_table_and_plot(tiny_data: Path, tmp_path: Path) -> None:
    for interaction in ("negated", "odd"):
        for seed in (0, 1):
            fit(
                tiny(
                    tiny_data,
                    tmp_path,
                    f"name='log/model.interaction={interaction}/seed={seed}'",
                    f"model.interaction={interaction}",
                    f"seed={seed}",
                )
            )
    folder = tmp_path / "log"  # a folder's name must not matter
    shutil.copytree(folder / "model.interaction=odd" / "seed=0", folder / "again")  # the same run once more is no further seed
    report_sweep(folder, finished_runs(folder))
    with open(folder / "table.csv", newline="") as handle:
        reader = csv.DictReader(handle)
        assert reader.fieldnames == ["interaction", "seed", "split", "metric", "horizon", "value"]
        rows = list(reader)
    assert {(r["interaction"], r["seed"]) for r in rows} == {(i, s) for i in ("negated", "odd") for s in "01"}
    assert {r["split"] for r in rows} == {"val", "test", "test_unseen", "test_unseen/interpolated", "test_unseen/extrapolated"}
    assert len({tuple(list(r.values())[:-1]) for r in rows}) == len(rows)  # the copy does not count
    chosen = {
        r["metric"]: float(r["value"])
        for r in rows
        if (r["interaction"], r["seed"], r["split"], r["horizon"]) == ("odd", "1", "test_unseen", "full")
    }
    run = list(read_rows(folder / "model.interaction=odd" / "seed=1" / "metrics.csv"))
    values = [r.value for r in run if (r.model, r.split, r.metric, r.horizon) == ("learned", "test_unseen", "rollout_mse", "full")]
    assert chosen["rollout_mse"] == pytest.approx(np.mean(values))
    val = {(r["interaction"], r["seed"]): float(r["value"]) for r in rows if r["split"] == "val"}
    assert val["negated", "0"] == validation_curve(Run(folder / "model.interaction=negated" / "seed=0", {}, table_of([])))[1][-1]
    table = (folder / "table.md").read_text()
    assert all(f"| {name} |" in table for name in ("negated", "odd", "ballistic", "stops_at_walls", "constant_velocity"))
    assert (folder / "validation_loss.png").stat().st_size > 1000
