import numpy as np
import pytest

from gpe_pl.geometry.shapes import Bowl, domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from gpe_pl.viz.camera import Camera


def empty_scene(bounds, gravity, shapes=()) -> Trajectory:
    dim = len(bounds)
    metadata = Metadata("test", ("sand",), ("friction_angle",), 0.02, 0.05, 0.1, bounds, gravity)
    nothing = np.empty((1, 0, dim))
    return Trajectory(metadata, nothing, nothing, np.empty(0, np.uint8), np.empty(0), np.empty((0, 1)), Boundary.sample(shapes, 0.1, dim))


def test_2d_scenes_keep_their_coordinates():
    camera = Camera(empty_scene(((0.0, 2.0), (0.0, 1.0)), (0.0, -9.81)))
    points = np.random.default_rng(0).normal(size=(5, 2))
    on_paper, depth = camera.project(points)
    assert (on_paper == points).all() and (depth == 0).all() and (camera.haze(depth) == 0).all()
    assert camera.aspect == pytest.approx((1 + 2 * 0.03) / (2 + 2 * 0.03))


@pytest.mark.parametrize("vertical", [0, 1, 2])
def test_gravity_points_down_on_paper_and_the_viewer_looks_from_above(vertical):
    down = -np.eye(3)[vertical]
    camera = Camera(empty_scene(((0.0, 1.0),) * 3, tuple(9.81 * down)))
    (right, up), depth = camera.project(down)
    assert right == pytest.approx(0) and up < -0.8 and depth < -0.2
    frame = np.stack([*camera.plane, camera.toward])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)  # a mirrored scene has -1
    np.testing.assert_allclose(camera.turn(np.eye(3)), frame.T)


def test_3d_domain_fits_on_paper_and_fades_from_near_to_far():
    camera = Camera(empty_scene(((0.0, 1.0), (-1.0, 1.0), (0.0, 0.5)), (0.0, 0.0, -9.81)))
    corners = np.stack([m.ravel() for m in np.meshgrid([0, 1], [-1, 1], [0, 0.5])], axis=-1)
    on_paper, depth = camera.project(corners)
    margin = on_paper.min(axis=0) - camera.low
    assert (margin > 0).all() and (camera.high - on_paper.max(axis=0) > 0).all() and margin.max() < 0.1
    haze = camera.haze(depth)
    assert haze[depth.argmax()] == 0 and haze[depth.argmin()] == 1


@pytest.mark.parametrize("dim", [2, 3])
def test_a_bowl_fills_the_picture_as_far_as_the_domain_reaches(dim):
    bounds, gravity, center = ((0.0, 4.0),) * dim, (0.0,) * (dim - 1) + (-9.81,), (2.0,) * dim
    camera = Camera(empty_scene(bounds, gravity, (Bowl(center, 0.5, 0.1), *domain_walls(bounds, 0.1))))
    np.testing.assert_allclose(camera.high - camera.low, 1.05)  # with half a spacing on each side
    low = Camera(empty_scene(bounds, gravity, (Bowl((0.0,) * dim, 0.5, 0.1),)))
    whole = Camera(empty_scene(bounds, gravity))
    assert (low.low >= whole.low).all() and (low.high <= whole.high).all()
