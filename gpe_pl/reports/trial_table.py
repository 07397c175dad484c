"""Table of trials: for each model and domain, compares several settings and marks the best.

Settings are compared by the rollout MSE over all frames. It is averaged over the trajectories of a split that all runs of a domain have evaluated; then the
median over seeds is taken. Failed rollouts count as in ``finished_runs.rollout_errors``.
"""

from __future__ import annotations

import csv
import logging
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import BOTH, bootstrap_interval, median_of_means
from gpe_pl.reports.domain_table import TABLE_MD, TABLES, domain_of, model_of
from gpe_pl.reports.finished_runs import (
    NUM_STEPS,
    VAL_INTERVAL,
    Run,
    axes_of,
    distinct_runs,
    rollout_errors,
    shared_table,
    shared_trajectories,
    starts_of,
    validation_curve,
    values_by_seed,
)
from gpe_pl.reports.stride_table import DIFFERENT_STARTS

log = logging.getLogger(__name__)

TRIALS_CSV, TRIALS_MD = "trials.csv", "trials.md"
CONSEQUENCES = (VAL_INTERVAL, "seed")
"""Keys that may differ between trials but are not compared: the validation interval, which follows from the number of steps, and the seed."""


def compares_settings(runs: list[Run]) -> bool:
    """Whether there are runs of several models or domains, and several settings of at least one of them."""
    groups = _by_model(runs)
    return len(groups) > 1 and any(_settings(runs) for runs in groups.values())


def report_trials(folder: Path, runs: list[Run]) -> None:
    """Write ``trials.csv``, with one line per run and split, and ``trials.md``, with one line per setting and the best of each domain and model in bold.

    An existing table of ``domain_table`` is deleted, because it would not show all runs.
    """
    runs = distinct_runs(runs)
    groups = _by_model(runs)
    settings = sorted({key for members in groups.values() for key in _settings(members)})
    splits = sorted({split for run in runs for split in run.rows["split"]})
    columns = [key.rpartition(".")[2] for key in settings]
    _write_csv(folder / TRIALS_CSV, groups, settings, columns, splits)
    scenes, left_out = _scenes(groups, splits)
    header = ["domain", "model", *columns, "seeds", "one-step nMSE", *splits]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for (domain, model), members in sorted(groups.items()):
        variants: dict[tuple[str, ...], list[Run]] = defaultdict(list)
        for run in members:
            variants[tuple(str(run.config.get(key)) for key in settings)].append(run)
        error = {v: {s: _error(runs, s, scenes[domain, s]) for s in splits} for v, runs in variants.items()}
        best = {s: min(error[v][s] for v in variants) for s in splits}
        is_compared = len(starts_of(members)) < 2
        for v, runs in sorted(variants.items()):
            cells = [
                _cell(
                    runs,
                    s,
                    scenes[domain, s],
                    error[v][s],
                    is_best=bool(is_compared and np.isfinite(error[v][s]) and error[v][s] == best[s]),
                )
                for s in splits
            ]
            losses = [loss[-1] for _, loss in (validation_curve(r) for r in runs) if len(loss)]
            lines.append(table_row([domain, model, *v, str(len(runs)), f"{np.mean(losses):.3f}" if losses else "–", *cells]))
    note = (
        "Rollout MSE ×1e-3 [m²] over all frames: mean over the trajectories of a split, median over seeds, 95 % bootstrap interval over both (of one seed "
        "it says nothing about training by other seeds). A rollout that had to be stopped has failed, and counts as ballistic flight in the same scene. Bold: "
        "best of a domain and model. "
        "One-step nMSE: of the validation split, relative to free fall."
    ) + (f" Left out, because not all runs have them: {', '.join(left_out)}." if left_out else "")
    starts = next((found for members in groups.values() if len(found := starts_of(members)) > 1), [])
    warning = ["", f"**{DIFFERENT_STARTS.format(', '.join(starts))}**"] if starts else []
    replace_text(folder / TRIALS_MD, "\n".join([*lines, "", note, *warning, ""]))
    if (folder / TABLE_MD).exists():
        for name in TABLES:
            (folder / name).unlink(missing_ok=True)
        log.warning(
            "%s: now compares settings (%s), and its table of models is deleted; to restore it, move the runs that do not belong to it to another name=…",
            folder,
            ", ".join(settings),
        )


def _by_model(runs: list[Run]) -> dict[tuple[str, str], list[Run]]:
    groups: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        groups[domain_of(run), model_of(run)].append(run)
    return groups


def _settings(runs: list[Run]) -> list[str]:
    """Return the configuration keys of the settings that trials compare."""
    keys = [key for key in axes_of(runs) if key not in (*CONSEQUENCES, NUM_STEPS)]
    steps: dict[tuple[str, ...], set[Any]] = defaultdict(set)
    for run in runs:
        steps[tuple(str(run.config.get(key)) for key in (*keys, "seed"))].add(run.config[NUM_STEPS])
    return [*keys, NUM_STEPS] if any(len(found) > 1 for found in steps.values()) else keys


def _scenes(groups: dict[tuple[str, str], list[Run]], splits: list[str]) -> tuple[dict[tuple[str, str], list[int]], list[str]]:
    """Return the trajectories that all runs of a domain have evaluated, by domain and split, and in words those that some runs lack."""
    scenes, left_out = {}, []
    for domain in sorted({domain for domain, _ in groups}):
        runs = [run for (d, _), members in groups.items() if d == domain for run in members]
        for split in splits:
            errors = rollout_errors(runs, split, "full")
            scenes[domain, split] = shared_trajectories(errors)
            count = len({trajectory for seed in errors for trajectory in seed})
            if missing := count - len(scenes[domain, split]):
                left_out.append(f"{missing} of {count} trajectories of `{split}` of {domain}")
    return scenes, left_out


def _error(runs: list[Run], split: str, scenes: list[int]) -> float:
    errors = shared_table(rollout_errors(runs, split, "full"), scenes)
    return float(median_of_means(errors, BOTH)) if errors.size else float("inf")


def _cell(runs: list[Run], split: str, scenes: list[int], error: float, *, is_best: bool) -> str:
    as_they_are = shared_table(values_by_seed(runs, LEARNED, split, "rollout_mse", "full"), scenes)
    if not as_they_are.size:
        return "–"
    failed = f"{int((~np.isfinite(as_they_are)).sum())} of {as_they_are.size} failed"
    if not np.isfinite(error):  # ballistic flight was not evaluated
        return failed
    i = bootstrap_interval(shared_table(rollout_errors(runs, split, "full"), scenes), statistic=median_of_means)
    text = f"{1e3 * error:.3g}"
    cell = f"{f'**{text}**' if is_best else text} [{1e3 * i.low:.3g}, {1e3 * i.high:.3g}]"
    return cell if np.isfinite(as_they_are).all() else f"{cell}, {failed}"


def _write_csv(path: Path, groups: dict[tuple[str, str], list[Run]], settings: list[str], columns: list[str], splits: list[str]) -> None:
    with replacing(path) as part, open(part, "w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle)
        writer.writerow(["domain", "model", *columns, "num_steps", "seed", "split", "num_trajectories", "num_failed", "rollout_mse"])
        for (domain, model), runs in sorted(groups.items()):
            for run in runs:
                for split in splits:
                    for values in values_by_seed([run], LEARNED, split, "rollout_mse", "full"):
                        about = [
                            domain,
                            model,
                            *(run.config.get(key) for key in settings),
                            run.config["training.num_steps"],
                            run.config["seed"],
                        ]
                        errors = np.array([*values.values()])
                        writer.writerow([*about, split, errors.size, int((~np.isfinite(errors)).sum()), float(errors.mean())])
