"""``LightningModule``: one-step loss, optimiser, learning-rate decay, and an early, clear stop when numbers go bad."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Annotated, Any, Literal

import lightning as L
import torch
from pydantic import Field
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torch_geometric.data import HeteroData

from gpe_pl.data.dataset import Samples
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.metrics import OneStepNMSE
from gpe_pl.system import ranks
from gpe_pl.system.machine import has_cpp_compiler
from gpe_pl.training.push_forward import Excursions

Schedule = Literal["cosine", "exponential"]
Compile = Literal["auto", "on", "off"]

MAX_SKIPPED, SKIP_WINDOW, MAX_IN_ROW = 10, 100, 3
"""A run goes on without batches whose loss or gradient is not finite, unless there are so many of them within so many steps, or in a row."""

COMPILE_PAYS_AFTER = 10_000
"""Steps from which ``compile: auto`` repays the time that compilation takes."""

RESUMED = {
    *("state_dict", "current_model_state", "averaging_state", "optimizer_states", "lr_schedulers", "loops", "callbacks", "global_step"),
    *("skipped", "excursions"),
}
"""What a checkpoint holds from which a run goes on."""

log = logging.getLogger(__name__)


def clipped_norm(gradient_clip: float | None) -> float:
    """The largest norm of a gradient; infinite without clipping: then the norm is only looked at."""
    return math.inf if gradient_clip is None else gradient_clip


def _rows(tensor: Tensor) -> int:
    """Nodes or edges in a tensor of a graph; ``edge_index`` has its edges in columns."""
    return tensor.shape[1] if tensor.dtype == torch.int64 and tensor.dim() == 2 else tensor.shape[0]


class TrainingError(GpeError, RuntimeError):
    """Training cannot go on; the message names step, trajectories and frames."""


class TrainingModule(L.LightningModule):
    """Trains a ``LearnedSimulator`` on one-step accelerations.

    The loss is the mean squared error of the normalised acceleration over all dynamic nodes and axes, which for a fixed frame interval is the paper's MSE of
    the next position up to a constant.

    Args:
        simulator: with statistics set.
        num_steps: optimiser steps of the whole run; the schedule ends there.
        learning_rate: at the start, in Adam.
        final_learning_rate: at the end.
        schedule: ``exponential`` decays geometrically (paper: 5e-5 to 1e-6); ``cosine`` warms up and follows a half cosine (short budgets).
        warmup_steps: linear warm-up of the ``cosine`` schedule.
        stress_weight: of the mean squared error of the normalised stress, where the model decodes one, beside that of the acceleration.
        compile: ``torch.compile`` the model: ``auto`` does so when the run is long enough, the model has no faster code of its own (``is_fused``, on a CPU)
            and a C++ compiler is found.
    """

    def __init__(
        self,
        simulator: LearnedSimulator,
        num_steps: Annotated[int, Field(ge=1)],
        learning_rate: Annotated[float, Field(gt=0)] = 1e-3,
        final_learning_rate: Annotated[float, Field(gt=0)] = 1e-5,
        schedule: Schedule = "cosine",
        warmup_steps: Annotated[int, Field(ge=0)] = 100,
        stress_weight: Annotated[float, Field(gt=0)] = 1.0,
        compile: Compile = "auto",
    ) -> None:
        super().__init__()
        self.simulator = simulator
        self.num_steps, self.schedule, self.warmup_steps = num_steps, schedule, warmup_steps
        self.learning_rate, self.final_learning_rate = learning_rate, final_learning_rate
        self.stress_weight = stress_weight
        self.compile_mode: Compile = compile
        self.val_nmse = OneStepNMSE()
        self._excursions = Excursions()
        self._compilation = ExitStack()
        self._windows: list[tuple[int, int]] = []  # (trajectory, frame) of the current batch
        self._skipped: deque[int] = deque(maxlen=MAX_SKIPPED)  # the last steps without an update

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.Adam(self.simulator.parameters(), lr=self.learning_rate, fused=True)
        # a plain function: of anything else the scheduler stores the attributes in checkpoints
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.learning_rate_factor(step))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def learning_rate_factor(self, step: int) -> float:
        """Learning rate at a step over ``learning_rate``."""
        ratio = self.final_learning_rate / self.learning_rate
        if self.schedule == "exponential":
            return ratio ** (min(step, self.num_steps) / self.num_steps)
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        progress = min(1.0, (step - self.warmup_steps) / max(1, self.num_steps - self.warmup_steps))
        return ratio + (1 - ratio) * 0.5 * (1 + math.cos(math.pi * progress))

    def on_fit_start(self) -> None:
        self._compilation.enter_context(self.compiled())

    def on_fit_end(self) -> None:
        self._compilation.close()

    @contextmanager
    def compiled(self) -> Iterator[None]:
        """Inside, training steps run the model's ``compute`` through ``torch.compile``, if that is wanted and works here."""
        model = self.simulator.model
        is_long = self.num_steps - self.global_step >= COMPILE_PAYS_AFTER
        is_fast_already = self.device.type == "cpu" and model.is_fused
        wanted = self.compile_mode == "on" or (self.compile_mode == "auto" and is_long and not is_fast_already)
        if wanted and self.compile_mode == "auto" and not has_cpp_compiler():
            log.warning("compile: auto found no C++ compiler, training runs without torch.compile")
            wanted = False
        if not wanted:
            yield
            return
        plain, fast = model.compute, torch.compile(model.compute, dynamic=True)
        compiler_works = True

        def compute(*args: Any) -> Any:
            # only training steps, and no sizes of one, which the compiler would specialise on: else it recompiles until it gives up
            nonlocal compiler_works
            if compiler_works and torch.is_grad_enabled() and all(_rows(t) > 1 for t in tree_leaves(args)):
                try:
                    return fast(*args)
                except Exception as error:  # whatever the machine's tool chain lacks
                    if self.compile_mode == "on":
                        raise
                    log.warning("compile: auto does without torch.compile (%s)", type(error).__name__)
                    compiler_works = False
            return plain(*args)

        model.compute = compute
        try:
            yield
        finally:
            del model.compute  # back to the class's own

    def loss(self, samples: Samples) -> Tensor:
        """Mean squared error of the normalised accelerations, and of the normalised stress where there is one; of several ranks, the part of this one.

        Starts are taken where the simulator has come to from them, and what it predicts there moves them on.
        """
        batch = self._excursions.graphs(self.simulator, samples) if isinstance(samples, list) else samples
        predicted = self.simulator(batch)
        if isinstance(samples, list):
            self._excursions.move_on(self.simulator, samples[0].lane, predicted.acceleration)
        if "trajectory" in batch:
            self._windows = list(zip(batch.trajectory.tolist(), batch.frame.tolist(), strict=True))
        std = self.simulator.stress_std.float()
        acceleration = [(a - self._normalized(batch[m].target)).square() for m, a in predicted.acceleration.items()]
        stress = [(s - batch[m].stress_target / std).square() for m, s in predicted.stress.items()]
        if "weight" in batch:
            acceleration = self._weighted(batch, predicted.acceleration, acceleration)
            stress = self._weighted(batch, predicted.stress, stress)
        shares = self._shares(acceleration, stress)
        loss = torch.cat(acceleration).mean() * shares[0]
        if stress:
            loss = loss + self.stress_weight * torch.cat(stress).mean() * shares[1]
        return loss

    @staticmethod
    def _weighted(batch: HeteroData, materials: Iterable[str], errors: list[Tensor]) -> list[Tensor]:
        """Errors [node, …] of each material, times the weights of their graphs."""
        weight = batch.weight.float()
        return [weight[batch[m].batch][:, None] * error for m, error in zip(materials, errors, strict=True)]

    def _shares(self, *errors: list[Tensor]) -> list[float]:
        """How many of all ranks' errors of each kind are on this one. The ranks exchange it also where this one has none of a kind."""
        if ranks.num_ranks() == 1:
            return [1.0] * len(errors)
        here = torch.tensor([sum(e.numel() for e in kind) for kind in errors], device=self.device)
        return [n / max(1, total) for n, total in zip(here.tolist(), ranks.summed(here).tolist(), strict=True)]

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor | None:
        """The loss, or None where it is not finite: then this step changes nothing."""
        loss = self.loss(batch)
        if not loss.requires_grad:  # all nodes are alone, and fall freely by design: this batch teaches nothing
            loss = loss + 0.0 * torch.stack([p.sum() for p in self.simulator.parameters() if p.requires_grad]).sum()
        total = ranks.summed(loss.detach())
        if not torch.isfinite(total):
            self._skip("loss", total)
            return None if ranks.num_ranks() == 1 else loss  # ranks wait for each other's gradients, which are dropped afterwards
        self.log("train/loss", total, batch_size=1)
        return loss

    def configure_gradient_clipping(
        self, optimizer: torch.optim.Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip by norm, if that is wanted; a gradient that is not finite is dropped before it spoils the weights."""
        norm = torch.nn.utils.clip_grad_norm_(self.simulator.parameters(), clipped_norm(gradient_clip_val))
        if not torch.isfinite(norm):
            if not self._skipped or self._skipped[-1] != self.global_step:  # else its loss was not finite either
                self._skip("gradient norm", norm)
            optimizer.zero_grad(set_to_none=True)  # without gradients Adam leaves weights and moments as they are

    def _skip(self, name: str, value: Tensor) -> None:
        """Go on without a batch, unless too many of the last ones were like it; on all ranks, as the value is a sum over them.

        Raises:
            TrainingError: names step, trajectories and frames.
        """
        windows = [window for part in ranks.gathered(self._windows) for window in part]
        what = f"step {self.global_step}: the {name} is {value.item()} for (trajectory, frame) = {', '.join(map(str, windows))}"
        is_often = len(self._skipped) == MAX_SKIPPED and self.global_step - self._skipped[0] < SKIP_WINDOW
        before = MAX_IN_ROW - 1
        is_in_row = len(self._skipped) >= before and self.global_step - self._skipped[-before] <= before
        if is_often or is_in_row:
            raise TrainingError(
                f"{what}, as in {len(self._skipped)} other batches since step {self._skipped[0]}. "
                "Lower training.learning_rate, or validate the data with `python -m gpe_pl.data.validate`"
            )
        self._skipped.append(self.global_step)
        log.warning("%s; training goes on without this batch", what)

    def validation_step(self, batch: HeteroData, batch_idx: int) -> None:
        predicted = self.simulator(batch).acceleration
        for material, value in predicted.items():
            self.val_nmse.update(value, self._normalized(batch[material].target))

    def on_validation_start(self) -> None:
        self._excursions.clear()  # they have drifted from the weights, and the checkpoints that follow stay small

    def on_validation_epoch_end(self) -> None:
        self.log("val/one_step_nmse", self.val_nmse.compute(), sync_dist=True)  # of all ranks already; Lightning advises it if not told
        self.val_nmse.reset()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["simulator"] = self.simulator.description()
        checkpoint["skipped"] = list(self._skipped)
        checkpoint["excursions"] = self._excursions.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        missing = RESUMED - checkpoint.keys()
        if missing:
            raise CheckpointError(f"last.ckpt: has no {min(missing)}, and is none to resume from; delete the file to train from the start")
        self._skipped.extend(checkpoint["skipped"])
        self._excursions.load_state_dict(checkpoint["excursions"])

    def _normalized(self, target: Tensor) -> Tensor:
        return target / self.simulator.acceleration_std.to(target.dtype)
