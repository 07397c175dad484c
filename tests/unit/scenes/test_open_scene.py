"""Inlets and outlets of scenes: what they become at the spacing of a model, what is said of impossible ones, and rollouts with them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.export.play_scene import state_for_page
from gpe_pl.export.program import OpenSceneError, scene_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.scenes.scene import Scene, SceneFault
from gpe_pl.scenes.scene_file import read_scene
from gpe_pl.schema import node_code
from gpe_pl.trajectory.store import read_trajectory, write_shard

SPACING = 0.015625  # of the shipped model of sand
INLET: dict[str, Any] = {"material": "sand", "side": "y_high", "at": (0.25, 0.875), "size": (0.125, 0.125), "speed": 1.5}
OUTLET: dict[str, Any] = {"side": "x_high", "at": (0.9, 0.0), "size": (0.1, 1.0)}


@cache
def model() -> LearnedSimulator:
    return LearnedSimulator.from_checkpoint("sand")


def tap(**changes: Any) -> Scene:
    return Scene(box=(1.0, 1.0)).inlet(**{**INLET, **changes})


def test_zones_become_openings() -> None:
    state, metadata = tap(friction_angle=35).outlet(**OUTLET).state(model())
    inlet, outlet = state.openings
    assert (inlet.side, inlet.speed, inlet.spacing, inlet.node_type) == ("y_high", 1.5, SPACING, node_code("sand"))
    assert inlet.mass == pytest.approx(1600 * SPACING**2)
    assert inlet.params == (35.0,)
    assert (outlet.low, outlet.high, outlet.speed) == ((0.9, 0.0), (1.0, 1.0), None)
    assert state.num_nodes == 8 * 8
    assert inlet.contains(state.pos).all()
    assert (state.vel == (0.0, -1.5)).all()
    assert state.node_id is not None
    assert metadata.bounds == ((0.0, 1.0), (0.0, 1.0))
    assert Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.0), size=(0.2, 0.2)).state(model())[0].openings == ()


def test_a_flow_rate_is_a_speed_times_a_cross_section() -> None:
    state, _ = tap(speed=None, flow_rate=0.25).outlet(**OUTLET, flow_rate=0.5).state(model())
    assert [opening.speed for opening in state.openings] == [pytest.approx(2.0), pytest.approx(-0.5)]


@pytest.mark.parametrize("width", [0.2, 0.13, 1.9 * SPACING])
def test_a_flow_rate_is_kept_whatever_the_width(width: float) -> None:
    """Layers have a whole number of nodes per line, so the speed makes up for the rest of the width."""
    state, metadata = tap(speed=None, flow_rate=0.05, size=(width, 0.125)).state(model())
    inlet, *_ = state.openings
    assert inlet.speed is not None
    assert inlet.num_in_layer * SPACING * inlet.speed == pytest.approx(0.05)
    np.testing.assert_allclose(state.vel, inlet.velocity_at(0.0)[None].repeat(state.num_nodes, 0))
    entered = sum(len(inlet.entering(k * metadata.frame_dt, (k + 1) * metadata.frame_dt)) for k in range(400))
    assert entered * inlet.mass == pytest.approx(1600 * 0.05 * 400 * metadata.frame_dt, abs=inlet.num_in_layer * inlet.mass)


def test_what_an_inlet_moves_has_not_fallen_before_the_start() -> None:
    state, metadata = tap(at=(0.4, 0.6), size=(0.2, 0.2)).block("sand", at=(0.1, 0.4), size=(0.1, 0.1)).state(model())
    history = model().standing(state, metadata).velocity_history
    assert history is not None
    inside = state.openings[0].contains(state.pos)
    assert inside.any() and not inside.all()
    assert (history[inside, :, 1] == -1.5).all()
    assert (history[~inside, :, 1] > 0).all()  # upward, before gravity brought it to rest at the start


def test_tables_of_speeds_and_flow_rates() -> None:
    table = [[0, 0.25], [1, 0.5], [2, -0.125]]
    state, _ = tap(speed=None, flow_rate=table).outlet(**OUTLET, speed=[(0, 0), (1, 2)]).state(model())
    inlet, outlet = state.openings
    assert inlet.speed is None
    assert inlet.speeds == ((0.0, 2.0), (1.0, 4.0), (2.0, -1.0))
    assert outlet.speeds == ((0.0, 0.0), (1.0, -2.0))
    assert inlet.enters
    assert not outlet.enters
    assert (state.vel == (0.0, -2.0)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": [[0, 1], [0, 2]]}, "inlet 1 (sand): speed: pair 2 is at 0 s, must be later than 0 s"),
        ({"speed": [[0, -1], [1, 0]]}, "inlet 1 (sand): speed: has no positive value, so nothing would pass"),
        (
            {"speed": "fast"},
            "inlet 1 (sand): speed='fast': must be a positive number, or pairs of a time [s] and a value, such as [[0, 0.5], [1, 1.5]]",
        ),
        ({"speed": [[0, True]]}, "inlet 1 (sand): speed=[[0, True]]: must be a positive number, or pairs of a time [s] and a value"),
    ],
)
def test_impossible_tables_get_one_clear_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneFault, match=re.escape(message)):
        tap(**changes).state(model())


def test_outlets_let_nothing_in() -> None:
    message = "outlet 2: speed: has a negative value; an inlet takes material out while its speed is negative, and needs its material for the rest"
    with pytest.raises(SceneFault, match=re.escape(message)):
        tap().outlet(**OUTLET, speed=[[0, 1], [1, -1]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"side": "z_low"}, "inlet 1 (sand): side='z_low': must be one of x_low, x_high, y_low, y_high"),
        ({"speed": None}, "inlet 1 (sand): speed, flow_rate: missing; give speed in m/s or flow_rate in m³/s (m²/s in 2D)"),
        ({"flow_rate": 1.0}, "inlet 1 (sand): speed, flow_rate: give speed in m/s or flow_rate in m³/s (m²/s in 2D), not both"),
        ({"speed": -1.0}, "inlet 1 (sand): speed=-1.0: must be a positive number"),
        ({"velocity": (0.0, 1.0)}, "inlet 1 (sand): velocity: follows from speed and side; leave it out"),
        ({"angle": 30}, "inlet 1 (sand): angle: unknown key"),
        ({"material": "sant"}, "inlet 1 (sant): unknown material; did you mean 'sand'?"),
        ({"at": (0.25, 0.9)}, "inlet 1 (sand): at, size: reaches from 0.9 to 1.025 m along y, the box from 0 to 1 m"),
        ({"size": (0.125, 0.03)}, "inlet 1 (sand): is 0.03 m deep along y; make it at least as deep as nodes see each other, 0.0585938 m"),
        ({"size": (0.01, 0.125)}, "inlet 1 (sand): is 0.01 m wide, less than the distance of nodes, 0.015625 m"),
    ],
)
def test_impossible_inlets_get_one_clear_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneFault, match=re.escape(message)):
        tap(**changes).state(model())


def test_bodies_must_not_be_in_an_inlet() -> None:
    scene = tap().block("sand", at=(0.3, 0.8), size=(0.2, 0.15))
    with pytest.raises(SceneFault, match=re.escape("inlet 1 (sand): overlaps block 1 (sand); move one of the two")):
        scene.state(model())


def test_meshes_cannot_enter() -> None:
    scene = Scene(box=(1.0, 1.0)).inlet(**{**INLET, "material": "elastomer"})
    with pytest.raises(SceneFault, match="elastomer has a mesh, and nodes of a mesh cannot enter one after the other"):
        scene.state(LearnedSimulator.from_checkpoint("elastomer"))


def test_exported_programs_and_pages_refuse_openings() -> None:
    state, metadata = tap().state(model())
    message = "exported programs and pages have no inlets and outlets, and this scene has 1"
    with pytest.raises(OpenSceneError, match=message):
        scene_of(model(), model().standing(state, metadata))
    with pytest.raises(OpenSceneError, match=message):
        state_for_page(state, [0], metadata.spacing)


def test_a_scene_file_has_openings(tmp_path: Path) -> None:
    path = tmp_path / "tap.yaml"
    path.write_text(
        "box: [1.0, 1.0]\nopenings:\n"
        "  - {inlet: sand, side: y_high, at: [0.25, 0.875], size: [0.125, 0.125], speed: 1.5}\n"
        "  - {outlet: x_high, at: [0.9, 0.0], size: [0.1, 1.0]}\n"
    )
    from_file, from_python = (scene.state(model())[0] for scene in (read_scene(path), tap().outlet(**OUTLET)))
    assert from_file.openings == from_python.openings
    np.testing.assert_array_equal(from_file.pos, from_python.pos)
    path.write_text(path.read_text().replace("speed: 1.5", "speed: [[0, 1.5], [1, -1]]"))
    assert read_scene(path).state(model())[0].openings[0].speeds == ((0.0, 1.5), (1.0, -1.0))
    path.write_text("box: [1.0, 1.0]\nopenings:\n  - {inlet: sand, at: [0.25, 0.875], size: [0.125, 0.125], speed: 1.5}\n")
    with pytest.raises(SceneFault, match=re.escape("inlet 1 (sand): side: missing")):
        read_scene(path)
    path.write_text("box: [1.0, 1.0]\nopenings:\n  - {tap: sand}\n")
    with pytest.raises(SceneFault, match=re.escape("openings, part 1: needs one of the keys inlet, outlet")):
        read_scene(path)


def test_a_model_predicts_what_enters_and_leaves(tmp_path: Path) -> None:
    drain: dict[str, Any] = {"side": "y_low", "at": (0.2, 0.8), "size": (0.3, 0.0625)}  # catches what the tap releases
    film = tap(speed=3.0).outlet(**drain).predict("sand", seconds=0.1)
    rollout = film.first
    assert rollout.termination is None
    assert rollout.alive is not None
    layers = round(0.1 * 3.0 / SPACING)
    assert rollout.num_nodes == 64 + 8 * layers
    half = rollout.num_frames // 2
    assert half == 10
    assert "\nin through y_high at 3 m/s\nout through y_low\n" in film.summary()
    assert "152 entered, " in film.summary()
    assert f"{1600 * SPACING**2 * rollout.alive[half:].sum(axis=1).mean():.4g} kg/m are there" in film.summary()
    assert (~rollout.alive[-1, :64]).sum() > 0
    assert (rollout.pos[rollout.alive][:, 1] > 0.8).all()
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [rollout])
    np.testing.assert_array_equal(read_trajectory(path, "00000", verify=True).alive, rollout.alive)
    for name in ("tap.html", "tap.png", "tap.npz"):
        assert film.write(tmp_path / name).stat().st_size > 1000
    with np.load(tmp_path / "tap.npz") as arrays:
        np.testing.assert_array_equal(arrays["alive"], rollout.alive)
        assert "y_low" in str(arrays["openings"])
