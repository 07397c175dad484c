"""Unknowns of a scene: material parameters, an initial velocity, the direction of gravity. Optimisers see each as a number from 0 to 1 between its bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from array_api_compat import array_namespace

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.metrics import displacement
from gpe_pl.schema import MATERIALS, MaterialParameter, node_code
from gpe_pl.trajectory.boundary import search_tree
from gpe_pl.trajectory.cells import bodies, components
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from gpe_pl.viz.captions import materials_of, parameter_name, parameter_value

VELOCITY: Literal["velocity"] = "velocity"
GRAVITY: Literal["gravity"] = "gravity"
"""Names of unknowns that are no material parameters."""
BODY_SPACINGS = 1.5
"""Nodes without cells belong to one body if they are nearer than this in the first frame [spacings]."""
STEEPEST = 45.0
"""Largest tilt of the sought direction of gravity from the stored one towards each other axis [deg]. Two such tilts in 3D make 54.7 degrees together."""
AT_BOUND = 0.01
"""Answers nearer to a bound than this fraction of the range count as lying at the bound."""

PARAMETERS = {f"{material}.{parameter.name}" for material, own in MATERIALS.items() for parameter in own}
"""All names of material parameters."""

Bounds = Mapping[str, tuple[float, float]]
"""Lowest and highest value of unknowns, by name ``MATERIAL.PARAMETER``."""


class UnknownError(GpeError, ValueError):
    """Raised for an unknown that a scene does not have."""


@dataclass(frozen=True)
class Unknown:
    """One number that is sought.

    Attributes:
        name: ``MATERIAL.PARAMETER``, ``velocity.x`` or ``gravity.x``; with ``#1`` and so on for the bodies of a scene.
        label: name for readers.
        unit: unit as in ``schema.MATERIALS``.
        low, high: bounds.
        is_log: whether steps are taken in the logarithm.
        kind: what is replaced in a state.
        place: column of ``material_params``, or axis of the velocity or of gravity.
        nodes: rows of the nodes that have it.
        truth: stored value; NaN if it is not one value.
    """

    name: str
    label: str
    unit: str
    low: float
    high: float
    is_log: bool
    kind: Literal["parameter", "velocity", "gravity"]
    place: int
    nodes: np.ndarray
    truth: float = math.nan

    def coordinate(self, value: float) -> float:
        """Return the coordinate in which errors and intervals are measured: the value, or its natural logarithm."""
        return math.log(value) if self.is_log else value

    def value(self, coordinate: float) -> float:
        return math.exp(coordinate) if self.is_log else coordinate

    @property
    def range(self) -> float:
        """Length of the range between the bounds, in coordinates."""
        return self.coordinate(self.high) - self.coordinate(self.low)

    def at(self, z: Any) -> Any:
        """Return the value at a number from 0 to 1, or at a tensor of such numbers."""
        coordinate = self.coordinate(self.low) + z * self.range
        if not self.is_log:
            return coordinate
        return array_namespace(z).exp(coordinate) if hasattr(z, "shape") else math.exp(coordinate)

    def bound_of(self, z: float) -> str:
        """Return ``lower`` or ``upper`` if the answer lies at a bound, otherwise an empty text."""
        return "lower" if z < AT_BOUND else "upper" if z > 1 - AT_BOUND else ""

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        parameter = self._parameter
        return f"{value:.3g} {self.unit}" if parameter is None else parameter_value(parameter, float(f"{value:.3g}"))

    def possible(self, value: float) -> float:
        """Return the value nearest to another one that is within the limits of the solvers or the bounds, whichever are wider."""
        parameter = self._parameter
        if parameter is None:
            return value
        return min(max(value, min(self.low, parameter.limits.low)), max(self.high, parameter.limits.high))

    @property
    def _parameter(self) -> MaterialParameter | None:
        """The material parameter that is sought; None for a velocity or a direction."""
        material, _, rest = self.name.partition(".")
        own = MATERIALS.get(material, ()) if self.kind == "parameter" else ()
        return next((parameter for parameter in own if parameter.name == rest.partition("#")[0]), None)


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a scene, in the order of the numbers from 0 to 1 that an optimiser changes."""

    items: tuple[Unknown, ...]

    def __len__(self) -> int:
        return len(self.items)

    @property
    def needs_start(self) -> bool:
        """Whether rollouts have to start at the first frame, because its velocity is sought."""
        return any(u.kind == VELOCITY for u in self.items)

    def applied(self, state: State, z: Any) -> State:
        """Return a state with the values at ``z`` [unknown]; all arrays are of the same library. Gradients pass to ``z``.

        A state whose velocity is sought has no velocity history.
        """
        params, vel, gravity = 1 * state.material_params, 1 * state.vel, 1 * state.gravity
        tilted = 0 * gravity
        for k, unknown in enumerate(self.items):
            value = unknown.at(z[k])
            if unknown.kind == "parameter":
                params[unknown.nodes, unknown.place] = value
            elif unknown.kind == VELOCITY:
                vel[unknown.nodes, unknown.place] = value
            else:
                tilted = tilted + array_namespace(z).tan(value * (math.pi / 180)) * _across(gravity, unknown.place)
        if any(u.kind == GRAVITY for u in self.items):
            size = (gravity**2).sum() ** 0.5
            gravity = gravity + size * tilted
            gravity = gravity * (size / (gravity**2).sum() ** 0.5)
        return replace(state, material_params=params, vel=vel, gravity=gravity)


def _across(gravity: Any, axis: int) -> Any:
    """Return the unit vector [dim] across gravity towards an axis, so that tilts are angles also if gravity is not along an axis."""
    direction = gravity / (gravity**2).sum() ** 0.5
    found = -direction[axis] * direction
    found[axis] = found[axis] + 1
    return found / (found**2).sum() ** 0.5


def unknowns_of(
    trajectory: Trajectory,
    wanted: Sequence[str] | str | None,
    ranges: Bounds,
    per_body: bool = False,
    first_frame: int = 0,
    stored: Trajectory | None = None,
) -> Unknowns:
    """Return the unknowns of a scene.

    Args:
        trajectory: the observed scene.
        wanted: names ``MATERIAL``, ``MATERIAL.PARAMETER``, ``velocity`` or ``gravity``, or one such name; None takes all parameters of all
            materials of the scene.
        ranges: bounds of material parameters by name ``MATERIAL.PARAMETER``.
        per_body: give each body values of its own.
        first_frame: frame in which nodes near each other are one body.
        stored: the scene as it is stored, whose values become ``truth``, if the observed one was completed from parts of it.

    Raises:
        UnknownError: the scene has no such unknown, or a parameter has no bounds. The message names it.
    """
    found: list[Unknown] = []
    groups = scene_bodies(trajectory, first_frame) if per_body else []
    names = [wanted] if isinstance(wanted, str) else wanted
    for name in materials_of(trajectory) if names is None else names:
        material, _, parameter = name.partition(".")
        if material in (VELOCITY, GRAVITY) and parameter:
            raise UnknownError(f"unknowns: {name!r}: {material} has no parts; write {material}")
        if material == VELOCITY:
            found += _velocities(trajectory, groups, (stored or trajectory).vel[0])
        elif material == GRAVITY:
            found += _gravity(trajectory)
        else:
            found += _parameters(trajectory, material, parameter, ranges, groups)
    if not found:
        raise UnknownError("unknowns=[]: name at least one, such as sand.friction_angle")
    named = [unknown.name for unknown in found]
    if twice := [name for name in named if named.count(name) > 1]:
        raise UnknownError(f"unknowns: {twice[0]} is named twice; name a parameter, or its material, once")
    return Unknowns(tuple(found))


def check_bounds(bounds: Bounds, metadata: Metadata) -> None:
    """Raise an error for bounds of a parameter that no scene of a data set has.

    Raises:
        UnknownError: a name is no parameter, or is one of another material. The message names it.
    """
    own = {f"{material}.{parameter.name}" for material in metadata.materials for parameter in metadata.parameters_of(material)}
    for name in sorted(set(bounds) - own):
        if name not in PARAMETERS:
            raise UnknownError(f"bounds: {name!r} is no MATERIAL.PARAMETER{did_you_mean(name, sorted(PARAMETERS))}")
        raise UnknownError(f"bounds: {name} is no unknown of these scenes, which have {', '.join(sorted(own))}; leave it out")


def scene_bodies(trajectory: Trajectory, frame: int = 0) -> list[np.ndarray]:
    """Return the nodes of each body in a frame: connected by cells, or within ``BODY_SPACINGS`` and of one material.

    Nodes without cells belong to the mesh of their material that they lie beside.
    """
    num_nodes = trajectory.num_nodes
    meshes = [] if trajectory.cells is None else bodies(trajectory.cells, num_nodes)
    free = np.setdiff1d(np.arange(num_nodes), np.concatenate([*meshes, np.zeros(0, dtype=np.int64)]).astype(np.int64))
    if not len(free):
        return meshes
    tree = search_tree(trajectory.pos[frame, free].astype(np.float64), trajectory.metadata.periodicity)
    pairs = tree.query_pairs(BODY_SPACINGS * trajectory.metadata.spacing, output_type="ndarray")
    kind = trajectory.node_type[free]
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]].astype(np.int64)
    number, label = components(pairs.T, len(free))
    loose = [free[label == k] for k in range(number)]
    beside = [_mesh_beside(trajectory, frame, meshes, own) for own in loose]
    joined = [np.concatenate([mesh, *(own for own, at in zip(loose, beside, strict=True) if at == k)]) for k, mesh in enumerate(meshes)]
    return [*map(np.sort, joined), *(own for own, at in zip(loose, beside, strict=True) if at is None)]


def _mesh_beside(trajectory: Trajectory, frame: int, meshes: list[np.ndarray], loose: np.ndarray) -> int | None:
    """Return the number of the mesh of the same material with the nearest node to ``loose`` nodes, within ``BODY_SPACINGS``; None if there is none."""
    nearest, most = None, BODY_SPACINGS * trajectory.metadata.spacing
    pos = trajectory.pos[frame].astype(np.float64)
    for k, mesh in enumerate(meshes):
        if trajectory.node_type[mesh[0]] == trajectory.node_type[loose[0]]:
            ways = trajectory.metadata.periodicity.shortest(pos[loose, None] - pos[mesh])
            distance = float(np.linalg.norm(ways, axis=-1).min())
            if distance <= most:
                nearest, most = k, distance
    return nearest


def _grouped(rows: np.ndarray, groups: list[np.ndarray]) -> list[tuple[str, str, np.ndarray]]:
    """Return name suffix, label suffix and nodes of each body among rows; one entry without suffix if there are no bodies."""
    if not groups:
        return [("", "", rows)]
    own = [np.intersect1d(rows, group) for group in groups]
    own = [nodes for nodes in own if len(nodes)]
    return [(f"#{k}", f", body {k}", nodes) for k, nodes in enumerate(own, start=1)]


def _parameters(trajectory: Trajectory, material: str, parameter: str, ranges: Bounds, groups: list[np.ndarray]) -> list[Unknown]:
    metadata = trajectory.metadata
    own = materials_of(trajectory)
    if material not in own:
        raise UnknownError(
            f"unknowns: {material!r} is no material of the scene; it has {', '.join(own)}, and also {VELOCITY} and {GRAVITY}"
        )
    stored = dict(zip((p.name for p in metadata.parameters_of(material)), metadata.columns_of(material), strict=True))
    if parameter and parameter not in stored:
        raise UnknownError(f"unknowns: {material} has no stored parameter {parameter!r}; it has {', '.join(stored)}")
    found, rows = [], np.flatnonzero(trajectory.node_type == node_code(material))
    for spec in metadata.parameters_of(material):
        name = f"{material}.{spec.name}"
        if parameter not in ("", spec.name):
            continue
        _check_range(name, spec, ranges.get(name))
        for suffix, label, nodes in _grouped(rows, groups):
            values = np.unique(trajectory.material_params[nodes, stored[spec.name]])
            truth = float(values[0]) if len(values) == 1 else math.nan
            found.append(
                Unknown(
                    name + suffix, f"{parameter_name(spec)} of {material}{label}", spec.unit, *ranges[name], spec.scale == "log",
                    "parameter", stored[spec.name], nodes, truth,
                )
            )  # fmt: skip
    return found


def _check_range(name: str, spec: MaterialParameter, bounds: tuple[float, float] | None) -> None:
    if bounds is None or not all(map(math.isfinite, bounds)) or bounds[0] == bounds[1]:
        raise UnknownError(f"{name}: has no range in training; give one with bounds='{{{name}:[LOW,HIGH]}}'")
    low, high = bounds
    if low > high:
        raise UnknownError(f"bounds of {name}: [{low:g}, {high:g}]: the first must be below the second")
    if not (spec.accepts(low) and spec.accepts(high)):
        raise UnknownError(f"bounds of {name}: [{low:g}, {high:g}]: must be {spec.rule}")


def _velocities(trajectory: Trajectory, groups: list[np.ndarray], stored: np.ndarray) -> list[Unknown]:
    """``stored`` are the stored velocities in the first frame [node, dim]; nodes of a body that differ have no true value."""
    pos = trajectory.pos.astype(np.float64)
    steps = np.abs(displacement(pos[1:], pos[:-1], trajectory.metadata)) / trajectory.metadata.frame_dt
    steps = steps[np.isfinite(steps).all(axis=(1, 2))]
    if not len(steps):
        raise UnknownError(f"unknowns: {VELOCITY}: the trajectory has no two successive frames with finite positions")
    fastest = 1.5 * float(np.quantile(steps.max(axis=(1, 2)), 0.95)) + 1e-6
    return [
        Unknown(f"{VELOCITY}.{axis}{suffix}", f"initial velocity {axis}{label}", "m/s", -fastest, fastest, False, VELOCITY, k, nodes, truth)
        for suffix, label, nodes in _grouped(np.arange(trajectory.num_nodes), groups)
        for k, axis in enumerate("xyz"[: trajectory.metadata.dim])
        for values in [stored[nodes, k].astype(np.float64)]
        for truth in [float(values.mean()) if np.ptp(values) <= 1e-5 * max(1e-3, np.abs(values).max()) else math.nan]
    ]


def _gravity(trajectory: Trajectory) -> list[Unknown]:
    gravity = np.abs(np.asarray(trajectory.metadata.gravity))
    if not gravity.any():
        raise UnknownError(f"unknowns: {GRAVITY}: the scene has no gravity whose direction could be sought; leave it out")
    return [
        Unknown(
            f"{GRAVITY}.{axis}", f"tilt of gravity to {axis}", "deg", -STEEPEST, STEEPEST, False, GRAVITY, k, np.zeros(0, np.int64), 0.0
        )
        for k, axis in enumerate("xyz"[: trajectory.metadata.dim])
        if k != int(gravity.argmax())
    ]
