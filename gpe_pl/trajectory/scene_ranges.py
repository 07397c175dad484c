"""Ranges of gravity, boundary conditions and the spacing of boundary nodes in scenes.

A model has learned only from the values of its training, often a single one. A range is an array [2, channel] of lowest and highest values. Its channels are
the components of gravity, followed by ``BOUNDARY_CHANNELS``. Without boundary nodes, the lowest value is ∞ and the highest −∞.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float64

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.schema import STICKY
from gpe_pl.trajectory.arrays import nearest_distances
from gpe_pl.trajectory.boundary import Boundary

BOUNDARY_CHANNELS = (("friction", ""), ("restitution", ""), ("speed", " m/s"), ("spacing", " m"))
"""Names and units of the channels of boundary nodes."""

TOLERANCE = 1e-5
"""Relative difference of boundary conditions that counts as none, as they are stored in single precision."""

SPACING_TOLERANCE = 0.1
"""Relative difference in the spacing of boundary nodes that counts as none: it varies with the obstacles of similar scenes."""


def scene_range(gravity: np.ndarray, boundary: Boundary, periodicity: Periodicity) -> Float64[np.ndarray, "2 channel"]:
    """Return the range of one scene, including all of the boundary's motion.

    Args:
        gravity: external acceleration [dim] in m/s².
        boundary: boundary of NumPy arrays.
        periodicity: axes along which space repeats.
    """
    columns = [np.asarray(gravity, np.float64)[:, None]]
    for name, _ in BOUNDARY_CHANNELS:
        values = _values(name, boundary, periodicity)
        columns.append(np.array([[values.min(initial=np.inf), values.max(initial=-np.inf)]]))
    return np.concatenate([np.broadcast_to(c, (len(c), 2)) for c in columns]).T.astype(np.float64)


def _values(name: str, boundary: Boundary, periodicity: Periodicity) -> np.ndarray:
    if name == "friction":
        return np.minimum(boundary.friction, STICKY)
    if name == "restitution":
        return np.asarray(boundary.restitution)
    if name == "speed":
        return np.asarray(np.linalg.norm(boundary.vel if boundary.motion is None else boundary.motion.vel, axis=-1))
    if len(boundary.pos) < 2:
        return np.empty(0)
    nearest = nearest_distances(np.asarray(boundary.pos, np.float64), periodicity)
    return np.array([np.median(nearest), nearest.max()])  # typical and widest spacing; a single coarse obstacle shows in the latter


def unlimited(dim: int) -> Float64[np.ndarray, "2 channel"]:
    """Return the range that contains every scene."""
    return np.array([[-np.inf], [np.inf]]) * np.ones(dim + len(BOUNDARY_CHANNELS))


def united(ranges: Iterable[Float64[np.ndarray, "2 channel"]]) -> Float64[np.ndarray, "2 channel"]:
    """Return the smallest range that contains all of ``ranges``."""
    low, high = zip(*ranges, strict=True)
    return np.stack([np.min(low, axis=0), np.max(high, axis=0)])


def described(trained: Float64[np.ndarray, "2 channel"]) -> Iterator[tuple[str, str]]:
    """Yield the name of each channel, and its range with the unit, as text."""
    gravity, boundary = np.split(trained, [-len(BOUNDARY_CHANNELS)], axis=1)
    yield "gravity", _between(_vector(gravity[0]), _vector(gravity[1]), " m/s²")
    for (name, unit), (low, high) in zip(BOUNDARY_CHANNELS, boundary.T, strict=True):
        yield f"{name} of boundary nodes", _between(f"{low:g}", f"{high:g}", unit) if low <= high else "none"


def outside(trained: Float64[np.ndarray, "2 channel"], scene: Float64[np.ndarray, "2 channel"], speed: float) -> Iterator[tuple[str, str]]:
    """Yield the kinds of values with which a scene leaves the trained range, each with a line that names the value and the range.

    Args:
        trained: range of training.
        scene: range of the scene.
        speed: typical speed of the scene [m/s], which scales the tolerance of speeds.
    """
    size = np.where(np.isfinite(trained), np.abs(trained), 0.0).max(axis=0)
    count = len(BOUNDARY_CHANNELS)
    size[:-count] = size[:-count].max()
    margin = TOLERANCE * size
    margin[-2] = TOLERANCE * max(size[-2], speed)
    margin[-1] = SPACING_TOLERANCE * size[-1]
    below, above = scene[0] < trained[0] - margin, scene[1] > trained[1] + margin
    known = dict(described(trained))
    if (below | above)[:-count].any():
        yield "gravity", f"gravity is {_vector(scene[0, :-count])} m/s², in training it was {known['gravity']}"
    if scene[0, -count] <= scene[1, -count] and trained[0, -count] > trained[1, -count]:
        yield "boundary nodes", "the scene has boundary nodes, training had none"
        return
    for k, (name, unit) in enumerate(BOUNDARY_CHANNELS, start=scene.shape[1] - count):
        kind = f"{name} of boundary nodes"
        if scene[0, k] <= scene[1, k] and (below[k] or above[k]):  # there are boundary nodes
            yield kind, f"{kind} is {scene[int(above[k]), k]:g}{unit}, in training it was {known[kind]}"


def _vector(values: np.ndarray) -> str:
    return f"({', '.join(f'{v:g}' for v in values + 0.0)})"


def _between(low: str, high: str, unit: str) -> str:
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"
