"""Selects the nodes that have edges, sorts nodes in memory, and merges levels of virtual nodes.

Nodes without an edge need no message passing. Message passing is faster if the nodes at both ends of an edge are near each other in memory.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gpe_pl.schema import EdgeType, role

Edges = dict[EdgeType, tuple[Tensor, Tensor, Tensor]]
"""``edge_index``, ``odd`` and ``even`` of each relation that has edges."""


def touched(num_nodes: dict[str, int], edges: Edges) -> dict[str, Tensor]:
    """Return a mask of the nodes that have an edge [node], for every node type of a relation in ``edges``."""
    masks: dict[str, Tensor] = {}
    for (source, _, target), (index, _, _) in edges.items():
        for node_type, rows in ((source, index[0]), (target, index[1])):
            if node_type not in masks:
                masks[node_type] = torch.zeros(num_nodes[node_type], dtype=torch.bool, device=rows.device)
            masks[node_type][rows] = True
    return masks


def order_of_edges(num_nodes: dict[str, int], edges: Edges) -> dict[str, Tensor]:
    """Return the nodes of every node type of a relation in ``edges``, in the order in which edges first reach them [node]. Nodes without an edge come last.

    The neighbour search proceeds through space, so in this order nodes that are near in space are near in memory. Edges keep their order, so all sums are
    taken in the same order as before.
    """
    never = 2 * sum(index.shape[1] for index, _, _ in edges.values())
    first: dict[str, Tensor] = {}
    count = 0
    for (source, _, target), (index, _, _) in edges.items():
        for node_type, rows, start in ((source, index[0], count), (target, index[1], count + 1)):
            if node_type not in first:
                first[node_type] = torch.full((num_nodes[node_type],), never, device=rows.device)
            visits = torch.arange(start, start + 2 * len(rows), 2, device=rows.device)
            first[node_type].scatter_reduce_(0, rows, visits, "amin")
        count += 2 * index.shape[1]
    return {t: torch.argsort(visit, stable=True) for t, visit in first.items()}


def reordered(edges: Edges, order: dict[str, Tensor]) -> Edges:
    """Return the edges with the node numbers of a new order."""
    number = {}
    for t, rows in order.items():
        number[t] = torch.empty_like(rows)
        number[t][rows] = torch.arange(len(rows), device=rows.device)
    return _with_numbers(edges, number)


def renumbered(edges: Edges, masks: dict[str, Tensor]) -> Edges:
    """Return the edges with new node numbers, after only the nodes in ``masks`` are kept. Both ends of every edge must be among them."""
    return _with_numbers(edges, {t: torch.cumsum(mask, dim=0) - 1 for t, mask in masks.items()})


def _with_numbers(edges: Edges, number: dict[str, Tensor]) -> Edges:
    return {
        (source, name, target): (torch.stack([number[source][index[0]], number[target][index[1]]]), odd, even)
        for (source, name, target), (index, odd, even) in edges.items()
    }


def merged_levels(x: dict[str, Tensor], edges: Edges) -> tuple[dict[str, Tensor], Edges]:
    """Merge all levels of virtual nodes into one node type. The messages are the same, because all levels have the same weights, but fewer calls are needed."""
    first: dict[str, int] = {}
    nodes: dict[str, list[Tensor]] = {}
    for node_type, value in x.items():
        parts = nodes.setdefault(role(node_type), [])
        first[node_type] = sum(part.shape[0] for part in parts)
        parts.append(value)
    merged: dict[EdgeType, list[tuple[Tensor, Tensor, Tensor]]] = {}
    for (source, name, target), (index, odd, even) in edges.items():
        index = torch.stack([index[0] + first[source], index[1] + first[target]])
        merged.setdefault((role(source), name, role(target)), []).append((index, odd, even))
    joined: Edges = {}
    for relation, stores in merged.items():
        indices, odds, evens = zip(*stores, strict=True)
        joined[relation] = torch.cat(indices, dim=1), torch.cat(odds), torch.cat(evens)
    return {t: torch.cat(parts) for t, parts in nodes.items()}, joined
