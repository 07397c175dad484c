"""Series of VTU, XDMF, PVD and Exodus files become trajectories with clamps, forces, stress and masses; others are refused by file and array."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from gpe_pl.data.importers.mesh_files import Frame
from gpe_pl.data.importers.meshes import mean_at_nodes, without_faces
from gpe_pl.export.trajectories import write_vtk
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory

meshio = pytest.importorskip("meshio", reason="meshio is not installed")

FRAMES, DT, SIZE, DENSITY = 7, 0.01, 0.1, 1200.0
POINTS = SIZE * np.argwhere(np.ones((3, 2, 2)))
CELLS = np.array([[0, 4, 6, 2, 1, 5, 7, 3], [4, 8, 10, 6, 5, 9, 11, 7]])
FLAT = SIZE * np.argwhere(np.ones((3, 2, 1)))
TRIANGLES = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])
VTK = [0, 3, 5, 1, 4, 2]
"""Components of a stress in the store's order, in VTK's order."""


def displacement(points: np.ndarray) -> np.ndarray:
    """Return displacements [frame, point, 3] that grow with the distance from the clamp."""
    time = DT * np.arange(FRAMES)[:, None, None]
    way = np.array([0.1, -1.0, 0.3]) * (np.ptp(points, axis=0) > 0)
    return np.sin(40 * time) * (points[:, :1] ** 2) * way


def stress(count: int) -> np.ndarray:
    """Return values [frame, place, 6] in VTK's order, which tell their place."""
    return 100.0 * np.arange(FRAMES)[:, None, None] + 10.0 * np.arange(count)[:, None] + np.arange(6)


def force() -> np.ndarray:
    values = np.zeros((FRAMES, len(POINTS), 3))
    values[:, 8:, 1] = -np.arange(FRAMES)[:, None]
    return values


def arrays(frame: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the point data and cell data of a frame."""
    points = {
        "displacement": displacement(POINTS)[frame],
        "velocity": displacement(POINTS)[frame] * 3,
        "force": force()[frame],
        "prescribed": (POINTS[:, 0] == 0).astype(float),
    }
    return points, {"S": [stress(2)[frame]], "density": [np.full(2, DENSITY)], "youngs_modulus": [np.array([1e5, 3e5])]}


def write_folder(folder: Path, edit: Callable[[Any, int], Any] = lambda mesh, frame: mesh) -> None:
    (folder / "beam").mkdir(parents=True)
    for frame in range(FRAMES):
        points, cells = arrays(frame)
        mesh = edit(meshio.Mesh(POINTS, [("hexahedron", CELLS)], point_data=points, cell_data=cells), frame)
        mesh.write(folder / "beam" / f"step_{frame}.vtu")


def write_xdmf(folder: Path, power: float = 1.0, data_format: str = "XML") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with meshio.xdmf.TimeSeriesWriter(folder / "beam.xdmf", data_format=data_format) as writer:
        writer.write_points_cells(POINTS, [("hexahedron", CELLS)])
        for frame in range(FRAMES):
            points, cells = arrays(frame)
            writer.write_data(DT * frame**power, point_data=points, cell_data=cells)


def imported(tmp_path: Path, **settings: Any) -> Trajectory:
    given = ImportSettings("meshio", str(tmp_path / "raw"), "set", holdout=0.0, **settings)
    report = import_dataset(tmp_path / "data", given)
    assert not report.refusals
    return next(iter_trajectories(tmp_path / "data" / "set" / "imported", "train"))


@pytest.mark.parametrize("series", ["folders", "xdmf"])
def test_a_series_of_meshio_becomes_a_trajectory(tmp_path: Path, series: str) -> None:
    write_folder(tmp_path / "raw") if series == "folders" else write_xdmf(tmp_path / "raw")
    found = imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT if series == "folders" else None)
    assert (found.num_frames, found.metadata.materials) == (FRAMES, ("solid",))
    assert found.metadata.frame_dt == pytest.approx(DT)
    np.testing.assert_allclose(found.pos - found.pos[0], displacement(POINTS), atol=1e-6)
    np.testing.assert_allclose(found.vel, 3 * displacement(POINTS), atol=1e-6)
    assert found.cells is not None and found.cells.tolist() == CELLS.tolist() and found.cell_dim == 3
    assert found.prescribed is not None and found.prescribed.tolist() == [[True] * 3] * 4 + [[False] * 3] * 8
    assert found.force is not None and found.stress is not None
    between = np.arange(FRAMES).clip(max=FRAMES - 1.5) + 0.5  # of a force that grows with time
    between[-1] = FRAMES - 1
    np.testing.assert_allclose(found.force[:, 8:, 1], -np.repeat(between[:, None], 4, axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.mass, DENSITY * SIZE**3 / 8 * np.repeat([1, 2, 1], 4), rtol=1e-5)
    np.testing.assert_allclose(found.material_params[:, 0], np.repeat([1e5, 2e5, 3e5], 4), rtol=1e-5)
    of_cells = stress(2)
    at_nodes = np.repeat(np.stack([of_cells[:, 0], of_cells.mean(axis=1), of_cells[:, 1]], axis=1), 4, axis=1)
    np.testing.assert_allclose(found.stress.node, at_nodes[..., VTK], rtol=1e-5)


def test_points_can_be_held_along_some_axes(tmp_path: Path) -> None:
    rollers = np.stack([POINTS[:, 0] == 0, POINTS[:, 1] == 0, np.zeros(len(POINTS))], axis=1)

    def edit(mesh: Any, frame: int) -> Any:
        mesh.point_data["prescribed"] = rollers.astype(float)
        return mesh

    write_folder(tmp_path / "raw", edit)
    found = imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)
    np.testing.assert_array_equal(found.prescribed, rollers)


def test_plane_meshes_with_points_that_move_and_nodes_with_stress(tmp_path: Path) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(FRAMES):
        data = {"stress": stress(6)[frame], "mass": np.full(6, 2.0), "material": np.full(6, 3)}
        mesh = meshio.Mesh(FLAT + displacement(FLAT)[frame], [("triangle", TRIANGLES)], point_data=data)
        mesh.write(tmp_path / "raw" / "a" / f"{frame}.vtk")
    found = imported(tmp_path, frame_dt=DT, materials={3: "elastomer"}, parameters={"elastomer": 7e5})
    assert (found.metadata.dim, found.metadata.materials) == (2, ("elastomer",))
    np.testing.assert_allclose(found.pos - found.pos[0], displacement(FLAT)[..., :2], atol=1e-6)
    assert found.stress is not None
    np.testing.assert_allclose(found.stress.node, stress(6)[..., [0, 3, 1, 2]], rtol=1e-5)
    np.testing.assert_allclose(found.mass, 2.0)


def test_what_this_package_exports_comes_back(tmp_path: Path) -> None:
    """Also wedges, whose corners meshio reads in another order."""
    rest = np.random.default_rng(0).uniform(0, 0.1, (7, 3)) + np.array(
        [[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [2, 2, 2]]
    )
    swing = 0.01 * np.sin(np.arange(8)[:, None, None] + rest)
    made = Trajectory.from_numpy(
        rest + swing,
        DT,
        "elastomer",
        {"elastomer": 4e5},
        cells={"wedge": [[0, 1, 2, 3, 4, 5]], "tetrahedron": [[0, 1, 2, 6]]},
        rest_pos=rest,
        mass=3.0,
    )
    (tmp_path / "raw").mkdir()
    write_vtk(tmp_path / "raw" / "a.pvd", made)
    found = imported(tmp_path, materials={3: "elastomer"})
    assert found.metadata.frame_dt == pytest.approx(DT)
    np.testing.assert_allclose(found.pos - found.pos[0], made.pos - made.pos[0], atol=1e-6)
    assert found.cells is not None and made.cells is not None and found.rest_pos is not None
    assert sorted(found.cells.tolist()) == sorted(made.cells.tolist())
    np.testing.assert_allclose(found.rest_pos - found.pos[0], rest - made.pos[0], atol=1e-6)
    np.testing.assert_allclose(found.material_params[:, 0], 4e5)
    np.testing.assert_allclose(found.mass, 3.0)


def test_exodus_with_all_times(tmp_path: Path) -> None:
    netcdf = pytest.importorskip("netCDF4", reason="netCDF4 is not installed")
    (tmp_path / "raw").mkdir()
    names = {"n": ["disp_x", "disp_y", "disp_z", "mass"], "e": [f"stress_{c}" for c in ("xx", "yy", "zz", "xy", "yz", "zx")]}
    with netcdf.Dataset(tmp_path / "raw" / "beam.e", "w", format="NETCDF3_64BIT_OFFSET") as file:
        for name, size in {"time_step": None, "node": 12, "len": 16, "cell": 2, "corner": 8, "n": 4, "e": 6}.items():
            file.createDimension(name, size)
        for k, axis in enumerate("xyz"):
            file.createVariable(f"coord{axis}", "f8", ("node",))[:] = POINTS[:, k]
        connect = file.createVariable("connect1", "i4", ("cell", "corner"))
        connect.elem_type, connect[:] = "HEX8", CELLS + 1
        time = file.createVariable("time_whole", "f8", ("time_step",))
        texts = {
            "n": file.createVariable("name_nod_var", "S1", ("n", "len")),
            "e": file.createVariable("name_elem_var", "S1", ("e", "len")),
        }
        for key, own in names.items():
            for k, name in enumerate(own):
                texts[key][k] = [c.encode() for c in name.ljust(16, "\0")]
        nodal = [file.createVariable(f"vals_nod_var{k + 1}", "f8", ("time_step", "node")) for k in range(4)]
        of_cells = [file.createVariable(f"vals_elem_var{k + 1}eb1", "f8", ("time_step", "cell")) for k in range(6)]
        for frame in range(FRAMES):
            time[frame] = DT * frame
            for k in range(3):
                nodal[k][frame] = displacement(POINTS)[frame, :, k]
            nodal[3][frame] = 2.0
            for k in range(6):
                of_cells[k][frame] = stress(2)[frame, :, k]
    found = imported(tmp_path, arrays={"displacement": "disp"})
    np.testing.assert_allclose(found.pos - found.pos[0], displacement(POINTS), atol=1e-6)
    assert found.stress is not None and found.cells is not None and found.cells.tolist() == CELLS.tolist()
    np.testing.assert_allclose(found.stress.node[:, 0], stress(2)[:, 0][:, VTK], rtol=1e-5)


def test_exodus_with_a_block_without_stress_is_refused(tmp_path: Path) -> None:
    netcdf = pytest.importorskip("netCDF4")
    (tmp_path / "raw").mkdir()
    with netcdf.Dataset(tmp_path / "raw" / "beam.e", "w") as file:
        for name, size in {"time_step": None, "node": len(POINTS), "cell": 1, "corner": 8, "len": 16, "n": 2, "e": 1}.items():
            file.createDimension(name, size)
        for k, axis in enumerate("xyz"):
            file.createVariable(f"coord{axis}", "f8", ("node",))[:] = POINTS[:, k]
        for block in (1, 2):
            connect = file.createVariable(f"connect{block}", "i4", ("cell", "corner"))
            connect.elem_type, connect[:] = "HEX8", CELLS[block - 1 : block] + 1
        for key, names in (("n", ("disp_x", "disp_y")), ("e", ("density",))):
            text = file.createVariable("name_nod_var" if key == "n" else "name_elem_var", "S1", (key, "len"))
            for k, name in enumerate(names):
                text[k] = [c.encode() for c in name.ljust(16, "\0")]
        time = file.createVariable("time_whole", "f8", ("time_step",))
        moved = [file.createVariable(f"vals_nod_var{k}", "f8", ("time_step", "node")) for k in (1, 2)]
        density = file.createVariable("vals_elem_var1eb1", "f8", ("time_step", "cell"))
        for frame in range(FRAMES):
            time[frame], density[frame] = DT * frame, DENSITY
            for k in range(2):
                moved[k][frame] = displacement(POINTS)[frame, :, k]
    with pytest.raises(ImportFailure, match=r"beam.e has no 'density' in some of its cells; write it in all blocks of cells"):
        imported(tmp_path, arrays={"displacement": "disp"})
    with pytest.raises(ImportFailure, match=r"'disp_y' has shape \[12\], expected \[point, 2\] or \[point, 3\]"):
        imported(tmp_path, arrays={"displacement": "disp_y"})


def test_cells_of_the_surface_add_no_mass_and_no_stress(tmp_path: Path) -> None:
    """Mesh generators write the triangles of the surface beside the tetrahedra."""
    corners = SIZE * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    cells = [("triangle", np.array([[0, 1, 2], [0, 1, 3]])), ("tetra", np.array([[0, 1, 2, 3]])), ("line", np.array([[0, 1]]))]
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(FRAMES):
        data = {
            "density": [np.full(2, DENSITY), np.full(1, DENSITY), np.full(1, DENSITY)],
            "stress": [np.full((2, 6), 7.0), np.full((1, 6), 3.0), np.full((1, 6), 9.0)],
        }
        mesh = meshio.Mesh(corners + displacement(corners)[frame], cells, cell_data=data)
        mesh.write(tmp_path / "raw" / "a" / f"{frame}.vtu")
    found = imported(tmp_path, frame_dt=DT)
    np.testing.assert_allclose(found.mass, DENSITY * SIZE**3 / 6 / 4, rtol=1e-5)
    assert found.stress is not None
    np.testing.assert_allclose(found.stress.node, 3.0)
    assert found.cells is not None and found.cells.tolist() == [[0, 1, 2, 3]] and found.cell_dim == 3
    assert "cells of kind triangle whose corners" in next((tmp_path / "data").rglob("report.json")).read_text()


def test_values_of_vertices_are_values_of_their_points() -> None:
    order = np.array([[2], [0], [3], [1]])
    cells = [("vertex", order[:1]), ("line", [[0, 1]]), ("vertex", order[1:])]
    values = 10.0 * order
    data = {"mass": [values[:1], np.zeros((1, 1)), values[1:]], "speed": [np.zeros((n, 1)) for n in (1, 1, 3)]}
    frame = Frame.of("a.vtu", 0.0, meshio.Mesh(FLAT[:4], cells, point_data={"speed": np.ones(4)}, cell_data=data))
    assert frame.point_data["mass"].ravel().tolist() == [0, 10, 20, 30]
    assert frame.point_data["speed"].tolist() == [1] * 4
    some = meshio.Mesh(FLAT[:4], [("vertex", order[:3])], cell_data={"mass": [values[:3]]})
    assert Frame.of("a.vtu", 0.0, some).point_data == {}


def test_only_cells_that_belong_to_a_larger_one_are_left_out() -> None:
    cells = {
        "hexahedron": np.array([[0, 1, 2, 3, 4, 5, 6, 6]]),  # collapsed: a corner twice
        "triangle": np.array([[0, 1, 2], [4, 6, 7]]),
        "line": np.array([[4, 7], [0, 1], [8, 9]]),
    }
    found = without_faces(cells, 10)
    assert {kind: own.tolist() for kind, own in found.items()} == {
        "hexahedron": cells["hexahedron"].tolist(), "triangle": [[4, 6, 7]], "line": [[8, 9]],
    }  # fmt: skip
    nothing = {"tetrahedron": np.zeros((0, 4), int), "triangle": np.array([[0, 1, 2]])}
    assert without_faces(nothing, 3)["triangle"].tolist() == [[0, 1, 2]]
    assert without_faces({"tetrahedron": CELLS, "triangle": CELLS[:, :3]}, 12).keys() == {"tetrahedron"}


def test_nodes_without_a_solid_have_the_mean_of_their_other_cells() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [3.0, 0.0]])
    cells = {"line": np.array([[1, 3], [0, 1]]), "triangle": np.array([[0, 1, 2]])}
    found = mean_at_nodes(points, cells, {"line": np.array([5.0, 7.0]), "triangle": np.array([2.0])})
    assert found.tolist() == [2.0, 2.0, 2.0, 5.0]


def test_cells_over_the_seam_of_a_periodic_domain_have_their_own_size(tmp_path: Path) -> None:
    """Also as weights of what cells have: a cell over the seam, of stress 3, is twice as wide as the others, of stress 0."""
    points = np.array([[x, y, 0.0] for x in (0.0, 0.2, 0.4, 0.6) for y in (0.0, 0.1)])
    cells = np.array([[2 * k, (2 * k + 2) % 8, (2 * k + 3) % 8, 2 * k + 1] for k in range(4)])
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(FRAMES):
        moved = 0.01 * np.sin(40 * DT * frame) * np.array([0.0, 1.0, 0.0]) * np.sin(2 * np.pi * points[:, :1])
        data = {"density": [np.full(4, DENSITY)], "stress": [np.repeat([[0.0], [0.0], [0.0], [3.0]], 6, axis=1)]}
        mesh = meshio.Mesh(points, [("quad", cells)], point_data={"displacement": moved}, cell_data=data)
        mesh.write(tmp_path / "raw" / "a" / f"{frame}.vtu")
    bounds = [(0.0, 1.0), (-1.0, 1.0)]
    found = imported(tmp_path, frame_dt=DT, periodic=[True, False], bounds=bounds)
    np.testing.assert_allclose(found.mass, DENSITY * 0.1 * np.repeat([0.6, 0.4, 0.4, 0.6], 2) / 4, rtol=1e-5)
    assert found.stress is not None
    np.testing.assert_allclose(found.stress.node[:, :, 0], np.tile(np.repeat([2.0, 0.0, 0.0, 2.0], 2), (FRAMES, 1)), atol=1e-6)
    with pytest.raises(ImportFailure, match=r"bounds = .* has 3 axes, the data have 2"):
        import_dataset(
            tmp_path / "data",
            ImportSettings("meshio", str(tmp_path / "raw"), "b", frame_dt=DT, bounds=[*bounds, (0.0, 1.0)], periodic=[True] * 3),
        )


def test_wedges_over_the_seam_keep_their_orientation(tmp_path: Path) -> None:
    points = np.array([[x, y, z] for x in (0.0, 0.25, 0.5, 0.75) for y, z in ((0.0, 0.0), (0.0, 0.1), (0.1, 0.0))])
    cells = (np.arange(6) + 3 * np.arange(4)[:, None]) % 12
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(FRAMES):
        moved = 0.01 * np.sin(40 * DT * frame) * np.array([0.0, 1.0, 0.0]) * np.sin(2 * np.pi * points[:, :1])
        meshio.Mesh(points, [("wedge", cells)], point_data={"displacement": moved}).write(tmp_path / "raw" / "a" / f"{frame}.vtu")
    found = imported(tmp_path, frame_dt=DT, periodic=[True, False, False], bounds=[(0.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)])
    assert found.cells is not None
    turned = [(row - row[0]) % 12 for row in found.cells]
    np.testing.assert_array_equal(turned, np.repeat(turned[:1], 4, axis=0))


def test_masses_jump_where_the_density_of_cells_does(tmp_path: Path) -> None:
    def edit(mesh: Any, frame: int) -> Any:
        mesh.cell_data["density"] = [np.array([DENSITY, 5 * DENSITY])]
        return mesh

    write_folder(tmp_path / "raw", edit)
    found = imported(tmp_path, frame_dt=DT)
    np.testing.assert_allclose(found.mass, DENSITY * SIZE**3 / 8 * np.repeat([1, 6, 5], 4), rtol=1e-5)


def test_a_value_that_some_cells_lack_is_told(tmp_path: Path) -> None:
    def edit(mesh: Any, frame: int) -> Any:
        mesh.cell_data["S"][0][1] = np.nan
        return mesh

    write_folder(tmp_path / "raw", edit)
    with pytest.raises(ImportFailure, match=r"step_0.vtu has no 'S' in some of its cells; write it in all blocks of cells"):
        imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)


def test_surfaces_in_space_have_no_mass_by_density(tmp_path: Path) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    bent = FLAT + np.array([0.0, 0.0, 1.0]) * FLAT[:, :1]
    for frame in range(FRAMES):
        mesh = meshio.Mesh(bent + displacement(bent)[frame], [("triangle", TRIANGLES)], point_data={"density": np.full(len(FLAT), DENSITY)})
        mesh.write(tmp_path / "raw" / "a" / f"{frame}.vtu")
    with pytest.raises(
        ImportFailure,
        match="cells of kind triangle have 2 dimensions in 3D, so their thickness is not known; give masses of points as 'mass'",
    ):
        imported(tmp_path, frame_dt=DT)


@pytest.mark.parametrize("refers", [False, True])
def test_grids_of_xdmf_have_their_own_points(tmp_path: Path, refers: bool) -> None:
    """Or refer to those of the first grid."""
    moved = FLAT + displacement(FLAT)
    topology = f'<Topology TopologyType="Triangle" NumberOfElements="{len(TRIANGLES)}">{item(TRIANGLES)}</Topology>'
    grids = ""
    for frame in range(FRAMES):
        mesh = f'{topology}<Geometry GeometryType="XYZ">{item(FLAT if refers else moved[frame])}</Geometry>'
        if frame and refers:
            mesh = '<Geometry Reference="XML">/Xdmf/Domain/Grid/Grid[1]/Geometry</Geometry>'
        data = f'<Attribute Name="displacement" AttributeType="Vector" Center="Node">{item(moved[frame] - FLAT)}</Attribute>'
        grids += f'<Grid Name="{frame}" GridType="Uniform">{mesh}<Time Value="{DT * frame}"/>{data}</Grid>'
    (tmp_path / "raw").mkdir()
    series = f'<Xdmf Version="3.0"><Domain><Grid GridType="Collection" CollectionType="Temporal">{grids}</Grid></Domain></Xdmf>'
    (tmp_path / "raw" / "a.xdmf").write_text(series)
    found = imported(tmp_path)
    np.testing.assert_allclose(found.pos - found.pos[0], (moved - moved[0])[..., :2], atol=1e-6)
    assert found.rest_pos is not None
    np.testing.assert_allclose(found.rest_pos - found.rest_pos[0], (FLAT - FLAT[0])[:, :2], atol=1e-6)


def item(values: np.ndarray) -> str:
    kind = "Float" if values.dtype.kind == "f" else "Int"
    text = "\n".join(" ".join(map(str, row)) for row in values.tolist())
    return f'<DataItem DataType="{kind}" Dimensions="{values.shape[0]} {values.shape[1]}" Format="XML" Precision="8">{text}</DataItem>'


def without(name: str, at: int = 0, until: int = FRAMES) -> Callable[[Any, int], Any]:
    def edit(mesh: Any, frame: int) -> Any:
        if at <= frame < until:
            mesh.point_data.pop(name, None)
            mesh.cell_data.pop(name, None)
        return mesh

    return edit


def in_cells(name: str) -> Callable[[Any, int], Any]:
    """Return an edit that adds an array of ones to the cells."""

    def edit(mesh: Any, frame: int) -> Any:
        mesh.cell_data[name] = [np.ones(len(block.data)) for block in mesh.cells]
        return mesh

    return edit


def quadratic(mesh: Any, frame: int) -> Any:
    return meshio.Mesh(POINTS, [("line3", np.array([[0, 1, 2]]))], point_data=mesh.point_data)


def beyond(mesh: Any, frame: int) -> Any:
    cells = CELLS.copy()
    cells[1, 7] = len(POINTS)
    return meshio.Mesh(POINTS, [("hexahedron", cells)], point_data=mesh.point_data, cell_data=mesh.cell_data)


def flat_stress(mesh: Any, frame: int) -> Any:
    mesh.cell_data["S"] = [np.ones((2, 3))]
    return mesh


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (without("displacement"), r"step_0.vtu: points do not move, and there are no displacements; name them with arrays={displacement: .*'velocity'"),
        (without("S"), r"step_0.vtu has no array 'S' \(arrays={stress: S}\); point data: 'displacement'.*cell data: 'density'"),
        (without("velocity", 0, 1), r"step_0.vtu has no array 'velocity', and step_1.vtu has one; write it in all frames"),
        (without("S", 0, 1), r"step_0.vtu has no array 'S', and step_1.vtu has one; write it in all frames"),
        (without("prescribed", 0, 2), r"step_0.vtu has no array 'prescribed', and step_2.vtu has one; write it in all frames"),
        (without("velocity", 4), r"step_4.vtu has no array 'velocity', step_0.vtu has one of shape \[12, 3\]"),
        (in_cells("material"), r"step_0.vtu has 'material' in cells, and values of points are needed; write it as point data"),
        (without("density"), r"has forces but no masses, and a model reads f/m; name them with arrays={mass: …} or arrays={density: …}"),
        (quadratic, r"step_0.vtu has cells of kind line3; cells must be linear: line, triangle"),
        (beyond, r"step_0.vtu has cells of kind hexahedron with points 0 to 12; there are 12 points"),
        (flat_stress, r"'S' has 3 components, expected 6 \(XX, YY, ZZ, XY, YZ, XZ\) or 9"),
        (lambda mesh, frame: meshio.Mesh(POINTS[:8], [("hexahedron", CELLS[:1])]) if frame == 2 else mesh, r"step_2.vtu has 8 points, step_0.vtu has 12"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_file_and_array(tmp_path: Path, edit: Callable[[Any, int], Any], message: str) -> None:
    write_folder(tmp_path / "raw", edit)
    with pytest.raises(ImportFailure, match=message):
        imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)


def test_the_interval_is_the_mean_of_rounded_times(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    with meshio.xdmf.TimeSeriesWriter(tmp_path / "raw" / "a.xdmf", data_format="XML") as writer:
        writer.write_points_cells(FLAT, [("triangle", TRIANGLES)])
        for frame in range(FRAMES):
            writer.write_data(round(frame / 30, 5), point_data={"displacement": displacement(FLAT)[frame]})
    assert imported(tmp_path).metadata.frame_dt == pytest.approx(1 / 30, rel=1e-6)


def test_a_damaged_file_uneven_times_and_wrong_settings_are_named(tmp_path: Path) -> None:
    write_folder(tmp_path / "raw")
    (tmp_path / "raw" / "beam" / "step_3.vtu").write_text("<VTKFile")
    with pytest.raises(ImportFailure, match=r"beam: step_3.vtu cannot be read by meshio \(it is damaged or of another format\)"):
        imported(tmp_path, frame_dt=DT)
    with pytest.raises(ImportFailure, match=r"frame_dt: beam has no times; pass frame_dt=… \[s\]"):
        imported(tmp_path)
    with pytest.raises(ImportFailure, match=r"arrays.displacemnt: unknown; did you mean 'displacement'\?"):
        imported(tmp_path, arrays={"displacemnt": "U"})
    write_xdmf(tmp_path / "raw" / "train", 1.1)
    with pytest.raises(ImportFailure, match="intervals between results are .* write results at even intervals"):
        imported(tmp_path)
    write_xdmf(tmp_path / "raw" / "train", 1.0)
    with pytest.raises(ImportFailure, match=r"results are \S+ s apart, and frame_dt is \S+ s \(of the command, or of other trajectories\)"):
        imported(tmp_path, frame_dt=2 * DT)


def test_several_parts_of_a_time_are_told(tmp_path: Path) -> None:
    write_folder(tmp_path / "raw")
    entries = "".join(
        f'<DataSet timestep="{DT * frame}" part="{part}" file="beam/step_{frame}.vtu"/>' for frame in range(3) for part in range(2)
    )
    (tmp_path / "raw" / "beam.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    with pytest.raises(ImportFailure, match=r"beam.pvd lists 2 files for the time 0; join the parts of each time into one file"):
        imported(tmp_path)


def test_a_collection_must_not_leave_its_folder(tmp_path: Path) -> None:
    write_folder(tmp_path / "elsewhere")
    (tmp_path / "raw").mkdir()
    entries = "".join(f'<DataSet timestep="{frame}" file="../elsewhere/beam/step_{frame}.vtu"/>' for frame in range(FRAMES))
    (tmp_path / "raw" / "a.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    with pytest.raises(ImportFailure, match=r"a.pvd lists ../elsewhere/beam/step_0.vtu, which is not in its folder"):
        imported(tmp_path, frame_dt=DT)


def changing(name: str, values: Callable[[int], np.ndarray], places: str = "points") -> Callable[[Any, int], Any]:
    """Return an edit that gives points or cells other values in each frame."""

    def edit(mesh: Any, frame: int) -> Any:
        if places == "points":
            mesh.cell_data.pop(name, None)
            mesh.point_data[name] = values(frame)
        else:
            mesh.cell_data[name] = [values(frame)]
        return mesh

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (changing("prescribed", lambda k: (POINTS[:, 0] == 0) * float(k > 2)), "step_3.vtu: array 'prescribed' differs from step_0.vtu; it changes with time"),
        (changing("prescribed", lambda k: (POINTS[:, 0] == 0) * float(k < 2)), "step_2.vtu: array 'prescribed' differs from step_0.vtu"),
        (changing("mass", lambda k: np.full(12, 1.0 / (1 + k))), "step_1.vtu: array 'mass' differs from step_0.vtu.* a trajectory has one value of it"),
        (changing("material", lambda k: np.full(12, k // 4)), "step_4.vtu: array 'material' differs from step_0.vtu"),
        (changing("youngs_modulus", lambda k: np.full(12, 1e5 + k)), "step_2.vtu: array 'youngs_modulus' differs from step_0.vtu"),
        (changing("youngs_modulus", lambda k: np.array([1e5, 1e5 + 9 * k]), "cells"), "step_1.vtu: array 'youngs_modulus' differs from step_0.vtu"),
    ],
)  # fmt: skip
def test_what_changes_with_time_but_is_stored_once_is_refused(tmp_path: Path, edit: Callable[[Any, int], Any], message: str) -> None:
    write_folder(tmp_path / "raw", edit)
    with pytest.raises(ImportFailure, match=message):
        imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)


def test_a_mark_without_a_value_is_refused(tmp_path: Path) -> None:
    """Not taken for a clamp."""
    marks = np.where(POINTS[:, 0] > 0, np.nan, 1.0)
    write_folder(tmp_path / "raw", changing("prescribed", lambda k: marks))
    with pytest.raises(ImportFailure, match="step_0.vtu: array 'prescribed' is NaN at node 4; write 0 where the motion is free"):
        imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)


@pytest.mark.parametrize("value", [1.5, 1.01, np.nan])
def test_numbers_of_materials_are_whole(tmp_path: Path, value: float) -> None:
    numbers = np.where(POINTS[:, 0] > 0, 1.0, 2.0)
    numbers[5] = value
    write_folder(tmp_path / "raw", changing("M", lambda k: numbers))
    with pytest.raises(ImportFailure, match=f"step_0.vtu: array 'M' is {value:g} at node 5; numbers of materials are whole"):
        imported(tmp_path, arrays={"stress": "S", "material": "M"}, frame_dt=DT, materials={1: "solid", 2: "elastomer"})


def test_numbers_of_materials_may_be_rounded(tmp_path: Path) -> None:
    write_folder(tmp_path / "raw", changing("material", lambda k: np.full(12, 0.9999)))
    assert imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT, materials={1: "elastomer"}).metadata.materials == ("elastomer",)


def test_rounding_and_the_size_of_marks_are_no_change(tmp_path: Path) -> None:
    def edit(mesh: Any, frame: int) -> Any:
        mesh.point_data["prescribed"] = (POINTS[:, 0] == 0) * (1.0 + frame)
        mesh.point_data["mass"] = np.full(12, 2.0 + 1e-6 * frame)
        return mesh

    write_folder(tmp_path / "raw", edit)
    found = imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)
    assert found.prescribed is not None and found.prescribed.any(axis=1).sum() == 4
    np.testing.assert_allclose(found.mass, 2.0)


def test_names_of_arrays_belong_to_this_format(tmp_path: Path) -> None:
    with pytest.raises(ImportFailure, match="only format=meshio finds arrays by their names"):
        import_dataset(tmp_path, ImportSettings("gns", str(tmp_path), "set", arrays={"stress": "S"}))
