"""Cauchy stress of the particles of ``MPM``."""

from __future__ import annotations

import numpy as np

from gpe_pl.solvers.materials import COEFFICIENT, LAMBDA, MAX_HARDENING, MU, SAND, SNOW, VISCOSITY
from gpe_pl.solvers.mpm import transfer_2d, transfer_3d
from gpe_pl.solvers.mpm.particles import Particles


def cauchy_stress(particles: Particles, last_substep: float) -> np.ndarray:
    """Return the Cauchy stress of the particles at their positions [node, component] in Pa, in the order of ``schema.STRESS_COMPONENTS``.

    It is the Kirchhoff stress with which the next substep begins, over the volume of the particle relative to its volume at rest.

    Args:
        particles: particles at the end of a frame.
        last_substep: length of the last substep [s], for which they have moved but not yet deformed.
    """
    count, dim = particles.pos.shape
    now = particles._replace(deformation=particles.deformation.copy(), plastic=particles.plastic.copy())
    kirchhoff = np.empty((count, 3 * dim - 3))
    (transfer_2d if dim == 2 else transfer_3d).deform(now, kirchhoff, last_substep)
    elastic = np.abs(np.linalg.det(now.deformation))  # the laws do not tell an inverted particle from its mirror image
    plastic = np.where(particles.law == SNOW, 1.0 + now.plastic, np.exp(np.where(particles.law == SAND, now.plastic, 0.0)))
    if dim == 2:
        kirchhoff = np.column_stack([kirchhoff, _across(particles, kirchhoff, elastic)])
    return kirchhoff / (elastic * plastic)[:, None]


def _across(particles: Particles, inside: np.ndarray, elastic: np.ndarray) -> np.ndarray:
    """Return the Kirchhoff stress [node] normal to the plane in plane strain.

    The laws of snow and of elastomers have no deviator for this direction, which is not stretched. That of sand has none either, because its plastic flow is in
    the plane.

    Args:
        particles: particles before they deform.
        inside: their Kirchhoff stress in the plane, xx, xy and yy [node, 3].
        elastic: their elastic volume ratio J [node].
    """
    constants, law = particles.constants, particles.law
    lam, mu = constants[:, LAMBDA], constants[:, MU]
    rate = np.trace(particles.gradient, axis1=1, axis2=2) * constants[:, VISCOSITY] / particles.specific_volume
    mean = (inside[:, 0] + inside[:, 2]) / 2 - rate / 3  # of the elastic stress
    found = np.where(law == SAND, lam / (lam + mu) * mean, lam * np.log(elastic))
    snow = law == SNOW
    factor = np.exp(np.minimum(-constants[snow, COEFFICIENT] * particles.plastic[snow], np.log(constants[snow, MAX_HARDENING])))
    found[snow] = factor * lam[snow] * (elastic[snow] - 1.0) * elastic[snow]
    return found - 2 * rate / 3
