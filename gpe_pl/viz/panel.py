"""One view of a scene: its boundary, and particles that can be moved and recoloured."""

from collections.abc import Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from mpl_toolkits.mplot3d.axes3d import Axes3D

from gpe_pl.geometry import signed_distance
from gpe_pl.metrics import displacement
from gpe_pl.trajectory import Trajectory

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Line colours that stay apart with colour-blind readers (Okabe and Ito, Color universal design, 2008)."""

INK = "0.15"
SOLID = "0.82"
REFERENCE = "#7A8B99"
"""Particles of the ground truth where colour means error."""

ColorBy = Literal["error", "height"]


def _shortened(name: str, low: float, high: float) -> Colormap:
    """The part of a colour map that shows on white paper."""
    return LinearSegmentedColormap.from_list(f"{name}_shortened", mpl.colormaps[name](np.linspace(low, high, 256)))


COLOR_MAPS: dict[ColorBy, Colormap] = {"error": _shortened("inferno", 0.08, 0.9), "height": _shortened("viridis", 0.0, 0.95)}


def vertical_axis(trajectory: Trajectory) -> int:
    """The axis along which gravity acts; the last one without gravity."""
    gravity = np.abs(trajectory.metadata.gravity)
    return int(np.argmax(gravity)) if gravity.any() else trajectory.metadata.dim - 1


def initial_height(trajectory: Trajectory) -> Float[np.ndarray, "node"]:
    """Height of every particle in frame 0 [m]: a colour by which material can be followed."""
    return trajectory.pos[0, :, vertical_axis(trajectory)].astype(np.float64)


def position_error(prediction: Trajectory, ground_truth: Trajectory, frame: int) -> Float[np.ndarray, "node"]:
    """Distance [m] of every particle from its place in the ground truth."""
    return np.linalg.norm(displacement(prediction.pos[frame], ground_truth.pos[frame], ground_truth.metadata), axis=-1)


def node_values(trajectory: Trajectory, ground_truth: Trajectory, frame: int, color: ColorBy) -> Float[np.ndarray, "node"] | None:
    """What to colour particles by [m]; None for the ground truth itself where colour means error."""
    if color == "height":
        return initial_height(ground_truth)
    return None if trajectory is ground_truth else position_error(trajectory, ground_truth, frame)


def color_scale(ground_truth: Trajectory, predictions: dict[str, Trajectory], frames: Sequence[int], color: ColorBy) -> Normalize:
    """One scale for all panels. Errors end at their 99th percentile, or a single lost particle would take all colour from the others."""
    if color == "height":
        height = initial_height(ground_truth)
        return Normalize(float(height.min()), float(height.max()))
    errors = [position_error(p, ground_truth, f) for p in predictions.values() for f in frames if f < p.num_frames]
    finite = np.concatenate([np.zeros(1), *errors])
    top = float(np.quantile(finite[np.isfinite(finite)], 0.99))
    return Normalize(0.0, top if top > 0 else ground_truth.metadata.spacing)


def view(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what a panel shows [m]: the domain and a margin for its walls."""
    low, high = np.asarray(trajectory.metadata.bounds, float).T
    margin = 0.015 * (high - low).max()
    return low - margin, high + margin


class Panel:
    """Axes that show one scene.

    Args:
        figure: figure to draw into; its size must be final, since it fixes how large a particle is.
        rectangle: left, bottom, width, height in parts of the figure; in 2D with the aspect ratio of ``view``.
        trajectory: gives boundary, domain, spacing and number of particles.
        color: what ``values`` in ``show`` mean.
        scale: colour scale of them.
    """

    def __init__(
        self, figure: Figure, rectangle: tuple[float, float, float, float], trajectory: Trajectory, color: ColorBy, scale: Normalize
    ) -> None:
        self.color_map, self.scale = COLOR_MAPS[color], scale
        three_d = trajectory.metadata.dim == 3
        low, high = view(trajectory)
        self.axes: Any = figure.add_axes(rectangle, projection="3d" if three_d else None)
        width_pt = rectangle[2] * figure.get_figwidth() * 72
        # In perspective a particle has no single size on paper; the diagonal of the domain gives about the right one.
        extent = np.linalg.norm(high - low) if three_d else high[0] - low[0]
        diameter_pt = max(0.6, 1.3 * trajectory.metadata.spacing / extent * width_pt)
        empty: list[np.ndarray] = [np.empty(0)] * trajectory.metadata.dim
        style: dict[str, Any] = {"s": diameter_pt**2, "linewidths": 0, "zorder": 3, "rasterized": trajectory.num_nodes > 500}
        if three_d:
            style["depthshade"] = False
        self.particles: Any = self.axes.scatter(*empty, **style)
        place = self.axes.text2D if isinstance(self.axes, Axes3D) else self.axes.text
        self.note = place(0.5, 0.5, "", transform=self.axes.transAxes, ha="center", va="center", color="0.35", fontsize=7, zorder=5)
        self.note.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5})
        self._frame(trajectory, low, high)
        self._boundary(trajectory)

    def _frame(self, trajectory: Trajectory, low: np.ndarray, high: np.ndarray) -> None:
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        self.axes.set_axis_off()
        if isinstance(self.axes, Axes3D):
            self.axes.set_zlim(low[2], high[2])
            self.axes.set_box_aspect(high - low, zoom=1.2)
            self.axes.view_init(elev=18, azim=-60, vertical_axis="xyz"[vertical_axis(trajectory)])
        else:
            self.axes.set_aspect("equal")

    def _boundary(self, trajectory: Trajectory) -> None:
        shapes: tuple[Any, ...] = trajectory.boundary.shapes
        if isinstance(self.axes, Axes3D):
            walls = tuple(s for s in shapes if s.kind == "wall")
            nodes = trajectory.boundary.pos
            # Walls would hide the scene: their edges must do. Obstacles are shown by their nodes.
            nodes = nodes[signed_distance(walls, nodes) > 1e-6 * trajectory.metadata.spacing]
            self.axes.scatter(*nodes.T, s=0.6, color="0.6", linewidths=0, depthshade=False, zorder=1)
            if walls:
                self._domain_edges(np.asarray(trajectory.metadata.bounds, float))
            return
        for shape in shapes:
            if shape.kind == "wall":
                axis = int(np.argmax(np.abs(shape.normal)))
                ends = np.array([shape.low, shape.high], float)
                ends[:, axis] = shape.offset * shape.normal[axis]
                self.axes.plot(*ends.T, color=INK, linewidth=0.8, solid_capstyle="projecting", zorder=4)
            else:
                self.axes.add_patch(_patch(shape))
        if not shapes:  # imported data knows its boundary by nodes only
            self.axes.scatter(*trajectory.boundary.pos.T, s=1.0, color=INK, linewidths=0, zorder=2)

    def _domain_edges(self, bounds: np.ndarray) -> None:
        corners = np.stack([m.ravel() for m in np.meshgrid(*bounds, indexing="ij")], axis=-1)
        pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if np.sum(a != b) == 1]
        for a, b in pairs:
            self.axes.plot(*np.stack([a, b]).T, color="0.55", linewidth=0.5, zorder=0)

    @property
    def artists(self) -> tuple[Any, ...]:
        """The artists that ``show`` and ``show_note`` change."""
        return (self.particles, self.note)

    def show(self, pos: Float[np.ndarray, "node dim"], values: Float[np.ndarray, "node"] | None) -> None:
        """Move the particles to ``pos`` [m] and colour them by ``values``, or uniformly without."""
        shown = np.isfinite(pos).all(axis=-1)
        pos = pos[shown]
        if pos.shape[-1] == 3:
            self._move_3d(pos)
        else:
            self.particles.set_offsets(pos)
        # One colour per particle even where all are equal: a single one makes Agg round positions to whole pixels.
        self.particles.set_facecolor([REFERENCE] * len(pos) if values is None else self.color_map(self.scale(values[shown])))
        self.note.set_text("")

    def show_note(self, text: str) -> None:
        """Show words in place of particles."""
        if isinstance(self.axes, Axes3D):
            self._move_3d(np.empty((0, 3)))
        else:
            self.particles.set_offsets(np.empty((0, 2)))
        self.note.set_text(text)

    def _move_3d(self, pos: Float[np.ndarray, "node 3"]) -> None:
        # mplot3d has no public setter, and projects only when it draws the whole axes, which an animation does once.
        self.particles._offsets3d = tuple(pos.T)
        if self.axes.M is not None:
            self.particles.do_3d_projection()

    def show_frame(self, trajectory: Trajectory, ground_truth: Trajectory, frame: int, color: ColorBy) -> None:
        """Show a frame of a trajectory, or why there is none."""
        if frame < trajectory.num_frames:
            self.show(trajectory.pos[frame].astype(np.float64), node_values(trajectory, ground_truth, frame, color))
        elif trajectory.termination is None:
            self.show_note("not simulated")
        else:
            stop = trajectory.termination
            self.show_note(f"stopped at {stop.frame * trajectory.metadata.frame_dt:.2f} s\n({stop.reason})")


def _patch(shape: Any) -> Patch:
    """An obstacle as a filled area."""
    style: dict[str, Any] = {"facecolor": SOLID, "edgecolor": INK, "linewidth": 0.6, "zorder": 2}
    if shape.kind == "sphere":
        return Circle(shape.center, shape.radius, **style)
    if shape.kind == "box":
        return Rectangle(shape.low, shape.high[0] - shape.low[0], shape.high[1] - shape.low[1], **style)
    if shape.kind == "polygon":
        return Polygon(shape.vertices, closed=True, joinstyle="round", **style)
    raise ValueError(f"do not know how to draw a boundary of kind {shape.kind!r}")
