"""Cost against error: conclusions from points on the two axes, and points of all simulators."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from gpe_pl.benchmarks import runtime_vs_error as module
from gpe_pl.benchmarks.cost_and_error import (
    Comparison,
    Family,
    Point,
    break_even,
    cost_at_error,
    error_at_cost,
    front,
    hypervolume,
    ratio_at_cost,
    speed_up,
    winners,
)
from gpe_pl.benchmarks.ladder_tables import section, summary, verdicts
from gpe_pl.benchmarks.reference_solutions import REFERENCES, ComparisonError, stored_reference
from gpe_pl.benchmarks.runtime_vs_error import Entrant, Settings, _entrants, compare, figures, points_of, run
from gpe_pl.benchmarks.solver_rungs import DATA, NODES
from gpe_pl.benchmarks.spent_before import Simulated, Spent
from gpe_pl.benchmarks.timed_rollouts import Start, distance, squared_error, timed
from gpe_pl.benchmarks.trained import Case, Labels
from gpe_pl.config.datasets import dataset, dataset_spec
from gpe_pl.data.ground_truth import generate_trajectory, initial_state, trajectory_metadata
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.reports.finished_runs import Run, table_of
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.solvers.resolution import Resolved
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import compose

OVERRIDES = ["data=sand", "size=tiny", "data.sizes.tiny.num_frames=24"]


def point(name: str, cost: float, error: float, family: Family = "solver") -> Point:
    return Point(name, family, [cost], {"full": [error]})


LADDER = [point("fine", 8.0, 1e-4), point("medium", 2.0, 1e-3), point("worse", 3.0, 5e-3), point("coarse", 0.5, 1e-2)]


def test_the_front_is_what_nothing_beats() -> None:
    assert [p.name for p in front(LADDER, "full")] == ["coarse", "medium", "fine"]
    assert [p.name for p in front([*LADDER, point("broken", 0.1, float("inf"))], "full")] == ["coarse", "medium", "fine"]


def test_equal_error_costs_what_lies_between_two_resolutions() -> None:
    assert cost_at_error(LADDER, 1e-3, "full") == pytest.approx(2.0)
    assert cost_at_error(LADDER, 10**-3.5, "full") == pytest.approx(4.0)
    assert cost_at_error(LADDER, 1.0, "full") == 0.5
    assert cost_at_error(LADDER, 1e-5, "full") == float("inf")


def test_a_model_is_faster_only_than_a_solver_of_its_error() -> None:
    assert speed_up(point("model", 1.0, 1e-3, "learned"), LADDER, "full") == pytest.approx(2.0)
    assert speed_up(point("slow", 4.0, 1e-3, "learned"), LADDER, "full") == pytest.approx(0.5)
    assert speed_up(point("exact", 9.0, 1e-5, "learned"), LADDER, "full") == float("inf")
    assert np.isnan(speed_up(point("careless", 0.1, 5e-2, "learned"), LADDER, "full"))
    assert speed_up(point("slow and careless", 1.0, 5e-2, "learned"), LADDER, "full") == pytest.approx(0.5)
    assert speed_up(point("failed", 0.1, float("inf"), "learned"), LADDER, "full") == 0.0


def test_equal_cost_buys_what_lies_between_two_resolutions() -> None:
    assert error_at_cost(LADDER, 2.0, "full") == pytest.approx(1e-3)
    assert error_at_cost(LADDER, 4.0, "full") == pytest.approx(10**-3.5)
    assert error_at_cost(LADDER, 100.0, "full") == pytest.approx(1e-4)
    assert error_at_cost(LADDER, 0.1, "full") == float("inf")


def test_the_verdict_says_who_is_below_the_curve_or_what_the_nearest_lacks() -> None:
    def verdict(*models: Point) -> str:
        (line,) = verdicts([*LADDER, *models], ["full"])
        return line

    slow, fast = point("slow", 8.0, 10**-3.5, "learned"), point("fast", 1.0, 1e-3, "learned")
    assert "**below" in verdict(slow, fast) and "fast" in verdict(slow, fast) and "slow" not in verdict(slow, fast)
    assert "Nearest is slow: it would have to be 2 times faster, or 3.2 times more accurate at its cost" in verdict(slow)
    assert "**below" in verdict(point("exact", 100.0, 1e-6, "learned"))
    careless, lost = point("careless", 0.01, 0.5, "learned"), point("lost", 1.0, float("inf"), "learned")
    assert "as the cheapest of the solvers (coarse). Nearest is careless: it would have to be 50 times more accurate" in verdict(
        careless, lost
    )


def test_errors_at_equal_time_are_compared_scene_by_scene() -> None:
    def scenes(name: str, cost: float, errors: list[float], family: Family = "solver") -> Point:
        return Point(name, family, [cost], dict.fromkeys(("20", "50"), errors))

    hard = np.array([1.0, 10.0, 100.0, 3.0, 2.0])  # scenes differ more than simulators
    solvers = [scenes("cheap", 1.0, list(4e-3 * hard)), scenes("dear", 4.0, list(1e-3 * hard))]
    better, worse = (scenes(name, 2.0, list(factor * 2e-3 * hard), "learned") for name, factor in (("better", 0.5), ("worse", 1.5)))
    ratio = ratio_at_cost(better, solvers, "20")
    assert ratio is not None and (ratio.low, ratio.estimate, ratio.high) == pytest.approx((0.5, 0.5, 0.5))
    free = ratio_at_cost(scenes("free", 0.5, list(1e-3 * hard), "learned"), solvers, "20")
    assert free is not None and free.estimate == pytest.approx(0.25), "the cheapest solver has more time, and is still worse"
    assert ratio_at_cost(scenes("careless", 0.5, list(5e-3 * hard), "learned"), solvers, "20") is None
    once = replace(better, name="once", mse={"20": better.mse["20"], "50": worse.mse["50"]})
    assert winners([*solvers, better, worse, once], ["20", "50"]) == ["better"]
    few = [replace(p, mse={h: errors[:4] for h, errors in p.mse.items()}) for p in (*solvers, better)]
    assert winners(few, ["20", "50"]) == []
    dearest = ratio_at_cost(replace(better, seconds=[100.0]), solvers, "20")
    assert dearest is not None and dearest.estimate == pytest.approx(1.0)


def test_models_that_are_cheaper_than_every_solver_have_a_verdict() -> None:
    """Whether they win, fail or are useless."""

    def case(cost: float, error: float) -> str:
        def scenes(name: str, own: float, error: float, family: Family = "solver") -> Point:
            return Point(name, family, [own], dict.fromkeys(("20", "full"), [error] * 6))

        solvers = [scenes("fine", 10.0, 1.0), scenes("medium", 2.0, 4.0), scenes("coarse", 1.0, 9.0)]
        return summary({"case": [*solvers, scenes("model", cost, error, "learned")]}).splitlines()[4]

    assert "0.00 [0.00, 0.00]" in case(0.5, 0.01) and case(0.5, 0.01).endswith("| 0, 0 | **wins** |")
    assert case(0.5, 1e4).endswith(
        "| every solver costs more | every solver costs more | –, – | cheaper and less accurate than every solver at 2 of 2 |"
    )
    assert case(0.5, float("inf")).endswith("| inf, inf | loses at 2 of 2 |")
    assert case(5.0, float("inf")).endswith("| inf, inf | loses at 2 of 2 |")
    assert case(1.0, 9.0).endswith("| 1, 1 | level |")
    assert break_even(replace(point("careless", 0.1, 1e4, "learned"), overhead=100.0), LADDER, "full", duration=1.0) == float("inf")
    (line,) = verdicts([*LADDER, replace(LADDER[1], name="copy", family="learned")], ["full"])
    assert "no learned model passes" in line


def test_training_pays_off_after_what_it_saves() -> None:
    model = point("model", 1.0, 1e-3, "learned")
    model.overhead = 600.0
    assert break_even(model, LADDER, "full", duration=2.0) == pytest.approx(300.0)
    model.seconds = [3.0]
    assert break_even(model, LADDER, "full", duration=2.0) == float("inf")
    assert break_even(replace(model, mse={"full": [1e-3, float("inf")]}, seconds=[0.1]), LADDER, "full", duration=2.0) == float("inf")
    for overhead, expected in ((60.0, 0.0), (float("nan"), float("nan"))):  # no solver is as accurate
        exact = replace(point("exact", 9.0, 1e-9, "learned"), overhead=overhead)
        assert break_even(exact, LADDER, "full", duration=2.0) == pytest.approx(expected, nan_ok=True)


def test_hypervolume_is_the_area_of_steps() -> None:
    assert hypervolume([point("a", 1.0, 1e-2)], "full", (10.0, 1.0)) == pytest.approx(2.0)
    two = [point("a", 1.0, 1e-1), point("b", 10**0.5, 1e-2)]
    assert hypervolume(two, "full", (10.0, 1.0)) == pytest.approx(1.0 + 0.5)
    assert hypervolume([point("slow", 20.0, 1e-2)], "full", (10.0, 1.0)) == 0


def untrained(stride: int = 1) -> LearnedSimulator:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    builder = GraphBuilder(GraphConfig(history=2), trajectory_metadata(spec, "test", 0).every(stride))
    torch.manual_seed(0)
    return LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder, stride)


@pytest.mark.slow
def test_every_simulator_is_timed_and_compared_with_the_reference() -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    settings = Settings({}, [], factors=[2.0], step_factors=[2], num_trajectories=1, horizons=[10, 21, 40])  # a rollout has 21 frames
    found = compare(spec, {"GPE 1 × 8": Entrant(untrained(), Spent(60.0, (Simulated(1, 150.0, 10.0),)))}, settings)
    by_name = {p.name: p for p in found.points}
    assert {DATA, "GPE 1 × 8", "ballistic", "stops at walls", "constant velocity"} < set(by_name)
    assert by_name[DATA].error("10") < by_name["solver, spacing × 2"].error("10") < by_name["constant velocity"].error("10")
    assert by_name[DATA].error("10") < by_name["solver, steps × 2"].error("10") < by_name["constant velocity"].error("10")
    assert by_name["solver, steps × 2"].error("10") < by_name["solver, spacing × 2, steps × 2"].error("10")
    assert all(p.cost > 0 and set(p.mse) == {"10", "full"} for p in found.points)
    assert by_name["GPE 1 × 8"].overhead == pytest.approx(60.0 + 10 * by_name[DATA].cost)
    assert np.isfinite(found.order) and not found.partial


@pytest.mark.slow
def test_a_model_with_longer_frames_starts_with_the_others_and_is_seen_at_all_frames() -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    models = {"every": Entrant(untrained(), Spent(0.0)), "third": Entrant(untrained(3), Spent(0.0))}  # before training they fall freely
    found = compare(spec, models, Settings({}, [], factors=[], step_factors=[], soft_factors=[], num_trajectories=1, horizons=[9]))
    by_name = {p.name: p for p in found.points}
    assert by_name["third"].error("9") == pytest.approx(by_name["every"].error("9"), rel=0.3)
    assert np.isfinite(by_name["third"].error("full")) and set(by_name["third"].mse) == {"9", "full"}


def test_models_of_finer_labels_start_where_the_solver_at_their_own_spacing_is(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES, "data.fine=2"))
    seen = []
    monkeypatch.setattr(module, "stored_reference", lambda spec, split, index, _: generate_trajectory(spec, split, index))
    monkeypatch.setattr(module, "observed_order", lambda *_: 1.0)

    def fake(simulator: Any, at: Any, data: Trajectory, kept_from: int) -> tuple[Trajectory, float]:
        seen.append((simulator, at))
        return data.frames(kept_from), 1.0 if at.from_start else 0.5

    monkeypatch.setattr(module, "timed", fake)
    settings = Settings({}, [], factors=[], step_factors=[], soft_factors=[], num_trajectories=1, horizons=[9])
    found = compare(spec, {"model": Entrant(untrained(), Spent(0.0))}, settings)
    by_name = {p.name: p for p in found.points}
    assert {DATA, NODES} < set(by_name)
    plain = generate_trajectory(replace(spec, fine=1), "test_unseen", 0, num_frames=3)
    (at,) = (at for simulator, at in seen if isinstance(simulator, Contained))
    np.testing.assert_allclose(np.asarray(at.resolved.state.pos), plain.pos[2])
    assert not np.allclose(plain.pos[2], generate_trajectory(spec, "test_unseen", 0, num_frames=3).pos[2])
    assert by_name["model"].seconds == pytest.approx([0.5 + 0.5 * 2 / 23])  # two of 23 steps are the solver's


@pytest.mark.parametrize("num_good_steps", [1, 5])
def test_a_solver_that_stops_is_infinitely_wrong_from_there_on(num_good_steps: int) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    data, start = generate_trajectory(spec, "test", 0), initial_state(spec, "test", 0)
    flight = ConstantVelocity(data.metadata.frame_dt)

    class Stopping:
        def __init__(self) -> None:
            self.num_steps = -1  # ``timed`` repeats the first step

        def step(self, state: State) -> State:
            self.num_steps += 1
            if self.num_steps > num_good_steps:
                raise SimulationError("stopped")
            return flight.step(state)

    prediction, _ = timed(Stopping(), Start(Resolved(start, lambda pos: pos), True), data, 3)
    error = squared_error(prediction, data.frames(3))
    num_good = max(1, num_good_steps + 1 - 3)  # before frame 3, the frame before the stop takes the place of the start
    assert np.isfinite(error[:num_good]).all() and np.isinf(error[num_good:]).all() and len(error) == data.num_frames - 3
    assert np.isinf(distance(prediction, data.frames(3)))


def test_longer_steps_are_as_many_frames_and_what_lies_between_is_interpolated() -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    data, start = generate_trajectory(spec, "test", 0), initial_state(spec, "test", 0)
    dt = data.metadata.frame_dt
    for every in (1, 3):
        at = Start(Resolved(start, lambda pos: pos), True, every)
        prediction, _ = timed(ConstantVelocity(every * dt), at, data, 0)
        times = dt * np.arange(data.num_frames)[:, None, None]
        assert prediction.num_frames == data.num_frames
        np.testing.assert_allclose(prediction.pos, start.pos + times * start.vel, rtol=1e-6, atol=1e-9)


def test_every_model_also_repeats_its_predictions(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = untrained()
    simulator.model = GNS(simulator.builder.spec, num_message_passing_steps=1, hidden_channels=8)
    monkeypatch.setattr(module, "trained_on", lambda *_, **__: {"GNS": (simulator, None)})
    monkeypatch.setattr(module, "spent_on", lambda *_: Spent(120.0))
    monkeypatch.setattr(module, "labels_of", lambda *_: Labels(1))
    models = _entrants([], dataset_spec(compose("simulate", *OVERRIDES)), Settings({}, [], repeats=[2, 4]))
    assert {label: (e.simulator.skips.repeat_frames, e.spent) for label, e in models.items()} == {
        "GNS": (1, Spent(120.0)),
        "GNS, repeated predictions × 2": (2, Spent(120.0)),
        "GNS, repeated predictions × 4": (4, Spent(120.0)),
    }
    weights = [*simulator.model.parameters()]
    assert all(own is shared for e in models.values() for own, shared in zip(e.simulator.model.parameters(), weights, strict=True))


def test_records_make_the_table_and_the_figure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    points = [
        *LADDER,
        point("model", 1.0, 2e-3, "learned"),
        point("slow model", 9.0, 2e-3, "learned"),
        point("exact model", 9.0, 1e-5, "learned"),
        point("careless model", 0.1, 5e-2, "learned"),
        point("ballistic", 0.01, 0.1, "trivial"),
        point("solver, spacing × 2, steps × 2", 0.4, 1.1e-2),
        point("solver, spacing × 2, moduli ÷ 4", 0.3, 1.2e-2),
    ]
    for p in points:
        p.distance = [1e-3]
    monkeypatch.setattr(module, "_entrants", lambda *_: {"model": None})
    monkeypatch.setattr(module, "compare", lambda *_: Comparison(points, 1.3))
    records, table = run(Settings({"sand": Case(OVERRIDES)}, [str(tmp_path)]), {"sand": spec}, tmp_path)
    assert "| model | **1.3** |" in table and "| slow model | 0.15 |" in table
    assert "| slow model | never |" in table
    assert {(r["simulator"], r["value"]) for r in records if r["metric"] == "break_even"} >= {("slow model", float("inf")), ("model", 0.0)}
    assert "| exact model | **more accurate" in table and "| careless model | cheaper and less accurate" in table
    assert "@full: **below the solver's curve**: model, exact model." in table
    assert "order of convergence is 1.3" in table
    assert "| model | the same, moduli of the data |" in table and "keep the elastic moduli of the data, none would" in table
    assert "| medium |" in table and "| worse |" not in table and "Of the solvers, 1 are only in `results.json`" in table
    ratio = {r["simulator"]: r["value"] for r in records if r["metric"] == "time_ratio_at_equal_error"}
    assert ratio["model"] == pytest.approx(1.3, rel=0.1) and np.isnan(ratio["careless model"])
    assert [(p.name, p.cost, p.mse) for p in points_of(records, "sand")] == [(p.name, p.cost, p.mse) for p in points]
    axes = figures(records)["cost_error_sand"].axes[0]
    labels = [
        "solver, coarser to the left",
        "solver, longer steps or softer",
        "solver, both",
        "model",
        "slow",
        "exact",
        "careless",
        "ballistic",
    ]
    assert axes.get_title() == "all frames" and [line.get_label() for line in axes.lines] == labels


def test_nothing_to_compare_says_so(tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    with pytest.raises(ComparisonError, match=": no finished run that was trained on the data set 'sand' of size 'tiny'"):
        run(Settings({"sand": Case(OVERRIDES)}, [str(tmp_path)]), {"sand": spec}, tmp_path)


@pytest.mark.slow
def test_the_suite_also_has_scenes_of_2500_nodes_at_the_spacing_of_the_small_ones() -> None:
    cases = {name: dataset(*case.overrides) for name, case in compose("benchmark", "suite=runtime_vs_error").suite.cases.items()}
    for material in ("sand", "snow"):
        small, large = cases[material], cases[f"{material}_2500"]
        assert (large.name, large.size, large.scene.spacing) == (small.name, small.size, small.scene.spacing)  # the same models take part
        assert initial_state(large, "test_unseen", 0).num_nodes == pytest.approx(2500, rel=0.02)


def test_a_stopped_comparison_continues_scene_by_scene(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    settings, entrants = Settings({}, [], num_trajectories=3), {"model": Entrant(untrained(), Spent(0.0), "teacher")}
    ran, stop_at = [], 2

    def scene(spec: Any, index: int, *_: Any) -> list[dict[str, Any]]:
        if index == stop_at:
            raise KeyboardInterrupt
        ran.append(index)
        error = None if index == 1 else 1e-3
        simulators = ((DATA, "solver"), ("model", "learned"))
        return [{"order": None if index else 1.5}] + [
            {"simulator": name, "family": family, "seconds": 1.0 + index, "mse": {"full": error}, "distance": error}
            for name, family in simulators
        ]

    monkeypatch.setattr(module, "_scene", scene)
    with pytest.raises(KeyboardInterrupt):
        compare(spec, entrants, settings, tmp_path)
    stop_at = -1
    found = compare(spec, entrants, settings, tmp_path)
    assert ran == [0, 1, 2] and found.order == 1.5
    (model,) = (p for p in found.points if p.family == "learned")
    assert (model.seconds, model.mse["full"], model.teacher) == ([1.0, 2.0, 3.0], [1e-3, float("inf"), 1e-3], "teacher")
    compare(spec, entrants, replace(settings, factors=[2.5]), tmp_path)  # other solvers: nothing of the above counts
    assert ran == [0, 1, 2, 0, 1, 2]


def test_a_solver_that_lacks_a_scene_is_left_out_of_all_comparisons(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))

    def scene(spec: Any, index: int, *_: Any) -> list[dict[str, Any]]:
        simulators = [(DATA, "solver", 4.0, 1e-4), ("model", "learned", 1.0, 1e-2), ("ballistic", "trivial", 0.1, 0.1)]
        if index:
            simulators.append(("solver, spacing × 2", "solver", 0.5, 1e-3))
        return [{"order": 1.0}] + [
            {"simulator": name, "family": family, "seconds": seconds, "mse": {"full": error}, "distance": error}
            for name, family, seconds, error in simulators
        ]

    monkeypatch.setattr(module, "_scene", scene)
    found = compare(spec, {"model": Entrant(untrained(), Spent(0.0))}, Settings({}, [], num_trajectories=3))
    assert [p.name for p in found.points] == [DATA, "model", "ballistic"] and found.partial == {"solver, spacing × 2": 2}
    assert all(len(record.get("values", "123")) == 3 for record in module._records("sand", found.points, found.order))
    assert "solver, spacing × 2 (2)" in section("sand", found, 3)


def test_a_reference_is_computed_once_for_each_scene_and_solver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES, "data.num_frames=4"))
    solved = []

    def generate(spec: Any, split: Any, index: int) -> Trajectory:
        solved.append((spec.fine, index))
        return generate_trajectory(spec, split, index)

    monkeypatch.setattr("gpe_pl.benchmarks.reference_solutions.generate_trajectory", generate)
    first, again = (stored_reference(spec, "test", 0, tmp_path / REFERENCES) for _ in range(2))
    np.testing.assert_array_equal(first.pos, again.pos)
    plain = generate_trajectory(replace(spec, fine=2), "test", 0)
    np.testing.assert_allclose(first.pos, plain.pos, atol=1e-6)
    stored_reference(spec, "test", 1, tmp_path / REFERENCES)
    stored_reference(replace(spec, solver=replace(cast(Any, spec.solver), cfl=0.25)), "test", 0, tmp_path / REFERENCES)
    stored_reference(spec, "test", 0, None)
    assert solved == [(2, 0), (2, 1), (2, 0), (2, 0)]
    with pytest.raises(ComparisonError, match="no solution at 1/8 of the spacing"):
        stored_reference(replace(spec, fine=4), "test", 0, tmp_path)


@pytest.mark.slow
def test_models_of_other_labels_of_the_same_scenes_take_part(tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", "data=snow", "size=tiny", "data.fine=2"))
    modulus = spec.solver.constants_of("snow").youngs_modulus  # type: ignore[attr-defined]

    def finished(name: str, data: str, **config: Any) -> Run:
        untrained().save(tmp_path / name / "checkpoints" / "best.ckpt")
        keys = {"data.name": data, "size.name": "tiny", "model._target_": "GPE", "training.num_steps": 1}
        return Run(tmp_path / name, keys | {f"data.{key}": value for key, value in config.items()}, table_of([]))

    runs = [
        finished("plain", "snow", fine=1),
        finished("fine", "snow_fine2", fine=2),
        finished("soft", "snow_fine2", fine=2, **{"solver.snow.youngs_modulus": modulus / 1.5}),
        finished("finer", "snow_fine4", fine=4),
        finished("other", "sand", fine=1),
    ]
    teachers = {label: e.teacher for label, e in _entrants(runs, spec, Settings({}, [], repeats=[])).items()}
    assert teachers == {
        "GPE 1 × 8": NODES,
        "GPE 1 × 8, labels: spacing ÷ 2": DATA,
        "GPE 1 × 8, labels: spacing ÷ 2 and moduli ÷ 1.5": f"{DATA}, moduli ÷ 1.5",
    }
    plain = _entrants(runs, replace(spec, name="snow", fine=1), Settings({}, [], repeats=[]))
    assert {label: e.teacher for label, e in plain.items()} == {"GPE 1 × 8": DATA}


@pytest.mark.slow
def test_a_shipped_model_takes_part_in_the_case_of_its_data() -> None:
    settings = Settings({}, [], repeats=[], checkpoints=["snow", "sand"])
    small = dataset_spec(compose("simulate", "data=snow", "size=small"))
    (label,) = _entrants([], small, settings)
    assert label.endswith(", snow") and np.isnan(_entrants([], small, settings)[label].spent.training)
    assert list(_entrants([], dataset_spec(compose("simulate", "data=snow", "size=small", "data.fine=2")), settings)) == [label]
    assert not _entrants([], dataset_spec(compose("simulate", "data=snow", "size=tiny")), settings)
    with pytest.raises(ComparisonError, match=r"two models of snow are called .*, snow; copy one of the checkpoints"):
        _entrants([], small, Settings({}, [], repeats=[], checkpoints=["snow", "snow"]))


def test_the_summary_names_the_nearest_model_and_what_it_lacks() -> None:
    scenes = np.array([1.0, 10.0, 100.0, 3.0, 2.0])

    def of(name: str, cost: float, error: float, family: Family = "solver") -> Point:
        return Point(name, family, [cost], {h: list(error * scenes) for h in ("20", "50")})

    solvers = [of("cheap", 1.0, 4e-3), of("dear", 4.0, 1e-3)]
    text = summary(
        {
            "won": [*solvers, of("good", 2.0, 1e-3, "learned"), of("bad", 2.0, 9e-3, "learned")],
            "lost": [*solvers, of("slow", 4.0, 2e-3, "learned"), of("broken", 1.0, float("inf"), "learned")],
            "failed": [*solvers, of("broken", 1.0, float("inf"), "learned")],
        }
    )
    assert "| won | good | **0.50 [0.50, 0.50]** | **0.50 [0.50, 0.50]** | 0.5, 0.5 | **wins** |" in text
    assert "| lost | slow | 2.00 [2.00, 2.00] | 2.00 [2.00, 2.00] | 2, 2 | loses at 2 of 2 |" in text
    (failed,) = (line for line in text.splitlines() if line.startswith("| failed | broken |"))
    assert failed.endswith("| inf, inf | loses at 2 of 2 |")


def test_emulator_superiority_is_against_the_solver_of_the_labels() -> None:
    scenes = [1.0, 2.0, 3.0, 4.0, 5.0]
    data, teacher = (
        Point(name, "solver", [cost], {"full": [f * s for s in scenes]}) for name, cost, f in ((DATA, 4.0, 1.0), (NODES, 1.0, 4.0))
    )
    model = Point("model", "learned", [1.0], {"full": [2 * s for s in scenes]}, teacher=NODES)
    for p in (data, teacher, model):
        p.distance = [1e-3]
    text = section("snow", Comparison([data, teacher, model], 1.0), 3)
    assert "| model | solver of its labels | **0.50 [0.50, 0.50]** |" in text
    assert "solver of its labels): model (@full): the interval lies below 1." in text
    model.teacher = DATA
    assert "solver of its labels): no model is, at any horizon." in section("snow", Comparison([data, teacher, model], 1.0), 3)
    for p in (data, teacher, model):
        p.mse = {"full": p.mse["full"][:3]}
    model.teacher = NODES
    text = section("snow", Comparison([data, teacher, model], 1.0), 3)
    assert "| model | solver of its labels | 0.50 [0.50, 0.50] |" in text
    assert "solver of its labels): fewer than 5 scenes are too few to say." in text


def test_a_scene_that_is_too_short_for_a_model_is_refused() -> None:
    spec = dataset_spec(compose("simulate", *OVERRIDES))
    with pytest.raises(ComparisonError, match="sand: long needs 24 frames before its first step, and scenes have 24; leave"):
        compare(spec, {"short": Entrant(untrained(), Spent(0.0)), "long": Entrant(untrained(12), Spent(0.0))}, Settings({}, []))
