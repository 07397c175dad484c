"""The suite of public learning sets: metrics, pooling, what is reported and what is done again."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpe_pl.benchmarks.learning_sets import measures, suite
from gpe_pl.benchmarks.learning_sets.sets import FULL, ONE_STEP, POSITION, RIGIDITY, SETS, SPACING, STOPPED, STRESS, VELOCITY, SetName
from gpe_pl.data.importers.source import ImportFailure
from gpe_pl.files import sealed
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory
from tests import sources


def test_a_relative_error_is_the_mean_of_those_of_the_frames() -> None:
    truth = np.ones((2, 3, 2)) * [[[1.0]], [[10.0]]]
    assert measures.relative_error(1.1 * truth, truth) == pytest.approx(0.1)
    assert measures.relative_error(truth + 1.0, truth) == pytest.approx((1.0 + 0.1) / 2)


def test_central_velocities_are_those_of_an_accelerated_motion() -> None:
    time = 0.1 * np.arange(5)[:, None, None]
    pos = 2.0 * time + 3.0 * time**2 / 2
    np.testing.assert_allclose(measures.central_velocities(pos, 0.1)[:, 0, 0], (2.0 + 3.0 * time[1:])[:, 0, 0])


def test_values_of_seeds_and_trajectories_become_one() -> None:
    table = np.array([[3.0, 4.0], [3.0, 4.0]])
    assert measures.pooled(FULL, table) == pytest.approx(np.sqrt(12.5))
    assert measures.pooled(RIGIDITY, table) == 4.0
    assert measures.pooled(POSITION, table) == 3.5


def test_the_best_baseline_has_the_smallest_error_or_the_ratio_nearest_to_one() -> None:
    values = {"model": {FULL: 0.1}, "ballistic": {FULL: 3.0, SPACING: 0.5}, "constant_velocity": {FULL: 2.0, SPACING: 1.4}}
    assert measures.trivial(values, FULL) == ("constant_velocity", 2.0)
    assert measures.trivial(values, SPACING) == ("constant_velocity", 1.4)
    assert measures.trivial(values, RIGIDITY) is None


def test_splits_leave_one_out_or_are_published() -> None:
    assert list(SETS["fluidfall"].parts().values()) == [{"leave_out": k} for k in range(5)]
    assert SETS["beam"].parts() == {"": {}}
    assert SETS["rigidfall"].parts()[""]["splits"]["test"] == [8, 9]


def record(split: str, seed: int, model: float, baseline: float, minutes: float = 10.0) -> dict[str, Any]:
    values = {"model": {FULL: [model], SPACING: [0.9], RIGIDITY: [1e-15 * model]}, "ballistic": {FULL: [baseline]}}
    return {"set": "fluidfall", "split": split, "seed": seed, "minutes": minutes, "values": values}


RECORDS = [
    record("without 0", 0, 3.0, 5.0),
    record("without 1", 0, 4.0, 12.0),
    record("without 0", 1, 1.0, 5.0),
    record("without 1", 1, 1.0, 12.0, minutes=5.0),
]


def test_the_table_pools_splits_and_seeds_with_an_interval(tmp_path: Path) -> None:
    text = suite.report(RECORDS, tmp_path)
    # a resample of seeds and trajectories has at least the error of the best seed, and at most that of the worst trajectory
    assert "| fluidfall | full rollout, RMS distance [m] | 0.0415 | 9.19 (ballistic) | 2.6 [1, 4] | 2 of 5 | 0, 1 | 5, 10 |" in text
    assert "| fluidfall | spacing of the settled liquid over the truth's |  |  | 0.9 [0.9, 0.9] | 2 of 5 | 0, 1 | 5, 10 |" in text
    assert "| fluidfall | change of distances in a body over its size |  |  | 4e-15 | 2 of 5 | 0, 1 | 5, 10 |" in text
    assert "| beam |  |  |  | not measured |  |  |  |" in text
    assert f"- beam: put data/database_beam of github.com/quercushernandez/ThermodynamicsGNN into {tmp_path / 'database_beam'}" in text


def test_rollouts_that_stopped_are_counted() -> None:
    stopped = [json.loads(json.dumps(own)) for own in RECORDS]
    for own in stopped:
        own["values"]["model"][STOPPED] = [float(own["seed"] == 1)]
    lines = suite.table(stopped)
    assert any("| 2.6 [1, 4], 2 of 4 stopped |" in line for line in lines)
    assert not any(STOPPED in line for line in lines)


def test_splits_that_lack_a_seed_are_left_out_of_the_table() -> None:
    lines = suite.table([*RECORDS, record("without 2", 0, 100.0, 100.0)])
    assert any("| 9.19 (ballistic) | 2.6 [1, 4] | 2 of 5 |" in line for line in lines)
    assert any("no split with all seeds" in line for line in suite.table([RECORDS[0], RECORDS[3]]))


def test_one_seed_and_trajectory_have_no_interval() -> None:
    assert any("| 5 (ballistic) | 3 | 1 of 5 | 0 | 10 |" in line for line in suite.table(RECORDS[:1]))


@pytest.fixture
def falls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with rollouts in the layout of FluidFall, shorter than the published ones."""
    monkeypatch.setitem(SETS, "fluidfall", replace(SETS["fluidfall"], num_frames=14, digest=None))
    for k in range(5):
        pos = sources.motion(14, dim=3, seed=k)
        sources.dpinet(tmp_path / "files" / "data_FluidFall" / "valid" / str(k), pos, np.gradient(pos, 1 / 60, axis=0))
    return tmp_path / "files"


@pytest.mark.slow
@pytest.mark.parametrize("averages", [None, True])
def test_every_split_is_trained_and_measured_once(
    averages: bool | None, tmp_path: Path, falls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands, averaged = [], []
    step_all = LearnedSimulator.step_all

    def watched(simulator: LearnedSimulator, states: list[State]) -> Any:
        averaged.append(simulator.mirror_average)
        return step_all(simulator, states)

    monkeypatch.setattr(LearnedSimulator, "step_all", watched)

    def trained(command: list[str], check: bool) -> SimpleNamespace:
        values = dict(argument.split("=", 1) for argument in command[3:])
        commands.append(values)
        first = next(iter_trajectories(Path(values["paths.data"]) / values["data.name"] / "imported", "train"))
        builder = GraphBuilder(GraphConfig(history=2), first.metadata)
        checkpoint = Path(values["paths.runs"]) / values["name"] / "checkpoints" / "best.ckpt"
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder).save(checkpoint)
        sealed.write(checkpoint.parents[1] / "config.json", {"evaluation": {"mirror_average": averages}})
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", trained)
    overrides: dict[SetName, list[str]] = {"fluidfall": ["graph.history=2"]}
    settings = suite.Settings(str(falls), only=["fluidfall", "beam"], seeds=[3], minutes=0.5, num_splits=2, training=overrides)
    records, text = suite.run(settings, tmp_path / "runs")
    assert [(r["set"], r["split"], r["seed"]) for r in records] == [("fluidfall", "without 0", 3), ("fluidfall", "without 1", 3)]
    assert [c["name"] for c in commands] == ["fluidfall_without_0_seed_3", "fluidfall_without_1_seed_3"]
    assert [c["reuse"] for c in commands] == ["fluidfall_without_0", "fluidfall_without_1"]
    assert all(c["seed"] == "3" and c["graph.history"] == "2" and c["training.budget_minutes"] == "0.5" for c in commands)
    assert all(record["minutes"] == 0.5 for record in records)
    assert records[0]["values"]["model"].keys() == {FULL, ONE_STEP, SPACING, STOPPED}
    assert records[0]["values"]["constant_velocity"][ONE_STEP][0] < records[0]["values"]["constant_velocity"][FULL][0]
    assert "| 2 of 5 | 3 | 0.5 |" in text and "beam: put" in text
    assert {*averaged} == {bool(averages)}


@pytest.mark.slow
def test_a_training_that_fails_names_its_command(tmp_path: Path, falls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    with pytest.raises(
        suite.LearningSetError,
        match=r"name=fluidfall_without_0_seed_0 seed=0 reuse=fluidfall_without_0 training.budget_minutes=10 paths.data=.* paths.runs=.*: failed",
    ):
        suite.run(suite.Settings(str(falls), only=["fluidfall"], num_splits=1), tmp_path / "runs")


def damage(folder: Path) -> None:
    (folder / "0" / "5.h5").write_bytes(b"cut off")


def shorten(folder: Path) -> None:
    (folder / "2" / "13.h5").unlink()


def lose(folder: Path) -> None:
    rmtree(folder / "4")


def exchange(folder: Path) -> None:
    rmtree(folder)
    for k in range(5):
        pos = sources.rigid(sources.motion(14, num_nodes=80, dim=3, seed=k), slice(0, 64))
        sources.dpinet(folder / str(k), pos, np.gradient(pos, 1 / 60, axis=0), clusters=np.zeros((1, 64), int))


def test_the_definition_of_the_digest_is_that_of_the_published_ones(tmp_path: Path) -> None:
    """A change of the definition would refuse the published files: ``LearningSet.digest`` has to be computed again from them."""
    for name, content in {"valid/0/0.h5": b"a", "valid/0/1.h5": b"b", "beam_1.pt": b"c", "stat.h5": b"d", "valid/.DS_Store": b"e"}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    lines = [
        f"{name}\0{sha256(content).hexdigest()}\n"
        for name, content in (("beam_1.pt", b"c"), ("valid/0/0.h5", b"a"), ("valid/0/1.h5", b"b"))
    ]
    assert suite.digest_of(tmp_path) == sha256("".join(lines).encode()).hexdigest()


@pytest.mark.slow
def test_files_with_other_values_than_the_published_ones_are_refused(tmp_path: Path, falls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = falls / "data_FluidFall"
    monkeypatch.setitem(SETS, "fluidfall", replace(SETS["fluidfall"], digest=suite.digest_of(files)))
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    settings = suite.Settings(str(falls), only=["fluidfall"], num_splits=1)
    (files / ".DS_Store").write_bytes(b"a file of the desktop")
    with pytest.raises(suite.LearningSetError, match="failed"):  # its training
        suite.run(settings, tmp_path / "runs")
    pos = 10 * sources.motion(14, dim=3, seed=2)
    rmtree(files / "valid" / "2")
    sources.dpinet(files / "valid" / "2", pos, np.gradient(pos, 1 / 60, axis=0))
    with pytest.raises(suite.LearningSetError, match="has as many trajectories and frames as the data set, and other values"):
        suite.run(settings, tmp_path / "others")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (damage, r"valid/0, frame 5: 5.h5: not a readable HDF5 file"),
        (shorten, r"has 13, 14 frames, the data set has 14"),
        (lose, r"has 4 trajectories, the data set has 5"),
        (exchange, r"has fluid, solid as materials, the data set has fluid"),
    ],
)
def test_files_that_are_not_the_published_ones_are_refused(
    tmp_path: Path, falls: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Path], None], says: str
) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("nothing should be trained"))
    change(falls / "data_FluidFall" / "valid")
    with pytest.raises((suite.LearningSetError, ImportFailure), match=says):
        suite.run(suite.Settings(str(falls), only=["fluidfall"], num_splits=1), tmp_path / "runs")
    assert not (tmp_path / "runs" / "data" / "fluidfall_without_0" / "imported").exists()


@pytest.mark.slow
def test_files_that_changed_after_the_import_are_refused(tmp_path: Path, falls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    settings = suite.Settings(str(falls), only=["fluidfall"], num_splits=1)
    for _ in range(2):  # the second time, the imported data are used again
        with pytest.raises(suite.LearningSetError, match="failed"):
            suite.run(settings, tmp_path / "runs")
    exchange(falls / "data_FluidFall" / "valid")
    with pytest.raises(
        suite.LearningSetError, match=r"data_FluidFall: holds other files than those that .*fluidfall_without_0 was made of"
    ):
        suite.run(settings, tmp_path / "runs")


def moving(num_frames: int = 4, **arrays: Any) -> Trajectory:
    pos = np.arange(num_frames * 4.0).reshape(num_frames, 2, 2) + 1
    return Trajectory.from_numpy(pos, 0.1, "elastomer", {"elastomer": 1e5}, **arrays)


def test_a_rollout_that_stopped_stays_where_it_was() -> None:
    whole = moving()
    _, pos = measures.lasting(whole.frames(0, 2), 4)
    np.testing.assert_array_equal(pos[1:], np.stack([whole.pos[1]] * 3))


def test_relative_quantities_have_a_stress_if_both_have_one() -> None:
    truth = moving(stress=np.ones((4, 2, 4)))
    found = dict(measures.errors((truth, truth.pos), truth, True))
    assert found.keys() == {POSITION, VELOCITY, STRESS} and found[POSITION] == found[STRESS] == 0
    stopped = dict(measures.errors((truth.frames(0, 2), truth.pos), truth, True))
    assert stopped[STRESS] == float("inf"), "a mean over the rollouts that did not stop would be too good"
    assert dict(measures.errors((moving(), truth.pos), truth, True)).keys() == {POSITION, VELOCITY}
