"""Facts about the trajectories of a source, collected in the first pass of an import, and trajectories that differ from the others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from gpe_pl.data.free_flight import FreeFlight, vector
from gpe_pl.data.importers.frame_order import wrong_frames
from gpe_pl.data.importers.recordings import Part, Recordings
from gpe_pl.data.importers.report import Event
from gpe_pl.data.importers.sampled import free_flight_of
from gpe_pl.data.importers.source import Facts, Item, Loaded, Refusal
from gpe_pl.data.position_rounding import MotionSummary, motion_of
from gpe_pl.data.validate import outside_bounds
from gpe_pl.schema import HISTORY, NODE_TYPES, stored_parameters
from gpe_pl.trajectory import cells_at_rest
from gpe_pl.trajectory.arrays import RADIUS_SPACINGS, nearest_distances
from gpe_pl.trajectory.cells import bodies
from gpe_pl.trajectory.cells_at_rest import ROUNDING
from gpe_pl.trajectory.rigid_deformation import rigid_deformation
from gpe_pl.trajectory.store import stored_arrays
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from gpe_pl.trajectory.values import faults, size_conflicts

NUM_SAMPLED = 8
"""Number of trajectories from which spacing, radius and neighbours are measured. Training trajectories come first."""
FLIGHT_FRAMES, FEW_FLIGHT_FRAMES = 50, 16
"""Numbers of frames of each of the first ``NUM_SAMPLED`` trajectories, and of each later one, in which groups in free flight are searched for."""
ENOUGH_OF_ONE = 5
"""Number of groups in free flight, over the examined frames of one trajectory, that can tell that its gravity is wrong."""
LONG_ENOUGH = HISTORY + 2
"""Number of frames that a model needs with the default history."""
COINCIDENCE = 1e-3
"""Nodes closer than this fraction of the median distance to the nearest node, in the first frame, count as at one place."""
FRAMES_COMPARED = 200
"""Number of first frames in which displacements and velocities are compared."""
SPACING_RATIO = 3.0
"""A warning is given if two distances that should be alike differ by more than this factor."""
USUAL = 0.75
"""Fraction of the trajectories that must have the same number of frames for a shorter one to be a suspect."""
NOT_RIGID, DEFORMED = 1e-3, 0.1
"""Changes of the distances in a rigid body, relative to its size. Above the first, a warning is given. Above the second, the trajectory is refused."""


@dataclass
class Survey:
    """Facts collected in the first pass.

    Attributes:
        good: usable trajectories by split.
        materials: materials of all trajectories.
        types: node types of the source that occur in any trajectory.
        columns: names of the parameters of all trajectories.
        stressed: materials with a stress in any trajectory.
        loads: loads that any trajectory has.
        bounds: bounds of each trajectory, ``(low, high)`` per axis [m].
        nearest: split, name and median distance to the nearest node [m] of each trajectory.
        lengths: split, name and number of frames of each trajectory.
        spacings, radii: spacing and connectivity radius of each sampled trajectory [m].
        velocity_ratios: mean displacement over mean velocity × frame interval, of each sampled trajectory.
        scenes: names of trajectories by the digests of their frames.
        recordings: what tells if trajectories are parts of one recording.
        motions: split, name and motion of each trajectory.
        assumes_gravity: for each trajectory, whether its gravity is only assumed to be the usual one of the format.
        suspects: warnings about trajectories.
        num_bytes: size of all arrays.
        flights: groups in free flight of each trajectory.
        common: frame interval [s], dimension and periodic axes of all trajectories.
        contents: metadata of each usable trajectory, and whether it has a stress, by the identity of its item.
    """

    good: dict[str, list[Item]] = field(default_factory=dict)
    materials: set[str] = field(default_factory=set)
    types: set[int] = field(default_factory=set)
    columns: set[str] = field(default_factory=set)
    stressed: set[str] = field(default_factory=set)
    loads: set[str] = field(default_factory=set)
    bounds: list[tuple[tuple[float, float], ...]] = field(default_factory=list)
    nearest: list[tuple[str, str, float]] = field(default_factory=list)
    lengths: list[tuple[str, str, int]] = field(default_factory=list)
    spacings: list[float] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    velocity_ratios: list[float] = field(default_factory=list)
    scenes: dict[bytes, str] = field(default_factory=dict)
    recordings: Recordings = field(default_factory=Recordings)
    motions: list[tuple[str, str, MotionSummary]] = field(default_factory=list)
    assumes_gravity: list[bool] = field(default_factory=list)
    suspects: list[Event] = field(default_factory=list)
    num_bytes: int = 0
    flights: list[Flight] = field(default_factory=list)
    common: tuple[float, int, tuple[bool, ...]] | None = None
    contents: dict[int, tuple[Metadata, bool]] = field(default_factory=dict)

    def add(self, split: str, item: Item, loaded: Loaded, facts: Facts) -> None:
        """Add a trajectory.

        Raises:
            Refusal: it is invalid, does not fit the others, or is one of them.
        """
        trajectory, name = loaded.trajectory, item.name
        m, where = trajectory.metadata, f"{split}, {name}"
        arrays = stored_arrays(trajectory)
        if trajectory.is_prediction:
            raise Refusal("is a rollout of a model and no ground truth; leave it out, or replace is_prediction to learn from it")
        for fault in _faults(m, arrays):
            raise Refusal(fault)
        common = (m.frame_dt, m.dim, m.periodic)
        if self.common is None:
            self.common = common
        if common != self.common:
            raise Refusal(
                f"frame_dt, dimension and periodic axes are {common}, of the trajectories before {self.common}; a data set has the same in all of them"
            )
        if not np.any(trajectory.pos != trajectory.pos[:1]):
            raise Refusal("nothing moves")
        deformation = 0.0 if trajectory.rigid_body is None else rigid_deformation(trajectory, trajectory.num_frames - 1)
        if deformation > DEFORMED:
            wide = ", or it is wider than half a period" if any(m.periodic) else ""
            raise Refusal(
                f"rigid_body: distances in a body change by {deformation:.3g} of its size, so it is not rigid{wide}; leave rigid_body out"
            )
        part = Part.of(trajectory)
        digest = part.digests.tobytes()
        if self.scenes.setdefault(digest, where) != where:
            raise Refusal(f"has exactly the positions of {self.scenes[digest]}: the same scene twice")
        if deformation > NOT_RIGID:
            what = f"distances in a rigid body change by {deformation:.3g} of its size; models keep them"
            self.suspects.append(Event(split, name, -1, what))
        num_frames = FLIGHT_FRAMES if len(self.flights) < NUM_SAMPLED else FEW_FLIGHT_FRAMES
        flight = Flight(split, name, loaded.assumes_gravity, free_flight_of(trajectory, facts, num_frames))  # the last that may refuse it
        self.flights.append(flight)
        self.good.setdefault(split, []).append(item)
        self.recordings.add(item, part)
        self.contents[id(item)] = m, trajectory.stress is not None
        self.suspects += [Event(split, name, -1, warning) for warning in loaded.warnings]
        if (end := trajectory.termination) is not None:
            what = f"stopped after {trajectory.num_frames} frames ({end.reason}: {end.message}): are its last frames right?"
            self.suspects.append(Event(split, name, -1, what))
        self.motions.append((split, name, motion_of(m, trajectory.pos)))
        self.assumes_gravity.append(loaded.assumes_gravity)
        self.suspects += [Event(split, name, frame, what) for frame, what in wrong_frames(trajectory)]
        if trajectory.num_frames < LONG_ENOUGH:
            what = f"has {trajectory.num_frames} frames; models leave it out unless graph.history is below the default, which needs {LONG_ENOUGH}"
            self.suspects.append(Event(split, name, -1, what))
        nearest = nearest_distances(trajectory.pos[0].astype(np.float64), m.periodicity)
        at_one_place = np.flatnonzero((nearest == 0) | (nearest < COINCIDENCE * np.median(nearest)))
        if len(at_one_place):
            what = f"{len(at_one_place)} nodes are at the place of another node, the first is node {at_one_place[0]}: do bodies overlap?"
            self.suspects.append(Event(split, name, 0, what))
        if trajectory.cells is not None and trajectory.rest_pos is not None:
            mesh = (trajectory.cells, trajectory.cell_dim, trajectory.rest_pos, m.periodicity)
            self.suspects += [Event(split, name, -1, what) for what in cells_at_rest.suspects(*mesh)]
            if (way := _way_from_rest(trajectory)) > 0:
                what = (
                    f"the nodes of a body are {way:.3g} m from rest_pos, more than its size: is rest_pos in the coordinates of the scene?"
                )
                self.suspects.append(Event(split, name, 0, what))
        there = nearest if trajectory.alive is None else nearest[trajectory.alive[0]]
        self.nearest.append((split, name, float(np.median(there)) if len(there) else np.inf))
        self.lengths.append((split, name, trajectory.num_frames))
        self.materials |= set(m.materials)
        self.types |= loaded.types
        self.columns |= set(m.param_names)
        self.loads |= set(m.loads or ())
        self.stressed |= set(m.with_stress if trajectory.stress is not None else ())
        self.num_bytes += sum(array.nbytes for array in arrays.values())
        self.bounds.append(m.bounds)
        if len(self.spacings) < NUM_SAMPLED:
            self.spacings.append(m.spacing)
            self.radii.append(m.connectivity_radius)
            if (ratio := _velocity_ratio(trajectory)) is not None:
                self.velocity_ratios.append(ratio)

    def refused_as_incomplete(self) -> Iterator[Event]:
        """Remove trajectories that lack a parameter or a stress of others from ``good``, and yield why."""
        for split, items in self.good.items():
            reasons = [self._lacks(item) for item in items]
            self.good[split] = [item for item, reason in zip(items, reasons, strict=True) if not reason]
            yield from (Event(split, item.name, -1, reason) for item, reason in zip(items, reasons, strict=True) if reason)

    def _lacks(self, item: Item) -> str:
        m, has_stress = self.contents[id(item)]
        for material in m.materials:
            if lacking := [p.name for p in stored_parameters(material, [*self.columns]) if p.name not in m.param_names]:
                return f"has no {lacking[0]} of {material}, which other trajectories have; give it to all, or choose parameters={{{material}: …}}"
        if self.stressed and not has_stress:
            return "has no stress, which other trajectories have; give it to all or to none"
        return ""

    @property
    def has_given_spacings(self) -> bool:
        """Whether the spacing of a sampled trajectory differs from the distance to the nearest node."""
        pairs = zip(self.spacings, self.nearest[: len(self.spacings)], strict=True)
        return not all(math.isclose(spacing, distance, rel_tol=ROUNDING) for spacing, (*_, distance) in pairs)

    @property
    def given_radii(self) -> list[float]:
        """Connectivity radii of the sampled trajectories that are not the default [m]."""
        pairs = zip(self.radii, self.spacings, strict=True)
        return [radius for radius, spacing in pairs if not math.isclose(radius, RADIUS_SPACINGS * spacing, rel_tol=ROUNDING)]

    def look_for_outliers(self) -> None:
        """Add suspects: trajectories whose distances, length or free flight differ from those of the others."""
        known = [(split, name, distance) for split, name, distance in self.nearest if 0 < distance < np.inf]
        usual = float(np.median([distance for _, _, distance in known])) if known else np.inf
        for split, name, distance in known:
            if not usual / SPACING_RATIO <= distance <= usual * SPACING_RATIO:
                what = f"nodes are {distance:.4g} m from the nearest one, in the median of all trajectories {usual:.4g} m: is its unit of length another?"
                self.suspects.append(Event(split, name, 0, what))
        ((length, count),) = Counter(length for _, _, length in self.lengths).most_common(1)
        for split, name, own in self.lengths:
            if own < length and count >= USUAL * len(self.lengths):
                self.suspects.append(Event(split, name, -1, f"has {own} frames, most trajectories have {length}: was it cut off?"))

    def look_for_wrong_gravity(self, assumed: tuple[float, ...] | None) -> None:
        """Add suspects: trajectories whose groups in free flight accelerate in another way than their gravity, while those of the others agree with it.

        Args:
            assumed: gravity [dim] in m/s² of the trajectories that do not state it.
        """
        flights = [f.free.under(assumed) if f.assumed and assumed is not None else f.free for f in self.flights]
        num_free, num_disturbed = (sum(getattr(free, name) for free in flights) for name in ("num_free", "num_disturbed"))
        for f, free in zip(self.flights, flights, strict=True):
            others_agree = 2 * (num_disturbed - free.num_disturbed) < num_free - free.num_free
            if others_agree and free.num_free >= ENOUGH_OF_ONE and free.agrees_on_another:
                stored = vector(np.median(free.gravity, axis=0))
                what = f"gravity is stored as {stored}, but {free.num_free} groups in free flight agree on {vector(free.typical)}"
                self.suspects.append(Event(f.split, f.name, -1, what))


@dataclass(frozen=True)
class Flight:
    """Groups in free flight of a trajectory.

    Attributes:
        split, name: the trajectory.
        assumed: whether its gravity is only assumed.
        free: the groups.
    """

    split: str
    name: str
    assumed: bool
    free: FreeFlight


def _way_from_rest(trajectory: Trajectory) -> float:
    """Return the largest distance of a body from its place at rest in the first frame [m], among the bodies that are farther away than they are large."""
    assert trajectory.cells is not None and trajectory.rest_pos is not None
    rest, now = trajectory.rest_pos.astype(np.float64), trajectory.pos[0].astype(np.float64)
    farthest = 0.0
    for rows in bodies(trajectory.cells, len(rest)):
        way = float(np.median(np.linalg.norm(trajectory.metadata.periodicity.shortest(now[rows] - rest[rows]), axis=1)))
        if way > np.linalg.norm(np.ptp(rest[rows], axis=0)):
            farthest = max(farthest, way)
    return farthest


def _velocity_ratio(trajectory: Trajectory) -> float | None:
    """Return mean displacement over mean velocity × frame interval; None for nodes without velocity."""
    m, first = trajectory.metadata, trajectory.frames(0, FRAMES_COMPARED)
    step = np.linalg.norm(m.periodicity.shortest(np.diff(first.pos.astype(np.float64), axis=0)), axis=-1).mean()
    speed = np.linalg.norm(first.vel.astype(np.float64), axis=-1)
    speed = (0.5 * (speed[1:] + speed[:-1])).mean()
    return float(step / (speed * m.frame_dt)) if speed > 0 else None


def _faults(m: Metadata, arrays: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Yield the reasons why the store would refuse the metadata or arrays of a trajectory."""
    yield from (f"{key} {violation}" for key, violation in m.violations())
    yield from size_conflicts(arrays, m.dim, len(m.param_names))
    yield from map(str, faults(arrays, NODE_TYPES, m.materials, m.param_names))
    yield from (f"pos: {text}" for text in outside_bounds(m, arrays["pos"]))
