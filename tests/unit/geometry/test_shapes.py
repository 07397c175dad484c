"""Signed distances against dense sampling of the surface, for every shape."""

from __future__ import annotations

import base64
import json
import pickle
import zlib
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shape_values import SHAPES, moved, shape_from_dict, shape_to_dict
from gpe_pl.geometry.shapes import (
    Bowl,
    Box,
    DistanceGrid,
    Polygon,
    SamplingError,
    Shape,
    Sphere,
    Wall,
    domain_walls,
    outward_normal,
    signed_distance,
)
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary

CONCAVE = ((0.2, 0.2), (0.9, 0.1), (0.5, 0.5), (0.8, 0.9), (0.2, 0.8))
SOLIDS: dict[str, Any] = {
    "disc": Sphere((0.4, 0.6), 0.25, 0.3),
    "ball": Sphere((0.4, 0.6, 0.5), 0.25, 0.3),
    "bowl 2D": Bowl((0.4, 0.6), 0.45, 0.3),
    "bowl 3D": Bowl((0.4, 0.6, 0.5), 0.45, 0.3),
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
    """Tell whether points are inside, without the signed distance."""
    if isinstance(solid, Bowl):
        return np.asarray(((points - np.array(solid.center)) ** 2).sum(-1) > solid.radius**2)
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


@each_solid
@pytest.mark.parametrize("spacing", [0.05, 0.3])
def test_samples_do_not_repeat(solid: Any, spacing: float) -> None:
    """Faces share edges and corners."""
    pos, _ = solid.sample(spacing)
    assert cKDTree(pos).query(pos, k=2)[0][:, 1].min() > 0.2 * spacing


def test_box_nodes_of_edges_and_corners() -> None:
    pos, normal = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0).sample(0.25)
    assert len(pos) == 5**3 - 3**3
    corner = normal[np.all(pos == (1.0, 0.0, 1.0), axis=-1)]
    np.testing.assert_allclose(corner, np.array([[1.0, -1.0, 1.0]]) / np.sqrt(3))
    edge = normal[np.all(pos == (1.0, 0.5, 1.0), axis=-1)]
    np.testing.assert_allclose(edge, np.array([[1.0, 0.0, 1.0]]) / np.sqrt(2))


def test_nodes_of_walls_around_a_bowl_vanish() -> None:
    bounds = ((0.0, 1.0),) * 3
    bowl = Bowl((0.5, 0.5, 0.5), 0.45, 0.2)
    boundary = Boundary.sample((*domain_walls(bounds, 0.9), bowl), 0.05, 3)
    assert set(np.unique(boundary.friction)) == {0.2}
    assert len(boundary.pos) == len(bowl.sample(0.05)[0])


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


@pytest.mark.parametrize("friction", [{"x_low": 0.5}, {"x_low": 0.1, "x_high": 0.2, "y_low": 0.3, "y_high": 0.4, "z_low": 0.5}, {}])
def test_each_wall_of_a_domain_has_a_friction(friction: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"friction is given for .*; give one for each of x_low, x_high, y_low, y_high"):
        domain_walls(((0.0, 1.0), (0.0, 1.0)), friction)


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
    assert shape_from_dict(json.loads(json.dumps(shape_to_dict(shape)))) == shape
    assert len({shape, shape_from_dict(shape_to_dict(shape))}) == 1
    assert isinstance(shape, Shape)
    assert SHAPES[shape.kind] is type(shape)


@pytest.mark.parametrize(
    "shape",
    [*SOLIDS.values(), *domain_walls(((0.0, 1.0), (0.0, 2.0)), 0.1), DistanceGrid.from_values((0.1, 0.2), 0.5, np.eye(3), 0.3)],
    ids=lambda s: s.kind,
)
def test_a_moved_shape_has_its_distances_elsewhere(shape: Any) -> None:
    dim = dimension(shape) if not isinstance(shape, DistanceGrid) else 2
    by, points = np.array([0.3, -7.0, 2.0])[:dim], random_points(dim)
    np.testing.assert_allclose(moved(shape, by).signed_distance(points + by), shape.signed_distance(points), atol=1e-12)
    np.testing.assert_allclose(moved(shape, by).sample(0.1)[0], shape.sample(0.1)[0] + by, atol=1e-12)


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


# --- distance grids -----------------------------------------------------------------------------------------------------------------------


def gridded(solid: Any, cells: int, low: float = -0.2, high: float = 1.2, friction: float = 0.3) -> DistanceGrid:
    dim, axis = dimension(solid), np.linspace(low, high, cells + 1)
    nodes = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1)
    return DistanceGrid.from_values((low,) * dim, (high - low) / cells, solid.signed_distance(nodes), friction)


GRIDDED = {name: SOLIDS[name] for name in ("disc", "ball", "bowl 2D", "bowl 3D", "box 3D", "concave polygon")}
each_gridded = pytest.mark.parametrize("solid", GRIDDED.values(), ids=GRIDDED.keys())


@each_gridded
def test_grid_keeps_the_distances_at_its_nodes(solid: Any) -> None:
    grid = gridded(solid, 20)
    nodes = np.stack(np.meshgrid(*[-0.2 + grid.spacing * np.arange(21)] * dimension(solid), indexing="ij"), axis=-1)
    np.testing.assert_allclose(grid.signed_distance(nodes), solid.signed_distance(nodes), atol=grid.spacing / 4096)
    np.testing.assert_allclose(grid.signed_distance(nodes), grid.values, atol=1e-6)
    assert not grid.values.flags.writeable


@pytest.mark.slow
@each_gridded
def test_grid_converges_to_the_solid(solid: Any) -> None:
    points = random_points(dimension(solid))
    error = [np.abs(gridded(solid, n).signed_distance(points) - solid.signed_distance(points)).max() for n in (14, 28, 56)]
    assert error[2] < 0.5 * error[0]
    assert error[2] < 0.5 * 1.4 / 56  # kinks are wrong by less than half a cell
    smooth = np.abs(solid.signed_distance(points)) < 0.1 if isinstance(solid, (Sphere, Bowl)) else np.zeros(len(points), dtype=bool)
    assert np.all(np.abs(gridded(solid, 56).signed_distance(points) - solid.signed_distance(points))[smooth] < 0.1 * 1.4 / 56)


def test_grid_interpolates_linear_functions_exactly_and_continues_them() -> None:
    rng = np.random.default_rng(0)
    for dim in (2, 3):
        slope = rng.normal(size=dim)
        nodes = np.stack(np.meshgrid(*[0.25 * np.arange(n) for n in (3, 5, 4)[:dim]], indexing="ij"), axis=-1) + 1.0
        grid = DistanceGrid.from_values((1.0,) * dim, 0.25, nodes @ slope - 1.0, 0.0)
        points = rng.uniform(-3, 5, (200, dim))
        np.testing.assert_allclose(grid.signed_distance(points), points @ slope - 1.0, atol=0.01)
        np.testing.assert_allclose(
            outward_normal(grid, points, 1e-2), np.broadcast_to(slope / np.linalg.norm(slope), points.shape), atol=0.01
        )


def test_grid_does_not_change_sign_beyond_its_edge() -> None:
    """Above the ground stays free and below stays solid, however far away."""
    x, z = np.meshgrid(np.arange(9) / 8, np.arange(9) / 8, indexing="ij")
    ground = DistanceGrid.from_values((0.0, 0.0), 1 / 8, z - 0.45 - 0.1 * np.sin(9 * x), 0.5)
    for height, sign in ((1.0, 1), (1.5, 1), (30.0, 1), (0.0, -1), (-1.0, -1), (-30.0, -1)):
        points = np.stack([np.linspace(-0.5, 1.5, 50), np.full(50, height)], axis=-1)
        assert np.all(np.sign(ground.signed_distance(points)) == sign)


@each_gridded
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_grid_numpy_equals_torch(solid: Any, dtype: str) -> None:
    grid = gridded(solid, 16)
    points = np.concatenate([random_points(dimension(solid)), 4 * random_points(dimension(solid))]).astype(dtype)
    points[0] = np.nan
    tensor = torch.from_numpy(points)
    result = grid.signed_distance(tensor)
    assert result.dtype == tensor.dtype
    assert np.isnan(result.numpy()[0])
    np.testing.assert_allclose(result.numpy(), grid.signed_distance(points), atol=1e-5 if dtype == "float32" else 1e-13)
    assert grid.signed_distance(torch.empty((5, dimension(solid)), device="meta")).device.type == "meta"
    assert grid.signed_distance(points[3]).shape == ()


@pytest.mark.slow
@each_gridded
@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.5])
def test_grid_samples_cover_the_surface(solid: Any, ratio: float) -> None:
    grid = gridded(solid, 28)
    spacing, dim = ratio * grid.spacing, dimension(solid)
    pos, normal = grid.sample(spacing)
    assert np.abs(grid.signed_distance(pos)).max() < 0.02 * spacing  # the validator asks for 0.1
    np.testing.assert_allclose((normal**2).sum(-1), 1, atol=1e-12)
    assert np.mean(grid.signed_distance(pos + 0.2 * grid.spacing * normal) > 0) > 0.99
    surface, _ = solid.sample(spacing / 8)
    reach = cKDTree(pos).query(surface)[0]
    assert np.quantile(reach, 0.99) < spacing + 0.1 * grid.spacing
    assert reach.max() < spacing + 0.6 * grid.spacing  # sharp corners lie between the nodes of the grid
    ideal = len(surface) / 8 ** (dim - 1)
    assert 0.8 * ideal < len(pos) < (1.9 if dim == 2 else 1.4) * ideal
    np.testing.assert_array_equal(pos, grid.sample(spacing)[0])


def test_grid_samples_both_sides_of_a_thin_plate() -> None:
    z = np.arange(17) / 16
    plate = np.broadcast_to(np.abs(z - 0.5) - 0.04, (17, 17, 17))
    pos, normal = DistanceGrid.from_values((0.0, 0.0, 0.0), 1 / 16, plate, 0.0).sample(0.12)
    upper, lower = pos[normal[:, 2] > 0.9], pos[normal[:, 2] < -0.9]
    assert len(upper) + len(lower) == len(pos)
    assert min(len(upper), len(lower)) > 0.9 * (1 / 0.12) ** 2
    np.testing.assert_allclose(upper[:, 2].mean() - lower[:, 2].mean(), 0.08, atol=0.01)


def test_grid_without_surface_has_no_nodes() -> None:
    pos, normal = DistanceGrid.from_values((0.0, 0.0), 0.5, np.ones((3, 3)), 0.0).sample(0.1)
    assert pos.shape == normal.shape == (0, 2)


def test_grid_round_trip() -> None:
    grid = gridded(SOLIDS["ball"], 16)
    again = shape_from_dict(json.loads(json.dumps(shape_to_dict(grid))))
    assert again == grid
    assert hash(again) == hash(grid)
    assert isinstance(again, DistanceGrid)
    assert len(repr(grid)) < 300
    np.testing.assert_array_equal(again.values, grid.values)
    assert pickle.loads(pickle.dumps(grid)) == grid
    assert isinstance(grid, Shape)
    assert grid != gridded(SOLIDS["ball"], 16, friction=0.4)
    assert len(grid.encoded) < 3 * grid.values.size  # less than the raw float32 takes
    assert set(shape_to_dict(grid)) == {"kind", "origin", "spacing", "counts", "encoded", "friction", "restitution"}


def packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data)).decode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoded": "no base64!"}, "damaged"),
        ({"encoded": "é"}, "damaged"),
        ({"encoded": base64.b64encode(b"not zlib").decode()}, "damaged"),
        ({"encoded": packed(bytes(4 * 9))[:-8]}, "damaged|do not fit"),
        ({"encoded": packed(bytes(4 * 8))}, "do not fit"),
        ({"encoded": packed(bytes(4 * 9 + 1))}, "do not fit"),
        ({"encoded": packed(bytes(2**24))}, "do not fit"),  # unpacks to much more than it should
        ({"encoded": packed(b"\xff" * 36)}, "not all finite"),
        ({"counts": (3, 4)}, "do not fit"),
        ({"counts": (1, 9)}, "counts"),
        ({"counts": (3, -3)}, "counts"),
        ({"counts": (3.0, 3.0)}, "counts"),
        ({"counts": (2**20, 2**20)}, "counts"),
        ({"counts": (9,)}, "2 or 3 axes"),
        ({"origin": (0.0, 0.0, 0.0)}, "2 or 3 axes"),
        ({"origin": (0.0, float("nan"))}, "finite"),
        ({"spacing": 0.0}, "positive"),
        ({"spacing": float("inf")}, "finite"),
    ],
)
def test_damaged_grids_are_refused(change: dict[str, Any], message: str) -> None:
    sound = shape_to_dict(DistanceGrid.from_values((0.0, 0.0), 0.5, np.zeros((3, 3)), 0.0))
    shape_from_dict(sound)
    with pytest.raises(ValueError, match=message):
        shape_from_dict(sound | change)


def test_unusable_grid_values_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        DistanceGrid.from_values((0.0, 0.0), 0.5, np.array([[0.0, np.nan], [0.0, 1.0]]), 0.0)
    with pytest.raises(ValueError, match="2 or 3 axes"):
        DistanceGrid.from_values((0.0,), 0.5, np.zeros(4), 0.0)
    with pytest.raises(ValueError, match="wider spacing"):
        DistanceGrid.from_values((0.0, 0.0), 0.5, np.broadcast_to(0.0, (2**13, 2**13)), 0.0)


@pytest.mark.parametrize(
    "shape",
    [
        *domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.3),
        *domain_walls(((0.0, 1e6), (0.0, 1e6), (0.0, 1.0)), 0.3)[4:],
        *SOLIDS.values(),
    ],
)
def test_a_surface_with_more_nodes_than_fit_into_memory_is_refused(shape: Shape) -> None:
    with pytest.raises(SamplingError, match=r"would have \S+ boundary nodes, at most 10000000 are made; choose a larger spacing"):
        shape.sample(1e-9)


@pytest.mark.parametrize(
    ("shapes", "spacing", "message"),
    [
        (domain_walls(((1.0, 0.0), (0.0, 1.0)), 0.5), 0.1, r"shape 0 \(wall\): low must be below high along every axis"),
        (domain_walls(((0.0, 1.0), (0.0, 1.0)), -0.5), 0.1, r"shape 0 \(wall\): friction is -0.5, must be at least 0"),
        (
            (*domain_walls(((0.0, 1.0), (0.0, 1.0)), 0.5), Sphere((0.5, 0.5), -0.1, 0.5)),
            0.1,
            r"shape 4 \(sphere\): radius is -0.1 m, must be positive",
        ),
        ((Sphere((0.5, 0.5, 0.5), 0.1, 0.5),), 0.1, r"shape 0 \(sphere\): center must have 2 components"),
        ((Box((0.5, 0.5), (0.4, 0.6), 0.5),), 0.1, r"shape 0 \(box\): low must be below high"),
        ((Sphere((0.5, 0.5), 0.1, float("nan")),), 0.1, r"shape 0 \(sphere\): not finite: friction"),
        ((Sphere((0.5, 0.5), 0.1, 0.5),), 0.0, "spacing=0.0: must be a positive number of m"),
        ((Sphere((0.5, 0.5), 0.1, 0.5),), -0.1, "spacing=-0.1: must be a positive number of m"),
    ],
)
def test_nodes_are_placed_on_sound_shapes_only(shapes: tuple[Shape, ...], spacing: float, message: str) -> None:
    with pytest.raises(ArrayError, match=message):
        Boundary.sample(shapes, spacing, 2)
    if spacing > 0:
        with pytest.raises(ArrayError, match=message):
            Boundary.sample(shapes, spacing, 2, Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False)))
