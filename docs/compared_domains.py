"""One table of a sweep that was made in several data sets: ``python docs/compared_domains.py FILE.md FOLDER…``.

Each folder has the runs of one data set, or their archive (``docs/results/NAME``). All differ in the same settings. The table has the error of each variant
over that of the first, over a quarter of a scene and over whole scenes, as ``reports.ratio_table`` computes it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from gpe_pl.evaluation.horizons import time_of
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.reports.finished_runs import finished_runs
from gpe_pl.reports.ratio_table import NOTE, SPLITS, ratio_cell
from gpe_pl.reports.sweep_table import variants_of

QUARTER = -3
"""Position of a quarter of a scene among the horizons of ``evaluation.horizons``, the whole scene included, from short to long."""


def table(folders: list[Path]) -> str:
    """Return the table in Markdown.

    Raises:
        ValueError: the runs of a folder differ in other settings than those of the first.
    """
    of_all: list[str] | None = None
    lines: list[str] = []
    for folder in folders:
        axes, variants = variants_of(finished_runs(folder))
        if of_all is None:
            of_all = axes
            header = [
                "data set",
                *(axis.rpartition(".")[2] for axis in axes),
                "seeds",
                *(f"{s}, {part}" for s in SPLITS for part in ("first quarter", "whole")),
            ]
            lines += [table_row(header), "|" + "---|" * len(header)]
        if axes != of_all:
            raise ValueError(f"{folder}: its runs differ in {', '.join(axes)}, those of {folders[0]} in {', '.join(of_all)}")
        first, *others = variants
        runs = variants[first]
        own = runs[0].rows[runs[0].rows["metric"] == "rollout_mse"]["horizon"].unique()
        times = sorted(own, key=time_of)
        for key in others:
            cells = [ratio_cell(variants[key], runs, split, times[place]) for split in SPLITS for place in (QUARTER, -1)]
            seeds = str(min(len(variants[key]), len(runs)))
            lines.append(table_row([f"{runs[0].config['data.name']}, {times[QUARTER]}", *key, seeds, *cells]))
    return "\n".join([*lines, "", f"The first row of each data set, which is left out, is {', '.join(first)}. {NOTE}", ""])


if __name__ == "__main__":
    if len(sys.argv) < 3 or not sys.argv[1].endswith(".md"):
        sys.exit(__doc__)
    replace_text(Path(sys.argv[1]), table([Path(name) for name in sys.argv[2:]]))
