"""A model in free fall knows no left and right; one with random weights does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gpe_pl.evaluation.mirror_check import MirrorError, mirror_equivariance_error
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.trajectory import Trajectory
from tests.bodies import path


def model(trajectory: Trajectory, acceleration: float) -> LearnedSimulator:
    torch.manual_seed(0)
    build = GraphBuilder(GraphConfig(history=2), trajectory.metadata)
    simulated = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    simulated.acceleration_std.fill_(acceleration)
    return simulated


def test_the_image_of_a_scene_moves_like_its_image() -> None:
    scene = path()
    assert mirror_equivariance_error(model(scene, 0.0), scene) < 1e-6
    assert mirror_equivariance_error(model(scene, 30.0), scene) > 1e-3


def test_gravity_along_every_axis_has_no_mirror() -> None:
    scene = path()
    tilted = replace(scene, metadata=replace(scene.metadata, gravity=(1.0, -9.0)))
    with pytest.raises(MirrorError, match="every axis"):
        mirror_equivariance_error(model(scene, 0.0), tilted)
