"""``Particles``: all arrays of the particles that the compiled kernels use."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Particles(NamedTuple):
    """Arrays of all particles, C-contiguous; the first six change in place.

    Attributes:
        pos, vel: positions and velocities [node, dim] in m and m/s.
        deformation, affine, gradient, plastic: as in ``MPMInternal``; ``gradient`` is the same array as ``affine`` where no particle has a ``MEMORY``.
        mass: masses [node] in kg.
        specific_volume: volume per mass at rest [node] in m³/kg.
        law: code of the constitutive law [node].
        constants: constants that the law reads [node, constant], see ``materials``.
    """

    pos: np.ndarray
    vel: np.ndarray
    deformation: np.ndarray
    affine: np.ndarray
    gradient: np.ndarray
    plastic: np.ndarray
    mass: np.ndarray
    specific_volume: np.ndarray
    law: np.ndarray
    constants: np.ndarray
