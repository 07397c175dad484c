"""Edges fade towards the radius: accelerations of a network that does not jump do not jump when nodes join islands and islands reach walls."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch_geometric.data import Batch, HeteroData

from gpe_pl.models.gpe import GPE
from gpe_pl.models.gpe_program_runner import Decoded
from gpe_pl.nn.edge_strength import FULL, strength, ties
from gpe_pl.nn.island_momentum import grouped
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.state import State
from tests import scenes

TWO = ("sand", "snow")


class Steady(GPE):
    """Network whose answers do not depend on the graph."""

    def _compiled(self, data: HeteroData, keep_absent: bool) -> Decoded:
        random = torch.Generator().manual_seed(5)
        found = {m: torch.randn(data[m].num_nodes, self.spec.dim, generator=random) for m in self.spec.materials}
        return Decoded({m: a.to(data[m].mass) for m, a in found.items()}, {}, {})


BUILD = scenes.builder(("sand",))


def accelerations(state: State, is_compiled: bool) -> Tensor:
    model = Steady(BUILD.spec, num_message_passing_steps=1, hidden_channels=8, island_momentum="angular").eval()
    with nullcontext() if is_compiled else unfused(), torch.no_grad():
        return model(BUILD(state.to_torch())).acceleration["sand"]


def cloud(shift: tuple[float, float], visitor: float) -> State:
    """Return a cloud of sand far from walls, moved, and one node beside it at a distance [radii] from the nearest one."""
    state = scenes.state(12, ("sand",), seed=1)
    pos = 0.5 + scenes.SPACING * np.stack(np.divmod(np.arange(12), 3), axis=1).astype(float) * 0.9
    pos[-1] = pos[10] + [visitor * BUILD.scales.radius, 0.0]
    return replace(state, pos=pos + shift)


@pytest.mark.parametrize("is_compiled", [True, False])
def test_a_node_joins_and_leaves_an_island_smoothly(is_compiled: bool) -> None:
    at = {s: accelerations(cloud((0.0, 0.0), s), is_compiled) for s in (0.7, FULL, FULL - 1e-5, 0.9, 0.9 + 1e-5, 1 - 1e-5, 1 + 1e-5, 1.5)}
    assert not at[1.5][-1].any()  # a node alone falls freely
    for low, high in ((FULL - 1e-5, FULL), (0.9, 0.9 + 1e-5), (1 - 1e-5, 1 + 1e-5), (1 + 1e-5, 1.5)):
        torch.testing.assert_close(at[low], at[high], rtol=0, atol=1e-3)
    assert (at[0.7] - at[1.5]).abs().max() > 0.05


@pytest.mark.parametrize("is_compiled", [True, False])
def test_an_island_reaches_a_wall_smoothly(is_compiled: bool) -> None:
    def at(gap: float) -> Tensor:
        return accelerations(cloud((0.0, gap * BUILD.scales.radius - 0.5), 0.5), is_compiled)

    near, far = at(0.5), at(1.5)
    for low, high in ((0.9, 0.9 + 1e-5), (1 - 1e-5, 1 + 1e-5), (1 + 1e-5, 1.5)):
        torch.testing.assert_close(at(low), at(high), rtol=0, atol=1e-3)
    assert (near - far).abs().max() > 0.1


@pytest.mark.parametrize("dim", [2, 3])
def test_compiled_ties_equal_those_of_pytorch_and_of_a_direct_computation(dim: int) -> None:
    build = scenes.builder(TWO, dim)
    count = 20 if dim == 2 else 60
    state = scenes.state(count, TWO, dim=dim, high=0.8)
    data = Batch.from_data_list([build(state.to_torch()), build(scenes.state(30, TWO, dim=dim, high=0.8, seed=2).to_torch())])
    _, _, island = grouped(data, TWO, "island", data.num_islands)
    found = ties(data, TWO, island, len(data.island_is_held))
    with unfused():
        expected = ties(data, TWO, island, len(data.island_is_held))
    torch.testing.assert_close(found, expected)
    alone = build(state.to_torch())
    own = ties(alone, TWO, torch.cat([alone[m].island for m in TWO]), int(alone.num_islands))
    pos, row = torch.from_numpy(state.pos), torch.cat([alone[m].node_id for m in TWO])
    between, to_wall = (torch.cdist(pos[row], other) / build.scales.radius for other in (pos[row], torch.from_numpy(state.boundary.pos)))
    between.fill_diagonal_(9.0)
    nearest = torch.minimum(between.min(dim=1).values, to_wall.min(dim=1).values)
    torch.testing.assert_close(own.node, strength(nearest[:, None]).float())
    label = torch.cat([alone[m].island for m in TWO])
    walls = torch.zeros(int(alone.num_islands), dtype=torch.float64)
    walls = walls.scatter_reduce(0, label, strength(to_wall.min(dim=1).values[:, None]), "amax")
    torch.testing.assert_close(own.wall, walls.float())
    assert 0 < (own.node == 0).sum() < (own.node < 1).sum() < count


def test_strength_falls_from_one_to_zero_with_finite_gradients() -> None:
    offset = torch.linspace(0, 1.2, 61, dtype=torch.float64)[:, None].requires_grad_()
    found = strength(offset)
    assert found[0] == 1 and found[-1] == 0 and (found.diff() <= 0).all() and found[offset[:, 0] < FULL].min() == 1
    (gradient,) = torch.autograd.grad(found.sum(), offset)
    assert gradient.isfinite().all() and gradient[0] == 0 and gradient.abs().max() < 8


def test_nodes_of_bodies_are_at_full_strength() -> None:
    build = scenes.builder(("elastomer",), mesh=True)
    state = scenes.mesh_state("lattice", ("elastomer",), num_bodies=1)
    data = build(replace(state, pos=state.pos * 3.0).to_torch())  # nodes are farther apart than the radius
    assert data["elastomer", "radius", "elastomer"].num_edges == 0
    assert (ties(data, ("elastomer",), data["elastomer"].island, int(data.num_islands)).node == 1).all()
