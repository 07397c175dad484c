"""Small states and graphs that tests build on."""

from __future__ import annotations

import torch
from torch_geometric.data import HeteroData

from gpe_pl.learned.testing.changes import permuted as permuted
from gpe_pl.learned.testing.changes import to_dtype as to_dtype
from gpe_pl.learned.testing.scenes import SPACING as SPACING
from gpe_pl.learned.testing.scenes import builder as builder
from gpe_pl.learned.testing.scenes import mesh as mesh
from gpe_pl.learned.testing.scenes import mesh_state as mesh_state
from gpe_pl.learned.testing.scenes import metadata as metadata
from gpe_pl.learned.testing.scenes import state as state


def graph(materials: tuple[str, ...] = ("sand",), dtype: torch.dtype = torch.float64, **settings: object) -> HeteroData:
    """Return a graph of a random state with features of the given precision."""
    return to_dtype(builder(materials)(state(materials=materials, **settings).to_torch()), dtype)  # type: ignore[arg-type]


def assert_equal_graphs(a: HeteroData, b: HeteroData, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Check that stores and values are equal, bit for bit unless tolerances are given."""
    assert (a.node_types, a.edge_types) == (b.node_types, b.edge_types)
    for store, other in zip(a.stores, b.stores, strict=True):
        assert set(store.keys()) == set(other.keys())
        for key, value in store.items():
            values = torch.as_tensor(value), torch.as_tensor(other[key])
            assert torch.equal(*values) or (rtol + atol > 0 and torch.allclose(*values, rtol=rtol, atol=atol)), key
