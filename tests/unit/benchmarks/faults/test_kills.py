"""Kills of commands: those that cannot be resumed, ignore a signal, or leave wrong results are noticed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.benchmarks.faults import isolation, runs
from gpe_pl.benchmarks.faults.isolation import Ended
from gpe_pl.benchmarks.faults.verdict import Verdict
from tests.unit.benchmarks.faults.test_faults import COMMANDS, Ends


def _of_this_test(mode: str, folder: str, output: str) -> None:
    """Play a command that takes 0.6 s and writes a table."""
    with open(output, "wb", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN if mode == "ignores signals" else signal.SIG_DFL)
    table = Path(folder) / "runs" / "table.md"
    if mode == "refuses to resume" and table.parent.exists():
        os.write(1, b"error: runs: remains of another command\n")
        os._exit(1)
    if mode == "wrong and done" and table.exists():
        os.write(1, b"error: runs: exists already\n")
        os._exit(1)
    table.parent.mkdir(parents=True, exist_ok=True)
    if mode == "wrong and done":
        table.write_text("right" if Path(folder).name == "whole" else "wrong")
    time.sleep(0.6)
    if mode != "wrong and done":
        table.write_text("right")
    os._exit(0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "module", "status"),
    [
        ("resumes", "fit", "harmless"),
        ("refuses to resume", "fit", "different"),
        ("wrong and done", "convert", "different"),
        ("ignores signals", "fit", "hung"),
    ],
)
def test_kills_notice_commands_that_neither_end_nor_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, module: str, status: str
) -> None:
    context = multiprocessing.get_context("fork")

    def start(_: str, given: list[str], output: Path, __: object = None) -> Any:
        output.touch()
        folder = next(Path(text.removeprefix("paths.runs=")).parent for text in given if text.startswith("paths.runs="))
        process = context.Process(target=_of_this_test, args=(mode, str(folder), str(output)))
        process.start()
        return process

    monkeypatch.setattr(isolation, "start", start)
    found = list(runs.kills(runs.Command("one", module, (), seconds=0.6), tmp_path, 6, in_a_row=3, seed=0))
    statuses = {verdict.status for verdict in found}
    assert status in statuses and statuses <= {"harmless", status}, found


def test_a_command_that_does_not_end_after_a_signal_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    class Runs(Ends):
        pid = 0

    def waited(_: object, seconds: float) -> bool:
        waits.append(seconds)
        return False

    monkeypatch.setattr(isolation, "start", lambda *_: Runs(0))
    monkeypatch.setattr(isolation, "waited", waited)
    monkeypatch.setattr(os, "kill", lambda *_: None)
    verdict = runs._killed(COMMANDS[0], tmp_path, tmp_path / "output", signal.SIGTERM, 0.3)
    assert verdict == Verdict("hung", "goes on for 5 s after SIGTERM") and waits == [0.3, runs.ANSWER]


@pytest.mark.parametrize("ended", [Ended(2, "error: no room"), Ended(0, "")])
def test_a_command_that_fails_undisturbed_cannot_be_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ended: Ended) -> None:
    """Neither at all, nor in another folder than the first."""
    monkeypatch.setattr(isolation, "run", lambda *_: ended)
    monkeypatch.setattr(isolation, "start", lambda _, __, output: output.write_text("error: no room") and Ends(2))
    assert {verdict.status for verdict in runs.kills(COMMANDS[0], tmp_path, 2)} == {"different"}


@pytest.mark.parametrize(("left", "status"), [(".fit.lock", "harmless"), (".fit.holder", "harmless"), ("x.part", "half-written")])
def test_a_lock_of_a_killed_command_may_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: str, status: str) -> None:
    """The operating system has released it; but the command that ends by itself removes what is temporary."""

    class Runs(Ends):
        pid = 0

    process, waits = Runs(0), iter([False, True])

    def start(module: str, arguments: list[str], output: Path) -> Runs:
        output.touch()
        (tmp_path / "killed-0" / "runs").mkdir(parents=True)
        (tmp_path / "killed-0" / "runs" / left).touch()
        return process

    monkeypatch.setattr(isolation, "start", start)
    monkeypatch.setattr(isolation, "run", lambda *_: Ended(0, ""))
    monkeypatch.setattr(isolation, "waited", lambda *_: next(waits))
    monkeypatch.setattr(os, "kill", lambda *_: None)
    assert [verdict.status for verdict in runs.kills(COMMANDS[0], tmp_path, 1)] == [status]
