"""Points inside meshes against a signed distance."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.mesh_points import in_mesh
from gpe_pl.geometry.meshing import quadrangulate, tetrahedralise, triangulate

RING = [np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, s * 2 * np.pi, 60, endpoint=False)]) * r for r, s in ((0.4, 1), (0.2, -1))]


@pytest.mark.parametrize("kind", ["triangles", "quadrilaterals"])
def test_points_in_a_ring(kind: str) -> None:
    rng = np.random.default_rng(0)
    pos, cells = (triangulate if kind == "triangles" else quadrangulate)(RING, 0.05, rng)
    points = rng.uniform(-0.5, 0.5, (4000, 2))
    radius = np.linalg.norm(points, axis=1)
    found, within = in_mesh(points, pos, cells), (radius > 0.2) & (radius < 0.4)
    clear = np.minimum(abs(radius - 0.2), abs(radius - 0.4)) > 5e-3
    assert not found[clear & ~within].any()
    assert found[clear & within].mean() > 0.85  # the rest are near faces of cells


def test_points_in_a_ball() -> None:
    rng = np.random.default_rng(0)
    pos, cells = tetrahedralise(lambda x: np.linalg.norm(x, axis=1) - 0.3, 0.4, 0.1, rng)
    points = rng.uniform(-0.4, 0.4, (4000, 3))
    radius, found = np.linalg.norm(points, axis=1), in_mesh(points, pos, cells)
    assert not found[radius > 0.31].any()
    assert found[radius < 0.27].mean() > 0.7


def test_a_surface_that_only_touches_is_outside() -> None:
    pos, cells = triangulate([np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])], 0.2, np.random.default_rng(0))
    assert not in_mesh(np.stack([np.linspace(-0.5, 1.5, 50), np.zeros(50)], axis=1), pos, cells).any()
    assert not in_mesh(np.empty((0, 2)), pos, cells).any() and not in_mesh(pos, pos, cells[:0]).any()
