"""Figure of errors against the material parameter, for trained and unseen values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.reports.finished_runs import Run, rollout_errors
from gpe_pl.schema import MATERIALS
from gpe_pl.viz.captions import UNITS, parameter_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETER_FIGURE = "error_by_parameter.png"


def parameter_curves(by_domain: dict[str, dict[str, list[Run]]]) -> Figure:
    """Return a figure of the rollout MSE over all frames against the material parameter. Failed rollouts count as in ``rollout_errors``.

    Args:
        by_domain: runs by domain and label of the curve.
    """
    from gpe_pl.viz.comparison import parameter_figure

    curves: dict[str, dict[str, dict[float, list[float]]]] = {}
    seen: dict[str, set[float]] = {}
    for domain, by_label in by_domain.items():
        for label, members in by_label.items():
            points = curves.setdefault(domain, {}).setdefault(label, {})
            for run in members:
                rows = run.rows
                rows = rows[(rows["model"] == LEARNED) & (rows["metric"] == "rollout_mse") & (rows["horizon"] == "full")]
                rows = rows[np.isfinite(rows["parameter"])]
                for split, of_split in rows.groupby("split"):
                    (errors,) = rollout_errors([run], str(split), "full")
                    for trajectory, parameter in zip(of_split["trajectory"], of_split["parameter"], strict=True):
                        points.setdefault(float(parameter), []).append(errors[int(trajectory)])
                seen.setdefault(domain, set()).update(rows[rows["parameter_group"] == "seen"]["parameter"].tolist())
    labels = {domain: axis_label(next(iter(by_label.values()))[0]) for domain, by_label in by_domain.items()}
    return parameter_figure(curves, {domain: sorted(values) for domain, values in seen.items()}, "rollout MSE [m²]", labels)


def axis_label(run: Run) -> str:
    """Return the label of an axis with the material parameters of a run's data set."""
    varied = [MATERIALS[m][0] for m in MATERIALS if any(key.startswith(f"data.parameters.{m}.") for key in run.config)]
    units = [UNITS.get(p.unit, p.unit).strip() for p in varied]
    return ", ".join(f"{parameter_name(p)} [{unit}]" if unit else parameter_name(p) for p, unit in zip(varied, units, strict=True))
