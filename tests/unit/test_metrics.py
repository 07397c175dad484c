import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.metrics import (
    UNITS,
    OneStepNMSE,
    RolloutMSE,
    bodies,
    bootstrap_interval,
    bootstrap_ratio,
    energy_distance,
    liquids,
    open_scenes,
    per_frame_mse,
    rollout_metrics,
)
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory

DT = 0.1


def trajectory(pos, mass=None, node_type=None, periodic=(False, False)) -> Trajectory:
    pos = np.asarray(pos, np.float64)
    num_nodes, dim = pos.shape[1:]
    metadata = Metadata("test", ("sand", "fluid"), ("friction_angle",), DT, 0.1, 0.25, ((-10.0, 10.0),) * dim, (0.0,) * dim, periodic[:dim])
    return Trajectory(
        metadata,
        pos,
        np.full_like(pos, np.nan),  # metrics take velocities from positions
        np.zeros(num_nodes, np.uint8) if node_type is None else np.asarray(node_type, np.uint8),
        np.ones(num_nodes) if mass is None else np.asarray(mass, float),
        np.zeros((num_nodes, 1)),
        Boundary.empty(dim),
    )


@pytest.fixture
def ground_truth() -> Trajectory:
    start = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    drift = np.arange(11)[:, None, None] * 0.02 * np.array([1.0, 0.5])
    return trajectory(start + drift)


def shifted(t: Trajectory, per_frame: np.ndarray) -> Trajectory:
    """Return the trajectory with every node displaced by per_frame[frame] along x."""
    pos = t.pos.copy()
    pos[..., 0] += per_frame[:, None]
    return replace(t, pos=pos)


def value(records, metric, horizon):
    (found,) = [r.value for r in records if (r.metric, r.horizon) == (metric, horizon)]
    return found


def test_per_frame_mse_averages_nodes_and_dimensions(ground_truth):
    error = per_frame_mse(shifted(ground_truth, 0.1 * np.arange(11)), ground_truth)
    np.testing.assert_allclose(error, 0.01 * np.arange(11) ** 2 / 2, atol=1e-15)


def test_rollout_mse_is_the_mean_over_frames_one_to_horizon(ground_truth):
    records = rollout_metrics(shifted(ground_truth, 0.1 * np.arange(11)), ground_truth, (2, "full"))
    assert value(records, "rollout_mse", 2) == pytest.approx((0.01 + 0.04) / 2 / 2)
    assert value(records, "rollout_mse", "full") == pytest.approx(0.01 * 385 / 10 / 2)
    assert {r.metric for r in records} == set(UNITS) - {
        "von_mises_error",
        "stress_error",
        "fraction_outside",
        "mirror_error",
        *bodies.UNITS,
        *liquids.UNITS,
        "rigid_deformation",
        *open_scenes.UNITS,
    }


def test_a_perfect_rollout_is_zero_everywhere(ground_truth):
    assert all(r.value == 0 for r in rollout_metrics(ground_truth, ground_truth, (5, 10, "full")))


def test_unreached_horizons_are_left_out(ground_truth):
    assert {r.horizon for r in rollout_metrics(ground_truth, ground_truth, (5, 10, 11, 20))} == {5, 10}
    short = ground_truth.frames(0, 6)  # a shorter rollout that did not fail
    assert {r.horizon for r in rollout_metrics(short, ground_truth, (5, 6, "full"))} == {5}


def test_relative_errors_by_hand():
    """Two nodes move by 2 and 4 per frame; the prediction's first node moves by 1 per frame more."""
    frames = np.arange(3)[:, None, None]
    truth = trajectory(frames * np.array([[2.0, 0.0], [0.0, 4.0]]))
    wrong = replace(truth, pos=truth.pos + (frames * np.array([[1.0, 0.0], [0.0, 0.0]])).astype(truth.pos.dtype))
    records = rollout_metrics(wrong, truth, (2,))
    assert value(records, "displacement_error", 2) == pytest.approx(np.sqrt((1 + 4) / (4 + 16 + 16 + 64)))
    assert value(records, "velocity_error", 2) == pytest.approx(np.sqrt(2 / (2 * (4 + 16))))


def test_von_mises_error_is_reported_where_both_have_a_stress():
    truth = trajectory(np.zeros((3, 2, 2)))
    uniaxial = np.zeros((3, 2, 4), np.float32)
    uniaxial[..., 0] = 2.0  # von Mises stress 2
    truth = replace(truth, stress=Stress(uniaxial, uniaxial[:, :1]))
    wrong = replace(truth, stress=Stress(1.5 * uniaxial, uniaxial[:, :1]))
    assert value(rollout_metrics(wrong, truth, (2,)), "von_mises_error", 2) == pytest.approx(0.5)
    assert "von_mises_error" not in {r.metric for r in rollout_metrics(replace(wrong, stress=None), truth, (2,))}


def test_stress_error_is_that_of_the_whole_tensor():
    truth = trajectory(np.zeros((3, 2, 2)))
    hydrostatic = np.zeros((3, 2, 4), np.float32)
    hydrostatic[..., [0, 2, 3]] = 2.0  # norm √12, von Mises stress 0
    sheared = hydrostatic + np.array([0, 1, 0, 0], np.float32)  # off by √2
    truth, wrong = (replace(truth, stress=Stress(s, s[:, :1])) for s in (hydrostatic, sheared))
    records = rollout_metrics(wrong, truth, (2,))
    assert value(records, "stress_error", 2) == pytest.approx(np.sqrt(2 / 12))
    assert value(records, "von_mises_error", 2) == np.inf
    axial = np.zeros((3, 2, 6), np.float32)
    axial[..., [0, 3, 5]] = 1.0
    spatial = trajectory(np.zeros((3, 2, 3)))
    shears = axial + np.array([0, 1, 1, 0, 1, 0], np.float32)
    truth, wrong = (replace(spatial, stress=Stress(s, s[:, :1])) for s in (axial, shears))
    assert value(rollout_metrics(wrong, truth, (2,)), "stress_error", 2) == pytest.approx(np.sqrt(6 / 3))


def test_stress_is_judged_by_what_the_impact_will_bring():
    truth, late = trajectory(np.zeros((5, 2, 2))), np.zeros((5, 2, 4), np.float32)
    late[3:, :, 0] = 2.0  # von Mises stress 2 in two of four frames: root mean square √2
    truth = replace(truth, stress=Stress(late, late[:, :1]))
    noisy = replace(truth, stress=Stress(late + np.array([0.1, 0, 0, 0], np.float32), late[:, :1]))
    assert value(rollout_metrics(noisy, truth, (2,)), "von_mises_error", 2) == pytest.approx(0.1 / np.sqrt(2), rel=1e-5)


def test_an_early_stop_is_infinitely_wrong_beyond_its_last_good_frame(ground_truth):
    stopped = replace(ground_truth.frames(0, 6), termination=Termination("nan", 6, 0, ""))
    error = per_frame_mse(stopped, ground_truth)
    assert (error[:6] == 0).all() and np.isposinf(error[6:]).all() and len(error) == 11
    records = rollout_metrics(stopped, ground_truth, (5, 6, 11, "full"))
    assert all(r.value == (0 if r.horizon == 5 else math.inf) for r in records)
    assert {r.horizon for r in records} == {5, 6, "full"}


def test_a_frame_that_is_not_finite_spoils_all_later_ones(ground_truth):
    pos = ground_truth.pos.copy()
    pos[4, 2, 0] = np.nan
    error = per_frame_mse(replace(ground_truth, pos=pos), ground_truth)
    assert (error[:4] == 0).all() and np.isposinf(error[4:]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: replace(t, pos=t.pos[:, :3], node_type=t.node_type[:3]), "different nodes"),
        (lambda t: replace(t, pos=np.concatenate([t.pos, t.pos])), "predicted frames"),
        (lambda t: t.frames(1), "frame 0 differs"),
        (lambda t: replace(t, metadata=replace(t.metadata, frame_dt=0.2)), "frame_dt"),
    ],
)
def test_trajectories_that_do_not_belong_together_are_refused(ground_truth, change, message):
    with pytest.raises(ValueError, match=message):
        per_frame_mse(change(ground_truth), ground_truth)


@pytest.mark.parametrize("horizon", [0, -1, "all"])
def test_senseless_horizons_are_refused(ground_truth, horizon):
    with pytest.raises((ValueError, TypeCheckError), match="horizon"):
        rollout_metrics(ground_truth, ground_truth, (horizon,))


def test_periodic_axes_take_the_short_way():
    pos = np.array([[[9.95, 0.0]], [[10.05, 0.0]], [[10.15, 0.0]]])
    wrapped = np.where(pos >= 10, pos - 20, pos)
    truth, prediction = trajectory(pos, periodic=(True, False)), trajectory(wrapped, periodic=(True, False))
    records = rollout_metrics(prediction, truth, (2,))
    assert {r.metric for r in records} == set(UNITS) - {
        *bodies.UNITS,
        *liquids.UNITS,
        "rigid_deformation",
        *open_scenes.UNITS,
        "mirror_error",
        "energy_distance",
        "angular_momentum_error",
        "von_mises_error",
        "stress_error",
        "fraction_outside",
    }
    assert all(r.value == pytest.approx(0, abs=1e-12) for r in records)


# --- distribution and conservation


def test_energy_distance_by_hand():
    a, b = np.array([[0.0], [2.0]]), np.array([[1.0]])
    # 2 E|A-B| = 2, E|A-A'| = 1 over all four pairs, E|B-B'| = 0
    assert energy_distance(a, b, np.ones(2), np.ones(1)) == pytest.approx(1.0)
    # with three quarters of the mass at 0: 2 - 2 * 3/4 * 1/4 * 2
    assert energy_distance(a, b, np.array([3.0, 1.0]), np.ones(1)) == pytest.approx(1.25)


@pytest.mark.slow
def test_energy_distance_in_blocks_equals_all_pairs_and_ignores_order():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2100, 2)), rng.normal(0.3, 1.0, size=(2500, 2))  # more than one block of rows

    def mean(x, y):
        return np.linalg.norm(x[:, None] - y[None], axis=-1).mean()

    ones = (np.ones(len(a)), np.ones(len(b)))
    assert energy_distance(a, b, *ones) == pytest.approx(2 * mean(a, b) - mean(a, a) - mean(b, b), rel=1e-9)
    assert energy_distance(a, rng.permutation(a), ones[0], ones[0]) == pytest.approx(0, abs=1e-12)


def test_exchanged_particles_count_unless_they_are_of_one_material():
    start = np.array([[0.0, 0.0], [1.0, 0.0]])
    pos = np.stack([start, start])
    swapped = np.stack([start, start[::-1]])
    for types, expected in ([0, 0], 0.0), ([0, 2], 2.0):
        records = rollout_metrics(trajectory(swapped, node_type=types), trajectory(pos, node_type=types), (1,))
        assert value(records, "energy_distance", 1) == pytest.approx(expected)
        assert value(records, "rollout_mse", 1) == pytest.approx(0.5)


def test_momentum_and_kinetic_energy_by_hand():
    # Two nodes of 1 and 3 kg. Ground truth: both at 1 m/s. Prediction: the heavy one at 2 m/s.
    frames = np.arange(3)[:, None, None] * DT
    truth = trajectory(frames * np.array([[1.0, 0.0], [1.0, 0.0]]), mass=[1, 3])
    prediction = trajectory(frames * np.array([[1.0, 0.0], [2.0, 0.0]]), mass=[1, 3])
    records = rollout_metrics(prediction, truth, (2,))
    assert value(records, "momentum_error", 2) == pytest.approx(3 * 1 / 4)
    assert value(records, "kinetic_energy_bias", 2) == pytest.approx((1 + 12) / 4 - 1)
    slow = rollout_metrics(truth, prediction, (2,))
    assert value(slow, "kinetic_energy_bias", 2) == pytest.approx(4 / 13 - 1)
    assert value(slow, "kinetic_energy_error", 2) == pytest.approx(1 - 4 / 13)


def test_angular_momentum_is_about_the_centre_of_mass():
    # A rotation by the angle w dt has angular momentum r^2 sin(w dt) / dt about the centre, with backward differences.
    angle = 0.3 * np.arange(4)
    arm = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    spinning = np.stack([arm, -arm], axis=1) + np.array([1.0, 2.0])  # away from the origin, whose moment would otherwise agree
    still = np.broadcast_to(spinning[:1], spinning.shape)
    translation = np.arange(4)[:, None, None] * np.array([0.3, -0.2])
    for prediction in spinning, spinning + translation:
        records = rollout_metrics(trajectory(prediction), trajectory(still), (3,))
        assert value(records, "angular_momentum_error", 3) == pytest.approx(math.sin(0.3) / DT)
    moved = rollout_metrics(trajectory(spinning + translation), trajectory(still), (3,))
    assert value(moved, "momentum_error", 3) == pytest.approx(math.hypot(0.3, 0.2) / DT)


def test_kinetic_energy_over_a_resting_ground_truth():
    still = trajectory(np.zeros((3, 1, 2)))
    assert value(rollout_metrics(still, still, (2,)), "kinetic_energy_error", 2) == 0
    moving = trajectory(np.arange(3)[:, None, None] * np.ones((1, 1, 2)))
    assert value(rollout_metrics(moving, still, (2,)), "kinetic_energy_error", 2) == math.inf


def test_fraction_outside_counts_particle_frames_up_to_the_horizon():
    walls = Boundary.sample((*domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.5),), 0.1, 2)
    inside = np.full((5, 2, 2), 0.5)
    outside = inside.copy()
    outside[3:, 0, 1] = -0.2
    truth, prediction = (replace(trajectory(p), boundary=walls) for p in (inside, outside))
    records = rollout_metrics(prediction, truth, (2, 3, 4))
    assert [value(records, "fraction_outside", h) for h in (2, 3, 4)] == pytest.approx([0, 1 / 6, 2 / 8])
    nodes_only = replace(truth, boundary=replace(walls, shapes=()))
    assert "fraction_outside" not in {r.metric for r in rollout_metrics(prediction, nodes_only, (2,))}


# --- torchmetrics


def test_one_step_nmse_by_hand_and_in_batches():
    prediction, target = torch.tensor([[1.0, 0.0], [0.0, 3.0]]), torch.tensor([[1.0, 1.0], [0.0, 1.0]])
    whole, parts = OneStepNMSE(), OneStepNMSE()
    whole.update(prediction, target)
    for k in range(2):
        parts.update(prediction[k : k + 1], target[k : k + 1])
    assert whole.compute().item() == pytest.approx(5 / 3)
    assert parts.compute() == whole.compute()
    zero = OneStepNMSE()
    zero.update(torch.zeros(2, 2), target)
    assert zero.compute() == 1
    zero.reset()
    zero.update(target, target)
    assert zero.compute() == 0


def test_one_step_nmse_does_not_broadcast():
    with pytest.raises((ValueError, TypeCheckError)):
        OneStepNMSE().update(torch.zeros(3, 2), torch.zeros(1, 2))


def test_rollout_mse_averages_trajectories_and_merges_like_processes(ground_truth):
    near, far = shifted(ground_truth, 0.1 * np.arange(11)), shifted(ground_truth, 0.2 * np.arange(11))
    together, left, right = (RolloutMSE((2, 50, "full")) for _ in range(3))
    together.update(near, ground_truth)
    together.update(far, ground_truth)
    left.update(near, ground_truth)
    right.update(far, ground_truth)
    result = together.compute()
    assert set(result) == {"rollout_mse@2", "rollout_mse@full"}
    assert result["rollout_mse@2"].item() == pytest.approx((0.0125 + 0.05) / 2)
    left.merge_state(right)
    assert left.compute() == result


def test_rollout_mse_counts_a_failure_as_infinite(ground_truth):
    metric = RolloutMSE((5, 8))
    metric.update(ground_truth, ground_truth)
    metric.update(replace(ground_truth.frames(0, 6), termination=Termination("nan", 6, 0, "")), ground_truth)
    assert {k: v.item() for k, v in metric.compute().items()} == {"rollout_mse@5": 0.0, "rollout_mse@8": math.inf}


# --- bootstrap


def test_bootstrap_covers_a_known_mean_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for trial in range(100):  # seeds and trajectories both vary; the trajectories are shared by all seeds
        values = 3.0 + rng.normal(0, 0.5, (8, 1)) + rng.normal(0, 1.0, (1, 25)) + rng.normal(0, 0.3, (8, 25))
        interval = bootstrap_interval(values, np.mean, seed=trial, num_resamples=200)
        hits += interval.low <= 3.0 <= interval.high
    assert 85 <= hits <= 99


def test_bootstrap_of_equal_values_has_no_width_and_is_reproducible():
    interval = bootstrap_interval([[2.0, 2.0], [2.0, 2.0]])
    assert (interval.estimate, interval.low, interval.high) == (2, 2, 2)
    values = np.random.default_rng(0).normal(size=(3, 10))
    assert bootstrap_interval(values, seed=1) == bootstrap_interval(values, seed=1) != bootstrap_interval(values, seed=2)


def test_bootstrap_keeps_shared_trajectories_together():
    # All spread comes from trajectories, so more seeds must not narrow the interval.
    column = np.random.default_rng(0).normal(size=(1, 20))
    few, many = (bootstrap_interval(np.repeat(column, n, axis=0), np.mean) for n in (2, 20))
    assert many.high - many.low == pytest.approx(few.high - few.low, rel=0.15)


def test_bootstrap_with_failures_is_never_nan():
    values = [[1.0, 2.0, math.inf], [1.5, math.inf, math.inf], [1.0, 2.0, 3.0]]
    interval = bootstrap_interval(values)
    assert interval.estimate == 2.0 and interval.low <= 2.0 and interval.high == math.inf
    assert bootstrap_interval(values, np.mean).high == math.inf


@pytest.mark.parametrize("values", [[], [[]], [[1.0, math.nan]], [[1.0, 2.0], [1.0]]])
def test_bootstrap_refuses_what_is_no_table(values):
    with pytest.raises(ValueError):
        bootstrap_interval(values)


def test_a_ratio_knows_that_both_models_met_the_same_trajectories():
    hard = np.exp(np.random.default_rng(0).normal(0, 2, (1, 20)))
    own, other = np.repeat(0.5 * hard, 3, axis=0), np.repeat(hard, 3, axis=0)
    interval = bootstrap_ratio(own, other, np.mean)
    assert (interval.estimate, interval.low, interval.high) == pytest.approx((0.5, 0.5, 0.5))
    apart = [bootstrap_interval(v, np.mean) for v in (own, other)]
    assert apart[0].low / apart[1].high < 0.3 and apart[0].high / apart[1].low > 0.8


def test_a_ratio_of_failures_is_never_nan():
    failed, fine = np.array([[math.inf, 1.0]]), np.array([[2.0, 2.0]])
    interval = bootstrap_ratio(failed, fine, np.mean)
    assert (interval.estimate, interval.low, interval.high) == (math.inf, 0.5, math.inf)
    assert bootstrap_ratio(fine, failed, np.mean).estimate == 0
    assert bootstrap_ratio(failed, failed, np.mean).estimate == 1
    assert bootstrap_ratio(fine, np.zeros((1, 2)), np.mean).estimate == math.inf


def test_a_ratio_needs_the_same_trajectories():
    with pytest.raises(ValueError, match="same test trajectories, got 2 and 3"):
        bootstrap_ratio(np.ones((1, 2)), np.ones((1, 3)))


def test_a_ratio_of_one_model_under_two_conditions_pairs_seeds_too():
    lucky = np.array([[1.0], [10.0], [3.0]])  # seeds that differ more than the conditions
    own, other = 0.9 * lucky * np.ones((1, 8)), lucky * np.ones((1, 8))
    paired, apart = (bootstrap_ratio(own, other, np.mean, is_paired=p) for p in (True, False))
    assert (paired.low, paired.high) == pytest.approx((0.9, 0.9)) and apart.low < 0.5 and apart.high > 1.5
    with pytest.raises(ValueError, match="paired tables need the same seeds, got 2 and 3"):
        bootstrap_ratio(own[:2], other, np.mean, is_paired=True)
