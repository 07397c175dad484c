"""How much worse other values of one unknown fit than the answer.

The search has tried many values. The lower convex hull of their misfits over one unknown is a curve that needs no further rollouts. With several unknowns, a
value was tried together with different values of the others. The hull then approximates the smallest misfit over these, as in a profile likelihood, if the
search has followed the valleys of the misfit (``valleys``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True)
class Profile:
    """A convex, piecewise linear curve: misfit above the smallest, over one unknown.

    Attributes:
        at: values of the unknown at the corners, in its coordinate, rising.
        excess: misfit above the smallest at the corners.
    """

    at: Float64[np.ndarray, "corner"]
    excess: Float64[np.ndarray, "corner"]

    @classmethod
    def of(cls, tried: Iterable[tuple[float, float]], bounds: tuple[float, float]) -> Profile:
        """Return the lower convex hull of what a search has tried.

        Args:
            tried: coordinate and misfit of each.
            bounds: bounds of the search in the coordinate. The last piece goes on as far as the bound, but not below the smallest misfit.
        """
        corners: list[tuple[float, float]] = []
        for x, y in sorted(tried):
            if corners and x <= corners[-1][0]:
                continue  # sorted, so the earlier one is lower
            while len(corners) > 1 and _slope(corners[-2], corners[-1]) >= _slope(corners[-2], (x, y)):
                corners.pop()
            corners.append((x, y))
        at, misfit = np.array(corners).T
        excess = misfit - misfit.min()
        for side, bound in ((0, bounds[0]), (-1, bounds[1])):
            if (bound < at[0]) if side == 0 else (bound > at[-1]):
                slope = np.diff(excess)[side] / np.diff(at)[side] if len(at) > 1 else 0.0
                end = max(0.0, excess[side] + slope * (bound - at[side]))
                at, excess = (np.insert(own, 0 if side == 0 else len(own), new) for own, new in ((at, bound), (excess, end)))
        return cls(at, excess)

    def above(self, coordinate: float) -> float:
        """Return the misfit above the smallest at a value; infinite outside the bounds."""
        return float(np.interp(coordinate, self.at, self.excess, left=np.inf, right=np.inf))

    def within(self, threshold: float) -> tuple[float, float]:
        """Return the smallest and largest value at which the misfit is at most ``threshold`` above the smallest."""
        best = int(np.argmin(self.excess))
        low = np.interp(-threshold, -self.excess[: best + 1], self.at[: best + 1])
        high = np.interp(threshold, self.excess[best:], self.at[best:])
        return float(low), float(high)


def _slope(start: tuple[float, float], end: tuple[float, float]) -> float:
    return (end[1] - start[1]) / (end[0] - start[0])
