"""Every kind of violation is named with file, trajectory, field and position, and no file makes the validator fail."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gpe_pl.data.free_flight import free_flights
from gpe_pl.data.validate import format_page, main, validate
from gpe_pl.geometry.shapes import Sphere
from gpe_pl.schema import node_code
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

ROOT = Path(__file__).parents[3]
Edit = Callable[[Trajectory], Trajectory]


def metadata(**values: Any) -> Edit:
    return lambda t: replace(t, metadata=replace(t.metadata, **values))


def changed(key: str, index: Any, value: float) -> Edit:
    """Set one element; ``boundary_*`` fields are in the boundary."""

    def edit(t: Trajectory) -> Trajectory:
        name = key.removeprefix("boundary_")
        array: Any = np.array(getattr(t if name == key else t.boundary, name))
        array[index] = value
        return replace(t, **{name: array}) if name == key else replace(t, boundary=replace(t.boundary, **{name: array}))

    return edit


def messages(tmp_path: Path, trajectory: Trajectory) -> list[str]:
    """Return the validator's messages about a shard with this trajectory, after checking and removing the path."""
    path = tmp_path / "shards" / "shard-00000.h5"
    write_shard(path, [trajectory])
    prefix = f"{path}: 00000: "
    found = [str(v) for v in validate([path]).violations]
    assert all(text.startswith(prefix) for text in found), found
    return [text.removeprefix(prefix) for text in found]


def test_sound_store(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(store)]) == 0
    report = capsys.readouterr().out
    assert "grains/train: 2 trajectories of sand in 2D" in report
    assert "frame_dt 0.01 s" in report
    assert "spacing 0.1 m" in report
    assert "friction_angle: 1 values, 30" in report
    assert "violations" not in report


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (changed("pos", (3, 7, 1), np.nan), "pos: frame 3, node 7, dim 1: not finite"),
        (changed("vel", (0, 2), np.inf), "vel: frame 0, node 2, dim 0 and 1 more: not finite"),
        (changed("pos", (2, 5, 0), 1.01), "pos: frame 2, node 5: x = 1.01 m is outside the bounds 0 … 1 m"),
        (changed("pos", (5, 0, 1), -0.01), "pos: frame 5, node 0: y = -0.01 m is outside the bounds 0 … 1 m"),
        (changed("mass", 4, 0.0), "mass: node 4: must be positive and finite"),
        (changed("mass", 4, np.nan), "mass: node 4: must be positive and finite"),
        (changed("node_type", 3, node_code("snow")), "node_type: node 3: the code stands for none of the data set's materials (sand)"),
        (changed("node_type", 3, node_code("boundary")), "node_type: node 3: the code stands for none"),
        (changed("node_type", 3, 77), "node_type: node 3: the code stands for none"),
        (changed("material_params", (6, 0), np.nan), "material_params: friction_angle: node 6: NaN, but the material has this parameter"),
        (
            changed("material_params", slice(6, 9), np.inf),
            "material_params: friction_angle: node 6 and 2 more: is inf deg of sand, must be finite",
        ),
        (changed("boundary_normal", (8, slice(None)), 0.5), "boundary_normal: boundary_node 8: length 0.707107, must be 1"),
        (changed("boundary_normal", (8, 0), np.nan), "boundary_normal: boundary_node 8, dim 0: not finite"),
        (changed("boundary_friction", 1, -0.1), "boundary_friction: boundary_node 1: negative"),
        (changed("boundary_restitution", 2, 1.5), "boundary_restitution: boundary_node 2: must lie between 0 and 1"),
        (changed("boundary_pos", (2, slice(None)), 0.3), "boundary_pos: boundary_node 2: 0.2236 m away from every shape"),
        (metadata(frame_dt=0.0, solver_dt=0.0), "frame_dt: is 0.0, must be positive"),
        (metadata(spacing=float("nan")), "spacing: is nan, must be positive"),
        (metadata(connectivity_radius=float("inf")), "connectivity_radius: is inf, must be positive"),
        (metadata(solver_dt=0.02), "solver_dt: is 0.02 s, must lie between 0 and frame_dt = 0.01 s"),
        (metadata(solver=""), "solver: is empty"),
        (metadata(solver_version=""), "solver_version: is empty"),
        (metadata(dataset=""), "dataset: is empty"),
        (metadata(materials=("lava",)), "materials: names ['lava']; known: sand"),
        (metadata(materials=()), "materials: names nothing"),
        (metadata(param_names=("stiffness",)), "param_names: is ('stiffness',), expected ('friction_angle',)"),
        (metadata(gravity=(0.0,)), "gravity: has 1 components in 2D"),
        (metadata(gravity=(0.0, float("nan"))), "gravity: is (0.0, nan), must be finite"),
        (metadata(periodic=(True,)), "periodic: has 1 components in 2D"),
        (metadata(bounds=((0.0, 1.0), (1.0, 0.0))), "bounds: axis 1: low 1.0 must be below high 0.0"),
        (metadata(config="{"), "config: is not JSON"),
        (metadata(split="exam"), "split: is 'exam', must be one of train, val, test, test_unseen"),
        (metadata(parameter_group="new"), "parameter_group: is 'new', must be one of seen, interpolated, extrapolated"),
        (metadata(parameter_group="interpolated"), "parameter_group: is 'interpolated' in split 'train'"),
        (metadata(split="test_unseen"), "parameter_group: is 'seen' in split 'test_unseen'"),
        (lambda t: replace(t, vel=t.vel[:-1]), "field 'vel' has size 5 along 'frame', expected 6"),
        (lambda t: replace(t, mass=t.mass[:-2]), "field 'mass' has size 10 along 'node', expected 12"),
        (lambda t: t.frames(0, 1), "pos: has 1 frames and 12 nodes"),
        (lambda t: replace(t, cells=np.array([[0, 1, 2], [3, 12, -1]], np.int32)), "cells: cell 1, corner 1 and 1 more: no such node"),
        (lambda t: replace(t, rest_pos=np.full((12, 2), np.nan, np.float32)), "rest_pos: node 0, dim 0 and 23 more: not finite"),
        (
            lambda t: replace(t, boundary=replace(t.boundary, shapes=(Sphere((0.0, 0.0, 0.0), 1.0, 0.1),))),
            "shapes: shape 0 (sphere): center must have 2 components",
        ),
        (
            lambda t: replace(t, boundary=replace(t.boundary, shapes=(Sphere((0.0, 0.0), float("nan"), 0.1),))),
            "shapes: shape 0 (sphere): not finite",
        ),
    ],
)
def test_each_violation_is_named(tmp_path: Path, trajectory: Trajectory, edit: Edit, message: str) -> None:
    assert messages(tmp_path, trajectory) == []
    found = messages(tmp_path, edit(trajectory))
    assert any(text.startswith(message) for text in found), found


def test_several_violations_at_once(tmp_path: Path, trajectory: Trajectory) -> None:
    spoiled = changed("mass", 1, -1.0)(changed("vel", (1, 1, 1), np.nan)(metadata(solver="")(trajectory)))
    assert [text.split(":")[0] for text in messages(tmp_path, spoiled)] == ["solver", "mass", "vel"]


def test_parameters_that_do_not_apply_must_be_nan(tmp_path: Path, trajectory: Trajectory) -> None:
    codes = np.array([node_code("sand")] * 6 + [node_code("snow")] * 6, np.uint8)
    params = np.full((12, 2), np.nan, np.float32)
    params[:6, 0], params[6:, 1] = 30, 10
    mixed = metadata(materials=("sand", "snow"), param_names=("friction_angle", "hardening_coefficient"))(
        replace(trajectory, node_type=codes, material_params=params)
    )
    assert messages(tmp_path, mixed) == []
    params[9, 0] = 30
    assert messages(tmp_path, mixed) == [
        "material_params: friction_angle: node 9: has a value, but the material has no such parameter (NaN expected)"
    ]


def test_periodic_axes_have_no_walls(tmp_path: Path, trajectory: Trajectory) -> None:
    assert messages(tmp_path, metadata(periodic=(True, False))(changed("pos", (2, 5, 0), 1.01)(trajectory))) == []


def test_split_must_match_the_folder(store: Path) -> None:
    (store / "val" / "shard-00000.h5").rename(store / "test" / "shard-00001.h5")
    (violation,) = validate([store]).violations
    assert str(violation).endswith("split: is 'val', but the shard lies in the folder 'test'")


def test_the_same_scene_twice(store: Path, trajectory: Trajectory) -> None:
    write_shard(store / "train" / "shard-00001.h5", [trajectory])
    (violation,) = validate([store]).violations
    assert "shard-00001.h5" in str(violation)
    assert f"has exactly the content of {store / 'train' / 'shard-00000.h5'}:00000" in str(violation)


def test_trajectories_of_one_data_set_agree(store: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    write_shard(store / "train" / "shard-00001.h5", [new_trajectory(9, frame_dt=0.02)])
    assert ["frame_dt: is 0.02, but 0.01 in" in str(v) for v in validate([store]).violations] == [True]


@pytest.fixture
def shard(tmp_path: Path, trajectory: Trajectory) -> Path:
    path = tmp_path / "shard-00000.h5"
    write_shard(path, [trajectory])
    return path


def only_message(path: Path) -> str:
    (violation,) = validate([path]).violations
    return str(violation)


def test_digest(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        file["00000"]["vel"][2, 3, 1] += np.float32(1e-3)
    assert "00000: sha256: does not match the content" in only_message(shard)


def test_extra_and_missing_fields(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        file["00000"]["colour"] = np.zeros(3)
    assert only_message(shard).endswith("00000: colour: is not a field of this schema")
    with h5py.File(shard, "r+") as file:
        del file["00000"]["colour"], file["00000"]["mass"]
    found = [str(v) for v in validate([shard]).violations]
    assert found[0] == f"{shard}: 00000: field 'mass' is missing; delete the shard and generate or import the data again"


def test_wrong_counts_units_and_version(shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        file.attrs["num_trajectories"] = 5
    assert only_message(shard).endswith("num_trajectories: is 5, but the file holds 1 trajectories")
    with h5py.File(shard, "r+") as file:
        file.attrs["num_trajectories"] = 1
        units = json.loads(file.attrs["units"])
        file.attrs["units"] = np.bytes_(json.dumps({**units, "pos": "mm"}).encode())
    assert "units: differ" in only_message(shard)
    with h5py.File(shard, "r+") as file:
        file.attrs["schema_version"] = 99
    assert "schema version 99" in only_message(shard)


def test_nothing_to_validate(tmp_path: Path) -> None:
    assert "no shards" in only_message(tmp_path)
    assert "no such file" in only_message(tmp_path / "nothing.h5")


def test_exit_status_and_count(shard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shard.write_bytes(b"not HDF5")
    assert main([str(shard), str(tmp_path / "nothing.h5")]) == 1
    *violations, last = capsys.readouterr().out.splitlines()
    assert len(violations) == 2
    assert last == "2 violations"


def hostile_link(file: h5py.File) -> None:
    file["00000"].move("pos", "old")
    file["00000"]["pos"] = h5py.SoftLink("/00000/pos")  # refers to itself


def hostile_name(file: h5py.File) -> None:
    file.move("00000", "\x1b[2J\nfake: ok")


def hostile_number(file: h5py.File) -> None:
    attrs = file["00000"].attrs
    attrs["metadata"] = np.bytes_(attrs["metadata"].replace(b'"seed": 0', b'"seed": 1' + b"0" * 6000))


def hostile_shapes(file: h5py.File) -> None:
    file["00000"].attrs["shapes"] = np.bytes_(b'[{"kind": "sphere", "center": "ab", "radius": [], "friction": {}}]')


def hostile_kind(file: h5py.File) -> None:
    file["00000"].attrs["shapes"] = np.bytes_(b'[{"kind": ["sphere"]}]')


def hostile_nesting(file: h5py.File) -> None:
    file["00000"].attrs["shapes"] = np.bytes_(b"[" * 50_000 + b"]" * 50_000)


def hostile_types(file: h5py.File) -> None:
    file["00000"].attrs["node_types"] = np.bytes_(b'{"sand": [1], "3": {}}')


def hostile_dataset(file: h5py.File) -> None:
    del file["00000"]
    file["00000"] = np.zeros(3)


def hostile_group(file: h5py.File) -> None:
    del file["00000"]["pos"]
    file["00000"].create_group("pos")


def hostile_null(file: h5py.File) -> None:
    del file["00000"]["pos"]
    file["00000"]["pos"] = h5py.Empty("float32")


def hostile_dtype(file: h5py.File) -> None:
    del file["00000"]["pos"]
    file["00000"].create_dataset("pos", (6, 12, 2), h5py.string_dtype())


def hostile_version(file: h5py.File) -> None:
    file.attrs["schema_version"] = np.arange(3)


HOSTILE = [value for name, value in dict(globals()).items() if name.startswith("hostile_")]


@pytest.mark.parametrize("edit", HOSTILE, ids=lambda f: f.__name__)
def test_hostile_files_give_violations(shard: Path, edit: Callable[[h5py.File], None], capsys: pytest.CaptureFixture[str]) -> None:
    with h5py.File(shard, "r+") as file:
        edit(file)
    status, output = main([str(shard)]), capsys.readouterr().out
    if edit is hostile_name:  # an odd name alone violates nothing, but must not reach the terminal as it is
        assert (status, "\x1b" in output, "\nfake" in output) == (0, False, False)
    else:
        assert status == 1
        assert str(shard) in output


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_random_damage_never_raises(shard: Path, tmp_path: Path, seed: int) -> None:
    """Every file that the validator passes can be read. This runs in a child process, so that a crash of HDF5 fails the test."""
    script = """
import sys
from pathlib import Path
import numpy as np
from gpe_pl.data.validate import validate
from gpe_pl.trajectory.store import read_trajectory

content, damaged, rng = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2]), np.random.default_rng(int(sys.argv[3]))
for _ in range(40):
    spoiled = bytearray(content)
    start, length = rng.integers(len(content)), rng.integers(1, 64)
    spoiled[start : start + length] = rng.bytes(length)
    damaged.write_bytes(spoiled[: rng.integers(len(content) // 2, 2 * len(content))])
    if not validate([damaged]).violations:
        read_trajectory(damaged, "00000", verify=True)
"""
    command = [sys.executable, "-c", script, str(shard), str(tmp_path / "damaged.h5"), str(seed)]
    child = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert child.returncode == 0, child.stderr


def test_validator_leaves_the_file_alone(shard: Path, trajectory: Trajectory) -> None:
    before = shard.read_bytes()
    validate([shard])
    assert shard.read_bytes() == before
    assert read_trajectory(shard, "00000", verify=True).metadata == trajectory.metadata


def test_format_page_is_up_to_date() -> None:
    assert (ROOT / "data" / "README.md").read_text() == format_page(), "run `python -m gpe_pl.data.validate --format-page > data/README.md`"


def test_format_page_names_everything() -> None:
    from gpe_pl.schema import FIELDS, MATERIALS
    from gpe_pl.trajectory.trajectory import Metadata

    page = format_page()
    for name in (*FIELDS, *MATERIALS, *Metadata.__dataclass_fields__):
        assert f"| `{name}` |" in page, name


def test_usage_error() -> None:
    with pytest.raises(SystemExit, match="2"):
        main([])


def falling(new_trajectory: Callable[..., Trajectory], extra: float, gap: float = 0.05, mesh: bool = False) -> Trajectory:
    """Return a falling pair of nodes in mid-air and a node at rest on the floor.

    The second node of the pair is ``gap`` [m] away and accelerates by ``extra`` [m/s²] more than gravity.
    """
    t = new_trajectory(num_nodes=3, num_frames=6)
    time = 0.01 * np.arange(6)[:, None]
    acceleration = np.array([[0.0, -9.81], [extra, -9.81], [0.0, 0.0]])
    start = np.array([[0.3, 0.6], [0.3 + gap, 0.6], [0.8, 0.02]])
    pos = start + 0.5 * time[:, None] ** 2 * acceleration
    cells, rest_pos = (np.array([[0, 1]], np.int32), start.astype(np.float32)) if mesh else (None, None)
    vel = (time[:, None] * acceleration).astype(np.float32)
    return replace(t, pos=pos.astype(np.float32), vel=vel, cells=cells, rest_pos=rest_pos)


@pytest.mark.parametrize("load", ["prescribed", "prescribed_axes", "force"])
def test_groups_that_a_load_moves_are_not_in_free_flight(new_trajectory: Callable[..., Trajectory], load: str) -> None:
    t = falling(new_trajectory, 0.1, 0.3)
    arrays = {"pos": t.pos, "vel": t.vel, "mass": t.mass, "boundary_pos": t.boundary.pos[None]}
    pushed = np.array([0, 1, 0])
    arrays[load] = {"prescribed": pushed, "prescribed_axes": pushed[:, None] * [0, 1], "force": np.ones((6, 1, 2)) * pushed[:, None]}[load]
    assert [(f.num_free, f.num_disturbed) for f in free_flights(t.metadata, arrays)] == [(1, 0)] * 4


@pytest.mark.parametrize(
    ("extra", "gap", "mesh", "expected"),
    [
        (0.0, 0.05, False, (2, 1, 0)),  # one free island, which falls
        (0.1, 0.05, False, (2, 1, 1)),  # pushed by something that the graph does not show
        (0.1, 0.3, False, (3, 2, 1)),  # apart: only one of them is pushed
        (0.1, 0.3, True, (2, 1, 1)),  # a cell ties them together
        (0.005, 0.05, False, (2, 1, 0)),  # below the tolerance
    ],
)
def test_islands_that_do_not_fall_freely(
    new_trajectory: Callable[..., Trajectory], extra: float, gap: float, mesh: bool, expected: tuple[int, int, int]
) -> None:
    t = falling(new_trajectory, extra, gap, mesh)
    arrays = {"pos": t.pos, "vel": t.vel, "mass": t.mass, "boundary_pos": t.boundary.pos[None]}
    if t.cells is not None:
        arrays["cells"] = t.cells
    assert [(f.num_islands, f.num_free, f.num_disturbed) for f in free_flights(t.metadata, arrays)] == [expected] * 4


def test_report_counts_disturbed_islands(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], capsys: pytest.CaptureFixture[str]
) -> None:
    write_shard(tmp_path / "shard-00000.h5", [falling(new_trajectory, 0.1)])
    assert main([str(tmp_path)]) == 0
    assert "4 of 4 free groups do not accelerate with gravity (100.000% of the free groups, 50.000% of all" in capsys.readouterr().out


def test_an_island_that_was_tied_a_frame_ago_is_not_in_free_flight(new_trajectory: Callable[..., Trajectory]) -> None:
    """Its last velocity still contains the push of the wall. Without any free island, the report says that nothing was tested."""
    t = falling(new_trajectory, 0.1)
    pos = t.pos.copy()
    pos[::2, :2, 1] -= 0.55  # at the floor in every second frame
    arrays = {"pos": pos, "vel": t.vel, "mass": t.mass, "boundary_pos": t.boundary.pos[None]}
    assert [f.num_free for f in free_flights(t.metadata, arrays)] == [0] * 4


def report_of(tmp_path: Path, capsys: pytest.CaptureFixture[str], *trajectories: Trajectory) -> str:
    write_shard(tmp_path / "shard-00000.h5", trajectories)
    assert main([str(tmp_path)]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("gravity", [(0.0, -9.81), (0.0, -0.1)])
def test_free_flight_is_compared_with_gravity(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], capsys: pytest.CaptureFixture[str], gravity: tuple[float, float]
) -> None:
    """If groups fall with another acceleration than the stored gravity, the report does not ask for a larger radius."""
    t = falling(new_trajectory, 0.0)
    report = report_of(tmp_path, capsys, replace(t, metadata=replace(t.metadata, gravity=gravity)))
    assert "free groups accelerate by (0, -9.8" in report
    assert f"(median), gravity is (0, {gravity[1]:.3g}) m/s²" in report
    assert ("they agree on another acceleration: gravity, frame_dt or the unit of length" in report) == (gravity[1] == -0.1)
    assert ("larger connectivity_radius" in report) == (gravity[1] == -9.81)


def test_without_gravity_the_scale_of_accelerations_tells_what_is_small(new_trajectory: Callable[..., Trajectory]) -> None:
    """A pair that accelerates by 0.02 m/s² beside a node that accelerates by ``strong`` on the floor."""
    t, time = new_trajectory(num_nodes=3, num_frames=6), 0.01 * np.arange(6)[:, None, None]
    for strong, disturbed in ((100.0, 0), (1.0, 4)):
        pos = np.array([[0.3, 0.6], [0.35, 0.6], [0.6, 0.02]]) + 0.5 * time**2 * np.array([[0.02, 0.0], [0.02, 0.0], [strong, 0.0]])
        pos[:, :2] += 0.2 * time * np.array([0.0, 1.0])  # nodes at rest do not count as free
        arrays = {"pos": pos, "mass": t.mass, "boundary_pos": t.boundary.pos[None]}
        flights = list(free_flights(replace(t.metadata, gravity=(0.0, 0.0)), arrays))
        assert (sum(f.num_free for f in flights), sum(f.num_disturbed for f in flights)) == (4, disturbed)


@pytest.mark.parametrize("is_lattice", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_rounding_of_free_fall_is_no_disturbance(dim: int, is_lattice: bool) -> None:
    """Bodies that fall exactly, in single precision: the nodes in a row of a lattice are all rounded alike, which no mean over them lessens."""
    rng, time = np.random.default_rng(0), 0.005 * np.arange(40)[:, None, None]
    lattice = 0.05 * np.stack(np.meshgrid(*[np.arange(3)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    gravity = np.eye(dim)[-1] * -9.81
    starts = [lattice + (0 if is_lattice else rng.uniform(0, 0.01, lattice.shape)) + 3.0 + 1.5 * k for k in range(5)]
    pos = np.concatenate([start + rng.uniform(-1, 1, dim) * time + 0.5 * gravity * time**2 for start in starts], axis=1).astype(np.float32)
    t = Trajectory.from_numpy(pos, 0.005, "sand", {"sand": 30.0}, bounds=[(-10, 20)] * dim, spacing=0.05, gravity=gravity)
    flights = list(free_flights(t.metadata, {"pos": pos, "mass": t.mass, "boundary_pos": np.empty((1, 0, dim))}))
    assert (sum(f.num_free for f in flights), sum(f.num_disturbed for f in flights)) == (5 * 38, 0)


def test_rounding_of_positions_is_named(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], capsys: pytest.CaptureFixture[str]
) -> None:
    """Nodes that fall and meet nothing within 2e-5 s move less than float32 resolves."""
    t, time = new_trajectory(num_nodes=3, num_frames=6), 2e-5 * np.arange(6)[:, None, None]
    pos = (np.array([[0.3, 0.6], [0.35, 0.6], [0.8, 0.02]]) + [0.0, -1.0] * time).astype(np.float32)
    report = report_of(tmp_path, capsys, replace(t, pos=pos, metadata=replace(t.metadata, frame_dt=2e-5, solver_dt=2e-5)))
    assert "positions in float32 round accelerations by 105 m/s², those of the data are " in report
    assert "a longer frame_dt is needed" in report
