"""Interface of importers, and functions that several of them use.

An importer provides the facts of a data set, and its trajectories one by one. Each trajectory can be refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from gpe_pl.data.importers.given_values import merged, replaced
from gpe_pl.errors import GpeError
from gpe_pl.files import regular_files
from gpe_pl.files.json_text import parsed
from gpe_pl.files.names import DataName
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.schema import BOUNDARY, MATERIALS, NODE_TYPES, MaterialValues, Split, parameters_by_name
from gpe_pl.trajectory.arrays import estimated_normals, numbers
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.trajectory import Trajectory

Format = Literal["gns", "lagrangebench", "meshgraphnets", "dpinet", "dmcf", "calculix", "meshio", "thermognn", "arrays"]

ASSUMED_FRICTION = 0.5
"""Friction coefficient that is stored if a source has none."""

SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest length or time of a source that is positive in the stored precision."""

STILL = 1e-2
"""Boundary nodes are still, or slide steadily, if they never deviate from this motion by more than this fraction of the spacing."""

WIDEST = 1.05
"""A warning is given if the nodes of the first frame extend over more than this number of periods along a periodic axis."""

MAX_JSON_BYTES = 2**24
MAX_TRAJECTORIES = 100_000
"""Maximum number of trajectories in one file. A file of 100 MB can name millions of empty ones."""


class ImportFailure(GpeError, ValueError):
    """Raised when a source cannot be imported at all; the message names the file and says what to do."""


class Refusal(GpeError, ValueError):
    """Raised when one trajectory of a source cannot be used; ``frame`` is -1 if the reason concerns no particular frame."""

    def __init__(self, reason: str, frame: int = -1) -> None:
        super().__init__(reason)
        self.frame = frame


@dataclass(frozen=True)
class ImportSettings:
    """Settings of an import. Values that are not None override the source, or add what it lacks.

    Attributes:
        format: format of the source.
        source: file or folder.
        name: name of the data set, which becomes a folder; None takes the name of the source.
        frame_dt: time between frames [s].
        bounds: ``[low, high]`` of the domain per axis [m].
        periodic: whether space repeats, per axis.
        gravity: external acceleration per axis [m/s²].
        spacing: rest spacing of neighbours [m].
        connectivity_radius: radius of the edges between nodes [m].
        walls: friction of walls at the bounds, by side (``x_low``, ``x_high``, …); ``{}`` for no walls.
        materials: material, or ``boundary``, of node types of the source, by their number. Other types keep the material of the format.
        parameters: parameters by material: a number for the first one, or several by name. Values that a trajectory of the source has itself override them.
        arrays: names of arrays in the files of ``meshio``, by what they are, such as ``displacement``.
        max_trajectories: maximum number of trajectories per split, from its start.
        splits: numbers of the trajectories of each split, from 0 over all trajectories of the source; see ``splits.arranged``.
        leave_out: number of the trajectory that becomes ``test``, while all others are for training; one number after the other gives a leave-one-out test.
        holdout: fraction of the training trajectories that becomes each of ``val`` and ``test`` if the source has none, at least one trajectory; 0 for none.
        allow_pickle: read object arrays, which can run code. Use it only for files that you trust.
    """

    format: Format
    source: str
    name: DataName | None = None
    frame_dt: Annotated[float, Field(gt=0)] | None = None
    bounds: list[tuple[float, float]] | None = None
    periodic: list[bool] | None = None
    gravity: list[float] | None = None
    spacing: Annotated[float, Field(gt=0)] | None = None
    connectivity_radius: Annotated[float, Field(gt=0)] | None = None
    walls: dict[str, Annotated[float, Field(ge=0)]] | None = None
    materials: dict[int, str] | None = None
    parameters: dict[str, float | dict[str, float]] | None = None
    arrays: dict[str, str] | None = None
    max_trajectories: Annotated[int, Field(ge=1)] | None = None
    splits: dict[Split, list[Annotated[int, Field(ge=0)]]] | None = None
    leave_out: Annotated[int, Field(ge=0)] | None = None
    holdout: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    allow_pickle: bool = False

    def __post_init__(self) -> None:
        wrong = sorted({*(self.materials or {}).values()} - {*NODE_TYPES}) + sorted({*(self.parameters or {})} - {*MATERIALS})
        if wrong:
            raise ValueError(f"unknown material {wrong[0]!r}; known: {', '.join(NODE_TYPES)}")
        for material, values in (self.parameters or {}).items():
            try:
                parameters_by_name(material, values)
            except ValueError as error:
                raise ValueError(f"parameters.{material}: {error}") from None
        sides = [f"{axis}_{side}" for axis in "xyz" for side in ("low", "high")]
        if self.walls and not {*self.walls} <= {*sides}:
            raise ValueError(f"walls: unknown side {min({*self.walls} - {*sides})!r}; known: {', '.join(sides)}")


@dataclass(frozen=True)
class Facts:
    """Facts that all trajectories of a data set share; None if unknown.

    Attributes:
        frame_dt: time between frames [s].
        bounds: ``(low, high)`` of the domain per axis [m].
        periodic: whether space repeats, per axis.
        gravity: external acceleration per axis [m/s²].
        spacing: rest spacing of neighbours [m].
        connectivity_radius: radius of the edges between nodes [m].
        walls: friction of walls at the bounds, by side.
        parameters: parameters by material that are the same in all trajectories: a number for the first one, or several by name.
        usual_gravity: usual gravity of the format per axis [m/s²]. It is used if neither the source nor a setting states one, unless groups of nodes in free
            flight show another one.
        notes: assumptions and omissions that concern the whole data set, one sentence each.
    """

    frame_dt: float | None = None
    bounds: tuple[tuple[float, float], ...] | None = None
    periodic: tuple[bool, ...] | None = None
    gravity: tuple[float, ...] | None = None
    spacing: float | None = None
    connectivity_radius: float | None = None
    walls: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, MaterialValues] = field(default_factory=dict)
    usual_gravity: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()

    @property
    def periodicity(self) -> Periodicity:
        return NOWHERE if self.bounds is None or self.periodic is None else Periodicity(self.bounds, self.periodic)

    def overridden(self, settings: ImportSettings) -> Facts:
        """Return these facts, overridden by the settings."""
        names = ("frame_dt", "bounds", "periodic", "gravity", "spacing", "connectivity_radius", "walls")
        given = {name: getattr(settings, name) for name in names if getattr(settings, name) is not None}
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
        notes = (*self.notes, *(f"{name} = {value} was given" for name, value in given.items()))
        return replace(self, **given, parameters=merged(self.parameters, settings.parameters or {}), notes=notes)


@dataclass(frozen=True)
class Repair:
    """A change that was necessary to store a trajectory.

    Attributes:
        what: the change, in words.
        frame: first changed frame, or -1 if the change does not concern a particular frame.
    """

    what: str
    frame: int = -1


@dataclass(frozen=True)
class Loaded:
    """A trajectory that was read.

    Attributes:
        trajectory: the trajectory.
        repairs: changes to the trajectory.
        notes: assumptions about the whole data set.
        warnings: what looks wrong about the trajectory.
        assumes_gravity: whether its gravity is the usual one of the format, because neither source nor settings state one.
        types: node types of the source that occur in it, if the format has such types.
    """

    trajectory: Trajectory
    repairs: tuple[Repair, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    assumes_gravity: bool = False
    types: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Item:
    """One trajectory of a source: its ``name``, and ``load``, which reads it. ``load`` raises ``Refusal`` or ``ArrayError`` if it cannot be used."""

    name: str
    load: Callable[[Facts], Loaded]


@dataclass(frozen=True)
class Source:
    """A data set in a public format.

    Attributes:
        facts: facts that all trajectories share.
        splits: trajectories of each split.
        warnings: what looks wrong about the whole data set.
    """

    facts: Facts
    splits: Mapping[str, Sequence[Item]]
    warnings: tuple[str, ...] = ()


# --- functions for several formats ---------------------------------------------------------------------------------------------------------


@dataclass
class Nodes:
    """Arrays of one trajectory of a source, in SI units.

    Attributes:
        pos: positions [frame, node, dim] in m.
        kind: node type of each node, a name of ``schema.NODE_TYPES`` [node]. ``build`` separates boundary nodes from the others.
        vel: velocities [frame, node, dim] in m/s, if the source has them.
        mass: mass of each node [node], or of all, in kg.
        gravity: gravity [dim] in m/s², if the source has it per trajectory.
        parameters: parameters by material: values of the first one, or several by name. A parameter has a value per node [node] or one for all.
        ground: height of the ground [m], where the bounds along y begin if no node is lower; None takes the lowest node.
        walls: positions and normals [boundary_node, dim] of additional boundary nodes.
        cells: cells of a mesh by kind [cell, corner].
        rest_pos: rest positions of a mesh [node, dim] in m.
        rigid_body: number of the rigid body of each node, −1 for none [node].
        prescribed: whether the motion of each node is given [node], or along which axes it is [node, dim].
        force: forces on nodes [frame, node, dim] in N.
        stress: Cauchy stress at nodes [frame, node, component] in Pa.
        moving_walls: positions and normals [frame, boundary_node, dim] of additional boundary nodes that move in a prescribed way.
        friction: friction coefficient of boundary nodes.
        types, repairs, notes, warnings: as in ``Loaded``.
    """

    pos: np.ndarray
    kind: np.ndarray
    vel: np.ndarray | None = None
    mass: Any = 1.0
    gravity: tuple[float, ...] | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    ground: float | None = None
    walls: tuple[np.ndarray, np.ndarray] | None = None
    cells: Mapping[str, np.ndarray] | None = None
    rest_pos: np.ndarray | None = None
    rigid_body: np.ndarray | None = None
    prescribed: np.ndarray | None = None
    force: np.ndarray | None = None
    stress: np.ndarray | None = None
    moving_walls: tuple[np.ndarray, np.ndarray] | None = None
    friction: float = ASSUMED_FRICTION
    types: frozenset[int] = frozenset()
    repairs: list[Repair] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def build(nodes: Nodes, facts: Facts) -> Loaded:
    """Build a trajectory from a source's arrays. Boundary nodes are separated, missing parameters are assumed, and missing normals are estimated.

    Raises:
        ImportFailure: ``frame_dt`` is unknown.
        Refusal: there are only boundary nodes, the facts have another number of axes, or cells are not indices of nodes.
        ArrayError, PeriodicityError: see ``Trajectory.from_numpy``.
    """
    if facts.frame_dt is None:
        raise ImportFailure("frame_dt: the source does not say how much time passes between frames; pass frame_dt=… [s]")
    check_axes(facts, nodes.pos.shape[2])
    numbers("pos", nodes.pos, {"frame": None, "node": None, "dim": None})
    moving = np.flatnonzero(nodes.kind != BOUNDARY)
    if not len(moving):
        raise Refusal("has no nodes but boundary nodes")
    pos, periodicity = nodes.pos[:, moving], facts.periodicity
    repairs, notes = list(nodes.repairs), list(nodes.notes)
    outside = [k for k, frame in enumerate(pos) if periodicity and (periodicity.wrapped(frame.astype(np.float64)) != frame).any()]
    if outside:
        repairs.append(Repair(f"positions folded into the periodic domain in {len(outside)} frames", outside[0]))
    warnings = [*nodes.warnings, *_wider_than_periods(pos[0], periodicity)]
    kinds = [str(k) for k in nodes.kind[moving]]
    parameters: dict[str, Any] = {}
    notes += replaced(facts.parameters, {material: values for material, values in nodes.parameters.items() if material in kinds})
    for material in dict.fromkeys(kinds):
        first = MATERIALS[material][0]
        given = merged(facts.parameters, nodes.parameters).get(material, {})
        own = dict(given) if isinstance(given, Mapping) else {first.name: given}
        if first.name not in own:
            own[first.name] = first.assumed
            notes.append(
                f"{first.name} of {material} is not in the source; {first.quantity(first.assumed)} is stored (parameters={{{material}: …}})"
            )
        parameters[material] = {name: value if np.ndim(value) == 0 else np.asarray(value)[moving] for name, value in own.items()}
    cells = _cells_of(nodes, moving, repairs)
    gravity = facts.gravity if facts.gravity is not None or nodes.gravity is None else nodes.gravity[: pos.shape[2]]
    assumes_gravity = gravity is None and facts.usual_gravity is not None
    boundary, wall_repairs, wall_notes = _boundary(nodes, pos, facts)
    trajectory = Trajectory.from_numpy(
        pos,
        facts.frame_dt,
        kinds,
        parameters,
        vel=None if nodes.vel is None else nodes.vel[:, moving],
        mass=nodes.mass if np.ndim(nodes.mass) == 0 else np.asarray(nodes.mass)[moving],
        bounds=facts.bounds,
        periodic=facts.periodic,
        gravity=facts.usual_gravity[: pos.shape[2]] if gravity is None and facts.usual_gravity is not None else gravity,
        spacing=facts.spacing,
        connectivity_radius=facts.connectivity_radius,
        boundary=boundary,
        cells=cells,
        rest_pos=None if nodes.rest_pos is None or cells is None else nodes.rest_pos[moving],
        rigid_body=None if nodes.rigid_body is None else nodes.rigid_body[moving],
        prescribed=None if nodes.prescribed is None else nodes.prescribed[moving],
        force=None if nodes.force is None else nodes.force[:, moving],
        stress=None if nodes.stress is None else nodes.stress[:, moving],
    )
    if facts.bounds is None and nodes.ground is not None:
        low, high = trajectory.metadata.bounds[1]
        bounds = (trajectory.metadata.bounds[0], (min(low, nodes.ground), high), *trajectory.metadata.bounds[2:])
        trajectory = replace(trajectory, metadata=replace(trajectory.metadata, bounds=bounds))
    return Loaded(
        trajectory,
        (*repairs, *wall_repairs),
        (*notes, *wall_notes),
        tuple(warnings),
        assumes_gravity,
        nodes.types,
    )


def check_axes(facts: Facts, dim: int) -> None:
    """Raise ``Refusal`` if bounds or periodic axes are not those of ``dim`` axes."""
    for name, axes in (("bounds", facts.bounds), ("periodic", facts.periodic)):
        if axes is not None and len(axes) != dim:
            raise Refusal(f"{name} = {axes}: has {len(axes)} axes, the data have {dim}")


def _wider_than_periods(first: np.ndarray, periodicity: Periodicity) -> Iterator[str]:
    """Yield a warning for each periodic axis along which the first frame [node, dim] is wider than the period."""
    for axis in periodicity.axes:
        width, period = np.ptp(first[:, axis]), periodicity.period[axis]
        if width > WIDEST * period:
            yield f"nodes spread over {width:.4g} m along {'xyz'[axis]} in the first frame, which is periodic with {period:.4g} m: bounds=… may be wrong"


def _cells_of(nodes: Nodes, moving: np.ndarray, repairs: list[Repair]) -> dict[str, np.ndarray] | None:
    """Return the cells between dynamic nodes by kind, with node numbers among the dynamic nodes."""
    if nodes.cells is None:
        return None
    row = np.full(nodes.pos.shape[1], -1)
    row[moving] = np.arange(len(moving))
    found, left_out, total = {}, 0, 0
    for kind, cells in nodes.cells.items():
        if cells.ndim != 2 or cells.dtype.kind not in "iu":
            raise Refusal(f"cells are {cells.dtype}{list(cells.shape)}, expected integers [cell, corner]")
        if ((cells < 0) | (cells >= nodes.pos.shape[1])).any():
            raise Refusal(f"cells name node {cells.max()}, there are {nodes.pos.shape[1]} nodes")
        kept = (row[cells] >= 0).all(axis=1)
        left_out, total = left_out + int((~kept).sum()), total + len(cells)
        if kept.any():
            found[kind] = row[cells[kept]]
    if left_out:
        repairs.append(Repair(f"{left_out} of {total} cells have boundary nodes and were left out; the connectivity radius connects these"))
    return found or None


def _boundary(nodes: Nodes, visited: np.ndarray, facts: Facts) -> tuple[Boundary, list[Repair], list[str]]:
    """Collect boundary nodes of the source, additional wall points, and walls at the bounds."""
    dim = nodes.pos.shape[2]
    parts: list[Boundary] = []
    repairs: list[Repair] = []
    notes: list[str] = []
    fixed = np.flatnonzero(nodes.kind == BOUNDARY)
    if len(fixed):
        vel, moves = _sliding(nodes.pos[:, fixed], facts, repairs)
        pos = facts.periodicity.wrapped(nodes.pos[0, fixed].astype(np.float64))
        if not moves.all():
            normal = estimated_normals(pos[~moves], visited, facts.periodicity)
            parts.append(Boundary.from_numpy(pos[~moves], normal, vel=vel[~moves], friction=nodes.friction))
        if moves.any():
            assert facts.frame_dt is not None
            normal, space = estimated_normals(pos[moves], visited[0], facts.periodicity), facts.periodicity
            way = nodes.pos[:, fixed[moves]]
            parts.append(Boundary.moving(way, normal, facts.frame_dt, friction=nodes.friction, periodicity=space))
            notes.append(f"{int(moves.sum())} boundary nodes move; their motion is prescribed to simulators and does not react to contacts")
        notes.append("normals of boundary nodes are estimated: they point to where the other nodes have been")
    if nodes.walls is not None:
        parts.append(Boundary.from_numpy(*nodes.walls, friction=nodes.friction))
    if nodes.moving_walls is not None and facts.frame_dt is not None:
        parts.append(Boundary.moving(*nodes.moving_walls, facts.frame_dt, friction=nodes.friction, periodicity=facts.periodicity))
        notes.append("walls of the source move; their motion is prescribed to simulators and does not react to contacts")
    if parts:
        notes.append(f"friction of boundary nodes is not in the source; {nodes.friction:g} is stored")
    return joined(dim, *parts, walls_at_bounds(facts, dim)), repairs, notes


def walls_at_bounds(facts: Facts, dim: int) -> Boundary:
    """Sample the walls that the facts name; there are none if bounds are unknown."""
    if not facts.walls or facts.bounds is None:
        return Boundary.empty(dim)
    spacing = facts.spacing or (max(high - low for low, high in facts.bounds) / 50)
    sides = [f"{axis}_{side}" for axis in "xyz"[:dim] for side in ("low", "high")]
    if beyond := [side for side in facts.walls if side not in sides]:
        raise Refusal(f"has {dim} axes, so there is no wall {beyond[0]}; walls are {', '.join(sides)}")
    walls = domain_walls(facts.bounds, {side: facts.walls.get(side, 0.0) for side in sides})
    named = tuple(wall for wall, side in zip(walls, sides, strict=True) if side in facts.walls)
    return Boundary.sample(named, spacing, dim, facts.periodicity)


def joined(dim: int, *parts: Boundary) -> Boundary:
    """Join the nodes of several boundaries. All moving boundaries must have the same number of frames."""
    parts = (Boundary.empty(dim), *parts)
    pos, vel, normal, friction, restitution = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("pos", "vel", "normal", "friction", "restitution")
    )
    motion, num_frames = None, max((part.motion.num_frames for part in parts if part.motion is not None), default=0)
    if num_frames:

        def way(part: Boundary, name: str) -> np.ndarray:
            now = getattr(part, name)
            return np.broadcast_to(now, (num_frames, *now.shape)) if part.motion is None else getattr(part.motion, name)

        motion = BoundaryMotion(*(np.concatenate([way(part, name) for part in parts], axis=1) for name in ("pos", "vel", "normal")))
    return Boundary(pos, vel, normal, friction, restitution, tuple(shape for part in parts for shape in part.shapes), motion)


def _sliding(pos: np.ndarray, facts: Facts, repairs: list[Repair]) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities of boundary nodes [boundary_node, dim] in m/s, and a mask [boundary_node] of the nodes with another motion.

    Nodes outside the mask are at rest, or slide at constant velocity along a periodic axis, like a lid.

    Args:
        pos: positions of boundary nodes [frame, boundary_node, dim] in m.
        facts: facts of the data set.
        repairs: list to which sliding nodes are added.
    """
    assert facts.frame_dt is not None
    path = np.cumsum(facts.periodicity.shortest(np.diff(pos.astype(np.float64), axis=0)), axis=0)
    mean = path[-1] / len(path)
    mean[:, [axis for axis in range(pos.shape[2]) if axis not in facts.periodicity.axes]] = 0.0
    tolerance = STILL * (facts.spacing or float(np.ptp(pos[0], axis=0).max()) / 50)
    unsteady = np.abs(path - mean * np.arange(1, len(path) + 1)[:, None, None]).max(axis=2) > tolerance
    moves = unsteady.any(axis=0)
    slides = ~moves & (np.abs(mean).max(axis=1) * len(path) > tolerance)
    if slides.any():
        repairs.append(
            Repair(
                f"{int(slides.sum())} boundary nodes slide along a periodic axis: stored at their positions of frame 0, with their velocity"
            )
        )
    return np.where(slides[:, None], mean / facts.frame_dt, 0.0), moves


def typed(pos: np.ndarray, types: np.ndarray, table: Mapping[int, str], settings: ImportSettings, **arrays: Any) -> Nodes:
    """Return ``Nodes`` whose node types are those of a source's integer types.

    Args:
        pos: positions [frame, node, dim] in m.
        types: types of the nodes [node].
        table: node type of each type of the format; the settings override it.
        settings: settings of the import.
        arrays: other arguments of ``Nodes``.

    Raises:
        Refusal: a type is unknown.
    """
    known = {**table, **(settings.materials or {})}
    unknown = [code for code in np.unique(types).tolist() if code not in known]
    if unknown:
        node = int(np.flatnonzero(types == unknown[0])[0])
        raise Refusal(
            f"node {node} has type {unknown[0]}; known: {', '.join(map(str, sorted(known)))}. Name it with materials={{{unknown[0]}: …}}"
        )
    kind = np.array([known[code] for code in types.tolist()], dtype="U16")
    found = frozenset(types.tolist())
    notes = [f"type {code} of the source is stored as {known[code]} (materials={{{code}: …}})" for code in sorted(found)]
    return Nodes(pos, kind, types=found, notes=notes, **arrays)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; raises ``ImportFailure`` if that is impossible."""
    try:
        regular_files.check(path)
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ImportFailure(f"{path}: has {path.stat().st_size} bytes, far more than a description of data")
        values = parsed(path.read_bytes())
    except OSError as error:
        raise ImportFailure(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ImportFailure(f"{path}: is not JSON ({error})") from None
    if not isinstance(values, dict):
        raise ImportFailure(f"{path}: expected a JSON object, found {type(values).__name__}")
    return values


def number(values: Mapping[str, Any], key: str, path: Path, low: float = -math.inf) -> float:
    """Return a finite number of a JSON object, at least ``low``; otherwise raises ``ImportFailure`` that names file and key."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < low:
        at_least = "" if low == -math.inf else f" of at least {low:g}"
        raise ImportFailure(f"{path}: {key} = {value!r}, expected a number{at_least}")
    return float(value)


def bounds_in(values: Mapping[str, Any], path: Path) -> tuple[tuple[float, float], ...]:
    """Return ``bounds`` of a JSON object, ``[low, high]`` of 2 or 3 axes; otherwise raises ``ImportFailure``."""
    rows = values.get("bounds")
    try:
        array = np.asarray(rows, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape not in ((2, 2), (3, 2)) or not np.isfinite(array).all() or (array[:, 0] >= array[:, 1]).any():
        raise ImportFailure(f"{path}: bounds = {rows!r}, expected [low, high] of 2 or 3 axes")
    return tuple((float(low), float(high)) for low, high in array)


def length_warning(num_frames: int, key: str, length: int | None) -> list[str]:
    """Return a warning if a trajectory has neither ``length`` nor ``length + 1`` frames. Formats count the frames in either way."""
    if length is None or num_frames in (length, length + 1):
        return []
    return [f"has {num_frames} frames, which were taken; {key} = {length} stands for {length} or {length + 1}"]


def count_in(values: Mapping[str, Any], key: str, path: Path) -> int | None:
    """Return a non-negative integer of a JSON object, or None if it is missing; otherwise raises ``ImportFailure``."""
    value = values.get(key)
    if value is not None and (type(value) is not int or value < 0):
        raise ImportFailure(f"{path}: {key} = {value!r}, expected an integer")
    return value


def natural(name: str) -> tuple[Any, ...]:
    """Return a sorting key that puts ``traj2`` before ``traj10``."""
    parts = re.split(r"([0-9]+)", name)  # text and digits in turn; digits compare by length first, so that no number is too long
    return tuple((len(digits := part.lstrip("0")), digits) if k % 2 else part for k, part in enumerate(parts)), name
