"""Data parallelism: every process computes its part of each batch, and the processes sum their gradients::

    L = Σ_r L_r,   L_r = Σ_{i on rank r} ‖a_i − â_i‖² / (D Σ_r N_r),   ∇L = Σ_r ∇L_r

N_r is the number of nodes on rank r. L is therefore the mean over all nodes of the batch, however they are distributed over the ranks.
``DistributedDataParallel`` averages the gradients of per-process means instead, which gives more weight to the nodes of processes that have few.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import ClassVar

import torch
import torch.distributed as dist
from lightning.fabric.plugins.environments import SLURMEnvironment, TorchElasticEnvironment
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn


def sum_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its sum over ranks, in one message.

    A rank lacks a gradient if none of its graphs has nodes of that type; it then counts as zero. A gradient that all ranks lack stays None, as in a single
    process: the optimiser then changes neither the parameter nor its moments.
    """
    parameters = list(parameters)
    is_there = torch.tensor([float(p.grad is not None) for p in parameters], device=parameters[0].device)
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    message = torch.cat([is_there, *(g.flatten() for g in gradients)])
    dist.all_reduce(message)
    is_there, *parts = message.split([len(parameters), *(p.numel() for p in parameters)])
    for parameter, part, number in zip(parameters, parts, is_there.tolist(), strict=True):
        parameter.grad = part.view_as(parameter) if number else None


def started_processes() -> int | None:
    """Return the number of processes that torchrun or Slurm's srun started with this one, or None if neither did."""
    if TorchElasticEnvironment.detect():
        return int(os.environ["WORLD_SIZE"])
    return int(os.environ["SLURM_NTASKS"]) if SLURMEnvironment.detect() else None


def be_the_only_process() -> None:
    """Let this process log and continue after the training, also in a task of Slurm that is not the first: every task may be a run of its own."""
    rank_zero_only.rank = 0  # type: ignore[attr-defined]


def end_later_processes() -> None:
    """End all processes of a run except the first, which alone continues after the training."""
    if rank_zero_only.rank > 0:  # type: ignore[attr-defined]
        sys.exit()
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


class SummedGradients(DDPStrategy):
    """Lightning's DDP strategy with ``sum_gradients`` instead of its wrapper around the module.

    All ranks start from the weights and statistics of rank 0 and then apply the same updates, so their weights stay equal bit for bit.

    Attributes:
        has_started_processes: whether this process has started others, which run its command from the beginning. For a second training they would begin with
            the first one.
    """

    has_started_processes: ClassVar[bool] = False

    def setup_environment(self) -> None:
        if getattr(self.launcher, "procs", []):
            SummedGradients.has_started_processes = True
        super().setup_environment()
        module = self.lightning_module
        assert module is not None
        module.load_state_dict(self.broadcast(module.state_dict()))

    def configure_ddp(self) -> None:
        """Do nothing: the module needs no wrapper."""

    def post_backward(self, closure_loss: Tensor) -> None:
        assert self.lightning_module is not None
        sum_gradients(p for p in self.lightning_module.parameters() if p.requires_grad)

    def on_exception(self, exception: BaseException) -> None:
        """End the processes that this one has started, which would otherwise wait for it forever."""
        started = getattr(self.launcher, "procs", [])
        processes = started[:]
        started.clear()  # Lightning watches this list, and kills the main process, too, when one of these fails
        for process in processes:
            process.kill()
            process.wait()
