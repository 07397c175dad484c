"""The stores of a graph as dictionaries.

Each access by ``data[key].name`` takes microseconds, and a model reads some fifty tensors of a graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.schema import EdgeType


def contents(data: HeteroData) -> tuple[dict[str, dict[str, Tensor]], dict[EdgeType, dict[str, Tensor]]]:
    """Return the tensors of each node store and of each edge store by name. Do not change these dictionaries."""
    nodes: dict[Any, Any] = data._node_store_dict
    edges: dict[Any, Any] = data._edge_store_dict
    return {t: store._mapping for t, store in nodes.items()}, {r: store._mapping for r, store in edges.items()}


def predicted_rows(store: Mapping[str, Any], values: Tensor) -> Tensor:
    """Return the values [node, …] of those nodes of a store that a model has to predict.

    Nodes whose motion is given are left out, and those of open scenes that have no target.
    """
    masks = [store[name] for name in ("prescribed", "without_target") if name in store]
    if not masks:
        return values
    return values[~(masks[0] if len(masks) == 1 else masks[0] | masks[1])]
