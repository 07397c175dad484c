"""Benchmark of the memory of gradients: one gradient of an identification, through rollouts of several lengths.

Steps are checkpointed, so memory should grow far less than the length. Each gradient is measured in a process of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import Field

from gpe_pl.benchmarks.trained import Case
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.observations import Observations
from gpe_pl.evaluation.identification.scene import trained_bounds
from gpe_pl.evaluation.identification.shooting import Shooting, ShootingSettings, shooting
from gpe_pl.evaluation.identification.unknowns import unknowns_of
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.system.machine import peak_memory
from gpe_pl.trajectory.trajectory import Trajectory

WARM_UP = 2
"""Frames of a first gradient, which loads code and is not measured."""


class ModelError(GpeError, ValueError):
    """Raised for a case without a model."""


@dataclass(frozen=True)
class Settings:
    """Models, and lengths of their rollouts.

    Attributes:
        cases: data sets; the first scene of their split ``test`` is simulated for long enough.
        models: shipped model or checkpoint of each case.
        lengths: numbers of frames through which a gradient passes; ratios are relative to the first.
        num_windows: number of rollouts that start at different frames.
    """

    cases: dict[str, Case]
    models: dict[str, str]
    lengths: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] = field(default_factory=lambda: [60, 500])
    num_windows: Annotated[int, Field(ge=1)] = 2

    def __post_init__(self) -> None:
        if self.models.keys() != self.cases.keys():
            raise ModelError(f"suite.models: names {', '.join(self.models)}; name a model for each of the cases {', '.join(self.cases)}")


def shots(simulator: LearnedSimulator, trajectory: Trajectory, length: int, num_windows: int) -> Shooting:
    """Return rollouts of a model from several frames of a motion, as a function of its material parameters."""
    unknowns = unknowns_of(trajectory, None, trained_bounds(simulator))
    return shooting(simulator, Observations.of(trajectory), unknowns, ShootingSettings(horizon=length, num_windows=num_windows))


def gradient(checkpoint: str, trajectory: Trajectory, length: int, num_windows: int) -> Callable[[], Any]:
    """Return the function that computes one gradient, after a short one that loads code."""
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    for frames in (WARM_UP, length):
        measured = shots(simulator, trajectory, frames, num_windows)
        z = [0.5] * len(measured.unknowns)
        if frames == WARM_UP:
            measured.misfit_and_gradient(z)
    return lambda: measured.misfit_and_gradient(z)


def run(settings: Settings, datasets: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """Return records of the memory [B] and its ratios, and a Markdown table."""
    first, longest = settings.lengths[0], max(settings.lengths)
    head = ["model", "nodes", "rollouts", "frames", "memory of a gradient [MB]", f"over that of {first} frames", "seconds"]
    records, lines = list[dict[str, Any]](), [table_row(head), "|" + "---|" * len(head)]
    for case, spec in datasets.items():
        checkpoint = settings.models[case]
        trajectory = generate_trajectory(spec, "test", 0, num_frames=longest + longest // 2 + 20)  # rollouts start at different frames
        base = 0
        for length in settings.lengths:
            number = len(shots(LearnedSimulator.from_checkpoint(checkpoint), trajectory, length, settings.num_windows).starts)
            began = time.monotonic()
            memory = peak_memory(gradient, checkpoint, trajectory, length, settings.num_windows)
            seconds, base = time.monotonic() - began, base or memory
            values = {"gradient_memory": (memory, "B"), "gradient_memory_ratio": (memory / base, "1"), "num_rollouts": (number, "1")}
            records += [{"metric": m, "case": f"{case}, {length}", "value": v, "unit": unit} for m, (v, unit) in values.items()]
            cells = [
                case,
                str(trajectory.num_nodes),
                str(number),
                str(length),
                f"{1e-6 * memory:.0f}",
                f"{memory / base:.2f}",
                f"{seconds:.0f}",
            ]
            lines.append(table_row(cells))
    about = (
        "Largest memory during one gradient, less that in use before it. Seconds include the start of a process and the loading of code."
    )
    return records, "\n".join([*lines, "", about])
