"""Inputs of suites: data sets, and folders of runs whose models were trained on them."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.reports.finished_runs import Run, axes_of, finished_runs

DEPTHS = ("num_message_passing_steps", "num_propagation_steps", "num_convolutions")
"""Names that models give to their number of layers."""


NOT_IN_LABELS = ("training.num_steps", "training.val_interval", "training.budget_minutes", "training.num_val_rollouts")
"""Settings that labels leave out: the length of the training, and how often and on what it is validated."""


@dataclass(frozen=True)
class Case:
    """A data set, given by the overrides of ``python -m gpe_pl.simulate``."""

    overrides: list[str]


def runs_in(folders: Sequence[str]) -> list[Run]:
    """Return the finished runs in all these folders."""
    return [run for folder in folders for run in finished_runs(Path(folder))]


class StrideError(GpeError, ValueError):
    """Raised for a model with a stride, because most suites run models on stored frames; the message names the model and its stride."""


def of_stored_frames(checkpoint: Path | str) -> LearnedSimulator:
    """Return the simulator of a checkpoint that was trained on all stored frames.

    Raises:
        StrideError: it was trained with ``data.stride`` above 1.
        CheckpointError: as ``LearnedSimulator.from_checkpoint``.
    """
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    if simulator.stride != 1:
        raise StrideError(
            f"{checkpoint}: was trained with data.stride={simulator.stride}, and suites run models on stored frames; choose a model without it, "
            "or compare strides with `fit experiment=stride`"
        )
    return simulator


def trained_on(spec: DatasetSpec, runs: Iterable[Run], with_strides: bool = False) -> dict[str, tuple[LearnedSimulator, Run]]:
    """Return simulators that were trained on a data set of this name and size, and their runs, by label.

    A label names the model, its stride if that is not 1, and the settings of training and graph in which its runs differ, without those in
    ``NOT_IN_LABELS``. Of runs with the same label, such as runs with other seeds, the first is returned.

    Args:
        spec: the data set.
        runs: finished runs; those on other data sets are left out.
        with_strides: whether models may have a stride.

    Raises:
        StrideError: a model was trained with ``data.stride`` above 1, unless ``with_strides``.
    """
    same: dict[str, list[tuple[LearnedSimulator, Run]]] = defaultdict(list)
    for run in runs:
        if (run.config["data.name"], run.config["size.name"]) == (spec.name, spec.size):
            checkpoint = run.folder / "checkpoints" / "best.ckpt"
            simulator = LearnedSimulator.from_checkpoint(checkpoint) if with_strides else of_stored_frames(checkpoint)
            label = model_label(simulator) + (f", stride {simulator.stride}" if simulator.stride > 1 else "")
            same[label].append((simulator, run))
    found: dict[str, tuple[LearnedSimulator, Run]] = {}
    for label, members in same.items():
        these = [run for _, run in members]
        axes = [axis for axis in axes_of(these) if axis.startswith(("training.", "graph.")) and axis not in NOT_IN_LABELS]
        axes = [axis for axis in axes if all(run.config.get(axis) is not None for run in these)]  # others follow from these
        for simulator, run in members:
            differences = [f"{axis.rpartition('.')[2]}={run.config.get(axis)}" for axis in axes]
            found.setdefault(", ".join([label, *differences]), (simulator, run))
    return found


def checkpoint_label(checkpoint: str) -> str:
    """Return a short name for a model that is given as the path of a checkpoint, the folder of a run, or the name of a shipped model."""
    path = Path(checkpoint)
    return path.parent.parent.name if path.parent.name == "checkpoints" else path.name.removesuffix(".ckpt")


def fingerprint_of(simulator: LearnedSimulator) -> str:
    """Return a checksum of the weights and settings of a simulator."""
    digest = sha256(json.dumps(simulator.description(), sort_keys=True).encode())
    for name, value in sorted(simulator.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.cpu().numpy().tobytes())
    return digest.hexdigest()


def model_label(simulator: LearnedSimulator) -> str:
    """Return a label: the model's class, depth × width, and the values of all other settings that differ from their defaults."""
    cls, settings = type(simulator.model), dict(simulator.description()["settings"])
    depth = next((settings.pop(k) for k in DEPTHS if k in settings), "")
    plain = cls(simulator.builder.spec).settings
    other = [str(v) for k, v in settings.items() if k != "hidden_channels" and v != plain.get(k)]
    return " ".join([f"{cls.__name__} {depth} × {settings['hidden_channels']}", *other])
