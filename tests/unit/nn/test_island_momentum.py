"""Free islands keep their momentum exactly, and everything else is unchanged."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor

from gpe_pl.nn.island_momentum import conserve, moved_by_contacts, rigid_part
from gpe_pl.system.compiled import unfused

SIZES = (40, 1, 2, 25, 3)
FREE = torch.tensor([1.0, 1.0, 1.0, 0.0, 1.0], dtype=torch.float64)


TIED = torch.ones(sum(SIZES), dtype=torch.float64)


def scene(dim: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    island = torch.repeat_interleave(torch.arange(len(SIZES)), torch.tensor(SIZES))
    order = torch.randperm(len(island), generator=generator)
    n = len(island)
    random = [torch.randn(n, dim, generator=generator, dtype=torch.float64) for _ in range(2)]
    mass = torch.rand(n, generator=generator, dtype=torch.float64) + 0.1
    return random[0], mass, 5 + random[1], island[order]


def momenta(a: Tensor, mass: Tensor, pos: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    m, r = mass[rows, None], pos[rows] - (mass[rows, None] * pos[rows]).sum(0) / mass[rows].sum()
    if a.shape[1] == 2:
        return (m * a[rows]).sum(0), (m[:, 0] * (r[:, 0] * a[rows, 1] - r[:, 1] * a[rows, 0])).sum()
    return (m * a[rows]).sum(0), (m * torch.linalg.cross(r, a[rows])).sum(0)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angular", [False, True])
def test_free_islands_gain_no_momentum(dim: int, angular: bool) -> None:
    a, mass, pos, island = scene(dim)
    kept = conserve(a, mass, pos, island, TIED, FREE, angular)
    for k, free in enumerate(FREE.tolist()):
        rows = torch.nonzero(island == k).flatten()
        linear, about_center = momenta(kept, mass, pos, rows)
        if not free:
            assert torch.equal(kept[rows], a[rows])
            continue
        assert linear.abs().max() < 1e-12
        if angular:
            assert about_center.abs().max() < 1e-11
        elif len(rows) > 2:
            assert about_center.abs().max() > 1e-3  # there was something to remove


@pytest.mark.parametrize("dim", [2, 3])
def test_the_change_is_a_rigid_motion_and_a_second_one_none(dim: int) -> None:
    a, mass, pos, island = scene(dim)
    kept = conserve(a, mass, pos, island, TIED, FREE, angular=True)
    torch.testing.assert_close(conserve(kept, mass, pos, island, TIED, FREE, angular=True), kept)
    rows = torch.nonzero(island == 0).flatten()
    change, r = (a - kept)[rows], pos[rows] - pos[rows].mean(0)
    gradient = torch.linalg.lstsq(torch.cat([r, torch.ones(len(rows), 1, dtype=r.dtype)], dim=1), change).solution
    torch.testing.assert_close(torch.cat([r, torch.ones(len(rows), 1, dtype=r.dtype)], dim=1) @ gradient, change)
    spin = gradient[:dim]
    torch.testing.assert_close(spin, -spin.T)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_single_node_falls_freely(dim: int) -> None:
    a, mass, pos, island = scene(dim)
    kept = conserve(a, mass, pos, island, TIED, FREE, angular=True)
    assert kept[island == 1].abs().max() < 1e-15


def test_nothing_free_leaves_everything() -> None:
    a, mass, pos, island = scene(2)
    assert torch.equal(conserve(a, mass, pos, island, TIED, torch.zeros_like(FREE), angular=True), a)
    empty = conserve(a[:0], mass[:0], pos[:0], island[:0], TIED[:0], FREE[:0], angular=True)
    assert empty.shape == (0, 2)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_are_finite_and_orthogonal_to_momentum(dim: int) -> None:
    a, mass, pos, island = scene(dim)
    a.requires_grad_()
    conserve(a, mass, pos, island, TIED, FREE, angular=True).square().sum().backward()
    assert a.grad is not None
    assert torch.isfinite(a.grad).all()
    rows = torch.nonzero(island == 0).flatten()
    assert (a.grad[rows]).sum(0).abs().max() < 1e-10  # adding the same to all nodes changes nothing


@pytest.mark.parametrize("dim", [2, 3])
def test_the_rigid_part_of_each_body_is_the_nearest_rigid_motion(dim: int) -> None:
    a, mass, pos, body = scene(dim)
    part = rigid_part(a, mass, pos, body, len(SIZES))
    for k in range(len(SIZES)):
        rows = torch.nonzero(body == k).flatten()
        motions = rigid_motions(pos[rows])
        weight = mass[rows].sqrt().repeat_interleave(dim)[:, None]
        fit = torch.linalg.lstsq(weight * motions, weight * a[rows].reshape(-1, 1), driver="gelsd").solution
        torch.testing.assert_close(part[rows].reshape(-1, 1), motions @ fit)
    torch.testing.assert_close(rigid_part(part, mass, pos, body, len(SIZES)), part)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("modes", [(True, False), (False, False), (False, True)], ids=["rigid", "local", "only contacts"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_compiled_contacts_move_bodies_as_plain_operations_do(
    dim: int, modes: tuple[bool, bool], dtype: torch.dtype, tolerance: float
) -> None:
    a, mass, pos, body = scene(dim)
    forces = torch.randn(a.shape, generator=torch.Generator().manual_seed(1), dtype=a.dtype)
    body = torch.where(body == 4, -1, body)
    inputs: tuple[Any, ...] = *(t.to(dtype) for t in (a, forces, mass, pos)), body, len(SIZES) - 1, *modes
    with torch.no_grad():
        found = moved_by_contacts(*inputs)
        with unfused():
            expected = moved_by_contacts(*inputs)
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * float(expected.abs().max()))
    assert torch.equal(found[body < 0], a.to(dtype)[body < 0])
    assert (found - a.to(dtype))[body >= 0].abs().min() > 0


def rigid_motions(pos: Tensor) -> Tensor:
    """Return translations along and rotations about every axis [node · dim, motion]."""
    n, dim = pos.shape
    r = pos - pos.mean(dim=0)
    shifts = torch.eye(dim, dtype=r.dtype).repeat(n, 1)
    turns = []
    for i in range(dim):
        for j in range(i):
            turn = torch.zeros_like(r)
            turn[:, i], turn[:, j] = r[:, j], -r[:, i]
            turns.append(turn.reshape(-1, 1))
    return torch.cat([shifts, *turns], dim=1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("which", ["linear", "angular", "rigid", "local", "only contacts"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
def test_compiled_gradients_equal_those_of_plain_operations(dim: int, which: str, dtype: torch.dtype, tolerance: float) -> None:
    a, mass, pos, island = (t.to(dtype) if t.is_floating_point() else t for t in scene(dim, seed=2))
    forces, weight = torch.randn(2, *a.shape, dtype=dtype, generator=torch.Generator().manual_seed(3))
    body = torch.where(island == 1, -1, island)

    tie, freedom = (torch.rand(n, generator=torch.Generator().manual_seed(n)).to(dtype) for n in (len(a), len(SIZES)))
    tie[0] = 0.0

    def gradients(create_graph: bool = False) -> list[Tensor]:
        inputs = [a.clone().requires_grad_(), forces.clone().requires_grad_()]
        if which in ("linear", "angular"):
            out = conserve(inputs[0], mass, pos, island, tie, freedom, which == "angular") + 0 * inputs[1]
        else:
            out = moved_by_contacts(inputs[0], inputs[1], mass, pos, body, len(SIZES), which == "rigid", which == "only contacts")
        loss = (weight * out**2).sum() / 2
        found = torch.autograd.grad(loss, inputs, create_graph=create_graph)
        if create_graph:
            found = torch.autograd.grad(found[0].square().sum() + found[1].square().sum(), inputs)
        return [out.detach(), *found]

    for create_graph in (False, True):
        found = gradients(create_graph)
        with unfused():
            expected = gradients(create_graph)
        for ours, theirs in zip(found, expected, strict=True):
            assert (ours - theirs).norm() <= tolerance * (1 + theirs.norm())


def test_gradients_with_respect_to_positions_are_those_of_plain_operations() -> None:
    a, mass, pos, island = scene(2)
    pos.requires_grad_()
    conserve(a, mass, pos, island, TIED, FREE, True).square().sum().backward()
    assert pos.grad is not None and pos.grad.abs().max() > 0


@pytest.mark.parametrize("is_compiled", [True, False])
@pytest.mark.parametrize("angular", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_free_islands_gain_no_momentum_whatever_the_weights_of_their_nodes(dim: int, angular: bool, is_compiled: bool) -> None:
    a, mass, pos, island = scene(dim)
    tie = torch.rand(len(a), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    tie[::7] = 0.0
    with nullcontext() if is_compiled else unfused():
        kept = conserve(a, mass, pos, island, tie, FREE, angular)
    assert not kept[tie == 0].any()
    for k in (0, 4):
        rows = torch.nonzero(island == k).flatten()
        linear, about_center = momenta(kept, mass, pos, rows)
        assert linear.abs().max() < 1e-12 and (not angular or about_center.abs().max() < 1e-11)
    rows = torch.nonzero(island == 3).flatten()  # not free
    torch.testing.assert_close(kept[rows], tie[rows, None] * a[rows], rtol=0, atol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_share_of_the_freedom_removes_a_share_of_the_momentum(dim: int) -> None:
    a, mass, pos, island = scene(dim)
    rows = torch.nonzero(island == 0).flatten()
    whole, _ = momenta(a, mass, pos, rows)
    left, _ = momenta(conserve(a, mass, pos, island, TIED, 0.25 * FREE, True), mass, pos, rows)
    torch.testing.assert_close(left, 0.75 * whole)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_low_precision_of_a_network_leaves_that_of_weights(dtype: torch.dtype) -> None:
    """As under autocast, where networks answer in low precision."""
    a, mass, pos, island = (t.float() if t.is_floating_point() else t for t in scene(2))
    tie, freedom = TIED.float(), FREE.float()
    found = conserve(a.to(dtype), mass, pos, island, tie, freedom, True)
    expected = conserve(a.to(dtype).float(), mass, pos, island, tie, freedom, True)
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), expected, rtol=1e-2, atol=1e-2)
