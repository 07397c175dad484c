"""Training runs that have ended: their configuration, what they were evaluated to, and the values that several of them share."""

from __future__ import annotations

import csv
import json
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.evaluation import LEARNED, MetricsError, Row, read_rows
from gpe_pl.run_folder import DATA_CHECKSUMS, RunError, config_in

log = logging.getLogger(__name__)

UNSEEN_GROUPS = ("interpolated", "extrapolated")
"""Where material parameters that training did not have can lie."""


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, its flattened configuration, its rows, and the checksums of its data, by key of the configuration."""

    folder: Path
    config: dict[str, Any]
    rows: list[Row]
    data: dict[str, str] = field(default_factory=dict)


UNSAID: dict[str, Any] = {"training.sampling": "uniform", "training.push_share": 0.0, "training.push_correction": 1.0}
"""What the ``config.json`` of a run leaves out where it is not used, as runs did before there was a choice."""

WITHOUT_CONSEQUENCE = {"evaluation.num_pictures", "evaluation.export"}
"""What runs may differ in without having been done otherwise."""

TRAINED = {"data.name": str, "model._target_": str, "training.num_steps": int}
"""What the configuration of every training run says, by type."""


def finished_runs(folder: Path) -> list[Run]:
    """All finished training runs below a folder, in order of their paths; evaluations beside them are none."""
    runs = []
    for path in sorted(folder.rglob("metrics.csv")):
        config = path.parent / "config.json"
        if config.exists():
            said = {key: value for key, value in _flatten(config_in(config)) if key not in WITHOUT_CONSEQUENCE}
            data = {key: str(said.pop(key)) for key in list(said) if DATA_CHECKSUMS in key.split(".")}
            values = UNSAID | said
            if values.keys() >= TRAINED.keys():
                for key, kind in TRAINED.items():
                    if type(values[key]) is not kind:
                        raise RunError(
                            f"{config}: {key} is {values[key]!r}; delete the folder {path.parent}, which this package has not written"
                        )
                runs.append(Run(path.parent, values, list(read_rows(path)), data))
            else:
                log.warning(
                    "%s is not of a training run (%s) and is left out of the report",
                    path.parent,
                    ", ".join(sorted(TRAINED.keys() - values.keys())),
                )
    _warn_of_replaced_data(runs)
    return runs


def _warn_of_replaced_data(runs: list[Run]) -> None:
    """Say where two runs used data of one description that hold different things, as when data are imported again under the same name."""
    first: dict[str, Run] = {}
    for run in runs:
        description = {
            key: value for key, value in run.config.items() if key.partition(".")[0] == "data" or key.startswith("evaluation.data.")
        }
        before = first.setdefault(json.dumps(description, sort_keys=True), run)
        if any(before.data.get(key, value) != value for key, value in run.data.items()):
            log.warning("%s and %s used different data of the same name; their errors do not compare", before.folder, run.folder)


def replaced_data(runs: list[Run]) -> list[str]:
    """Keys of the data of which runs have different checksums. Runs of earlier versions have none, and differ in nothing."""
    keys = sorted({key for run in runs for key in run.data})
    return [key for key in keys if len({run.data[key] for run in runs if key in run.data}) > 1]


def distinct_runs(runs: list[Run]) -> list[Run]:
    """Runs of the same configuration count once."""
    first: dict[str, Run] = {}
    for run in runs:
        kept = first.setdefault(json.dumps(run.config, sort_keys=True), run)
        if kept is not run:
            log.warning("%s repeats %s and is left out of the report", run.folder, kept.folder)
    return list(first.values())


def _flatten(value: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flatten(item, f"{path}.{key}" if path else str(key))
    else:
        yield path, value if not isinstance(value, list) else json.dumps(value)


def axes_of(runs: list[Run]) -> list[str]:
    """Configuration keys whose values differ between runs, ``seed`` last."""
    keys = sorted({k for r in runs for k in r.config})
    different = [k for k in keys if len({json.dumps(r.config.get(k)) for r in runs}) > 1]
    return sorted(different, key=lambda k: (k == "seed", k))


def groups_of(row: Row) -> list[str]:
    """Splits that a row counts for; unseen parameters also apart by where they lie."""
    return [row.split, f"{row.split}/{row.parameter_group}"] if row.parameter_group in UNSEEN_GROUPS else [row.split]


def validation_curve(run_dir: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps and one-step validation loss of a run, over all its starts; raises ``MetricsError`` where a log is damaged."""
    points: dict[int, float] = {}
    logs = {path: path.parent.name.removeprefix("version_") for path in run_dir.glob("log/version_*/metrics.csv")}
    for path in sorted((path for path, version in logs.items() if version.isdecimal()), key=lambda path: int(logs[path])):
        with open(path, newline="", encoding="utf-8") as handle:
            reader = csv.DictReader(handle)
            try:
                for line in reader:
                    if line.get("val/one_step_nmse"):
                        points[int(line["step"]) + 1] = float(line["val/one_step_nmse"])
            except (ValueError, KeyError, TypeError, csv.Error) as error:  # also what is not text
                raise MetricsError(
                    f"{path}, line {reader.line_num}: damaged ({error}); delete the file, which only the curve of the validation loss needs"
                ) from None
    steps = sorted(points)
    return np.array(steps), np.array([points[s] for s in steps])


Values = list[dict[int, float]]
"""Of one metric: for each seed that has any, a value by number of the trajectory."""


def values_by_seed(runs: list[Run], model: str, split: str, metric: str, horizon: str) -> Values:
    """What runs have of a metric, in order of trajectories."""
    table = []
    for run in runs:
        rows = [r for r in run.rows if r.model == model and r.metric == metric and r.horizon == horizon and split in groups_of(r)]
        table.append({r.trajectory: r.value for r in sorted(rows, key=lambda r: r.trajectory)})
    return [t for t in table if t]


STAND_IN = "ballistic"
"""Trivial model whose error a failed rollout gets."""


def rollout_errors(runs: list[Run], split: str, horizon: str) -> Values:
    """Rollout MSE [m²] of learned models as tables judge it: a failed rollout gets the error of ballistic flight in the same scene over the same frames.

    It stays infinite where ballistic flight was not evaluated. ``values_by_seed`` has the errors as they are.
    """
    errors = []
    for run in runs:
        trivial: dict[int, float] = dict(*values_by_seed([run], STAND_IN, split, "rollout_mse", horizon))
        for seed in values_by_seed([run], LEARNED, split, "rollout_mse", horizon):
            errors.append({k: value if math.isfinite(value) else trivial.get(k, value) for k, value in seed.items()})
    return errors


def shared_trajectories(*values: Values) -> list[int]:
    """Numbers of the trajectories that all seeds, of several models if given, have evaluated."""
    seeds = [set(seed) for table in values for seed in table]
    return sorted(set.intersection(*seeds)) if seeds else []


def shared_table(values: Values, trajectories: list[int] | None = None) -> np.ndarray:
    """Values as a table [seed, trajectory], of the given trajectories or of those that all seeds have."""
    chosen = shared_trajectories(values) if trajectories is None else trajectories
    return np.array([[seed[k] for k in chosen] for seed in values]).reshape(len(values), len(chosen))
