"""Terrain for scenes, as signed distances on a grid: read from a mesh, a point cloud or a height map, or a random canyon.

The last axis of a scene points up. Nothing that is read is executed, and no file but the named one is opened.
"""

from __future__ import annotations

import io
import logging
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, no_type_check

import numpy as np
from numba import njit

from gpe_pl.errors import GpeError
from gpe_pl.geometry import MAX_GRID_NODES, DistanceGrid
from gpe_pl.schema import STICKY

log = logging.getLogger(__name__)

Bounds = tuple[tuple[float, float], ...]
Fit = Literal["contain", "stretch", "none"]
Solid = Literal["auto", "inside", "outside", "below"]
Up = Literal["x", "y", "z"]

MESHES = (".obj", ".stl", ".ply")
POINT_CLOUDS = (".ply", ".xyz", ".npy", ".npz")
HEIGHT_MAPS = (".npy", ".npz", ".png", ".csv")

MAX_FILE_BYTES = 2**30
MAX_TRIANGLES = 2_000_000
MAX_POINTS = 5_000_000
MAX_HEIGHTS = 2**25

_BAND = 2
"""Cells around a triangle whose distances are exact by construction; farther ones inherit the nearest triangle of a neighbour."""

_TO_Z_UP = {"x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]], "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "z": np.eye(3)}


class TerrainError(GpeError, ValueError):
    """A terrain file cannot be used; the message names the file and what to do."""


@dataclass(frozen=True)
class _Mesh:
    vertices: np.ndarray  # [vertex, 3]
    faces: np.ndarray  # [triangle, 3]
    watertight: bool


@dataclass(frozen=True)
class _Cloud:
    points: np.ndarray  # [point, 3]
    normals: np.ndarray | None  # [point, 3] into free space


@dataclass(frozen=True)
class _Heights:
    values: np.ndarray  # [along x, along y]


def read_terrain(
    path: Path | str,
    bounds: Bounds,
    spacing: float,
    *,
    fit: Fit = "contain",
    up: Up = "z",
    solid: Solid = "auto",
    relief: float | None = None,
    friction: float = STICKY,
) -> DistanceGrid:
    """Signed distances of the terrain in a file, at grid nodes that cover the domain.

    * Triangle meshes: OBJ, STL, PLY.
    * Point clouds: PLY without faces; XYZ (text) and NPY with 3 columns, or 6 with normals into free space; NPZ with ``points`` and
      perhaps ``normals``. Without normals the ground is the height field through the points.
    * Height maps, seen from above with north up (columns along x, rows against y): NPY with another number of columns, NPZ with
      ``heights``, CSV, PNG (its largest grey value is 1).

    Args:
        path: the file; its extension tells the format.
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: of the grid [m].
        fit: ``contain`` scales by one factor until the terrain fits into the domain, ``stretch`` along each axis until it fills it; both put it
            in the middle of the floor. ``none`` takes coordinates as they are, in m (pixels of a height map are 1 m wide).
        up: axis of a mesh or point cloud that points up.
        solid: what is solid: the ``inside`` of a closed mesh (behind the normals of a point cloud), the ``outside`` (a container), or
            what is ``below`` an open surface, which continues beyond its rim at the height of the rim. ``auto``: ``inside`` for watertight meshes
            and clouds with normals, ``below`` for all others; the choice is logged.
        relief: height [m] between the lowest and the highest point; by default as it comes with ``fit``, and half the domain's height for a
            height map that is not taken as it is.
        friction: Coulomb coefficient of the surface.

    Raises:
        TerrainError: the file cannot be read, holds nothing usable, is too large, or does not fit the options; or it is an OBJ, STL or PLY and the package
            trimesh is not installed.
        ValueError: options or bounds that no file could fit.
    """
    path = Path(path)
    low, counts = _lattice(bounds, spacing)
    for name, value, known in (("fit", fit, get_args(Fit)), ("up", up, get_args(Up)), ("solid", solid, get_args(Solid))):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    if relief is not None and (fit == "none" or not 0 < relief < math.inf):
        raise ValueError(f"relief must be positive, and not given with fit='none', got {relief}")
    source = _read(path)
    if solid == "auto":
        closed = source.watertight if isinstance(source, _Mesh) else isinstance(source, _Cloud) and source.normals is not None
        solid = "inside" if closed else "below"
        log.info("%s: took what is %s the surface as solid; solid=inside|outside|below says otherwise", path, solid)
    if solid != "below" and (isinstance(source, _Heights) or (isinstance(source, _Cloud) and source.normals is None)):
        raise TerrainError(f"{path}: solid={solid!r} needs a mesh or normals; this file is a height field, use solid='below'")
    if isinstance(source, _Heights):
        heights = _resampled(path, source.values, bounds, spacing, fit, relief)
        values = _below_heights(heights, low, spacing, counts)
    elif isinstance(source, _Mesh):
        vertices, _ = _placed(path, source.vertices, None, bounds, fit, up, relief)
        values = _mesh_distances(path, vertices[source.faces], low, spacing, counts, solid)
    else:
        points, normals = _placed(path, source.points, source.normals, bounds, fit, up, relief)
        if solid == "below" or normals is None:
            values = _below_heights(_heights_of(path, points, low, spacing, counts), low, spacing, counts)
        else:
            values = _cloud_distances(points, normals if solid == "inside" else -normals, low, spacing, counts)
    if not (values.min() < 0 < values.max()):
        what = "no free space" if values.max() <= 0 else "nothing solid"
        raise TerrainError(f"{path}: there is {what} in the domain {bounds}; check fit={fit!r}, up={up!r} and solid={solid!r}")
    return DistanceGrid.from_values(low, spacing, values, friction)


def ground_of(points: np.ndarray, normals: np.ndarray, bounds: Bounds, spacing: float, friction: float = STICKY) -> DistanceGrid:
    """What is solid below an open surface given by points [point, 3] in m with unit normals into free space, at grid nodes that cover the domain.

    Near the surface the normals tell which side is free. Farther away, where the nearest normal may belong to the rim of a cliff, it is what lies above the
    height field through the points.

    Args:
        points, normals: of the surface.
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: of the grid [m].
        friction: Coulomb coefficient of the surface.

    Raises:
        TerrainError: seen from above all points lie on one line.
    """
    low, counts = _lattice(bounds, spacing)
    values = _cloud_distances(points, normals, low, spacing, counts)
    heights = _heights_of(Path("points"), points, low, spacing, counts)
    is_above = low[2] + spacing * np.arange(counts[2]) > heights[..., None]
    values = np.where(np.abs(values) > spacing, np.where(is_above, 1.0, -1.0) * np.abs(values), values)
    return DistanceGrid.from_values(low, spacing, values, friction)


def _lattice(bounds: Bounds, spacing: float) -> tuple[np.ndarray, tuple[int, ...]]:
    """First node and number of nodes of the grid that covers the domain."""
    if len(bounds) != 3 or any(not -math.inf < low < high < math.inf for low, high in bounds):
        raise ValueError(f"terrain needs bounds (low, high) with low < high along 3 axes, got {bounds}")
    if not 0 < spacing < math.inf:
        raise ValueError(f"spacing must be positive, got {spacing}")
    counts = tuple(max(1, math.ceil((high - low) / spacing - 1e-6)) + 1 for low, high in bounds)
    if math.prod(counts) > MAX_GRID_NODES:
        raise ValueError(f"a grid of {counts} nodes is too large, at most {MAX_GRID_NODES} together; use a wider spacing than {spacing} m")
    return np.array([low for low, _ in bounds], float), counts


# --- files --------------------------------------------------------------------------------------------------------------------------------


def _read(path: Path) -> _Mesh | _Cloud | _Heights:
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
    try:
        source = _READERS[extension](path)
    except TerrainError:
        raise
    except ModuleNotFoundError as error:
        raise TerrainError(f"{path}: needs the package {error.name}; install it with `pip install 'gpe_pl[terrain]'`") from None
    except Exception as error:  # the readers raise anything on damaged files
        raise TerrainError(f"{path}: cannot be read as {extension[1:].upper()}: {type(error).__name__}: {error}") from error
    return source


def _read_mesh(path: Path) -> _Mesh | _Cloud:
    import trimesh

    # from memory, so that the reader cannot follow references to materials and textures
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
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # texture seams are no holes
    corners = np.asarray(mesh.triangles, np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    faces = np.asarray(mesh.faces, np.int64)[area > 1e-14 * np.max(np.ptp(corners.reshape(-1, 3), axis=0)) ** 2]
    if len(faces) == 0:
        raise TerrainError(f"{path}: all {len(area)} triangles are without area")
    return _Mesh(np.asarray(mesh.vertices, np.float64), faces, bool(mesh.is_watertight))


def _ply_normals(cloud: Any) -> np.ndarray | None:
    columns = cloud.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else columns
    return np.stack([np.ravel(columns[k]) for k in ("nx", "ny", "nz")], -1) if all(k in names for k in ("nx", "ny", "nz")) else None


def _cloud(path: Path, points: np.ndarray, normals: np.ndarray | None) -> _Cloud:
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
    return _Cloud(points, normals)


def _read_xyz(path: Path) -> _Cloud:
    return _columns(path, np.loadtxt(path, ndmin=2))


def _columns(path: Path, values: np.ndarray) -> _Cloud:
    if values.ndim != 2 or values.shape[1] not in (3, 6):
        raise TerrainError(f"{path}: a point cloud has 3 columns, or 6 with normals, got an array {list(values.shape)}")
    return _cloud(path, values[:, :3], values[:, 3:] if values.shape[1] == 6 else None)


def _height_map(path: Path, rows: np.ndarray) -> _Heights:
    """Heights of an image, its rows from north to south."""
    if rows.ndim != 2 or min(rows.shape) < 2:
        raise TerrainError(f"{path}: a height map has at least 2 rows and 2 columns, got an array {list(rows.shape)}")
    if rows.size > MAX_HEIGHTS:
        raise TerrainError(f"{path}: {rows.size} heights are too many, at most {MAX_HEIGHTS}; resample the map first")
    values = np.asarray(rows, np.float64)[::-1].T
    _require_finite(path, values)
    return _Heights(values)


def _read_npy(path: Path) -> _Cloud | _Heights:
    values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header that promises more than the file holds is an error here
    return _columns(path, values) if values.ndim == 2 and values.shape[1] in (3, 6) else _height_map(path, values)


def _read_npz(path: Path) -> _Cloud | _Heights:
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


def _read_png(path: Path) -> _Heights:
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as image:
        if image.width * image.height > MAX_HEIGHTS:
            raise TerrainError(
                f"{path}: {image.width} x {image.height} pixels are too many, at most {MAX_HEIGHTS}; resample the image first"
            )
        deep = image.mode.startswith("I")  # 16 bits
        return _height_map(path, np.asarray(image if deep else image.convert("L"), np.float64) / (65535 if deep else 255))


def _read_csv(path: Path) -> _Heights:
    return _height_map(path, np.loadtxt(path, delimiter=",", ndmin=2))


_READERS: dict[str, Any] = {
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


# --- placing ------------------------------------------------------------------------------------------------------------------------------


def _placed(
    path: Path, points: np.ndarray, normals: np.ndarray | None, bounds: Bounds, fit: Fit, up: Up, relief: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and normals in the frame of the scene."""
    turn = np.asarray(_TO_Z_UP[up], float).T
    points, normals = points @ turn, None if normals is None else normals @ turn
    if fit == "none":
        return points, normals
    floor, room = np.array(bounds, float)[:, 0], np.ptp(np.array(bounds, float), axis=1)
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    if np.sum(extent > 0) < 2:
        raise TerrainError(f"{path}: all points lie on one line")
    share = np.divide(room, extent, out=np.full(3, np.inf), where=extent > 0)
    vertical = share[2] if relief is None or extent[2] == 0 else relief / extent[2]
    if fit == "contain":
        one = min(share) if relief is None else min(share[:2])
        scale = np.array([one, one, one if relief is None else vertical])
    else:
        scale = np.array([share[0], share[1], vertical])
    scale = np.where(np.isfinite(scale), scale, 1.0)
    start = floor + np.array([0.5, 0.5, 0.0]) * (room - scale * extent)
    if normals is not None:
        normals = normals / scale
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return start + (points - low) * scale, normals


def _columns_of(low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Positions of the grid's vertical lines [along x, along y, 2]."""
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(2)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _resampled(path: Path, values: np.ndarray, bounds: Bounds, spacing: float, fit: Fit, relief: float | None) -> np.ndarray:
    """A height map placed in the scene: height [m] of the ground at the grid's vertical lines."""
    from scipy.ndimage import map_coordinates

    low, counts = _lattice(bounds, spacing)
    room, extent, rise = np.ptp(np.array(bounds), axis=1), np.array(values.shape) - 1.0, float(np.ptp(values))
    place = _columns_of(low, spacing, counts)
    if fit == "none":
        index = place
    else:
        scale = room[:2] / extent
        scale = np.full(2, scale.min()) if fit == "contain" else scale
        index = (place - low[:2] - 0.5 * (room[:2] - scale * extent)) / scale
        values = low[2] + (values - values.min()) * ((relief or 0.5 * room[2]) / rise if rise > 0 else 0.0)
    return np.asarray(map_coordinates(values, np.moveaxis(index, -1, 0), order=1, mode="nearest"))


def _heights_of(path: Path, points: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Height [m] of a cloud's surface at the grid's vertical lines: linear between the points, that of the nearest point around them."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    place = _columns_of(low, spacing, counts)
    nearest = np.asarray(NearestNDInterpolator(points[:, :2], points[:, 2])(place))
    try:
        heights = np.asarray(LinearNDInterpolator(points[:, :2], points[:, 2])(place))
    except QhullError:
        raise TerrainError(f"{path}: seen from above all points lie on one line; check the option up") from None
    return np.where(np.isfinite(heights), heights, nearest)


# --- distances ----------------------------------------------------------------------------------------------------------------------------


def _below_heights(heights: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Signed distances to the ground under heights [m] at the grid's vertical lines."""
    corners = _ground(heights, low, spacing, np.ones((counts[0] - 1, counts[1] - 1), dtype=bool))
    z = low[2] + spacing * np.arange(counts[2])
    return np.where(z < heights[..., None], -1.0, 1.0) * _unsigned(corners, low, spacing, counts)


def _ground(heights: np.ndarray, low: np.ndarray, spacing: float, cells: np.ndarray) -> np.ndarray:
    """Corners [triangle, 3, 3] of two triangles in each of these cells between vertical lines."""
    place = np.concatenate([_columns_of(low, spacing, heights.shape), heights[..., None]], axis=-1)
    a, b, c, d = place[:-1, :-1][cells], place[1:, :-1][cells], place[1:, 1:][cells], place[:-1, 1:][cells]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _mesh_distances(path: Path, corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...], solid: Solid) -> np.ndarray:
    """Signed distances to triangles [triangle, 3, 3]."""
    from scipy.ndimage import distance_transform_edt

    if solid == "below":
        above, top = _crossings(corners, low, spacing, counts, 2)
        covered = np.isfinite(top)
        if not covered.any():
            raise TerrainError(f"{path}: the surface lies nowhere over the domain; check the options fit and up")
        rim = distance_transform_edt(~covered, return_distances=False, return_indices=True)
        top = top[tuple(rim)]
        z = low[2] + spacing * np.arange(counts[2])
        inside = np.where(covered[..., None], above % 2 == 1, z < top[..., None])
        full = covered[:-1, :-1] & covered[1:, :-1] & covered[1:, 1:] & covered[:-1, 1:]
        corners = np.concatenate([corners, _ground(top, low, spacing, ~full)])
    else:  # two of three rays decide, so a crack that one ray slips through does no harm
        votes = sum((_crossings(corners, low, spacing, counts, axis)[0] % 2).astype(int) for axis in range(3))
        inside = (np.asarray(votes) >= 2) == (solid == "inside")
    return np.where(inside, -1.0, 1.0) * _unsigned(corners, low, spacing, counts)


def _cloud_distances(points: np.ndarray, normals: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Signed distances to an oriented point cloud: weighted mean of the distances to the tangent planes of the nearest points.

    Far from the cloud, where planes mean little, it is the distance to the nearest point with the sign of that mean.
    """
    from scipy.spatial import cKDTree

    nodes = low + spacing * np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    number = min(8, len(points))
    tree = cKDTree(points)
    gap = np.median(tree.query(points[:: max(1, len(points) // 1000)], k=number)[0][:, -1])
    distance, near = tree.query(nodes, k=number)
    plane = np.sum((nodes[:, None] - points[near]) * normals[near], axis=-1)
    weight = np.exp(-((distance**2 - distance[:, :1] ** 2) / max(float(gap), 1e-9 * spacing) ** 2))
    mean = np.sum(weight * plane, axis=1) / np.sum(weight, axis=1)
    values = np.where(distance[:, 0] < 2 * max(float(gap), spacing), mean, np.where(mean < 0, -1.0, 1.0) * distance[:, 0])
    return values.reshape(counts)


def _unsigned(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Distances [m] of grid nodes to the nearest of these triangles [triangle, 3, 3]."""
    triangles = np.ascontiguousarray(corners, dtype=np.float64).reshape(-1, 9)
    distance = np.full(counts, np.inf)
    nearest = np.full(counts, -1, dtype=np.int64)
    origin = np.array(low, dtype=np.float64)
    _near(triangles, origin, float(spacing), _BAND, distance, nearest)
    _spread(triangles, origin, float(spacing), distance, nearest)
    return np.sqrt(distance)


def _crossings(corners: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...], axis: int) -> tuple[np.ndarray, np.ndarray]:
    """How many triangles lie beyond each grid node along an axis, and for each line of nodes the last crossing (-inf: none)."""
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]
    hits = np.zeros([counts[k] for k in order], dtype=np.int64)
    last = np.full(hits.shape[:2], -np.inf)
    _cast(
        np.ascontiguousarray(corners[:, :, order], dtype=np.float64).reshape(-1, 9),
        np.array(low[order], np.float64),
        float(spacing),
        hits,
        last,
    )
    beyond = np.cumsum(hits[..., ::-1], axis=-1)[..., ::-1]
    return np.transpose(beyond, np.argsort(order)), last


@njit(cache=True, error_model="numpy")
@no_type_check
def _to_edge(px, py, pz, ax, ay, az, bx, by, bz):
    """Squared distance of p to the segment from a to b."""
    ex, ey, ez, wx, wy, wz = bx - ax, by - ay, bz - az, px - ax, py - ay, pz - az
    length = ex * ex + ey * ey + ez * ez
    t = (ex * wx + ey * wy + ez * wz) / length if length > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return (wx - t * ex) ** 2 + (wy - t * ey) ** 2 + (wz - t * ez) ** 2


@njit(cache=True, error_model="numpy")
@no_type_check
def _to_triangle(px, py, pz, t):
    """Squared distance of p to a triangle: to its plane above the inside, else to the nearest edge."""
    ux, uy, uz, vx, vy, vz = t[3] - t[0], t[4] - t[1], t[5] - t[2], t[6] - t[0], t[7] - t[1], t[8] - t[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    wx, wy, wz = px - t[0], py - t[1], pz - t[2]
    area = nx * nx + ny * ny + nz * nz
    # barycentric coordinates of the foot point, times area
    b = nx * (wy * vz - wz * vy) + ny * (wz * vx - wx * vz) + nz * (wx * vy - wy * vx)
    c = nx * (uy * wz - uz * wy) + ny * (uz * wx - ux * wz) + nz * (ux * wy - uy * wx)
    if area > 0.0 and b >= 0.0 and c >= 0.0 and b + c <= area:
        return (nx * wx + ny * wy + nz * wz) ** 2 / area
    first = _to_edge(px, py, pz, t[0], t[1], t[2], t[3], t[4], t[5])
    second = _to_edge(px, py, pz, t[3], t[4], t[5], t[6], t[7], t[8])
    third = _to_edge(px, py, pz, t[6], t[7], t[8], t[0], t[1], t[2])
    return min(first, second, third)


@njit(cache=True, error_model="numpy")
@no_type_check
def _node(x, count):
    """A place along an axis as the index of a node that exists; also where it lies far outside of the grid."""
    return int(min(max(x, 0.0), count - 1.0))


@njit(cache=True, error_model="numpy")
@no_type_check
def _near(triangles, origin, spacing, band, distance, nearest):
    """Squared distances of the nodes within ``band`` cells of a triangle; one outside of the grid counts for the nodes at the rim."""
    nx, ny, nz = distance.shape
    for f in range(len(triangles)):
        t = triangles[f]
        x0, x1 = (min(t[0], t[3], t[6]) - origin[0]) / spacing - band, (max(t[0], t[3], t[6]) - origin[0]) / spacing + band
        y0, y1 = (min(t[1], t[4], t[7]) - origin[1]) / spacing - band, (max(t[1], t[4], t[7]) - origin[1]) / spacing + band
        z0, z1 = (min(t[2], t[5], t[8]) - origin[2]) / spacing - band, (max(t[2], t[5], t[8]) - origin[2]) / spacing + band
        for i in range(_node(x0, nx), _node(x1, nx) + 1):
            for j in range(_node(y0, ny), _node(y1, ny) + 1):
                for k in range(_node(z0, nz), _node(z1, nz) + 1):
                    d = _to_triangle(origin[0] + i * spacing, origin[1] + j * spacing, origin[2] + k * spacing, t)
                    if d < distance[i, j, k]:
                        distance[i, j, k] = d
                        nearest[i, j, k] = f


@njit(cache=True, error_model="numpy")
@no_type_check
def _spread(triangles, origin, spacing, distance, nearest):
    """Fast sweeping: every node tries the nearest triangles of its neighbours, in all eight orders, twice."""
    nx, ny, nz = distance.shape
    for sweep in range(16):
        di, dj, dk = 1 - 2 * (sweep & 1), 1 - (sweep & 2), 1 - (sweep & 4) // 2
        for a in range(nx):
            i = a if di > 0 else nx - 1 - a
            for b in range(ny):
                j = b if dj > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if dk > 0 else nz - 1 - c
                    tried = nearest[i, j, k]
                    for n in range(1, 8):
                        p, q, r = i - di * (n & 1), j - dj * ((n & 2) >> 1), k - dk * ((n & 4) >> 2)
                        if p < 0 or q < 0 or r < 0 or p >= nx or q >= ny or r >= nz:
                            continue
                        f = nearest[p, q, r]
                        if f < 0 or f == tried or f == nearest[i, j, k]:
                            continue
                        tried = f
                        d = _to_triangle(origin[0] + i * spacing, origin[1] + j * spacing, origin[2] + k * spacing, triangles[f])
                        if d < distance[i, j, k]:
                            distance[i, j, k] = d
                            nearest[i, j, k] = f


@njit(cache=True, error_model="numpy")
@no_type_check
def _cast(triangles, origin, spacing, hits, last):
    """Count for each node the triangles that its line along the third axis crosses between it and the next node (after the last: anywhere).

    Lines are moved towards the middle by a millionth of a cell and less, so that none runs through an edge of a mesh that is aligned with
    the grid or just fills it.
    """
    nx, ny, nz = hits.shape
    for f in range(len(triangles)):
        t = triangles[f]
        ax, ay, az = (t[0] - origin[0]) / spacing, (t[1] - origin[1]) / spacing, (t[2] - origin[2]) / spacing
        bx, by, bz = (t[3] - origin[0]) / spacing, (t[4] - origin[1]) / spacing, (t[5] - origin[2]) / spacing
        cx, cy, cz = (t[6] - origin[0]) / spacing, (t[7] - origin[1]) / spacing, (t[8] - origin[2]) / spacing
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        for i in range(_node(math.floor(min(ax, bx, cx)), nx), _node(math.ceil(max(ax, bx, cx)), nx) + 1):
            x = i + 1.31e-6 * ((nx - 0.93) * 0.5 - i) / nx
            for j in range(_node(math.floor(min(ay, by, cy)), ny), _node(math.ceil(max(ay, by, cy)), ny) + 1):
                y = j + 0.73e-6 * ((ny - 0.89) * 0.5 - j) / ny
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = ((ax - x) * (by - y) - (ay - y) * (bx - x)) / area
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                z = u * az + v * bz + w * cz
                last[i, j] = max(last[i, j], origin[2] + z * spacing)
                if z > 0.0:
                    hits[i, j, _node(math.ceil(z) - 1.0, nz)] += 1


# --- a procedural canyon ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Canyon:
    """A canyon along x: a river bed that descends from a reservoir at low x, a waterfall, and a pool at high x.

    Attributes:
        terrain: the rock.
        reservoir: ``(low, high)`` per axis [m] of the region where the water starts, held by the headwall and the banks.
        fall: x [m] of the edge of the waterfall.
        pool: height [m] of the deepest ground below it.
    """

    terrain: DistanceGrid
    reservoir: Bounds
    fall: float
    pool: float


def canyon(seed: int, bounds: Bounds, spacing: float, friction: float = STICKY) -> Canyon:
    """A random canyon; the same for any spacing.

    Args:
        seed: non-negative integer.
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: of the grid of distances [m].
        friction: Coulomb coefficient of the rock.
    """
    low, counts = _lattice(bounds, spacing)
    room = np.ptp(np.array(bounds, float), axis=1)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    place = (_columns_of(low, spacing, counts) - low[:2]) / room[:2]
    x, y = place[..., 0], place[..., 1]
    edge, lip, sink = rng.uniform(0.46, 0.58), rng.uniform(0.44, 0.5), rng.uniform(0.05, 0.1)
    bend, turns, phase = rng.uniform(0.05, 0.12), rng.uniform(0.8, 1.4), rng.uniform(0, 2 * math.pi)
    narrow, narrows = rng.uniform(0.13, 0.18), rng.uniform(0.34, 0.4)

    step = 0.03  # length of the fall, of the domain's
    upper = lip + 0.15 * (edge - x) + 0.006 * _waves(rng, x, 0 * x, 3.0)
    lower = sink + 0.03 * _waves(rng, x, y, 5.0) * (1 - _rise(edge, edge + 0.2, x)) + 0.02
    bed = upper + (lower - upper) * _rise(edge, edge + step, x)
    width = narrow + (0.26 - narrow) * (1 - _rise(0.22, narrows, x)) + (0.29 - narrow) * _rise(edge, edge + 0.15, x)
    width = width * (1 + 0.1 * _waves(rng, x, 0 * y, 9.0)) + 0.02 * _waves(rng, x, y, 12.0)
    middle = 0.5 + bend * np.sin(2 * math.pi * turns * x + phase) * _rise(0.15, 0.35, x)
    outside = np.abs(y - middle) - width
    plateau = 0.86 + 0.08 * _waves(rng, x, y, 4.0)
    bank = 0.65 * _rise(0.0, 0.06, outside) + 0.35 * _rise(0.07, 0.14, outside)  # two steps with a ledge between them
    share = bed + (plateau - bed) * bank + 0.015 * _waves(rng, x, y, 25.0) * (0.3 + bank)
    heights = low[2] + room[2] * np.clip(share, 0.03, 0.97)
    terrain = DistanceGrid.from_values(low, spacing, _below_heights(heights, low, spacing, counts), friction)
    # the banks hold water up to the lowest place of their crests
    banks = heights[: int(np.sum(x[:, 0] <= narrows))]
    level = min(bank.max(axis=1).min() for bank in np.array_split(banks, 2, axis=1))
    first, across, floor = (float(v) for v in low)
    reservoir = (
        (first, first + float(narrows * room[0])),
        (across, across + float(room[1])),
        (floor + float((lip - 0.05) * room[2]), float(level)),
    )
    return Canyon(terrain, reservoir, float(low[0] + room[0] * edge), float(heights.min()))


def _rise(start: float, end: float, x: np.ndarray) -> np.ndarray:
    """A smooth step from 0 at ``start`` to 1 at ``end``."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def _waves(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, frequency: float, number: int = 8) -> np.ndarray:
    """Random smooth noise of about unit size: a sum of waves of up to ``frequency`` per unit length."""
    total: np.ndarray = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for _ in range(number):
        angle, phase, k = rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi), 2 * math.pi * frequency * rng.uniform(0.3, 1.0)
        total = total + np.cos(k * (math.cos(angle) * x + math.sin(angle) * y) + phase)
    return total * math.sqrt(2 / number) / 2


def compile_kernels() -> None:
    """Compile the kernels, or load them from Numba's cache."""
    flat: Sequence[Sequence[float]] = [[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [0.0, 1.0, 0.5]]
    low, corners = np.zeros(3), np.array([flat])
    _unsigned(corners, low, 1.0, (2, 2, 2))
    _crossings(corners, low, 1.0, (2, 2, 2), 2)
