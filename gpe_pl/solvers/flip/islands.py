"""Connected bodies of liquid (islands). Some fly freely, and some fill a closed space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
@no_type_check
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, error_model="numpy")
@no_type_check
def find_islands(active, strides, area, density, weight, liquid, island):
    """Label the cells that hold mass and are connected by open faces.

    Two particles on one side of a wall that share a face of the grid are in one island, so islands do not act on each other.

    Args:
        active: indices of the cells that liquid reaches, in ascending order.
        strides: index difference of neighbours along each axis [dim].
        area, weight: open fraction and density of faces [axis, cell].
        density: density of cells [cell].
        liquid: number of each liquid cell, 0 for the others [cell].
        island: output, the label of each cell that holds mass [cell].

    Returns:
        Two arrays by label: whether the island touches no solid, and whether it has no free surface.
    """
    dim = strides.shape[0]
    for n in range(active.shape[0]):
        island[active[n]] = n
    parent = np.arange(active.shape[0])
    for n in range(active.shape[0]):
        c = active[n]
        if density[c] > 0.0:
            for a in range(dim):
                if density[c - strides[a]] > 0.0 and area[a, c] > 0.0:  # spaces that a wall divides keep their own volumes
                    i, j = _root(parent, n), _root(parent, island[c - strides[a]])
                    parent[max(i, j)] = min(i, j)
    is_free, is_full = np.ones(active.shape[0], dtype=np.bool_), np.ones(active.shape[0], dtype=np.bool_)
    for n in range(active.shape[0]):
        c = active[n]
        if not density[c] > 0.0:
            continue
        i = _root(parent, n)
        for m in range(2 * dim):
            a = m // 2
            face, other = (c, c - strides[a]) if m % 2 == 0 else (c + strides[a], c + strides[a])
            if weight[a, face] > 0.0 and area[a, face] < 1.0:
                is_free[i] = False
            if area[a, face] > 0.0 and (liquid[c] == 0 or liquid[other] == 0):
                is_full[i] = False
    for n in range(active.shape[0]):  # comes last, because the loops above use the numbers of the cells
        island[active[n]] = _root(parent, n)
    return is_free, is_full


@dataclass(frozen=True)
class Flying:
    """Particles of islands that touch no solid, in their state before a substep.

    Only gravity moves the centre of mass of such an island. The pressure at a free surface satisfies this only to the accuracy of the grid.

    Attributes:
        node: indices of the particles [flying].
        island: island of each particle, numbered from 0 [flying].
        mass: masses [flying] in kg.
        pos, vel: positions and velocities [flying, dim] in m and m/s.
    """

    node: np.ndarray
    island: np.ndarray
    mass: np.ndarray
    pos: np.ndarray
    vel: np.ndarray

    @classmethod
    def select(cls, island: np.ndarray, is_free: np.ndarray, pos: np.ndarray, vel: np.ndarray, mass: np.ndarray) -> Flying:
        """Copy the particles of free islands.

        Args:
            island: island of each particle, numbered from 0 [node].
            is_free: whether each island touches no solid [island].
            pos, vel, mass: positions, velocities and masses of all particles.
        """
        node = np.flatnonzero(is_free[island])
        return cls(node, np.unique(island[node], return_inverse=True)[1], mass[node], pos[node], vel[node])

    def balance(self, pos: np.ndarray, vel: np.ndarray, gravity: np.ndarray, h: float) -> None:
        """Move each island as a whole so that its centre of mass follows the parabola of free fall over a time h [s]."""
        if len(self.node) == 0:
            return
        total = np.bincount(self.island, self.mass)
        target = self.pos + h * self.vel + 0.5 * h * h * gravity, self.vel + h * gravity
        for values, wanted in zip((pos, vel), target, strict=True):
            error = wanted - values[self.node]
            for axis in range(pos.shape[1]):
                values[self.node, axis] += (np.bincount(self.island, self.mass * error[:, axis]) / total)[self.island]
