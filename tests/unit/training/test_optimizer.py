"""Passes over all parameters give the results of PyTorch's optimiser, clipping and averages."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from gpe_pl.training import parameter_passes
from gpe_pl.training.optimizer import OnePassAdam, clip

SHAPES = [(7, 5), (3,), (1,), (0, 4), (33, 2), ()]
KINDS = [(torch.float32, 1e-6), (torch.float64, 1e-14)]


def parameters(dtype: torch.dtype) -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(shape, generator=generator, dtype=dtype)) for shape in SHAPES]


def set_gradients(values: list[nn.Parameter], step: int) -> None:
    """Give all parameters a gradient, but the first and the last only in every other step."""
    generator = torch.Generator().manual_seed(step)
    for k, value in enumerate(values):
        gradient = torch.randn(value.shape, generator=generator, dtype=value.dtype)
        value.grad = None if k in (0, len(values) - 1) and step % 2 else gradient


def check_equal(found: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), KINDS)
def test_steps_equal_those_of_adam_and_absent_gradients_change_nothing(dtype: torch.dtype, tolerance: float) -> None:
    found, expected = parameters(dtype), parameters(dtype)
    one_pass, adam = OnePassAdam(found, 0.01), torch.optim.Adam(expected, lr=0.01)
    for step in range(12):
        for values, optimizer in ((found, one_pass), (expected, adam)):
            optimizer.param_groups[0]["lr"] = 0.01 / (1 + step)
            set_gradients(values, step)
            before = values[0].detach().clone()
            optimizer.step()
            assert step % 2 == 0 or torch.equal(values[0], before)
        check_equal([*found], [*expected], tolerance)
    for p, q in zip(found, expected, strict=True):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(one_pass.state[p][name], adam.state[q][name], rtol=10 * tolerance, atol=tolerance)


def test_the_state_of_adam_is_continued_from() -> None:
    """A training that was interrupted with PyTorch's optimiser resumes with this one."""
    found, expected = parameters(torch.float64), parameters(torch.float64)
    adam = torch.optim.Adam(expected, lr=0.01, fused=True)
    for step in range(3):
        set_gradients(expected, step)
        adam.step()
    one_pass = OnePassAdam(found, 0.5)
    one_pass.load_state_dict(copy.deepcopy(adam.state_dict()))
    with torch.no_grad():
        for p, q in zip(found, expected, strict=True):
            p.copy_(q)
    for values, optimizer in ((found, one_pass), (expected, adam)):
        set_gradients(values, 4)
        optimizer.step()
    check_equal([*found], [*expected], 1e-14)
    assert one_pass.state_dict().keys() == adam.state_dict().keys()


def test_a_closure_runs_with_gradients() -> None:
    weight = nn.Parameter(torch.ones(3))
    optimizer = OnePassAdam([weight], 0.1)

    def loss() -> Tensor:
        value = weight.square().sum()
        value.backward()
        return value

    with torch.no_grad():
        assert float(optimizer.step(loss)) == 3
    assert (weight < 1).all()


@pytest.mark.parametrize("layout", ["contiguous", "transposed"])
@pytest.mark.parametrize("largest", [None, 1e-3, 1e3])
@pytest.mark.parametrize(("dtype", "tolerance"), KINDS)
def test_clipping_equals_that_of_pytorch(largest: float | None, layout: str, dtype: torch.dtype, tolerance: float) -> None:
    found, expected = parameters(dtype), parameters(dtype)
    for values in (found, expected):
        set_gradients(values, 0)
        if layout == "transposed":
            values[1].grad = torch.arange(6, dtype=dtype)[::2]
    norm = clip(found, largest)
    assert norm == pytest.approx(float(torch.nn.utils.clip_grad_norm_(expected, math.inf if largest is None else largest)), rel=tolerance)
    check_equal([p.grad for p in found if p.grad is not None], [p.grad for p in expected if p.grad is not None], tolerance)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_norm_that_is_not_finite_is_returned_and_nothing_is_scaled(value: float) -> None:
    values = parameters(torch.float32)
    set_gradients(values, 0)
    assert values[1].grad is not None and values[4].grad is not None
    values[1].grad[2] = value
    before = values[4].grad.clone()
    assert not math.isfinite(clip(values, 1.0))
    assert torch.equal(values[4].grad, before)


@pytest.mark.parametrize(("dtype", "tolerance"), KINDS)
def test_averages_move_towards_the_weights(dtype: torch.dtype, tolerance: float) -> None:
    averaged, current = ([p.detach() for p in parameters(dtype)] for _ in range(2))
    for a in averaged:
        a.mul_(-2).add_(1)
    expected = [torch.lerp(a, c, 0.3) for a, c in zip(averaged, current, strict=True)]
    parameter_passes.pull(averaged, current, 0.3)
    check_equal(averaged, expected, tolerance)


def test_other_layouts_and_precisions_are_left_to_pytorch() -> None:
    one = torch.zeros(3)
    assert parameter_passes.are_covered([one], [one, torch.zeros(2, 2)])
    assert not parameter_passes.are_covered([one], [torch.zeros(4)[::2]])
    assert not parameter_passes.are_covered([one, torch.zeros(1, dtype=torch.float64)])
    assert not parameter_passes.are_covered([torch.zeros(3, dtype=torch.bfloat16)])
    assert not parameter_passes.are_covered([torch.zeros(3, device="meta")])
