"""Graphs that contain islands, and a model that conserves their momentum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch_geometric.data import Batch

from gpe_pl.graphs.islands import islands_within
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE, IslandError
from gpe_pl.trajectory.state import State
from tests import scenes

TWO = ("sand", "snow")


def two_clouds(gap: float) -> State:
    """Return a cloud near the floor and one ``gap`` above it, of two materials."""
    low, high = scenes.state(20, TWO, history=2, seed=1, high=0.25), scenes.state(15, TWO, history=2, seed=2, high=0.25)
    high = replace(high, pos=high.pos + np.array([0.3, gap]))
    return State.joined([low, high])


def test_islands_are_components_across_materials() -> None:
    build = scenes.builder(TWO, history=2)
    s = two_clouds(0.4)
    graph = build(s.to_torch())
    distance = np.linalg.norm(s.pos[:, None] - s.pos, axis=-1)
    near = distance <= build.scales.radius
    count, label = connected_components(coo_array(near), directed=False)
    found = np.empty(s.num_nodes, dtype=np.int64)
    for m in TWO:
        found[graph[m].node_id.numpy()] = graph[m].island.numpy()
    assert int(graph.num_islands) == count == len(graph.island_is_held)
    assert len({*zip(found.tolist(), label.tolist(), strict=True)}) == count
    assert count > 1 and not graph.island_is_held.any()


def test_a_batch_keeps_the_momentum_of_each_of_its_islands() -> None:
    build = scenes.builder(TWO, history=2)
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, island_momentum="angular"), build)
    states = [two_clouds(gap).to_torch() for gap in (0.4, 0.45, 0.02)]
    graphs = [build(s) for s in states]
    assert [int(g.num_islands) for g in graphs] != [1, 1, 1]
    together = simulator(Batch.from_data_list(graphs)).acceleration
    for m in TWO:
        alone = torch.cat([simulator(g).acceleration[m] for g in graphs])
        torch.testing.assert_close(together[m], alone, rtol=1e-4, atol=1e-6)
    before, after = states[0], simulator.step(states[0])
    rows = torch.arange(20, 35)
    mass = before.mass[rows, None]
    expected = (mass * before.vel[rows]).sum(0) + mass.sum() * before.gravity * build.metadata.frame_dt
    torch.testing.assert_close((mass * after.vel[rows]).sum(0), expected, rtol=0, atol=1e-5)
    other = torch.arange(20)
    assert not torch.allclose(
        (before.mass[other, None] * (after.vel - before.vel)[other]).sum(0),
        before.mass[other].sum() * before.gravity * build.metadata.frame_dt,
        atol=1e-4,
    )  # which stands on the floor


def test_a_graph_without_islands_is_refused() -> None:
    with pytest.raises(IslandError, match="model.island_momentum=linear needs graph.islands=true"):
        GPE(scenes.builder(islands=False).spec, island_momentum="linear")


def test_islands_are_those_that_the_graphs_own_radius_shows() -> None:
    s = two_clouds(0.4).to_torch()
    wide, narrow = scenes.builder(TWO, history=2)(s), scenes.builder(TWO, history=2, connectivity_spacings=0.5)(s)
    assert int(narrow.num_islands) > int(wide.num_islands)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("trim", [True, False])
def test_islands_of_edges_are_those_of_the_radius(dim: int, trim: bool) -> None:
    build = scenes.builder(("sand", "snow"), dim, trim_boundary=trim)
    s = scenes.state(60, ("sand", "snow"), dim=dim, high=0.8)
    data = build(s.to_torch())
    expected = islands_within(build.scales.radius, s.pos, s.boundary.pos, np.empty((2, 0), dtype=np.int64))
    label = np.empty(60, dtype=np.int64)
    for m in ("sand", "snow"):
        label[data[m].node_id] = data[m].island
    np.testing.assert_array_equal(label, expected.label)
    assert 2 < len(data.island_is_held) == len(expected.is_free) < 60


def test_far_from_the_origin_lever_arms_keep_their_precision() -> None:
    build = scenes.builder(("sand",), 2)
    near = scenes.state(60, ("sand",), high=0.8)
    shift = np.array([2.0**20, -(2.0**19)])
    far = replace(near, pos=near.pos + shift, boundary=replace(near.boundary, pos=near.boundary.pos + shift))
    np.testing.assert_allclose(build(far.to_torch())["sand"].pos, build(near.to_torch())["sand"].pos, rtol=0, atol=1e-7)
