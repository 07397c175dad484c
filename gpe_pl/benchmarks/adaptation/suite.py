"""The suite of adaptation: an engine that nobody here wrote makes a few scenes, and models learn from them.

For each engine it compares, on the same test scenes of the engine: the solver, the shipped model as it is, that model trained on with a few trajectories, and
the same network trained on them from scratch with as many steps. Each training is a process of ``python -m gpe_pl.fit``. A command that was stopped goes on
where it was.
"""

from __future__ import annotations

import logging
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field

from gpe_pl.benchmarks.acceptance.trial import Candidate
from gpe_pl.benchmarks.adaptation.scenes import DIMENSIONS, Pair, digest_of, pair
from gpe_pl.benchmarks.learning_sets.measures import MODEL, lasting, rms_distance
from gpe_pl.benchmarks.outside.engine import EngineError
from gpe_pl.benchmarks.outside.engines import SCENES, EngineName
from gpe_pl.benchmarks.outside.suite import candidate_of
from gpe_pl.benchmarks.trained import Case
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.data.importers.assemble import FOLDER, save_dataset
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.predictions import Predictor
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.rollouts import bootstrap_interval, bootstrap_ratio

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""
SOLVER, SHIPPED, ADAPTED, SCRATCH = "solver", "shipped model", "adapted", "from scratch"
MOST = 2
"""Largest number of scenes that an engine may be given, as a multiple of those that are needed."""
HEADER = ["engine", "simulator", "RMS distance to the engine [spacings]", "over the shipped model", "stopped", "seeds"]


class AdaptationError(GpeError, RuntimeError):
    """Raised when a training fails, with its command, and for a model of another material than the engine's scenes."""


@dataclass(frozen=True)
class OfEngine:
    """What is adapted to an engine.

    Attributes:
        checkpoint: model that was trained on our solver: a shipped name, a folder of a run or a checkpoint.
        training: overrides of ``python -m gpe_pl.fit`` that make the same network.
    """

    checkpoint: str
    training: list[str]


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by name; each checkpoint must have been trained on one of them.
        engines: engines, and what is adapted to each. Those that are missing are named.
        num_train, num_val, num_test: numbers of scenes of each engine.
        seeds: seeds of the trainings.
        num_steps: training steps, also from scratch.
        learning_rate: learning rate from scratch.
        adapted_learning_rate: learning rate of the adaptation.
        num_threads: threads of PyTorch in evaluations.
    """

    cases: dict[str, Case]
    engines: dict[EngineName, OfEngine]
    num_train: Annotated[int, Field(ge=1)] = 12
    num_val: Annotated[int, Field(ge=1)] = 3
    num_test: Annotated[int, Field(ge=2)] = 10
    seeds: Annotated[list[int], Field(min_length=1)] = field(default_factory=lambda: [0])
    num_steps: Annotated[int, Field(ge=1)] = 1500
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    adapted_learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, specs: Mapping[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per engine, simulator and seed with the RMS distance of each test scene, and a Markdown table.

    Raises:
        OutsideError: a checkpoint was trained on none of ``specs``.
        AdaptationError: a training failed, an engine gives up too many scenes, or a checkpoint was trained on other materials or in another dimension.
    """
    torch.set_num_threads(settings.num_threads)
    records, missing = list[dict[str, Any]](), list[tuple[str, str]]()
    for name, own in settings.engines.items():
        if SCENES[name].is_missing():
            missing.append((SCENES[name].label, SCENES[name].remedy))
        else:
            records += _of_engine(name, own, candidate_of(own.checkpoint, specs), settings, folder)
    return records, report(records, missing)


def _of_engine(name: EngineName, own: OfEngine, candidate: Candidate, settings: Settings, folder: Path) -> list[dict[str, Any]]:
    materials, dim = candidate.spec.scene.materials, len(candidate.spec.scene.bounds)
    if (materials, dim) != ((SCENES[name].material,), DIMENSIONS[name]):
        raise AdaptationError(
            f"{name}: its scenes are of {SCENES[name].material} in {DIMENSIONS[name]}D, and {own.checkpoint} was trained on {', '.join(materials)} in {dim}D; "
            "name another checkpoint"
        )
    pairs, num_given_up = _made(name, candidate, settings, folder)
    dataset, tests = _stored(name, pairs, settings, folder), pairs[-settings.num_test :]
    start = candidate.simulator.builder.config.history
    rows: list[tuple[str, int | None, list[tuple[float, bool]]]] = [
        (SOLVER, None, [(rms_distance(p.solver[start + 1 :], p.engine.pos[start + 1 :]), False) for p in tests])
    ]
    root = folder / "data" / dataset / FOLDER
    for who, values in measured(own.checkpoint, root, start).items():
        rows.append((SHIPPED if who == MODEL else who.replace("_", " "), None, values))
    for seed in settings.seeds:
        for who in (ADAPTED, SCRATCH):
            checkpoint = _trained(dataset, own, who, seed, settings, folder)
            rows.append((who, seed, measured(str(checkpoint), root, start)[MODEL]))
    about = {"engine": name, "given_up": num_given_up}
    return [
        about
        | {
            "simulator": who,
            "seed": seed,
            "rms": [round(x / candidate.spacing, 5) for x, _ in values],
            "stopped": sum(s for _, s in values),
        }
        for who, seed, values in rows
    ]


def _made(name: EngineName, candidate: Candidate, settings: Settings, folder: Path) -> tuple[list[Pair], int]:
    """Make the scenes, as far as they are missing. Return them, and the number of scenes that the engine gave up."""
    kept = folder / "scenes" / name
    kept.mkdir(parents=True, exist_ok=True)
    total = settings.num_train + settings.num_val + settings.num_test
    pairs, label = list[Pair](), SCENES[name].label
    for seed in range(MOST * total):
        log.info("%s: scene %d of %d", label, len(pairs) + 1, total)
        try:
            pairs.append(pair(name, candidate, seed, kept))
        except EngineError as error:
            log.warning("%s; the scene is left out", error)
            last = error
        if len(pairs) == total:
            return pairs, seed + 1 - total
    raise AdaptationError(f"{label}: gives up more than half of the scenes. {last}; {kept} has those that it finished") from last


def _stored(name: EngineName, pairs: Sequence[Pair], settings: Settings, folder: Path) -> str:
    """Write the engine's scenes as a data set, unless an earlier run has done so, and return its name, which other scenes or splits do not share."""
    trajectories, num_held_out = [p.engine for p in pairs], settings.num_val + settings.num_test
    dataset = f"{name}_{digest_of(np.array([settings.num_train, settings.num_val]), *(a for t in trajectories for a in (t.pos, t.vel)))}"
    if not (folder / "data" / dataset / FOLDER).is_dir():
        train, val, test = (
            trajectories[:-num_held_out],
            trajectories[-num_held_out : -settings.num_test],
            trajectories[-settings.num_test :],
        )
        report = save_dataset(folder / "data", dataset, train=train, val=val, test=test)
        if report.refusals:
            shutil.rmtree(folder / "data" / dataset)  # a later run would take it for complete
            raise AdaptationError(f"{SCENES[name].label}: {len(report.refusals)} scenes cannot be used: {report.refusals[0]}")
    return dataset


def measured(checkpoint: str, root: Path, start: int) -> dict[str, list[tuple[float, bool]]]:
    """Return the RMS distance [m] of rollouts from frame ``start`` in each test scene, of a model (``MODEL``) and of the trivial baselines.

    With each distance comes whether the rollout stopped early. Nodes then stay where they were, which can be near the end of a scene that comes to rest.
    """
    simulator, found = LearnedSimulator.from_checkpoint(checkpoint), dict[str, list[tuple[float, bool]]]()
    settings = EvaluationSettings(splits=["test"], num_uncontained=0, num_pictures=0)
    for scene in Predictor(simulator, settings, MODEL, None, 1, start, seconds=[]).scenes(root, "test"):
        for name, prediction in scene.predictions.items():
            _, pos = lasting(prediction, scene.truth.num_frames)
            stopped = prediction.num_frames < scene.truth.num_frames
            found.setdefault(name, []).append((rms_distance(pos[1:], scene.truth.pos[1:]), stopped))
    return found


def _trained(dataset: str, own: OfEngine, who: str, seed: int, settings: Settings, folder: Path) -> Path:
    """Train with one seed, unless it has been done, and return the checkpoint."""
    run_name = f"{dataset}_{who.replace(' ', '_')}_seed_{seed}"
    rate = settings.learning_rate if who == SCRATCH else settings.adapted_learning_rate
    overrides = ["data=imported", f"data.name={dataset}", f"name={run_name}", f"seed={seed}", *own.training]
    overrides += [f"training.num_steps={settings.num_steps}", f"training.learning_rate={rate:g}"]
    overrides += [f"start_from={own.checkpoint}"] if who == ADAPTED else []
    paths = [f"paths.data={folder / 'data'}", f"paths.runs={folder / 'runs'}"]
    if subprocess.run([sys.executable, "-m", "gpe_pl.fit", *overrides, *paths], check=False).returncode:
        raise AdaptationError(f"python -m gpe_pl.fit {shlex.join([*overrides, *paths])}: failed; its messages are above")
    return folder / "runs" / run_name / "checkpoints" / "best.ckpt"


def report(records: Sequence[Mapping[str, Any]], missing: Sequence[tuple[str, str]]) -> str:
    """Return the table, and what is missing."""
    lines = [table_row(HEADER), "|" + "---|" * len(HEADER)]
    for name in dict.fromkeys(record["engine"] for record in records):
        tables = _tables([record for record in records if record["engine"] == name])
        for who, (table, seeds) in tables.items():
            found = bootstrap_interval(table, statistic=pooled)
            cells = [SCENES[name].label, who, f"{found.estimate:.3g} [{found.low:.3g}, {found.high:.3g}]", "", _stopped(records, name, who)]
            cells.append(", ".join(map(str, seeds)))
            if who != SHIPPED:
                ratio = bootstrap_ratio(table, tables[SHIPPED][0], statistic=pooled)
                cells[3] = f"{ratio.estimate:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]"
            lines.append(table_row(cells))
    given_up = {SCENES[record["engine"]].label: record["given_up"] for record in records if record["given_up"]}
    parts = [*lines, "", NOTE, *(f"\n{label} gave up {count} further scenes, which are left out." for label, count in given_up.items())]
    if missing:
        parts += ["", "Missing, and how to get it:", "", *(f"- {name}: {remedy}" for name, remedy in missing)]
    return "\n".join(parts)


NOTE = (
    "Whole rollouts on the engine's test scenes: RMS distance over frames, nodes and scenes, with its 95 % bootstrap interval over scenes and seeds, and the "
    "ratio on the same scenes. Stopped: number of rollouts that a guard ended; their nodes stay where they were. Models start from some frames of the engine, "
    "the solver from its initial state. Adapted and from scratch have the same trajectories and steps, and learning rates of their own. "
    "Only the shipped model has static friction, if it was shipped with it."
)


def figures(records: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Draw one figure with a panel per engine: the distance of each test scene and seed as a dot, and the pooled distance as a line, by simulator."""
    from matplotlib.ticker import LogLocator

    from gpe_pl.viz.film_strip import new_figure

    names = [*dict.fromkeys(record["engine"] for record in records)]
    if not names:
        return {}
    figure = new_figure(2.6 * len(names), 2.4)
    figure.set_layout_engine("constrained")
    for axes, name in zip(np.ravel(figure.subplots(1, len(names), squeeze=False)), names, strict=True):
        tables = _tables([record for record in records if record["engine"] == name])
        for place, (table, _) in enumerate(tables.values()):
            axes.plot(np.full(table.size, place), table.ravel(), ".", color="0.6", markersize=3)
            axes.plot([place - 0.3, place + 0.3], 2 * [float(pooled(table))], color="C0", linewidth=2)
        axes.set_yscale("log")
        axes.set_xticks(range(len(tables)), list(tables), rotation=60, ha="right", fontsize="xx-small")
        axes.set_title(f"distance to {SCENES[name].label} [spacings]", fontsize="xx-small")
        axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.tick_params(which="both", labelsize="xx-small")
    return {"adaptation": figure}


def pooled(table: np.ndarray, axis: tuple[int, int] = (-2, -1)) -> Any:
    """Return the root mean square of a table [..., seed, scene]."""
    return np.sqrt(np.square(table).mean(axis=axis))


def _stopped(records: Sequence[Mapping[str, Any]], engine: str, who: str) -> str:
    """Return the number of stopped rollouts of a simulator; records of earlier versions have none."""
    found = [record.get("stopped") for record in records if (record["engine"], record["simulator"]) == (engine, who)]
    return "not recorded" if None in found else str(sum(filter(None, found)))


def _tables(records: Sequence[Mapping[str, Any]]) -> dict[str, tuple[np.ndarray, list[int]]]:
    """Return for each simulator its distances [seed, scene] and its seeds, which are none for what is not trained here."""
    found = dict[str, tuple[np.ndarray, list[int]]]()
    for who in dict.fromkeys(record["simulator"] for record in records):
        own = [record for record in records if record["simulator"] == who]
        found[who] = np.array([record["rms"] for record in own]), [record["seed"] for record in own if record["seed"] is not None]
    return found
