"""The store: written data read back unchanged, and damage is noticed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gpe_pl.errors import GpeError
from gpe_pl.schema import NODE_TYPES, SCHEMA_VERSION
from gpe_pl.trajectory.state import Stress, von_mises
from gpe_pl.trajectory.store import StoreError, iter_trajectories, read_metadata, read_trajectory, shards, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Termination, Trajectory

New = Callable[..., Trajectory]


def assert_same(a: Trajectory, b: Trajectory) -> None:
    assert a.metadata == b.metadata
    for f in fields(Trajectory):
        if f.name not in ("metadata", "boundary", "termination", "stress"):
            np.testing.assert_array_equal(getattr(a, f.name), getattr(b, f.name), err_msg=f.name)
    for f in fields(a.boundary):
        if f.name != "shapes":
            np.testing.assert_array_equal(getattr(a.boundary, f.name), getattr(b.boundary, f.name), err_msg=f.name)
    assert a.boundary.shapes == b.boundary.shapes
    assert (a.stress is None) == (b.stress is None)
    if a.stress is not None and b.stress is not None:
        np.testing.assert_array_equal(a.stress.node, b.stress.node)
        np.testing.assert_array_equal(a.stress.cell, b.stress.cell)


@pytest.fixture
def shard(tmp_path: Path, trajectory: Trajectory) -> Path:
    path = tmp_path / "train" / "shard-00000.h5"
    write_shard(path, [trajectory])
    return path


def test_round_trip(shard: Path, trajectory: Trajectory) -> None:
    assert trajectory_names(shard) == ["00000"]
    assert read_metadata(shard, "00000") == trajectory.metadata
    assert_same(read_trajectory(shard, "00000", verify=True), trajectory)


def test_round_trip_of_mesh_fields(tmp_path: Path, trajectory: Trajectory) -> None:
    rng = np.random.default_rng(1)
    mesh = replace(
        trajectory,
        rest_pos=rng.random((12, 2)).astype(np.float32),
        cells=rng.integers(0, 12, (7, 3), dtype=np.int32),
        stress=Stress(rng.normal(size=(6, 12, 4)).astype(np.float32), rng.normal(size=(6, 7, 4)).astype(np.float32)),
    )
    write_shard(tmp_path / "mesh.h5", [mesh])
    assert_same(read_trajectory(tmp_path / "mesh.h5", "00000", verify=True), mesh)


def test_half_a_stress_is_refused(tmp_path: Path, trajectory: Trajectory) -> None:
    stressed = replace(trajectory, stress=Stress(np.zeros((6, 12, 4), np.float32), np.zeros((6, 7, 4), np.float32)))
    write_shard(tmp_path / "mesh.h5", [stressed])
    with h5py.File(tmp_path / "mesh.h5", "r+") as file:
        del file["00000/cell_stress"]
    with pytest.raises(StoreError, match="only one of the fields 'node_stress' and 'cell_stress'"):
        read_trajectory(tmp_path / "mesh.h5", "00000")


def test_von_mises_of_known_stresses() -> None:
    """Uniaxial tension s: s; pure shear τ: √3 τ; hydrostatic: 0."""
    uniaxial, shear, hydrostatic = [0.0, 0.0, 3.0, 0.0], [0.0, 2.0, 0.0, 0.0], [5.0, 0.0, 5.0, 5.0]
    np.testing.assert_allclose(von_mises(np.array([uniaxial, shear, hydrostatic])), [3.0, 2 * 3**0.5, 0.0], atol=1e-12)
    spatial = [[0.0, 0, 0, 0, 0, -3.0], [0.0, 1, 2, 0, 2, 0], [5.0, 0, 0, 5, 0, 5]]
    np.testing.assert_allclose(von_mises(np.array(spatial)), [3.0, 3 * 3**0.5, 0.0], atol=1e-12)


def test_round_trip_without_nodes_or_with_long_text(tmp_path: Path, trajectory: Trajectory, new_trajectory: New) -> None:
    empty = new_trajectory(num_nodes=0)
    long = replace(trajectory, metadata=replace(trajectory.metadata, config='{"text": "' + "ü" * 200_000 + '"}'))
    write_shard(tmp_path / "odd.h5", [empty, long])
    assert_same(read_trajectory(tmp_path / "odd.h5", "00000", verify=True), empty)
    assert_same(read_trajectory(tmp_path / "odd.h5", "00001", verify=True), long)


def test_only_some_frames(shard: Path, trajectory: Trajectory) -> None:
    part = read_trajectory(shard, "00000", frames=slice(2, 5))
    assert_same(part, trajectory.frames(2, 5))
    with pytest.raises(ValueError, match="verify"):
        read_trajectory(shard, "00000", verify=True, frames=slice(2, 5))
    with pytest.raises(ValueError, match=r"must not have a step; take every so many frames with Trajectory\.every"):
        read_trajectory(shard, "00000", frames=slice(0, None, 2))


def test_a_part_remembers_when_it_begins(tmp_path: Path, trajectory: Trajectory) -> None:
    """This also holds for parts from the end, parts of parts and with a checksum. Whole trajectories do not have the attribute."""
    dt, last = trajectory.metadata.frame_dt, trajectory.num_frames - 1
    write_shard(tmp_path / "part.h5", [trajectory, trajectory.frames(1)])
    whole, part = (read_trajectory(tmp_path / "part.h5", name, verify=True) for name in ("00000", "00001"))
    assert (whole.start_time, part.start_time) == (0.0, dt)
    for name in ("00000", "00001"):
        end = read_trajectory(tmp_path / "part.h5", name, frames=slice(-1, None))
        assert end.start_time == pytest.approx(last * dt) and end.num_frames == 1
    with h5py.File(tmp_path / "part.h5", "r+") as file:
        assert "start_time" not in file["00000"].attrs
        for text, message in (("1.5", "SHA-256"), ("null", "'start_time' is unreadable: must be a number"), ("NaN", "must be a number")):
            file["00001"].attrs["start_time"] = np.bytes_(text.encode())
            file.flush()
            with pytest.raises(StoreError, match=message):
                read_trajectory(tmp_path / "part.h5", "00001", verify=message == "SHA-256")


def test_node_types_are_stored_by_name(shard: Path, trajectory: Trajectory) -> None:
    """A later schema may number the node types differently; names decide."""
    with h5py.File(shard, "r+") as file:
        file["00000"].attrs["node_types"] = np.bytes_(b'["snow", "sand"]')
        file["00000/node_type"][:] = 1
    assert {NODE_TYPES[k] for k in read_trajectory(shard, "00000").node_type} == {"sand"}


@pytest.mark.slow
def test_equal_content_gives_equal_bytes(tmp_path: Path, trajectory: Trajectory) -> None:
    write_shard(tmp_path / "a.h5", [trajectory, trajectory])
    time.sleep(1.1)  # HDF5's time stamps count whole seconds
    write_shard(tmp_path / "b.h5", [trajectory, trajectory])
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_exception_in_the_middle_leaves_no_file(tmp_path: Path, trajectory: Trajectory) -> None:
    def broken() -> Iterator[Trajectory]:
        yield trajectory
        raise RuntimeError("solver failed")

    with pytest.raises(RuntimeError, match="solver failed"):
        write_shard(tmp_path / "new" / "shard.h5", broken())
    assert list((tmp_path / "new").iterdir()) == []


def test_exception_in_the_middle_keeps_the_old_file(shard: Path, trajectory: Trajectory) -> None:
    before = shard.read_bytes()

    def broken() -> Iterator[Trajectory]:
        yield trajectory
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shard(shard, broken())
    assert shard.read_bytes() == before
    assert os.listdir(shard.parent) == [shard.name]


def test_too_few_names(tmp_path: Path, trajectory: Trajectory) -> None:
    with pytest.raises(ValueError, match="1 names for more than 1 trajectories"):
        write_shard(tmp_path / "shard.h5", [trajectory, trajectory], names=["a"])
    assert not (tmp_path / "shard.h5").exists()


@pytest.mark.parametrize("name", ["a/b", "00001\0x", "", "."])
def test_names_that_hdf5_would_change_are_refused(tmp_path: Path, trajectory: Trajectory, name: str) -> None:
    with pytest.raises(StoreError, match=r"shard\.h5: .* cannot name a trajectory; choose a name that is not empty"):
        write_shard(tmp_path / "shard.h5", [trajectory], names=[name])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rigid_body": np.array([2**32 - 1] * 3 + [-1] * 9)}, "field 'rigid_body': 4294967295 cannot be stored as int32"),
        ({"rigid_body": np.array([0.5] * 12)}, r"field 'rigid_body': 0\.5 cannot be stored as int32"),
        ({"node_type": np.full(12, 256)}, "field 'node_type': 256 cannot be stored as uint8"),
        ({"start_time": float("nan")}, "start_time is nan; give a number of seconds"),
    ],
)
def test_values_that_would_be_read_as_others_are_refused(
    tmp_path: Path, trajectory: Trajectory, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(StoreError, match=rf"shard\.h5:00000: {message}"):
        write_shard(tmp_path / "shard.h5", [replace(trajectory, **change)])


def test_a_seed_has_at_most_as_many_digits_as_are_read(tmp_path: Path, trajectory: Trajectory) -> None:
    largest, larger = (replace(trajectory, metadata=replace(trajectory.metadata, seed=seed)) for seed in (10**20 - 1, 10**20))
    write_shard(tmp_path / "shard.h5", [largest])
    assert read_metadata(tmp_path / "shard.h5", "00000").seed == 10**20 - 1
    with pytest.raises(StoreError, match=r"shard\.h5:00000: the seed in the metadata has more than 20 digits"):
        write_shard(tmp_path / "shard.h5", [larger])


def test_positions_that_float32_rounds_have_one_warning(tmp_path: Path, trajectory: Trajectory, caplog: pytest.LogCaptureFixture) -> None:
    near = replace(trajectory, pos=trajectory.pos.astype(np.float64) + 1.0 / 3.0)
    write_shard(tmp_path / "shard.h5", [near, replace(near, pos=near.pos.astype(np.float32) + np.float32(5e6))])
    assert not caplog.messages
    write_shard(tmp_path / "shard.h5", [near, *[replace(near, pos=near.pos + 5e6)] * 2])
    (message,) = caplog.messages
    assert "shard.h5:00001: positions are stored in float32, which rounds them by up to 0.2" in message


def test_errors_name_the_file(shard: Path) -> None:
    with pytest.raises(StoreError, match=r"nothing\.h5: no such file"):
        read_trajectory(shard.with_name("nothing.h5"), "00000")
    with pytest.raises(StoreError, match=r"shard-00000\.h5: no trajectory '7'; it has 1 trajectories"):
        read_trajectory(shard, "7")
    with pytest.raises(StoreError, match="has no split 'val' but train"):
        shards(shard.parent.parent, "val")


def test_wrong_schema_version(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    with pytest.raises(StoreError, match=rf"shard-00000\.h5: schema version {SCHEMA_VERSION + 1}.*reads {SCHEMA_VERSION}"):
        trajectory_names(shard)


@pytest.mark.parametrize("key", ["pos", "boundary_normal", "node_type"])
def test_missing_field(shard: Path, key: str) -> None:
    with h5py.File(shard, "r+") as file:
        del file["00000"][key]
    with pytest.raises(StoreError, match=rf"shard-00000\.h5:00000: field '{key}' is missing"):
        read_trajectory(shard, "00000")


def replace_field(shard: Path, key: str, data: np.ndarray | h5py.ExternalLink | h5py.SoftLink) -> None:
    with h5py.File(shard, "r+") as file:
        del file["00000"][key]
        file["00000"][key] = data


def test_wrong_type_and_shape(shard: Path, trajectory: Trajectory) -> None:
    replace_field(shard, "mass", trajectory.mass.astype(np.float64))
    with pytest.raises(StoreError, match=r"field 'mass' is float64\[12\], expected float32 \[node\]"):
        read_trajectory(shard, "00000")
    replace_field(shard, "mass", trajectory.mass[:-1])
    with pytest.raises(StoreError, match="field 'mass' has size 11 along 'node', expected 12"):
        read_trajectory(shard, "00000")


def test_a_shard_refers_to_no_other_file(shard: Path, tmp_path: Path, trajectory: Trajectory) -> None:
    write_shard(tmp_path / "other.h5", [trajectory])
    replace_field(shard, "vel", h5py.ExternalLink(str(tmp_path / "other.h5"), "/00000/vel"))
    with pytest.raises(StoreError, match="field 'vel' is not an array inside this file"):
        read_trajectory(shard, "00000")


def test_huge_shape_without_data_is_refused_before_it_fills_the_memory(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        del file["00000"]["pos"]
        file["00000"].create_dataset("pos", (2**20, 2**20, 2), "float32", chunks=(1, 12, 2))
    with pytest.raises(StoreError, match="field 'pos' claims 8796093022208 bytes, the file holds"):
        read_trajectory(shard, "00000")


def test_variable_length_text_is_refused(shard: Path) -> None:
    """Damage in such text hangs HDF5, so it must not even be read."""
    with h5py.File(shard, "r+") as file:
        file["00000"].attrs["metadata"] = file["00000"].attrs["metadata"].decode()
    with pytest.raises(StoreError, match="'metadata' is object.*expected text of fixed length"):
        read_trajectory(shard, "00000")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("metadata", b"{", "metadata unreadable"),
        ("metadata", b"[1]", "metadata unreadable"),
        ("metadata", b"[" * 100_000, "metadata unreadable"),
        ("metadata", b'{"dataset": 1}', "metadata unreadable: keys .*'bounds'"),
        ("shapes", b'[{"kind": "cone"}]', "unknown shape kind 'cone'"),
        ("shapes", b"3", "'shapes' is unreadable"),
        ("node_types", b'["sand", "lava"]', r"names \['lava'\]"),
        ("node_types", b"[]", "field 'node_type': node 0 and 11 more: the code stands for none of the data set's materials"),
    ],
)
def test_damaged_attributes(shard: Path, key: str, value: bytes, message: str) -> None:
    with h5py.File(shard, "r+") as file:
        file["00000"].attrs[key] = np.bytes_(value)
    with pytest.raises(StoreError, match=message):
        read_trajectory(shard, "00000")


def test_metadata_of_the_wrong_type(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        attrs = file["00000"].attrs
        attrs["metadata"] = np.bytes_(attrs["metadata"].replace(b'"frame_dt": 0.01', b'"frame_dt": "x"'))
    with pytest.raises(StoreError, match="00000: metadata unreadable: frame_dt: .*number"):
        read_trajectory(shard, "00000")


def test_changed_array_fails_the_digest(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        file["00000"]["pos"][2, 3, 1] += np.float32(1e-6)  # with HDF5's own checksum renewed
    read_trajectory(shard, "00000")
    with pytest.raises(StoreError, match=r"shard-00000\.h5:00000: SHA-256 digest does not match"):
        read_trajectory(shard, "00000", verify=True)


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_truncated_file(shard: Path, fraction: float) -> None:
    content = shard.read_bytes()
    shard.write_bytes(content[: int(len(content) * fraction)])
    with pytest.raises(StoreError, match=r"shard-00000\.h5"):
        read_trajectory(shard, "00000", verify=True)


# Flips one bit at each of the given positions in turn; a child process, so that a crash or an endless loop of HDF5 fails the test.
_FLIP = """
import sys
from pathlib import Path
import numpy as np
from gpe_pl.trajectory.store import StoreError, read_trajectory, trajectory_names

path, seed, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
content = path.read_bytes()
sound = read_trajectory(path, "00000", verify=True)
damaged = path.with_name("damaged.h5")
detected = 0
for bit in np.random.default_rng(seed).integers(0, 8 * len(content), count):
    flipped = bytearray(content)
    flipped[bit // 8] ^= 1 << (bit % 8)
    damaged.write_bytes(flipped)
    try:
        assert trajectory_names(damaged) == ["00000"], bit
        read = read_trajectory(damaged, "00000", verify=True)
    except StoreError as error:
        assert "damaged.h5" in str(error), (bit, error)
        detected += 1
        continue
    assert read.metadata == sound.metadata and read.boundary.shapes == sound.boundary.shapes, bit
    for owner in ("", "boundary"):
        a, b = (getattr(t, owner) if owner else t for t in (read, sound))
        for key, array in vars(a).items():
            if isinstance(array, np.ndarray):
                assert array.tobytes() == vars(b)[key].tobytes(), (bit, key)
print(detected)
"""


@pytest.mark.slow
def test_every_flipped_bit_is_detected_or_harmless(shard: Path) -> None:
    """A file that still reads after one bit flipped has the same content: the bit belonged to unused space or to a unit's text."""
    count = 600
    child = subprocess.run([sys.executable, "-c", _FLIP, str(shard), "7", str(count)], capture_output=True, text=True, timeout=120)
    assert child.returncode == 0, child.stderr
    assert int(child.stdout) > count / 2


def test_iter_trajectories(store: Path, new_trajectory: New) -> None:
    for read, seed in zip(iter_trajectories(store, "train"), (0, 1), strict=True):
        assert_same(read, new_trajectory(seed))


def test_state_uses_stored_velocities_without_history(trajectory: Trajectory) -> None:
    state = trajectory.state(3)
    np.testing.assert_array_equal(state.vel, trajectory.vel[3])
    assert state.pos.dtype == state.vel.dtype == np.float64
    assert state.velocity_history is None
    assert state.time == pytest.approx(0.03)


def test_state_differences_positions_with_history(trajectory: Trajectory) -> None:
    state = trajectory.state(4, history=3)
    assert state.velocity_history is not None
    assert state.velocity_history.shape == (12, 3, 2)
    for k, frame in enumerate((2, 3, 4)):  # oldest first
        expected = (trajectory.pos[frame].astype(np.float64) - trajectory.pos[frame - 1].astype(np.float64)) / 0.01
        np.testing.assert_allclose(state.velocity_history[:, k], expected, rtol=1e-14)
    np.testing.assert_array_equal(state.vel, state.velocity_history[:, -1])


def test_a_part_knows_when_its_rollout_stopped(trajectory: Trajectory) -> None:
    stopped = replace(trajectory, termination=Termination("nan", 9, 0, "frame 9"))
    for part, frame in (
        (stopped.frames(3), 6),
        (stopped.frames(2).every(2), 4),
        (stopped.every(2).frames(1), 4),
    ):
        assert part.termination is not None and part.termination.frame == frame
    assert stopped.frames(0, 2).termination is None  # these frames are good


def test_the_reason_why_a_rollout_stopped_is_stored(tmp_path: Path, trajectory: Trajectory) -> None:
    end = Termination("escape", 6, 3, "frame 6: node 3 is outside")
    write_shard(tmp_path / "a.h5", [replace(trajectory, termination=end), trajectory])
    assert read_trajectory(tmp_path / "a.h5", "00000", verify=True).termination == end
    assert read_trajectory(tmp_path / "a.h5", "00001", verify=True).termination is None
    assert read_trajectory(tmp_path / "a.h5", "00000", frames=slice(2, None)).termination == replace(end, frame=4)
    assert read_trajectory(tmp_path / "a.h5", "00000", frames=slice(2, 5)).termination is None
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        assert "termination" not in file["00001"].attrs
        for text in ("null", '{"reason": "x"}', '{"reason": "x", "frame": "6", "node": 0, "message": ""}'):
            file["00000"].attrs["termination"] = np.bytes_(text.encode())
            file.flush()
            with pytest.raises(StoreError, match="attribute 'termination' is unreadable: must have reason, frame, node, message"):
                read_trajectory(tmp_path / "a.h5", "00000")


@pytest.mark.parametrize("stride", [0, -1])
def test_a_stride_is_a_number_of_frames(trajectory: Trajectory, stride: int) -> None:
    with pytest.raises(ValueError, match="must be a positive whole number of frames"):
        trajectory.every(stride)


def test_a_part_has_a_frame(shard: Path, trajectory: Trajectory) -> None:
    for first, last in ((6, None), (3, 3), (4, 2)):
        with pytest.raises(ValueError, match=r"has no frame; the trajectory has 6 frames"):
            trajectory.frames(first, last)
        with pytest.raises(StoreError, match="has 6 frames, and none of slice"):
            read_trajectory(shard, "00000", frames=slice(first, last))


@pytest.mark.parametrize(("frame", "history"), [(-1, 0), (6, 0), (2, 3), (6, 2)])
def test_state_outside_the_trajectory(trajectory: Trajectory, frame: int, history: int) -> None:
    """A command prints it as one line; others catch what a wrong number raises everywhere."""
    with pytest.raises(IndexError, match=f"frame {frame} with history {history} is outside the 6 frames") as failure:
        trajectory.state(frame, history)
    assert isinstance(failure.value, GpeError)


def test_to_torch_and_back(trajectory: Trajectory) -> None:
    state = trajectory.state(4, history=2).to_torch()
    for key in ("pos", "vel", "velocity_history", "material_params", "gravity"):
        tensor = getattr(state, key)
        assert str(tensor.dtype) == "torch.float64", key
        np.testing.assert_array_equal(tensor.numpy(), getattr(trajectory.state(4, history=2), key))
    assert str(state.node_type.dtype) == "torch.int64"


def test_materials_named_twice_are_refused(trajectory: Trajectory) -> None:
    twice = replace(trajectory.metadata, materials=trajectory.metadata.materials * 2, param_names=trajectory.metadata.param_names * 2)
    assert ("materials", "names a material twice") in list(twice.violations())
