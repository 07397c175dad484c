"""Finished training runs: reads their configurations and metrics, and selects values of several runs."""

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
import pandas as pd

from gpe_pl.evaluation.metric_rows import LEARNED, MetricsError, Row, read_rows
from gpe_pl.evaluation.rollout_cost import Cost, read_cost
from gpe_pl.files.run_folder import DATA_CHECKSUMS, RunError, config_in
from gpe_pl.reports import run_archive

log = logging.getLogger(__name__)

UNSEEN_GROUPS = ("interpolated", "extrapolated")
"""Groups of material parameters that training did not have."""


Curve = tuple[np.ndarray, np.ndarray]
"""Training steps [point], and the one-step validation loss at each [point]."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: folder of the run; for an archived run, the folder before archiving.
        config: values of the configuration by keys such as ``training.num_steps``.
        rows: metrics: a table with the fields of ``evaluation.metric_rows.Row`` as columns.
        data: checksums of the data, by key of the configuration.
        curve: validation curve of an archived run; None if it is in the run's folder (see ``validation_curve``).
        cost: computing time of rollouts; None if it was not measured.
    """

    folder: Path
    config: dict[str, Any]
    rows: pd.DataFrame
    data: dict[str, str] = field(default_factory=dict)
    curve: Curve | None = None
    cost: Cost | None = None


WITHOUT_CONSEQUENCE = {
    *("evaluation.num_pictures", "evaluation.export", "evaluation.material_controls"),
    *("training.compile", "training.cuda_graph"),  # the same computation, up to rounding
}
"""Keys ignored when comparing runs."""

TRAINED = {"data.name": str, "model._target_": str, "training.num_steps": int}
"""Keys that the configuration of every training run has, with the types of their values."""


def table_of(rows: Iterable[Row]) -> pd.DataFrame:
    """Return a table with one line per row of ``metrics.csv``."""
    return pd.DataFrame([[*vars(row).values()] for row in rows], columns=run_archive.COLUMNS)


def archive(runs: list[Run], root: Path, folder: Path) -> None:
    """Write the runs below ``root`` to the two files of ``run_archive`` in a folder."""
    about = {}
    for run in runs:
        settings = {f"{CONFIG}{key}": value for key, value in run.config.items()} | {
            f"{DATA}{key}": value for key, value in run.data.items()
        }
        settings |= {} if run.cost is None else {COST_KEY: run.cost.seconds, GPU_KEY: run.cost.on_gpu}
        about[run_name(run, root)] = settings | dict(zip(CURVE, (array.tolist() for array in validation_curve(run)), strict=True))
    run_archive.write_archive(folder, about, {run_name(run, root): run.rows for run in runs})


def evaluation_in(folder: Path) -> Run:
    """Return the run in a folder of ``evaluate`` or ``fit``, with its whole configuration."""
    return Run(folder, dict(_flatten(config_in(folder / "config.json"))), table_of(read_rows(folder / "metrics.csv")))


CONFIG, DATA = "config:", "data:"
"""Prefixes of an archive's keys for the configuration of a run and for the checksums of its data."""
CURVE = ("validation_steps", "validation_losses")
"""Keys of an archive for the validation losses of a run and their training steps."""
COST_KEY = "seconds_per_simulated_second"
"""Key of an archive for the computing time of a run's rollouts per simulated second [s]."""
GPU_KEY = "rollouts_on_gpu"
"""Key of an archive that tells whether the rollouts of a run were computed on a GPU."""


def run_name(run: Run, root: Path) -> str:
    """Return the path of a run relative to the folder of its sweep."""
    return run.folder.relative_to(root).as_posix()


def _archived(folder: Path) -> list[Run]:
    about, rows = run_archive.read_archive(folder)
    runs = []
    for name, known in about.items():
        config, data = ({key.removeprefix(kind): value for key, value in known.items() if key.startswith(kind)} for kind in (CONFIG, DATA))
        curve = np.array(known[CURVE[0]], int), np.array(known[CURVE[1]], float)
        cost = Cost(known[COST_KEY], known.get(GPU_KEY, False)) if COST_KEY in known else None
        runs.append(Run(folder / name, config, rows[name], data, curve, cost))
    return runs


def finished_runs(folder: Path) -> list[Run]:
    """Return all finished training runs below a folder, in order of their paths. Those of an archive in it come first.

    A run in its own folder replaces the same run in the archive, because it may be newer. Folders that ``evaluate`` has written are not training runs. The keys
    in ``WITHOUT_CONSEQUENCE`` are left out of the configurations.

    Raises:
        RunError: a configuration cannot be read, or has values of other types than ``TRAINED``.
        MetricsError: a ``metrics.csv`` is damaged.
        ArchiveError: the archive is damaged.
    """
    archived = _archived(folder) if (folder / run_archive.RUNS).exists() else []
    runs = [*{run.folder: run for run in [*archived, *_in_own_folders(folder)]}.values()]
    _warn_of_replaced_data(runs)
    return runs


def _in_own_folders(folder: Path) -> list[Run]:
    """Return all finished training runs below a folder that are not in an archive, in order of their paths."""
    runs = []
    for path in sorted(folder.rglob("metrics.csv")):
        config = path.parent / "config.json"
        if config.exists():
            said = {key: value for key, value in _flatten(config_in(config)) if key not in WITHOUT_CONSEQUENCE}
            data = {key: str(said.pop(key)) for key in list(said) if DATA_CHECKSUMS in key.split(".")}
            if said.keys() >= TRAINED.keys():
                for key, kind in TRAINED.items():
                    if type(said[key]) is not kind:
                        raise RunError(
                            f"{config}: {key} is {said[key]!r}, which this package did not write; delete the folder {path.parent}"
                        )
                runs.append(Run(path.parent, said, table_of(read_rows(path)), data, cost=read_cost(path.parent)))
            else:
                log.warning(
                    "%s is not a training run (its configuration lacks %s) and is left out of the report",
                    path.parent,
                    ", ".join(sorted(TRAINED.keys() - said.keys())),
                )
    return runs


EVALUATED = ("checkpoint", "split", "data.name")
"""Keys that the configuration of every evaluation by ``evaluate`` has."""


def is_evaluation(run: Run) -> bool:
    """Tell whether a run was written by ``evaluate``, which trains nothing."""
    return run.config.keys() >= {*EVALUATED} and not run.config.keys() >= TRAINED.keys()


def evaluations_below(folder: Path) -> list[Run]:
    """Return all finished evaluations by ``evaluate`` below a folder, in order of their paths.

    Raises:
        RunError: a configuration cannot be read.
        MetricsError: a ``metrics.csv`` is damaged.
    """
    found = [evaluation_in(path.parent) for path in sorted(folder.rglob("metrics.csv")) if (path.parent / "config.json").exists()]
    return [run for run in found if is_evaluation(run)]


def _warn_of_replaced_data(runs: list[Run]) -> None:
    """Warn if two runs used different data with the same description, for example data that were imported again under the same name."""
    first: dict[str, Run] = {}
    for run in runs:
        description = {
            key: value for key, value in run.config.items() if key.partition(".")[0] == "data" or key.startswith("evaluation.data.")
        }
        before = first.setdefault(json.dumps(description, sort_keys=True), run)
        if any(before.data.get(key, value) != value for key, value in run.data.items()):
            log.warning("%s and %s used different data of the same name; their errors do not compare", before.folder, run.folder)


def replaced_data(runs: list[Run]) -> list[str]:
    """Return keys of data for which runs have different checksums. A run without a checksum is not compared."""
    keys = sorted({key for run in runs for key in run.data})
    return [key for key in keys if len({run.data[key] for run in runs if key in run.data}) > 1]


def starts_of(runs: Iterable[Run]) -> list[str]:
    """Return the different starts of runs' rollouts: times, or frames if the length of frames is not known. Runs whose configuration has none are left out."""
    return sorted({start for start in map(_start, runs) if start is not None})


def _start(run: Run) -> str | None:
    time, frame_dt = run.config.get("evaluation.start_time"), _of_evaluated_data(run, "solver.frame_dt")
    if time is not None:
        return f"{time:g} s"
    frame = run.config.get("evaluation.start_frame")  # of earlier versions
    frame = run.config.get("graph.history") if frame is None else frame
    if frame is None:
        return None
    stride = _of_evaluated_data(run, "stride")
    frame *= 1 if stride is None else stride
    return f"frame {frame}" if frame_dt is None else f"{frame * frame_dt:g} s"


def _of_evaluated_data(run: Run, key: str) -> Any:
    """Return a setting of the data that a run was evaluated on: those that it was trained on, unless ``evaluation.data`` says otherwise."""
    return run.config.get(f"evaluation.data.{key}", run.config.get(f"data.{key}"))


def distinct_runs(runs: list[Run]) -> list[Run]:
    """Return the runs without repetitions: of runs with the same configuration, only the first."""
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


NUM_STEPS, VAL_INTERVAL = "training.num_steps", "training.val_interval"
"""Keys of the number of steps and of the validation interval. They count as compared settings only if runs with the same other settings and seed differ in
them. Otherwise they follow from a time budget."""


def axes_of(runs: list[Run]) -> list[str]:
    """Return configuration keys whose values differ between runs, ``seed`` last."""
    keys = sorted({k for r in runs for k in r.config})
    different = [k for k in keys if len({json.dumps(r.config.get(k)) for r in runs}) > 1]
    return sorted(different, key=lambda k: (k == "seed", k))


def with_groups(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows, and the rows of unseen parameters a second time under the name ``split/group`` with a group in ``UNSEEN_GROUPS``."""
    unseen = rows[rows["parameter_group"].isin(UNSEEN_GROUPS)]
    return pd.concat([rows, unseen.assign(split=unseen["split"] + "/" + unseen["parameter_group"])], ignore_index=True)


def splits_of(run: Run) -> list[str]:
    """Return splits on which a run was evaluated, including ``split/group`` for groups of unseen parameters."""
    return sorted(with_groups(run.rows)["split"].unique())


def validation_curve(run: Run) -> Curve:
    """Return the validation curve of a run, over all its starts.

    Raises:
        MetricsError: a log is damaged.
    """
    if run.curve is not None:
        return run.curve
    points: dict[int, float] = {}
    logs = {path: path.parent.name.removeprefix("version_") for path in run.folder.glob("log/version_*/metrics.csv")}
    for path in sorted((path for path, version in logs.items() if version.isdecimal()), key=lambda path: int(logs[path])):
        with open(path, newline="", encoding="utf-8") as handle:
            reader = csv.DictReader(handle)
            try:
                for line in reader:
                    if line.get("val/one_step_nmse"):
                        points[int(line["step"]) + 1] = float(line["val/one_step_nmse"])
            except (ValueError, KeyError, TypeError, csv.Error) as error:  # also a file that is not text
                raise MetricsError(
                    f"{path}, line {reader.line_num}: damaged ({error}); delete the file, which only the curve of the validation loss needs"
                ) from None
    steps = sorted(points)
    return np.array(steps), np.array([points[s] for s in steps])


Values = list[dict[int, float]]
"""Values of one metric: for each seed that has any, the values by number of the trajectory."""


def values_by_seed(runs: list[Run], model: str, split: str, metric: str, horizon: str) -> Values:
    """Return values of a metric for each run, in order of trajectories. Runs without a value are left out.

    Args:
        runs: runs that differ in their seeds only.
        model: label of the model in the rows.
        split: a split, or ``split/group`` for one group of parameters.
        metric, horizon: as in the rows.
    """
    parent, _, group = split.partition("/")
    table = []
    for run in runs:
        rows = run.rows
        chosen = (rows["model"] == model) & (rows["metric"] == metric) & (rows["horizon"] == horizon) & (rows["split"] == parent)
        if group:
            chosen &= rows["parameter_group"] == group
        found = rows[chosen].sort_values("trajectory")
        table.append(dict(zip(found["trajectory"].tolist(), found["value"].tolist(), strict=True)))
    return [t for t in table if t]


STAND_IN = "ballistic"
"""Trivial model whose error counts for a failed rollout."""


def rollout_errors(runs: list[Run], split: str, horizon: str, model: str = LEARNED) -> Values:
    """Return rollout MSE [m²] of a model as tables show it: a failed rollout has the error of ballistic flight in the same scene over the same frames.

    The error stays infinite if ballistic flight was not evaluated. ``values_by_seed``, which has the same arguments, returns the errors without this
    replacement.
    """
    errors = []
    for run in runs:
        trivial: dict[int, float] = dict(*values_by_seed([run], STAND_IN, split, "rollout_mse", horizon))
        for seed in values_by_seed([run], model, split, "rollout_mse", horizon):
            errors.append({k: value if math.isfinite(value) else trivial.get(k, value) for k, value in seed.items()})
    return errors


def shared_trajectories(*values: Values) -> list[int]:
    """Return the numbers of the trajectories that all seeds in all of ``values`` have evaluated."""
    seeds = [set(seed) for table in values for seed in table]
    return sorted(set.intersection(*seeds)) if seeds else []


def shared_table(values: Values, trajectories: list[int] | None = None) -> np.ndarray:
    """Return values as an array [seed, trajectory]. Without ``trajectories``, the array has those that all seeds have evaluated."""
    chosen = shared_trajectories(values) if trajectories is None else trajectories
    return np.array([[seed[k] for k in chosen] for seed in values]).reshape(len(values), len(chosen))
