"""The table of what augmentation gives with few trajectories: ``docs/results/outside_few``.

``python docs/few_trajectories.py FOLDER NOTE`` reads finished runs below FOLDER. They were trained on data sets ``NAME3``, ``NAME12``, … with so many
trajectories and the same test scenes, each with at most one of ``training.mirror``, ``training.rotate`` and ``training.boost_speed``.
"""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

from gpe_pl.files import sealed
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_interval, bootstrap_ratio, median_of_means
from gpe_pl.reports.finished_runs import Run, finished_runs, rollout_errors, shared_table, shared_trajectories
from gpe_pl.system.provenance import PROVENANCE, sessions

TARGET = Path(__file__).resolve().parent / "results" / "outside_few"
IMAGES = ("mirror", "rotate", "boost_speed")


def key_of(run: Run) -> tuple[int, int, str]:
    """The number of trajectories, and rank and name of the augmentation."""
    used = [name for name in IMAGES if float(run.config.get(f"training.{name}") or 0)]
    found = re.search(r"\d+$", str(run.config["data.name"]))
    if found is None or len(used) > 1:
        raise SystemExit(f"{run.folder}: expected a data set with the number of its trajectories at the end, and one augmentation at most")
    return int(found[0]), 1 + IMAGES.index(used[0]) if used else 0, used[0] if used else "none"


def main(folder: Path, note: str) -> None:
    """Write the table, the errors of single scenes, and where they come from."""
    runs = sorted(finished_runs(folder), key=key_of)
    errors = {key_of(run): rollout_errors([run], "test", "full") for run in runs}
    lines = [table_row(["trajectories", "augmentation", "rollout MSE ×1e-3 [m²]", "over none"]), "|" + "---|" * 4]
    for (count, rank, name), own in errors.items():
        mean = bootstrap_interval(1e3 * shared_table(own), statistic=median_of_means)
        cell = ""
        if rank and (plain := errors.get((count, 0, "none"))) is not None:
            scenes = shared_trajectories(own, plain)
            ratio = bootstrap_ratio(shared_table(own, scenes), shared_table(plain, scenes), statistic=median_of_means, is_paired=True)
            cell = f"{ratio.estimate:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]"
        lines.append(table_row([str(count), name, f"{mean.estimate:.3g} [{mean.low:.3g}, {mean.high:.3g}]", cell]))
    lines += [
        "",
        "Whole rollouts: mean over the test scenes and its 95 % bootstrap interval, and the ratio to the training without augmentation.",
        "",
    ]
    TARGET.mkdir(parents=True, exist_ok=True)
    replace_text(TARGET / "table.md", "\n".join(lines))
    with (TARGET / "table.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["trajectories", "augmentation", "scene", "rollout_mse"])
        rows.writerows([count, name, scene, f"{value:.4g}"] for (count, _, name), own in errors.items() for scene, value in own[0].items())
    seeds = sorted({int(run.config["seed"]) for run in runs})
    sealed.write(TARGET / PROVENANCE, {"sessions": [s for run in runs for s in sessions(run.folder)], "seeds": seeds, "note": note})


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
