"""Changes of states and graphs whose effect on a prediction is known, or that have no effect."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.models.base import Prediction
from gpe_pl.schema import FeatureSpec, is_symmetric
from gpe_pl.trajectory.state import State


def permuted(state: State, order: Any) -> State:
    """Return the state with its nodes in another order, or with only some of them. A state with some of its nodes has no mesh."""
    taken = state.take(order)
    return taken if len(order) == state.num_nodes else replace(taken, cells=None, rest_pos=None)


def to_dtype(data: HeteroData, dtype: torch.dtype) -> HeteroData:
    """Return the graph with all floating-point features in another precision."""
    out = data.clone()
    for store in out.stores:
        for key, value in store.items():
            if isinstance(value, Tensor) and value.is_floating_point():
                store[key] = value.to(dtype)
    return out


def turned(data: HeteroData, spec: FeatureSpec, seed: int = 0, *, turn: bool = True, shuffle: bool = True) -> HeteroData:
    """Return the graph with a random half of its reversible edges reversed (``turn``), and with its edges in random order (``shuffle``).

    ``spec`` lists the relations of the graph. An edge is reversible if ``schema.is_symmetric`` holds for its relation.
    """
    out = data.clone()
    random = torch.Generator().manual_seed(seed)
    for relation in spec.relations:
        store = out[relation]
        count = store.edge_index.shape[1]
        if turn and is_symmetric(relation):
            chosen = torch.rand(count, generator=random) < 0.5
            store.edge_index = torch.where(chosen, store.edge_index.flip(0), store.edge_index)
            for key in {"odd", "offset"} & set(store.keys()):
                store[key] = torch.where(chosen[:, None], -store[key], store[key])
        if shuffle:
            order = torch.randperm(count, generator=random)
            store.edge_index = store.edge_index[:, order]
            for key in {"odd", "even", "offset"} & set(store.keys()):
                store[key] = store[key][order]
    return out


def in_order(predicted: Prediction, graph: HeteroData, num_nodes: int, dim: int) -> Tensor:
    """Return predicted accelerations [node, dim] in the order of the state's nodes; NaN for nodes without a prediction."""
    values = [*predicted.acceleration.values()]
    out = torch.full((num_nodes, dim), float("nan"), dtype=values[0].dtype if values else torch.float64)
    for material, value in predicted.acceleration.items():
        out[graph[material].node_id] = value
    return out
