"""Periodic axes. A node that leaves the domain on one side enters it on the other.

With L the period and low the lower bound of an axis::

    shortest(d) = d − L round(d / L)               minimum image of a difference of positions
    wrapped(x)  = x − L floor((x − low) / L)       image inside the domain

Source: Allen and Tildesley, Computer Simulation of Liquids (1987), section 1.5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from gpe_pl.errors import GpeError

Array = Any
"""A NumPy array or a torch tensor."""


class PeriodicityError(GpeError, ValueError):
    """Raised for a length that does not fit a periodic domain; the message names axis and period."""


@dataclass(frozen=True)
class Periodicity:
    """The periodic axes of a domain and their periods. The object is false if no axis is periodic.

    Attributes:
        bounds: ``(low, high)`` of the domain per axis [m].
        periodic: whether space repeats, per axis.
    """

    bounds: tuple[tuple[float, float], ...] = ()
    periodic: tuple[bool, ...] = ()

    def __bool__(self) -> bool:
        return any(self.periodic)

    @cached_property
    def axes(self) -> tuple[int, ...]:
        """Indices of the periodic axes."""
        return tuple(axis for axis, repeats in enumerate(self.periodic) if repeats)

    @cached_property
    def period(self) -> np.ndarray:
        """Period of each axis [dim] in m; 0 for axes that are not periodic."""
        return np.array([high - low if repeats else 0.0 for (low, high), repeats in zip(self.bounds, self.periodic, strict=True)])

    def shortest(self, difference: Array) -> Array:
        """Return minimum images of differences of positions [..., dim] in m; returns the same object if no axis is periodic."""
        return difference - self._turns(difference, round_down=False) if self else difference

    def wrapped(self, pos: Array) -> Array:
        """Return images of positions [..., dim] in m that satisfy ``low <= x < high`` along periodic axes, in the precision of ``pos``.

        Positions inside the domain are unchanged to the bit. The same object is returned if no axis is periodic.
        """
        if not self:
            return pos
        xp = array_namespace(pos)
        low, high = (self._row([b[side] for b in self.bounds], pos) for side in (0, 1))
        folded = pos - self._turns(pos - low, round_down=True)
        folded = xp.where((folded < low) | (folded >= high), low, folded)  # rounding can lead outside; both bounds are one place
        folds = (self._row([float(p) for p in self.periodic], pos) > 0) & ~((pos >= low) & (pos < high))
        return xp.where(folds, folded, pos)

    def from_corner(self, pos: Array) -> Array:
        """Return wrapped positions [..., dim] in m relative to the domain's lower corner, below the period along periodic axes, as a k-d tree needs them."""
        xp = array_namespace(pos)
        low, period = self._row([low for low, _ in self.bounds], pos), self._row(self.period, pos)
        inside = self.wrapped(pos) - low
        return xp.where((period > 0) & (inside >= period), 0.0 * inside, inside)  # the subtraction may round up to the period

    def check_radius(self, radius: float) -> None:
        """Raise ``PeriodicityError`` if a node can have several images within the radius [m]."""
        for axis in self.axes:
            if not 2 * radius < self.period[axis]:
                raise PeriodicityError(
                    f"radius {radius:g} m must be below half the period {self.period[axis]:g} m of axis {'xyz'[axis]}, or nodes would be neighbours "
                    "on both sides; choose a smaller connectivity radius or a larger domain"
                )

    def _turns(self, length: Array, round_down: bool) -> Array:
        """Return the multiples of the period nearest to lengths along each axis, or the next ones below with ``round_down`` [m]."""
        xp = array_namespace(length)
        period = self._row(self.period, length)
        turns = length / self._row(np.where(self.period > 0, self.period, 1.0), length)
        return period * (xp.floor(turns) if round_down else xp.round(turns))

    @staticmethod
    def _row(values: Any, like: Array) -> Array:
        return array_namespace(like).asarray(values, dtype=like.dtype, device=device(like))


NOWHERE = Periodicity()
"""Periodicity of a domain without periodic axes."""
