"""Metrics of bodies of rollouts that differ from the ground truth in a known way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.metrics import rollout_metrics
from gpe_pl.metrics.bodies import STRESS, UNITS, Bodies, body_metrics
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from tests.bodies import DT, FRAMES, path


def metrics(prediction: Trajectory, truth: Trajectory, num_steps: int = FRAMES - 1) -> dict[str, float]:
    bodies = Bodies.of(truth)
    assert bodies is not None and len(bodies.nodes) == 2
    return body_metrics(bodies.predicted(prediction), bodies, num_steps)


def test_a_perfect_rollout() -> None:
    found = metrics(path(), path())
    assert found.keys() == {*UNITS} - {*STRESS}
    expected = {name: float(name.endswith("_ratio")) for name in found}
    assert found == pytest.approx(expected, abs=1e-6)


def test_twice_the_deformation() -> None:
    found = metrics(path(stretch=0.02), path(stretch=0.01))
    assert found["deformation_ratio"] == pytest.approx(2) and found["deformation_error"] == pytest.approx(1)
    assert found["strain_energy_ratio"] == pytest.approx(4, rel=0.05)
    assert found["rotation_error"] == pytest.approx(0, abs=1e-6)


def test_a_rigid_body_has_ratio_zero_and_error_one() -> None:
    found = metrics(path(stretch=0.0), path())
    assert found["deformation_ratio"] < 1e-6 and found["strain_energy_ratio"] < 1e-6
    assert found["deformation_error"] == pytest.approx(1)


def test_rotation_is_no_deformation() -> None:
    found = metrics(path(turned=7.0), path())
    assert found["rotation_error"] == pytest.approx(7.0)
    assert found["deformation_ratio"] == pytest.approx(1) and found["deformation_error"] < 1e-6


def test_a_lower_bounce_is_lower_in_proportion() -> None:
    found = metrics(path(bounce=0.25), path(bounce=0.5))
    assert found["bounce_height_ratio"] == pytest.approx(0.5)
    assert found["contact_time_ratio"] > 1.05
    stays = metrics(path(bounce=0.0), path(bounce=0.5))
    assert stays["bounce_height_ratio"] == pytest.approx(0, abs=1e-6) and stays["contact_time_ratio"] > found["contact_time_ratio"]


def test_nothing_is_compared_that_the_ground_truth_lacks() -> None:
    """Frames 1 and 2 have neither deformation nor contact, whatever the prediction does there."""
    assert metrics(path(), path(), 2).keys() == {"rotation_error"}
    no_gravity = path()
    no_gravity = replace(no_gravity, metadata=replace(no_gravity.metadata, gravity=(0.0, 0.0)))
    assert "bounce_height_ratio" not in metrics(path(), no_gravity)
    unknown = replace(path(), metadata=replace(path().metadata, config="{}"))
    assert "strain_energy_ratio" not in metrics(path(), unknown)
    still = metrics(path(), path(stretch=0.0))
    assert not still.keys() & {"deformation_ratio", "deformation_error", "strain_energy_ratio"}


def test_units_do_not_matter() -> None:
    expected = metrics(path(0.05, 0.3, 4.0), path())
    assert metrics(path(0.05, 0.3, 4.0, 1e-3, 1e2), path(length=1e-3, time=1e2)) == pytest.approx(expected, rel=1e-9)


def test_peak_stress_and_stress_in_the_first_contact() -> None:
    """The prediction has half of the stress in contact, and the peak of the ground truth in another frame."""
    truth = path()
    touching = np.arange(FRAMES) == 6
    stress = np.zeros((FRAMES, 30, 4), np.float32)
    stress[touching, :, 0] = 2e3
    wrong = 0.5 * stress
    wrong[10, 3, 0] = 3e3
    cell = np.zeros((FRAMES, len(truth.cells), 4), np.float32)  # type: ignore[arg-type]
    stressed = replace(truth, stress=Stress(stress, cell))
    assert not {r.metric for r in rollout_metrics(truth, stressed, ("full",))} & {*STRESS}  # a model without a stress has not failed
    broken = wrong.copy()
    broken[-1, 0, 0] = np.nan
    assert metrics(replace(truth, stress=Stress(broken, cell)), stressed)["peak_von_mises"] == np.inf
    broken[touching, 0, 0] = np.nan
    records = rollout_metrics(replace(truth, stress=Stress(broken, cell)), stressed, ("full",))
    assert all(r.value == np.inf for r in records if r.metric in {*STRESS, "stress_error", "von_mises_error"})
    found = metrics(replace(truth, stress=Stress(wrong, cell)), stressed)
    assert found["peak_von_mises"] == pytest.approx(3e3) and found["peak_von_mises_ratio"] == pytest.approx(1.5)
    assert found["contact_von_mises_error"] == pytest.approx(0.5)


def test_particles_and_periodic_domains_have_no_bodies() -> None:
    particles = Trajectory.from_numpy(np.repeat([[[0.1, 0.1], [0.2, 0.2]]], 3, axis=0), DT, "sand", {"sand": 30.0})
    assert Bodies.of(particles) is None
    truth = path()
    assert Bodies.of(replace(truth, metadata=replace(truth.metadata, periodic=(True, False)))) is None
    assert Bodies.of(replace(truth, cells=np.empty((0, 3), np.int32))) is None


def test_rollouts_have_these_metrics_and_fail_in_all_of_them() -> None:
    truth = path()
    found = {(r.metric, r.horizon): r.value for r in rollout_metrics(path(stretch=0.05), truth, (2, "full"))}
    expected = metrics(path(stretch=0.05), truth)
    assert {name: found[name, "full"] for name in expected} == expected
    assert {name for name, horizon in found if horizon == 2 and name in UNITS} == {"rotation_error"}

    stopped = replace(path().frames(0, 9), termination=Termination("nan", 9, 0, ""))
    records = {(r.metric, r.horizon): r.value for r in rollout_metrics(stopped, truth, (8, "full"))}
    assert records["deformation_ratio", 8] == pytest.approx(1)
    assert all(records[name, "full"] == math.inf for name in expected)


def test_a_turn_of_a_straight_rod_about_its_axis_is_no_error() -> None:
    """It does not show. Otherwise rounding would decide it."""
    rest = np.column_stack([0.1 * np.arange(6), np.zeros((6, 2))])
    bent = rest + 0.02 * np.sin(np.linspace(0, np.pi, 6))[:, None] * np.array([0.0, 1.0, 0.5])
    pos = np.stack([rest, *(rest + amount * (bent - rest) for amount in (0.5, 1.0, 0.7))]) + 0.5
    cells = {"line": np.column_stack([np.arange(5), np.arange(1, 6)])}

    def rod(noise: float) -> Trajectory:
        moved = pos + noise * np.random.default_rng(0).normal(size=pos.shape) * (np.arange(4) > 0)[:, None, None]
        bounds = ((0.0, 2.0),) * 3
        return Trajectory.from_numpy(
            moved, DT, "elastomer", {"elastomer": 1e5}, bounds=bounds, spacing=0.1, cells=cells, rest_pos=rest + 0.5
        )

    truth = Bodies.of(rod(0.0))
    assert truth is not None
    found = body_metrics(truth.predicted(rod(1e-7)), truth, 3)
    assert found["deformation_ratio"] == pytest.approx(1, abs=1e-4)
    assert not {"rotation_error", "deformation_error"} & found.keys()
