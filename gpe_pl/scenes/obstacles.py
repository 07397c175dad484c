"""Obstacles of a scene: shapes, and solids from mesh files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpe_pl.geometry.grid_distance import mesh_distances
from gpe_pl.geometry.sections import section, solid_within
from gpe_pl.geometry.shapes import DistanceGrid, Shape, Sphere
from gpe_pl.geometry.terrain import Up, turned
from gpe_pl.geometry.terrain_files import Mesh, TerrainError, read_surface
from gpe_pl.geometry.thin_parts import thinnest

log = logging.getLogger(__name__)

FRICTION = 0.4
"""Coulomb coefficient of walls and obstacles for which none is given."""
CELLS = 2
"""Number of cells of the grid of distances to a mesh in a spacing of nodes."""


def Circle(center: Sequence[float | int], radius: float | int, friction: float | int = FRICTION, restitution: float | int = 0) -> Sphere:
    """Return a disc (2D) or ball (3D) as an obstacle.

    Args:
        center: position of the centre [dim] in m.
        radius: radius [m].
        friction: Coulomb coefficient.
        restitution: fraction of the normal velocity that a bounce returns.
    """
    return Sphere(tuple(float(x) for x in center), float(radius), float(friction), float(restitution))


@dataclass(frozen=True)
class MeshObstacle:
    """A solid from a triangle mesh. In 2D the obstacle is a section: the plane through the middle of the mesh along the axis that points away.

    Attributes:
        path: OBJ, STL or PLY file.
        at: low corner of its bounding box [dim] in m; None keeps the coordinates of the file, in m.
        size: largest side of its bounding box in the scene [m]; None keeps the size of the file, in m.
        up: axis of the file that points up.
        friction: Coulomb coefficient.
    """

    path: Path
    at: np.ndarray | None
    size: float | None
    up: Up
    friction: float

    def shape(self, bounds: tuple[tuple[float, float], ...], spacing: float) -> Shape:
        """Return signed distances for a scene whose nodes are ``spacing`` [m] apart.

        Raises:
            TerrainError: the file cannot be read, holds no closed mesh, or nothing of it is in the domain.
        """
        source = read_surface(self.path)
        if not isinstance(source, Mesh):
            raise TerrainError(f"{self.path}: is no triangle mesh; export it as one that encloses a volume")
        if not source.watertight:
            raise TerrainError(f"{self.path}: encloses no volume: {source.why_not_closed()}; export each closed part as a mesh of its own")
        axes = [0, 2] if len(bounds) == 2 else [0, 1, 2]
        vertices = turned(source.vertices, self.up)
        low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
        scale = 1.0 if self.size is None else self.size / float(extent[axes].max())
        vertices = (vertices - low) * scale + low * (scale if self.at is None else 0.0)
        if self.at is not None:
            vertices[:, axes] += self.at
        step = spacing / CELLS
        try:
            if len(bounds) == 2:
                middle = float((vertices[:, 1].min() + vertices[:, 1].max()) / 2)
                outlines = section(vertices[source.faces], middle)
                self._warn_of_thin_parts(outlines, step)
                return solid_within(outlines, bounds, step, self.friction)
            self._warn_of_thin_parts(vertices[source.faces], step)
            origin = np.array([a - step for a, _ in bounds])
            counts = tuple(int(np.ceil((b - a) / step)) + 3 for a, b in bounds)
            values = mesh_distances(vertices[source.faces], origin, step, counts, "inside")
            if not (values < 0).any():
                raise ValueError(f"nothing of it is in the box {bounds}")
            return DistanceGrid.from_values(origin, step, values, self.friction)
        except ValueError as error:
            reach = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(vertices.min(axis=0)[axes], vertices.max(axis=0)[axes], strict=True))
            raise TerrainError(f"{self.path}: reaches from {reach} m; {error}; give at=… and size=… in m") from None

    def _warn_of_thin_parts(self, faces: np.ndarray, step: float) -> None:
        thickness, place = thinnest(faces) if len(faces) else (np.inf, np.zeros(0))
        if thickness < step:
            where = ", ".join(f"{x:.3g}" for x in place)
            log.warning(
                "%s: a part of it near (%s) m is %.2g m thick, and this scene resolves %.2g m (half of the spacing), so nodes may pass through it; thicken it, "
                "or give a box or polygon",
                self.path,
                where,
                thickness,
                step,
            )
