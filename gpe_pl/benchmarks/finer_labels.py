"""Benchmark of finer labels (``data.fine=2``): their distance from a still finer solution, over that of the solver at the spacing of the scene.

The same scenes are solved at their spacing, at half of it and at a quarter. The last solution is the reference. Solutions are compared at the nodes of the
scene, at equal times. Two other choices of tracers are compared with the one of ``solvers.finer_solver``: the mean of the parts into which a particle
was divided, and the start of the node plus the displacement of one part.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, cast

import numpy as np
from pydantic import Field

from gpe_pl.benchmarks.trained import Case
from gpe_pl.data.ground_truth import DatasetSpec, initial_state
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_ratio
from gpe_pl.rollout.loop import SimulationError, steps
from gpe_pl.schema import Split
from gpe_pl.solvers.finer_solver import FinerSolver
from gpe_pl.system.progress import progress_bar
from gpe_pl.system.workers import pool, results
from gpe_pl.trajectory.state import State

REFERENCE = 4
"""Factor by which the reference divides the spacing."""

SAME = 1e-18
"""Mean squared distance [m²] up to which solutions differ only by rounding."""

COARSE, TRACERS = "solver at the spacing of the scene", "tracers at half the spacing (`data.fine=2`)"
MEAN, PART = "mean of the parts", "one of the parts"


class LabelsError(GpeError):
    """Raised when a scene cannot be solved; the message names it."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by label.
        split, num_scenes: split and number of the scenes per data set.
        times: compared times after the start [s], in ascending order. Each is taken at the nearest frame.
        num_workers: number of processes, each of which solves one scene.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    split: Split = "test"
    num_scenes: Annotated[int, Field(ge=1)] = 6
    times: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1)] = field(default_factory=lambda: [0.05, 0.1, 0.2, 0.3])
    num_workers: Annotated[int, Field(ge=1)] = 1

    def __post_init__(self) -> None:
        if any(later <= earlier for earlier, later in pairwise(self.times)):
            raise ValueError(f"times={self.times}: must ascend")


@dataclass(frozen=True)
class Solution:
    """Positions at the compared instants.

    Attributes:
        pos: positions of each choice of tracers [instant, node, dim] in m, by name.
        momentum: mean velocity of the tracers minus mean velocity of all parts, both weighted by mass [instant, dim] in m/s, by name.
        seconds: processor time per simulated second.
    """

    pos: dict[str, np.ndarray]
    momentum: dict[str, np.ndarray]
    seconds: float


def solved(spec: DatasetSpec, start: State, factor: int, frames: Sequence[int]) -> Solution:
    """Solve a scene at ``1 / factor`` of its spacing, and keep the solution at some frames, which must ascend.

    Raises:
        SimulationError: the solver stopped.
    """
    solver, kept = spec.refined(factor), list[State]()
    solver.step(start)  # compiles, and fills caches
    begun = time.process_time()
    for frame, state in enumerate(steps(solver, start, max(frames)), start=1):
        if frame in frames:
            kept.append(state)
    seconds = (time.process_time() - begun) / (max(frames) * spec.solver.frame_dt)
    pos, momentum = {TRACERS: np.stack([state.pos for state in kept])}, dict[str, np.ndarray]()
    if factor > 1 and not getattr(spec.solver, "has_mesh", False):
        count, begun_as = start.num_nodes, cast(FinerSolver, solver).solution(start)
        parts = np.arange(count, begun_as.state.num_nodes).reshape(count, -1)
        begin = begun_as.state.pos
        fine = [state.internal.state for state in kept]
        pos[MEAN] = np.stack([f.pos[parts].mean(axis=1) for f in fine])
        pos[PART] = np.stack([f.pos[parts[:, 0]] - begin[parts[:, 0]] + start.pos for f in fine])
        weight = start.mass[:, None] / start.mass.sum()
        velocities = {TRACERS: [state.vel for state in kept], PART: [f.vel[parts[:, 0]] for f in fine]}
        whole = np.stack([(weight * f.vel[parts].mean(axis=1)).sum(axis=0) for f in fine])
        momentum = {name: np.stack([(weight * v).sum(axis=0) for v in own]) - whole for name, own in velocities.items()}
    return Solution(pos, momentum, seconds)


def scene_records(spec: DatasetSpec, label: str, split: Split, index: int, times: Sequence[float]) -> list[dict[str, Any]]:
    """Return records of one scene: squared distances from the reference [m²], errors of momentum [m/s], and processor time.

    Args:
        spec: data set of the scene.
        label: name of the data set in the records.
        split, index: split and number of the scene.
        times: compared times after the start [s], in ascending order.

    Raises:
        LabelsError: a solver stopped.
    """
    start = initial_state(spec, split, index)
    frames = [max(1, round(t / spec.solver.frame_dt)) for t in times]
    try:
        own, half, reference = (solved(spec, start, factor, frames) for factor in (1, 2, REFERENCE))
    except SimulationError as error:
        raise LabelsError(f"{label}, scene {index} of {split}: {error}") from error
    about = {"case": label, "scene": index}
    records: list[dict[str, Any]] = []
    for name, pos in {COARSE: own.pos[TRACERS], **half.pos}.items():
        squared = np.square(pos - reference.pos[TRACERS]).sum(axis=-1).mean(axis=-1)
        records.append(
            {**about, "metric": "squared_distance", "labels": name, "times": list(times), "values": squared.tolist(), "unit": "m²"}
        )
    for name, difference in half.momentum.items():
        speed = np.linalg.norm(difference, axis=-1)
        records.append({**about, "metric": "momentum", "labels": name, "times": list(times), "values": speed.tolist(), "unit": "m/s"})
    for factor, solution in ((1, own), (2, half), (REFERENCE, reference)):
        records.append({**about, "metric": "seconds", "factor": factor, "values": [solution.seconds], "unit": "1"})
    return records


def run(settings: Settings, specs: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """Return records of each scene, and Markdown tables.

    Raises:
        LabelsError: a solver stopped, or a data set has too few scenes.
    """
    for label, spec in specs.items():
        if spec.counts[settings.split] < settings.num_scenes:
            raise LabelsError(f"suite.cases.{label}: {settings.split} has {spec.counts[settings.split]} scenes; lower suite.num_scenes")
        spec.solver.compile_kernels()
    jobs = [(spec, label, settings.split, index, settings.times) for label, spec in specs.items() for index in range(settings.num_scenes)]
    records: list[dict[str, Any]] = []
    with progress_bar("scenes") as on_progress, pool(settings.num_workers) as executor:
        for done, found in enumerate(results(executor, scene_records, jobs), start=1):
            records += found
            on_progress(done, len(jobs))
    return records, report(records)


def report(records: list[dict[str, Any]]) -> str:
    """Return the tables: ratios of distances with the cost, distances of all choices of tracers, and errors of momentum."""
    cases = list(dict.fromkeys(r["case"] for r in records))
    times = next(r["times"] for r in records if r["metric"] == "squared_distance")
    num_scenes = len({(r["case"], r["scene"]) for r in records}) // len(cases)
    header = ["", "labels", *(f"{t:g} s" for t in times)]
    distances = [table_row(header), "|" + "---|" * len(header)]
    ratios = [table_row(["", *header[2:], "seconds per simulated second, at spacing × 1", "× 1/2", "× 1/4"])]
    ratios.append("|" + "---|" * (len(times) + 4))
    noise = [table_row(header), "|" + "---|" * len(header)]
    for case in cases:
        squared = _values(records, case, "squared_distance")
        distances += [table_row([case, name, *(f"{1e3 * np.sqrt(v):.3g}" for v in own.mean(axis=0))]) for name, own in squared.items()]
        cells = []
        for k in range(len(times)):
            far, near = squared[COARSE][:, k][None], squared[TRACERS][:, k][None]
            if near.max() < SAME and far.max() < SAME:
                cells.append("both in free flight")
                continue
            ratio = bootstrap_ratio(near, far, statistic=np.mean)
            cells.append("{:.2f} [{:.2f}, {:.2f}]".format(*np.sqrt([ratio.estimate, ratio.low, ratio.high])))
        seconds = [np.median([r["values"][0] for r in records if r["case"] == case and r.get("factor") == k]) for k in (1, 2, REFERENCE)]
        ratios.append(table_row([case, *cells, *(f"{s:.2g}" for s in seconds)]))
        momentum = _values(records, case, "momentum")
        noise += [
            table_row([case, name, *(f"{1e3 * np.sqrt(np.square(own[:, k]).mean()):.2g}" for k in range(len(times)))])
            for name, own in momentum.items()
        ]
    about = (
        f"{num_scenes} scenes per data set. The reference divides the spacing by {REFERENCE}. Distances are root mean squares over nodes and scenes [mm], at "
        "times after the start. If errors halved with the spacing, the ratio of the first table would be 0.33."
    )
    return "\n".join(
        [
            *(about, "", "**Distance of tracers at half the spacing, over that of the solver at the spacing of the scene**", ""),
            *ratios,
            *(
                "",
                "Ratios of root mean squares, with 95 % intervals over scenes. Processor time on one core.",
                "",
                "**Distances from the reference [mm]**",
                "",
            ),
            *distances,
            *("", "**Momentum of tracers, less that of all parts, over the mass of the scene [mm/s]**, root mean square over scenes", ""),
            *noise,
        ]
    )


def _values(records: list[dict[str, Any]], case: str, metric: str) -> dict[str, np.ndarray]:
    """Return the values of a metric [scene, instant] by choice of tracers."""
    found: dict[str, list[list[float]]] = {}
    for r in records:
        if r["case"] == case and r["metric"] == metric:
            found.setdefault(r["labels"], []).append(r["values"])
    return {name: np.array(values) for name, values in found.items()}
