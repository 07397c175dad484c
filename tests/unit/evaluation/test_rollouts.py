"""Numbers of ``metrics.csv``: no failure improves them, and their format."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.evaluation import split_files
from gpe_pl.evaluation.horizons import labels, time_of
from gpe_pl.evaluation.metric_rows import MetricsError, Row, read_rows, write_rows
from gpe_pl.evaluation.predictions import _cost_of_skipping, _fraction_outside
from gpe_pl.evaluation.rollouts import _parameter, evaluate
from gpe_pl.evaluation.settings import EvaluationSettings, StartError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Termination, Trajectory


@pytest.fixture
def inside(new_trajectory: Callable[..., Trajectory]) -> Trajectory:
    """Return eleven frames with all particles in free space."""
    return new_trajectory(num_frames=11)


def test_frames_that_a_stopped_rollout_lacks_count_as_outside(inside: Trajectory) -> None:
    stopped = replace(inside.frames(0, 5), termination=Termination("nan", 5, 0, "frame 5"))
    assert _fraction_outside(inside, 1, 10, 0.0) == 0.0
    assert _fraction_outside(stopped, 1, 10, 0.0) == pytest.approx(6 / 10)
    assert _fraction_outside(inside, 10, 10, 0.0) == 0.0
    assert _fraction_outside(stopped, 10, 10, 0.0) == 1.0


def test_the_cost_of_skipping_is_over_the_frames_of_both(inside: Trajectory) -> None:
    totals = {"num_asleep": 0.0, "lost_impulse": 0.0}
    frames = np.arange(11)[:, None, None]
    exact = replace(inside, pos=inside.pos + np.where(frames == 2, 0.3, 0.0).astype(np.float32))
    stopped = replace(inside.frames(0, 5), termination=Termination("nan", 5, 0, "frame 5"))
    for own, other in ((stopped, exact), (exact, stopped)):
        assert _cost_of_skipping(own, other, totals)["skipping_mse"] == pytest.approx(0.3**2 / 4, rel=1e-4)
    assert _cost_of_skipping(replace(stopped, pos=stopped.pos[:1], vel=stopped.vel[:1]), inside, totals)["skipping_mse"] == float("inf")


def test_a_particle_inside_a_wall_counts(inside: Trajectory) -> None:
    pos = inside.pos.copy()
    pos[3, 0] = -0.5
    assert _fraction_outside(replace(inside, pos=pos), 1, 10, 0.0) == pytest.approx(1 / (10 * inside.num_nodes))


@pytest.mark.slow
@pytest.mark.parametrize(("num_trajectories", "numbers"), [(None, {1, 2}), (2, {1})])
def test_scenes_keep_their_numbers_if_others_are_too_short(
    new_trajectory: Callable[..., Trajectory], tmp_path: Path, num_trajectories: int | None, numbers: set[int]
) -> None:
    """So that tables compare the same scenes of models with other histories or strides."""
    whole = new_trajectory(num_frames=7, seed=2)
    scenes = [whole.frames(0, 3), whole.frames(0, 6), whole]
    write_shard(tmp_path / "data" / "test" / "shard-00000.h5", scenes)
    builder = GraphBuilder(GraphConfig(history=2), scenes[0].metadata)
    simulator = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder).eval()
    settings = EvaluationSettings(["test"], num_pictures=0, num_uncontained=2, num_trajectories=num_trajectories)
    rows = evaluate(simulator, tmp_path / "data", settings, tmp_path / "run")
    assert {row.trajectory for row in rows} == {-1, *numbers}
    assert {row.trajectory for row in rows if row.metric == "fraction_outside_uncontained"} == {1}


@pytest.mark.slow
def test_figures_that_cannot_be_drawn_do_not_lose_the_metrics(
    new_trajectory: Callable[..., Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = new_trajectory(num_frames=7, seed=2)
    write_shard(tmp_path / "data" / "test" / "shard-00000.h5", [whole])
    builder = GraphBuilder(GraphConfig(history=2), whole.metadata)
    simulator = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder).eval()

    def fails(*_: object) -> None:
        raise RuntimeError("cannot draw")

    monkeypatch.setattr(split_files, "write_pictures", lambda *_: None)
    monkeypatch.setattr(split_files, "write_error_curve", fails)
    with pytest.raises(RuntimeError, match="cannot draw"):
        evaluate(simulator, tmp_path / "data", EvaluationSettings(["test"], num_pictures=1), tmp_path / "run")
    assert {row.trajectory for row in read_rows(tmp_path / "run" / "metrics.csv")} == {-1, 0}


def test_rows_survive_the_file(tmp_path: Path) -> None:
    rows = [Row("learned", "test", 3, "seen", 30.0, "rollout_mse", "full", np.inf), Row("ballistic", "test", 0, "", 0.1, "x", "5", 1e-300)]
    write_rows(tmp_path / "metrics.csv", rows)
    assert list(read_rows(tmp_path / "metrics.csv")) == rows
    assert {p.name for p in tmp_path.iterdir()} == {"metrics.csv", "metrics.csv.sha256"}
    digest = (tmp_path / "metrics.csv.sha256").read_text()
    assert digest == f"{hashlib.sha256((tmp_path / 'metrics.csv').read_bytes()).hexdigest()}  metrics.csv\n"


@pytest.mark.parametrize("change", [lambda b: b.replace(b"30.0", b"31.0"), lambda b: b[: b.rindex(b"ballistic")], lambda b: b""])
def test_changed_rows_are_refused(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "metrics.csv"
    write_rows(path, [Row(model, "test", 3, "seen", 30.0, "rollout_mse", "full", 1.0) for model in ("learned", "ballistic")])
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(MetricsError, match=r"metrics.csv: damaged or changed \(checksum mismatch\); delete the file to evaluate again"):
        list(read_rows(path))
    (tmp_path / "metrics.csv.sha256").unlink()
    assert len(list(read_rows(path))) < 3  # as in runs of earlier versions


@pytest.mark.parametrize(
    "change",
    [
        {"horizon": "many"},
        {"horizon": "-5"},
        {"horizon": ""},
        {"horizon": "0s"},
        {"horizon": "infs"},
        {"split": "exam"},
        {"parameter_group": "new"},
        {"model": "\x1b[2Kerror: forged"},
        {"metric": "a\u202eb"},
        {"trajectory": "one"},
        {"value": "x"},
    ],
)
def test_rows_without_a_digest_have_to_mean_something(tmp_path: Path, change: dict[str, str]) -> None:
    row = {
        "model": "learned",
        "split": "test",
        "trajectory": 3,
        "parameter_group": "seen",
        "parameter": 30.0,
        "metric": "x",
        "horizon": "full",
    }
    with open(tmp_path / "metrics.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*row, "value"])
        writer.writeheader()
        writer.writerow({**row, "value": 1.0, **change})
    with pytest.raises(MetricsError, match="metrics.csv, line 2: damaged") as refused:
        list(read_rows(tmp_path / "metrics.csv"))
    assert str(refused.value).isprintable()


def test_rollouts_start_where_asked_or_as_early_as_they_can() -> None:
    assert EvaluationSettings().first_frame(3, 0.005) == 3
    assert [EvaluationSettings(start_time=0.06).first_frame(3, dt) for dt in (0.005, 0.02)] == [12, 3]
    with pytest.raises(
        StartError, match=r"start_time=0\.02: graph.history=3 needs as many frames of 0.01 s before it; choose at least 0.03$"
    ):
        EvaluationSettings(start_time=0.02).first_frame(3, 0.01)
    with pytest.raises(StartError, match=r"start_time=0\.05: is between two frames of 0.02 s; choose 0.04$"):
        EvaluationSettings(start_time=0.05).first_frame(2, 0.02)


@pytest.mark.parametrize(
    ("frame_dt", "expected"), [(0.005, {20: "0.1s", 50: "0.25s"}), (0.02, {5: "0.1s", 12: "0.24s"}), (0.3, {1: "0.3s"})]
)
def test_horizons_are_frames_near_a_time_and_named_by_their_own_time(frame_dt: float, expected: dict[int, str]) -> None:
    assert labels([0.1, 0.25], frame_dt) == expected
    assert sorted(["full", *labels([2.0, 0.25], frame_dt).values()], key=time_of)[-2:] == [f"{round(2 / frame_dt) * frame_dt:.6g}s", "full"]


def test_a_scene_of_several_materials_has_no_one_parameter(inside: Trajectory) -> None:
    values = np.full((inside.num_nodes, 2), np.nan)
    values[:, 0] = 30.0
    metadata = replace(inside.metadata, materials=("sand", "elastomer"), param_names=("friction_angle", "youngs_modulus"))
    scene = replace(inside, metadata=metadata)
    assert _parameter(replace(scene, material_params=values)) == 30.0
    values[0] = np.nan, 1e5
    assert np.isnan(_parameter(replace(scene, material_params=values)))
