"""What a learned model costs before its first rollout: tuning, training, and generating its data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from gpe_pl.learned.pretrained import BEST, fingerprint
from gpe_pl.reports.finished_runs import Run
from gpe_pl.training.budget import read_times


@dataclass(frozen=True)
class Simulated:
    """Training data.

    Attributes:
        fine: factor by which their solver divides the spacing of the nodes.
        num_nodes: number of nodes of a scene; NaN if the configuration does not name it.
        seconds: simulated time of all training scenes [s].
        name: name, size and seed of the data set, by which data sets of equal size differ.
    """

    fine: int
    num_nodes: float
    seconds: float
    name: str = ""


@dataclass(frozen=True)
class Spent:
    """What a model cost before its first rollout.

    Attributes:
        training: seconds of its training, of the trainings that it started from, and of tuning; NaN if one of them is not known.
        data: the data of these trainings, each data set once.
    """

    training: float
    data: tuple[Simulated, ...] = ()

    def seconds(self, rates: Mapping[int, float], num_nodes: float) -> float:
        """Return the total time [s]; NaN if part of it is not known.

        The time of a solver is taken to be proportional to the number of nodes, if it is known.

        Args:
            rates: seconds per simulated second of the solver, by the factor by which it divides the spacing of the nodes.
            num_nodes: number of nodes of the scenes that gave the rates; NaN if not known.
        """
        total = self.training
        for data in self.data:
            ratio = data.num_nodes / num_nodes
            total += data.seconds * rates.get(data.fine, math.nan) * (1.0 if math.isnan(ratio) else ratio)
        return total


def spent_on(run: Run, runs: Iterable[Run], tuning: Sequence[Run] = ()) -> Spent:
    """Return what the model of a run cost.

    Args:
        run: the run.
        runs: finished runs, among them the one that it started from, if any. Without it the cost is not known.
        tuning: runs that were made to choose settings. The model's own trainings among them are not counted twice.
    """
    chain = _trainings(run, [*runs, *tuning])
    if chain is None:
        return Spent(math.nan)
    further = [other for other in tuning if other.folder not in {own.folder for own in chain}]
    data = dict.fromkeys(_simulated(own) for own in chain)
    return Spent(sum(training_seconds(own) for own in (*chain, *further)), tuple(data))


def _trainings(run: Run, runs: Sequence[Run]) -> list[Run] | None:
    """Return the run and those whose models it and they started from; None if one is missing."""
    chain = [run]
    while (start := chain[-1].config.get("start_from")) is not None:
        before = next((other for other in runs if (other.folder / BEST).exists() and fingerprint(other.folder) == start), None)
        if before is None:
            return None
        chain.append(before)
    return chain


def _simulated(run: Run) -> Simulated:
    count, frames, dt = (float(run.config.get(f"data.{key}", math.nan)) for key in ("num_train", "num_frames", "solver.frame_dt"))
    num_nodes = float(run.config.get("data.scene.num_particles", math.nan))
    name = " ".join(str(run.config.get(key)) for key in ("data.name", "size.name", "data.seed"))
    return Simulated(int(run.config.get("data.fine", 1)), num_nodes, count * (frames - 1) * dt, name)


def training_seconds(run: Run) -> float:
    """Return the training time of a run [s]: its number of steps times the step time that its sweep measured.

    Of several measured times, the largest counts with which the run stays within its time budget, or else the smallest. NaN if there is none.
    """
    path = next((p for folder in (run.folder, *run.folder.parents) if (p := folder / "step_times.json").exists()), None)
    model = str(run.config["model._target_"]).rpartition(".")[2]
    about = f"{run.config['data.name']} {run.config['size.name']} {model} "
    steps, budget = float(run.config["training.num_steps"]), 60 * float(run.config.get("size.comparison.budget_minutes") or math.inf)
    times = {} if path is None else read_times(path)
    possible = sorted(steps * t for key, t in times.items() if key.startswith(about))
    return max((seconds for seconds in possible if seconds <= budget), default=possible[0] if possible else math.nan)
