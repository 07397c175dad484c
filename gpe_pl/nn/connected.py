"""Nodes that take part in message passing: those that an edge touches."""

from __future__ import annotations

import torch
from torch import Tensor

from gpe_pl.schema import EdgeType

Edges = dict[EdgeType, tuple[Tensor, Tensor, Tensor]]
"""``edge_index``, ``odd`` and ``even`` of the relations that have edges."""


def touched(num_nodes: dict[str, int], edges: Edges) -> dict[str, Tensor]:
    """For every node type, which of its nodes have an edge [node]."""
    masks: dict[str, Tensor] = {}
    for (source, _, target), (index, _, _) in edges.items():
        for node_type, rows in ((source, index[0]), (target, index[1])):
            if node_type not in masks:
                masks[node_type] = torch.zeros(num_nodes[node_type], dtype=torch.bool, device=rows.device)
            masks[node_type][rows] = True
    return masks


def renumbered(edges: Edges, masks: dict[str, Tensor]) -> Edges:
    """The edges between the nodes that ``masks`` keep, by their new numbers."""
    number = {t: torch.cumsum(mask, dim=0) - 1 for t, mask in masks.items()}
    return {
        (source, name, target): (torch.stack([number[source][index[0]], number[target][index[1]]]), odd, even)
        for (source, name, target), (index, odd, even) in edges.items()
    }
