"""Two linear maps on blocks of rows give PyTorch's results and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from gpe_pl.nn import blocks as blocks_module
from gpe_pl.nn import fused
from gpe_pl.nn.blocks import MLP
from gpe_pl.nn.fused_mlp import fused_mlp

IN, HIDDEN, OUT = 5, 6, 3


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "BLOCK", 16)


def inputs(num_rows: int, dtype: torch.dtype) -> list[Tensor]:
    """Return x, A, b, p, C, c, r."""
    generator = torch.Generator().manual_seed(num_rows)
    shapes = [(num_rows, IN), (HIDDEN, IN), (HIDDEN,), (1,), (OUT, HIDDEN), (OUT,), (num_rows, OUT)]
    return [torch.randn(*shape, generator=generator, dtype=dtype) for shape in shapes]


def plain(
    x: Tensor, weight: Tensor, bias: Tensor, slope: Tensor, out_weight: Tensor, out_bias: Tensor, residual: Tensor | None = None
) -> Tensor:
    y = functional.linear(functional.prelu(functional.linear(x, weight, bias), slope), out_weight, out_bias)
    return y if residual is None else y + residual


@pytest.mark.parametrize("has_residual", [True, False])
@pytest.mark.parametrize("num_rows", [0, 1, 16, 45])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_results_and_gradients_equal_the_plain_ones(num_rows: int, has_residual: bool, dtype: torch.dtype, tolerance: float) -> None:
    results = []
    for function in (plain, fused_mlp):
        values = [v.requires_grad_() for v in inputs(num_rows, dtype)[: 7 if has_residual else 6]]
        y = function(*values)
        loss = (torch.sin(torch.arange(y.numel(), dtype=dtype)).view_as(y) * y).sum()
        results.append((y, *torch.autograd.grad(loss, values)))
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)
    assert num_rows == 0 or all(r.abs().max() > 0 for r in results[1])


@pytest.mark.parametrize("has_gradient", [True, False])
def test_views_are_read_as_they_are_and_nothing_is_written_to(has_gradient: bool) -> None:
    values = [v.t().contiguous().t() if v.dim() == 2 else v for v in inputs(40, torch.float64)]
    before = [v.clone() for v in values]
    with torch.set_grad_enabled(has_gradient):
        torch.testing.assert_close(fused_mlp(*values), plain(*values), rtol=1e-13, atol=1e-13)
    for value, old in zip(values, before, strict=True):
        torch.testing.assert_close(value, old, rtol=0, atol=0)


def test_inputs_without_gradient_get_none() -> None:
    values = inputs(20, torch.float64)
    for value in values[1:6]:
        value.requires_grad_()
    found, expected = (torch.autograd.grad(f(*values).square().sum(), values[1:6]) for f in (fused_mlp, plain))
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


def test_not_a_number_stays_one() -> None:
    values = inputs(20, torch.float64)
    values[0][4, 1] = float("nan")
    y = fused_mlp(*values)
    assert y[4].isnan().all() and y[torch.arange(20) != 4].isfinite().all()


@pytest.mark.parametrize("norm", [True, False])
@pytest.mark.parametrize("has_residual", [True, False])
def test_a_network_takes_it_and_stays_the_same(norm: bool, has_residual: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(blocks_module, "fused_mlp", lambda *values: calls.append(1) or fused_mlp(*values))  # type: ignore[func-returns-value]
    x, residual = torch.randn(30, IN, dtype=torch.float64), torch.randn(30, OUT, dtype=torch.float64) if has_residual else None
    results, keys = [], []
    for is_fused in (True, False):
        torch.manual_seed(0)
        network = MLP(IN, HIDDEN, OUT, norm, is_fused).double()
        y = network(x, residual)
        y.sin().sum().backward()
        results.append([y, *(p.grad for p in network.parameters())])
        keys.append([*network.state_dict()])
        assert isinstance(network[-1], nn.LayerNorm) == norm
    assert len(calls) == 1 and keys[0] == keys[1]
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_other_devices_and_precisions_are_declined() -> None:
    assert fused.works_on(torch.zeros(1), torch.zeros(2))
    assert not fused.works_on(torch.zeros(1), torch.zeros(1, dtype=torch.float64))
    assert not fused.works_on(torch.zeros(1, dtype=torch.bfloat16))
    assert not fused.works_on(torch.zeros(1, device="meta"))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert not fused.works_on(torch.zeros(1))
