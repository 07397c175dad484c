"""Compares models by metric and horizon, over the same scenes: the table ``horizons.md`` of a folder in ``docs/results``.

``python docs/compared_horizons.py TARGET METRICS FIRST OTHER…`` takes folders in which ``python -m gpe_pl.evaluate`` evaluated models, and METRICS such as
``rollout_mse,deformation_error``. It writes the mean of each model, and the ratio of each OTHER to FIRST with its 95 % bootstrap interval over scenes and
seeds. ``FOLDER,FOLDER`` are several seeds of one model. Columns are named after the first folder of a model.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from gpe_pl.evaluation.horizons import time_of
from gpe_pl.evaluation.metric_rows import LEARNED, read_rows
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_ratio

CAPTION = "Mean of the values up to a horizon, and ratio to the first model with its 95 % bootstrap interval, over the same scenes and over seeds."


def values_of(folder: Path) -> dict[tuple[str, str], dict[int, float]]:
    """Return the values of the learned model by metric and horizon, and then by scene."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    for row in read_rows(folder / "metrics.csv"):
        if row.model == LEARNED and row.trajectory >= 0:
            found.setdefault((row.metric, row.horizon), {})[row.trajectory] = row.value
    return found


def table(metrics: list[str], models: list[list[Path]]) -> str:
    """Return the table in Markdown. Each model has a folder per seed.

    Raises:
        ValueError: a folder lacks a metric.
    """
    own = [[values_of(folder) for folder in seeds] for seeds in models]
    first, *others = (seeds[0].name for seeds in models)
    columns = ["metric", "up to", "scenes", first, *(text for other in others for text in (other, f"{other} / {first}"))]
    lines = [table_row(columns), "|" + "---|" * len(columns)]
    for metric in metrics:
        horizons = sorted((h for m, h in own[0][0] if m == metric), key=time_of)
        if not horizons:
            raise ValueError(f"{models[0][0]}: has no metric {metric}")
        for horizon in horizons:
            at = [[values.get((metric, horizon), {}) for values in seeds] for seeds in own]
            scenes = sorted(set(at[0][0]).intersection(*(values for seeds in at for values in seeds)))
            arrays = [np.array([[values[k] for k in scenes] for values in seeds]) for seeds in at]
            cells = [metric, horizon, str(len(scenes)), f"{arrays[0].mean():.3g}"]
            for array in arrays[1:]:
                ratio = bootstrap_ratio(array, arrays[0], np.mean)
                cells += [f"{array.mean():.3g}", f"{ratio.estimate:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"]
            lines.append(table_row(cells))
    return "\n".join([*lines, "", CAPTION]) + "\n"


if __name__ == "__main__":
    target, metrics, *models = sys.argv[1:]
    replace_text(Path(target) / "horizons.md", table(metrics.split(","), [[*map(Path, model.split(","))] for model in models]))
