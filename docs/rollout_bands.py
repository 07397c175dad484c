"""How often error bands of models cover the ground truth: table and figure of ``docs/results/bands``.

``python docs/rollout_bands.py FOLDER snow elastomer …`` takes shipped models whose data sets have their names; ``sand=FILE.ckpt`` takes another checkpoint.
For each model it generates scenes that no training had, and runs ``evaluate`` three times: on the split ``val`` to calibrate bands, which are stored beside
the checkpoint, and on ``test`` and ``test_unseen`` to measure their coverage. Data and evaluations go to FOLDER. Finished evaluations are not repeated.
``docs/embed_results.py FOLDER/runs bands`` copies the results, and ``docs/rollout_bands.py --cards FOLDER snow elastomer …`` writes them into the cards of
shipped models.
"""

from __future__ import annotations

import subprocess
import sys
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


def lines_of(name: str, checkpoint: str, rows: list[Row]) -> list[str]:
    """Return the rows of the table of one model."""
    own, spacing = bands.read(checkpoint), LearnedSimulator.from_checkpoint(checkpoint).builder.metadata.spacing
    assert own is not None
    lines = []
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
            lines.append(table_row(cells))
    return lines


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


def draw(axes: Axes, name: str, rows: list[Row]) -> None:
    """Draw the coverage of bands of one model at each horizon, with a line per group."""
    axes.axhspan(*ACCEPTED, color="0.92", linewidth=0)
    axes.axhline(100 * bands.LEVEL, color="0.5", linewidth=1, linestyle=":")
    for k, (group, label) in enumerate(GROUPS.items()):
        inside = values(rows, "fraction_in_bands", group)
        found = [bootstrap_interval([fractions], statistic=np.mean) for fractions in inside.values()]
        low, middle, high = 100 * np.array([[each.low, each.estimate, each.high] for each in found]).T
        place, color = np.arange(len(inside)) + 0.12 * (k - 1), PALETTE[k]
        axes.errorbar(place, middle, [middle - low, high - middle], fmt="o-", color=color, markersize=3, linewidth=1, label=label)
        axes.set_xticks(range(len(inside)), [horizon.removesuffix("s") if horizon != FULL else "end" for horizon in inside])
    axes.set_title(name, fontsize=8)
    axes.set_xlabel("time [s]", fontsize=7.5)
    axes.set_ylim(60, 101)
    axes.tick_params(labelsize=6.5)
    axes.spines[["top", "right"]].set_visible(False)


def main(folder: Path, models: dict[str, str]) -> None:
    """Measure what is missing, and write the table and the figure."""
    for name, checkpoint in models.items():
        measure(folder, name, checkpoint)
    rows = {name: rows_of(folder, name) for name in models}
    head = [
        *("model", "material parameters", "scenes", "horizon", "nodes inside", f"within {ACCEPTED[0]} to {ACCEPTED[1]} %"),
        *("scenes with enough nodes inside", "by chance", "radius [spacings]"),
    ]
    lines = [table_row(head), "|" + "---|" * len(head)]
    lines += [line for name, checkpoint in models.items() for line in lines_of(name, checkpoint, rows[name])]
    replace_text(folder / "runs" / "table.md", "\n".join([*lines, ""]))
    figure = new_figure(2.1 * len(models) + 0.4, 2.4)
    figure.set_layout_engine("constrained")
    panels = np.ravel(figure.subplots(1, len(models), sharey=True, squeeze=False))
    for axes, (name, own) in zip(panels, rows.items(), strict=True):
        draw(axes, name, own)
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
