"""Trivial simulators that any learned model has to beat."""

from dataclasses import dataclass, replace

from array_api_compat import array_namespace

from gpe_pl import integrators
from gpe_pl.geometry import signed_distance
from gpe_pl.trajectory import State


@dataclass(frozen=True)
class ConstantVelocity:
    """Every node keeps its velocity and ignores walls."""

    dt: float

    def step(self, state: State) -> State:
        return replace(state, pos=state.pos + state.vel * self.dt, velocity_history=None, time=state.time + self.dt)


@dataclass(frozen=True)
class Ballistic:
    """Free fall until a node touches a wall or obstacle, where it sticks."""

    dt: float

    def step(self, state: State) -> State:
        xp = array_namespace(state.pos)
        pos, vel = integrators.advance(state.pos, state.vel, state.gravity, self.dt)
        outside = (signed_distance(state.boundary.shapes, pos) <= 0)[:, None]
        stuck = outside | xp.all(state.vel == 0, axis=-1, keepdims=True)  # a node at exact rest has stuck before
        # stop on the surface: the fraction of the step after which the distance is used up
        before = signed_distance(state.boundary.shapes, state.pos)
        after = signed_distance(state.boundary.shapes, pos)
        fraction = xp.clip(before / xp.where(before > after, before - after, xp.ones_like(before)), 0.0, 1.0)[:, None]
        pos = xp.where(outside, state.pos + fraction * (pos - state.pos), pos)
        at_rest = stuck & ~outside
        pos = xp.where(at_rest, state.pos, pos)
        vel = xp.where(stuck, xp.zeros_like(vel), vel)
        return replace(state, pos=pos, vel=vel, velocity_history=None, time=state.time + self.dt)
