"""``python -m gpe_pl.evaluate`` with the checkpoint of any model, after its run has moved, or with a shipped model by name."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.ground_truth import trajectory_metadata
from gpe_pl.evaluate import _identity, evaluate_checkpoint
from gpe_pl.evaluation import showcase
from gpe_pl.evaluation.metric_rows import Row, read_rows
from gpe_pl.export.play_model import PageError
from gpe_pl.files.run_folder import RunError
from gpe_pl.fit import fit
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned import pretrained
from gpe_pl.learned.simulator import LearnedSimulator, SceneError
from gpe_pl.models.gpe import GPE
from gpe_pl.reports.finished_runs import table_of
from gpe_pl.reports.sweep_table import summary
from gpe_pl.trajectory.store import StoreError
from tests.runs import DATA, compose, tiny


def evaluate(data: Path, runs: Path, checkpoint: Path | str, *overrides: str) -> list[Row]:
    shared = [f"paths.data={data}", f"paths.runs={runs}", "evaluation.horizons=[0.025]", "split=test_unseen", "name=evaluation_test_unseen"]
    evaluate_checkpoint(compose("evaluate", *DATA, *shared, f"checkpoint={checkpoint}", *overrides))
    return list(read_rows(runs / "evaluation_test_unseen" / "metrics.csv"))


def untrained(stride: int = 1) -> LearnedSimulator:
    """Return a small model of the tiny data."""
    metadata = trajectory_metadata(dataset_spec(compose("simulate", *DATA)), "train", 0).every(stride)
    builder = GraphBuilder(GraphConfig(history=2), metadata)
    return LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder, stride)


def key(row: Row) -> tuple[str, int, str, str]:
    return row.model, row.trajectory, row.metric, row.horizon


@pytest.mark.slow
@pytest.mark.parametrize("model", ["gpe", *(pytest.param(m, marks=pytest.mark.long) for m in ("gns", "dpinet", "cconv"))])
def test_a_run_that_was_moved_gives_the_same_numbers(
    model: str, tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(tiny(tiny_data, tmp_path / "runs", f"model={model}"))
    known = {key(r): r.value for r in read_rows(tmp_path / "runs" / "fit" / "metrics.csv") if r.split == "test_unseen"}
    shutil.move(tmp_path / "runs" / "fit", tmp_path / "elsewhere")
    checkpoint = tmp_path / "elsewhere" / "checkpoints" / "best.ckpt"
    rows = evaluate(tiny_data, tmp_path / "new", checkpoint, "evaluation.num_pictures=1", "evaluation.export=[vtk,npz]")
    assert {key(r): r.value for r in rows} == pytest.approx(known, rel=1e-9)
    written = {path.name for path in (tmp_path / "new" / "evaluation_test_unseen").iterdir()}
    assert {f"rollout_test_unseen_00.{suffix}" for suffix in ("png", "gif", "html", "pvd", "npz")} <= written
    assert {"error_curve_test_unseen.png", "ground_truth_test_unseen_00.pvd", "ground_truth_test_unseen_00.npz"} <= written
    assert "model.pt2" not in written
    assert re.search(r"rollout_mse +learned", capsys.readouterr().out)


@pytest.mark.slow
def test_a_folder_keeps_the_evaluation_that_it_holds(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path))
    run, folder = tmp_path / "fit", tmp_path / "evaluation_test_unseen"
    rows = evaluate(tiny_data, tmp_path, run, "evaluation.num_pictures=0")
    again = evaluate(tiny_data, tmp_path, run, "evaluation.num_pictures=1")  # the same numbers, and a picture
    assert {key(r): r.value for r in again} == pytest.approx({key(r): r.value for r in rows}, rel=1e-12)
    assert (folder / "rollout_test_unseen_00.png").exists()
    model = json.loads((folder / "config.json").read_text())["model"]
    assert model == {"_target_": "gpe_pl.models.gpe.GPE", "material_embedding": "affine"}  # so tables find the models without the parameter
    before = (folder / "metrics.csv").read_bytes()
    with pytest.raises(
        RunError,
        match=r"evaluation_test_unseen holds a run with another configuration \(checkpoint: 'best.ckpt .* there, 'last.ckpt .* now",
    ):
        evaluate(tiny_data, tmp_path, run / "checkpoints" / "last.ckpt")
    run = run.rename(tmp_path / "moved")
    assert {key(r) for r in evaluate(tiny_data, tmp_path, run, "evaluation.num_pictures=0")} == {key(r) for r in rows}
    before = (folder / "metrics.csv").read_bytes()
    with pytest.raises(RunError, match=r"evaluation\.containment: True there, False now.*choose another name=… or delete the folder"):
        evaluate(tiny_data, tmp_path, run, "evaluation.containment=false")
    assert (folder / "metrics.csv").read_bytes() == before
    (folder / "config.json").unlink()
    with pytest.raises(RunError, match="its config.json is missing"):
        evaluate(tiny_data, tmp_path, run)


def test_another_precision_of_products_is_another_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.data.checksum.split_checksum", lambda *_: "same")
    simulator = LearnedSimulator.from_checkpoint("sand")
    default, same, medium = (
        _identity(compose("evaluate", "checkpoint=sand", override), tmp_path, simulator)
        for override in ("trainer=cpu", "trainer.num_threads=2", "trainer.matmul_precision=medium")
    )
    assert "trainer" not in default and same == default
    assert medium == default | {"trainer": {"matmul_precision": "medium"}}


def test_the_folder_is_named_after_model_and_data(tmp_path: Path) -> None:
    checkpoint = f"checkpoint='{tmp_path}/runs/sweep/seed=0/checkpoints/best.ckpt'"
    cfg = compose("evaluate", checkpoint, f"paths.runs={tmp_path}/runs", "data=snow")
    assert cfg.name == "evaluation_sweep_seed=0_snow_test"
    assert compose("evaluate", "checkpoint=sand").name == "evaluation_sand_sand_test"
    canyons = [compose("evaluate", "checkpoint=fluid", "data=fluid", f"scene={scene}").name for scene in ("canyon", "recorded_canyon")]
    assert canyons == ["evaluation_fluid_fluid_canyon_test", "evaluation_fluid_fluid_canyon_recorded_test"]  # one may follow the other


def test_several_checkpoints_are_one_ensemble_by_name(tmp_path: Path) -> None:
    assert compose("evaluate", "checkpoint=[sand,other]").name == "evaluation_sand_ensemble_of_2_sand_test"
    assert compose("evaluate", "checkpoint=[sand]").name == "evaluation_sand_sand_test"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["checkpoint=null"], "name the folder of a run"),
        (["checkpoint=[]"], "name the folder of a run"),
        (["checkpoint=[sand,2]"], "name the folder of a run"),
        (["checkpoint=[fluid,fluid]", "data=fluid", "scene=canyon"], "data.showcase: rolls out a single model"),
        (["checkpoint=sand", "calibrate=maybe"], "must be true or false"),
        (["checkpoint=sand", "calibrate=true", "split=train"], "not trained on"),
    ],
)
def test_checkpoints_and_calibration_that_make_no_sense_are_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        evaluate_checkpoint(compose("evaluate", *overrides))


@pytest.mark.slow
def test_an_ensemble_is_calibrated_and_its_coverage_measured(tiny_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fit(tiny(tiny_data, tmp_path))
    run = tmp_path / "fit"
    checkpoints = f"[{run},{run}/checkpoints/last.ckpt]"
    more = ["data.name=more", "++data.sizes.tiny.num_test=10", "split=test", "evaluation.num_pictures=0"]
    rows = evaluate(tmp_path / "data", tmp_path, checkpoints, *more, "calibrate=true")
    assert not [row for row in rows if row.metric == "fraction_in_bands"]
    assert len([*(run / "checkpoints").glob("best.ensemble_*.bands.json")]) == 1
    shutil.rmtree(tmp_path / "evaluation_test_unseen")
    rows = evaluate(tiny_data, tmp_path, checkpoints, "evaluation.num_pictures=0")
    inside = [row.value for row in rows if row.metric == "fraction_in_bands" and row.horizon == "full"]
    assert len(inside) == 2 and all(0 <= value <= 1 for value in inside)
    assert {row.metric for row in rows} >= {"enough_in_bands", "band_radius", "num_unlike"}
    written = tmp_path / "evaluation_test_unseen"
    assert "10 scenes of more" in (written / "coverage.md").read_text() and (written / "coverage.png").exists()
    shutil.rmtree(written)
    rows = evaluate(tmp_path / "data", tmp_path, checkpoints, *more)
    assert "these scenes are the calibration scenes" in caplog.text
    assert not [row for row in rows if row.metric == "fraction_in_bands"]
    alone = evaluate(tiny_data, tmp_path / "alone", run, "evaluation.num_pictures=0")
    assert not [row for row in alone if row.metric == "fraction_in_bands"], "bands of an ensemble are not those of its member"


@pytest.mark.slow
def test_data_that_do_not_fit_are_refused_before_any_is_generated(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(
        SceneError, match=r"was trained with .* in 2D on sand; the scene has .* in 3D and sand; choose the data set with data="
    ):
        evaluate(tmp_path / "data", tmp_path / "runs", checkpoint, "dimension=3")
    with pytest.raises(SceneError, match="choose the data set with data=sand size=small$"):
        evaluate(tmp_path / "data", tmp_path / "runs", "sand", "size=tiny")
    assert not (tmp_path / "data").exists() and not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_model_of_longer_frames_asks_for_its_stride(tmp_path: Path) -> None:
    path = tmp_path / "every_second.ckpt"
    untrained(stride=2).save(path)
    for stride in (1, 4):
        with pytest.raises(SceneError, match=r"frame_dt=0.01 s \(data.stride=2\) .* choose the data set with data.stride=2$"):
            evaluate(tmp_path / "data", tmp_path, path, f"data.stride={stride}")
    with pytest.raises(SceneError, match=r"choose the data set with data=sand size=tiny data.stride=2$"):
        evaluate(tmp_path / "data", tmp_path, path, "dimension=3", "data.stride=2")
    rows = evaluate(tmp_path / "data", tmp_path, path, "data.stride=2")
    assert {r.horizon for r in rows if r.metric == "rollout_mse"} == {"0.02s", "full"}
    assert {r.value for r in rows if r.metric == "num_good_frames"} <= {0.0, 1.0, 2.0, 3.0}  # frames 2 to 5 of 6


@pytest.mark.slow
def test_an_evaluation_that_fails_leaves_no_folder(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit(tiny(tiny_data, tmp_path))

    def fails(*_: object) -> None:
        raise StoreError("damaged")

    monkeypatch.setattr("gpe_pl.config.datasets.ensure_split", fails)
    with pytest.raises(StoreError, match="damaged"):
        evaluate(tiny_data, tmp_path, tmp_path / "fit")
    assert not (tmp_path / "evaluation_test_unseen").exists()


@pytest.mark.slow
def test_a_shipped_model_is_named(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "shipped")
    untrained().save(tmp_path / "shipped" / "sand.ckpt")
    rows = evaluate(tiny_data, tmp_path, "sand", "evaluation.num_pictures=0")
    assert capsys.readouterr().out.startswith("acceptance not measured\n")
    assert {r.model for r in rows} == {"learned", "ballistic", "stops_at_walls", "constant_velocity"}
    with pytest.raises(ConfigError, match=r"checkpoint=None: name the folder of a run.*, or a shipped model: sand"):
        evaluate(tiny_data, tmp_path, "null")


@pytest.mark.slow
def test_film_and_model_are_exported_on_request(tiny_data: Path, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="MP4 needs imageio-ffmpeg")
    fit(tiny(tiny_data, tmp_path))
    exports = ("evaluation.num_pictures=1", "evaluation.export=[mp4,model]")
    without_checks = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)  # lengths are symbols while a program is made
    try:
        evaluate(tiny_data, tmp_path, tmp_path / "fit" / "checkpoints" / "best.ckpt", *exports)
    finally:
        jaxtyping.config.update("jaxtyping_disable", without_checks)
    folder = tmp_path / "evaluation_test_unseen"
    assert (folder / "rollout_test_unseen_00.mp4").stat().st_size > 1000 and torch.export.load(folder / "model.pt2")


@pytest.mark.slow
def test_a_page_is_exported_with_films_of_the_solver(tiny_data: Path, tmp_path: Path) -> None:
    simulator = untrained()
    simulator.model = GPE(simulator.builder.spec, num_message_passing_steps=1, hidden_channels=8, edge_state="geometry")
    simulator.save(tmp_path / "new.ckpt")
    with pytest.raises(PageError, match="a model that was not trained"):
        evaluate(tiny_data, tmp_path, tmp_path / "new.ckpt", "evaluation.export=[page]")
    simulator.get_buffer("trained_sand")[:, 0] = torch.tensor([20.0, 42.5])
    simulator.save(tmp_path / "own.ckpt")
    evaluate(tiny_data, tmp_path, tmp_path / "own.ckpt", "evaluation.num_pictures=2", "evaluation.export=[page]")
    folder = tmp_path / "evaluation_test_unseen" / "page"
    assert {path.name for path in folder.iterdir()} == {"index.html", "play.css", "play.js", "model_0.js"}
    assert (folder / "model_0.js").read_text().count('"numFrames"') == 2


def test_a_page_of_another_model_is_refused_before_the_rollouts(tiny_data: Path, tmp_path: Path) -> None:
    untrained().save(tmp_path / "own.ckpt")
    with pytest.raises(PageError, match="model.edge_state=latent"):
        evaluate(tiny_data, tmp_path, tmp_path / "own.ckpt", "evaluation.export=[page]")


def test_an_unknown_format_is_refused(tiny_data: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"evaluation\.export\.0='vtu': must be 'vtk', 'npz', 'mp4', 'svg', 'pdf', 'model', 'onnx' or 'page'"
    ):
        evaluate(tiny_data, tmp_path, "x.ckpt", "evaluation.export=[vtu]")


@pytest.mark.parametrize("key", ["evaluation.splits=[test,test_unseen]", "+evaluation.data.scene=column"])
def test_keys_of_fit_are_refused(key: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"evaluation\.splits: are keys of fit; evaluate takes data=… and split=…"):
        evaluate(tmp_path, tmp_path, "sand", key)


def test_a_summary_has_a_line_per_metric_and_a_column_per_horizon() -> None:
    def row(model: str, metric: str, horizon: str, value: float, group: str = "seen") -> Row:
        return Row(model, "test", 0, group, 1.0, metric, horizon, value)

    rows = [
        *(row("learned", "rollout_mse", h, v) for h, v in (("20", 2.0), ("100", 3.0), ("full", 4.0), ("full", 6.0))),
        row("learned", "one_step_nmse", "1", 0.25),
        row("learned", "fraction_outside_uncontained", "full", 0.0),
        *(row("ballistic", metric, "full", 7.0) for metric in ("rollout_mse", "velocity_error")),
    ]
    header, *lines = summary(table_of(rows)).splitlines()
    assert len({len(line) for line in (header, *lines)}) == 1  # aligned
    assert header.split() == ["split", "metric", "model", "20", "100", "full"]
    assert [line.split() for line in lines] == [
        ["test", "fraction_outside_uncontained", "learned", "0"],
        ["test", "one_step_nmse", "learned", "0.25"],
        ["test", "rollout_mse", "ballistic", "7"],
        ["test", "rollout_mse", "learned", "2", "3", "5"],
    ]


def of_rollouts(rows: list[Row], model: str = "learned") -> dict[tuple[int, str, str], float]:
    return {(r.trajectory, r.metric, r.horizon): r.value for r in rows if r.model == model and r.trajectory >= 0}


@pytest.mark.slow
def test_levels_of_skipping_change_nothing_or_are_reported_with_what_they_cost(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path))
    checkpoint = tmp_path / "fit" / "checkpoints" / "best.ckpt"

    def rows(name: str, *levels: str) -> list[Row]:
        return evaluate(tiny_data, tmp_path / name, checkpoint, "evaluation.num_pictures=0", *(f"rollout.{level}" for level in levels))

    usual = of_rollouts(rows("usual"))
    everything = rows(
        "all", "absent_types=false", "static_boundary=false", "isolated_nodes=false", "edges_at_once=null", "sorted_from=null"
    )
    assert of_rollouts(everything) == pytest.approx(usual, rel=1e-3, abs=1e-9)
    approximate = rows("approximate", "repeat_frames=2", "sleep_after=1", "rest_step_spacings=100", "rest_step_change_spacings=100")
    shared = of_rollouts(approximate, "learned, exact")
    assert shared == pytest.approx({k: usual[k] for k in shared}, rel=1e-6, abs=1e-12) and len(shared) > 10
    costs = {k: v for k, v in of_rollouts(approximate).items() if k[1] in ("skipping_mse", "fraction_asleep", "lost_impulse")}
    assert len(costs) == 6 and all(v > 0 for v in costs.values())
    assert not any(metric in ("skipping_mse", "fraction_asleep", "lost_impulse") for _, metric, _ in usual)


@pytest.mark.slow
def test_an_exact_rollout_that_stops_first_is_compared_as_far_as_it_came(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path))
    wild = LearnedSimulator.from_checkpoint(tmp_path / "fit" / "checkpoints" / "best.ckpt")
    wild.acceleration_std.mul_(300)
    wild.save(tmp_path / "wild.ckpt")
    rows = evaluate(tiny_data, tmp_path / "runs", tmp_path / "wild.ckpt", "evaluation.num_pictures=0", "rollout.repeat_frames=3")
    lengths = {model: [r.value for r in rows if (r.model, r.metric) == (model, "rollout_mse")] for model in ("learned", "learned, exact")}
    assert not np.isfinite(lengths["learned, exact"]).all()
    assert sum(r.metric == "skipping_mse" for r in rows) == 2


@pytest.mark.slow
def test_only_the_split_that_is_asked_for_is_generated(tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path))
    checkpoint = tmp_path / "fit" / "checkpoints" / "best.ckpt"
    known = evaluate(tiny_data, tmp_path / "known", checkpoint, "evaluation.num_pictures=0")
    rows = evaluate(tmp_path / "new", tmp_path / "runs", checkpoint, "evaluation.num_pictures=0")
    assert of_rollouts(rows) == pytest.approx(of_rollouts(known), rel=1e-6, abs=1e-12)
    (folder,) = (tmp_path / "new").glob("*/*")
    assert folder.parent.name == "sand_test_unseen"
    assert {path.parent.name for path in folder.glob("*/shard-*.h5")} == {"train", "test_unseen"}


@pytest.mark.long
def test_the_canyon_is_compared_with_the_solver_and_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = dataset_spec(compose("simulate", *DATA, "data=fluid"))
    builder = GraphBuilder(GraphConfig(history=2), trajectory_metadata(spec, "train", 0))
    LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder).save(tmp_path / "water.ckpt")
    show = [f"data.showcase.{key}" for key in ("num_steps=2", "scene.num_particles=50", "scene.bounds=[[0,3],[0,1.5],[0,1.5]]")]
    smaller = ["data.sizes.tiny.d3.num_particles=50", "data.showcase.scene.reservoir=null", "evaluation.num_pictures=0", *show]
    seen, run = list[LearnedSimulator](), showcase.run

    def watched(simulator: LearnedSimulator, *further: Any) -> Any:
        seen.append(simulator)
        return run(simulator, *further)

    monkeypatch.setattr(showcase, "run", watched)
    settings = ["evaluation.mirror_average=true", "evaluation.clamp_parameters=false"]
    rows = evaluate(tmp_path, tmp_path, tmp_path / "water.ckpt", "data=fluid", "scene=canyon", *smaller, *settings)
    assert [(own.mirror_average, own.clamps_parameters) for own in seen] == [(True, False)]
    assert {r.model for r in rows} == {"learned", "ballistic", "stops_at_walls", "constant_velocity"}
    assert (tmp_path / "evaluation_test_unseen" / "showcase.json").exists()
    printed = capsys.readouterr().out
    assert re.search(r"rollout_mse +learned", printed) and "showcase  fraction_corrected" in printed
