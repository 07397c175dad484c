"""A solver with half its time step. The change of its result is a measure of the solver's own error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gpe_pl.solvers.finer_solver import FinerSolver
from gpe_pl.trajectory.state import State


@dataclass(frozen=True)
class HalfSteps:
    """A simulator that advances a frame in two steps of a solver with half the frame interval and half the ``cfl``.

    It takes twice as many substeps as the solver, even if one substep takes a whole frame. Where gravity or viscosity limits the substeps, the number grows
    less.

    Attributes:
        solver: the solver, a dataclass with ``frame_dt`` and ``cfl``, or a ``FinerSolver`` with such a solver.
    """

    solver: Any

    @cached_property
    def _half(self) -> Any:
        if isinstance(self.solver, FinerSolver):
            return replace(self.solver, solver=_halved(self.solver.solver))
        return _halved(self.solver)

    def step(self, state: State) -> State:
        middle = self._half.step(state)
        after = self._half.step(middle)
        return replace(after, num_substeps=middle.num_substeps + after.num_substeps)


def _halved(solver: Any) -> Any:
    return replace(solver, frame_dt=solver.frame_dt / 2, cfl=solver.cfl / 2)
