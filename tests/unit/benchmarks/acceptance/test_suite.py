"""The suite measures every scene of a checkpoint once, continues where it was stopped, and stores what fails where it is looked up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.benchmarks.acceptance import particles, scenes, suite
from gpe_pl.benchmarks.acceptance.suite import AcceptanceError, Settings, failures, run
from gpe_pl.benchmarks.acceptance.trial import Candidate, Result, Trial, TrialError, at_most, contained, shown, tried
from gpe_pl.benchmarks.half_steps import HalfSteps
from gpe_pl.benchmarks.trained import SameNameError
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, trajectory_metadata
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import headline
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Termination


@pytest.fixture(scope="module")
def spec() -> DatasetSpec:
    return dataset("data=sand", "size=tiny")


def untrained(spec: DatasetSpec) -> LearnedSimulator:
    torch.manual_seed(0)
    build = GraphBuilder(GraphConfig(history=2, islands=True), trajectory_metadata(spec, "train", 0))
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build)


@pytest.fixture
def checkpoint(spec: DatasetSpec, tmp_path: Path) -> Path:
    """An untrained model, which passes nothing but free flight."""
    simulator = untrained(spec)
    for _, trained in simulator.trained_ranges():
        trained.copy_(torch.tensor([[20.0], [40.0]]))
    path = tmp_path / "own" / "checkpoints" / "best.ckpt"
    simulator.save(path)
    return path


def column(candidate: Candidate) -> Result:
    """Run a column of eight particles for a moment."""
    trials = [tried(candidate, value, scenes.column(candidate.spec, value, 4, 2), 0.02) for value in candidate.values]
    return Result([at_most("column: tilt", [2.0], 3.0, "°"), at_most("column: sideways", [2.0], 1.0, " %")], shown(candidate, trials, 1.0))


def test_results_are_written_and_lead(spec: DatasetSpec, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "SCENES", {"column": {"sand": column}, "flat": {"solid": column}})
    records, table = run(Settings({}, [str(checkpoint)]), {"sand": spec}, tmp_path)
    assert [(r["model"], r["scene"], r["passed"]) for r in records] == [("own", "column", True), ("own", "column", False)]
    assert failures(records) == ["own: column: sideways 2 %"]
    assert "1 of 2 checks passed" in table and table.index("**FAIL**") < table.index("| pass |")
    assert (tmp_path / "acceptance_own_column.png").stat().st_size > 1000
    assert headline(checkpoint) == "fails acceptance in 1 of 2 checks: column: sideways 2 %"
    assert not (tmp_path / "parts").exists()


def test_a_stopped_suite_continues_with_the_next_scene(
    spec: DatasetSpec, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    def stopping(candidate: Candidate) -> Result:
        seen.append(candidate.name)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return Result([at_most(f"scene {len(seen)}", [0.0], 1.0, "")], [])

    monkeypatch.setattr(suite, "SCENES", {name: {"sand": stopping} for name in "abc"})
    settings = Settings({}, [str(checkpoint)])
    with pytest.raises(KeyboardInterrupt):
        run(settings, {"sand": spec}, tmp_path)
    assert headline(checkpoint) == "acceptance not measured"
    records, _ = run(settings, {"sand": spec}, tmp_path)
    assert [r["name"] for r in records] == ["scene 1", "scene 3", "scene 4"] and len(seen) == 4


def test_a_checkpoint_that_is_replaced_during_the_suite_gets_no_verdict(
    spec: DatasetSpec, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replacing(candidate: Candidate) -> Result:
        candidate.simulator.acceleration_std.fill_(2.0)
        candidate.simulator.save(checkpoint)
        return Result([at_most("a scene", [0.0], 1.0, "")], [])

    monkeypatch.setattr(suite, "SCENES", {"column": {"sand": replacing}})
    with pytest.raises(AcceptanceError, match=r"best.ckpt: was replaced while the suite ran"):
        run(Settings({}, [str(checkpoint)]), {"sand": spec}, tmp_path)
    assert headline(checkpoint) == "acceptance not measured" and not [*tmp_path.rglob("*.acceptance.json")]


@pytest.mark.parametrize("who", ["the solver", "the solver with half its time step"])
def test_a_solver_that_stops_is_no_reference(spec: DatasetSpec, checkpoint: Path, monkeypatch: pytest.MonkeyPatch, who: str) -> None:
    from gpe_pl.benchmarks.acceptance import trial

    def stopping(simulator: Any, *args: Any) -> Any:
        found = rollout(simulator, *args)
        is_stopped = isinstance(simulator, HalfSteps) == (who != "the solver")
        return replace(found.frames(0, 3), termination=Termination("nan", 3, 0, "frame 3: node 0")) if is_stopped else found

    monkeypatch.setattr(trial, "rollout", stopping)
    candidate = Candidate("own", LearnedSimulator.from_checkpoint(checkpoint), spec)
    with pytest.raises(TrialError, match=f"sand: {who} stopped early, so there is nothing to compare with: frame 3"):
        tried(candidate, 30.0, scenes.column(spec, 30.0, 4, 2), 0.02)


def test_a_model_that_stops_has_no_containment_to_judge(spec: DatasetSpec, checkpoint: Path) -> None:
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    simulator.acceleration_std.fill_(1e9)
    found = tried(Candidate("own", simulator, spec), 30.0, scenes.column(spec, 30.0, 4, 2), 0.02)
    check = contained("column", [found])
    assert found.model.termination is not None and not check.passed and check.measured == "stopped %"


def test_a_model_without_scenes_and_two_of_one_name_are_refused(spec: DatasetSpec, checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(AcceptanceError, match=r"best.ckpt: was trained on sand \(sand, spacing .*choose its size="):
        run(Settings({}, [str(checkpoint)]), {"sand": dataset("data=sand", "size=small")}, tmp_path)
    with pytest.raises(SameNameError, match="two checkpoints are called own"):
        run(Settings({}, [str(checkpoint)] * 2), {"sand": spec}, tmp_path)


def test_every_domain_has_scenes() -> None:
    cases = {"sand": "sand", "snow": "snow", "elastomer": "elastomer", "fluid": "fluid", "fem": "solid"}
    for name, material in cases.items():
        assert sum(material in materials for materials in suite.SCENES.values()) >= 2, name


@pytest.mark.slow
def test_a_pile_that_is_too_steep_has_to_flow(spec: DatasetSpec, checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    candidate = Candidate("own", LearnedSimulator.from_checkpoint(checkpoint), spec)
    for frozen in (True, False):

        def known(_: Candidate, value: float, start: State, seconds: float, frozen: bool = frozen) -> Trial:
            truth = rollout(spec.solver, start, round(seconds / spec.solver.frame_dt), candidate.metadata())
            model = replace(truth, pos=np.repeat(truth.pos[:1], truth.num_frames, axis=0)) if frozen else truth
            assert value == start.material_params.max() == 20.0
            return Trial(value, truth, truth, model, 0.0)

        monkeypatch.setattr(particles, "tried", known)
        way, corrected = particles.slump(candidate).checks
        assert way.passed is not frozen and corrected.passed


@pytest.mark.slow
def test_a_solver_with_one_substep_per_frame_has_an_uncertainty_too() -> None:
    spec = dataset("data=fluid", "size=tiny")
    start = scenes.pool(spec, 0.01, one_side=True)
    trial = tried(Candidate("own", untrained(spec), spec), 0.01, start, 0.05)
    assert spec.solver.step(start).num_substeps == 1
    assert 0 < np.abs(trial.finer.pos - trial.truth.pos).max() < spec.scene.spacing
