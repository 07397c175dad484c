"""Means over scenes and seeds as text, with their intervals."""

from __future__ import annotations

import numpy as np

from gpe_pl.metrics import bootstrap_interval
from gpe_pl.reports.finished_runs import Values, shared_table


def mean_text(values: Values, scale: float = 1.0) -> str:
    """Format a mean with its bootstrap interval. If rollouts failed, the mean is infinite; then the number of failures and the median are shown."""
    if not values:
        return "–"
    table = shared_table(values) * scale
    failed = int(np.sum(~np.isfinite(table)))
    if failed:
        return f"{failed} of {table.size} failed, median {np.median(table):.3g}"
    i = bootstrap_interval(table, statistic=np.mean)
    return f"{i.estimate:.3g} [{i.low:.3g}, {i.high:.3g}]"
