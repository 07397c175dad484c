"""Corners of obstacles that touch edges of elastic bodies."""

from __future__ import annotations

import torch
from torch import Tensor

from gpe_pl.nn.elastic_motion import Cells, Corners, Walls, _in_rounds, elastic_motion
from gpe_pl.nn.fused import unfused

REST = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
LAW = (torch.tensor([0.3]).double(), torch.tensor([0.2]).double(), torch.tensor([0.01]).double())


def moved(
    pos: Tensor, vel: Tensor, forcing: Tensor, point: Tensor, friction: float, copies: int = 1, mass: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the motion of copies of a square, with a corner at ``point`` below its lowest edge."""
    mass, scene = torch.full((4 * copies,), 0.25).double() if mass is None else mass, torch.arange(copies).repeat_interleave(4)
    nodes = torch.arange(4 * copies).reshape(copies, 4)
    cells = Cells.of(nodes, REST.repeat(copies, 1), mass, scene)
    walls = Walls(torch.zeros_like(pos), torch.zeros_like(mass), torch.zeros_like(mass))
    corners = Corners(nodes[:, :2], point.repeat(copies, 1), torch.full((copies,), friction).double())
    law = tuple(c.repeat(copies) for c in LAW)
    return elastic_motion(pos, vel, forcing, mass, (law[0], law[1], law[2]), cells, walls, corners)[:2]


def test_a_corner_stops_an_edge_and_not_what_passes_beside_it() -> None:
    vel = torch.tensor([[0.0, -0.5]]).double().expand(4, 2)
    nothing = torch.zeros(4, 2).double()
    way, _ = moved(REST, vel, nothing, torch.tensor([[0.5, -0.1]]).double(), 0.0)
    assert float((REST + way)[:2, 1].mean()) > -0.1 - 1e-6
    assert float((REST + way)[2:, 1].mean()) < 1.0 - 0.1
    beside, _ = moved(REST, vel, nothing, torch.tensor([[1.4, -0.1]]).double(), 0.0)
    assert torch.allclose(beside, vel)


def test_a_corner_below_the_middle_of_an_edge_leaves_a_symmetric_body_symmetric() -> None:
    way, after = moved(
        REST, torch.tensor([[0.0, -0.5]]).double().expand(4, 2), torch.zeros(4, 2).double(), torch.tensor([[0.5, -0.1]]).double(), 0.7
    )
    image = torch.tensor([-1.0, 1.0]).double()
    assert torch.allclose(way[[1, 0, 3, 2]] * image, way, atol=1e-12)
    assert torch.allclose(after[[1, 0, 3, 2]] * image, after, atol=1e-12)


def test_friction_stops_or_slips() -> None:
    vel, nothing = torch.tensor([[0.05, -0.2]]).double().expand(4, 2), torch.zeros(4, 2).double()
    point = torch.tensor([[0.3, -0.01]]).double()
    smooth, some, rough = (moved(REST, vel, nothing, point, mu)[1].mean(dim=0) for mu in (0.0, 0.1, 1e6))
    assert float(smooth[0]) > float(some[0]) > float(rough[0])
    lost_along, gained_up = float(vel[0, 0] - some[0]), float(some[1] - vel[0, 1])
    assert lost_along <= 0.1 * gained_up * 1.3 + 1e-12  # the edge turns a little


def test_the_compiled_pass_equals_the_plain_one() -> None:
    generator = torch.Generator().manual_seed(3)
    inputs = [x.requires_grad_() for x in (
        REST.repeat(3, 1) + 0.05 * torch.randn(12, 2, generator=generator).double(),
        torch.tensor([0.05, -0.3]).double() + 0.05 * torch.randn(12, 2, generator=generator).double(),
        0.05 * torch.randn(12, 2, generator=generator).double(),
    )]  # fmt: skip
    weight = torch.randn(2, 12, 2, generator=generator).double()

    def results() -> list[Tensor]:
        way, after = moved(inputs[0], inputs[1], inputs[2], torch.tensor([[0.4, -0.05]]).double(), 0.3, copies=3)
        return [way, after, *torch.autograd.grad((weight * torch.stack([way, after])).sum(), inputs)]

    compiled = results()
    with unfused():
        plain = results()
    for a, b in zip(compiled, plain, strict=True):
        assert torch.allclose(a, b, rtol=1e-10, atol=1e-12)
    free, _ = moved(inputs[0], inputs[1], inputs[2], torch.tensor([[0.4, -50.0]]).double(), 0.3, copies=3)
    assert not torch.allclose(free, compiled[0])


def test_gradients_of_masses_pass_contacts_of_corners() -> None:
    """A corner beside the middle of an edge turns the body, which depends on the masses at both ends. The place on the edge counts as constant."""
    vel, nothing = torch.tensor([[0.05, -0.2]]).double().expand(4, 2), torch.zeros(4, 2).double()

    def of(mass: Tensor) -> Tensor:
        return moved(REST, vel, nothing, torch.tensor([[0.3, -0.19]]).double(), 0.3, mass=mass)[1]

    mass = torch.tensor([0.2, 0.3, 0.25, 0.25]).double().requires_grad_()
    assert (of(mass) - of(2.0 * mass)).abs().max() > 1e-3
    assert torch.autograd.gradcheck(of, mass, eps=1e-6, atol=2e-3, rtol=0)


def test_contacts_that_share_nodes_follow_each_other_in_both_passes() -> None:
    """Two corners touch one edge of the first square, and one of them the edge beside it."""
    nodes = torch.arange(8).reshape(2, 4)
    mass, scene = torch.linspace(0.2, 0.4, 8).double(), torch.arange(2).repeat_interleave(4)
    cells = Cells.of(nodes, REST.repeat(2, 1), mass, scene)
    walls = Walls(torch.zeros(8, 2).double(), torch.zeros(8).double(), torch.zeros(8).double())
    pairs = torch.tensor([[0, 1], [2, 3], [0, 1], [3, 0], [1, 2], [4, 5]])
    point = torch.tensor([[0.3, -0.02], [0.5, 1.05], [0.8, -0.01], [-0.01, 0.1], [1.02, 0.4], [0.5, -0.03]]).double()
    corners = Corners(pairs, point, torch.linspace(0.1, 0.9, 6).double())
    law = tuple(c.repeat(2) for c in LAW)
    pos = REST.repeat(2, 1).requires_grad_()
    vel = torch.tensor([[0.1, -0.4]]).double().repeat(8, 1) + 0.2 * torch.randn(8, 2, generator=torch.Generator().manual_seed(1)).double()

    def results() -> list[Tensor]:
        way, after, _ = elastic_motion(pos, vel, torch.zeros_like(vel), mass, (law[0], law[1], law[2]), cells, walls, corners)
        return [way, after, *torch.autograd.grad(way.square().sum() + after[:, 0].sum(), pos)]

    compiled = results()
    with unfused():
        plain = results()
    for a, b in zip(compiled, plain, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)
    only_one = Corners(pairs[:1], point[:1], corners.friction[:1])
    way = elastic_motion(pos, vel, torch.zeros_like(vel), mass, (law[0], law[1], law[2]), cells, walls, only_one).displacement
    assert not torch.allclose(way[:4], compiled[0][:4], atol=1e-3)


def test_rounds_keep_the_order_of_pairs_that_share_a_node() -> None:
    pair = torch.tensor([[0, 1], [1, 2], [4, 5], [2, 0], [0, 1], [5, 6]])
    rounds = [r.tolist() for r in _in_rounds(pair, 7)]
    assert rounds == [[0, 2], [1, 5], [3], [4]]
    assert [*_in_rounds(pair[:0], 7)] == []
