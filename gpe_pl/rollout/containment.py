"""Containment: puts particles that end a step inside a wall or obstacle back on its surface, and counts them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.geometry.shapes import Shape, outward_normal, signed_distance, surface_tolerance
from gpe_pl.rollout.loop import SimulationError, Simulator, step_all
from gpe_pl.trajectory.boundary import Array
from gpe_pl.trajectory.state import State


def contain(state: State, dt: float) -> tuple[State, Array]:
    """Move nodes inside a wall or obstacle back to its surface, along the normal. Depths up to ``geometry.shapes.surface_tolerance`` are allowed.

    In a narrow gap between surfaces, a node may still be inside afterwards; it then returns to its position before the step. Velocities and the last entry of
    the velocity history change by displacement / ``dt``, so that they remain differences of positions.

    Args:
        state: state after a step.
        dt: frame interval [s].

    Returns:
        Corrected state (the same object if no node was inside) and a mask [node] of the corrected nodes.
    """
    shapes = state.boundary.shapes
    pos = state.pos
    xp = array_namespace(pos)
    tolerance = surface_tolerance(shapes)
    inside = signed_distance(shapes, pos) < -tolerance
    if not bool(xp.any(inside)):
        return state, inside
    rows = xp.nonzero(inside)[0]
    moved = xp.asarray(_on_surfaces(shapes, _plain(pos[rows]), tolerance))
    caught = signed_distance(shapes, moved) < -tolerance
    moved = xp.where(caught[:, None], pos[rows] - state.vel[rows] * dt, moved)
    new_pos, vel = xp.asarray(pos, copy=True), xp.asarray(state.vel, copy=True)
    new_pos[rows] = state.periodicity.wrapped(moved)
    vel[rows] = vel[rows] + (moved - pos[rows]) / dt
    return state.corrected(new_pos, vel), inside


def _plain(points: Array) -> Array:
    """Return points on a CPU as a NumPy array, whose operations on few points take less time than PyTorch's."""
    return points if str(device(points)) != "cpu" or getattr(points, "requires_grad", False) else np.asarray(points)


def _on_surfaces(shapes: tuple[Shape, ...], points: Array, tolerance: float) -> Array:
    """Move points along the normals of all shapes that they are inside of."""
    xp = array_namespace(points)
    for _ in range(4):  # corners need a pass per surface
        if not bool(xp.any(signed_distance(shapes, points) < 0)):
            break
        for shape in shapes:
            distance = shape.signed_distance(points)
            depth = xp.maximum(-distance, xp.zeros_like(distance))
            if bool(xp.any(depth > 0)):  # normals are expensive, and most shapes contain no node
                points = points + depth[:, None] * outward_normal(shape, points, step=tolerance)
    return points


@dataclass(frozen=True)
class Contained:
    """A simulator with containment after every step. ``State.num_corrected`` of a new state is the number of corrected nodes.

    Attributes:
        simulator: simulator that makes the steps.
        dt: frame interval [s].
    """

    simulator: Simulator
    dt: float

    def step(self, state: State) -> State:
        return self._contain(self.simulator.step(state))

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        return [self._contain(item) if isinstance(item, State) else item for item in step_all(self.simulator, states)]

    def _contain(self, state: State) -> State:
        contained, corrected = contain(state, self.dt)
        num_corrected = 0 if contained is state else int(corrected.sum())
        return contained if num_corrected == state.num_corrected else replace(contained, num_corrected=num_corrected)
