"""Openings whose speed changes in time, also its sign: layers, what enters and leaves, and storage."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from gpe_pl.data.validate import validate
from gpe_pl.metrics import per_frame_mse
from gpe_pl.metrics.open_scenes import entering, leaving, ledger, present
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.openings import Opening, openings_fault, openings_from_json, openings_to_json
from gpe_pl.trajectory.store import StoreError, read_trajectory, write_shard
from tests.open_scenes import DT, GRAVITY, OPENINGS, OUTLET, STEADY, TURNING, open_state, open_trajectory

RAMP = Opening((0.0, 0.0), (0.3, 0.2), "x_low", None, 0.1, 0, 2.0, (30.0,), ((0.0, 0.0), (1.0, 1.0), (3.0, -1.0)))


def test_travel_is_the_integral_of_the_speed() -> None:
    times = np.linspace(0.0, 5.0, 20_001)
    speeds = np.array([RAMP.speed_at(t) for t in times])
    way = np.concatenate([[0.0], np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2)])
    for k in (0, 3_000, 7_777, 20_000):
        assert RAMP.travel(times[k]) == pytest.approx(way[k], abs=1e-6)
    assert (RAMP.speed_at(-1.0), RAMP.speed_at(9.0)) == (0.0, -1.0)
    np.testing.assert_allclose(RAMP.mean_velocity(0.0, 1.0), [0.5, 0.0])
    np.testing.assert_allclose(replace(RAMP, side="x_high").velocity_at(1.0), [-1.0, 0.0])


def test_openings_say_what_they_do() -> None:
    texts = [
        str(opening)
        for opening in (STEADY, TURNING, OUTLET, replace(OUTLET, speed=-2.0), replace(OUTLET, speeds=((0.0, -2.0), (1.0, 0.0))))
    ]
    assert texts == [
        "in through x_low at 1 m/s",
        "in and out through y_high at -0.8 to 0.8 m/s",
        "out through y_low",
        "out through y_low at 2 m/s",
        "out through y_low at 0 to 2 m/s",
    ]


def test_layers_enter_and_leave_with_the_speed() -> None:
    present, dt = RAMP.nodes_at_start(), 0.05
    counts = [len(present)]
    for k in range(68):
        start, end = k * dt, (k + 1) * dt
        before, present = present, present + dt * RAMP.mean_velocity(start, end)
        present = present[~RAMP.removes(before, present, start, end)]
        present = np.concatenate([present, RAMP.entering(start, end)])
        depth = np.unique(np.round(RAMP.depth_of(present), 9))
        assert 0 <= depth[0] < 0.1 + 1e-6
        np.testing.assert_allclose(np.diff(depth), 0.1, atol=1e-6)
        counts.append(len(present))
    assert max(counts) == counts[0] + 2 * round(RAMP.travel(2.0) / 0.1)
    assert counts[-1] == counts[0] + 2 * round(RAMP.travel(3.4) / 0.1)


def test_what_was_drawn_in_does_not_lie_on_new_layers() -> None:
    """Nodes that come from the scene are between the layers. A layer that enters after them keeps half a spacing from them."""
    zone = Opening((0.0, 0.0), (0.3, 0.1), "x_low", None, 0.1, 0, 2.0, (30.0,), ((0.0, -1.0), (1.0, -1.0), (1.001, 1.0)))
    foreign, dt, closest = np.array([[0.1 * k + 0.033, 0.05] for k in range(3, 14)]), 0.01, np.inf
    layers = np.empty((0, 2))
    for k in range(150):
        start, end = k * dt, (k + 1) * dt
        way = dt * zone.mean_velocity(start, end)
        kept = [group[~zone.removes(group, group + way, start, end)] + way for group in (foreign, layers)]
        foreign, layers = kept[0], np.concatenate([kept[1], zone.entering(start, end)])
        if len(foreign) and len(layers):
            closest = min(closest, float(np.abs(foreign[:, None, 0] - layers[None, :, 0]).min()))
    assert len(foreign)
    assert len(layers)
    assert 0.05 - 1e-9 <= closest < 0.1


def test_numbers_add_up_in_a_rollout() -> None:
    trajectory = open_trajectory(40)
    count = present(trajectory).sum(axis=1)
    np.testing.assert_array_equal(count, count[0] + np.cumsum(entering(trajectory) - leaving(trajectory)))
    inlets = trajectory.material_params[:, 0]
    assert set(np.unique(inlets)) == {30.0, 40.0}  # each inlet has parameters of its own
    seconds = 39 * DT
    assert (inlets == 30.0).sum() == len(STEADY.nodes_at_start()) + 2 * round(seconds / 0.1)
    assert leaving(trajectory)[25:].sum() > 0
    top = trajectory.pos[-1, present(trajectory)[-1] & (inlets == 40.0), 1]
    assert not len(top)  # the inlet has taken back what is in it, and the rest fell


def test_momentum_changes_by_forces_and_by_what_enters_and_leaves() -> None:
    book = ledger(open_trajectory(40))
    change = np.diff(book.momentum, axis=0)
    np.testing.assert_allclose(change, book.forces[1:] + book.entered_momentum[1:] - book.left_momentum[1:], atol=1e-9)
    trajectory = open_trajectory(40)
    assert trajectory.alive is not None
    stays = trajectory.alive[1:] & trajectory.alive[:-1]
    inside = np.any([opening.contains(trajectory.pos[:-1].reshape(-1, 2)) for opening in OPENINGS[:2]], axis=0).reshape(stays.shape)
    falling = np.einsum("fn,n->f", stays & ~inside, trajectory.mass)
    turn = np.array([TURNING.mean_velocity(k * DT, (k + 1) * DT) - TURNING.mean_velocity((k - 1) * DT, k * DT) for k in range(1, 39)])
    carried = np.einsum("fn,n->f", stays & inside & (trajectory.material_params[:, 0] == 40.0), trajectory.mass)
    expected = falling[1:, None] * DT * np.array(GRAVITY) + carried[1:, None] * turn
    np.testing.assert_allclose(book.forces[2:], expected, atol=2e-3)


def test_tables_are_stored_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [open_trajectory()])
    found = read_trajectory(path, "00000", verify=True)
    assert found.openings == OPENINGS
    assert not validate([path]).violations


def test_openings_of_one_speed_are_stored_as_before(tmp_path: Path) -> None:
    text = openings_to_json([STEADY])
    assert "speeds" not in text
    assert openings_from_json(text) == (STEADY,)
    assert openings_from_json(openings_to_json(OPENINGS)) == OPENINGS
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [replace(open_trajectory(), openings=(STEADY,))])
    with h5py.File(path) as file:
        assert json.loads(file["00000"].attrs["openings"].decode())[0].keys() == {
            *("low", "high", "side", "speed", "spacing", "node_type", "mass", "params")
        }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speeds": ((0.0, 1.0), (0.0, 2.0))}, "opening 1: speeds pair 2 is at 0 s, must be later than 0 s"),
        ({"speeds": ((0.0, float("nan")),)}, "opening 1: speeds pair 1 is (0.0, nan), must be a time [s] and a speed [m/s]"),
        ({"speed": 1.0}, "opening 1: speed is 1.0, must be null beside speeds"),
        ({"params": ()}, "opening 1: params are (), must be one number or null for each of 1 columns"),
    ],
)
def test_faults_of_tables_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    wrong = replace(RAMP, **changes)  # type: ignore[arg-type]
    assert openings_fault([RAMP], 2, 1, 5) is None
    assert openings_fault([wrong], 2, 1, 5) == message
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [open_trajectory()])
    with h5py.File(path, "r+") as file:
        file["00000"].attrs["openings"] = np.bytes_(openings_to_json([wrong]).replace("NaN", "1e300").encode())
    with pytest.raises(StoreError, match="opening 1: "):
        read_trajectory(path, "00000")


@pytest.mark.parametrize("stride", [2, 4])
def test_longer_frames_number_nodes_as_a_rollout_with_longer_frames_does(stride: int) -> None:
    """Two inlets take turns within a longer frame."""
    start = replace(open_state(), gravity=np.zeros(2)).opened((STEADY, replace(TURNING, speeds=((0.0, 0.8),))))
    metadata = open_trajectory(3).metadata
    short, long = (
        rollout(
            Ballistic(DT * k), replace(start, velocity_history=np.asarray(start.vel)[:, None]), 24 // k, replace(metadata, frame_dt=DT * k)
        )
        for k in (1, stride)
    )
    found = short.every(stride)
    assert found.num_nodes == long.num_nodes > start.num_nodes
    assert found.alive is not None
    assert long.alive is not None
    np.testing.assert_array_equal(found.alive, long.alive)
    assert float(per_frame_mse(long, found).max()) < 1e-12
