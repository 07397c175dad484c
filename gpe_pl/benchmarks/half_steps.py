"""A solver with half its time step. What this changes is a measure of the solver's own error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gpe_pl.trajectory.state import State


@dataclass(frozen=True)
class HalfSteps:
    """A simulator that advances a frame in two steps of a solver with half the frame interval and half the ``cfl``.

    It takes twice as many substeps as the solver, also where one substep takes a whole frame. It takes fewer where gravity or viscosity limits them.

    Attributes:
        solver: the solver, a dataclass with ``frame_dt`` and ``cfl``.
    """

    solver: Any

    @cached_property
    def _half(self) -> Any:
        return replace(self.solver, frame_dt=self.solver.frame_dt / 2, cfl=self.solver.cfl / 2)

    def step(self, state: State) -> State:
        middle = self._half.step(state)
        after = self._half.step(middle)
        return replace(after, num_substeps=middle.num_substeps + after.num_substeps)
