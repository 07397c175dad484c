"""Coulomb's law for islands that touch one plane: the plane can push and rub them, but it holds nothing.

Training has no bodies that start at rest at walls, so a network may hold them at a ceiling or beside a smooth wall. The total force F of walls on an island
that touches only walls with one normal n is therefore brought into the friction cone::

    F·n ≥ 0,   |F − (F·n) n| ≤ μ F·n

μ is the largest friction coefficient of these walls. The part along n is clamped first, then the part across it is shortened. The change moves the island as a
whole. Nothing changes at no-slip walls, at which solvers let material stick, nor where an island touches walls with several normals or something besides walls
acts on it.

MPM and finite elements obey this law at every contact, so bodies do, too. Single particles of spray may break it in MPM, since particles farther apart than the
radius of the graph still share nodes of the grid. FLIP has walls without slip whatever their friction, so this law is not for its liquids.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.schema import STICKY

NO_SLIP = 0.5 * STICKY
"""Friction coefficient from which walls are no-slip, with room for the rounding of features."""
ALIKE = 1e-6
"""Largest difference from 1 of the length of the mean of unit normals that count as one normal."""
TINY = 1e-12
"""Smallest force across a normal that is compared [m/s²]."""


def limited(
    acceleration: Float[Tensor, "node dim"], mass: Float[Tensor, " node"], gravity: Float[Tensor, " dim"], contacts: WallContacts
) -> Float[Tensor, "node dim"]:
    """Return accelerations with which planes act on islands by Coulomb's law.

    Args:
        acceleration: accelerations in m/s², with gravity.
        mass: masses [kg].
        gravity: acceleration by gravity [m/s²].
        contacts: edges to walls.
    """
    count, island = contacts.others_act.shape[0], contacts.island
    normal, friction = contacts.normal.to(acceleration.dtype), contacts.friction.to(acceleration.dtype)

    def sums(values: Tensor, group: Tensor) -> Tensor:
        return values.new_zeros(count, *values.shape[1:]).index_add(0, group, values)

    number = sums(torch.ones_like(friction), contacts.at)[:, None]
    mean = sums(normal, contacts.at) / number.clamp(min=1.0)
    length = mean.norm(dim=1, keepdim=True)
    mu = friction.new_zeros(count).scatter_reduce(0, contacts.at, friction.clamp(max=STICKY), "amax")[:, None]
    applies = (length > 1 - ALIKE) & (mu < NO_SLIP) & ~contacts.others_act[:, None]
    n = mean / length.clamp(min=0.5)
    m = mass[:, None].to(acceleration.dtype)
    total = sums(m, island).clamp(min=torch.finfo(m.dtype).tiny)
    force = sums(m * (acceleration - gravity.to(acceleration.dtype)), island) / total
    along = (force * n).sum(dim=1, keepdim=True)
    across = force - along * n
    size = (across.square().sum(dim=1, keepdim=True) + TINY**2).sqrt()
    pushes = along.clamp(min=0.0)
    allowed = pushes * n + across * (mu * pushes / size).clamp(max=1.0)
    return acceleration + torch.where(applies, allowed - force, 0.0)[island]


def limit(acceleration: np.ndarray, mass: np.ndarray, gravity: np.ndarray, contacts: WallContacts) -> None:
    """Do the same as ``limited`` in place, with a compiled loop."""
    edges = contacts.at.numpy(), contacts.normal.numpy(), contacts.friction.numpy()
    _limit(acceleration, mass, gravity, contacts.island.numpy(), contacts.others_act.numpy(), *edges)


@njit(cache=True, error_model="numpy")
@no_type_check
def _limit(acceleration, mass, gravity, island, others_act, at, normal, friction):
    count, dim = len(others_act), acceleration.shape[1]
    number, mu, total = np.zeros(count), np.zeros(count), np.zeros(count)
    mean, force = np.zeros((count, dim)), np.zeros((count, dim))
    for e in range(len(at)):
        k = at[e]
        number[k] += 1.0
        mu[k] = max(mu[k], friction[e])
        for a in range(dim):
            mean[k, a] += normal[e, a]
    for i in range(len(island)):
        k = island[i]
        if number[k] == 0.0:
            continue
        total[k] += mass[i]
        for a in range(dim):
            force[k, a] += mass[i] * (acceleration[i, a] - gravity[a])
    applies = False
    for k in range(count):
        square, along = 0.0, 0.0
        for a in range(dim):
            mean[k, a] /= max(number[k], 1.0)
            square += mean[k, a] ** 2
        length = np.sqrt(square)
        if length <= 1 - ALIKE or mu[k] >= NO_SLIP or others_act[k]:
            force[k] = 0.0  # from here on the change of the acceleration
            continue
        applies = True
        for a in range(dim):
            force[k, a] /= total[k]
            mean[k, a] /= length
            along += force[k, a] * mean[k, a]
        square = TINY**2
        for a in range(dim):
            square += (force[k, a] - along * mean[k, a]) ** 2
        pushes = max(along, 0.0)
        share = min(mu[k] * pushes / np.sqrt(square), 1.0)
        for a in range(dim):
            across = force[k, a] - along * mean[k, a]
            force[k, a] = pushes * mean[k, a] + share * across - force[k, a]
    if not applies:
        return
    for i in range(len(island)):
        for a in range(dim):
            acceleration[i, a] += force[island[i], a]
