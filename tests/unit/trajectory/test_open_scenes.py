"""Open scenes: openings, their storage, and states that have the nodes that are in the scene now."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from gpe_pl.data.validate import validate
from gpe_pl.schema import FIELDS
from gpe_pl.trajectory.living import columns
from gpe_pl.trajectory.openings import Opening, carried, openings_fault
from gpe_pl.trajectory.reflection import Reflection, Rotation
from gpe_pl.trajectory.store import StoreError, read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.open_scenes import BOUNDS, OPENINGS, open_state

INLET = Opening((0.0, 0.0), (0.3, 0.2), "x_low", speed=0.5, spacing=0.1, node_type=0, mass=2.0, params=(30.0,))


@pytest.fixture
def channel(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory whose node 0 leaves after frame 3, and whose last node enters in frame 2."""
    alive = np.ones((trajectory.num_frames, trajectory.num_nodes), bool)
    alive[4:, 0] = alive[:2, -1] = False
    return replace(trajectory, alive=alive, openings=(INLET, Opening((0.8, 0.0), (1.0, 0.5), "x_high")))


@pytest.mark.parametrize("side", ["x_low", "x_high", "y_low", "y_high"])
def test_nodes_enter_at_the_flow_rate_on_a_lattice_that_moves(side: str) -> None:
    inlet = replace(INLET, low=(0.0, 0.0), high=(0.3, 0.3), side=side)
    start = inlet.nodes_at_start()
    assert len(start) == 9
    assert inlet.contains(start).all()
    present, dt, num_steps = start, 0.07, 100
    for k in range(num_steps):
        present = np.concatenate([present + dt * inlet.velocity_at(0.0), inlet.entering(k * dt, (k + 1) * dt)])
        depth = np.sort(np.unique(np.round(inlet.depth_of(present), 9)))
        assert depth[0] >= 0
        np.testing.assert_allclose(np.diff(depth), 0.1, atol=1e-6)
    assert len(present) - len(start) == 3 * round(0.5 * num_steps * dt / 0.1)


def test_an_opening_removes_nodes_by_its_kind() -> None:
    pos = np.array([[0.95, 0.1], [1.02, 0.1], [0.95, 0.4], [0.5, 0.1]])
    outlet = Opening((0.9, 0.0), (1.0, 0.3), "x_high")
    before = pos - [0.05, 0.0]
    assert outlet.removes(before, pos, 0.0, 0.1).tolist() == [True, True, False, False]
    assert outlet.removes(pos, pos, 0.0, 0.1).tolist() == [True, False, False, False]  # what was beyond the face does not leave
    assert replace(outlet, speed=-1.0).removes(before, pos, 0.0, 0.1).tolist() == [False, True, False, False]
    assert not replace(outlet, speed=-1.0).removes(pos, pos, 0.0, 0.1).any()
    assert len(outlet.entering(0.0, 9.0)) == 0
    assert len(replace(outlet, speed=-1.0, spacing=0.1).entering(0.0, 9.0)) == 0


def test_round_trip(tmp_path: Path, channel: Trajectory) -> None:
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [channel])
    found = read_trajectory(path, "00000", verify=True)
    assert found.alive is not None
    np.testing.assert_array_equal(found.alive, channel.alive)
    assert found.openings == channel.openings
    assert not validate([path]).violations
    early = read_trajectory(path, "00000", frames=slice(0, 2))
    assert early.num_nodes == channel.num_nodes - 1  # a node that has not entered is left out


def test_openings_are_part_of_the_digest_and_checked(tmp_path: Path, channel: Trajectory) -> None:
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [channel])
    with h5py.File(path, "r+") as file:
        values = json.loads(file["00000"].attrs["openings"].decode())
        values[1]["side"] = "z_low"
        file["00000"].attrs["openings"] = np.bytes_(json.dumps(values).encode())
    with pytest.raises(StoreError, match="SHA-256"):
        read_trajectory(path, "00000", verify=True)
    with pytest.raises(StoreError, match="opening 2: side is 'z_low', must be one of x_low, x_high, y_low, y_high"):
        read_trajectory(path, "00000")
    with h5py.File(path, "r+") as file:
        values[1]["speed"] = "fast"
        file["00000"].attrs["openings"] = np.bytes_(json.dumps(values).encode())
    with pytest.raises(StoreError, match="attribute 'openings' is unreadable"):
        read_trajectory(path, "00000")


def test_files_from_before_open_scenes_are_sound(tmp_path: Path, trajectory: Trajectory) -> None:
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [trajectory])
    with h5py.File(path, "r+") as file:
        units = {key: spec.unit for key, spec in FIELDS.items() if key != "alive"}
        file.attrs["units"] = np.bytes_(json.dumps(units).encode())
    assert not validate([path]).violations
    assert read_trajectory(path, "00000", verify=True).alive is None
    with h5py.File(path, "r+") as file:
        file.attrs["units"] = np.bytes_(json.dumps({**units, "pos": "mm"}).encode())
    assert [v.field for v in validate([path]).violations] == ["units"]


def test_a_node_that_enters_twice_is_refused(tmp_path: Path, channel: Trajectory) -> None:
    assert channel.alive is not None
    channel.alive[-1, 0] = True
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [channel])
    with pytest.raises(StoreError, match=rf"frame {channel.num_frames - 1}, node 0: enters the scene again"):
        read_trajectory(path, "00000")


def test_a_state_has_the_living_nodes(channel: Trajectory) -> None:
    last = channel.num_nodes - 1
    before, after = channel.state(1), channel.state(5)
    assert before.node_id is not None
    assert after.node_id is not None
    assert before.node_id.tolist() == [*range(last)]
    assert after.node_id.tolist() == [*range(1, last + 1)]
    assert (before.next_id, after.next_id) == (last, last + 1)
    assert after.openings == channel.openings
    np.testing.assert_array_equal(after.pos, channel.pos[5, 1:])
    assert after.identity(0) == 1


def test_the_history_of_a_node_that_entered_is_its_velocity_there(channel: Trajectory) -> None:
    state, closed = channel.state(4, history=4), replace(channel, alive=None).state(4, history=4)
    assert state.velocity_history is not None
    assert closed.velocity_history is not None
    np.testing.assert_allclose(state.velocity_history[-1, :2], np.tile(channel.vel[2, -1], (2, 1)))
    np.testing.assert_array_equal(state.velocity_history[-1, 2:], closed.velocity_history[-1, 2:])
    np.testing.assert_array_equal(state.velocity_history[:-1], closed.velocity_history[1:-1])
    entered = channel.state(2, history=2)
    np.testing.assert_allclose(entered.vel[-1], channel.vel[2, -1])


def test_frames_leave_out_nodes_that_are_in_none_of_them(channel: Trajectory) -> None:
    assert channel.frames(0, 2).num_nodes == channel.num_nodes - 1
    assert channel.frames(4).num_nodes == channel.num_nodes - 1
    assert channel.frames(3, 5).num_nodes == channel.num_nodes
    np.testing.assert_array_equal(channel.frames(4).state(0).pos, channel.state(4).pos)


def test_longer_frames_keep_the_places_of_entry_and_exit(channel: Trajectory) -> None:
    longer = channel.every(3)
    assert longer.alive is not None and not longer.alive.all()
    first, last = longer.alive.argmax(axis=0), longer.num_frames - 1 - longer.alive[::-1].argmax(axis=0)
    for node in range(longer.num_nodes):
        np.testing.assert_array_equal(longer.pos[: first[node], node], np.broadcast_to(longer.pos[first[node], node], (first[node], 2)))
        assert (longer.pos[last[node] :, node] == longer.pos[last[node], node]).all()


def test_columns_keep_identities_and_the_nearest_values() -> None:
    values, alive, ids = columns(
        [np.array([0, 4]), np.array([4, 5]), np.array([5])], [np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0])]
    )
    assert ids.tolist() == [0, 4, 5]
    assert alive.tolist() == [[True, True, False], [False, True, True], [False, False, True]]
    assert values.tolist() == [[1.0, 2.0, 4.0], [1.0, 3.0, 4.0], [1.0, 3.0, 5.0]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"low": (0.0,)}, "low is (0.0,), must be 2 numbers"),
        ({"high": (0.3, float("nan"))}, "high is (0.3, nan), must be 2 numbers"),
        ({"high": (0.0, 0.2)}, "low (0.0, 0.0) must be below high (0.0, 0.2) along every axis"),
        ({"speed": float("inf")}, "speed is inf, must be a number of m/s or null"),
        ({"spacing": -0.1}, "spacing is -0.1, must be at least 0"),
        ({"mass": 0.0}, "mass is 0.0, must be positive"),
        ({"node_type": 77}, "node_type is 77, must be the code of a material"),
        ({"params": ()}, "params are (), must be one number or null for each of 1 columns"),
    ],
)
def test_faults_of_openings_are_named(changes: dict[str, object], message: str) -> None:
    assert openings_fault([INLET], 2, 1, 5) is None
    assert openings_fault([replace(INLET, **changes)], 2, 1, 5) == f"opening 1: {message}"  # type: ignore[arg-type]


def test_openings_are_mirrored_with_their_scene() -> None:
    """Averages over mirror images need it: the graph of an image asks which nodes are in an opening."""
    pos = np.random.default_rng(0).uniform(0.0, 1.0, (200, 2))
    for axes in ([0], [1], [0, 1]):
        mirror = Reflection.of(BOUNDS, axes)
        images = mirror.openings(OPENINGS)
        np.testing.assert_array_equal(carried(images, mirror.point(pos)), carried(OPENINGS, pos))
        for opening, image in zip(OPENINGS, images, strict=True):
            if opening.enters:
                where = mirror.point(np.array(opening.nodes_at_start()))
                np.testing.assert_allclose(sorted(where.tolist()), sorted(np.array(image.nodes_at_start()).tolist()), atol=1e-9)
        again = mirror.openings(images)
        assert [o.side for o in again] == [o.side for o in OPENINGS]
        np.testing.assert_allclose([o.low for o in again], [o.low for o in OPENINGS], atol=1e-12)
    state = open_state()
    assert Reflection.of(BOUNDS, [0]).state(state, state.boundary).openings[0].side == "x_high"
    with pytest.raises(ValueError, match="inlets and outlets lie along the axes, so they cannot be turned"):
        Rotation.between_axes(1, [0.5, 0.5]).state(state, state.boundary)
