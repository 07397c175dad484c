"""``HeteroData`` from dictionaries of its stores.

Assigning attributes one by one takes longer than computing them: a quarter of a millisecond for a graph of meshes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch_geometric.data import HeteroData
from torch_geometric.data.storage import EdgeStorage, NodeStorage

from gpe_pl.schema import EdgeType


def assembled(nodes: Mapping[str, dict[str, Any]], edges: Mapping[EdgeType, dict[str, Any]], about: dict[str, Any]) -> HeteroData:
    """Return a graph from the attributes of each node store, of each edge store, and of the graph itself. The graph uses these dictionaries, not copies."""
    data = HeteroData()
    for kind, stores, target in ((NodeStorage, nodes, data._node_store_dict), (EdgeStorage, edges, data._edge_store_dict)):
        for key, values in stores.items():
            store = kind.__new__(kind)
            store.__setstate__({"_mapping": values, "_key": key, "_parent": data})  # the protocol of pickle
            target[key] = store
    for name, value in about.items():
        data[name] = value
    return data
