"""Losses of trainings at the same steps, also of trainings that have no evaluation: table, values and figure.

``python docs/training_losses.py KEY FOLDER NAME NOTE`` reads the logs of all trainings below FOLDER, groups them by the configuration key KEY, for example
``model.interaction``, and writes ``table.md``, ``losses.csv``, ``validation_loss.png`` and ``provenance.json`` to ``docs/results/NAME``.
``python docs/training_losses.py --draw NAME`` draws the figure again from ``docs/results/NAME/losses.csv``.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from embed_results import RESULTS, add_session, picture

from gpe_pl.files import sealed
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.system.provenance import PROVENANCE, recorded, sessions
from gpe_pl.viz.figures import validation_loss_figure
from gpe_pl.viz.saving import save_figure

COLUMNS = {"val/one_step_nmse": "validation loss", "val/rollout_mse": "validation rollout"}
FRACTIONS = (1 / 21, 1 / 7, 2 / 7, 1.0)
"""Parts of the training after which the table has the validation loss."""


def logged(run: Path) -> dict[str, dict[int, float]]:
    """Return the values of ``COLUMNS`` by training step."""
    values: dict[str, dict[int, float]] = {name: {} for name in COLUMNS}
    for path in sorted(run.glob("log/version_*/metrics.csv"), key=lambda path: int(path.parent.name.removeprefix("version_"))):
        with open(path, newline="", encoding="utf-8") as handle:
            for line in csv.DictReader(handle):
                for name in COLUMNS:
                    if line.get(name):
                        values[name][int(line["step"]) + 1] = float(line[name])
    return values


def spread(values: list[float]) -> str:
    """Return the median over seeds and their range."""
    return f"{np.median(values):.3g} ({min(values):.3g} – {max(values):.3g})"


def main(key: str, folder: Path, name: str, note: str) -> None:
    """Read all trainings below the folder and write what a reader should see of them."""
    runs = sorted(path.parent for path in folder.rglob("config.json") if (path.parent / "log").is_dir())
    groups: dict[str, dict[int, dict[str, dict[int, float]]]] = defaultdict(dict)
    for run in runs:
        config = json.loads((run / "config.json").read_text())
        value = config
        for part in key.split("."):
            value = value[part]
        groups[str(value)][int(config["seed"])] = logged(run)
    target = RESULTS / name
    target.mkdir(exist_ok=True)
    rows = [[key, "seed", "step", *COLUMNS.values()]]
    for variant, seeds in groups.items():
        for seed, values in sorted(seeds.items()):
            loss, rolled = (values[name] for name in COLUMNS)
            rows += [[variant, seed, step, f"{loss[step]:.5g}", f"{rolled.get(step, np.nan):.4g}"] for step in sorted(loss)]
    replace_text(target / "losses.csv", "".join(",".join(map(str, row)) + "\n" for row in rows))
    loss, rolled = COLUMNS
    every = sorted({step for seeds in groups.values() for values in seeds.values() for step in values[loss]})
    shown = [*dict.fromkeys(min(every, key=lambda step: abs(step - part * every[-1])) for part in FRACTIONS)]
    table = [table_row([key, "seeds", *(f"loss at step {step}" for step in shown), f"rollout at step {shown[-1]} [1e-6 m²]"])]
    table.append("|" + "---|" * (len(shown) + 3))
    for variant, seeds in groups.items():
        losses = [spread([values[loss][step] for values in seeds.values()]) for step in shown]
        ends = spread([1e6 * values[rolled][shown[-1]] for values in seeds.values()])
        table.append(table_row([variant, str(len(seeds)), *losses, ends]))
    replace_text(target / "table.md", "\n".join([*table, "", "Medians over seeds, with their ranges.", ""]))
    figure(target)
    of_runs = [session for path in sorted(folder.rglob(PROVENANCE)) for session in sessions(path.parent)]
    sealed.write(
        target / PROVENANCE, {"sessions": of_runs[:1], "seeds": sorted({s for seeds in groups.values() for s in seeds}), "note": note}
    )


def figure(target: Path) -> None:
    """Draw ``validation_loss.png`` from ``losses.csv`` in the same folder."""
    curves: dict[str, dict[str, tuple[list[int], list[float]]]] = defaultdict(dict)
    with open(target / "losses.csv", newline="", encoding="utf-8") as handle:
        _, *rows = csv.reader(handle)
    for variant, seed, step, loss, _ in rows:
        steps, losses = curves[variant].setdefault(seed, ([], []))
        steps.append(int(step))
        losses.append(float(loss))
    of_seeds = {variant: list(seeds.values()) for variant, seeds in curves.items()}
    path = target / "validation_loss.png"
    save_figure(validation_loss_figure(of_seeds, "validation loss (one-step nMSE)"), path, dpi=150)
    picture(path, path)


def draw(name: str) -> None:
    """Draw the figure of ``docs/results/{name}`` again, and add the session to those of the folder."""
    target = RESULTS / name
    with TemporaryDirectory() as folder:
        with recorded(Path(folder), "docs/training_losses.py", ["--draw", name], folder):
            shutil.copy(target / "losses.csv", folder)
            figure(Path(folder))
        shutil.copy(Path(folder, "validation_loss.png"), target)
        add_session(target, Path(folder))


if __name__ == "__main__":
    if sys.argv[1] == "--draw":
        draw(sys.argv[2])
    else:
        main(sys.argv[1], Path(sys.argv[2]), sys.argv[3], sys.argv[4])
