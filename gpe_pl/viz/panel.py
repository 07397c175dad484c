"""One view of a scene: its boundary, and moving particles and meshes."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from gpe_pl.schema import CELL_KINDS
from gpe_pl.trajectory.cells import kinds_of, stacked
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.captions import frame_time, hidden_nodes
from gpe_pl.viz.coloring import Coloring
from gpe_pl.viz.scenery import INK, LIGHT, draw_scenery

DOT = 1.3
"""Diameter of a particle in rest spacings; neighbours overlap a little."""

APART, APART_SPACING = 0.9, 3.0
"""Diameter [spacings] of 2D particles that are drawn apart, with a thin edge, and the smallest spacing on paper [points] for this."""

DISC = np.stack([np.cos(np.arange(12) * np.pi / 6), np.sin(np.arange(12) * np.pi / 6)], axis=-1)

MAX_FACES = 30_000
"""Number of surface faces above which a 3D mesh is shown by its nodes."""

HAZE, HIDDEN = 0.3, 0.25
"""Fraction of white at the far end of a 3D scene, and opacity of items behind an obstacle."""

NOTE, NOTE_PAD, NOTE_WIDTH = 7, 4.0, 0.92
"""Largest size of a note's letters and its distance from the top of the panel [points], and its largest width as a fraction of the panel's."""

FACES = {
    "tetrahedron": np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]),
    "wedge": np.array([[0, 1, 2, 2], [3, 5, 4, 4], [0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]]),
    "hexahedron": np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]),
}
"""Corners of each face of a volume cell."""


def drawn_faces(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return polygons that show a mesh, as nodes [face, corner], and the cell of each [face].

    They are the cells of a 2D or surface mesh, or the outer faces of a volume mesh and its other cells. A line is a polygon without area. A volume mesh
    with more than ``MAX_FACES`` faces has none.
    """
    cells = trajectory.cells
    if cells is None or len(cells) == 0:
        return np.empty((0, 3), int), np.empty(0, int)
    kinds = kinds_of(cells, trajectory.cell_dim, trajectory.metadata.dim)
    names = list(CELL_KINDS)
    if trajectory.metadata.dim == 2 or not np.isin(kinds, [names.index(kind) for kind in FACES]).any():
        return cells, np.arange(len(cells))
    rows = {kind: np.flatnonzero(kinds == names.index(kind)) for kind in FACES}
    flat = np.flatnonzero(~np.isin(kinds, [names.index(kind) for kind in FACES]))
    groups = {kind: cells[rows[kind]][:, corners].reshape(-1, corners.shape[1]) for kind, corners in FACES.items() if len(rows[kind])}
    faces = stacked(groups | {"flat": cells[flat][:, :4]})
    of_cell = np.concatenate([*(np.repeat(rows[kind], len(corners)) for kind, corners in FACES.items()), flat])
    num_volume = len(faces) - len(flat)
    outer = np.concatenate([_that_occur_once(faces[:num_volume]), np.arange(num_volume, len(faces))])
    return (faces[outer], of_cell[outer]) if len(outer) <= MAX_FACES else (np.empty((0, 3), int), np.empty(0, int))


def outline(trajectory: Trajectory) -> np.ndarray:
    """Return the edges that belong to only one cell of a 2D mesh, as nodes [edge, 2]."""
    if trajectory.cells is None or trajectory.metadata.dim == 3:
        return np.empty((0, 2), int)
    edges = polygon_edges(trajectory.cells)
    return edges[_that_occur_once(edges)]


def polygon_edges(polygons: np.ndarray) -> np.ndarray:
    """Return the edges [edge, 2] of polygons [polygon, corner]; a polygon with fewer corners than others repeats its last."""
    edges = np.stack([polygons, np.roll(polygons, -1, axis=1)], axis=-1).reshape(-1, 2)
    return edges[edges[:, 0] != edges[:, 1]]


def _that_occur_once(groups: np.ndarray) -> np.ndarray:
    """Return the indices of the groups of nodes [group, node] whose set of nodes occurs in no other group."""
    nodes = np.sort(groups, axis=1).astype(np.int64)
    again = nodes[:, 1:] == nodes[:, :-1]
    nodes[:, 1:][again] = np.broadcast_to(nodes[:, -1:], again.shape)[again]
    nodes.sort(axis=1)
    key = np.zeros(len(nodes), np.int64)
    for column in nodes.T:
        key = key * (int(groups.max(initial=0)) + 1) + column
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    return np.sort(first[count == 1])


class Panel:
    """Axes that show one scene.

    Args:
        figure: figure to draw into; its size must be final, because it determines the size of particles.
        rectangle: left, bottom, width and height as fractions of the figure; the aspect ratio must be that of ``Camera``.
        trajectory: trajectory to show.
        coloring: colours of its particles and mesh cells.
        above: height of the free paper above and below the panel [inch], where notes stand that would cover most of a flat panel.
    """

    def __init__(
        self, figure: Figure, rectangle: tuple[float, float, float, float], trajectory: Trajectory, coloring: Coloring, above: float = 0.0
    ) -> None:
        self.trajectory, self.coloring, self.camera = trajectory, coloring, Camera(trajectory)
        self._is_3d = trajectory.metadata.dim == 3
        self._faces, self._cell_of_face = drawn_faces(trajectory)
        meshed = np.empty(0, int) if trajectory.cells is None or len(self._faces) == 0 else trajectory.cells
        self._loose = np.setdiff1d(np.arange(trajectory.num_nodes), meshed)

        low, high = self.camera.low, self.camera.high
        self.axes: Any = figure.add_axes(rectangle)
        self.axes.set_axis_off()
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        points_per_metre = rectangle[2] * figure.get_figwidth() * 72 / (high[0] - low[0])
        spacing = trajectory.metadata.spacing * points_per_metre
        is_apart = not self._is_3d and spacing >= APART_SPACING
        diameter = max(0.6, (APART if is_apart else DOT) * spacing)
        self._radius = diameter / 2 / points_per_metre
        many = trajectory.num_nodes > 500
        self.particles: Any = self.axes.scatter(
            [], [], s=diameter**2, linewidths=0.06 * diameter if self._is_3d or is_apart else 0, zorder=3, rasterized=many
        )
        # Wide edges cover the seams between cells. Among small cells they must not be darker, or they would hide the cells.
        self._edge = 1 - 0.3 * float(np.clip((diameter - 1.5) / 3, 0.0, 1.0))
        self.mesh: Any = PolyCollection([], linewidths=0.35, snap=False, joinstyle="round", zorder=3, rasterized=many)
        self.axes.add_collection(self.mesh, autolim=False)
        self._outline = outline(trajectory)
        self.outline: Any = LineCollection([], colors=[INK], linewidths=0.4, capstyle="round", snap=False, zorder=3)
        self.axes.add_collection(self.outline, autolim=False)
        self.note: Any = self.axes.text(0.5, 0.5, "", transform=self.axes.transAxes, ha="center", color="0.35", zorder=5)
        self._width, self._height, self._above = (
            72 * rectangle[2] * figure.get_figwidth(),
            72 * rectangle[3] * figure.get_figheight(),
            72 * above,
        )
        self.note.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5})
        self._cover = draw_scenery(self.axes, self.camera, trajectory, points_per_metre)

    @property
    def artists(self) -> tuple[Any, ...]:
        """Artists that ``show_frame`` changes, in drawing order."""
        return (self.mesh, self.outline, self.particles, self.note)

    def show_frame(self, frame: int) -> None:
        """Show a frame of the trajectory, or the reason why it is missing."""
        if frame < self.trajectory.num_frames:
            pos = self.trajectory.metadata.periodicity.wrapped(self.trajectory.pos[frame].astype(np.float64))
            self._show(pos, *self.coloring(self.trajectory, frame))
            self._note_above_motion("\n".join(hidden_nodes(self.trajectory, frame)))
            return
        self._show(np.full(self.trajectory.pos.shape[1:], np.nan), *self.coloring(self.trajectory, 0))
        stop = self.trajectory.termination
        reason = "not simulated" if stop is None else f"stopped at {frame_time(stop.frame, self.trajectory)}\n({stop.reason})"
        if self._fit(reason) > self._height + 2 * self._above:
            self._fit(reason.replace("\n", " "))
        self.note.set(y=0.5, va="center")

    def _fit(self, text: str) -> float:
        """Write a note that is no wider than the panel; return its height [points]."""
        self.note.set_text(text)
        self.note.set_fontsize(NOTE)
        if not text:
            return 0.0
        points = 72 / self.note.figure.dpi
        self.note.set_fontsize(NOTE * min(1.0, NOTE_WIDTH * self._width / (points * self.note.get_window_extent().width)))
        return float(points * self.note.get_window_extent().height)

    def _note_above_motion(self, text: str) -> None:
        """Write a note at the top of the panel, or above it if it would cover half of the panel and there is room."""
        height = self._fit(text.replace(" are", "\nare"))
        if height > self._height / 2:
            height = self._fit(text)
        if self._height / 2 < height <= self._above:
            self.note.set(y=1.0, va="bottom")
        elif height + NOTE_PAD <= self._height:
            self.note.set(y=1 - NOTE_PAD / self._height, va="top")
        else:
            self.note.set(y=0.5, va="center")

    def _show(
        self, pos: Float[np.ndarray, "node dim"], node_colors: Float[np.ndarray, "node 4"], cell_colors: Float[np.ndarray, "cell 4"]
    ) -> None:
        """Move everything to positions [m]; items that are not finite are left out."""
        finite = np.isfinite(pos).all(axis=-1)
        pos = np.where(finite[:, None], pos, 0.0)
        on_paper, depth = self.camera.project(pos)
        whole = finite[self._faces].all(axis=1)
        faces, dots = self._faces[whole], self._loose[finite[self._loose]]
        corners, shown = self._corners(pos, faces)
        face_colors = cell_colors[self._cell_of_face[whole][shown]]
        outlines = list(self.camera.project(corners)[0])
        if self._is_3d and len(faces):
            # Dots among faces become polygons, so that everything can be drawn from far to near.
            outlines += list(on_paper[dots, None] + self._radius * DISC)
            face_colors[:, :3] *= self._shade(corners)[:, None]
            face_colors = np.concatenate([face_colors, node_colors[dots]])
            middle = np.concatenate([corners.mean(axis=1), pos[dots]])
            order = np.argsort(middle @ self.camera.toward, kind="stable")
            outlines = [outlines[k] for k in order]
            face_colors = self._seen_from_afar(face_colors, *self.camera.project(middle))[order]
            dots = dots[:0]
        self.mesh.set_verts(outlines)
        self._paint(self.mesh, face_colors, self._edge)
        segments, _ = self._corners(pos, self._outline[finite[self._outline].all(axis=1)])
        self.outline.set_segments(self.camera.project(segments)[0])
        dots = dots[np.argsort(depth[dots], kind="stable")]
        self.particles.set_offsets(on_paper[dots])
        # Give every particle its own colour: with a single colour Agg rounds positions to whole pixels.
        self._paint(self.particles, self._seen_from_afar(node_colors[dots], on_paper[dots], depth[dots]), 0.7)

    def _corners(self, pos: Float[np.ndarray, "node dim"], groups: np.ndarray) -> tuple[Float[np.ndarray, "drawn corner dim"], np.ndarray]:
        """Return positions of the nodes of faces or edges, and the index of each; those at the seam of a periodic domain appear on both sides."""
        corners, which = pos[groups], np.arange(len(groups))
        periodicity = self.trajectory.metadata.periodicity
        if periodicity:
            corners = corners[:, :1] + periodicity.shortest(corners - corners[:, :1])
        for axis in periodicity.axes:
            low, high = periodicity.bounds[axis]
            step = (high - low) * np.eye(pos.shape[1])[axis]
            below, above = (corners[..., axis] < low).any(axis=1), (corners[..., axis] > high).any(axis=1)
            corners = np.concatenate([corners, corners[below] + step, corners[above] - step])
            which = np.concatenate([which, which[below], which[above]])
        return corners, which

    def _paint(self, artist: Any, colors: Float[np.ndarray, "item 4"], edge: float) -> None:
        artist.set_facecolor(colors)
        artist.set_edgecolor(colors * (edge, edge, edge, 1.0))

    def _shade(self, corners: Float[np.ndarray, "face corner 3"]) -> Float[np.ndarray, "face"]:
        """Return the brightness of triangles under light that falls on either side."""
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
        normal = self.camera.turn(normal)
        return 0.85 + 0.15 * np.clip((normal * np.where(normal[:, 2:] < 0, -1, 1)) @ LIGHT, -1, 1)

    def _seen_from_afar(
        self, colors: Float[np.ndarray, "item 4"], on_paper: Float[np.ndarray, "item 2"], depth: Float[np.ndarray, "item"]
    ) -> Float[np.ndarray, "item 4"]:
        """Fade colours with distance, and behind obstacles."""
        colors = colors.copy()
        colors[:, :3] += HAZE * self.camera.haze(depth)[:, None] * (1 - colors[:, :3])
        colors[self._cover.hides(on_paper, depth), 3] = HIDDEN
        return colors
