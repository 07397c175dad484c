"""Commands that are killed, run out of disk, may not write, or find their files damaged report it in one line and can be continued."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import yaml

from gpe_pl.benchmarks.faults import isolation, outside, pairs, runs
from gpe_pl.benchmarks.faults.runs import Command
from gpe_pl.benchmarks.faults.verdict import GOOD, Fault, Verdict
from gpe_pl.config.folder import CONF
from gpe_pl.training.checkpoints import AtomicCheckpoints

pytestmark = pytest.mark.long
SUITE = yaml.safe_load((CONF / "suite" / "faults.yaml").read_text())


def command(name: str, data: Path | None = None) -> Command:
    """Return one of the miniature commands of the suite."""
    attacked = SUITE["commands"][name]
    return Command(name, attacked["module"], (*SUITE["data"], *attacked["arguments"]), None if data is None else str(data))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    simulate = command("simulate")
    ended = isolation.run("simulate", simulate.given(folder))
    assert ended.code == 0, ended.output
    return folder / "data"


@pytest.mark.parametrize("name", ["simulate", "fit", "sweep"])
def test_killed_at_random_moments(data: Path, tmp_path: Path, name: str) -> None:
    found = list(runs.kills(command(name, None if name == "simulate" else data), tmp_path, 4, in_a_row=4, seed=1))
    assert len(found) == 4
    assert all(v.status == "harmless" for v in found), found


def test_two_trainings_at_once(data: Path, tmp_path: Path) -> None:
    fit = command("fit", data)
    assert isolation.run("fit", fit.given(tmp_path / "whole")).code == 0
    left = runs.digests(tmp_path / "whole")
    own = tmp_path / "pair"
    own.mkdir()
    verdict = pairs.together((fit, fit), (left, left), 0.5, 600.0, own)
    assert verdict.status == "refused" and pairs.SAYS_WHY.search(verdict.detail), verdict


@pytest.mark.parametrize("state", outside.STATES)
def test_paths_in_checkpoints_lead_nowhere(data: Path, tmp_path: Path, state: str) -> None:
    fit = command("fit", data)
    assert isolation.run("fit", fit.given(tmp_path / "whole")).code == 0
    attack = partial(outside.resumed, fit, state, "{canary}/checkpoints/best.ckpt", runs.digests(tmp_path / "whole"), 600.0)
    verdict = isolation._watched(Fault("kind", state, attack, 600.0), tmp_path / "own", tmp_path / isolation.CANARY)
    assert verdict.status in GOOD, verdict
    assert "not done" not in verdict.detail


@pytest.mark.parametrize("size", [100, 20_000])
def test_a_full_disk(data: Path, tmp_path: Path, size: int) -> None:
    fit = command("fit", data)
    whole = tmp_path / "whole"
    assert isolation.run("fit", fit.given(whole)).code == 0
    for attack in (runs.full_disk, runs.file_limit):
        own = tmp_path / attack.__name__
        own.mkdir()
        verdict = attack(fit, size, runs.digests(whole), 600.0, own)
        assert verdict.status == "refused", verdict


@pytest.mark.parametrize("attack", [runs.read_only, runs.file_in_the_way])
def test_a_folder_that_cannot_be_written(data: Path, tmp_path: Path, attack: Callable[[Command, float, Path], Verdict]) -> None:
    verdict = attack(command("fit", data), 600.0, tmp_path)
    assert verdict.status == "refused" or "not done" in verdict.detail, verdict


def test_a_damaged_checkpoint_is_not_resumed_from(data: Path, tmp_path: Path) -> None:
    fit = command("fit", data)
    assert isolation.run("fit", fit.given(tmp_path)).code == 0
    run = tmp_path / "runs" / "fit"
    (run / "metrics.csv").unlink()
    last = run / "checkpoints" / "last.ckpt"
    last.write_bytes(last.read_bytes()[:-1000])
    ended = isolation.run("fit", fit.given(tmp_path))
    assert ended.verdict().status == "refused"
    assert "last.ckpt: not a safe, complete checkpoint" in ended.output
    last.unlink()
    assert isolation.run("fit", fit.given(tmp_path)).code == 0


def test_runs_end_with_their_sweep(data: Path, tmp_path: Path) -> None:
    """Otherwise the same command, given again, would meet them in their folders."""
    arguments = [*SUITE["data"], *SUITE["commands"]["fit"]["arguments"], f"paths.data={data}", f"paths.runs={tmp_path}"]
    endless = [a for a in arguments if "num_steps" not in a] + ["training.num_steps=1000000", "hydra.mode=MULTIRUN", "seed=0", "name=sweep"]
    sweep = subprocess.Popen([sys.executable, "-m", "gpe_pl.fit", *endless], stdout=subprocess.DEVNULL, cwd=CONF.parent)
    deadline = time.monotonic() + 500
    try:
        while not list(tmp_path.rglob("last.ckpt")):
            assert sweep.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        assert len(_running(str(tmp_path))) == 2
    finally:
        sweep.kill()
        sweep.wait()
    while _running(str(tmp_path)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def _running(text: str) -> list[int]:
    """Return the processes with a text in their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if text in path.read_text() and int(path.parent.name) != os.getpid():
                found.append(int(path.parent.name))
    return found


def test_checkpoints_are_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpoints().save_checkpoint({"a": 1}, path)
    before = path.read_bytes()

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="No space left"):
        AtomicCheckpoints().save_checkpoint({"a": 2}, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]
    assert AtomicCheckpoints().load_checkpoint(path) == {"a": 1}


def test_a_table_without_results_is_no_result(data: Path, tmp_path: Path) -> None:
    fit = command("fit", data)
    assert isolation.run("fit", fit.given(tmp_path)).code == 0
    table = tmp_path / "runs" / "fit" / "metrics.csv"
    whole = table.read_text()
    table.write_text(whole.splitlines(keepends=True)[0])
    table.with_name("metrics.csv.sha256").unlink()  # as if it had been written so
    ended = isolation.run("fit", fit.given(tmp_path))
    assert ended.verdict().status == "refused"
    assert "has no rollout_mse of learned on" in ended.output and "delete the file" in ended.output
    table.unlink()
    assert isolation.run("fit", fit.given(tmp_path)).code == 0
    assert table.read_text() == whole
