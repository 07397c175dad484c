"""Processor time of rollouts per simulated second, which compares models whose frames differ in length.

Only the time of this process on CPUs counts. Work on a GPU is not in it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.files import sealed
from gpe_pl.rollout.loop import SimulationError, Simulator, step_all
from gpe_pl.trajectory.state import State

COST_FILE = "rollout_cost.json"
"""File with the cost of rollouts in the folder of a run or evaluation."""
WARM_UP = 20
"""Number of steps before the mean begins."""


@dataclass(frozen=True)
class Timed:
    """A simulator whose steps are timed.

    Attributes:
        simulator: simulator that makes the steps.
        seconds: processor time of each step of each scene so far [s].
    """

    simulator: Simulator
    seconds: list[float] = field(default_factory=list)

    def step(self, state: State) -> State:
        begun = time.process_time()
        new = self.simulator.step(state)
        self.seconds.append(time.process_time() - begun)
        return new

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        begun = time.process_time()
        new = step_all(self.simulator, states)
        count = max(1, len(states))
        self.seconds.extend([(time.process_time() - begun) / count] * count)
        return new


def write_cost(folder: Path, seconds: list[float], frame_dt: float) -> None:
    """Write the mean processor time of a step of one scene [s], and this time divided by ``frame_dt``. Without a step, nothing is written.

    The mean counts steps that skip their work, and those that do not, as often as they happen. The first steps, in which functions are compiled, are left out
    if there are enough others.

    Args:
        folder: folder of the run or evaluation.
        seconds: processor time of each step of each scene [s], in their order.
        frame_dt: time between frames [s].
    """
    if seconds:
        step = float(np.mean(seconds[min(WARM_UP, len(seconds) // 2) :]))
        sealed.write(folder / COST_FILE, {"seconds_per_step": step, "seconds_per_simulated_second": step / frame_dt})


def read_cost(folder: Path) -> float | None:
    """Return the processor time per simulated second [s/s], or None if it was not measured.

    Raises:
        SealError: the file was changed or damaged.
    """
    if not (folder / COST_FILE).is_file():
        return None
    return float(sealed.read(folder / COST_FILE, "delete it to do without")["seconds_per_simulated_second"])
