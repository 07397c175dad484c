"""Mean velocities over the last frame are told from those at the frames."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.data.frame_velocities import ADVICE, are_means, warn_of_means
from gpe_pl.data.importers import save_dataset
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.trajectory import Trajectory

DT, GRAVITY = 0.005, np.array([0.0, -9.81])
REST = 0.05 * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2, 0]], float)
CELLS = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]])


def thrown(seed: int, knows_velocities: bool, far: float = 0.0) -> Trajectory:
    """Return a body that swings in free flight."""
    speed, rate, time = np.random.default_rng(seed).uniform(-1, 1, 2), 40.0, DT * np.arange(20)[:, None, None]
    pos = far + REST * (1 + 0.002 * np.sin(rate * time)) + speed * time + 0.5 * GRAVITY * time**2
    vel = 0.002 * rate * REST * np.cos(rate * time) + speed + GRAVITY * time
    given = vel if knows_velocities else None
    return Trajectory.from_numpy(pos, DT, "elastomer", {"elastomer": 1e4}, gravity=GRAVITY, mass=1.0, cells=CELLS, vel=given)


@pytest.mark.parametrize("far", [0.0, 20.0])
def test_velocities_at_the_frames_are_told_from_means(far: float) -> None:
    assert are_means(thrown(0, False, far))
    assert not are_means(thrown(0, True, far))


def test_nothing_is_said_of_particles_and_of_bodies_that_keep_their_velocity() -> None:
    body = thrown(0, False)
    assert not are_means(replace(body, cells=None, rest_pos=None, cell_dim=None))
    drifting = body.pos[:1] + DT * np.arange(20)[:, None, None] * np.array([1.0, 0.0])
    assert not are_means(Trajectory.from_numpy(drifting, DT, "elastomer", {"elastomer": 1e4}, cells=CELLS))


def simulator(trajectory: Trajectory, elastic: bool) -> LearnedSimulator:
    build = GraphBuilder(GraphConfig(history=2, mesh=True, islands=True, cells=elastic), trajectory.metadata)
    return LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8, elastic=elastic), build)


@pytest.mark.parametrize("knows_velocities", [False, True])
def test_report_and_commands_say_so(tmp_path: Path, caplog: pytest.LogCaptureFixture, knows_velocities: bool) -> None:
    """The start of the elastic law would be wrong by g·dt/2 in free flight."""
    scenes = [thrown(seed, knows_velocities) for seed in range(3)]
    report = save_dataset(tmp_path, "thrown", train=scenes)
    assert (ADVICE in report.notes) is not knows_velocities
    for elastic in (False, True):
        with caplog.at_level(logging.WARNING):
            warn_of_means(simulator(scenes[0], elastic), Path(report.folder), "test")
        assert ("law=elastic: " in caplog.text) is (elastic and not knows_velocities)
        caplog.clear()
