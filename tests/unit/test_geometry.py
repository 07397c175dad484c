"""Signed distances against dense sampling of the surface, for every shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gpe_pl.geometry import Box, Polygon, Sphere, Wall, domain_walls, outward_normal, shape_from_dict, shape_to_dict, signed_distance
from gpe_pl.trajectory import Boundary

CONCAVE = ((0.2, 0.2), (0.9, 0.1), (0.5, 0.5), (0.8, 0.9), (0.2, 0.8))
SOLIDS: dict[str, Any] = {
    "disc": Sphere((0.4, 0.6), 0.25, 0.3),
    "ball": Sphere((0.4, 0.6, 0.5), 0.25, 0.3),
    "box 2D": Box((0.3, 0.1), (0.7, 0.9), 0.3),
    "box 3D": Box((0.3, 0.1, 0.2), (0.7, 0.9, 0.5), 0.3),
    "concave polygon": Polygon(CONCAVE, 0.3),
    "triangle with a horizontal edge": Polygon(((0.1, 0.2), (0.9, 0.2), (0.5, 0.7)), 0.3),
}
each_solid = pytest.mark.parametrize("solid", SOLIDS.values(), ids=SOLIDS.keys())


def dimension(solid: Any) -> int:
    return 2 if isinstance(solid, Polygon) else len(getattr(solid, "center", None) or solid.low)


def random_points(dim: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.2, 1.2, (count, dim))


def inside(solid: Any, points: np.ndarray) -> np.ndarray:
    """Membership, computed in another way than the signed distance does."""
    if isinstance(solid, Sphere):
        return np.asarray(((points - np.array(solid.center)) ** 2).sum(-1) < solid.radius**2)
    if isinstance(solid, Box):
        return np.all((points > np.array(solid.low)) & (points < np.array(solid.high)), axis=-1)
    vertices = np.array(solid.vertices)  # winding number
    a, b = vertices[None] - points[:, None], np.roll(vertices, -1, axis=0)[None] - points[:, None]
    angle = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1))
    return np.asarray(np.abs(angle.sum(-1)) > np.pi)


@each_solid
def test_signed_distance_equals_brute_force(solid: Any) -> None:
    dim = dimension(solid)
    points, spacing = random_points(dim), 0.002 if dim == 2 else 0.02
    surface, _ = solid.sample(spacing)
    nearest = np.array([np.sqrt(((surface - p) ** 2).sum(-1).min()) for p in points])
    distance = solid.signed_distance(points)
    # a sample lies within the spacing of the nearest surface point, and no sample is nearer than the surface
    assert np.all(np.abs(distance) <= nearest + 1e-9)
    assert np.all(nearest <= np.sqrt(distance**2 + spacing**2) + 1e-9 + 0.1 * spacing)
    np.testing.assert_array_equal(distance < 0, inside(solid, points))


@each_solid
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_numpy_equals_torch(solid: Any, dtype: str) -> None:
    points = random_points(dimension(solid)).astype(dtype)
    tensor = torch.from_numpy(points)
    result = solid.signed_distance(tensor)
    assert result.dtype == tensor.dtype
    np.testing.assert_allclose(result.numpy(), solid.signed_distance(points), atol=1e-6 if dtype == "float32" else 1e-14)
    normal = outward_normal(solid, tensor, 1e-3)
    np.testing.assert_allclose(normal.numpy(), outward_normal(solid, points, 1e-3), atol=2e-3 if dtype == "float32" else 1e-10)


@each_solid
def test_stays_on_the_device_of_the_points(solid: Any) -> None:
    """The meta device refuses to mix with the CPU, as an accelerator does."""
    points = torch.empty((5, dimension(solid)), device="meta")
    assert solid.signed_distance(points).device.type == "meta"
    assert outward_normal(solid, points, 1e-3).device.type == "meta"
    assert signed_distance((solid,), points).device.type == "meta"


@each_solid
def test_samples_lie_on_the_surface_with_normals_into_free_space(solid: Any) -> None:
    pos, normal = solid.sample(0.05)
    np.testing.assert_allclose(solid.signed_distance(pos), 0, atol=1e-12)
    np.testing.assert_allclose((normal**2).sum(-1), 1, atol=1e-12)
    assert np.all(solid.signed_distance(pos + 1e-6 * normal) > 0)


@each_solid
@pytest.mark.parametrize("spacing", [0.013, 0.05, 0.3, 10.0])
def test_samples_are_no_further_apart_than_the_spacing(solid: Any, spacing: float) -> None:
    pos, _ = solid.sample(spacing)
    gaps, _ = cKDTree(pos).query(pos, k=2)
    assert gaps[:, 1].max() <= spacing + 1e-12


def test_outward_normal_is_the_direction_to_the_surface() -> None:
    sphere = Sphere((0.5, 0.5), 0.2, 0.0)
    points = np.array([[0.9, 0.5], [0.5, 0.35], [0.8, 0.8]])
    expected = (points - 0.5) / np.linalg.norm(points - 0.5, axis=-1, keepdims=True)
    np.testing.assert_allclose(outward_normal(sphere, points, 1e-4), expected, atol=1e-6)
    assert np.all(np.isfinite(outward_normal(sphere, np.array([[0.5, 0.5]]), 1e-4)))  # undefined at the centre


def test_walls_close_the_domain() -> None:
    bounds = ((-1.0, 2.0), (0.5, 3.0))
    walls = domain_walls(bounds, {"x_low": 0.1, "x_high": 0.2, "y_low": 0.3, "y_high": 0.4})
    points = np.random.default_rng(0).uniform((-2, 0), (3, 4), (500, 2))
    low, high = np.array(bounds).T
    np.testing.assert_allclose(signed_distance(walls, points), np.minimum(points - low, high - points).min(-1), atol=1e-12)
    assert [wall.friction for wall in walls] == [0.1, 0.2, 0.3, 0.4]
    for wall in walls:
        pos, normal = wall.sample(0.3)
        np.testing.assert_allclose(signed_distance(walls, pos), 0, atol=1e-12)
        np.testing.assert_allclose(signed_distance(walls, pos * 0.999 + 0.001 * np.array([0.5, 1.75])), 0, atol=0.01)
        assert np.all(wall.signed_distance(pos + 0.1 * normal) > 0.0999)
        steps = np.linalg.norm(np.diff(pos, axis=0), axis=-1)
        assert steps.max() <= 0.3 + 1e-12


def test_nearest_of_several_shapes() -> None:
    shapes = (SOLIDS["disc"], SOLIDS["box 2D"])
    points = random_points(2)
    np.testing.assert_array_equal(signed_distance(shapes, points), np.minimum(*(s.signed_distance(points) for s in shapes)))
    assert np.all(np.isinf(signed_distance((), points)))


def test_boundary_leaves_out_nodes_inside_other_shapes() -> None:
    walls = domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.5)
    box = Box((0.4, -0.1), (0.6, 0.2), 0.9)
    boundary = Boundary.sample((*walls, box), 0.05, 2)
    assert signed_distance((*walls, box), boundary.pos).min() > -1e-9
    floor_under_box = (np.abs(boundary.pos[:, 0] - 0.5) < 0.09) & (boundary.pos[:, 1] < 0.1)
    assert not floor_under_box.any()
    assert set(np.unique(boundary.friction)) == {0.5, 0.9}


@pytest.mark.parametrize("shape", [*SOLIDS.values(), *domain_walls(((0.0, 1.0), (0.0, 2.0)), 0.1)], ids=lambda s: s.kind)
def test_dictionary_round_trip(shape: Any) -> None:
    assert shape_from_dict(shape_to_dict(shape)) == shape


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown shape kind 'cone'; known: wall"):
        shape_from_dict({"kind": "cone"})
    with pytest.raises(ValueError, match="sphere.*unexpected.*radios"):
        shape_from_dict({"kind": "sphere", "center": [0.0, 0.0], "radius": 1.0, "radios": 1.0, "friction": 0.0})
    with pytest.raises(ValueError, match="counter-clockwise"):
        Polygon(CONCAVE[::-1], 0.0)
    with pytest.raises(ValueError, match="at least 3 vertices"):
        Polygon(CONCAVE[:2], 0.0)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (((0, 0), (1, 0), (1, 0), (0, 1)), "vertices 1 and 2 coincide"),
        (((0, 0), (1, 0), (1, 1), (0, 1), (0, 0)), "vertices 4 and 0 coincide"),
        (((0, 0), (1, 0), (1, 1e-15), (0, 1)), "vertices 1 and 2 coincide"),
        (((0, 0), (2, 0), (2, 1), (0.5, -0.5), (0, 1)), "edges 0 .* and 2 .* intersect"),  # crosses
        (((0, 0), (1, 1), (1, 0), (0, 1)), "edges 0 .* and 2 .* intersect"),  # bow tie
        (((0, 0), (2, 0), (2, 2), (1, 0), (0, 2)), "edges 0 .* and 2 .* intersect"),  # a vertex on an edge
        (((0, 0), (1, 1), (2, 0), (2, 2), (1, 1), (0, 2)), "edges 0 .* and 3 .* intersect"),  # a vertex met twice
        (((0, 0), (3, 0), (2, 0), (2, 1), (0, 1)), "edges 0 .* and 1 .* intersect"),  # doubles back
        (
            ((0, 0), (2, 0), (2, 1), (0, 1), (0, -1)),
            "edges 3 .* and 4 .* intersect|edges 0 .* and 3 .* intersect",
        ),  # over the closing vertex
        (((0, 0), (1, 0), (2, 0)), "edges . .* and . .* intersect"),  # no area
    ],
)
def test_degenerate_outlines_are_refused(vertices: Any, message: str) -> None:
    vertices = tuple((float(x), float(y)) for x, y in vertices)
    for shift in range(len(vertices)):
        with pytest.raises(ValueError, match=message if shift == 0 else "coincide|intersect"):
            Polygon(vertices[shift:] + vertices[:shift], 0.3)


def test_simple_outlines_are_accepted() -> None:
    """Straight angles, reflex corners and many random star-shaped outlines; nothing is refused for being thin or large."""
    Polygon(((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)), 0.3)
    rng = np.random.default_rng(0)
    for scale in (1e-6, 1.0, 1e6):
        for _ in range(50):
            turn = np.sort(rng.uniform(0, 2 * np.pi, 9))
            if np.max(np.diff(np.append(turn, turn[0] + 2 * np.pi))) < 3:
                points = scale * rng.uniform(0.1, 1, 9)[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
                Polygon(tuple((float(x), float(y)) for x, y in points), 0.3)


def test_wall_sampling_covers_the_face() -> None:
    wall = Wall((0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 0.0), (1.0, 0.5, 1.0), 0.0)
    pos, _ = wall.sample(0.1)
    np.testing.assert_allclose(pos.min(0), (0, 0, 0), atol=1e-12)
    np.testing.assert_allclose(pos.max(0), (1, 0.5, 0), atol=1e-12)
    assert len(pos) == 11 * 6
