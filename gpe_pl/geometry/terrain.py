"""Terrain for scenes, read from a mesh, a point cloud or a height map into signed distances on a grid. The last axis of a scene points up."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from gpe_pl.geometry.grid_distance import Bounds, Solid, below_heights, cloud_distances, columns_of, lattice, mesh_distances
from gpe_pl.geometry.shapes import DistanceGrid
from gpe_pl.geometry.terrain_files import Cloud, Heights, Mesh, TerrainError, read_surface
from gpe_pl.schema import STICKY

log = logging.getLogger(__name__)

Fit = Literal["contain", "stretch", "none"]
Up = Literal["x", "y", "z"]

_TO_Z_UP = {"x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]], "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "z": np.eye(3)}


def read_terrain(
    path: Path | str,
    bounds: Bounds,
    spacing: float,
    *,
    fit: Fit = "contain",
    up: Up = "z",
    solid: Solid | Literal["auto"] = "auto",
    relief: float | None = None,
    friction: float = STICKY,
) -> DistanceGrid:
    """Read the terrain in a file as signed distances at grid nodes that cover the domain.

    * Triangle meshes: OBJ, STL, PLY.
    * Point clouds: PLY without faces; XYZ (text) and NPY with 3 columns, or with 6 columns that include unit normals into free space; NPZ with ``points`` and
      optionally ``normals``. Without normals the ground is the height field through the points.
    * Height maps, seen from above with north up (columns along x, rows against y): NPY with another number of columns, NPZ with
      ``heights``, CSV, PNG (the largest possible grey value is 1).
    * NPY with 3 columns and fewer than ``terrain_files.FEWEST_POINTS`` rows, or with 6 columns without unit normals, may be either: it is refused.

    Args:
        path: the file; its extension determines the format.
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: spacing of the grid [m].
        fit: how to place the terrain. ``contain`` scales it by one factor until it fits into the domain. ``stretch`` scales each axis until it fills the
            domain. Both put it in the middle of the floor. ``none`` uses the coordinates of the file in m (a pixel of a height map is 1 m wide).
        up: axis of a mesh or point cloud that points up.
        solid: which side is solid. ``inside``: inside a closed mesh, or behind the normals of a point cloud. ``outside``: the opposite side, for a
            container. ``below``: below an open surface, which continues beyond its rim at the height of the rim. ``auto`` chooses ``inside`` for
            watertight meshes and clouds with normals, and ``below`` for all others; the choice is logged.
        relief: height between the lowest and the highest point [m]. By default it follows from ``fit``; for a height map it is then half the domain's
            height, unless ``fit`` is ``none``.
        friction: Coulomb coefficient of the surface.

    Raises:
        TerrainError: the file cannot be read, contains nothing usable, is too large, or does not fit the options; or it is an OBJ, STL or PLY file and the
            package trimesh is not installed.
        ValueError: an option, bounds or spacing are invalid for every file.
    """
    path = Path(path)
    low, counts = lattice(bounds, spacing)
    for name, value, known in (("fit", fit, get_args(Fit)), ("up", up, get_args(Up)), ("solid", solid, ("auto", *get_args(Solid)))):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    if relief is not None and (fit == "none" or not 0 < relief < math.inf):
        raise ValueError(f"relief must be positive, and not given with fit='none', got {relief}")
    source = read_surface(path)
    if solid == "auto":
        closed = source.watertight if isinstance(source, Mesh) else isinstance(source, Cloud) and source.normals is not None
        solid = "inside" if closed else "below"
        log.info("%s: the solid is %s the surface; choose with solid=inside|outside|below", path, solid)
    if solid != "below" and (isinstance(source, Heights) or (isinstance(source, Cloud) and source.normals is None)):
        raise TerrainError(f"{path}: solid={solid!r} needs a mesh or normals; this file is a height field, use solid='below'")
    if isinstance(source, Heights):
        heights = _resampled(path, source.values, bounds, spacing, fit, relief)
        values = below_heights(heights, low, spacing, counts)
    elif isinstance(source, Mesh):
        vertices, _ = _placed(path, source.vertices, None, bounds, fit, up, relief)
        try:
            values = mesh_distances(vertices[source.faces], low, spacing, counts, solid)
        except ValueError as error:
            raise TerrainError(f"{path}: {error}") from None
    else:
        points, normals = _placed(path, source.points, source.normals, bounds, fit, up, relief)
        if solid == "below" or normals is None:
            values = below_heights(_heights_of(path, points, low, spacing, counts), low, spacing, counts)
        else:
            values = cloud_distances(points, normals if solid == "inside" else -normals, low, spacing, counts)
    if not (values.min() < 0 < values.max()):
        what = "no free space" if values.max() <= 0 else "nothing solid"
        raise TerrainError(f"{path}: there is {what} in the domain {bounds}; check fit={fit!r}, up={up!r} and solid={solid!r}")
    return DistanceGrid.from_values(low, spacing, values, friction)


def ground_of(points: np.ndarray, normals: np.ndarray, bounds: Bounds, spacing: float, friction: float = STICKY) -> DistanceGrid:
    """Create the solid ground below an open surface given by points, as signed distances at grid nodes that cover the domain.

    Near the surface, the normals determine which side is free. Farther away the nearest normal may belong to the rim of a cliff, so there the free side lies
    above the height field through the points.

    Args:
        points: points of the surface [point, 3] in m.
        normals: unit normals into free space [point, 3].
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: spacing of the grid [m].
        friction: Coulomb coefficient of the surface.

    Raises:
        TerrainError: seen from above all points lie on one line.
        ValueError: bounds or spacing are invalid, or the grid would have too many nodes.
    """
    low, counts = lattice(bounds, spacing)
    values = cloud_distances(points, normals, low, spacing, counts)
    heights = _heights_of(Path("points"), points, low, spacing, counts)
    is_above = low[2] + spacing * np.arange(counts[2]) > heights[..., None]
    values = np.where(np.abs(values) > spacing, np.where(is_above, 1.0, -1.0) * np.abs(values), values)
    return DistanceGrid.from_values(low, spacing, values, friction)


def turned(vectors: np.ndarray, up: Up) -> np.ndarray:
    """Return vectors [vector, 3] of a file, whose axis ``up`` points up, with z up."""
    return vectors @ np.asarray(_TO_Z_UP[up], float).T


def _placed(
    path: Path, points: np.ndarray, normals: np.ndarray | None, bounds: Bounds, fit: Fit, up: Up, relief: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Move points [point, 3] and their normals into the frame of the scene; returns positions in m."""
    points, normals = turned(points, up), None if normals is None else turned(normals, up)
    if fit == "none":
        return points, normals
    floor, room = np.array(bounds, float)[:, 0], np.ptp(np.array(bounds, float), axis=1)
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    if np.sum(extent > 0) < 2:
        raise TerrainError(f"{path}: all points lie on one line")
    ratio = np.divide(room, extent, out=np.full(3, np.inf), where=extent > 0)
    vertical = ratio[2] if relief is None or extent[2] == 0 else relief / extent[2]
    if fit == "contain":
        one = min(ratio) if relief is None else min(ratio[:2])
        scale = np.array([one, one, one if relief is None else vertical])
    else:
        scale = np.array([ratio[0], ratio[1], vertical])
    scale = np.where(np.isfinite(scale), scale, 1.0)
    start = floor + np.array([0.5, 0.5, 0.0]) * (room - scale * extent)
    if normals is not None:
        normals = normals / scale
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return start + (points - low) * scale, normals


def _resampled(path: Path, values: np.ndarray, bounds: Bounds, spacing: float, fit: Fit, relief: float | None) -> np.ndarray:
    """Place a height map in the scene: heights of the ground [along x, along y] in m at the grid's vertical lines."""
    from scipy.ndimage import map_coordinates

    low, counts = lattice(bounds, spacing)
    room, extent, rise = np.ptp(np.array(bounds), axis=1), np.array(values.shape) - 1.0, float(np.ptp(values))
    place = columns_of(low, spacing, counts)
    if fit == "none":
        index = place
    else:
        scale = room[:2] / extent
        scale = np.full(2, scale.min()) if fit == "contain" else scale
        index = (place - low[:2] - 0.5 * (room[:2] - scale * extent)) / scale
        values = low[2] + (values - values.min()) * ((relief or 0.5 * room[2]) / rise if rise > 0 else 0.0)
    return np.asarray(map_coordinates(values, np.moveaxis(index, -1, 0), order=1, mode="nearest"))


def _heights_of(path: Path, points: np.ndarray, low: np.ndarray, spacing: float, counts: tuple[int, ...]) -> np.ndarray:
    """Return heights [along x, along y] in m of a cloud's surface at the grid's vertical lines.

    Heights are interpolated linearly between the points. Outside of them the height of the nearest point is used.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    place = columns_of(low, spacing, counts)
    nearest = np.asarray(NearestNDInterpolator(points[:, :2], points[:, 2])(place))
    try:
        heights = np.asarray(LinearNDInterpolator(points[:, :2], points[:, 2])(place))
    except QhullError:
        raise TerrainError(f"{path}: seen from above all points lie on one line; check the option up") from None
    return np.where(np.isfinite(heights), heights, nearest)
