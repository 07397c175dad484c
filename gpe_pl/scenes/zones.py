"""Inlets and outlets of a scene, which become openings at the spacing of a model."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpe_pl.scenes.bodies import Body, BodyFault, Nodes
from gpe_pl.schema import MESH_MATERIALS, node_code
from gpe_pl.trajectory.openings import Opening, speeds_fault

AT_ONCE = "give speed in m/s or flow_rate in m³/s (m²/s in 2D)"
Table = tuple[tuple[float, float], ...]
"""Pairs of a time [s] and a value, linear in between."""


@dataclass(frozen=True)
class Zone:
    """An inlet or outlet.

    Attributes:
        name: name in messages, such as ``inlet 1 (fluid)``.
        low, high: corners of its box [dim] in m.
        side: side of the box that is the outer face, such as ``x_low``.
        speed: speed into the scene [m/s], negative out of it, or a table of times and speeds; None for an outlet that removes what reaches it.
        body: material, velocity and parameters of what enters; None for outlets.
        has_rate: whether the speed follows from a flow rate and the area of the cross-section.
    """

    name: str
    low: np.ndarray
    high: np.ndarray
    side: str
    speed: float | Table | None
    body: Body | None = None
    has_rate: bool = False

    @property
    def opening(self) -> Opening:
        """The zone as an opening through which nothing enters."""
        table = self.speed if isinstance(self.speed, tuple) else ()
        steady = None if isinstance(self.speed, tuple) else self.speed
        return Opening(tuple(self.low.tolist()), tuple(self.high.tolist()), self.side, steady, speeds=table)

    def at_spacing(self, spacing: float) -> Zone:
        """Return the zone with the speed at which nodes ``spacing`` [m] apart carry its flow rate: a layer has a whole number of them per line."""
        if not self.has_rate or self.body is None:
            return self
        opening = replace(self.opening, spacing=spacing)
        area = float(np.prod(np.delete(self.high - self.low, opening.axis)))
        factor = area / (opening.num_in_layer * spacing ** (len(self.low) - 1))
        speed = tuple((t, factor * v) for t, v in self.speed) if isinstance(self.speed, tuple) else factor * (self.speed or 0.0)
        new = replace(self, speed=speed, has_rate=False)
        return replace(new, body=replace(self.body, velocity=new.opening.velocity_at(0.0)))


def speed_of(low: np.ndarray, high: np.ndarray, side: str, speed: Any, flow_rate: Any, is_inlet: bool) -> float | Table | None:
    """Return the speed of a zone into the scene [m/s], or a table of times and speeds, that is given by speed, flow rate [m^dim/s], or neither.

    Speeds of outlets are given as speeds out of the scene. Tables of inlets may have negative speeds, with which the zone takes material out.

    Raises:
        BodyFault: both are given, or a value is impossible.
    """
    if speed is not None and flow_rate is not None:
        raise BodyFault(f"speed, flow_rate: {AT_ONCE}, not both")
    if speed is None and flow_rate is None:
        return None
    key, given, area = "speed", speed, 1.0
    if flow_rate is not None:
        key, given, area = "flow_rate", flow_rate, float(np.prod(np.delete(high - low, "xyz".index(side[0]))))
    unit = (1.0 if is_inlet else -1.0) / area
    if is_number(given):
        if not 0 < given < math.inf:
            raise BodyFault(f"{key}={given!r}: must be a positive number")
        return unit * float(given)
    table = _table(key, given)
    if not is_inlet and min(value for _, value in table) < 0:
        raise BodyFault(
            f"{key}: has a negative value; an inlet takes material out while its {key} is negative, and needs its material for the rest"
        )
    if max(value for _, value in table) <= 0:
        raise BodyFault(f"{key}: has no positive value, so nothing would pass")
    return tuple((time, unit * value) for time, value in table)


def is_number(value: Any) -> bool:
    """Tell whether a value is a real number, also one of NumPy."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _table(key: str, given: Any) -> Table:
    pairs = list(given) if isinstance(given, (list, tuple)) else []
    if not pairs or not all(isinstance(pair, (list, tuple)) and len(pair) == 2 and all(map(is_number, pair)) for pair in pairs):
        raise BodyFault(f"{key}={given!r}: must be a positive number, or pairs of a time [s] and a value, such as [[0, 0.5], [1, 1.5]]")
    table = tuple((float(time), float(value)) for time, value in pairs)
    if (wrong := speeds_fault(table)) is not None:
        raise BodyFault(f"{key}: {wrong}")
    return table


def opening_of(zone: Zone, spacing: float, radius: float, mass: float, params: Sequence[float]) -> Opening:
    """Return the opening of a zone in a scene whose nodes are ``spacing`` [m] apart and see each other within ``radius`` [m].

    Args:
        zone: the zone.
        spacing, radius: of the model.
        mass: mass of a node that enters [kg].
        params: material parameters of such a node, in the columns of the scene.

    Raises:
        BodyFault: the zone is too small, or its material has a mesh.
    """
    opening = zone.opening
    if opening.depth < radius * (1 - 1e-6):
        raise BodyFault(f"is {opening.depth:g} m deep along {zone.side[0]}; make it at least as deep as nodes see each other, {radius:g} m")
    if zone.body is None:
        return opening
    if zone.body.material in MESH_MATERIALS:
        raise BodyFault(f"{zone.body.material} has a mesh, and nodes of a mesh cannot enter one after the other")
    narrow = min(np.delete(zone.high - zone.low, opening.axis))
    if narrow < spacing * (1 - 1e-6):
        raise BodyFault(f"is {narrow:g} m wide, less than the distance of nodes, {spacing:g} m")
    known = tuple(None if np.isnan(value) else float(value) for value in params)
    return replace(opening, spacing=spacing, node_type=node_code(zone.body.material), mass=mass, params=known)


def nodes_of(opening: Opening) -> Nodes:
    """Return the nodes that are in an opening at the start."""
    pos = opening.nodes_at_start()
    return Nodes(pos, np.full(len(pos), opening.mass), np.empty((0, pos.shape[1] + 1), dtype=np.int64))
