"""Names shared by every layer: node types, relations, material parameters and stored fields.

This module imports only the standard library, so that solvers, store and models can agree on names without depending on each other.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

SCHEMA_VERSION = 2
"""Version of the HDF5 layout; a reader refuses any other."""

LARGEST = math.sqrt(3.4028234663852886e38)
"""Largest magnitude of stored values. Squares of larger numbers overflow float32, in which data are stored and trained on."""

STICKY = 1.0e6
"""Coulomb friction coefficient of a no-slip boundary. Larger values are no-slip too."""


HISTORY = 5
"""Default of ``graph.history``, the number of past velocities per node that a model sees."""


@dataclass(frozen=True)
class Limits:
    """Smallest (``low``) and largest value (``high``) of a material parameter that the solvers accept, in the unit of the parameter."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low:g} … {self.high:g}"


@dataclass(frozen=True)
class MaterialParameter:
    """One continuous parameter of a material.

    Attributes:
        name: column name in ``material_params``.
        unit: unit of the stored value.
        scale: how the parameter enters a model: ``linear``, or ``log`` for parameters that span decades.
        limits: limits of the solvers. Imported data may exceed them; ``rule`` says what can be stored.
        assumed: value that an importer stores if a source has none.
    """

    name: str
    unit: str
    scale: Literal["linear", "log"]
    limits: Limits
    assumed: float

    @property
    def rule(self) -> str:
        """Rule for stored values, as text for messages."""
        return "positive and finite" if self.scale == "log" else "finite and not negative"

    def accepts(self, values: Any) -> Any:
        """Return a mask of the values of an array or tensor that follow the rule; for a number, whether it does."""
        return ((values > 0.0) if self.scale == "log" else (values >= 0.0)) & (values < LARGEST)

    def quantity(self, value: Any) -> str:
        """Return a number, or text that stands for one, with the unit if there is one."""
        return (value if isinstance(value, str) else f"{value:g}") + ("" if self.unit == "1" else f" {self.unit}")


POISSON_RATIO = MaterialParameter("poisson_ratio", "1", "linear", Limits(0.0, 0.49), 0.3)

MATERIALS: dict[str, tuple[MaterialParameter, ...]] = {
    "sand": (
        MaterialParameter("friction_angle", "deg", "linear", Limits(0.0, 60.0), 30.0),
        MaterialParameter("cohesion", "Pa", "linear", Limits(0.0, 2e4), 0.0),
    ),
    "snow": (  # with larger critical strains, much elastic energy is stored when the snow hardens, and hardening multiplies it
        MaterialParameter("hardening_coefficient", "1", "linear", Limits(0.0, 30.0), 8.0),
        MaterialParameter("critical_compression", "1", "linear", Limits(1e-3, 0.2), 2.5e-2),
        MaterialParameter("critical_stretch", "1", "linear", Limits(1e-3, 0.2), 7.5e-3),
    ),
    "fluid": (MaterialParameter("kinematic_viscosity", "m^2/s", "log", Limits(1e-6, 10.0), 1e-3),),
    "elastomer": (MaterialParameter("youngs_modulus", "Pa", "log", Limits(1e3, 1e8), 1e5), POISSON_RATIO),
    "solid": (MaterialParameter("youngs_modulus", "Pa", "log", Limits(1e3, 1e9), 1e6), POISSON_RATIO),
}
"""Dynamic node types with their material parameters. The order of materials fixes the integer codes of ``node_type``.

Every data set stores the first parameter of its materials. It may store further ones; those that it does not store have the values of the solver's settings.
A name stands for one column, so materials with the same parameter store it together.
"""

MaterialValues = float | Mapping[str, float]
"""Value of the first parameter of a material, or values of its parameters by name."""

MESH_MATERIALS = ("elastomer", "solid")
"""Materials whose nodes keep their neighbours. With ``graph.mesh`` their nodes are connected along mesh cells."""

LOADS = ("motion", "sliding", "force")
"""What data sets can give of nodes as boundary conditions: the motion of nodes, their motion along some axes only, as on rollers, and forces on nodes.
Data sets with ``sliding`` have ``motion``, too.
"""

CELL_KINDS: dict[str, tuple[int, int]] = {
    "line": (1, 2),
    "triangle": (2, 3),
    "quadrilateral": (2, 4),
    "tetrahedron": (3, 4),
    "wedge": (3, 6),
    "hexahedron": (3, 8),
}
"""Dimension and number of corners of each kind of mesh cell. Corners are in VTK's order. Four corners are a quadrilateral or a tetrahedron."""

BOUNDARY = "boundary"
NODE_TYPES: tuple[str, ...] = (*MATERIALS, BOUNDARY)
RADIUS, CELL, SAME, DOWN = "radius", "cell", "same", "down"
"""Relations: within a radius; in one mesh cell; neighbouring virtual nodes of one level; from a virtual node to its children (``up`` is the reverse)."""
TOUCH_REACH = 5.0
"""Largest distance in rest spacings of nodes of different bodies that may touch within a frame. A smaller radius of the graph limits it."""

EdgeType = tuple[str, str, str]
"""``(source node type, relation, target node type)``."""

Split = Literal["train", "val", "test", "test_unseen"]
SPLITS: tuple[str, ...] = get_args(Split)
ParameterGroup = Literal["seen", "interpolated", "extrapolated"]


def grid(level: int) -> str:
    """Return the node type of the virtual nodes of a level. Level 1 is the first level above the mesh nodes."""
    return f"grid_{level}"


def level_of(node_type: str) -> int:
    """Return the level of the virtual nodes of a node type."""
    return int(node_type.removeprefix("grid_"))


def role(node_type: str) -> str:
    """Return the role of a node type. Types with the same role use the same statistics and weights.

    Virtual nodes of all levels have one role; every other node type has its own.
    """
    return "grid" if node_type.startswith("grid_") else node_type


def is_symmetric(relation: EdgeType) -> bool:
    """Whether the ends of an edge can be swapped: they have the same type, and neither is the parent of the other."""
    source, name, target = relation
    return source == target and name != DOWN


def node_code(name: str) -> int:
    """Return the integer code of a node type, as stored in ``node_type``."""
    return NODE_TYPES.index(name)


def param_names(materials: Iterable[str], further: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the column names of ``material_params`` for a data set with these materials, without repetition, in schema order.

    Args:
        materials: materials of the data set.
        further: names of the parameters that it stores besides the first ones of its materials.
    """
    chosen, further = set(materials), set(further)
    every = [(k, p.name) for m in MATERIALS if m in chosen for k, p in enumerate(MATERIALS[m])]
    return tuple(dict.fromkeys(name for k, name in every if k == 0 or name in further))


def stored_parameters(material: str, names: Sequence[str]) -> tuple[MaterialParameter, ...]:
    """Return the parameters of a material among the columns of a data set, in schema order."""
    return tuple(p for p in MATERIALS[material] if p.name in names)


def parameters_by_name(material: str, value: Any) -> dict[str, Any]:
    """Return the parameters of a material by name, in schema order; a value without a name is that of the first parameter.

    Raises:
        ValueError: the material has no such parameter, or the first one is missing. The message names it.
    """
    first, *_ = own = [p.name for p in MATERIALS[material]]
    named = dict(value) if isinstance(value, Mapping) else {first: value}
    for name in named:
        if name not in own:
            raise ValueError(f"{material} has no parameter {name!r}; it has {', '.join(own)}")
    if first not in named:
        raise ValueError(f"{material} needs {first}; only {', '.join(own[1:]) or 'no parameter'} may be left out")
    return {name: named[name] for name in own if name in named}


def radius_relations(materials: tuple[str, ...]) -> tuple[EdgeType, ...]:
    """Return all ``radius`` relations of a data set with these materials.

    Each unordered pair of node types appears once. ``boundary`` is always the source and has no relation with itself.
    """
    names = [m for m in MATERIALS if m in materials]
    pairs = [(a, RADIUS, b) for i, a in enumerate(names) for b in names[i:]]
    return (*pairs, *((BOUNDARY, RADIUS, m) for m in names))


def mesh_relations(materials: tuple[str, ...], num_levels: int) -> tuple[EdgeType, ...]:
    """Return relations of meshes: along cells, between virtual nodes of each level, and from virtual nodes to their children."""
    meshes = [m for m in MESH_MATERIALS if m in materials]
    if not meshes:
        return ()
    same = [(grid(level), SAME, grid(level)) for level in range(1, num_levels + 1)]
    down = [(grid(level), DOWN, grid(level - 1)) for level in range(2, num_levels + 1)]
    return (*((m, CELL, m) for m in meshes), *((grid(1), DOWN, m) for m in meshes if num_levels), *same, *down)


Values = Literal[
    "finite",  # magnitudes up to LARGEST
    "positive",
    "at least 0",
    "0 to 1",
    "unit vectors",
    "node types",  # of the data set's materials
    "parameters",  # finite if the node's material has the parameter, and positive if its scale is logarithmic
    "nodes of cells",  # rows of nodes; the number of different nodes is that of a kind of cell
    "numbers of bodies",  # −1 for none
    "one stretch",  # 0 or 1, and 1 in consecutive frames only
    "dimension of cells",  # 1, 2 or 3, and at most the dimension of space
]
"""Rules for the values of stored arrays. ``gpe_pl.trajectory.values`` checks them."""


@dataclass(frozen=True)
class Field:
    """A stored array.

    Attributes:
        dims: names of its axes.
        dtype: stored type.
        unit: unit of its values.
        doc: meaning of its values.
        required: whether every trajectory has it.
        values: rule for its values.
    """

    dims: tuple[str, ...]
    dtype: str
    unit: str
    doc: str
    required: bool = True
    values: Values = "finite"


STRESS_COMPONENTS = "xx, xy, yy, zz in plane strain; xx, xy, xz, yy, yz, zz in 3D"

MOTION = "one or frame"
"""Axis of boundary arrays: of length 1 if the boundary stands still, else one entry per frame of its prescribed motion."""

FIELDS: dict[str, Field] = {
    "pos": Field(("frame", "node", "dim"), "float32", "m", "positions of the dynamic nodes"),
    "vel": Field(
        ("frame", "node", "dim"),
        "float32",
        "m/s",
        "velocities of the dynamic nodes at the frame; in predictions of models that do not know them, their mean over the last frame",
    ),
    "node_type": Field(("node",), "uint8", "1", "index into the attribute node_types", values="node types"),
    "mass": Field(("node",), "float32", "kg", "mass (per metre of depth in 2D)", values="positive"),
    "material_params": Field(
        ("node", "param"), "float32", "per column", "columns as in param_names; NaN if a parameter does not apply", values="parameters"
    ),
    "boundary_pos": Field((MOTION, "boundary_node", "dim"), "float32", "m", "positions of the boundary nodes"),
    "boundary_vel": Field((MOTION, "boundary_node", "dim"), "float32", "m/s", "velocities of the boundary nodes, to the next frame"),
    "boundary_normal": Field(
        (MOTION, "boundary_node", "dim"), "float32", "1", "unit normals that point into free space", values="unit vectors"
    ),
    "boundary_friction": Field(
        ("boundary_node",), "float32", "1", f"Coulomb coefficient; {STICKY:g} or more is no-slip", values="at least 0"
    ),
    "boundary_restitution": Field(
        ("boundary_node",), "float32", "1", "fraction of the normal velocity that a bounce returns", values="0 to 1"
    ),
    "rest_pos": Field(("node", "dim"), "float32", "m", "undeformed positions of mesh nodes", required=False),
    "alive": Field(
        ("frame", "node"),
        "uint8",
        "1",
        "1 in the frames in which a node is in an open scene, which nodes enter and leave; in other frames its position and velocity have no meaning; "
        "without this field every node is in the scene in every frame",
        required=False,
        values="one stretch",
    ),
    "rigid_body": Field(
        ("node",),
        "int32",
        "1",
        "number of the rigid body that a node belongs to, -1 for none; the nodes of a body move by one rigid motion",
        required=False,
        values="numbers of bodies",
    ),
    "prescribed": Field(
        ("node",),
        "uint8",
        "1",
        "1 for nodes whose motion is given, such as clamped ones, and 0 for others; without it, no motion is given",
        required=False,
        values="0 to 1",
    ),
    "prescribed_axes": Field(
        ("node", "dim"),
        "uint8",
        "1",
        "1 along axes along which the motion of a node is given, and 0 along others; takes the place of prescribed if the motion of some node is given along "
        "some axes only, as on rollers",
        required=False,
        values="0 to 1",
    ),
    "force": Field(
        ("frame", "node", "dim"),
        "float32",
        "N",
        "forces on nodes from each frame to the next, without gravity (per metre of depth in 2D)",
        required=False,
    ),
    "cells": Field(
        ("cell", "corner"),
        "int32",
        "1",
        "node indices of each mesh cell; cells with fewer corners than others repeat their last node",
        required=False,
        values="nodes of cells",
    ),
    "cell_dim": Field(
        ("one",),
        "uint8",
        "1",
        "largest dimension of the cells: 1 for lines, 2 for triangles and quadrilaterals, 3 for tetrahedra, wedges and hexahedra; by default that of space",
        required=False,
        values="dimension of cells",
    ),
    "node_stress": Field(("frame", "node", "stress"), "float32", "Pa", f"Cauchy stress at nodes: {STRESS_COMPONENTS}", required=False),
    "cell_stress": Field(("frame", "cell", "stress"), "float32", "Pa", "Cauchy stress in cells, components as node_stress", required=False),
    "node_von_mises": Field(("frame", "node"), "float32", "Pa", "von Mises stress at nodes", required=False, values="at least 0"),
    "cell_von_mises": Field(("frame", "cell"), "float32", "Pa", "von Mises stress in cells", required=False, values="at least 0"),
}


@dataclass(frozen=True)
class FeatureSpec:
    """Channel counts of a data set's graphs, from which a model builds its layers.

    Attributes:
        dim: space dimension.
        materials: dynamic node types, in schema order.
        node_channels: number of channels of ``x`` per node type, including ``boundary``.
        parameters: stored parameters per material.
        relations: edge types that can occur.
        odd_channels: number of edge channels per relation that change sign when source and target swap. The first ``dim`` are the relative displacement.
        even_channels: number of edge channels per relation that do not change sign.
        stress_channels: number of components of the Cauchy stress, in the order of ``STRESS_COMPONENTS``, per material that has a stress.
        num_levels: number of levels of virtual nodes above meshes.
        islands: whether graphs contain the island of each node, and tell which islands a given motion or an opening moves.
        cells: whether graphs contain the cells of meshes and their rest shape.
        loads: loads of nodes that are features of the nodes of materials, names of ``LOADS``.
        reads_stress: whether the stress of the present frame is a feature of the nodes of materials that have one.
    """

    dim: int
    materials: tuple[str, ...]
    node_channels: dict[str, int]
    parameters: dict[str, tuple[MaterialParameter, ...]]
    relations: tuple[EdgeType, ...]
    odd_channels: dict[EdgeType, int]
    even_channels: dict[EdgeType, int]
    stress_channels: dict[str, int] = field(default_factory=dict)
    num_levels: int = 0
    islands: bool = False
    cells: bool = False
    loads: tuple[str, ...] = ()
    reads_stress: bool = False

    @property
    def param_channels(self) -> dict[str, int]:
        """Number of stored parameters per material."""
        return {material: len(own) for material, own in self.parameters.items()}

    @property
    def node_types(self) -> tuple[str, ...]:
        return (*self.materials, BOUNDARY, *(grid(level) for level in range(1, self.num_levels + 1)))

    @property
    def meshes(self) -> tuple[str, ...]:
        """Materials that are connected along their cells."""
        return tuple(source for source, name, _ in self.relations if name == CELL)
