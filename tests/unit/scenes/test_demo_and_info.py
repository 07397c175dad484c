"""``gpe demo`` and ``gpe info``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from gpe_pl.learned import verdicts
from gpe_pl.learned.pretrained import checkpoint_path, names
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.scenes import demo, info, rollouts
from gpe_pl.scenes.film import FilmFault
from gpe_pl.scenes.recorded import NotRecorded, recorded_scene, recorded_solver
from gpe_pl.scenes.rollouts import middle_values
from gpe_pl.system.command_line import ArgumentFault


@pytest.mark.slow
@pytest.mark.parametrize("model", names())
def test_scene_and_solver_of_a_shipped_model_are_recorded(model: str) -> None:
    simulator = LearnedSimulator.from_checkpoint(model)
    own = simulator.builder.metadata
    scene, solver = recorded_scene(own), recorded_solver(own)
    assert (scene.materials, scene.spacing, scene.bounds) == (own.materials, own.spacing, own.bounds)
    assert (solver.name, solver.frame_dt) == (own.solver, own.frame_dt)
    state = scene.sample(middle_values(simulator), 0)
    assert simulator.untrained_parameters(simulator.standing(state, own)) == []


def test_imported_data_have_no_solver() -> None:
    own = LearnedSimulator.from_checkpoint("sand").builder.metadata
    with pytest.raises(NotRecorded, match="data set 'mine' comes from import/npz, so its scenes and solver are not known here"):
        recorded_solver(replace(own, dataset="mine", solver="import/npz", config="{}"))


def test_a_demo_is_a_viewer_and_says_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gpe_pl.viz.browser.has_desktop", lambda: False)
    demo.run("sand", {"seconds": 0.01, "parameter": 27.5})
    lines = capsys.readouterr().out.splitlines()
    assert "sand, friction angle 27.5°" in lines
    assert lines[-2:] == ["demo_sand.html", "no browser here; copy the file, which needs nothing else, and open it elsewhere"]
    assert "friction angle 27.5°" in (tmp_path / "demo_sand.html").read_text()


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        ("snad", {}, "gpe demo snad: name a shipped model .*; did you mean 'sand'?"),
        (None, {}, "gpe demo: name a shipped model"),
        ("sand", {"parameter": 80.0}, "parameter=80: friction_angle = 80.0 deg is outside 0 … 60, the solvers' limits"),
        ("sand", {"file": Path("x.doc")}, "x.doc: files of type .doc are not written; take one of .html, .png, .svg"),
    ],
)
def test_a_demo_that_cannot_be_is_refused(model: str | None, values: dict[str, object], message: str) -> None:
    with pytest.raises((ArgumentFault, FilmFault), match=message):
        demo.run(model, values)


def test_a_parameter_of_several_materials_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"sand": {"friction_angle": 30.0}, "elastomer": {"youngs_modulus": 1e5}}
    monkeypatch.setattr("gpe_pl.scenes.rollouts.middle_values", lambda simulator: values)
    with pytest.raises(ArgumentFault, match="parameter=30: sand knows sand and elastomer, so it is not clear whose parameter this is"):
        demo.demo("sand", parameter=30.0)


def test_info_says_settings_ranges_and_checks(capsys: pytest.CaptureFixture[str]) -> None:
    info.run("sand", {"speed": False})
    printed = capsys.readouterr().out
    measured = verdicts.read(verdicts.path_beside(checkpoint_path("sand"), "acceptance"))
    for part in (
        "model: GPE with 181,972 parameters, for sand in 2D",
        "friction_angle of sand: 20 to 42.5 deg",
        f"acceptance: {sum(check.passed for check in measured.checks)} of {len(measured.checks)} checks passed",
    ):
        assert part in printed
    info.run(None, {})
    assert all(f"\n{name}: " in f"\n{capsys.readouterr().out}" for name in names()[:1])
    with pytest.raises(ArgumentFault, match="did you mean 'snow'?"):
        info.run("snwo", {})


@pytest.mark.slow
def test_info_times_a_step(capsys: pytest.CaptureFixture[str]) -> None:
    info.run("sand", {})
    assert "ms for a frame of 320 nodes" in capsys.readouterr().out


@pytest.mark.parametrize(("few", "threads"), [(10_000, 1), (0, 2)])
def test_small_scenes_run_on_one_thread(monkeypatch: pytest.MonkeyPatch, few: int, threads: int) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    own, seen, before = simulator.builder.metadata, list[int](), torch.get_num_threads()
    monkeypatch.setattr(rollouts, "FEW", few)
    whole = rollouts.rollout

    def watched(*arguments: Any) -> Any:
        seen.append(torch.get_num_threads())
        return whole(*arguments)

    monkeypatch.setattr(rollouts, "rollout", watched)
    torch.set_num_threads(2)
    try:
        rollouts.predicted(simulator, recorded_scene(own).sample(middle_values(simulator), 0), own, 2, "")
        assert (seen, torch.get_num_threads()) == ([threads], 2)
    finally:
        torch.set_num_threads(before)
