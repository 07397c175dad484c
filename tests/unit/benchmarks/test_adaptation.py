"""The suite of adaptation: random scenes of engines, what is trained on them, and the table."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpe_pl.benchmarks.acceptance.trial import Candidate
from gpe_pl.benchmarks.adaptation import scenes, suite
from gpe_pl.benchmarks.outside.engine import EngineError, Motion
from gpe_pl.benchmarks.outside.engines import SCENES, EngineName
from gpe_pl.benchmarks.outside.suite import candidate_of
from gpe_pl.config.datasets import dataset
from gpe_pl.geometry.shapes import signed_distance
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.store import iter_trajectories

ENGINES: dict[EngineName, str] = {"kratos": "sand", "calculix": "fem", "splishsplash": "fluid"}


@pytest.fixture(scope="module")
def candidates() -> dict[EngineName, Candidate]:
    specs = {name: dataset(f"data={name}", "size=small") for name in ENGINES.values()}
    return {engine: candidate_of(checkpoint, specs) for engine, checkpoint in ENGINES.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ENGINES)
def test_random_scenes_are_inside_the_walls_and_the_trained_range(name: EngineName, candidates: dict[EngineName, Candidate]) -> None:
    candidate = candidates[name]
    low, _, high = candidate.values
    states = [scenes.start(name, candidate, seed) for seed in range(20)]
    for state in states:
        assert low <= float(state.material_params[0, 0]) <= high
        assert signed_distance(state.boundary.shapes, np.asarray(state.pos)).min() > 0.2 * candidate.spacing
    assert len({state.num_nodes for state in states}) > 5
    np.testing.assert_array_equal(scenes.start(name, candidate, 3).pos, states[3].pos)


def engine_that_slides(shift: float, given_up: Sequence[int] = ()) -> Any:
    """An engine that moves all nodes sideways at a constant speed of ``shift`` spacings per frame, and gives up some of its calls."""
    calls = []

    def run(candidate: Candidate, state: State, num_frames: int) -> Motion:
        calls.append(state)
        if len(calls) - 1 in given_up:
            raise EngineError("the engine: diverges")
        pos = np.asarray(state.pos) + shift * candidate.spacing * np.arange(num_frames)[:, None, None] * np.eye(state.dim)[0]
        if state.cells is None:
            return Motion(pos)
        return Motion(
            pos, np.full(pos.shape, 3.0), Stress(*(np.full((num_frames, count, 4), 1e5) for count in (len(pos[0]), len(state.cells))))
        )

    return run, calls


def with_engine(monkeypatch: pytest.MonkeyPatch, name: EngineName, run: Any) -> None:
    monkeypatch.setitem(SCENES, name, replace(SCENES[name], run=run, is_missing=lambda: False, seconds=0.02))


def test_a_stopped_command_does_not_run_the_engine_again(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, calls = engine_that_slides(0.1)
    with_engine(monkeypatch, "kratos", run)
    first, again = (scenes.pair("kratos", candidates["kratos"], 0, tmp_path) for _ in range(2))
    assert len(calls) == 1
    engine, dt = again.engine, candidates["kratos"].spec.solver.frame_dt
    np.testing.assert_array_equal(engine.pos, first.engine.pos)
    np.testing.assert_array_equal(engine.vel[0], 0.0)  # at rest, as the initial state says
    np.testing.assert_allclose(engine.vel[1:, :, 0], 0.1 * candidates["kratos"].spacing / dt, rtol=1e-4)
    assert again.solver.shape == engine.pos.shape and not np.array_equal(again.solver, engine.pos)


@pytest.mark.slow
def test_an_engine_runs_again_for_other_constants_of_the_solver(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poisson's ratio is not in the state."""
    run, calls = engine_that_slides(0.1)
    with_engine(monkeypatch, "calculix", run)
    other = replace(candidates["calculix"], spec=dataset("data=fem", "size=small", "data.solver.poisson_ratio=0.45"))
    for candidate in (candidates["calculix"], other, other):
        scenes.pair("calculix", candidate, 0, tmp_path)
    assert len(calls) == 2


@pytest.mark.slow
def test_a_model_of_another_material_is_refused(tmp_path: Path, candidates: dict[EngineName, Candidate]) -> None:
    wrong: list[tuple[EngineName, str]] = [("kratos", "fluid"), ("kratos", "fem"), ("calculix", "sand"), ("splishsplash", "sand")]
    for engine, other in wrong:
        (candidate,) = (c for name, c in candidates.items() if ENGINES[name] == other)
        with pytest.raises(suite.AdaptationError, match=f"{engine}: its scenes are of .* and {other} was trained on"):
            suite._of_engine(engine, suite.OfEngine(other, []), candidate, settings(), tmp_path)
    assert not any(tmp_path.iterdir())


def test_velocities_and_stress_of_an_engine_are_stored_with_its_scenes(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, _ = engine_that_slides(0.1)
    with_engine(monkeypatch, "calculix", run)
    pairs = [
        scenes.pair("calculix", candidates["calculix"], seed, tmp_path) for seed in (0, 1, 2, 3, 0)
    ]  # the last one is read from the file
    assert pairs[-1].engine.stress is not None
    of_engine = {"calculix": suite.OfEngine("fem", [])}
    name = suite._stored("calculix", pairs[1:], suite.Settings({}, of_engine, 1, 1, 2), tmp_path)  # type: ignore[arg-type]
    for split in ("train", "val", "test"):
        for trajectory in iter_trajectories(tmp_path / "data" / name / "imported", split):
            assert trajectory.metadata.with_stress == ("solid",) and trajectory.stress is not None
            assert (trajectory.stress.cell == 1e5).all() and (trajectory.stress.node == 1e5).all()
            assert (trajectory.vel == 3.0).all()


@pytest.mark.slow
def test_scenes_that_cannot_be_used_leave_no_data_set(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A later run would take it for complete."""
    run, _ = engine_that_slides(0.1)
    with_engine(monkeypatch, "calculix", run)
    pairs = [scenes.pair("calculix", candidates["calculix"], seed, tmp_path) for seed in (1, 2, 3, 0)]
    broken = replace(pairs[-1].engine, pos=pairs[-1].engine.pos * np.nan)
    chosen = suite.Settings({}, {"calculix": suite.OfEngine("fem", [])}, 1, 1, 2)  # type: ignore[arg-type]
    for _ in range(2):
        with pytest.raises(suite.AdaptationError, match="1 scenes cannot be used"):
            suite._stored("calculix", [*pairs[:-1], replace(pairs[-1], engine=broken)], chosen, tmp_path)
    assert not list((tmp_path / "data").glob("calculix_*"))


def settings(**changes: Any) -> suite.Settings:
    of_engine = {"kratos": suite.OfEngine("sand", ["model=gpe_tuned"])}
    return suite.Settings(cases={}, engines=of_engine, **{"num_train": 2, "num_val": 1, "num_test": 2, **changes})  # type: ignore[arg-type]


@pytest.mark.slow
def test_what_is_trained_and_compared(tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = engine_that_slides(0.1, given_up=[3])
    with_engine(monkeypatch, "kratos", run)
    commands: list[list[str]] = []

    def trained(command: list[str], **_: object) -> SimpleNamespace:
        commands.append(command)
        return SimpleNamespace(returncode=0)

    def found(checkpoint: str, *_: object) -> dict[str, list[tuple[float, bool]]]:
        return {"model": [(1e-3, False), (2e-3, True)], "ballistic": [(3e-3, False), (4e-3, False)]}

    monkeypatch.setattr(subprocess, "run", trained)
    monkeypatch.setattr(suite, "measured", found)
    specs = {"sand": candidates["kratos"].spec}
    records, table = suite.run(settings(seeds=[0, 1]), specs, tmp_path)
    assert [(r["simulator"], r["seed"]) for r in records] == [
        ("solver", None),
        ("shipped model", None),
        ("ballistic", None),
        ("adapted", 0),
        ("from scratch", 0),
        ("adapted", 1),
        ("from scratch", 1),
    ]
    (dataset_name,) = (path.name for path in (tmp_path / "data").iterdir())
    adapted, scratch, *_ = ([part for part in command if "=" in part] for command in commands)
    assert "start_from=sand" in adapted and "training.learning_rate=0.0003" in adapted and f"name={dataset_name}_adapted_seed_0" in adapted
    assert not any(part.startswith("start_from") for part in scratch) and "training.learning_rate=0.001" in scratch
    assert "training.num_steps=1500" in adapted and "training.num_steps=1500" in scratch
    assert {
        split: len(list(iter_trajectories(tmp_path / "data" / dataset_name / "imported", split))) for split in ("train", "val", "test")
    } == {
        "train": 2,
        "val": 1,
        "test": 2,
    }
    assert "Kratos MPM gave up 1 further scenes" in table
    assert next(line for line in table.splitlines() if "| adapted |" in line).endswith("| 1 [1, 1] | 2 | 0, 1 |")
    assert next(line for line in table.splitlines() if "| ballistic |" in line).endswith("| 0 |  |")
    suite.run(settings(num_train=1), specs, tmp_path)  # other splits of the same scenes are another data set
    assert len(list((tmp_path / "data").iterdir())) == 2


def test_an_engine_that_gives_up_most_scenes_is_an_error(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, calls = engine_that_slides(0.1, given_up=range(100))
    with_engine(monkeypatch, "kratos", run)
    with pytest.raises(suite.AdaptationError, match=r"Kratos MPM: gives up more than half of the scenes. the engine: diverges"):
        suite.run(settings(), {"sand": candidates["kratos"].spec}, tmp_path)
    assert len(calls) == 10


def test_engines_that_are_missing_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENES, "kratos", replace(SCENES["kratos"], is_missing=lambda: True))
    records, table = suite.run(settings(), {}, tmp_path)
    assert records == [] and "- Kratos MPM: pip install KratosMPMApplication" in table


def test_a_failed_training_is_named_with_its_command(
    tmp_path: Path, candidates: dict[EngineName, Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, _ = engine_that_slides(0.1)
    with_engine(monkeypatch, "kratos", run)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    monkeypatch.setattr(suite, "measured", lambda *_: {"model": [1e-3, 2e-3]})
    with pytest.raises(
        suite.AdaptationError,
        match=r"gpe_pl.fit data=imported data.name=kratos_[0-9a-f]{16} .* start_from=sand paths.data=.* paths.runs=.*: failed",
    ):
        suite.run(settings(), {"sand": candidates["kratos"].spec}, tmp_path)


def test_distances_are_pooled_and_compared_on_the_same_scenes() -> None:
    rows = [("solver", None, [3.0, 4.0]), ("shipped model", None, [6.0, 8.0]), ("adapted", 0, [3.0, 4.0]), ("adapted", 1, [3.0, 4.0])]
    records = [{"engine": "kratos", "given_up": 0, "simulator": who, "seed": seed, "rms": rms} for who, seed, rms in rows]
    lines = suite.report(records, []).splitlines()
    assert lines[2] == "| Kratos MPM | solver | 3.54 [3, 4] | 0.5 [0.5, 0.5] | not recorded |  |"
    assert lines[3] == "| Kratos MPM | shipped model | 7.07 [6, 8] |  | not recorded |  |"
    assert lines[4] == "| Kratos MPM | adapted | 3.54 [3, 4] | 0.5 [0.5, 0.5] | not recorded | 0, 1 |"
    assert "gave up" not in "".join(lines)
    (axes,) = suite.figures(records)["adaptation"].axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["solver", "shipped model", "adapted"]
    np.testing.assert_allclose(axes.lines[5].get_ydata(), np.sqrt(12.5))
    assert suite.figures([]) == {}
