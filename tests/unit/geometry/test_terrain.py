"""Terrain from files and the random canyon, compared with analytic distances and brute force."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gpe_pl.geometry import grid_distance, terrain, terrain_files
from gpe_pl.geometry.canyon import canyon
from gpe_pl.geometry.grid_distance import unsigned
from gpe_pl.geometry.shapes import DistanceGrid
from gpe_pl.geometry.terrain import read_terrain
from gpe_pl.geometry.terrain_files import TerrainError, read_surface

UNIT = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))


def nodes_of(grid: DistanceGrid) -> np.ndarray:
    axes = [o + grid.spacing * np.arange(n) for o, n in zip(grid.origin, grid.counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def hills(x: Any, y: Any) -> np.ndarray:
    return np.asarray(0.4 + 0.12 * np.sin(4 * x) * np.cos(3 * y))


def hill_mesh(cells: int = 40, low: float = 0.0, high: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of an open surface."""
    x, y = np.meshgrid(*[np.linspace(low, high, cells + 1)] * 2, indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return np.stack([x, y, hills(x, y)], -1).reshape(-1, 3), faces


def to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return distances [point] to triangles by minimising over a dense barycentric lattice, then refining; the kernel uses another method."""
    steps = np.linspace(0, 1, 41)
    u, v = (w.ravel() for w in np.meshgrid(steps, steps, indexing="ij"))
    u, v = u[u + v <= 1 + 1e-9], v[u + v <= 1 + 1e-9]
    cloud = corners[:, :1] + u[:, None] * (corners[:, 1] - corners[:, 0])[:, None] + v[:, None] * (corners[:, 2] - corners[:, 0])[:, None]
    return np.array([np.sqrt(((cloud - p) ** 2).sum(-1)).min() for p in points])


def assert_distances(values: np.ndarray, exact: np.ndarray) -> None:
    """Check distances: exact near the surface up to facets; far away, sweeping may miss the nearest triangle by a little."""
    np.testing.assert_allclose(values, exact, atol=4e-3)
    np.testing.assert_allclose(values[np.abs(exact) < 0.1], exact[np.abs(exact) < 0.1], atol=1.2e-3)


@pytest.mark.slow
def test_distances_equal_brute_force() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-0.3, 1.3, (12, 3, 3))  # some of them cross the rim of the grid or lie outside
    corners[5] += 3.0
    low, spacing, counts = np.zeros(3), 1 / 8, (9, 9, 9)
    distance = unsigned(corners, low, spacing, counts)
    points = np.stack(np.meshgrid(*[np.arange(9) / 8] * 3, indexing="ij"), -1).reshape(-1, 3)
    expected = to_triangles(points, corners)
    found = distance.ravel()
    assert np.all(found <= expected + 1e-12)  # the lattice only comes near to the nearest point
    np.testing.assert_allclose(found, expected, atol=0.035)
    single = unsigned(corners[:1], low, spacing, counts).ravel()
    np.testing.assert_allclose(single, to_triangles(points, corners[:1]), atol=0.035)


def test_point_to_triangle_in_every_region() -> None:
    triangle = np.array([[[0.25, 0.25, 0.5], [0.75, 0.25, 0.5], [0.25, 0.75, 0.5]]])
    distance = unsigned(triangle, np.zeros(3), 0.25, (5, 5, 5))
    cases = {(1, 1, 4): 0.5, (2, 1, 2): 0.0, (0, 0, 2): 0.25 * 2**0.5, (4, 1, 2): 0.25, (1, 0, 2): 0.25, (3, 3, 2): 0.25 * 2**0.5}
    for node, expected in cases.items():
        assert distance[node] == pytest.approx(expected, abs=1e-12), node


# --- meshes -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("extension", ["obj", "stl", "ply"])
def test_ball_from_every_mesh_format(tmp_path: Path, extension: str, caplog: pytest.LogCaptureFixture) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=3.0)
    ball.apply_translation((7.0, -2.0, 11.0))
    path = tmp_path / f"ball.{extension}"
    ball.export(path)
    with caplog.at_level(logging.INFO, logger="gpe_pl.geometry.terrain"):
        grid = read_terrain(path, UNIT, 1 / 24)
    assert "the solid is inside the surface" in caplog.text
    exact = np.linalg.norm(nodes_of(grid) - 0.5, axis=-1) - 0.5  # scaled to fit
    assert_distances(grid.values, exact)
    np.testing.assert_array_equal(read_terrain(path, UNIT, 1 / 24, solid="outside").values, -grid.values)


def test_box_mesh_inside_and_options(tmp_path: Path) -> None:
    """A box aligned with the grid: rays along its edges and faces still count right."""
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "box.stl"
    trimesh.creation.box(bounds=[[0.25, 0.25, 0.0], [0.75, 0.5, 0.5]]).export(path)
    grid = read_terrain(path, UNIT, 1 / 16, fit="none")
    q = np.abs(nodes_of(grid) - (0.5, 0.375, 0.25)) - (0.25, 0.125, 0.25)
    exact = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    np.testing.assert_allclose(np.abs(grid.values), np.abs(exact), atol=1e-4)
    clear = np.abs(exact) > 1e-9
    np.testing.assert_array_equal(grid.values[clear] < 0, exact[clear] < 0)
    contained = read_terrain(path, ((0.0, 2.0), (0.0, 1.0), (0.0, 1.0)), 1 / 16)  # 1 x 0.5 x 1, in the middle of the floor
    inside = nodes_of(contained)[contained.values < -1e-6]
    assert np.all(inside.min(0) > (0.5, 0.25, -0.01))
    assert np.all(inside.max(0) < (1.5, 0.75, 1.0))
    assert inside[:, 0].max() - inside[:, 0].min() > 0.8
    tall = read_terrain(path, UNIT, 1 / 16, fit="stretch", relief=0.25, up="y")
    assert np.all(tall.signed_distance(np.array([[0.5, 0.5, 0.2], [0.1, 0.9, 0.1]])) < 0)
    assert tall.signed_distance(np.array([0.5, 0.5, 0.35])) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_up_axis_keeps_the_handedness(tmp_path: Path, up: Any) -> None:
    trimesh = pytest.importorskip("trimesh")
    axis = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}[up]
    cone = trimesh.creation.cone(radius=0.5, height=1.0)
    cone.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), axis))
    path = tmp_path / "cone.ply"
    cone.export(path)
    grid = read_terrain(path, UNIT, 1 / 16, up=up)
    width = [(grid.values[:, 8, k] < 0).sum() for k in (1, 8, 14)]
    assert width[0] > width[1] > width[2] > 0
    assert np.linalg.det(np.asarray(terrain._TO_Z_UP[up], float)) == pytest.approx(1)


def test_twenty_thousand_triangles_are_exact(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.4)
    ball.apply_translation((0.5, 0.5, 0.5))
    ball.export(tmp_path / "ball.stl")
    grid = read_terrain(tmp_path / "ball.stl", UNIT, 1 / 32, fit="none")
    assert_distances(grid.values, np.linalg.norm(nodes_of(grid) - 0.5, axis=-1) - 0.4)


@pytest.mark.parametrize("extension", ["obj", "stl", "ply"])
def test_open_surface_is_solid_below(tmp_path: Path, extension: str, caplog: pytest.LogCaptureFixture) -> None:
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = hill_mesh()
    path = tmp_path / f"hills.{extension}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    with caplog.at_level(logging.INFO, logger="gpe_pl.geometry.terrain"):
        grid = read_terrain(path, UNIT, 1 / 20, fit="none")
    assert "the solid is below the surface" in caplog.text
    x = nodes_of(grid)
    gap = x[..., 2] - hills(x[..., 0], x[..., 1])
    clear = np.abs(gap) > 2e-3
    np.testing.assert_array_equal(grid.values[clear] < 0, gap[clear] < 0)
    slope = 0.12 * 5
    assert np.all(np.abs(grid.values) <= np.abs(gap) + 1e-3)
    assert np.all(np.abs(grid.values) >= np.abs(gap) / np.sqrt(1 + slope**2) - 2e-3)


def test_open_surface_continues_beyond_its_rim(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = hill_mesh(low=0.3, high=0.65)
    path = tmp_path / "patch.ply"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    grid = read_terrain(path, UNIT, 1 / 20, fit="none")
    columns = grid.values
    assert np.all(columns[..., 0] < 0)
    assert np.all(columns[..., -1] > 0)
    assert np.all((np.diff(columns > 0, axis=-1)).sum(-1) == 1)  # one surface, no cracks
    assert np.abs(np.diff(columns, axis=0)).max() < 1.05 / 20  # nowhere steeper than a distance can be
    assert np.abs(np.diff(columns, axis=2)).max() < 1.05 / 20
    top = np.argmax(columns > 0, axis=-1) / 20
    np.testing.assert_allclose(top[0, 0], hills(0.3, 0.3), atol=0.06)


def test_overhang_of_an_open_surface_is_free_below(tmp_path: Path) -> None:
    """A profile along x that doubles back: the ground goes right at z = 0.2, back left at 0.5 and right again at 0.7."""
    trimesh = pytest.importorskip("trimesh")
    line = np.array([[0.0, 0.2], [0.8, 0.2], [0.8, 0.5], [0.4, 0.5], [0.4, 0.7], [1.0, 0.7]])
    vertices = np.array([[x, y, z] for x, z in line for y in (0.0, 1.0)])
    faces = np.array([f for k in range(5) for f in ((2 * k, 2 * k + 2, 2 * k + 1), (2 * k + 1, 2 * k + 2, 2 * k + 3))])
    path = tmp_path / "overhang.obj"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    grid = read_terrain(path, UNIT, 1 / 20, fit="none")
    for point, sign in (((0.2, 0.5, 0.4), 1), ((0.6, 0.5, 0.35), 1), ((0.6, 0.5, 0.6), -1), ((0.6, 0.5, 0.8), 1), ((0.6, 0.5, 0.1), -1)):
        assert np.sign(grid.signed_distance(np.array(point))) == sign, point
    assert grid.signed_distance(np.array((0.6, 0.5, 0.35))) == pytest.approx(0.15, abs=1e-3)


def test_crack_in_a_closed_mesh_does_no_harm(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.45)
    ball.apply_translation((0.5, 0.5, 0.5))
    cracked = trimesh.Trimesh(ball.vertices, np.delete(ball.faces, [17, 230], axis=0), process=False)
    assert not cracked.is_watertight
    cracked.export(tmp_path / "ball.obj")
    grid = read_terrain(tmp_path / "ball.obj", UNIT, 1 / 20, fit="none", solid="inside")
    exact = np.linalg.norm(nodes_of(grid) - 0.5, axis=-1) - 0.45
    clear = np.abs(exact) > 0.02
    np.testing.assert_array_equal(grid.values[clear] < 0, exact[clear] < 0)


# --- clouds and height maps ---------------------------------------------------------------------------------------------------------------


def write_ply_cloud(path: Path, points: np.ndarray, normals: np.ndarray | None) -> None:
    names = ("x", "y", "z") if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    rows = points if normals is None else np.hstack([points, normals])
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {n}" for n in names), "end_header"]
    path.write_text("\n".join(header) + "\n" + "\n".join(" ".join(f"{v:.8f}" for v in row) for row in rows) + "\n")


@pytest.mark.parametrize("name", ["ball.xyz", "ball.npy", "ball.npz", "ball.ply"])
def test_cloud_with_normals(tmp_path: Path, name: str) -> None:
    if name.endswith("ply"):
        pytest.importorskip("trimesh")
    normals = np.random.default_rng(0).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points, path = 0.5 + 0.4 * normals, tmp_path / name
    if name.endswith("xyz"):
        np.savetxt(path, np.hstack([points, 2 * normals]))
    elif name.endswith("npy"):
        np.save(path, np.hstack([points, normals]))
    elif name.endswith("npz"):
        np.savez(path, points=points, normals=normals)
    else:
        write_ply_cloud(path, points, normals)
    grid = read_terrain(path, UNIT, 1 / 16, fit="none")
    exact = np.linalg.norm(nodes_of(grid) - 0.5, axis=-1) - 0.4
    np.testing.assert_allclose(grid.values, exact, atol=0.015)
    assert np.abs(grid.values - exact)[np.abs(exact) < 0.1].max() < 0.01
    np.testing.assert_array_equal(read_terrain(path, UNIT, 1 / 16, fit="none", solid="outside").values < 0, grid.values > 0)


@pytest.mark.parametrize("name", ["hills.xyz", "hills.npy", "hills.npz", "hills.ply"])
def test_cloud_without_normals_is_a_height_field(tmp_path: Path, name: str) -> None:
    if name.endswith("ply"):
        pytest.importorskip("trimesh")
    x, y = np.random.default_rng(1).uniform(0, 1, (2, 4000))
    points, path = np.stack([x, y, hills(x, y)], -1), tmp_path / name
    if name.endswith("xyz"):
        np.savetxt(path, points)
    elif name.endswith("npy"):
        np.save(path, points)
    elif name.endswith("npz"):
        np.savez(path, points=points)
    else:
        write_ply_cloud(path, points, None)
    grid = read_terrain(path, UNIT, 1 / 16, fit="none")
    place = nodes_of(grid)
    gap = place[..., 2] - hills(place[..., 0], place[..., 1])
    clear = np.abs(gap) > 0.02
    np.testing.assert_array_equal(grid.values[clear] < 0, gap[clear] < 0)
    with pytest.raises(TerrainError, match=f"{name}.*needs a mesh or normals"):
        read_terrain(path, UNIT, 1 / 16, solid="inside")


def write_heights(path: Path, rows: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, rows)
    elif path.suffix == ".npz":
        np.savez(path, heights=rows)
    elif path.suffix == ".csv":
        np.savetxt(path, rows, delimiter=",")
    elif path.stem == "deep":
        Image.fromarray(np.round((rows - rows.min()) / np.ptp(rows) * 65535).astype(np.uint16)).save(path)
    else:
        Image.fromarray(np.round((rows - rows.min()) / np.ptp(rows) * 255).astype(np.uint8)).save(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map.npy", "map.npz", "map.csv", "map.png", "deep.png"])
def test_height_maps_fill_the_domain(tmp_path: Path, name: str) -> None:
    """Rows run from north to south; the lowest place lies on the floor and ``relief`` is the whole height."""
    x, y = np.meshgrid(np.linspace(0, 1, 33), np.linspace(1, 0, 25))
    rows = 100 + 50 * x + 20 * y
    write_heights(tmp_path / name, rows)
    bounds = ((0.0, 2.0), (1.0, 2.5), (-0.5, 0.5))
    grid = read_terrain(tmp_path / name, bounds, 1 / 16, relief=0.35, friction=0.25)
    ground = -0.5 + 0.35 / 70 * (50 * nodes_of(grid)[..., 0] / 2 + 20 * (nodes_of(grid)[..., 1] - 1) / 1.5)
    gap = nodes_of(grid)[..., 2] - ground
    slope = np.hypot(0.25 / 2, 0.1 / 1.5)
    inner = (slice(6, -6),) * 2
    np.testing.assert_allclose(grid.values[inner], gap[inner] / np.hypot(1, slope), atol=6e-3)
    assert grid.friction == 0.25
    half = read_terrain(tmp_path / name, bounds, 1 / 16)
    top = -0.5 + np.argmax(half.values > 0, axis=-1) / 16
    assert top.max() == pytest.approx(0.0, abs=1 / 16)


def test_height_map_in_metres(tmp_path: Path) -> None:
    write_heights(tmp_path / "map.npy", np.array([[1.0, 1.5, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0]]))
    grid = read_terrain(tmp_path / "map.npy", ((0.0, 3.0), (0.0, 1.0), (0.0, 4.0)), 0.25, fit="none")
    ground = [float(np.argmax(grid.values[i, j] > 0)) * 0.25 for i, j in ((0, 0), (4, 4), (8, 4), (12, 0))]
    np.testing.assert_allclose(ground, [2.25, 1.75, 1.25, 2.25])


def test_contained_height_map_keeps_its_proportions(tmp_path: Path) -> None:
    write_heights(tmp_path / "map.csv", np.eye(5))
    grid = read_terrain(tmp_path / "map.csv", ((0.0, 2.0), (0.0, 1.0), (0.0, 1.0)), 1 / 16)
    ridge = np.argwhere(grid.values[:, :, 4] < 0)  # from north west to south east, in the middle of the long domain
    np.testing.assert_allclose(ridge.mean(0), (16, 8), atol=1)
    np.testing.assert_allclose(np.asarray(np.corrcoef(ridge.T))[0, 1], -1, atol=0.15)


# --- wrong input --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.gltf", b"", "unknown extension '.gltf'.*obj.*xyz.*png"),
        ("a", b"", "unknown extension"),
        ("a.obj", b"", "no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "not finite|cannot be read"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "without area"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 1e300 1e300 0\nf 1 2 3\n", "too large|not finite"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", "cannot be read|no triangles"),
        ("a.stl", b"not a mesh", "no triangles|cannot be read"),
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50), "cannot be read|no triangles"),
        ("a.ply", b"not a mesh", "cannot be read"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 2000000000\nproperty float x\nend_header\n1\n", "cannot be read"),
        ("a.npy", b"\x93NUMPY", "cannot be read"),
        ("a.npy", b"", "cannot be read"),
        ("a.npz", b"PK", "cannot be read"),
        ("a.png", b"\x89PNG", "cannot be read"),
        ("a.csv", b"1,2\n3\n", "cannot be read"),
        ("a.csv", b"1,2\n3,nan\n", "index .* is not finite"),
        ("a.csv", b"1,2\n", "at least 2 rows"),
        ("a.csv", b"import os", "cannot be read"),
        ("a.xyz", b"1 2\n3 4\n", "3 columns, or 6"),
        ("a.xyz", b"1 2 3\n3 4 5\n", "at least 3 points"),
        ("a.xyz", b"0 0 0\n1 1 1\n2 2 2\n3 3 3\n", "on one line"),
        ("a.xyz", b"0 0 0\n1 1 1\n2 2 2\n1 2 inf\n", "not finite"),
        ("a.xyz", b"0 0 0 0 0 1\n1 0 0 0 0 0\n1 1 0 0 0 -1\n", "normal 1 has no length"),
        ("a.xyz", b"0 0 0 0 0 1\n1 0 0 99 90 60\n1 1 0 0 0 1\n", r"columns 4 to 6 are no unit normals, point 1 has \[99.0, .*colours"),
        ("a.xyz", b"0 0 0 .9 .8 .7\n1 0 0 .9 .9 .6\n1 1 0 0 0 0\n", "columns 4 to 6 are no unit normals, point 0"),
    ],
)
def test_unusable_files_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    if name.endswith((".obj", ".stl", ".ply")):
        pytest.importorskip("trimesh")
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(TerrainError, match=message) as caught:
        read_terrain(path, UNIT, 0.25)
    assert str(path) in str(caught.value)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((40, 3), r"array \[40, 3\] with fewer than 100 rows may be a height map or a point cloud; write an .npz file with 'heights'"),
        ((40, 6), r"array \[40, 6\] without unit normals in columns 4 to 6 may be a height map"),
        ((4000, 6), r"array \[4000, 6\] without unit normals"),
    ],
)
def test_arrays_that_may_be_maps_or_clouds_are_refused(tmp_path: Path, shape: tuple[int, int], message: str) -> None:
    values = np.random.default_rng(0).uniform(size=shape)
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(TerrainError, match=message):
        read_terrain(tmp_path / "a.npy", UNIT, 0.25)
    np.savez(tmp_path / "a.npz", heights=values)
    read_terrain(tmp_path / "a.npz", UNIT, 0.25)


def test_missing_and_large_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TerrainError, match="no such file"):
        read_terrain(tmp_path / "a.csv", UNIT, 0.25)
    np.save(tmp_path / "a.npy", np.random.default_rng(0).random((50, 50)))
    np.savez_compressed(tmp_path / "a.npz", heights=np.zeros((500, 500)))
    monkeypatch.setattr(terrain_files, "MAX_HEIGHTS", 100)
    with pytest.raises(TerrainError, match="2500 heights are too many"):
        read_terrain(tmp_path / "a.npy", UNIT, 0.25)
    monkeypatch.setattr(terrain_files, "MAX_FILE_BYTES", 10_000)
    with pytest.raises(TerrainError, match="bytes are too many"):
        read_terrain(tmp_path / "a.npy", UNIT, 0.25)
    with pytest.raises(TerrainError, match="unpacks to"):
        read_terrain(tmp_path / "a.npz", UNIT, 0.25)


def test_pickles_are_not_executed(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(TerrainError, match="cannot be read"):
        read_terrain(tmp_path / "a.npy", UNIT, 0.25)
    np.savez(tmp_path / "a.npz", heights=np.array([[{}]], dtype=object))
    with pytest.raises(TerrainError, match="cannot be read"):
        read_terrain(tmp_path / "a.npz", UNIT, 0.25)
    np.savez(tmp_path / "b.npz", other=np.zeros(3))
    with pytest.raises(TerrainError, match="needs an array 'heights' or 'points', holds other"):
        read_terrain(tmp_path / "b.npz", UNIT, 0.25)


def test_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.npy"
    np.save(path, np.random.default_rng(0).random((8, 8)))
    with pytest.raises(ValueError, match="relief"):
        read_terrain(path, UNIT, 0.25, relief=-1.0)
    with pytest.raises(ValueError, match="relief"):
        read_terrain(path, UNIT, 0.25, relief=1.0, fit="none")
    with pytest.raises(ValueError, match="3 axes"):
        read_terrain(path, UNIT[:2], 0.25)
    with pytest.raises(ValueError, match="spacing"):
        read_terrain(path, UNIT, 0.0)
    with pytest.raises(ValueError, match="wider spacing"):
        read_terrain(path, UNIT, 1e-4)
    np.save(path, np.full((8, 8), 5.0))
    with pytest.raises(TerrainError, match="no free space"):
        read_terrain(path, UNIT, 0.25, fit="none")
    np.save(path, np.full((8, 8), -5.0))
    with pytest.raises(TerrainError, match="nothing solid"):
        read_terrain(path, UNIT, 0.25, fit="none")


# --- the canyon ---------------------------------------------------------------------------------------------------------------------------

CANYON = ((0.0, 2.0), (0.0, 1.0), (0.0, 1.0))


def ground(grid: DistanceGrid) -> np.ndarray:
    """Return the height [m] of the lowest free node of each column."""
    return np.asarray(grid.origin[2] + grid.spacing * np.argmax(grid.values > 0, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_canyon_leads_from_the_reservoir_over_the_fall_into_the_pool(seed: int) -> None:
    made = canyon(seed, CANYON, 1 / 24)
    height = ground(made.terrain)
    bed = height.min(axis=1)
    edge = int(made.fall * 24)
    (first, last), _, (bottom, level) = made.reservoir
    assert first == 0.0
    assert last < made.fall
    assert np.all(np.diff(bed) <= 1.01 / 24)
    assert bed[1] - bed[edge - 2] >= 0  # down to the fall
    assert bed[edge - 2] - bed[edge + 4] > 0.25  # the fall
    assert bed[edge + 4 :].max() - bed[edge + 4 :].min() < 0.1  # the pool
    assert bottom < bed[0] < level - 0.2
    crests = [half[: int(last * 24)].max(axis=1).min() for half in (height[:, :12], height[:, 13:])]
    assert min(crests) > level - 1.01 / 24  # the banks hold the water
    assert np.all((np.diff(made.terrain.values > 0, axis=-1)).sum(-1) == 1)


def test_canyon_is_reproducible_and_differs_by_seed() -> None:
    made = canyon(4, CANYON, 1 / 16)
    assert canyon(4, CANYON, 1 / 16) == made
    assert canyon(5, CANYON, 1 / 16).terrain != made.terrain
    fine = canyon(4, CANYON, 1 / 32)
    points = nodes_of(made.terrain)[4:-4, 4:-4]
    difference = np.abs(fine.terrain.signed_distance(points) - made.terrain.signed_distance(points))
    assert np.quantile(difference, 0.95) < 0.5 / 16  # the same canyon, seen more closely
    assert fine.fall == made.fall


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start", "repeated", "count", "message"),
    [
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1", b"\nf 1 2 3", terrain_files.MAX_TEXT_TRIANGLES, "triangles are too many"),
        ("a.obj", b"v 0 0 0\rv 1 0 0\rv 0 1 1", b"\rf 1 2 3", terrain_files.MAX_TEXT_TRIANGLES, "triangles are too many"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1", b"\nvt 0 0", terrain_files.MAX_TEXT_VERTICES, "vertices are too many"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1", b"\nusemtl a\nf 1 2 3", terrain_files.MAX_PARTS, "parts are too many"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1\nf", b" 1 2 3", 7_000_000, "values are too many"),
        ("a.stl", b"solid a\n", b"endfacet\n", terrain_files.MAX_ASCII_TRIANGLES, "triangles are too many"),
        ("a.xyz", b"", b"1 2\r", terrain_files.MAX_TEXT_VALUES // 2, "values are too many"),
        ("a.csv", b"", b"1,2\n", terrain_files.MAX_TEXT_VALUES // 2, "heights are too many"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement  foo 1000001\n", b"1\n", 1_000_001, "too large for text"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", b"1 ", terrain_files.MAX_ASCII_BYTES // 2, "too large for text"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nelement face 2000001\n",
            b"\n",
            2_000_001,
            "2000001 elements of kind face are too many",
        ),
        ("a.npz", b"PK\x03\x04", b"PK\x01\x02", terrain_files.MAX_MEMBERS, "holds 1001 arrays"),
    ],
)
def test_what_is_too_much_is_counted_before_it_is_read(
    tmp_path: Path, name: str, start: bytes, repeated: bytes, count: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(*_: Any, **__: Any) -> None:
        raise AssertionError

    for module, function in (("numpy", "loadtxt"), ("zipfile", "ZipFile"), ("trimesh", "load_scene")):
        monkeypatch.setattr(f"{module}.{function}", read)
    (tmp_path / name).write_bytes(start + repeated * (count + 1))
    with pytest.raises(TerrainError, match=message):
        read_surface(tmp_path / name)


def stl(path: Path, corners: np.ndarray) -> Path:
    """Write triangles [triangle, 3, 3] as a binary STL file."""
    facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", 9), ("attributes", "<u2")])
    facets["corners"] = corners.reshape(-1, 9)
    path.write_bytes(bytes(80) + np.uint32(len(corners)).tobytes() + facets.tobytes())
    return path


def test_a_mesh_of_many_large_triangles_is_refused_before_the_work(tmp_path: Path) -> None:
    path = stl(tmp_path / "soup.stl", np.random.default_rng(0).random((30_000, 3, 3)))
    with pytest.raises(
        TerrainError, match=r"soup.stl: 30000 triangles have together .* grid nodes near them, at most 1.07e\+09; simplify the mesh"
    ):
        read_terrain(path, UNIT, 1 / 120, solid="inside")


def test_work_is_what_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """One triangle in a corner, one across, one outside of a grid of 11 nodes along each axis."""
    corners = np.array(
        [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [10, 10, 0], [10, 10, 10]], [[99, 99, 99], [99, 98, 99], [98, 99, 99]]], float
    )
    count = grid_distance._num_pairs(corners, np.zeros(3), 1.0, (11, 11, 11))
    assert count == 4 * 4 * 3 + 11**3 + 1
    monkeypatch.setattr(grid_distance, "MAX_PAIRS", count)
    grid_distance.mesh_distances(corners, np.zeros(3), 1.0, (11, 11, 11), "inside")
    monkeypatch.setattr(grid_distance, "MAX_PAIRS", count - 1)
    with pytest.raises(ValueError, match="3 triangles have together"):
        grid_distance.mesh_distances(corners, np.zeros(3), 1.0, (11, 11, 11), "inside")
