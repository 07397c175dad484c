"""Lines of a sweep's table that compare strides: errors at the same instants, cost per simulated second, and edges per node."""

from __future__ import annotations

from itertools import compress

import numpy as np

from gpe_pl.evaluation.horizons import FULL, time_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_ratio
from gpe_pl.reports.finished_runs import Run, shared_table, shared_trajectories, splits_of, starts_of, values_by_seed

STRIDES_MD = "strides.md"
"""Name of the file that holds only these lines."""
AXIS = "data.stride"
LENGTHS = ("training.num_steps", "training.val_interval")
"""Keys that the table leaves out, because they always differ between runs of equal training time."""
ERROR = "final_mse"
DIFFERENT_STARTS = (
    "Rollouts start at different times ({}), so their errors are of different parts of the scenes and do not compare: evaluate all with one "
    "`evaluation.start_time=…`."
)
NOTE = (
    "Position MSE ×1e-3 [m²] at the instant, nodes and axes: median over trajectories and seeds, and the ratio of the means to the first row with its 95 % "
    "bootstrap interval over paired trajectories that no row failed. Failed: rollouts that stopped early. Cost: computing time of rollout steps per simulated "
    "second, measured in each run's evaluation, and its ratio to the first row. It is processor time on a CPU and wall time on a GPU, which do not compare. "
    "Edges: within the radius, per node, in the middle of the scenes."
)


def stride_lines(axes: list[str], variants: dict[tuple[str, ...], list[Run]]) -> list[str]:
    """Return a Markdown table of variants that differ in their stride; empty if they do not.

    Args:
        axes: configuration keys in which the variants differ.
        variants: runs by their values of these keys. The first is the reference.
    """
    if AXIS not in axes:
        return []
    first, *_ = variants.values()
    starts = starts_of(run for runs in variants.values() for run in runs)
    instants = _shared_instants(variants)
    shown = [axis not in LENGTHS for axis in axes]
    names = [axis.rpartition(".")[2] for axis in compress(axes, shown)]
    header = [*names, "split", *(f"at {instant}" for instant in instants), "failed", "cost [s/s]", "edges per node"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for split in sorted({split for runs in variants.values() for run in runs for split in splits_of(run)}):
        for key, runs in variants.items():
            errors = [_error(runs, first if len(starts) < 2 else runs, split, instant, variants) for instant in instants]
            ends = [value for seed in values_by_seed(runs, LEARNED, split, ERROR, FULL) for value in seed.values()]
            failed = f"{int(np.sum(~np.isfinite(ends)))} of {len(ends)}"
            edges = [value for seed in values_by_seed(runs, LEARNED, split, "edges_per_node", FULL) for value in seed.values()]
            lines.append(
                table_row(
                    [
                        *compress(key, shown),
                        split,
                        *errors,
                        failed,
                        _cost(runs, first),
                        f"{np.mean(edges):.1f}" if edges else "not measured",
                    ]
                )
            )
    warning = ["", f"**{DIFFERENT_STARTS.format(', '.join(starts))}**"] if len(starts) > 1 else []
    return [*lines, "", NOTE, *warning]


def _shared_instants(variants: dict[tuple[str, ...], list[Run]]) -> list[str]:
    """Return the horizons that all runs have, apart from the full length, which differs between strides."""
    found = [{*run.rows[run.rows["metric"] == ERROR]["horizon"]} for runs in variants.values() for run in runs]
    return sorted(set.intersection(*found) - {FULL}, key=time_of)


def _error(runs: list[Run], first: list[Run], split: str, instant: str, variants: dict[tuple[str, ...], list[Run]]) -> str:
    own, reference = (values_by_seed(some, LEARNED, split, ERROR, instant) for some in (runs, first))
    if not own:
        return "not measured"
    median = f"{1e3 * np.median(shared_table(own)):.3g}"
    if runs is first or not reference:
        return median
    every = [values_by_seed(some, LEARNED, split, ERROR, instant) for some in variants.values()]
    sound = [k for k in shared_trajectories(*every) if all(np.isfinite(seed[k]) for table in every for seed in table)]
    if not sound:
        return median
    ratio = bootstrap_ratio(shared_table(own, sound), shared_table(reference, sound), np.mean)
    return f"{median} (×{ratio.estimate:.2f} [{ratio.low:.2f}, {ratio.high:.2f}])"


def _cost(runs: list[Run], first: list[Run]) -> str:
    own, reference = ([run.cost for run in some if run.cost is not None] for some in (runs, first))
    if not own:
        return "not measured"
    clocks = {cost.on_gpu for cost in own}
    if len(clocks) > 1:
        return "on a CPU and on a GPU"
    mean, reference_mean = (np.mean([cost.seconds for cost in costs]) if costs else np.nan for costs in (own, reference))
    is_comparable = runs is not first and clocks == {cost.on_gpu for cost in reference}
    ratio = f" (×{mean / reference_mean:.2f})" if is_comparable else ""
    return f"{mean:.3g}{' on a GPU' if True in clocks else ''}{ratio}"
