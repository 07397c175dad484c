"""Containment: puts particles that end a step inside a wall or obstacle back on its surface, and counts them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from array_api_compat import array_namespace

from gpe_pl.geometry.shapes import outward_normal, signed_distance, surface_tolerance
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
    moved = pos[rows]
    for _ in range(4):  # corners need a pass per surface
        before = moved
        for shape in shapes:
            depth = xp.clip(-shape.signed_distance(moved), 0.0, None)
            if bool(xp.any(depth > 0)):  # normals are expensive, and most shapes contain no node
                moved = moved + depth[:, None] * outward_normal(shape, moved, step=tolerance)
        if moved is before:
            break
    caught = signed_distance(shapes, moved) < -tolerance
    moved = xp.where(caught[:, None], pos[rows] - state.vel[rows] * dt, moved)
    new_pos, vel = xp.asarray(pos, copy=True), xp.asarray(state.vel, copy=True)
    new_pos[rows] = state.periodicity.wrapped(moved)
    vel[rows] = vel[rows] + (moved - pos[rows]) / dt
    return state.corrected(new_pos, vel), inside


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
