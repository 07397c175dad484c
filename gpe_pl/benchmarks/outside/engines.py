"""The same scene by another engine, by the solver of a data set and by a model.

- ``calculix``: a block of a solid that falls on a floor.
- ``splishsplash``: a column of liquid that collapses in a box.
- ``kratos``: a column of sand that collapses on a rough floor.

Solver and engine start from the same state. The first frames of the model are the solver's, because a model needs a history.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import Candidate, predicted
from gpe_pl.benchmarks.outside import calculix, kratos, splishsplash
from gpe_pl.benchmarks.outside.engine import Motion
from gpe_pl.benchmarks.outside.experiments import DAM_WIDTH, FRONT, HALF_WIDTH, filled
from gpe_pl.files.markdown import table_row
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

EngineName = Literal["calculix", "splishsplash", "kratos"]
DROP_GAP, DROP_SPEED, DROP_SECONDS = 0.05, 1.0, 0.2
"""Gap between the block and the floor [m], speed at the start [m/s], and duration [s]."""
DAM_SECONDS = 0.3
"""Duration of the collapse of a column of liquid [s]. The liquid does not reach the opposite wall."""
COLUMN_ASPECT, COLUMN_SECONDS = 2, 0.4
"""Height of the column of sand over its half width, and duration of the collapse [s]."""

APART = "distance of nodes from the engine's"
"""Quantity of scenes with material points: 0 for the engine itself."""
POINTS = 40
"""About the number of frames that a record has, evenly spread."""
COLUMNS = 4
"""Panels of a figure side by side."""

Quantities = dict[str, Callable[[np.ndarray, Candidate], np.ndarray]]
"""Lengths over time [frame] in m by name, from positions [frame, node, dim]."""


def _centre(axis: int) -> Callable[[np.ndarray, Candidate], np.ndarray]:
    return lambda pos, candidate: pos[..., axis].mean(axis=1) - candidate.spec.scene.bounds[axis][0]


def _front(pos: np.ndarray, candidate: Candidate) -> np.ndarray:
    return np.quantile(pos[..., 0], FRONT, axis=1) + candidate.spacing / 2 - candidate.spec.scene.bounds[0][0]


def _run_out(pos: np.ndarray, candidate: Candidate) -> np.ndarray:
    return np.quantile(np.abs(pos[..., 0] - scenes.middle_of_floor(candidate.spec)[0]), FRONT, axis=1) + candidate.spacing / 2


@dataclass(frozen=True)
class EngineScene:
    """A scene that an engine can run.

    Attributes:
        label: name of the engine.
        remedy: how to get it.
        is_missing: tells whether it is not there.
        material: material of the scene.
        about: the scene in words.
        start: initial state for a model, by its material parameter.
        run: what the engine does, from the initial state and the number of frames.
        seconds: duration of the scene [s].
        quantities: what is compared.
        points: whether the nodes are the same material points over the whole scene, so that their distance is compared too.
        difference: how the engine's scene differs from the solver's.
    """

    label: str
    remedy: str
    is_missing: Callable[[], bool]
    material: str
    about: str
    start: Callable[[Candidate, float], State]
    run: Callable[[Candidate, State, int], Motion]
    seconds: float
    quantities: Quantities
    points: bool
    difference: str


def _block(candidate: Candidate, value: float) -> State:
    return scenes.dropped_block(candidate.spec, value, 10, 8, DROP_GAP, DROP_SPEED)


def _by_calculix(candidate: Candidate, state: State, num_frames: int) -> Motion:
    solver: Any = candidate.spec.solver
    return calculix.run(state, solver, num_frames)


def _dam(candidate: Candidate, value: float) -> State:
    spec = candidate.spec
    low, high = np.array(spec.scene.bounds, float).T
    width = DAM_WIDTH * (high - low)[0]
    size = np.array([width, *(high - low)[1:-1], 2 * width])
    return filled(spec, value, low, np.round(size / spec.scene.spacing).astype(int), jitter=0.0)


def _by_splishsplash(candidate: Candidate, state: State, num_frames: int) -> Motion:
    scene = candidate.spec.scene
    return Motion(splishsplash.run(state, scene.bounds, scene.spacing, candidate.spec.solver.frame_dt, num_frames))


def _column(candidate: Candidate, value: float) -> State:
    return scenes.column(candidate.spec, value, 2 * HALF_WIDTH, COLUMN_ASPECT * HALF_WIDTH)


def _by_kratos(candidate: Candidate, state: State, num_frames: int) -> Motion:
    scene, solver = candidate.spec.scene, candidate.spec.solver
    constants: Any = solver
    return Motion(kratos.run(state, constants.constants_of("sand"), scene.bounds, scene.spacing, solver.frame_dt, num_frames))


SCENES: dict[str, EngineScene] = {
    "calculix": EngineScene(
        "CalculiX", "apt install calculix-ccx (Debian, Ubuntu), or the program ccx from calculix.de on the path", calculix.is_missing, "solid",
        "a block of 10 × 8 squares falls on a floor", _block, _by_calculix, DROP_SECONDS,
        {"height of the centre": _centre(1)}, True,
        "implicit time steps, contact by penalty and consistent masses; ours has explicit steps, inelastic contact of nodes and lumped masses",
    ),
    "splishsplash": EngineScene(
        "SPlisHSPlasH", "pip install pySPlisHSPlasH", splishsplash.is_missing, "fluid",
        "a column of liquid collapses in a box", _dam, _by_splishsplash, DAM_SECONDS,
        {"front": _front, "height of the centre": _centre(2)}, False,
        "particles interact over two spacings without a grid, and walls are particles; ours has a grid of two spacings",
    ),
    "kratos": EngineScene(
        "Kratos MPM", "pip install KratosMPMApplication", kratos.is_missing, "sand",
        "a column of sand collapses on a rough floor", _column, _by_kratos, COLUMN_SECONDS,
        {"half width": _run_out, "height of the centre": _centre(1)}, True,
        "Mohr–Coulomb plasticity without dilatancy, implicit steps and a bilinear grid of two spacings; ours has Drucker–Prager plasticity, explicit steps and "
        "a quadratic grid of one spacing",
    ),
}  # fmt: skip
"""Scenes by the names of their engines."""


def compared(name: str, candidate: Candidate) -> list[dict[str, Any]]:
    """Return a record per quantity of the scene of an engine; none if the model has another material.

    A record has the values of ``engine``, ``solver`` and ``model`` over time. Those of a model that stopped early are shorter.

    Raises:
        EngineError: the engine failed.
    """
    scene = SCENES[name]
    if scenes.material_of(candidate.spec) != scene.material:
        return []
    records = []
    for value in candidate.values[::2] if scene.material == "fluid" else candidate.values[1:2]:
        log.info("%s: %s", scene.label, candidate.described(value))
        start, solver = scene.start(candidate, value), candidate.spec.solver
        history = candidate.simulator.builder.config.history
        count = history + max(2, round(scene.seconds / solver.frame_dt))
        whole = rollout(solver, start, count, candidate.metadata())
        model, _ = predicted(candidate, candidate.simulator.initial_state(whole, history), whole.frames(history))
        by = {"engine": scene.run(candidate, start, count + 1).pos[history:], "solver": whole.pos[history:], "model": model.pos}
        every = max(1, len(by["solver"]) // POINTS)
        times = solver.frame_dt * (history + np.arange(len(by["solver"])))[::every]
        about = {"engine_name": name, "model": candidate.name, "parameter": candidate.described(value), "spacing": candidate.spacing}
        about |= {"x": times.round(4).tolist()}
        for quantity, function in scene.quantities.items():
            records.append(about | {"quantity": quantity} | {key: _listed(function(pos, candidate)[::every]) for key, pos in by.items()})
        if scene.points:
            engine = by["engine"]
            apart = {key: np.linalg.norm(by[key] - engine[: len(by[key])], axis=-1).mean(axis=1)[::every] for key in ("solver", "model")}
            nothing = [0.0] * len(times)
            records.append(about | {"quantity": APART, "engine": nothing} | {key: _listed(values) for key, values in apart.items()})
    return records


def _listed(values: np.ndarray) -> list[float]:
    return np.asarray(values).round(5).tolist()


def difference(own: Sequence[float], other: Sequence[float], spacing: float) -> float:
    """Return the mean difference of two curves over the frames of the shorter one, in spacings."""
    count = min(len(own), len(other))
    return float(np.mean(np.abs(np.array(own[:count]) - np.array(other[:count])))) / spacing


def report(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of a table of differences; none without engines."""
    of_engines = [record for record in records if "quantity" in record]
    if not of_engines:
        return []
    names = ["engine", "material", "quantity", "range [spacings]", "solver − engine", "model − engine", "model − solver"]
    lines = [table_row(names), "|" + "---|" * len(names)]
    for r in of_engines:
        spacing, whole = r["spacing"], len(r["model"]) == len(r["engine"])
        spread = max(r["engine"]) - min(r["engine"])
        model = [f"{difference(r['model'], r[key], spacing):.2f}" + ("" if whole else " until it stopped") for key in ("engine", "solver")]
        is_apart = spread == 0
        solver = f"{difference(r['solver'], r['engine'], spacing):.2f}"
        cells = [
            SCENES[r["engine_name"]].label,
            r["parameter"],
            r["quantity"],
            "" if is_apart else f"{spread / spacing:.1f}",
            solver,
            model[0],
        ]
        lines.append(table_row([*cells, "" if is_apart else model[1]]))
    lines += ["", "Mean difference over the frames, in spacings. The model's first frames are the solver's.", ""]
    return lines + [
        f"- {s.label}: {s.about}. {s.difference}." for name, s in SCENES.items() if any(r["engine_name"] == name for r in of_engines)
    ]


def drawn(records: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Draw one figure: engine, solver and model over time, one panel per quantity and parameter. Nothing is drawn without engines."""
    from gpe_pl.viz.film_strip import new_figure

    panels = [r for r in records if "quantity" in r and max(r["engine"]) > 0]
    if not panels:
        return {}
    rows = math.ceil(len(panels) / COLUMNS)
    figure = new_figure(1.8 * COLUMNS, 1.8 * rows)
    figure.set_layout_engine("constrained")
    grid = np.ravel(figure.subplots(rows, COLUMNS, squeeze=False))
    for axes, r in zip(grid, panels, strict=False):
        label = SCENES[r["engine_name"]].label
        for key, style in (("engine", ":"), ("solver", "-"), ("model", "--")):
            axes.plot(r["x"][: len(r[key])], r[key], style, label=label if key == "engine" else key)
        axes.set_title(f"{r['parameter']}\n{r['quantity']} [m]", fontsize="xx-small")
        axes.tick_params(labelsize="xx-small")
        axes.set_xlabel("t [s]", fontsize="xx-small")
        axes.legend(fontsize="xx-small")
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    return {"engines": figure}
