"""A small mesh with virtual nodes and random features, made by hand: a chain whose neighbours are merged in pairs, level by level."""

from __future__ import annotations

import torch
from torch_geometric.data import HeteroData

from gpe_pl.schema import BOUNDARY, CELL, DOWN, MATERIALS, RADIUS, SAME, EdgeType, FeatureSpec, grid, mesh_relations, radius_relations

NUM_NODES, NUM_BOUNDARY = 8, 2


def spec(num_levels: int) -> FeatureSpec:
    """Channels of ``graph``; every relation and type has its own widths."""
    materials = ("solid",)
    relations = (*radius_relations(materials), *mesh_relations(materials, num_levels))
    widths = {RADIUS: (4, 2), CELL: (6, 3), SAME: (6, 4), DOWN: (6, 4)}
    return FeatureSpec(
        dim=2,
        materials=materials,
        node_channels={"solid": 4, BOUNDARY: 6, **{grid(level): 5 for level in range(1, num_levels + 1)}},
        parameters={"solid": MATERIALS["solid"][:1]},
        relations=relations,
        odd_channels={r: widths[r[1]][0] for r in relations},
        even_channels={r: widths[r[1]][1] for r in relations},
        num_levels=num_levels,
    )


def graph(num_levels: int, seed: int = 0) -> HeteroData:
    """Return nodes 0 … 7 in a chain of cells, 2 boundary nodes near its ends, contact of its ends, and 4, 2, 1 virtual nodes."""
    channels, random = spec(num_levels), torch.Generator().manual_seed(seed)
    size = {"solid": NUM_NODES, BOUNDARY: NUM_BOUNDARY, **{grid(level): NUM_NODES >> level for level in range(1, num_levels + 1)}}
    pairs: dict[EdgeType, list[tuple[int, int]]] = {
        ("solid", RADIUS, "solid"): [(7, 0)],
        (BOUNDARY, RADIUS, "solid"): [(0, 0), (0, 1), (1, 7)],
    }
    for source, name, target in channels.relations:
        if name in (CELL, SAME):
            pairs[source, name, target] = [(k, k + 1) for k in range(size[source] - 1)]
        elif name == DOWN:
            pairs[source, name, target] = [(k // 2, k) for k in range(size[target])]

    def features(rows: int, count: int) -> torch.Tensor:
        return torch.randn(rows, count, generator=random, dtype=torch.float64)

    data = HeteroData()
    for node_type, rows in size.items():
        data[node_type].x = features(rows, channels.node_channels[node_type])
    data["solid"].material_params, data["solid"].mass = features(NUM_NODES, 1), features(NUM_NODES, 1)[:, 0].exp()
    for relation, edges in pairs.items():
        store = data[relation]
        store.edge_index = torch.tensor(edges, dtype=torch.int64).reshape(-1, 2).T
        store.odd = features(len(edges), channels.odd_channels[relation])
        store.even = features(len(edges), channels.even_channels[relation])
    return data
