"""The message-passing layer: both sides of a bipartite relation, summation before or after the last linear map, and the orientation rule."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch_geometric.nn import MessagePassing

from gpe_pl.nn.momentum_conv import MomentumConv, orient

DOUBLE = torch.float64
KINDS = ["directed", "negated", "odd", "odd_even"]


def problem(interaction: str, num_source: int = 7, num_target: int = 5, num_edges: int = 20) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(0)
    edges = torch.stack([torch.randint(num_source, (num_edges,), generator=g), torch.randint(num_target, (num_edges,), generator=g)])
    rows = 2 * num_edges if interaction == "directed" else num_edges
    shapes = ((num_source, 8), (num_target, 8), (rows, 8), (num_edges, 3))
    hs, ht, e, s = (torch.randn(shape, generator=g, dtype=DOUBLE) for shape in shapes)
    return hs, ht, edges, e, s


def make(interaction: str, implementation: str = "factored") -> MomentumConv:
    torch.manual_seed(0)
    return MomentumConv(8, 8, 3, interaction, implementation).double()  # type: ignore[arg-type]


def test_is_a_message_passing_layer() -> None:
    assert isinstance(make("odd"), MessagePassing)


def test_names_of_its_calls_are_read_once_for_all_layers() -> None:
    """PyG falls back silently, to parsing the layer's source again for every layer made, when a call passes ``**names``."""
    assert type(make("odd")).propagate.__module__ != MessagePassing.__module__


@pytest.mark.parametrize("implementation", ["factored", "plain"])
@pytest.mark.parametrize("interaction", KINDS)
def test_sums_equal_a_loop_over_edges(interaction: str, implementation: str) -> None:
    conv = make(interaction, implementation)
    hs, ht, edges, e, s = problem(interaction)
    at_target, at_source, state = conv(hs, ht, edges, e, s)
    want_target, want_source = torch.zeros_like(ht), torch.zeros_like(hs)
    num_edges = edges.shape[1]

    def phi(a: torch.Tensor, b: torch.Tensor, state: torch.Tensor, even: torch.Tensor) -> torch.Tensor:
        parts = [a, b, state, even] if conv.is_odd else [a, b, state]
        return conv.act(conv.lin_in(torch.cat(parts)))

    for n in range(num_edges):
        j, i = edges[:, n].tolist()
        forward = phi(ht[i], hs[j], e[n], s[n])
        if interaction == "directed":
            reverse = phi(hs[j], ht[i], e[num_edges + n], s[n])
            want_target[i] += conv.lin_out(forward)
            want_source[j] += conv.lin_out(reverse)
            continue
        if conv.is_odd:
            reverse = phi(hs[j], ht[i], -e[n], s[n])
            m = conv.lin_out(forward - reverse)
        else:
            m = conv.lin_out(forward)
        torch.testing.assert_close(state[n], e[n] + m)
        want_target[i] += m
        want_source[j] -= m
        if conv.lin_even is not None:
            want_target[i] += conv.lin_even(forward + reverse)
            want_source[j] += conv.lin_even(forward + reverse)
    torch.testing.assert_close(at_target, want_target)
    torch.testing.assert_close(at_source, want_source)


@pytest.mark.parametrize("interaction", KINDS)
def test_last_linear_map_commutes_with_the_sum(interaction: str) -> None:
    conv = make(interaction)
    updated = conv(*problem(interaction))
    without = conv(*problem(interaction), update_edges=False)
    assert without[2] is None
    for a, b in zip(updated[:2], without[:2], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("interaction", ["negated", "odd"])
def test_what_one_end_gains_the_other_loses(interaction: str) -> None:
    at_target, at_source, _ = make(interaction)(*problem(interaction))
    assert at_target.sum(dim=0).norm() > 0.1
    torch.testing.assert_close(at_target.sum(dim=0), -at_source.sum(dim=0))


@pytest.mark.parametrize("update_edges", [True, False])
@pytest.mark.parametrize("edges_at_once", [None, 7])
@pytest.mark.parametrize("implementation", ["factored", "plain"])
@pytest.mark.parametrize("interaction", KINDS)
def test_nodes_of_one_type_get_both_sums_in_one(
    interaction: str, implementation: str, edges_at_once: int | None, update_edges: bool
) -> None:
    """Equal to the sum of two, also in gradients, and where an edge joins a node to itself."""
    h, _, edges, e, s = problem(interaction, num_target=7)
    edges[:, 0] = 2
    results = []
    for source in (h, h.clone()):
        conv = make(interaction, implementation)
        with torch.set_grad_enabled(edges_at_once is None):
            at_target, at_source, state = conv(source, h, edges, e, s, update_edges, edges_at_once)
        assert (at_source is None) == (source is h) and (state is not None) == update_edges
        total = at_target if at_source is None else at_target + at_source
        if edges_at_once is None:
            total.sin().sum().backward()
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in conv.parameters()]
        results.append([total, *grads, *([state] if update_edges else [])])
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-12)


def test_no_edges_give_zero_sums() -> None:
    for interaction in KINDS:
        hs, ht, _, e, s = problem(interaction, num_edges=0)
        at_target, at_source, _ = make(interaction)(hs, ht, torch.empty(2, 0, dtype=torch.int64), e, s)
        assert at_target.shape == ht.shape and at_source.shape == hs.shape
        assert not at_target.any() and not at_source.any()


def test_orientation_rule() -> None:
    edges = torch.tensor([[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]])
    odd = torch.tensor([[1.0, -2.0], [-1.0, 2.0], [0.0, -3.0], [0.0, 3.0], [0.0, 0.0]])
    index, out = orient(edges, odd)
    assert index.tolist() == [[0, 6, 7, 3, 4], [5, 1, 2, 8, 9]]
    assert out.tolist() == [[1.0, -2.0], [1.0, -2.0], [0.0, 3.0], [0.0, 3.0], [0.0, 0.0]]
    again, same = orient(index.flip(0), -out)
    assert torch.equal(again[:, :4], index[:, :4]) and torch.equal(same[:4], out[:4])


@pytest.mark.parametrize("update_edges", [True, False])
@pytest.mark.parametrize("interaction", ["negated", "odd", "odd_even", "directed"])
def test_autocast_changes_no_more_than_its_precision(interaction: Any, update_edges: bool) -> None:
    torch.manual_seed(0)
    conv = MomentumConv(8, 8, 3, interaction)
    edge_index, h = torch.tensor([[0, 1, 2], [1, 2, 0]]), torch.randn(3, 8)
    e, s = torch.randn(6 if interaction == "directed" else 3, 8), torch.randn(3, 3)
    expected = conv(h, h, edge_index, e, s, update_edges)[0]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = conv(h, h, edge_index, e, s, update_edges)[0]
    torch.testing.assert_close(found.float(), expected, rtol=0.05, atol=0.05)
