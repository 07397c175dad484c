"""The outcome of an evaluation: mean metrics, and one line per split on how far a model is below free flight, what failed, and what else is wrong."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator

from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.reports.finished_runs import Run, rollout_errors, splits_of, values_by_seed

FREE_FLIGHT = "ballistic"
"""Baseline in which every node falls freely until it touches a wall."""
REMARKS = {
    "fraction_corrected": (0.01, "containment corrected {:.3g} % of the particle-steps"),
    "fraction_outside_at_end": (0.0, "{:.3g} % of the nodes end in walls"),
}
"""Fractions that are mentioned above a limit, with the words for their percentage."""


def means(run: Run) -> dict[str, float]:
    """Return the means of a model's metrics over trajectories, by ``split/metric@horizon``, and the number of failed rollouts, by ``split/num_failed``.

    A failed rollout has the error of ballistic flight, as in tables (``rollout_errors``).
    """
    rows = run.rows[run.rows["model"] == LEARNED]
    found: dict[str, float] = {}
    for (split, metric, horizon), values in rows.groupby(["split", "metric", "horizon"], sort=False)["value"]:
        shown = values.to_list()
        if metric == "rollout_mse":
            (errors,) = rollout_errors([run], split, horizon)
            shown = [*errors.values()]
        if (metric, horizon) == ("rollout_mse", "full"):
            found[f"{split}/num_failed"] = float(sum(not math.isfinite(value) for value in values))
        found[f"{split}/{metric}@{horizon}"] = sum(shown) / len(shown)
    return found


def outcomes(run: Run) -> Iterator[str]:
    """Yield one line per split that has rollouts of the model and of free flight over the whole horizon."""
    for split in splits_of(run):
        exact = values_by_seed([run], LEARNED, split, "rollout_mse", "full")
        flight = values_by_seed([run], FREE_FLIGHT, split, "rollout_mse", "full")
        if not (exact and flight and exact[0] and flight[0]):
            continue
        (errors,) = rollout_errors([run], split, "full")
        shared = sorted(errors.keys() & flight[0].keys())
        own, trivial = (sum(values[k] for k in shared) / max(1, len(shared)) for values in (errors, flight[0]))
        finished = {k for k, value in exact[0].items() if math.isfinite(value)}
        failed = len(exact[0]) - len(finished)
        if not finished:
            yield f"{split}: all {failed} rollouts failed"
            continue
        counted = ", and count as free flight" if failed else ""
        yield "; ".join(
            [
                f"{split}: full-horizon error {_compared(own, trivial)}",
                f"{failed} of {len(exact[0])} rollouts failed{counted}",
                *_remarks(run, split, finished),
            ]
        )


def _compared(own: float, trivial: float) -> str:
    if not (own > 0 and trivial > 0 and math.isfinite(own / trivial)):
        return f"{own:.3g} m², free flight {trivial:.3g} m²"
    ratio = trivial / own
    return (
        f"{ratio:.3g} times below free flight" if ratio >= 1 else f"{1 / ratio:.3g} times ABOVE free flight, so the model is of no use here"
    )


def _remarks(run: Run, split: str, finished: Container[int]) -> Iterator[str]:
    """Yield remarks on the rollouts with these numbers."""
    for metric, (limit, words) in REMARKS.items():
        for horizon in ("full", ""):
            for values in values_by_seed([run], LEARNED, split, metric, horizon):
                known = [value for k, value in values.items() if math.isfinite(value) and k in finished]
                if known and (mean := sum(known) / len(known)) > limit:
                    yield words.format(100 * mean)
