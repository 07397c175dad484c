"""The multi-scale graph of meshes compared with plain loops, and GPE on it."""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import Batch, HeteroData

from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.multiscale import MeshError, MultiscaleGraph, _cached, build, levels_of, multiscale_graph
from gpe_pl.graphs.standardizer import GraphStandardizer
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import BOUNDARY, grid, is_symmetric, node_code
from gpe_pl.trajectory.cells import cell_edges
from gpe_pl.trajectory.state import State
from tests import scenes

KINDS = ["lattice", "triangles", "tetrahedra"]
DOUBLE = torch.float64
BOTH = ("sand", "elastomer")
MIXED = ("sand", "elastomer", "solid")


def builder(materials: tuple[str, ...] = ("elastomer",), dim: int = 2, **config: Any) -> GraphBuilder:
    return scenes.builder(materials, dim, **{"mesh": True, "islands": True, **config})


def dim_of(kind: str) -> int:
    return 3 if kind == "tetrahedra" else 2


def double(build: GraphBuilder, s: State) -> HeteroData:
    return scenes.to_dtype(build(s.to_torch()), DOUBLE)


def model_of(build: GraphBuilder, **settings: Any) -> GPE:
    """Return a random model in double precision without gradients. Equal arguments give the same object, because PyG makes layers slowly."""
    values = {"num_message_passing_steps": 2, "hidden_channels": 16, **settings}
    key = repr((build.spec, sorted(values.items())))
    if key not in MODELS:
        torch.manual_seed(0)
        MODELS[key] = GPE(build.spec, **values).double()
    MODELS[key].zero_grad()
    return MODELS[key]


MODELS: dict[str, GPE] = {}


def accelerations(model: GPE, data: HeteroData, num_nodes: int) -> torch.Tensor:
    out = torch.zeros(num_nodes, model.spec.dim, dtype=DOUBLE)
    for material, value in model(data).acceleration.items():
        out[data[material].node_id] = value
    return out


# --- the construction -----------------------------------------------------------------------------------------------------------------------


def by_loops(rest_pos: np.ndarray, cells: np.ndarray, num_levels: int) -> tuple[set[Any], set[Any], set[Any], dict[int, int]]:
    """Return cell edges, (parent, child) pairs, same edges, and the body of every node; a virtual node is (level, the mesh nodes below it)."""
    edges = {frozenset(pair) for cell in cells.tolist() for pair in itertools.combinations(cell, 2)}
    neighbours = defaultdict(set)
    for a, b in map(tuple, edges):
        neighbours[a].add(b)
        neighbours[b].add(a)
    body: dict[int, int] = {}
    for node in range(len(rest_pos)):
        reached = {node} if node not in body else set()
        while reached:
            new = reached.pop()
            body[new] = node
            reached |= {k for k in neighbours[new] if k not in body}

    down, same = set(), set()
    for number in set(body.values()):
        nodes = [k for k in neighbours if body[k] == number]
        if not nodes:
            continue
        low = rest_pos[nodes].min(axis=0)
        corner = []  # of the root's box, so that the body is in its middle
        for axis in range(rest_pos.shape[1]):
            count = 1 + max(int((rest_pos[k, axis] - low[axis]) / scenes.SPACING + 1e-6) for k in nodes)
            root = next(2**level for level in range(20) if 2**level >= count)
            corner.append(low[axis] - 2 * ((root - count) // 4) * scenes.SPACING)
        below = {k: k for k in nodes}  # of each mesh node, what stands for it one level down
        links = [tuple(e) for e in edges if body[min(e)] == number]
        for level in range(1, num_levels + 1):
            boxes = defaultdict(set)
            for k in nodes:
                boxes[tuple(((rest_pos[k] - corner) / (scenes.SPACING * 2**level) + 1e-6).astype(int))].add(k)
            here = {k: (level, frozenset(members)) for members in boxes.values() for k in members}
            down |= {(here[k], below[k]) for k in nodes}
            pairs = {frozenset((here[a], here[b])) for a, b in links if here[a] != here[b]}
            same |= pairs
            below, links = here, [tuple(next(iter(v[1])) for v in pair) for pair in pairs]
            if len(boxes) == 1:
                break
    return edges, down, same, body


def names_of(graph: MultiscaleGraph) -> dict[int, Any]:
    """Return the virtual nodes of a graph by their names in ``by_loops``."""
    below = defaultdict(set)
    for parent, node in graph.descent.T.tolist():
        below[parent].add(node)
    return {**{k: k for k in range(graph.num_nodes)}, **{p: (int(graph.level[p]), frozenset(nodes)) for p, nodes in below.items()}}


@pytest.mark.parametrize("num_levels", [0, 1, 2, 6])
@pytest.mark.parametrize("kind", KINDS)
def test_equals_plain_loops(kind: str, num_levels: int) -> None:
    for seed in range(3):
        assert_equals_plain_loops(scenes.mesh_state(kind, seed=seed), num_levels)


def assert_equals_plain_loops(s: State, num_levels: int) -> None:
    assert s.rest_pos is not None
    assert s.cells is not None
    graph = build(s.rest_pos, s.cells, scenes.SPACING, num_levels)
    edges, down, same, body = by_loops(s.rest_pos, s.cells, num_levels)
    name = names_of(graph)
    assert len(name) == len(graph.level) == len(set(name.values()))
    for found, expected in ((graph.cell_edges, edges), (graph.same_edges, same)):
        assert found.shape[1] == len(expected)
        assert {frozenset((name[a], name[b])) for a, b in found.T.tolist()} == expected
    assert graph.down_edges.shape[1] == len(down)
    assert {(name[a], name[b]) for a, b in graph.down_edges.T.tolist()} == down
    assert len({*graph.body[: s.num_nodes]}) == len({*body.values()}) == 2
    assert len({(int(graph.body[k]), body[k]) for k in range(s.num_nodes)}) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_every_child_has_one_parent_and_every_body_one_root(kind: str) -> None:
    s = scenes.mesh_state(kind, num_bodies=3)
    graph = build(s.rest_pos, s.cells, scenes.SPACING, 8)  # type: ignore[arg-type]
    children = graph.down_edges[1]
    assert len(np.unique(children)) == len(children)
    roots = np.flatnonzero(graph.parent < 0)
    assert sorted(graph.body[roots]) == [0, 1, 2]
    assert (graph.level[roots] >= 1).all()
    for root in roots:
        assert (graph.descent[1][graph.descent[0] == root].size) == (graph.body[: s.num_nodes] == graph.body[root]).sum()
    assert (graph.level[graph.down_edges[0]] == graph.level[children] + 1).all()
    for edges in (graph.cell_edges, graph.same_edges):
        assert (graph.level[edges[0]] == graph.level[edges[1]]).all()
        assert (graph.body[edges[0]] == graph.body[edges[1]]).all()


def test_a_cell_that_names_a_node_twice_is_a_triangle() -> None:
    cells = np.array([[0, 1, 2, 2], [1, 1, 1, 1]])
    assert cell_edges(cells, 3).T.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_a_lattice_merges_two_by_two() -> None:
    size = 8
    points, number = np.argwhere(np.ones((size, size))) * 0.1, np.arange(size**2).reshape(size, size)
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    for offset in (0.0, 0.3, -7.7):  # rounding must not move a row into the next box
        graph = build(points + offset, cells, 0.1, 5)
        assert np.bincount(graph.level).tolist() == [64, 16, 4, 1]
        assert (np.bincount(graph.down_edges[0])[64:] == 4).all()
        assert graph.same_edges.shape[1] == (4 * 3 * 2 + 2 * 3 * 3) + 6


def test_siblings_are_of_similar_size() -> None:
    """A body one spacing wider than a box is not cut into a whole box and a sliver."""
    line = np.stack([np.arange(17) * 0.1, np.zeros(17)], axis=1)
    graph = build(line, np.stack([np.arange(16), np.arange(1, 17)], axis=1), 0.1, 8)
    halves = graph.descent[:, graph.level[graph.descent[0]] == 4][0]
    assert sorted(np.unique(halves, return_counts=True)[1]) == [7, 10]
    assert (graph.level[graph.parent < 0] == 5).all()


def test_levels_lead_to_one_root_of_the_largest_body_of_a_domain() -> None:
    for count in (2, 3, 16, 17, 31):
        line = np.stack([np.arange(count) * 0.1, np.zeros(count)], axis=1)
        graph = build(line, np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), 0.1, levels_of(count * 0.1, 0.1))
        assert (graph.parent < 0).sum() == 1


def test_nodes_of_no_cell_stand_alone() -> None:
    points = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.02, 0.02]])
    graph = build(points, np.array([[0, 1, 2]]), 0.1, 3)
    assert graph.parent[3] < 0
    assert graph.body[3] not in graph.body[:3]
    assert len(graph.level) == 5


def test_the_graph_of_a_mesh_is_built_once_and_found_by_content() -> None:
    s = scenes.mesh_state(seed=11)
    build = builder(history=1)
    before = _cached.cache_info()
    build(s.to_torch())
    moved = replace(s, pos=s.pos + 0.01, rest_pos=s.rest_pos.copy(), cells=s.cells.astype(np.int32))  # type: ignore[union-attr]
    for _ in range(3):
        build(moved.to_torch())
    after = _cached.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits) == (1, 3)
    graph = multiscale_graph(s.rest_pos, s.cells, scenes.SPACING, build.spec.num_levels)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="read-only"):
        graph.level[0] = 1


def test_what_is_no_mesh_is_named() -> None:
    s = scenes.mesh_state()
    assert s.rest_pos is not None
    assert s.cells is not None
    cells, rest = s.cells.copy(), s.rest_pos.copy()
    cells[3, 1] = s.num_nodes
    with pytest.raises(MeshError, match=rf"cell 3 has the nodes .*there are {s.num_nodes} nodes"):
        builder()(replace(s, cells=cells).to_torch())
    rest[5, 0] = np.nan
    with pytest.raises(MeshError, match="node 5 has a rest position that is not finite"):
        builder()(replace(s, rest_pos=rest).to_torch())
    with pytest.raises(GraphError, match="cells but no rest_pos"):
        builder()(replace(s, rest_pos=None).to_torch())
    mixed = scenes.mesh_state(materials=("sand", "elastomer"))
    kinds = mixed.node_type.copy()
    kinds[mixed.cells[2, 0]] = node_code("sand")  # type: ignore[index]
    with pytest.raises(GraphError, match=r"cell \d+ has nodes of elastomer, sand; a cell is of one material"):
        builder(("sand", "elastomer"))(replace(mixed, node_type=kinds).to_torch())


# --- the graph of a state -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [scenes.state(20, ("elastomer",)), scenes.state(20, ("sand",))], ids=["no cells", "no mesh material"])
def test_a_scene_without_mesh_builds_no_virtual_node(state: State) -> None:
    for materials in (("sand", "elastomer"), ("sand",)):
        if materials == ("sand",) and (state.node_type != node_code("sand")).any():
            continue
        build = builder(materials)
        state = replace(state, material_params=np.ones((20, len(build.metadata.param_names))))
        data, plain = build(state.to_torch()), scenes.builder(materials)(state.to_torch())
        assert set(data.node_types) == set(build.spec.node_types)
        assert set(data.edge_types) == set(build.spec.relations)
        for store in data.stores:
            key = getattr(store, "_key", None)
            if key in plain.node_types or key in plain.edge_types:
                assert torch.equal(store.get("odd", store.get("x")), plain[key].get("odd", plain[key].get("x")))
            elif key is not None:
                assert (store.edge_index.shape[1] if isinstance(key, tuple) else store.num_nodes) == 0
    assert builder(("sand", "snow")).spec == scenes.builder(("sand", "snow")).spec


@pytest.mark.parametrize("features", ["paper", "contact"])
@pytest.mark.parametrize("kind", KINDS)
def test_stores_have_the_channels_of_the_spec(kind: str, features: str) -> None:
    for num_levels, materials in itertools.product((None, 0, 1, 3), (("elastomer",), MIXED)):
        build = builder(materials, dim_of(kind), features=features, history=2, num_levels=num_levels)
        data = build(scenes.mesh_state(kind, materials, history=2).to_torch())
        assert {t: data[t].x.shape[1] for t in data.node_types} == build.spec.node_channels
        assert {r: data[r].odd.shape[1] for r in data.edge_types} == build.spec.odd_channels
        assert {r: data[r].even.shape[1] for r in data.edge_types} == build.spec.even_channels
        assert all(torch.isfinite(s.odd).all() and torch.isfinite(s.even).all() for s in data.edge_stores)
        for relation in build.spec.relations:
            index = data[relation].edge_index
            if index.shape[1]:
                assert index.min() >= 0
                assert index[0].max() < data[relation[0]].num_nodes
                assert index[1].max() < data[relation[2]].num_nodes


def masses(build: GraphBuilder, data: HeteroData) -> dict[str, torch.Tensor]:
    """Return the mass of every node; a virtual node has the mass of its children."""
    mass = {m: data[m].mass.double() for m in build.spec.materials}
    for level in range(1, build.spec.num_levels + 1):
        mass[grid(level)] = torch.zeros(data[grid(level)].num_nodes, dtype=DOUBLE)
        for relation in build.spec.relations:
            if relation[:2] == (grid(level), "down"):
                j, i = data[relation].edge_index
                mass[grid(level)].index_add_(0, j, mass[relation[2]][i])
    return mass


@pytest.mark.parametrize("kind", KINDS)
def test_virtual_nodes_are_the_mass_weighted_mean_of_their_children(kind: str) -> None:
    materials = ("elastomer", "solid")
    build = builder(materials, dim_of(kind), history=3)
    data = double(build, scenes.mesh_state(kind, materials, history=3))
    mass = masses(build, data)
    for level in range(1, build.spec.num_levels + 1):
        x = data[grid(level)].x
        assert (x[:, -1] == level).all()
        moment, offset, total = torch.zeros_like(x[:, :-1]), torch.zeros(len(x), build.spec.dim, dtype=DOUBLE), mass[grid(level)]
        for relation in build.spec.relations:
            if relation[:2] == (grid(level), "down"):
                (j, i), child = data[relation].edge_index, relation[2]
                channels = moment.shape[1]
                moment.index_add_(0, j, mass[child][i, None] * data[child].x[i, :channels])
                offset.index_add_(0, j, mass[child][i, None] * data[relation].odd[:, : build.spec.dim])
        torch.testing.assert_close(moment / total[:, None], x[:, :-1], rtol=1e-4, atol=1e-6)  # features are float32
        torch.testing.assert_close(offset / total[:, None], torch.zeros_like(offset), rtol=0, atol=1e-6)
    tops = sum(float(mass[grid(level)][children(build, data, level)].sum()) for level in range(1, build.spec.num_levels + 1))
    assert tops == pytest.approx(sum(float(mass[m].sum()) for m in materials))


def children(build: GraphBuilder, data: HeteroData, level: int) -> torch.Tensor:
    """Tell which virtual nodes of a level have no parent."""
    is_top = torch.ones(data[grid(level)].num_nodes, dtype=torch.bool)
    if level < build.spec.num_levels:
        is_top[data[grid(level + 1), "down", grid(level)].edge_index[1]] = False
    return is_top


@pytest.mark.parametrize("gap", [0.5, 1.5])
@pytest.mark.parametrize("materials", [("elastomer",), MIXED])
@pytest.mark.parametrize("kind", KINDS)
def test_contact_edges_are_near_pairs_of_different_bodies(kind: str, materials: tuple[str, ...], gap: float) -> None:
    build = builder(materials, dim_of(kind), trim_boundary=False)
    s = scenes.mesh_state(kind, materials, gap=gap, num_bodies=3)
    assert s.rest_pos is not None
    assert s.cells is not None
    radius, count = build.scales.radius, 0
    *_, body = by_loops(s.rest_pos, s.cells, 1)
    data = build(s.to_torch())
    for relation in build.spec.relations:
        source, name, target = relation
        if name != "radius" or BOUNDARY in relation:
            continue
        a, b = data[source].node_id.tolist(), data[target].node_id.tolist()
        expected = set()
        for j, i in itertools.product(a, b):
            if j != i and np.linalg.norm(s.pos[i] - s.pos[j]) <= radius:
                is_mesh = source == target != "sand"
                far_at_rest = np.linalg.norm(s.rest_pos[i] - s.rest_pos[j]) > 2 * radius
                if not is_mesh or body[i] != body[j] or far_at_rest:
                    expected.add(frozenset((j, i)))
        found = [frozenset((a[j], b[i])) for j, i in data[relation].edge_index.T.tolist()]
        assert len(set(found)) == len(found)
        assert set(found) == expected
        count += len(found) if "sand" not in relation else 0
    assert count > 3
    assert data[BOUNDARY, "radius", "elastomer"].edge_index.shape[1] > 0
    assert not [r for r in build.spec.relations if BOUNDARY in r and any("grid" in t for t in r)]


def test_a_folded_body_touches_itself_but_never_along_a_cell() -> None:
    """A strip of long cells bent into a ring, so that its ends meet."""
    count, width = 24, 0.06
    x = np.arange(count) * scenes.SPACING
    rest = np.concatenate([np.stack([x, np.zeros(count)], 1), np.stack([x, np.full(count, width)], 1)])
    cells = np.array([[k, k + 1, k + 1 + count, k + count] for k in range(count - 1)])
    far = np.array([[0, 10, 10 + count, count]])  # nodes of one cell, far apart at rest
    cells = np.concatenate([cells, far])
    angle = rest[:, 0] / x[-1] * 2 * np.pi * 0.97
    radius = 0.19 + rest[:, 1]
    pos = np.stack([0.5 + radius * np.cos(angle), 0.5 + radius * np.sin(angle)], axis=1)
    pos[10] = pos[0] + 0.01
    past = np.zeros((2 * count, 1, 2))
    s = replace(scenes.state(2 * count, ("elastomer",)), pos=pos, vel=past[:, 0], velocity_history=past, rest_pos=rest, cells=cells)
    build = builder()
    found = {frozenset(e) for e in build(s.to_torch())["elastomer", "radius", "elastomer"].edge_index.T.tolist()}
    near = {
        frozenset((a, b))
        for a, b in itertools.combinations(range(2 * count), 2)
        if np.linalg.norm(pos[a] - pos[b]) <= build.scales.radius and np.linalg.norm(rest[a] - rest[b]) > 2 * build.scales.radius
    }
    assert frozenset((0, count - 1)) in found
    assert frozenset((0, 10)) in near
    assert found == near - {frozenset((0, 10)), frozenset((0, 10 + count)), frozenset((count, 10)), frozenset((count, 10 + count))}


@pytest.mark.parametrize("kind", KINDS)
def test_swapping_all_nodes_flips_odd_channels_and_keeps_even_ones(kind: str) -> None:
    """Reversing the nodes reverses every cell edge; the same pair must then carry the opposite odd and equal even channels."""
    build = builder(dim=dim_of(kind))
    s = scenes.mesh_state(kind)
    n = s.num_nodes
    a, b = build(s.to_torch()), build(scenes.permuted(s, np.arange(n)[::-1]).to_torch())
    store, other = (g["elastomer", "cell", "elastomer"] for g in (a, b))
    reverse = {(n - 1 - i, n - 1 - j): k for k, (j, i) in enumerate(other.edge_index.T.tolist())}
    order = [reverse[j, i] for j, i in store.edge_index.T.tolist()]
    assert torch.equal(store.odd, -other.odd[order])
    assert torch.equal(store.even, other.even[order])


def test_a_body_at_rest_is_unstretched_however_it_is_turned() -> None:
    build = builder()
    s = scenes.mesh_state()
    assert s.rest_pos is not None
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    rigid = replace(s, pos=s.rest_pos @ turn.T, vel=0 * s.vel, velocity_history=0 * s.velocity_history)  # type: ignore[operator]
    stretched = replace(rigid, pos=1.1 * rigid.pos)
    for state, strain in ((rigid, 0.0), (stretched, 0.1)):
        data = build(state.to_torch())
        for relation in build.spec.relations:
            if relation[1] != "radius" and data[relation].num_edges:
                stretch, approach, rest_length = data[relation].even[:, :3].T
                torch.testing.assert_close(stretch, strain * rest_length, rtol=1e-4, atol=1e-6)
                assert (approach == 0).all()
                torch.testing.assert_close(data[relation].odd[:, -2:].norm(dim=1), stretch.abs(), rtol=1e-4, atol=1e-6)


def test_levels_of_a_uniformly_strained_lattice_look_alike() -> None:
    """All levels can share weights: in units of its width, each level of a stretched and turning body has the same features."""
    size = 16
    points, number = np.argwhere(np.ones((size, size))) * scenes.SPACING, np.arange(size**2).reshape(size, size)
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    pos = points * np.array([1.1, 0.9])
    spin = np.stack([-pos[:, 1], pos[:, 0]], axis=1)[:, None]
    s = replace(scenes.state(size**2, ("elastomer",), walls=False), pos=pos, vel=spin[:, 0], velocity_history=spin, rest_pos=points)
    data = builder(num_levels=4)(replace(s, cells=cells, mass=np.ones(size**2)).to_torch())
    looks = [{tuple(np.round(e, 4)) for e in np.concatenate([s.odd, s.even[:, :3]], 1).tolist()} for s in same_stores(data, 3)]
    assert looks[0] == looks[1] == looks[2]


def same_stores(data: HeteroData, levels: int) -> list[Any]:
    return [data[grid(k), "same", grid(k)] for k in range(1, levels + 1)]


# --- GPE on it ------------------------------------------------------------------------------------------------------------------------------

VARIANTS: dict[str, dict[str, Any]] = {
    **{i: {"interaction": i} for i in ("directed", "negated", "odd", "odd_even")},
    "pair": {"decoder": "pair", "interaction": "odd"},
    "contact": {"decoder": "contact", "island_momentum": "linear"},
    "geometry": {"edge_state": "geometry"},
    "separate": {"level_weights": "separate"},
    "separate-odd": {"level_weights": "separate", "interaction": "odd"},
}


USUAL = {"negated", "pair", "contact", "geometry", "separate-odd"}
"""Variants of the fast tests; the others run with the slow tests."""


@pytest.fixture(params=[pytest.param(name, marks=() if name in USUAL else pytest.mark.slow) for name in VARIANTS])
def settings(request: pytest.FixtureRequest) -> dict[str, Any]:
    return VARIANTS[request.param]


@pytest.mark.slow
def test_relabelling_the_nodes_relabels_the_output(settings: dict[str, Any]) -> None:
    build = builder(BOTH)
    model = model_of(build, **settings)
    s, lattice = (scenes.mesh_state(kind, BOTH) for kind in ("triangles", "lattice"))
    assert lattice.rest_pos is not None
    for state in (s, lattice, replace(lattice, pos=lattice.rest_pos)):  # at rest, the rows of a lattice are exactly in line
        order = np.random.default_rng(1).permutation(state.num_nodes)
        y = accelerations(model, double(build, state), state.num_nodes)
        z = accelerations(model, double(build, scenes.permuted(state, order)), state.num_nodes)
        assert (z - y[order]).norm() <= 1e-12 * y.norm()


def test_edge_orientation_and_order_do_not_matter(settings: dict[str, Any]) -> None:
    build = builder(BOTH)
    s = scenes.mesh_state("triangles", BOTH)
    data = double(build, s)
    model = model_of(build, **settings)
    flipped = data.clone()
    generator = torch.Generator().manual_seed(0)
    for relation in build.spec.relations:
        store = flipped[relation]
        if is_symmetric(relation):
            turn = torch.rand(store.num_edges, generator=generator) < 0.5
            store.edge_index = torch.where(turn, store.edge_index.flip(0), store.edge_index)
            store.odd = torch.where(turn[:, None], -store.odd, store.odd)
        order = torch.randperm(store.num_edges, generator=generator)
        store.edge_index, store.odd, store.even = store.edge_index[:, order], store.odd[order], store.even[order]
    y, z = accelerations(model, data, s.num_nodes), accelerations(model, flipped, s.num_nodes)
    assert (z - y).norm() <= 1e-12 * y.norm()


def test_translation_changes_nothing(settings: dict[str, Any]) -> None:
    build = builder(BOTH)
    s = scenes.mesh_state("lattice", BOTH).to_torch()
    offset = torch.tensor([3.0, -2.0], dtype=DOUBLE)
    moved = replace(s, pos=s.pos + offset, boundary=replace(s.boundary, pos=s.boundary.pos + offset))
    model = model_of(build, **settings)
    y, z = (accelerations(model, scenes.to_dtype(build(state), DOUBLE), s.num_nodes) for state in (s, moved))
    assert (z - y).norm() <= 1e-5 * y.norm()  # features are float32


@pytest.mark.slow
def test_batch_equals_singles_with_and_without_meshes(settings: dict[str, Any]) -> None:
    build = builder(BOTH)
    states = [
        scenes.mesh_state("triangles", BOTH, seed=1),
        scenes.mesh_state("triangles", BOTH, num_bodies=1, seed=2),
        scenes.state(12, BOTH, seed=3),
        replace(scenes.state(10, ("sand",), seed=4), material_params=np.ones((10, 2))),
        replace(scenes.mesh_state("lattice", num_bodies=1, seed=5, walls=False)),
    ]
    states[4] = replace(states[4], material_params=np.repeat(states[4].material_params, 2, axis=1))
    graphs = [double(build, s) for s in states]
    model = model_of(build, **settings)
    singles = [model(g).acceleration for g in graphs]
    for order in ((0, 1, 2, 3, 4), (3, 2, 0, 4, 1), (2, 4, 3, 1, 0)):
        batch = Batch.from_data_list([graphs[k] for k in order])
        for material, value in model(batch).acceleration.items():
            for position, k in enumerate(order):
                expected = singles[k].get(material, torch.empty(0, 2, dtype=DOUBLE))
                torch.testing.assert_close(value[batch[material].batch == position], expected, rtol=1e-11, atol=1e-12)


def test_trained_with_four_levels_runs_with_six() -> None:
    """Weights and statistics of all levels are one set, so they load into a model of deeper bodies; the same body gives the same result."""
    four, six = builder(num_levels=4), builder(num_levels=6)
    model, deeper = (model_of(b, num_message_passing_steps=6) for b in (four, six))
    deeper.load_state_dict(model.state_dict())
    standardizer, deep_standardizer = GraphStandardizer(four.spec).double(), GraphStandardizer(six.spec).double()
    shallow = scenes.mesh_state("lattice")
    standardizer.fit([double(four, shallow)])
    deep_standardizer.load_state_dict(standardizer.state_dict())
    y = accelerations(model, standardizer(double(four, shallow)), shallow.num_nodes)
    z = accelerations(deeper, deep_standardizer(double(six, shallow)), shallow.num_nodes)
    assert torch.equal(y, z)

    count = 50
    x = np.arange(count) * scenes.SPACING
    strip = np.concatenate([np.stack([x, np.zeros(count)], 1), np.stack([x, np.full(count, scenes.SPACING)], 1)])
    cells = np.array([[k, k + 1, k + 1 + count, k + count] for k in range(count - 1)])
    s = replace(scenes.state(2 * count, ("elastomer",), walls=False), pos=strip, rest_pos=strip, cells=cells)
    assert [len(double(b, s)[grid(b.spec.num_levels)].x) for b in (four, six)] == [4, 1]
    out = accelerations(deeper, deep_standardizer(double(six, s)), s.num_nodes)
    assert torch.isfinite(out).all()
    one, two = (model_of(builder(num_levels=k), level_weights="separate") for k in (1, 2))
    with pytest.raises(RuntimeError, match="Missing key"):
        two.load_state_dict(one.state_dict())


def test_reach_of_a_step() -> None:
    """Pulling one end of a strip is felt at the other after as many steps as it takes to climb and come down."""
    count = 32
    x = np.arange(count) * scenes.SPACING
    line = np.stack([x, 0 * x], 1)
    s = replace(
        scenes.state(count, ("elastomer",), walls=False),
        pos=line,
        rest_pos=line,
        cells=np.stack([np.arange(count - 1), np.arange(1, count)], 1),
    )
    build = builder(num_levels=5)
    data = double(build, s)
    pulled = data.clone()
    pulled["elastomer"].x[0] += 1.0
    needed = 9  # four levels up, one edge across, four levels down: the root is not needed
    for steps in (1, needed - 1, needed):
        model = model_of(build, num_message_passing_steps=steps)
        change = accelerations(model, pulled, count) - accelerations(model, data, count)
        assert bool(change[-1].abs().max() > 0) == (steps == needed)


def test_pair_forces_of_a_free_body_sum_to_zero() -> None:
    build = builder()
    s = scenes.mesh_state(walls=False, gap=0.5)
    for interaction in ("directed", "negated", "odd", "odd_even"):
        data = double(build, s)
        assert data["elastomer", "radius", "elastomer"].num_edges > 0
        force = model_of(build, decoder="pair", interaction=interaction)(data).acceleration["elastomer"] * data["elastomer"].mass[:, None]
        assert force.norm(dim=1).sum() > 1e-3
        assert force.sum(dim=0).norm() / force.norm(dim=1).sum() < 1e-14


def test_every_parameter_is_used(settings: dict[str, Any]) -> None:
    build = builder(BOTH, num_levels=2)
    model = model_of(build, **settings)
    prediction = model(double(build, scenes.mesh_state("triangles", BOTH, gap=0.5)))
    torch.stack([v.square().sum() for v in prediction.acceleration.values()]).sum().backward()
    unused = [n for n, p in model.named_parameters() if p.grad is None]
    assert all(n.startswith("updates.1.") for n in unused), unused
    assert not unused or settings.get("decoder") == "pair" or settings.get("interaction") == "odd_even", unused


def test_particles_run_no_code_of_meshes() -> None:
    build = builder(BOTH)
    model = model_of(build)
    called: list[str] = []
    for name, module in model.named_modules():
        if "grid" in name or "cell" in name:
            module.register_forward_hook(lambda *_, n=name: called.append(n))
    model(double(build, replace(scenes.state(20), material_params=np.ones((20, 2)))))
    assert called == []
    model(double(build, scenes.mesh_state("lattice", BOTH)))
    assert called != []


@pytest.mark.slow
def test_degenerate_meshes_are_finite_with_finite_gradients(settings: dict[str, Any]) -> None:
    build = builder(BOTH)
    s = scenes.mesh_state("triangles", BOTH)
    assert s.cells is not None
    collapsed = s.pos.copy()
    collapsed[s.cells[0]] = collapsed[s.cells[0, 0]]
    for state in (replace(s, pos=collapsed), replace(s, pos=0 * s.pos), replace(s, cells=s.cells[:1]), replace(s, cells=s.cells[:0])):
        data = double(build, state)
        model = model_of(build, **settings)
        out = model(data).acceleration["elastomer"]
        assert torch.isfinite(out).all()
        out.square().sum().backward()
        assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)
