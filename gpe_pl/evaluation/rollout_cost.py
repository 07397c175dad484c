"""Computing time of rollouts per simulated second, which compares models whose frames differ in length.

It is processor time of this process on a CPU, and wall time on a GPU. The two do not compare.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.files import sealed
from gpe_pl.rollout.loop import SimulationError, Simulator, step_all
from gpe_pl.system.machine import work_clock
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
        seconds: computing time of each step of each scene so far [s].
        on_gpu: whether the simulator computes on a GPU.
    """

    simulator: Simulator
    seconds: list[float] = field(default_factory=list)
    on_gpu: bool = False

    def step(self, state: State) -> State:
        clock = work_clock(self.on_gpu)
        begun = clock()
        new = self.simulator.step(state)
        self.seconds.append(clock() - begun)
        return new

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        clock = work_clock(self.on_gpu)
        begun = clock()
        new = step_all(self.simulator, states)
        count = max(1, len(states))
        self.seconds.extend([(clock() - begun) / count] * count)
        return new


@dataclass(frozen=True)
class Cost:
    """Computing time of rollouts.

    Attributes:
        seconds: computing time per simulated second [s/s].
        on_gpu: whether it is wall time on a GPU; else it is processor time on a CPU.
    """

    seconds: float
    on_gpu: bool = False


def write_cost(folder: Path, seconds: list[float], frame_dt: float, on_gpu: bool = False) -> None:
    """Write the mean computing time of a step of one scene [s], and this time divided by ``frame_dt``. Without a step, nothing is written.

    The mean counts steps that skip their work, and those that do not, as often as they happen. The first steps, in which functions are compiled, are left out
    if there are enough others.

    Args:
        folder: folder of the run or evaluation.
        seconds: computing time of each step of each scene [s], in their order.
        frame_dt: time between frames [s].
        on_gpu: whether the steps were computed on a GPU.
    """
    if seconds:
        step = float(np.mean(seconds[min(WARM_UP, len(seconds) // 2) :]))
        sealed.write(folder / COST_FILE, {"seconds_per_step": step, "seconds_per_simulated_second": step / frame_dt, "on_gpu": on_gpu})


def read_cost(folder: Path) -> Cost | None:
    """Return the computing time of the rollouts of a run or evaluation, or None if it was not measured.

    Raises:
        SealError: the file was changed or damaged.
    """
    if not (folder / COST_FILE).is_file():
        return None
    values = sealed.read(folder / COST_FILE, "delete it to do without")
    return Cost(float(values["seconds_per_simulated_second"]), bool(values.get("on_gpu", False)))
