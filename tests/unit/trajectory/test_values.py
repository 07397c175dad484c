"""Values that break the rules of the schema are found in the store, in arrays from memory, and in the initial state of a rollout."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.dataset import long_enough, open_split, usable
from gpe_pl.data.importers import ImportFailure, save_dataset
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import Repeated
from gpe_pl.geometry.shapes import Box, Polygon, Shape, Sphere, Wall
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import FIELDS, LARGEST, MATERIALS, NODE_TYPES, node_code, param_names
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import StoreError, UnsoundError, read_trajectory, stored_arrays, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.trajectory.values import faults

NAN, INF = float("nan"), float("inf")


@pytest.fixture
def trajectory(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without jumps, which training would leave out."""
    return replace(trajectory, pos=trajectory.pos[:1] + 0.01 * (trajectory.pos - trajectory.pos[:1]))


def with_value(trajectory: Trajectory, key: str, index: Any, value: float) -> Trajectory:
    """Return the trajectory with a value in one of its stored fields."""
    name = key.removeprefix("boundary_")
    owner: Any = trajectory.boundary if name != key else trajectory
    array = np.array(getattr(owner, name))
    array[index] = value
    changed = replace(owner, **{name: array})
    return replace(trajectory, boundary=changed) if name != key else changed


BROKEN = [
    *[(key, (2, 5, 1), value, r"frame 2, node 5, dim 1") for key in ("pos", "vel") for value in (NAN, -INF, 1e30)],
    *[("mass", 4, value, "node 4: must be positive and finite") for value in (NAN, INF, 0.0, -1.0)],
    *[("material_params", (6, 0), value, "friction_angle: node 6") for value in (NAN, INF, -INF)],
    ("node_type", 3, node_code("snow"), "node 3: the code stands for none of the data set's materials"),
    ("node_type", 3, 200, "node 3: the code stands for none of the data set's materials"),
    *[(key, (1, 0), value, "boundary_node 1, dim 0") for key in ("boundary_pos", "boundary_vel") for value in (NAN, INF, -1e30)],
    *[("boundary_normal", (1, slice(None)), value, r"boundary_node 1") for value in (NAN, INF, 0.0, 2.0, -1e30)],
    *[("boundary_friction", 7, value, "boundary_node 7: negative or not finite") for value in (NAN, INF, -0.1, -1e30)],
    *[("boundary_restitution", 7, value, "boundary_node 7: must lie between 0 and 1") for value in (NAN, INF, -0.1, 1.5)],
]


@pytest.mark.slow
@pytest.mark.parametrize(("key", "index", "value", "message"), BROKEN)
def test_what_breaks_a_rule_is_refused_everywhere(
    tmp_path: Path, trajectory: Trajectory, key: str, index: Any, value: float, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    broken = with_value(trajectory, key, index, value)
    path = tmp_path / "set" / "train" / "shard-00000.h5"
    write_shard(path, [broken, trajectory])
    wanted = f"field '{key}': {message}"
    with pytest.raises(UnsoundError, match=rf"shard-00000\.h5:00000: {wanted}"):
        read_trajectory(path, "00000")
    with caplog.at_level(logging.WARNING):
        assert [stored.name for stored in usable(open_split(tmp_path / "set", "train"))] == ["00001"]  # training
        assert len(list(long_enough(tmp_path / "set", "train", 1))) == 1  # evaluation
    assert len(caplog.messages) == 2 and all(f"shard-00000.h5:00000: left out, {wanted}" in text for text in caplog.messages)
    with pytest.raises(ImportFailure, match=wanted):
        save_dataset(tmp_path, "own", train=[broken])


@pytest.mark.parametrize(("key", "index", "value", "message"), [case for case in BROKEN if case[0] not in ("pos", "vel")])
@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_no_rollout_starts_from_what_breaks_a_rule(
    trajectory: Trajectory, key: str, index: Any, value: float, message: str, backend: str
) -> None:
    def step(state: State) -> State:
        raise AssertionError("a step was made")

    state = with_value(trajectory, key, index, value).state(0)
    result = rollout(Steps(step), state.to_torch() if backend == "torch" else state, 3, trajectory.metadata)
    assert result.termination is not None and result.num_frames == 1
    assert result.termination.message.startswith(f"field '{key}': {message}")
    assert result.termination.frame == 0


class Steps:
    def __init__(self, step: Any) -> None:
        self.step = step


@pytest.mark.parametrize("name", ["pos", "vel", "normal", "friction", "restitution"])
def test_a_boundary_of_another_length_starts_no_rollout(trajectory: Trajectory, name: str) -> None:
    boundary = replace(trajectory.boundary, **{name: getattr(trajectory.boundary, name)[:-1]})
    result = rollout(
        Steps(lambda _: pytest.fail("a step was made")), replace(trajectory.state(0), boundary=boundary), 3, trajectory.metadata
    )
    assert result.termination is not None and result.termination.message.startswith("field 'boundary_")


LOW, HIGH = (0.0, 0.0), (1.0, 1.0)
BALL = Sphere((0.5, 0.5), 0.1, 0.3)
BROKEN_SHAPES: list[tuple[Shape, str]] = [
    *[(replace(BALL, radius=value), r"\(sphere\): not finite: radius") for value in (NAN, INF, -1e30)],
    *[(replace(BALL, radius=value), r"\(sphere\): radius is .* must be positive") for value in (0.0, -0.1)],
    *[(replace(BALL, friction=value), "not finite: friction") for value in (NAN, INF)],
    (replace(BALL, friction=-0.1), "friction is -0.1, must be at least 0"),
    *[(replace(BALL, restitution=value), "restitution is .* must lie between 0 and 1") for value in (-0.1, 1.5)],
    (replace(BALL, center=(0.5, NAN)), "not finite: center"),
    (replace(BALL, center=(0.5, 0.5, 0.5)), "center must have 2 components"),
    (Box((0.2, 0.2), (0.4, 0.2), 0.0), "low must be below high"),
    (Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, NAN)), 0.0), "not finite: vertices"),
    *[
        (Wall(normal, 0.0, LOW, HIGH, 0.3), "normal must be a unit vector along one axis")
        for normal in ((0.0, 0.0), (0.6, 0.8), (0.0, 2.0))
    ],
    (Wall((0.0, 1.0), NAN, LOW, HIGH, 0.3), "not finite: offset"),
    (Repeated(BALL, Periodicity((LOW, HIGH), (True, False))), "repeats along"),
]


@pytest.mark.parametrize(("shape", "message"), BROKEN_SHAPES)
def test_shapes_that_break_a_rule_are_refused_by_the_reader_and_by_rollouts(
    tmp_path: Path, trajectory: Trajectory, shape: Shape, message: str
) -> None:
    """The distance to a shape with NaN is NaN, so containment would let all nodes through."""
    broken = replace(trajectory, boundary=replace(trajectory.boundary, shapes=(BALL, shape)))
    write_shard(tmp_path / "a.h5", [broken])
    with pytest.raises(UnsoundError, match=rf"a\.h5:00000: shape 1 .*{message}"):
        read_trajectory(tmp_path / "a.h5", "00000")
    result = rollout(Steps(lambda _: pytest.fail("a step was made")), broken.state(2, history=2), 3, trajectory.metadata)
    assert result.termination is not None and result.termination.reason == "input" and "shape 1" in result.termination.message


@pytest.mark.parametrize("name", ["gravity", "velocity_history"])
def test_gravity_and_history_of_a_start_are_finite(trajectory: Trajectory, name: str) -> None:
    state = trajectory.state(2, history=2)
    values: Any = np.array(getattr(state, name))
    values[0] = NAN
    result = rollout(Steps(lambda _: pytest.fail("a step was made")), replace(state, **{name: values}), 3, trajectory.metadata)
    assert result.termination is not None and result.termination.message == f"{name} is not finite or too large"


def test_frames_of_a_window_have_their_own_numbers(tmp_path: Path, trajectory: Trajectory) -> None:
    write_shard(tmp_path / "a.h5", [with_value(trajectory, "pos", (3, 5, 1), NAN)])
    assert read_trajectory(tmp_path / "a.h5", "00000", frames=slice(0, 3)).num_frames == 3
    with pytest.raises(StoreError, match="frame 3, node 5, dim 1: not finite"):
        read_trajectory(tmp_path / "a.h5", "00000", frames=slice(2, 5))


@pytest.mark.parametrize(("name", "value"), [("pos", NAN), ("vel", INF), ("normal", 0.0)])
def test_moving_boundaries_are_looked_at_in_every_frame(tmp_path: Path, trajectory: Trajectory, name: str, value: float) -> None:
    b, count = trajectory.boundary, trajectory.num_frames
    way = {key: np.repeat(np.asarray(getattr(b, key))[None], count, axis=0) for key in ("pos", "vel", "normal")}
    way[name][4, 2] = value
    broken = replace(trajectory, boundary=replace(b, motion=BoundaryMotion(**way)))
    write_shard(tmp_path / "a.h5", [broken])
    with pytest.raises(UnsoundError, match=rf"field 'boundary_{name}': frame 4, boundary_node 2"):
        read_trajectory(tmp_path / "a.h5", "00000")
    result = rollout(Steps(lambda _: pytest.fail("a step was made")), broken.state(0), 3, trajectory.metadata)
    assert result.termination is not None and f"'boundary_{name}': frame 4, boundary_node 2" in result.termination.message


@pytest.mark.parametrize("cell", [[0, 1, -1], [0, 1, 12], [0, 1, 2**31 - 1]])
def test_cells_name_nodes_that_exist(tmp_path: Path, trajectory: Trajectory, cell: list[int]) -> None:
    cells = np.array([[0, 1, 2], cell], np.int32)
    write_shard(tmp_path / "a.h5", [replace(trajectory, cells=cells, rest_pos=trajectory.pos[0])])
    with pytest.raises(UnsoundError, match="field 'cells': cell 1, corner 2: no such node, there are 12"):
        read_trajectory(tmp_path / "a.h5", "00000")


def test_metadata_that_describe_no_scene_are_refused(tmp_path: Path, trajectory: Trajectory) -> None:
    write_shard(tmp_path / "a.h5", [replace(trajectory, metadata=replace(trajectory.metadata, gravity=(0.0, NAN)))])
    with pytest.raises(UnsoundError, match=r"a.h5:00000: gravity is \(0.0, nan\), must be finite"):
        read_trajectory(tmp_path / "a.h5", "00000")


@pytest.mark.parametrize("value", [2e19, 1e30])
def test_parameters_whose_squares_overflow_are_not_finite(trajectory: Trajectory, value: float) -> None:
    broken = with_value(trajectory, "material_params", (7, 0), value)
    (found,) = faults(stored_arrays(broken), NODE_TYPES, ("sand",), ("friction_angle",))
    assert str(found) == f"field 'material_params': friction_angle: node 7: is {value:g} deg of sand, must be {MATERIALS['sand'][0].rule}"


def test_parameters_are_not_negative_and_positive_where_they_enter_by_their_logarithm(trajectory: Trajectory) -> None:
    codes = np.array([node_code("sand"), node_code("fluid")], np.uint8)
    for value, number in ((0.0, 1), (-1.0, 1), (1e-30, 0)):
        params = np.array([[0.0, INF], [NAN, value]], np.float32)  # what does not apply is not looked at
        arrays: dict[str, np.ndarray] = {"node_type": codes, "material_params": params}
        materials = ("sand", "fluid")
        found = list(faults(arrays, ("sand", "snow", "fluid"), materials, param_names(materials)))
        assert len(found) == number
        assert all(
            fault.message.startswith(f"kinematic_viscosity: node 1: is {value:g} m^2/s of fluid, must be positive") for fault in found
        )
    arrays["material_params"] = np.array([[-5.0, INF], [NAN, 1.0]], np.float32)
    (fault,) = faults(arrays, ("sand", "snow", "fluid"), materials, param_names(materials))
    assert fault.message == "friction_angle: node 0: is -5 deg of sand, must be finite and not negative"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_largest_numbers(dtype: Any, trajectory: Trajectory) -> None:
    """Many allowed numbers pass, although the sum of their squares overflows."""
    for factor, number in ((0.999, 0), (1.001, 1)):
        pos = np.full((3, 100, 2), factor * LARGEST, dtype)
        assert len(list(faults({"pos": pos}, (), (), ()))) == number


def test_every_field_has_a_rule(trajectory: Trajectory) -> None:
    sound = stored_arrays(trajectory)
    assert list(faults(sound, ("sand",), ("sand",), ("friction_angle",))) == []
    t = trajectory
    none, boundary = slice(0), Boundary.empty(2)
    empty = Trajectory(t.metadata, t.pos[:, :0], t.vel[:, :0], t.node_type[none], t.mass[none], t.material_params[none], boundary)
    assert list(faults(stored_arrays(empty), ("sand",), ("sand",), ("friction_angle",))) == []
    for key, spec in FIELDS.items():
        if spec.dtype == "float32" and key != "material_params":
            array = np.full((2,) * len(spec.dims), NAN, np.float32)
            (found,) = faults({"node_type": np.zeros(2, np.uint8), key: array}, ("sand",), ("sand",), ("friction_angle",))
            assert found.field == key


def test_tensors_are_looked_at_wherever_they_are(trajectory: Trajectory) -> None:
    state = trajectory.state(2, history=2).to_torch()
    result = rollout(Steps(lambda s: s), replace(state, pos=state.pos.clone().requires_grad_()), 2, trajectory.metadata)
    assert result.termination is None and isinstance(state.pos, torch.Tensor)
