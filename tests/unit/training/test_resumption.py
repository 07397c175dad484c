"""A run resumes only from a checkpoint whose optimiser and schedule belong to its model and step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from gpe_pl.training.optimizer import OnePassAdam
from gpe_pl.training.resumption import check_resumable

STEPS = 3


def checkpoint() -> tuple[dict[str, Any], list[nn.Parameter]]:
    """Return what a checkpoint holds after some steps, and the parameters. The last one has never had a gradient."""
    parameters = [nn.Parameter(torch.ones(shape)) for shape in ((2, 3), (4,), (2, 3))]
    optimizer = OnePassAdam(parameters, 1e-3)
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0)
    for _ in range(STEPS):
        for p in parameters[:2]:
            p.grad = torch.full_like(p, 0.5)
        optimizer.step()
        scheduler.step()
    kept = {"optimizer_states": [optimizer.state_dict()], "lr_schedulers": [scheduler.state_dict()], "global_step": STEPS, "skipped": []}
    return {**{key: {} for key in ("state_dict", "loops", "callbacks", "excursions")}, **kept}, parameters


def test_what_training_saved_is_accepted() -> None:
    check_resumable(*checkpoint(), is_averaged=False)


def test_a_run_whose_batches_were_all_skipped_has_no_moments() -> None:
    made, parameters = checkpoint()
    made["optimizer_states"][0]["state"], made["skipped"] = {}, [0, 1, 2]
    check_resumable(made, parameters, is_averaged=False)


def moments(made: dict[str, Any]) -> dict[int, Any]:
    found: dict[int, Any] = made["optimizer_states"][0]["state"]
    return found


def reverse(made: dict[str, Any]) -> None:
    own = moments(made)
    own[0], own[1] = own[1], own[0]


SPOILED: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no optimizer": (lambda c: c["optimizer_states"].clear(), "optimizer_states must have one entry"),
    "no schedule": (lambda c: c["lr_schedulers"].clear(), "lr_schedulers must have one entry"),
    "no loops": (lambda c: c.pop("loops"), "has no loops"),
    "no moments": (lambda c: moments(c).clear(), "optimizer_states has no moments after 3 steps"),
    "other order": (reverse, r"parameter 0: exp_avg is torch.float32 of shape \(4,\), must be floating-point of shape \(2, 3\)"),
    "one is missing": (lambda c: moments(c)[1].pop("exp_avg_sq"), "parameter 1: has no exp_avg_sq"),
    "unknown parameter": (lambda c: moments(c).update({7: moments(c)[0]}), "moments of parameter 7, the model has 3"),
    "not a number": (lambda c: moments(c)[1]["exp_avg"].fill_(torch.nan), "parameter 1: exp_avg is not finite"),
    "negative": (lambda c: moments(c)[1]["exp_avg_sq"].fill_(-1.0), "parameter 1: exp_avg_sq is negative"),
    "integers": (lambda c: moments(c)[0].update(exp_avg=torch.zeros(2, 3, dtype=torch.int32)), "parameter 0: exp_avg is torch.int32"),
    "a list": (lambda c: moments(c).update({0: [1.0]}), "parameter 0: must be a table"),
    "no groups": (lambda c: c["optimizer_states"][0].pop("param_groups"), "must have state and param_groups"),
    "a word as rate": (lambda c: c["optimizer_states"][0]["param_groups"][0].update(lr="fast"), "lr, eps and betas must be numbers"),
    "another step": (lambda c: c["lr_schedulers"][0].update(last_epoch=99), "lr_schedulers is at step 99, the training at step 3"),
}


@pytest.mark.parametrize("kind", SPOILED)
def test_what_does_not_belong_together_is_refused(kind: str) -> None:
    spoil, message = SPOILED[kind]
    made, parameters = checkpoint()
    spoil(made)
    with pytest.raises(ValueError, match=message):
        check_resumable(made, parameters, is_averaged=False)


def test_averaging_needs_its_weights() -> None:
    with pytest.raises(ValueError, match="has no averaging_state"):
        check_resumable(*checkpoint(), is_averaged=True)
