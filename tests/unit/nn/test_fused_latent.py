"""Blocks of edges give the results and gradients of gather, multiply, activate and scatter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn import fused, momentum_conv
from gpe_pl.nn.fused_latent import fused_latent
from gpe_pl.nn.momentum_conv import MomentumConv

WIDTH, EVEN = 6, 3


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "BLOCK", 16)


def inputs(num_edges: int, dtype: torch.dtype, is_odd: bool) -> tuple[list[Tensor], Tensor]:
    """Return a, b, e, s, W, V, p, C, c; and the edges."""
    generator = torch.Generator().manual_seed(num_edges)
    targets, sources = 7, 7 if is_odd else 5
    shapes = [(targets, WIDTH), (sources, WIDTH), (num_edges, WIDTH), (num_edges, EVEN), (WIDTH, WIDTH), (WIDTH, EVEN)]
    values = [torch.randn(*shape, generator=generator, dtype=dtype) for shape in shapes]
    more = [torch.randn(*shape, generator=generator, dtype=dtype) for shape in ((WIDTH, WIDTH), (WIDTH,))]
    edges = torch.stack([torch.randint(0, n, (num_edges,), generator=generator) for n in (sources, targets)])
    return [*values, torch.tensor([0.3], dtype=dtype), *more], edges


def plain(values: list[Tensor], edges: Tensor, is_odd: bool, update: bool) -> list[Tensor]:
    a, b, e, s, weight, even, slope, out, bias = values
    j, i = edges
    w, u = functional.linear(e, weight), functional.linear(s, even)
    if is_odd:
        x = functional.prelu(a[i] + b[j] + u + w, slope) - functional.prelu(a[j] + b[i] + u - w, slope)
    else:
        x = functional.prelu(a[i] + b[j] + w, slope)
    m = functional.linear(x, out, None if is_odd else bias) if update else x
    sums = [torch.zeros_like(a).index_add(0, i, m), torch.zeros_like(b).index_add(0, j, m, alpha=-1)]
    return [*sums, e + m] if update else sums


def in_blocks(values: list[Tensor], edges: Tensor, is_odd: bool, update: bool) -> list[Tensor]:
    a, b, e, s, weight, even, slope, out, bias = values
    c = (out, None if is_odd else bias) if update else None
    found = fused_latent(a, b, e, s if is_odd else None, weight, even, slope, c, edges)
    assert (found[2] is not None) == update
    return [value for value in found if value is not None]


@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize("is_odd", [True, False])
@pytest.mark.parametrize("num_edges", [0, 1, 16, 45])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_results_and_gradients_equal_the_plain_ones(
    num_edges: int, is_odd: bool, update: bool, dtype: torch.dtype, tolerance: float
) -> None:
    results = []
    for function in (plain, in_blocks):
        values, edges = inputs(num_edges, dtype, is_odd)
        for value in values:
            value.requires_grad_()
        outputs = function(values, edges, is_odd, update)
        loss = sum((torch.sin(torch.arange(o.numel(), dtype=dtype)).view_as(o) * o).sum() for o in outputs)
        assert isinstance(loss, Tensor)
        grads = torch.autograd.grad(loss, values, allow_unused=True)
        results.append([*outputs, *(torch.zeros_like(v) if g is None else g for v, g in zip(values, grads, strict=True))])
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)
    assert num_edges == 0 or results[1][0].abs().max() > 0


@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize("is_odd", [True, False])
def test_without_gradients_states_may_take_the_place_of_the_old_ones(is_odd: bool, update: bool) -> None:
    values, edges = inputs(45, torch.float64, is_odd)
    before = [v.clone() for v in values]
    a, b, e, s, weight, even, slope, out, bias = values
    others = s if is_odd else None, weight, even, slope, (out, None if is_odd else bias) if update else None, edges
    expected = plain(values, edges, is_odd, update)
    with torch.no_grad():
        kept = fused_latent(a, b, e, *others)
        for value, old in zip(values, before, strict=True):
            torch.testing.assert_close(value, old, rtol=0, atol=0)
        written = fused_latent(a, b, e, *others, overwrites=True)
    for found in (kept, written):
        for x, y in zip(expected, (f for f in found if f is not None), strict=True):
            torch.testing.assert_close(y, x, rtol=1e-12, atol=1e-12)
    assert written[2] is None or written[2].data_ptr() == e.data_ptr()


@pytest.mark.parametrize("has_gradient", [True, False])
def test_views_are_read_as_they_are(has_gradient: bool) -> None:
    values, edges = inputs(30, torch.float64, is_odd=True)
    turned = [v.t().contiguous().t() if v.dim() == 2 else v for v in values]
    edges = edges.flip(0).contiguous().flip(0)
    with torch.set_grad_enabled(has_gradient):
        for x, y in zip(in_blocks(turned, edges, True, True), plain(values, edges, True, True), strict=True):
            torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


def test_not_a_number_stays_one() -> None:
    values, edges = inputs(20, torch.float64, is_odd=False)
    values[2][4, 1] = float("nan")
    at_target, at_source, state = in_blocks(values, edges, False, True)
    assert at_target[edges[1, 4]].isnan().all() and at_source[edges[0, 4]].isnan().all() and state[4].isnan().all()
    assert state[5].isfinite().all()


@pytest.mark.parametrize("update", [True, False])
@pytest.mark.parametrize("interaction", ["negated", "odd"])
def test_a_layer_takes_it_and_stays_the_same(interaction: str, update: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(momentum_conv, "fused_latent", lambda *values: calls.append(1) or fused_latent(*values))  # type: ignore[func-returns-value]
    monkeypatch.setattr(momentum_conv, "RAW", 4)
    results = []
    for implementation in ("factored", "plain"):
        torch.manual_seed(0)
        conv = MomentumConv(WIDTH, WIDTH, EVEN, interaction, implementation).double()  # type: ignore[arg-type]
        h, e, s = (torch.randn(n, w, dtype=torch.float64) for n, w in ((9, WIDTH), (30, WIDTH), (30, EVEN)))
        edges = torch.randint(0, 9, (2, 30))
        found = conv(h, h, edges, e, s, update)
        found[0].sin().sum().backward()
        results.append([value for value in found if value is not None] + [p.grad for p in conv.parameters()])
    assert len(calls) == 1
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-11, atol=1e-11)


def test_edges_between_two_types_are_left_to_the_plain_path_where_odd(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(momentum_conv, "fused_latent", fail)
    conv = MomentumConv(WIDTH, WIDTH, EVEN, "odd", "factored")
    e, s = torch.randn(8, WIDTH), torch.randn(8, EVEN)
    conv(torch.randn(4, WIDTH), torch.randn(5, WIDTH), torch.randint(0, 4, (2, 8)), e, s)
