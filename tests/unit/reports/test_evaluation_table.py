"""Tables of evaluations compare models of one domain scene by scene, and show whether each reads its material."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gpe_pl.evaluation.material_controls import CONTROLS, SOLVER_ENDS, SOLVER_NEAREST, UNSEEN, label_of
from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.files import sealed
from gpe_pl.files.run_folder import RunError
from gpe_pl.reports.evaluation_table import labelled
from gpe_pl.reports.finished_runs import archive, evaluations_below, finished_runs
from gpe_pl.reports.stride_table import DIFFERENT_STARTS
from gpe_pl.reports.tables import main

HARD = (1.0, 2.0, 4.0, 8.0, 3.0, 5.0)
"""Errors of six scenes [1e-3 m²]."""


def write_evaluation(
    folder: Path,
    data: str,
    factor: float,
    friction: float | None = None,
    nearest: float = 0.0,
    split: str = UNSEEN,
    seed: int = 0,
    history: int = 2,
    stride: int = 1,
) -> None:
    """Write an evaluation whose errors are those of ``HARD`` times a factor, with controls if ``nearest`` is above 0."""
    folder.mkdir(parents=True)
    parameters = {data: {"seen": [20.0, 30.0]}}
    config = {
        "checkpoint": f"{data}.ckpt (sha256 0123)",
        "split": split,
        "data_sha256": {split: f"{data}{seed}"},
        "data": {"name": data, "seed": seed, "parameters": parameters, "solver": {"frame_dt": 0.01}, "stride": stride},
        "graph": {"history": history},
        "evaluation": {"static_friction": friction},
    }
    sealed.write(folder / "config.json", config)
    factors = {LEARNED: factor, "ballistic": 50.0}
    if nearest:
        factors |= {label_of(LEARNED, control): nearest for control in CONTROLS} | {SOLVER_NEAREST: 0.2, SOLVER_ENDS: 4.0}
    rows = [
        Row(model, split, k, "interpolated", 20.5 + k, "rollout_mse", "full", 1e-3 * scale * error)
        for model, scale in factors.items()
        for k, error in enumerate(HARD)
    ]
    write_rows(folder / "metrics.csv", rows)


def cells(text: str, *beginning: str) -> list[str]:
    """Return the cells of the one line of a table that begins with these cells."""
    lines = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines()]
    (found,) = (line for line in lines if line[: len(beginning)] == [*beginning])
    return found


def test_evaluations_of_a_domain_are_compared_with_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, friction, factor in (("a", 0.0, 1.0), ("b", 0.5, 1.5)):
        write_evaluation(tmp_path / "sand" / name, "sand", factor, friction)
        write_evaluation(tmp_path / "sand" / f"{name}-test", "sand", factor, friction, split="test")
    write_evaluation(tmp_path / "snow", "snow", 3.0, 0.5)
    assert main([str(tmp_path)]) == 0
    text = (tmp_path / "table.md").read_text()
    assert text == capsys.readouterr().out[:-1]
    for split in (UNSEEN, "test"):
        first, second = (cells(text, "sand", split, f"static_friction={value}") for value in ("0.0", "0.5"))
        assert first[4].startswith("3.83 [") and first[5:7] == ["", "0"]
        assert second[4].startswith("5.75 [") and second[5] == "1.5 [1.5, 1.5]"
    assert cells(text, "snow", UNSEEN, "snow")[3] == "6"
    assert "reads the material" not in text


def test_evaluations_that_start_at_different_times_are_marked(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "a", "sand", 1.0, 0.0)
    write_evaluation(tmp_path / "snow", "snow", 1.0, history=5)
    assert main([str(tmp_path)]) == 0
    assert "start at" not in (tmp_path / "table.md").read_text()  # one domain need not start as another
    write_evaluation(tmp_path / "b", "sand", 1.0, 0.5, history=5)
    assert main([str(tmp_path)]) == 0
    text = (tmp_path / "table.md").read_text()
    assert DIFFERENT_STARTS.format("0.02 s, 0.05 s") in text
    assert cells(text, "sand", UNSEEN, "static_friction=0.5")[5] == "1 [1, 1]"  # labels need no history


@pytest.mark.slow
def test_each_domain_says_whether_it_reads_the_material(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "runs" / "sand", "sand", 0.5, nearest=1.0)
    write_evaluation(tmp_path / "runs" / "fluid", "fluid", 1.0, nearest=1.0)
    assert main([str(tmp_path / "runs")]) == 0
    text = (tmp_path / "runs" / "table.md").read_text()
    assert cells(text, "sand", "sand", "1.92")[-5:] == ["0.50 [0.50, 0.50]", "yes", *2 * ["0.50 [0.50, 0.50]"], "0.12"]
    assert cells(text, "fluid", "fluid", "3.83")[-5:] == ["1.00 [1.00, 1.00]", "no", *2 * ["1.00 [1.00, 1.00]"], "0.25"]
    assert (tmp_path / "runs" / "reads_material.png").stat().st_size > 1000
    archived = tmp_path / "archive"
    archived.mkdir()
    archive(evaluations_below(tmp_path / "runs"), tmp_path / "runs", archived)
    assert main([str(archived)]) == 0
    assert (archived / "table.md").read_text() == text


def test_evaluations_of_different_data_of_one_name_are_refused(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "a", "sand", 1.0, 0.0)
    write_evaluation(tmp_path / "b", "sand", 1.0, 0.5, seed=1)
    with pytest.raises(RunError, match=r"b and .*a are of different data of one name \(data.seed\) and do not compare; move one of them"):
        labelled(evaluations_below(tmp_path))
    write_evaluation(tmp_path / "c", "sand", 1.0, 0.0, split="test", seed=1)
    assert len(labelled([run for run in evaluations_below(tmp_path) if run.folder.name != "b"])) == 2  # splits are not compared


def test_a_repeated_evaluation_counts_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_evaluation(tmp_path / "a", "sand", 1.0)
    write_evaluation(tmp_path / "b", "sand", 1.0, nearest=1.0)
    (group,) = labelled(evaluations_below(tmp_path)).values()
    assert [run.folder.name for run in group.values()] == ["b"]  # it has more rows
    assert f"{tmp_path / 'a'} repeats {tmp_path / 'b'} and is left out" in caplog.text


def test_evaluations_of_a_model_at_two_strides_are_two(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "a", "sand", 1.0)
    write_evaluation(tmp_path / "b", "sand", 2.0, stride=2)
    (group,) = labelled(evaluations_below(tmp_path)).values()
    assert list(group) == ["stride=1", "stride=2"]


def change(folder: Path, **changes: object) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    del config["sha256"]
    sealed.write(path, config | changes)


@pytest.mark.parametrize(
    ("checkpoints", "labels"),
    [
        (("affine.ckpt (sha256 01)", "none.ckpt (sha256 23)"), ["affine", "none"]),
        (("best.ckpt (sha256 01)", "best.ckpt (sha256 23)"), ["best.ckpt (sha256 01)", "best.ckpt (sha256 23)"]),
    ],
)
def test_checkpoints_have_their_names_unless_these_are_alike(tmp_path: Path, checkpoints: tuple[str, str], labels: list[str]) -> None:
    for name, checkpoint in zip("ab", checkpoints, strict=True):
        write_evaluation(tmp_path / name, "sand", 1.0)
        change(tmp_path / name, checkpoint=checkpoint, model={"material_embedding": name})  # belongs to the checkpoint
    (group,) = labelled(evaluations_below(tmp_path)).values()
    assert [*group] == labels


def test_settings_follow_the_name_of_the_checkpoint(tmp_path: Path) -> None:
    for name, friction in (("a", None), ("b", 0.2), ("c", 0.2)):
        write_evaluation(tmp_path / name, "sand", 1.0, friction)
    change(tmp_path / "c", checkpoint="other.ckpt (sha256 45)")
    (group,) = labelled(evaluations_below(tmp_path)).values()
    assert [*group] == ["sand, static_friction=None", "sand, static_friction=0.2", "other, static_friction=0.2"]


def test_training_runs_and_evaluations_are_told_apart(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "sand", "sand", 1.0)
    assert not finished_runs(tmp_path) and [run.folder.name for run in evaluations_below(tmp_path)] == ["sand"]
    assert list(labelled(evaluations_below(tmp_path))) == [("sand", UNSEEN)]
    folder = tmp_path / "trained"
    folder.mkdir()
    config = {
        "data": {"name": "sand"},
        "model": {"_target_": "gpe_pl.models.gpe.GPE"},
        "training": {"num_steps": 1},
        "checkpoint": "a",
        "split": "test",
    }
    sealed.write(folder / "config.json", config)
    write_rows(folder / "metrics.csv", [Row(LEARNED, "test", 0, "seen", 20.0, "rollout_mse", "full", 1.0)])
    assert [run.folder.name for run in finished_runs(tmp_path)] == ["trained"]
    assert [run.folder.name for run in evaluations_below(tmp_path)] == ["sand"]


def test_an_evaluation_without_rollouts_has_a_dash(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_evaluation(tmp_path / name, "sand", 1.0)
    config = json.loads((tmp_path / "a" / "config.json").read_text())
    del config["sha256"]
    sealed.write(tmp_path / "a" / "config.json", {**config, "checkpoint": "short.ckpt (sha256 0123)"})
    write_rows(tmp_path / "a" / "metrics.csv", [Row(LEARNED, UNSEEN, 0, "interpolated", 20.5, "one_step_nmse", "1", 0.3)])
    main([str(tmp_path)])
    text = (tmp_path / "table.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("| sand |")]
    assert sorted(line.split("|")[4].strip() for line in lines) == ["0", "6"]
    assert any("| – |" in line for line in lines)
