"""The stress tests: they pass and fail as they should, a crash counts as a failure, and all results reach the table."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl.benchmark import benchmark
from gpe_pl.benchmarks.stability import conservation, geometry, horizon, inputs, invariances, precision, suite
from gpe_pl.benchmarks.stability.horizon import energy, growth_rate, separation, valid_steps
from gpe_pl.benchmarks.stability.subject import Outcome, StressTest, Subject, largest
from gpe_pl.benchmarks.stability.suite import GROUPS, NothingToTestError, ReplacedError, Settings, figures, is_gating, run
from gpe_pl.benchmarks.stability.suite import test as run_tests
from gpe_pl.benchmarks.trained import Case, model_label, trained_on
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.learned.verdicts import headline
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.reports.finished_runs import Run, table_of
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import compose

NUM_FRAMES = 16
SHIPPED = {"edge_state": "geometry", "island_momentum": "angular"}


@pytest.fixture(scope="module")
def spec() -> DatasetSpec:
    return dataset("data=sand", "size=tiny", f"data.sizes.tiny.num_frames={NUM_FRAMES}", "data.sizes.tiny.d2.num_particles=60")


@pytest.fixture(scope="module")
def scenes(spec: DatasetSpec) -> list[Trajectory]:
    return [generate_trajectory(spec, "test", k) for k in range(2)]


def subject(spec: DatasetSpec, scenes: list[Trajectory], **settings: str) -> Subject:
    """Return an untrained model as a subject."""
    torch.manual_seed(0)
    build = GraphBuilder(GraphConfig(history=2, islands=True), scenes[0].metadata)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, **settings), build).eval()  # type: ignore[arg-type]
    for _, trained in simulator.trained_ranges():
        trained.copy_(torch.tensor([[20.0], [40.0]]))
    return Subject("GPE", "sand", simulator, spec, scenes, max_speed=10.0, is_gating=True, horizon_factors=(1.0, 2.0), num_rest_steps=5)


@pytest.mark.parametrize("gravity", [(0.0, -9.81), (0.0, 0.0, -9.81), (0.0, -9.81, 0.0), (9.81, 0.0, 0.0)])
def test_a_quarter_turn_turns_gravity(gravity: tuple[float, ...]) -> None:
    quarter, pull = invariances.quarter_turn(gravity), torch.tensor(gravity, dtype=torch.float64)
    assert float(pull @ quarter @ pull) == 0
    torch.testing.assert_close(quarter @ quarter.T, torch.eye(len(gravity), dtype=torch.float64))
    assert float(torch.linalg.det(quarter)) == pytest.approx(1.0)


def test_all_tests_are_there_once() -> None:
    assert sorted(t.number for tests in GROUPS.values() for t in tests) == list(range(1, 32))
    assert all(t.criterion and t.name for tests in GROUPS.values() for t in tests)


HOLDS = (
    invariances.label_permutation,
    invariances.edge_orientation,
    invariances.edge_order,
    conservation.angular_momentum,
    geometry.coincident,
    geometry.isolated,
    geometry.density_spike,
    geometry.neighbour_list,
    inputs.materials,
    inputs.not_finite,
    inputs.types,
    pytest.param(horizon.resuming, marks=pytest.mark.slow),
    precision.implementations,
    precision.skipping,
    precision.guard,
)


@pytest.mark.slow
@pytest.mark.parametrize("stress_test", HOLDS, ids=lambda t: str(t.number) if isinstance(t, StressTest) else None)
def test_what_holds_by_construction_holds_before_training(spec: DatasetSpec, scenes: list[Trajectory], stress_test: StressTest) -> None:
    outcome = stress_test(subject(spec, scenes, **SHIPPED))
    assert outcome.passed is True, outcome.measured


def test_exact_momentum_of_islands_is_measured_as_such(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    exact, plain = subject(spec, scenes, **SHIPPED), subject(spec, scenes)
    assert conservation.momentum_residual(exact.simulator, exact.free_state()) < 5e-6
    assert conservation.momentum_residual(plain.simulator, plain.free_state()) > 1e-2


def test_a_network_that_knows_the_numbers_of_its_nodes_is_found_out(spec: DatasetSpec, scenes: list[Trajectory]) -> None:

    class Leaking(GraphBuilder):
        def __call__(self, state: State) -> HeteroData:
            data = super().__call__(state)
            data["sand"].x = data["sand"].x + 0.1 * torch.arange(state.num_nodes)[:, None]
            return data

    own = subject(spec, scenes, **SHIPPED)
    own.simulator.builder = Leaking(own.simulator.builder.config, own.simulator.builder.metadata)
    assert invariances.relabelling_error(own, torch.float32, seed=0) > 1e-3
    (record,) = run_tests(own, [1])
    assert record["status"] == "failed"


def test_the_jump_at_the_radius_is_also_told_without_island_momentum(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    exact, plain = subject(spec, scenes, **SHIPPED), subject(spec, scenes, edge_state="geometry")
    own, cause = geometry.cutoff(exact).measured.split(" one-step RMSE; ")
    assert cause.endswith(" without island momentum") and float(own) != float(cause.split()[0])
    alone = geometry.cutoff(plain).measured
    assert alone.endswith(" one-step RMSE")  # the same weights
    assert float(cause.split()[0]) * exact.one_step_rmse == pytest.approx(float(alone.split()[0]) * plain.one_step_rmse, rel=0.1)
    assert exact.simulator.model.settings["island_momentum"] == "angular"


@pytest.mark.parametrize(("interaction", "jumps"), [("negated", True), ("odd", False), ("odd_even", False), ("directed", False)])
def test_only_negated_messages_jump_where_an_edge_turns(spec: DatasetSpec, scenes: list[Trajectory], interaction: str, jumps: bool) -> None:
    outcome = geometry.turning_edge(subject(spec, scenes, interaction=interaction))
    jump = float(outcome.measured.split()[0])
    assert outcome.measured.endswith("one-step RMSE, largest of 8 edges") and outcome.passed is (jump < 1)
    assert (jump > 1e-4) is jumps, outcome.measured


def test_a_model_without_exact_momentum_says_so(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    own = subject(spec, scenes)
    assert conservation.linear_momentum(own).passed is None
    assert conservation.angular_momentum(own).passed is None
    assert conservation.node_head(own).passed is None
    assert geometry.isolated(own).passed is False  # a node alone does not fall freely


def test_a_node_head_is_compared_with_gns(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    exact = subject(spec, scenes, **SHIPPED)
    build = exact.simulator.builder
    gns = LearnedSimulator(GNS(build.spec, num_message_passing_steps=2, hidden_channels=8), build).eval()
    peers = {"GPE": exact.simulator, "GNS": gns}
    better, worse = (replace(s, peers=peers) for s in (exact, subject(spec, scenes)))
    assert conservation.node_head(better).passed is True
    theirs = conservation.momentum_residual(gns, worse.free_state())
    own = conservation.momentum_residual(worse.simulator, worse.free_state())
    assert conservation.node_head(worse).passed is (own <= theirs)
    assert conservation.node_head(replace(worse, simulator=gns)).measured == f"this is GNS: {theirs:.2g}"


def test_an_exploding_model_fails(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    own = subject(spec, scenes)
    own.simulator.acceleration_std.fill_(1e6)
    outcome = horizon.long_horizon(own)
    assert outcome.passed is False
    assert "stopped at frame 1: " in outcome.measured
    assert all(f <= 2 for f in outcome.curves["steps_to_failure"])


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 3, 4, 7])
def test_a_model_that_answers_nan_fails(spec: DatasetSpec, scenes: list[Trajectory], monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Only the first comparison is finite, so the largest by ``max`` would be that one."""
    changes = itertools.chain([0.0], itertools.repeat(float("nan")))
    monkeypatch.setattr(invariances, "relative_change", lambda *_: next(changes))
    (stress_test,) = (test for test in invariances.TESTS if test.number == number)
    assert stress_test(subject(spec, scenes)).passed is False


def test_the_largest_of_several_values_is_nan_if_one_is() -> None:
    assert largest([1.0, 3.0, 2.0]) == 3.0
    assert np.isnan(largest([1.0, float("nan"), 2.0]))


def test_energy_is_kinetic_and_of_height(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    truth = scenes[0]
    one = replace(truth.frames(0, 1), vel=np.full_like(truth.vel[:1], 2.0))
    height = truth.pos[0, :, 1] - truth.metadata.bounds[1][0]
    expected = (truth.mass * (0.5 * 8.0 + abs(truth.metadata.gravity[1]) * height)).sum()
    assert energy(one, subject(spec, scenes)) == pytest.approx(expected, rel=1e-5)


def test_a_prediction_is_valid_until_it_is_half_a_spacing_off(scenes: list[Trajectory]) -> None:
    truth = scenes[0]
    spacing = truth.metadata.spacing
    shift = np.zeros(truth.num_frames, np.float32)
    shift[7:] = 0.51 * spacing
    off = replace(truth, pos=truth.pos + shift[:, None, None] * np.array([1.0, 0.0], np.float32))
    assert valid_steps(off, truth, spacing) == 6
    assert valid_steps(truth, truth, spacing) == truth.num_frames - 1
    assert valid_steps(truth.frames(0, 5), truth, spacing) == 4


def test_growth_rates_are_those_of_exponentials() -> None:
    grown = 1e-4 * np.exp(0.3 * np.arange(60))
    assert growth_rate(np.minimum(grown, 2.0), spacing=1.0) == pytest.approx(0.3)
    assert growth_rate(1e-4 * np.exp(-0.1 * np.arange(60)), spacing=1.0) == pytest.approx(-0.1)


def test_twins_of_free_fall_keep_their_distance(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    from gpe_pl.rollout.baselines import Ballistic

    own = subject(spec, scenes)
    apart = separation(Ballistic(own.dt), own.state(0, 0.0), 5, own.spacing, 1.0)
    assert apart == pytest.approx(np.full(6, 1e-6 / own.spacing), rel=1e-6)


def test_a_crash_is_a_failure_with_its_reason(spec: DatasetSpec, scenes: list[Trajectory], monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(_: Subject) -> Outcome:
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setitem(GROUPS, "inputs", (StressTest(17, "a", "b", crash),))
    (record,) = run_tests(subject(spec, scenes), [17])
    assert record["status"] == "failed"
    assert record["measured"] == "crashed: ZeroDivisionError: by zero"
    assert record["gating"] is True


@pytest.mark.slow
def test_a_run_writes_records_table_and_figures(spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path) -> None:
    own = subject(spec, scenes, **SHIPPED).simulator
    own.save(tmp_path / "own.ckpt")
    cases = {"sand": Case([]), "snow": Case([])}
    tests = [1, 5, 12, 21, 23]
    settings = Settings(cases, [str(tmp_path)], [str(tmp_path / "own.ckpt")], SHIPPED, 1, [1.0, 2.0], 5, tests)
    other = dataset("data=snow", "size=tiny")
    records, table = run(settings, {"sand": spec, "snow": other}, tmp_path / "results")
    assert [r["test"].split()[0] for r in records] == [str(t) for t in tests]
    assert {r["status"] for r in records} <= {"passed", "failed", "not_applicable"}
    assert all(r["gating"] and r["model"] == "own" and r["domain"] == "sand" for r in records)
    assert json.loads(json.dumps(records, allow_nan=False)) == records
    assert "Not tested, for want of a model: snow." in table
    assert sum(line.startswith("| ") for line in table.splitlines()) == 2 + 1 + len(tests)
    assert "‖Pᵀf(Px) − f(x)‖" in table
    assert set(figures(records)) == {"long_horizon_sand", "perturbation_sand"}
    with pytest.raises(NothingToTestError, match="no model that was trained on one of snow tiny; train with"):
        run(settings, {"snow": other}, tmp_path / "results")


def test_a_stopped_run_continues_with_the_next_test(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[int] = []

    def stopping(stress_test: StressTest, _: Subject) -> Outcome:
        if stress_test.number == 5 and 5 not in measured:
            measured.append(5)
            raise KeyboardInterrupt
        measured.append(stress_test.number)
        return Outcome(True, "as it should be")

    subject(spec, scenes, **SHIPPED).simulator.save(tmp_path / "own.ckpt")
    monkeypatch.setattr(suite, "_outcome", stopping)
    settings = Settings({"sand": Case([])}, [], [str(tmp_path / "own.ckpt")], SHIPPED, 1, [1.0], 5, [1, 5, 12])
    with pytest.raises(KeyboardInterrupt):
        run(settings, {"sand": spec}, tmp_path / "results")
    assert measured == [1, 5]
    records, _ = run(settings, {"sand": spec}, tmp_path / "results")
    assert measured == [1, 5, 5, 12] and [r["test"].split()[0] for r in records] == ["1", "5", "12"]
    run(settings, {"sand": spec}, tmp_path / "results")
    assert measured == [1, 5, 5, 12, 1, 5, 12]  # after the end, a run measures everything again


def test_a_pile_rests_by_the_static_friction_that_ships(
    spec: DatasetSpec, scenes: list[Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = subject(spec, scenes, **SHIPPED)
    monkeypatch.setattr(horizon, "settle", lambda _: scenes[0].state(5, 0))
    fractions: list[float | None] = []

    def drift(_: Subject, simulator: Any, __: State) -> horizon.Drift:
        fractions.append(None if simulator is spec.label_solver else simulator.simulator.static_friction)
        return horizon.Drift(0.3 if fractions[-1] else 0.7 if fractions[-1] is not None else solver, 0.1, 0.0, None)

    monkeypatch.setattr(horizon, "drift", drift)
    for fraction, other, solver, passed in ((0.0, 0.5, 0.2, False), (0.25, 0.0, 0.1, False), (0.25, 0.0, 0.2, True), (0.0, 0.5, 0.4, True)):
        own.simulator.static_friction = fraction
        (kept,) = suite.subjects("sand", spec, {"GPE": own.simulator}, Settings({}, num_scenes=1))
        outcome = horizon.rest(kept)
        assert (fractions[-3:], outcome.passed) == ([None, fraction, other], passed)  # the solver's own drift widens the limit
        assert outcome.measured.startswith("without static friction: " if fraction == 0 else "static friction 0.25: farthest 0.3")
        assert f"solver: farthest {solver}" in outcome.measured
        assert invariances.in_double(own.simulator).static_friction == fraction


@pytest.mark.slow
def test_a_pile_at_rest_is_compared_with_the_solvers_own_drift(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    own = replace(subject(spec, scenes, **SHIPPED), spec=replace(spec, num_frames=200), horizon_factors=(5.0,), num_rest_steps=20)
    settled = horizon.settle(own)
    assert isinstance(settled, State) and not settled.vel.any()
    solver = horizon.drift(own, spec.label_solver, settled)
    assert 0 < solver.farthest < 20 * horizon.AT_REST and solver.stop is None
    outcome = horizon.rest(own)
    assert outcome.passed is False and outcome.measured.endswith(f"solver: {solver.text}")  # an untrained model lets the pile fall


def test_a_body_that_swings_is_not_at_rest_where_it_turns(
    spec: DatasetSpec, scenes: list[Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = replace(subject(spec, scenes, **SHIPPED), spec=replace(spec, num_frames=80), horizon_factors=(5.0,))
    start = scenes[0].state(5, 0)

    def swings(amplitude: float) -> Any:
        def steps(_: object, __: object, num_steps: int) -> Iterator[State]:
            unit = own.spacing / own.dt
            for frame in range(num_steps):
                yield replace(start, vel=np.full_like(start.vel, unit * amplitude * abs(np.sin(0.3 * frame)) / start.dim**0.5))

        return steps

    monkeypatch.setattr(horizon, "steps", swings(0.05))
    assert "do not come to rest: at best 0.05 spacings per frame over 50 frames" in str(horizon.settle(own))
    monkeypatch.setattr(horizon, "steps", swings(0.005))
    assert isinstance(horizon.settle(own), State)


@pytest.mark.slow
def test_verdicts_are_stored_beside_the_checkpoint_and_completed(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator, checkpoint = subject(spec, scenes, **SHIPPED).simulator, tmp_path / "own.ckpt"
    simulator.save(checkpoint)
    outcomes: dict[int, bool | None] = {1: True, 2: False, 5: None}
    monkeypatch.setattr(suite, "_outcome", lambda stress_test, _: Outcome(outcomes.get(stress_test.number, True), "4 spacings"))

    def stored(*tests: int, **length: Any) -> str:
        settings = Settings({"sand": Case([])}, [], [str(checkpoint)], SHIPPED, 1, [1.0], 5, [*tests])
        run(replace(settings, **length), {"sand": spec}, tmp_path / "results")
        return headline(checkpoint).partition(". ")[2]

    assert stored(1, 5) == "Passes 1 of 1 stress tests"
    assert stored() == "Fails 1 of 28 stress tests: 2 edge orientation"  # 21 and 22 were shortened
    assert stored(21, 22, horizon_factors=[10.0], num_rest_steps=1000) == "Fails 1 of 30 stress tests: 2 edge orientation"
    outcomes |= {21: False, 22: False}
    assert stored(21, 22) == "Fails 1 of 30 stress tests: 2 edge orientation"  # a shorter test changes nothing
    outcomes |= {2: None, 12: False}
    assert stored(2, 5, 12) == "Fails 1 of 29 stress tests: 12 coincident particles"
    simulator.acceleration_std.fill_(2.0)
    simulator.save(checkpoint)
    assert stored(1) == "Passes 1 of 1 stress tests"  # another checkpoint keeps nothing


@pytest.mark.slow
def test_failures_of_gating_models_fail_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = [
        {"domain": "sand", "model": f"{status} {gating}", "test": "3 x", "status": status, "gating": gating}
        for status in ("passed", "failed", "not_applicable")
        for gating in (True, False)
    ]
    assert suite.failures(records) == ["sand, failed True: 3 x"]
    monkeypatch.setattr(suite, "run", lambda *_: (records, "the table"))
    monkeypatch.setattr(suite, "figures", lambda _: {})
    command = compose("benchmark", "suite=stability", f"paths.runs={tmp_path}")
    with pytest.raises(SystemExit, match="error: 1 failed: sand, failed True: 3 x"):
        benchmark(command)
    assert (tmp_path / "benchmark" / "stability" / "table.md").read_text() == "the table\n"  # in any case
    del records[2]
    benchmark(command)


def test_what_gates_is_the_shipped_configuration(spec: DatasetSpec, scenes: list[Trajectory]) -> None:
    assert is_gating(subject(spec, scenes, **SHIPPED).simulator, SHIPPED)
    assert not is_gating(subject(spec, scenes).simulator, SHIPPED)
    assert not is_gating(subject(spec, scenes, **SHIPPED).simulator, {})
    assert model_label(subject(spec, scenes, **SHIPPED).simulator) == "GPE 2 × 8 geometry angular"


@pytest.mark.slow
def test_runs_of_one_model_are_told_apart_by_their_training(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def made(name: str, model: Subject, **training: Any) -> Run:
        model.simulator.save(tmp_path / name / "checkpoints" / "best.ckpt")
        config = {"data.name": spec.name, "size.name": spec.size, "seed": len(name), "training.num_steps": len(name)}
        return Run(tmp_path / name, config | {f"training.{key}": value for key, value in training.items()}, table_of([]))

    plain, tuned = subject(spec, scenes), subject(spec, scenes, **SHIPPED)
    runs = [
        made("a", plain, velocity_noise_of_change=0.3),
        made("bb", tuned, velocity_noise_of_change=0.3),
        made("ccc", tuned, velocity_noise_of_change=0.0),
        made("dddd", tuned, velocity_noise_of_change=0.0),
    ]
    found = trained_on(spec, runs)
    assert {label: run.folder.name for label, (_, run) in found.items()} == {
        "GPE 2 × 8": "a",
        "GPE 2 × 8 geometry angular, velocity_noise_of_change=0.3": "bb",
        "GPE 2 × 8 geometry angular, velocity_noise_of_change=0.0": "ccc",
    }
    assert (
        f"{tmp_path / 'dddd'}: left out, because its label is that of {tmp_path / 'ccc'}; they differ in training.num_steps" in caplog.text
    )
    caplog.clear()
    trained_on(spec, [runs[0], replace(runs[0], config={**runs[0].config, "seed": 7})])
    assert not caplog.text  # another seed is expected


def test_two_checkpoints_of_one_name_are_an_error(spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path) -> None:
    files = [tmp_path / name / "model.ckpt" for name in "ab"]
    for file in files:
        file.parent.mkdir()
        subject(spec, scenes).simulator.save(file)
    settings = Settings({"sand": Case([])}, [], [str(f) for f in files], SHIPPED, 1, [1.0], 5, [19])
    with pytest.raises(NothingToTestError, match="two models of sand are called model"):
        run(settings, {"sand": spec}, tmp_path / "results")


def test_a_checkpoint_that_fits_no_data_set_is_named(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    subject(spec, scenes, **SHIPPED).simulator.save(tmp_path / "own.ckpt")
    monkeypatch.setattr(suite, "_outcome", lambda *_: Outcome(True, "as it should be"))
    settings = Settings({"sand": Case([])}, [], [str(tmp_path / "own.ckpt"), "snow"], SHIPPED, 1, [1.0], 5, [1])
    _, table = run(settings, {"sand": spec}, tmp_path / "results")
    assert "Checkpoints that were not tested, because they were trained on none of these data sets: snow." in table
    assert "snow: not tested" in caplog.text


def test_a_run_that_finishes_during_the_suite_takes_no_part(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The suite runs for minutes, and trainings may go on beside it. Their checkpoints must not stop it at its end."""
    subject(spec, scenes, **SHIPPED).simulator.save(tmp_path / "own.ckpt")
    settings = Settings({"sand": Case([])}, [str(tmp_path / "runs")], [str(tmp_path / "own.ckpt")], SHIPPED, 1, [1.0], 5, [1])
    late: list[Run] = []
    monkeypatch.setattr(suite, "runs_in", lambda _: list(late))

    def finishing(*_: object) -> Outcome:
        file = tmp_path / "late" / "checkpoints" / "best.ckpt"
        file.parent.mkdir(parents=True)
        file.write_bytes(b"a checkpoint of another version")
        late.append(Run(tmp_path / "late", {"data.name": spec.name, "size.name": spec.size}, table_of([])))
        return Outcome(True, "as it should be")

    monkeypatch.setattr(suite, "_outcome", finishing)
    records, _ = run(settings, {"sand": spec}, tmp_path / "results")
    assert [r["model"] for r in records] == ["own"]
    with pytest.raises(CheckpointError, match="late/checkpoints/best.ckpt: "):
        run(settings, {"sand": spec}, tmp_path / "results")
    assert len(late) == 1


def test_a_checkpoint_that_is_replaced_during_the_suite_gets_no_verdict(
    spec: DatasetSpec, scenes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator, checkpoint = subject(spec, scenes, **SHIPPED).simulator, tmp_path / "own.ckpt"
    simulator.save(checkpoint)
    settings = Settings({"sand": Case([])}, [], [str(checkpoint)], SHIPPED, 1, [1.0], 5, [1])
    looked_up = suite._checkpoints

    def replacing(*args: Any) -> Any:
        found = looked_up(*args)
        simulator.acceleration_std.fill_(2.0)
        simulator.save(checkpoint)
        return found

    monkeypatch.setattr(suite, "_outcome", lambda *_: Outcome(True, "as it should be"))
    monkeypatch.setattr(suite, "_checkpoints", replacing)
    with pytest.raises(ReplacedError, match=r"own.ckpt: was replaced while the suite ran"):
        run(settings, {"sand": spec}, tmp_path / "results")
    assert not [*tmp_path.glob("*.json")]
