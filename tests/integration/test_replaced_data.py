"""Data imported again under the same name count as other data in runs, evaluations and step times."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import data_statistics
from gpe_pl.data.generation import generate
from gpe_pl.data.importers.assemble import save_dataset
from gpe_pl.evaluate import evaluate_checkpoint
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError
from gpe_pl.fit import fit
from gpe_pl.reports.finished_runs import finished_runs
from gpe_pl.trajectory.store import StoreError, iter_trajectories, read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import DATA, RUN, compose, generate_tiny


def falling(gravity: float, seed: int = 0) -> list[Trajectory]:
    """Return falling blocks of sand, slightly rotated."""
    rng, dt = np.random.default_rng(seed), 0.01
    made = []
    for _ in range(4):
        start = (
            np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) * 0.05
            + [0.3, 1.0]
            + rng.uniform(-0.01, 0.01, (16, 2))
        )
        time = dt * np.arange(10)[:, None, None]
        sway = 0.02 * np.sin(8 * time + rng.uniform(0, 6, (16, 1)))
        pos = start - np.array([0.0, 0.5 * gravity]) * time**2 + sway * [1.0, 0.0]
        made.append(
            Trajectory.from_numpy(
                pos.astype(np.float32),
                dt,
                materials="sand",
                params={"sand": 30.0},
                bounds=[[0.0, 1.0], [0.0, 2.0]],
                gravity=[0.0, -gravity],
            )
        )
    return made


def imported(folder: Path, gravity: float) -> Path:
    shutil.rmtree(folder / "mine", ignore_errors=True)
    made = falling(gravity)
    save_dataset(folder, "mine", train=made[:2], val=made[2:3], test=made[3:])
    return folder


def config(command: str, tmp_path: Path, *overrides: str) -> DictConfig:
    fixed = ["data=imported", "data.name=mine", "size=tiny", f"paths.data={tmp_path / 'data'}", f"paths.runs={tmp_path / 'runs'}"]
    return compose(
        command, *fixed, *(RUN if command == "fit" else ["evaluation.num_pictures=0", "evaluation.horizons=[0.025]"]), *overrides
    )


@pytest.mark.slow
def test_a_run_knows_its_data_by_what_they_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imported(tmp_path / "data", 9.81)
    run = config("fit", tmp_path, "evaluation.splits=[test]", "name=run")
    judged = config("evaluate", tmp_path, f"checkpoint={tmp_path / 'runs' / 'run'}", "name=judged")
    value = fit(run)
    evaluate_checkpoint(judged)
    table = tmp_path / "runs" / "judged" / "metrics.csv"
    rows = table.read_bytes()

    imported(tmp_path / "data", 9.81)  # the same again
    assert fit(run) == value
    shutil.move(tmp_path / "data", tmp_path / "moved")
    run.paths.data = judged.paths.data = str(tmp_path / "moved")
    assert fit(run) == value
    evaluate_checkpoint(judged)
    assert table.read_bytes() == rows

    imported(tmp_path / "moved", 3.0)
    with pytest.raises(RunError, match=r"run holds a run with another configuration \(data_sha256.train: '\w+' there, '\w+' now"):
        fit(run)
    with pytest.raises(RunError, match=r"judged holds a run with another configuration \(data_sha256.test: '\w+' there, '\w+' now"):
        evaluate_checkpoint(judged)
    (tmp_path / "runs" / "run" / "metrics.csv").unlink()  # as if it were interrupted
    with pytest.raises(RunError, match="data_sha256.train"):
        fit(run)
    other = config("fit", tmp_path, "evaluation.splits=[test]", "name=other", "reuse=run", f"paths.data={tmp_path / 'moved'}")
    (tmp_path / "runs" / "run" / "metrics.csv").touch()
    monkeypatch.setattr("gpe_pl.config.fit_run.train", lambda *_: pytest.fail("trains its own", pytrace=False))
    with pytest.raises(pytest.fail.Exception, match="trains its own"):  # rather than take the model of the run on other data
        fit(other)


@pytest.mark.slow
def test_new_test_data_alone_are_noticed(tmp_path: Path) -> None:
    imported(tmp_path / "data", 9.81)
    run = config("fit", tmp_path, "evaluation.splits=[test]", "name=run")
    fit(run)
    (shard,) = (tmp_path / "data" / "mine" / "imported" / "test").iterdir()
    write_shard(
        shard, [replace(t, material_params=t.material_params + 1) for t in (read_trajectory(shard, n) for n in trajectory_names(shard))]
    )
    with pytest.raises(RunError, match=r"\(evaluation.data_sha256.test: '\w+' there, '\w+' now\)"):
        fit(run)


def test_statistics_of_other_data_are_not_used(tmp_path: Path) -> None:
    root = imported(tmp_path / "data", 9.81) / "mine" / "imported"
    before = data_statistics(root)
    shards = sorted((root / "train").iterdir())
    for shard in shards:
        write_shard(shard, [replace(t, pos=1.5 * t.pos) for t in (read_trajectory(shard, n) for n in trajectory_names(shard))])
    with pytest.raises(
        StoreError, match=r"statistics.json: cannot be used \(it belongs to other data than those in train\); generate or import"
    ):
        data_statistics(root)
    assert before["acceleration_std"] > 0


@pytest.mark.slow
def test_generated_statistics_follow_their_shards(tmp_path: Path) -> None:
    root = generate_tiny(tmp_path) / "sand" / "tiny"
    before = json.loads((root / "statistics.json").read_text())
    (shard,) = (root / "train").iterdir()
    names = trajectory_names(shard)
    write_shard(
        shard, [replace(t, vel=0.5 * t.vel, pos=0.5 + 0.5 * (t.pos - 0.5)) for t in (read_trajectory(shard, n) for n in names)], names
    )
    generate(tmp_path, dataset_spec(compose("simulate", *DATA)), 1)
    after = json.loads((root / "statistics.json").read_text())
    assert after["velocity_std"] == pytest.approx(0.5 * before["velocity_std"], rel=1e-3)
    assert after["data_sha256"] == split_checksum(root, "train") != before["data_sha256"]


def test_how_trajectories_are_spread_over_shards_does_not_matter(store: Path, tmp_path: Path) -> None:
    trajectories = list(iter_trajectories(store, "train"))
    for number, trajectory in enumerate(trajectories):
        write_shard(tmp_path / "other" / "train" / f"shard-{number:05d}.h5", [trajectory])
    assert split_checksum(tmp_path / "other", "train") == split_checksum(store, "train")
    write_shard(tmp_path / "turned" / "train" / "shard-00000.h5", trajectories[::-1])
    assert split_checksum(tmp_path / "turned", "train") != split_checksum(store, "train")


def test_a_report_says_which_runs_used_other_data(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    said: dict[str, Any] = {"data": {"name": "mine"}, "model": {"_target_": "gpe_pl.models.gpe.GPE"}, "training": {"num_steps": 2}}
    for name, data, checksum in (("a", "mine", "1"), ("b", "mine", "2"), ("c", "yours", "3")):
        folder = tmp_path / name
        folder.mkdir()
        said["data"]["name"] = data
        sealed.write(folder / "config.json", said | {"seed": name, "data_sha256": {"train": checksum}})
        (folder / "metrics.csv").write_text("model,split,trajectory,parameter,parameter_group,metric,horizon,value\n")
    runs = finished_runs(tmp_path)
    assert [r.message for r in caplog.records] == [
        f"{tmp_path / 'a'} and {tmp_path / 'b'} used different data of the same name; their errors do not compare"
    ]
    assert all("sha256" not in key for run in runs for key in run.config)  # which are what tables are made of
