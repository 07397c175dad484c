"""The suite of other people's physics: experiments, other engines and public data sets.

Nothing is fetched from a network. The suite uses files in a folder of the user and installed programs, and names what is missing and how to get it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import Field

from gpe_pl.benchmarks.acceptance.trial import Candidate
from gpe_pl.benchmarks.learning_sets import suite as learning_sets
from gpe_pl.benchmarks.learning_sets.sets import SETS
from gpe_pl.benchmarks.outside import engines, experiments
from gpe_pl.benchmarks.outside.engines import EngineName
from gpe_pl.benchmarks.outside.experiments import DAM_BREAK_FILE, Experiment, OutsideError
from gpe_pl.benchmarks.trained import Case, checkpoint_label, of_stored_frames, refuse_same_names
from gpe_pl.data.ground_truth import DatasetSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEARNING_SETS = "learning_sets"
"""Name of the suite of public learning sets."""
RESUMES = True
"""``run`` takes the folder of the suite, beside which the suite of public learning sets has its own."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by name; each checkpoint must have been trained on one of them.
        folder: folder of the user's files.
        checkpoints: models as paths of checkpoints, folders of runs, or names of shipped models.
        experiments: experiments to run.
        engines: other engines to run.
        num_threads: threads of PyTorch; the solvers use one.
    """

    cases: dict[str, Case]
    folder: str = "outside"
    checkpoints: Annotated[list[str], Field(min_length=1)] = field(default_factory=lambda: ["fluid", "sand", "fem"])
    experiments: list[Experiment] = field(default_factory=lambda: ["dam_break", "column_collapse", "droplet"])
    engines: list[EngineName] = field(default_factory=lambda: ["calculix", "splishsplash", "kratos"])
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, specs: Mapping[str, DatasetSpec], own: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per curve, per quantity of an engine and per missing thing, and a Markdown report.

    Args:
        settings: settings of the suite.
        specs: data sets, by name.
        own: folder of the suite's results. What ``suite=learning_sets`` has measured in the folder beside it is reported, too.

    Raises:
        OutsideError: a checkpoint was trained on none of ``specs``, or a file of the user cannot be read.
        SameNameError: two checkpoints have the same name.
        EngineError: an engine failed.
    """
    torch.set_num_threads(settings.num_threads)
    folder = Path(settings.folder).expanduser()
    refuse_same_names(settings.checkpoints)
    candidates = [candidate_of(checkpoint, specs) for checkpoint in settings.checkpoints]
    records = [record for name in settings.experiments for c in candidates for record in experiments.compared(name, c, folder)]
    present = [name for name in settings.engines if not engines.SCENES[name].is_missing()]
    records += [record for name in present for c in candidates for record in engines.compared(name, c)]
    missing = missing_things(folder, settings)
    records += [{"missing": name, "remedy": remedy} for name, remedy in missing]
    measured = learning_sets.records_in(own.parent / LEARNING_SETS)
    return records + [{"learning_set": record} for record in measured], report(records, missing, folder, measured)


def candidate_of(checkpoint: str, specs: Mapping[str, DatasetSpec]) -> Candidate:
    """Return a model with the data set that it was trained on.

    Raises:
        OutsideError: it was trained on none of ``specs``.
    """
    simulator = of_stored_frames(checkpoint)
    own = simulator.builder.metadata
    fitting = [s for s in specs.values() if s.name == own.dataset and abs(s.scene.spacing / own.spacing - 1) < 0.01]
    if not fitting or len(own.materials) > 1:
        raise OutsideError(f"{checkpoint}: was trained on {own.dataset}, the suite has {', '.join(specs)}; add the data set to suite.cases")
    return Candidate(checkpoint_label(checkpoint), simulator, fitting[0])


def missing_things(folder: Path, settings: Settings) -> list[tuple[str, str]]:
    """Return what is not there, each with how to get it."""
    found = []
    if "dam_break" in settings.experiments and not (folder / DAM_BREAK_FILE).is_file():
        remedy = "columns series, T, Z; from the papers named in gpe_pl.benchmarks.outside.experiments"
        found.append((f"measured fronts of dam breaks, {folder / DAM_BREAK_FILE}", remedy))
    for name in settings.engines:
        if engines.SCENES[name].is_missing():
            found.append((engines.SCENES[name].label, engines.SCENES[name].remedy))
    return found + learning_sets.missing_sets(folder)


def report(
    records: Sequence[Mapping[str, Any]], missing: Sequence[tuple[str, str]], folder: Path, measured: Sequence[Mapping[str, Any]]
) -> str:
    """Return the tables, what was measured on public learning sets, how to train on those that are there, and what is missing."""
    parts = [experiments.report(records), engines.report(records), ["Public learning sets:", "", *learning_sets.table(measured)]]
    commands = [learning_sets.command(name, folder) for name, own in SETS.items() if (folder / own.source).is_dir()]
    if commands:
        parts.append(["Those that are there; train and evaluate on them with:", "", *(f"- `{command}`" for command in commands)])
    if missing:
        parts.append(["Missing, and how to get it:", "", *(f"- {name}: {remedy}" for name, remedy in missing)])
    return "\n\n".join("\n".join(part) for part in parts if part)


def figures(records: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Draw one figure per experiment and model, and one of all engines."""
    return experiments.drawn(records) | engines.drawn(records)
