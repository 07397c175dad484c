"""Table that compares models of several scales with models of one, at each spacing and frame interval (``experiment=scales``)."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from gpe_pl.evaluation.horizons import FULL, time_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_ratio
from gpe_pl.reports.domain_table import TableError
from gpe_pl.reports.finished_runs import Run, axes_of, distinct_runs, rollout_errors, shared_table, shared_trajectories, values_by_seed

SCALES_MD = "scales.md"
"""Name of the file."""
USE, SPECIALIST = "graph.scales", "one"
COMPARED = {"dimensionless": "several scales", "dimensional": "without features"}
"""Values of ``USE`` of the models that are compared with specialists, and their names in the table."""
SPACING, STRIDE, FRAME = "evaluation.data.spacing_factor", "evaluation.data.stride", "data.solver.frame_dt"
MAY_DIFFER = (
    "seed",
    USE,
    "data.name",
    "data.scales",
    "data.spacing_factor",
    "data.stride",
    "data.scene.grid_spacing",
    "data.solver.grid_spacing",
    SPACING,
    STRIDE,
)
"""Prefixes of the keys in which models of one scale and of several scales may differ. They set the seed, the spacing and the frame interval."""
NOTE = (
    "Ratios of rollout MSE to that of a model that was trained on this spacing and frame interval alone, with as many steps: ratio of the means over scenes, "
    "95 % bootstrap interval over paired scenes. A rollout that had to be stopped counts as ballistic flight in the same scene. Failed: rollouts that stopped, "
    "of the specialist and of the compared models. In training: whether the models of several scales were trained on this spacing and on this frame interval."
)

Cell = tuple[float, float]
"""Spacing [m] and frame interval [s]."""


def compares_scales(runs: list[Run]) -> bool:
    """Tell whether some of the runs were trained on several scales, and evaluated on data that ``evaluation.data`` names."""
    return any(run.config.get(USE) in COMPARED and SPACING in run.config for run in runs)


def report_scales(folder: Path, runs: list[Run]) -> None:
    """Write ``scales.md`` into a folder.

    Raises:
        TableError: runs of one spacing, frame interval and value of ``USE`` differ in more than the seed, or runs differ in keys not in ``MAY_DIFFER``.
    """
    replace_text(folder / SCALES_MD, "\n".join([*scale_lines(distinct_runs(runs)), ""]))


def scale_lines(runs: list[Run]) -> list[str]:
    """Return a Markdown table with one line for each spacing and frame interval.

    Raises:
        TableError: as in ``report_scales``.
    """
    cells: dict[Cell, dict[str, list[Run]]] = defaultdict(lambda: defaultdict(list))
    spacings = {
        run.config[SPACING]: run.config["data.scene.grid_spacing"]
        for run in runs
        if run.config.get(USE) == SPECIALIST and SPACING in run.config
    }
    for run in runs:
        if run.config.get(SPACING) in spacings:
            cells[spacings[run.config[SPACING]], run.config[STRIDE] * run.config[FRAME]][run.config.get(USE, SPECIALIST)].append(run)
    _check(cells)
    present = [use for use in COMPARED if any(use in own for own in cells.values())]
    instants = _shared_instants(runs)
    header = ["spacing [mm]", "frame [ms]", "in training", f"specialist at {instants[-1]} [1e-3 m²]"]
    header += [f"{COMPARED[use]} at {instant}" for use in present for instant in instants] + ["failed"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for (spacing, frame), own in sorted(cells.items()):
        lines.append(table_row([f"{1e3 * spacing:.4g}", f"{1e3 * frame:.4g}", *_line(own, present, instants)]))
    return [*lines, "", NOTE]


def _check(cells: dict[Cell, dict[str, list[Run]]]) -> None:
    """Raise ``TableError`` for runs that are no seeds of one model, or that the table compares although more than the scale differs."""
    advice = "give runs that do not belong to the table another name=…"
    for (spacing, frame), own in cells.items():
        for use, runs in own.items():
            if keys := [key for key in axes_of(runs) if key != "seed"]:
                where = f"with {USE}={use} at {1e3 * spacing:.4g} mm and {1e3 * frame:.4g} ms"
                raise TableError(f"runs {where} differ in {', '.join(keys[:3])}, not in the seed alone; {advice}")
    every = [run for own in cells.values() for runs in own.values() for run in runs]
    if keys := [key for key in axes_of(every) if not key.startswith(MAY_DIFFER)]:
        raise TableError(f"models of one scale and of several scales differ in {', '.join(keys[:3])} and do not compare; {advice}")


def _line(own: dict[str, list[Run]], present: list[str], instants: list[str]) -> list[str]:
    special = own.get(SPECIALIST, [])
    compared = [run for use in present for run in own.get(use, [])]
    trained = _trained(compared[0]) if compared else "–"
    error = shared_table(rollout_errors(special, "test", instants[-1]))
    shown = [trained, f"{1e3 * error.mean():.3g}" if error.size else "not measured"]
    shown += [_ratio(own.get(use, []), special, instant) for use in present for instant in instants]
    return [*shown, " / ".join(_failed(own.get(use, [])) for use in (SPECIALIST, *present))]


def _trained(run: Run) -> str:
    """Tell whether the spacing and the stride of an evaluation are among those of the training."""
    known = [
        run.config[key] in _numbers(run.config[axis])
        for key, axis in ((SPACING, "data.scales.spacing_factors"), (STRIDE, "data.scales.strides"))
    ]
    return {(True, True): "both", (True, False): "spacing", (False, True): "frame"}.get((known[0], known[1]), "neither")


def _numbers(listed: str) -> list[float]:
    return [float(part) for part in listed.strip("[]").split(",")]


def _shared_instants(runs: list[Run]) -> list[str]:
    """Return the horizons that all runs have, without the full length, whose number of frames differs; but with it if there is no other."""
    found = [{*run.rows[run.rows["metric"] == "rollout_mse"]["horizon"]} for run in runs]
    return sorted(set.intersection(*found) - {FULL}, key=time_of) or [FULL]


def _ratio(runs: list[Run], reference: list[Run], instant: str) -> str:
    own, other = (rollout_errors(some, "test", instant) for some in (runs, reference))
    if not own or not other:
        return "not measured"
    scenes = shared_trajectories(own, other)
    ratio = bootstrap_ratio(shared_table(own, scenes), shared_table(other, scenes), np.mean)
    return f"{ratio.estimate:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def _failed(runs: list[Run]) -> str:
    ends = [value for seed in values_by_seed(runs, LEARNED, "test", "rollout_mse", FULL) for value in seed.values()]
    return str(int(np.sum(~np.isfinite(ends))))
