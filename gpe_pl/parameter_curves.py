"""How errors depend on the material parameter, trained values and others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpe_pl.evaluation import LEARNED
from gpe_pl.finished_runs import Run
from gpe_pl.schema import MATERIALS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETER_FIGURE = "error_by_parameter.png"


def parameter_curves(by_domain: dict[str, dict[str, list[Run]]]) -> Figure:
    """Rollout MSE over all frames against the material parameter, of runs by domain and label."""
    from gpe_pl.viz.comparison import parameter_figure

    curves: dict[str, dict[str, dict[float, list[float]]]] = {}
    for domain, by_label in by_domain.items():
        for label, members in by_label.items():
            points = curves.setdefault(domain, {}).setdefault(label, {})
            for row in (row for run in members for row in run.rows):
                if (row.model, row.metric, row.horizon) == (LEARNED, "rollout_mse", "full") and np.isfinite(row.parameter):
                    points.setdefault(row.parameter, []).append(row.value)
    runs = {domain: [run for members in by_label.values() for run in members] for domain, by_label in by_domain.items()}
    seen = {d: sorted({row.parameter for run in own for row in run.rows if row.parameter_group == "seen"}) for d, own in runs.items()}
    return parameter_figure(curves, seen, "rollout MSE [m²]", {domain: _axis_label(own[0]) for domain, own in runs.items()})


def _axis_label(run: Run) -> str:
    varied = [m for m in MATERIALS if any(key.startswith(f"data.parameters.{m}.") for key in run.config)]
    return ", ".join(f"{MATERIALS[m].name.replace('_', ' ')}\n[{MATERIALS[m].unit}]" for m in varied)
