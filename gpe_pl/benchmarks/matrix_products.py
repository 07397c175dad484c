"""The floating-point operations of the matrix products in a forward pass of GPE. Benchmarks divide run times by the time that these products take.

``products`` counts the operations of the factored form, in which node features are multiplied before they are gathered to edges. The formula is written
out here, so that it does not change when the implementation of layers changes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from torch_geometric.data import HeteroData

from gpe_pl.models.gpe import GPE
from gpe_pl.schema import CELL, RADIUS, EdgeType, is_symmetric, role
from gpe_pl.system.machine import gemm_rate


@dataclass(frozen=True)
class _Sizes:
    """Numbers of rows and channels of a graph. Levels of virtual nodes with the same weights are one type.

    Attributes:
        nodes: number of nodes of each type.
        edges: number of edges of each relation that has any.
        odd, even: channels of each relation.
    """

    nodes: dict[str, int]
    edges: dict[EdgeType, int]
    odd: dict[EdgeType, int]
    even: dict[EdgeType, int]


def products(model: GPE, graph: HeteroData) -> int:
    """Return the number of floating-point operations of the matrix products of a forward pass [FLOP].

    A product of a matrix [n, k] with one [k, m] counts 2 n k m. All nodes count, also those without an edge.
    """
    spec, settings, hidden = model.spec, model.settings, model.settings["hidden_channels"]
    square = hidden**2
    readable = _readable(model)
    sizes = _sizes(model, graph, readable[0])
    total = 0
    for t, count in sizes.nodes.items():
        node_type = next(n for n in spec.node_types if _name(model, n) == t)
        params = 0 if settings["material_embedding"] == "none" else spec.param_channels.get(node_type, 0)
        per_node = spec.node_channels[node_type] * hidden + square
        if params:  # the embedding, and its part of the encoder
            per_node += params * hidden + square + (square if settings["material_embedding"] == "mlp" else 0)
        total += count * per_node
    for relation, count in sizes.edges.items():
        total += count * _edge_encoder(model, relation, sizes)
    for step, types in enumerate(readable):
        names = {_name(model, t) for t in types}
        updates_edges = settings["edge_state"] == "latent" and step < len(readable) - 1
        total += sum(_messages(model, r, sizes, updates_edges) for r in sizes.edges if {r[0], r[2]} & names)
        total += sum(2 * count * square for t, count in sizes.nodes.items() if t in names)
    return 2 * (total + _decoders(model, graph))


def product_rate(model: GPE, graph: HeteroData) -> float:
    """Return the rate at which this machine multiplies the hidden states of all nodes of materials by a square matrix [FLOP/s], now, in processor time."""
    rows = sum(graph[m].x.shape[0] for m in model.spec.materials)
    return gemm_rate(rows, model.settings["hidden_channels"], "cpu", time.process_time)


def _name(model: GPE, node_type: str) -> str:
    return role(node_type) if model.settings["level_weights"] == "shared" else node_type


def _readable(model: GPE) -> list[set[str]]:
    """Return for every step the node types whose state after it can still influence a material."""
    readable = [{*model.spec.materials}]
    while len(readable) < model.settings["num_message_passing_steps"]:
        readers = readable[0]
        readable.insert(0, readers.union(*({r[0], r[2]} for r in model.spec.relations if {r[0], r[2]} & readers)))
    return readable


def _sizes(model: GPE, graph: HeteroData, readable: set[str]) -> _Sizes:
    spec, sizes = model.spec, _Sizes({}, {}, {}, {})
    joined_names = {r: (_name(model, r[0]), r[1], _name(model, r[2])) for r in spec.relations}
    used = {joined_names[r] for r in spec.relations if {r[0], r[2]} & readable}
    ends = {_name(model, t) for t in readable}.union(*({r[0], r[2]} for r in used))
    for t in spec.node_types:
        if _name(model, t) in ends:
            sizes.nodes[_name(model, t)] = sizes.nodes.get(_name(model, t), 0) + graph[t].x.shape[0]
    for r, joined in joined_names.items():
        count = graph[r].edge_index.shape[1]
        if count and joined in used:
            sizes.edges[joined] = sizes.edges.get(joined, 0) + count
            sizes.odd[joined], sizes.even[joined] = spec.odd_channels[r], spec.even_channels[r]
    return sizes


def _kind(model: GPE, relation: EdgeType) -> str:
    interaction: str = model.settings["interaction"]
    return interaction if is_symmetric(relation) or interaction == "directed" else "negated"


def _edge_encoder(model: GPE, relation: EdgeType, sizes: _Sizes) -> int:
    """Return the multiplications that encode one edge."""
    if model.settings["edge_state"] == "geometry":
        return 0
    hidden: int = model.settings["hidden_channels"]
    features = sizes.odd[relation] + sizes.even[relation]
    return (features * hidden + hidden**2) * (2 if _kind(model, relation) == "directed" else 1)


def _messages(model: GPE, relation: EdgeType, sizes: _Sizes, updates_edges: bool) -> int:
    """Return the multiplications of a message-passing layer for one relation."""
    hidden, kind, count = model.settings["hidden_channels"], _kind(model, relation), sizes.edges[relation]
    source, _, target = relation
    is_odd, is_joint, directions = kind in ("odd", "odd_even"), source == target, 2 if kind == "directed" else 1
    rows = sizes.nodes[target] + (0 if is_joint else sizes.nodes[source])
    state = hidden if model.settings["edge_state"] == "latent" else sizes.odd[relation] + (0 if is_odd else sizes.even[relation])
    total = directions * count * state * hidden + (count * sizes.even[relation] * hidden if is_odd else 0)
    total += rows * hidden**2 * (2 if is_joint or kind == "directed" else 1)
    total += directions * count * hidden**2 if updates_edges else rows * hidden**2
    return int(total + (rows * hidden**2 if kind == "odd_even" else 0))


def _decoders(model: GPE, graph: HeteroData) -> int:
    """Return the multiplications of all decoders."""
    spec, settings, hidden = model.spec, model.settings, model.settings["hidden_channels"]
    total = 0
    for m in spec.materials:
        count = graph[m].x.shape[0]
        total += count * (hidden**2 + hidden * spec.dim) if settings["decoder"] != "pair" else 0
        total += count * (hidden**2 + hidden * spec.stress_channels[m]) if settings["stress"] and m in spec.stress_channels else 0
    for r in spec.relations:
        count = graph[r].edge_index.shape[1]
        at_bodies = r[1] == RADIUS and bool({r[0], r[2]} & {*model.bodies})
        if count and (at_bodies or (settings["decoder"] == "pair" and r[1] in (RADIUS, CELL))):
            total += (graph[r[0]].x.shape[0] + graph[r[2]].x.shape[0]) * hidden**2
            total += count * hidden * (spec.odd_channels[r] + spec.even_channels[r] + spec.dim)
    return int(total)
