"""``LightningModule`` of a learned simulator: loss over one or several steps, optimiser, learning-rate schedule, and an end if losses stay infinite or NaN."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Annotated, Any, Literal

import lightning as L
import torch
from lightning.pytorch.callbacks import WeightAveraging
from pydantic import Field
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torch_geometric.data import HeteroData

from gpe_pl.data.dataset import Samples
from gpe_pl.data.training_samples import Unroll, UnrollStart
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import OneStepNMSE
from gpe_pl.models.base import Prediction
from gpe_pl.nn.stores import predicted_rows
from gpe_pl.system import ranks
from gpe_pl.system.machine import has_cpp_compiler
from gpe_pl.training.cuda_graph import CudaGraphs
from gpe_pl.training.loss_terms import LEAST_ERROR, Loss, StressLoss, num_neighbors, penalty, stress_error, without_held
from gpe_pl.training.optimizer import OnePassAdam, clip
from gpe_pl.training.push_forward import Excursions
from gpe_pl.training.resumption import check_resumable
from gpe_pl.training.unroll_gradients import predictions

Schedule = Literal["cosine", "exponential", "staircase"]
Compile = Literal["auto", "on", "off"]
CudaGraph = Literal["auto", "off"]

MAX_SKIPPED, SKIP_WINDOW, MAX_IN_ROW = 10, 100, 3
"""Limits on skipped batches, whose loss or gradient is not finite. More than ``MAX_SKIPPED`` within ``SKIP_WINDOW`` steps, or ``MAX_IN_ROW`` in a row, stop the
run."""

COMPILE_PAYS_AFTER = 10_000
"""Number of training steps from which compilation saves more time than it takes. ``compile: auto`` compiles longer runs."""

log = logging.getLogger(__name__)


def _rows(tensor: Tensor) -> int:
    """Return the number of nodes or edges in a tensor of a graph; ``edge_index`` has its edges in columns."""
    return tensor.shape[1] if tensor.dtype == torch.int64 and tensor.dim() == 2 else tensor.shape[0]


class TrainingError(GpeError, RuntimeError):
    """Raised when training cannot continue; the message names step, trajectories and frames."""


class TrainingModule(L.LightningModule):
    """Trains a ``LearnedSimulator`` on accelerations.

    By default, the loss is the mean squared error of the normalised acceleration over axes and all dynamic nodes whose motion is not given. For a fixed frame
    interval this is, up to a constant, the paper's MSE of the next position.

    Args:
        simulator: simulator with its statistics set.
        num_steps: optimiser steps of the whole run; the schedule ends there.
        learning_rate: highest learning rate of Adam: that at the start, or after the warm-up.
        final_learning_rate: learning rate at the end.
        schedule: ``exponential`` decays geometrically (paper: 5e-5 to 1e-6); ``cosine`` warms up and follows a half cosine (short budgets); ``staircase`` keeps
            the rate for half of the steps, then falls after every tenth of the steps by the same factor, to the final rate in the last tenth.
        warmup_steps: steps of linear warm-up in the ``cosine`` schedule.
        loss: penalty of errors of normalised accelerations, ``square``, ``log`` or ``root``; see ``loss_terms.penalty``.
        stress_loss: squared errors of the stress, ``square``, or divided by the mean square in each scene, ``relative``; see ``loss_terms.stress_error``.
        stress_weight: weight of the mean squared error of the normalised stress, relative to that of the acceleration; used if the model decodes a stress.
        neighbor_weight: c in the weight exp(−c n/n̄) of the acceleration of a node with n neighbours; see ``loss_terms.num_neighbors``. None weights all alike.
        mean_neighbors: n̄, the mean number of neighbours of a node in the training data.
        compile: whether to apply ``torch.compile`` to the model. ``auto`` compiles if the run is long enough, the model has neither CUDA graphs nor fused
            passes for the device (``is_fused``, on a CPU), and a C++ compiler is found.
        cuda_graph: whether training steps use CUDA graphs of the model. ``auto`` does so on a GPU in runs of one process; see ``training.cuda_graph``.
    """

    def __init__(
        self,
        simulator: LearnedSimulator,
        num_steps: Annotated[int, Field(ge=1)],
        learning_rate: Annotated[float, Field(gt=0)] = 1e-3,
        final_learning_rate: Annotated[float, Field(gt=0)] = 1e-5,
        schedule: Schedule = "cosine",
        warmup_steps: Annotated[int, Field(ge=0)] = 100,
        loss: Loss = "square",
        stress_loss: StressLoss = "square",
        stress_weight: Annotated[float, Field(gt=0)] = 1.0,
        neighbor_weight: Annotated[float, Field(gt=0, le=10)] | None = None,
        mean_neighbors: Annotated[float, Field(gt=0)] = 1.0,
        compile: Compile = "auto",
        cuda_graph: CudaGraph = "auto",
    ) -> None:
        super().__init__()
        self.simulator = simulator
        self.num_steps, self.schedule, self.warmup_steps = num_steps, schedule, warmup_steps
        self.learning_rate, self.final_learning_rate = learning_rate, final_learning_rate
        self.loss_kind: Loss = loss
        self.stress_loss: StressLoss = stress_loss
        self.stress_weight, self.neighbor_weight, self.mean_neighbors = stress_weight, neighbor_weight, mean_neighbors
        self.compile_mode: Compile = compile
        self.cuda_graph: CudaGraph = cuda_graph
        self.val_nmse = OneStepNMSE()
        self._excursions = Excursions()
        self._compilation = ExitStack()
        self._graphs: CudaGraphs | None = None  # inside ``compiled``
        self._windows: list[tuple[int, int]] = []  # (trajectory, frame) of the current batch
        self._skipped: deque[int] = deque(maxlen=MAX_SKIPPED)  # the last steps without an update

    def configure_optimizers(self) -> Any:
        optimizer = OnePassAdam(self.simulator.parameters(), self.learning_rate)
        # a plain function: the scheduler would store the attributes of any other callable in checkpoints
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.learning_rate_factor(step))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def learning_rate_factor(self, step: int) -> float:
        """Return the learning rate at a step divided by ``learning_rate``."""
        ratio = self.final_learning_rate / self.learning_rate
        if self.schedule == "exponential":
            return ratio ** (min(step, self.num_steps) / self.num_steps)
        if self.schedule == "staircase":
            return ratio ** (min(5, max(0, 10 * step // self.num_steps - 4)) / 5)
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
        """Run the model's ``compute`` through ``torch.compile`` and as CUDA graphs in training steps inside this context, where the settings say so."""
        model = self.simulator.model
        plain = compute = model.compute
        if self._wants_compilation():
            compute = self._compiled(plain)
        if self._wants_graphs():
            compute = self._graphs = CudaGraphs(model, compute)
        if compute is plain:
            yield
            return
        model.compute = compute
        try:
            yield
        finally:
            if self._graphs is not None:
                self._graphs.clear()
                self._graphs = None
            del model.compute  # leaves the method of the class

    def _wants_graphs(self) -> bool:
        return self.cuda_graph == "auto" and self.device.type == "cuda" and ranks.num_ranks() == 1

    def _wants_compilation(self) -> bool:
        """Tell whether ``compile`` asks for ``torch.compile``, and it works here."""
        is_long = self.num_steps - self.global_step >= COMPILE_PAYS_AFTER
        is_fast_already = self._wants_graphs() or (self.device.type == "cpu" and self.simulator.model.is_fused)
        wanted = self.compile_mode == "on" or (self.compile_mode == "auto" and is_long and not is_fast_already)
        if wanted and self.compile_mode == "auto" and not has_cpp_compiler():
            log.warning("compile: auto found no C++ compiler; training runs without torch.compile")
            return False
        return wanted

    def _compiled(self, plain: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``compute`` of the model, compiled for training steps."""
        fast, compiler_works = torch.compile(plain, dynamic=True), True

        def compute(*args: Any) -> Any:
            # only training steps, and no sizes of one: the compiler would specialise on them and recompile until it gives up
            nonlocal compiler_works
            if compiler_works and torch.is_grad_enabled() and all(_rows(t) > 1 for t in tree_leaves(args)):
                try:
                    return fast(*args)
                except Exception as error:  # depends on what the machine's tool chain lacks
                    if self.compile_mode == "on":
                        raise
                    log.warning("compile: auto continues without torch.compile, which fails here (%s)", type(error).__name__)
                    compiler_works = False
            return plain(*args)

        return compute

    def loss(self, samples: Samples) -> Tensor:
        """Return the mean penalty of the normalised accelerations, plus the weighted error of the normalised stress if the model decodes one.

        With several ranks, the result is this rank's part of the loss; the loss is the sum over ranks. For push-forward samples, graphs are made of the states
        that the unrolls have reached, and the predictions advance these unrolls by one step. For unrolls with gradients, the loss is the mean over their steps.
        Its errors are those of positions after each step, in units of the acceleration scale times the squared frame interval.
        """
        if self._graphs is not None:
            self._graphs.begin_step()
        if isinstance(samples, list) and isinstance(samples[0], Unroll):
            unrolls = [sample for sample in samples if isinstance(sample, Unroll)]
            return self._mean_loss(predictions(self.simulator, unrolls), unrolls[0].num_steps)
        starts = [sample for sample in samples if isinstance(sample, UnrollStart)] if isinstance(samples, list) else []
        batch = self._excursions.graphs(self.simulator, starts).to(self.device) if isinstance(samples, list) else samples
        predicted = self.simulator(batch)
        if starts:
            self._excursions.move_on(self.simulator, starts[0].lane, predicted)
        self._remember_windows(batch)
        return self._loss_of(batch, predicted)

    def _mean_loss(self, steps: Iterable[tuple[HeteroData, Prediction]], count: int) -> Tensor:
        """Return the mean loss over ``count`` steps. Steps in which no scene is left count as zero."""
        losses: list[Tensor] = []
        for batch, predicted in steps:
            if not losses:
                self._remember_windows(batch)
            losses.append(self._loss_of(batch, predicted))
        for _ in range(count - len(losses)):
            self._fractions([], [])  # other ranks may have these steps
        return torch.stack(losses).sum() / count

    def _remember_windows(self, batch: HeteroData) -> None:
        if "trajectory" in batch:
            self._windows = list(zip(batch.trajectory.tolist(), batch.frame.tolist(), strict=True))

    def _loss_of(self, batch: HeteroData, predicted: Prediction) -> Tensor:
        """Return the loss of the predictions for a batch of training graphs."""
        std = self.simulator.stress_std.to(self.simulator.builder.precision)
        acceleration = [
            self._penalty(without_held(batch[m], a - self._normalized(batch[m].target))) for m, a in predicted.acceleration.items()
        ]
        stress = [self._stress_error(batch, m, s, batch[m].stress_target / std) for m, s in predicted.stress.items()]
        stores = [batch[m] for m in predicted.acceleration]
        if self.neighbor_weight is not None:
            acceleration = self._weighted_by_neighbors(batch, predicted.acceleration, acceleration)
        if "weight" in batch:
            acceleration = self._weighted(batch, predicted.acceleration, acceleration)
            stress = self._weighted(batch, predicted.stress, stress)
        acceleration = [predicted_rows(store, error) for store, error in zip(stores, acceleration, strict=True)]
        fractions = self._fractions(acceleration, stress)
        loss = torch.cat(acceleration).mean() * fractions[0]
        if stress:
            loss = loss + self.stress_weight * torch.cat(stress).mean() * fractions[1]
        return loss

    def _penalty(self, error: Tensor) -> Tensor:
        """Return ``loss_terms.penalty`` of errors [node, dim] of normalised accelerations."""
        unit = self.simulator.builder.scales.acceleration / self.simulator.acceleration_std  # moves a node by one rest spacing in a frame
        return penalty(error, self.loss_kind, (LEAST_ERROR * unit).to(error.dtype))

    def _stress_error(self, batch: HeteroData, material: str, predicted: Tensor, target: Tensor) -> Tensor:
        """Return ``loss_terms.stress_error`` of the nodes of a material."""
        store = batch[material]
        graph = store.batch if "batch" in store else target.new_zeros(len(target), dtype=torch.int64)
        return stress_error(predicted, target, self.stress_loss, graph)

    def _weighted_by_neighbors(self, batch: HeteroData, materials: Iterable[str], errors: list[Tensor]) -> list[Tensor]:
        """Return errors [node, …] of each material, multiplied by the weights of their nodes."""
        assert self.neighbor_weight is not None
        scale = self.neighbor_weight / self.mean_neighbors
        count = num_neighbors(batch, self.simulator.builder.spec.materials)
        return [torch.exp(-scale * count[m])[:, None] * error for m, error in zip(materials, errors, strict=True)]

    def _weighted(self, batch: HeteroData, materials: Iterable[str], errors: list[Tensor]) -> list[Tensor]:
        """Return errors [node, …] of each material, multiplied by the weights of their graphs."""
        weight = batch.weight.to(self.device).float()  # graphs that were built on a GPU have numbers, which a batch collects on the CPU
        return [weight[batch[m].batch][:, None] * error for m, error in zip(materials, errors, strict=True)]

    def _fractions(self, *errors: list[Tensor]) -> list[float]:
        """For each kind of error, return the fraction of all ranks' values that is on this rank. Ranks without values also take part in the exchange."""
        if ranks.num_ranks() == 1:
            return [1.0] * len(errors)
        here = torch.tensor([sum(e.numel() for e in kind) for kind in errors], device=self.device)
        return [n / max(1, total) for n, total in zip(here.tolist(), ranks.summed(here).tolist(), strict=True)]

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Move a batch to the device. Starts of push-forward stay on the CPU, where their unrolls are advanced."""
        if isinstance(batch, list) and isinstance(batch[0], UnrollStart):
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor | None:
        """Return the loss of a batch. If the loss is not finite, the step changes nothing; a run of one process then returns None."""
        loss = self.loss(batch)
        if not loss.requires_grad:  # no node has an edge, so all fall freely by design: nothing to learn from this batch
            loss = loss + 0.0 * torch.stack([p.sum() for p in self.simulator.parameters() if p.requires_grad]).sum()
        total = ranks.summed(loss.detach())
        if not torch.isfinite(total):
            self._skip("loss", float(total))
            return None if ranks.num_ranks() == 1 else loss  # ranks wait for each other's gradients; clipping drops them
        if (self.global_step + 1) % getattr(
            self._trainer, "log_every_n_steps", 1
        ) == 0:  # Lightning takes as long for a value that no logger gets
            self.log("train/loss", total, batch_size=1, logger=False)
            for logger in self.loggers:  # Lightning writes only after the step, which an interruption may end
                logger.log_metrics({"train/loss": float(total)}, step=self.global_step)
        return loss

    def configure_gradient_clipping(
        self, optimizer: torch.optim.Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip the gradient by its norm if a clip value is set. If the loss or the gradient is not finite, drop the gradient; weights and moments then stay."""
        norm = clip([p for group in optimizer.param_groups for p in group["params"]], gradient_clip_val)
        loss_is_finite = not self._skipped or self._skipped[-1] != self.global_step
        if loss_is_finite and not math.isfinite(norm):
            self._skip("gradient norm", norm)
        if not (loss_is_finite and math.isfinite(norm)):
            optimizer.zero_grad(set_to_none=True)  # without gradients Adam changes neither weights nor moments

    def _skip(self, name: str, value: float) -> None:
        """Count and report a skipped batch. All ranks do so together, as ``value`` is a sum over ranks.

        Raises:
            TrainingError: too many of the last batches were skipped; the message names step, trajectories and frames.
        """
        windows = [window for part in ranks.gathered(self._windows) for window in part]
        what = f"step {self.global_step}: the {name} is {value} for (trajectory, frame) = {', '.join(map(str, windows))}"
        is_often = len(self._skipped) == MAX_SKIPPED and self.global_step - self._skipped[0] < SKIP_WINDOW
        before = MAX_IN_ROW - 1
        is_in_row = len(self._skipped) >= before and self.global_step - self._skipped[-before] <= before
        if is_often or is_in_row:
            raise TrainingError(
                f"{what}, as in {len(self._skipped)} other batches since step {self._skipped[0]}. "
                "Lower training.learning_rate, or validate the data with `python -m gpe_pl.data.validate`"
            )
        self._skipped.append(self.global_step)
        log.warning("%s; training continues without this batch", what)

    def validation_step(self, batch: HeteroData, batch_idx: int) -> None:
        predicted = self.simulator(batch).acceleration
        for material, value in predicted.items():
            own, target = (predicted_rows(batch[material], v) for v in (value, self._normalized(batch[material].target)))
            self.val_nmse.update(own, target)

    def on_validation_start(self) -> None:
        self._excursions.clear()  # they were made with older weights; and the checkpoints that follow stay small

    def on_validation_epoch_end(self) -> None:
        self.log("val/one_step_nmse", self.val_nmse.compute(), sync_dist=True)  # equal on all ranks; Lightning warns without sync_dist
        self.val_nmse.reset()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["simulator"] = self.simulator.description()
        checkpoint["skipped"] = list(self._skipped)
        checkpoint["excursions"] = self._excursions.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        callbacks = () if self._trainer is None else self._trainer.callbacks  # type: ignore[attr-defined]
        is_averaged = any(isinstance(callback, WeightAveraging) for callback in callbacks)
        check_resumable(checkpoint, list(self.simulator.parameters()), is_averaged)
        self._skipped.extend(checkpoint["skipped"])
        self._excursions.load_state_dict(checkpoint["excursions"])

    def _normalized(self, target: Tensor) -> Tensor:
        return target / self.simulator.acceleration_std.to(target.dtype)
