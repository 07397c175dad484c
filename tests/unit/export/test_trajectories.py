from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from gpe_pl.data.importers import save_dataset
from gpe_pl.export.trajectories import write_npz, write_vtk
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import FIELDS, node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.store import iter_trajectories, stored_arrays
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from tests.conftest import make_trajectory
from tests.unit.viz.conftest import block, falling, falling_mesh

meshio = pytest.importorskip("meshio", reason="meshio, another reader of VTK files, is not installed")


def series(path: Path) -> list[tuple[float, Any]]:
    """Return times and grids of a series, as another program reads them."""
    entries = ElementTree.parse(path).getroot().iter("DataSet")
    return [(float(e.attrib["timestep"]), meshio.read(path.parent / e.attrib["file"])) for e in entries]


def rowed(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with velocities and stresses in which no two numbers are equal."""
    rng = np.random.default_rng(0)
    stress = (
        None
        if trajectory.stress is None
        else Stress(rng.normal(size=trajectory.stress.node.shape), rng.normal(size=trajectory.stress.cell.shape))
    )
    return replace(trajectory, vel=rng.normal(size=trajectory.vel.shape), stress=stress)


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_come_back(tmp_path: Path, dim: int) -> None:
    truth = rowed(falling(dim))
    moved = replace(truth, pos=truth.pos + 0.01, node_type=np.full(truth.num_nodes, node_code("snow"), np.uint8))
    write_vtk(tmp_path / "deep" / "a.pvd", moved, truth, stride=5)
    found = series(tmp_path / "deep" / "a.pvd")
    assert [time for time, _ in found] == pytest.approx([0.0, 0.1, 0.2])
    for frame, (_, grid) in zip((0, 5, 10), found, strict=True):
        np.testing.assert_array_equal(grid.points[:, :dim], moved.pos[frame])
        np.testing.assert_array_equal(grid.points[:, dim:], 0)
        np.testing.assert_array_equal(grid.point_data["velocity"][:, :dim], moved.vel[frame])
        np.testing.assert_allclose(grid.point_data["error"], 0.01 * np.sqrt(dim))
        assert set(grid.point_data["material"]) == {node_code("snow")} and "friction_angle" in grid.point_data
        assert [(block.type, len(block.data)) for block in grid.cells] == [("vertex", truth.num_nodes)]
    boundary = meshio.read(tmp_path / "deep" / "a" / "boundary.vtu")
    np.testing.assert_array_equal(boundary.points[:, :dim], truth.boundary.pos)
    np.testing.assert_array_equal(boundary.point_data["friction"], truth.boundary.friction)
    assert {p.suffix for p in (tmp_path / "deep").rglob("*") if p.is_file()} == {".pvd", ".vtu"}


@pytest.mark.parametrize("dim", [2, 3])
def test_meshes_come_back_with_their_stress(tmp_path: Path, dim: int) -> None:
    mesh = rowed(falling_mesh(dim))
    assert mesh.stress is not None and mesh.cells is not None and mesh.rest_pos is not None
    write_vtk(tmp_path / "a.pvd", mesh)
    _, grid = series(tmp_path / "a.pvd")[3]
    cells, particles = grid.cells
    assert (cells.type, particles.type) == ("quad" if dim == 2 else "tetra", "vertex")
    np.testing.assert_array_equal(cells.data, mesh.cells)
    np.testing.assert_array_equal(particles.data[:, 0], [mesh.num_nodes - 2, mesh.num_nodes - 1])
    np.testing.assert_allclose(grid.point_data["displacement"][:, :dim], mesh.pos[3] - mesh.rest_pos)
    # stored xx, xy, (xz,) yy, (yz,) zz become XX, YY, ZZ, XY, YZ, XZ
    names = ("xx", "xy", "yy", "zz") if dim == 2 else ("xx", "xy", "xz", "yy", "yz", "zz")
    order = [names.index(n) if n in names else None for n in ("xx", "yy", "zz", "xy", "yz", "xz")]
    for found, stored in ((grid.point_data["stress"], mesh.stress.node[3]), (grid.cell_data["stress"][0], mesh.stress.cell[3])):
        expected = np.stack([np.zeros(len(stored)) if k is None else stored[:, k] for k in order], axis=1)
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_allclose(grid.cell_data["von_mises"][0], mesh.stress.cell_von_mises[3])
    assert np.isnan(grid.cell_data["von_mises"][1]).all()


GRID = np.arange(9).reshape(3, 3)
QUADS = np.stack([GRID[:-1, :-1], GRID[1:, :-1], GRID[1:, 1:], GRID[:-1, 1:]], -1).reshape(-1, 4)
CUBE = [0, 1, 3, 2, 4, 5, 7, 6]
"""A hexahedron of the corners of a cube, numbered in binary."""
MESHES: dict[str, tuple[int, int, dict[str, Any]]] = {
    "quadrilaterals": (2, 9, {"quadrilateral": QUADS}),
    "a shell of quadrilaterals": (3, 9, {"quadrilateral": QUADS}),
    "triangles and quadrilaterals": (2, 9, {"triangle": [[0, 3, 4], [0, 4, 1]], "quadrilateral": QUADS[1:]}),
    "a shell of both": (3, 9, {"quadrilateral": QUADS[1:], "triangle": [[0, 3, 4], [0, 4, 1]]}),
    "tetrahedra": (3, 5, {"tetrahedron": [[0, 1, 2, 3], [1, 2, 3, 4]]}),
    "a hexahedron and a tetrahedron": (3, 9, {"hexahedron": [CUBE], "tetrahedron": [[4, 5, 6, 8]]}),
    "a wedge, a triangle and a line": (3, 9, {"wedge": [[0, 1, 2, 3, 4, 5]], "triangle": [[2, 5, 6]], "line": [[6, 8]]}),
}
NAMES = {
    "line": "line",
    "wedge": "wedge",
    "triangle": "triangle",
    "quadrilateral": "quad",
    "tetrahedron": "tetra",
    "hexahedron": "hexahedron",
}


def meshed(name: str) -> Trajectory:
    """Return a mesh that swings, of cells that are a little distorted."""
    dim, count, cells = MESHES[name]
    points = np.random.default_rng(0).uniform(0.0, 0.3, (count, dim))
    if "quadrilateral" in cells:
        points[:, :2] += np.argwhere(GRID >= 0)
    elif "hexahedron" in cells:
        points[:8] += np.argwhere(np.ones((2, 2, 2)))[:, ::-1]
    elif "wedge" in cells:
        points[:6] += [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (0, 1))]
    rest = 0.3 + 0.1 * points
    swing = 0.01 * np.sin(np.arange(8)[:, None, None] + rest)
    return Trajectory.from_numpy(rest + swing, 0.01, "elastomer", {"elastomer": 1e5}, cells=cells)


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_cells_keep_their_kind(tmp_path: Path, name: str) -> None:
    """Through the store and a rollout to a program that draws them."""
    made = meshed(name)
    assert made.cells is not None
    report = save_dataset(tmp_path, "set", train=[made], holdout=0.0)
    stored = next(iter_trajectories(report.folder, "train"))
    rolled = rollout(ConstantVelocity(0.01), stored.state(0), 3, stored.metadata)
    for trajectory in (made, stored, stored.frames(2), rolled):
        write_vtk(tmp_path / "a.pvd", trajectory)
        _, grid = series(tmp_path / "a.pvd")[0]
        found = {group.type: group.data.tolist() for group in grid.cells if group.type != "vertex"}
        if "wedge" in found:  # meshio turns wedges of VTK files round
            found["wedge"] = [[cell[k] for k in (0, 2, 1, 3, 5, 4)] for cell in found["wedge"]]
        assert found == {NAMES[kind]: np.asarray(cells).tolist() for kind, cells in MESHES[name][2].items()}
        alone = {node for group in grid.cells if group.type == "vertex" for node in group.data.ravel().tolist()}
        assert alone == set(range(made.num_nodes)) - set(np.ravel(made.cells).tolist())


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_vtk_itself_sees_the_kinds(tmp_path: Path, name: str) -> None:
    vtk = pytest.importorskip("vtk", reason="vtk is not installed")
    write_vtk(tmp_path / "a.pvd", meshed(name))
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "a" / "frame_00000.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    codes = {
        "line": vtk.VTK_LINE,
        "wedge": vtk.VTK_WEDGE,
        "triangle": vtk.VTK_TRIANGLE,
        "quadrilateral": vtk.VTK_QUAD,
        "tetrahedron": vtk.VTK_TETRA,
        "hexahedron": vtk.VTK_HEXAHEDRON,
    }
    wanted = [(codes[kind], cell) for kind, cells in MESHES[name][2].items() for cell in np.asarray(cells).tolist()]
    for k, (code, nodes) in enumerate(wanted):
        cell = grid.GetCell(k)
        assert (cell.GetCellType(), [cell.GetPointId(i) for i in range(cell.GetNumberOfPoints())]) == (code, nodes)


def test_cells_of_no_kind_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    mesh = falling_mesh(2)
    assert mesh.cells is not None
    with pytest.raises(
        ValueError, match=r"cell 0 has the nodes \[.*\], which form none of line, triangle, quadrilateral, tetrahedron, wedge, hexahedron"
    ):
        write_vtk(tmp_path / "a.pvd", replace(mesh, cells=mesh.cells[:, :1]))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("turns", [0.5, 1.7])
def test_a_mesh_stays_whole_at_the_seam_and_its_displacement_goes_on(tmp_path: Path, turns: float) -> None:
    corners, cells = block(2)
    way = np.linspace(0, turns, 20)[:, None, None] * np.array([1.0, 0.0]) * np.ones((9, 1))
    way[1:, :, 0] += 0.04 * (-1.0) ** np.arange(9)  # so that some nodes are more than half a period from rest, and others less
    start = 0.4 + 0.2 * corners
    mesh = Trajectory.from_numpy(
        start + way, 0.01, "elastomer", {"elastomer": 1e5}, bounds=[(0, 1), (0, 1)], periodic=[True, False], cells=cells
    )
    for first in (0, 18):  # a rollout may start late
        write_vtk(tmp_path / "a.pvd", mesh.frames(first, mesh.num_frames), stride=2)
        for frame, (_, grid) in zip(range(first, mesh.num_frames, 2), series(tmp_path / "a.pvd"), strict=True):
            assert np.ptp(grid.points[grid.cells[0].data], axis=1).max() < 0.2
            np.testing.assert_allclose(grid.points[:, 0] % 1, mesh.pos[frame, :, 0] % 1, atol=1e-6)
            moved = way[frame] - np.round(way[first, 0])  # turns before the first frame are not known
            np.testing.assert_allclose(grid.point_data["displacement"][:, :2], moved, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_vtk_itself_reads_it(tmp_path: Path, dim: int) -> None:
    """ParaView reads by the same classes."""
    vtk = pytest.importorskip("vtk", reason="vtk is not installed")
    mesh = rowed(falling_mesh(dim))
    assert mesh.stress is not None and mesh.cells is not None
    write_vtk(tmp_path / "a.pvd", mesh)
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "a" / "frame_00002.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    assert reader.GetErrorCode() == 0
    assert (grid.GetNumberOfPoints(), grid.GetNumberOfCells()) == (mesh.num_nodes, len(mesh.cells) + 2)
    array = grid.GetCellData().GetArray("stress")
    assert [array.GetComponentName(k) for k in range(6)] == ["XX", "YY", "ZZ", "XY", "YZ", "XZ"]
    assert array.GetTuple(0)[0] == mesh.stress.cell[2, 0, 0]
    assert grid.GetPoint(5)[:dim] == tuple(mesh.pos[2, 5])


def test_a_new_series_takes_the_place_of_an_earlier_one(tmp_path: Path) -> None:
    trajectory = make_trajectory(num_frames=5)
    write_vtk(tmp_path / "series.pvd", trajectory)
    (tmp_path / "series" / "notes.txt").write_text("of the user")
    without_walls = replace(trajectory, boundary=Boundary.empty(trajectory.metadata.dim))
    write_vtk(tmp_path / "series.pvd", without_walls, stride=3)
    assert sorted(path.name for path in (tmp_path / "series").iterdir()) == ["frame_00000.vtu", "frame_00003.vtu", "notes.txt"]


def test_an_archive_holds_what_the_store_holds(tmp_path: Path) -> None:
    mesh = falling_mesh(2)
    write_npz(tmp_path / "a.npz", mesh)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        stored = stored_arrays(mesh)
        assert set(archive) == {*stored, "metadata", "shapes", "node_types"} and set(stored) <= set(FIELDS)
        for name, values in stored.items():
            np.testing.assert_array_equal(archive[name], values)
        assert TypeAdapter(Metadata).validate_json(str(archive["metadata"])) == mesh.metadata
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def single(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory in the precision of the store."""
    return replace(trajectory, pos=trajectory.pos.astype(np.float32))


@pytest.mark.parametrize("config", ["", "sand", "[1]", '{"origin": [1.0]}', '{"origin": ["a", "b"]}', '{"origin": [0.0, 0.0]}'])
def test_other_settings_move_nothing(tmp_path: Path, config: str) -> None:
    other = replace(single(falling(2)), metadata=replace(falling(2).metadata, config=config))
    write_npz(tmp_path / "a.npz", other)
    write_vtk(tmp_path / "a.pvd", other)
    assert "origin" not in np.load(tmp_path / "a.npz").files
    assert series(tmp_path / "a.pvd")[0][1].points.dtype == np.float32


def test_files_know_the_coordinates_of_the_source(tmp_path: Path) -> None:
    """Archives say where the origin was moved to. Series for ParaView are in the coordinates of the source, beside which they are shown."""
    truth, origin = single(falling(2)), np.array([500123.0, 5800321.0])
    moved = replace(truth, metadata=replace(truth.metadata, config='{"origin": [500123.0, 5800321.0]}'))
    write_npz(tmp_path / "a.npz", moved)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert archive["origin"].tolist() == origin.tolist()
        np.testing.assert_array_equal(archive["pos"], truth.pos)
    write_vtk(tmp_path / "a.pvd", moved, truth)
    for frame, (_, grid) in enumerate(series(tmp_path / "a.pvd")):
        assert grid.points.dtype == np.float64
        np.testing.assert_allclose(grid.points[:, :2] - origin, truth.pos[frame], atol=1e-8)
        np.testing.assert_array_equal(grid.points[:, 2], 0)
        np.testing.assert_array_equal(grid.point_data["error"], 0)
    boundary = meshio.read(tmp_path / "a" / "boundary.vtu")
    np.testing.assert_allclose(boundary.points[:, :2] - origin, truth.boundary.pos, atol=1e-8)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    truth = falling(2)
    with pytest.raises(ValueError, match=r"a VTK series ends in \.pvd"):
        write_vtk(tmp_path / "a.vtu", truth)
    with pytest.raises(ValueError, match="stride must be positive"):
        write_vtk(tmp_path / "a.pvd", truth, stride=0)
    with pytest.raises(ValueError, match=r"ground truth has \(5, 25\) frames and nodes, the trajectory \(12, 25\)"):
        write_vtk(tmp_path / "a.pvd", truth, truth.frames(0, 5))
    with pytest.raises(
        ValueError, match=r"the trajectory begins at 0\.\d+ s, the ground truth at 0 s; cut one of them \(Trajectory\.frames\)"
    ):
        write_vtk(tmp_path / "a.pvd", truth.frames(5), truth)
    with pytest.raises(ValueError, match=r"a NumPy archive ends in \.npz"):
        write_npz(tmp_path / "a.npy", truth)
    assert not [*tmp_path.iterdir()]
