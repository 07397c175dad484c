"""A user's arrays become trajectories, or give an error that names argument, frame and node; data sets of them are written once."""

from __future__ import annotations

import json
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, assemble, save_dataset
from gpe_pl.data.validate import validate
from gpe_pl.geometry.periodicity import Periodicity, PeriodicityError
from gpe_pl.geometry.shapes import Box, Shape, domain_walls
from gpe_pl.schema import STICKY, node_code
from gpe_pl.trajectory import trajectory as trajectory_module
from gpe_pl.trajectory.arrays import ArrayError, estimated_normals, typical_spacing
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import iter_trajectories, read_trajectory
from gpe_pl.trajectory.trajectory import Trajectory
from tests.sources import DT, motion

BOX = ((0.0, 1.0), (0.0, 1.0))


def trajectory(seed: int = 0, **changes: Any) -> Trajectory:
    values: dict[str, Any] = {"pos": motion(seed=seed), "frame_dt": DT, "materials": "sand", "params": {"sand": 30.0}}
    return Trajectory.from_numpy(**(values | changes))


# --- from_numpy ----------------------------------------------------------------------------------------------------------------------------


def test_little_is_needed() -> None:
    t = trajectory()
    np.testing.assert_array_equal(t.pos, motion())
    assert t.pos.dtype == t.vel.dtype == np.float32
    np.testing.assert_allclose(t.vel[1:], np.diff(motion().astype(np.float64), axis=0) / DT, atol=1e-4)
    np.testing.assert_array_equal(t.vel[0], t.vel[1])
    m = t.metadata
    assert m.spacing == pytest.approx(typical_spacing(motion()[0].astype(np.float64)))
    assert m.connectivity_radius == pytest.approx(2 * m.spacing)
    np.testing.assert_allclose(np.array(m.bounds).T, [motion().min(axis=(0, 1)), motion().max(axis=(0, 1))])
    assert (m.gravity, m.periodic) == ((0.0, 0.0), (False, False))
    assert (t.mass == 1).all() and (trajectory(force=np.zeros((20, 2))).mass == 1).all()
    assert len(t.boundary.pos) == 0
    assert t.state(5, history=2).velocity_history is not None


def test_everything_can_be_given() -> None:
    names = ["sand", "fluid"] * 10
    walls = Boundary.sample(domain_walls(BOX, 0.3)[:2], 0.1, 2)
    t = trajectory(
        materials=names, params={"sand": 30, "fluid": np.linspace(0.1, 1, 20)}, vel=np.ones((10, 20, 2)), mass=np.arange(1, 21), bounds=BOX,
        periodic=[False, True], gravity=[0, -9.81], spacing=0.05, connectivity_radius=0.15, boundary=walls, dataset="mine", split="val",
    )  # fmt: skip
    assert t.node_type.tolist() == [node_code(n) for n in names]
    assert np.isnan(t.material_params[0]).tolist() == [False, True]
    np.testing.assert_allclose(t.material_params[1::2, 1], np.linspace(0.1, 1, 20)[1::2], rtol=1e-6)
    assert (t.vel == 1).all()
    np.testing.assert_array_equal(t.mass, np.arange(1, 21))
    m = t.metadata
    assert (m.dataset, m.split, m.periodic, m.gravity) == ("mine", "val", (False, True), (0.0, -9.81))
    assert (m.spacing, m.connectivity_radius) == (0.05, 0.15)
    assert (t.boundary.friction == 0.3).all()
    assert {tuple(normal) for normal in t.boundary.normal} == {(1.0, 0.0), (-1.0, 0.0)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("material", "value"),
    [
        ("fluid", 8.93e-7),  # water at 25 °C
        ("fluid", 1.14e-7),  # mercury
        ("elastomer", 500.0),  # soft tissue
        ("solid", 2.1e11),  # steel
        ("sand", 65.0),
    ],
)
def test_a_parameter_that_no_solver_computes_is_stored(tmp_path: Path, material: str, value: float) -> None:
    trajectories = [trajectory(k, materials=material, params={material: value}) for k in range(3)]
    report = save_dataset(tmp_path, "set", train=trajectories)
    stored = next(iter_trajectories(Path(report.folder), "train"))
    np.testing.assert_allclose(stored.material_params, value, rtol=1e-6)
    assert not validate([report.folder]).violations


def test_positions_are_folded_into_a_periodic_domain() -> None:
    far = motion().astype(np.float64) + np.array([5.0, 0.0])
    t = trajectory(pos=far, bounds=BOX, periodic=(True, False))
    np.testing.assert_allclose(t.pos, motion(), atol=1e-6)
    assert np.abs(t.vel).max() < 20


def test_lists_will_do() -> None:
    t = trajectory(pos=motion().tolist(), materials=["sand"] * 20)
    np.testing.assert_array_equal(t.pos, motion())


def test_a_mesh() -> None:
    t = trajectory(materials="solid", params={"solid": 1e6}, cells=[[0, 1, 2], [1, 2, 3]])
    assert t.rest_pos is not None and t.cells is not None
    np.testing.assert_array_equal(t.rest_pos, motion()[0])
    assert t.cells.dtype == np.int32


BAD = motion()
BAD[3, 5, 1] = np.nan


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pos": BAD}, "^pos: frame 3, node 5 is nan$"),
        ({"pos": motion()[:2]}, r"^pos \[frame, node, dim\] is \[2, 20, 2\]: at least 3 frames"),
        ({"pos": np.zeros((5, 0, 2))}, "at least 3 frames, 1 node"),
        ({"pos": np.zeros((5, 4, 1))}, "2 or 3 dimensions"),
        ({"pos": motion().astype(object)}, "^pos: has type object, expected real numbers$"),
        ({"pos": motion().astype(complex)}, "^pos: has type complex"),
        ({"pos": [[1, 2], [3]]}, "^pos: not an array of numbers"),
        ({"pos": np.zeros((5, 9, 2))}, "^spacing: half of the nodes coincide with another one"),
        ({"pos": motion(num_nodes=1)}, "^spacing: a single node has no neighbours; pass spacing$"),
        ({"frame_dt": 0}, "^frame_dt=0: must be a positive number of seconds$"),
        ({"frame_dt": np.inf}, "^frame_dt=inf"),
        ({"frame_dt": True}, "^frame_dt=True"),
        ({"materials": "mud"}, "^materials: node 0 is 'mud'; known: sand, snow, fluid, elastomer, solid$"),
        ({"materials": ["sand"] * 3}, "^materials: 3 names for 20 nodes$"),
        ({"params": {}}, r"^params: has nothing, needs sand: friction_angle \[deg\]; give any constant"),
        ({"params": {"sand": 30, "snow": 5}}, "^params: has sand, snow, needs sand"),
        ({"params": {"sand": np.full(20, np.nan)}}, r"^params\['sand'\]: node 0 is nan$"),
        (
            {"materials": "fluid", "params": {"fluid": np.append(np.ones(19), 0.0)}},
            r"^params\['fluid'\]: node 19 has kinematic_viscosity = 0 m\^2/s, must be positive and finite$",
        ),
        ({"vel": np.zeros((10, 20, 3))}, r"^vel: has shape \[10, 20, 3\], expected \[frame 10, node 20, dim 2\]$"),
        ({"mass": np.zeros(20)}, "^mass: node 0 is 0, must be positive$"),
        ({"force": np.ones((20, 2))}, "^mass: there are forces and no masses"),
        ({"mass": [1, 2]}, r"^mass: has shape \[2\], expected \[node 20\]$"),
        ({"bounds": [[0, 1]]}, r"^bounds: has shape \[1, 2\]"),
        ({"bounds": [[1, 0], [0, 1]]}, r"^bounds\[0\] = \(1.0, 0.0\) must be finite with low < high$"),
        ({"bounds": [[0, 0.5], [0, 1]]}, r"^pos: frame 0, node \d+: x = 0\.\d+ m is outside the bounds 0 … 0.5 m$"),
        ({"periodic": [True, False]}, "^bounds: a periodic axis needs bounds"),
        ({"periodic": [True], "bounds": BOX}, "^periodic=.*needs true or false for each of 2 axes$"),
        ({"periodic": True, "bounds": BOX}, "^periodic=True: needs true or false for each of 2 axes$"),
        ({"periodic": ["no", "no"], "bounds": BOX}, r"^periodic=\['no', 'no'\]: needs true or false"),
        ({"periodic": np.array(["False", "True"]), "bounds": BOX}, "^periodic=.*: needs true or false"),
        ({"periodic": [np.nan, 0.0], "bounds": BOX}, "^periodic=.*: needs true or false"),
        ({"periodic": [0, 2], "bounds": BOX}, "^periodic=.*: needs true or false"),
        ({"pos": np.ma.masked_greater(motion(), 0.5)}, "^pos: is a masked array with [0-9]+ masked values"),
        ({"gravity": [0, 0, -9.81]}, r"^gravity: has shape \[3\], expected \[dim 2\]$"),
        ({"gravity": [0, np.nan]}, "^gravity: component 1 is nan$"),
        ({"spacing": 0}, "^spacing=0: must be a positive number of m$"),
        ({"connectivity_radius": -1}, "^connectivity_radius=-1: must be"),
        ({"boundary": Boundary.empty(3)}, r"^boundary: its positions are \[0, 3\], expected \[boundary_node, 2\]$"),
        ({"cells": [[0, 1, 2]]}, "^cells: cell 0 has nodes of sand; a cell is of one material, and meshes are of elastomer, solid$"),
        ({"cells": [[0.0, 1, 2]]}, "^cells: is float64"),
        ({"rest_pos": motion()[0]}, "^rest_pos: only meshes have rest positions"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ArrayError, match=message):
        trajectory(**changes)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([[0, 1, 99]], "cell 0 has the nodes .*99"),
        ([[3, 4, 5], [0, 1, 1]], "cell 1 has the nodes"),
        (
            [[0, 1, 6, 5], [1, 2, 7]],
            "^cells: rows have different lengths; give cells by kind, such as {'triangle': …, 'quadrilateral': …}$",
        ),
        ([[0, 1, 2, 3, 4]], r"^cells: has shape \[1, 5\], expected .* of a kind: line 2, triangle 3, quadrilateral 4$"),
        ({"tetrahedron": [[0, 1, 2, 3]]}, "^cells: unknown kind 'tetrahedron'; in 2D there are line, triangle, quadrilateral$"),
        ({"triangle": [[0, 1, 2, 3]]}, r"^cells\['triangle'\]: has shape \[1, 4\], expected \[cell, 3\]$"),
        ({}, "^cells: has no kind"),
    ],
)
def test_cells_that_do_not_fit(cells: Any, message: str) -> None:
    with pytest.raises(ArrayError, match=message):
        trajectory(materials="solid", params={"solid": 1e6}, cells=cells)


def test_four_corners_in_space_are_declared() -> None:
    shape: dict[str, Any] = {"pos": motion(dim=3), "materials": "solid", "params": {"solid": 1e6}}
    message = "^cells: with 4 corners in 3D they are quadrilateral or tetrahedron; say which: cells={'quadrilateral': …}$"
    with pytest.raises(ArrayError, match=message):
        trajectory(**shape, cells=[[0, 1, 2, 3]])
    with pytest.raises(ArrayError, match="^cells: has quadrilateral, wedge; give triangles instead of quadrilaterals beside volumes$"):
        trajectory(**shape, cells={"quadrilateral": [[0, 1, 2, 3]], "wedge": [[0, 1, 2, 3, 4, 5]]})
    assert [trajectory(**shape, cells={kind: [[0, 1, 2, 3]]}).cell_dim for kind in ("quadrilateral", "tetrahedron")] == [2, 3]


def test_a_radius_of_half_the_period() -> None:
    with pytest.raises(PeriodicityError, match="must be below half the period 1 m of axis x"):
        trajectory(bounds=BOX, periodic=(True, False), connectivity_radius=0.5)


# --- boundaries ----------------------------------------------------------------------------------------------------------------------------


def test_a_boundary_of_points() -> None:
    b = Boundary.from_numpy([[0.0, 0.0], [1.0, 0.0]], [[0, 2], [3, 4]], vel=[1.0, 0.0], friction=[0.1, 0.2])
    np.testing.assert_allclose(b.normal, np.array([[0, 1], [0.6, 0.8]]), rtol=1e-6)
    np.testing.assert_array_equal(b.vel, [[1, 0], [1, 0]])
    np.testing.assert_allclose(b.friction, [0.1, 0.2])
    assert (b.restitution == 0).all()
    assert (Boundary.from_numpy([[0.0, 0.0]], [[0, 1]]).friction == STICKY).all()


def test_boundary_points_without_a_shape_are_named(caplog: pytest.LogCaptureFixture) -> None:
    """The elastic law and containment see no wall there."""
    trajectory_module._warn_of_missing_shapes.cache_clear()
    walls, box = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3), Box((0.4, 0.2), (0.6, 0.4), 0.3)
    sampled = Boundary.sample((*walls, box), 0.05, 2)
    every: tuple[tuple[Shape, ...], ...] = ((*walls, box), ())
    for shapes in every:
        given = Boundary.from_numpy(sampled.pos, sampled.normal, shapes=shapes)
        assert trajectory(boundary=given).boundary.shapes == shapes
    assert not caplog.messages
    part = Boundary.from_numpy(sampled.pos, sampled.normal, shapes=walls)
    for _ in range(2):
        trajectory(boundary=part)
    (said,) = caplog.messages
    assert said.startswith("boundary: some nodes are on none of the shapes; containment and the elastic law see shapes only")


def test_boundary_points_given_as_integers_are_positions() -> None:
    periodicity = Periodicity(((-0.5, 1.5), (0.0, 1.0)), (True, False))
    boundary = Boundary.from_numpy([[2, 0], [3, 0]], [[0, 1], [0, 1]]).inside(periodicity)
    np.testing.assert_array_equal(boundary.pos, [[0.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normal": [[0, 0], [0, 1]]}, "boundary normal: boundary_node 0 has length 0"),
        ({"normal": [[0, 1]]}, r"boundary normal: has shape \[1, 2\], expected \[boundary_node 2, dim 2\]"),
        ({"friction": [-1, 0]}, "boundary friction: boundary_node 0 is -1, must be at least 0"),
        ({"restitution": 1.5}, "boundary restitution: boundary_node 0 is 1.5, must be between 0 and 1"),
        ({"vel": np.inf}, "boundary vel: boundary_node 0 is inf"),
    ],
)
def test_a_boundary_that_does_not_fit(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ArrayError, match=message):
        Boundary.from_numpy(**{"pos": [[0.0, 0.0], [1.0, 0.0]], "normal": [[0, 1], [0, 1]], **changes})


def test_normals_point_to_where_nodes_have_been() -> None:
    rng = np.random.default_rng(0)
    inside = rng.uniform(0.05, 0.95, (5, 400, 2))
    x = np.linspace(0.1, 0.9, 9)
    sides: list[tuple[np.ndarray, list[int]]] = [
        (np.stack([x, 0 * x], 1), [0, 1]),
        (np.stack([x, 0 * x + 1], 1), [0, -1]),
        (np.stack([0 * x, x], 1), [1, 0]),
    ]
    for wall, normal in sides:
        estimated = estimated_normals(wall, inside)
        np.testing.assert_allclose(np.linalg.norm(estimated, axis=1), 1)
        assert (estimated @ normal > 0.8).all()
    space = Periodicity(BOX, (True, False))
    corner = estimated_normals(np.array([[0.0, 0.0]]), inside, space)
    assert corner[0, 1] > 0.8  # free space on both sides of the seam
    assert estimated_normals(np.array([[0.0, 0.0]]), inside)[0, 1] < 0.8
    alone = estimated_normals(np.array([[0.5, 0.5]]), np.array([[0.5, 0.5]]))
    np.testing.assert_allclose(alone, [[0, 1]])


@pytest.mark.parametrize("num_frames", [20, 1000])
def test_normals_of_slow_scenes_come_from_all_nodes(num_frames: int) -> None:
    """Every fiftieth of 2500 nodes in 1000 frames would be the same fifty nodes in all frames."""
    site = (np.arange(50) + 0.5) / 50
    lattice = np.stack(np.meshgrid(site, site), axis=-1).reshape(-1, 2)
    visited = lattice + 1e-4 * np.arange(num_frames)[:, None, None] / num_frames
    zero, one = np.zeros(50), np.ones(50)
    sides = {(1, 0): (zero, site), (-1, 0): (one, site), (0, 1): (site, zero), (0, -1): (site, one)}
    for normal, wall in sides.items():
        estimated = estimated_normals(np.stack(wall, axis=1), visited)
        assert ((estimated @ np.array(normal, float)) > 0.8).mean() > 0.9


def test_the_spacing_of_a_lattice() -> None:
    lattice = 0.1 * np.argwhere(np.ones((10, 5))).astype(np.float64)
    assert typical_spacing(lattice) == pytest.approx(0.1)
    pair = np.array([[0.02, 0.5], [0.95, 0.5]])
    assert typical_spacing(pair, Periodicity(BOX, (True, False))) == pytest.approx(0.07)


# --- data sets -----------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_data_set_of_trajectories(tmp_path: Path) -> None:
    fluid = [trajectory(seed=k, materials="fluid", params={"fluid": 0.1 * k}) for k in (1, 2)]
    test = [trajectory(seed=5, materials=["sand", "fluid"] * 10, params={"sand": 20, "fluid": 0.15})]
    unseen = [trajectory(seed=k, params={"sand": angle}) for k, angle in ((6, 25.0), (7, 50.0))]
    train = [*fluid, trajectory(), trajectory(seed=3, params={"sand": 20.0})]
    report = save_dataset(tmp_path, "mine", train=train, val=[trajectory(seed=4)], test=test, test_unseen=unseen)
    folder = tmp_path / "mine" / "imported"
    assert not [str(v) for v in validate([folder]).violations]
    assert {split: c.trajectories for split, c in report.splits.items()} == {"train": 4, "val": 1, "test": 1, "test_unseen": 2}
    stored = list(iter_trajectories(folder, "train"))
    for t, original in zip(stored, train, strict=True):
        np.testing.assert_array_equal(t.pos, original.pos)
        assert t.metadata.materials == ("sand", "fluid")
        assert t.metadata.spacing == stored[0].metadata.spacing
        assert t.metadata.dataset == "mine"
    assert [t.metadata.parameter_group for t in iter_trajectories(folder, "test_unseen")] == ["interpolated", "extrapolated"]
    statistics = json.loads((folder / "statistics.json").read_text())
    assert statistics["num_trajectories"] == 4
    assert statistics["acceleration_std"] > 0


@pytest.mark.slow
def test_trajectories_are_made_when_they_are_asked_for(tmp_path: Path) -> None:
    """A data set that does not fit into memory."""

    class Scenes(Sequence[Trajectory]):
        made: list[weakref.ref[Trajectory]] = []  # noqa: RUF012

        def __len__(self) -> int:
            return 12

        def __getitem__(self, k: Any) -> Any:
            assert sum(ref() is not None for ref in self.made) < 3
            found = trajectory(seed=k)
            self.made.append(weakref.ref(found))
            return found

    report = save_dataset(tmp_path, "mine", train=Scenes())
    assert report.splits["train"].trajectories == 10
    generated = save_dataset(tmp_path, "other", train=(trajectory(seed=k) for k in range(3)))
    assert generated.splits["train"].trajectories == 1


def test_a_trajectory_that_cannot_be_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trajectory that fails in the second pass does not affect the others, unless it is the last of its split."""
    decided: list[None] = []
    decide = assemble._Conversion._decide

    class Scenes(Sequence[Trajectory]):
        def __len__(self) -> int:
            return 3

        def __getitem__(self, k: Any) -> Any:
            if k == 1 and decided:
                raise KeyError("gone")
            return trajectory(seed=k)

    monkeypatch.setattr(assemble._Conversion, "_decide", lambda self: decided.append(decide(self)))
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' checks of types look at items themselves
    report = save_dataset(tmp_path, "mine", train=Scenes(), holdout=0.0)
    assert [str(e) for e in report.refusals] == ["train, train[1]: cannot be read (KeyError: 'gone')"]
    assert report.splits["train"].trajectories == 2
    decided.clear()
    with pytest.raises(ImportFailure, match=r"no trajectory of test can be used: test, train\[1\]: cannot be read"):
        save_dataset(tmp_path, "other", train=Scenes())


def test_what_is_missing_is_taken_from_the_end_of_train(tmp_path: Path) -> None:
    report = save_dataset(tmp_path, "mine", train=[trajectory(seed=k) for k in range(12)], holdout=0.25)
    assert {split: c.trajectories for split, c in report.splits.items()} == {"train": 6, "val": 3, "test": 3}
    path = tmp_path / "mine" / "imported" / "val" / "shard-00000.h5"
    np.testing.assert_array_equal(read_trajectory(path, "00000").pos, motion(seed=9))
    assert sum("the source has no" in note for note in report.notes) == 2


def test_imported_data_are_never_overwritten(tmp_path: Path) -> None:
    save_dataset(tmp_path, "mine", train=[trajectory(seed=k) for k in range(3)])
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(ImportFailure, match="exists already, and imported data are never overwritten; delete it, or choose another name="):
        save_dataset(tmp_path, "mine", train=[trajectory(seed=9)])
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("name", "splits", "message"),
    [
        ("a/b", {"train": [0]}, "name='a/b': must be a folder's name"),
        ("../x", {"train": [0]}, "name='../x': must be"),
        ("x", {}, "train has no trajectories"),
        ("x", {"train": []}, "train has no trajectories"),
        ("x", {"train": [0], "vla": [1]}, "vla is none of"),
        ("x", {"train": [0, 0]}, None),
    ],
)
def test_a_data_set_that_cannot_be(tmp_path: Path, name: str, splits: dict[str, list[int]], message: str | None) -> None:
    given = {split: [trajectory(seed=k) for k in seeds] for split, seeds in splits.items()}
    if message is None:
        report = save_dataset(tmp_path, name, 0.1, **given)
        assert [e.what for e in report.refusals] == ["has exactly the positions of train, train[0]: the same scene twice"]
        return
    with pytest.raises(ImportFailure, match=message):
        save_dataset(tmp_path, name, 0.1, **given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("train", "message"),
    [
        (trajectory(), r"train: is one trajectory; give a list of them, train=\[…\]"),
        ([trajectory(), np.zeros((3, 2, 2))], r"train\[1\]: is of type ndarray; make a trajectory of arrays with Trajectory.from_numpy"),
    ],
    ids=["one", "arrays"],
)
def test_only_trajectories_make_a_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, train: Any, message: str) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users have it
    with pytest.raises(ImportFailure, match=message):
        save_dataset(tmp_path, "x", train=train)
    assert not list(tmp_path.iterdir())


def test_trajectories_that_do_not_belong_together(tmp_path: Path) -> None:
    other = trajectory(seed=1, frame_dt=0.5)
    flat = trajectory(seed=2, pos=motion(dim=3))
    report = save_dataset(tmp_path, "mine", train=[trajectory(), other, flat, trajectory(seed=3)], holdout=0.0)
    assert [(e.trajectory, "frame_dt, dimension and periodic axes are" in e.what) for e in report.refusals] == [
        ("train[1]", True),
        ("train[2]", True),
    ]
    assert report.splits["train"].trajectories == 2


def test_what_only_falls_teaches_nothing(tmp_path: Path) -> None:
    steady = np.arange(20.0)[:, None] + 0.25 * np.arange(10)[:, None, None] * np.ones(2)  # exact in binary
    with pytest.raises(ImportFailure, match="nothing accelerates other than by gravity"):
        save_dataset(tmp_path, "mine", train=[trajectory(pos=steady)])
    assert not (tmp_path / "mine").exists()


def test_arrays_of_the_caller_can_be_used_again() -> None:
    for dtype in (np.float32, np.float64):
        pos, vel = motion().astype(dtype), np.ones_like(motion(), np.float32)
        given: dict[str, Any] = {
            "pos": pos,
            "vel": vel,
            "force": np.ones_like(vel),
            "mass": np.ones(pos.shape[1]),
            "prescribed": np.arange(pos.shape[1]) < 2,
        }
        made = trajectory(**given)
        before = {name: np.array(getattr(made, name)) for name in given}
        for values in given.values():
            values[:] = 0
        for name, values in before.items():
            np.testing.assert_array_equal(getattr(made, name), values, err_msg=name)
