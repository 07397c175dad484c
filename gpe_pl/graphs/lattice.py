"""A scene for timing: a jittered lattice of sand without walls. You choose its numbers of nodes and edges; the radius follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from torch_geometric.data import HeteroData

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.schema import node_code, param_names
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata


def lattice_scene(num_nodes: int, num_edges: int, config: GraphConfig, dim: int = 2, seed: int = 0) -> tuple[GraphBuilder, State]:
    """Return a builder and a state with about ``num_edges`` undirected edges between ``num_nodes`` nodes in a unit square or cube.

    Nodes are in random order, as after a long simulation. ``seed`` determines the order and the jitter of positions.
    """
    rng = np.random.default_rng(seed)
    side = int(np.ceil(num_nodes ** (1 / dim)))
    lattice = np.stack(np.meshgrid(*[np.arange(side)] * dim), axis=-1).reshape(-1, dim)
    pos = (rng.permutation(lattice)[:num_nodes] + rng.uniform(-0.25, 0.25, (num_nodes, dim))) / side
    metadata = Metadata(
        dataset="synthetic",
        materials=("sand",),
        param_names=param_names(("sand",)),
        frame_dt=0.005,
        spacing=1 / side,
        connectivity_radius=_radius(pos, num_edges),
        bounds=((0.0, 1.0),) * dim,
        gravity=(*(0.0,) * (dim - 1), -9.81),
    )
    past = rng.normal(size=(num_nodes, config.history, dim))
    state = State(
        pos,
        past[:, -1],
        np.full(num_nodes, node_code("sand"), dtype=np.uint8),
        np.ones(num_nodes),
        np.full((num_nodes, 1), 30.0),
        Boundary.empty(dim),
        np.array(metadata.gravity),
        past,
    )
    return GraphBuilder(replace(config, connectivity_spacings=None), metadata), state.to_torch()


def lattice_graph(num_nodes: int, num_edges: int, config: GraphConfig, dim: int = 2, seed: int = 0) -> tuple[GraphBuilder, HeteroData]:
    """Return the builder and the graph of ``lattice_scene``, which has the same arguments."""
    builder, state = lattice_scene(num_nodes, num_edges, config, dim, seed)
    return builder, builder(state)


def _radius(pos: np.ndarray, num_edges: int) -> float:
    """Return the radius [m] within which about ``num_edges`` pairs lie, by bisection on a sample of the nodes."""
    tree = cKDTree(pos)
    some = cKDTree(pos[:: max(1, len(pos) // 20_000)])
    wanted = 2 * num_edges * some.n / tree.n
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if _count(some, tree, middle, wanted) < wanted else (low, middle)
    return high


def _count(some: cKDTree, tree: cKDTree, radius: float, enough: float) -> float:
    """Return the number of ordered pairs of distinct nodes within a radius; ``enough`` if there must be many times more."""
    volume = (2 * radius) ** tree.m
    if volume * tree.n > 1000 * enough / some.n:
        return enough
    return float(some.count_neighbors(tree, radius) - some.n)
