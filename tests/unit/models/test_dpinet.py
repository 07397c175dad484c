"""DPI-Net compared with its propagation, written out with concatenation and loops over nodes and edges, and with the published sizes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch_geometric.data import Batch, HeteroData

from gpe_pl.models.dpinet import DPINet
from gpe_pl.schema import BOUNDARY, CELL, DOWN, RADIUS, SAME, FeatureSpec, grid
from tests import meshes, scenes

DOUBLE = torch.float64
Node = tuple[str, int]


def published(model: Any, data: HeteroData) -> Tensor:
    """Compute accelerations of one material's nodes by stages: leaves, then up and same per level, then down per level from the top."""
    spec: FeatureSpec = model.spec
    (material,) = spec.materials
    levels = range(1, spec.num_levels + 1)
    x = {(t, k): inputs(spec, data, t, k) for t in spec.node_types for k in range(len(data[t].x))}
    h = {node: torch.zeros(model.hidden_channels, dtype=DOUBLE) for node in x}

    def directed(names: tuple[str, ...], towards: str) -> list[tuple[Node, Node, Tensor]]:
        """Return (sender, receiver, relation) of the edges with these names whose receiver has this type."""
        found = []
        for relation in spec.relations:
            source, name, target = relation
            store = data[relation]
            for n, (j, i) in enumerate(store.edge_index.T.tolist()):
                for sender, receiver, sign in (((source, j), (target, i), 1), ((target, i), (source, j), -1)):
                    if name in names and receiver[0] == towards:
                        found.append((sender, receiver, relation_inputs(spec, name, sign * store.odd[n], store.even[n])))
        return found

    def stage(name: str, edges: list[tuple[Node, Node, Tensor]], towards: str, num_steps: int) -> None:
        net = model.stages[name]
        encode = nn.Sequential(net.relation_encoder_in.linear, *net.relation_encoder_out)
        codes = [encode(torch.cat([relation, x[receiver], x[sender]])) for sender, receiver, relation in edges]
        for _ in range(num_steps):
            total = {node: torch.zeros_like(h[node]) for node in x if node[0] == towards}
            for (sender, receiver, _), code in zip(edges, codes, strict=True):
                total[receiver] += torch.relu(net.relation_propagator.linear(torch.cat([code, h[receiver], h[sender]])))
            for node, effect in total.items():
                h[node] = torch.relu(net.particle_propagator(torch.cat([net.particle_encoder(x[node]), effect])) + h[node])

    stage("leaves", directed((RADIUS, CELL), material), material, model.num_propagation_steps)
    for level in levels:
        children = material if level == 1 else grid(level - 1)
        edges = [(s, r, f) for s, r, f in directed((DOWN,), grid(level)) if s[0] == children]
        stage("up", edges, grid(level), 1)
        stage("same", directed((SAME,), grid(level)), grid(level), model.num_propagation_steps)
    for level in reversed(levels):
        children = material if level == 1 else grid(level - 1)
        stage("down", [(s, r, f) for s, r, f in directed((DOWN,), children) if s[0] == grid(level)], children, 1)
    return torch.stack([model.predictor(h[material, k]) for k in range(len(data[material].x))])


def inputs(spec: FeatureSpec, data: HeteroData, t: str, k: int) -> Tensor:
    """Return input columns: material | boundary | virtual | parameter | one-hot type."""
    kind = "grid" if t.startswith("grid") else t
    (material,) = spec.materials
    widths = {material: spec.node_channels[material], BOUNDARY: spec.node_channels[BOUNDARY]}
    if spec.num_levels:
        widths["grid"] = spec.node_channels["grid_1"]
    parts = [data[t].x[k] if kind == name else torch.zeros(width) for name, width in widths.items()]
    parts.append(data[t].material_params[k] if t == material else torch.zeros(spec.param_channels[material]))
    return torch.cat([*parts, torch.tensor([float(kind == name) for name in widths], dtype=DOUBLE)])


def relation_inputs(spec: FeatureSpec, name: str, odd: Tensor, even: Tensor) -> Tensor:
    widths = {r[1]: (spec.odd_channels[r], spec.even_channels[r]) for r in spec.relations}
    parts: list[Tensor] = []
    for other, (odd_width, even_width) in widths.items():
        parts += [odd, even] if other == name else [torch.zeros(odd_width), torch.zeros(even_width)]
    return torch.cat(parts)


@pytest.mark.parametrize("num_levels", [0, 1, 3])
@pytest.mark.parametrize("num_steps", [1, 2])
def test_equals_the_published_stages(num_levels: int, num_steps: int) -> None:
    torch.manual_seed(0)
    model = DPINet(meshes.spec(num_levels), num_steps, hidden_channels=8).double()
    data = meshes.graph(num_levels)
    out = model(data).acceleration["solid"]
    torch.testing.assert_close(out, published(model, data), rtol=1e-10, atol=1e-12)
    assert len(out.unique(dim=0)) == meshes.NUM_NODES


def test_equals_the_published_stage_on_particles() -> None:
    build = scenes.builder()
    torch.manual_seed(0)
    model = DPINet(build.spec, hidden_channels=8).double()
    data = scenes.to_dtype(build(scenes.state(25).to_torch()), DOUBLE)
    torch.testing.assert_close(model(data).acceleration["sand"], published(model, data), rtol=1e-10, atol=1e-12)


def test_number_of_parameters_is_that_of_the_published_network() -> None:
    """FluidFall: state of 6, attribute of 1 and its offset of 6, relation of 1, widths 200, 300 and 200, without the predictor for rigid bodies."""

    def linear(channels: int, out: int) -> int:
        return (channels + 1) * out

    relations = (("fluid", "radius", "fluid"),)
    spec = FeatureSpec(3, ("fluid",), {"fluid": 10, BOUNDARY: 1}, {"fluid": ()}, relations, {relations[0]: 1}, {relations[0]: 0})
    model = DPINet(spec)
    attribute, state, relation = 1 + 6, 6, 1
    assert model.graph.node_channels + model.graph.num_kinds == attribute + state
    particle_encoder = linear(attribute + state, 200) + linear(200, 200)
    relation_encoder = linear(2 * attribute + 2 * state + relation, 300) + 2 * linear(300, 300)
    propagators = linear(300 + 2 * 200, 200) + linear(2 * 200, 200)
    predictor = 2 * linear(200, 200) + linear(200, 3)
    assert sum(p.numel() for p in model.parameters()) == particle_encoder + relation_encoder + propagators + predictor


def influence(model: Any, num_levels: int) -> list[bool]:
    """Tell which mesh nodes a change at node 0 affects."""
    data = meshes.graph(num_levels)
    data["solid", RADIUS, "solid"].edge_index = torch.empty(2, 0, dtype=torch.int64)
    before = model(data).acceleration["solid"]
    data["solid"].x[0] += 1.0
    return ((model(data).acceleration["solid"] - before).norm(dim=1) > 1e-12).tolist()


@pytest.mark.parametrize("num_steps", [1, 2, 3])
def test_leaves_reach_as_far_as_they_step(num_steps: int) -> None:
    """The first step carries the sender's input one edge, each further step its effect another."""
    torch.manual_seed(0)
    model = DPINet(meshes.spec(0), num_steps, hidden_channels=32).double()
    assert influence(model, 0) == [k <= num_steps for k in range(meshes.NUM_NODES)]


def test_a_scene_of_fewer_levels_is_computed_as_alone() -> None:
    """Its roots have no parent at the levels that only another scene of the batch has."""
    torch.manual_seed(0)
    model = DPINet(meshes.spec(3), hidden_channels=8).double()
    tall, low = meshes.graph(3), meshes.graph(3, seed=1)
    top = grid(3)
    low[top].x = low[top].x[:0]
    low[top, DOWN, grid(2)].edge_index = torch.empty(2, 0, dtype=torch.int64)
    for name in ("odd", "even"):
        low[top, DOWN, grid(2)][name] = low[top, DOWN, grid(2)][name][:0]
    together = model(Batch.from_data_list([tall, low])).acceleration["solid"]
    alone = torch.cat([model(data).acceleration["solid"] for data in (tall, low)])
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=1e-12)


def test_hierarchy_couples_the_whole_body() -> None:
    torch.manual_seed(0)
    model = DPINet(meshes.spec(3), 1, hidden_channels=32).double()
    assert all(influence(model, 3))


def test_boundary_sends_and_does_not_receive() -> None:
    """A boundary node changes its neighbours by its own features only; two nodes that share it do not feel each other through it."""
    torch.manual_seed(0)
    model = DPINet(meshes.spec(0), 3, hidden_channels=32).double()
    data = meshes.graph(0)
    for relation in (("solid", RADIUS, "solid"), ("solid", CELL, "solid")):
        data[relation].edge_index = torch.empty(2, 0, dtype=torch.int64)
    before = model(data).acceleration["solid"]
    data["solid"].x[0] += 1.0
    after = model(data).acceleration["solid"]
    assert (after[0] - before[0]).norm() > 1e-6 and torch.equal(after[1:], before[1:])
    data[BOUNDARY].x[0] += 1.0  # neighbour of nodes 0 and 1
    last = model(data).acceleration["solid"]
    assert ((last - after).norm(dim=1) > 1e-6).tolist() == [True, True, *[False] * 6]


def test_weights_serve_deeper_meshes() -> None:
    torch.manual_seed(0)
    model = DPINet(meshes.spec(1), hidden_channels=8).double()
    deeper = DPINet(meshes.spec(3), hidden_channels=8).double()
    deeper.load_state_dict(model.state_dict())
    data = meshes.graph(3)
    torch.testing.assert_close(deeper(data).acceleration["solid"], published(deeper, data), rtol=1e-10, atol=1e-12)
