"""``Opening``: a box through which nodes enter or leave an open scene. Inlets and outlets are openings.

An opening lies at one side of the scene and has its depth along the axis of that side. It either prescribes a speed or removes nodes:

- Nodes in an opening with a ``speed`` move with it along the axis, whatever acts on them. With a positive speed, new nodes enter at the outer face. With a
  negative speed, nodes leave when they pass the outer face. The speed may change in time (``speeds``), also its sign.
- An opening without a speed removes every node that is in it after a frame.

New nodes lie on a lattice that moves with the speed, so their places follow from the time alone. Layer k of the lattice is at the distance
``(k + 1/2) spacing + travel(time)`` from the outer face, where ``travel`` is the integral of the speed. Layers with k ≥ 0 are in the opening at the start
(``nodes_at_start``). While the speed is negative, layers leave. The nodes that are nearest to a layer leave with it. The next layer that enters is therefore
at least half a spacing from all other nodes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from pydantic import TypeAdapter

from gpe_pl.files.json_text import parsed
from gpe_pl.schema import LARGEST

ROUNDING = 1e-6
"""Fraction of a spacing by which sums of frame intervals may be wrong, so that a layer enters in the frame that exact times give."""

ON_FACE = 1e-5
"""Fraction of its depth by which an opening is deeper for the question which nodes are in it. Layers often lie exactly on its inner face."""
LATER = {"speeds"}
"""Attributes that files have only if they are not empty. The first files with openings lack them."""
MOST_SPEEDS = 10_000
"""Maximum number of pairs of ``Opening.speeds``."""


@dataclass(frozen=True)
class Opening:
    """An inlet or outlet. Lengths in m, times in s.

    Attributes:
        low, high: corners of the box [dim].
        side: side of the box that is the outer face, such as ``x_low``.
        speed: speed of its nodes into the scene [m/s], negative out of it; None for an opening that removes nodes, or if ``speeds`` are given.
        spacing: distance of new nodes; 0 if none enter, as for the attributes below.
        node_type: code of the material of new nodes.
        mass: mass of a new node [kg].
        params: material parameters of a new node, in the columns of the scene; None where its material lacks the parameter.
        speeds: pairs of a time since the start of the scene [s], ascending, and the speed then [m/s]. Between them the speed is linear, before and after them
            constant. Empty for a speed that does not change.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    side: str
    speed: float | None = None
    spacing: float = 0.0
    node_type: int = 0
    mass: float = 0.0
    params: tuple[float | None, ...] = ()
    speeds: tuple[tuple[float, float], ...] = ()

    @property
    def axis(self) -> int:
        """Axis of the outer face."""
        return "xyz".index(self.side[0])

    @property
    def inward(self) -> float:
        """Sign of the direction into the scene along ``axis``."""
        return 1.0 if self.side.endswith("low") else -1.0

    @property
    def depth(self) -> float:
        return self.high[self.axis] - self.low[self.axis]

    @property
    def drives(self) -> bool:
        """Whether it prescribes the motion of its nodes."""
        return self.speed is not None or bool(self.speeds)

    def __str__(self) -> str:
        """Return which way nodes go and at which speeds, such as ``in and out through x_low at -1 to 1 m/s``."""
        if not self.drives:
            return f"out through {self.side}"
        speeds = [self.speed_at(0.0), *(speed for _, speed in self.speeds)]
        low, high = min(speeds), max(speeds)
        way = "in" if low >= 0 else "out" if high <= 0 else "in and out"
        if way == "out":
            low, high = abs(high), abs(low)
        return f"{way} through {self.side} at {f'{low:g}' if low == high else f'{low:g} to {high:g}'} m/s"

    def speed_at(self, time: float) -> float:
        """Return the speed [m/s] at a time since the start of the scene [s]; 0 if it prescribes none."""
        if not self.speeds:
            return self.speed or 0.0
        times, speeds = zip(*self.speeds, strict=True)
        return float(np.interp(time, times, speeds))

    def travel(self, time: float) -> float:
        """Return the integral of the speed [m] from the start of the scene to a time [s]."""
        if not self.speeds:
            return (self.speed or 0.0) * time
        knots = np.array([0.0, *(t for t, _ in self.speeds if 0 < t < time), time])
        values = np.array([self.speed_at(t) for t in knots])
        return float(np.sum(np.diff(knots) * (values[1:] + values[:-1]) / 2))

    def velocity_at(self, time: float) -> np.ndarray:
        """Return the velocity of its nodes [dim] in m/s at a time [s]; zero without a speed."""
        return self._along(self.speed_at(time))

    def mean_velocity(self, start: float, end: float) -> np.ndarray:
        """Return the mean velocity of its nodes [dim] in m/s between two times [s]; zero without a speed."""
        return self._along((self.travel(end) - self.travel(start)) / (end - start) if self.speeds else self.speed or 0.0)

    def _along(self, speed: float) -> np.ndarray:
        velocity = np.zeros(len(self.low))
        velocity[self.axis] = self.inward * speed
        return velocity

    def moved(self, by: np.ndarray) -> Opening:
        """Return the opening displaced by ``by`` [dim] in m."""
        low, high = (tuple((np.array(corner) + by).tolist()) for corner in (self.low, self.high))
        return replace(self, low=low, high=high)

    def depth_of(self, pos: np.ndarray) -> np.ndarray:
        """Return the distances [node] in m of points [node, dim] from the outer face into the scene; infinite for points beside the opening."""
        others = [axis for axis in range(len(self.low)) if axis != self.axis]
        beside = np.any([(pos[:, a] < self.low[a]) | (pos[:, a] > self.high[a]) for a in others], axis=0)
        return np.where(beside, np.inf, self._way_from_face(pos))

    def _way_from_face(self, pos: np.ndarray) -> np.ndarray:
        """Return the distances [node] in m of points [node, dim] from the plane of the outer face, negative beyond it."""
        face = self.low[self.axis] if self.inward > 0 else self.high[self.axis]
        return np.asarray(self.inward * (pos[:, self.axis] - face))

    def contains(self, pos: np.ndarray) -> np.ndarray:
        """Return a mask [node] of the points [node, dim] in the box; the faces along the axis belong to it, also if positions are rounded to float32."""
        depth, margin = self.depth_of(pos), ON_FACE * self.depth
        return np.asarray((depth >= -margin) & (depth <= self.depth + margin))

    def removes(self, before: np.ndarray, pos: np.ndarray, start: float, end: float) -> np.ndarray:
        """Return a mask [node] of the nodes that leave between two times [s], given their positions [node, dim] in m then, ``before`` and ``pos``.

        Without a speed, those in the box leave. Those that have passed the outer face, up to a depth beyond it, leave in any case. With a layer that leaves, so
        do those nearest to it. What was beyond the outer face already does not leave.
        """
        depth, limit = self.depth_of(pos), 0.0
        if not self.drives:
            limit = self.depth
        elif self.enters and self._num_layers(end) < self._num_layers(start):
            limit = self._depth_of_layer(-self._num_layers(end), end) - self.spacing / 2
        has_passed = (depth >= -self.depth) & (self._way_from_face(before) >= -ON_FACE * self.depth)
        return np.asarray(((depth >= 0) | has_passed) & (depth < limit))

    @property
    def num_in_layer(self) -> int:
        """Number of nodes of a layer of the lattice; 0 if none enter."""
        return len(self._layer()) if self.enters else 0

    @property
    def enters(self) -> bool:
        """Whether new nodes enter at some time."""
        return self.spacing > 0 and any(speed > 0 for speed in (self.speed or 0.0, *(speed for _, speed in self.speeds)))

    def nodes_at_start(self) -> np.ndarray:
        """Return the positions [node, dim] in m of the lattice in the box at time 0."""
        if not self.enters:
            return np.empty((0, len(self.low)))
        return self._nodes(np.arange(math.floor(self.depth / self.spacing + ROUNDING)), 0.0)

    def entering(self, start: float, end: float) -> np.ndarray:
        """Return the positions [node, dim] in m at the time ``end`` of the nodes that enter after ``start``, both in s since the start of the scene."""
        if not self.enters:
            return np.empty((0, len(self.low)))
        first, last = (-self._num_layers(time) for time in (end, start))
        return self._nodes(np.arange(last - 1, first - 1, -1), end)

    def _num_layers(self, time: float) -> int:
        """Return how many layers have passed the outer face between the start of the scene and a time; negative if layers left."""
        return math.floor(self.travel(time) / self.spacing + 0.5 + ROUNDING)

    def _depth_of_layer(self, layer: int, time: float) -> float:
        return max(0.0, (layer + 0.5) * self.spacing + self.travel(time))

    def _nodes(self, layers: np.ndarray, time: float) -> np.ndarray:
        face = self.low[self.axis] if self.inward > 0 else self.high[self.axis]
        depth = np.array([self._depth_of_layer(int(layer), time) for layer in layers])
        layer = self._layer()
        pos = np.tile(layer, (len(layers), 1))
        pos[:, self.axis] = face + self.inward * np.repeat(depth, len(layer))
        return pos

    def _layer(self) -> np.ndarray:
        """Return positions [node, dim] of a layer, in the middle of the cross-section; 0 along the axis."""
        lines = []
        for axis, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            count = 1 if axis == self.axis else max(1, math.floor((high - low) / self.spacing + ROUNDING))
            margin = (high - low - (count - 1) * self.spacing) / 2
            lines.append(np.zeros(1) if axis == self.axis else low + margin + self.spacing * np.arange(count))
        return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(self.low))


def carried(openings: Sequence[Opening], pos: np.ndarray) -> np.ndarray:
    """Return a mask [node] of the nodes at ``pos`` [node, dim] in m that an opening moves with its speed, whatever a model predicts."""
    return np.any([np.zeros(len(pos), bool), *(opening.contains(pos) for opening in openings if opening.drives)], axis=0)


def openings_to_json(openings: Sequence[Opening]) -> str:
    """Convert openings to text, from which ``openings_from_json`` rebuilds them."""
    values = [asdict(opening) for opening in openings]
    return json.dumps([{key: v for key, v in own.items() if key not in LATER or v} for own in values], sort_keys=True)


def openings_from_json(text: str) -> tuple[Opening, ...]:
    """Rebuild openings from text. Their values may break the rules of ``openings_fault``.

    Raises:
        ValueError: the text is no JSON, or a key is missing, unknown or of another type.
    """
    values, known = parsed(text), {f.name for f in fields(Opening)}
    if not isinstance(values, list) or not all(isinstance(v, dict) and known - LATER <= set(v) <= known for v in values):
        raise ValueError(f"must be a list of openings with the keys {', '.join(sorted(known))}")
    return TypeAdapter(tuple[Opening, ...]).validate_json(text, strict=True)


def openings_fault(openings: Sequence[Opening], dim: int, num_params: int, num_types: int) -> str | None:
    """Describe the first opening that breaks a rule; None if all are valid. Every reader of files calls it.

    Args:
        openings: openings of a scene.
        dim: dimension of space.
        num_params: number of columns of material parameters of the scene.
        num_types: number of node types.
    """
    for number, opening in enumerate(openings, 1):
        if (fault := _fault(opening, dim, num_params, num_types)) is not None:
            return f"opening {number}: {fault}"
    return None


def _fault(opening: Opening, dim: int, num_params: int, num_types: int) -> str | None:
    def is_number(value: float) -> bool:
        return abs(value) < LARGEST

    for key in ("low", "high"):
        corner = getattr(opening, key)
        if len(corner) != dim or not all(map(is_number, corner)):
            return f"{key} is {corner!r}, must be {dim} numbers"
    if not all(low < high for low, high in zip(opening.low, opening.high, strict=True)):
        return f"low {opening.low} must be below high {opening.high} along every axis"
    sides = [f"{axis}_{end}" for axis in "xyz"[:dim] for end in ("low", "high")]
    if opening.side not in sides:
        return f"side is {opening.side!r}, must be one of {', '.join(sides)}"
    if opening.speed is not None and not is_number(opening.speed):
        return f"speed is {opening.speed!r}, must be a number of m/s or null"
    if opening.speeds and (wrong := speeds_fault(opening.speeds)) is not None:
        return f"speeds {wrong}"
    if opening.speeds and opening.speed is not None:
        return f"speed is {opening.speed!r}, must be null beside speeds"
    if not is_number(opening.spacing) or opening.spacing < 0:
        return f"spacing is {opening.spacing!r}, must be at least 0"
    if not opening.enters:
        return None
    if not is_number(opening.mass) or opening.mass <= 0:
        return f"mass is {opening.mass!r}, must be positive"
    if not 0 <= opening.node_type < num_types:
        return f"node_type is {opening.node_type!r}, must be the code of a material"
    params = opening.params
    if len(params) != num_params or not all(p is None or is_number(p) for p in params):
        return f"params are {params!r}, must be one number or null for each of {num_params} columns"
    return None


def speeds_fault(speeds: Sequence[tuple[float, float]]) -> str | None:
    """Describe what is wrong with a table of times [s] and speeds [m/s]; None if nothing is."""
    if len(speeds) > MOST_SPEEDS:
        return f"have {len(speeds)} pairs, at most {MOST_SPEEDS} are read"
    for number, (time, speed) in enumerate(speeds, 1):
        if not (abs(time) < LARGEST and abs(speed) < LARGEST):
            return f"pair {number} is ({time!r}, {speed!r}), must be a time [s] and a speed [m/s]"
        if number > 1 and time <= speeds[number - 2][0]:
            return f"pair {number} is at {time:g} s, must be later than {speeds[number - 2][0]:g} s"
    return None
