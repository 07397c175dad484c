"""Islands are connected components, and those with a boundary edge are not free."""

import networkx
import numpy as np
import pytest

from gpe_pl.graphs.islands import find_islands


@pytest.mark.parametrize("seed", range(5))
def test_equal_to_networkx(seed):
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, 30, (2, 20))
    touches = rng.random(30) < 0.1
    islands = find_islands(30, edges, touches)
    graph = networkx.Graph()
    graph.add_nodes_from(range(30))
    graph.add_edges_from(edges.T.tolist())
    expected = {frozenset(c) for c in networkx.connected_components(graph)}
    found = {frozenset(np.flatnonzero(islands.label == k).tolist()) for k in range(len(islands.is_free))}
    assert found == expected
    for k, free in enumerate(islands.is_free):
        assert free == (not touches[islands.label == k].any())


def test_mean_is_weighted_by_mass():
    islands = find_islands(3, np.array([[0], [2]]), np.zeros(3, dtype=bool))
    mean = islands.mean(np.array([[1.0, 0.0], [5.0, 5.0], [4.0, 6.0]]), np.array([2.0, 1.0, 1.0]))
    np.testing.assert_allclose(mean[islands.label], [[2.0, 2.0], [5.0, 5.0], [2.0, 2.0]])
    assert islands.is_free.all() and len(islands.is_free) == 2


def test_no_nodes():
    islands = find_islands(0, np.empty((2, 0), dtype=np.int64), np.empty(0, dtype=bool))
    assert len(islands.label) == len(islands.is_free) == 0
