"""The ``contact`` decoder: what touches a body of a mesh moves it as a whole, and nothing else does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.models.gpe import GPE, IslandError
from gpe_pl.schema import node_code
from gpe_pl.skips import Skips
from gpe_pl.trajectory import State
from tests import scenes

BOTH = ("sand", "elastomer")


def builder(materials: tuple[str, ...] = BOTH, dim: int = 2, **config: Any) -> GraphBuilder:
    return scenes.builder(materials, dim, **{"mesh": True, "islands": True, **config})


def double(build: GraphBuilder, s: State) -> HeteroData:
    return scenes.to_dtype(build(s.to_torch()), torch.float64)


def contact_model(build: GraphBuilder) -> GPE:
    torch.manual_seed(0)
    return GPE(build.spec, decoder="contact", num_message_passing_steps=2, hidden_channels=16).double()


@pytest.mark.parametrize("kind", ["lattice", "tetrahedra"])
def test_contacts_alone_move_and_turn_a_body(kind: str) -> None:
    """Newton's and Euler's laws of each body under the forces of its contacts; what nodes add has no momentum."""
    build = builder(dim=3 if kind == "tetrahedra" else 2)
    s = scenes.mesh_state(kind, BOTH, num_bodies=2, gap=0.5)
    assert s.cells is not None
    cells = s.cells[~(s.cells == s.cells[0, 0]).any(axis=1)]  # which leaves a node, and more, without a cell
    data = double(build, replace(s, cells=cells))
    model = contact_model(build)
    predicted, decoded = prediction_and_parts(model, data)
    mass, pos, body = data["elastomer"].mass, data["elastomer"].pos, data["elastomer"].body
    force = decoded.contact["elastomer"] * mass[:, None]
    loose = np.setdiff1d(np.flatnonzero(s.node_type == node_code("elastomer")), cells)
    assert len(loose)
    assert (body == -1).nonzero().flatten().tolist() == [np.flatnonzero(data["elastomer"].node_id == n)[0] for n in loose]
    assert body.max() + 1 == data.num_bodies
    assert force.norm(dim=1).sum() > 1e-3
    for b in range(int(data.num_bodies)):
        m, r = mass[body == b][:, None], pos[body == b]
        r = r - (m * r).sum(dim=0) / m.sum()
        change, scale = m * predicted["elastomer"][body == b] - force[body == b], force.norm(dim=1).sum()
        assert change.sum(dim=0).norm() < 1e-12 * scale
        assert turning(r, change).norm() < 1e-12 * scale
    torch.testing.assert_close(predicted["elastomer"][body < 0], decoded.acceleration["elastomer"][body < 0], rtol=0, atol=0)
    torch.testing.assert_close(predicted["sand"], decoded.acceleration["sand"], rtol=0, atol=0)


def prediction_and_parts(model: GPE, data: HeteroData) -> tuple[dict[str, torch.Tensor], Any]:
    """The accelerations that a model predicts, and what it made them of."""
    parts: list[Any] = []
    compute = model.compute

    def recorded(*args: Any) -> Any:
        parts.append(compute(*args))
        return parts[-1]

    model.compute = recorded  # type: ignore[assignment, method-assign]
    try:
        return model(data).acceleration, parts[0]
    finally:
        del model.compute


def turning(arm: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Torque, of as many components as axes to turn about."""
    arm, force = (torch.nn.functional.pad(x, (0, 3 - x.shape[1])) for x in (arm, force))
    return torch.linalg.cross(arm, force).sum(dim=0)


def test_without_contact_a_body_falls_freely_and_deforms() -> None:
    build = builder(("elastomer",))
    data = double(build, scenes.mesh_state(walls=False, gap=9.0))
    acceleration = contact_model(build)(data).acceleration["elastomer"]
    mass = data["elastomer"].mass[:, None]
    assert acceleration.norm(dim=1).sum() > 1e-3
    assert (data["elastomer"].body >= 0).all()
    for b in range(int(data.num_bodies)):
        chosen = data["elastomer"].body == b
        assert (mass * acceleration)[chosen].sum(dim=0).norm() <= 1e-13 * (mass * acceleration).norm(dim=1).sum()


@pytest.mark.parametrize("skips", [Skips(), Skips(sorted_from=0)])
def test_a_body_that_touches_itself_does_not_turn_itself(skips: Skips) -> None:
    """Two heaps of cells that touch, far apart at rest and tied together by one long cell: forces at their contact are no forces from outside."""
    build = builder(("elastomer",))
    s = scenes.mesh_state("triangles", ("elastomer",), num_bodies=2, gap=0.5, walls=False)
    store = double(build, s)["elastomer"]
    first, second = (store.node_id[store.body == b].numpy() for b in range(2))
    assert s.cells is not None and s.rest_pos is not None
    s = replace(s, cells=np.concatenate([s.cells, [[*first[:2], second[0]]]]))
    rest = np.array(s.rest_pos)
    rest[second, 0] += 50 * scenes.SPACING
    data = double(build, replace(s, rest_pos=rest))
    assert data.num_bodies == 1
    assert data["elastomer", "radius", "elastomer"].edge_index.shape[1]
    model = contact_model(build)
    model.skips = skips
    acceleration = model.eval()(data).acceleration["elastomer"]
    mass, pos = data["elastomer"].mass[:, None], data["elastomer"].pos
    force, arm = mass * acceleration, pos - (mass * pos).sum(dim=0) / mass.sum()
    assert force.norm(dim=1).sum() > 1e-3
    assert force.sum(dim=0).norm() < 1e-12 * force.norm(dim=1).sum()
    assert turning(arm, force).norm() < 1e-12 * force.norm(dim=1).sum()


def test_the_bodies_of_a_batch_are_told_apart() -> None:
    build = builder()
    model = contact_model(build)
    graphs = [double(build, scenes.mesh_state(kind, BOTH, num_bodies=n, gap=0.5)) for kind, n in (("lattice", 2), ("triangles", 1))]
    together = model(batched(graphs)).acceleration["elastomer"]
    torch.testing.assert_close(together, torch.cat([model(g).acceleration["elastomer"] for g in graphs]), rtol=1e-12, atol=1e-14)


def test_contacts_move_nothing_but_bodies() -> None:
    spec = builder(mesh=False).spec
    torch.manual_seed(0)
    contact = GPE(spec, decoder="contact", num_message_passing_steps=1, hidden_channels=8)
    torch.manual_seed(0)
    node = GPE(spec, num_message_passing_steps=1, hidden_channels=8)
    assert contact.state_dict().keys() == node.state_dict().keys()
    assert contact.num_hops == node.num_hops


def test_bodies_without_their_graphs_labels_are_refused() -> None:
    with pytest.raises(IslandError, match=r"decoder=contact needs graph\.islands=true"):
        GPE(builder(islands=False).spec, decoder="contact")
