"""Liquids: the fluid-implicit-particle method with variational pressure and viscosity.

``grid`` knows cells and solids, ``transfer`` takes velocities between particles and grid, ``viscosity`` and ``pressure`` assemble the two linear systems
that ``linear`` solves, ``islands`` finds separate bodies of liquid, and ``solver`` puts them together. All are the same for 2D and 3D.
"""

from gpe_pl.solvers.flip.solver import FLIP

__all__ = ["FLIP"]
