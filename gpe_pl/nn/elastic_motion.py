"""Motion of elastic bodies over a whole frame, with a constitutive law whose constants a network learns.

Elastic waves cross several cells within a frame, so forces at the start of a frame say little about the motion over it. Here the nodes of bodies move through a
frame in leapfrog substeps::

    y'' = f + Σ forces of cells / m,   y(0) = x(t),   y'(0) = velocity at the frame

f are the accelerations that the network predicts, constant over the frame, such as those of contacts with other bodies. Cells are neo-Hookean with a viscous
stress, as in ``solvers.fem.elements`` (Bonet & Wood 2008, section 6.4.3)::

    P = μ F + (λ log J − μ)/J cof F + η F (Fᵀ Ḟ + Ḟᵀ F)

A node that would enter the plane of its nearest wall loses just enough normal velocity to arrive on it. Walls may have an elastic layer in front of this plane.
With the thickness D it pushes a node at distance d with the acceleration ``k D δ² + c δ v``. δ = 1 − d/D is the relative depth, k the stiffness per mass, c the
damping per mass, and v the speed towards the wall, 0 for a node that moves away. The damping grows with the depth, as in Hunt & Crossley (1975, J. Appl. Mech.
42), so the force does not jump where the layer begins. Coulomb friction takes tangential velocity.

Bodies may act on each other (see ``nn.elastic_touch``). Cells that are torn at the start of a frame carry no forces. Forces of cells change neither the linear
nor the angular momentum of a body.

Units: time is in frames, length in m, and masses in any unit. λ and μ are in that unit of mass per m^(dim − 2) and frame², and η is in that times a frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gpe_pl.nn.elastic_kernels import DEEPEST, HEAVY, LOG_SMALLEST, TORN, move_forward, pull_back
from gpe_pl.nn.elastic_touch import Touching, touching_forces
from gpe_pl.nn.fused import works_on
from gpe_pl.trajectory.strain import HEXAHEDRON, POINTS_TO_CORNERS, SMALLEST_RATIO, shape_gradients

MAX_SUBSTEPS = 96
"""Largest number of substeps in a frame. Cells that need more are softened."""
STABLE = 0.7
"""Length of a substep as a fraction of the largest one that is proven to be stable at the start of the frame. Cells may stiffen within the frame."""
SOFTER = (1.0, 1 / 16, 1 / 256, 0.0)
"""Factors of the law of a scene that is unstable even with ``MAX_SUBSTEPS``, in this order. Cells that are crushed stiffen a hundredfold within a frame."""
LOGARITHM_SCALE = 5.0
"""The logarithms of constants are this factor times their weights, so that training finds the constants within some hundred steps."""
FIRST_GUESS = (10.0, 10.0, 0.1)
"""λ, μ and η before training, in units of density × (spacing/frame)²: waves cross a few cells in a frame."""
NEGLIGIBLE = 1e-8
"""η of cells that are not viscous, in the same unit."""


@dataclass(frozen=True)
class Cells:
    """Cells of the bodies of several scenes at rest, in double precision.

    Attributes:
        nodes: nodes of the corners [cell, corner].
        gradient: gradients of the shape functions at the quadrature points [cell, point, corner, dim] in 1/m.
        volume: rest volumes of these points [cell, point].
        rate: bound of the squared frequency of each cell per modulus [cell].
        scene: scene of each cell [cell].
        node_start: first node of each scene, and the number of nodes [scene + 1].
    """

    nodes: Int64[Tensor, "cell corner"]
    gradient: Float[Tensor, "cell point corner dim"]
    volume: Float[Tensor, "cell point"]
    rate: Float[Tensor, " cell"]
    scene: Int64[Tensor, " cell"]
    node_start: Int64[Tensor, " _"]

    @classmethod
    def of(
        cls,
        nodes: Int64[Tensor, "cell corner"],
        rest_pos: Float[Tensor, "node dim"],
        mass: Float[Tensor, " node"],
        scene: Int64[Tensor, " node"] | None,
    ) -> Cells:
        """Return cells of one kind at rest.

        Args:
            nodes: nodes of the corners, scene by scene.
            rest_pos: positions at rest [m].
            mass: masses of the nodes.
            scene: scene of each node, in ascending order; None stands for one scene.
        """
        device = rest_pos.device
        corners = rest_pos.detach().double().cpu().numpy()[nodes.cpu().numpy()]
        gradient, volume = (torch.from_numpy(a).to(device) for a in shape_gradients(corners))
        volume = volume.abs()  # cells of a mirror image are numbered the other way round
        whole = volume.sum(dim=1)
        around = mass.new_zeros(len(mass), dtype=torch.float64).index_add_(0, nodes.flatten(), whole.repeat_interleave(nodes.shape[1]))
        own_mass = mass.detach().double()[nodes] * whole[:, None] / around[nodes]
        rate = (volume[:, :, None] * gradient.square().sum(dim=3)).sum(dim=1).div(own_mass).sum(dim=1)
        of_node = torch.zeros(len(mass), dtype=torch.int64, device=device) if scene is None else scene
        sizes = torch.bincount(of_node, minlength=1)
        start = torch.cat([sizes.new_zeros(1), torch.cumsum(sizes, dim=0)])
        return cls(nodes, gradient, volume, rate, of_node[nodes[:, 0]], start)

    def to(self, device: torch.device) -> Cells:
        """Return the same cells on a device."""
        return self if self.nodes.device == device else Cells(*(getattr(self, f.name).to(device) for f in fields(self)))

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Nodes, gradients, volumes and rates of the cells, and the first cell and node of each scene, as contiguous arrays."""
        nodes, gradient, volume, rate, scene, node_start = (np.ascontiguousarray(getattr(self, f.name).numpy()) for f in fields(self))
        return nodes, gradient, volume, rate, np.searchsorted(scene, np.arange(self.num_scenes + 1)), node_start

    @cached_property
    def length(self) -> Float[Tensor, " scene"]:
        """Mean length of the cells of each scene [m], 0 in scenes without cells."""
        of_cell = self.volume.sum(dim=1).pow(1.0 / self.gradient.shape[3])
        total, count = of_cell.new_zeros(2, self.num_scenes).index_add_(1, self.scene, torch.stack([of_cell, torch.ones_like(of_cell)]))
        return total / count.clamp(min=1.0)

    @property
    def num_scenes(self) -> int:
        return self.node_start.shape[0] - 1

    def substeps(self, pos: Tensor, law: Law) -> tuple[Int64[Tensor, " scene"], Float[Tensor, " cell"]]:
        """Return the number of substeps of each scene, and how many times more than the largest number a cell needs, 1 if that number suffices.

        A substep h is stable while h² ω² + 2 h Γ ≤ 4, with ω the highest frequency and Γ the highest damping rate.
        """
        lam, mu, eta = (t.detach()[:, None] for t in law)
        corner = pos.detach()[self.nodes]
        f = torch.einsum("cai,cqaj->cqij", corner - corner[:, :1], self.gradient)
        ratio = _determinant(f, _cofactor(f)).clamp(min=SMALLEST_RATIO)
        first = (lam * ratio.log() - mu) / ratio
        second = (lam / ratio - first) / ratio
        square = f.square().sum(dim=(2, 3)) / f.shape[-1]
        stiffness = mu + torch.maximum(first.abs() * square.sqrt(), second * square ** (f.shape[-1] - 1) + first.abs())
        frequency = stiffness.amax(dim=1).clamp(min=0.0) * self.rate
        damping = (2.0 * eta * square * f.shape[-1]).amax(dim=1) * self.rate
        needed = 0.25 * (damping + (damping.square() + 4.0 * frequency).sqrt()) / STABLE
        largest = needed.new_zeros(self.num_scenes).scatter_reduce_(0, self.scene, needed.clamp(max=MAX_SUBSTEPS), "amax")
        return (largest - 1e-9).ceil().long().clamp(min=1), (needed / MAX_SUBSTEPS).clamp(1.0, 1e15)


Law = tuple[Tensor, Tensor, Tensor]
"""λ, μ and η of each cell [cell]."""


@dataclass(frozen=True)
class Walls:
    """The nearest wall of each node, as a plane that the node does not enter.

    Attributes:
        normal: outward normals [node, dim]; zero where no wall is near.
        gap: distances of the nodes from their planes [node] in m.
        friction: Coulomb coefficients [node].
        layer: thickness of the elastic layer in m, its stiffness per mass in 1/frame², and its largest damping per mass in 1/frame [node, 3]; None for none.
    """

    normal: Float[Tensor, "node dim"]
    gap: Float[Tensor, " node"]
    friction: Float[Tensor, " node"]
    layer: Float[Tensor, "node 3"] | None = None


@dataclass(frozen=True)
class Corners:
    """Convex corners of obstacles near edges of bodies in 2D, as pairs of a corner and an edge in the order of the scenes.

    Attributes:
        nodes: ends of the edge [pair, 2]; the body is on its left.
        point: position of the corner [pair, 2] in m.
        friction: Coulomb coefficient [pair].
    """

    nodes: Int64[Tensor, "pair 2"]
    point: Float[Tensor, "pair dim"]
    friction: Float[Tensor, " pair"]


class ElasticMotion(NamedTuple):
    """Motion over a frame, in double precision.

    Attributes:
        displacement: in m [node, dim].
        velocity: velocity at the end in m/frame [node, dim].
        law: the law of each cell [cell], softened where ``MAX_SUBSTEPS`` would not suffice or its scene was unstable, and zero in torn cells.
    """

    displacement: Float[Tensor, "node dim"]
    velocity: Float[Tensor, "node dim"]
    law: Law


def elastic_motion(
    pos: Float[Tensor, "node dim"],
    vel: Float[Tensor, "node dim"],
    forcing: Float[Tensor, "node dim"],
    mass: Float[Tensor, " node"],
    law: Law,
    cells: Cells,
    walls: Walls,
    corners: Corners | None = None,
    held: Bool[Tensor, "node dim"] | None = None,
    touching: Touching | None = None,
) -> ElasticMotion:
    """Return the motion over a frame.

    A scene whose substeps prove too long is computed again with ``MAX_SUBSTEPS``, and then with the softer laws of ``SOFTER``. Other scenes do not change.

    Args:
        pos: positions at the start [m].
        vel: velocities at the start [m/frame].
        forcing: accelerations by everything but cells and walls [m/frame²].
        mass: masses of the nodes. Derivatives with respect to them need the plain pass, which is slower.
        law: constants of each cell.
        cells: the cells.
        walls: planes that nodes do not enter.
        corners: points that do not pass edges of bodies; None stands for none. Derivatives take the place of their contact on the edge as constant.
        held: axes along which nodes keep their velocity, whatever acts on them; None stands for none.
        touching: nodes of different bodies that act on each other; None stands for none.
    """
    if corners is None:
        corners = Corners(cells.nodes.new_empty(0, 2), pos.new_empty(0, pos.shape[1]), pos.new_empty(0))
    softened, number = _softened_law(pos, law, cells)
    axis_mass, normal = mass.double()[:, None].expand_as(pos), walls.normal
    if held is not None:
        forcing, axis_mass = torch.where(held, 0.0, forcing), torch.where(held, HEAVY, axis_mass)
        normal = torch.where(held.any(dim=1, keepdim=True), 0.0, normal)  # walls do not move a held node
    gap = walls.gap.clamp(min=0.0)  # a node behind a plane is not pushed out at once
    touching = touching or Touching.nothing(pos)
    first, level = softened, torch.zeros_like(number)
    while True:
        layer = pos.new_zeros(len(pos), 3) if walls.layer is None else _stable_layer(walls.layer, number, cells)
        of_node = number.repeat_interleave(cells.node_start.diff(), output_size=len(pos))
        soft = touching.softened(mass.double(), of_node, vel.double())
        contacts = (normal, gap, walls.friction, layer, corners.point, corners.friction, soft.way, soft.law)
        values = [t.double() for t in (pos, vel, forcing, axis_mass, *softened, *contacts)]
        move: Any = _Motion.apply if works_on(*values) and not axis_mass.requires_grad else plain_motion
        displacement, velocity = move(*values, corners.nodes, soft.nodes, cells, number)
        again = _unstable(vel, forcing, layer, displacement, velocity, cells, number)
        again &= (number < MAX_SUBSTEPS) | (level + 1 < len(SOFTER))
        if not bool(again.any()):
            return ElasticMotion(displacement, velocity, softened)
        level = level + (again & (number == MAX_SUBSTEPS))
        number = torch.where(again, MAX_SUBSTEPS, number)
        factor = first[0].new_tensor(SOFTER)[level][cells.scene]
        softened = (first[0] * factor, first[1] * factor, first[2] * factor)


@torch.no_grad()
def _unstable(
    vel: Tensor, forcing: Tensor, layer: Tensor, displacement: Tensor, last_velocity: Tensor, cells: Cells, number: Tensor
) -> Bool[Tensor, " scene"]:
    """Tell in which scenes substeps were too long: a node became faster than start, forcing, and one cell and one layer per substep explain."""
    scene = torch.arange(cells.num_scenes, device=vel.device).repeat_interleave(cells.node_start.diff(), output_size=len(vel))

    def largest(x: Tensor) -> Tensor:
        size = x.double().norm(dim=1)
        size = torch.where(size.isfinite(), size, torch.inf)
        return size.new_zeros(cells.num_scenes).scatter_reduce_(0, scene, size, "amax")

    explained = largest(vel) + largest(forcing) + number * (cells.length + largest(layer[:, :1]))
    reached = torch.maximum(largest(displacement), largest(last_velocity))
    return (cells.length > 0) & ((reached > explained) | reached.isinf())


def _softened_law(pos: Float[Tensor, "node dim"], law: Law, cells: Cells) -> tuple[Law, Int64[Tensor, " scene"]]:
    """Return the law of each cell, softened where ``MAX_SUBSTEPS`` would not suffice and zero where it is torn, and the substeps of each scene."""
    corner = pos.detach().double()[cells.nodes]
    square = torch.einsum("cai,cqaj->cqij", corner - corner[:, :1], cells.gradient).square().sum(dim=(2, 3))
    intact = (square <= TORN**2).all(dim=1)
    lam, mu, eta = (torch.where(intact, constant.double(), 0.0) for constant in law)
    number, excess = cells.substeps(pos.double(), (lam, mu, eta))
    return (lam / excess**2, mu / excess**2, eta / excess), number


def plain_motion(
    pos: Tensor,
    vel: Tensor,
    forcing: Tensor,
    mass: Tensor,
    lam: Tensor,
    mu: Tensor,
    eta: Tensor,
    normal: Tensor,
    gap: Tensor,
    friction: Tensor,
    layer: Tensor,
    point: Tensor,
    point_friction: Tensor,
    way: Tensor,
    touch: Tensor,
    pair: Tensor,
    touch_nodes: Tensor,
    cells: Cells,
    number: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return displacement [m] and last velocity [m/frame] as ``elastic_motion`` does, by PyTorch's operations.

    The arguments are the fields of its arguments, but ``mass`` is per axis [node, dim]: a node that keeps its velocity along an axis is heavy there.
    ``number`` has the number of substeps of each scene; a scene with fewer than others stops earlier.
    """
    own = number.repeat_interleave(cells.node_start.diff(), output_size=len(pos))
    step = (1.0 / own.double())[:, None]
    touching = Touching(touch_nodes, way, touch)
    rounds = [torch.from_numpy(some).to(pos.device) for some in _in_rounds(pair, len(pos))]
    corners = [Corners(pair[some], point[some], point_friction[some]) for some in rounds]
    y, velocity = pos, vel
    for k in range(int(own.max()) + 1 if len(own) else 0):
        force = _internal(y, velocity, (lam, mu, eta), cells)
        if len(touch_nodes):
            force = force + touching_forces(y - pos, velocity, touching)
        total = forcing + force / mass
        half = torch.where(torch.logical_or(own == k, torch.full_like(own, k == 0, dtype=torch.bool)), 0.5, 1.0)[:, None]
        pushed = velocity + half * step * total
        moves = (own > k)[:, None]
        stopped = _stopped(pushed, y - pos, normal, gap, friction, layer, step[:, 0])
        stopped = _stopped_by_corners(stopped, y, mass, corners, step[:, 0])
        velocity = torch.where(moves, stopped, torch.where((own == k)[:, None], pushed, velocity))
        y = torch.where(moves, y + step * velocity, y)
    return y - pos, velocity


def _stable_layer(layer: Float[Tensor, "node 3"], number: Int64[Tensor, " scene"], cells: Cells) -> Float[Tensor, "node 3"]:
    """Return the layer of each node, softened where the substeps of its scene would be too long for it."""
    rate = number.repeat_interleave(cells.node_start.diff(), output_size=len(layer)).to(layer)
    thickness, stiffness, damping = layer.unbind(dim=1)
    return torch.stack([thickness, torch.minimum(stiffness, 0.5 * rate.square()), torch.minimum(damping, 0.5 * rate)], dim=1)


def _stopped(velocity: Tensor, moved: Tensor, normal: Tensor, gap: Tensor, friction: Tensor, layer: Tensor, step: Tensor) -> Tensor:
    """Return velocities after contact."""
    along = (velocity * normal).sum(dim=1)
    distance = gap + (moved * normal).sum(dim=1)
    thickness, stiffness, damping = layer.unbind(dim=1)
    has_layer = thickness > 0
    depth = torch.where(has_layer, 1.0 - distance / torch.where(has_layer, thickness, 1.0), 0.0).clamp(min=0.0)
    soft = step * (stiffness * thickness * depth.square() - damping * depth * along.clamp(max=0.0))
    change = torch.maximum(-distance / step - along, soft)
    hits = (change > 0) & (normal != 0).any(dim=1)
    tangential = velocity - along[:, None] * normal
    speed = tangential.square().sum(dim=1)
    slips = speed > (friction * change).square()
    left = torch.where(slips, 1.0 - friction * change / torch.where(slips, speed, 1.0).sqrt(), 0.0)
    return torch.where(hits[:, None], (along + change)[:, None] * normal + left[:, None] * tangential, velocity)


def _in_rounds(pair: Int64[Tensor, "pair 2"], num_nodes: int) -> Iterator[Int64[np.ndarray, " _"]]:
    """Yield the pairs in rounds: pairs of one round share no node, and pairs that share a node keep their order."""
    ends = pair.cpu().numpy()
    left = np.arange(len(ends))
    while len(left):
        first = np.full(num_nodes, len(ends))
        np.minimum.at(first, ends[left].ravel(), left.repeat(2))
        is_next = (first[ends[left]] == left[:, None]).all(axis=1)
        yield left[is_next]
        left = left[~is_next]


def _stopped_by_corners(velocity: Tensor, y: Tensor, mass: Tensor, corners: Sequence[Corners], step: Tensor) -> Tensor:
    """Return velocities after contacts of corners with edges, which are given by rounds of ``_in_rounds``."""
    for one in corners:
        ends = one.nodes.T
        with torch.no_grad():
            n, place, least, stop, hits = _corner_contact(y[ends], velocity[ends], one, step[ends[0]])
        weight, inertia = torch.stack([1 - place, place]), mass.amin(dim=1)[ends][:, :, None]
        factors = torch.where(hits, weight / inertia / (weight.square() / inertia).sum(dim=0), 0.0)
        here = (1 - place) * velocity[ends[0]] + place * velocity[ends[1]]
        along = (here * n).sum(dim=1, keepdim=True)
        change = (along - least) * n + stop * (here - along * n)
        velocity = velocity.index_add(0, ends.flatten(), -(factors * change).flatten(0, 1))
    return velocity


def _corner_contact(
    y: Float[Tensor, "2 pair dim"],
    velocity: Float[Tensor, "2 pair dim"],
    corners: Corners,
    step: Float[Tensor, " pair"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute contacts of corners with edges. Where there is none, all results are zero.

    Returns:
        Normal of the edge [pair, dim], place on the edge as a fraction of it [pair, 1], allowed velocity along the normal [pair, 1] in m/frame, fraction of the
        tangential velocity that stops [pair, 1], and whether there is a contact [pair, 1].
    """
    d, from_first = y[1] - y[0], corners.point - y[0]
    square = d.square().sum(dim=1)
    length = square.sqrt()
    place = (from_first * d).sum(dim=1) / square
    n = torch.stack([d[:, 1], -d[:, 0]], dim=1) / length[:, None]
    height = (from_first * n).sum(dim=1)
    here = (1 - place)[:, None] * velocity[0] + place[:, None] * velocity[1]
    along = (here * n).sum(dim=1)
    least = height.clamp(min=0.0) / step
    excess = along - least
    hits = (place >= 0) & (place <= 1) & (height > -DEEPEST * length) & (excess > 0)
    tangential = (here - along[:, None] * n).norm(dim=1)
    stop = (corners.friction * excess / tangential.clamp(min=1e-300)).clamp(max=1.0)
    where = hits[:, None]
    n, place, least, stop = (torch.where(where, value, 0.0) for value in (n, place[:, None], least[:, None], stop[:, None]))
    return n, place, least, stop, where


def _internal(y: Tensor, velocity: Tensor, law: Law, cells: Cells) -> Tensor:
    """Return the forces of the cells on their nodes."""
    lam, mu, eta = (t[:, None] for t in law)
    corner, speed = y[cells.nodes], velocity[cells.nodes]
    f = torch.einsum("cai,cqaj->cqij", corner - corner[:, :1], cells.gradient)
    d = torch.einsum("cai,cqaj->cqij", speed - speed[:, :1], cells.gradient)
    cofactor = _cofactor(f)
    ratio = _determinant(f, cofactor)
    safe = ratio.clamp(min=SMALLEST_RATIO)
    first = torch.where(
        ratio > SMALLEST_RATIO,
        (lam * safe.log() - mu) / safe,
        (lam * (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) - mu) / SMALLEST_RATIO,
    )
    viscous = f @ (f.mT @ d + d.mT @ f)
    stress = mu[:, :, None, None] * f + first[:, :, None, None] * cofactor + eta[:, :, None, None] * viscous
    force = -torch.einsum("cqij,cqaj,cq->cai", stress, cells.gradient, cells.volume)
    return torch.zeros_like(y).index_add(0, cells.nodes.flatten(), force.flatten(0, 1))


def cauchy_stress(pos: Float[Tensor, "node dim"], law: Law, cells: Cells) -> Float[Tensor, "node component"]:
    """Return the elastic Cauchy stress at nodes, the mean over the cells around a node by rest volume; zero at nodes without a cell.

    Components are in the order of ``schema.STRESS_COMPONENTS``, in the unit of λ and μ. Where J is below ``SMALLEST_RATIO``, the stress is relative to that
    fraction of the rest volume. A cell has its mean stress at all corners, as in ``solvers.fem.elements``. In hexahedra, which that solver does not have, the
    stress at the quadrature points is extrapolated to each corner, as finite-element programs do: the stress of bending is largest at the surface.

    Args:
        pos: positions [m].
        law: constants of each cell; η is not used.
        cells: the cells.
    """
    lam, mu = (t.double()[:, None] for t in law[:2])
    corner = pos.double()[cells.nodes]
    f = torch.einsum("cai,cqaj->cqij", corner - corner[:, :1], cells.gradient)
    ratio = _determinant(f, _cofactor(f))
    safe = ratio.clamp(min=SMALLEST_RATIO)
    volumetric = torch.where(
        ratio > SMALLEST_RATIO,
        lam * safe.log() - mu,
        (lam * (LOG_SMALLEST + (ratio - SMALLEST_RATIO) / SMALLEST_RATIO) - mu) * ratio / SMALLEST_RATIO,
    )
    left = f @ f.mT
    if f.shape[-1] == 2:  # plane strain: the third stretch is 1
        left = torch.nn.functional.pad(left, (0, 1, 0, 1)) + torch.diag(left.new_tensor([0.0, 0.0, 1.0]))
    whole = (mu[:, :, None, None] * left + volumetric[:, :, None, None] * torch.eye(3, dtype=f.dtype, device=f.device)) / safe[
        :, :, None, None
    ]
    rows, columns = ([0, 0, 1, 2], [0, 1, 1, 2]) if f.shape[-1] == 2 else ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
    where, count, size = cells.nodes.flatten(), cells.nodes.shape[1], cells.volume.sum(dim=1)
    if count == HEXAHEDRON:
        weighted = (
            torch.einsum("aq,cqk->cak", torch.from_numpy(POINTS_TO_CORNERS).to(whole), whole[:, :, rows, columns]) * size[:, None, None]
        )
    else:
        weighted = (cells.volume[:, :, None] * whole[:, :, rows, columns]).sum(dim=1, keepdim=True).expand(-1, count, -1)
    total = weighted.new_zeros(len(pos), len(rows)).index_add(0, where, weighted.flatten(0, 1))
    volume = weighted.new_zeros(len(pos)).index_add(0, where, size.repeat_interleave(count))
    return total / volume.clamp(min=torch.finfo(volume.dtype).tiny)[:, None]


def _cofactor(f: Tensor) -> Tensor:
    if f.shape[-1] == 2:
        return torch.stack([torch.stack([f[..., 1, 1], -f[..., 1, 0]], -1), torch.stack([-f[..., 0, 1], f[..., 0, 0]], -1)], -2)
    x, y, z = f.unbind(-2)
    return torch.stack([torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y)], -2)


def _determinant(f: Tensor, cofactor: Tensor) -> Tensor:
    return (f[..., 0, :] * cofactor[..., 0, :]).sum(dim=-1)


class _Motion(torch.autograd.Function):
    """``plain_motion`` in one compiled pass, forward and backward."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        *values, pair, touch_nodes, cells, number = inputs
        values = [t.detach().contiguous() for t in values]
        pos, arrays, most = values[0], [t.numpy() for t in values], int(number.max())
        nodes, gradient, volume, _, cell_start, node_start = cells.arrays
        path, speed_path, pushed = np.empty((most + 1, *pos.shape)), np.empty((most + 1, *pos.shape)), np.empty((most, *pos.shape))
        pairs, touching = np.ascontiguousarray(pair.numpy()), np.ascontiguousarray(touch_nodes.numpy())
        pair_start, touch_start = (
            np.searchsorted(np.searchsorted(node_start, of_scenes[:, 0], side="right") - 1, np.arange(cells.num_scenes + 1))
            for of_scenes in (pairs, touching)
        )
        geometry = (pairs, touching, nodes, gradient, volume, cell_start, node_start, pair_start, touch_start, number.numpy())
        contacts = np.zeros((most, len(pairs), 6))
        last_vel = np.empty_like(arrays[0])
        move_forward(*arrays, *geometry, path, speed_path, pushed, contacts, last_vel)
        ctx.save_for_backward(*values)
        ctx.geometry, ctx.paths = geometry, (path, speed_path, pushed, contacts)
        last = np.repeat(number.numpy(), np.diff(node_start))
        return torch.from_numpy(path[last, np.arange(len(pos))] - path[0]), torch.from_numpy(last_vel)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_last: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        pos, vel, forcing, mass, lam, mu, eta, normal, gap, friction, layer, _, _, way, touch = (t.numpy() for t in ctx.saved_tensors)
        found = [np.zeros_like(a) for a in (pos, vel, forcing, lam, mu, eta, gap, friction, layer, way, touch)]
        constants = (mass, lam, mu, eta, normal, gap, friction, layer, way, touch)
        pull_back(grad.contiguous().numpy(), grad_last.contiguous().numpy(), *ctx.paths, *constants, *ctx.geometry, *found)
        pos, vel, forcing, lam, mu, eta, gap, friction, layer, way, touch = (torch.from_numpy(g) for g in found)
        return pos, vel, forcing, None, lam, mu, eta, None, gap, friction, layer, None, None, way, touch, None, None, None, None


class Constants(nn.Module):
    """Learned constants λ, μ and η of a material. Their logarithms are affine in the standardised material parameters.

    Args:
        param_channels: number of material parameters.
        viscous: learn η; otherwise it stays ``NEGLIGIBLE``.
    """

    def __init__(self, param_channels: int, viscous: bool = True) -> None:
        super().__init__()
        guess = torch.tensor(FIRST_GUESS if viscous else (*FIRST_GUESS[:2], NEGLIGIBLE))
        self.num_learned = 3 if viscous else 2
        self.logarithm = nn.ParameterDict(  # nn.Linear warns if there are no parameters
            {"weight": torch.zeros(3, param_channels), "bias": guess.log() / LOGARITHM_SCALE}
        )

    def convert_units(self, stress: float, time: float) -> None:
        """Rewrite the constants for units of stress and time of which the previous ones were ``stress`` and ``time`` times as large. η is a stress × time."""
        shift = torch.tensor([stress, stress, stress * time], dtype=torch.float64).log() / LOGARITHM_SCALE
        self.logarithm["bias"][: self.num_learned] += shift[: self.num_learned].to(self.logarithm["bias"])

    def forward(self, params: Float[Tensor, "node param"]) -> tuple[Float[Tensor, " node"], Float[Tensor, " node"], Float[Tensor, " node"]]:
        """Return λ, μ and η, each from e⁻²⁰ to e²⁰."""
        weight, bias = (
            torch.cat([t[: self.num_learned], t[self.num_learned :].detach()]) for t in (self.logarithm["weight"], self.logarithm["bias"])
        )
        lam, mu, eta = (LOGARITHM_SCALE * nn.functional.linear(params, weight, bias)).clamp(-20.0, 20.0).exp().unbind(dim=1)
        return lam, mu, eta
