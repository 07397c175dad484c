"""Node and edge features. They are dimensionless: each is divided by a scale of the data set.

With ``paper``, edges have the relative displacement only (paper, section 2.1). With ``contact``, they also have the relative velocity, the gap (the distance
minus one rest spacing), the direction of walls, and in meshes the difference from the rest shape. Odd channels change sign when source and target are swapped;
even channels do not. Features have the double precision of states.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Float64, Int64
from pydantic import Field
from torch import Tensor

from gpe_pl.graphs.multiscale import levels_of
from gpe_pl.graphs.topology import GraphError
from gpe_pl.schema import (
    BOUNDARY,
    CELL,
    HISTORY,
    MESH_MATERIALS,
    RADIUS,
    EdgeType,
    FeatureSpec,
    grid,
    mesh_relations,
    radius_relations,
)
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

Features = Literal["paper", "contact"]
ParameterScale = Literal["linear"]
ScaleUse = Literal["one", "dimensional", "dimensionless"]

GAP_SCALE = 0.2
"""Unit of gaps in features, as a fraction of the rest spacing."""
GAP_LIMIT = 6.0
"""Largest gap in features, in the unit of gaps. Larger gaps are clipped, so that the channel resolves contacts."""
SCALE_CHANNELS = 2
"""Number of node channels with ``scales=dimensionless``, see ``Scales.numbers``."""
AHEAD_CHANNELS = 2
"""Number of even edge channels with ``scales=dimensionless``, see ``ahead_features``."""
TINY = 1e-12
"""Length given to an edge between coincident nodes, in rest spacings or widths of a level."""


@dataclass(frozen=True)
class GraphConfig:
    """Settings of the graphs of a data set.

    Attributes:
        features: edge features, ``paper`` or ``contact``.
        boundary_condition: boundary nodes have velocity, normal, friction and restitution. If false, they have only the velocity (paper).
        history: number of past velocities per node.
        connectivity_spacings: radius of the edges between nodes in rest spacings; None takes the data set's radius.
        parameter_scale: ``linear`` gives models the physical value of every material parameter, as the paper does. None takes the scale of each parameter
            in ``schema.MATERIALS``, which is logarithmic where values span decades.
        trim_boundary: leave out boundary nodes without an edge, which cannot influence anything.
        mesh: connect ``schema.MESH_MATERIALS`` along their cells and add levels of virtual nodes above them. If false, their nodes are particles like all
            others.
        num_levels: number of levels of virtual nodes; None takes as many as a body of the size of the domain needs for a single root.
        islands: find the connected groups of nodes, and those that a given motion or an opening moves; see ``nn.island_momentum``.
        cells: include the cells of meshes and their rest shape, for ``model.elastic``; needs ``mesh`` and ``islands``.
        scales: ``one`` if all data have one spacing and one frame interval. With ``dimensionless``, they may vary, and models get both as features (see
            ``Scales``). With ``dimensional``, they may vary, too, and models are not told.
        stress: nodes have the Cauchy stress of the present frame as features (see ``stress_features``); for models that predict it.
    """

    features: Features = "contact"
    boundary_condition: bool = True
    history: Annotated[int, Field(ge=1, le=20)] = HISTORY
    connectivity_spacings: Annotated[float, Field(gt=0)] | None = None
    parameter_scale: ParameterScale | None = None
    trim_boundary: bool = True
    mesh: bool = False
    num_levels: Annotated[int, Field(ge=0, le=20)] | None = None
    islands: bool = False
    cells: bool = False
    scales: ScaleUse = "one"
    stress: bool = False


@dataclass(frozen=True)
class Scales:
    """Physical scales of a scene, by which features are divided.

    Let h be the rest spacing, Δt the frame interval, and h₀ and Δt₀ those of the ``reference``. Lengths are divided by h, and accelerations by h₀/Δt₀². The
    unit of velocities depends on ``use``::

        one             h/Δt             the reference is the scene itself
        dimensional     h₀/Δt₀           a constant
        dimensionless   Δt h₀/Δt₀²       the velocity that the unit of acceleration gives in one frame

    Attributes:
        radius: radius of the edges between nodes [m].
        spacing: rest spacing [m].
        frame_dt: frame interval [s].
        reference: rest spacing [m] and frame interval [s] of the reference; None for the scene itself.
        use: as ``GraphConfig.scales``.
    """

    radius: float
    spacing: float
    frame_dt: float
    reference: tuple[float, float] | None = None
    use: ScaleUse = "one"

    @property
    def velocity(self) -> float:
        """Unit of velocities [m/s]."""
        if self.use == "dimensionless":
            return self.acceleration * self.frame_dt
        spacing, frame_dt = self.reference or (self.spacing, self.frame_dt)
        return spacing / frame_dt

    @property
    def acceleration(self) -> float:
        """Unit of accelerations [m/s²]."""
        spacing, frame_dt = self.reference or (self.spacing, self.frame_dt)
        return spacing / frame_dt**2

    @property
    def length_ratio(self) -> float:
        """Rest spacing over that of the reference. Masses of nodes are divided by its power of the dimension."""
        return 1.0 if self.reference is None else self.spacing / self.reference[0]

    @property
    def numbers(self) -> tuple[float, ...]:
        """Dimensionless numbers of the scene that models get as node features; none unless ``use`` is ``dimensionless``.

        They are log₂ of g Δt²/h (a Froude number) and of c Δt/h (the stiffness × frame / spacing), each over its value at the reference. Gravity g and the
        speed c of sound are those of the data set, so they cancel.
        """
        if self.use != "dimensionless":
            return ()
        spacing, frame_dt = self.reference or (self.spacing, self.frame_dt)
        length, time = self.spacing / spacing, self.frame_dt / frame_dt
        return math.log2(time**2 / length), math.log2(time / length)


def scales_of(config: GraphConfig, metadata: Metadata, reference: Metadata | None = None) -> Scales:
    """Return the scales of a scene, with the radius of the graph configuration if it names one.

    Args:
        config: settings of the graphs.
        metadata: metadata of the scene.
        reference: metadata of the reference, if spacing and frame interval may differ from it (``config.scales``).
    """
    own = config.connectivity_spacings
    radius = metadata.connectivity_radius if own is None else own * metadata.spacing
    if config.scales == "one":
        return Scales(radius, metadata.spacing, metadata.frame_dt)
    known = reference or metadata
    return Scales(radius, metadata.spacing, metadata.frame_dt, (known.spacing, known.frame_dt), config.scales)


def feature_spec(config: GraphConfig, metadata: Metadata) -> FeatureSpec:
    """Return the channel counts of a data set's graphs.

    Raises:
        GraphError: ``config.cells`` without ``mesh`` or ``islands``, several scales with meshes or loads, or ``config.stress`` without a stored stress.
    """
    if config.cells and not (config.mesh and config.islands):
        raise GraphError("graph.cells=true needs graph.mesh=true graph.islands=true; choose these, or law=none")
    dim, materials = metadata.dim, metadata.materials
    meshes = set(materials) & set(MESH_MATERIALS) if config.mesh else set()
    if config.scales != "one" and (meshes or metadata.loads):
        raise GraphError(f"graph.scales={config.scales}: works with particles only; set graph.mesh=false, or graph.scales=one")
    stress_channels = dict.fromkeys(metadata.with_stress, 4 if dim == 2 else 6)
    if config.stress and (not stress_channels or config.scales != "one"):
        raise GraphError(
            f"graph.stress=true: the data set stores no stress of {', '.join(materials)}; set graph.stress=false, or data.solver.stress=true for MPM"
            if not stress_channels
            else f"graph.scales={config.scales}: not with graph.stress=true; set one of them to its default"
        )
    if not meshes:
        num_levels = 0
    elif config.num_levels is not None:
        num_levels = config.num_levels
    else:
        num_levels = levels_of(metadata.longest_side, metadata.spacing)
    relations = (*radius_relations(materials), *(mesh_relations(materials, num_levels) if meshes else ()))
    motion = (config.history + 1) * dim
    virtual = {grid(level): motion + 1 for level in range(1, num_levels + 1)}
    is_told = config.scales == "dimensionless"
    channels = {r: _edge_channels(config.features, r, dim, is_told) for r in relations}
    loads = metadata.loads or ()
    of_loads = (1 + dim) * ("motion" in loads) + dim * ("sliding" in loads) + dim * ("force" in loads)
    return FeatureSpec(
        dim=dim,
        materials=materials,
        node_channels={
            **{m: motion + of_loads + SCALE_CHANNELS * is_told + config.stress * stress_channels.get(m, 0) for m in materials},
            BOUNDARY: 2 * dim + 2 if config.boundary_condition else dim,
            **virtual,
        },
        parameters={m: metadata.parameters_of(m) for m in materials},
        relations=relations,
        odd_channels={r: odd for r, (odd, _) in channels.items()},
        even_channels={r: even for r, (_, even) in channels.items()},
        stress_channels=stress_channels,
        num_levels=num_levels,
        islands=config.islands,
        cells=config.cells,
        loads=loads,
        reads_stress=config.stress,
    )


def _edge_channels(features: Features, relation: EdgeType, dim: int, is_told: bool) -> tuple[int, int]:
    """Return the numbers of odd and even channels of ``edge_features`` (``radius``) and ``mesh_features`` (all other relations)."""
    if features == "paper":
        return dim, 0
    if relation[1] == RADIUS:
        return 3 * dim, 4 + AHEAD_CHANNELS * is_told
    return 4 * dim, 3 if relation[1] == CELL else 4


def material_features(velocity_history: Float64[Tensor, "node history dim"], gravity: Float64[Tensor, " dim"], scales: Scales) -> Tensor:
    """Return motion and external acceleration of dynamic nodes [node, (history + 1) · dim], with ``Scales.numbers`` behind them if there are some.

    The velocity history enters as the last velocity and the earlier changes of velocity. A change is about a tenth of a velocity, so it would hardly be visible
    in the earlier velocities.
    """
    n = velocity_history.shape[0]
    changes = velocity_history[:, 1:] - velocity_history[:, :-1]
    motion = torch.cat([velocity_history[:, -1:], changes.flip(1)], dim=1).flatten(1) / scales.velocity
    features = torch.cat([motion, (gravity / scales.acceleration).expand(n, -1)], dim=1)
    return torch.cat([features, motion.new_tensor(scales.numbers).expand(n, -1)], dim=1) if scales.numbers else features


def boundary_features(config: GraphConfig, boundary: Boundary, scales: Scales) -> Tensor:
    """Return features of boundary nodes: velocity [node, dim], with ``boundary_condition`` also normal, friction and restitution [node, 2 dim + 2].

    Friction μ enters as μ/(1+μ), which is 1 for no-slip.
    """
    velocity = boundary.vel / scales.velocity
    if not config.boundary_condition:
        return velocity
    friction = boundary.friction / (1 + boundary.friction)
    return torch.cat([velocity, boundary.normal, torch.stack([friction, boundary.restitution], dim=1)], dim=1)


def boundary_values(x: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return velocities in features' units, normals and friction coefficients from what ``boundary_features`` returns with ``boundary_condition``."""
    velocity, normal, friction = x[:, :dim], x[:, dim : 2 * dim], x[:, 2 * dim].double()
    return velocity, normal, friction / (1 - friction)


def edge_features(
    features: Features,
    displacement: Float64[Tensor, "edge dim"],
    relative_velocity: Float64[Tensor, "edge dim"],
    normal: Float[Tensor, "edge dim"] | None,
    scales: Scales,
) -> tuple[Float[Tensor, "edge odd"], Float[Tensor, "edge even"]]:
    """Return odd and even channels of edges within the radius.

    With ``contact``, odd channels are the displacement, its direction and the relative velocity. Even channels are the gap, the relative velocity along the
    displacement, and the displacement and the relative velocity along the wall's normal, which are 0 between dynamic nodes.

    Args:
        features: ``paper`` or ``contact``.
        displacement: x_target − x_source [m].
        relative_velocity: v_target − v_source [m/s].
        normal: wall normal at the source for ``boundary`` edges, None between dynamic nodes.
        scales: scales of the data set.
    """
    relative = displacement / scales.radius
    if features == "paper":
        return relative, displacement.new_empty((displacement.shape[0], 0))
    distance = (displacement.square().sum(dim=1, keepdim=True) + (TINY * scales.spacing) ** 2).sqrt()
    unit = displacement / distance  # zero for coincident nodes
    velocity = relative_velocity / scales.velocity
    gap = ((distance / scales.spacing - 1) / GAP_SCALE).clamp(-GAP_LIMIT, GAP_LIMIT)
    approach = (velocity * unit).sum(dim=1, keepdim=True)
    if normal is None:
        wall = displacement.new_zeros((displacement.shape[0], 1))
        wall_approach = wall
    else:
        wall = (displacement * normal).sum(dim=1, keepdim=True) / scales.spacing
        wall_approach = (velocity * normal).sum(dim=1, keepdim=True)
    odd = torch.cat([relative, unit, velocity], dim=1)
    even = torch.cat([gap, approach, wall, wall_approach], dim=1)
    if scales.use == "dimensionless":
        even = torch.cat([even, ahead_features(displacement, relative_velocity, normal, scales)], dim=1)
    return odd, even


def ahead_features(
    displacement: Float[Tensor, "edge dim"],
    relative_velocity: Float[Tensor, "edge dim"],
    normal: Float[Tensor, "edge dim"] | None,
    scales: Scales,
) -> Float[Tensor, "edge 2"]:
    """Return the gap, and the distance along the wall's normal, that an edge would have one frame later if velocities stayed.

    They are in the unit of gaps and clipped like gaps. Without them, a model would have to multiply velocities by the frame interval. Arguments are those of
    ``edge_features``.
    """
    way = relative_velocity * scales.frame_dt
    distance = (displacement.square().sum(dim=1, keepdim=True) + (TINY * scales.spacing) ** 2).sqrt()
    later = distance + (way * displacement).sum(dim=1, keepdim=True) / distance
    wall = torch.zeros_like(later) if normal is None else ((displacement + way) * normal).sum(dim=1, keepdim=True)
    reached = torch.cat([later / scales.spacing - 1, wall / scales.spacing], dim=1)
    return (reached / GAP_SCALE).clamp(-GAP_LIMIT, GAP_LIMIT)


def virtual_features(
    velocity_history: Float64[Tensor, "node history dim"], level: Int64[Tensor, " node"], gravity: Float64[Tensor, " dim"], scales: Scales
) -> Tensor:
    """Return features of virtual nodes [node, (history + 1) · dim + 1].

    They are the features of material nodes (``material_features``) and the level, which is log₂ of the width of the node's box over the rest spacing.
    """
    return torch.cat([material_features(velocity_history, gravity, scales), level[:, None].double()], dim=1)


def mesh_features(
    features: Features,
    displacement: Float64[Tensor, "edge dim"],
    rest_displacement: Float64[Tensor, "edge dim"],
    relative_velocity: Float64[Tensor, "edge dim"],
    level: Int64[Tensor, " edge"] | None,
    scales: Scales,
) -> tuple[Float[Tensor, "edge odd"], Float[Tensor, "edge even"]]:
    """Return odd and even channels of mesh edges.

    Lengths are in units of the width of the level, so that all levels of a uniformly strained body have similar features.

    Let x be the displacement, X the displacement at rest and x̂ = x/|x|. Odd channels are x, the relative velocity, X and (|x| − |X|) x̂, which has the
    direction of a spring force. Even channels are |x| − |X|, the relative velocity along x̂ and |X|. Edges from virtual nodes also have the level.

    Args:
        features: ``paper`` or ``contact``.
        displacement: x_target − x_source [m].
        rest_displacement: displacement at rest [m].
        relative_velocity: v_target − v_source [m/s].
        level: level of the source; None for cell edges, whose width is one spacing.
        scales: scales of the data set.
    """
    width = scales.spacing if level is None else scales.spacing * torch.exp2(level.double())[:, None]
    relative, rest = _without_rounding(displacement / width), _without_rounding(rest_displacement / width)
    if features == "paper":
        return relative, relative.new_empty((relative.shape[0], 0))
    velocity = relative_velocity * scales.frame_dt / width
    length = (relative.square().sum(dim=1, keepdim=True) + TINY**2).sqrt()
    rest_length = rest.norm(dim=1, keepdim=True)
    unit, stretch = relative / length, length - rest_length  # the unit vector is zero for coincident nodes
    odd = [relative, velocity, rest, stretch * unit]
    even = [stretch, (velocity * unit).sum(dim=1, keepdim=True), rest_length]
    if level is not None:
        even.append(level[:, None].double())
    return torch.cat(odd, dim=1), torch.cat(even, dim=1)


def _without_rounding(displacement: Tensor) -> Tensor:
    """Return displacements in which components as small as rounding errors are zero. Virtual nodes above a lattice then lie exactly in rows."""
    return torch.where(displacement.abs() < 1e-9, 0.0, displacement)


def from_centre(pos: Float64[Tensor, "node dim"], island: Int64[Tensor, " node"], num_islands: int) -> Float64[Tensor, "node dim"]:
    """Return positions relative to the mean of their island [m]."""
    count = pos.new_zeros(num_islands, 1).index_add_(0, island, torch.ones_like(pos[:, :1]))
    centre = pos.new_zeros(num_islands, pos.shape[1]).index_add_(0, island, pos) / count
    return pos - centre[island]


def history_of(state: State) -> Float64[Tensor, "node history dim"]:
    """Return the velocity history of a state [m/s], or its velocity if there is no history."""
    return state.vel[:, None] if state.velocity_history is None else state.velocity_history
