"""Criteria of acceptance checks pass what is right, and fail a model that is wrong, that stops early, or that ignores its parameter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.benchmarks.acceptance import flight, particles, scenes
from gpe_pl.benchmarks.acceptance.trial import at_most, follows_parameter, near_solver, not_above_solver, of_size
from gpe_pl.config.datasets import dataset
from gpe_pl.rollout.loop import rollout
from gpe_pl.solvers.scenes import describe
from gpe_pl.trajectory.trajectory import Termination, Trajectory

NAN = math.nan


def test_a_limit_fails_what_exceeds_it_or_stops() -> None:
    assert at_most("tilt", [1.0, 2.9], 3.0, "°").passed
    assert not at_most("tilt", [1.0, 3.1], 3.0, "°").passed
    stopped = at_most("tilt", [1.0, NAN], 3.0, "°")
    assert not stopped.passed and "stopped" in stopped.measured


def test_a_solver_that_misses_a_limit_widens_it() -> None:
    assert not not_above_solver("creep", [(0.3, 0.04, 0.02)], 0.1, "").passed
    check = not_above_solver("creep", [(0.3, 0.1, 0.2)], 0.1, "")
    assert check.passed and check.limit == "at most 0.1 or twice the solver's"
    assert not not_above_solver("creep", [(0.3, 0.1, 0.2), (0.3, 0.01, 0.01)], 0.1, "").passed  # each scene by itself


def test_values_are_compared_with_the_solver_and_its_uncertainty() -> None:
    def near(*values: tuple[float, float, float]) -> bool:
        return near_solver("bounce", values, 0.25, 0.01, " m").passed

    assert near((1.2, 1.0, 1.0), (0.8, 1.0, 1.01))
    assert not near((1.2, 1.0, 1.0), (0.7, 1.0, 1.0))
    assert not near((NAN, 1.0, 1.0))
    assert near((0.65, 1.0, 1.2)) and not near((0.55, 1.0, 1.2))  # twice the solver's own change
    assert near((0.01, 0.0, 0.0)) and not near((0.02, 0.0, 0.0))


def test_a_way_of_the_right_size_is_half_to_twice_the_solvers() -> None:
    assert of_size("way", [(0.5, 1.0, 1.0), (2.0, 1.0, 1.0)], "").passed
    for own in (0.49, 2.1, NAN):
        assert not of_size("way", [(1.0, 1.0, 1.0), (own, 1.0, 1.0)], "").passed


SOLVER = (0.3, 0.2, 0.1)


def compared(model: tuple[float, ...], finer: tuple[float, ...] = SOLVER) -> list[bool]:
    values = list(zip(model, SOLVER, finer, strict=True))
    return [check.passed for check in follows_parameter("run-out", values, " m")]


@pytest.mark.parametrize(
    ("model", "passed"),
    [
        (SOLVER, True),
        ((0.35, 0.2, 0.05), True),
        ((0.2, 0.2, 0.2), False),  # ignores the parameter
        ((0.21, 0.2, 0.19), False),  # in order, but by a tenth of the change
        ((0.1, 0.2, 0.3), False),  # the wrong way round
        ((0.3, 0.31, 0.1), False),  # the unseen value is out of order
        ((0.3, NAN, 0.1), False),
    ],
)
def test_a_quantity_follows_the_parameter(model: tuple[float, ...], passed: bool) -> None:
    assert compared(model) == [passed]


def test_no_order_is_asked_for_where_the_solver_has_none() -> None:
    assert compared(SOLVER, finer=(0.3, 0.2, 0.25)) == []
    values = [(1.0, solver, solver) for solver in (1.0, 0.97, 0.95)]
    assert follows_parameter("bounce", values, " m") == []  # too small a change to be seen


@pytest.fixture(scope="module")
def falling() -> Trajectory:
    """A ball in free fall, from the solver."""
    spec = dataset("data=sand", "size=tiny")
    return rollout(spec.solver, scenes.thrown(spec, 30.0), 8, describe(spec.scene, spec.solver.frame_dt))


def test_free_fall_has_no_drift_of_momentum(falling: Trajectory) -> None:
    """The wind accelerates by 5 % of gravity. The largest difference is in the last step, whose middle is half a step before the end."""
    assert flight.drift(falling, falling) == 0
    wind = 0.5 * 0.05 * 9.81 * (falling.metadata.frame_dt * np.arange(falling.num_frames)) ** 2
    blown = replace(falling, pos=falling.pos + wind[:, None, None] * np.array([1, 0]))
    assert flight.drift(blown, falling) == pytest.approx(5 * 7.5 / 8, rel=0.01)


@pytest.mark.parametrize("fault", ["stops at once", "doubles its speed", "goes back sideways", "hangs between"])
def test_a_flight_with_the_acceleration_of_gravity_can_have_a_drift(falling: Trajectory, fault: str) -> None:
    """Of all but the last, every step after the first changes the velocity by gravity."""
    dt = falling.metadata.frame_dt
    steps = dt * np.arange(falling.num_frames)[:, None, None]
    way = falling.pos[1:2] - falling.pos[:1]
    pos = {
        "stops at once": falling.pos - steps / dt * way,
        "doubles its speed": falling.pos + steps / dt * way,
        "goes back sideways": falling.pos - 2 * steps / dt * way * np.array([1, 0]),
        "hangs between": np.concatenate([np.repeat(falling.pos[:1], falling.num_frames - 1, axis=0), falling.pos[-1:]]),
    }[fault]
    assert flight.drift(replace(falling, pos=pos), falling) > 50


def test_quantities_of_particles_are_those_of_made_up_motions(falling: Trajectory) -> None:
    spacing, seconds = falling.metadata.spacing, 8 * falling.metadata.frame_dt
    still = replace(falling, pos=np.repeat(falling.pos[:1], falling.num_frames, axis=0))
    moved = still.pos + 0.1 * spacing * np.linspace(0, 1, still.num_frames)[:, None, None] * np.array([1, 0])
    sliding = replace(still, pos=moved)
    assert particles.creep(still) == 0 and particles.creep(sliding) == pytest.approx(0.1 / seconds, rel=1e-3)
    assert particles.final_speed(sliding) == pytest.approx(0.1 / seconds, rel=1e-3)
    beside = replace(still, pos=still.pos + 2 * spacing * np.array([1, 0]))
    assert particles.separation(still, still) == 0 and particles.separation(still, beside) == pytest.approx(2, rel=1e-3)
    assert particles.imbalance(0.0, still) == 50 and particles.imbalance(0.5, still) < 10
    taller = replace(still, pos=still.pos * np.linspace(1, 1.1, still.num_frames)[:, None, None])
    assert particles.sinking(taller) == pytest.approx(0.1, rel=1e-3)


def test_a_rollout_that_stopped_has_no_number(falling: Trajectory) -> None:
    from gpe_pl.benchmarks.acceptance.trial import Trial

    stopped = replace(falling, termination=Termination("nan", 3, 0, "broken"))
    own, solver, _ = Trial(30.0, falling, falling, stopped, 0.0).measured(particles.final_speed)
    assert math.isnan(own) and not math.isnan(solver)
