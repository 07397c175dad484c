"""The picture of the guide's page on uncertainty, ``docs/images/uncertainty.png``, and its numbers, ``docs/images/uncertainty.txt``.

``python docs/uncertainty_picture.py errors DATA_SET SPLIT NUMBER FILE`` rolls the shipped model of sand out in scenes of a data set, and stores how far
nodes are from the ground truth. Run it for calibration scenes and for new ones, of ``python -m gpe_pl.simulate data=sand size=small data.seed=1`` with
``data.num_test=40``, and of another seed. ``python docs/uncertainty_picture.py draw CALIBRATION_FILE NEW_FILE`` calibrates bands on the first and draws their
coverage of the second.
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import numpy as np
from matplotlib.collections import EllipseCollection

from gpe_pl.evaluation.predictions import start_of
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.bands import LEVEL, LEVELS, errors_of, factors_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.conformal import chance_range
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollouts
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import new_figure

IMAGES = Path(__file__).resolve().parent / "images"
NUM_FRAMES = 101
HORIZONS = (5, 20, 50, 100)
SHOWN = (5, 20, 50)
AT_ONCE = 16


def errors(root: Path, split: str, number: int, file: Path) -> None:
    """Store errors [scene, frame, node] in spacings, groups of parameters, and the positions of the first scene."""
    simulator = LearnedSimulator.from_checkpoint("sand")
    history, metadata = simulator.builder.config.history, simulator.builder.metadata
    trajectories = list(islice(iter_trajectories(root, split), number))
    found, groups, first = list[np.ndarray](), [t.metadata.parameter_group for t in trajectories], None
    for k in range(0, len(trajectories), AT_ONCE):
        truths = [t.frames(history, history + NUM_FRAMES) for t in trajectories[k : k + AT_ONCE]]
        starts = [start_of(simulator, history, *pair) for pair in zip(trajectories[k : k + AT_ONCE], truths, strict=True)]
        predictions = rollouts(Contained(simulator, metadata.frame_dt), starts)
        found += [errors_of(*pair) / metadata.spacing for pair in zip(predictions, truths, strict=True)]
        first = first or (predictions[0].pos[[*SHOWN]] / metadata.spacing, truths[0].pos[[*SHOWN]] / metadata.spacing)
    assert first is not None
    np.savez_compressed(file, errors=np.stack(found), groups=groups, predicted=first[0], truth=first[1], dt=metadata.frame_dt)


def draw(calibration: Path, new: Path) -> None:
    """Calibrate on one file, and draw and tabulate the coverage of another."""
    known, scenes = np.load(calibration), np.load(new)
    scores = [*known["errors"][:, :NUM_FRAMES]]
    nodes, whole = factors_of(scores, "nodes"), factors_of(scores, "scene")
    dt, level = float(scenes["dt"]), f"{LEVEL:g}"
    header = [
        "scenes",
        "number",
        "time",
        "nodes inside",
        "scenes with enough nodes inside",
        "by chance",
        "radius [spacings]",
        "radius for scenes",
    ]
    lines = [table_row(header), "|" + "---|" * len(header)]
    figure = new_figure(9.5, 4.6)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(2, 3)
    for axes, k, frame in zip(panels[0], range(3), SHOWN, strict=True):
        predicted, truth, radius = scenes["predicted"][k], scenes["truth"][k], nodes[level][frame - 1]
        size = np.full(len(predicted), 2 * float(radius or np.nan))
        bands = EllipseCollection(
            size, size, np.zeros(len(size)), units="xy", offsets=predicted, transOffset=axes.transData, color=PALETTE[0], alpha=0.06
        )
        axes.add_collection(bands)
        inside = np.linalg.norm(predicted - truth, axis=1) <= float(radius or np.inf)
        for mask, color in ((inside, "black"), (~inside, PALETTE[1])):
            axes.plot(*truth[mask].T, ".", markersize=2.5, color=color)
        axes.set_aspect("equal")
        axes.set_xlim(0, 64)
        axes.set_ylim(0, 45)
        axes.set_title(f"after {frame * dt:g} s: {100 * inside.mean():.0f} % of nodes inside", fontsize=8)
    groups = scenes["groups"]
    for axes, group in zip(panels[1], ("interpolated", "extrapolated"), strict=False):
        own = scenes["errors"][groups == group]
        axes.fill_between([40, 100], [35, 95], [45, 105], color="0.92", linewidth=0)
        axes.plot([40, 100], [40, 100], ":", color="0.5")
        for j, frame in enumerate(HORIZONS):
            inside = [np.mean(own[:, frame] <= float(nodes[f"{q:g}"][frame - 1] or np.inf)) for q in LEVELS]
            axes.plot(
                [100 * q for q in LEVELS],
                [100 * x for x in inside],
                "o-",
                markersize=3,
                linewidth=1,
                color=PALETTE[j],
                label=f"{frame * dt:g} s",
            )
            covered = (own[:, frame] <= float(whole[level][frame - 1] or np.inf)).mean(axis=1) >= LEVEL
            low, high = chance_range(len(scores), len(own), LEVEL)
            cells = [
                group,
                str(len(own)),
                f"{frame * dt:g} s",
                f"{100 * inside[LEVELS.index(LEVEL)]:.1f} %",
                f"{100 * covered.mean():.0f} %",
            ]
            lines.append(
                table_row(
                    [*cells, f"{100 * low:.0f} to {100 * high:.0f} %", f"{nodes[level][frame - 1]:.3g}", f"{whole[level][frame - 1]:.3g}"]
                )
            )
        axes.set_xlabel("nominal coverage [%]", fontsize=8)
        axes.set_ylabel("observed [%]", fontsize=8)
        axes.set_title(f"{len(own)} scenes with {group} friction angles", fontsize=8)
        axes.set_xlim(45, 100)
        axes.set_ylim(45, 102)
        axes.legend(fontsize=7, frameon=False, loc="lower right")
    time = dt * np.arange(1, NUM_FRAMES)
    for factors, name, color in ((nodes, "for nodes", PALETTE[0]), (whole, "for scenes", PALETTE[3])):
        panels[1][2].plot(
            time, [np.nan if f is None else f for f in factors[level]], color=color, label=f"bands of {100 * LEVEL:g} % {name}"
        )
    panels[1][2].plot(time, np.median(scenes["errors"][groups == "interpolated"][:, 1:], axis=(0, 2)), "k:", label="median error")
    panels[1][2].set_yscale("log")
    panels[1][2].set_xlabel("time [s]", fontsize=8)
    panels[1][2].set_ylabel("spacings", fontsize=8)
    panels[1][2].set_title("radii", fontsize=8)
    panels[1][2].legend(fontsize=7, frameon=False)
    for axes in panels.flat:
        axes.tick_params(labelsize=6.5)
    figure.savefig(IMAGES / "uncertainty.png", dpi=110)
    (IMAGES / "uncertainty.txt").write_text(
        "\n".join([*lines, "", f"Bands with a level of {100 * LEVEL:g} %, from {len(scores)} calibration scenes.", ""])
    )


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    if command == "errors":
        errors(Path(arguments[0]), arguments[1], int(arguments[2]), Path(arguments[3]))
    else:
        draw(Path(arguments[0]), Path(arguments[1]))
