"""``FinerSolver``: solves a scene at a finer spacing, and returns the solution at the nodes of the scene.

A model at the spacing of the scene can learn such a solution. The nodes are tracers: a fixed subset of the particles or mesh nodes of the finer solution. At
the start they have the positions and velocities of the scene. Each keeps the mass of its node in the scene. ``resolution`` divides scenes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from gpe_pl.rollout.loop import SimulationError, Simulator
from gpe_pl.solvers.resolution import Divided, divided_mesh, divided_particles
from gpe_pl.trajectory.state import State, Stress

FACTORS = (1, 2, 4)
"""Factors by which the spacing can be divided."""

TRACERS = "1"
"""Version of the code that divides scenes and selects tracers; data sets store it. Raise it with every change of results."""


@runtime_checkable
class Refinable(Simulator, Protocol):
    """A solver that can solve scenes at a finer spacing.

    Attributes:
        has_mesh: whether it solves on a mesh, whose cells are divided for a finer spacing. Otherwise particles are divided.
    """

    has_mesh: ClassVar[bool]

    def finer(self, factor: int) -> Refinable:
        """Return the solver for ``1 / factor`` of its spacing, with the same frame interval."""
        ...


@dataclass(frozen=True)
class FinerSolver:
    """A solver at a finer spacing for scenes at their own spacing; a ``Simulator``.

    A state must be the start of a scene or a state that ``step`` returned, because the nodes of the scene do not tell where all particles are. Material
    parameters may be changed in between. Each particle gets those of the node from which it comes.

    Attributes:
        solver: the solver for the finer spacing, a ``Refinable``.
        factor: factor by which the spacing is divided, one of ``FACTORS``.
        spacing: spacing of the nodes of the scene [m].
    """

    solver: Any
    factor: int
    spacing: float

    @property
    def name(self) -> str:
        return self.solver.name

    @property
    def version(self) -> str:
        return self.solver.version

    @property
    def stores_stress(self) -> bool:
        return self.solver.stores_stress

    @property
    def has_mesh(self) -> bool:
        return self.solver.has_mesh

    @property
    def frame_dt(self) -> float:
        return self.solver.frame_dt

    @property
    def solver_dt(self) -> float:
        return self.solver.solver_dt

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        return self.solver.bounds

    @property
    def materials(self) -> tuple[str, ...]:
        return self.solver.materials

    @property
    def smallest_resolved(self) -> dict[str, float]:
        """Smallest parameters that the solver resolves, by material; see ``caution``."""
        return getattr(self.solver, "smallest_resolved", {})

    def compile_kernels(self) -> None:
        self.solver.compile_kernels()

    def step(self, state: State) -> State:
        """Advance one frame. ``State.internal`` is the finer solution (``Divided``).

        Raises:
            SimulationError: with reason ``input``, if the finer solution of a state is not known, or the cells of a mesh cannot be divided; otherwise as the
                solver. The error names the node of the scene from which the failing particle comes.
        """
        fine = self.solution(state)
        start = replace(fine.state, material_params=fine.origin @ state.material_params, boundary=state.boundary, gravity=state.gravity)
        try:
            after = self.solver.step(start)
        except SimulationError as error:
            node = -1 if error.node < 0 else int(fine.origin[[error.node]].argmax())
            raise SimulationError(f"in the solution at 1/{self.factor} of the spacing: {error}", reason=error.reason, node=node) from None
        nodes = slice(state.num_nodes)
        stress = None
        if after.stress is not None:
            stress = _averaged(after.stress.cell, state) if self.solver.has_mesh else Stress.of_nodes(after.stress.node[nodes], state.cells)
        return state.later(
            self.frame_dt, after.pos[nodes], after.vel[nodes], velocity_history=None, stress=stress, num_substeps=after.num_substeps,
            internal=Divided(after, fine.origin),
        )  # fmt: skip

    def solution(self, state: State) -> Divided:
        """Return the finer solution of a state; errors are those of ``step``."""
        fine, count = state.internal, state.num_nodes
        if fine is None and state.time == 0:
            try:
                if self.solver.has_mesh:
                    return divided_mesh(state, self.factor)
                return divided_particles(state, self.spacing, self.factor)
            except ValueError as error:
                raise SimulationError(str(error), reason="input") from None
        remedy = "start at frame 0 of a scene, or step on from the state that the solver returned"
        if not isinstance(fine, Divided):
            raise SimulationError(f"the finer solution of the state at {state.time:g} s is not known; {remedy}", reason="input")
        if not (np.array_equal(fine.state.pos[:count], state.pos) and np.array_equal(fine.state.vel[:count], state.vel)):
            raise SimulationError(
                f"nodes at {state.time:g} s were moved, which the finer solution does not contain; {remedy}", reason="input"
            )
        return fine


def _averaged(parts: np.ndarray, state: State) -> Stress:
    """Return the stress of the cells of a scene from that of their parts [part, component] in Pa.

    The parts of a cell have equal volumes and the order of ``divided_mesh``. The stress of a node is the mean over the cells around it by volume at rest.
    """
    assert state.cells is not None and state.rest_pos is not None
    cell = parts.reshape(-1, len(state.cells), parts.shape[1]).mean(axis=0)
    corners = state.rest_pos[state.cells]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    around = np.zeros((state.num_nodes, 1 + parts.shape[1]))
    for corner in state.cells.T:
        np.add.at(around, corner, np.column_stack([volume, volume[:, None] * cell]))
    return Stress(around[:, 1:] / around[:, :1], cell)
