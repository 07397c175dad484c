"""Callbacks: weight averaging with warm-up, rollouts as validation, progress."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import zip_longest
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, WeightAveraging
from torch.autograd.graph import increment_version

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import liquids, open_scenes, per_frame_mse
from gpe_pl.metrics.bodies import Bodies, body_metrics
from gpe_pl.metrics.liquids import liquid_metrics, liquid_nodes
from gpe_pl.metrics.open_scenes import open_metrics
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Start, rollouts
from gpe_pl.system import ranks
from gpe_pl.system.progress import progress_bar
from gpe_pl.training import parameter_passes
from gpe_pl.trajectory.trajectory import Trajectory


class WarmAverage(WeightAveraging):
    """Exponential moving average of the weights, used for validation, checkpoints and the final model.

    The decay grows as (1 + n) / (10 + n) up to ``decay``, so that short runs are not dominated by their first steps.
    """

    def __init__(self, decay: float = 0.999) -> None:
        def average(averaged: list[torch.Tensor], current: list[torch.Tensor], _: Any) -> None:
            if averaged[0].is_floating_point():  # all tensors of one call have the same type
                assert self._average_model is not None
                number = int(self._average_model.n_averaged)  # on the CPU, so that a GPU does not have to wait
                torch._foreach_lerp_(averaged, current, self._weight_of_next(number))
            else:
                torch._foreach_copy_(averaged, current)

        super().__init__(use_buffers=False, multi_avg_fn=average)  # buffers do not learn, and infinite values have no mean
        self.decay = decay
        self._parameters: tuple[list[torch.Tensor], list[torch.Tensor]] = [], []
        self._is_covered: bool | None = None

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            self._parameters = [*self._average_model.module.parameters()], [*pl_module.parameters()]

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Move the average to the device of the weights, which Lightning moves after ``setup``."""
        if self._average_model is not None:
            self._average_model.module.to(pl_module.device)

    def _swap_models(self, pl_module: L.LightningModule) -> None:
        """Swap weights and averages, and count this as a change of the weights, which compiled rollouts have to notice. Lightning copies past the count."""
        super()._swap_models(pl_module)
        for parameter in pl_module.parameters():
            increment_version(parameter)

    def _weight_of_next(self, num_averaged: int) -> float:
        return 1 - min(self.decay, (1 + num_averaged) / (10 + num_averaged))

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Any, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Add the weights after a step to the average: on a CPU in one pass over all of them, else by the method of the base class."""
        average = self._average_model
        if self._is_covered is None:  # asked now, because the weights may have moved to another device after ``setup``
            self._is_covered = parameter_passes.are_covered(*self._parameters)
        if average is None or not average.n_averaged or not self._is_covered:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        elif trainer.global_step > self._latest_update_step:
            parameter_passes.pull(*self._parameters, self._weight_of_next(int(average.n_averaged)))
            average.n_averaged += 1
            self._latest_update_step = trainer.global_step


BODY_METRICS = ("deformation_ratio", "deformation_error", "rotation_error", "strain_energy_ratio")
"""Metrics of ``metrics.bodies`` that validation rollouts of meshes log."""


class RolloutValidation(Callback):
    """Rolls the current (averaged) model out on validation trajectories and logs the position MSE [m²] as ``val/rollout_mse``.

    If a rollout stops early, each missing frame has the error of the squared longest side of the domain. Meshes also get ``val/deformation_ratio`` and the
    other ``BODY_METRICS``, liquids the metrics of ``metrics.liquids``, and open scenes those of ``metrics.open_scenes``, as means over the trajectories whose
    truth has them. These metrics use only the frames before a rollout stops.

    Put it before ``WarmAverage`` in the list of callbacks, so that it sees the averaged weights. Each rank takes some of the trajectories.

    Args:
        trajectories: ground truth.
        num_steps: rollout length in frames.
        containment: put particles that cross a wall back on its surface.

    Attributes:
        errors: position MSE of each trajectory in the last validation [m²]; the same on all ranks.
    """

    def __init__(self, trajectories: list[Trajectory], num_steps: int, containment: bool = True) -> None:
        self.trajectories, self.num_steps, self.containment = trajectories, num_steps, containment
        self.errors: list[float] = []

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        simulator: Any = pl_module.simulator
        if trainer.sanity_checking:
            return
        pairs = self.measured(simulator)
        for name, value in {"rollout_mse": float(np.mean(self.errors)), **self._shapes(pairs)}.items():
            pl_module.log(f"val/{name}", value, sync_dist=True)  # equal on all ranks; Lightning warns without sync_dist

    def measured(self, simulator: LearnedSimulator) -> list[tuple[Trajectory, Trajectory]]:
        """Set ``errors`` to those of a simulator, and return prediction and ground truth of this rank's trajectories."""
        was_training = simulator.training
        simulator.eval()
        pairs = self._rollouts(simulator)
        simulator.train(was_training)
        self.errors = self._errors(pairs)
        return pairs

    def _rollouts(self, simulator: LearnedSimulator) -> list[tuple[Trajectory, Trajectory]]:
        """Return prediction and ground truth of this rank's trajectories."""
        trajectories = self.trajectories[ranks.rank() :: ranks.num_ranks()]
        scales = dict.fromkeys((t.metadata.spacing, t.metadata.frame_dt) for t in trajectories)
        groups = [[t for t in trajectories if (t.metadata.spacing, t.metadata.frame_dt) == scale] for scale in scales]
        return [pair for group in groups for pair in self._group(simulator.on(group[0].metadata), group)]

    def _group(self, simulator: LearnedSimulator, trajectories: list[Trajectory]) -> list[tuple[Trajectory, Trajectory]]:
        """Return prediction and ground truth of trajectories of one spacing and frame interval."""
        history = simulator.builder.config.history
        truths = [t.frames(history, history + self.num_steps + 1) for t in trajectories]
        starts = []
        for trajectory, truth in zip(trajectories, truths, strict=True):
            guard = Guard(
                bounds=truth.metadata.bounds, margin=truth.metadata.longest_side
            )  # no max_speed: nodes that fast leave the domain
            starts.append(Start(simulator.initial_state(trajectory, history), truth.num_frames - 1, truth.metadata, guard))
        contained = Contained(simulator, trajectories[0].metadata.frame_dt) if self.containment else simulator
        predicted = [own.with_nodes_of(truth) for own, truth in zip(rollouts(contained, starts), truths, strict=True)]
        return list(zip(predicted, truths, strict=True))

    def _errors(self, pairs: list[tuple[Trajectory, Trajectory]]) -> list[float]:
        """Return the position MSE of every trajectory [m²], in their order, from the pairs of all ranks."""
        means = []
        for prediction, truth in pairs:
            error, worst = per_frame_mse(prediction, truth)[1:], truth.metadata.longest_side**2
            means.append(float(np.where(np.isfinite(error), error, worst).mean()))  # frames that a stopped rollout lacks count as worst
        return [mean for part in zip_longest(*ranks.gathered(means)) for mean in part if mean is not None]

    def _shapes(self, pairs: list[tuple[Trajectory, Trajectory]]) -> dict[str, float]:
        found: list[dict[str, float]] = []
        for prediction, truth in pairs:
            steps = int(np.isfinite(per_frame_mse(prediction, truth)[1:]).sum())
            bodies, liquid = Bodies.of(truth), liquid_nodes(truth)
            if bodies is not None and steps:
                found.append(body_metrics(bodies.predicted(prediction.frames(0, steps + 1)), bodies, steps))
            if truth.alive is not None and steps:
                found.append(open_metrics(prediction, truth, steps))
            elif liquid.any() and steps:
                found.append(liquid_metrics(prediction.pos[steps, liquid], truth.pos[steps, liquid], truth.mass[liquid], truth.metadata))
        everywhere = [values for part in ranks.gathered(found) for values in part]
        named = {
            name: [values[name] for values in everywhere if name in values] for name in (*BODY_METRICS, *liquids.UNITS, *open_scenes.UNITS)
        }
        return {name: float(np.mean(values)) for name, values in named.items() if values}


class StepProgress(Callback):
    """Shows a progress bar over all steps of a training, in the terminal of the first process. A resumed training continues at its step.

    Beside it stand the last logged loss, and ``validating`` during a validation.
    """

    def __init__(self) -> None:
        self._bar = ExitStack()
        self._loss, self._is_validating = "", False

    def note(self) -> str:
        """Return what stands beside the bar."""
        return "  ".join(part for part in (self._loss, "validating" if self._is_validating else "") if part)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            self._show = self._bar.enter_context(progress_bar("training", self.note))
            self._show(trainer.global_step, trainer.max_steps)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        if trainer.is_global_zero:
            if trainer.global_step % trainer.log_every_n_steps == 0 and "train/loss" in trainer.callback_metrics:  # type: ignore[attr-defined]
                self._loss = f"loss {float(trainer.callback_metrics['train/loss']):.3g}"
            self._show(trainer.global_step, trainer.max_steps)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._is_validating = True

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._is_validating = False

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._bar.close()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        self._bar.close()
