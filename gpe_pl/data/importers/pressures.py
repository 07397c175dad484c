"""Pressures on faces of solid elements as forces on nodes.

The work of a pressure p on the motion of a face defines the force on its corner a, with the shape function N_a of the face and the normal n into the element::

    f_a = p ∫ N_a n dA

Faces are numbered as in Abaqus and CalculiX.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "C3D4": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "C3D6": ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "C3D8": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
"""Corners of the faces of each kind of element, which turn to the right about the normal into the element."""
CORNERS = {"C3D4": 4, "C3D6": 6, "C3D8": 8}
POINT = 1 / np.sqrt(3)
"""Coordinate of the quadrature points of a quadrilateral, which has those of its corners at −1 and 1."""


def kind_of(element_type: str) -> str | None:
    """Return the key of ``FACES`` of a type of element, such as C3D8I; None for other types, quadratic ones among them."""
    for kind in FACES:
        if element_type.startswith(kind) and not element_type.removeprefix(kind)[:1].isdigit():
            return kind
    return None


def corner_areas(corners: Float[np.ndarray, "*frame face corner 3"]) -> Float[np.ndarray, "*frame face corner 3"]:
    """Return ∫ N_a n dA of each corner of triangles or quadrilaterals with corners at these positions [m], in m²."""
    if corners.shape[-2] == 3:
        first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
        return np.repeat(np.cross(first, second)[..., None, :] / 6, 3, axis=-2)
    total = np.zeros(corners.shape)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for xi, eta in POINT * signs:
        value = (1 + xi * signs[:, 0]) * (1 + eta * signs[:, 1]) / 4
        along = np.stack([signs[:, 0] * (1 + eta * signs[:, 1]), signs[:, 1] * (1 + xi * signs[:, 0])]) / 4
        first, second = (np.einsum("a,...ai->...i", slope, corners) for slope in along)
        total += value[:, None] * np.cross(first, second)[..., None, :]
    return total
