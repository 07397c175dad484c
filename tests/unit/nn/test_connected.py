"""Nodes with edges, and the order in which edges reach them."""

from __future__ import annotations

import torch

from gpe_pl.nn.connected import Edges, order_of_edges, renumbered, reordered, touched

SAND, MIXED = ("sand", "radius", "sand"), ("boundary", "radius", "sand")
COUNTS = {"sand": 6, "boundary": 3, "snow": 2}


def edges() -> Edges:
    nothing = torch.empty(0, 1)
    return {
        SAND: (torch.tensor([[4, 4, 1], [2, 1, 5]]), nothing, nothing),
        MIXED: (torch.tensor([[2, 0], [5, 3]]), nothing, nothing),
    }


def test_nodes_stand_in_the_order_in_which_edges_come_to_them() -> None:
    order = order_of_edges(COUNTS, edges())
    assert {t: rows.tolist() for t, rows in order.items()} == {"sand": [4, 2, 1, 5, 3, 0], "boundary": [2, 0, 1]}


def test_edges_keep_their_ends() -> None:
    order = order_of_edges(COUNTS, edges())
    for (source, name, target), (index, _, _) in reordered(edges(), order).items():
        assert torch.equal(torch.stack([order[source][index[0]], order[target][index[1]]]), edges()[source, name, target][0])


def test_only_nodes_with_edges_are_numbered() -> None:
    masks = touched(COUNTS, edges())
    assert {t: mask.tolist() for t, mask in masks.items()} == {"sand": [False, *[True] * 5], "boundary": [True, False, True]}
    assert renumbered(edges(), masks)[MIXED][0].tolist() == [[1, 0], [4, 2]]
