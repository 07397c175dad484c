"""Benchmark that tells whether the package has become slower.

It has seven cases: a rollout step of each of the five shipped models, a rollout step of several scenes together, and a training step. The time of each is
divided by the time that its matrix products take on this machine, because such ratios differ less between machines than times do. A ratio that is at least
``GROWN`` times the earlier one in ``docs/results/performance`` is reported.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated, Any, cast

import torch
from pydantic import Field

from gpe_pl.benchmarks.matrix_products import products
from gpe_pl.benchmarks.step_ratio import FRAME, NUM_STEPS, StepError
from gpe_pl.benchmarks.trained import Case
from gpe_pl.benchmarks.training_step_ratio import training_records
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.errors import GpeError
from gpe_pl.files.json_text import parsed
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Start, rollouts
from gpe_pl.system.machine import gemm_rate
from gpe_pl.training.run import TrainingSettings

log = logging.getLogger(__name__)

TRAINS = True
"""Whether the suite also takes the settings of a training on each data set."""

GROWN = 1.5
"""A ratio that is at least this many times the earlier one is reported."""

RATIOS = {"step_ratio": "rollout step", "training_step_ratio": "training step"}
"""Compared metrics, and the step that each measures."""

TIMES = {"step_ratio": ("step_time", "product_time"), "training_step_ratio": ("training_step_time", "training_product_time")}
"""Metrics with the times [s] of which each ratio is made: of the step, and of its products."""

TRAINING_ROUNDS = 5
"""Number of rounds of training steps."""

RENEW = "if the new times are right, renew the file with `python docs/embed_results.py runs/benchmark/performance performance`"


class PerformanceError(GpeError):
    """Raised when the file to compare with cannot be read; the message names it."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets of shipped models, by the name of the model.
        several: case of which several scenes together, and a training step, are timed as well.
        reference: path of the ``results.json`` of an earlier run. With None, or if the file does not exist, ratios are not compared.
        num_rounds: number of rollouts per case. The shortest processor time counts, because other work on the machine only makes it longer.
        num_scenes: number of scenes that are rolled out together.
        num_threads: threads of PyTorch.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    several: str
    reference: str | None = None
    num_rounds: Annotated[int, Field(ge=1)] = 40
    num_scenes: Annotated[int, Field(ge=2)] = 8
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, specs: dict[str, DatasetSpec], trainings: dict[str, TrainingSettings]) -> tuple[list[dict[str, Any]], str]:
    """Return records of times [s] and ratios, and a Markdown table. The lines of ``comparison`` are logged.

    Raises:
        PerformanceError: the file to compare with cannot be read, or there is no case ``several``.
        StepError: a rollout stopped early.
    """
    if settings.several not in specs:
        raise PerformanceError(f"suite.several={settings.several}: must be one of the cases {', '.join(specs)}")
    earlier = ratios_in(settings.reference)
    torch.set_num_threads(settings.num_threads)
    name, spec = settings.several, specs[settings.several]
    records = [record for case, own in specs.items() for record in rollout_records(case, own, 1, settings.num_rounds)]
    records += rollout_records(name, spec, settings.num_scenes, settings.num_rounds)
    records += training_records({name: spec}, {name: trainings[name]}, TRAINING_ROUNDS)
    for line in comparison(records, earlier, settings.reference):
        log.warning(line)
    return records, table(records)


def rollout_records(name: str, spec: DatasetSpec, num_scenes: int, num_rounds: int) -> list[dict[str, Any]]:
    """Return records of a rollout step of one or several test scenes together: its time [s], that of its products [s], and their ratio.

    Args:
        name: name of a shipped model.
        spec: its data set. If it has fewer test scenes than ``num_scenes``, they are used again.
        num_scenes, num_rounds: numbers of scenes and of timed rollouts.
    """
    simulator = LearnedSimulator.from_checkpoint(name)
    model, starts, flop, num_nodes = cast(GPE, simulator.model), list[Start](), 0, 0
    for index in range(num_scenes):
        truth = generate_trajectory(spec, "test", index % max(1, spec.num_test), num_frames=FRAME + 1)
        state, metadata = simulator.initial_state(truth, FRAME), truth.metadata
        margin = max(high - low for low, high in metadata.bounds)
        guard = Guard(max_speed=1e3, bounds=metadata.bounds, margin=margin, spacing=metadata.spacing)
        starts.append(Start(state, NUM_STEPS, metadata, guard))
        flop, num_nodes = flop + products(model, simulator.builder(state)), num_nodes + state.num_nodes
    step, rate = inf, 0.0
    for k in range(num_rounds + 1):
        started = time.process_time()
        ended = rollouts(Contained(simulator, spec.solver.frame_dt), starts)
        seconds = (time.process_time() - started) / NUM_STEPS
        if any(trajectory.termination is not None for trajectory in ended):
            raise StepError(f"{name}: a rollout of {num_scenes} scenes stopped and was not timed; check the checkpoint")
        step = min(step, seconds) if k else inf  # the first round loads compiled code
        rate = max(rate, gemm_rate(num_nodes, model.settings["hidden_channels"], "cpu", time.process_time))
    case = name if num_scenes == 1 else f"{name}, {num_scenes} scenes"
    log.info("%s: a step takes %.2f ms, %.1f times its products", case, 1e3 * step, step * rate / flop)
    values = {"step_time": (step, "s"), "product_time": (flop / rate, "s"), "step_ratio": (step * rate / flop, "1")}
    return [{"metric": metric, "case": case, "value": value, "unit": unit} for metric, (value, unit) in values.items()]


def ratios_in(path: str | None) -> dict[tuple[str, str], float] | None:
    """Return the ratios in a file of results by metric and case, or None if there is no file.

    Raises:
        PerformanceError: the file cannot be read, or does not hold records.
    """
    if path is None or not Path(path).exists():
        return None
    try:
        return ratios(parsed(Path(path).read_bytes())["records"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PerformanceError(
            f"suite.reference={path}: does not hold results of this suite ({type(error).__name__}: {error}); restore it, or set suite.reference=null"
        ) from None


def ratios(records: list[dict[str, Any]]) -> dict[tuple[str, str], float]:
    """Return the ratios among records by metric and case."""
    return {(r["metric"], r["case"]): float(r["value"]) for r in records if r["metric"] in RATIOS}


def comparison(records: list[dict[str, Any]], earlier: dict[tuple[str, str], float] | None, path: str | None) -> Iterator[str]:
    """Compare ratios with earlier ones.

    Yields:
        A line for each ratio that grew by half, and for each that the file lacks. The last line says how to renew the file, or that no ratio grew. If
        ``earlier`` is None, one line says that the file was not found; without a path there is no line.

    Args:
        records: records of this run.
        earlier: earlier ratios by metric and case, as ``ratios_in`` returns them.
        path: file of the earlier ratios, for the lines.
    """
    if earlier is None:
        if path is not None:
            yield f"{path}: not found in {Path.cwd()}, so ratios are not compared; begin in a clone of the repository, or set suite.reference"
        return
    grown = 0
    for (metric, case), ratio in ratios(records).items():
        before = earlier.get((metric, case))
        if before is None:
            yield f"{RATIOS[metric]} of {case}: {path} has no such ratio"
        elif ratio >= GROWN * before:
            grown += 1
            yield f"{RATIOS[metric]} of {case}: {ratio:.1f} times its products, {before:.1f} in {path}: grew by {100 * (ratio / before - 1):.0f} %"
    if grown:
        yield f"{grown} of {len(ratios(records))} ratios grew by half or more; {RENEW}"
    else:
        yield f"no ratio grew by half against {path}"


def table(records: list[dict[str, Any]]) -> str:
    """Return a Markdown table of the records."""
    values = {(r["metric"], r["case"]): r["value"] for r in records}
    lines = [table_row(["", "case", "time [ms]", "products [ms]", "ratio"]), "|---|---|---|---|---|"]
    for metric, case in ratios(records):
        step, floor = (1e3 * values[name, case] for name in TIMES[metric])
        lines.append(table_row([RATIOS[metric], case, f"{step:.2f}", f"{floor:.2f}", f"{values[metric, case]:.1f}"]))
    note = (
        "Rollout step: search, features, network, integration, containment, guard and recording of the shipped model. Training step: a step of the training "
        "loop of `fit`, and three times the products. Products: those of the factored network at the rate measured for its nodes. Times are the shortest "
        "of all rounds, in processor time."
    )
    return "\n".join([*lines, "", note])
