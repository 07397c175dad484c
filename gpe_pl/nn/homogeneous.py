"""Conversion of a typed graph to a graph of one node type, for models that use the same layers for all types and distinguish types by their input.

Nodes are ordered by type, in the order of ``FeatureSpec.node_types``. Features of different meaning have separate blocks of columns. For nodes these are the
motion of materials, boundary nodes, virtual nodes, and the parameters of each material. Edges have one block of odd and one of even channels per kind of
relation (``radius``, ``cell``, …). A block is zero for nodes or edges that do not have its features.
"""

from collections.abc import Iterable
from typing import Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional
from torch_geometric.data import HeteroData

from gpe_pl.schema import EdgeType, FeatureSpec, role

MaterialEmbeddingKind = Literal["feature", "none"]
"""``feature``: material parameters are features of nodes. ``none``: they are left out, for comparison."""

Edges = dict[EdgeType, tuple[Tensor, Tensor, Tensor]]
"""``edge_index``, ``odd`` and ``even`` of each relation that has edges."""


class Homogeneous:
    """Layout of types and relations of a ``FeatureSpec`` in the homogeneous graph.

    Args:
        spec: channels of the typed graphs.
        node_types: node types that take part, all materials among them.
        material_embedding: whether material parameters are features.

    Attributes:
        kind: integer code of each node type; virtual nodes of all levels have the same code.
        num_kinds: number of different kinds.
        node_channels: number of columns of ``nodes``.
        edge_channels: number of columns of ``edges``.
    """

    def __init__(self, spec: FeatureSpec, node_types: tuple[str, ...], material_embedding: MaterialEmbeddingKind) -> None:
        kinds = list(dict.fromkeys(role(t) for t in node_types))
        self.kind = {t: kinds.index(role(t)) for t in node_types}
        self.num_kinds = len(kinds)

        block = {t: "material" if t in spec.materials else role(t) for t in node_types}
        widths: dict[str, int] = {}
        for t in node_types:
            widths[block[t]] = max(widths.get(block[t], 0), spec.node_channels[t])
        read = spec.materials if material_embedding == "feature" else ()
        widths |= {f"parameters of {m}": spec.param_channels[m] for m in read}
        first = _first_columns(widths)
        self._x = {t: first[block[t]] for t in node_types}
        self._params = {m: first[f"parameters of {m}"] for m in read}
        self.node_channels = sum(widths.values())

        edge_widths: dict[str, int] = {}
        for relation in spec.relations:
            for sign, channels in (("odd", spec.odd_channels), ("even", spec.even_channels)):
                key = f"{relation[1]} {sign}"
                edge_widths[key] = max(edge_widths.get(key, 0), channels[relation])
        self._edge = _first_columns(edge_widths)
        self.edge_channels = sum(edge_widths.values())

    def nodes(self, x: dict[str, Tensor], params: dict[str, Tensor]) -> tuple[Float[Tensor, "node channel"], Int64[Tensor, " node"]]:
        """Return features and kinds of all nodes, from the features of each node type and the parameters of each material."""
        rows, kinds = [], []
        for t, features in x.items():
            row = _place(features, self._x[t], self.node_channels)
            if t in self._params and t in params:
                row = row + _place(params[t], self._params[t], self.node_channels)
            rows.append(row)
            kinds.append(torch.full((features.shape[0],), self.kind[t], dtype=torch.int64, device=features.device))
        return torch.cat(rows), torch.cat(kinds)

    def edges(
        self, x: dict[str, Tensor], edges: Edges, forward: Iterable[EdgeType], backward: Iterable[EdgeType]
    ) -> tuple[Int64[Tensor, "2 edge"], Float[Tensor, "edge channel"]]:
        """Return directed edges (row 0 source, row 1 target) and features: relations in ``forward`` as stored, relations in ``backward`` reversed."""
        start = first_rows(x)
        indices, features = [], []
        for relations, sign in ((forward, 1), (backward, -1)):
            for relation in relations:
                if relation not in edges:
                    continue
                source, kind, target = relation
                edge_index, odd, even = edges[relation]
                index = torch.stack([edge_index[0] + start[source], edge_index[1] + start[target]])
                indices.append(index if sign > 0 else index.flip(0))
                placed = _place(odd if sign > 0 else -odd, self._edge[f"{kind} odd"], self.edge_channels)
                features.append(placed + _place(even, self._edge[f"{kind} even"], self.edge_channels))
        if not indices:
            some = next(iter(x.values()))
            return torch.empty((2, 0), dtype=torch.int64, device=some.device), some.new_empty((0, self.edge_channels))
        return torch.cat(indices, dim=1), torch.cat(features)


def present(data: HeteroData, spec: FeatureSpec) -> tuple[dict[str, Tensor], dict[str, Tensor], Edges]:
    """Return the features of node types, the parameters of materials and the relations of a graph, without those that are empty."""
    x = {t: data[t].x for t in spec.node_types if data[t].x.shape[0]}
    params = {m: data[m].material_params for m in spec.materials if m in x}
    return x, params, {r: (data[r].edge_index, data[r].odd, data[r].even) for r in spec.relations if data[r].edge_index.shape[1]}


def first_rows(x: dict[str, Tensor]) -> dict[str, int]:
    """Return the row at which each node type starts."""
    start, rows = {}, 0
    for t, features in x.items():
        start[t] = rows
        rows += features.shape[0]
    return start


def _first_columns(widths: dict[str, int]) -> dict[str, int]:
    """Return the first column of each block."""
    first, column = {}, 0
    for name, width in widths.items():
        first[name] = column
        column += width
    return first


def _place(values: Tensor, first: int, channels: int) -> Tensor:
    """Write values to columns ``first``, ``first + 1``, … of ``channels`` columns; the others are zero."""
    return functional.pad(values, (first, channels - first - values.shape[1]))
