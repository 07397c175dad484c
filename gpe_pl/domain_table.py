"""Table 1 of the paper from a sweep over domains, models and seeds: one table of numbers for machines, one for people, and two figures.

The number judged is the rollout MSE over all frames, mean over the trajectories of a domain's unseen material parameters, median over seeds.
"""

from __future__ import annotations

import csv
import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpe_pl.atomic import replace_text, replacing
from gpe_pl.errors import GpeError
from gpe_pl.evaluation import LEARNED
from gpe_pl.finished_runs import Run, axes_of, distinct_runs, finished_runs, groups_of, shared_table, shared_trajectories, values_by_seed
from gpe_pl.markdown import table_row
from gpe_pl.metrics import Interval, bootstrap_interval, bootstrap_ratio, median_of_means
from gpe_pl.parameter_curves import PARAMETER_FIGURE, parameter_curves

log = logging.getLogger(__name__)

TABLE_CSV, TABLE_MD, FIGURE = "table1.csv", "table1.md", "table1.png"
TABLES = (TABLE_CSV, TABLE_MD, FIGURE, PARAMETER_FIGURE)
OWN = "GPE"
NOT_LEARNED = 2.0
"""A model that is not this many times better than ballistic flight has learned nothing worth comparing."""

PAPER = {
    "sand": {"DPINet": 5.15, "GNS": 3.80, "ContinuousConvNet": 3.51, "GPE": 2.37},
    "snow": {"DPINet": 4.91, "GNS": 5.49, "ContinuousConvNet": 5.24, "GPE": 3.94},
    "elastomer": {"DPINet": 2.07, "GNS": 3.58, "ContinuousConvNet": 2.82, "GPE": 1.35},
    "fem": {"DPINet": 1.76, "GNS": 5.03, "ContinuousConvNet": 4.96, "GPE": 1.27},
    "fluid": {"DPINet": 3.31, "GNS": 3.78, "ContinuousConvNet": 2.75, "GPE": 3.22},
}
"""Yang et al. 2022, table 1: average MSE ×1e-3 in the paper's own units, which are not ours; only ratios compare."""

INTERPOLATED, UNSEEN = "test_unseen/interpolated", "test_unseen"
"""Judged are unseen values that lie between trained ones; of solids also those outside, as in the paper (trained on 1–4 MPa, tested on 0.5–10 MPa)."""

SAME_IN_A_ROW = ("data.", "evaluation.data.", "evaluation.containment", "evaluation.hold_parameters", "evaluation.static_friction")
"""Configuration keys, by how they begin, that all models of a domain need alike to be compared."""


class TableError(GpeError, ValueError):
    """Runs that do not belong into one table; names them, and what to do."""


@dataclass(frozen=True)
class Cell:
    """A model in a domain: its interval [m²], the errors of single rollouts [seed, trajectory] [m²], infinite for failed ones, and that of ballistic
    flight [m²].
    """

    interval: Interval
    errors: np.ndarray
    ballistic: float

    @property
    def median(self) -> float:
        """Of the single rollouts, of all seeds [m²]."""
        return float(np.median(self.errors))

    @property
    def is_learned(self) -> bool:
        return self.interval.estimate * NOT_LEARNED <= self.ballistic


def judged_group(run: Run) -> str:
    """The trajectories that a run is judged on, as a split or part of one."""
    return UNSEEN if any(key.startswith("data.parameters.solid.") for key in run.config) else INTERPOLATED


def compares_models(folder: Path) -> bool:
    """Whether the runs below a folder are of several models or domains."""
    return len({(domain_of(run), model_of(run)) for run in finished_runs(folder)}) > 1


def report_domains(folder: Path) -> None:
    """Write table and figures of all finished runs below a folder.

    Raises:
        TableError: runs of one model and domain differ in more than their seeds, or those of a domain were judged on different scenes.
    """
    runs = distinct_runs(finished_runs(folder))
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
    for domain in domains:
        cells |= {(domain, model): cell for model, cell in _row({m: by_cell[d, m] for d, m in by_cell if d == domain}, domain).items()}
    replace_text(folder / TABLE_MD, _markdown(domains, models, cells, by_cell))
    _figures(folder, domains, models, cells, by_cell)


def domain_of(run: Run) -> str:
    """Name of the data set that a run was trained on."""
    return str(run.config["data.name"])


def model_of(run: Run) -> str:
    """Class name of a run's model."""
    return str(run.config["model._target_"]).rpartition(".")[2]


def _check(folder: Path, domains: list[str], by_cell: dict[tuple[str, str], list[Run]]) -> None:
    """Refuse to average, or to compare, what was not done in the same way."""
    for (domain, model), runs in by_cell.items():
        keys = [key for key in axes_of(runs) if key != "seed"]
        if keys:
            raise TableError(
                f"{folder}: runs of {model} on {domain} differ in {', '.join(keys[:3])}, not in the seed alone; "
                "give what is no part of the table a name=… of its own"
            )
    for domain in domains:
        runs = [run for (d, _), members in by_cell.items() if d == domain for run in members]
        keys = [key for key in axes_of(runs) if key.startswith(SAME_IN_A_ROW)]
        if keys:
            raise TableError(
                f"{folder}: models on {domain} were trained or judged on different data ({', '.join(keys[:3])}) and do not compare; "
                "give these runs a name=… of their own"
            )
        frames = {frame for frame in map(_first_frame, runs) if frame is not None}
        if len(frames) > 1:
            raise TableError(
                f"{folder}: rollouts of models on {domain} start at different frames ({', '.join(map(str, sorted(frames)))}: evaluation.start_frame, "
                "or else graph.history) and do not compare; evaluate all with one evaluation.start_frame=…"
            )


def _first_frame(run: Run) -> int | None:
    """Where rollouts of a run start, if its configuration says so."""
    frame = run.config.get("evaluation.start_frame")
    return run.config.get("graph.history") if frame is None else frame


def _row(by_model: dict[str, list[Run]], domain: str) -> dict[str, Cell]:
    """The cells of a domain, on the trajectories that all its runs have evaluated."""
    found = {}
    for model, runs in by_model.items():
        group = judged_group(runs[0])
        values = [values_by_seed(runs, name, group, "rollout_mse", "full") for name in (LEARNED, "ballistic")]
        if all(values):
            found[model] = values
    trajectories = shared_trajectories(*(table for values in found.values() for table in values))
    if not trajectories:
        return {}
    num_evaluated = max(len(seed) for own, _ in found.values() for seed in own)
    if len(trajectories) < num_evaluated:
        log.warning("%s: judged on the %d of %d trajectories that all runs have evaluated", domain, len(trajectories), num_evaluated)
    row = {}
    for model, (own, trivial) in found.items():
        errors = shared_table(own, trajectories)
        ballistic = float(shared_table(trivial[:1], trajectories).mean())
        row[model] = Cell(bootstrap_interval(errors, statistic=median_of_means), errors, ballistic)
    return row


def _write_csv(path: Path, runs: Sequence[Run]) -> None:
    """One line per domain, model, seed, split, metric and horizon: the mean over trajectories. Trivial models have no seed."""
    lines: dict[tuple[str, ...], float] = {}
    for run in runs:
        groups: dict[tuple[str, ...], list[float]] = defaultdict(list)
        for row in run.rows:
            model, seed = (model_of(run), str(run.config.get("seed"))) if row.model == LEARNED else (row.model, "")
            for split in groups_of(row):
                groups[domain_of(run), model, seed, split, row.metric, row.horizon].append(row.value)
        lines |= {key: float(np.mean(values)) for key, values in groups.items()}
    with replacing(path) as part, open(part, "w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["domain", "model", "seed", "split", "metric", "horizon", "value"])
        writer.writerows([*key, value] for key, value in sorted(lines.items()))


def _markdown(domains: list[str], models: list[str], cells: dict[tuple[str, str], Cell], by_cell: dict[tuple[str, str], list[Run]]) -> str:
    other_scenes = any(key.startswith("evaluation.data.scene") for runs in by_cell.values() for run in runs for key in run.config)
    papers = {} if other_scenes else {domain: [_paper_ratio(domain)] for domain in domains}
    header = ["domain", *models, "ballistic", f"{OWN} / best baseline", *(["paper"] if papers else [])]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for domain in domains:
        own = {m: cells[domain, m] for m in models if (domain, m) in cells}
        ballistic = next((c.ballistic for c in own.values()), float("nan"))
        texts = [_text(own.get(m)) for m in models]
        lines.append(table_row([domain, *texts, f"{1e3 * ballistic:.3g}", _ratio(own), *papers.get(domain, [])]))
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
        "Rollout MSE ×1e-3 [m²] over all frames on material parameters not seen in training (between the trained ones; of solids also outside, where all "
        "models get the nearest trained value): mean over trajectories, median over seeds, 95 % bootstrap interval over both; a rollout that had to be "
        "stopped has failed, and the mean with it. A model that is not twice as good as ballistic flight is *not learned* and wins nothing. Ratio: over the "
        "best baseline that has learned, with its interval, on the same trajectories; bold where that excludes 1."
    ) + (" Last column: the paper's ratio, from its table 1; its units are not ours." if papers else "")
    return "\n".join([*lines, "", note, *_medians(domains, models, cells), *budget, ""])


def _medians(domains: list[str], models: list[str], cells: dict[tuple[str, str], Cell]) -> list[str]:
    """A second table: of the typical scene rather than of their mean, which a few scenes carry that can go either way."""
    header = ["domain", *models, f"{OWN} / best baseline"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    for domain in domains:
        own = {m: cells[domain, m].median for m in models if (domain, m) in cells}
        others = [value for m, value in own.items() if m != OWN]
        ratio = f"{own[OWN] / min(others):.2f}" if OWN in own and others else "–"
        lines.append(table_row([domain, *(f"{1e3 * own[m]:.3g}" if m in own else "–" for m in models), ratio]))
    return ["", "The median over trajectories and seeds instead; it judges nothing.", "", *lines]


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "–"
    i = cell.interval
    numbers = f"{1e3 * i.estimate:.3g} [{1e3 * i.low:.3g}, {1e3 * i.high:.3g}]"
    failed = int((~np.isfinite(cell.errors)).sum())
    if failed:
        known = numbers if np.isfinite(i.estimate) else f"median {1e3 * cell.median:.3g}"
        numbers = f"{known}, {failed} of {cell.errors.size} failed"
    return numbers if cell.is_learned else f"*not learned* ({numbers})"


def _ratio(cells: dict[str, Cell]) -> str:
    """GPE's error over that of the best baseline that has learned something, with the interval; bold where that excludes 1."""
    own, others = cells.get(OWN), [c for m, c in cells.items() if m != OWN]
    baselines = [c for c in others if c.is_learned]
    if own is None or not others:
        return "–"
    if not baselines:
        return "no baseline learned" if own.is_learned else "no model learned"
    best = min(baselines, key=lambda c: c.interval.estimate)
    i = bootstrap_ratio(own.errors, best.errors, statistic=median_of_means)
    estimate = f"**{i.estimate:.2f}**" if i.low > 1 or i.high < 1 else f"{i.estimate:.2f}"
    return f"{estimate} [{i.low:.2f}, {i.high:.2f}]" + ("" if own.is_learned else ", not learned")


def _paper_ratio(domain: str) -> str:
    values = PAPER.get(domain, {})
    others = [v for m, v in values.items() if m != OWN]
    return f"{values[OWN] / min(others):.2f}" if others else "–"


def _figures(
    folder: Path, domains: list[str], models: list[str], cells: dict[tuple[str, str], Cell], by_cell: dict[tuple[str, str], list[Run]]
) -> None:
    from gpe_pl.viz.comparison import comparison_figure

    shown = {d: {m: cells[d, m].interval for m in models if (d, m) in cells} for d in domains}
    references = {d: next(c.ballistic for (domain, _), c in cells.items() if domain == d) for d in domains if shown[d]}
    if any(shown.values()):
        comparison_figure({d: s for d, s in shown.items() if s}, references, "rollout MSE [m²]").savefig(folder / FIGURE, dpi=150)
    by_domain = {d: {m: by_cell[d, m] for m in models if (d, m) in by_cell} for d in domains}
    parameter_curves(by_domain).savefig(folder / PARAMETER_FIGURE, dpi=150)
