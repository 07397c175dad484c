"""The suite of public learning sets: imports, trains, and evaluates with the published metric and split, beside published figures and trivial baselines.

Each training is a process of ``python -m gpe_pl.fit``. A command that was stopped goes on where it was. Nothing is fetched from a network.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from gpe_pl.benchmarks.learning_sets.measures import MODEL, measured, pooled, trivial
from gpe_pl.benchmarks.learning_sets.sets import QUANTITIES, RIGIDITY, SETS, STOPPED, LearningSet, SetName
from gpe_pl.data.importers import ImportSettings, import_dataset
from gpe_pl.data.importers.assemble import FOLDER
from gpe_pl.data.importers.report import Report
from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.files.run_folder import CONFIG, config_in
from gpe_pl.metrics.rollouts import bootstrap_interval

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""

MEASURED_FILE = "measured.json"
SOURCE_FILE = "source.sha256"
"""File beside imported data with the digest of the files that they were made of."""
HEADER = ["data set", "quantity", "published", "trivial baseline", "model", "splits", "seeds", "core-minutes"]


class LearningSetError(GpeError, RuntimeError):
    """Raised when files are not those of a data set, or when a training fails; the message names folder or command."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        folder: folder with the files of the data sets.
        only: data sets that are trained and evaluated. What is there of the others is reported.
        seeds: seeds of the trainings.
        minutes: training time on one core or GPU [min], which decides the number of steps; validation and evaluation come on top.
        num_splits: maximum number of splits of a data set that leaves one trajectory out after the other; None for all.
        training: overrides of ``python -m gpe_pl.fit`` for each data set.
        num_threads: threads of PyTorch in evaluations.
    """

    folder: str = "outside"
    only: list[SetName] = field(default_factory=lambda: list(SETS))
    seeds: Annotated[list[int], Field(min_length=1)] = field(default_factory=lambda: [0])
    minutes: Annotated[float, Field(gt=0)] = 10.0
    num_splits: Annotated[int, Field(ge=1)] | None = None
    training: dict[SetName, list[str]] = field(default_factory=dict)
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per training, and a Markdown table.

    Raises:
        ImportFailure: files of a data set cannot be read.
        LearningSetError: the files are not those of the data set, or others than an earlier run of this folder imported; or a training failed.
    """
    torch.set_num_threads(settings.num_threads)
    source = Path(settings.folder).expanduser()
    for name in settings.only:
        if (source / SETS[name].source).is_dir():
            digest = digest_of(source / SETS[name].source)
            for label, splits in list(SETS[name].parts().items())[: settings.num_splits]:
                for seed in settings.seeds:
                    dataset = imported(name, label, splits, source, folder, digest)
                    _trained(name, label, dataset, seed, folder, settings)
    records = records_in(folder)
    return records, report(records, source)


def digest_of(source: Path) -> str:
    """Return a digest of the names and contents of the files of a data set, which are ``{name}_{number}.pt`` or ``{number}.h5``. Others do not count."""
    found = sha256()
    for path in sorted(path for path in source.rglob("*") if re.fullmatch(r"(\w+_)?[0-9]+\.(pt|h5)", path.name)):
        found.update(f"{path.relative_to(source).as_posix()}\0{sha256(path.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()


def imported(name: SetName, label: str, splits: Mapping[str, Any], source: Path, folder: Path, digest: str) -> str:
    """Import one split, unless an earlier run has done so, and return the name of the data.

    Args:
        name: name of the data set.
        label: label of the split.
        splits: settings of ``convert`` for the split.
        source: folder of all data sets.
        folder: folder of the suite.
        digest: digest of the files (``digest_of``).

    Raises:
        ImportFailure: files cannot be read.
        LearningSetError: files are damaged, missing, or of another data set; or others than those that an earlier run imported.
    """
    learning_set, dataset = SETS[name], "_".join([name, *label.split()])
    files, root = source / learning_set.source, folder / "data" / dataset
    stored = root / SOURCE_FILE
    if (root / FOLDER).is_dir():
        if not stored.is_file() or stored.read_text(encoding="utf-8").strip() != digest:
            raise LearningSetError(
                f"{files}: holds other files than those that {root} was made of; choose another folder with hydra.run.dir=…"
            )
        return dataset
    replace_text(stored, digest + "\n")
    report = import_dataset(folder / "data", ImportSettings(learning_set.format, str(files), name=dataset, **splits))
    fault = _fault(report, learning_set)
    if not fault and learning_set.digest not in (None, digest):
        fault = "has as many trajectories and frames as the data set, and other values"
    if fault:
        rmtree(root)
        raise LearningSetError(f"{files}: {fault}; its figures would not be comparable. Get the files of {learning_set.origin}")
    return dataset


def _fault(report: Report, learning_set: LearningSet) -> str:
    """Return what shows that imported data are not the data set as it was published; empty if nothing does."""
    if report.refusals:
        return f"{len(report.refusals)} trajectories cannot be used: {report.refusals[0]}"
    count = sum(split.trajectories for split in report.splits.values())
    lengths = {length for split in report.splits.values() for length in split.frames}
    for what, found, expected in (
        ("trajectories", count, learning_set.num_trajectories),
        ("frames", ", ".join(map(str, sorted(lengths))), str(learning_set.num_frames)),
        ("as materials", ", ".join(sorted(report.materials)), ", ".join(sorted(learning_set.materials))),
    ):
        if found != expected:
            return f"has {found} {what}, the data set has {expected}"
    return ""


def _trained(name: SetName, label: str, dataset: str, seed: int, folder: Path, settings: Settings) -> None:
    """Train and measure one split with one seed, as far as it has not been done."""
    learning_set, root = SETS[name], folder / "data" / dataset / FOLDER
    run_name = f"{dataset}_seed_{seed}"
    overrides = [*settings.training.get(name, []), f"training.budget_minutes={settings.minutes:g}"]
    shared = f"reuse={dataset}"  # seeds share a measured step time, which is stored there, so they have equal numbers of steps
    about = ["data=imported", f"data.name={dataset}", f"name={run_name}", f"seed={seed}", shared, *overrides]
    paths = [f"paths.data={folder / 'data'}", f"paths.runs={folder / 'runs'}"]
    if subprocess.run([sys.executable, "-m", "gpe_pl.fit", *about, *paths], check=False).returncode:
        raise LearningSetError(f"python -m gpe_pl.fit {shlex.join([*about, *paths])}: failed; its messages are above")
    checkpoint = folder / "runs" / run_name / "checkpoints" / "best.ckpt"
    digest = sha256(checkpoint.read_bytes()).hexdigest()
    stored = folder / "runs" / run_name / MEASURED_FILE
    if not stored.is_file() or json.loads(stored.read_text(encoding="utf-8"))["checkpoint"] != digest:
        own = config_in(folder / "runs" / run_name / CONFIG)["evaluation"]
        values = measured(checkpoint, root, learning_set, bool(own["mirror_average"]))
        about_run = {"set": name, "split": label, "seed": seed, "minutes": settings.minutes, "training": overrides}
        record = {**about_run, "values": values, "checkpoint": digest}
        replace_text(stored, json.dumps(record) + "\n")


def records_in(folder: Path) -> list[dict[str, Any]]:
    """Return what was measured of every finished training in the folder of the suite."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(f"runs/*/{MEASURED_FILE}"))]


def report(records: Sequence[Mapping[str, Any]], source: Path) -> str:
    """Return the table of what was measured, and what is missing."""
    parts = ["\n".join(table(records))]
    if missing := missing_sets(source):
        parts.append("\n".join(["Missing, and how to get it:", "", *(f"- {name}: {remedy}" for name, remedy in missing)]))
    return "\n\n".join(parts)


def table(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of the table, and what its columns mean."""
    rows = [line for name in SETS for line in _rows(name, [record for record in records if record["set"] == name])]
    noted = [f"- {name}: {SETS[name].note}." for name in SETS if SETS[name].note and any(record["set"] == name for record in records)]
    return [table_row(HEADER), "|" + "---|" * len(HEADER), *rows, "", NOTE, *(["", "Published figures:", "", *noted] if noted else [])]


NOTE = (
    "Test trajectories are never trained on. RMS distances are pooled over frames, nodes, trajectories and splits. Relative L2 norms are means over frames. "
    "Intervals are 95 % bootstrap intervals over seeds and test trajectories. With one seed they do not contain the spread between seeds, and with three they "
    "underestimate it. The trivial baseline is the best one. Core-minutes are training time. Where a rollout stopped early, nodes stay where they were, its "
    "stress has an infinite error, and rigid bodies are measured in its last frame."
)


def _rows(name: SetName, records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the rows of a data set; one that says so if nothing was measured."""
    if not records:
        return [table_row([name, "", "", "", "not measured", *[""] * 3])]
    learning_set, lines = SETS[name], list[str]()
    seeds = sorted({record["seed"] for record in records})
    by_run = {(record["split"], record["seed"]): record for record in records}
    splits = [split for split in learning_set.parts() if all((split, seed) in by_run for seed in seeds)]
    if not splits:
        return [table_row([name, "", "", "", "no split with all seeds", "", ", ".join(map(str, seeds)), ""])]
    known = [[by_run[split, seed] for split in splits] for seed in seeds]
    minutes = sorted({record["minutes"] for own in known for record in own})
    for quantity in QUANTITIES:
        if any(quantity not in record["values"][MODEL] for own in known for record in own):
            continue
        best = trivial(_baselines(known[0], quantity), quantity)
        published = learning_set.published.get(quantity)
        cells = [
            *(
                name,
                quantity,
                "" if published is None else f"{published:.3g}",
                "" if best is None else f"{best[1]:.3g} ({best[0].replace('_', ' ')})",
            ),
            _estimate(quantity, np.array([[x for record in own for x in record["values"][MODEL][quantity]] for own in known]))
            + _stopped([record["values"][MODEL] for own in known for record in own]),
            f"{len(splits)} of {len(learning_set.parts())}",
            ", ".join(map(str, seeds)),
            ", ".join(f"{value:g}" for value in minutes),
        ]
        lines.append(table_row(cells))
    return lines


def _stopped(values: Sequence[Mapping[str, list[float]]]) -> str:
    """Return how many rollouts of a model stopped early; empty if none did, or if an earlier version did not count them."""
    flags = [flag for own in values for flag in own.get(STOPPED, [])]
    return f", {sum(flags):.0f} of {len(flags)} stopped" if any(flags) else ""


def _estimate(quantity: str, table: np.ndarray) -> str:
    """Return the pooled value of a table [seed, trajectory], with an interval if there are several and it is not a maximum."""
    if table.size == 1 or quantity == RIGIDITY:
        return f"{pooled(quantity, table):.3g}"
    found = bootstrap_interval(table, lambda own, axis: pooled(quantity, own, axis))
    return f"{found.estimate:.3g} [{found.low:.3g}, {found.high:.3g}]"


def _baselines(records: Sequence[Mapping[str, Any]], quantity: str) -> dict[str, dict[str, float]]:
    """Return the pooled values of each baseline. They do not depend on seeds."""
    names = [name for name in records[0]["values"] if name != MODEL and quantity in records[0]["values"][name]]
    return {
        name: {quantity: float(pooled(quantity, np.array([[x for record in records for x in record["values"][name][quantity]]])))}
        for name in names
    }


def missing_sets(source: Path) -> list[tuple[str, str]]:
    """Return the data sets that are not in the user's folder, each with how to get it."""
    return [(name, f"put {s.origin} into {source / s.source}") for name, s in SETS.items() if not (source / s.source).is_dir()]


def command(name: SetName, source: Path) -> str:
    """Return the command that trains and evaluates on a data set."""
    return f"python -m gpe_pl.benchmark suite=learning_sets suite.folder={source} 'suite.only=[{name}]'"
