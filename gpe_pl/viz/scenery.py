"""Draws walls, obstacles, containers and terrain, and finds the particles of a 3D scene that they hide.

In 3D, a surface is shown only if its free side faces the viewer. A viewer outside a container therefore sees its inside, and the near bank of a river is not
drawn.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.patches import Circle, Patch, Polygon, Rectangle

from gpe_pl.geometry.shapes import Shape, signed_distance
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import Camera

INK = "0.15"
SOLID = "0.82"
BACKDROP = "0.965"

GRID = 240
"""Points along the longer side of a 2D scene at which signed distances are sampled, for shapes without a simple outline."""

LIGHT = np.array([-0.45, 0.75, 0.5]) / np.linalg.norm([-0.45, 0.75, 0.5])
"""Direction to the light: to the right, upward and towards the viewer."""


class Cover:
    """Tells which points of a 3D scene are hidden by a surface. It keeps the depth of the nearest surface in each cell of a raster of the picture.

    Args:
        camera: camera of the picture.
        pos: points on visible surfaces [point, dim] in m.
        spacing: distance between them [m].
    """

    def __init__(self, camera: Camera, pos: Float[np.ndarray, "point dim"], spacing: float) -> None:
        self._low, self._pixel, self._slack = camera.low, 1.5 * spacing, 4 * spacing  # a pixel of the ground spans 3.4 spacings of depth
        self._depth = np.full(np.ceil((camera.high - camera.low) / self._pixel).astype(int) + 1, -np.inf)
        on_paper, depth = camera.project(pos)
        np.maximum.at(self._depth, self._index(on_paper), depth)

    def _index(self, on_paper: Float[np.ndarray, "point 2"]) -> tuple[np.ndarray, ...]:
        return tuple(np.clip((on_paper - self._low) / self._pixel, 0, np.array(self._depth.shape) - 1).astype(int).T)

    def hides(self, on_paper: Float[np.ndarray, "point 2"], depth: Float[np.ndarray, "point"]) -> Bool[np.ndarray, "point"]:
        """Tell whether a surface lies in front of points."""
        return depth + self._slack < self._depth[self._index(on_paper)]


def draw_scenery(axes: Any, camera: Camera, trajectory: Trajectory, points_per_metre: float) -> Cover:
    """Draw the boundary of a trajectory into ``axes``; return the ``Cover`` of its surfaces. ``points_per_metre`` is the scale of the picture."""
    if trajectory.metadata.dim == 2:
        _draw_2d(axes, trajectory)
        return Cover(camera, np.empty((0, 2)), trajectory.metadata.spacing)
    return _draw_3d(axes, camera, trajectory, points_per_metre)


def _draw_2d(axes: Any, trajectory: Trajectory) -> None:
    shapes: tuple[Any, ...] = trajectory.boundary.shapes
    for shape in shapes:
        if shape.kind == "wall":
            axis = int(np.argmax(np.abs(shape.normal)))
            ends = np.array([shape.low, shape.high], float)
            ends[:, axis] = shape.offset * shape.normal[axis]
            axes.plot(*ends.T, color=INK, linewidth=0.8, solid_capstyle="projecting", zorder=4)
        elif (patch := _patch(shape)) is not None:
            axes.add_patch(patch)
        else:
            _fill_solid(axes, shape, np.asarray(trajectory.metadata.bounds, float))
    low, high = np.array(trajectory.metadata.bounds).T
    for axis in trajectory.metadata.periodicity.axes:
        for side in (low, high):
            ends = np.array([low, high])
            ends[:, axis] = side[axis]
            axes.plot(*ends.T, color="0.6", linewidth=0.6, linestyle=":", zorder=1)
    if len(loose := loose_nodes(trajectory)):
        axes.scatter(*loose.T, s=1.0, color=INK, linewidths=0, zorder=2)


def loose_nodes(trajectory: Trajectory) -> np.ndarray:
    """Return positions [node, dim] in m of the boundary nodes that are on no shape. Imported data give some boundaries by nodes only."""
    pos, shapes = trajectory.boundary.pos, trajectory.boundary.shapes
    distances = [np.abs(shape.signed_distance(pos)) for shape in shapes]
    return pos[np.min(distances, axis=0) > 0.1 * trajectory.metadata.spacing] if shapes else pos


def _patch(shape: Any) -> Patch | None:
    """Return a solid with a simple outline as a filled area; None for other shapes."""
    style: dict[str, Any] = {"facecolor": SOLID, "edgecolor": INK, "linewidth": 0.6, "zorder": 2}
    if shape.kind == "sphere":
        return Circle(shape.center, shape.radius, **style)
    if shape.kind == "box":
        return Rectangle(shape.low, shape.high[0] - shape.low[0], shape.high[1] - shape.low[1], **style)
    if shape.kind == "polygon":
        return Polygon(shape.vertices, closed=True, joinstyle="round", **style)
    return None


def _fill_solid(axes: Any, shape: Shape, bounds: Float[np.ndarray, "2 2"]) -> None:
    """Draw any shape by its signed distance: fill where it is negative, and trace where it is zero."""
    step = np.ptp(bounds, axis=1).max() / GRID
    x, y = (np.linspace(low, high, max(2, round((high - low) / step) + 1)) for low, high in bounds)
    distance = shape.signed_distance(np.stack(np.meshgrid(x, y), axis=-1))
    lowest = float(distance.min())
    if lowest < 0:
        axes.contourf(x, y, distance, levels=[1.01 * lowest, 0.0], colors=[SOLID], zorder=2)
        if distance.max() > 0:
            axes.contour(x, y, distance, levels=[0.0], colors=[INK], linewidths=0.6, zorder=2)


def _draw_3d(axes: Any, camera: Camera, trajectory: Trajectory, points_per_metre: float) -> Cover:
    boundary, spacing = trajectory.boundary, trajectory.metadata.spacing
    shapes: tuple[Any, ...] = boundary.shapes
    walls, boxes, bowls = (tuple(s for s in shapes if s.kind == kind) for kind in ("wall", "box", "bowl"))
    style: dict[str, Any] = {"linewidth": 0.5, "joinstyle": "round"}
    for wall in () if bowls else walls:  # a bowl hides the walls around it
        axis = int(np.argmax(np.abs(wall.normal)))
        if wall.normal[axis] * camera.toward[axis] > 0:
            outline = _face(camera, wall.low, wall.high, axis, wall.offset * wall.normal[axis])
            axes.add_patch(Polygon(outline, facecolor=BACKDROP, edgecolor="0.6", zorder=0, **style))
    for box in boxes:
        for axis, side in enumerate(np.sign(camera.toward)):
            outline = _face(camera, box.low, box.high, axis, (box.high if side > 0 else box.low)[axis])
            grey = str(_brightness(camera, side * np.eye(3)[axis]))
            axes.add_patch(Polygon(outline, facecolor=grey, edgecolor=grey, zorder=1, **style))
    # Overlapping discs look like a surface, and the light on them shows its shape. They end where the solid does.
    pos, normal, gap = surface_points(boundary, spacing)
    seen = (normal @ camera.toward >= 0) & (signed_distance(walls, pos) > 1e-6 * spacing)
    pos, normal, radius = pos[seen], normal[seen], 0.85 * gap[seen]
    on_paper, depth = camera.project(pos - radius[:, None] * normal)
    order = np.argsort(depth)
    colors = np.repeat(_brightness(camera, normal[order])[:, None], 3, axis=1)
    size = (2 * radius[order] * points_per_metre) ** 2
    surface = axes.scatter(*on_paper[order].T, s=size, c=colors, linewidths=0, zorder=1, rasterized=len(pos) > 500)
    for bowl in bowls:
        rim = Circle(
            camera.project(np.asarray(bowl.center, float))[0], bowl.radius, facecolor="none", edgecolor="0.6", linewidth=0.5, zorder=1
        )
        surface.set_clip_path(axes.add_patch(rim))
    hiding = (boundary.normal @ camera.toward >= 0) & (signed_distance(walls, boundary.pos) > 1e-6 * spacing)
    return Cover(camera, boundary.pos[hiding], spacing)


def surface_points(boundary: Boundary, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions and normals [point, 3] on all surfaces except boxes, and distances between neighbours [point] in m.

    Nodes on walls are included. The caller leaves them out where it draws walls as areas.
    """
    flat_or_round: tuple[Any, ...] = tuple(s for s in boundary.shapes if s.kind in ("box", "sphere", "bowl"))
    rest = np.abs(signed_distance(flat_or_round, boundary.pos)) > 1e-6 * spacing
    parts = [(boundary.pos[rest], boundary.normal[rest], np.full(np.count_nonzero(rest), spacing))]
    for shape in flat_or_round:
        if shape.kind != "box":  # sampled from the smooth shape, not from its nodes
            gap = min(spacing, shape.radius / 16)
            pos, normal = shape.sample(gap)
            parts.append((pos, normal, np.full(len(pos), gap)))
    pos, normal, gaps = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return pos, normal, gaps


def _brightness(camera: Camera, normal: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Return the grey of a surface under the light."""
    return np.asarray(0.7 + 0.24 * np.clip(camera.turn(normal) @ LIGHT, -0.4, 1))


def _face(camera: Camera, low: Sequence[float], high: Sequence[float], axis: int, value: float) -> Float[np.ndarray, "4 2"]:
    """Return the corners in the picture [4, 2] of the face of a box on which a coordinate has this value."""
    first, second = (k for k in range(3) if k != axis)
    corners = np.full((4, 3), value)
    corners[:, first] = np.take([low[first], high[first]], [0, 1, 1, 0])
    corners[:, second] = np.take([low[second], high[second]], [0, 0, 1, 1])
    return camera.project(corners)[0]
