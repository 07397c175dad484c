"""Exact conservation of momentum for islands in free flight, with any network, and the rigid part of the accelerations of bodies.

An island without edges to anything outside keeps its linear and angular momentum. With a the accelerations without gravity of its nodes, m their masses and r
their positions relative to the island's centre of mass::

    a ← a − Σ m a / Σ m                                  linear: the centre of mass falls freely
    a ← a − α × r,   J α = Σ m r × a                     angular: J is the inertia tensor

This is the smallest change in the mass-weighted sense for which Σ m a and Σ m r × a vanish. The part that is removed is the ``rigid_part``.

Nodes join islands, and islands reach walls, when edges appear. So that accelerations do not jump then, strengths of edges are weights (``nn.edge_strength``).
With w the strength of the strongest edge of a node, and f = 1 − that of the strongest edge of its island to a wall, ``conserve`` is ``a ← w (a − f R a)``. R a
is the rigid part with masses w m. A node alone has w = 0 and falls freely. Islands with f = 1 keep their momentum exactly. When two islands become one,
accelerations still jump, and so they do when an island meets a node that is at a wall.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.nn.fused import plain_gradients, works_on
from gpe_pl.nn.island_momentum_kernels import remove_rigid_part, replace_rigid_part

IslandMomentum = Literal["ignored", "linear", "angular"]
SMALLEST_PRINCIPAL_FRACTION = 1e-4
"""Fraction of the largest principal moment of inertia below which an island has no defined rotation about an axis (a single node, nodes in a row)."""


def joined(parts: list[Tensor]) -> Tensor:
    """Return tensors joined along their first axis."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def grouped(data: HeteroData, materials: Iterable[str], name: str, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mass, lever arm and group (``island`` or ``body``) of the nodes of these materials; graphs of a batch number groups from 0; −1: no group."""
    stores = [data[m] for m in materials]
    arm = "body_arm" if name == "body" and "body_arm" in stores[0] else "pos"
    if len(stores) == 1 and "batch" not in stores[0]:
        return stores[0].mass, stores[0][arm], stores[0][name]
    start = torch.cumsum(count, dim=0) - count
    group = torch.cat([torch.where(s[name] < 0, s[name], s[name] + start[s.batch]) if "batch" in s else s[name] for s in stores])
    return torch.cat([s.mass for s in stores]), torch.cat([s[arm] for s in stores]), group


def conserve(
    acceleration: Float[Tensor, "node dim"],
    mass: Float[Tensor, " node"],
    pos: Float[Tensor, "node dim"],
    island: Int64[Tensor, " node"],
    tie: Float[Tensor, " node"],
    freedom: Float[Tensor, " island"],
    angular: bool,
) -> Float[Tensor, "node dim"]:
    """Return accelerations without gravity that change no free island's linear momentum, nor its angular momentum if ``angular``.

    Args:
        acceleration: accelerations without gravity, in any unit.
        mass: masses [kg].
        pos: positions [m].
        island: island of each node.
        tie: weight of each node, from 0 (alone) to 1 (in the island).
        freedom: fraction of the rigid part of each island that is removed; 1 if nothing acts on it from outside.
        angular: also conserve angular momentum.
    """
    arguments = acceleration, mass, pos, island, tie, freedom
    if _compiles(acceleration, mass, pos, tie, freedom):
        if not torch.is_grad_enabled():
            return _compiled(*arguments, angular)
        return cast(Tensor, _Conserved.apply(*arguments, angular))  # type: ignore[no-untyped-call]
    return _conserved(*arguments, angular)


def _conserved(acceleration: Tensor, mass: Tensor, pos: Tensor, island: Tensor, tie: Tensor, freedom: Tensor, angular: bool) -> Tensor:
    """Do the same as ``conserve`` with PyTorch's operations."""
    kept = _kept(acceleration, tie * mass, pos, island, freedom.shape[0], angular)
    changed = tie[:, None] * (acceleration + freedom[island][:, None] * (kept - acceleration))
    return changed.to(acceleration.dtype)  # weights keep their precision under autocast


def _compiled(acceleration: Tensor, mass: Tensor, pos: Tensor, island: Tensor, tie: Tensor, freedom: Tensor, angular: bool) -> Tensor:
    """Do the same as ``conserve`` with compiled loops."""
    return tie[:, None] * _without_rigid_part(acceleration, tie * mass, pos, island, freedom, angular)


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
    return acceleration - _kept(acceleration, mass, pos, body, count, angular=True)


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
    arguments = acceleration, forces, mass, pos, body, count, are_rigid, only_contacts
    if _compiles(acceleration, mass, pos) and _compiles(forces, mass, pos):
        if not torch.is_grad_enabled():
            return _with_contacts(*arguments)
        return cast(Tensor, _MovedByContacts.apply(*arguments))  # type: ignore[no-untyped-call]
    return _moved_by_contacts(*arguments)


def _moved_by_contacts(
    acceleration: Tensor, forces: Tensor, mass: Tensor, pos: Tensor, body: Tensor, count: int, are_rigid: bool, only_contacts: bool
) -> Tensor:
    """Do the same as ``moved_by_contacts`` with PyTorch's operations."""
    in_body = body >= 0
    groups = torch.where(in_body, body, count), count + 1
    if are_rigid:
        change = rigid_part(forces - acceleration, mass, pos, *groups)
    else:
        change = forces - (acceleration if only_contacts else rigid_part(acceleration, mass, pos, *groups))
    return acceleration + torch.where(in_body[:, None], change, 0.0)


def _compiles(values: Tensor, *constants: Tensor) -> bool:
    """Tell whether ``island_momentum_kernels`` can be used in the present context. They have no gradients with respect to masses, positions and weights."""
    return works_on(values, *constants) and not (torch.is_grad_enabled() and any(t.requires_grad for t in constants))


class _Conserved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, acceleration: Tensor, *others: Any) -> Tensor:
        ctx.save_for_backward(acceleration, *others[:-1])
        ctx.angular = others[-1]
        return _compiled(acceleration, *others)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        acceleration, mass, pos, island, tie, freedom = ctx.saved_tensors
        if torch.is_grad_enabled():

            def plain(a: Tensor) -> tuple[Tensor]:
                return (_conserved(a, mass, pos, island, tie, freedom, ctx.angular),)

            return *plain_gradients(plain, [acceleration], [grad]), *[None] * 6
        removed = _transposed(grad, mass, tie * mass, pos, island, freedom, ctx.angular)
        return tie[:, None] * (grad - removed), *[None] * 6


class _MovedByContacts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, acceleration: Tensor, forces: Tensor, mass: Tensor, pos: Tensor, body: Tensor, *settings: Any) -> Tensor:
        ctx.save_for_backward(acceleration, forces, mass, pos, body)
        ctx.settings = settings
        return _with_contacts(acceleration, forces, mass, pos, body, *settings)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        acceleration, forces, mass, pos, body = ctx.saved_tensors
        count, are_rigid, only_contacts = ctx.settings
        nothing = [None] * 6
        if torch.is_grad_enabled():

            def plain(a: Tensor, f: Tensor) -> tuple[Tensor]:
                return (_moved_by_contacts(a, f, mass, pos, body, count, are_rigid, only_contacts),)

            return *plain_gradients(plain, [acceleration, forces], [grad]), *nothing
        in_body = (body >= 0)[:, None]
        if only_contacts and not are_rigid:
            return torch.where(in_body, 0.0, grad), torch.where(in_body, grad, 0.0), *nothing
        share = mass.new_ones(count + 1)
        share[count] = 0.0
        rigid = _transposed(grad, mass, mass, pos, torch.where(body >= 0, body, count), share, True)
        return grad - rigid, rigid if are_rigid else torch.where(in_body, grad, 0.0), *nothing


def _without_rigid_part(acceleration: Tensor, mass: Tensor, pos: Tensor, group: Tensor, share: Tensor, angular: bool) -> Tensor:
    kept = acceleration.detach().clone(memory_format=torch.contiguous_format)
    remove_rigid_part(kept.numpy(), *_arrays(mass, pos, group, share), angular, SMALLEST_PRINCIPAL_FRACTION)
    return kept


def _with_contacts(acceleration: Tensor, forces: Tensor, mass: Tensor, pos: Tensor, body: Tensor, *settings: Any) -> Tensor:
    moved = acceleration.detach().clone(memory_format=torch.contiguous_format)
    replace_rigid_part(moved.numpy(), *_arrays(forces, mass, pos, body), *settings, SMALLEST_PRINCIPAL_FRACTION)
    return moved


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [t.detach().contiguous().numpy() for t in tensors]


def _transposed(grad: Tensor, mass: Tensor, weighted: Tensor, pos: Tensor, group: Tensor, share: Tensor, angular: bool) -> Tensor:
    """Return the gradient g [node, dim] with respect to accelerations a of the share f of their rigid part R a, for masses m and w m; w g has the weights, too.

    R is a projection that is orthogonal in the product with w m, so Rᵀ = w m R (w m)⁻¹, and Rᵀ f w grad = w m f R (grad / m).
    """
    scaled = grad / mass[:, None]
    return (scaled - _without_rigid_part(scaled, weighted, pos, group, share, angular)) * mass[:, None]


def _kept(acceleration: Tensor, mass: Tensor, pos: Tensor, group: Tensor, count: int, angular: bool) -> Tensor:
    """Return accelerations without the rigid part of each group."""
    m, a = mass[:, None], acceleration
    total = _sum(m, group, count).clamp(min=torch.finfo(m.dtype).tiny)
    a = a - (_sum(m * a, group, count) / total)[group]
    if angular:
        r = pos - (_sum(m * pos, group, count) / total)[group]
        a = a - _rotation(a, m, r, group, count)
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
    # in double precision, because a GPU may round the factors of products in single precision to TF32
    inverse = torch.linalg.pinv(inertia.double(), rtol=SMALLEST_PRINCIPAL_FRACTION, hermitian=True)
    alpha = (inverse @ moment.double()[:, :, None]).to(r.dtype)
    return torch.linalg.cross(alpha[label, :, 0], r)
