"""One pass over the edges gives the results and gradients of gather, add, activate and scatter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn import momentum_conv
from gpe_pl.nn.fused_messages import fused_messages
from gpe_pl.nn.momentum_conv import MomentumConv


def inputs(num_edges: int, dtype: torch.dtype, targets: int = 7, sources: int = 5, width: int = 6, channels: int = 4) -> list[Tensor]:
    generator = torch.Generator().manual_seed(num_edges)
    shapes = [(targets, width), (sources, width), (num_edges, channels), (width, channels)]
    values = [torch.randn(*shape, generator=generator, dtype=dtype) for shape in shapes]
    index = torch.stack([torch.randint(0, n, (num_edges,), generator=generator) for n in (sources, targets)])
    return [*values, torch.tensor([0.3], dtype=dtype), index]


def plain(a: Tensor, b: Tensor, e: Tensor, weight: Tensor, slope: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
    j, i = edge_index
    x = functional.prelu(a[i] + b[j] + functional.linear(e, weight), slope)
    return torch.zeros_like(a).index_add(0, i, x), torch.zeros_like(b).index_add(0, j, x, alpha=-1)


@pytest.mark.parametrize("is_joint", [True, False])
@pytest.mark.parametrize("num_edges", [0, 1, 40])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_sums_and_gradients_equal_the_plain_ones(num_edges: int, is_joint: bool, dtype: torch.dtype, tolerance: float) -> None:
    def joint(*values: Tensor) -> list[Tensor]:
        at_target, at_source = plain(*values)
        return [at_target + at_source]

    def in_one_pass(*values: Tensor) -> list[Tensor]:
        return [s for s in fused_messages(*values, is_joint=is_joint) if s is not None]  # type: ignore[arg-type, misc]

    results = []
    for function in (joint if is_joint else plain, in_one_pass):
        a, b, e, weight, slope, index = inputs(num_edges, dtype, sources=7 if is_joint else 5)
        values = [v.requires_grad_() for v in (a, b, e, weight, slope)]
        sums = function(a, b, e, weight, slope, index)
        loss = sum((torch.sin(torch.arange(s.numel(), dtype=dtype)).view_as(s) * s).sum() for s in sums)
        assert isinstance(loss, Tensor)
        results.append((*sums, *torch.autograd.grad(loss, values)))
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)
    assert num_edges < 40 or all(r.abs().max() > 0 for r in results[1])


def test_views_and_slices_are_read_as_they_are() -> None:
    a, b, e, weight, slope, index = inputs(30, torch.float64)
    wide = torch.randn(6, 11, dtype=torch.float64)
    wide[:, 3:7] = weight
    turned = index.flip(0).contiguous().flip(0)
    found = fused_messages(a.t().contiguous().t(), b, e[:, [1, 0, 2, 3]][:, [1, 0, 2, 3]], wide[:, 3:7], slope, turned)
    for x, y in zip(found, plain(a, b, e, weight, slope, index), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-13, atol=1e-13)


def test_not_a_number_stays_one() -> None:
    a, b, e, weight, slope, index = inputs(10, torch.float64)
    e[4, 1] = float("nan")
    at_target, at_source = fused_messages(a, b, e, weight, slope, index)
    assert at_source is not None
    assert at_target[index[1, 4]].isnan().all()
    assert at_source[index[0, 4]].isnan().all()


def test_a_layer_without_edge_states_takes_it_and_stays_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    conv = MomentumConv(6, 4, 0, "negated", "factored").double()
    h, e, index = torch.randn(9, 6, dtype=torch.float64), torch.randn(30, 4, dtype=torch.float64), torch.randint(0, 9, (2, 30))
    s = torch.empty(30, 0, dtype=torch.float64)
    calls = []
    monkeypatch.setattr(momentum_conv, "fused_messages", lambda *values: calls.append(1) or fused_messages(*values))  # type: ignore[func-returns-value]
    fused = conv(h, h, index, e, s, False)
    conv.implementation = "plain"
    torch.testing.assert_close(fused, conv(h, h, index, e, s, False), rtol=1e-12, atol=1e-12)
    assert len(calls) == 1
