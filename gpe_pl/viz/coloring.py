"""Meaning of the colours of particles and mesh cells."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.colors import Colormap, LinearSegmentedColormap, ListedColormap, Normalize

from gpe_pl.metrics import displacement
from gpe_pl.schema import BOUNDARY, MATERIALS, node_code
from gpe_pl.trajectory.cells import mean_over_corners
from gpe_pl.trajectory.state import von_mises
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import vertical_axis

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours that colour-blind readers can distinguish (Okabe and Ito, Color universal design, 2008)."""

DASHES = ("-", "--", ":", "-.")
MOST_CURVES = math.lcm(len(PALETTE), len(DASHES))
"""Number of curves in one figure up to which no two have the same colour and line style."""

MATERIAL_COLORS = {"sand": "#E69F00", "snow": "#56B4E9", "fluid": "#0072B2", "elastomer": "#D55E00", "solid": "#009E73"}

REFERENCE = "#7A8B99"
"""Colour of items without a value: ground-truth particles under ``error``, particles without a stress under ``von_mises``, and moving walls."""

ColorBy = Literal["error", "height", "material", "speed", "von_mises"]


def curve_styles(count: int) -> list[tuple[str, str]]:
    """Return colour and line style of every curve. Neighbours differ in both, so that coinciding curves can be told apart.

    Raises:
        ValueError: there are more than ``MOST_CURVES``.
    """
    if count > MOST_CURVES:
        raise ValueError(f"{count} curves, but no more than {MOST_CURVES} can be told apart in one figure")
    return [(PALETTE[k % len(PALETTE)], DASHES[k % len(DASHES)]) for k in range(count)]


def _shortened(name: str, low: float, high: float) -> Colormap:
    """Return the part of a colour map that is visible on white paper."""
    return LinearSegmentedColormap.from_list(f"{name}_shortened", mpl.colormaps[name](np.linspace(low, high, 256)))


COLOR_MAPS: dict[ColorBy, Colormap] = {
    "error": _shortened("inferno", 0.08, 0.9),
    "height": _shortened("viridis", 0.0, 0.95),
    "material": ListedColormap([MATERIAL_COLORS[name] for name in MATERIALS], name="materials"),
    "speed": _shortened("YlGnBu", 0.3, 1.0),
    "von_mises": _shortened("YlOrRd", 0.1, 1.0),
}

BAR_LABELS: dict[ColorBy, str] = {"error": "position error [m]", "speed": "speed [m/s]", "von_mises": "von Mises stress"}
"""Labels of the colours that need a scale."""


def position_error(prediction: Trajectory, truth: Trajectory, frame: int) -> Float[np.ndarray, "node"]:
    """Return the distance [m] of every particle from its position in the ground truth."""
    return np.linalg.norm(displacement(prediction.pos[frame], truth.pos[frame], truth.metadata), axis=-1)


class Coloring:
    """Colours of all trajectories in one figure, on a common scale.

    Args:
        by: quantity. ``error`` is the distance from ``truth``; ``height`` is the height in its first frame, which makes mixing visible; ``material``,
            ``speed`` and ``von_mises`` are named after their quantities.
        trajectories: all trajectories in the figure.
        frames: the frames in the figure.
        truth: ground truth, for ``error``.
        by_node: whether meshes are painted by the values of their nodes, as in the viewer, instead of their cells, as in pictures.

    Attributes:
        scale: range of values from the first to the last colour.
        is_exceeded: whether a painted value is above the end of the scale, whose colour then means that value and all above.

    Raises:
        ValueError: ``von_mises`` if no trajectory has a stress, or ``error`` without ground truth.
    """

    def __init__(
        self, by: ColorBy, trajectories: Sequence[Trajectory], frames: Iterable[int], truth: Trajectory | None = None, by_node: bool = False
    ) -> None:
        if by == "error" and truth is None:
            raise ValueError("colour by error needs the ground truth")
        if by == "von_mises" and all(t.stress is None for t in trajectories):
            raise ValueError("colour by von_mises needs a stress, which no trajectory has")
        self.by, self._truth = by, truth
        self.color_map: Colormap = COLOR_MAPS[by].with_extremes(bad=REFERENCE)
        painted = self._painted(trajectories, [0] if by == "height" else list(frames), by_node)
        self.scale: Normalize = self._scale(painted, trajectories[0].metadata.spacing)
        self.is_exceeded: bool = any(bool((values > self.scale.vmax).any()) for values in painted)

    def _painted(self, trajectories: Sequence[Trajectory], frames: list[int], by_node: bool) -> list[Float[np.ndarray, "value"]]:
        """Return the finite values that are painted, as a group of nodes and one of cells. Only a stress can differ between a cell and its corners."""
        nodes, cells = [np.empty(0)], [np.empty(0)]
        for trajectory in trajectories:
            meshed = trajectory.cells if self.by == "von_mises" and not by_node else None
            loose = np.setdiff1d(np.arange(trajectory.num_nodes), np.empty(0, int) if meshed is None else meshed)
            for frame in (f for f in frames if f < trajectory.num_frames):
                of_nodes, of_cells = self.values(trajectory, frame)
                nodes.append(of_nodes[loose])
                cells.append(of_cells if meshed is not None else np.empty(0))
        return [values[np.isfinite(values)] for values in map(np.concatenate, (nodes, cells))]

    def _scale(self, painted: list[Float[np.ndarray, "value"]], least: float) -> Normalize:
        if self.by == "material":
            return Normalize(-0.5, len(MATERIALS) - 0.5)
        if self.by == "height":
            return Normalize(float(painted[0].min()), float(painted[0].max()))
        # End at the 99th percentile: otherwise a single lost particle would take all contrast from the others. Particles and cells have one each, or a fine
        # mesh would hide the stress of a few particles.
        top = max(float(np.quantile(np.append(values, 0.0), 0.99)) for values in painted)
        return Normalize(0.0, top or max(float(values.max(initial=0.0)) for values in painted) or least)

    @property
    def bar_label(self) -> str | None:
        """Label of the colour bar, or None if the colours need no bar."""
        if self.by == "error" and self._truth is not None and self._truth.is_prediction:
            return "distance from the first rollout [m]"
        return BAR_LABELS.get(self.by)

    @property
    def explanation(self) -> str:
        """What colours mean, if they need neither a bar nor a legend; otherwise empty."""
        return "colour: height at the start" if self.by == "height" else ""

    def values(self, trajectory: Trajectory, frame: int) -> tuple[Float[np.ndarray, "node"], Float[np.ndarray, "cell"]]:
        """Return the values that colour nodes and mesh cells; NaN where there is none."""
        cells = np.empty((0, 1), int) if trajectory.cells is None else trajectory.cells
        unknown = np.full(trajectory.num_nodes, np.nan)
        if self.by == "von_mises":
            if trajectory.stress is None:
                return unknown, np.full(len(cells), np.nan)
            known = np.isin(np.arange(trajectory.num_nodes), cells)
            particles = np.setdiff1d([node_code(m) for m in trajectory.metadata.with_stress], trajectory.node_type[known])
            known |= np.isin(trajectory.node_type, particles)
            nodes = np.where(known, von_mises(trajectory.stress.node[frame]), np.nan)
            return nodes, von_mises(trajectory.stress.cell[frame]).astype(float)
        if self.by == "height":
            first = 0 if trajectory.alive is None else trajectory.alive.argmax(axis=0)  # the frame in which a node enters
            nodes = trajectory.pos[first, np.arange(trajectory.num_nodes), vertical_axis(trajectory)].astype(float)
        elif self.by == "material":
            nodes = trajectory.node_type.astype(float)
        elif self.by == "speed":
            nodes = np.linalg.norm(trajectory.vel[frame].astype(float), axis=-1)
        else:
            assert self._truth is not None
            nodes = unknown if trajectory is self._truth else position_error(trajectory, self._truth, frame)
        nodes = np.where(trajectory.node_type == node_code(BOUNDARY), np.nan, nodes)
        return nodes, mean_over_corners(nodes, cells)

    def __call__(self, trajectory: Trajectory, frame: int) -> tuple[Float[np.ndarray, "node 4"], Float[np.ndarray, "cell 4"]]:
        """Return red, green, blue and opacity of every node and mesh cell."""
        nodes, cells = (self.color_map(self.scale(values)) for values in self.values(trajectory, frame))
        return nodes, cells

    def legend(self, trajectories: Iterable[Trajectory]) -> dict[str, Any]:
        """Return the colour of every material that occurs if colours mean materials; otherwise an empty dictionary."""
        if self.by != "material":
            return {}
        codes = {int(code) for t in trajectories for code in np.unique(t.node_type)}
        return {name: MATERIAL_COLORS[name] for code, name in enumerate(MATERIALS) if code in codes}
