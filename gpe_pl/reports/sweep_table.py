"""Table and figure of a sweep. The settings in which its runs differ are the axes."""

from __future__ import annotations

import csv
import hashlib
import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpe_pl.errors.printable import printable
from gpe_pl.evaluation.horizons import time_of
from gpe_pl.evaluation.metric_rows import EXACT, LEARNED, read_rows
from gpe_pl.files import sealed
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.files.markdown import table_row
from gpe_pl.reports.body_table import body_lines
from gpe_pl.reports.finished_runs import (
    NUM_STEPS,
    UNSEEN_GROUPS,
    VAL_INTERVAL,
    Run,
    Values,
    axes_of,
    distinct_runs,
    evaluation_in,
    finished_runs,
    rollout_errors,
    run_name,
    shared_table,
    shared_trajectories,
    splits_of,
    starts_of,
    table_of,
    validation_curve,
    values_by_seed,
    with_groups,
)
from gpe_pl.reports.material_table import MATERIALS_FIGURE, material_lines, verdict, write_material_figure
from gpe_pl.reports.mean_text import mean_text
from gpe_pl.reports.outcome import outcomes
from gpe_pl.reports.parameter_curves import PARAMETER_FIGURE, parameter_curves
from gpe_pl.reports.ratio_table import ratio_lines
from gpe_pl.reports.stride_table import DIFFERENT_STARTS, STRIDES_MD, stride_lines
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.viz.coloring import MOST_CURVES
from gpe_pl.viz.saving import save_figure

log = logging.getLogger(__name__)

STRESS_METRICS = ("von_mises_error", "stress_error")
BODY_COLUMNS = {
    "deformation_ratio": "deformation, ratio",
    "deformation_error": "deformation, error",
    "rotation_error": "rotation error [°]",
    "strain_energy_ratio": "strain energy, ratio",
    "bounce_height_ratio": "bounce height, ratio",
    "contact_time_ratio": "contact time, ratio",
    "peak_von_mises_ratio": "peak stress, ratio",
    "contact_von_mises_error": "stress in first contact, error",
    "mirror_error": "mirror error",
}
"""Metrics of whole rollouts in the table of bodies, with their headings."""
BODY_NOTE = (
    "Bodies over whole rollouts. Ratios are to the ground truth: 1 is right, 0 is a rigid body, no bounce or no stress. Errors are relative: 1 is the "
    "error of a rigid body or of no stress. Deformation is what the best rigid motion of a body leaves. Means are over seeds and over the trajectories "
    "whose ground truth has the quantity, with intervals as above."
)

LIQUID_COLUMNS = {
    "spacing_error": "spacing",
    "density_error": "density",
    "volume_error": "volume",
    "centre_error": "centre of mass [m]",
    "spread_error": "spread",
}
"""Metrics of ``metrics.liquids`` in a table, with their headings."""
LIQUID_NOTE = (
    "Liquids in the last frame: relative errors of the distance between nearest nodes, of the density, of the volume and of the spread, and the distance of "
    "the centres of mass. None depends on which node is where."
)
SWEEP_MD = "table.md"
FORWARD_TIMES = "forward_times.json"
Variant = tuple[str, ...]
"""Values of the configuration keys in which runs of a sweep differ."""

TABLE_HORIZONS = 4
"""Number of horizons in the Markdown table, which shows the longest ones; ``table.csv`` has all."""


def report_sweep(folder: Path, runs: list[Run]) -> None:
    """Write table and figures that compare finished runs into a folder."""
    _report(folder, distinct_runs(runs))


def report(folder: Path) -> None:
    """Write table and figures of the single run in ``folder``, without runs in folders below it."""
    _report(folder, [run for run in finished_runs(folder) if run.folder == folder])


def variants_of(runs: list[Run]) -> tuple[list[str], dict[Variant, list[Run]]]:
    """Return the configuration keys in which runs differ, without the seed, and the runs by their values of these keys.

    Numbers of steps that follow from a budget of time are left out: those without which the runs still differ in the seed or another key.
    """
    axes = [axis for axis in axes_of(runs) if axis != "seed"]
    others = [axis for axis in axes if axis not in (NUM_STEPS, VAL_INTERVAL)]
    if len({tuple(str(run.config.get(key)) for key in (*others, "seed")) for run in runs}) == len(runs):
        axes = others
    variants: dict[Variant, list[Run]] = defaultdict(list)
    for run in runs:
        variants[tuple(str(run.config.get(axis)) for axis in axes)].append(run)
    return axes, variants


def _report(folder: Path, runs: list[Run]) -> None:
    """Write ``table.csv``, ``table.md``, ``strides.md`` if variants differ in their stride, and these figures.

    - ``validation_loss.png``, if every variant has a validation curve.
    - ``reads_material.png``, if a variant has controls of the material.
    - ``error_by_parameter.png``, if the first run was evaluated on unseen material parameters.

    Curves of more than ``MOST_CURVES`` variants are not drawn.
    """
    if not runs:
        return
    axes, variants = variants_of(runs)
    _write_csv(folder / "table.csv", axes, runs)
    ratios = forward_time_ratios(folder, variants)
    replace_text(folder / SWEEP_MD, _markdown(axes, variants, ratios))
    if strides := stride_lines(axes, variants):
        replace_text(folder / STRIDES_MD, "\n".join([*strides, ""]))
    curves = {", ".join(v) or LEARNED: [validation_curve(r) for r in members] for v, members in variants.items()}
    curves = {k: [c for c in v if len(c[0])] for k, v in curves.items()}
    can_be_drawn = len(variants) <= MOST_CURVES
    if not can_be_drawn:
        log.warning("%s: %d variants, but no more than %d can be told apart in one figure; tables only", folder, len(variants), MOST_CURVES)
    if can_be_drawn and all(curves.values()):
        from gpe_pl.viz.figures import validation_loss_figure

        save_figure(validation_loss_figure(curves), folder / "validation_loss.png", dpi=150)
    write_material_figure(folder / MATERIALS_FIGURE, _material_groups(variants))
    rows = runs[0].rows
    if can_be_drawn and (rows["parameter_group"].isin(UNSEEN_GROUPS) & np.isfinite(rows["parameter"])).any():
        by_label = {", ".join(v) or LEARNED: members for v, members in variants.items()}
        save_figure(parameter_curves({str(runs[0].config["data.name"]): by_label}), folder / PARAMETER_FIGURE, dpi=150)


def _material_groups(variants: dict[Variant, list[Run]]) -> dict[tuple[str, str], list[Run]]:
    return {(str(runs[0].config["data.name"]), ", ".join(v) or LEARNED): runs for v, runs in variants.items()}


def report_evaluation(folder: Path) -> None:
    """Write ``reads_material.png`` for an evaluation by ``evaluate``, if it has controls of the material."""
    run = evaluation_in(folder)
    write_material_figure(folder / MATERIALS_FIGURE, _material_groups({(): [run]}))


def conclusion(folder: Path) -> str:
    """Return the text that a command prints at its end: metrics of the run or evaluation in a folder, viewers, and what follows from them.

    The last lines are ``outcome.outcomes``, and whether the model reads the material.
    """
    viewers = sorted(folder.glob("rollout_*_00.html"))
    rows = table_of(read_rows(folder / "metrics.csv"))
    run = Run(folder, {}, rows)
    said = [*outcomes(run), *filter(None, [verdict([run])])]
    return "\n".join([summary(rows), *(printable(f"look at {viewer}") for viewer in viewers), *said])


def summary(rows: pd.DataFrame) -> str:
    """Return means over trajectories as plain text: one line per split, metric and model, one column per horizon.

    For trivial models and controls, only the rollout MSE is shown.
    """
    shown = with_groups(rows[rows["model"].isin([LEARNED, EXACT]) | (rows["metric"] == "rollout_mse")])
    groups: dict[tuple[str, str, str], dict[str, float]] = defaultdict(dict)
    for (split, metric, model, horizon), value in shown.groupby(["split", "metric", "model", "horizon"])["value"].mean().items():
        groups[split, metric, model][horizon] = value
    horizons = sorted({*rows["horizon"]} - {"1", "full"}, key=time_of)
    lines = [(("split", "metric", "model"), "".join(f"{h:>11}" for h in (*horizons, "full")))]
    for key, values in sorted(groups.items()):
        if "1" in values:  # a metric of one step, shown in the last column
            values["full"] = values["1"]
        lines.append((key, "".join(f"{values[h]:11.4g}" if h in values else " " * 11 for h in (*horizons, "full"))))
    widths = [max(len(key[column]) for key, _ in lines) for column in range(3)]
    said = scenes_left_out([Run(Path(), {}, rows)], [*horizons, "full"])
    return "\n".join(
        [*(" ".join(f"{name:{width}}" for name, width in zip(key, widths, strict=True)) + cells for key, cells in lines), *said]
    )


def _column(axis: str) -> str:
    return axis.rpartition(".")[2]


def _write_csv(path: Path, axes: list[str], runs: list[Run]) -> None:
    """Write means over trajectories and the last validation loss: one line per variant, seed, split, metric and horizon."""
    lines: list[list[Any]] = []
    for run in runs:
        key = [run.config.get(a) for a in axes]
        rows = with_groups(run.rows[run.rows["model"] == LEARNED])
        means = rows.groupby(["split", "metric", "horizon"])["value"].mean().to_dict()
        steps, losses = validation_curve(run)
        if len(steps):
            means["val", "one_step_nmse", "1"] = float(losses[-1])
        lines += [[*key, run.config.get("seed"), *group, value] for group, value in sorted(means.items())]
    with replacing(path) as part, open(part, "w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle)
        writer.writerow([*(_column(a) for a in axes), "seed", "split", "metric", "horizon", "value"])
        writer.writerows(lines)


def forward_time_ratios(folder: Path, variants: dict[Variant, list[Run]]) -> dict[Variant, float]:
    """Return the forward time of each variant divided by that of the first, as measured by ``benchmarks.forward_times``; empty if it was not measured."""
    path = folder / FORWARD_TIMES
    if not path.exists():
        return {}
    measured = sealed.read(path, "delete it; the command of the sweep measures again")
    names = {variant: run_name(members[0], folder) for variant, members in variants.items()}
    if networks_in(measured) != {names[variant]: network_digest(members[0]) for variant, members in variants.items()}:
        return {}
    return {variant: measured[name]["ratio"] for variant, name in names.items()}


def network_digest(run: Run) -> str:
    """Return a digest of the settings that the forward time of a run's model depends on: those of its network and of its graphs."""
    settings = {key: value for key, value in run.config.items() if key.startswith(("model.", "graph."))}
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]


def networks_in(measured: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of the networks in a file of forward times, by the name of their run; empty for a file of an earlier version."""
    return {name: entry["network"] for name, entry in measured.items() if isinstance(entry, dict)}


def _markdown(axes: list[str], variants: dict[Variant, list[Run]], ratios: dict[Variant, float]) -> str:
    names = [_column(a) for a in axes] or ["model"]
    return "\n".join(
        [
            *_training_table(names, variants, ratios),
            "",
            *_rollout_table(names, variants),
            *_different_starts(variants),
            *ratio_lines(axes, variants, _horizons(run for runs in variants.values() for run in runs)),
            *_stress_table(names, variants),
            *_metric_table(names, variants, BODY_COLUMNS, BODY_NOTE),
            *body_lines([(*key, runs) for key, runs in _material_groups(variants).items()]),
            *_metric_table(names, variants, LIQUID_COLUMNS, LIQUID_NOTE),
            *(["", *strides] if (strides := stride_lines(axes, variants)) else []),
            *(["", *lines] if (lines := material_lines(_material_groups(variants))) else []),
            "",
        ]
    )


def _training_table(names: list[str], variants: dict[Variant, list[Run]], ratios: dict[Variant, float]) -> list[str]:
    header = [
        *names,
        "seeds",
        "steps",
        "validation loss (one-step nMSE)",
        "forward time",
        "momentum error, test [m/s]",
        "outside without containment",
        "corrected",
    ]
    lines = table_row(header), "|" + "---|" * len(header)
    rows = []
    for key, runs in variants.items():
        losses = [loss[-1] for _, loss in (validation_curve(r) for r in runs) if len(loss)]
        rows.append(
            table_row(
                [
                    *(key or (LEARNED,)),
                    str(len(runs)),
                    _steps(runs),
                    f"{np.mean(losses):.4f} ({min(losses):.4f} – {max(losses):.4f})" if losses else "–",
                    f"{ratios[key]:.2f}" if key in ratios else "–",
                    mean_text(values_by_seed(runs, LEARNED, "test", "momentum_error", "full")),
                    _percent(values_by_seed(runs, LEARNED, "test", "fraction_outside_uncontained", "full")),
                    _percent(values_by_seed(runs, LEARNED, "test", "fraction_corrected", "full"))
                    + _failed(values_by_seed(runs, LEARNED, "test", "rollout_mse", "full")),
                ]
            )
        )
    note = (
        "Validation loss: last value, mean over seeds (range). Forward time: trained models on one graph, by PyTorch's operations alone, "
        "median of paired ratios to the first row. "
        "Outside: fraction of particle-frames inside a wall or obstacle when containment is off; corrected: fraction of particle-steps that containment moves, "
        "up to where rollouts stopped."
    )
    return [*lines, *rows, "", note]


def _rollout_table(names: list[str], variants: dict[Variant, list[Run]]) -> list[str]:
    runs_of_all = [run for runs in variants.values() for run in runs]
    splits = sorted({split for run in runs_of_all for split in splits_of(run)})
    horizons = _horizons(runs_of_all)
    baselines = sorted({model for run in runs_of_all for model in run.rows["model"]} & {*BASELINES})
    header = [*names, "split", *(f"@{h}" for h in horizons)]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for split in splits:
        for key, runs in variants.items():
            cells = []
            for h in horizons:
                values = rollout_errors(runs, split, h)
                trivial = [v for b in baselines if (v := values_by_seed(runs[:1], b, split, "rollout_mse", h))]
                failed = _failed(values_by_seed(runs, LEARNED, split, "rollout_mse", h))
                cells.append(mean_text(values, 1e3) + _factor(_times_lower(values, trivial)) + failed if values else "–")
            lines.append(table_row([*(key or (LEARNED,)), split, *cells]))
        for baseline in baselines:
            rows: defaultdict[tuple[str, ...], list[Variant]] = defaultdict(list)  # most sweeps evaluate all variants in the same scenes
            for key, runs in variants.items():
                rows[tuple(mean_text(values_by_seed(runs[:1], baseline, split, "rollout_mse", h), 1e3) for h in horizons)].append(key)
            rows.pop(("–",) * len(horizons), None)
            for shown, keys in rows.items():
                of = f"{baseline} ({' / '.join(', '.join(key) for key in keys)})" if len(rows) > 1 else baseline
                lines.append(table_row([of, *[""] * (len(names) - 1), split, *shown]))
    note = (
        "Rollout MSE ×1e-3 [m²] over frames 1 … h, nodes and axes: mean over trajectories and seeds, 95 % bootstrap interval over both (too narrow where "
        "seeds or trajectories are few), and how many times lower than the best trivial baseline (bold where it is lower). A rollout that had to be "
        "stopped has failed, and counts as ballistic flight in the same scene."
    )
    if "test_unseen" in splits:
        note += " `test_unseen` holds material parameters that training did not have, between the trained ones and outside their range."
    other_scenes = [f"{', '.join(key) or LEARNED}: {said}" for key, runs in variants.items() for said in scenes_left_out(runs, horizons)]
    return [*lines, "", note, *(line for said in (*other_scenes, *unlike_scenes(variants)) for line in ("", f"**{said}**"))]


def scenes_left_out(runs: list[Run], horizons: Iterable[str]) -> list[str]:
    """Say which columns of a table are means over fewer scenes than others, because trajectories are shorter or seeds have evaluated other scenes.

    Args:
        runs: runs that differ in their seeds only.
        horizons: horizons of the columns.
    """
    said = []
    for split in sorted({split for run in runs for split in splits_of(run) if "/" not in split}):
        found = {h: values_by_seed(runs, LEARNED, split, "rollout_mse", h) for h in horizons}
        scenes = {k for values in found.values() for seed in values for k in seed}
        counts = {h: len(shared_trajectories(values)) for h, values in found.items() if values}
        fewer = [f"{count} at {h}" for h, count in counts.items() if count < len(scenes)]
        if fewer:
            said.append(
                f"of {len(scenes)} scenes of `{split}`, columns have only {', '.join(fewer)}, so columns with other scenes cannot be compared"
            )
    return said


def unlike_scenes(variants: Mapping[Variant, list[Run]]) -> list[str]:
    """Say which variants of a data set have evaluated other scenes of a split than others, so that means over all scenes cannot be compared."""
    said = []
    for domain in dict.fromkeys(str(run.config["data.name"]) for runs in variants.values() for run in runs):
        own = {key: runs for key, runs in variants.items() if str(runs[0].config["data.name"]) == domain}
        for split in sorted({split for runs in own.values() for run in runs for split in splits_of(run) if "/" not in split}):
            found = {key: shared_trajectories(values) for key, runs in own.items() if (values := rollout_errors(runs, split, "full"))}
            if len({tuple(scenes) for scenes in found.values()}) > 1:
                counts = ", ".join(f"{len(scenes)} ({', '.join(key) or LEARNED})" for key, scenes in found.items())
                said.append(f"rows of {domain} have other scenes of `{split}`: {counts}; only ratios over the same scenes compare them")
    return said


def _different_starts(variants: dict[Variant, list[Run]]) -> list[str]:
    """Return a warning for rollouts that start at different times; empty if there are none. Variants of several domains may."""
    by_domain: dict[str, list[Run]] = defaultdict(list)
    for run in (run for runs in variants.values() for run in runs):
        by_domain[str(run.config["data.name"])].append(run)
    starts = next((found for runs in by_domain.values() if len(found := starts_of(runs)) > 1), [])
    return ["", f"**{DIFFERENT_STARTS.format(', '.join(starts))}**"] if starts else []


def _horizons(runs: Iterable[Run]) -> list[str]:
    found = {horizon for run in runs for horizon in run.rows[run.rows["metric"] == "rollout_mse"]["horizon"]}
    return sorted(found, key=time_of)[-TABLE_HORIZONS:]


def _stress_table(names: list[str], variants: dict[Variant, list[Run]]) -> list[str]:
    """Return a table of the errors of displacement, velocity and stress for models that decode a stress; empty if none does."""
    stressed = {key: runs for key, runs in variants.items() if runs[0].rows["metric"].isin(STRESS_METRICS).any()}
    if not stressed:
        return []
    horizons = _horizons(run for runs in stressed.values() for run in runs)
    header = [*names, "split", "relative error", *(f"@{h}" for h in horizons)]
    lines = ["", table_row(header), "|" + "---|" * len(header)]
    for key, runs in stressed.items():
        for split in sorted({split for run in runs for split in run.rows["split"]}):
            for metric in ("displacement_error", "velocity_error", *STRESS_METRICS):
                cells = [mean_text(values_by_seed(runs, LEARNED, split, metric, h)) for h in horizons]
                lines.append(table_row([*(key or (LEARNED,)), split, metric.removesuffix("_error").replace("_", " "), *cells]))
    note = (
        "L2 errors relative to the ground truth's displacement and velocity up to the horizon, and to its stress over all frames; von Mises stress, and stress "
        "as a tensor, at mesh nodes. Mean over trajectories and seeds with its interval, as above."
    )
    return [*lines, "", note]


def _metric_table(names: list[str], variants: dict[Variant, list[Run]], headings: dict[str, str], note: str) -> list[str]:
    """Return a table of some metrics over whole rollouts; empty if no variant has the first of them."""
    measured = {metric for runs in variants.values() for run in runs for metric in run.rows["metric"].unique()}
    columns = {metric: heading for metric, heading in headings.items() if metric in measured}
    if next(iter(headings)) not in columns:
        return []
    header = [*names, "split", *columns.values()]
    lines = ["", table_row(header), "|" + "---|" * len(header)]
    for key, runs in variants.items():
        for split in splits_of(runs[0]):
            cells = [mean_text(values_by_seed(runs, LEARNED, split, metric, "full")) for metric in columns]
            lines.append(table_row([*(key or (LEARNED,)), split, *cells]))
    return [*lines, "", note]


def _factor(ratio: float) -> str:
    if ratio == 0 or np.isnan(ratio):  # failed rollouts make the mean infinite, or no trivial model was evaluated
        return ""
    return f" **{ratio:.1f}×**" if ratio > 1 else f" {ratio:.2g}×" if ratio >= 0.01 else " < 0.01×"


def _times_lower(values: Values, trivial: list[Values]) -> float:
    """Return the smallest ratio of the mean of a trivial model to that of a model, in the scenes that both have."""
    shared = [(other, scenes) for other in trivial if (scenes := shared_trajectories(values, other))]
    return min(
        (float(shared_table(other, scenes).mean() / shared_table(values, scenes).mean()) for other, scenes in shared), default=float("nan")
    )


def _failed(values: Values) -> str:
    """Return the number of failed rollouts as text; empty if none failed."""
    numbers = [value for seed in values for value in seed.values()]
    failed = sum(not np.isfinite(value) for value in numbers)
    return f", {failed} of {len(numbers)} failed" if failed else ""


def _steps(runs: list[Run]) -> str:
    """Return the number of training steps as text: a range if it differs between seeds."""
    steps = sorted({int(run.config[NUM_STEPS]) for run in runs if NUM_STEPS in run.config})
    return " – ".join(f"{number:,}" for number in dict.fromkeys((*steps[:1], *steps[-1:]))) or "–"


def _percent(values: Values) -> str:
    return f"{100 * float(shared_table(values).mean()):.3f} %" if values else "–"
