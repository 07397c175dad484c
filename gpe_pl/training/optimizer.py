"""Optimiser and clipping of gradients, each as one pass over all parameters on a CPU."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from gpe_pl.training import parameter_passes

log = logging.getLogger(__name__)


def train_only(model: nn.Module, layers: Iterable[nn.Module], parameters: Iterable[nn.Parameter]) -> None:
    """Keep all parameters of a model as they are in training, except those of some layers and some single ones."""
    trained = {id(p) for p in (*(p for layer in layers for p in layer.parameters()), *parameters)}
    for parameter in model.parameters():
        parameter.requires_grad_(id(parameter) in trained)
    count = sum(p.numel() for p in model.parameters() if p.requires_grad)
    log.info("training.early_layers: %s of %s weights are trained", f"{count:,}", f"{sum(p.numel() for p in model.parameters()):,}")


class OnePassAdam(torch.optim.Adam):
    """``torch.optim.Adam`` in one pass on a CPU. State and checkpoints are the same, and updates are the same up to rounding.

    A parameter without a gradient keeps its value and moments.

    Args:
        parameters: parameters to optimise.
        learning_rate: learning rate.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float) -> None:
        super().__init__(parameters, lr=learning_rate, fused=True)
        self._is_covered = parameter_passes.are_covered(*(group["params"] for group in self.param_groups))

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove all gradients, or set them to zero."""
        if not set_to_none:
            super().zero_grad(set_to_none=False)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Update all parameters, and return the result of ``closure``, which computes the gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        pairs = [_with_gradients(group["params"]) for group in self.param_groups]
        if not (self._is_covered and all(g.is_contiguous() for _, gradients in pairs for g in gradients)):
            super().step()
            return loss
        for group, (parameters, gradients) in zip(self.param_groups, pairs, strict=True):
            states = [self._state_of(p) for p in parameters]
            means, squares, steps = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
            parameter_passes.adam(parameters, gradients, means, squares, steps, float(group["lr"]), group["betas"], group["eps"])
        return loss

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state


def clip(parameters: Iterable[nn.Parameter], largest: float | None) -> float:
    """Scale the gradients down if their norm exceeds ``largest`` (None: no limit) and is finite, and return the norm that they had."""
    with_gradient, gradients = _with_gradients(parameters)
    if not parameter_passes.are_covered(gradients):
        return float(torch.nn.utils.clip_grad_norm_(with_gradient, math.inf if largest is None else largest))
    norm = parameter_passes.norm(gradients)
    if largest is not None and largest < norm < math.inf:
        parameter_passes.scale(gradients, largest / (norm + 1e-6))
    return norm


def _with_gradients(parameters: Iterable[nn.Parameter]) -> tuple[list[Tensor], list[Tensor]]:
    """Return the parameters that have a gradient, and their gradients."""
    pairs = [(p, g) for p in parameters if (g := p.grad) is not None]
    return [p for p, _ in pairs], [g for _, g in pairs]
