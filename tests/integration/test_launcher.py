"""Runs of a sweep side by side equal the same commands alone; a failed run is named, and the others run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gpe_pl.config.launcher import ProcessLauncher, default_processes
from gpe_pl.evaluation.metric_rows import read_rows
from gpe_pl.trajectory.store import iter_trajectories
from tests.runs import DATA, RUN


def sweep(data: Path, runs: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    where = [f"paths.data={data}", f"paths.runs={runs}", "name=sweep", "hydra.launcher.num_processes=2"]
    command = [sys.executable, "-m", "gpe_pl.fit", "-m", *DATA, *RUN, *where, *overrides]
    return subprocess.run(command, capture_output=True, text=True, timeout=500)


def finished(folder: Path) -> dict[Path, int]:
    """Return the times at which runs wrote their results."""
    return {p: p.stat().st_mtime_ns for p in folder.rglob("metrics.csv") if (p.parent / "config.json").exists()}


@pytest.mark.long
def test_failures_are_named_and_the_others_run_and_a_rerun_finishes_them(tiny_data: Path, tmp_path: Path) -> None:
    steps = "training.num_steps=6", "training.val_interval=3"
    result = sweep(tiny_data, tmp_path, "training.learning_rate=1e-3,1e30", "seed=0,1", *steps)
    assert result.returncode == 2
    assert "2 of 4 runs failed" in result.stderr
    assert "training.learning_rate=1e" in result.stderr
    assert "output.log" in result.stderr
    assert "Traceback" not in result.stderr
    before = finished(tmp_path)
    assert len(before) == 2
    again = sweep(tiny_data, tmp_path, "training.learning_rate=1e-3", "seed=0,1", *steps)
    assert again.returncode == 0, again.stderr
    assert "2/2 done" in again.stdout
    assert finished(tmp_path) == before  # finished runs are left as they are
    assert (tmp_path / "sweep" / "table.md").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["experiment=few_shot", "training.num_steps=3000"], "training.num_steps=3000: adaptation=zero_shot sets this key itself"),
        (["experiment=tuning", "size.comparison.seeds='0,1,2'"], "size.comparison.seeds='0,1,2': has no effect"),
    ],
)
def test_what_some_run_would_refuse_is_refused_before_the_first_run(overrides: list[str], message: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gpe_pl.fit", *overrides, f"paths.data={tmp_path}", f"paths.runs={tmp_path}"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert result.returncode == 2 and result.stderr.startswith(f"error: {message}")
    assert not [*tmp_path.rglob("output.log")]


@pytest.mark.long
def test_a_wrong_configuration_is_said_once(tiny_data: Path, tmp_path: Path) -> None:
    result = sweep(tiny_data, tmp_path, "training.learning_rate=-1", "seed=0,1,2,3")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert "training.learning_rate=-1" in result.stderr and "greater than 0" in result.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("launcher", "settings"), [("processes", []), ("slurm", ["hydra.launcher.cluster=local"]), ("ray", ["hydra.launcher.num_cpus=1"])]
)
def test_parts_of_a_data_set_are_generated_by_any_launcher(tiny_data: Path, tmp_path: Path, launcher: str, settings: list[str]) -> None:
    if launcher != "processes":
        pytest.importorskip({"slurm": "submitit"}.get(launcher, launcher))
    shards = "++data.sizes.tiny.trajectories_per_shard=1"
    command = [
        sys.executable,
        "-m",
        "gpe_pl.simulate",
        "-m",
        *DATA,
        shards,
        f"paths.data={tmp_path}",
        "num_workers=1",
        "num_parts=2",
        "part=0,1",
    ]
    result = subprocess.run([*command, f"hydra/launcher={launcher}", *settings], capture_output=True, text=True, timeout=500)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "2/2 done" in result.stdout
    folder, whole = tmp_path / "sand" / "tiny", tiny_data / "sand" / "tiny"
    found, expected = (json.loads((f / "statistics.json").read_text()) for f in (folder, whole))
    for values in (found, expected):
        del values["sha256"]  # sums over other shards round otherwise
        values |= values.pop("material_params")["friction_angle"]
    assert found == pytest.approx(expected)
    assert sorted(p.name for p in (folder / "train").glob("*.h5")) == ["shard-00000.h5", "shard-00001.h5"]
    for split in ("train", "val", "test", "test_unseen"):
        for part, there in zip(iter_trajectories(folder, split), iter_trajectories(whole, split), strict=True):
            assert part.pos.tobytes() == there.pos.tobytes()
    assert len([*(tmp_path / "jobs").rglob("output.log")]) == 2


@pytest.mark.long
def test_optuna_searches_with_any_launcher(tiny_data: Path, tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    search = [
        "experiment=search",
        "evaluation.num_trajectories=1",
        "hydra.sweeper.num_trials=3",
        "hydra.sweeper.num_at_once=2",
        "training.budget_minutes=null",
    ]
    command = [sys.executable, "-m", "gpe_pl.fit", *DATA, *RUN, *search, f"paths.data={tiny_data}", f"paths.runs={tmp_path}"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "best of 3 trials" in result.stdout
    best = json.loads((tmp_path / "search" / "best.json").read_text())
    assert set(best["values"]) == {"training.learning_rate", "training.velocity_noise_of_change"}
    assert len(finished(tmp_path)) == 3
    assert (tmp_path / "search" / "table.md").exists()
    again = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert again.returncode == 0 and again.stdout.count("runs, ") == 1  # nothing is left to try; the best one is asked again


@pytest.mark.long
def test_a_command_with_two_devices_starts_two_processes(tiny_data: Path, tmp_path: Path) -> None:
    steps = ["training.num_steps=4", "training.val_interval=2", "training.warmup_steps=1"]
    command = [sys.executable, "-m", "gpe_pl.fit", *DATA, *RUN, *steps, f"paths.data={tiny_data}", f"paths.runs={tmp_path}"]
    for name, devices in (("one", 1), ("two", 2)):
        result = subprocess.run([*command, f"name={name}", f"trainer.devices={devices}"], capture_output=True, text=True, timeout=500)
        assert result.returncode == 0, result.stdout + result.stderr
        assert "sync_dist" not in result.stderr  # advice that is not for users
    values = {
        n: {(r.trajectory, r.metric, r.horizon, r.split): r.value for r in read_rows(tmp_path / n / "metrics.csv")} for n in ("one", "two")
    }
    assert values["two"] == pytest.approx(values["one"], rel=1e-3, abs=1e-9, nan_ok=True)
    assert len([*(tmp_path / "two" / "log").iterdir()]) == 1
    assert (tmp_path / "two" / "table.md").exists()


def test_as_many_runs_at_once_as_there_are_cores() -> None:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    assert default_processes(1) == cores
    assert default_processes(None) == 1
    assert default_processes(cores + 1) == 1
    assert default_processes(1, devices=cores) == 1


@pytest.mark.parametrize("number", [0, -1, True])
def test_a_wrong_number_of_processes_is_named(number: int) -> None:
    with pytest.raises(ValueError, match="num_processes"):
        ProcessLauncher(number)
