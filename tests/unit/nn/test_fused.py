"""Properties of all fused passes for CPUs: sums over many rows are as accurate as PyTorch's, and second derivatives are right."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gpe_pl.nn.fused_latent import fused_latent
from gpe_pl.nn.fused_messages import fused_messages
from gpe_pl.nn.fused_mlp import fused_mlp

WIDTH = 4


def of_mlp(num_rows: int) -> tuple[Callable[..., Tensor], list[Tensor]]:
    shapes = [(num_rows, WIDTH), (WIDTH, WIDTH), (WIDTH,), (1,), (WIDTH, WIDTH), (WIDTH,)]
    return fused_mlp, _values(shapes)


def of_messages(num_rows: int) -> tuple[Callable[..., Tensor], list[Tensor]]:
    edges = _edges(num_rows)
    shapes = [(len(edges[0]) // 8 + 2, WIDTH)] * 2 + [(num_rows, WIDTH), (WIDTH, WIDTH), (1,)]

    def call(a: Tensor, b: Tensor, e: Tensor, weight: Tensor, slope: Tensor) -> Tensor:
        return torch.cat([s for s in fused_messages(a, b, e, weight, slope, edges) if s is not None])

    return call, _values(shapes)


def of_latent(num_rows: int, is_odd: bool) -> tuple[Callable[..., Tensor], list[Tensor]]:
    edges = _edges(num_rows)
    nodes = (len(edges[0]) // 8 + 2, WIDTH)
    shapes = [nodes, nodes, (num_rows, WIDTH), (num_rows, WIDTH), (WIDTH, WIDTH), (WIDTH, WIDTH), (1,), (WIDTH, WIDTH), (WIDTH,)]

    def call(a: Tensor, b: Tensor, e: Tensor, s: Tensor, weight: Tensor, even: Tensor, slope: Tensor, out: Tensor, bias: Tensor) -> Tensor:
        found = fused_latent(a, b, e, s if is_odd else None, weight, even, slope, (out, None if is_odd else bias), edges)
        return torch.cat([y for y in found if y is not None])

    return call, _values(shapes)


def _values(shapes: list[tuple[int, ...]]) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(*shape, generator=generator, dtype=torch.float64) - 0.8 for shape in shapes]  # sums that grow


def _edges(count: int) -> Tensor:
    return torch.randint(0, count // 8 + 2, (2, count), generator=torch.Generator().manual_seed(1))


PASSES = {
    "mlp": of_mlp,
    "messages": of_messages,
    "latent": lambda n: of_latent(n, False),
    "odd latent": lambda n: of_latent(n, True),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PASSES)
def test_gradients_summed_over_many_rows_keep_single_precision(name: str) -> None:
    function, values = PASSES[name](200_000)
    found = []
    for dtype in (torch.float64, torch.float32):
        own = [v.to(dtype).requires_grad_() for v in values]
        y = function(*own)
        weights = torch.linspace(0.5, 1.5, y.numel(), dtype=torch.float64).to(dtype).view_as(y)
        found.append(torch.autograd.grad((weights * y).sum(), own, allow_unused=True))
    for expected, single, value in zip(*found, values, strict=True):
        if expected is not None and expected.abs().max() > 0 and value.shape[0] <= WIDTH:
            is_product = value.dim() == 2 and name != "messages"  # summed by PyTorch within a block
            assert (single.double() - expected).norm() / expected.norm() < (1e-5 if is_product else 1e-6), value.shape


@pytest.mark.slow
@pytest.mark.parametrize("name", PASSES)
def test_second_derivatives_are_those_of_finite_differences(name: str) -> None:
    function, values = PASSES[name](9)
    inputs = tuple(v.requires_grad_() for v in values)
    assert torch.autograd.gradcheck(function, inputs)
    assert torch.autograd.gradgradcheck(function, inputs)


def test_a_vector_times_the_hessian_is_not_nothing() -> None:
    function, values = of_mlp(9)
    weights, direction = values[1:], torch.ones_like(values[0])
    _, product = torch.autograd.functional.hvp(lambda x: function(x, *weights).square().sum(), values[0], direction)
    assert product.norm() > 1e-3


def test_an_input_that_comes_from_another_counts_once() -> None:
    """Node states and edge states have a common origin."""
    function, values = of_messages(9)
    a, _, e, weight, slope = values
    assert torch.autograd.gradgradcheck(lambda a: function(a, 2 * a, e, weight, slope), (a.requires_grad_(),))
