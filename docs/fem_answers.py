"""What an engineer asks of finite-element data: deflection and peak stress of trained models beside CalculiX, in ``docs/results/fem_decks``.

``python docs/fem_answers.py NOTE DATA RUN …`` rolls each model out in the test scenes of its imported data set below DATA, from the first frame on, and writes
``table.md``, ``table.csv``, ``fem_decks.png`` and ``provenance.json``. The first scene of the first run of each data set is in the picture.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
from embed_results import RESULTS, picture

from gpe_pl.files import sealed
from gpe_pl.files.atomic import replace_text
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.quantities import quantities
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import Simulator, rollout
from gpe_pl.system.provenance import PROVENANCE, sessions
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.coloring import PALETTE
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.saving import save_figure

TARGET = RESULTS / "fem_decks"
ASKED = ("deflection", "peak stress")
COLUMNS = (
    "data",
    "model",
    "scene",
    "steps",
    "error",
    "free flight",
    *(f"{name}, {part}" for name in ASKED for part in ("over time", "largest")),
)
Row = tuple[str, str, int, int, float, float, float, float, float, float]


def rolled_out(simulator: Simulator, truth: Trajectory, start: int) -> Trajectory:
    """Return a rollout from a frame to the end."""
    return rollout(simulator, truth.state(start), truth.num_frames - 1 - start, truth.metadata)


def error(found: Trajectory, truth: Trajectory) -> float:
    """Return ‖x − x̂‖ / ‖x̂ − x̂(0)‖ over all frames; 1 is the error of a body that stays at rest, infinite that of a rollout that failed."""
    if found.num_frames < truth.num_frames:
        return float("inf")
    pos = truth.pos.astype(np.float64)
    return float(np.linalg.norm(found.pos - pos) / np.linalg.norm(pos - pos[0]))


def answers(found: Trajectory, truth: Trajectory) -> tuple[list[float], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return, for each of ``ASKED``, rms error over time relative to the largest value, and ratio of the largest values; and the values over time."""
    of_truth, own, numbers, courses = quantities(truth), quantities(found), list[float](), {}
    for name in ASKED:
        a, b = of_truth[name].over_time, own[name].over_time
        courses[name] = a, b
        numbers += [float(np.sqrt(np.mean((a[: len(b)] - b) ** 2)) / a.max()), float(b.max() / a.max())]
    return numbers, courses


def main(note: str, data: Path, runs: list[Path]) -> None:
    """Roll out, and write table and picture."""
    rows, shown = list[Row](), {}
    for run in runs:
        config = json.loads((run / "config.json").read_text())
        name, steps = config["data"]["name"], int(config["training"]["num_steps"])
        simulator = LearnedSimulator.from_checkpoint(run)
        for k, truth in enumerate(iter_trajectories(data / name / "imported", "test")):
            start = simulator.builder.config.history
            found = rollout(simulator, simulator.initial_state(truth, start), truth.num_frames - 1 - start, truth.metadata)
            own = truth.frames(start)
            numbers, courses = answers(found, own)
            flight = rolled_out(Ballistic(truth.metadata.frame_dt), truth, start)
            rows.append((name, run.name, k, steps, error(found, own), error(flight, own), *numbers))  # type: ignore[arg-type]
            shown.setdefault(name, (truth.metadata.frame_dt, courses))
    TARGET.mkdir(exist_ok=True)
    with (TARGET / "table.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *([*row[:4], *(f"{x:.4g}" for x in row[4:])] for row in rows)])
    replace_text(TARGET / "table.md", "\n".join(table(rows)))
    figure = new_figure(6.0, 2.0 * len(shown) + 0.2)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(len(shown), len(ASKED), squeeze=False)
    for line, (name, (dt, courses)) in zip(panels, shown.items(), strict=True):
        for axes, asked in zip(line, ASKED, strict=True):
            unit, scale = ("mm", 1e3) if asked == "deflection" else ("kPa", 1e-3)
            for values, label, style in zip(
                courses[asked], ("CalculiX", "model"), ({"color": "0.2"}, {"color": PALETTE[1], "linestyle": "--"}), strict=True
            ):
                axes.plot(dt * np.arange(1, len(values) + 1), scale * values, label=label, **style)
            axes.set_title(name, fontsize=8)
            axes.set_xlabel("time [s]", fontsize=7.5)
            axes.set_ylabel(f"{asked} [{unit}]", fontsize=7.5)
            axes.tick_params(labelsize=6.5)
            axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].legend(fontsize=6.5, frameon=False)
    save_figure(figure, TARGET / "before.png", dpi=150)
    picture(TARGET / "before.png", TARGET / "fem_decks.png")
    (TARGET / "before.png").unlink()
    told = [session for run in runs for session in sessions(run)]
    sealed.write(TARGET / PROVENANCE, {"sessions": told, "seeds": [0], "note": note})


def table(rows: list[Row]) -> list[str]:
    """Return the lines of the table: means over scenes."""
    lines = [
        table_row(
            [
                "data",
                "model",
                "steps",
                "scenes",
                "error",
                "free flight",
                *(f"{n}, {p}" for n in ASKED for p in ("error over time", "largest")),
            ]
        ),
        "|" + "---|" * 10,
    ]
    for name, model in dict.fromkeys(row[:2] for row in rows):
        own = [row for row in rows if row[:2] == (name, model)]
        mean = np.mean([row[4:] for row in own], axis=0)
        cells = [f"{mean[0]:.3g}", f"{mean[1]:.3g}"] + [f"{100 * mean[k]:.1f} %" if k % 2 == 0 else f"{mean[k]:.2f}" for k in range(2, 6)]
        lines.append(table_row([name, model, str(own[0][3]), str(len(own)), *cells]))
    lines += [
        "",
        "Means over test scenes, from the first frame to the last. Error: ‖x − x̂‖ / ‖x̂ − x̂(0)‖; a body that stays at rest has 1. Error over time: rms "
        "difference from CalculiX relative to its largest value. Largest: largest value over that of CalculiX.",
        "",
    ]
    return lines


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), [Path(run) for run in sys.argv[3:]])
