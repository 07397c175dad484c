"""A budget of minutes becomes a number of steps once, and keeps that number."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from gpe_pl.config.entry_point import construct
from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.data.sampling import BatchSize, PushForward
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import without_tables
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.training import budget
from gpe_pl.training.budget import BudgetError, PauseForMeasurements, step_time, step_time_key, within_budget
from gpe_pl.training.module import COMPILE_PAYS_AFTER, TrainingModule
from gpe_pl.training.run import TrainerSettings, TrainingSettings
from tests.runs import compose

SETTINGS = TrainingSettings(num_steps=1000, val_interval=250, budget_minutes=0.5)


def test_steps_fill_the_budget_and_validations_keep_their_number(tmp_path: Path) -> None:
    path, calls = tmp_path / "sweep" / "step_times.json", []

    def measure(_: TrainingSettings) -> float:
        calls.append(1)
        return 0.0301

    settings = within_budget(SETTINGS, path, "sand GPE", measure)
    assert (settings.num_steps, settings.val_interval) == (4 * 249, 249)  # 30 s / 30.1 ms / 4 = 249.2
    assert settings.budget_minutes is None
    assert within_budget(SETTINGS, path, "sand GPE", measure) == settings
    assert len(calls) == 1
    other = within_budget(SETTINGS, path, "sand GNS", lambda _: 0.1)
    assert other.num_steps == 300
    assert within_budget(SETTINGS, path, "sand GPE", measure) == settings


def test_a_step_dearer_than_the_budget_is_taken_once_per_validation(tmp_path: Path) -> None:
    assert within_budget(SETTINGS, tmp_path / "t.json", "slow", lambda _: 1e4).num_steps == 4


@pytest.mark.parametrize(("plain", "asked"), [(0.1, ["off"]), (0.001, ["off", "auto"])])
def test_the_step_is_measured_as_the_run_will_take_it(tmp_path: Path, plain: float, asked: list[str]) -> None:
    seen = []

    def measure(settings: TrainingSettings) -> float:
        seen.append(settings.compile)
        assert settings.compile == "off" or settings.num_steps >= COMPILE_PAYS_AFTER
        return plain if settings.compile == "off" else plain / 2

    result = within_budget(SETTINGS, tmp_path / "t.json", "sand", measure)
    assert seen == asked
    assert result.num_steps == (300 if plain == 0.1 else 60_000)


def test_trainings_pause_while_a_step_is_measured(tmp_path: Path) -> None:
    path, events = tmp_path / "step_times.json", []
    measuring, may_end = threading.Event(), threading.Event()

    def measure(_: TrainingSettings) -> float:
        measuring.set()
        may_end.wait(30)
        events.append("measured")
        return 0.1

    def train() -> None:
        PauseForMeasurements(path).on_train_batch_start()
        events.append("trained")

    measurer = threading.Thread(target=within_budget, args=(SETTINGS, path, "sand", measure))
    measurer.start()
    assert measuring.wait(30)
    trainer = threading.Thread(target=train)
    trainer.start()
    trainer.join(0.2)
    assert events == []
    may_end.set()
    measurer.join(30)
    trainer.join(30)
    assert events == ["measured", "trained"]


def test_a_measurement_that_was_killed_holds_nobody_up(tmp_path: Path) -> None:
    path = tmp_path / "step_times.json"
    (tmp_path / "step_times.measuring").touch()
    PauseForMeasurements(path).on_train_batch_start()
    assert not (tmp_path / "step_times.measuring").exists()


@pytest.mark.parametrize(("rate", "is_another"), [(1e11, False), (1.3e11, False), (1.5e11, True), (0.5e11, True)])
def test_times_of_another_machine_are_not_mixed_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, rate: float, is_another: bool
) -> None:
    path = tmp_path / "step_times.json"
    monkeypatch.setattr(budget, "gemm_rate", lambda *_: 1e11)
    within_budget(SETTINGS, path, "sand GPE", lambda _: 0.1)
    monkeypatch.setattr(budget, "gemm_rate", lambda *_: rate)
    within_budget(SETTINGS, path, "sand GPE", lambda _: 0.1)
    assert "products" not in caplog.text
    within_budget(SETTINGS, path, "sand GNS", lambda _: 0.1)
    said = f"step_times.json: its step times were measured where products ran at 100 GFLOP/s, and here it is {rate / 1e9:.0f}; sand GNS"
    assert (said in caplog.text) == is_another
    assert budget.read_times(path) == {budget.RATE: 1e11, "sand GPE": 0.1, "sand GNS": 0.1}


def test_a_file_without_a_rate_stays_without(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "step_times.json"
    sealed.write(path, {"sand GPE": 0.1})
    within_budget(SETTINGS, path, "sand GNS", lambda _: 0.1)
    assert budget.read_times(path) == {"sand GPE": 0.1, "sand GNS": 0.1}
    assert "products" not in caplog.text


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"sand": 0.1}', '{"sand": NaN}', '{"sand": 1e999}', "[" * 10**5, "\x00", '{"sand": 1' + 5000 * "0" + "}"]
)
def test_a_damaged_file_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "step_times.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(BudgetError, match=r"step_times\.json: .*; delete it to measure again"):
        within_budget(SETTINGS, path, "sand", lambda _: 1.0)


@pytest.mark.parametrize("value", [0, -0.1, "fast", None, True, [0.1]])
def test_a_step_time_is_a_positive_number(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "step_times.json"
    sealed.write(path, {"sand": value})
    with pytest.raises(BudgetError, match=r"step_times\.json: not a file of step times, which are positive numbers; delete it"):
        within_budget(SETTINGS, path, "sand", lambda _: 1.0)


def test_a_changed_digit_does_not_change_the_number_of_steps(tmp_path: Path) -> None:
    path = tmp_path / "step_times.json"
    within_budget(SETTINGS, path, "sand", lambda _: 0.0301)
    path.write_text(path.read_text(encoding="utf-8").replace("0.0301", "9.0301"), encoding="utf-8")
    with pytest.raises(BudgetError, match=r"was changed or damaged since it was written \(checksum mismatch\); delete it to measure again"):
        within_budget(SETTINGS, path, "sand", lambda _: 1.0)


def test_a_measurement_that_fails_writes_nothing(tmp_path: Path) -> None:
    def measure(_: TrainingSettings) -> float:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        within_budget(SETTINGS, tmp_path / "t.json", "sand", measure)
    assert not (tmp_path / "t.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "is_other"),
    [
        (["seed=3", "name=mine", "trainer.progress=false"], False),
        (["data.larger.scene.max_bodies=7", "size.comparison.seeds='0'"], False),
        (["model.hidden_channels=8"], True),
        (["training.batch_size=3"], True),
        (["batching=by_nodes"], True),
        (["training.compile=auto"], True),
        (["trainer.matmul_precision=high"], True),
        (["training.push_fraction=0.9"], True),
        (["training.cuda_graph=off"], False),  # on a CPU, which has none
        (["training.push_fraction=0", "training.unroll_steps=2"], True),
        (["training.targets=solver"], True),
        (["training.mirror=true"], True),
        (["training.neighbor_weight=1.0"], True),
        (["training.early_layers=1"], True),
    ],
)
def test_a_step_is_measured_again_where_its_time_is_another(overrides: list[str], is_other: bool) -> None:
    def key(*more: str) -> str:
        cfg = compose("fit", "size=tiny", "model=gpe_tuned", "training.compile=off", *more)
        values: Any = OmegaConf.to_container(cfg, resolve=True)
        settings = construct(TrainingSettings, cfg.training, "training"), construct(TrainerSettings, cfg.trainer, "trainer")
        return step_time_key(without_tables(values), *settings)

    assert (key(*overrides) != key()) == is_other


def test_a_step_with_cuda_graphs_has_a_time_of_its_own_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = compose("fit", "size=tiny", "model=gpe_tuned")
    trainer = construct(TrainerSettings, cfg.trainer, "trainer")
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    values = without_tables(config)
    monkeypatch.setattr(TrainerSettings, "device", "cuda")
    keys = {step_time_key(values, replace(SETTINGS, cuda_graph=choice), trainer) for choice in ("auto", "off")}
    assert len(keys) == 2


@pytest.fixture
def measurable(tiny_data: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[TrainingModule, WindowDataset]:
    """Return a module and its windows, of which few steps are measured."""
    monkeypatch.setattr(budget, "WARM_UP_STEPS", 1)
    monkeypatch.setattr(budget, "MEASURED_STEPS", 2)
    stored = open_split(tiny_data / "sand" / "tiny", "train")
    builder = GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata)
    module = TrainingModule(LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder), num_steps=10)
    return module, WindowDataset(stored, builder)


def test_measuring_trains_nothing(measurable: tuple[TrainingModule, WindowDataset]) -> None:
    module, data = measurable
    before = {k: v.clone() for k, v in module.state_dict().items()}
    assert step_time(module, data, BatchSize(2), gradient_clip=1.0) > 0
    assert step_time(module, data, BatchSize(2), 1.0, PushForward(0, 3)) > 0
    assert all(torch.equal(v, before[k]) for k, v in module.state_dict().items())


@pytest.mark.parametrize(("limit", "num_steps"), [(0.0, 1 + 2), (math.inf, 1 + 5 * 2)])
def test_no_round_begins_after_the_limit(
    measurable: tuple[TrainingModule, WindowDataset], limit: float, num_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of warming up, and rounds of two."""
    module, data = measurable
    monkeypatch.setattr(budget, "ROUNDS", 5)
    counted: list[int] = []
    loss = module.loss

    def counted_loss(batch: Any) -> torch.Tensor:
        counted.append(1)
        return loss(batch)

    monkeypatch.setattr(module, "loss", counted_loss)
    step_time(module, data, BatchSize(2), 1.0, limit=limit)
    assert len(counted) == num_steps


def test_steps_with_unrolls_weigh_as_they_occur_and_divide_the_time_to_measure(
    measurable: tuple[TrainingModule, WindowDataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    module, data = measurable
    limits: list[float] = []

    def fake(*arguments: Any, limit: float) -> float:
        limits.append(limit)
        return 0.1 if len(arguments) == 4 else 0.5

    monkeypatch.setattr(budget, "step_time", fake)
    settings = replace(SETTINGS, budget_minutes=0.5)
    times = [budget.mean_step_time(module, data, BatchSize(2), replace(settings, push_fraction=s)) for s in (0.0, 0.25)]
    assert times == pytest.approx([0.1, 0.2])
    assert limits == [15.0, 7.5, 7.5]


def test_step_times_of_imported_data_are_known_by_what_the_data_hold() -> None:
    config = {
        "graph": {},
        "model": {"_target_": "a.GPE"},
        "data": {"name": "mine"},
        "size": {"name": "tiny"},
        "batching": {"max_nodes": None},
    }
    training, trainer = TrainingSettings(num_steps=2, val_interval=1), TrainerSettings()
    first, second = (step_time_key(config, training, trainer, data) for data in ("0123", "4567"))
    assert first != second
