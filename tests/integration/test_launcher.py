"""Sweeps run side by side, each run as the command that would run it alone; what fails is named, and the rest is run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gpe_pl.launcher import ProcessLauncher, default_processes
from tests.runs import DATA, RUN


def sweep(data: Path, runs: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    where = [f"paths.data={data}", f"paths.runs={runs}", "name=sweep", "hydra.launcher.num_processes=2"]
    command = [sys.executable, "-m", "gpe_pl.fit", "-m", *DATA, *RUN, *where, *overrides]
    return subprocess.run(command, capture_output=True, text=True, timeout=500)


def finished(folder: Path) -> dict[Path, int]:
    """When each run wrote its results."""
    return {p: p.stat().st_mtime_ns for p in folder.rglob("metrics.csv") if (p.parent / "config.json").exists()}


@pytest.mark.slow
def test_failures_are_named_and_the_others_run_and_a_rerun_finishes_them(tiny_data: Path, tmp_path: Path) -> None:
    result = sweep(tiny_data, tmp_path, "training.learning_rate=1e-3,1e30", "seed=0,1")
    assert result.returncode == 2
    assert "2 of 4 runs failed" in result.stderr
    assert "training.learning_rate=1e" in result.stderr
    assert "output.log" in result.stderr
    assert "Traceback" not in result.stderr
    before = finished(tmp_path)
    assert len(before) == 2
    again = sweep(tiny_data, tmp_path, "training.learning_rate=1e-3", "seed=0,1")
    assert again.returncode == 0, again.stderr
    assert "2/2 done" in again.stdout
    assert finished(tmp_path) == before  # finished runs are left as they are
    assert (tmp_path / "sweep" / "table.md").exists()


@pytest.mark.slow
def test_a_wrong_configuration_is_said_once(tiny_data: Path, tmp_path: Path) -> None:
    result = sweep(tiny_data, tmp_path, "training.learning_rate=-1", "seed=0,1,2,3")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert "training.learning_rate=-1" in result.stderr and "greater than 0" in result.stderr


def test_as_many_runs_at_once_as_there_are_cores() -> None:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    assert default_processes(1) == cores
    assert default_processes(None) == 1
    assert default_processes(cores + 1) == 1


@pytest.mark.parametrize("number", [0, -1, True])
def test_a_wrong_number_of_processes_is_named(number: int) -> None:
    with pytest.raises(ValueError, match="num_processes"):
        ProcessLauncher(number)
