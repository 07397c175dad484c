"""Inlets and outlets of a scene, which become openings at the spacing of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpe_pl.scenes.bodies import Body, BodyFault, Nodes
from gpe_pl.schema import MESH_MATERIALS, node_code
from gpe_pl.trajectory.openings import Opening

AT_ONCE = "give speed in m/s or flow_rate in m³/s (m²/s in 2D)"


@dataclass(frozen=True)
class Zone:
    """An inlet or outlet.

    Attributes:
        name: name in messages, such as ``inlet 1 (fluid)``.
        low, high: corners of its box [dim] in m.
        side: side of the box that is the outer face, such as ``x_low``.
        speed: speed into the scene [m/s], negative out of it; None for an outlet that removes what reaches it.
        body: material, velocity and parameters of what enters; None for outlets.
    """

    name: str
    low: np.ndarray
    high: np.ndarray
    side: str
    speed: float | None
    body: Body | None = None


def speed_of(low: np.ndarray, high: np.ndarray, side: str, speed: float | None, flow_rate: float | None) -> float | None:
    """Return the speed [m/s] of a zone that is given by its speed, by its flow rate [m^dim/s], or by neither.

    Raises:
        BodyFault: both are given.
    """
    if speed is not None and flow_rate is not None:
        raise BodyFault(f"speed, flow_rate: {AT_ONCE}, not both")
    if flow_rate is None:
        return speed
    return flow_rate / float(np.prod(np.delete(high - low, "xyz".index(side[0]))))


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
    low, high = tuple(zone.low.tolist()), tuple(zone.high.tolist())
    opening = Opening(low, high, zone.side, zone.speed)
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
    return Opening(low, high, zone.side, zone.speed, spacing, node_code(zone.body.material), mass, known)


def nodes_of(opening: Opening) -> Nodes:
    """Return the nodes that are in an opening at the start."""
    pos = opening.nodes_at_start()
    return Nodes(pos, np.full(len(pos), opening.mass), np.empty((0, pos.shape[1] + 1), dtype=np.int64))
