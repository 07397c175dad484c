"""Simulators refuse precisions and ensembles in which their answers would be wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from gpe_pl.geometry.shapes import Sphere
from gpe_pl.learned.checkpoint_file import CheckpointError
from gpe_pl.learned.ensemble import LearnedEnsemble
from gpe_pl.learned.simulator import LearnedSimulator, PrecisionError
from gpe_pl.models.gpe import GPE
from gpe_pl.scenes.scene import Scene
from gpe_pl.trajectory.boundary import Boundary
from tests import scenes


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused_and_changes_nothing(dtype: torch.dtype) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    before = {name: values.clone() for name, values in simulator.state_dict().items()}
    with pytest.raises(PrecisionError, match=f"{dtype}: a simulator computes in float32 or float64"):
        simulator.to(dtype)
    after = simulator.state_dict()
    assert all(torch.equal(values, after[name]) and values.dtype == after[name].dtype for name, values in before.items())
    assert next(simulator.double().model.parameters()).dtype == torch.float64


def plain_model(**config: Any) -> LearnedSimulator:
    builder = scenes.builder(("elastomer",), 2, mesh=True, **config)
    return LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder).eval()


def test_members_of_an_ensemble_fit_each_other() -> None:
    sand, snow = (LearnedSimulator.from_checkpoint(name) for name in ("sand", "snow"))
    with pytest.raises(CheckpointError, match="an ensemble needs at least one model"):
        LearnedEnsemble(())
    with pytest.raises(CheckpointError, match="member 1 has other materials, frames, spacing or history than member 0"):
        LearnedEnsemble((sand, snow))
    assert len(LearnedEnsemble((sand, sand)).members) == 2


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize(
    ("other", "difference"),
    [
        ({"cells": True}, r"velocities at the start \(graph.cells\)"),
        ({"connectivity_spacings": 2.0}, r"neighbours \(connectivity radius\)"),
    ],
)
def test_members_that_start_otherwise_are_refused(other: dict[str, Any], difference: str, order: tuple[int, int]) -> None:
    """Otherwise the start of the ensemble would be that of its first member."""
    members = [plain_model(**config) for config in ({}, other)]
    with pytest.raises(CheckpointError, match=f"member 1 has other {difference} than member 0"):
        LearnedEnsemble(tuple(members[k] for k in order))
    assert len(LearnedEnsemble((members[1], members[1])).members) == 2


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_every_member_of_an_ensemble_warns_of_what_it_was_not_trained_on(order: tuple[int, int], caplog: pytest.LogCaptureFixture) -> None:
    members = [LearnedSimulator.from_checkpoint("sand") for _ in range(2)]
    dict(members[0].trained_ranges())["sand"][1] = 60.0
    ensemble = LearnedEnsemble(tuple(members[k] for k in order))
    scene, metadata = Scene(box=(1.0, 1.0)).block("sand", at=(0.3, 0.0), size=(0.1, 0.1), friction_angle=50).state(members[0])
    ensemble.standing(scene, metadata)
    assert "friction_angle of sand is 50 deg, trained were 20 to 42.5" in caplog.text


@pytest.mark.parametrize("is_inside", [True, False])
def test_a_start_inside_an_obstacle_is_warned_of(is_inside: bool, caplog: pytest.LogCaptureFixture) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    state, metadata = Scene(box=(1.0, 1.0)).block("sand", at=(0.3, 0.0), size=(0.1, 0.1), friction_angle=30).state(simulator)
    ball = Sphere((0.35, 0.05), 0.04, 0.3) if is_inside else Sphere((0.6, 0.05), 0.04, 0.3)
    shapes = (*state.boundary.shapes, ball)
    simulator.standing(replace(state, boundary=Boundary.sample(shapes, metadata.spacing, 2)), metadata)
    assert ("nodes start inside walls or obstacles, up to 0.0" in caplog.text) == is_inside
