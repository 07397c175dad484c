"""Scenes unlike the known ones are named, with quantity, node type and amount."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.unlike import UnlikeScenes, Watch, quantities, sampled_frames, trained_limits, united, unlike
from gpe_pl.trajectory.state import State
from tests.scenes import mesh_state, metadata, state


@pytest.fixture
def simulator(checkpoint: Path) -> LearnedSimulator:
    return LearnedSimulator.from_checkpoint(checkpoint)


def faster(own: State, factor: float) -> State:
    history = own.velocity_history
    return replace(own, vel=factor * own.vel, velocity_history=None if history is None else factor * history)


def test_quantities_are_physical(simulator: LearnedSimulator) -> None:
    own = simulator.standing(state(), metadata())
    found = quantities(simulator, own)
    speed = own.vel.norm(dim=1)
    assert found["speed of sand [m/s]"] == pytest.approx((float(speed.min()), float(speed.max())), rel=1e-5)
    near = np.linalg.norm(own.pos.numpy()[:, None] - own.pos.numpy()[None], axis=-1)
    near = near[(near > 0) & (near <= simulator.builder.scales.radius)]
    assert found["distance of sand from sand [m]"] == pytest.approx((near.min(), near.max()), rel=1e-5)
    assert {name.split(" [")[0] for name in found} >= {"edges per node of sand", "distance of sand from boundary"}


def test_what_is_unlike_is_named(simulator: LearnedSimulator) -> None:
    own = simulator.standing(state(), metadata())
    limits = quantities(simulator, own)
    assert list(unlike(limits, limits)) == []
    assert list(unlike(quantities(simulator, faster(own, 1.1)), limits)) == [], "within the margin"
    (name, line), *others = unlike(quantities(simulator, faster(own, 4.0)), limits)
    assert name == "speed of sand [m/s]" and "in calibration scenes at most" in line and "(4 times as much)" in line
    assert not others
    dense = replace(own, pos=0.5 + 0.4 * (own.pos - 0.5))
    assert "edges per node of sand" in dict(unlike(quantities(simulator, dense), limits))
    assert dict(unlike({"stretch of edges of solid": (0.0, 1.0)}, limits))["stretch of edges of solid"].endswith(
        "does not occur in calibration scenes"
    )


def test_statistics_of_training_are_limits_without_calibration(simulator: LearnedSimulator) -> None:
    own = simulator.standing(state(), metadata())
    assert trained_limits(simulator) == {}, "an untrained model knows nothing"
    simulator.standardizer.fit([simulator.builder(own)])
    limits = trained_limits(simulator)
    scenes = UnlikeScenes(limits, "training", is_complete=False)
    assert scenes.add(quantities(simulator, own)) == 0, "distances and numbers of edges have no limits"
    assert scenes.add(quantities(simulator, faster(own, 50.0))) >= 1
    assert "speed of sand [m/s]" in scenes.lines


def test_few_frames_are_looked_at(simulator: LearnedSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sampled_frames(101) == {0, 25, 50, 75, 100} and sampled_frames(2) == {0, 1}
    own = simulator.standing(state(), metadata())
    watch, calls = Watch(simulator, 100), list[State]()

    def counted(_: object, seen: State) -> dict[str, tuple[float, float]]:
        calls.append(seen)
        return {"speed": (0.0, float(len(calls)))}

    monkeypatch.setattr("gpe_pl.learned.unlike.quantities", counted)
    for frame in range(101):
        watch.see(frame, own)
    assert len(calls) == 5 and watch.found == {"speed": (0.0, 5.0)}


def test_a_warning_counts_scenes(caplog: pytest.LogCaptureFixture) -> None:
    scenes = UnlikeScenes({"speed of sand [m/s]": (0.0, 2.0)}, "calibration scenes", is_complete=True, spread=[0.1, 0.2])
    narrow, wide = np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.1, 0.6])
    assert scenes.add({"speed of sand [m/s]": (0.1, 2.1)}, narrow) == 0
    assert scenes.add({"speed of sand [m/s]": (0.1, 6.0)}, narrow) == 1
    assert scenes.add({"speed of sand [m/s]": (0.1, 9.0)}, wide) == 2
    assert UnlikeScenes({}, "calibration scenes", is_complete=True, spread=[0.1, 0.2]).add({}, 1.2 * narrow) == 0, "within the margin"
    new = UnlikeScenes(scenes.limits, "calibration scenes", is_complete=True)
    assert new.add({"edges per node of sand": (3.0, 4.0)}) == 1, "calibration scenes have no such quantity"
    with caplog.at_level(logging.WARNING):
        scenes.warn("test")
    speed, spread = caplog.messages
    assert (
        speed
        == "unlike calibration scenes in 2 of 3 scenes of test: speed of sand [m/s] is up to 6, in calibration scenes at most 2 (3 times as much)"
    )
    assert spread.startswith("unlike calibration scenes in 1 of 3 scenes of test: spread of the ensemble is 0.6 m after 2 frames")


def test_meshes_are_measured_by_their_stretch() -> None:
    from gpe_pl.models.gpe import GPE
    from tests.scenes import builder

    build = builder(("solid",), mesh=True)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=4), build)
    own = mesh_state(materials=("solid",)).to_torch()
    assert own.rest_pos is not None
    rested = replace(own, pos=own.rest_pos)
    stretched = replace(own, pos=own.rest_pos * 1.2)
    assert quantities(simulator, rested)["stretch of edges of solid"] == pytest.approx((0.0, 0.0), abs=1e-6)
    assert quantities(simulator, stretched)["stretch of edges of solid"] == pytest.approx((0.2, 0.2), abs=1e-4)
    assert united([{"a": (0.0, 1.0)}, {"a": (-1.0, 0.5), "b": (2.0, 2.0)}]) == {"a": (-1.0, 1.0), "b": (2.0, 2.0)}
