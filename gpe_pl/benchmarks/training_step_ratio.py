"""Time of a training step of the shipped models over three times that of the matrix products of a forward pass.

The step is one of Lightning's loop with the settings of ``fit``: windows, noise, targets, graphs, forward and backward pass, push-forward, clipping, Adam and
the average of the weights. The backward pass multiplies twice as much as the forward pass, hence three times.
"""

from __future__ import annotations

import logging
from itertools import islice
from pathlib import Path
from typing import Any, cast

from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.matrix_products import product_rate, products
from gpe_pl.data.dataset import StoredTrajectory, WindowDataset, collated
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.data.sampling import BatchSize, PushForward
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import Restartable
from gpe_pl.training.loop_times import STEPS_PER_ROUND, loop_times
from gpe_pl.training.run import TrainingSettings

log = logging.getLogger(__name__)

NUM_FRAMES = 100
"""Number of frames of the trajectory from which windows are drawn."""
NOTE = (
    "Training step: a step of the training loop of `fit`, in the mean of steps with and without push-forward, with windows of one trajectory. Products: three "
    "times those of a forward pass of the factored network, at the rate measured for its nodes. Both are the shortest of all rounds, in processor time."
)


def training_records(specs: dict[str, DatasetSpec], settings: dict[str, TrainingSettings], num_rounds: int) -> list[dict[str, Any]]:
    """Return records of every shipped model: the time of a training step [s], that of its products [s], and their ratio ``training_step_ratio``.

    Args:
        specs: data set of each shipped model, by its name.
        settings: settings of its training.
        num_rounds: number of timed rounds of steps, with and without push-forward each.
    """
    records: list[dict[str, Any]] = []
    for name, spec in specs.items():
        simulator, training = LearnedSimulator.from_checkpoint(name), settings[name]
        data, size = _windows(simulator, spec, training), BatchSize(training.batch_size)
        floor = _seconds_of_products(simulator, data, size, num_rounds)
        seconds = min(loop_times(simulator, data, size, training, None, num_rounds))
        if training.push_fraction:
            push = PushForward(0, training.push_steps, training.push_correction)
            late = min(loop_times(simulator, data, size, training, push, num_rounds))
            seconds = (1 - training.push_fraction) * seconds + training.push_fraction * late
        log.info("%s: a training step takes %.2f ms, %.1f times its products", name, 1e3 * seconds, seconds / floor)
        values = {
            "training_step_time": (seconds, "s"),
            "training_product_time": (floor, "s"),
            "training_step_ratio": (seconds / floor, "1"),
        }
        records += [{"metric": metric, "case": name, "value": value, "unit": unit} for metric, (value, unit) in values.items()]
    return records


def _windows(simulator: LearnedSimulator, spec: DatasetSpec, training: TrainingSettings) -> WindowDataset:
    trajectory = generate_trajectory(spec, "train", 0, num_frames=NUM_FRAMES)
    stored = StoredTrajectory(Path(spec.name), "0", trajectory.num_frames, trajectory.num_nodes, trajectory)
    solver = cast(Restartable, spec.solver) if training.targets == "solver" else None
    unit = float(simulator.acceleration_std) * trajectory.metadata.frame_dt
    stress = bool(simulator.model.settings.get("stress", False))
    return WindowDataset([stored], simulator.builder, training.noise, unit, 0, stress, solver, training.augmentation)


def _seconds_of_products(simulator: LearnedSimulator, data: WindowDataset, size: BatchSize, num_rounds: int) -> float:
    """Return three times the mean time of the products of a batch [s]."""
    model = cast(GPE, simulator.model)
    batches = [cast(HeteroData, collated([data[key] for key in keys])) for keys in islice(size.batches(data, 0, 0), STEPS_PER_ROUND)]
    rate = max(product_rate(model, batch) for batch in batches[:num_rounds])
    return 3 * sum(products(model, batch) for batch in batches) / len(batches) / rate


def training_table(records: list[dict[str, Any]]) -> str:
    """Return a Markdown table of these records."""
    values: dict[str, dict[str, float]] = {}
    for record in records:
        values.setdefault(record["case"], {})[record["metric"]] = record["value"]
    lines = [
        table_row(
            [name, f"{1e3 * v['training_step_time']:.1f}", f"{1e3 * v['training_product_time']:.1f}", f"{v['training_step_ratio']:.1f}"]
        )
        for name, v in values.items()
    ]
    header = table_row(["shipped model", "training step [ms]", "its products [ms]", "ratio"])
    return "\n".join([header, "|---|---|---|---|", *lines, "", NOTE])
