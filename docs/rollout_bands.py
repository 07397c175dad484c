"""How often error bands of models cover the ground truth: table and figure of ``docs/results/bands``.

``python docs/rollout_bands.py FOLDER snow elastomer …`` takes shipped models whose data sets have their names; ``sand=FILE.ckpt`` takes another checkpoint.
For each model it generates scenes that no training had, and runs ``evaluate`` three times: on the split ``val`` to calibrate bands, which are stored beside
the checkpoint, and on ``test`` and ``test_unseen`` to measure their coverage. Data and evaluations go to FOLDER. Finished evaluations are not repeated.
Table and figure also have the models of ``docs/results/bands`` that are not named.
``docs/embed_results.py --add FOLDER/runs bands`` copies the results, and ``docs/rollout_bands.py --cards FOLDER snow elastomer …`` writes them into the cards
of shipped models.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from gpe_pl.evaluation.horizons import FULL, time_of
from gpe_pl.evaluation.metric_rows import LEARNED, Row, read_rows
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.learned import bands
from gpe_pl.learned.pretrained import FOLDER as CARDS
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import bootstrap_interval
from gpe_pl.metrics.conformal import chance_range
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

TESTS = ("test", "test_unseen")
NEW_SCENES = (
    *("data.seed=1", "data.num_train=1", "data.num_val=40", "data.num_test=40", "data.num_test_unseen=40"),
    *("evaluation.num_pictures=0", "evaluation.num_uncontained=0", "trainer.progress=false"),
)
GROUPS = {"seen": "seen", "interpolated": "interpolated", "extrapolated": "outside the trained range"}
"""Names of the groups of material parameters."""
EMBEDDED = Path(__file__).resolve().parent / "results" / "bands" / "table.md"
"""Table in the documentation."""
OPENING = "Its error bands of"
"""Beginning of the paragraph of a card."""
ACCEPTED = (85, 95)
"""Coverages of bands of 90 % that count as right [%]."""


def measure(folder: Path, name: str, checkpoint: str) -> None:
    """Calibrate bands of a model, and measure their coverage, where this was not done before."""
    common = ["size=small", f"checkpoint={checkpoint}", f"data={name}", f"data.name={name}_bands", *NEW_SCENES]
    paths = [f"paths.data={folder / 'data'}", f"paths.runs={folder / 'runs'}"]
    for split in ("val", *TESTS):
        run = f"{name}_{split}"
        if not (folder / "runs" / run / "metrics.csv").exists():
            calibrates = ["calibrate=true"] if split == "val" else []
            command = ["gpe_pl.evaluate", *common, f"split={split}", f"name={run}", *calibrates, *paths]
            subprocess.run([sys.executable, "-m", *command], check=True)
            new = folder / "runs" / run / f"{name}.bands.json"  # of a shipped model, whose own bands ``evaluate`` leaves alone
            if new.exists():
                replace_text(CARDS / new.name, new.read_text())


def rows_of(folder: Path, name: str) -> list[Row]:
    """Return the metrics of the rollouts of a model in both test splits."""
    found = [row for split in TESTS for row in read_rows(folder / "runs" / f"{name}_{split}" / "metrics.csv")]
    return [row for row in found if row.model == LEARNED and row.trajectory >= 0]


def values(rows: list[Row], metric: str, group: str) -> dict[str, list[float]]:
    """Return the values of a metric in the scenes of a group, by horizon."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if (row.metric, row.parameter_group) == (metric, group):
            found.setdefault(row.horizon, []).append(row.value)
    return {horizon: found[horizon] for horizon in sorted(found, key=time_of)}


def cells_of(name: str, checkpoint: str, rows: list[Row]) -> list[list[str]]:
    """Return the rows of the table of one model."""
    own, spacing = bands.read(checkpoint), LearnedSimulator.from_checkpoint(checkpoint).builder.metadata.spacing
    assert own is not None
    found = []
    for group, label in GROUPS.items():
        inside, enough, radii = (values(rows, metric, group) for metric in ("fraction_in_bands", "enough_in_bands", "band_radius"))
        for horizon, fractions in inside.items():
            mean, number = bootstrap_interval([fractions], statistic=np.mean), len(fractions)
            low, high = chance_range(own.num_scenes, number, bands.LEVEL)
            cells = [
                *(name, label, str(number), horizon),
                f"{100 * mean.estimate:.1f} % [{100 * mean.low:.1f}, {100 * mean.high:.1f}]",
                "yes" if ACCEPTED[0] <= 100 * mean.estimate <= ACCEPTED[1] else "no",
                *(f"{100 * np.mean(enough[horizon]):.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"),
                f"{np.mean(radii[horizon]) / spacing:.3g}",
            ]
            found.append(cells)
    return found


def write_card(folder: Path, name: str) -> None:
    """Write the coverage of a shipped model's bands into its card, before the last paragraph."""
    card = CARDS / f"{name}.md"
    *kept, last = [part for part in card.read_text().split("\n\n") if not part.startswith(OPENING)]
    card.write_text("\n\n".join([*kept, sentence(rows_of(folder, name)), last]))


def sentence(rows: list[Row]) -> str:
    """Return a sentence for the card of a model on the coverage of its bands after 0.1 s and at the end of rollouts."""
    parts = []
    for group, label in GROUPS.items():
        inside = values(rows, "fraction_in_bands", group)
        early, late = (f"{100 * np.mean(inside[horizon]):.0f} %" for horizon in ("0.1s", FULL))
        parts.append(f"{early} and {late} in {len(inside[FULL])} scenes of the group *{label}*")
    return f"{OPENING} {100 * bands.LEVEL:g} % contain these fractions of the nodes after 0.1 s and at the end of rollouts: {'; '.join(parts)}."


def kept_cells(models: Iterable[str]) -> list[list[str]]:
    """Return the rows of the table in the documentation that are of other models."""
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in EMBEDDED.read_text().splitlines()[2:]]
    return [cells for cells in rows if cells[0] not in models]


def draw(axes: Axes, name: str, rows: list[list[str]]) -> None:
    """Draw the coverage of bands of one model at each horizon, with a line per group, from its rows of the table."""
    axes.axhspan(*ACCEPTED, color="0.92", linewidth=0)
    axes.axhline(100 * bands.LEVEL, color="0.5", linewidth=1, linestyle=":")
    for k, label in enumerate(GROUPS.values()):
        own = [cells for cells in rows if cells[1] == label]
        middle, low, high = np.array([[float(number) for number in re.findall(r"[\d.]+", cells[4])] for cells in own]).T
        place, color = np.arange(len(own)) + 0.12 * (k - 1), PALETTE[k]
        axes.errorbar(place, middle, [middle - low, high - middle], fmt="o-", color=color, markersize=3, linewidth=1, label=label)
        axes.set_xticks(range(len(own)), ["end" if cells[3] == FULL else cells[3].removesuffix("s") for cells in own])
    axes.set_title(name, fontsize=8)
    axes.set_xlabel("time [s]", fontsize=7.5)
    axes.set_ylim(25, 101)
    axes.tick_params(labelsize=6.5)
    axes.spines[["top", "right"]].set_visible(False)


def main(folder: Path, models: dict[str, str]) -> None:
    """Measure what is missing, and write the table and the figure."""
    for name, checkpoint in models.items():
        measure(folder, name, checkpoint)
    head = [
        *("model", "material parameters", "scenes", "horizon", "nodes inside", f"within {ACCEPTED[0]} to {ACCEPTED[1]} %"),
        *("scenes with enough nodes inside", "by chance", "radius [spacings]"),
    ]
    rows = kept_cells(models)
    for name, checkpoint in models.items():
        rows += cells_of(name, checkpoint, rows_of(folder, name))
    replace_text(folder / "runs" / "table.md", "\n".join([table_row(head), "|" + "---|" * len(head), *map(table_row, rows), ""]))
    names = [*dict.fromkeys(cells[0] for cells in rows)]
    figure = new_figure(2.1 * len(names) + 0.4, 2.4)
    figure.set_layout_engine("constrained")
    panels = np.ravel(figure.subplots(1, len(names), sharey=True, squeeze=False))
    for axes, name in zip(panels, names, strict=True):
        draw(axes, name, [cells for cells in rows if cells[0] == name])
    panels[0].set_ylabel("nodes inside bands of 90 % [%]", fontsize=7.5)
    panels[0].legend(fontsize=6, frameon=False, loc="lower left")
    save_figure(figure, folder / "runs" / "bands.png", dpi=150)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    if sys.argv[1] == "--cards":
        for shipped in sys.argv[3:]:
            write_card(Path(sys.argv[2]), shipped)
    else:
        named = (argument.partition("=") for argument in sys.argv[2:])
        main(Path(sys.argv[1]).resolve(), {name: checkpoint or name for name, _, checkpoint in named})
