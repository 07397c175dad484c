"""Tables of bodies by their material parameter: ratios to the ground truth at low, middle and high values, and whether the peak stress rises with the value."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from gpe_pl.evaluation.material_controls import SOLVER_ENDS, UNSEEN, label_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.markdown import table_row
from gpe_pl.reports.finished_runs import Run, Values, values_by_seed
from gpe_pl.reports.material_table import FULL
from gpe_pl.reports.mean_text import mean_text
from gpe_pl.schema import MATERIALS

RATIOS = {
    "deformation_ratio": "deformation, ratio",
    "bounce_height_ratio": "bounce height, ratio",
    "peak_von_mises_ratio": "peak stress, ratio",
}
"""Metrics of whole rollouts in the table, with their headings."""
NUM_PARTS = 3
"""Number of parts into which the values of a split are divided."""
PEAK = "peak_von_mises"


Labelled = Sequence[tuple[str, str, Sequence[Run]]]
"""Domain, label, and runs that differ in their seeds only."""


def body_lines(groups: Labelled) -> list[str]:
    """Return two tables in Markdown, each with a note below it; empty if no group of runs has bodies with a parameter of their own."""
    return [*_ratio_lines(groups), *_peak_lines(groups)]


def _ratio_lines(groups: Labelled) -> list[str]:
    rows: list[str] = []
    for domain, label, runs in groups:
        for split in sorted(runs[0].rows["split"].unique()):
            parameters = _parameters(runs, split)
            measured = {metric: values_by_seed(list(runs), LEARNED, split, metric, FULL) for metric in RATIOS}
            if not measured["deformation_ratio"] or not parameters:
                continue
            for part in np.array_split(np.unique([*parameters.values()]), NUM_PARTS):
                scenes = {scene for scene, value in parameters.items() if value in part}
                if scenes:
                    cells = [mean_text(_chosen(values, scenes)) for values in measured.values()]
                    rows.append(table_row([domain, label, split, _range(part), str(len(scenes)), *cells]))
    if not rows:
        return []
    header = ["domain", "model", "split", "parameter", "scenes", *RATIOS.values()]
    note = (
        "Bodies over whole rollouts, by the parameter of their scenes: lowest, middle and highest third of the values of a split. Ratios are to the ground "
        "truth, means over seeds and over the scenes whose ground truth has the quantity, with 95 % bootstrap intervals over both."
    )
    return ["", table_row(header), "|" + "---|" * len(header), *rows, "", note]


def _peak_lines(groups: Labelled) -> list[str]:
    rows: list[str] = []
    for domain, label, runs in groups:
        parameters = _parameters(runs, UNSEEN)
        own, far = (values_by_seed(list(runs), name, UNSEEN, PEAK, FULL) for name in (LEARNED, label_of(LEARNED, "far")))
        ends = values_by_seed(list(runs[:1]), SOLVER_ENDS, UNSEEN, f"{PEAK}_ratio", FULL)
        material, trained = _trained(runs[0])
        if not parameters or not ends or not trained or len(own) != len(far):
            continue
        is_logarithmic = MATERIALS[material][0].scale == "log"
        rises = [
            (other[scene] - one[scene]) * (_farthest(parameters[scene], trained, is_logarithmic) - parameters[scene]) > 0
            for one, other in zip(own, far, strict=True)
            for scene in sorted(one.keys() & other.keys() & parameters.keys())
        ]
        lowest_over_highest = [*ends[0].values()]
        counts = [f"{sum(found)} of {len(found)}" for found in (rises, [ratio < 1 for ratio in lowest_over_highest])]
        rows.append(table_row([domain, label, str(len(runs)), *counts]))
    if not rows:
        return []
    header = ["domain", "model", "seeds", "rises, model", "rises, solver"]
    note = (
        "In how many scenes with unseen parameters does the peak of the von Mises stress rise with the parameter? Model: all seeds together, from the lower to "
        "the higher of a scene's own and the farthest trained value. Solver: from the lowest to the highest trained value. Equal peaks, such as those of a "
        "model without the parameter, do not rise."
    )
    return ["", table_row(header), "|" + "---|" * len(header), *rows, "", note]


def _parameters(runs: Sequence[Run], split: str) -> dict[int, float]:
    """Return the material parameter of each scene of a split that has one."""
    rows = runs[0].rows
    rows = rows[(rows["model"] == LEARNED) & (rows["split"] == split) & np.isfinite(rows["parameter"]) & (rows["trajectory"] >= 0)]
    return dict(zip(rows["trajectory"].tolist(), rows["parameter"].tolist(), strict=True))


def _chosen(values: Values, scenes: set[int]) -> Values:
    """Return the values of some scenes; seeds without any are left out."""
    return [found for seed in values if (found := {scene: value for scene, value in seed.items() if scene in scenes})]


def _range(values: np.ndarray) -> str:
    low, high = f"{values.min():.3g}", f"{values.max():.3g}"
    return low if low == high else f"{low} – {high}"


def _trained(run: Run) -> tuple[str, list[float]]:
    """Return the material whose parameter a data set varies, and its trained values; none if several materials or parameters vary."""
    found = {key: value for key, value in run.config.items() if key.startswith("data.parameters.") and key.endswith(".seen")}
    if len(found) != 1:
        return "", []
    ((key, values),) = found.items()
    return key.split(".")[2], [float(value) for value in json.loads(str(values))]


def _farthest(value: float, trained: Sequence[float], is_logarithmic: bool) -> float:
    """Return the trained value that is farthest from another one, as ``data.control_runs.TrainedValues`` chooses it."""
    ends = np.array([min(trained), max(trained)])
    distance = np.abs(np.log(ends / value)) if is_logarithmic else np.abs(ends - value)
    return float(ends[int(np.argmax(distance))])
