"""Reader of series of mesh files through meshio: PVD collections, XDMF series, Exodus files, and folders with a file per frame."""

from __future__ import annotations

import contextlib
import io
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gpe_pl.data.importers.source import Refusal, natural
from gpe_pl.schema import CELL_KINDS

XDMF, EXODUS = (".xdmf", ".xmf"), (".e", ".ex2", ".exo")
ENDINGS = (".pvd", *XDMF, *EXODUS)
"""Endings of files with all frames of a trajectory."""
KINDS = {
    "line": "line",
    "triangle": "triangle",
    "quad": "quadrilateral",
    "tetra": "tetrahedron",
    "wedge": "wedge",
    "hexahedron": "hexahedron",
}
"""Kinds of cells by their names in meshio."""
EXODUS_KINDS = {
    "TRI": "triangle",
    "QUA": "quad",
    "SHE": "quad",
    "TET": "tetra",
    "WED": "wedge",
    "HEX": "hexahedron",
    "BAR": "line",
    "BEA": "line",
}
"""Names in meshio of cells by the first three letters of their names in Exodus."""
DECIMAL = re.compile(r"([0-9]+(?:[.][0-9]+)?(?:e[-+][0-9]+)?)", re.IGNORECASE)
"""A number, which may have decimals and an exponent."""
WHOLE = 1e-6
"""Multiples of the usual step between numbers are whole within this margin."""
COMPONENTS = (("xx", "yy", "zz", "xy", "yz", "xz"), ("xx", "yy", "zz", "xy", "yz", "zx"), ("x", "y", "z"), ("x", "y"))
"""Endings of the names of the components of tensors, in VTK's order, and of vectors."""


@dataclass
class Frame:
    """A frame of a series.

    Attributes:
        file: name of the file, for messages.
        time: time [s]; None if the file has none.
        points: points [point, axis] in m.
        cells: nodes of the cells by kind of ``schema.CELL_KINDS`` [cell, corner].
        point_data: values of points by name [point, …].
        cell_data: values of cells by name and kind [cell, …].
    """

    file: str
    time: float | None
    points: np.ndarray
    cells: dict[str, np.ndarray]
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, dict[str, np.ndarray]]

    @classmethod
    def of(cls, file: str, time: float | None, mesh: Any) -> Frame:
        """Return the frame of a ``meshio.Mesh``.

        Points of their own are cells of kind ``vertex`` to meshio. Their values are values of the points if each point has one such cell.

        Raises:
            Refusal: a kind of cells is not known, or a cell names a point that the mesh lacks.
        """
        points = np.asarray(mesh.points, np.float64)
        point_data = _of_vertices(mesh, len(points)) | {name: np.asarray(values) for name, values in mesh.point_data.items()}
        cells: dict[str, list[np.ndarray]] = {}
        data: dict[str, dict[str, list[np.ndarray]]] = {name: {} for name in mesh.cell_data}
        for k, block in enumerate(mesh.cells):
            if block.type == "vertex":
                continue
            if block.type not in KINDS:
                raise Refusal(f"{file} has cells of kind {block.type}; cells must be linear: {', '.join(KINDS)}")
            kind = KINDS[block.type]
            cells.setdefault(kind, []).append(np.asarray(block.data, np.int64))
            for name, values in mesh.cell_data.items():
                data[name].setdefault(kind, []).append(np.asarray(values[k]))
        whole = {kind: np.concatenate(parts) for kind, parts in cells.items()}
        for kind, corners in whole.items():
            if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
                raise Refusal(
                    f"{file} has cells of kind {kind} with points {corners.min()} to {corners.max()}; there are {len(points)} points"
                )
        cell_data = {name: {kind: np.concatenate(parts) for kind, parts in own.items()} for name, own in data.items()}
        return cls(file, time, points, whole, point_data, cell_data)


def _of_vertices(mesh: Any, num_points: int) -> dict[str, np.ndarray]:
    blocks = [k for k, block in enumerate(mesh.cells) if block.type == "vertex"]
    points = np.concatenate([np.asarray(mesh.cells[k].data, np.int64).ravel() for k in blocks] or [np.zeros(0, np.int64)])
    order = np.argsort(points)
    if not num_points or not np.array_equal(points[order], np.arange(num_points)):
        return {}
    return {name: np.concatenate([np.asarray(values[k]) for k in blocks])[order] for name, values in mesh.cell_data.items()}


def read_series(path: Path) -> list[Frame]:
    """Read all frames of a trajectory.

    Raises:
        Refusal: a file is missing, damaged or of an unknown format, has cells that are not linear, or has only a part of a frame.
    """
    if path.is_dir():
        files = _in_order([file for file in path.iterdir() if file.is_file()])
        return [Frame.of(file.name, None, _mesh(file)) for file in files]
    if path.suffix.lower() == ".pvd":
        collection = _collection(path)
        repeated, count = max(Counter(time for time, _ in collection).items(), key=lambda item: item[1], default=(0.0, 0))
        if count > 1:
            raise Refusal(f"{path.name} lists {count} files for the time {repeated:g}; join the parts of each time into one file")
        return [Frame.of(file.name, time, _mesh(file)) for time, file in collection]
    reader: Callable[[Path], Iterator[tuple[float, Any]]] = _xdmf if path.suffix.lower() in XDMF else _exodus
    with _readable(path):
        return [Frame.of(path.name, time, mesh) for time, mesh in reader(path)]


def _in_order(files: list[Path]) -> list[Path]:
    """Return files in the order of the numbers in their names.

    Raises:
        Refusal: names differ elsewhere than in numbers that rise together, the order depends on whether ``0.1`` is a number with decimals or two numbers, or a
            number is missing or occurs twice.
    """
    ordered = sorted(files, key=lambda file: natural(file.name))
    if len(ordered) < 2:
        return ordered
    numbers = _numbers(ordered)
    by_value = [file for _, file in sorted(zip(numbers, ordered, strict=True), key=lambda pair: pair[0])]
    for whole, decimal in zip(ordered, by_value, strict=True):
        if whole != decimal:
            raise Refusal(
                f"{whole.name} and {decimal.name}: the order of files is not clear, because their numbers have decimals; number them 0, 1, 2, …, or list them "
                "with their times in a PVD file"
            )
    _require_all_numbers(ordered, numbers)
    return ordered


def _numbers(files: list[Path]) -> list[Decimal]:
    """Return the number in which the names of the files of one series differ; of several, such as step and time, the first that always rises.

    Raises:
        Refusal: names differ elsewhere, or a number falls, so the files may be of several series.
    """
    parts = [DECIMAL.split(file.name) for file in files]
    for file, own in zip(files, parts, strict=True):
        if own[::2] != parts[0][::2]:
            raise _several_series(files[0], file)
    columns = [[Decimal(number) for number in column] for column in list(zip(*parts, strict=True))[1::2]]
    varying = [column for column in columns if len({*column}) > 1] or [[Decimal(0)] * len(files)]
    for column in varying if len(varying) > 1 else ():
        if (fallen := next((k for k, (before, after) in enumerate(pairwise(column), 1) if after < before), None)) is not None:
            raise _several_series(files[0], files[fallen])
    return next((column for column in varying if all(before < after for before, after in pairwise(column))), varying[-1])


def _several_series(first: Path, other: Path) -> Refusal:
    return Refusal(
        f"{first.name} and {other.name}: names of the frames of a series differ in numbers only, which rise together; give each series a folder of its own, "
        "without other files"
    )


def _require_all_numbers(files: list[Path], numbers: list[Decimal]) -> None:
    """Raise a refusal for numbers such as 0, 1, 2, 4, 5, or 0, 1, 1, 2. Numbers without a common step, such as those of iterations, say nothing."""
    steps = np.array([float(after - before) for before, after in pairwise(numbers)])
    if steps.min() <= 0:
        twice = int(np.argmin(steps))
        raise Refusal(f"{files[twice].name} and {files[twice + 1].name} have the same number; number the frames 0, 1, 2, …")
    multiples, largest = steps / np.median(steps), int(np.argmax(steps))
    if (
        len(steps) >= 3
        and abs(multiples - np.rint(multiples)).max() < WHOLE
        and multiples.min() > 1 - WHOLE
        and multiples.max() > 1 + WHOLE
    ):
        raise Refusal(
            f"between {files[largest].name} and {files[largest + 1].name}, files are missing: other numbers rise by {np.median(steps):g}; give all files, or "
            "list them with their times in a PVD file"
        )


def times_of(path: Path) -> np.ndarray | None:
    """Return the times of the frames of a trajectory; None if there are none or they cannot be read."""
    if path.is_dir():
        return None
    try:
        if path.suffix.lower() == ".pvd":
            return np.array([time for time, _ in _collection(path)])
        with _readable(path):
            return np.array([time for time, _ in (_xdmf if path.suffix.lower() in XDMF else _exodus)(path)])
    except Refusal:
        return None


def files_of(path: Path) -> list[Path]:
    """Return the files that a PVD or XDMF file names; none if it cannot be read or is of another format."""
    try:
        if path.suffix.lower() == ".pvd":
            return [file.resolve() for _, file in _collection(path)]
        if path.suffix.lower() in XDMF:
            with _readable(path):
                items = [item for item in ElementTree.parse(path).iter("DataItem") if item.get("Format") in ("HDF", "Binary")]
                return [(path.parent / (item.text or "").split(":")[0].strip()).resolve() for item in items]
    except Refusal:
        pass
    return []


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn the various errors of readers, and their exits, into a refusal that names the file; what they print is dropped."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            yield
    except Refusal:
        raise
    except ModuleNotFoundError as error:
        raise Refusal(f"{path.name} needs the package {error.name}; install it with `pip install {error.name}`") from None
    except (Exception, SystemExit) as error:
        if "Could not deduce file format" in str(error):
            raise Refusal(
                f"has files {path.suffix} such as {path.name}, which meshio does not know; save them as .vtu, or use format=arrays"
            ) from None
        reason = " ".join(printed.getvalue().split()) if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        raise Refusal(f"{path.name} cannot be read by meshio ({reason or 'it is damaged or of another format'})") from None


def _mesh(path: Path) -> Any:
    import meshio

    with _readable(path):
        return meshio.read(path)


def _collection(path: Path) -> list[tuple[float, Path]]:
    """Return times and files of a PVD collection; files lie below its folder.

    Raises:
        Refusal: the file is damaged or lists a file elsewhere.
    """
    with _readable(path):
        entries = [(float(e.attrib["timestep"]), e.attrib["file"]) for e in ElementTree.parse(path).iter("DataSet")]
    folder = path.parent.resolve()
    for _, name in entries:
        if not (folder / name).resolve().is_relative_to(folder):
            raise Refusal(f"{path.name} lists {name}, which is not in its folder")
    return [(time, folder / name) for time, name in sorted(entries)]


def _xdmf(path: Path) -> Iterator[tuple[float, Any]]:
    import meshio

    with meshio.xdmf.TimeSeriesReader(path) as reader:
        points, cells = reader.read_points_cells()
        for k, grid in enumerate(reader.collection):
            if any(
                (own := _stored(grid, part)) is not None and own != _stored(reader.mesh_grid, part) for part in ("Geometry", "Topology")
            ):
                reader.mesh_grid = grid  # otherwise meshio takes one mesh for all times
                moved, others = reader.read_points_cells()
                points, cells = points if moved is None else moved, others or cells
                reader.cells = cells
            time, point_data, cell_data = reader.read_data(k)
            yield time, meshio.Mesh(points, cells, point_data=point_data, cell_data=cell_data)


def _stored(grid: ElementTree.Element, part: str) -> bytes | None:
    """Return a part of a grid as it is stored in an XDMF file; None if the grid has none, or refers to that of another grid."""
    element = grid.find(part)
    items = [] if element is None else [element, *element.iter("DataItem")]
    if element is None or len(items) < 2 or any("Reference" in item.attrib for item in items):
        return None
    return ElementTree.tostring(element).strip()


def _exodus(path: Path) -> Iterator[tuple[float, Any]]:
    """Yield times and meshes of an Exodus file [Schoof & Yarberry 1994]; meshio itself reads its first time only. Values that a block lacks are NaN."""
    import meshio
    import netCDF4

    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        values = file.variables
        axes = values["coord"][:] if "coord" in values else [values[f"coord{axis}"][:] for axis in "xyz" if f"coord{axis}" in values]
        points = np.stack(list(axes), axis=1)
        blocks = [k for k in range(1, len(values) + 1) if f"connect{k}" in values]
        cells = [_exodus_cells(str(values[f"connect{k}"].elem_type), values[f"connect{k}"][:] - 1) for k in blocks]
        of_points, of_cells = _names(values, "name_nod_var"), _names(values, "name_elem_var")
        for t, time in enumerate(values["time_whole"][:]):
            point_data = _grouped({name: values[f"vals_nod_var{k}"][t] for k, name in enumerate(of_points, start=1)})
            by_block = [
                _grouped({name: values[key][t] for k, name in enumerate(of_cells, start=1) if (key := f"vals_elem_var{k}eb{b}") in values})
                for b in blocks
            ]
            shapes = {name: own[name].shape[1:] for own in by_block for name in own}
            cell_data = {
                name: [own.get(name, np.full((len(rows), *shape), np.nan)) for own, (_, rows) in zip(by_block, cells, strict=True)]
                for name, shape in shapes.items()
            }
            yield float(time), meshio.Mesh(points, cells, point_data=point_data, cell_data=cell_data)


def _exodus_cells(kind: str, rows: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the name in meshio of a kind of cells in Exodus, or its own name if the cells are not linear, and the cells."""
    name = EXODUS_KINDS.get(kind[:3].upper(), kind)
    is_linear = name in KINDS and rows.shape[1] == CELL_KINDS[KINDS[name]][1]
    return name if is_linear else kind, rows


def _names(values: Any, key: str) -> list[str]:
    return [b"".join(row).split(b"\0")[0].decode().strip() for row in values[key][:]] if key in values else []


def _grouped(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return values by name, with vectors and tensors whose components are arrays of their own, such as ``disp_x`` and ``disp_y``, also as ``disp``."""
    found, by_name = dict(values), {name.lower(): own for name, own in values.items()}
    for endings in COMPONENTS:
        for name in values:
            stem = name[: -len(endings[0])]
            parts = [by_name.get(stem.lower() + ending) for ending in endings]
            if name.lower().endswith(endings[0]) and stem and all(part is not None for part in parts):
                found.setdefault(stem.rstrip("_"), np.stack([part for part in parts if part is not None], axis=-1))
    return found
