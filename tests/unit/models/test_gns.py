"""GNS compared with its equations, written out with concatenation and a loop over directed edges, and with the sizes of published models."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.models.gns import GNS
from gpe_pl.schema import BOUNDARY, FeatureSpec
from tests import meshes, scenes

DOUBLE = torch.float64


def published(model: Any, data: HeteroData) -> dict[str, Tensor]:
    """Compute the model edge by edge. Columns of a node: material | boundary | virtual | parameters; of an edge: one block per relation, then the length."""
    spec: FeatureSpec = model.spec
    kinds = [*spec.materials, BOUNDARY, *(["grid"] if spec.num_levels else [])]
    h: dict[tuple[str, int], Tensor] = {}
    for t in spec.node_types:
        kind = "grid" if t.startswith("grid") else t
        for k, x in enumerate(data[t].x):
            block = "material" if t in spec.materials else kind
            parts = [x if block == b else torch.zeros(width) for b, width in blocks(spec).items()]
            parts += [data[m].material_params[k] if m == t else torch.zeros(spec.param_channels[m]) for m in spec.materials]
            h[t, k] = model.node_encoder(torch.cat([*parts, model.type_embedding.weight[kinds.index(kind)]]))

    edges = []
    for relation in spec.relations:
        source, name, target = relation
        store = data[relation]
        for n, (j, i) in enumerate(store.edge_index.T.tolist()):
            for sender, receiver, odd in (((source, j), (target, i), store.odd[n]), ((target, i), (source, j), -store.odd[n])):
                parts = []
                for other, (odd_width, even_width) in relation_blocks(spec).items():
                    parts += [odd, store.even[n]] if other == name else [torch.zeros(odd_width), torch.zeros(even_width)]
                length = odd[: spec.dim].square().sum().sqrt()
                edges.append((sender, receiver, model.edge_encoder(torch.cat([*parts, length[None]]))))

    for step in model.processor:
        mlp = nn.Sequential(step.edge_in.linear, *step.edge_out)
        messages = [mlp(torch.cat([e, h[receiver], h[sender]])) for sender, receiver, e in edges]
        total = {node: torch.zeros_like(value) for node, value in h.items()}
        for (_, receiver, _), message in zip(edges, messages, strict=True):
            total[receiver] = total[receiver] + message
        edges = [(sender, receiver, e + m) for (sender, receiver, e), m in zip(edges, messages, strict=True)]
        h = {node: value + step.node(torch.cat([value, total[node]])) for node, value in h.items()}
    return {m: torch.stack([model.decoder(h[m, k]) for k in range(len(data[m].x))]) for m in spec.materials if len(data[m].x)}


def blocks(spec: FeatureSpec) -> dict[str, int]:
    widths = {"material": spec.node_channels[spec.materials[0]], BOUNDARY: spec.node_channels[BOUNDARY]}
    return widths | ({"grid": spec.node_channels["grid_1"]} if spec.num_levels else {})


def relation_blocks(spec: FeatureSpec) -> dict[str, tuple[int, int]]:
    return {name: (spec.odd_channels[r], spec.even_channels[r]) for r in spec.relations for name in [r[1]]}


@pytest.mark.parametrize("features", ["paper", "contact"])
@pytest.mark.parametrize("num_hidden_layers", [1, 2])
def test_equals_its_equations(features: str, num_hidden_layers: int) -> None:
    build = scenes.builder(("sand", "snow"), features=features)
    torch.manual_seed(0)
    model = GNS(build.spec, num_message_passing_steps=3, hidden_channels=8, num_hidden_layers=num_hidden_layers).double()
    data = scenes.to_dtype(build(scenes.state(20, ("sand", "snow")).to_torch()), DOUBLE)
    out, expected = model(data).acceleration, published(model, data)
    assert set(out) == set(expected) == {"sand", "snow"}
    for material, value in expected.items():
        torch.testing.assert_close(out[material], value, rtol=1e-10, atol=1e-12)


def test_takes_meshes_as_one_graph() -> None:
    torch.manual_seed(0)
    model = GNS(meshes.spec(2), num_message_passing_steps=3, hidden_channels=8).double()
    data = meshes.graph(2)
    torch.testing.assert_close(model(data).acceleration["solid"], published(model, data)["solid"], rtol=1e-10, atol=1e-12)


def sizes_of(dim: int, motion: int, edge: int) -> FeatureSpec:
    """Return a graph whose inputs are as wide as those of a published model; all columns but one are the material's."""
    relations = (("fluid", "radius", "fluid"),)
    return FeatureSpec(
        dim, ("fluid",), {"fluid": motion - 1, BOUNDARY: 1}, {"fluid": ()}, relations, {relations[0]: edge}, {relations[0]: 0}
    )


def count(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(("steps", "width", "thousands"), [(5, 64, 161), (10, 128, 1212)])
def test_number_of_parameters_is_that_of_lagrangebench(steps: int, width: int, thousands: int) -> None:
    """GNS-5-64 has 161K and GNS-10-128 1.2M parameters [Toshev et al. 2023, "LagrangeBench", table of baselines].

    Inputs in 2D: 5 velocities, a type embedding of 16, edges with displacement and distance; one hidden layer per MLP. It knows 9 types, here are 2.
    """
    model = GNS(sizes_of(dim=2, motion=10, edge=2), steps, width, num_hidden_layers=1)
    assert round((count(model) + 7 * 16) / 1000) == thousands


def test_number_of_parameters_is_that_of_the_paper() -> None:
    """10 steps of width 128 with two hidden layers: counted from the text of section 4 and supplement B, in 3D with 5 velocities."""

    def mlp(channels: int, out: int = 128, norm: bool = True) -> int:
        return (channels + 1) * 128 + (128 + 1) * 128 + (128 + 1) * out + (2 * out if norm else 0)

    model = GNS(sizes_of(dim=3, motion=15, edge=3))
    expected = 2 * 16 + mlp(15 + 16) + mlp(3 + 1) + 10 * (mlp(3 * 128) + mlp(2 * 128)) + mlp(128, out=3, norm=False)
    assert count(model) == expected
    mlps = [model.node_encoder, model.edge_encoder, *(m for step in model.processor for m in (step.edge_out, step.node))]  # type: ignore[union-attr]
    assert all(isinstance(m[-1], nn.LayerNorm) for m in mlps) and isinstance(model.decoder[-1], nn.Linear)  # type: ignore[index]


def test_steps_are_residual() -> None:
    """With the processor's LayerNorms at zero, the steps add nothing: the decoder gets the encoder's output."""
    build = scenes.builder()
    data = scenes.to_dtype(build(scenes.state().to_torch()), DOUBLE)
    torch.manual_seed(0)
    model: Any = GNS(build.spec, 3, 8).double()
    for step in model.processor:
        for norm in (step.edge_out[-1], step.node[-1]):
            nn.init.zeros_(norm.weight)
    features, kind = model.graph.nodes({"sand": data["sand"].x}, {"sand": data["sand"].material_params})
    encoded = model.node_encoder(torch.cat([features, model.type_embedding(kind)], dim=1))
    torch.testing.assert_close(model(data).acceleration["sand"], model.decoder(encoded))


def test_tells_types_apart() -> None:
    """Two lone particles with equal features but of different material accelerate differently, because of the embedding alone."""
    build = scenes.builder(("sand", "snow"))
    data = scenes.to_dtype(build(scenes.state(2, ("sand", "snow"), walls=False).to_torch()), DOUBLE)
    for store in data.edge_stores:
        store.edge_index, store.odd, store.even = store.edge_index[:, :0], store.odd[:0], store.even[:0]
    data["snow"].x = data["sand"].x.clone()
    for m in ("sand", "snow"):
        data[m].material_params = torch.zeros(1, 1, dtype=DOUBLE)
    torch.manual_seed(0)
    model = GNS(build.spec, 2, 8).double()
    out = model(data).acceleration
    assert (out["sand"] - out["snow"]).norm() > 1e-3
    nn.init.ones_(model.type_embedding.weight)
    out = model(data).acceleration
    torch.testing.assert_close(out["sand"], out["snow"])
