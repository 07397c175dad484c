"""Learning curves with scenes that models chose and with random scenes: table and figure of ``docs/results/active``.

``python docs/active_curve.py FOLDER`` repeats this for three seeds of data and training: simulate ``SIZES[0]`` scenes, train ``MEMBERS`` models, and let them
choose scenes until there are ``SIZES[1]``, and so on. The control has the same first scenes, and as many further ones drawn at random from the same candidates.
Every model is trained from scratch with equal steps, and rolled out on the same unseen scenes. Data and runs go to FOLDER. What is finished is not repeated.
``docs/embed_results.py FOLDER active`` copies the results.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from gpe_pl.config.datasets import candidate_spec, dataset_folder, dataset_spec
from gpe_pl.config.entry_point import compose
from gpe_pl.config.fit_run import FitRun
from gpe_pl.data import chosen_scenes
from gpe_pl.data.generation import generate
from gpe_pl.evaluation.active import ActiveSettings, choose
from gpe_pl.evaluation.horizons import FULL
from gpe_pl.evaluation.metric_rows import read_rows
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import bootstrap_interval, bootstrap_ratio
from gpe_pl.reports.finished_runs import Run, rollout_errors, shared_table, shared_trajectories, table_of
from gpe_pl.system.provenance import recorded
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

SEEDS, SIZES, MEMBERS = (0, 1, 2), (4, 8), 2
NUM_CANDIDATES = 100
HORIZONS = ("0.1s", "0.25s", FULL)
ARMS = {"chosen": "chosen by models", "random": "random"}
MODEL = (
    *("size=tiny", "data=sand", "model=gpe_tuned", "law=none", "comparison=equal_steps"),
    *("trainer.num_threads=1", "trainer.progress=false", "evaluation.num_pictures=0", "evaluation.num_uncontained=0"),
    *("evaluation.splits=[test]", "evaluation.num_trajectories=20", "evaluation.horizons=[0.1,0.25]"),
    *("training.num_steps=500", "training.val_interval=500"),
    *("training.push_fraction=0.3", "training.push_steps=5", "training.ema_decay=0.99", "training.num_val_rollouts=2"),
    "+evaluation.data={name:sand_active_test,seed:1000,num_train:1,num_val:0,num_test:40,num_test_unseen:0}",
)
DATA = ("data.num_val=2", "data.num_test=0", "data.num_test_unseen=0")


def config_of(command: str, folder: Path, arm: str, seed: int, size: int, *more: str) -> DictConfig:
    """Return the config of a command on the data set of one arm and seed."""
    data = (f"data.name=sand_{arm}_{seed}", f"data.seed={seed}", f"data.num_train={size}", *DATA)
    paths = (f"paths.data={folder / 'data'}", f"paths.runs={folder / 'runs'}")
    return compose(command, [*(MODEL if command == "fit" else ("size=tiny", "data=sand")), *data, *paths, *more])


def simulate(folder: Path, arm: str, seed: int, size: int) -> None:
    """Let a data set grow to a number of training scenes, in the order of the data set or by a choice of the models trained before."""
    cfg = config_of("simulate", folder, arm, seed, size)
    own = dataset_folder(cfg)
    known = [scene for choice in chosen_scenes.read(own) for scene in choice.scenes]
    if len(known) > size:  # all models of this size are trained
        return
    if arm == "random" or size == SIZES[0]:
        order = np.random.default_rng(seed).permutation(NUM_CANDIDATES)[:size].tolist()
        chosen_scenes.write(own, [chosen_scenes.Choice(order, [], NUM_CANDIDATES, 0, [], 0.0)])
    else:
        before = SIZES[SIZES.index(size) - 1]
        models = [str(folder / "runs" / name) for name in names_of(arm, seed, before)]
        choose(cfg.paths.data, candidate_spec(cfg, NUM_CANDIDATES), size, ActiveSettings(models, NUM_CANDIDATES))
    generate(cfg.paths.data, dataset_spec(cfg))


def names_of(arm: str, seed: int, size: int) -> list[str]:
    """Return the names of the runs of one data set. Both arms begin with the same models. The last data set needs one, because no choice follows."""
    number = 1 if size == SIZES[-1] else MEMBERS
    return [f"{'random' if size == SIZES[0] else arm}_{seed}_{size}_{member}" for member in range(number)]


def train(folder: Path, arm: str, seed: int, size: int) -> None:
    """Train and evaluate the models of one data set, where this was not done before."""
    for member, name in enumerate(names_of(arm, seed, size)):
        run_folder = folder / "runs" / name
        if (run_folder / "metrics.csv").exists():
            continue
        started = time.process_time()
        cfg = config_of("fit", folder, arm, seed, size, f"name={name}", f"seed={100 * seed + member}")
        run = FitRun(cfg, run_folder)
        run.prepare_data()
        run.choose_num_steps()
        run.claim_folder()
        run.evaluate(run.train())
        print(f"{name}: {run.error():.4g} m², {time.process_time() - started:.0f} s", flush=True)


def errors_of(folder: Path, arm: str, size: int, horizon: str) -> list[dict[int, float]]:
    """Return the errors of each finished seed by scene: means over the members."""
    found = []
    for seed in finished(folder):
        folders = [folder / "runs" / name for name in names_of(arm, seed, size)]
        runs = [Run(own, {}, table_of(read_rows(own / "metrics.csv"))) for own in folders]
        errors = rollout_errors(runs, "test", horizon)
        found.append({scene: float(np.mean([of[scene] for of in errors])) for scene in shared_trajectories(errors)})
    return found


def finished(folder: Path) -> list[int]:
    """Return the seeds of which all models are evaluated."""

    def is_finished(seed: int) -> bool:
        names = [name for arm in ARMS for size in SIZES for name in names_of(arm, seed, size)]
        return all((folder / "runs" / name / "metrics.csv").exists() for name in names)

    return [seed for seed in SEEDS if is_finished(seed)]


def report(folder: Path) -> None:
    """Write table and figure of the finished seeds."""
    seeds = finished(folder)
    lines = [table_row(["training scenes", "horizon", *(f"{label}: MSE ×1e-3 [m²]" for label in ARMS.values()), "chosen over random"])]
    lines.append("|" + "---|" * 5)
    rows: list[list[str]] = []
    figure = new_figure(2.3 * len(HORIZONS) + 0.4, 2.4)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(1, len(HORIZONS))
    for axes, horizon in zip(panels, HORIZONS, strict=True):
        curves: dict[str, list[tuple[float, float, float]]] = {arm: [] for arm in ARMS}
        for size in SIZES:
            tables = {arm: 1e3 * shared_table(errors_of(folder, arm, size, horizon)) for arm in ARMS}
            own = {arm: bootstrap_interval(table, statistic=np.mean) for arm, table in tables.items()}
            for arm, found in own.items():
                curves[arm].append((found.low, found.estimate, found.high))
            cells = [f"{found.estimate:.3g} [{found.low:.3g}, {found.high:.3g}]" for found in own.values()]
            ratio = bootstrap_ratio(tables["chosen"], tables["random"], statistic=np.mean, is_paired=True)
            is_start = size == SIZES[0]
            cells.append("the same models" if is_start else f"{ratio.estimate:.3g} [{ratio.low:.3g}, {ratio.high:.3g}]")
            rows.append([str(size), horizon, *cells])
        for k, (arm, curve) in enumerate(curves.items()):
            low, middle, high = np.array(curve).T
            place = np.array(SIZES) * (1.03 if k else 0.97)
            axes.errorbar(place, middle, [middle - low, high - middle], fmt="o-", color=PALETTE[k], markersize=3, label=ARMS[arm])
        axes.set_xscale("log", base=2)
        axes.set_xticks(SIZES, map(str, SIZES))
        axes.set_ylim(bottom=0)
        axes.set_title("whole rollout" if horizon == FULL else horizon, fontsize=8)
        axes.set_xlabel("training scenes", fontsize=7.5)
        axes.tick_params(labelsize=6.5)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("rollout MSE ×1e-3 [m²]", fontsize=7.5)
    panels[0].legend(fontsize=6, frameon=False)
    lines += [table_row(row) for row in rows]
    note = (
        f"Means over test scenes and seeds (number: {len(seeds)}), with 95 % bootstrap intervals over both. MSE: mean squared displacement over the frames up "
        f"to the horizon. Before a choice, each seed has {MEMBERS} models, afterwards one."
    )
    replace_text(folder / "table.md", "\n".join([*lines, "", note, "", *choices_table(folder), ""]))
    save_figure(figure, folder / "active.png", dpi=150)
    with (folder / "table.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["arm", "seed", "training_scenes", "horizon", "scene", "rollout_mse"])
        for arm in ARMS:
            for size in SIZES:
                for horizon in HORIZONS:
                    for seed, own in zip(seeds, errors_of(folder, arm, size, horizon), strict=True):
                        table.writerows([arm, seed, size, horizon, scene, f"{value:.4g}"] for scene, value in own.items())


def choices_table(folder: Path) -> list[str]:
    """Return a table of how far models were apart in the scenes that they chose."""
    lines = [table_row(["seed", "training scenes", "median spread of chosen scenes [spacings]", "of all candidates"]), "|" + "---|" * 4]
    for seed in finished(folder):
        total = 0
        for choice in chosen_scenes.read(folder / "data" / f"sand_chosen_{seed}" / "tiny"):
            total += len(choice.scenes)
            if choice.models:
                lines.append(table_row([str(seed), str(total), f"{np.median(choice.spread):.3g}", f"{choice.median_spread:.3g}"]))
    return lines


def main(folder: Path) -> None:
    """Do what is missing, and write the report."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in SEEDS:
        for size in SIZES:
            for arm in ("random", "chosen"):
                simulate(folder, arm, seed, size)
                if arm == "random" or size > SIZES[0]:
                    train(folder, arm, seed, size)
        report(folder)  # after each seed, because all take long


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    target = Path(sys.argv[1]).resolve()
    with recorded(target, "docs/active_curve.py", ["FOLDER"], str(target)):
        main(target)
