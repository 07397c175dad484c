"""Table and figure that show whether models read the material parameter (see ``evaluation.material_controls``).

A model reads the material if its error with a scene's own, unseen parameters is smaller than with the nearest trained ones: the 95 % interval of the ratio of
both errors is below 1. Scenes are those with interpolated parameters, because evaluation usually clamps parameters outside the trained range.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np

from gpe_pl.evaluation.horizons import time_of
from gpe_pl.evaluation.material_controls import CONTROLS, SOLVER_ENDS, SOLVER_NEAREST, UNSEEN, label_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import Interval, bootstrap_ratio, median_of_means
from gpe_pl.reports.finished_runs import (
    NUM_STEPS,
    VAL_INTERVAL,
    Run,
    Values,
    axes_of,
    rollout_errors,
    shared_table,
    shared_trajectories,
    values_by_seed,
)
from gpe_pl.reports.parameter_curves import axis_label
from gpe_pl.viz.saving import save_figure

MATERIALS_FIGURE = "reads_material.png"
FULL = "full"
"""Horizon of whole rollouts."""
INTERPOLATED = f"{UNSEEN}/interpolated"
FEWEST_SCENES = 6
"""Fewest scenes from which a verdict follows. A model that does not read the material is better in all of so many by chance in 2 % of cases."""
WITHOUT = "none"
"""Value of ``model.material_embedding`` of models without the parameter."""
EMBEDDING = "model.material_embedding"
MAY_DIFFER = {EMBEDDING, "seed", NUM_STEPS, VAL_INTERVAL, "checkpoint"}
"""Settings in which a model without the parameter may differ from the model that it is compared with."""

CURVES = {
    "own": "own value",
    "nearest": "nearest trained value",
    "middle": "middle trained value",
    "far": "farthest trained value",
    "shuffled": "value of another scene",
    WITHOUT: "trained without the parameter",
    SOLVER_NEAREST: "solver, nearest trained value",
    SOLVER_ENDS: "solver, lowest against highest",
}
"""Names of the curves in ``MATERIALS_FIGURE``."""
LONGEST_LINE = 45
"""Largest number of characters in a line of a panel's title."""

FARTHER = ("middle", "shuffled")
"""Controls that differ from a scene's own parameters by more than the nearest trained ones."""

Groups = Mapping[tuple[str, str], Sequence[Run]]
"""Runs that differ in their seeds only, by domain and label."""


def reads_material(runs: Sequence[Run]) -> tuple[bool, Interval, int] | None:
    """Return whether a model reads the material, the ratio behind it (``_over``), and the number of scenes.

    Return None unless all runs have controls and share scenes with interpolated parameters.
    """
    found = _over(runs, "nearest")
    return None if found is None else (found[0].high < 1, *found)


def _over(runs: Sequence[Run], control: str, horizon: str = FULL) -> tuple[Interval, int] | None:
    """Return the ratio of the errors up to a horizon with own parameters and with those of a control, and the number of scenes.

    Errors are means over scenes, median over seeds, and the bootstrap interval is over both.
    """
    own, other = _errors(runs, LEARNED, horizon), _errors(runs, label_of(LEARNED, control), horizon)
    scenes = shared_trajectories(own, other)
    if not scenes or len(own) != len(other):
        return None
    tables = shared_table(own, scenes), shared_table(other, scenes)
    return bootstrap_ratio(*tables, statistic=median_of_means, is_paired=True), len(scenes)


def verdict(runs: Sequence[Run]) -> str:
    """Return ``reads_material`` in words; empty if the runs have no controls."""
    found = reads_material(runs)
    if found is None:
        return ""
    _, ratio, count = found
    return (
        f"reads the material: {_answer(*found)} (error with own parameters over that with the nearest trained ones: {_ratio(ratio)}, 95 % interval, "
        f"{count} scenes with interpolated parameters)"
    )


def material_lines(groups: Groups) -> list[str]:
    """Return a table in Markdown, and a note below it, which show whether models read the material parameter.

    Each group of runs that has controls, and shares scenes with interpolated parameters, has a row with errors and their ratios. Without such a group there is
    no table.
    """
    shown = {key: runs for key, runs in groups.items() if reads_material(runs) is not None}
    if not shown:
        return []
    header = [
        "domain", "model", "own", *CONTROLS, "without the parameter", "solver, nearest", "effect", "own / nearest", "reads the material",
        *(f"own / {control}" for control in FARTHER), "own / effect",
    ]  # fmt: skip
    lines = [table_row(header), "|" + "---|" * len(header)]
    for (domain, label), runs in shown.items():
        learned = [_errors(runs, label) for label in (LEARNED, *(label_of(LEARNED, control) for control in CONTROLS))]
        solver = [_solver(runs, label) for label in (SOLVER_NEAREST, SOLVER_ENDS)]
        means = _means([*learned, _errors(_without(groups, domain, runs), LEARNED), *solver])
        own, effect = means[0], means[-1]
        found = reads_material(runs)
        assert found is not None
        fraction = f"{own / effect:.2f}" if effect > 0 else "–"
        farther = [_ratio(ratio[0]) if (ratio := _over(runs, control)) else "–" for control in FARTHER]
        lines.append(table_row([domain, label, *map(_text, means), _ratio(found[1]), _answer(*found), *farther, fraction]))
    note = (
        "Does the model read the material parameter? Rollout MSE ×1e-3 [m²] over all frames, mean over scenes with interpolated parameters, median over seeds: "
        "with a scene's own parameters, and the same model with the nearest, the middle and the farthest trained ones and with those of another scene; a model "
        "trained without the parameter; the solver with the nearest trained parameters; effect: the solver with the lowest against the highest trained "
        "parameters. A model reads the material if own / nearest has a 95 % interval below 1, over the same scenes and seeds; "
        f"fewer than {FEWEST_SCENES} scenes are too few to say. A model that uses the parameter, but is too inaccurate for the difference between neighbouring "
        "values, has only own / middle and own / shuffled below 1. A rollout that had to be stopped has failed, and counts as ballistic flight in that scene."
    )
    return [*lines, "", note, *_horizon_lines(shown)]


def _horizon_lines(groups: Groups) -> list[str]:
    """Return a table of the ratios at each horizon, and a note below it. Motion after many contacts is chaotic, so short horizons can tell more."""
    horizons = _horizons(groups)
    if not horizons:
        return []
    columns = [f"{what}, {horizon}" for what in ("own / nearest", "own / effect") for horizon in horizons]
    lines = [table_row(["domain", "model", *columns]), "|" + "---|" * (2 + len(columns))]
    for (domain, label), runs in groups.items():
        nearest = [_ratio(found[0]) if (found := _over(runs, "nearest", horizon)) else "–" for horizon in horizons]
        effects = [_means([_errors(runs, LEARNED, horizon), _solver(runs, SOLVER_ENDS, horizon)]) for horizon in horizons]
        lines.append(table_row([domain, label, *nearest, *(f"{own / effect:.2f}" if effect > 0 else "–" for own, effect in effects)]))
    return ["", *lines, "", "The same ratios for means over the frames up to a horizon."]


def _horizons(groups: Groups) -> list[str]:
    """Return the horizons of the rows, whole rollouts excluded, in ascending order."""
    found = {
        str(h) for runs in groups.values() for run in runs for h in run.rows.loc[run.rows["metric"] == "rollout_mse", "horizon"].unique()
    }
    return sorted(found - {FULL}, key=time_of)


def write_material_figure(path: Path, groups: Groups) -> None:
    """Draw the errors of each group with controls against the parameter, with the controls; nothing is written if there is no group.

    A group without the parameter has no panel of its own if it is a curve in the panel of another group.
    """
    from gpe_pl.viz.comparison import parameter_figure

    shown = {key: runs for key, runs in groups.items() if reads_material(runs) is not None}
    twins = {key: _apart(_without(groups, key[0], runs), runs) for key, runs in shown.items()}
    drawn = [run for found in twins.values() for run in found]
    shown = {key: runs for key, runs in shown.items() if len(_apart(runs, drawn)) == len(runs)}
    names = [domain for domain, _ in shown]
    curves: dict[str, dict[str, dict[float, list[float]]]] = {}
    seen: dict[str, list[float]] = {}
    axes: dict[str, str] = {}
    for (domain, label), runs in shown.items():
        title = domain if names.count(domain) == 1 else "\n".join(wrap(f"{domain}, {label}", LONGEST_LINE))
        curves[title] = {CURVES["own"]: _points(runs, LEARNED)}
        curves[title] |= {CURVES[control]: _points(runs, label_of(LEARNED, control)) for control in CONTROLS}
        curves[title][CURVES[WITHOUT]] = _points(twins[domain, label], LEARNED)
        curves[title] |= {CURVES[name]: _points(runs, name) for name in (SOLVER_NEAREST, SOLVER_ENDS)}
        curves[title] = {name: points for name, points in curves[title].items() if points}
        rows = runs[0].rows
        trained = [value for key, value in runs[0].config.items() if key.startswith("data.parameters.") and key.endswith(".seen")]
        seen[title] = _numbers(trained[0]) if len(trained) == 1 else rows[rows["parameter_group"] == "seen"]["parameter"].unique().tolist()
        axes[title] = axis_label(runs[0])
    if curves:
        figure = parameter_figure(curves, seen, "rollout MSE [m²]", axes, references=(CURVES[SOLVER_NEAREST], CURVES[SOLVER_ENDS]))
        save_figure(figure, path, dpi=150)


def _apart(runs: Sequence[Run], others: Sequence[Run]) -> list[Run]:
    """Return the runs that are not among the others."""
    return [run for run in runs if not any(run is other for other in others)]


def _answer(is_better: bool, ratio: Interval, count: int) -> str:
    if count < FEWEST_SCENES:
        return "too few scenes"
    return "yes" if is_better else "no"


def _numbers(text: object) -> list[float]:
    return [float(value) for value in json.loads(str(text))]


def _points(runs: Sequence[Run], label: str) -> dict[float, list[float]]:
    """Return the errors in all scenes with unseen parameters, by value of the parameter."""
    points: dict[float, list[float]] = {}
    for run in runs:
        rows = run.rows
        rows = rows[(rows["model"] == label) & (rows["split"] == UNSEEN) & (rows["metric"] == "rollout_mse") & (rows["horizon"] == FULL)]
        for seed in rollout_errors([run], UNSEEN, FULL, label):
            for trajectory, parameter in zip(rows["trajectory"], rows["parameter"], strict=True):
                if np.isfinite(parameter):
                    points.setdefault(float(parameter), []).append(seed[int(trajectory)])
    return points


def _without(groups: Groups, domain: str, runs: Sequence[Run]) -> list[Run]:
    """Return the runs in the same domain that were trained without the parameter. Their other settings are those of ``runs``, seeds and steps excepted."""
    others = [run for (d, _), members in groups.items() if d == domain for run in members if run.config.get(EMBEDDING) == WITHOUT]
    return [run for run in others if {*axes_of([runs[0], run])} <= MAY_DIFFER]


def _errors(runs: Sequence[Run], label: str, horizon: str = FULL) -> Values:
    return rollout_errors(list(runs), INTERPOLATED, horizon, label)


def _solver(runs: Sequence[Run], label: str, horizon: str = FULL) -> Values:
    """Return values of the solver, which are the same in all runs of a domain."""
    return values_by_seed(list(runs[:1]), label, INTERPOLATED, "rollout_mse", horizon)


def _means(tables: Sequence[Values]) -> list[float]:
    """Return the mean of each table over the scenes that all of them have, median over seeds [m²]; NaN for an empty table or without such scenes."""
    scenes = shared_trajectories(*tables)
    return [float(median_of_means(shared_table(own, scenes), axis=(-2, -1))) if own and scenes else float("nan") for own in tables]


def _text(value: float) -> str:
    return f"{1e3 * value:.3g}" if not np.isnan(value) else "–"


def _ratio(ratio: Interval) -> str:
    return f"{ratio.estimate:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"
