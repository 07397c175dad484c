"""An HTML viewer: one file that plays a rollout beside the ground truth, without server, network or installation.

The page draws with WebGL 2; its parts are in ``page/``. It stores arrays as base64 of zlib. Positions are rounded to 16 bits per axis over the region where
nodes are shown::

    x = low + step q,   q = 0 … 65534,   |rounding| ≤ step / 2

In a domain of 1 m the rounding is 8 µm; the page states it. Speed and stress have 16 bits as well. The colours of errors follow from the positions.
"""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from matplotlib.colors import to_rgb

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_text
from gpe_pl.geometry.shapes import Bowl, signed_distance
from gpe_pl.schema import BOUNDARY, NODE_TYPES, node_code
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.camera import AZIMUTH, ELEVATION, vertical_axis
from gpe_pl.viz.captions import SHOWN_OUTSIDE, frame_time, heading, hidden_nodes, in_common, pictured, time_decimals, with_heading
from gpe_pl.viz.coloring import MATERIAL_COLORS, REFERENCE, ColorBy, Coloring, position_error
from gpe_pl.viz.contact_sheet import informative_color
from gpe_pl.viz.panel import DOT, drawn_faces, outline, polygon_edges
from gpe_pl.viz.scenery import BACKDROP, loose_nodes, surface_points

PAGE = Path(__file__).parent / "page"

LEVELS = 65535
"""Number of 16-bit integers that encode the values of a quantity. One further integer means that there is no value."""

FASTEST = 50.0
"""Largest stored speed or stress, as a multiple of the end of its colour scale, so that an exploded value does not use up all levels."""

UNITS: dict[ColorBy, tuple[str, str]] = {
    "height": ("height at the start", "m"),
    "material": ("material", ""),
    "speed": ("speed", "m/s"),
    "von_mises": ("von Mises stress", "Pa"),
}
"""Name and unit of each quantity that colours show."""

SOLID_GRID = 512
"""Number of points along the longer side of a 2D scene at which the signed distance of obstacles is sampled."""
SOLID_CELLS = 4
"""Largest signed distance that is stored, in cells of this grid."""


class ViewerError(GpeError, ValueError):
    """Raised when trajectories do not show the same scene."""


def write_viewer(
    path: Path | str,
    ground_truth: Trajectory,
    predictions: Mapping[str, Trajectory] | None = None,
    stride: int = 1,
    title: str | None = None,
) -> float:
    """Write a page with ground truth, prediction and error side by side; the file appears complete or not at all.

    Args:
        path: file that ends in ``.html``.
        ground_truth: first trajectory, which sets the length. If it is a prediction, its panel is called ``prediction``.
        predictions: rollouts of the same frames, by name; the page shows one at a time. Without predictions it shows the ground truth alone.
        stride: step between shown frames.
        title: title of the page; by default data set and split.

    Returns:
        The largest rounding of a shown position [m]. Nodes further outside the domain than its size are not shown; panels say how many nodes are outside
        the domain or have no position.

    Raises:
        ViewerError: a prediction has other nodes than the ground truth.
        ValueError: the file type is wrong, the stride is not positive, or a prediction has the name of the first panel.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(f"{path}: a viewer ends in .html")
    page, rounding = viewer_page(ground_truth, predictions, stride, title)
    replace_text(path, page)
    return rounding


def viewer_page(
    ground_truth: Trajectory, predictions: Mapping[str, Trajectory] | None = None, stride: int = 1, title: str | None = None
) -> tuple[str, float]:
    """Return the page that ``write_viewer`` writes, as HTML, and the largest rounding of a shown position [m]; arguments and errors as there."""
    if stride < 1:
        raise ValueError(f"stride must be positive, got {stride}")
    trajectories = {name: t.with_nodes_of(ground_truth) for name, t in with_heading(ground_truth, predictions or {}).items()}
    for name, trajectory in trajectories.items():
        if not np.array_equal(trajectory.node_type, ground_truth.node_type):
            raise ViewerError(
                f"{name!r} has {trajectory.num_nodes} nodes and the {heading(ground_truth)} {ground_truth.num_nodes}, or their materials differ; "
                "give rollouts of the same scene"
            )
    about = ground_truth.metadata
    title = title or " ".join(word for word in (about.dataset, about.split) if word)
    scene, arrays = _scene(pictured(ground_truth, predictions or {}), stride)
    parts = {
        "title": html.escape(title),
        "contents": html.escape(", ".join(trajectories)),
        "materials": html.escape(in_common([*trajectories.values()])),
        "apart": scene["apart"]["name"],
        "style": (PAGE / "viewer.css").read_text(encoding="utf-8"),
        "arrays": "\n".join(_element(name, *value) for name, value in arrays.items()),
        "scene": json.dumps(scene, allow_nan=False).replace("<", "\\u003c"),
        "script": "\n".join((PAGE / name).read_text(encoding="utf-8") for name in ("data.js", "render.js", "viewer.js")),
    }
    page = re.sub(r"\{\{(\w+)\}\}", lambda slot: parts[slot[1]], (PAGE / "viewer.html").read_text(encoding="utf-8"))
    return page, float(scene["rounding"])


Arrays = dict[str, tuple[str, np.ndarray]]
"""Arrays of a page by name: kind (``frames`` of 16 bits, or a NumPy type) and values."""


def _scene(trajectories: dict[str, Trajectory], stride: int) -> tuple[dict[str, Any], Arrays]:
    """Return the content of the page as plain values and arrays."""
    first, truth = next(iter(trajectories.items()))
    about = truth.metadata
    frames = range(0, truth.num_frames, stride)
    shown = {name: _inside(t.frames(0, truth.num_frames)) for name, t in trajectories.items()}
    raster = Raster.of([t.pos[::stride] for t in shown.values()], np.asarray(about.bounds, float))
    colorings = {by: Coloring(by, [*shown.values()], frames, shown[first], by_node=True) for by in _colors(shown)}
    largest = {by: _largest(by, colorings[by], shown, frames) for by in ("speed", "von_mises") if by in colorings}
    tops = {by: float(min(value, FASTEST * colorings[by].scale.vmax)) or 1.0 for by, value in largest.items()}  # type: ignore[operator]
    steps = {by: top / (LEVELS - 1) for by, top in tops.items()}
    codes = np.unique(truth.node_type).tolist()
    vertical = vertical_axis(truth)
    apart = (
        {"title": "distance", "name": "distance from the first rollout"}
        if truth.is_prediction
        else {"title": "error", "name": "position error"}
    )
    scene = {
        "dim": about.dim,
        "nodes": truth.num_nodes,
        "stride": stride,
        "startTime": truth.start_time,
        "frameInterval": stride * about.frame_dt,
        "decimals": time_decimals(about.frame_dt),
        "spacing": about.spacing,
        "diameter": DOT * about.spacing,
        "periods": [high - low if periodic else 0.0 for (low, high), periodic in zip(about.bounds, about.periodic, strict=True)],
        "position": {"low": _in_3d(raster.low), "extent": _in_3d(LEVELS * raster.step)},
        "rounding": float(raster.step.max() / 2),
        "order": np.roll(np.arange(3), 2 - vertical).tolist(),  # as ``Camera``: right-handed, with the vertical last
        "azimuth": AZIMUTH,
        "elevation": ELEVATION,
        "neutral": to_rgb(REFERENCE),
        "materials": [{"name": NODE_TYPES[code], "color": MATERIAL_COLORS.get(NODE_TYPES[code], REFERENCE)} for code in codes],
        "nodeMaterials": list(NODE_TYPES),
        "colors": [_color(by, coloring, apart["name"]) for by, coloring in colorings.items()],
        "apart": apart,
        "steps": steps,
        "cut": [by for by, top in tops.items() if top < largest[by]],
        "trajectories": [],
        **_focus(truth),
    }
    arrays: Arrays = {f"map_{by}": ("uint8", _color_map(coloring)) for by, coloring in colorings.items()}
    for by in ("height", "material"):
        arrays[f"all_{by}"] = ("float32", colorings[by].values(shown[first], 0)[0])  # type: ignore[index]
    for number, (name, trajectory) in enumerate(shown.items()):
        kept = [frame for frame in frames if frame < trajectory.num_frames]
        fields = {"pos": raster(trajectory.pos[kept])}
        for by, step in steps.items():
            if by != "von_mises" or trajectory.stress is not None:
                fields[by] = _levels(np.stack([colorings[by].values(trajectory, frame)[0] for frame in kept]), step)
        arrays |= {f"t{number}_{field}": ("frames", values) for field, values in fields.items()}
        stop = trajectory.termination
        scene["trajectories"].append(
            {
                "id": f"t{number}",
                "name": name,
                "frames": len(kept),
                "fields": [*fields],
                "notes": [", ".join(hidden_nodes(trajectory, frame)) for frame in kept],
                "stopped": "not simulated" if stop is None else f"stopped at {frame_time(stop.frame, truth)} ({stop.reason})",
                "rmse": None if number == 0 else _rmse(trajectory, shown[first], frames),
            }
        )
    arrays |= {name: ("uint32", values) for name, values in _mesh(truth).items()}
    if about.dim == 2:
        solid, scenery = _scenery_2d(truth)
        scene |= solid
    else:
        scenery = _scenery_3d(truth)
    return scene, arrays | scenery


def _inside(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with all nodes wrapped into the domain along its periodic axes."""
    return replace(trajectory, pos=trajectory.metadata.periodicity.wrapped(trajectory.pos))


def _colors(trajectories: Mapping[str, Trajectory]) -> list[ColorBy]:
    """Return the quantities that can colour nodes, the most informative first."""
    shown = [*trajectories.values()]
    colors: list[ColorBy] = ["height", "speed", "material"]
    if any(trajectory.stress is not None for trajectory in shown):
        colors.append("von_mises")
    if len(shown) > 1:
        colors.append("error")
    return sorted(colors, key=lambda by: by != informative_color(shown))


@dataclass(frozen=True)
class Raster:
    """Encoding of positions as 16-bit integers.

    Attributes:
        low: low corner of the region that is shown [dim] in m.
        step: difference of neighbouring values [dim] in m.
    """

    low: Float[np.ndarray, " dim"]
    step: Float[np.ndarray, " dim"]

    @classmethod
    def of(cls, positions: Sequence[Float[np.ndarray, "_ node dim"]], bounds: Float[np.ndarray, "dim 2"]) -> Raster:
        """Return the raster of the smallest region that contains the domain, and all nodes outside that are no further away than its longest side."""
        low, high = bounds.T.copy()
        size = float(np.max(high - low))
        for pos in positions:
            for axis, values in enumerate(np.moveaxis(pos, -1, 0)):
                near = values[(values >= bounds[axis, 0] - size) & (values <= bounds[axis, 1] + size)]  # NaN compares as false
                if near.size:
                    low[axis], high[axis] = min(low[axis], float(near.min())), max(high[axis], float(near.max()))
        return cls(low, (high - low) / (LEVELS - 1))

    def __call__(self, pos: Float[np.ndarray, "frame node dim"]) -> UInt16[np.ndarray, "frame node dim"]:
        """Return rounded positions; all axes of a node outside the region have the value 65535."""
        with np.errstate(invalid="ignore"):
            level = np.round((pos - self.low) / self.step)
            outside = ~((level >= 0) & (level < LEVELS)).all(axis=-1)
        return np.where(outside[..., None], LEVELS, np.nan_to_num(level)).astype(np.uint16)


def _largest(by: ColorBy, coloring: Coloring, trajectories: Mapping[str, Trajectory], frames: Sequence[int]) -> float:
    """Return the largest finite value of a quantity in all frames."""
    values = [coloring.values(t, f)[0] for t in trajectories.values() for f in frames if f < t.num_frames]
    return float(max(v[np.isfinite(v)].max(initial=0.0) for v in values))


def _levels(values: Float[np.ndarray, "frame node"], step: float) -> UInt16[np.ndarray, "frame node"]:
    """Encode a quantity in 16 bits; 65535 stands for no value."""
    known = np.isfinite(values)
    return np.where(known, np.clip(np.round(np.where(known, values, 0.0) / step), 0, LEVELS - 1), LEVELS).astype(np.uint16)


def _rmse(prediction: Trajectory, truth: Trajectory, frames: Sequence[int]) -> list[float | None]:
    """Return the root mean square of the position error [m] in each frame over the nodes that both have, or None if there are none."""
    free = truth.node_type != node_code(BOUNDARY)
    errors = [position_error(prediction, truth, frame)[free] if frame < prediction.num_frames else np.empty(0) for frame in frames]
    known = [error[np.isfinite(error)] for error in errors]
    return [float(np.sqrt(np.mean(error**2))) if len(error) else None for error in known]


def _color(by: ColorBy, coloring: Coloring, apart: str) -> dict[str, Any]:
    """Return the name and scale of a colouring; ``apart`` names the distance between two trajectories."""
    name, unit = UNITS.get(by, (apart, "m"))
    low, high = coloring.scale.vmin, coloring.scale.vmax
    return {"by": by, "name": name, "label": name, "unit": unit, "low": low, "high": high, "isExceeded": coloring.is_exceeded}


def _color_map(coloring: Coloring) -> np.ndarray:
    return np.round(255 * coloring.color_map(np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)


def _in_3d(values: np.ndarray) -> list[float]:
    return [*map(float, values), *[0.0] * (3 - len(values))]


def _focus(trajectory: Trajectory) -> dict[str, Any]:
    """Return the part of the scene that fills a panel, whether it is a bowl, and a distance from its middle that no shown node exceeds [m]."""
    low, high = np.asarray(trajectory.metadata.bounds, float).T
    bowls = [shape for shape in trajectory.boundary.shapes if isinstance(shape, Bowl)]
    if bowls:
        center, radius = np.asarray(bowls[0].center, float), bowls[0].radius
        low, high = np.maximum(low, center - radius), np.minimum(high, center + radius)
    margin = SHOWN_OUTSIDE * trajectory.metadata.spacing
    low, high = low - margin, high + margin
    bounds = np.asarray(trajectory.metadata.bounds, float)
    return {
        "focus": {"low": _in_3d(low), "high": _in_3d(high)},
        "round": bool(bowls),
        "depth": 4.0 * float(np.linalg.norm(np.ptp(bounds, axis=1))),
    }


def _mesh(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return triangles and edges of meshes, outlines of 2D meshes, and the nodes outside meshes."""
    faces, _ = drawn_faces(trajectory)
    meshed = np.empty(0, int) if trajectory.cells is None or len(faces) == 0 else trajectory.cells
    fans = [faces[:, [0, k, k + 1]] for k in range(1, faces.shape[1] - 1)]
    triangles = np.concatenate([np.empty((0, 3), int), *fans])
    return {
        "triangles": triangles[triangles[:, 1] != triangles[:, 2]],  # a triangle in a mesh of quadrilaterals repeats its last corner
        "edges": np.unique(np.sort(polygon_edges(faces), axis=1), axis=0),
        "outline": outline(trajectory),
        "loose": np.setdiff1d(np.arange(trajectory.num_nodes), meshed),
    }


INK_RGB, SEAM_RGB = (0.15, 0.15, 0.15), (0.7, 0.7, 0.7)


def _scenery_2d(trajectory: Trajectory) -> tuple[dict[str, Any], Arrays]:
    """Return walls as lines, and all solids as one picture of their signed distance."""
    shapes: tuple[Any, ...] = trajectory.boundary.shapes
    walls, solids = [s for s in shapes if s.kind == "wall"], tuple(s for s in shapes if s.kind != "wall")
    lines = []
    for wall in walls:
        axis = int(np.argmax(np.abs(wall.normal)))
        ends = np.array([wall.low, wall.high], float)
        ends[:, axis] = wall.offset * wall.normal[axis]
        lines += [(*end, 0.0, 0.0, 0.0, 0.0, *INK_RGB) for end in ends]
    arm = 0.25 * trajectory.metadata.spacing
    for x, y in loose_nodes(trajectory):  # a cross for each
        for dx, dy in ((arm, 0.0), (0.0, arm)):
            lines += [(x + sign * dx, y + sign * dy, 0.0, 0.0, 0.0, 0.0, *INK_RGB) for sign in (-1, 1)]
    low, high = np.asarray(trajectory.metadata.bounds, float).T
    for axis in trajectory.metadata.periodicity.axes:  # where space repeats
        for side in (low, high):
            ends = np.array([low, high])
            ends[:, axis] = side[axis]
            lines += [(*end, 0.0, 0.0, 0.0, 0.0, *SEAM_RGB) for end in ends]
    arrays: Arrays = {"lines": ("float32", np.array(lines))}
    if not solids:
        return {}, arrays
    bounds = np.asarray(trajectory.metadata.bounds, float)
    cell = np.ptp(bounds, axis=1).max() / (SOLID_GRID - 1)
    x, y = (np.linspace(low, high, max(2, round((high - low) / cell) + 1)) for low, high in bounds)
    distance = signed_distance(solids, np.stack(np.meshgrid(x, y), axis=-1))
    unit = 2 * SOLID_CELLS * cell
    arrays["solid"] = ("uint8", np.clip(np.round(distance / unit * 255) + 128, 0, 255))
    return {"solid": {"width": len(x), "height": len(y), "low": low.tolist(), "high": high.tolist(), "unit": unit}}, arrays


def _scenery_3d(trajectory: Trajectory) -> Arrays:
    """Return walls and boxes as triangles, and every other surface as discs; each is visible from its free side."""
    bounds, spacing = np.asarray(trajectory.metadata.bounds, float), trajectory.metadata.spacing
    shapes: tuple[Any, ...] = trajectory.boundary.shapes
    bowls = [s for s in shapes if s.kind == "bowl"]
    flats, lines = [], []
    for wall in [] if bowls else [s for s in shapes if s.kind == "wall"]:  # a bowl hides the walls around it
        axis = int(np.argmax(np.abs(wall.normal)))
        corners = _face(wall.low, wall.high, axis, wall.offset * wall.normal[axis])
        flats += _facet(corners, wall.normal, float(BACKDROP))
        lines += [(*p, *wall.normal, 0.6, 0.6, 0.6) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True) for p in (a, b)]
    for box in (s for s in shapes if s.kind == "box"):
        for axis in range(3):
            for side, value in ((-1.0, box.low[axis]), (1.0, box.high[axis])):
                grey = 0.72 + 0.18 * (axis == vertical_axis(trajectory)) + 0.08 * (axis == 1)
                flats += _facet(_face(box.low, box.high, axis, value), side * np.eye(3)[axis], grey)
    pos, normal, gap = surface_points(trajectory.boundary, spacing)
    kept = signed_distance(tuple(s for s in shapes if s.kind == "wall"), pos) > 1e-6 * spacing
    length = np.linalg.norm(normal, axis=1)
    kept &= length > 0
    surface = np.column_stack([pos, normal / np.maximum(length, 1e-12)[:, None], 0.85 * gap])[kept]
    if not shapes:
        low, high = bounds.T
        for axis in range(3):
            for value in bounds[axis]:
                corners = _face(low.tolist(), high.tolist(), axis, float(value))
                lines += [(*p, 0, 0, 0, 0.8, 0.8, 0.8) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True) for p in (a, b)]
    return {name: ("float32", np.array(values, float)) for name, values in (("flats", flats), ("lines", lines), ("surface", surface))}


def _face(low: Sequence[float], high: Sequence[float], axis: int, value: float) -> Float[np.ndarray, "4 3"]:
    """Return the corners of the face of a box on which a coordinate has this value, in order."""
    first, second = (k for k in range(3) if k != axis)
    corners = np.full((4, 3), value)
    corners[:, first] = np.take([low[first], high[first]], [0, 1, 1, 0])
    corners[:, second] = np.take([low[second], high[second]], [0, 0, 1, 1])
    return corners


def _facet(corners: Float[np.ndarray, "4 3"], normal: Any, grey: float) -> list[tuple[float, ...]]:
    """Return two triangles, as vertices with normal and colour."""
    return [(*corners[k], *normal, grey, grey, grey) for k in (0, 1, 2, 0, 2, 3)]


def _element(name: str, kind: str, values: np.ndarray) -> str:
    """Return an array as an element of the page: little-endian, compressed, in base64."""
    width = 0
    if kind == "frames":
        # Store differences between frames, all low bytes before all high bytes: they are small and compress best this way.
        width = int(np.prod(values.shape[1:]))
        flat = values.reshape(len(values), width)
        change = np.concatenate([flat[:1], np.diff(flat, axis=0)])  # modulo 2^16
        data = change.astype("<u2").reshape(-1, 1).view(np.uint8).T.tobytes()
    else:
        data = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()
    text = base64.b64encode(zlib.compress(data, 6)).decode("ascii")
    return f'<script type="application/octet-stream" data-name="{name}" data-kind="{kind}" data-width="{width}">{text}</script>'
