"""Every mesh: positive cells, matching faces, no unused nodes, one part, good shapes, the right size."""

import math

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gpe_pl.geometry.bodies import OUTLINES, SOLIDS, random_outline, random_solid
from gpe_pl.geometry.meshing import (
    TETRAHEDRA_PER_CUBE,
    MeshingError,
    optimise_shapes,
    quadrangulate,
    shape_quality,
    tetrahedralise,
    triangulate,
)

SQUARE = [np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])]


def signed_volumes(points, cells):
    """Return signed volumes of triangles and tetrahedra, and of the worst corner of quadrilaterals."""
    if cells.shape[1] == 4 and points.shape[1] == 2:
        cells = np.stack([cells[:, [k, (k + 1) % 4, k - 1]] for k in range(4)], axis=1).reshape(-1, 3)
    corners = points[cells]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / math.factorial(points.shape[1])


def area(points, cells):
    corners = points[cells]
    after = np.roll(corners, -1, axis=1)
    return float(np.sum(corners[..., 0] * after[..., 1] - corners[..., 1] * after[..., 0]) / 2)


def faces(cells, dim):
    """Count the cells of each face: a set of corners -> count."""
    count: dict[frozenset[int], int] = {}
    for cell in cells.tolist():
        sides = [cell[:k] + cell[k + 1 :] for k in range(4)] if dim == 3 else zip(cell, cell[1:] + cell[:1], strict=True)
        for side in sides:
            count[frozenset(side)] = count.get(frozenset(side), 0) + 1
    return count


def assert_sound(points, cells):
    dim = points.shape[1]
    assert np.all(np.isfinite(points)) and np.all(signed_volumes(points, cells) > 0)
    assert np.array_equal(np.unique(cells), np.arange(len(points)))
    count = faces(cells, dim)
    assert set(count.values()) <= {1, 2}
    pairs = cells[:, [[a, b] for a in range(cells.shape[1]) for b in range(a)]].reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    assert connected_components(graph)[0] == 1
    # the surface is closed: in 2D each of its nodes ends as many edges as it starts, in 3D each of its edges has an even number of faces
    surface = [face for face, times in count.items() if times == 1]
    ends: dict[frozenset[int], int] = {}
    for face in surface:
        for part in [frozenset([n]) for n in face] if dim == 2 else [face - {n} for n in face]:
            ends[part] = ends.get(part, 0) + 1
    assert all(times % 2 == 0 for times in ends.values())


@pytest.mark.parametrize("family", OUTLINES)
@pytest.mark.parametrize("num_cells", [230, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mesher", [triangulate, quadrangulate])
def test_plane_meshes(family, mesher, num_cells):
    rng = np.random.default_rng(num_cells)
    loops = random_outline(rng, family)
    spacing = math.sqrt((4 / math.sqrt(3) if mesher is triangulate else 1.0) / num_cells)
    points, cells = mesher(loops, spacing, rng)
    assert_sound(points, cells)
    assert 0.8 * num_cells < len(cells) < 1.1 * num_cells
    assert area(points, cells) == pytest.approx(1.0, abs=0.04)
    quality = shape_quality(points, cells)
    assert quality.min() > (0.65 if mesher is triangulate else 0.25) and quality.mean() > 0.85
    edges = points[cells] - points[np.roll(cells, 1, axis=1)]
    lengths = np.linalg.norm(edges, axis=-1)
    assert lengths.min() > 0.4 * spacing and np.mean(lengths) == pytest.approx(spacing, rel=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("family", SOLIDS)
@pytest.mark.parametrize("num_cells", [400, 1000])
def test_tetrahedra(family, num_cells):
    rng = np.random.default_rng(num_cells)
    distance, reach = random_solid(rng, family)
    spacing = (TETRAHEDRA_PER_CUBE / num_cells) ** (1 / 3)
    points, cells = tetrahedralise(distance, reach, spacing, rng)
    assert_sound(points, cells)
    assert 0.7 * num_cells < len(cells) < 1.25 * num_cells
    assert np.sum(signed_volumes(points, cells)) == pytest.approx(1.0, abs=0.25 if num_cells == 400 else 0.12)
    assert shape_quality(points, cells).min() > 0.3
    surface = np.unique([n for face, times in faces(cells, 3).items() if times == 1 for n in face])
    assert np.abs(distance(points[surface])).max() < 0.03 * spacing
    pairs = np.unique(np.sort(cells[:, [[a, b] for a in range(4) for b in range(a)]].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    assert np.mean(lengths) == pytest.approx(spacing, rel=0.12)


@pytest.mark.slow
def test_same_seed_gives_same_bytes():
    def meshes():
        rng = np.random.default_rng(3)
        yield triangulate(random_outline(rng), 0.1, rng)
        yield quadrangulate(random_outline(rng), 0.1, rng)
        yield tetrahedralise(*random_solid(rng), 0.3, rng)

    for (a, b), (c, d) in zip(meshes(), meshes(), strict=True):
        assert a.tobytes() == c.tobytes() and b.tobytes() == d.tobytes()


def test_corners_of_the_outline_are_nodes():
    for mesher in (triangulate, quadrangulate):
        points, cells = mesher(SQUARE, 0.09, np.random.default_rng(0))
        for corner in SQUARE[0]:
            assert np.abs(points - corner).sum(axis=1).min() == 0.0
        assert area(points, cells) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("mesher", [triangulate, quadrangulate])
def test_holes_stay_open(mesher):
    angle = np.linspace(0, 2 * math.pi, 60, endpoint=False)
    hole = 0.5 + 0.2 * np.stack([np.cos(-angle), np.sin(-angle)], axis=-1)
    points, cells = mesher([*SQUARE, hole], 0.06, np.random.default_rng(0))
    assert_sound(points, cells)
    assert area(points, cells) == pytest.approx(1 - math.pi * 0.04, rel=0.01)
    assert np.linalg.norm(points - 0.5, axis=1).min() > 0.19


def test_details_finer_than_the_spacing_are_refused():
    comb = [(0.0, 0.0), (1.0, 0.0)]
    for k in reversed(range(20)):  # teeth much thinner than the spacing
        comb += [((k + 0.9) / 20, 1.0), ((k + 0.5) / 20, 1.0), ((k + 0.5) / 20, 0.01), (k / 20, 0.01)]
    with pytest.raises(MeshingError, match="smaller spacing"):
        triangulate([np.array(comb)], 0.5, np.random.default_rng(0))
    with pytest.raises(MeshingError, match="smaller spacing"):
        tetrahedralise(lambda x: np.linalg.norm(x, axis=-1) - 0.1, 0.2, 1.0, np.random.default_rng(0))


def test_quality_of_known_cells():
    equilateral = np.array([[0, 0], [1, 0], [0.5, math.sqrt(0.75)]])
    assert shape_quality(equilateral, np.array([[0, 1, 2]])) == pytest.approx(1.0)
    assert shape_quality(equilateral, np.array([[0, 2, 1]])) == pytest.approx(-1.0)
    assert shape_quality(np.array([[0.0, 0], [1, 0], [2, 0]]), np.array([[0, 1, 2]])) == pytest.approx(0.0)
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    assert shape_quality(square, np.array([[0, 1, 2, 3]])) == pytest.approx(1.0)
    sheared = square + square[:, 1:] * [math.tan(math.radians(30)), 0]
    assert 0.5 < shape_quality(sheared, np.array([[0, 1, 2, 3]]))[0] < 1.0
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    assert shape_quality(regular, np.array([[0, 2, 1, 3]])) == pytest.approx(1.0) or shape_quality(
        regular, np.array([[0, 1, 2, 3]])
    ) == pytest.approx(1.0)


def test_optimisation_turns_inverted_cells_back():
    ring = np.array([(math.cos(k), math.sin(k)) for k in 2 * math.pi * np.arange(6) / 6])
    points = np.concatenate([ring, [[1.5, 0.4]]])  # the middle node lies outside
    cells = np.array([[k, (k + 1) % 6, 6] for k in range(6)])
    fixed = np.arange(7) < 6
    assert shape_quality(points, cells).min() < 0
    better = optimise_shapes(points, cells, fixed)
    np.testing.assert_array_equal(better[:6], ring)
    np.testing.assert_allclose(better[6], 0.0, atol=1e-3)
    assert shape_quality(better, cells).min() > 0.99
