"""Groups of nodes in free flight. They touch nothing, so their acceleration should equal the gravity of the data.

A group is an island: a connected component of the graph. It is in free flight if no boundary node lies within the connectivity radius of its nodes, neither in
this frame nor in the frame before. In the frame before, its nodes may belong to several islands, but these islands have no other nodes. The graph of such a
group contains no cause of any acceleration except gravity.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gpe_pl.graphs.islands import Islands, free_since, islands_within
from gpe_pl.trajectory.trajectory import Metadata

TOLERANCE = 1e-3
"""Tolerance for the acceleration of a free group, as a fraction of gravity; without gravity, of the rms acceleration of all nodes."""

SCATTER = 0.25
"""Free groups share an acceleration other than gravity if its median scatter is below this fraction of its difference from gravity."""

SUBSTANTIAL = 0.1
"""A shared acceleration must differ from gravity by at least this fraction of gravity, and of the rms acceleration of all nodes. Smaller differences are
disturbances of single groups."""

AT_REST = 1e-3
"""A group that moves by less than this fraction of the radius in a frame may lie on something that the data do not contain. It does not count as free."""

MOST_FRAMES = 50
"""Maximum number of frames of a trajectory, evenly spread, in which groups are examined."""


@dataclass(frozen=True)
class FreeFlight:
    """Free groups of one or more frames.

    Attributes:
        num_islands: number of groups in all examined frames, free or not.
        acceleration: mass-weighted mean acceleration of each free group [group, dim] in m/s², from second differences of positions.
        gravity: gravity of the group's trajectory [group, dim] in m/s².
        resolution: uncertainty of ``acceleration`` due to rounding of positions [group] in m/s².
        scale: rms acceleration of all nodes in the group's frame, gravity included [group] in m/s².
    """

    num_islands: int
    acceleration: np.ndarray
    gravity: np.ndarray
    resolution: np.ndarray
    scale: np.ndarray

    @property
    def num_free(self) -> int:
        return len(self.acceleration)

    @property
    def tolerance(self) -> np.ndarray:
        """Allowed difference between a group's acceleration and gravity [group] in m/s²."""
        strength = np.linalg.norm(self.gravity, axis=-1)
        return np.maximum(TOLERANCE * np.where(strength > 0, strength, self.scale), self.resolution)

    @property
    def num_disturbed(self) -> int:
        """Number of free groups that do not accelerate with gravity."""
        return int((np.linalg.norm(self.acceleration - self.gravity, axis=-1) > self.tolerance).sum())

    @property
    def typical(self) -> np.ndarray:
        """Median acceleration of the free groups [dim] in m/s², of which there must be at least one.

        A component is 0 unless it exceeds both the median deviation of the groups from it and their median ``resolution``.
        """
        middle = np.median(self.acceleration, axis=0)
        noise = np.maximum(np.median(np.abs(self.acceleration - middle), axis=0), np.median(self.resolution))
        return np.where(np.abs(middle) > noise, middle, 0.0)

    @property
    def agrees_on_another(self) -> bool:
        """Whether the groups share an acceleration that differs from gravity."""
        if not self.num_free or 2 * self.num_disturbed <= self.num_free:
            return False
        excess = self.acceleration - self.gravity
        middle = np.median(excess, axis=0)
        distance, scatter = np.linalg.norm(middle), np.median(np.linalg.norm(excess - middle, axis=-1))
        strength = np.median(np.maximum(np.linalg.norm(self.gravity, axis=-1), self.scale))
        return bool(distance > SUBSTANTIAL * strength and scatter < SCATTER * distance)

    def under(self, gravity: tuple[float, ...]) -> FreeFlight:
        """Return the same groups with another ``gravity`` [dim] in m/s² to compare with."""
        return replace(self, gravity=np.broadcast_to(np.asarray(gravity, np.float64), self.acceleration.shape))


def joined(flights: Iterable[FreeFlight], dim: int) -> FreeFlight:
    """Join the groups of several frames or trajectories."""
    flights = [nothing(dim), *flights]
    parts = (np.concatenate([getattr(f, name) for f in flights]) for name in ("acceleration", "gravity", "resolution", "scale"))
    return FreeFlight(sum(f.num_islands for f in flights), *parts)


def nothing(dim: int) -> FreeFlight:
    """Return a ``FreeFlight`` without groups."""
    return FreeFlight(0, np.empty((0, dim)), np.empty((0, dim)), np.empty(0), np.empty(0))


def free_flights(metadata: Metadata, arrays: dict[str, np.ndarray], most_frames: int = MOST_FRAMES) -> Iterator[FreeFlight]:
    """Yield the free groups of a trajectory, frame by frame.

    Args:
        metadata: metadata of the trajectory.
        arrays: arrays by their names in ``schema.FIELDS``: ``pos``, ``mass``, ``boundary_pos`` and, if there are any, ``cells``, ``prescribed`` or
            ``prescribed_axes``, and ``force``.
        most_frames: maximum number of frames that are examined, evenly spread.
    """
    pos, mass = arrays["pos"].astype(np.float64), arrays["mass"].astype(np.float64)
    gravity, dt, radius = np.asarray(metadata.gravity), metadata.frame_dt, metadata.connectivity_radius
    half_step = float(np.finfo(arrays["pos"].dtype).eps) / 2 * float(np.max(np.abs(pos), initial=0.0))
    resolution = 4 * half_step * math.sqrt(metadata.dim) / dt**2  # (x₂ − 2 x₁ + x₀)/Δt² has at most four such errors per axis
    boundary = arrays["boundary_pos"].astype(np.float64)
    cells = arrays.get("cells", np.empty((0, 2), np.int64)).astype(np.int64)
    mesh = np.concatenate([np.stack([cells[:, 0], cells[:, k]]) for k in range(1, cells.shape[1])], axis=1)

    def islands_of(frame: int) -> Islands:
        return islands_within(radius, pos[frame], boundary[min(frame, len(boundary) - 1)], mesh, metadata.periodicity)

    for frame in np.unique(np.linspace(1, len(pos) - 2, min(len(pos) - 2, most_frames)).astype(int)).tolist():
        before, islands = islands_of(frame - 1), islands_of(frame)
        count = len(islands.is_free)
        free = free_since(before, islands)
        window = pos[frame - 1 : frame + 2]
        if metadata.periodicity:  # relative to the middle frame, so that crossing the seam is not a jump
            window = metadata.periodicity.shortest(window - pos[frame])
        of_nodes = np.diff(window, 2, axis=0)[0] / dt**2
        moves = np.linalg.norm(islands.mean(window[2] - window[1], mass), axis=-1) > AT_REST * radius
        free &= moves
        free[islands.label[_are_loaded(arrays, frame)]] = False
        acceleration = islands.mean(of_nodes, mass)[free]
        uncertain = resolution / np.sqrt(_independent(islands.label, pos[frame], count)[free])
        rms = float(np.sqrt(np.mean(np.sum(of_nodes**2, axis=-1))))
        yield FreeFlight(count, acceleration, np.broadcast_to(gravity, acceleration.shape), uncertain, np.full(len(acceleration), rms))


def _are_loaded(arrays: dict[str, np.ndarray], frame: int) -> np.ndarray:
    """Return a mask [node] of the nodes whose motion is given along some axis, and of those on which a force acts just before or after a frame."""
    mask = np.zeros(len(arrays["mass"]), bool)
    if "prescribed" in arrays:
        mask |= arrays["prescribed"] != 0
    if "prescribed_axes" in arrays:
        mask |= (arrays["prescribed_axes"] != 0).any(axis=1)
    if "force" in arrays:
        mask |= (arrays["force"][frame - 1 : frame + 1] != 0).any(axis=(0, 2))
    return mask


def _independent(label: np.ndarray, pos: np.ndarray, count: int) -> np.ndarray:
    """Return the number of different coordinates in each island [island], the minimum over axes.

    Equal coordinates, as in rows of a lattice, are rounded alike, so their errors are not independent.
    """
    different = []
    for x in pos.T:
        order = np.lexsort((x, label))
        is_new = np.append(True, (np.diff(x[order]) != 0) | (np.diff(label[order]) != 0))
        different.append(np.bincount(label[order][is_new], minlength=count))
    return np.min(different, axis=0)


def vector(values: Iterable[float]) -> str:
    """Format an acceleration for messages."""
    return f"({', '.join(f'{value:.3g}' for value in values)}) m/s²"
