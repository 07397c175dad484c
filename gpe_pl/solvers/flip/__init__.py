"""Liquids: the fluid-implicit-particle method with variational pressure and viscosity.

``grid`` defines cells and solids, ``transfer`` moves velocities between particles and grid, ``viscosity`` and ``pressure`` assemble the two linear systems,
``linear`` solves them, ``islands`` finds separate bodies of liquid, and ``solver`` combines all of these. The code is the same for 2D and 3D.
"""

from gpe_pl.solvers.flip.solver import FLIP

__all__ = ["FLIP"]
