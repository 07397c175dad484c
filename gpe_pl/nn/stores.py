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
    """Return those values of a store that a model has to predict.

    Without given motion, these are the rows of ``values`` [node, …]. With it, they are the components of vectors [node, dim], or the rows of other values of
    nodes that are not held along all axes. Nodes of open scenes that have no target are left out.
    """
    held, unknown = store.get("prescribed"), store.get("without_target")
    if held is None:
        return values if unknown is None else values[~unknown]
    if values.shape != held.shape:
        held = held.all(dim=1)
    return values[~(held if unknown is None else held | unknown.reshape(-1, *[1] * (held.ndim - 1)))]
