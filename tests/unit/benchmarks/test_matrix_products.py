"""The formula of matrix products equals what PyTorch counts, for every variant of GPE."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.matrix_products import products
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.fused import unfused
from gpe_pl.schema import is_symmetric
from tests import meshes, scenes

VARIANTS: list[dict[str, Any]] = [
    *(
        {"interaction": interaction, "edge_state": state}
        for interaction in ("directed", "negated", "odd", "odd_even")
        for state in ("latent", "geometry")
    ),
    {"decoder": "pair"},
    {"decoder": "pair", "interaction": "odd"},
    {"material_embedding": "mlp", "node_norm": "layer"},
    {"material_embedding": "none", "num_message_passing_steps": 1},
    {"level_weights": "separate"},
    {"level_weights": "separate", "interaction": "directed"},
]


def counted(model: GPE, graph: HeteroData) -> int:
    """Count the operations of products as PyTorch does, without leaving out nodes that have no edge."""
    with unfused(), torch.inference_mode(), FlopCounterMode(display=False) as counter:
        model.train()(graph)
    return int(counter.get_total_flops()) + in_place(model, graph)


def in_place(model: GPE, graph: HeteroData) -> int:
    """Return the operations of products of even features, which PyTorch does not count because they are in place."""
    if model.interaction not in ("odd", "odd_even"):
        return 0
    layers = [r for convs in model.convs for r in model.spec.relations if is_symmetric(r) and model.key(r) in cast(Any, convs)]
    return sum(2 * graph[r].edge_index.shape[1] * model.spec.even_channels[r] * model.settings["hidden_channels"] for r in layers)


def of(spec: Any, **variant: Any) -> GPE:
    return GPE(spec, **{"num_message_passing_steps": 3, "hidden_channels": 8, **variant})


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_of_particles_and_meshes(variant: dict[str, Any]) -> None:
    particles = of(scenes.builder(("sand", "snow")).spec, **variant), scenes.graph(("sand", "snow"), torch.float32)
    mesh = of(meshes.spec(3), **variant), scenes.to_dtype(meshes.graph(3), torch.float32)
    for model, graph in (particles, mesh):
        assert products(model, graph) == counted(model, graph) > 0


def test_of_contacts_and_stress() -> None:
    build = scenes.builder(("solid",), mesh=True)
    graph = scenes.to_dtype(build(scenes.mesh_state(materials=("solid",), gap=0.5).to_torch()), torch.float32)
    model = of(build.spec, decoder="contact", stress=True)
    assert graph["solid", "radius", "solid"].edge_index.shape[1] > 0
    assert products(model, graph) == counted(model, graph)
