"""Optuna's sweep: trials within the space, stored in a journal, and resumed after an interruption."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf

from gpe_pl.config.launcher import SweepError, UsageError
from gpe_pl.config.sweeper import OptunaSweeper

optuna = pytest.importorskip("optuna")

SPACE = {"rate": "tag(log, interval(1e-4, 1e-2))", "model": "gpe,gns", "depth": "int(interval(1, 4))"}


class Launcher:
    """Launcher whose jobs return a formula of their overrides; the n-th may be killed, and some models fail or return another value."""

    def __init__(self, killed_at: int | None = None, failing: str = "", other: dict[str, float | None] | None = None) -> None:
        self.killed_at, self.failing, self.other = killed_at, failing, other or {}
        self.jobs: list[list[str]] = []
        self.sizes: list[int] = []

    def launch(self, overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        self.sizes.append(len(overrides))
        returns = []
        for job in overrides:
            self.jobs.append(list(job))
            assert len(self.jobs) <= 8, "the sweep does not end"
            if len(self.jobs) - 1 == self.killed_at:
                raise KeyboardInterrupt
            values = dict(o.split("=", 1) for o in job)
            if self.failing and values["model"] == self.failing:
                returns.append(JobReturn(job, status=JobStatus.FAILED, _return_value=SweepError("no")))
            else:
                loss = abs(float(values["rate"]) - 3e-3) + int(values["depth"]) + (values["model"] == "gns")
                value = self.other.get(values["model"], loss)
                returns.append(JobReturn(job, status=JobStatus.COMPLETED, _return_value=value))
        return returns


def sweeper(folder: Path, launcher: Launcher, **settings: Any) -> OptunaSweeper:
    made = OptunaSweeper(**{"num_trials": 6, "params": SPACE, **settings})
    made.config, made.launcher = OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}), launcher  # type: ignore[assignment]
    return made


def test_trials_lie_in_the_space_and_the_best_is_written(tmp_path: Path) -> None:
    launcher = Launcher()
    sweeper(tmp_path, launcher, num_at_once=4).sweep(["seed=3", "size=tiny"])
    assert launcher.sizes == [4, 2]
    losses = {}
    for job in launcher.jobs:
        values = dict(o.split("=", 1) for o in job)
        assert values["seed"] == "3" and values["size"] == "tiny"
        assert 1e-4 <= float(values["rate"]) <= 1e-2 and values["model"] in ("gpe", "gns") and values["depth"] in ("1", "2", "3", "4")
        losses[json.dumps(values)] = abs(float(values["rate"]) - 3e-3) + int(values["depth"]) + (values["model"] == "gns")
    assert len(losses) == 6
    best = json.loads((tmp_path / "best.json").read_text())
    assert best["value"] == pytest.approx(min(losses.values()))


def test_a_sweep_that_was_killed_goes_on(tmp_path: Path) -> None:
    first = Launcher(killed_at=3)
    with pytest.raises(KeyboardInterrupt):
        sweeper(tmp_path, first).sweep([])
    second = Launcher()
    sweeper(tmp_path, second).sweep([])
    assert second.jobs[0] in first.jobs[:3]  # the best so far, whose folder knows that it is finished
    assert second.jobs[1] == first.jobs[3]  # whose folder knows how far it is
    assert len(second.jobs) == 4
    assert not [job for job in second.jobs[1:] if job in first.jobs[:3]]
    finished = Launcher()
    sweeper(tmp_path, finished).sweep([])
    assert len(finished.jobs) == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            Launcher(other={"gpe": 0.25}),
            r"trial \d of an earlier start had [\d.]+ and has 0.25 now, so settings or data have changed; choose",
        ),
        (Launcher(failing="gpe"), r"trial \d of an earlier start cannot be repeated: no; choose another name=… or delete the folder$"),
    ],
)
def test_numbers_of_other_settings_or_data_are_not_compared(tmp_path: Path, changed: Launcher, message: str) -> None:
    sweeper(tmp_path, Launcher(), num_trials=2).sweep(["model=gpe"])
    best = (tmp_path / "best.json").read_bytes()
    with pytest.raises(SweepError, match=message):
        sweeper(tmp_path, changed, num_trials=4).sweep(["model=gpe"])
    assert len(changed.jobs) == 1 and (tmp_path / "best.json").read_bytes() == best


def test_a_key_on_the_command_line_takes_the_place_of_the_space(tmp_path: Path) -> None:
    launcher = Launcher()
    sweeper(tmp_path, launcher, num_trials=3).sweep(["model=gns", "depth=2,3"])
    values = [dict(o.split("=", 1) for o in job) for job in launcher.jobs]
    assert {v["model"] for v in values} == {"gns"} and {v["depth"] for v in values} <= {"2", "3"}


def test_failed_trials_are_left_out_and_a_sweep_of_nothing_else_ends(tmp_path: Path) -> None:
    launcher = Launcher(failing="gns")
    sweeper(tmp_path, launcher, num_trials=8, num_at_once=4).sweep([])
    assert json.loads((tmp_path / "best.json").read_text())["values"]["model"] == "gpe"
    assert len(launcher.jobs) == 8
    with pytest.raises(SweepError, match="no"):
        sweeper(tmp_path / "other", Launcher(failing="gns")).sweep(["model=gns"])


@pytest.mark.slow
@pytest.mark.parametrize("value", [math.nan, math.inf, None])
def test_trials_without_a_finite_value_count_and_are_left_out(tmp_path: Path, value: float | None) -> None:
    launcher = Launcher(other={"gns": value})
    sweeper(tmp_path, launcher, num_trials=8, num_at_once=4).sweep([])
    best = json.loads((tmp_path / "best.json").read_text())
    assert best["values"]["model"] == "gpe" and math.isfinite(best["value"])
    assert len(launcher.jobs) == 8 and any("model=gns" in job for job in launcher.jobs)
    with pytest.raises(SweepError, match="no trial has returned a finite number"):
        sweeper(tmp_path / "other", Launcher(other={"gns": value})).sweep(["model=gns"])


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="hydra.sweeper.num_trials=0: must be an integer of at least 1"):
        OptunaSweeper(num_trials=0)
    with pytest.raises(UsageError, match="no key has several values"):
        sweeper(tmp_path, Launcher(), params={}).sweep(["seed=1"])
    with pytest.raises(UsageError, match=r"rate=tag\(log, interval\(0, 1\)\): "):
        sweeper(tmp_path, Launcher(), params={"rate": "tag(log, interval(0, 1))"}).sweep([])


@pytest.mark.parametrize(
    "damage", ["{\n", "[1]\n", '{"op_code": 99}\n', '{"op_code": 4, "worker_id": "x"}\n', "\x00\n", "[" * 100_000 + "\n"]
)
def test_a_damaged_journal_is_named(tmp_path: Path, damage: str) -> None:
    sweeper(tmp_path, Launcher(), num_trials=2).sweep([])
    path = tmp_path / "optuna.log"
    path.write_text(damage + path.read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(SweepError, match=r"optuna.log: damaged \(.*\); delete the file to begin the search again"):
        sweeper(tmp_path, Launcher(), num_trials=4).sweep([])


def test_a_journal_whose_last_line_was_cut_off_keeps_its_trials(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sweeper(tmp_path, Launcher(), num_trials=3).sweep([])
    path = tmp_path / "optuna.log"
    path.write_bytes(path.read_bytes()[:-20])
    for num_trials in (4, 5):
        launcher = Launcher()
        sweeper(tmp_path, launcher, num_trials=num_trials).sweep([])
        assert 0 < len(launcher.jobs) < num_trials  # the other trials are known
    assert caplog.text.count("optuna.log: its last line was not finished and is dropped") == 1
