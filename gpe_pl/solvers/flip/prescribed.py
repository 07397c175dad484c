"""Faces whose velocity openings with a speed prescribe.

A cell with its centre in such an opening moves as a whole. Pressure acts on none of its faces, and its neighbours see the flow through the common face.
Particles in the opening move with its velocity. An opening without a speed needs nothing here: it is empty at the beginning of every frame, like any space
without liquid. A space that is full and closed keeps its volume, so an opening cannot fill or empty it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpe_pl.rollout.loop import SimulationError
from gpe_pl.solvers.flip.grid import Grid, Solids
from gpe_pl.trajectory.openings import Opening

KNOWN = 1e-30
"""Weight of faces that no particle reaches."""


@dataclass(frozen=True)
class Prescribed:
    """Faces with a prescribed velocity, and the openings that prescribe it.

    Attributes:
        openings: openings with a speed, each with its mean velocity in the frame [dim] in m/s.
        axes, cells: axis of each face, and the cell above it [face].
        below: cell below each face [face].
        velocity: velocity of each face along its axis [face] in m/s.
        area: open fraction of each face [face].
        is_inside: whether a cell belongs to an opening [cell].
    """

    openings: tuple[tuple[Opening, np.ndarray], ...]
    axes: np.ndarray
    cells: np.ndarray
    below: np.ndarray
    velocity: np.ndarray
    area: np.ndarray
    is_inside: np.ndarray

    @staticmethod
    def of(openings: tuple[Opening, ...], time: float, frame_dt: float, grid: Grid, solids: Solids) -> Prescribed | None:
        """Return the faces that openings prescribe in the frame that begins at a time [s]; None if none has a speed.

        Raises:
            SimulationError: with reason ``input``, if an opening contains the centre of no cell.
        """
        driven = tuple((opening, opening.mean_velocity(time, time + frame_dt)) for opening in openings if opening.drives)
        if not driven:
            return None
        lines = [o + grid.spacing * (np.arange(n) + 0.5) for o, n in zip(grid.origin, grid.counts, strict=True)]
        centres = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, grid.dim)
        is_inside, velocity = np.zeros(grid.num_cells, bool), np.zeros((grid.dim, grid.num_cells))
        prescribed = np.zeros((grid.dim, grid.num_cells), bool)
        for opening, mean in driven:
            own = np.flatnonzero(opening.contains(centres))
            if not len(own):
                raise SimulationError(
                    f"the opening from {opening.low} to {opening.high} m contains the centre of no cell of the grid, whose cells are {grid.spacing:g} m "
                    "wide; make it deeper",
                    reason="input",
                )
            is_inside[own] = True
            for axis, stride in enumerate(grid.strides):
                for face in (own, own + stride):
                    prescribed[axis, face], velocity[axis, face] = True, mean[axis]
        axes, cells = np.nonzero(prescribed & (solids.area > 0))
        return Prescribed(driven, axes, cells, cells - grid.strides[axes], velocity[axes, cells], solids.area[axes, cells], is_inside)

    def closed(self, solids: Solids) -> Solids:
        """Return the open space in which pressure acts: without prescribed faces, and without the cells of openings."""
        area = solids.area.copy()
        area[self.axes, self.cells] = 0.0
        return replace(solids, area=area, is_open=solids.is_open & ~self.is_inside)

    def impose(self, touched: np.ndarray, velocity: np.ndarray, weight: np.ndarray) -> None:
        """Write the velocities of the faces next to touched cells to ``velocity`` [axis, cell]; arguments as in ``solver.Fields``."""
        near = touched[self.cells] | touched[self.below]
        face = self.axes[near], self.cells[near]
        velocity[face] = self.velocity[near]
        weight[face] = np.maximum(weight[face], KNOWN)

    def add_inflow(self, liquid: np.ndarray, right: np.ndarray) -> None:
        """Add the flow through prescribed faces to ``right`` [liquid], as ``pressure.inflow``; ``liquid`` as in ``solver.Fields``."""
        flow = self.area * self.velocity
        for cell, sign in ((self.cells, 1.0), (self.below, -1.0)):
            number = liquid[cell] - 1
            np.add.at(right, number[number >= 0], sign * flow[number >= 0])

    def carry(self, start: np.ndarray, pos: np.ndarray, vel: np.ndarray, h: float) -> None:
        """Move the particles that were in an opening at ``start`` [node, dim] with its velocity for a time h [s], in place."""
        for opening, mean in self.openings:
            inside = opening.contains(start)
            pos[inside], vel[inside] = start[inside] + h * mean, mean
