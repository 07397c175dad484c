"""What validation rollouts log of bodies that bend, and of particles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import lightning as L
import numpy as np
import pytest

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import liquids
from gpe_pl.training import callbacks
from gpe_pl.training.callbacks import BODY_METRICS, RolloutValidation
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from tests.bodies import FRAMES, path
from tests.sources import motion


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, float]]:
    def validate(truths: list[Trajectory], predictions: list[Trajectory]) -> dict[str, float]:
        """Return what a validation logs whose rollouts are these predictions."""
        monkeypatch.setattr(callbacks, "rollouts", lambda *_: predictions)
        found: dict[str, float] = {}
        simulator = Mock(spec=LearnedSimulator, builder=SimpleNamespace(config=SimpleNamespace(history=1)), training=True)
        simulator.on.return_value = simulator
        simulator.initial_state = lambda trajectory, history: trajectory.state(history, history)
        module = Mock(spec=L.LightningModule, simulator=simulator, log=lambda name, value, **_: found.update({name: value}))
        RolloutValidation(truths, FRAMES, containment=False).on_validation_epoch_end(Mock(spec=L.Trainer, sanity_checking=False), module)
        return found

    return validate


def test_bodies_are_compared_in_validation(logged: Callable[..., dict[str, float]]) -> None:
    found = logged([path(), path()], [path(stretch=0.1).frames(1), path(stretch=0.05).frames(1)])
    assert found.keys() == {"val/rollout_mse", *(f"val/{name}" for name in BODY_METRICS)}
    assert found["val/deformation_ratio"] == pytest.approx((1 + 0.5) / 2, abs=0.01)
    assert found["val/deformation_error"] == pytest.approx((0 + 0.5) / 2, abs=0.01)


def test_a_stopped_rollout_counts_with_its_good_frames(logged: Callable[..., dict[str, float]]) -> None:
    stopped = replace(path(stretch=0.05).frames(1, 8), termination=Termination("nan", 7, 0, ""))
    found = logged([path()], [stopped])
    assert found["val/deformation_ratio"] == pytest.approx(0.5, abs=0.01)
    at_once = replace(path().frames(1, 2), termination=Termination("nan", 1, 0, ""))
    assert logged([path()], [at_once]).keys() == {"val/rollout_mse"}


def test_particles_have_no_bodies(logged: Callable[..., dict[str, float]]) -> None:
    particles = replace(path(), cells=None, rest_pos=None)
    assert logged([particles], [particles.frames(1)]) == {"val/rollout_mse": 0.0}


def test_liquids_are_compared_in_validation(logged: Callable[..., dict[str, float]]) -> None:
    pool = Trajectory.from_numpy(motion(num_frames=6), 0.01, "fluid", {"fluid": 1e-3}, spacing=0.1)
    elsewhere = replace(pool, pos=pool.pos + np.where(np.arange(6) > 1, 0.3, 0.0)[:, None, None])
    found = logged([pool], [elsewhere.frames(1)])
    assert found.keys() == {"val/rollout_mse", *(f"val/{name}" for name in liquids.UNITS)}
    assert found["val/centre_error"] == pytest.approx(0.3 * 2**0.5)
    assert found["val/spacing_error"] == pytest.approx(0.0, abs=1e-6)
