"""How errors depend on the material parameter, trained values and others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpe_pl.evaluation import LEARNED
from gpe_pl.finished_runs import Run, rollout_errors
from gpe_pl.schema import MATERIALS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETER_FIGURE = "error_by_parameter.png"


def parameter_curves(by_domain: dict[str, dict[str, list[Run]]]) -> Figure:
    """Rollout MSE over all frames against the material parameter, of runs by domain and label; failed rollouts as in ``rollout_errors``."""
    from gpe_pl.viz.comparison import parameter_figure

    curves: dict[str, dict[str, dict[float, list[float]]]] = {}
    seen: dict[str, set[float]] = {}
    for domain, by_label in by_domain.items():
        for label, members in by_label.items():
            points = curves.setdefault(domain, {}).setdefault(label, {})
            for run in members:
                errors: dict[str, dict[int, float]] = {}
                for row in run.rows:
                    if (row.model, row.metric, row.horizon) == (LEARNED, "rollout_mse", "full") and np.isfinite(row.parameter):
                        if row.split not in errors:
                            (errors[row.split],) = rollout_errors([run], row.split, "full")
                        points.setdefault(row.parameter, []).append(errors[row.split][row.trajectory])
                        if row.parameter_group == "seen":
                            seen.setdefault(domain, set()).add(row.parameter)
    labels = {domain: _axis_label(next(iter(by_label.values()))[0]) for domain, by_label in by_domain.items()}
    return parameter_figure(curves, {domain: sorted(values) for domain, values in seen.items()}, "rollout MSE [m²]", labels)


def _axis_label(run: Run) -> str:
    varied = [m for m in MATERIALS if any(key.startswith(f"data.parameters.{m}.") for key in run.config)]
    return ", ".join(f"{MATERIALS[m].name.replace('_', ' ')}\n[{MATERIALS[m].unit}]" for m in varied)
