"""Reading of surfaces from files: triangle meshes, point clouds and height maps.

Nothing in a file is executed, and no other file is opened.
"""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.files.zip_members import num_members

MESHES = (".obj", ".stl", ".ply")
POINT_CLOUDS = (".ply", ".xyz", ".npy", ".npz")
HEIGHT_MAPS = (".npy", ".npz", ".png", ".csv")

MAX_FILE_BYTES = 2**30
MAX_TRIANGLES = 2_000_000
MAX_POINTS = 5_000_000
MAX_HEIGHTS = 2**25
MAX_MEMBERS = MAX_PARTS = 1000
MAX_TEXT_TRIANGLES, MAX_TEXT_VERTICES, MAX_TEXT_VALUES = 1_000_000, 2_000_000, 10_000_000
MAX_ASCII_TRIANGLES, MAX_ASCII_ELEMENTS, MAX_ASCII_BYTES = 300_000, 1_000_000, 2**24
"""Limits for text files, which are read in some seconds."""
BINARY = {
    ".obj": "write it as a binary .stl or .ply",
    ".stl": "write it as a binary .stl",
    ".ply": "write it as a binary .ply",
    ".xyz": "write it as .npy",
    ".csv": "write it as .npy",
}
FEWEST_POINTS = 100
"""An array in an NPY file with 3 columns and fewer rows may be a height map as well as a point cloud, and is refused."""
OFF_UNIT = 0.01
"""Largest deviation from 1 of the lengths of unit normals, which may be rounded in text."""
HEADER_BYTES = 2**16
"""Number of bytes at the start of a PLY file that are searched for the numbers of elements."""


class TerrainError(GpeError, ValueError):
    """Raised when a terrain file cannot be used; the message names the file and what to do."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: positions [vertex, 3].
        faces: vertex indices [triangle, 3].
        watertight: whether the triangles enclose a volume.
    """

    vertices: np.ndarray
    faces: np.ndarray
    watertight: bool

    def why_not_closed(self) -> str:
        """Return why the triangles enclose no volume, with a point of an edge in the file's coordinates."""
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, count = np.unique(edges, axis=0, return_counts=True)
        for is_bad, what in ((count == 1, "one triangle only, so the surface has holes"), (count > 2, "more than two triangles")):
            if is_bad.any():
                x, y, z = self.vertices[edges[is_bad][0]].mean(axis=0)
                return f"{int(is_bad.sum())} of its edges, such as that at ({x:.3g}, {y:.3g}, {z:.3g}), belong to {what}"
        return "its triangles look inwards and outwards"


@dataclass(frozen=True)
class Cloud:
    """A point cloud of a surface.

    Attributes:
        points: positions [point, 3].
        normals: unit normals into free space [point, 3], or None.
    """

    points: np.ndarray
    normals: np.ndarray | None


@dataclass(frozen=True)
class Heights:
    """A height map on a square lattice, in the unit of the file.

    Attributes:
        values: heights [along x, along y].
    """

    values: np.ndarray


def read_surface(path: Path) -> Mesh | Cloud | Heights:
    """Read the surface in a file. The extension determines the format.

    Raises:
        TerrainError: the file cannot be read, contains nothing usable, or is too large; or a package that its format needs is not installed.
    """
    extension = path.suffix.lower()
    if extension not in (*MESHES, *POINT_CLOUDS, *HEIGHT_MAPS):
        raise TerrainError(
            f"{path}: unknown extension {extension!r}; meshes are {', '.join(MESHES)}, point clouds {', '.join(POINT_CLOUDS)}, "
            f"height maps {', '.join(HEIGHT_MAPS)}"
        )
    if not path.is_file():
        raise TerrainError(f"{path}: no such file (searched from {Path.cwd()})")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise TerrainError(f"{path}: {path.stat().st_size} bytes are too many, at most {MAX_FILE_BYTES}; simplify it first")
    if extension in COUNTED:
        _require_countable(path, extension)
    try:
        source = READERS[extension](path)
    except TerrainError:
        raise
    except ModuleNotFoundError as error:
        raise TerrainError(f"{path}: needs the package {error.name}; install it with `pip install 'gpe_pl[terrain]'`") from None
    except Exception as error:  # readers raise errors of any type on damaged files
        raise TerrainError(f"{path}: cannot be read as {extension[1:].upper()}: {type(error).__name__}: {error}") from error
    return source


COUNTED: dict[str, tuple[tuple[tuple[bytes, ...], int, str], ...]] = {
    ".obj": (
        ((b"\nf", b"\rf"), MAX_TEXT_TRIANGLES, "triangles"),
        ((b"\nv", b"\rv"), MAX_TEXT_VERTICES, "vertices"),
        ((b"usemtl", b"\no", b"\ng", b"\ro", b"\rg"), MAX_PARTS, "parts"),
        ((b"\n", b"\r", b" ", b"\t"), 2 * MAX_TEXT_VALUES, "values"),
    ),
    ".stl": (((b"endfacet",), MAX_ASCII_TRIANGLES, "triangles"),),
    ".xyz": (((b"\n", b"\r", b" ", b"\t"), MAX_TEXT_VALUES, "values"),),
    ".ply": (),
    ".csv": (((b"\n", b"\r", b","), MAX_TEXT_VALUES, "heights"),),
}
"""Byte strings to count in text files, by extension: marks that begin or separate parts, the limit, and the name of the parts. Counting is far faster than
reading."""


def _require_countable(path: Path, extension: str) -> None:
    """Refuse files that would take minutes to read before their size is known."""
    content = path.read_bytes()
    if extension == ".stl" and not content[:512].lstrip().lower().startswith(b"solid"):
        return  # a binary file: the reader compares the number in its header with the size
    for marks, most, what in COUNTED[extension]:
        if (count := sum(map(content.count, marks))) > most:
            raise TerrainError(
                f"{path}: about {count} {what} are too many for text, at most {most}; simplify it first, or {BINARY[extension]}"
            )
    if extension == ".ply":
        _require_countable_elements(path, content)


def _require_countable_elements(path: Path, content: bytes) -> None:
    head = content[:HEADER_BYTES].partition(b"end_header")[0]
    counts = [(kind, int(count)) for kind, count in re.findall(rb"element\s+(\S{1,100})\s+(\d{1,20})", head)]
    for kind, count in counts:
        if (MAX_TRIANGLES if kind == b"face" else MAX_POINTS) < count <= len(content):  # the reader reports a damaged header
            raise TerrainError(f"{path}: {count} elements of kind {kind.decode(errors='replace')} are too many; simplify it first")
    is_text = re.search(rb"format\s+ascii", head) is not None
    if is_text and (len(content) > MAX_ASCII_BYTES or MAX_ASCII_ELEMENTS < sum(count for _, count in counts) <= len(content)):
        raise TerrainError(
            f"{path}: too large for text, at most {MAX_ASCII_BYTES} bytes and {MAX_ASCII_ELEMENTS} elements are read; {BINARY['.ply']}"
        )


def _read_mesh(path: Path) -> Mesh | Cloud:
    import trimesh

    # The file is read from memory, so that the reader cannot follow references to materials and textures.
    scene = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type=path.suffix[1:].lower(), skip_materials=True, process=False)
    meshes = [g for g in scene.geometry.values() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not meshes:
        clouds = [g for g in scene.geometry.values() if isinstance(g, trimesh.PointCloud) and len(g.vertices)]
        if not clouds or path.suffix.lower() != ".ply":
            raise TerrainError(f"{path}: holds no triangles; export the surface as a triangle mesh")
        return _cloud(path, clouds[0].vertices, _ply_normals(clouds[0]))
    mesh: Any = trimesh.util.concatenate(meshes)
    if len(mesh.faces) > MAX_TRIANGLES:
        raise TerrainError(f"{path}: {len(mesh.faces)} triangles are too many, at most {MAX_TRIANGLES}; decimate the mesh first")
    _require_finite(path, mesh.vertices)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # texture seams are not holes
    corners = np.asarray(mesh.triangles, np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    faces = np.asarray(mesh.faces, np.int64)[area > 1e-14 * np.max(np.ptp(corners.reshape(-1, 3), axis=0)) ** 2]
    if len(faces) == 0:
        raise TerrainError(f"{path}: all {len(area)} triangles are without area; export the surface again")
    return Mesh(np.asarray(mesh.vertices, np.float64), faces, bool(mesh.is_watertight))


def _ply_normals(cloud: Any) -> np.ndarray | None:
    columns = cloud.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else columns
    return np.stack([np.ravel(columns[k]) for k in ("nx", "ny", "nz")], -1) if all(k in names for k in ("nx", "ny", "nz")) else None


def _cloud(path: Path, points: np.ndarray, normals: np.ndarray | None) -> Cloud:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3:
        raise TerrainError(f"{path}: a point cloud needs at least 3 points of 3 coordinates, got an array {list(points.shape)}")
    if len(points) > MAX_POINTS:
        raise TerrainError(f"{path}: {len(points)} points are too many, at most {MAX_POINTS}; thin them out first")
    _require_finite(path, points)
    if normals is not None:
        normals = np.asarray(normals, np.float64)
        _require_finite(path, normals)
        if normals.shape != points.shape:
            raise TerrainError(f"{path}: normals {list(normals.shape)} do not fit points {list(points.shape)}")
        length = np.linalg.norm(normals, axis=-1)
        if np.any(length < 1e-6):
            raise TerrainError(f"{path}: normal {int(np.argmin(length))} has no length")
        normals = normals / length[:, None]
    return Cloud(points, normals)


def _read_xyz(path: Path) -> Cloud:
    values = np.loadtxt(path, ndmin=2)
    if values.ndim != 2 or values.shape[1] not in (3, 6):
        raise TerrainError(f"{path}: a point cloud has 3 columns, or 6 with normals, got an array {list(values.shape)}")
    if (
        values.shape[1] == 6 and (values[:, 3:] >= 0).all() and (row := _not_unit(values[:, 3:])) is not None
    ):  # normals of other lengths have signs
        raise TerrainError(
            f"{path}: columns 4 to 6 are no unit normals, point {row} has {values[row, 3:].tolist()}; are they colours? Write 3 columns only"
        )
    return _columns(path, values)


def _not_unit(normals: np.ndarray) -> int | None:
    """Return the first row of normals [point, 3] whose length is not 1; None if there is none."""
    is_unit = np.abs(np.linalg.norm(normals, axis=-1) - 1) <= OFF_UNIT
    return None if is_unit.all() else int(is_unit.argmin())


def _columns(path: Path, values: np.ndarray) -> Cloud:
    return _cloud(path, values[:, :3], values[:, 3:] if values.shape[1] == 6 else None)


def _height_map(path: Path, rows: np.ndarray) -> Heights:
    """Create a height map from the rows of an image, which run from north to south."""
    if rows.ndim != 2 or min(rows.shape) < 2:
        raise TerrainError(f"{path}: a height map has at least 2 rows and 2 columns, got an array {list(rows.shape)}")
    if rows.size > MAX_HEIGHTS:
        raise TerrainError(f"{path}: {rows.size} heights are too many, at most {MAX_HEIGHTS}; resample the map first")
    values = np.asarray(rows, np.float64)[::-1].T
    _require_finite(path, values)
    return Heights(values)


def _read_npy(path: Path) -> Cloud | Heights:
    values = np.load(path, mmap_mode="r", allow_pickle=False)  # raises if the header promises more than the file contains
    columns = values.shape[1] if values.ndim == 2 else 0
    if (columns == 3 and len(values) < FEWEST_POINTS) or (columns == 6 and _not_unit(values[:, 3:]) is not None):
        why = f"with fewer than {FEWEST_POINTS} rows" if columns == 3 else "without unit normals in columns 4 to 6"
        raise TerrainError(
            f"{path}: an array {list(values.shape)} {why} may be a height map or a point cloud; write an .npz file with 'heights', or with 'points' and "
            "possibly 'normals'"
        )
    return _columns(path, values) if columns in (3, 6) else _height_map(path, values)


def _read_npz(path: Path) -> Cloud | Heights:
    if (count := num_members(path)) > MAX_MEMBERS:
        raise TerrainError(f"{path}: holds {count} arrays, at most {MAX_MEMBERS} are read")
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > MAX_FILE_BYTES:
        raise TerrainError(f"{path}: unpacks to {unpacked} bytes, at most {MAX_FILE_BYTES}")
    with np.load(path, allow_pickle=False) as arrays:
        if "heights" in arrays:
            return _height_map(path, arrays["heights"])
        if "points" in arrays:
            return _cloud(path, arrays["points"], arrays.get("normals"))
        raise TerrainError(f"{path}: needs an array 'heights' or 'points', holds {', '.join(arrays.files) or 'none'}")


def _read_png(path: Path) -> Heights:
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as image:
        if image.width * image.height > MAX_HEIGHTS:
            raise TerrainError(
                f"{path}: {image.width} x {image.height} pixels are too many, at most {MAX_HEIGHTS}; resample the image first"
            )
        deep = image.mode.startswith("I")  # 16 bits
        return _height_map(path, np.asarray(image if deep else image.convert("L"), np.float64) / (65535 if deep else 255))


def _read_csv(path: Path) -> Heights:
    return _height_map(path, np.loadtxt(path, delimiter=",", ndmin=2))


READERS: dict[str, Any] = {
    ".obj": _read_mesh,
    ".stl": _read_mesh,
    ".ply": _read_mesh,
    ".xyz": _read_xyz,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".png": _read_png,
    ".csv": _read_csv,
}


def _require_finite(path: Path, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        row = np.argwhere(~np.isfinite(values))[0].tolist()
        raise TerrainError(f"{path}: the value at index {row} is not finite; remove or fill such values")
    if np.abs(values).max(initial=0) > 1e12:
        raise TerrainError(f"{path}: values up to {np.abs(values).max():.3g} are too large to be coordinates")
