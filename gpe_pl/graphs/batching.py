"""Batches: several graphs joined into one, which a model computes in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.assembly import assembled
from gpe_pl.nn.stores import contents
from gpe_pl.schema import EdgeType


def batched(graphs: Sequence[HeteroData]) -> HeteroData:
    """Return the disjoint union of graphs with the same types and attributes; ``batch`` of node stores gives the graph of each row.

    The values equal those of ``torch_geometric.data.Batch.from_data_list``. That function handles any data and is slower: for a small graph it takes longer
    than building the edges.
    """
    parts, about = [contents(graph) for graph in graphs], dict[str, Any]()
    offsets: dict[str, list[int]] = {}
    nodes, edges = dict[str, dict[str, Any]](), dict[EdgeType, dict[str, Any]]()
    for node_type, first in parts[0][0].items():
        stores = [of_nodes[node_type] for of_nodes, _ in parts]
        sizes = [store["x"].shape[0] for store in stores]
        offsets[node_type] = [0, *accumulate(sizes[:-1])]
        own = nodes[node_type] = {key: torch.cat([store[key] for store in stores]) for key in first if not key.endswith("_index")}
        for key in [key for key in first if key.endswith("_index")]:
            own[key] = torch.cat([_shifted(store[key], start) for store, start in zip(stores, offsets[node_type], strict=True)])
        own["batch"] = torch.from_numpy(np.repeat(np.arange(len(graphs)), sizes)).to(first["x"].device)
    for edge_type, first in parts[0][1].items():
        starts = [*zip(offsets[edge_type[0]], offsets[edge_type[2]], strict=True)]
        own = edges[edge_type] = {}
        for key in first:
            values = [of_edges[edge_type][key] for _, of_edges in parts]
            if key == "edge_index":
                own[key] = torch.cat([_shifted(index, *start) for index, start in zip(values, starts, strict=True)], dim=1)
            else:
                own[key] = torch.cat(values)
    for key, value in graphs[0].stores[0].items():
        of_graphs = [graph[key] for graph in graphs]
        about[key] = torch.cat(of_graphs) if isinstance(value, Tensor) else torch.tensor(of_graphs)
    return assembled(nodes, edges, about)


def _shifted(index: Tensor, source: int, target: int | None = None) -> Tensor:
    """Return indices whose nodes start at the row ``source``; those in the second row of edges [2, edge] start at ``target``."""
    if target is None or target == source:
        return index + source if source else index
    return index + index.new_tensor([[source], [target]])
