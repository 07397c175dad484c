"""Deformation gradients of mesh cells, and the elastic energy that neo-Hookean cells store.

With corners x of a cell and the gradients G of its shape functions in the rest configuration::

    F = Σ_a x_a ⊗ G_a,   J = det F,   Ψ = μ/2 (tr FᵀF - 3) - μ log J + λ/2 (log J)²

Ψ is the energy per rest volume (Bonet & Wood 2008, section 6.4.3), in plane strain in 2D. Below ``J = SMALLEST_RATIO`` the tangent of the logarithm replaces
it, so the energy of a crushed or inverted cell is finite, and larger the further it is crushed.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from jaxtyping import Float

SMALLEST_RATIO = 0.2
"""Volume ratio J below which the tangent replaces the logarithm."""

_GAUSS = 1.0 / math.sqrt(3.0)

_SIGNS = {
    2: np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
    3: np.array([[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))]),
}
"""Corners of the square and the cube from -1 to 1 in VTK's order, by dimension."""

HEXAHEDRON = 8
"""Number of corners of a hexahedron."""

POINTS_TO_CORNERS = np.prod((1.0 + _SIGNS[3][:, None] * _SIGNS[3] / _GAUSS) / 2.0, axis=2)
"""Weights that extrapolate values from the quadrature points of a hexahedron to its corners [corner, point], by the trilinear function through the points."""

FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)


def lame_parameters(youngs_modulus: FloatOrArray, poisson_ratio: float | np.ndarray) -> tuple[FloatOrArray, FloatOrArray]:
    """Return the first Lamé parameter λ and the shear modulus μ in Pa (plane strain in 2D)."""
    shear = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    first = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return first, shear  # type: ignore[return-value]


def local_gradients(dim: int, num_corners: int) -> tuple[Float[np.ndarray, "point corner dim"], float]:
    """Return the gradients of the shape functions at the quadrature points of an undistorted cell, and the volume of each of its points.

    Args:
        dim: dimension of the cell.
        num_corners: dim + 1 for a simplex, 2^dim for a quadrilateral or hexahedron.
    """
    if num_corners == dim + 1:
        return np.concatenate([-np.ones((1, dim)), np.eye(dim)])[None], 1.0 / math.factorial(dim)
    signs = _SIGNS[dim]
    points = signs * _GAUSS
    factor = (1 + points[:, None] * signs) / 2  # of the shape functions ∏ (1 + ξ_k s_k) / 2 [point, corner, dim]
    slopes = [math.prod(signs[:, k] / 2 if k == axis else factor[..., k] for k in range(dim)) for axis in range(dim)]
    return np.stack(slopes, axis=-1), 1.0


def shape_gradients(
    corners: Float[np.ndarray, "cell corner dim"],
) -> tuple[Float[np.ndarray, "cell point corner dim"], Float[np.ndarray, "cell point"]]:
    """Return the gradients of the shape functions at the quadrature points of cells at rest, and the volumes of these points.

    Simplices are linear and have one point. Quadrilaterals and hexahedra are multilinear, with 2 points along each axis.

    Args:
        corners: positions of the corners at rest [m]; dim + 1 corners make a simplex, 2^dim corners in VTK's order a quadrilateral or hexahedron.

    Returns:
        Gradients in 1/m, and volumes in m^dim. A volume is negative if the corners are in the reverse order, and zero in a cell without volume, whose
        gradients mean nothing.
    """
    count, dim = corners.shape[1:]
    local, volume = local_gradients(dim, count)
    jacobian = np.einsum("cai,qaj->cqij", corners, local)
    determinant = np.linalg.det(jacobian)
    safe = np.where((determinant != 0)[..., None, None], jacobian, np.eye(dim))
    return np.ascontiguousarray(np.einsum("qaj,cqjd->cqad", local, np.linalg.inv(safe))), determinant * volume


def deformation_gradients(
    corners: Float[np.ndarray, "cell corner dim"], gradient: Float[np.ndarray, "cell point corner dim"]
) -> Float[np.ndarray, "cell point dim dim"]:
    """Return F at the quadrature points of deformed cells, from the present corners [m] and the gradients of ``shape_gradients``."""
    return np.einsum("cai,cqaj->cqij", corners - corners[:, :1], gradient)


def neo_hookean_density(
    deformation: Float[np.ndarray, "cell point dim dim"], lam: Float[np.ndarray, "cell"], mu: Float[np.ndarray, "cell"]
) -> Float[np.ndarray, "cell point"]:
    """Return Ψ [J/m³] for deformation gradients F and Lamé parameters λ and μ [Pa]."""
    ratio = np.linalg.det(deformation)
    above = np.maximum(ratio, SMALLEST_RATIO)
    logarithm = np.log(above) + (ratio - above) / SMALLEST_RATIO
    square = np.sum(deformation**2, axis=(-2, -1)) - deformation.shape[-1]
    return mu[:, None] * (square / 2 - logarithm) + lam[:, None] / 2 * logarithm**2
