"""Checks the content of ``last.ckpt`` before a run resumes from it.

PyTorch checks neither shapes nor values of an optimiser's moments, and passes over moments and schedules that are missing. Steps would then read foreign
memory, or continue another training without a word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

RESUMED = {
    *("state_dict", "optimizer_states", "lr_schedulers", "loops", "callbacks", "global_step"),
    *("skipped", "excursions"),
}
"""Keys that a checkpoint needs for a run to resume from it."""
OF_AVERAGE = {"current_model_state", "averaging_state"}
"""Further keys that a checkpoint needs if the run averages its weights."""


def check_resumable(checkpoint: Mapping[str, Any], parameters: Sequence[Tensor], is_averaged: bool) -> None:
    """Check that a checkpoint has everything that a training goes on from, and that its optimiser fits the parameters.

    Args:
        checkpoint: content of the file.
        parameters: parameters in the order of the optimiser.
        is_averaged: whether the run averages its weights.

    Raises:
        ValueError: something is missing or does not fit; the message names it.
    """
    missing = (RESUMED | OF_AVERAGE if is_averaged else RESUMED) - checkpoint.keys()
    if missing:
        raise ValueError(f"has no {min(missing)}")
    for key in ("optimizer_states", "lr_schedulers"):
        if not (isinstance(checkpoint[key], list) and len(checkpoint[key]) == 1 and isinstance(checkpoint[key][0], Mapping)):
            raise ValueError(f"{key} must have one entry")
    (optimizer,), (schedule,), step = checkpoint["optimizer_states"], checkpoint["lr_schedulers"], checkpoint["global_step"]
    if schedule.get("last_epoch") != step:
        raise ValueError(f"lr_schedulers is at step {schedule.get('last_epoch')}, the training at step {step}")
    moments, groups = optimizer.get("state"), optimizer.get("param_groups")
    if not (isinstance(moments, Mapping) and isinstance(groups, list) and all(isinstance(group, Mapping) for group in groups)):
        raise ValueError("optimizer_states must have state and param_groups")
    for group in groups:
        if not all(_is_number(value) for value in (group.get("lr"), group.get("eps"), *(group.get("betas") or [None]))):
            raise ValueError("optimizer_states: lr, eps and betas must be numbers of at least 0")
    if not moments and step > len(checkpoint["skipped"]):
        raise ValueError(f"optimizer_states has no moments after {step} steps")
    for number, values in moments.items():
        if type(number) is not int or not 0 <= number < len(parameters):
            raise ValueError(f"optimizer_states has moments of parameter {number}, the model has {len(parameters)} parameters")
        if fault := _fault(values, parameters[number]):
            raise ValueError(f"optimizer_states, parameter {number}: {fault}")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and 0 <= value < float("inf")


def _fault(values: Any, parameter: Tensor) -> str | None:
    """Describe what is wrong with the moments of a parameter; None if nothing is."""
    if not isinstance(values, Mapping):
        return "must be a table"
    for name, shape in (("exp_avg", parameter.shape), ("exp_avg_sq", parameter.shape), ("step", torch.Size())):
        value = values.get(name)
        if not isinstance(value, Tensor):
            return f"has no {name}"
        if value.shape != shape or not value.is_floating_point():
            return f"{name} is {value.dtype} of shape {tuple(value.shape)}, must be floating-point of shape {tuple(shape)}"
        if not bool(value.isfinite().all()):
            return f"{name} is not finite"
        if name != "exp_avg" and bool((value < 0).any()):
            return f"{name} is negative"
    return None
