"""Rigid bodies: groups of nodes that move by one rigid motion.

A simulator predicts a velocity v for each node of a body. The body instead moves by the one translation V and rotation R about its centre of mass c that have
the same momentum and the same angular momentum, with arms r = x − c, masses m and the frame interval Δt::

    Σ m V = Σ m v        Σ m r × R r / Δt = Σ m r × v

The new velocity of a node is its displacement over Δt, so both sums also hold for the stored velocities. Without forces, momentum and angular momentum are
constant over any number of steps. In 2D the second equation reads I sin φ = L Δt. In 3D it is solved by Newton's method for the vector part of the unit
quaternion of R. If no rotation by at most ``LARGEST_ANGLE`` has the angular momentum, the body gets the largest fraction of it that such a rotation has.

Source: Moser and Veselov 1991, "Discrete versions of some classical integrable systems and factorization of matrix polynomials", Comm. Math. Phys. 139.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from array_api_compat import array_namespace, device

from gpe_pl.trajectory.boundary import Array
from gpe_pl.trajectory.state import State

LARGEST_ANGLE = math.pi / 2
"""Largest rotation in one step [rad]. With the discrete law above, no larger rotation has more angular momentum."""
NUM_ITERATIONS = 12
"""Maximum number of Newton steps. Three suffice for turns by 0.1 rad."""
SMALL = 1e-14
"""Newton's method ends at this change of the quaternion."""
INSIDE = 1 - 1e-6
"""Newton's method stays below this fraction of the limit. At the limit itself its slope has no inverse."""
NUM_HALVINGS = 10
"""Number of halvings of the interval in which the largest possible fraction of an angular momentum is searched for, which gives it to a thousandth."""
NO_INERTIA = 1e-12
"""Fraction of the moment of inertia that is added along all axes. Bodies in a row, and single nodes, have none along some."""
TINY = 1e-300


def bodies_of(rigid_body: Array) -> Iterator[Array]:
    """Yield the rows [body_node] of each rigid body; ``rigid_body`` has the number of each node's body, −1 for none [node]."""
    xp = array_namespace(rigid_body)
    for number in xp.unique_values(rigid_body):
        if number >= 0:
            yield xp.nonzero(rigid_body == number)[0]


def all_of_bodies(mask: Array, rigid_body: Array | None) -> Array:
    """Return a mask [node] in which a rigid body is true as a whole or not at all: true if all its nodes are. Nodes of no body keep their values."""
    if rigid_body is None:
        return mask
    whole = mask & True
    for rows in bodies_of(rigid_body):
        whole[rows] = mask[rows].all()
    return whole


def moved_rigidly(before: State, after: State, dt: float) -> State:
    """Return a state after a step in which the nodes of each rigid body have moved by one rigid motion. The other nodes are unchanged.

    Args:
        before: state before the step.
        after: state after the step; its velocities are those that the simulator predicts.
        dt: frame interval [s].
    """
    if before.rigid_body is None:
        return after
    pos, vel = after.pos + 0.0, after.vel + 0.0  # copies that keep gradients
    for rows in bodies_of(before.rigid_body):
        way = rigid_displacement(whole_body(before, rows), after.vel[rows], before.mass[rows], dt)
        pos[rows] = before.periodicity.wrapped(before.pos[rows] + way)
        vel[rows] = way / dt
    return after.corrected(pos, vel)


def whole_body(state: State, rows: Array) -> Array:
    """Return the positions of a body [body_node, dim] in m, undivided by the seam of a periodic domain."""
    pos = state.pos[rows]
    return pos if not state.periodicity else pos[:1] + state.periodicity.shortest(pos - pos[:1])


def rigid_modes(pos: Array, mass: Array) -> Array:
    """Return small rigid motions [mode, node, dim] of one body: translations along the axes, then rotations about the centre of mass.

    They are orthonormal with respect to the masses: Σ w u · v is 1 for a mode with itself and 0 for two modes, with w = m / Σ m. A rotation that moves no
    node is 0.

    Args:
        pos: positions [node, dim] in m.
        mass: masses [node] in kg.
    """
    xp = array_namespace(pos)
    dim = pos.shape[1]
    weight = xp.astype(mass, pos.dtype)[:, None]
    weight = weight / xp.sum(weight)
    arm = pos - xp.sum(weight * pos, axis=0)
    axes = xp.eye(dim, dtype=arm.dtype, device=device(arm))
    shifts = axes[:, None, :] + 0 * arm
    if dim == 2:
        turns = xp.stack([-arm[:, 1], arm[:, 0]], axis=1)[None]
    else:
        turns = xp.stack([_cross(axes[k] + 0 * arm, arm) for k in range(dim)])
    limits = xp.finfo(arm.dtype)
    least = max(NO_INERTIA, 4 * float(limits.eps)) * xp.sum(weight * arm**2) + float(limits.smallest_normal)
    inertia = xp.sum(weight * turns[:, None] * turns[None], axis=(2, 3))
    factor = xp.linalg.cholesky(inertia + least * xp.eye(len(turns), dtype=arm.dtype, device=device(arm)))
    turns = xp.linalg.solve(factor, xp.reshape(turns, (len(turns), -1)))
    return xp.concat([shifts, xp.reshape(turns, (-1, *arm.shape))])


def rigid_displacement(pos: Array, vel: Array, mass: Array, dt: float) -> Array:
    """Return the displacements [node, dim] in m of one body over a frame.

    Args:
        pos: positions [node, dim] in m.
        vel: predicted velocities [node, dim] in m/s.
        mass: masses [node] in kg.
        dt: frame interval [s].
    """
    xp = array_namespace(pos)
    weight = xp.astype(mass, pos.dtype)[:, None]
    weight = weight / xp.sum(weight)
    arm = pos - xp.sum(weight * pos, axis=0)
    way = xp.sum(weight * vel, axis=0) * dt
    turned = _turned_in_plane if pos.shape[1] == 2 else _turned_in_space
    return way + turned(arm, weight, vel * dt)


def _turned_in_plane(arm: Array, weight: Array, way: Array) -> Array:
    """Return the displacements by rotation [node, 2] of arms [node, 2], given weights [node, 1] and predicted displacements [node, 2]."""
    xp = array_namespace(arm)
    across = xp.stack([-arm[:, 1], arm[:, 0]], axis=1)
    inertia = xp.sum(weight * arm**2) + TINY
    sine = xp.clip(xp.sum(weight * across * way) / inertia, -1.0, 1.0)
    cosine_less_one = -(sine**2) / (1 + xp.sqrt(1 - sine**2))  # exact for small angles
    return cosine_less_one * arm + sine * across


def _turned_in_space(arm: Array, weight: Array, way: Array) -> Array:
    """Return the displacements by rotation [node, 3], arguments as in ``_turned_in_plane``.

    With the quaternion (s, q) and the tensor of inertia I, Σ m r × R r = 2 s I q + 2 q × I q.
    """
    xp = array_namespace(arm)
    one = xp.eye(3, dtype=arm.dtype, device=device(arm))
    second = (weight * arm).T @ arm
    trace = xp.sum(weight * arm**2) + TINY
    inertia = (1 + NO_INERTIA) * trace * one - second
    wanted = xp.sum(weight * _cross(arm, way), axis=0) / 2
    q, is_solved = _solved(xp.linalg.solve(inertia, wanted[:, None])[:, 0], wanted, inertia)
    if not is_solved and bool(xp.all(xp.isfinite(wanted))):  # no rotation up to the limit has this angular momentum
        q, low, high = 0 * wanted, 0.0, 1.0
        for _ in range(NUM_HALVINGS):
            middle = (low + high) / 2
            found, is_solved = _solved(q if low else middle * xp.linalg.solve(inertia, wanted[:, None])[:, 0], middle * wanted, inertia)
            if is_solved:
                q, low = found, middle
            else:
                high = middle
    turn = _cross(xp.broadcast_to(q, arm.shape), arm)
    return 2 * (xp.sqrt(1 - xp.sum(q**2)) * turn + _cross(xp.broadcast_to(q, arm.shape), turn))


def _solved(q: Array, wanted: Array, inertia: Array) -> tuple[Array, bool]:
    """Return the vector part [3] of the rotation up to the limit with half an angular momentum [3] times the frame interval, and whether there is one.

    Newton's method starts at ``q`` [3].
    """
    xp = array_namespace(q)
    limit = math.sin(LARGEST_ANGLE / 2)
    for _ in range(NUM_ITERATIONS):
        q = _at_most(q, INSIDE * limit)
        change = xp.linalg.solve(_slope(q, inertia), (_momentum(q, inertia) - wanted)[:, None])[:, 0]
        q = q - change
        if bool(xp.all(xp.abs(change) < SMALL)):
            break
    q = _at_most(q, limit)
    missed = xp.sum((_momentum(q, inertia) - wanted) ** 2)
    return q, bool(missed <= xp.finfo(q.dtype).eps * xp.sum(wanted**2))


def _momentum(q: Array, inertia: Array) -> Array:
    """Return half the angular momentum [3] of the rotation with the vector part ``q`` [3], times the frame interval."""
    xp = array_namespace(q)
    spin = inertia @ q
    return xp.sqrt(1 - xp.sum(q**2)) * spin + _cross(q, spin)


def _slope(q: Array, inertia: Array) -> Array:
    """Return the derivative [3, 3] of ``_momentum`` by ``q``."""
    xp = array_namespace(q)
    scalar, spin = xp.sqrt(1 - xp.sum(q**2)), inertia @ q
    return scalar * inertia - spin[:, None] * q[None, :] / scalar + _matrix(q) @ inertia - _matrix(spin)


def _at_most(q: Array, limit: float) -> Array:
    xp = array_namespace(q)
    length = xp.sqrt(xp.sum(q**2) + TINY)
    return xp.where(length > limit, q * (limit / length), q)


def _cross(a: Array, b: Array) -> Array:
    xp = array_namespace(a)
    parts = [a[..., j] * b[..., k] - a[..., k] * b[..., j] for j, k in ((1, 2), (2, 0), (0, 1))]
    return xp.stack(parts, axis=-1)


def _matrix(q: Array) -> Array:
    """Return the matrix [3, 3] whose product with a vector is the cross product of ``q`` with it."""
    xp = array_namespace(q)
    zero: Any = 0 * q[0]
    rows = ([zero, -q[2], q[1]], [q[2], zero, -q[0]], [-q[1], q[0], zero])
    return xp.stack([xp.stack(row) for row in rows])
