"""Containment: puts particles that end a step inside a wall or obstacle back on its surface, and counts them."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.geometry.compiled_distance import has_compiled_distance
from gpe_pl.geometry.compiled_surfaces import FACING, NUM_PASSES, put_back
from gpe_pl.geometry.shapes import Shape, outward_normal, signed_distance, surface_tolerance
from gpe_pl.rollout.ensemble import Ensemble
from gpe_pl.rollout.loop import SimulationError, Simulator, step_all
from gpe_pl.rollout.rigid_containment import put_back_body
from gpe_pl.system.compiled import is_wanted
from gpe_pl.trajectory.boundary import Array, as_numpy
from gpe_pl.trajectory.rigid_bodies import bodies_of, whole_body
from gpe_pl.trajectory.state import State

log = logging.getLogger(__name__)


def contain(state: State, dt: float) -> tuple[State, Array]:
    """Move nodes inside a wall or obstacle back to its surface, along the normal. Depths up to ``geometry.shapes.surface_tolerance`` are allowed.

    In a narrow gap between surfaces, a node may still be inside afterwards; it then returns to its position before the step. So does a node between two
    surfaces that face each other, such as the floor and the lower face of a box that stands on it. Velocities and the last entry of
    the velocity history change by displacement / ``dt``, so that they remain differences of positions. A rigid body moves as a whole
    (``rollout.rigid_containment``).

    Args:
        state: state after a step.
        dt: frame interval [s].

    Returns:
        Corrected state (the same object if no node was inside) and a mask [node] of the corrected nodes.
    """
    contained, inside = _contain_nodes(state, dt)
    if state.rigid_body is not None and contained is not state:
        contained, inside = _contain_bodies(state, contained, inside, dt)
    if state.loads is not None:  # nodes whose motion is given stay inside
        inside = inside & ~array_namespace(inside).asarray(state.loads.prescribed.all(axis=1), device=device(inside))
    return contained, inside


def _contain_nodes(state: State, dt: float) -> tuple[State, Array]:
    """Return the results of ``contain`` for a state without rigid bodies."""
    shapes = state.boundary.shapes
    tolerance = surface_tolerance(shapes)
    if not _is_compiled(state):
        return _contain_plainly(state, dt, tolerance)
    pos, vel = np.ascontiguousarray(as_numpy(state.pos)), np.ascontiguousarray(as_numpy(state.vel))
    found = put_back(shapes, pos, vel, dt, tolerance)
    xp = array_namespace(state.pos)
    if found is None:
        return state, xp.zeros(len(pos), dtype=xp.bool)
    new_pos, new_vel, inside = found
    if state.periodicity:
        new_pos[inside] = state.periodicity.wrapped(new_pos[inside])
    return state.corrected(xp.asarray(new_pos), xp.asarray(new_vel)), xp.asarray(inside)


def _is_compiled(state: State) -> bool:
    """Tell whether compiled loops cover the arrays and shapes of a state."""
    if not is_wanted() or not has_compiled_distance(state.boundary.shapes):
        return False
    pos, vel = state.pos, state.vel
    if isinstance(pos, np.ndarray):
        return pos.dtype == vel.dtype == np.float64
    xp = array_namespace(pos)
    on_cpu = str(device(pos)) == "cpu" and not pos.requires_grad and not vel.requires_grad
    return bool(on_cpu and pos.dtype == vel.dtype == xp.float64)


def _contain_plainly(state: State, dt: float, tolerance: float) -> tuple[State, Array]:
    """Return the results of ``contain`` by the methods of the shapes."""
    shapes, pos = state.boundary.shapes, state.pos
    xp = array_namespace(pos)
    inside = (signed_distance(shapes, pos) < -tolerance) | _are_between(shapes, pos, tolerance)
    if not bool(xp.any(inside)):
        return state, inside
    rows = xp.nonzero(inside)[0]
    moved = xp.asarray(_on_surfaces(shapes, _plain(pos[rows]), tolerance))
    caught = (signed_distance(shapes, moved) < -tolerance) | _are_between(shapes, moved, tolerance)
    moved = xp.where(caught[:, None], pos[rows] - state.vel[rows] * dt, moved)
    new_pos, vel = xp.asarray(pos, copy=True), xp.asarray(state.vel, copy=True)
    new_pos[rows] = state.periodicity.wrapped(moved)
    vel[rows] = vel[rows] + (moved - pos[rows]) / dt
    return state.corrected(new_pos, vel), inside


def _contain_bodies(state: State, contained: State, inside: Array, dt: float) -> tuple[State, Array]:
    """Return the results of ``contain``, given those of ``_contain_nodes``."""
    shapes, xp = state.boundary.shapes, array_namespace(state.pos)
    pos, vel, moves = contained.pos + 0.0, contained.vel + 0.0, inside | False
    for rows in bodies_of(state.rigid_body):
        if not bool(xp.any(inside[rows])):
            continue
        start, mass = _plain(whole_body(state, rows)), state.mass[rows]
        mass = np.asarray(mass) if isinstance(start, np.ndarray) else mass
        own = put_back_body(shapes, start, mass, state.periodicity.wrapped, surface_tolerance(shapes))
        if own is None:
            own = start - _plain(state.vel[rows]) * dt
        way = own - start
        own, way = (xp.asarray(own), xp.asarray(way)) if isinstance(start, np.ndarray) else (own, way)
        pos[rows], moves[rows] = state.periodicity.wrapped(own), True
        vel[rows] = state.vel[rows] + way / dt
    return state.corrected(pos, vel), moves


def _plain(points: Array) -> Array:
    """Return points on a CPU as a NumPy array, whose operations on few points take less time than PyTorch's."""
    return points if str(device(points)) != "cpu" or getattr(points, "requires_grad", False) else np.asarray(points)


def _are_between(shapes: tuple[Shape, ...], points: Array, tolerance: float) -> Array:
    """Return whether each point is on the surfaces of two shapes that face each other."""
    xp = array_namespace(points)
    between, on_before = xp.zeros(len(points), dtype=xp.bool, device=device(points)), list[tuple[Array, Array]]()
    for shape in shapes:
        on = xp.abs(shape.signed_distance(points)) <= tolerance
        if not bool(xp.any(on)):  # normals are expensive, and most shapes touch no node
            continue
        normal = outward_normal(shape, points, step=tolerance)
        for other, other_normal in on_before:
            between = between | (on & other & (xp.sum(normal * other_normal, axis=1) < FACING))
        on_before.append((on, normal))
    return between


def _on_surfaces(shapes: tuple[Shape, ...], points: Array, tolerance: float) -> Array:
    """Move points along the normals of all shapes that they are inside of."""
    xp = array_namespace(points)
    for _ in range(NUM_PASSES):
        if not bool(xp.any(signed_distance(shapes, points) < 0)):
            break
        for shape in shapes:
            distance = shape.signed_distance(points)
            depth = xp.maximum(-distance, xp.zeros_like(distance))
            if bool(xp.any(depth > 0)):  # normals are expensive, and most shapes contain no node
                points = points + depth[:, None] * outward_normal(shape, points, step=tolerance)
    return points


@cache
def _warn_of_points() -> None:
    """Warn, once in a process, of walls without shapes."""
    log.warning(
        "containment: walls that are points only, and walls that move, have no shape, so nodes that cross them are neither put back nor counted"
    )


@dataclass(frozen=True)
class Contained:
    """A simulator with containment after every step. ``State.num_corrected`` of a new state is the number of corrected nodes.

    Attributes:
        simulator: simulator that makes the steps.
        dt: frame interval [s].

    Raises:
        ValueError: the simulator is an ensemble, whose members would go through walls unseen.
    """

    simulator: Simulator
    dt: float

    def __post_init__(self) -> None:
        if isinstance(self.simulator, Ensemble):
            raise ValueError(
                "containment of an ensemble would move the mean of its members only; contain each member: "
                "Ensemble(tuple(Contained(member, dt) for member in ensemble.members))"
            )

    @property
    def frame_dt(self) -> float:
        """Frame interval [s], which that of a scene has to be."""
        return self.dt

    def step(self, state: State) -> State:
        return self._contain(self.simulator.step(state))

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        return [self._contain(item) if isinstance(item, State) else item for item in step_all(self.simulator, states)]

    def _contain(self, state: State) -> State:
        if len(state.boundary.pos) and not state.boundary.shapes:
            _warn_of_points()
        contained, corrected = contain(state, self.dt)
        num_corrected = 0 if contained is state else int(corrected.sum())
        return contained if num_corrected == state.num_corrected else replace(contained, num_corrected=num_corrected)
