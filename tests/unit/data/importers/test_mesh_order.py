"""Files and points of a series of meshes are joined in their order: one series per folder, files by their numbers, and points by theirs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from tests.unit.data.importers.test_meshio import (
    CELLS,
    DT,
    FLAT,
    FRAMES,
    POINTS,
    SIZE,
    TRIANGLES,
    displacement,
    imported,
    write_folder,
    write_xdmf,
)

meshio = pytest.importorskip("meshio", reason="meshio is not installed")


@pytest.mark.parametrize(("names", "is_clear"), [("0.05 0.10 0.15 0.20", True), ("0.05 0.1 0.15 0.2", False), ("1.8 1.9 1.10 1.11", False)])
def test_files_are_in_the_order_of_their_numbers(tmp_path: Path, names: str, is_clear: bool) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame, name in enumerate(names.split()):
        meshio.Mesh(FLAT + frame * SIZE, [("triangle", TRIANGLES)]).write(tmp_path / "raw" / "a" / f"out_{name}.vtu")
    if is_clear:
        found = imported(tmp_path, frame_dt=DT)
        np.testing.assert_allclose(found.pos[:, 0, 0] - found.pos[0, 0, 0], SIZE * np.arange(4), atol=1e-6)
    else:
        with pytest.raises(
            ImportFailure, match=r"the order of files is not clear, because their numbers have decimals; number them 0, 1, 2"
        ):
            imported(tmp_path, frame_dt=DT)


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ("0 1 2 3 5 6", ("out_3.vtu", "out_5.vtu", 1)),
        ("0 10 20 40 50", ("out_20.vtu", "out_40.vtu", 10)),
        ("0 10 20 30", None),
        ("0 103 205 311 402", None),  # iterations
    ],
)
def test_a_missing_number_is_told(tmp_path: Path, numbers: str, missing: tuple[str, str, int] | None) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame, number in enumerate(numbers.split()):
        meshio.Mesh(FLAT + frame * SIZE, [("triangle", TRIANGLES)]).write(tmp_path / "raw" / "a" / f"out_{number}.vtu")
    if missing is None:
        assert imported(tmp_path, frame_dt=DT).num_frames == len(numbers.split())
    else:
        before, after, usual = missing
        with pytest.raises(ImportFailure, match=f"between {before} and {after}, files are missing: other numbers rise by {usual}"):
            imported(tmp_path, frame_dt=DT)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("a_0.vtu a_1.vtu a_2.vtu b_0.vtu b_1.vtu b_2.vtu", "a_0.vtu and b_0.vtu: .* differ in numbers only, which rise together; give each"),
        ("run1_0.vtu run1_1.vtu run2_0.vtu run2_1.vtu", "run1_0.vtu and run2_0.vtu: names of the frames of a series differ in numbers only"),
        ("run1.000.vtu run1.001.vtu run1.002.vtu run2.000.vtu run2.001.vtu", "between run1.002.vtu and run2.000.vtu, files are missing"),
        ("0.vtk 0.vtu 1.vtk 1.vtu 2.vtk 2.vtu", "0.vtk and 0.vtu: names of the frames of a series differ in numbers only"),
        ("start.vtu a_0.vtu a_1.vtu", "a_0.vtu and start.vtu: names of the frames of a series differ in numbers only"),
        ("a_0.vtu a_1.vtu a_01.vtu a_2.vtu", "a_01.vtu and a_1.vtu have the same number; number the frames 0, 1, 2"),
        ("a_0001_0.vtu a_0002_0.vtu a_0003_0.vtu", ""),  # of part 0
        ("a_08_t0.8.vtu a_09_t0.9.vtu a_10_t1.0.vtu a_11_t1.1.vtu", ""),
        ("a_0.90.vtu a_0.95.vtu a_1.00.vtu a_1.05.vtu", ""),
    ],
)  # fmt: skip
def test_a_folder_has_the_files_of_one_series(tmp_path: Path, names: str, message: str) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame, name in enumerate(names.split()):
        meshio.Mesh(FLAT + frame * SIZE, [("triangle", TRIANGLES)]).write(tmp_path / "raw" / "a" / name)
    if message:
        with pytest.raises(ImportFailure, match=message):
            imported(tmp_path, frame_dt=DT)
    else:
        assert imported(tmp_path, frame_dt=DT).num_frames == len(names.split())


def write_collections(folder: Path, files: str) -> None:
    """Write two collections of seven frames; ``files`` is the place of a frame, with the name and the number of the frame."""
    for scale, name in ((1.0, "a"), (1.2, "b")):
        entries = ""
        for frame in range(FRAMES):
            file = files.format(name=name, frame=frame)
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            meshio.Mesh(FLAT + scale * displacement(FLAT)[frame], [("triangle", TRIANGLES)]).write(folder / file)
            entries += f'<DataSet timestep="{DT * frame}" file="{file}"/>'
        (folder / f"{name}.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')


@pytest.mark.parametrize("files", ["vtu/{name}_{frame}.vtu", "vtu/{name}/{frame}.vtu", "vtu/{frame}{name}.vtu"])
def test_a_folder_of_several_collections_is_no_trajectory(tmp_path: Path, files: str) -> None:
    write_collections(tmp_path / "raw", files)
    report = import_dataset(tmp_path / "data", ImportSettings("meshio", str(tmp_path / "raw"), "set", holdout=0.0))
    assert not report.refusals and report.splits["train"].trajectories == 2


def test_files_beside_the_folders_of_splits_are_named(tmp_path: Path) -> None:
    write_xdmf(tmp_path / "raw" / "train")
    write_xdmf(tmp_path / "raw")
    settings = ImportSettings("meshio", str(tmp_path / "raw"), "set", holdout=0.0, arrays={"stress": "S"})
    assert "1 files beside train/ were not read, the first is beam.xdmf" in " ".join(import_dataset(tmp_path / "data", settings).warnings)


def test_a_folder_with_the_values_of_an_xdmf_file_is_no_trajectory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "raw" / "values").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "raw" / "values")  # where meshio writes the values
    write_xdmf(tmp_path / "raw", data_format="HDF")
    text = (tmp_path / "raw" / "beam.xdmf").read_text()
    (tmp_path / "raw" / "beam.xdmf").write_text(text.replace("beam.h5:", "values/beam.h5:"))
    report = import_dataset(tmp_path / "data", ImportSettings("meshio", str(tmp_path / "raw"), "set", holdout=0.0, arrays={"stress": "S"}))
    assert not report.refusals and report.splits["train"].trajectories == 1


def test_rows_that_change_are_followed_by_their_numbers(tmp_path: Path) -> None:
    """Also the cells, and values of points."""

    def edit(mesh: Any, frame: int) -> Any:
        order = np.roll(np.arange(len(POINTS)), frame)
        data = {name: values[order] for name, values in mesh.point_data.items()} | {"GlobalNodeIds": 100 - order}
        return meshio.Mesh(POINTS[order], [("hexahedron", np.argsort(order)[CELLS])], point_data=data, cell_data=mesh.cell_data)

    write_folder(tmp_path / "raw", edit)
    found = imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)
    np.testing.assert_allclose(found.pos - found.pos[0], displacement(POINTS), atol=1e-6)
    np.testing.assert_allclose(found.vel, 3 * displacement(POINTS), atol=1e-6)
    assert found.cells is not None and found.cells.tolist() == CELLS.tolist()


def test_particles_whose_rows_change_are_followed(tmp_path: Path) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(FRAMES):
        order = np.random.default_rng(frame).permutation(len(FLAT))
        pos, numbers = (FLAT + displacement(FLAT)[frame])[order], order[:, None].astype(float)
        body = {"id": np.ones(len(FLAT), int), "Particle_ID": numbers}  # the first numbers no points
        meshio.Mesh(pos, [("vertex", np.arange(len(FLAT))[:, None])], point_data=body).write(tmp_path / "raw" / "a" / f"{frame}.vtu")
    found = imported(tmp_path, frame_dt=DT, materials={0: "sand"})
    order = np.random.default_rng(0).permutation(len(FLAT))
    np.testing.assert_allclose(found.pos - found.pos[0], displacement(FLAT)[:, order, :2], atol=1e-6)


def numbered(numbers: Callable[[int], np.ndarray | None]) -> Callable[[Any, int], Any]:
    """Return an edit that adds numbers of points, by frame."""

    def edit(mesh: Any, frame: int) -> Any:
        if (own := numbers(frame)) is not None:
            mesh.point_data["ids"] = own
        return mesh

    return edit


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (lambda k: np.arange(12) + (k > 3), "step_4.vtu: array 'ids' has other numbers of points than step_0.vtu, such as 0; write the same points"),
        (lambda k: np.roll(np.arange(12) // 2, k), "step_1.vtu: array 'ids' differs from step_0.vtu and has numbers twice"),
        (lambda k: np.arange(12) if k < 2 else np.arange(12) // 2, "step_2.vtu: array 'ids' has other numbers of points than step_0.vtu, such as 6"),
        (lambda k: np.arange(12) if k < 2 else None, "step_2.vtu has no array 'ids' of whole numbers, step_0.vtu has one; write it in all frames"),
    ],
)  # fmt: skip
def test_numbers_of_points_that_do_not_tell_which_is_which_are_refused(
    tmp_path: Path, numbers: Callable[[int], np.ndarray | None], message: str
) -> None:
    write_folder(tmp_path / "raw", numbered(numbers))
    with pytest.raises(ImportFailure, match=message):
        imported(tmp_path, arrays={"stress": "S"}, frame_dt=DT)


def test_particles_that_come_or_go_are_refused_as_such(tmp_path: Path) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(4):
        meshio.Mesh(FLAT[: len(FLAT) - frame // 2] + frame * SIZE, [("vertex", np.arange(len(FLAT) - frame // 2)[:, None])]).write(
            tmp_path / "raw" / "a" / f"out_{frame}.vtu"
        )
    with pytest.raises(ImportFailure, match="particles must be the same in all frames"):
        imported(tmp_path, frame_dt=DT, materials={0: "fluid"})


def test_files_that_meshio_does_not_know(tmp_path: Path) -> None:
    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(4):
        (tmp_path / "raw" / "a" / f"out_{frame}.vtp").write_text("<VTKFile/>")
    with pytest.raises(ImportFailure, match="save them as .vtu, or use format=arrays"):
        imported(tmp_path, frame_dt=DT)
