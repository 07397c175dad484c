"""The union of graphs equals that of torch-geometric."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch_geometric.data import Batch, HeteroData

from gpe_pl.graphs.batching import batched
from tests import scenes


def particles() -> list[HeteroData]:
    """Return graphs of different sizes, one without snow and one without neighbours."""
    build = scenes.builder(("sand", "snow"), history=2, islands=True)
    states = [scenes.state(n, ("sand", "snow"), history=2, seed=n).to_torch() for n in (30, 7, 2)]
    states[1].node_type[:] = states[1].node_type[0]
    return [build(state) for state in states]


def meshes() -> list[HeteroData]:
    build = scenes.builder(("elastomer",), history=1, islands=True, mesh=True)
    return [build(scenes.mesh_state("triangles", seed=seed).to_torch()) for seed in (0, 1)]


@pytest.mark.parametrize("graphs", [particles, meshes], ids=["particles", "meshes"])
@pytest.mark.parametrize("number", [1, 2, 5])
def test_it_equals_the_batch_of_torch_geometric(graphs: Callable[[], list[HeteroData]], number: int) -> None:
    made = (3 * graphs())[:number]
    for k, graph in enumerate(made := [graph.clone() for graph in made]):
        graph.trajectory, graph.frame, graph.weight = k, 3 * k, 0.1 + k
        for material in graph.node_types:
            graph[material].target = torch.randn(graph[material].x.shape[0], 2)
    expected, found = Batch.from_data_list(made), batched(made)
    assert (found.node_types, found.edge_types) == (expected.node_types, expected.edge_types)
    for store, other in zip(found.stores, expected.stores, strict=True):
        assert {*store.keys()} == {*other.keys()} - {"ptr"}
        for key, value in store.items():
            torch.testing.assert_close(value, other[key], rtol=0, atol=0, equal_nan=True, msg=key)
