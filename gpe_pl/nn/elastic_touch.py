"""Contact between elastic bodies of one material within a frame: forces between their nodes, with constants that a network learns.

Two nodes whose distance r is below the thickness D of the layer, at a depth ``δ = 1 − r/D``, act on each other with the force::

    f = (k D (δ² − a δ) − c δ w·n) n − b δ (w − w·n n)

n is the unit vector between them and w their relative velocity. In the material point method, bodies that are less than about three spacings apart
share nodes of the grid and so move alike. They resist being pushed together, stick a little when they separate, and do not slide freely. k is the
stiffness, a the adhesion, and c and b damp approach and sliding. Forces are opposite, so momentum is conserved. Angular momentum is not, where pairs slide.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from gpe_pl.nn.elastic_touch_kernels import CLOSEST
from gpe_pl.schema import TOUCH_REACH

SHARE = 0.5
"""Contacts of a node are softened until their squared frequency is at most this fraction of the squared number of substeps, and their rate of damping at most
this fraction of the number."""
APPROACH = 1.0 / 3.0
"""Least distance by which nodes are taken to approach within a frame, as a fraction of the thickness, for the estimate of these rates."""
MOST_ADHESION = 0.9
"""Largest adhesion. With 1, nodes would attract each other at any depth."""
FIRST = (0.1, 0.05, 1.0, 1.0)
"""Stiffness, adhesion and damping of approach and of sliding before training; the damping is a fraction of the critical one."""


@dataclass(frozen=True)
class Touching:
    """Pairs of nodes of different bodies that may touch within the frame, in the order of the scenes.

    Attributes:
        nodes: both nodes [pair, 2].
        way: vector from the second to the first at the start of the frame [pair, dim] in m.
        law: thickness [m], stiffness in mass/frame², adhesion, and damping of approach and of sliding in mass/frame [pair, 5].
    """

    nodes: Int64[Tensor, "pair 2"]
    way: Float[Tensor, "pair dim"]
    law: Float[Tensor, "pair 5"]

    @classmethod
    def nothing(cls, pos: Float[Tensor, "node dim"]) -> Touching:
        """Return no pairs, for nodes at ``pos``."""
        return cls(torch.empty(0, 2, dtype=torch.int64, device=pos.device), pos.new_empty(0, pos.shape[1]), pos.new_empty(0, 5))

    def softened(self, mass: Float[Tensor, " node"], number: Int64[Tensor, " node"], velocity: Float[Tensor, "node dim"]) -> Touching:
        """Return the same pairs, softened where the substeps would be too long for the contacts of a node.

        Args:
            mass: masses of the nodes.
            number: number of substeps in the scene of each node.
            velocity: velocities at the start of the frame [m/frame].
        """
        if not len(self.nodes):
            return self
        thickness, stiffness, adhesion, approach, sliding = self.law.unbind(dim=1)
        distance = torch.maximum(self.way.norm(dim=1), CLOSEST * thickness)
        closing = -((velocity[self.nodes[:, 0]] - velocity[self.nodes[:, 1]]) * self.way).sum(dim=1) / (distance * thickness)
        depth = (1.0 + closing.clamp(min=APPROACH) - distance / thickness).clamp(0.0, 1.0)
        softer = self._least(SHARE * number.double() ** 2 * mass, stiffness * (4.0 * depth + torch.where(depth > 0, 2.0 * adhesion, 0.0)))
        less = self._least(SHARE * number.double() * mass, 2.0 * torch.maximum(approach, sliding) * depth)
        one = torch.ones_like(softer)
        return Touching(self.nodes, self.way, self.law * torch.stack([one, softer, one, less, less], dim=1))

    def _least(self, most: Float[Tensor, " node"], value: Float[Tensor, " pair"]) -> Float[Tensor, " pair"]:
        """Return the factor that keeps the sum of a value over the pairs of both nodes below ``most``."""
        total = torch.zeros_like(most).index_add(0, self.nodes.flatten(), value.repeat_interleave(2))
        factor = (most / total.clamp(min=torch.finfo(most.dtype).tiny)).clamp(max=1.0)
        return factor[self.nodes].amin(dim=1)


def touching_forces(moved: Float[Tensor, "node dim"], velocity: Float[Tensor, "node dim"], touching: Touching) -> Float[Tensor, "node dim"]:
    """Return the forces on all nodes.

    Args:
        moved: way of the nodes since the start of the frame [m].
        velocity: velocities [m/frame].
        touching: the pairs.
    """
    first, second = touching.nodes.T
    thickness, stiffness, adhesion, approach, sliding = touching.law.T[:, :, None]
    x = touching.way + moved[first] - moved[second]
    w = velocity[first] - velocity[second]
    distance = torch.maximum(x.square().sum(dim=1, keepdim=True), (CLOSEST * thickness) ** 2).sqrt()
    depth = (1.0 - distance / thickness).clamp(min=0.0)
    n = x / distance
    along = (w * n).sum(dim=1, keepdim=True)
    push = stiffness * thickness * (depth.square() - adhesion * depth) - (approach - sliding) * depth * along
    force = push * n - sliding * depth * w
    return torch.zeros_like(moved).index_add(0, first, force).index_add(0, second, -force)


class BodyLayer(nn.Module):
    """Learned layer between bodies of a material. Its thickness is one value; the logarithms of the other constants are affine in the material parameters.

    Args:
        thickness: thickness before training, in rest spacings; 0 stands for no layer, which is not learned. It stays at most ``schema.TOUCH_REACH``.
        param_channels: number of material parameters.
        scale: factor of the logarithms, so that training finds them within some hundred steps.
    """

    def __init__(self, thickness: float, param_channels: int, scale: float) -> None:
        super().__init__()
        self.has_thickness, self.scale = thickness > 0, scale
        if self.has_thickness:
            self.log_thickness = nn.Parameter(torch.tensor(float(thickness)).log())
            self.logarithm = nn.ParameterDict(
                {"weight": torch.zeros(len(FIRST), param_channels), "bias": torch.tensor(FIRST).log() / scale}
            )

    @property
    def thickness(self) -> float:
        """Distance of nodes below which bodies push each other, in rest spacings; 0 without a layer."""
        return min(float(self.log_thickness.detach().exp()), TOUCH_REACH) if self.has_thickness else 0.0

    def law_of(
        self, nodes: Int64[Tensor, "pair 2"], params: Float[Tensor, "node param"], modulus: Float[Tensor, " node"], spacing: Tensor
    ) -> Float[Tensor, "pair 5"]:
        """Return the constants of pairs as ``Touching`` has them, means over both nodes.

        Args:
            nodes: nodes of the pairs.
            params: standardised material parameters.
            modulus: λ + 2μ in units of mean mass × spacing^(2 - dim) per frame².
            spacing: rest spacing [m].
        """
        logarithm = self.scale * nn.functional.linear(params, self.logarithm["weight"].to(params), self.logarithm["bias"].to(params))
        factor, adhesion, approach, sliding = logarithm.clamp(-20.0, 20.0).exp()[nodes].mean(dim=1).double().unbind(dim=1)
        thickness, adhesion = self.log_thickness.exp().clamp(max=TOUCH_REACH).to(factor), adhesion.clamp(max=MOST_ADHESION)
        stiffness = factor * modulus[nodes].mean(dim=1).double() / thickness
        critical = 2.0 * stiffness.sqrt()
        return torch.stack([(thickness * spacing).expand_as(factor), stiffness, adhesion, approach * critical, sliding * critical], dim=1)
