"""The network of continuous convolutions compared with its layers, written out edge by edge, and with the published sizes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.standardizer import GraphStandardizer
from gpe_pl.models.cconv import ContinuousConvNet, NotAParticleGraphError
from gpe_pl.nn.continuous_conv import interpolate
from gpe_pl.schema import BOUNDARY, FeatureSpec
from tests import meshes, scenes

DOUBLE = torch.float64
Edge = tuple[int, int, Tensor]


def convolve(conv: Any, features: Tensor, edges: list[Edge], num_targets: int, kernel_size: int) -> Tensor:
    """Convolve with one filter matrix per edge (source, target, (x_source − x_target) / R)."""
    out = [conv.bias for _ in range(num_targets)]
    for j, i, u in edges:
        cells, weights = interpolate(u[None], kernel_size)
        out[i] = out[i] + features[j] @ (weights[0, :, None, None] * conv.weight[cells[0]]).sum(dim=0)
    return torch.stack(out)


def published(model: Any, data: HeteroData) -> Tensor:
    """Compute the paper's network for particles of one or two materials, first those of the first."""
    spec: FeatureSpec = model.spec
    rows = {m: len(data[m].x) for m in spec.materials}
    first = dict(zip(spec.materials, [0, *rows.values()], strict=False))
    features = []
    for m in spec.materials:
        for k in range(rows[m]):
            params = [data[m].material_params[k] if m == other else torch.zeros(1) for other in spec.materials]
            features.append(torch.cat([data[m].x[k], *params, torch.tensor([float(m == other) for other in spec.materials])]))
    inside: list[Edge] = []
    outside: list[Edge] = []
    for relation in spec.relations:
        source, _, target = relation
        for (j, i), u in zip(data[relation].edge_index.T.tolist(), data[relation].offset, strict=True):
            if source == BOUNDARY:
                outside.append((j, i + first[target], -u))
            else:
                a, b = j + first[source], i + first[target]
                inside += [(a, b, -u), (b, a, u)]

    f, n, size = torch.stack(features), len(features), model.kernel_size
    g = torch.cat([data[BOUNDARY].x, torch.ones(len(data[BOUNDARY].x), 1, dtype=DOUBLE)], dim=1)
    parts = [convolve(model.conv_boundary, g, outside, n, size), convolve(model.conv_particles, f, inside, n, size)]
    f = torch.cat([*parts, model.dense_particles(f)], dim=1)
    for conv, dense in zip(model.convs, model.denses, strict=True):
        active = torch.relu(f)
        out = convolve(conv, active, inside, n, size) + dense(active)
        f = out + f if out.shape[1] == f.shape[1] else out
    return f


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("materials", [("sand",), ("sand", "snow")])
def test_equals_the_published_layers(materials: tuple[str, ...], dim: int) -> None:
    build = scenes.builder(materials, dim)
    torch.manual_seed(0)
    model = ContinuousConvNet(build.spec, num_convolutions=5, hidden_channels=8).double()  # two layers keep their width: residual
    data = scenes.to_dtype(build(scenes.state(12, materials, dim=dim, high=0.25).to_torch()), DOUBLE)
    assert sum(data[r].edge_index.shape[1] for r in build.spec.relations if r[0] == BOUNDARY) > 0
    out = torch.cat([model(data).acceleration[m] for m in materials])
    torch.testing.assert_close(out, published(model, data), rtol=1e-10, atol=1e-12)


def test_layers_are_those_of_the_paper() -> None:
    """3D, inputs 1 and velocity, boundary normals and 1, filters of 4³ points: 32 + 32 + 32, 64, 64 and 3 channels."""

    def conv(channels: int, out: int) -> int:
        return 4**3 * channels * out + out

    def dense(channels: int, out: int) -> int:
        return channels * out + out

    relations = (("fluid", "radius", "fluid"), (BOUNDARY, "radius", "fluid"))
    spec = FeatureSpec(
        3, ("fluid",), {"fluid": 3, BOUNDARY: 3}, {"fluid": ()}, relations, dict.fromkeys(relations, 3), dict.fromkeys(relations, 0)
    )
    first = conv(4, 32) + conv(3 + 1, 32) + dense(4, 32)
    others = sum(conv(a, b) + dense(a, b) for a, b in ((96, 64), (64, 64), (64, 3)))
    assert sum(p.numel() for p in ContinuousConvNet(spec).parameters()) == first + others


def test_a_lone_particle_passes_the_dense_layers_only() -> None:
    build = scenes.builder()
    data = scenes.to_dtype(build(scenes.state(1, walls=False).to_torch()), DOUBLE)
    torch.manual_seed(0)
    model: Any = ContinuousConvNet(build.spec, hidden_channels=8).double()
    for conv in (model.conv_boundary, model.conv_particles, *model.convs):
        torch.nn.init.normal_(conv.weight)
    f = torch.cat([data["sand"].x, data["sand"].material_params, torch.ones(1, 1, dtype=DOUBLE)], dim=1)
    f = torch.cat([torch.zeros(1, 8, dtype=DOUBLE), model.dense_particles(f)], dim=1)
    g = model.denses[0](torch.relu(f))
    g = g + model.denses[1](torch.relu(g))
    torch.testing.assert_close(model(data).acceleration["sand"], model.denses[2](torch.relu(g)))


def test_uses_nothing_of_edges_but_where_the_neighbour_is() -> None:
    build = scenes.builder()
    data = scenes.to_dtype(build(scenes.state().to_torch()), DOUBLE)
    model = ContinuousConvNet(build.spec, hidden_channels=8).double()
    before = model(data).acceleration["sand"]
    for store in data.edge_stores:
        store.odd, store.even = 2 * store.odd, 2 * store.even
    assert torch.equal(model(data).acceleration["sand"], before)
    for store in data.edge_stores:
        store.offset = 0.5 * store.offset
    assert (model(data).acceleration["sand"] - before).norm() > 1e-3


@pytest.mark.parametrize("features", ["paper", "contact"])
def test_offset_is_the_displacement_over_the_radius(features: str) -> None:
    """This also holds after standardisation, and with any other edge features."""
    build = scenes.builder(features=features)
    s = scenes.state()
    data = build(s.to_torch())
    standardizer = GraphStandardizer(build.spec)
    standardizer.fit([data])
    store = standardizer(data)["sand", "radius", "sand"]
    j, i = store.edge_index.numpy()
    expected = torch.tensor(s.pos[i] - s.pos[j]) / build.scales.radius
    torch.testing.assert_close(store.offset.double(), expected, rtol=1e-6, atol=1e-7)
    assert store.offset.norm(dim=1).max() <= 1


def test_refuses_meshes() -> None:
    with pytest.raises(NotAParticleGraphError, match="cell, down, same: set graph.mesh=false"):
        ContinuousConvNet(meshes.spec(2))
