"""All message-passing steps in one function give PyTorch's results and gradients."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gpe_pl.nn import fused_processor as module
from gpe_pl.nn import matrix_product
from gpe_pl.nn.fused_processor import Conv, Relation, Step, Update, fused_processor, plain_processor
from gpe_pl.nn.fused_processor_kernels import EDGES

WIDTH, EPS = 6, 1e-5
CHANNELS = 10
"""Largest number of features of an edge: that of particles, for which other tests compile the functions too."""
NODES = [9, 4, 7]
"""Nodes of three types: type 0 exchanges messages with itself and with the others, type 1 is not updated in the last step."""


def example(dtype: torch.dtype, norm: bool, seed: int = 0) -> tuple[list[Relation], list[Step], list[Tensor]]:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    def parameters(*shapes: tuple[int, ...]) -> list[Tensor]:
        return [(random(*shape) / shape[-1] ** 0.5).requires_grad_() for shape in shapes]

    relations = []
    for source, target, count, channels in ((0, 0, EDGES + 21, 3), (1, 0, 10, 2), (2, 0, 16, CHANNELS), (2, 2, 0, CHANNELS)):
        ends = [torch.randint(NODES[t], (count,), generator=generator) for t in (source, target)]
        relations.append(Relation(source, target, torch.stack(ends), random(count, channels)))
    steps = []
    for types in ((0, 1, 2), (0, 2), (0,)):
        convs = {
            r: Conv(*parameters((WIDTH, 2 * WIDTH + relation.features.shape[1]), (WIDTH,), (1,), (WIDTH, WIDTH), (WIDTH,)))
            for r, relation in enumerate(relations)
            if {relation.source, relation.target} & {*types}
        }
        shapes = [(WIDTH, WIDTH), (WIDTH,), (1,), (WIDTH, WIDTH), (WIDTH,), *([(WIDTH,)] * 2 if norm else [])]
        steps.append(Step(convs, {t: Update(*parameters(*shapes)) for t in types}))
    return relations, steps, [random(n, WIDTH).requires_grad_() for n in NODES]


def differentiated(function: object, dtype: torch.dtype, norm: bool) -> list[Tensor]:
    relations, steps, h = example(dtype, norm)
    states = function(relations, steps, EPS, h)  # type: ignore[operator]
    loss = sum((torch.sin(torch.arange(s.numel(), dtype=dtype)).view_as(s) * s).sum() for s in states)
    return [*states, *torch.autograd.grad(loss, [*h, *(t for step in steps for t in step.tensors)])]  # type: ignore[arg-type]


@pytest.mark.parametrize("norm", [True, False])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_states_and_gradients_equal_the_plain_ones(dtype: torch.dtype, tolerance: float, norm: bool) -> None:
    found, expected = (differentiated(f, dtype, norm) for f in (fused_processor, plain_processor))
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=tolerance * max(1.0, float(y.abs().max())))
    without_edges = 2 * len(Conv._fields)
    assert sum(not y.any() for y in expected) == without_edges


def test_products_of_scipy_serve_where_pytorch_shows_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own = matrix_product.gemm_address(np.dtype(np.float64))
    with monkeypatch.context() as without_library:
        without_library.setattr(torch, "__file__", str(tmp_path / "__init__.py"))
        address = matrix_product.gemm_address.__wrapped__(np.dtype(np.float64))
    monkeypatch.setattr(matrix_product, "gemm_address", lambda _: address)
    found, expected = (differentiated(f, torch.float64, True) for f in (fused_processor, plain_processor))
    assert address != own
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-12 * max(1.0, float(y.abs().max())))


def test_gradients_equal_differences_of_values() -> None:
    relations, steps, h = example(torch.float64, norm=True)
    tensors = [t for step in steps for t in step.tensors]

    def values(*inputs: Tensor) -> tuple[Tensor, ...]:
        rest = [*inputs[3:]]
        return tuple(fused_processor(relations, [step.of(rest) for step in steps], EPS, inputs[:3]))

    assert torch.autograd.gradcheck(values, (*h, *tensors), fast_mode=True)


def test_second_derivatives_are_those_of_the_plain_operations() -> None:
    results = []
    for function in (fused_processor, plain_processor):
        relations, steps, h = example(torch.float64, norm=True)
        weight = steps[0].convs[0].weight
        loss = torch.cat([s.sin() for s in function(relations, steps, EPS, h)]).sum()
        first = torch.autograd.grad(loss, [h[0], weight], create_graph=True)
        results.append(torch.autograd.grad(first[0].square().sum() + first[1].square().sum(), [h[0], weight]))
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-10, atol=1e-10)


def test_inputs_are_read_as_they_are_and_not_written_to() -> None:
    relations, steps, h = example(torch.float64, norm=True)
    views = [rows.detach().t().contiguous().t().requires_grad_() for rows in h]
    before = [rows.detach().clone() for rows in views]
    found, expected = (f(relations, steps, EPS, rows) for f, rows in ((fused_processor, views), (plain_processor, h)))
    sum(s.square().sum() for s in found).backward()  # type: ignore[union-attr]
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)
    for x, y in zip(views, before, strict=True):
        assert torch.equal(x, y)


def test_weights_that_change_before_the_backward_pass_are_noticed() -> None:
    relations, steps, h = example(torch.float64, norm=True)
    loss = torch.cat(fused_processor(relations, steps, EPS, h)).sum()
    loss.backward(retain_graph=True)
    before = h[0].grad
    assert before is not None
    h[0].grad = None
    loss.backward(retain_graph=True)
    assert torch.equal(h[0].grad, before)  # type: ignore[arg-type]
    with torch.no_grad():
        steps[0].updates[0].weight.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_nothing_is_kept_after_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """An output that its own node in autograd's graph holds would never be freed."""
    made = []

    class Tables(module._Tables):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            made.append(weakref.ref(self))

    monkeypatch.setattr(module, "_Tables", Tables)
    states = fused_processor(*example(torch.float64, norm=True)[:2], EPS, example(torch.float64, norm=True)[2])
    sum(s.sum() for s in states).backward()  # type: ignore[union-attr]
    assert made[0]() is not None
    del states
    gc.collect()
    assert made[0]() is None


def test_not_a_number_stays_one() -> None:
    relations, steps, h = example(torch.float64, norm=True)
    with torch.no_grad():
        h[1][2] = torch.nan
    states = fused_processor(relations, steps, EPS, h)
    reached = relations[1].edge_index[1][relations[1].edge_index[0] == 2]
    assert len(reached) and states[0][reached].isnan().all()
