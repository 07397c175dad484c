"""Exact conservation of momentum for islands in free flight, with any network, and the rigid part of the accelerations of bodies.

An island without edges to anything outside keeps its linear and angular momentum. With a the accelerations without gravity of its nodes, m their masses and r
their positions relative to the island's centre of mass::

    a ← a − Σ m a / Σ m                                  linear: the centre of mass falls freely
    a ← a − α × r,   J α = Σ m r × a                     angular: J is the inertia tensor

This is the smallest change in the mass-weighted sense for which Σ m a and Σ m r × a vanish. The part that is removed is the ``rigid_part``.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gpe_pl.nn.fused import works_on
from gpe_pl.nn.island_momentum_kernels import remove_rigid_part, replace_rigid_part

IslandMomentum = Literal["ignored", "linear", "angular"]
SMALLEST_PRINCIPAL_FRACTION = 1e-4
"""Fraction of the largest principal moment of inertia below which an island has no defined rotation about an axis (a single node, nodes in a row)."""


def conserve(
    acceleration: Float[Tensor, "node dim"],
    mass: Float[Tensor, " node"],
    pos: Float[Tensor, "node dim"],
    island: Int64[Tensor, " node"],
    is_free: Bool[Tensor, " island"],
    angular: bool,
) -> Float[Tensor, "node dim"]:
    """Return accelerations without gravity that change no free island's linear momentum, nor its angular momentum if ``angular``.

    Args:
        acceleration: accelerations without gravity, in any unit.
        mass: masses [kg].
        pos: positions [m].
        island: island of each node.
        is_free: whether each island has no edge to anything outside.
        angular: also conserve angular momentum.
    """
    if torch.compiler.is_exporting():  # shapes must not depend on values: compute all rows, then select those of free islands
        rows = torch.arange(island.shape[0], device=island.device)
        return torch.where(is_free[island][:, None], _kept(acceleration, mass, pos, island, rows, is_free.shape[0], angular), acceleration)
    if _compiles(acceleration, mass, pos):
        kept = acceleration.clone()
        if bool(is_free.any()):
            arrays = [t.detach().contiguous().numpy() for t in (mass, pos, island, is_free)]
            remove_rigid_part(kept.detach().numpy(), *arrays, angular, SMALLEST_PRINCIPAL_FRACTION)
        return kept
    rows = torch.nonzero(is_free[island]).flatten()
    if not len(rows):
        return acceleration
    kept = _kept(acceleration, mass, pos, island, rows, is_free.shape[0], angular)
    return acceleration.index_copy(0, rows, kept)


def rigid_part(
    acceleration: Float[Tensor, "node dim"],
    mass: Float[Tensor, " node"],
    pos: Float[Tensor, "node dim"],
    body: Int64[Tensor, " node"],
    count: int,
) -> Float[Tensor, "node dim"]:
    """Return the rigid part of the accelerations of nodes, body by body. It has all of the body's linear and angular momentum, and deforms nothing.

    Args:
        acceleration: accelerations, in any unit.
        mass: masses [kg].
        pos: positions [m].
        body: body of each node.
        count: number of bodies.
    """
    rows = torch.arange(body.shape[0], device=body.device)
    return acceleration - _kept(acceleration, mass, pos, body, rows, count, angular=True)


def moved_by_contacts(
    acceleration: Float[Tensor, "node dim"],
    forces: Float[Tensor, "node dim"],
    mass: Float[Tensor, " node"],
    pos: Float[Tensor, "node dim"],
    body: Int64[Tensor, " node"],
    count: int,
    are_rigid: bool,
    only_contacts: bool,
) -> Float[Tensor, "node dim"]:
    """Return accelerations in which contacts take the place of the rigid part of the accelerations of bodies.

    Args:
        acceleration: accelerations that a network decodes at nodes.
        forces: accelerations by contacts.
        mass: masses.
        pos: positions.
        body: body of each node; a negative number stands for none, and the node keeps its acceleration.
        count: number of bodies, or an upper bound of it.
        are_rigid: contacts move bodies as a whole. Otherwise they act at the nodes where they are.
        only_contacts: nodes of bodies have no acceleration besides contacts; for bodies that are not rigid.
    """
    if _compiles(acceleration, forces, mass, pos):
        moved = acceleration.clone()
        arrays = [t.detach().contiguous().numpy() for t in (forces, mass, pos, body)]
        replace_rigid_part(moved.detach().numpy(), *arrays, count, are_rigid, only_contacts, SMALLEST_PRINCIPAL_FRACTION)
        return moved
    in_body = body >= 0
    groups = torch.where(in_body, body, count), count + 1
    if are_rigid:
        change = rigid_part(forces - acceleration, mass, pos, *groups)
    else:
        change = forces - (acceleration if only_contacts else rigid_part(acceleration, mass, pos, *groups))
    return acceleration + torch.where(in_body[:, None], change, 0.0)


def _compiles(*tensors: Tensor) -> bool:
    """Tell whether ``island_momentum_kernels`` can be used in the present context."""
    return not torch.is_grad_enabled() and works_on(*tensors)


def _kept(acceleration: Tensor, mass: Tensor, pos: Tensor, island: Tensor, rows: Tensor, count: int, angular: bool) -> Tensor:
    """Apply ``conserve`` to these rows, which are whole islands."""
    label, m, a = island[rows], mass[rows, None], acceleration[rows]
    total = _sum(m, label, count).clamp(min=torch.finfo(m.dtype).tiny)
    a = a - (_sum(m * a, label, count) / total)[label]
    if angular:
        r = pos[rows] - (_sum(m * pos[rows], label, count) / total)[label]
        a = a - _rotation(a, m, r, label, count)
    return a


def _sum(values: Tensor, label: Tensor, count: int) -> Tensor:
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, label, values)


def _rotation(a: Tensor, m: Tensor, r: Tensor, label: Tensor, count: int) -> Tensor:
    """Return α × r of each node: the part of the accelerations in which its island rotates."""
    if a.shape[1] == 2:
        moment = _sum(m * (r[:, :1] * a[:, 1:] - r[:, 1:] * a[:, :1]), label, count)
        inertia = _sum(m * r.square().sum(dim=1, keepdim=True), label, count)
        alpha = torch.where(inertia > 0, moment / inertia.clamp(min=torch.finfo(m.dtype).tiny), 0.0)[label]
        return alpha * torch.stack([-r[:, 1], r[:, 0]], dim=1)
    moment = _sum(m * torch.linalg.cross(r, a), label, count)
    squares = r.square().sum(dim=1)[:, None, None] * torch.eye(3, dtype=r.dtype, device=r.device) - r[:, :, None] * r[:, None, :]
    inertia = _sum(m[:, :, None] * squares, label, count)
    alpha = torch.linalg.pinv(inertia, rtol=SMALLEST_PRINCIPAL_FRACTION, hermitian=True) @ moment[:, :, None]
    return torch.linalg.cross(alpha[label, :, 0], r)
