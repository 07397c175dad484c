"""Table of evaluations by ``evaluate`` below one folder: errors of trained models, and whether they read the material parameter.

Evaluations of the same split of a data set are compared with the first of them, scene by scene. They may differ in the checkpoint or in settings of the
rollout, such as ``evaluation.static_friction``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from gpe_pl.evaluation.material_controls import UNSEEN
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.files.run_folder import DATA_CHECKSUMS, RunError
from gpe_pl.metrics import bootstrap_interval, bootstrap_ratio, median_of_means
from gpe_pl.reports.body_table import body_lines
from gpe_pl.reports.finished_runs import Run, Values, axes_of, rollout_errors, shared_table, shared_trajectories, starts_of, values_by_seed
from gpe_pl.reports.material_table import MATERIALS_FIGURE, material_lines, write_material_figure
from gpe_pl.reports.stride_table import DIFFERENT_STARTS

log = logging.getLogger(__name__)

EVALUATIONS_MD = "table.md"
NOT_IN_LABELS = ("data", "split", "graph.history", "evaluation.material_controls", "evaluation.num_pictures")
"""Prefixes of configuration keys that labels leave out, except that of the stride, at which a model of several scales may be evaluated."""
STRIDE = "data.stride"
CHECKPOINT = "checkpoint"
OF_MODEL = "model."
"""Prefix of settings that belong to the checkpoint."""

Labelled = dict[tuple[str, str], dict[str, Run]]
"""Evaluations by domain and split, then by label."""


def report_evaluations(folder: Path, runs: Sequence[Run]) -> None:
    """Write ``table.md``, and ``reads_material.png`` if there are evaluations with controls of the material."""
    groups = labelled(runs)
    controlled = {(domain, label): [run] for (domain, split), own in groups.items() if split == UNSEEN for label, run in own.items()}
    lines = _error_lines(groups)
    if materials := material_lines(controlled):
        lines += ["", *materials]
    lines += body_lines([(domain, label, [run]) for (domain, _), own in groups.items() for label, run in own.items()])
    replace_text(folder / EVALUATIONS_MD, "\n".join([*lines, ""]))
    write_material_figure(folder / MATERIALS_FIGURE, controlled)


def labelled(runs: Sequence[Run]) -> Labelled:
    """Return evaluations by domain and split, then by label.

    A label names the checkpoint, and the settings in which the evaluations of a domain differ. Settings of models are left out if their checkpoints differ,
    and the checkpoint is left out if all have the same one and differ in settings.

    Raises:
        RunError: evaluations of one split are of different data.
    """
    groups: Labelled = {}
    for domain in dict.fromkeys(str(run.config["data.name"]) for run in runs):
        own = [run for run in runs if run.config["data.name"] == domain]
        axes = [axis for axis in axes_of(own) if axis == STRIDE or not axis.startswith(NOT_IN_LABELS)]
        checkpoints = _names_of_checkpoints(own)
        if CHECKPOINT in axes:
            axes = [axis for axis in axes if axis != CHECKPOINT and not axis.startswith(OF_MODEL)]
        for run in own:
            values = [f"{axis.rpartition('.')[2]}={run.config.get(axis)}" for axis in axes]
            label = ", ".join([checkpoints[str(run.config[CHECKPOINT])], *values] if len(checkpoints) > 1 or not values else values)
            group = groups.setdefault((domain, str(run.config["split"])), {})
            _check_data(run, [*group.values()])
            if (before := group.get(label)) is not None:
                left_out, kept = sorted((before, run), key=lambda own: len(own.rows))
                log.warning("%s repeats %s and is left out of the report", left_out.folder, kept.folder)
                group[label] = kept
            else:
                group[label] = run
    return groups


def _names_of_checkpoints(runs: Sequence[Run]) -> dict[str, str]:
    """Return names of checkpoints: those of their files, or with the checksums if different ones have the same name."""
    checkpoints = {str(run.config[CHECKPOINT]) for run in runs}
    names = {checkpoint: checkpoint.partition(".ckpt")[0] for checkpoint in checkpoints}
    return names if len({*names.values()}) == len(names) else {checkpoint: checkpoint for checkpoint in checkpoints}


def _check_data(run: Run, others: list[Run]) -> None:
    """Raise ``RunError`` if an evaluation and others of the same split are of different data, by their checksums."""
    keys, checksum = axes_of([run, *others]), f"{DATA_CHECKSUMS}.{run.config['split']}"
    if checksum in keys:
        keys = [key for key in keys if key.startswith("data.")] or [checksum]
        raise RunError(
            f"{run.folder} and {others[0].folder} are of different data of one name ({', '.join(keys[:3])}) and do not compare; "
            "move one of them to a folder of its own"
        )


def _error_lines(groups: Labelled) -> list[str]:
    header = ["domain", "split", "model", "scenes", "rollout MSE ×1e-3 [m²]", "over the first", "failed", "corrected"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for (domain, split), own in groups.items():
        errors = {label: rollout_errors([run], split, "full") for label, run in own.items()}
        first = next((found for found in errors.values() if found), [])
        for label, run in own.items():
            raw = [value for seed in values_by_seed([run], LEARNED, split, "rollout_mse", "full") for value in seed.values()]
            moved = values_by_seed([run], LEARNED, split, "fraction_corrected", "full")
            cells = [
                *(domain, split, label, str(len(raw))),
                _mean(errors[label]),
                _over(errors[label], first),
                str(sum(value == float("inf") for value in raw)),
                f"{100 * float(shared_table(moved).mean()):.2g} %" if moved else "–",
            ]
            lines.append(table_row(cells))
    note = (
        "Whole rollouts: mean over scenes with its 95 % bootstrap interval, and the ratio to the first model of the same split over the same scenes. A failed "
        "rollout counts as ballistic flight in the same scene. Corrected: fraction of particle-steps that containment moves, up to where rollouts stopped."
    )
    starts = next((found for own in groups.values() if len(found := starts_of(own.values())) > 1), [])
    return [*lines, "", note, *(["", f"**{DIFFERENT_STARTS.format(', '.join(starts))}**"] if starts else [])]


def _mean(errors: Values) -> str:
    """Return the mean error [1e-3 m²] with its interval, or a dash for an evaluation without rollouts."""
    if not errors:
        return "–"
    mean = bootstrap_interval(1e3 * shared_table(errors), statistic=median_of_means)
    return f"{mean.estimate:.3g} [{mean.low:.3g}, {mean.high:.3g}]"


def _over(errors: Values, first: Values) -> str:
    """Return the ratio of two models' errors in the scenes of both, with its interval; empty for the first model itself."""
    scenes = shared_trajectories(errors, first)
    if errors is first or not errors or not scenes:
        return ""
    ratio = bootstrap_ratio(shared_table(errors, scenes), shared_table(first, scenes), statistic=median_of_means, is_paired=True)
    return f"{ratio.estimate:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]"
