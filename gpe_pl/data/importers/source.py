"""What an importer has to provide: the facts of a data set, and its trajectories one by one, each of which can be refused."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from gpe_pl.errors import GpeError
from gpe_pl.files import regular_files
from gpe_pl.files.json_text import parsed
from gpe_pl.files.names import DataName
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.schema import BOUNDARY, MATERIALS, NODE_TYPES
from gpe_pl.trajectory.arrays import estimated_normals, numbers
from gpe_pl.trajectory.boundary import Boundary, Motion
from gpe_pl.trajectory.trajectory import Trajectory

Format = Literal["gns", "lagrangebench", "meshgraphnets", "dpinet", "dmcf", "arrays"]

SPLIT_NAMES = {"train": "train", "valid": "val", "validation": "val", "val": "val", "test": "test", "test_unseen": "test_unseen"}
"""Names of splits in public data sets, and those of the store."""

ASSUMED_PARAMETERS = {"sand": 30.0, "snow": 8.0, "fluid": 1e-3, "elastomer": 1e5, "solid": 1e6}
"""Material parameters that are stored where a source has none."""

ASSUMED_FRICTION = 0.5

SMALLEST = float(np.finfo(np.float32).tiny)
"""Lengths and times of a source are at least this: what is positive in the precision that is stored."""

STILL = 1e-2
"""Boundary nodes that never get farther than this share of the spacing from where they should be are still, or slide steadily."""

WIDEST = 1.05
"""Periods that nodes may spread over in a first frame."""

MAX_JSON_BYTES = 2**24
MAX_TRAJECTORIES = 100_000
"""In one file; a file of 100 MB can name millions of empty ones."""


class ImportFailure(GpeError, ValueError):
    """A source cannot be imported at all; the message names the file and what to do."""


class Refusal(GpeError, ValueError):
    """One trajectory of a source cannot be used; ``frame`` is -1 where the reason concerns none in particular."""

    def __init__(self, reason: str, frame: int = -1) -> None:
        super().__init__(reason)
        self.frame = frame


@dataclass(frozen=True)
class ImportSettings:
    """What is imported, and what is said about it that the source does not say, or says wrongly. None takes what the source has.

    Attributes:
        format: of the source.
        source: file or folder.
        name: of the data set, a folder's name; None takes that of the source.
        frame_dt: time between frames [s].
        bounds: ``[low, high]`` of the domain per axis [m].
        periodic: per axis.
        gravity: external acceleration per axis [m/s²].
        spacing: rest spacing of neighbours [m].
        connectivity_radius: neighbour radius [m].
        walls: friction of walls at the bounds, by side (``x_low``, ``x_high``, …); ``{}`` for none.
        materials: material, or ``boundary``, of node types of the source, by their number; the others are as the format has them.
        parameters: parameter of materials of which the source has none.
        max_trajectories: per split, from its start.
        holdout: share of the training trajectories that become ``val`` and ``test`` where the source has none, at least one each; 0 for none.
        allow_pickle: read object arrays, which can run code; for files that you trust.
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
    parameters: dict[str, float] | None = None
    max_trajectories: Annotated[int, Field(ge=1)] | None = None
    holdout: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    allow_pickle: bool = False

    def __post_init__(self) -> None:
        wrong = sorted({*(self.materials or {}).values()} - {*NODE_TYPES}) + sorted({*(self.parameters or {})} - {*MATERIALS})
        if wrong:
            raise ValueError(f"unknown material {wrong[0]!r}; known: {', '.join(NODE_TYPES)}")
        sides = [f"{axis}_{side}" for axis in "xyz" for side in ("low", "high")]
        if self.walls and not {*self.walls} <= {*sides}:
            raise ValueError(f"walls: unknown side {min({*self.walls} - {*sides})!r}; known: {', '.join(sides)}")


@dataclass(frozen=True)
class Facts:
    """What is the same for all trajectories of a data set; None where it is not known.

    Attributes:
        frame_dt: time between frames [s].
        bounds, periodic: of the domain, per axis.
        gravity: external acceleration per axis [m/s²].
        spacing, connectivity_radius: in m.
        walls: friction of walls at the bounds, by side.
        parameters: of materials, where all nodes have the same.
        usual_gravity: what data in the format usually have, per axis [m/s²]; taken where neither the source nor a setting has any, unless groups of nodes in
            free flight show another one.
        notes: what is assumed, or left out, about all of it; one sentence each.
    """

    frame_dt: float | None = None
    bounds: tuple[tuple[float, float], ...] | None = None
    periodic: tuple[bool, ...] | None = None
    gravity: tuple[float, ...] | None = None
    spacing: float | None = None
    connectivity_radius: float | None = None
    walls: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    usual_gravity: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()

    @property
    def periodicity(self) -> Periodicity:
        return NOWHERE if self.bounds is None or self.periodic is None else Periodicity(self.bounds, self.periodic)

    def overridden(self, settings: ImportSettings) -> Facts:
        """These facts, with those that the settings name."""
        names = ("frame_dt", "bounds", "periodic", "gravity", "spacing", "connectivity_radius", "walls")
        given = {name: getattr(settings, name) for name in names if getattr(settings, name) is not None}
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
        notes = (*self.notes, *(f"{name} = {value} was given" for name, value in given.items()))
        return replace(self, **given, parameters={**self.parameters, **(settings.parameters or {})}, notes=notes)


@dataclass(frozen=True)
class Repair:
    """What was changed in a trajectory so that it could be stored; ``frame`` is the first one concerned, -1 for all or none."""

    what: str
    frame: int = -1


@dataclass(frozen=True)
class Loaded:
    """A trajectory with what was changed in it, what was assumed about the whole data set, what looks wrong about the trajectory, and whether its gravity is
    the usual one of the format, because nothing says what it is.
    """

    trajectory: Trajectory
    repairs: tuple[Repair, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    assumes_gravity: bool = False


@dataclass(frozen=True)
class Item:
    """One trajectory of a source: its name there, and how to read it. Reading raises ``Refusal`` or ``ArrayError`` for what cannot be used."""

    name: str
    load: Callable[[Facts], Loaded]


@dataclass(frozen=True)
class Source:
    """A data set in a public format: what is known about it, the trajectories of each split that it has, and what looks wrong about all of it."""

    facts: Facts
    splits: Mapping[str, Sequence[Item]]
    warnings: tuple[str, ...] = ()


# --- what several formats share ------------------------------------------------------------------------------------------------------------


@dataclass
class Nodes:
    """Arrays of one trajectory as a source has them, in SI units.

    Attributes:
        pos: positions [frame, node, dim].
        kind: ``schema.NODE_TYPES`` name of each node [node]; boundary nodes are taken out of ``pos``.
        vel: velocities [frame, node, dim], where the source has them.
        mass: of each node, or of all.
        gravity: [dim] in m/s², where the source has it for each trajectory.
        parameters: of materials, per node or for all.
        walls: positions and normals [boundary_node, dim] of further boundary nodes.
        cells: of a mesh, by kind [cell, corner].
        rest_pos: of a mesh.
    """

    pos: np.ndarray
    kind: np.ndarray
    vel: np.ndarray | None = None
    mass: Any = 1.0
    gravity: tuple[float, ...] | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    walls: tuple[np.ndarray, np.ndarray] | None = None
    cells: Mapping[str, np.ndarray] | None = None
    rest_pos: np.ndarray | None = None
    friction: float = ASSUMED_FRICTION
    repairs: list[Repair] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def build(nodes: Nodes, facts: Facts) -> Loaded:
    """The trajectory of a source's arrays, with boundary nodes apart, and parameters and normals assumed where the source has none.

    Raises:
        Refusal: there are only boundary nodes, or the facts have other axes.
        ArrayError: see ``Trajectory.from_numpy``.
    """
    if facts.frame_dt is None:
        raise ImportFailure("frame_dt: the source does not say how much time passes between frames; pass frame_dt=… [s]")
    for name, axes in (("bounds", facts.bounds), ("periodic", facts.periodic)):
        if axes is not None and len(axes) != nodes.pos.shape[2]:
            raise Refusal(f"{name} = {axes}: has {len(axes)} axes, the data have {nodes.pos.shape[2]}")
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
    for material in dict.fromkeys(kinds):
        value = nodes.parameters.get(material, facts.parameters.get(material))
        if value is None:
            value, spec = ASSUMED_PARAMETERS[material], MATERIALS[material]
            notes.append(f"{spec.name} of {material} is not in the source; {value:g} {spec.unit} is stored (parameters={{{material}: …}})")
        parameters[material] = value if np.ndim(value) == 0 else np.asarray(value)[moving]
    cells = _cells_of(nodes, moving, repairs)
    gravity = facts.gravity if facts.gravity is not None or nodes.gravity is None else nodes.gravity[: pos.shape[2]]
    assumes_gravity = gravity is None and facts.usual_gravity is not None
    boundary, wall_repairs, wall_notes = _boundary(nodes, pos, facts)
    return Loaded(
        Trajectory.from_numpy(
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
        ),
        (*repairs, *wall_repairs),
        (*notes, *wall_notes),
        tuple(warnings),
        assumes_gravity,
    )


def _wider_than_periods(first: np.ndarray, periodicity: Periodicity) -> Iterator[str]:
    """What speaks against the periods: a first frame [node, dim] that is wider than one."""
    for axis in periodicity.axes:
        width, period = np.ptp(first[:, axis]), periodicity.period[axis]
        if width > WIDEST * period:
            yield f"nodes spread over {width:.4g} m along {'xyz'[axis]} in the first frame, which is periodic with {period:.4g} m: bounds=… may be wrong"


def _cells_of(nodes: Nodes, moving: np.ndarray, repairs: list[Repair]) -> dict[str, np.ndarray] | None:
    """Cells between moving nodes by kind, renumbered."""
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
        repairs.append(Repair(f"{left_out} of {total} cells have boundary nodes and were left out; the neighbour radius connects these"))
    return found or None


def _boundary(nodes: Nodes, visited: np.ndarray, facts: Facts) -> tuple[Boundary, list[Repair], list[str]]:
    """Boundary nodes of the source, further wall points, and walls at the bounds."""
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
            notes.append(f"{int(moves.sum())} boundary nodes move; a simulator is told where they go, whatever they meet")
        notes.append("normals of boundary nodes are estimated: they point to where the other nodes have been")
    if nodes.walls is not None:
        parts.append(Boundary.from_numpy(*nodes.walls, friction=nodes.friction))
    if parts:
        notes.append(f"friction of boundary nodes is not in the source; {nodes.friction:g} is stored")
    return joined(dim, *parts, walls_at_bounds(facts, dim)), repairs, notes


def walls_at_bounds(facts: Facts, dim: int) -> Boundary:
    """The walls that the facts name, where bounds are known."""
    if not facts.walls or facts.bounds is None:
        return Boundary.empty(dim)
    spacing = facts.spacing or (max(high - low for low, high in facts.bounds) / 50)
    sides = [f"{axis}_{side}" for axis in "xyz"[:dim] for side in ("low", "high")]
    walls = domain_walls(facts.bounds, {side: facts.walls.get(side, 0.0) for side in sides})
    named = tuple(wall for wall, side in zip(walls, sides, strict=True) if side in facts.walls)
    return Boundary.sample(named, spacing, dim, facts.periodicity)


def joined(dim: int, *parts: Boundary) -> Boundary:
    """All boundary nodes of several boundaries, of which those that move have motions of equally many frames."""
    parts = (Boundary.empty(dim), *parts)
    pos, vel, normal, friction, restitution = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("pos", "vel", "normal", "friction", "restitution")
    )
    motion, num_frames = None, max((part.motion.num_frames for part in parts if part.motion is not None), default=0)
    if num_frames:

        def way(part: Boundary, name: str) -> np.ndarray:
            now = np.asarray(getattr(part, name), np.float32)
            return np.broadcast_to(now, (num_frames, *now.shape)) if part.motion is None else getattr(part.motion, name)

        motion = Motion(*(np.concatenate([way(part, name) for part in parts], axis=1) for name in ("pos", "vel", "normal")))
    return Boundary(pos, vel, normal, friction, restitution, tuple(shape for part in parts for shape in part.shapes), motion)


def _sliding(pos: np.ndarray, facts: Facts, repairs: list[Repair]) -> tuple[np.ndarray, np.ndarray]:
    """Velocity [boundary_node, dim] of boundary nodes, and which of them [boundary_node] neither are still nor slide steadily along a periodic axis, as a lid.

    Args:
        pos: their positions [frame, boundary_node, dim].
        facts: of the data set.
        repairs: what slides is added to these.
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
            Repair(f"{int(slides.sum())} boundary nodes slide along a periodic axis: stored where they are in frame 0, with their velocity")
        )
    return np.where(slides[:, None], mean / facts.frame_dt, 0.0), moves


def typed(pos: np.ndarray, types: np.ndarray, table: Mapping[int, str], settings: ImportSettings, **arrays: Any) -> Nodes:
    """Nodes by a source's integer types [node]; raises ``Refusal`` for one that is not known.

    Args:
        pos: positions [frame, node, dim].
        types: of the nodes.
        table: what types of the format become, unless the settings say otherwise.
        settings: of the conversion.
        arrays: further arguments of ``Nodes``.
    """
    known = {**table, **(settings.materials or {})}
    unknown = [code for code in np.unique(types).tolist() if code not in known]
    if unknown:
        node = int(np.flatnonzero(types == unknown[0])[0])
        raise Refusal(
            f"node {node} has type {unknown[0]}; known: {', '.join(map(str, sorted(known)))}. Name it with materials={{{unknown[0]}: …}}"
        )
    kind = np.array([known[code] for code in types.tolist()], dtype="U16")
    notes = [f"type {code} of the source is stored as {known[code]} (materials={{{code}: …}})" for code in np.unique(types).tolist()]
    return Nodes(pos, kind, notes=notes, **arrays)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; raises ``ImportFailure``."""
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
    """A finite number of a JSON object, at least ``low``; raises ``ImportFailure`` that names file and key."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < low:
        at_least = "" if low == -math.inf else f" of at least {low:g}"
        raise ImportFailure(f"{path}: {key} = {value!r}, expected a number{at_least}")
    return float(value)


def bounds_in(values: Mapping[str, Any], path: Path) -> tuple[tuple[float, float], ...]:
    """``bounds`` of a JSON object: ``[low, high]`` of 2 or 3 axes."""
    rows = values.get("bounds")
    try:
        array = np.asarray(rows, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape not in ((2, 2), (3, 2)) or not np.isfinite(array).all() or (array[:, 0] >= array[:, 1]).any():
        raise ImportFailure(f"{path}: bounds = {rows!r}, expected [low, high] of 2 or 3 axes")
    return tuple((float(low), float(high)) for low, high in array)


def length_warning(num_frames: int, key: str, length: int | None) -> list[str]:
    """What to say of a trajectory whose frames are neither as many as the source's description says nor one more, which is how some formats count."""
    if length is None or num_frames in (length, length + 1):
        return []
    return [f"has {num_frames} frames, which were taken; {key} = {length} stands for {length} or {length + 1}"]


def count_in(values: Mapping[str, Any], key: str, path: Path) -> int | None:
    """A number of things in a JSON object, None where it is not said; raises ``ImportFailure``."""
    value = values.get(key)
    if value is not None and (type(value) is not int or value < 0):
        raise ImportFailure(f"{path}: {key} = {value!r}, expected an integer")
    return value


def natural(name: str) -> tuple[Any, ...]:
    """Sorting key by which ``traj2`` comes before ``traj10``."""
    parts = re.split(r"([0-9]+)", name)  # text and digits in turn; digits compare by length first, however many there are
    return tuple((len(digits := part.lstrip("0")), digits) if k % 2 else part for k, part in enumerate(parts)), name


def split_files(path: Path, endings: Sequence[str]) -> dict[str, Path]:
    """Files ``train``, ``valid`` and ``test`` with one of the endings in a folder, by split; a single file is one of training data."""
    if path.is_file():
        return {SPLIT_NAMES.get(path.name.partition(".")[0], "train"): path}
    there = [(split, path / f"{name}{ending}") for name, split in SPLIT_NAMES.items() for ending in endings]
    found = _one_each(path, [(split, file) for split, file in there if file.is_file()])
    if not found:
        wanted = " or ".join(f"train{ending}" for ending in endings)
        raise ImportFailure(f"{path}: {'no such file or folder' if not path.exists() else f'holds no {wanted}'}")
    return found


def split_folders(path: Path) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Folders ``train``, ``valid``, ``test`` and ``test_unseen`` in a folder, by split, and a warning for each other one beside them."""
    if not path.is_dir():
        return {}, ()
    folders = {entry.name: entry for entry in path.iterdir() if entry.is_dir() and not entry.name.startswith(".")}
    found = _one_each(path, [(split, folders[name]) for name, split in SPLIT_NAMES.items() if name in folders])
    others = sorted({*folders} - {*SPLIT_NAMES})
    return found, tuple(f"{name}/ was not read: splits are {', '.join(SPLIT_NAMES)}" for name in others) if found else ()


def _one_each(path: Path, found: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """What was found by split; raises ``ImportFailure`` where two places are the same split."""
    places: dict[str, Path] = {}
    for split, place in found:
        if split in places:
            raise ImportFailure(f"{path}: {places[split].name} and {place.name} are both the split {split}; move one of them elsewhere")
        places[split] = place
    return places
