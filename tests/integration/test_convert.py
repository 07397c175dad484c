"""``python -m gpe_pl.convert`` as a user runs it, and ``fit`` on its result, without any other step."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from gpe_pl.config.datasets import ensure_data
from gpe_pl.config.entry_point import ConfigError, explain
from gpe_pl.config.folder import CONF
from gpe_pl.convert import convert
from gpe_pl.data.importers import ImportFailure, save_dataset
from gpe_pl.evaluate import evaluate_checkpoint
from gpe_pl.evaluation.metric_rows import read_rows
from gpe_pl.fit import fit
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.trajectory.store import StoreError
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources
from tests.runs import RUN, compose
from tests.sources import DT, motion

ROOT = Path(__file__).parents[2]


def crowd(seed: int) -> np.ndarray:
    """Return particles that fill the unit box."""
    return motion(num_frames=14, num_nodes=60, seed=seed, low=0.0, high=1.0)


@pytest.fixture(scope="module")
def lagrangebench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a folder in LagrangeBench's layout: a fluid that drifts through a periodic box."""
    raw = tmp_path_factory.mktemp("raw") / "2D_TGV"
    sources.lagrangebench_metadata(raw)
    for k, name in enumerate(("train", "valid", "test")):
        scenes = [(crowd(10 * k + i) + 0.05 * np.arange(14)[:, None, None]) % 1.0 for i in range(2 if k == 0 else 1)]
        sources.lagrangebench_h5(raw / f"{name}.h5", [(pos, np.zeros(60, int)) for pos in scenes])
    return raw


def trained(tmp_path: Path, name: str, *overrides: str) -> DictConfig:
    cfg = compose(
        "fit", *RUN, "data=imported", f"data.name={name}", f"paths.data={tmp_path / 'data'}", f"paths.runs={tmp_path / 'runs'}", *overrides
    )
    value = fit(cfg)
    assert 0 < value < 1
    return cfg


def files(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_a_periodic_data_set_is_imported_trained_on_and_evaluated(
    tmp_path: Path, lagrangebench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert(compose("convert", "format=lagrangebench", f"source={lagrangebench}", "name=tgv", f"paths.data={tmp_path / 'data'}"))
    printed = capsys.readouterr().out
    folder = tmp_path / "data" / "tgv" / "imported"
    for part in (
        "tgv: lagrangebench data of",
        "frame dt",
        "0.01 s",
        "x 0 … 1 periodic, y 0 … 1 periodic",
        "neighbours",
        "kinematic_viscosity 0.02",
    ):
        assert part in printed
    assert re.search(r"train +2 trajectories, 14 frames, 60 nodes", printed)
    assert "train on it: python -m gpe_pl.fit data=imported data.name=tgv" in printed
    assert (folder / "contact_sheet.png").stat().st_size > 1000
    before = files(folder)

    cfg = trained(tmp_path, "tgv", "evaluation.num_pictures=1")
    rows = list(read_rows(tmp_path / "runs" / "fit" / "metrics.csv"))
    assert {r.split for r in rows} == {"test"}
    assert {"rollout_mse", "momentum_error"} <= {r.metric for r in rows}
    assert not any(r.metric.startswith(("fraction_outside", "fraction_corrected")) for r in rows)  # there are no walls
    assert (tmp_path / "runs" / "fit" / "rollout_test_00.png").stat().st_size > 1000
    simulator = LearnedSimulator.from_checkpoint(tmp_path / "runs" / "fit" / "checkpoints" / "best.ckpt")
    assert simulator.builder.metadata.periodic == (True, True)
    assert simulator.builder.metadata.dataset == "tgv"
    fit(cfg)  # finished: nothing to do
    evaluate_checkpoint(
        compose(
            "evaluate", "data=imported", "data.name=tgv", "split=val", f"checkpoint={tmp_path / 'runs' / 'fit' / 'checkpoints' / 'best.ckpt'}",
            f"paths.data={tmp_path / 'data'}", f"paths.runs={tmp_path / 'runs'}", "evaluation.num_pictures=0", "evaluation.horizons=[0.025]",
        )
    )  # fmt: skip
    assert (tmp_path / "runs" / "evaluation_fit_tgv_val" / "metrics.csv").exists()
    assert files(folder) == before
    with pytest.raises(ImportFailure, match="never overwritten"):
        convert(compose("convert", "format=lagrangebench", f"source={lagrangebench}", "name=tgv", f"paths.data={tmp_path / 'data'}"))
    assert files(folder) == before


@pytest.mark.slow
def test_trajectories_of_any_length(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Trajectories too short for the history are left out, and rows number the others by their places in the split. They differ in length."""
    lengths = {"train": (14, 3, 28), "val": (3, 14), "test": (20, 3, 14)}

    def scene(seed: int, num_frames: int) -> Trajectory:
        pos = np.concatenate([crowd(seed), crowd(seed) + 0.01])[:num_frames]
        return Trajectory.from_numpy(
            pos % 1.0, 0.01, "sand", {"sand": 30.0}, bounds=[(0, 1)] * 2, periodic=[True, True], connectivity_radius=0.2
        )

    splits = {split: [scene(10 * k + i, n) for i, n in enumerate(found)] for k, (split, found) in enumerate(lengths.items())}
    save_dataset(tmp_path / "data", "any", **splits)  # type: ignore[arg-type]
    trained(tmp_path, "any", "evaluation.num_pictures=1", "evaluation.splits=[test]")
    rows = [r for r in read_rows(tmp_path / "runs" / "fit" / "metrics.csv") if r.model == "learned" and r.horizon == "full"]
    assert {r.trajectory: r.value for r in rows if r.metric == "num_good_frames"} == {0: 17.0, 2: 11.0}  # after 2 of history
    assert (tmp_path / "runs" / "fit" / "error_curve_test.png").exists()
    for split, number in (("val", 0), ("test", 1)):
        assert f"{split}/shard-00000.h5:{number:05d}: left out, its 3 frames are fewer than the 4" in caplog.text


def test_what_cannot_be_evaluated_is_said_before_the_training(tmp_path: Path) -> None:
    short = Trajectory.from_numpy(crowd(9)[:3], 0.01, "sand", {"sand": 30.0})
    long = [Trajectory.from_numpy(crowd(k), 0.01, "sand", {"sand": 30.0}) for k in range(2)]
    save_dataset(tmp_path / "data", "short", train=long[:1], val=long[1:], test=[short])
    with pytest.raises(StoreError, match=r"short/imported/test: no trajectory has the 4 frames that a start at frame 2 needs"):
        trained(tmp_path, "short", "evaluation.splits=[test]")
    assert not list((tmp_path / "runs").rglob("*.ckpt"))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["gpe_tuned", "gns", *(pytest.param(model, marks=pytest.mark.long) for model in ("cconv", "dpinet"))])
def test_other_models_train_on_periodic_data(tmp_path: Path, lagrangebench: Path, model: str) -> None:
    convert(compose("convert", "format=lagrangebench", f"source={lagrangebench}", "name=tgv", f"paths.data={tmp_path / 'data'}"))
    trained(tmp_path, "tgv", f"model={model}")


@pytest.mark.slow
def test_own_arrays_are_trained_on(tmp_path: Path) -> None:
    """A notebook can save arrays as a data set and train on it."""
    made = [
        Trajectory.from_numpy(crowd(k), DT, ["sand", "fluid"] * 30, {"sand": 20.0 + k, "fluid": 0.1}, gravity=[0, -1]) for k in range(4)
    ]
    report = save_dataset(tmp_path / "data", "mine", train=made)
    assert {split: counts.trajectories for split, counts in report.splits.items()} == {"train": 2, "val": 1, "test": 1}
    trained(tmp_path, "mine")


@pytest.mark.slow
def test_a_cloth_is_trained_on(tmp_path: Path) -> None:
    raw = tmp_path / "flag"
    cloths = [sources.sheet(num_frames=14, seed=k) for k in range(4)]
    sources.mgn_meta(raw, cloths[0])
    sources.mgn_tfrecord(raw / "train.tfrecord", cloths)
    convert(compose("convert", "format=meshgraphnets", f"source={raw}", f"paths.data={tmp_path / 'data'}"))
    trained(tmp_path, "flag", "evaluation.num_pictures=1")


# --- what is refused -----------------------------------------------------------------------------------------------------------------------


def test_data_that_are_not_there_are_named(tmp_path: Path) -> None:
    save_dataset(tmp_path / "data", "mine", train=[Trajectory.from_numpy(motion(seed=k), DT, "sand", {"sand": 30.0}) for k in range(3)])
    cfg = compose("fit", "data=imported", "data.name=nime", f"paths.data={tmp_path / 'data'}")
    with pytest.raises(
        ConfigError, match=r"data.name=nime: no imported data in .*python -m gpe_pl.convert name=nime .*\(imported are: mine\)"
    ):
        ensure_data(cfg)
    with pytest.raises(ConfigError, match="data.name=null: name the imported data set"):
        ensure_data(compose("fit", "data=imported"))


def test_imported_data_are_not_simulated() -> None:
    GlobalHydra.instance().clear()
    overrides = ["data=imported", "data.name=mine"]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"), pytest.raises(HydraException) as caught:
        hydra.compose("simulate", overrides)
    assert (
        explain(caught.value, "simulate", overrides)
        == "data=imported: simulate takes data that it simulates; fit and evaluate take imported ones"
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["format=gsn"], "format='gsn': must be 'gns', 'lagrangebench'"),
        (["frame_dt=-1"], "frame_dt=-1: must be greater than 0"),
        (["name=a/b"], "name='a/b': must be a folder's name"),
        (["materials={7:mud}"], "unknown material 'mud'; known: sand"),
        (["parameters={mud:1}"], "unknown material 'mud'"),
        (["walls={front:1}"], "walls: unknown side 'front'; known: x_low"),
        (["holdout=0.9"], "holdout=0.9: must be at most 0.4"),
    ],
)
def test_a_wrong_setting_is_named(tmp_path: Path, overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        convert(compose("convert", "format=gns", f"source={tmp_path}", f"paths.data={tmp_path}", *overrides))
    assert not list(tmp_path.iterdir())


def test_the_help_names_every_setting() -> None:
    file: Any = OmegaConf.to_container(OmegaConf.load(CONF / "convert.yaml"))
    text = file["hydra"]["help"]["template"]
    missing = [key for key in file if key not in ("defaults", "hydra") and not re.search(rf"\b{key}\b", text)]
    assert not missing


@pytest.mark.slow
def test_the_command(tmp_path: Path, lagrangebench: Path) -> None:
    command = [sys.executable, "-m", "gpe_pl.convert", "format=lagrangebench", f"paths.data={tmp_path}"]
    done = subprocess.run([*command, f"source={lagrangebench}"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert "report.md" in done.stdout.splitlines()[-1]
    failed = subprocess.run([*command, f"source={tmp_path / 'nowhere'}"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert failed.returncode == 2
    assert failed.stderr.splitlines()[-1].startswith("error: ") and "no such file or folder" in failed.stderr
    assert "Traceback" not in failed.stderr + failed.stdout
