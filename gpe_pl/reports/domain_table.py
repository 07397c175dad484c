"""Table 1 of the paper from a sweep over domains, models and seeds, as CSV and Markdown, and two figures.

Models are compared by the rollout MSE over all frames. It is averaged over a domain's trajectories with unseen material parameters; then the median over seeds
is taken. In all domains, a failed rollout counts as ballistic flight in the same scene (``finished_runs.rollout_errors``). A separate column gives the ratio
with an infinite error for failed rollouts.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.horizons import time_of
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import Interval, bootstrap_interval, median_of_means
from gpe_pl.reports.finished_runs import (
    STAND_IN,
    Run,
    axes_of,
    distinct_runs,
    replaced_data,
    rollout_errors,
    shared_table,
    shared_trajectories,
    starts_of,
    values_by_seed,
    with_groups,
)
from gpe_pl.reports.material_table import FEWEST_SCENES, MATERIALS_FIGURE, material_lines, write_material_figure
from gpe_pl.reports.parameter_curves import PARAMETER_FIGURE, parameter_curves
from gpe_pl.reports.ratio_table import FEWEST_SEEDS, ratio_text
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.viz.saving import save_figure

log = logging.getLogger(__name__)

TABLE_CSV, TABLE_MD, RATIOS_MD, FIGURE = "table1.csv", "table1.md", "table1_ratios.md", "table1.png"
TABLES = (TABLE_CSV, TABLE_MD, RATIOS_MD, FIGURE, PARAMETER_FIGURE, MATERIALS_FIGURE)
OWN = "GPE"
NOT_LEARNED = 2.0
"""A model has learned only if its error is at least this many times lower than that of the best trivial baseline."""

PAPER = {
    "sand": {"DPINet": 5.15, "GNS": 3.80, "ContinuousConvNet": 3.51, "GPE": 2.37},
    "snow": {"DPINet": 4.91, "GNS": 5.49, "ContinuousConvNet": 5.24, "GPE": 3.94},
    "elastomer": {"DPINet": 2.07, "GNS": 3.58, "ContinuousConvNet": 2.82, "GPE": 1.35},
    "fem": {"DPINet": 1.76, "GNS": 5.03, "ContinuousConvNet": 4.96, "GPE": 1.27},
    "fluid": {"DPINet": 3.31, "GNS": 3.78, "ContinuousConvNet": 2.75, "GPE": 3.22},
}
"""Average MSE ×1e-3 of Yang et al. 2022, table 1. The paper uses other units, so only ratios can be compared."""

EVALUATED = "test_unseen"
"""Split that is evaluated in every domain: all scenes with material parameters that training did not have, between the trained values and outside. The paper
names its test parameters for solids only, and does the same there (trained on 1–4 MPa, tested on 0.5–10 MPa)."""

PAPER_COLUMN = "paper"

TRIVIAL_SHOWN = ("ballistic", "stops_at_walls")
"""Trivial baselines with a column in the table and a line in the figure, if they were evaluated."""

SAME_IN_A_ROW = (
    "data.",
    "evaluation.data.",
    "evaluation.containment",
    "evaluation.clamp_parameters",
    "evaluation.static_friction",
    "evaluation.mirror_average",
)
"""Prefixes of the configuration keys that must be equal for all models of a domain."""


WHOLE_SPLIT = -1
"""Number of the trajectory in rows of a metric of a whole split."""


class TableError(GpeError, ValueError):
    """Raised when runs do not belong in one table. The message names them and says what to do."""


@dataclass(frozen=True)
class Cell:
    """Results of one model in one domain.

    Attributes:
        errors: rollout MSE [seed, trajectory] in m². Failed rollouts have the error of ballistic flight or infinity, as the column requires.
        num_failed: number of rollouts that had to be stopped.
        trivial: mean error of each trivial baseline that was evaluated [m²].
    """

    errors: np.ndarray
    num_failed: int
    trivial: dict[str, float]

    @cached_property
    def interval(self) -> Interval:
        """Mean error over trajectories, median over seeds, with its bootstrap interval [m²]."""
        return bootstrap_interval(self.errors, statistic=median_of_means)

    @property
    def median(self) -> float:
        """Median error over the rollouts of all seeds [m²]."""
        return float(np.median(self.errors))

    @property
    def is_learned(self) -> bool:
        return self.interval.estimate * NOT_LEARNED <= min(self.trivial.values())


def compares_models(runs: list[Run]) -> bool:
    """Whether there are runs of several models or domains."""
    return len({(domain_of(run), model_of(run)) for run in runs}) > 1


def report_domains(folder: Path, runs: list[Run]) -> None:
    """Write tables and figures of finished runs into a folder.

    Raises:
        TableError: runs of one model and domain (data set) differ in more than the seed, or runs of one domain differ in their data, in settings of the
            evaluation or in the start frame.
    """
    runs = distinct_runs(runs)
    if not runs:
        log.warning("%s: no finished run", folder)
        return
    by_cell: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        by_cell[domain_of(run), model_of(run)].append(run)
    domains = sorted({d for d, _ in by_cell}, key=lambda d: ([*PAPER, d].index(d), d))
    models = sorted({m for _, m in by_cell}, key=lambda m: (m == OWN, m))
    _check(folder, domains, by_cell)
    _write_csv(folder / TABLE_CSV, runs)
    cells: dict[tuple[str, str], Cell] = {}
    strict: dict[tuple[str, str], Cell] = {}
    for domain in domains:
        for model, pair in _row({m: by_cell[d, m] for d, m in by_cell if d == domain}, domain).items():
            cells[domain, model], strict[domain, model] = pair
    ratios = _ratios(domains, cells, strict, by_cell)
    replace_text(folder / TABLE_MD, _markdown(domains, models, cells, ratios, by_cell))
    replace_text(
        folder / RATIOS_MD,
        "\n".join([*_lines(["domain", *ratios[0]], [[d, *row.values()] for d, row in zip(domains, ratios, strict=True)]), ""]),
    )
    _figures(folder, domains, models, cells, by_cell)


def domain_of(run: Run) -> str:
    """Return the name of the data set that a run was trained on."""
    return str(run.config["data.name"])


def model_of(run: Run) -> str:
    """Return the class name of a run's model."""
    return str(run.config["model._target_"]).rpartition(".")[2]


def _check(folder: Path, domains: list[str], by_cell: dict[tuple[str, str], list[Run]]) -> None:
    """Raise ``TableError`` for runs that cannot be averaged or compared because their settings differ."""
    for (domain, model), runs in by_cell.items():
        keys = [key for key in axes_of(runs) if key != "seed"]
        if keys:
            raise TableError(
                f"{folder}: runs of {model} on {domain} differ in {', '.join(keys[:3])}, not in the seed alone; "
                "give runs that do not belong to the table another name=…"
            )
    for domain in domains:
        runs = [run for (d, _), members in by_cell.items() if d == domain for run in members]
        keys = [key for key in axes_of(runs) if key.startswith(SAME_IN_A_ROW)] + replaced_data(runs)
        if keys:
            raise TableError(
                f"{folder}: models on {domain} were trained or evaluated on different data ({', '.join(keys[:3])}) and do not compare; "
                "give these runs another name=…"
            )
        starts = starts_of(runs)
        if len(starts) > 1:
            raise TableError(
                f"{folder}: rollouts of models on {domain} start at different times ({', '.join(starts)}: evaluation.start_time, "
                "or else graph.history) and do not compare; evaluate all with one evaluation.start_time=…"
            )


def _row(by_model: dict[str, list[Run]], domain: str) -> dict[str, tuple[Cell, Cell]]:
    """Return two cells for each model of a domain. Failed rollouts count as ballistic flight in the first cell, and as infinite errors in the second.

    Both cells use the trajectories that all runs of the domain have evaluated. Models without errors of their own or of ballistic flight are left out.
    """
    found = {}
    for model, runs in by_model.items():
        values = {name: values_by_seed(runs, name, EVALUATED, "rollout_mse", "full") for name in (LEARNED, *BASELINES)}
        if values[LEARNED] and values[STAND_IN]:
            found[model] = {name: table for name, table in values.items() if table}
    trajectories = shared_trajectories(*(table for values in found.values() for table in values.values()))
    if not trajectories:
        return {}
    num_evaluated = max(len(seed) for values in found.values() for seed in values[LEARNED])
    if len(trajectories) < num_evaluated:
        log.warning("%s: compared on the %d of %d trajectories that all runs have evaluated", domain, len(trajectories), num_evaluated)
    row = {}
    for model, values in found.items():
        errors = shared_table(values.pop(LEARNED), trajectories)
        counted = shared_table(rollout_errors(by_model[model], EVALUATED, "full"), trajectories)
        trivial = {name: float(shared_table(table[:1], trajectories).mean()) for name, table in values.items()}
        num_failed = int((~np.isfinite(errors)).sum())
        row[model] = Cell(counted, num_failed, trivial), Cell(errors, num_failed, trivial)
    return row


def _write_csv(path: Path, runs: Sequence[Run]) -> None:
    """Write means over trajectories: one line per domain, model, seed, split and metric, one column per horizon. Only trained models have a seed.

    Means are over the trajectories that all runs of a domain have evaluated, so a trivial baseline has the same mean in all of them.
    """
    keys = ["domain", "model", "seed", "split", "metric"]
    scenes = {domain: _evaluated_by_all(domain, runs) for domain in sorted({domain_of(run) for run in runs})}
    tables = []
    for run in runs:
        shared = [
            trajectory in scenes[domain_of(run)][split] for split, trajectory in zip(run.rows["split"], run.rows["trajectory"], strict=True)
        ]
        rows = with_groups(run.rows[shared])
        is_own = rows["model"].str.startswith(LEARNED)  # also with other parameters
        rows = rows.assign(domain=domain_of(run), seed=np.where(is_own, str(run.config.get("seed")), ""))
        models = rows["model"].str.replace(LEARNED, model_of(run), n=1).where(is_own, rows["model"])
        tables.append(rows.assign(model=models).groupby([*keys, "horizon"])["value"].mean())
    means = pd.concat(tables)
    means = means[~means.index.duplicated(keep="last")].unstack("horizon")
    means = means[sorted(means.columns, key=time_of)]
    with replacing(path) as part:
        means.sort_index().to_csv(part, float_format="%.6g", lineterminator="\n", na_rep="")


def _evaluated_by_all(domain: str, runs: Sequence[Run]) -> dict[str, set[int]]:
    """Return the trajectories of each split that all runs of a domain have evaluated, of those runs that have the split; and ``WHOLE_SPLIT``."""
    evaluated: dict[str, list[set[int]]] = defaultdict(list)
    for run in runs:
        if domain_of(run) == domain:
            for (split, _), rows in run.rows[run.rows["model"].isin([LEARNED, *BASELINES])].groupby(["split", "model"]):
                evaluated[split].append({*rows["trajectory"]} - {WHOLE_SPLIT})
    for split, sets in evaluated.items():
        shared, every = set.intersection(*sets), set.union(*sets)
        if shared != every:
            log.warning(
                "%s: means of %s over the %d of %d trajectories of %s that all runs have evaluated",
                TABLE_CSV,
                domain,
                len(shared),
                len(every),
                split,
            )
    return {split: set.intersection(*sets) | {WHOLE_SPLIT} for split, sets in evaluated.items()}


def _markdown(
    domains: list[str],
    models: list[str],
    cells: dict[tuple[str, str], Cell],
    ratios: list[dict[str, str]],
    by_cell: dict[tuple[str, str], list[Run]],
) -> str:
    shown = [name for name in TRIVIAL_SHOWN if any(name in c.trivial for c in cells.values())]
    rows = []
    for domain, ratio in zip(domains, ratios, strict=True):
        trivial: dict[str, float] = next((c.trivial for (d, _), c in cells.items() if d == domain), {})
        texts = [_text(cells.get((domain, m))) for m in models]
        numbers = [f"{1e3 * trivial[name]:.3g}" if name in trivial else "–" for name in shown]
        rows.append([domain, *texts, *numbers, *ratio.values()])
    lines = _lines(["domain", *models, *(name.replace("_", " ") for name in shown), *ratios[0]], rows)
    budget = ["", "Training, one row per model: steps and seeds.", "", table_row(["domain", *models]), "|" + "---|" * (len(models) + 1)]
    for domain in domains:
        steps = [
            ", ".join(sorted({f"{int(r.config['training.num_steps']):,}" for r in by_cell[domain, m]})) + f" × {len(by_cell[domain, m])}"
            if (domain, m) in by_cell
            else "–"
            for m in models
        ]
        budget.append(table_row([domain, *steps]))
    note = (
        "Rollout MSE ×1e-3 [m²] over all frames on material parameters not seen in training, between the trained ones and outside (where all models get "
        "the nearest trained value): mean over trajectories, median over seeds, 95 % bootstrap interval over both. A rollout that had to be stopped has "
        "failed, and counts as ballistic flight in the same scene. A model that is not twice as good as the best trivial baseline is *not learned* and wins "
        "nothing. Ratio: over the best baseline that has learned, with its interval, on the same trajectories; bold where that excludes 1 and has at least "
        f"{FEWEST_SEEDS} seeds of both and {FEWEST_SCENES} trajectories. *failed = ∞*: the same ratio if the error of a failed rollout were infinite, and the "
        "mean with it."
    ) + (" Last column: the paper's ratio, from its table 1; its units are not ours." if PAPER_COLUMN in ratios[0] else "")
    materials = material_lines({(d, m): by_cell[d, m] for d in domains for m in models if (d, m) in by_cell})
    return "\n".join([*lines, "", note, *_medians(domains, models, cells), *budget, *(["", *materials] if materials else []), ""])


def _ratios(
    domains: list[str], cells: dict[tuple[str, str], Cell], strict: dict[tuple[str, str], Cell], by_cell: dict[tuple[str, str], list[Run]]
) -> list[dict[str, str]]:
    """Return the ratios of each domain by column: failed rollouts as ballistic flight, failed rollouts as infinite errors, and the ratio in the paper.

    The last column is left out if models were evaluated in other scenes than those of the paper.
    """
    other_scenes = any(key.startswith("evaluation.data.scene") for runs in by_cell.values() for run in runs for key in run.config)
    rows = []
    for domain in domains:
        own, other = ({m: cell for (d, m), cell in table.items() if d == domain} for table in (cells, strict))
        paper = {} if other_scenes else {PAPER_COLUMN: _paper_ratio(domain)}
        rows.append({f"{OWN} / best baseline": _ratio(own), f"{OWN} / best baseline, failed = ∞": _ratio(other)} | paper)
    return rows


def _lines(header: list[str], rows: list[list[str]]) -> list[str]:
    return [table_row(header), "|" + "---|" * len(header), *map(table_row, rows)]


def _medians(domains: list[str], models: list[str], cells: dict[tuple[str, str], Cell]) -> list[str]:
    """Return a table of median errors. They describe the typical scene; the mean depends on a few scenes with large errors."""
    header = ["domain", *models, f"{OWN} / best baseline"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for domain in domains:
        own = {m: cells[domain, m].median for m in models if (domain, m) in cells}
        others = [value for m, value in own.items() if m != OWN]
        ratio = f"{own[OWN] / min(others):.2f}" if OWN in own and others else "–"
        lines.append(table_row([domain, *(f"{1e3 * own[m]:.3g}" if m in own else "–" for m in models), ratio]))
    return ["", "The median over trajectories and seeds instead; no comparison uses it.", "", *lines]


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "–"
    i = cell.interval
    numbers = f"{1e3 * i.estimate:.3g} [{1e3 * i.low:.3g}, {1e3 * i.high:.3g}]"
    if cell.num_failed:
        numbers = f"{numbers}, {cell.num_failed} of {cell.errors.size} failed"
    return numbers if cell.is_learned else f"*not learned* ({numbers})"


def _ratio(cells: dict[str, Cell]) -> str:
    """Return the ratio of GPE's error to that of the best baseline that has learned, with its interval; bold if it excludes 1 and there are enough runs."""
    own, others = cells.get(OWN), [c for m, c in cells.items() if m != OWN]
    baselines = [c for c in others if c.is_learned]
    if own is None or not others:
        return "–"
    if not baselines:
        return "no baseline learned" if own.is_learned else "no model learned"
    best = min(baselines, key=lambda c: c.interval.estimate)
    return ratio_text(own.errors, best.errors, median_of_means) + ("" if own.is_learned else ", not learned")


def _paper_ratio(domain: str) -> str:
    values = PAPER.get(domain, {})
    others = [v for m, v in values.items() if m != OWN]
    return f"{values[OWN] / min(others):.2f}" if others else "–"


def _figures(
    folder: Path, domains: list[str], models: list[str], cells: dict[tuple[str, str], Cell], by_cell: dict[tuple[str, str], list[Run]]
) -> None:
    from gpe_pl.viz.comparison import comparison_figure

    shown = {d: {m: cells[d, m].interval for m in models if (d, m) in cells} for d in domains}
    trivial = {d: next(c.trivial for (domain, _), c in cells.items() if domain == d) for d in domains if shown[d]}
    references = {
        name.replace("_", " "): {d: t[name] for d, t in trivial.items() if name in t}
        for name in TRIVIAL_SHOWN
        if any(name in t for t in trivial.values())
    }
    if any(shown.values()):
        save_figure(comparison_figure({d: s for d, s in shown.items() if s}, references, "rollout MSE [m²]"), folder / FIGURE, dpi=150)
    write_material_figure(folder / MATERIALS_FIGURE, {(d, OWN): by_cell[d, OWN] for d in domains if (d, OWN) in by_cell})
    by_domain = {d: {m: by_cell[d, m] for m in models if (d, m) in by_cell} for d in domains}
    save_figure(parameter_curves(by_domain), folder / PARAMETER_FIGURE, dpi=150)
