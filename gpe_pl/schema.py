"""Names shared by every layer: node types, relations, material parameters and stored fields.

This module imports only the standard library, so that solvers, store and models can agree on names without depending on each other.
"""

import math
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
class MaterialParameter:
    """One continuous parameter of a material.

    Attributes:
        name: column name in ``material_params``.
        unit: unit of the stored value.
        scale: how the parameter enters a model: ``linear``, or ``log`` for parameters that span decades.
    """

    name: str
    unit: str
    scale: Literal["linear", "log"]

    @property
    def rule(self) -> str:
        """Rule for stored values. Solvers accept a smaller range; see ``solvers.materials.LIMITS``."""
        return "positive and finite" if self.scale == "log" else "finite and not negative"

    def accepts(self, values: Any) -> Any:
        """Return a mask of the values of an array or tensor that follow the rule; for a number, whether it does."""
        return ((values > 0.0) if self.scale == "log" else (values >= 0.0)) & (values < LARGEST)


MATERIALS: dict[str, MaterialParameter] = {
    "sand": MaterialParameter("friction_angle", "deg", "linear"),
    "snow": MaterialParameter("hardening_coefficient", "1", "linear"),
    "fluid": MaterialParameter("kinematic_viscosity", "m^2/s", "log"),
    "elastomer": MaterialParameter("youngs_modulus", "Pa", "log"),
    "solid": MaterialParameter("youngs_modulus", "Pa", "log"),
}
"""Dynamic node types with their material parameter; the order fixes the integer codes of ``node_type``."""

MESH_MATERIALS = ("elastomer", "solid")
"""Materials whose nodes keep their neighbours. With ``graph.mesh`` their nodes are connected along mesh cells."""

CELL_KINDS: dict[str, tuple[int, int]] = {"triangle": (2, 3), "quadrilateral": (2, 4), "tetrahedron": (3, 4), "hexahedron": (3, 8)}
"""Dimension and number of corners of each kind of mesh cell. Corners are in VTK's order."""

BOUNDARY = "boundary"
NODE_TYPES: tuple[str, ...] = (*MATERIALS, BOUNDARY)
RADIUS, CELL, SAME, DOWN = "radius", "cell", "same", "down"
"""Relations: within a radius; in one mesh cell; neighbouring virtual nodes of one level; from a virtual node to its children (``up`` is the reverse)."""

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


def param_names(materials: tuple[str, ...]) -> tuple[str, ...]:
    """Return column names of ``material_params`` for a data set with these materials, without repetition, in schema order."""
    return tuple(dict.fromkeys(MATERIALS[m].name for m in MATERIALS if m in materials))


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
    "dimension of cells",  # 2 or 3, and at most the dimension of space
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
    "vel": Field(("frame", "node", "dim"), "float32", "m/s", "velocities of the dynamic nodes at the frame, from the solver"),
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
        "dimension of the cells: 2 for triangles and quadrilaterals, 3 for tetrahedra and hexahedra; by default that of space",
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
        param_channels: number of material parameters per material.
        relations: edge types that can occur.
        odd_channels: number of edge channels per relation that change sign when source and target swap. The first ``dim`` are the relative displacement.
        even_channels: number of edge channels per relation that do not change sign.
        stress_channels: number of components of the Cauchy stress, in the order of ``STRESS_COMPONENTS``, per material that has a stress.
        num_levels: number of levels of virtual nodes above meshes.
        islands: whether graphs contain the groups of connected nodes, and which groups touch nothing.
    """

    dim: int
    materials: tuple[str, ...]
    node_channels: dict[str, int]
    param_channels: dict[str, int]
    relations: tuple[EdgeType, ...]
    odd_channels: dict[EdgeType, int]
    even_channels: dict[EdgeType, int]
    stress_channels: dict[str, int] = field(default_factory=dict)
    num_levels: int = 0
    islands: bool = False

    @property
    def node_types(self) -> tuple[str, ...]:
        return (*self.materials, BOUNDARY, *(grid(level) for level in range(1, self.num_levels + 1)))

    @property
    def meshes(self) -> tuple[str, ...]:
        """Materials that are connected along their cells."""
        return tuple(source for source, name, _ in self.relations if name == CELL)
