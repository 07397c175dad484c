"""Trivial baselines: simulators that learn nothing. A learned model is useful only if it has smaller errors."""

from collections.abc import Callable
from dataclasses import dataclass

from array_api_compat import array_namespace

from gpe_pl.geometry.shapes import Shape, signed_distance, surface_tolerance
from gpe_pl.rollout.loop import Simulator
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import Array
from gpe_pl.trajectory.rigid_bodies import moved_rigidly
from gpe_pl.trajectory.state import State

NUM_BISECTIONS = 30


@dataclass(frozen=True)
class _Baseline:
    """A baseline of any scene.

    Attributes:
        dt: frame interval [s].
    """

    dt: float

    @property
    def frame_dt(self) -> float:
        """Frame interval [s], which that of a scene has to be."""
        return self.dt


@dataclass(frozen=True)
class ConstantVelocity(_Baseline):
    """Every node keeps its velocity, and every rigid body its momentum and angular momentum; walls are ignored."""

    def step(self, state: State) -> State:
        return moved_rigidly(state, state.later(self.dt, state.pos + state.vel * self.dt, state.vel), self.dt)


@dataclass(frozen=True)
class StopsAtWalls(_Baseline):
    """Every node keeps its velocity until it touches a wall or obstacle, where it sticks. This baseline also suits data whose gravity is unknown."""

    def step(self, state: State) -> State:
        return _sticking(state, self.dt, 0.0 * state.gravity)


@dataclass(frozen=True)
class Ballistic(_Baseline):
    """Every node falls freely until it touches a wall or obstacle, where it sticks."""

    def step(self, state: State) -> State:
        return _sticking(state, self.dt, state.gravity)


BASELINES: dict[str, Callable[[float], Simulator]] = {
    "ballistic": Ballistic,
    "stops_at_walls": StopsAtWalls,
    "constant_velocity": ConstantVelocity,
}
"""Baselines of an evaluation by their names in tables; each takes the frame interval [s]."""


def _sticking(state: State, dt: float, acceleration: Array) -> State:
    """Return the state after a step with a constant acceleration [dim] in m/s². Nodes that touch a wall or obstacle stay there."""
    xp = array_namespace(state.pos)
    shapes = state.boundary.shapes
    pos, vel = integrators.advance(state.pos, state.vel, acceleration, dt)
    stuck = xp.all(state.vel == 0, axis=-1) & (signed_distance(shapes, state.pos) < surface_tolerance(shapes))
    hit = (signed_distance(shapes, pos) <= 0) & ~stuck
    if bool(xp.any(hit)):
        rows = xp.nonzero(hit)[0]
        pos = xp.asarray(pos, copy=True)
        pos[rows] = _touchdown(shapes, state.pos[rows], pos[rows])
    pos = xp.where(stuck[:, None], state.pos, pos)
    vel = xp.where((hit | stuck)[:, None], xp.zeros_like(vel), vel)
    return moved_rigidly(state, state.later(dt, pos, vel), dt)


def _touchdown(shapes: tuple[Shape, ...], start: Array, end: Array) -> Array:
    """Return the last free points [node, dim] on the straight paths between two points each, found by bisection."""
    xp = array_namespace(end)
    free, inside = start, end
    for _ in range(NUM_BISECTIONS):
        middle = (free + inside) / 2
        is_free = (signed_distance(shapes, middle) >= 0)[:, None]
        free, inside = xp.where(is_free, middle, free), xp.where(is_free, inside, middle)
    return free
