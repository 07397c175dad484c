"""Published experiments and scaling laws beside solver and model.

- ``dam_break``: front of a collapsing column of water, Martin and Moyce 1952 and Koshizuka and Oka 1996, as Z = z/a over T = t √(2g/a) with the width a.
- ``column_collapse``: run-out of columns of sand, Lube et al. 2005: Δl/l = 1.2 a for a < 1.8, otherwise 1.9 a^(2/3), with a the height over the half width l.
- ``droplet``: radius of a viscous drop on a floor, Huppert 1982: r = 0.894 (g V³ / 3ν)^(1/8) t^(1/8).

The first frames of a model are the solver's, because a model needs a history.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import Candidate, tried
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.geometry.body_shapes import JITTER, integer_lattice
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

Experiment = Literal["dam_break", "column_collapse", "droplet"]
DAM_BREAK_FILE = "dam_break_front.csv"
FRONT = 0.98
"""Fraction of the particles within the front, so that single drops and grains do not count."""
DAM_SECONDS, COLUMN_SECONDS, DROP_SECONDS = 0.4, 1.0, 1.0
DAM_WIDTH = 0.25
"""Width of the column of water as a fraction of the domain. Its height is twice the width, as in the experiments."""
NEAR_WALL = 0.9
"""Fraction of the domain up to which fronts are compared."""
HALF_WIDTH, ASPECTS = 6, (1, 2, 3)
"""Half width of columns of sand in spacings, and their ratios of height to half width."""
DROP_RADIUS, DROP_HEIGHT = 4, 4
"""Radius and height of the drop at the start, in spacings."""
SLUMPED = 0.2
"""Fraction of the time before which the radius of the drop is not compared: the law holds when inertia no longer matters."""


class OutsideError(GpeError, ValueError):
    """Raised when a checkpoint was trained on none of the suite's data sets, or a file of the user cannot be read; the message names it."""


@dataclass(frozen=True)
class Curve:
    """Values ``y`` over ``x`` of one series of an experiment."""

    series: str
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class Axes:
    """Labels of the axes of an experiment, and how it differs from the simulated scene."""

    x: str
    y: str
    difference: str


AXES: dict[str, Axes] = {
    "dam_break": Axes(
        "T = t √(2g/a)", "front Z = z/a", "walls without slip and liquid of the lowest trained viscosity; the experiments have water"
    ),
    "column_collapse": Axes(
        "a = height / half width", "run-out Δl/l", "plane columns on a rough floor; the law is a fit to experiments with quartz sand"
    ),
    "droplet": Axes("t [s]", "radius r [m]", "a film of one or two particles at the end; the law is for thin films without inertia"),
}


def compared(experiment: Experiment, candidate: Candidate, folder: Path) -> list[dict[str, Any]]:
    """Return a record per curve of an experiment; none if the model has another material."""
    measure, material = MEASURED[experiment]
    if scenes.material_of(candidate.spec) != material:
        return []
    log.info("%s: %s", experiment, candidate.name)
    return [
        {"experiment": experiment, "model": candidate.name, "series": c.series, "x": c.x.round(6).tolist(), "y": c.y.round(6).tolist()}
        for c in measure(candidate, folder)
    ]


def _dam_break(candidate: Candidate, folder: Path) -> list[Curve]:
    spec, value = candidate.spec, candidate.values[0]
    low, high = np.array(spec.scene.bounds, float).T
    spacing, width = spec.scene.spacing, DAM_WIDTH * (high - low)[0]
    size = [width, *(high - low)[1:-1], 2 * width]
    trial = tried(candidate, value, filled(spec, value, low, np.round(np.array(size) / spacing).astype(int)), DAM_SECONDS)
    curves = measured_fronts(folder / DAM_BREAK_FILE) if (folder / DAM_BREAK_FILE).is_file() else []
    gravity = abs(spec.scene.gravity[-1])
    fronts = {
        series: np.quantile(trajectory.pos[..., 0], FRONT, axis=1) + spacing / 2 - low[0]
        for series, trajectory in (("solver", trial.truth), ("model", trial.model))
    }
    free = int((np.maximum.accumulate(fronts["solver"]) < NEAR_WALL * (high - low)[0]).sum())  # the experiments have no wall there
    times = times_of(trial.truth) * np.sqrt(2 * gravity / width)
    return curves + [Curve(series, times[: len(front)][:free], front[:free] / width) for series, front in fronts.items()]


def measured_fronts(path: Path) -> list[Curve]:
    """Return the measured fronts of a file with the columns ``series``, ``T`` and ``Z``.

    Raises:
        OutsideError: the file is not UTF-8, has other columns or no rows, or a value is no finite number.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            names, *rows = list(csv.reader(file)) or [[]]
    except UnicodeDecodeError as error:
        raise OutsideError(f"{path}: is not UTF-8 ({error.reason} at byte {error.start})") from None
    except csv.Error as error:
        raise OutsideError(f"{path}: is not a table of comma-separated values ({error})") from None
    if wrong := next((name for name in ("series", "T", "Z") if names.count(name) != 1), None):
        raise OutsideError(f"{path}: has {names.count(wrong)} columns {wrong}; expected the columns series, T and Z once each")
    for number, row in enumerate(rows, 2):
        if not row:
            continue
        values = dict(zip(names, row, strict=False))
        try:
            point = float(values["T"]), float(values["Z"])
        except (KeyError, ValueError):
            point = np.nan, np.nan
        if not (np.isfinite(point).all() and values.get("series")):
            raise OutsideError(f"{path}: line {number}: {','.join(row)[:100]!r}: expected a series, and finite numbers T and Z")
        found.setdefault(values["series"], []).append(point)
    if not found:
        raise OutsideError(f"{path}: has no rows")
    return [Curve(series, *np.array(sorted(points)).T) for series, points in found.items()]


def _column_collapse(candidate: Candidate, _: Path) -> list[Curve]:
    spec, aspects = candidate.spec, np.array(ASPECTS, float)
    runs: dict[str, list[float]] = {"solver": [], "model": []}
    middle, half = scenes.middle_of_floor(spec)[0], HALF_WIDTH * spec.scene.spacing
    for aspect in ASPECTS:
        start = scenes.column(spec, candidate.values[1], 2 * HALF_WIDTH, aspect * HALF_WIDTH)
        trial = tried(candidate, candidate.values[1], start, COLUMN_SECONDS)
        for series, trajectory in (("solver", trial.truth), ("model", trial.model)):
            reach = np.quantile(np.abs(trajectory.pos[-1, :, 0] - middle), FRONT) + spec.scene.spacing / 2
            runs[series].append(reach / half - 1 if trajectory.termination is None else np.nan)
    return [
        Curve("Lube et al. 2005", aspects, run_out(aspects)),
        *(Curve(series, aspects, np.array(values)) for series, values in runs.items()),
    ]


def run_out(aspect: np.ndarray) -> np.ndarray:
    """Return the published run-out Δl/l of plane columns with these ratios of height to half width."""
    return np.where(aspect < 1.8, 1.2 * aspect, 1.9 * aspect ** (2 / 3))


def _droplet(candidate: Candidate, _: Path) -> list[Curve]:
    spec, value = candidate.spec, candidate.values[2]
    spacing, floor = spec.scene.spacing, scenes.middle_of_floor(spec)
    lattice = (
        integer_lattice(np.array([-DROP_RADIUS, -DROP_RADIUS, 0]), np.array([DROP_RADIUS - 1, DROP_RADIUS - 1, DROP_HEIGHT - 1])) + 0.5
    )
    lattice = lattice[np.linalg.norm(lattice[:, :2], axis=1) <= DROP_RADIUS]
    pos = floor + spacing * (lattice + np.random.default_rng(0).uniform(-JITTER, JITTER, lattice.shape))
    state = scenes.start(spec, value, pos, np.zeros(3), domain_walls(spec.scene.bounds, spec.scene.friction))  # type: ignore[attr-defined]
    trial = tried(candidate, value, state, DROP_SECONDS)
    volume, gravity = len(pos) * spacing**3, abs(spec.scene.gravity[-1])
    curves = []
    for series, trajectory in (("solver", trial.truth), ("model", trial.model)):
        radius = np.quantile(np.linalg.norm(trajectory.pos[..., :2] - floor[:2], axis=-1), FRONT, axis=1) + spacing / 2
        curves.append(Curve(series, times_of(trajectory), radius))
    times = np.linspace(SLUMPED, 1.0, 20) * DROP_SECONDS
    return [Curve("Huppert 1982", times, drop_radius(times, volume, value, gravity)), *curves]


def drop_radius(times: np.ndarray, volume: float, viscosity: float, gravity: float) -> np.ndarray:
    """Return the published radius [m] of a viscous drop at some times [s], with volume [m³], kinematic viscosity [m²/s] and gravity [m/s²]."""
    return np.asarray(0.894 * (gravity * volume**3 / (3 * viscosity) * times) ** (1 / 8))


MEASURED: dict[str, tuple[Callable[[Candidate, Path], list[Curve]], str]] = {
    "dam_break": (_dam_break, "fluid"),
    "column_collapse": (_column_collapse, "sand"),
    "droplet": (_droplet, "fluid"),
}
"""Function and material of each experiment."""


def filled(spec: DatasetSpec, value: float, low: np.ndarray, counts: np.ndarray, jitter: float = JITTER) -> State:
    """Return particles at rest, up to ``jitter`` spacings from a lattice, in a box of ``counts`` particles per axis at a corner of the domain."""
    lattice = integer_lattice(np.zeros(len(counts), int), counts - 1) + 0.5
    pos = low + spec.scene.spacing * (lattice + np.random.default_rng(0).uniform(-jitter, jitter, lattice.shape))
    walls = domain_walls(spec.scene.bounds, spec.scene.friction)  # type: ignore[attr-defined]
    return scenes.start(spec, value, pos, np.zeros(len(counts)), walls)


def times_of(trajectory: Trajectory) -> np.ndarray:
    """Return the time of each frame [s]."""
    return trajectory.start_time + trajectory.metadata.frame_dt * np.arange(trajectory.num_frames)


# --- report ---------------------------------------------------------------------------------------------------------------------------------


def deviation(own: Curve, reference: Curve) -> tuple[float, int]:
    """Return the mean relative deviation of a curve from the points of a reference within its range, and the number of these points."""
    inside = (reference.x >= own.x.min()) & (reference.x <= own.x.max())
    if not inside.any():
        return float("nan"), 0
    expected = reference.y[inside]
    return float(np.mean(np.abs(np.interp(reference.x[inside], own.x, own.y) - expected) / expected)), int(inside.sum())


def _curves(records: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], list[Curve]]:
    found: dict[tuple[str, str], list[Curve]] = {}
    for r in records:
        if "experiment" in r:
            found.setdefault((r["experiment"], r["model"]), []).append(Curve(r["series"], np.array(r["x"]), np.array(r["y"])))
    return found


def report(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of a table of deviations from the references; none without experiments."""
    curves_of = _curves(records)
    if not curves_of:
        return []
    lines = [table_row(["experiment", "model", "reference", "points", "solver", "model"]), "|" + "---|" * 6]
    for (experiment, model), curves in curves_of.items():
        by_name = {curve.series: curve for curve in curves}
        for reference in [curve for curve in curves if curve.series not in ("solver", "model")]:
            values = [deviation(by_name[series], reference) for series in ("solver", "model")]
            most = values[0][1]
            cells = ["not measured" if np.isnan(value) else f"{100 * value:.1f} %" for value, _ in values]
            if 0 < values[1][1] < most:
                cells[1] += f" (of the {values[1][1]} points before it ended)"
            lines.append(table_row([experiment, model, reference.series, str(most), *cells]))
    lines += [
        "",
        "Mean relative deviation from the points of the reference that the rollout reaches. The model's first frames are the solver's.",
        "",
    ]
    return lines + [
        f"- {experiment}: {axes.difference}." for experiment, axes in AXES.items() if any(experiment == key for key, _ in curves_of)
    ]


def drawn(records: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Draw one figure per experiment and model: experiment or law, solver and model on the same axes."""
    from gpe_pl.viz.film_strip import new_figure

    found = {}
    for (experiment, model), curves in _curves(records).items():
        figure = new_figure(5.2, 3.6)
        figure.set_layout_engine("constrained")
        axes = figure.subplots()
        limit = max((curve.x.max() for curve in curves if curve.series == "solver"), default=np.inf)
        for curve in curves:
            is_run = curve.series in ("solver", "model")
            shown = curve.x <= 1.1 * limit
            style = (
                {"linestyle": "-" if curve.series == "solver" else "--"}
                if is_run
                else {"linestyle": "none", "marker": "o", "markersize": 4}
            )
            if experiment == "column_collapse":
                style |= {"marker": "o"}
            axes.plot(curve.x[shown], curve.y[shown], label=curve.series.replace("_", " "), **style)
        axes.set(xlabel=AXES[experiment].x, ylabel=AXES[experiment].y, title=f"{experiment.replace('_', ' ')}, {model}")
        axes.legend(fontsize="small")
        found[f"{experiment}_{model}"] = figure
    return found
