"""The contract of the graph builder: exact edges, each once, all stores, and features with the symmetries that models need."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import Batch, HeteroData

from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.features import edge_features, scales_of
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import BOUNDARY, STICKY, node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from tests import scenes

SAND, TWO, THREE = ("sand",), ("sand", "snow"), ("sand", "snow", "fluid")
Pairs = Callable[[np.ndarray, np.ndarray, float], set[tuple[int, int]]]


def builder(materials: tuple[str, ...] = SAND, dim: int = 2, **config: Any) -> GraphBuilder:
    return scenes.builder(materials, dim, **{"history": 1, **config})


def only(material: str, count: int, materials: tuple[str, ...] = TWO, **settings: Any) -> State:
    """Return a state with one of the data set's materials, or without any node."""
    s = scenes.state(max(count, len(materials)) * len(materials), materials, **settings)
    rows = np.flatnonzero(s.node_type == node_code(material))[:count]
    return scenes.permuted(s, rows)


def node_positions(build: GraphBuilder, s: State) -> dict[str, np.ndarray]:
    return {**{m: s.pos[s.node_type == node_code(m)] for m in build.spec.materials}, BOUNDARY: s.boundary.pos}


def edges_of(data: HeteroData, relation: tuple[str, str, str]) -> list[tuple[int, int]]:
    return [(int(j), int(i)) for j, i in data[relation].edge_index.T]


def assert_edges_are_exact(build: GraphBuilder, s: State, brute_force: Pairs) -> int:
    """Compare every relation with all pairs; return the number of edges."""
    data, pos, count = build(s.to_torch()), node_positions(build, s), 0
    assert set(data.edge_types) == set(build.spec.relations)
    for relation in build.spec.relations:
        source, _, target = relation
        expected = brute_force(pos[source], pos[target], build.scales.radius)
        found = edges_of(data, relation)
        assert len(set(found)) == len(found)
        if source == target:
            assert all(j != i for j, i in found)
            assert not {(i, j) for j, i in found} & set(found)
            assert {frozenset(e) for e in found} == {frozenset(e) for e in expected if e[0] != e[1]}
        else:
            assert set(found) == expected
        count += len(found)
    return count


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("materials", [SAND, TWO, THREE])
@pytest.mark.parametrize("seed", [0, 1])
def test_edges_are_all_pairs_within_the_radius(dim: int, materials: tuple[str, ...], seed: int, brute_force_radius: Pairs) -> None:
    s = scenes.state(70, materials, seed=seed, dim=dim, high=0.45 if dim == 2 else 0.3)
    assert assert_edges_are_exact(builder(materials, dim, trim_boundary=False), s, brute_force_radius) > 100


@pytest.mark.parametrize("radius", [0.125, 0.25])
def test_pairs_exactly_at_the_radius_are_neighbours(radius: float, brute_force_radius: Pairs) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(1, 6) / 8] * 2, indexing="ij"), axis=-1).reshape(-1, 2)  # exact in binary
    s = replace(scenes.state(len(grid), walls=False), pos=grid)
    build = builder(connectivity_spacings=radius / scenes.SPACING)
    assert assert_edges_are_exact(build, s, brute_force_radius) == (40 if radius == 0.125 else 40 + 32 + 30)
    floor = Boundary(np.zeros((1, 2)), np.zeros((1, 2)), np.array([[0.0, 1.0]]), np.zeros(1), np.zeros(1))
    beside = replace(scenes.state(2), pos=np.array([[radius, 0.0], [np.nextafter(radius, 1), 0.0]]), boundary=floor)
    assert edges_of(build(beside.to_torch()), (BOUNDARY, "radius", "sand")) == [(0, 0)]


def test_coincident_nodes_are_neighbours_of_each_other_but_not_of_themselves(brute_force_radius: Pairs) -> None:
    s = scenes.state(12, TWO)
    pos = s.pos.copy()
    pos[:6] = pos[0]
    pos[6] = s.boundary.pos[3]
    count = assert_edges_are_exact(builder(TWO, trim_boundary=False), replace(s, pos=pos), brute_force_radius)
    assert count >= 15
    assert all(torch.isfinite(e.odd).all() for e in builder(TWO)(replace(s, pos=pos).to_torch()).edge_stores)


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("walls", [True, False])
def test_every_store_is_there_and_empty_where_the_frame_has_none(count: int, walls: bool) -> None:
    build = builder(TWO)
    data = build(only("snow", count, walls=walls).to_torch())
    assert set(data.node_types) == {"sand", "snow", BOUNDARY}
    assert set(data.edge_types) == set(build.spec.relations)
    assert data["sand"].num_nodes == 0
    assert data["snow"].num_nodes == count
    for t in build.spec.materials:
        assert data[t].x.shape[1] == build.spec.node_channels[t]
        assert data[t].material_params.shape == (data[t].num_nodes, 1)
        assert data[t].mass.shape == data[t].node_id.shape == (data[t].num_nodes,)
    assert data[BOUNDARY].x.shape[1] == build.spec.node_channels[BOUNDARY]
    for relation in build.spec.relations:
        store = data[relation]
        assert store.edge_index.shape == (2, store.odd.shape[0])
        assert store.edge_index.dtype == torch.int64
        assert store.odd.shape[1] == build.spec.odd_channels[relation]
        assert store.even.shape == (store.odd.shape[0], build.spec.even_channels[relation])


def test_boundary_nodes_have_no_edges_among_themselves() -> None:
    data = builder(TWO)(scenes.state(40, TWO).to_torch())
    assert not [e for e in data.edge_types if e[2] == BOUNDARY]
    assert sum(data[e].edge_index.shape[1] for e in data.edge_types if e[0] == BOUNDARY) > 20


def test_nodes_carry_their_own_values() -> None:
    s = scenes.state(30, TWO)
    data = builder(TWO)(s.to_torch())
    assert torch.equal(torch.cat([data[m].node_id for m in TWO]).sort().values, torch.arange(30))
    for column, m in enumerate(TWO):
        rows = data[m].node_id.numpy()
        assert (s.node_type[rows] == node_code(m)).all()
        np.testing.assert_allclose(data[m].mass, s.mass[rows], rtol=1e-6)
        np.testing.assert_allclose(data[m].material_params[:, 0], s.material_params[rows, column], rtol=1e-6)


def test_a_state_is_left_as_it_is() -> None:
    s = scenes.state(30, TWO).to_torch()
    owners = (s, s.boundary)
    before = [{k: v.clone() for k, v in vars(o).items() if isinstance(v, torch.Tensor)} for o in owners]
    builder(TWO)(s)
    for owner, arrays in zip(owners, before, strict=True):
        for key, value in arrays.items():
            assert torch.equal(getattr(owner, key).nan_to_num(), value.nan_to_num()), key


@pytest.mark.parametrize("features", ["paper", "contact"])
def test_swapping_two_nodes_flips_odd_channels_and_keeps_even_ones(features: Any) -> None:
    build = builder(features=features)
    s = scenes.state(2, high=0.08, walls=False)
    swapped = scenes.permuted(s, np.array([1, 0]))
    a, b = (build(x.to_torch())["sand", "radius", "sand"] for x in (s, swapped))
    assert edges_of(build(s.to_torch()), ("sand", "radius", "sand")) == edges_of(build(swapped.to_torch()), ("sand", "radius", "sand"))
    assert a.odd.abs().min() > 0
    assert torch.equal(a.odd, -b.odd)
    assert torch.equal(a.even, b.even)


def test_edge_features_are_displacement_and_motion_of_the_target_relative_to_the_source() -> None:
    build = builder(trim_boundary=False)
    s = scenes.state(20)
    data = build(s.to_torch())
    r, u = build.scales.radius, build.scales.velocity
    for relation, source_pos, source_vel in (
        (("sand", "radius", "sand"), s.pos, s.vel),
        ((BOUNDARY, "radius", "sand"), s.boundary.pos, s.boundary.vel),
    ):
        j, i = data[relation].edge_index.numpy()
        displacement, relative = s.pos[i] - source_pos[j], s.vel[i] - source_vel[j]
        np.testing.assert_allclose(data[relation].odd[:, :2], displacement / r, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(data[relation].odd[:, 4:], relative / u, rtol=1e-5, atol=1e-7)
        normal = s.boundary.normal[j] if relation[0] == BOUNDARY else np.zeros_like(displacement)
        wall = (displacement * normal).sum(1) / build.scales.spacing
        np.testing.assert_allclose(data[relation].even[:, 2], wall, rtol=1e-5, atol=1e-6)


def test_even_channels_of_a_wall_follow_its_normal() -> None:
    build = builder()
    scales = scales_of(build.config, build.metadata)
    displacement, velocity = torch.tensor([[0.03, 0.04]]).double(), torch.tensor([[1.0, -2.0]]).double()
    _, even = edge_features("contact", displacement, velocity, torch.tensor([[0.0, 1.0]]).double(), scales)
    approach = (0.03 * 1.0 - 0.04 * 2.0) / 0.05 / scales.velocity
    expected = [(0.05 / scales.spacing - 1) / 0.2, approach, 0.04 / scales.spacing, -2.0 / scales.velocity]
    np.testing.assert_allclose(even[0], expected, rtol=1e-5, atol=1e-6)


def test_boundary_nodes_tell_sticky_from_slip() -> None:
    build = builder(trim_boundary=False)
    s = scenes.state(5)
    rows = np.arange(len(s.boundary.friction))
    slip, sticky = (replace(s, boundary=replace(s.boundary, friction=np.full(len(rows), f))) for f in (0.0, STICKY))
    x, y = build(slip.to_torch())[BOUNDARY].x, build(sticky.to_torch())[BOUNDARY].x
    assert torch.equal(torch.isclose(x, y), torch.tensor([True] * 4 + [False, True]).expand_as(x))
    assert torch.equal(x[:, 4], torch.zeros(len(rows)))
    np.testing.assert_allclose(y[:, 4], 1.0, atol=2e-6)
    moving = replace(s, boundary=replace(s.boundary, vel=np.ones_like(s.boundary.vel)))
    bouncing = replace(s, boundary=replace(s.boundary, restitution=np.full(len(rows), 0.5)))
    same = build(s.to_torch())[BOUNDARY].x
    assert not torch.equal(build(moving.to_torch())[BOUNDARY].x[:, :2], same[:, :2])
    assert (build(bouncing.to_torch())[BOUNDARY].x[:, 5] == 0.5).all()


def test_boundary_nodes_may_have_their_velocity_only() -> None:
    """The paper does so. The other channels would hold normal, friction and restitution."""
    s = scenes.state(5)
    s = replace(s, boundary=replace(s.boundary, vel=np.ones_like(s.boundary.vel))).to_torch()
    plain, full = (builder(trim_boundary=False, boundary_condition=b) for b in (False, True))
    assert (plain.spec.node_channels[BOUNDARY], full.spec.node_channels[BOUNDARY]) == (2, 6)
    assert torch.equal(plain(s)[BOUNDARY].x, full(s)[BOUNDARY].x[:, :2])


def test_trimming_the_boundary_changes_no_prediction() -> None:
    full, trimmed = (builder(TWO, trim_boundary=t) for t in (False, True))
    s = scenes.state(40, TWO).to_torch()
    a, b = full(s), trimmed(s)
    assert 0 < b[BOUNDARY].num_nodes < a[BOUNDARY].num_nodes
    assert torch.unique(torch.cat([b[e].edge_index[0] for e in b.edge_types if e[0] == BOUNDARY])).tolist() == list(
        range(b[BOUNDARY].num_nodes)
    )
    torch.manual_seed(0)
    model = GPE(full.spec, num_message_passing_steps=2, hidden_channels=8).double()
    x, y = (model(scenes.to_dtype(g, torch.float64)).acceleration for g in (a, b))
    for m in TWO:
        torch.testing.assert_close(x[m], y[m], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("missing", ["snow", "fluid"])
def test_a_material_that_the_data_set_lacks_is_named(missing: str) -> None:
    s = scenes.state(10, ("sand", missing))
    with pytest.raises(
        GraphError, match=rf"state has nodes of {missing}; the data set 'test' has sand; take a model that was trained on {missing}$"
    ):
        builder()(s.to_torch())


def test_a_wrong_history_is_named() -> None:
    with pytest.raises(GraphError, match="history of 2 velocities, the graph needs 3"):
        builder(history=3)(scenes.state(5, history=2).to_torch())


@pytest.mark.slow
def test_a_batch_numbers_nodes_as_its_graphs_do() -> None:
    build = builder(TWO)
    states = [
        scenes.state(30, TWO, seed=1),
        only("sand", 9, seed=2),
        only("snow", 7, seed=3),
        only("snow", 5, seed=4, walls=False),
        only("sand", 0, seed=5),
    ]
    graphs = [build(s.to_torch()) for s in states]
    for order in itertools.permutations(range(len(graphs))):
        batch = Batch.from_data_list([graphs[k] for k in order])
        for relation in build.spec.relations:
            source, _, target = relation
            offset, expected = torch.zeros(2, 1, dtype=torch.int64), []
            for k in order:
                expected.append(graphs[k][relation].edge_index + offset)
                offset = offset + torch.tensor([[graphs[k][source].x.shape[0]], [graphs[k][target].x.shape[0]]])
            assert torch.equal(batch[relation].edge_index, torch.cat(expected, dim=1)), (order, relation)
        for t in build.spec.node_types:
            assert torch.equal(batch[t].x, torch.cat([graphs[k][t].x for k in order]))
