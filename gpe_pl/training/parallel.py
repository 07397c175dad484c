"""Data parallelism: every process computes its part of each batch, and the parts of the gradient are summed::

    L = Σ_r L_r,   L_r = Σ_{i on rank r} ‖a_i − â_i‖² / (D Σ_r N_r),   ∇L = Σ_r ∇L_r

with the number N_r of nodes on rank r, so that L is the mean over all nodes of the batch, however they are spread. Averaging the gradients of per-process
means instead, which is what ``DistributedDataParallel`` does, weighs a node by how few others its process has.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import torch
import torch.distributed as dist
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn


def sum_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its sum over ranks, in one message.

    A gradient that a rank lacks, because none of its graphs has nodes of that type, counts as zero. One that all ranks lack stays absent, as in one process,
    where the optimiser leaves such a parameter and its moments alone.
    """
    parameters = list(parameters)
    is_there = torch.tensor([float(p.grad is not None) for p in parameters], device=parameters[0].device)
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    message = torch.cat([is_there, *(g.flatten() for g in gradients)])
    dist.all_reduce(message)
    is_there, *parts = message.split([len(parameters), *(p.numel() for p in parameters)])
    for parameter, part, number in zip(parameters, parts, is_there.tolist(), strict=True):
        parameter.grad = part.view_as(parameter) if number else None


def end_later_processes() -> None:
    """End all processes of a run but the first, which alone does what follows the training."""
    if rank_zero_only.rank > 0:  # type: ignore[attr-defined]
        sys.exit()
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


class SummedGradients(DDPStrategy):
    """Lightning's processes and devices of DDP, with ``sum_gradients`` in place of its wrapper around the module.

    All ranks start from the weights and statistics of rank 0, and add the same numbers ever after, so that their weights stay equal bit for bit.
    """

    def setup_environment(self) -> None:
        super().setup_environment()
        module = self.lightning_module
        assert module is not None
        module.load_state_dict(self.broadcast(module.state_dict()))

    def configure_ddp(self) -> None:
        """Leaves the module as it is."""

    def post_backward(self, closure_loss: Tensor) -> None:
        assert self.lightning_module is not None
        sum_gradients(p for p in self.lightning_module.parameters() if p.requires_grad)

    def on_exception(self, exception: BaseException) -> None:
        """End the processes that this one has started: they would wait for it for ever."""
        for process in getattr(self.launcher, "procs", []):
            process.kill()
