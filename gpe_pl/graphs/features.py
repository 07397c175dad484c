"""Node and edge features, made dimensionless with the data set's own scales.

``paper``: the relative displacement only (paper, section 2.1). ``contact``: also the unit vector, the relative velocity, the gap in units of the rest
spacing, and how the pair meets a wall; odd channels change sign when source and target swap, even channels do not.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Float64
from pydantic import Field
from torch import Tensor

from gpe_pl.schema import BOUNDARY, FeatureSpec, param_names, radius_relations
from gpe_pl.trajectory import Boundary, Metadata, State

Features = Literal["paper", "contact"]

GAP_SCALE = 0.2
"""Gaps are resolved in units of this fraction of the rest spacing, …"""
GAP_LIMIT = 6.0
"""… and clipped here, so that the channel resolves contact and saturates beyond it."""
TINY = 1e-12


@dataclass(frozen=True)
class GraphConfig:
    """How states become graphs.

    Attributes:
        features: edge features, ``paper`` or ``contact``.
        history: velocities per node.
        connectivity_radius: neighbour radius [m]; None takes the data set's.
        trim_boundary: leave out boundary nodes without an edge, which cannot influence anything.
    """

    features: Features = "contact"
    history: Annotated[int, Field(ge=1, le=20)] = 5
    connectivity_radius: Annotated[float, Field(gt=0)] | None = None
    trim_boundary: bool = True


@dataclass(frozen=True)
class Scales:
    """Physical scales of a data set; everything that a feature is divided by."""

    radius: float
    spacing: float
    frame_dt: float

    @property
    def velocity(self) -> float:
        """One rest spacing per frame [m/s]."""
        return self.spacing / self.frame_dt

    @property
    def acceleration(self) -> float:
        """One rest spacing per frame squared [m/s²]."""
        return self.spacing / self.frame_dt**2


def scales_of(config: GraphConfig, metadata: Metadata) -> Scales:
    """Scales from the metadata, with the radius of the graph configuration if it names one."""
    return Scales(config.connectivity_radius or metadata.connectivity_radius, metadata.spacing, metadata.frame_dt)


def feature_spec(config: GraphConfig, metadata: Metadata) -> FeatureSpec:
    """Channel counts of the graphs that ``config`` makes of a data set."""
    dim = metadata.dim
    materials = tuple(m for m in metadata.materials)
    relations = radius_relations(materials)
    return FeatureSpec(
        dim=dim,
        materials=materials,
        node_channels={**dict.fromkeys(materials, (config.history + 1) * dim), BOUNDARY: 2 * dim + 2},
        param_channels={m: len(param_names((m,))) for m in materials},
        relations=relations,
        odd_channels=dict.fromkeys(relations, dim if config.features == "paper" else 3 * dim),
        even_channels=dict.fromkeys(relations, 0 if config.features == "paper" else 4),
    )


def material_features(velocity_history: Float64[Tensor, "node history dim"], gravity: Float64[Tensor, " dim"], scales: Scales) -> Tensor:
    """Motion and external acceleration of dynamic nodes [node, (history + 1) · dim].

    The history enters as the last velocity and the velocity changes before it: the same content as the velocities, but a change is a tenth of a velocity
    and would drown in its scale.
    """
    n = velocity_history.shape[0]
    changes = velocity_history[:, 1:] - velocity_history[:, :-1]
    motion = torch.cat([velocity_history[:, -1:], changes.flip(1)], dim=1).flatten(1) / scales.velocity
    return torch.cat([motion, (gravity / scales.acceleration).expand(n, -1)], dim=1).float()


def boundary_features(boundary: Boundary, scales: Scales) -> Tensor:
    """Velocity, normal and boundary condition of boundary nodes [boundary_node, 2 dim + 2]; friction μ enters as μ/(1+μ), so no-slip is 1."""
    friction = boundary.friction / (1 + boundary.friction)
    condition = torch.stack([friction, boundary.restitution], dim=1)
    return torch.cat([boundary.vel / scales.velocity, boundary.normal, condition], dim=1).float()


def edge_features(
    features: Features,
    displacement: Float64[Tensor, "edge dim"],
    relative_velocity: Float64[Tensor, "edge dim"],
    normal: Float[Tensor, "edge dim"] | None,
    scales: Scales,
) -> tuple[Float[Tensor, "edge odd"], Float[Tensor, "edge even"]]:
    """Odd and even edge channels.

    Args:
        features: which set.
        displacement: x_target − x_source [m].
        relative_velocity: v_target − v_source [m/s].
        normal: wall normal at the source for ``boundary`` edges, None between dynamic nodes.
        scales: units.
    """
    relative = displacement / scales.radius
    if features == "paper":
        return relative.float(), displacement.new_empty((len(displacement), 0)).float()
    distance = (displacement.square().sum(dim=1, keepdim=True) + TINY**2).sqrt()
    unit = displacement / distance  # zero for coincident nodes
    velocity = relative_velocity / scales.velocity
    gap = ((distance / scales.spacing - 1) / GAP_SCALE).clamp(-GAP_LIMIT, GAP_LIMIT)
    approach = (velocity * unit).sum(dim=1, keepdim=True)
    if normal is None:
        wall = displacement.new_zeros((len(displacement), 1))
        wall_approach = wall
    else:
        wall = (displacement * normal).sum(dim=1, keepdim=True) / scales.spacing
        wall_approach = (velocity * normal).sum(dim=1, keepdim=True)
    odd = torch.cat([relative, unit, velocity], dim=1)
    even = torch.cat([gap, approach, wall, wall_approach], dim=1)
    return odd.float(), even.float()


def history_of(state: State) -> Float64[Tensor, "node history dim"]:
    """Velocity history of a state, or its velocity alone."""
    return state.vel[:, None] if state.velocity_history is None else state.velocity_history
