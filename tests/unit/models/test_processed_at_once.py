"""The message-passing steps of GPE in training are one function, with the results and gradients of PyTorch's operations."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.models import gpe as module
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.fused import unfused
from gpe_pl.nn.fused_processor import fused_processor
from gpe_pl.schema import FeatureSpec
from tests import meshes, scenes


def particles() -> tuple[FeatureSpec, HeteroData]:
    build = scenes.builder(("sand", "snow"), history=1)
    data = build(scenes.state(30, ("sand", "snow"), seed=0).to_torch())
    for store in data.stores:
        for key, value in store.items():
            if isinstance(value, Tensor) and value.is_floating_point():
                store[key] = value.double()
    return build.spec, data


@pytest.mark.parametrize("settings", [{}, {"node_norm": "layer"}, {"level_weights": "separate"}, {"decoder": "pair"}], ids=str)
@pytest.mark.parametrize("scene", [particles, lambda: (meshes.spec(3), meshes.graph(3))], ids=["particles", "mesh"])
def test_gradients_equal_those_of_pytorch(scene: Any, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(module, "fused_processor", lambda *values: calls.append(1) or fused_processor(*values))  # type: ignore[func-returns-value]
    spec, data = scene()
    results = []
    for is_fused in (True, False):
        torch.manual_seed(0)
        model = GPE(spec, edge_state="geometry", num_message_passing_steps=3, hidden_channels=8, **settings).double().train()
        with torch.enable_grad():
            if is_fused:
                predicted = model(data).acceleration
            else:
                with unfused():
                    predicted = model(data).acceleration
            loss = torch.cat([*predicted.values()]).sin().sum()
            loss.backward()
        results.append([loss.detach(), *(torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters())])
    assert len(calls) == 1
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
