"""Batches: several graphs joined into one, which a model computes in one pass."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch_geometric.data import HeteroData


def batched(graphs: Sequence[HeteroData]) -> HeteroData:
    """Return the disjoint union of graphs with the same types and attributes; ``batch`` of node stores gives the graph of each row.

    The values equal those of ``torch_geometric.data.Batch.from_data_list``. That function handles any data and is slower: for a small graph it takes longer
    than building the edges.
    """
    out, first = HeteroData(), graphs[0]
    offsets: dict[str, list[int]] = {}
    for node_type in first.node_types:
        stores = [graph[node_type] for graph in graphs]
        for key, _ in stores[0].items():
            if not key.endswith("_index"):
                out[node_type][key] = torch.cat([store[key] for store in stores])
        sizes = [store.x.shape[0] for store in stores]
        offsets[node_type] = [sum(sizes[:k]) for k in range(len(sizes))]
        for key in [key for key in first[node_type] if key.endswith("_index")]:
            shifted = [store[key] + start for store, start in zip(stores, offsets[node_type], strict=True)]
            out[node_type][key] = torch.cat(shifted)
        number = torch.arange(len(graphs), device=stores[0].x.device)
        out[node_type].batch = torch.repeat_interleave(number, torch.tensor(sizes, device=number.device))
    for edge_type in first.edge_types:
        edges, (source, _, target) = [graph[edge_type] for graph in graphs], edge_type
        for key, _ in edges[0].items():
            parts = [store[key] for store in edges]
            if key == "edge_index":
                parts = [_shifted(*part) for part in zip(parts, offsets[source], offsets[target], strict=True)]
            out[edge_type][key] = torch.cat(parts, dim=1 if key == "edge_index" else 0)
    for key, value in first.stores[0].items():
        values = [graph[key] for graph in graphs]
        out[key] = torch.cat(values) if isinstance(value, Tensor) else torch.tensor(values)
    return out


def _shifted(edge_index: Tensor, source: int, target: int) -> Tensor:
    """Return the edges of a graph whose source and target nodes start at these rows."""
    return edge_index + torch.tensor([[source], [target]], device=edge_index.device)
