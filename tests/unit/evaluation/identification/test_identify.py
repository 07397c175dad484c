"""Unknowns of a scene are found from its motion, also if parts of it are missing; intervals cover, and gradients are right or refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from gpe_pl.config.entry_point import ConfigError
from gpe_pl.evaluation import rollout_scores as rollout_scores_module
from gpe_pl.evaluation.identification.answer import Answer, AnswerError, known_of, read_answers, side_by_side
from gpe_pl.evaluation.identification.calibration import FewScenesError, Known, calibrated, cross_calibrated
from gpe_pl.evaluation.identification.gradient_check import GradientCheck, gradient_check
from gpe_pl.evaluation.identification.observations import ObservationError, Observations, ObservationSettings
from gpe_pl.evaluation.identification.pictures import misfit_figure
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.evaluation.identification.results import MotionError, Task, write_table
from gpe_pl.evaluation.identification.scene import SolverError, identify_parameters, solver_of
from gpe_pl.evaluation.identification.search import SearchSettings
from gpe_pl.evaluation.identification.shooting import FLOOR, Shooting, ShootingError, ShootingSettings, shooting
from gpe_pl.evaluation.identification.unknowns import Unknown, UnknownError, unknowns_of
from gpe_pl.evaluation.rollout_scores import rollout_scores
from gpe_pl.files import sealed
from gpe_pl.identify import Settings, _calibrations, _identity, identify_all
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.conformal import interval_score
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import SimulationError, rollout
from gpe_pl.scenes.scene import Scene
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes
from tests.drag import ANGLE, BOUNDS, DT, FLUID_BOUNDS, Drag, thrown
from tests.runs import compose
from tests.unit.training.test_unroll_gradients import Double, simulator_of, slow, unroll


def test_a_parameter_is_found_whatever_is_stored() -> None:
    seen = thrown()
    hidden = replace(seen, material_params=np.full_like(seen.material_params, 25.0))
    answer = identify_parameters(Drag(), hidden, bounds=BOUNDS)
    assert answer["sand.friction_angle"].estimate == pytest.approx(ANGLE, abs=0.1)
    assert answer["sand.friction_angle"].truth == 25.0
    assert answer.num_windows == 2
    assert answer.method == "derivative_free"
    assert "friction angle of sand 31" in str(answer)


def test_logarithmic_parameters_are_found() -> None:
    simulator = Drag(rate=20.0)
    answer = identify_parameters(simulator, thrown(0.03, "fluid", simulator), bounds=FLUID_BOUNDS)
    assert answer.values[0].estimate == pytest.approx(0.03, rel=0.02)


@pytest.mark.parametrize("high", [0.02, 0.2, 20.0])
def test_tick_labels_of_misfits_do_not_overlap(high: float) -> None:
    bounds = {"fluid.kinematic_viscosity": (0.003, high)}
    figure = misfit_figure({"solver": identify_parameters(Drag(rate=20.0), thrown(0.03, "fluid"), bounds=bounds)})
    figure.draw_without_rendering()
    labels = sorted((tick.label1 for tick in figure.axes[0].xaxis._update_ticks()), key=lambda label: label.get_position()[0])
    boxes = [label.get_window_extent() for label in labels if label.get_text()]
    assert len(boxes) >= 2
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


@pytest.mark.slow
def test_bodies_have_values_of_their_own() -> None:
    values = np.repeat([24.0, 38.0], 9)
    answer = identify_parameters(Drag(), thrown(values), per_body=True, bounds=BOUNDS, search_settings=SearchSettings(max_evaluations=100))
    assert [value.estimate for value in answer.values] == pytest.approx([24.0, 38.0], abs=0.5)
    assert [value.truth for value in answer.values] == [24.0, 38.0]


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [["sand", "velocity"], ["sand", "gravity"]])
def test_motion_of_the_scene_is_found_too(wanted: list[str]) -> None:
    settings = SearchSettings(max_evaluations=150)
    seen = thrown()
    if "gravity" in wanted:
        down = np.array([math.tan(math.radians(10.0)), -1.0])
        tilted = replace(seen.metadata, gravity=tuple(9.81 * down / np.linalg.norm(down)))
        moved = rollout(Drag(), replace(seen.state(0), gravity=np.array(tilted.gravity)), 39, tilted)
        answer = identify_parameters(Drag(), replace(moved, metadata=seen.metadata), wanted, bounds=BOUNDS, search_settings=settings)
        assert answer["gravity.x"].estimate == pytest.approx(10.0, abs=1.0)
    else:
        answer = identify_parameters(Drag(), seen, wanted, bounds=BOUNDS, search_settings=settings)
        assert [answer[f"velocity.{axis}"].estimate for axis in "xy"] == pytest.approx([1.0, 0.5], abs=0.05)
        assert answer.num_windows == 1
    assert answer["sand.friction_angle"].estimate == pytest.approx(ANGLE, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sand", "snow"])
def test_the_initial_velocity_of_a_body_in_flight_is_that_at_the_start(name: str) -> None:
    """Models read mean velocities of frames before the start, which differ from the sought one by half of what gravity changes in a frame."""
    model = LearnedSimulator.from_checkpoint(name)
    state, metadata = Scene(box=(1.0, 1.0)).block(name, at=(0.4, 0.6), size=(0.15, 0.15), velocity=(0.3, -0.7)).state(model)
    seen = rollout(model, model.standing(state, metadata), 15, metadata)
    sought = unknowns_of(seen, ["velocity"], {})
    own = shooting(model, Observations.of(seen), sought, ShootingSettings(single_frames=15))

    def misfit(vertical: float) -> float:
        return own.misfit([(u.coordinate(v) - u.coordinate(u.low)) / u.range for u, v in zip(sought.items, (0.3, vertical), strict=True)])

    assert misfit(-0.7) < math.log(1.1 * FLOOR)
    assert misfit(-0.7) < min(misfit(-0.69), misfit(-0.71)) - 1
    _, gradient = own.misfit_and_gradient([0.5, 0.5])
    assert (gradient != 0).all()


def test_a_search_that_was_cut_short_says_so() -> None:
    few = SearchSettings(num_scanned=3, max_evaluations=2)
    answer = identify_parameters(Drag(), thrown(), bounds=BOUNDS, search_settings=few)
    assert answer.is_unfinished and "stopped at search.max_evaluations" in str(answer)
    assert not identify_parameters(Drag(), thrown(), bounds=BOUNDS).is_unfinished


def test_an_answer_at_a_bound_says_so() -> None:
    answer = identify_parameters(Drag(), thrown(45.0), bounds=BOUNDS)
    assert answer.values[0].at_bound == "upper"
    assert "model at the upper bound" not in side_by_side({"solver": answer})[0]
    assert "solver at the upper bound" in side_by_side({"solver": answer})[0]


def test_rollouts_that_fail_do_not_win() -> None:
    @dataclass(frozen=True)
    class Fails(Drag):
        def step(self, state: State) -> State:
            if state.material_params[0, 0] < 30:
                raise SimulationError("too soft")
            return super().step(state)

    assert identify_parameters(Fails(), thrown(32.0), bounds=BOUNDS).values[0].estimate == pytest.approx(32.0, abs=0.2)


@pytest.mark.parametrize(
    ("wanted", "bounds", "message"),
    [
        (["sand", "sand.friction_angle"], BOUNDS, r"unknowns: sand\.friction_angle is named twice"),
        (["velocity.x"], BOUNDS, r"unknowns: 'velocity\.x': velocity has no parts; write velocity"),
        (None, {"sand.friction": (10.0, 50.0)}, r"bounds: 'sand\.friction' is no MATERIAL\.PARAMETER; did you mean 'sand\.friction_angle'"),
        (
            None,
            {**BOUNDS, **FLUID_BOUNDS},
            r"bounds: fluid\.kinematic_viscosity is no unknown of these scenes, which have sand\.friction_angle",
        ),
        (None, {"sand.friction_angle": (50.0, 10.0)}, r"bounds of sand\.friction_angle: \[50, 10\]: the first must be below the second"),
        (None, {"sand.friction_angle": (-50.0, 10.0)}, r"bounds of sand\.friction_angle: \[-50, 10\]: must be finite and not negative"),
    ],
)
def test_unknowns_and_bounds_without_meaning_are_refused(
    wanted: list[str] | None, bounds: dict[str, tuple[float, float]], message: str
) -> None:
    with pytest.raises(UnknownError, match=message):
        identify_parameters(Drag(), thrown(), wanted, bounds=bounds)


def test_a_logarithmic_parameter_needs_positive_bounds() -> None:
    with pytest.raises(UnknownError, match=r"\[0, 0\.5\]: must be positive and finite"):
        identify_parameters(Drag(), thrown(0.03, "fluid"), bounds={"fluid.kinematic_viscosity": (0.0, 0.5)})


def test_a_scene_in_which_every_rollout_fails_has_no_answer() -> None:
    @dataclass(frozen=True)
    class Fails(Drag):
        def step(self, state: State) -> State:
            raise SimulationError("failed")

    with pytest.raises(ShootingError, match="first: every rollout failed, with all"):
        identify_parameters(Fails(), thrown(), bounds=BOUNDS, scene="first")


def test_an_answer_that_does_not_fit_says_so() -> None:
    seen = thrown()
    answer = identify_parameters(Drag(), replace(seen, pos=10 * seen.pos), bounds=BOUNDS)
    assert "solver does not fit: its rollouts are" in str(answer)
    assert any("solver does not fit" in line for line in side_by_side({"solver": answer}))
    assert not identify_parameters(Drag(), seen, bounds=BOUNDS).warning


@dataclass(frozen=True)
class Recorded(Drag):
    """A solver, which knows its frames."""

    name: ClassVar[str] = "drag"
    version: ClassVar[str] = "1"
    frame_dt: float = DT
    materials: tuple[str, ...] = ("sand",)


def test_a_solver_with_other_frames_than_the_motion_is_refused() -> None:
    seen = thrown()
    assert identify_parameters(Recorded(), seen, bounds=BOUNDS)["sand.friction_angle"].estimate == pytest.approx(ANGLE, abs=0.1)
    with pytest.raises(ShootingError, match=r"the solver drag has frame_dt = 0.01 s, the scene 0.02 s"):
        identify_parameters(Recorded(), seen.every(2), bounds=BOUNDS)


def test_refusals() -> None:
    seen = thrown()
    with pytest.raises(UnknownError, match=r"'snow' is no material of the scene; it has sand"):
        identify_parameters(Drag(), seen, ["snow"], bounds=BOUNDS)
    with pytest.raises(UnknownError, match=r"no stored parameter 'cohesion'; it has friction_angle"):
        identify_parameters(Drag(), seen, "sand.cohesion", bounds=BOUNDS)
    with pytest.raises(UnknownError, match=r"give one with bounds='\{sand\.friction_angle:\[LOW,HIGH\]\}'"):
        identify_parameters(Drag(), seen)
    lost = seen.pos.copy()
    lost[4, 2] = np.nan
    with pytest.raises(ObservationError, match="frame 4, node 2: is marked as seen, and its position is not a number"):
        Observations(replace(seen, pos=lost), np.ones(seen.pos.shape[:2], dtype=bool))
    with pytest.raises(ObservationError, match="fewer than 2 frames"):
        Observations(seen, np.zeros(seen.pos.shape[:2], dtype=bool))
    with pytest.raises(ShootingError, match="needs the start; choose simulator=model"):
        identify_parameters(Drag(can_restart=False), replace(seen, start_time=1.0), bounds=BOUNDS)
    with pytest.raises(ShootingError, match="solvers have no gradients"):
        shooting(Drag(), Observations.of(seen), unknowns_of(seen, None, BOUNDS)).misfit_and_gradient([0.5])
    with pytest.raises(SolverError, match="not from one that comes with the package"):
        solver_of(seen.metadata)


# --- gradients -----------------------------------------------------------------------------------------------------------------------------


def learned(num_frames: int = 9) -> tuple[LearnedSimulator, Trajectory]:
    """Return a small network in double precision, and one of its own rollouts."""
    builder = scenes.builder(("sand",))
    builder = Double(builder.config, builder.metadata)
    state = slow(scenes.state(materials=("sand",)).to_torch())
    simulator = simulator_of(GPE, builder, [unroll(builder, state, 1).graph], hidden_channels=8, num_message_passing_steps=1)
    made = rollout(simulator, state, num_frames - 1, builder.metadata)
    return simulator, replace(made, is_prediction=False)


def gradients_of(simulator: LearnedSimulator, seen: Trajectory) -> Shooting:
    unknowns = unknowns_of(seen, None, {"sand.friction_angle": (1.0, 60.0)})
    return shooting(simulator, Observations.of(seen), unknowns, ShootingSettings(horizon=2, num_windows=2))


@pytest.mark.parametrize("averages", [False, True])
def test_gradients_agree_with_finite_differences(averages: bool) -> None:
    simulator, seen = learned()
    shots = gradients_of(simulator.configured(mirror_average=averages), seen)
    z, step = 0.7, 1e-4
    value, gradient = shots.misfit_and_gradient([z])
    difference = (shots.misfit([z + step]) - shots.misfit([z - step])) / (2 * step)
    assert value == pytest.approx(shots.misfit([z]), rel=1e-9)
    assert abs(difference) > 1e-6
    assert gradient == pytest.approx([difference], rel=1e-2)


def test_bounds_of_training_do_not_clamp() -> None:
    simulator, seen = learned()
    simulator.get_buffer("trained_sand").copy_(torch.tensor([[30.0], [31.0]]))
    assert gradients_of(simulator, seen).misfit_and_gradient([0.9])[1][0] != 0


def squares(_: int, frame: int, state: Any) -> Any:
    """Return a score of every frame but the second."""
    return None if frame == 2 else (1e3 * state.pos**2).sum()


def leaves_and_start(simulator: LearnedSimulator, seen: Trajectory) -> tuple[list[torch.Tensor], State]:
    """Return tensors with gradients, and a state that depends on them: its material parameters and its walls."""
    start = simulator.initial_state(seen, 5)
    leaves = [start.material_params.clone().requires_grad_(), start.boundary.pos.clone().requires_grad_()]
    return leaves, replace(start, material_params=1 * leaves[0], boundary=replace(start.boundary, pos=1 * leaves[1]))


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [1, 5, 9])
def test_scores_have_the_gradients_of_plain_rollouts(num_steps: int) -> None:
    """Also those of walls, which a step leaves as they are, with frames that have no score, and in several segments."""
    simulator, seen = learned()
    leaves, start = leaves_and_start(simulator, seen)
    states: list[Any] = [start]
    plain = dict[tuple[int, int], torch.Tensor]()
    for frame in range(1, num_steps + 1):
        states = simulator.next_states(states)
        if frame != 2:
            plain[0, frame] = squares(0, frame, states[0])
    found = rollout_scores(simulator, {0: start}, num_steps, squares)
    assert found.keys() == plain.keys()
    totals = [torch.stack([scores[0, frame] * frame for _, frame in plain]).sum() for scores in (found, plain)]
    own, expected = (torch.autograd.grad(total, leaves, retain_graph=True) for total in totals)
    for one, other in zip(own, expected, strict=True):
        assert torch.isfinite(other).all() and other.abs().max() > 0
        assert torch.allclose(one, other, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_scenes_of_a_batch_keep_their_gradients_where_one_fails() -> None:
    simulator, seen = learned()
    leaves, start = leaves_and_start(simulator, seen)
    failing = replace(start, pos=start.pos * torch.nan)
    alone = rollout_scores(simulator, {3: start}, 4, squares)
    together = rollout_scores(simulator, {1: failing, 3: start}, 4, squares)
    assert together.keys() == alone.keys()
    for key in alone:
        (own,), (expected,) = (torch.autograd.grad(scores[key], leaves[:1], retain_graph=True) for scores in (together, alone))
        assert torch.allclose(own, expected, rtol=1e-6, atol=1e-12)


def test_only_scores_are_kept_for_gradients_and_states_of_few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator, seen = learned()
    _, start = leaves_and_start(simulator, seen)
    runs = list[rollout_scores_module._Run]()
    forward = rollout_scores_module._Run.forward

    def noted(run: rollout_scores_module._Run) -> torch.Tensor:
        runs.append(run)
        return forward(run)

    monkeypatch.setattr(rollout_scores_module._Run, "forward", noted)
    sizes: list[int] = []

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        sizes.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        rollout_scores(simulator, {0: start}, 9, squares)
        assert not sizes
        simulator.next_states([start])
    assert sum(sizes) > 1000
    assert [*runs[0].stored] == [0, 3, 6]


@pytest.mark.slow
def test_a_search_without_trusted_gradients_goes_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator, seen = learned()
    trusted = gradient_check(gradients_of(simulator, seen), [0.7])
    settings = {"shooting_settings": ShootingSettings(horizon=2, num_windows=2), "bounds": {"sand.friction_angle": (1.0, 60.0)}}
    search = SearchSettings(method="gradient", num_scanned=3, max_evaluations=6)
    answer = identify_parameters(simulator, seen, search_settings=search, **settings)  # type: ignore[arg-type]
    assert (answer.method == "gradient") == ("are trusted" in answer.gradients)
    assert trusted.is_trusted
    monkeypatch.setattr(GradientCheck, "is_trusted", False)
    answer = identify_parameters(simulator, seen, search_settings=search, **settings)  # type: ignore[arg-type]
    assert answer.method == "derivative_free"
    assert "derivative-free search takes their place" in answer.gradients


# --- calibration ---------------------------------------------------------------------------------------------------------------------------


NUMBERS = count()


def scene(truth: float, certainty: float, error: float) -> Known:
    """Return an answer whose misfit is a parabola."""
    at = np.linspace(0, 60, 241)
    return Known(
        truth + error, truth, Profile.of(zip(at, certainty * (at - truth - error) ** 2, strict=True), (0.0, 60.0)), f"scene {next(NUMBERS)}"
    )


def uneven(number: int, seed: int) -> list[Known]:
    """Return scenes that say much about the unknown, and others that say little."""
    rng = np.random.default_rng(seed)
    spread = rng.choice([0.2, 2.0], number)
    return [scene(*own) for own in zip(rng.uniform(20, 40, number), spread**-2, spread * rng.normal(size=number), strict=True)]


def test_a_profile_is_the_lower_hull_of_all_misfits() -> None:
    tried = [(3.0, 1.0), (1.0, -1.0), (2.0, -2.0), (2.0, 5.0), (4.0, 8.0), (2.5, 3.0)]
    found = Profile.of(tried, (0.0, 4.0))
    assert found.at.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert found.excess.tolist() == [2.0, 1.0, 0.0, 3.0, 10.0]  # beyond 1 the first piece goes on
    assert found.within(1.5) == pytest.approx((0.5, 2.5))
    assert found.within(math.inf) == (0.0, 4.0)
    assert found.above(1.5) == 0.5
    assert found.above(4.1) == math.inf


def test_a_profile_without_values_near_a_bound_reaches_it() -> None:
    found = Profile.of([(2.0, 1.0), (3.0, 4.0)], (0.0, 3.5))
    assert found.within(0.1)[0] == 0.0
    assert found.above(3.5) == 4.5
    assert Profile.of([(2.0, 1.0)], (0.0, 3.0)).within(0.1) == (0.0, 3.0)


@pytest.mark.slow
def test_calibrated_intervals_cover_and_follow_the_misfit() -> None:
    known, new = uneven(200, 0), uneven(1000, 1)
    found, truth = calibrated(known), np.array([own.truth for own in new])
    _, low, high = np.array([found.interval(own.estimate, own.profile) for own in new]).T
    assert 0.86 < np.mean((low <= truth) & (truth <= high)) < 0.94
    halves = np.arange(200) % 2
    scores, stored = [], [own.truth for own in known]
    for adapts in (True, False):
        _, low, high = cross_calibrated(known, halves, 0.9, adapts).T
        scores.append(interval_score(low, high, stored, 0.9).mean())
    assert scores[0] < 0.9 * scores[1]
    with pytest.raises(FewScenesError, match="8 calibration scenes; .* at least 9"):
        calibrated(uneven(8, 0))


def test_calibration_corrects_answers_that_are_too_low() -> None:
    rng = np.random.default_rng(0)
    answers = [scene(own, 1.0, error) for own, error in zip(rng.uniform(20, 40, 40), 0.3 * rng.normal(size=40), strict=True)]
    low = [replace(own, truth=1.25 * own.truth + 3) for own in answers]
    found = calibrated(low)
    assert (found.offset, found.slope) == pytest.approx((3.0, 1.25), abs=0.8)
    errors = [found.interval(own.estimate, own.profile)[0] - own.truth for own in low]
    assert abs(np.median(errors)) < 0.1
    assert found.threshold == pytest.approx(calibrated(answers).threshold, rel=0.3)


def test_answers_at_a_bound_do_not_spoil_the_correction_of_others() -> None:
    rng = np.random.default_rng(0)
    right = [scene(own, 1.0, error) for own, error in zip(rng.uniform(20, 40, 40), 0.3 * rng.normal(size=40), strict=True)]
    at_bound = [replace(scene(20.0, 1.0, 0.0), truth=40.0) for _ in range(12)]
    assert calibrated(right + at_bound).slope == pytest.approx(calibrated(right).slope, abs=0.05)


def test_answers_that_fall_where_true_values_rise_are_not_corrected() -> None:
    found = calibrated([scene(20.0 + k, 1.0, -2.0 * k) for k in range(10)])
    assert (found.offset, found.slope) == (0.0, 1.0)


def test_bodies_of_a_scene_count_as_one_scene() -> None:
    known = [replace(own, scene=str(k // 2)) for k, own in enumerate(uneven(16, 0))]
    with pytest.raises(FewScenesError, match="8 calibration scenes"):
        calibrated(known)
    twice = uneven(20, 0)
    single, double = calibrated(twice), calibrated([*twice, *twice])
    assert single.num_scenes == double.num_scenes
    assert single.threshold == pytest.approx(double.threshold)


def test_intervals_do_not_depend_on_the_truth_of_their_own_part() -> None:
    known = uneven(40, 0)
    changed = [replace(own, truth=own.truth + 5) if k % 2 else own for k, own in enumerate(known)]
    before, after = (cross_calibrated(own, np.arange(40) % 2) for own in (known, changed))
    assert (before[1::2] == after[1::2]).all()
    assert (before[::2] != after[::2]).any()


def test_intervals_have_no_ends_if_true_values_lie_beyond_the_bounds() -> None:
    known = [scene(20.0 + k, 1.0, 0.0) for k in range(15)] + [replace(scene(60.0, 1.0, 0.0), truth=70.0) for _ in range(5)]
    found = calibrated(known)
    assert found.threshold == math.inf
    assert found.interval(known[0].estimate, known[0].profile)[1:] == (-math.inf, math.inf)


def test_corrections_stay_within_what_is_possible() -> None:
    ratio = Unknown("solid.poisson_ratio#2", "", "1", 0.1, 0.45, False, "parameter", 1, np.zeros(0, np.int64))
    assert [ratio.possible(value) for value in (-math.inf, 0.3, 0.517)] == [0.0, 0.3, 0.49]
    assert replace(ratio, high=0.5).possible(0.517) == 0.5  # the user's own bounds are wider
    assert replace(ratio, name="velocity.x", kind="velocity").possible(-9.0) == -9.0


def test_answers_are_read_as_they_were_written(tmp_path: Path) -> None:
    answer: Answer = identify_parameters(Drag(), thrown(), bounds=BOUNDS, scene="first")
    answer.write(tmp_path)
    assert read_answers(tmp_path, "solver") == [answer]
    older = sealed.read(path := tmp_path / "scenes" / "first_solver.json", "")
    del older["is_unfinished"]
    sealed.write(path, older)
    assert read_answers(tmp_path, "solver") == [answer]
    known = known_of([answer, answer])["sand.friction_angle"]
    assert [own.truth for own in known] == [ANGLE, ANGLE]
    assert known[0].estimate == answer.values[0].raw
    assert known[0].profile.within(0.2) == pytest.approx((answer.values[0].low, answer.values[0].high))


def test_an_answer_of_another_version_is_refused(tmp_path: Path) -> None:
    identify_parameters(Drag(), thrown(), bounds=BOUNDS, scene="first").write(tmp_path)
    path = tmp_path / "scenes" / "first_solver.json"
    found = sealed.read(path, "")
    found["values"][0]["scale"] = 1.0
    sealed.write(path, found)
    with pytest.raises(AnswerError, match=r"first_solver\.json: is an answer of another version; delete the file"):
        read_answers(tmp_path, "solver")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("there", "name"),
    [({"unknowns": ["sand", "velocity"]}, "unknowns"), ({"bounds": {"sand.friction_angle": [10.0, 50.0]}}, "bounds"), ({"checkpoint": "x"}, "checkpoint")],
)  # fmt: skip
def test_a_calibration_of_another_search_is_refused(tmp_path: Path, there: dict[str, Any], name: str) -> None:
    """Its threshold and line hold for its own unknowns, bounds and model only, also for answers of the solver."""
    cfg = compose("identify", "checkpoint=sand", "trajectory=scenes", "simulator=solver", f"calibration={tmp_path}")
    settings = Settings("sand", "scenes", simulator="solver", calibration=str(tmp_path))
    for k in range(9):
        answer = identify_parameters(Drag(), thrown(25.0 + k), bounds=BOUNDS, scene=f"scene{k}")
        answer.write(tmp_path)
    sealed.write(tmp_path / "config.json", _identity(cfg))
    found, known = _calibrations(cfg, settings)
    assert found.keys() == {"solver"} and len(known) == 9
    identify_parameters(Drag(), thrown(40.0), bounds=BOUNDS, scene="scene9").write(tmp_path)
    assert _identity(cfg, _calibrations(cfg, settings)[1]) != _identity(cfg, known)  # more scenes there, so other intervals
    sealed.write(tmp_path / "config.json", {**_identity(cfg), **there})
    with pytest.raises(ConfigError, match=f"was made with other settings .{name}: "):
        _calibrations(cfg, settings)


@pytest.mark.parametrize(("simulator", "advice"), [("solver", "known values$"), ("both", "known values, or choose simulator=solver$")])
def test_a_calibration_without_stored_values_is_refused(tmp_path: Path, simulator: Any, advice: str) -> None:
    cfg = compose("identify", "checkpoint=sand", "trajectory=scenes", f"simulator={simulator}", f"calibration={tmp_path}")
    identify_parameters(Drag(), thrown(np.repeat([24.0, 38.0], 9)), bounds=BOUNDS, scene="two_bodies").write(tmp_path)
    sealed.write(tmp_path / "config.json", _identity(cfg))
    number, kind = (1, "solver") if simulator == "solver" else (0, "model")
    with pytest.raises(ConfigError, match=rf"simulator={kind}: none of {number} .* intervals of 95 % need at least 19 that do: .*{advice}"):
        _calibrations(cfg, Settings("sand", "scenes", simulator=simulator, calibration=str(tmp_path), level=0.95))


def test_a_true_value_at_a_bound_is_not_beyond_it_because_of_rounding() -> None:
    low = 10.7  # the nearest float32 is smaller
    (known,) = known_of([identify_parameters(Drag(), thrown(low), bounds={"sand.friction_angle": (low, 42.5)})])["sand.friction_angle"]
    assert known.profile.above(known.truth) < 0.01


@pytest.mark.slow
def test_a_calibration_with_true_values_beyond_the_bounds_is_refused(tmp_path: Path) -> None:
    cfg = compose("identify", "checkpoint=sand", "trajectory=scenes", "simulator=solver", f"calibration={tmp_path}")
    for k in range(10):
        identify_parameters(Drag(), thrown(20.0 + 3 * k), bounds=BOUNDS, scene=f"scene{k}").write(tmp_path)  # the last two exceed 42.5
    sealed.write(tmp_path / "config.json", _identity(cfg))
    with pytest.raises(
        ConfigError, match="sand.friction_angle by simulator=solver: too many calibration scenes have true values beyond the bounds"
    ):
        _calibrations(cfg, Settings("sand", "scenes", simulator="solver", calibration=str(tmp_path)))


@pytest.mark.slow
def test_a_scene_that_is_too_short_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    model, seen = learned()
    seen = replace(seen, material_params=np.full_like(seen.material_params, 30.0))
    few, short = SearchSettings(num_scanned=3, max_evaluations=1), ShootingSettings(horizon=2, num_windows=1)
    task = Task(model, None, False, {"sand.friction_angle": (1.0, 60.0)}, ("model",), ObservationSettings(), short, few, {})
    (left_out,) = identify_all(task, [("brief", seen.frames(0, 1)), ("long", seen)], tmp_path)
    assert left_out.startswith("brief: ")
    assert "brief: left out: " in (printed := capsys.readouterr().out) and "long: friction angle of sand " in printed
    assert [answer.scene for answer in read_answers(tmp_path, "model")] == ["long"]
    with pytest.raises(ConfigError, match="no scene can be identified; brief: "):
        identify_all(task, [("brief", seen.frames(0, 1))], tmp_path)
    with pytest.raises(UnknownError, match=r"bounds: solid\.youngs_modulus is no unknown of these scenes"):
        identify_all(replace(task, bounds={"solid.youngs_modulus": (1e5, 2e5)}), [("long", seen)], tmp_path)


@pytest.mark.slow
def test_a_folder_of_scenes_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, seen = learned()
    seen = replace(seen, material_params=np.full_like(seen.material_params, 30.0))
    monkeypatch.setattr("gpe_pl.evaluation.identification.results.solver_of", lambda _: Drag())
    bounds = {"sand.friction_angle": (1.0, 60.0)}
    few, short = SearchSettings(num_scanned=3, max_evaluations=1), ShootingSettings(horizon=2, num_windows=1)
    task = Task(model, None, False, bounds, ("model", "solver"), ObservationSettings(), short, few, {})
    (line,) = task.run("first", seen, tmp_path)
    assert line.startswith("friction angle of sand ")
    assert ", solver " in line
    assert {path.name for path in (tmp_path / "scenes").glob("*.png")} == {"first_misfit.png", "first_motion.png"}
    before = read_answers(tmp_path, "model")
    monkeypatch.setattr("gpe_pl.evaluation.identification.results.identify_parameters", None)
    (tmp_path / "scenes" / "first_motion.png").unlink()  # as after an interruption between answer and pictures
    assert [*task.run("first", seen, tmp_path)] == [line]
    assert read_answers(tmp_path, "model") == before
    assert (tmp_path / "scenes" / "first_motion.png").exists()
    with pytest.raises(MotionError, match=r"first_model\.json: is the answer for another motion than that of first"):
        list(task.run("first", replace(seen, pos=seen.pos + 0.01), tmp_path))
    known = replace(task, calibrated_on={Observations.of(seen).digest})
    with pytest.raises(MotionError, match="first: this motion is one of those that the calibration is from"):
        list(known.run("first", seen, tmp_path))
    assert "sand.friction_angle | model | none | 1 |" in write_table(tmp_path)


@pytest.mark.parametrize(("number", "others"), [(11, "other scenes"), (18, "the other half")])
def test_the_table_says_what_calibration_gives(tmp_path: Path, number: int, others: str) -> None:
    answer = identify_parameters(Drag(rate=0.11), thrown(31.0), bounds=BOUNDS)  # too low by a tenth
    for k in range(number):
        replace(answer, scene=f"{k:02d}").write(tmp_path)
    rows = [line.strip("| ").split(" | ") for line in write_table(tmp_path).splitlines()[2:]]
    assert [row[2] for row in rows] == ["none", others, f"{others}, one width"]
    assert [row[9] for row in rows] == ["0% of 90%", "100% of 90%", "100% of 90%"]
    assert float(rows[0][5]) == float(rows[0][6]) == pytest.approx(2.8, abs=0.1)
    assert all(float(row[5]) < 0.01 for row in rows[1:])  # corrected
    assert len((tmp_path / "table.md").read_text().splitlines()) == 5 + 1 + 2 + number
