"""Inputs of suites: data sets, and folders of runs whose models were trained on them."""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

from gpe_pl.benchmarks.solver_rungs import CONSTANT_MODULI
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.reports.finished_runs import Run, axes_of, finished_runs

DEPTHS = ("num_message_passing_steps", "num_propagation_steps", "num_convolutions")
"""Names that models give to their number of layers."""


NOT_IN_LABELS = ("training.num_steps", "training.val_interval", "training.budget_minutes", "training.num_val_rollouts")
"""Settings that labels leave out: the length of the training, and how often and on what it is validated."""
HOW_VALIDATED = ("training.val_interval", "training.num_val_rollouts")
TRAINS = ("model.", "graph.", "training.", "data.", "start_from")
"""Prefixes of settings on which a trained model depends, besides the seed."""

log = logging.getLogger(__name__)


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


@dataclass(frozen=True)
class Labels:
    """How the labels of a training were solved.

    Attributes:
        fine: factor by which their solver divides the spacing of the nodes (``data.fine``).
        softness: factor by which its constant elastic moduli are smaller than those of a data set.
    """

    fine: int
    softness: float = 1.0

    def __str__(self) -> str:
        changes = ([f"spacing ÷ {self.fine}"] if self.fine > 1 else []) + ([f"moduli ÷ {self.softness:g}"] if self.softness != 1 else [])
        return f"labels: {' and '.join(changes)}" if changes else ""


def labels_of(run: Run, spec: DatasetSpec) -> Labels:
    """Return how the labels of a run were solved, with moduli relative to those of ``spec``."""
    ratios, solver = [], cast(Any, spec.solver)
    for material in solver.materials if hasattr(solver, "constants_of") else ():
        constants = solver.constants_of(material)
        for name in CONSTANT_MODULI:
            if hasattr(constants, name):
                own = getattr(constants, name)
                ratios.append(own / float(run.config.get(f"data.solver.{material}.{name}") or own))
    return Labels(int(run.config.get("data.fine", 1)), float(f"{max(ratios, default=1.0):.4g}"))


def has_scenes_of(spec: DatasetSpec, name: str, fine: int) -> bool:
    """Tell whether a data set is ``spec``, or has the same scenes with labels that are no finer.

    Args:
        spec: a data set.
        name, fine: name of another one, and the factor by which the solver of its labels divides the spacing.
    """

    def plain(name: str, fine: int) -> str:
        return name.removesuffix(f"_fine{fine}")

    return plain(name, fine) == plain(spec.name, spec.fine) and fine <= spec.fine


def trained_on(
    spec: DatasetSpec, runs: Iterable[Run], with_strides: bool = False, with_other_labels: bool = False
) -> dict[str, tuple[LearnedSimulator, Run]]:
    """Return simulators that were trained on a data set of this name and size, and their runs, by label.

    A label names the model, its stride if that is not 1, and the settings of training and graph in which its runs differ, without those in
    ``NOT_IN_LABELS``. Of runs with the same label, such as runs with other seeds, the first is returned. A warning names the others, except those that differ
    in their seed alone.

    Args:
        spec: the data set.
        runs: finished runs; those on other data sets are left out.
        with_strides: whether models may have a stride.
        with_other_labels: whether the labels may also be of a solver at another spacing or with other elastic moduli (``Labels``); then a label says which.

    Raises:
        StrideError: a model was trained with ``data.stride`` above 1, unless ``with_strides``.
    """
    same: dict[str, list[tuple[LearnedSimulator, Run]]] = defaultdict(list)
    for run in runs:
        name, fine = str(run.config["data.name"]), int(run.config.get("data.fine", 1))
        is_same = has_scenes_of(spec, name, fine) if with_other_labels else name == spec.name
        if is_same and run.config["size.name"] == spec.size:
            checkpoint = run.folder / "checkpoints" / "best.ckpt"
            simulator = LearnedSimulator.from_checkpoint(checkpoint) if with_strides else of_stored_frames(checkpoint)
            stride = f"stride {simulator.stride}" if simulator.stride > 1 else ""
            labels = str(labels_of(run, spec)) if with_other_labels else ""
            label = ", ".join(part for part in (model_label(simulator), stride, labels) if part)
            same[label].append((simulator, run))
    found: dict[str, tuple[LearnedSimulator, Run]] = {}
    for label, members in same.items():
        these = [run for _, run in members]
        axes = [axis for axis in axes_of(these) if axis.startswith(("training.", "graph.")) and axis not in NOT_IN_LABELS]
        axes = [axis for axis in axes if all(run.config.get(axis) is not None for run in these)]  # others follow from these
        for simulator, run in members:
            differences = [f"{axis.rpartition('.')[2]}={run.config.get(axis)}" for axis in axes]
            _, kept = found.setdefault(", ".join([label, *differences]), (simulator, run))
            if unlike := [axis for axis in axes_of([kept, run]) if axis.startswith(TRAINS) and axis not in HOW_VALIDATED]:
                log.warning("%s: left out, because its label is that of %s; they differ in %s", run.folder, kept.folder, ", ".join(unlike))
    return found


class SameNameError(GpeError, ValueError):
    """Raised when two checkpoints of a suite have one name, because reports tell models apart by their names; the message has the name."""


def refuse_same_names(checkpoints: Sequence[str]) -> None:
    """Do nothing if all models of a suite have different labels (``checkpoint_label``).

    Raises:
        SameNameError: two have the same.
    """
    labels = [checkpoint_label(checkpoint) for checkpoint in checkpoints]
    if twice := next((label for label in labels if labels.count(label) > 1), None):
        raise SameNameError(f"two checkpoints are called {twice}; copy one of them to a file of another name")


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
    """Return a label: the model's class, depth × width, and all other settings that differ from their defaults: texts by value, switches by name."""
    cls, settings = type(simulator.model), dict(simulator.description()["settings"])
    depth = next((settings.pop(k) for k in DEPTHS if k in settings), "")
    plain = cls(simulator.builder.spec).settings
    other = [_setting(k, v) for k, v in settings.items() if k != "hidden_channels" and v != plain.get(k)]
    return " ".join([f"{cls.__name__} {depth} × {settings['hidden_channels']}", *other])


def _setting(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    return name if value is True else f"{name}={value}"
