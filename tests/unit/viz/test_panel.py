import warnings
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Sphere, domain_walls
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Termination
from gpe_pl.viz.camera import Camera
from gpe_pl.viz.coloring import Coloring
from gpe_pl.viz.film_strip import new_figure
from gpe_pl.viz.panel import HIDDEN, Panel, drawn_faces, outline
from tests.open_scenes import open_trajectory


class Diamond:
    """Shape of a kind unknown to all modules."""

    kind: ClassVar[str] = "diamond"
    friction, restitution, extent = 0.3, 0.0, 0.5

    def __init__(self, dim):
        self.up = np.eye(dim)[-1]

    def signed_distance(self, points):
        return abs(points - 0.5).sum(axis=-1) - 0.25

    def sample(self, spacing):
        return np.stack([0.5 + 0.25 * self.up, 0.5 - 0.25 * self.up]), np.stack([self.up, -self.up])


def terrain(dim: int) -> DistanceGrid:
    axes = np.meshgrid(*[np.linspace(0, 1, 17)] * dim, indexing="ij")
    return DistanceGrid.from_values((0.0,) * dim, 1 / 16, axes[-1] - 0.2 - 0.1 * np.sin(6 * axes[0]), 0.3)


def with_shapes(trajectory, *shapes):
    return replace(trajectory, boundary=Boundary.sample(shapes, 0.05, trajectory.metadata.dim))


def panel_of(trajectory, frame=0, by="height") -> Panel:
    panel = Panel(new_figure(3.0, 3.0), (0.0, 0.0, 1.0, 1.0), trajectory, Coloring(by, [trajectory], [0, frame]))
    panel.show_frame(frame)
    return panel


def pixels(panel) -> np.ndarray:
    panel.axes.figure.canvas.draw()
    return np.asarray(panel.axes.figure.canvas.buffer_rgba())[..., :3].astype(int)


def at(panel, image, point) -> np.ndarray:
    """Return the colour of the pixel that shows a point of the scene."""
    column, row = panel.axes.transData.transform(panel.camera.project(np.asarray(point, float))[0])
    return image[image.shape[0] - 1 - int(row), int(column)]


def test_a_panel_says_how_many_nodes_it_does_not_show(ground_truth):
    assert panel_of(ground_truth).note.get_text() == ""
    gone = replace(ground_truth, pos=ground_truth.pos + np.where(np.arange(ground_truth.num_nodes)[:, None] < 3, -5.0, 0.0))
    assert panel_of(gone).note.get_text() == f"3 of {ground_truth.num_nodes} nodes\nare outside"
    pos = gone.pos.copy()
    pos[:, 3:5] = np.nan
    assert panel_of(replace(gone, pos=pos)).note.get_text().endswith(f"2 of {ground_truth.num_nodes} nodes\nare missing")


def test_a_panel_says_exactly_when_a_rollout_stopped(ground_truth):
    metadata = replace(ground_truth.metadata, frame_dt=2.5e-3)
    stopped = replace(ground_truth.frames(0, 7), metadata=metadata, termination=Termination("explosion", 7, 0, ""))
    assert panel_of(stopped, 9).note.get_text() == "stopped at 0.0175 s\n(explosion)"


def test_nodes_that_are_not_in_an_open_scene_are_not_missing():
    scene = open_trajectory().with_absent_hidden()
    assert scene.alive is not None
    frame = scene.num_frames // 2
    present = np.flatnonzero(scene.alive[frame])
    assert 2 < len(present) < scene.num_nodes
    assert panel_of(scene, frame).note.get_text() == ""
    pos = scene.pos.copy()
    pos[frame, present[:2]] = np.nan
    assert panel_of(replace(scene, pos=pos), frame).note.get_text() == f"2 of {len(present)} nodes\nare missing"


def test_mesh_cells_are_filled_and_only_loose_particles_are_dots(mesh, dim):
    panel = panel_of(mesh)
    loose = np.setdiff1d(np.arange(mesh.num_nodes), mesh.cells)
    faces, _ = drawn_faces(mesh)
    polygons = panel.mesh.get_paths()
    if dim == 2:
        assert len(polygons) == len(mesh.cells) and len(panel.particles.get_offsets()) == len(loose)
        np.testing.assert_allclose(polygons[3].vertices[:-1], mesh.pos[0, mesh.cells[3]], atol=1e-6)
    else:  # in depth order together with the loose ones
        assert len(polygons) == len(faces) + len(loose) and len(panel.particles.get_offsets()) == 0
        assert len(faces) == 6 * 2 * 2 * 2  # two triangles on each of the four squares of each side of the cube
    assert (np.ptp(pixels(panel), axis=-1) > 20).sum() > 100


def test_outer_faces_point_outward_and_know_their_cell(mesh, dim):
    faces, cell = drawn_faces(mesh)
    assert all(set(f) <= set(mesh.cells[c]) for f, c in zip(faces.tolist(), cell.tolist(), strict=True))
    if dim == 3:
        a, b, c = (mesh.rest_pos[faces[:, k]] for k in range(3))
        outward = (a + b + c) / 3 - mesh.rest_pos[np.unique(mesh.cells)].mean(axis=0)
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) > 0).all()
        assert len(outline(mesh)) == 0
    else:
        assert len(outline(mesh)) == 4 * 2


def test_cells_are_drawn_by_their_kind(mesh, dim):
    """Surface cells are drawn unchanged. Volume cells show the faces that only one cell has, even where triangles meet faces of hexahedra."""
    number = np.arange(27).reshape(3, 3, 3)
    if dim == 2:
        mixed = replace(
            mesh, cells=np.concatenate([mesh.cells[1:], mesh.cells[:1, [0, 1, 2, 2]], mesh.cells[:1, [0, 2, 3, 3]]]), stress=None
        )
        assert len(drawn_faces(mixed)[0]) == 5 and len(outline(mixed)) == len(outline(mesh))
        return
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    cubes = np.array([[number[i + a, j + b, k + c] for a, b, c in corners] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    assert len(drawn_faces(replace(mesh, cells=cubes, cell_dim=3))[0]) == 6 * 4
    beside = np.pad([[0, 1, 3, 27], [1, 4, 3, 28], [27, 0, 1, 28]], ((0, 0), (0, 4)), mode="edge")
    faces, cell = drawn_faces(replace(mesh, cells=np.concatenate([cubes[:1], beside]), cell_dim=3))
    assert len(faces) == 6 + 3 * 4 - 2 and np.bincount(cell).tolist() == [6, 3, 4, 3]  # the first and the last share a face
    shell = replace(mesh, cells=cubes[:, :4], cell_dim=2, stress=None)
    np.testing.assert_array_equal(drawn_faces(shell)[0], shell.cells)
    assert len(panel_of(shell).mesh.get_paths()) >= len(cubes)  # beside particles of no cell


def test_triangles_are_drawn_like_quadrilaterals(mesh, dim):
    if dim == 3:
        pytest.skip("tetrahedra")
    halves = np.concatenate([mesh.cells[:, [0, 1, 2]], mesh.cells[:, [0, 2, 3]]])
    triangles = replace(mesh, cells=halves, stress=None)
    panel = panel_of(triangles)
    assert len(panel.mesh.get_paths()) == 2 * len(mesh.cells) and len(outline(triangles)) == len(outline(mesh))
    assert (pixels(panel_of(replace(mesh, stress=None)))[..., 1] < 200).sum() == pytest.approx(
        (pixels(panel)[..., 1] < 200).sum(), rel=0.02
    )


def test_cells_show_their_stress(mesh, dim):
    colors = panel_of(mesh, -1, "von_mises").mesh.get_facecolor()
    if dim == 2:
        stress = mesh.stress.cell_von_mises[-1]
        assert colors[stress.argmax(), 1] < colors[stress.argmin(), 1] - 0.4  # from pale yellow to red
    assert len(np.unique(colors, axis=0)) > 2


def test_a_fine_surface_is_shown_by_its_nodes(mesh, dim, monkeypatch):
    monkeypatch.setattr("gpe_pl.viz.panel.MAX_FACES", 10)
    panel = panel_of(mesh)
    assert len(panel.particles.get_offsets()) == (mesh.num_nodes if dim == 3 else mesh.num_nodes - len(np.unique(mesh.cells)))


def test_what_is_not_finite_is_left_out(mesh):
    pos = mesh.pos.copy()
    pos[0, mesh.cells[0, 0]] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        panel = panel_of(replace(mesh, pos=pos))
    assert 0 < len(panel.mesh.get_paths()) < len(panel_of(mesh).mesh.get_paths())
    pixels(panel)


def test_a_bowl_is_solid_outside(ground_truth, dim):
    panel = panel_of(with_shapes(ground_truth, Bowl((0.5,) * dim, 0.4, 0.3)))
    image = pixels(panel)
    centre, corner = (0.5, 0.25) if dim == 2 else (0.5, 0.5, 0.25), panel.camera.low + 0.03
    row, column = image.shape[0] - 1 - round(0.03 * image.shape[0]), round(0.03 * image.shape[1])
    if dim == 2:
        assert tuple(at(panel, image, centre)) == (255, 255, 255) and tuple(at(panel, image, corner)) == (209, 209, 209)
    else:  # the far half of the inside is seen
        assert 120 < at(panel, image, centre)[0] < 245 and tuple(image[row, column]) == (255, 255, 255)


def test_terrain_is_shaded_and_its_free_space_is_not(ground_truth, dim):
    panel = panel_of(with_shapes(ground_truth, terrain(dim), *domain_walls(ground_truth.metadata.bounds, 0.3)))
    image = pixels(panel)
    if dim == 2:
        assert tuple(at(panel, image, (0.3, 0.1))) == (209, 209, 209) and tuple(at(panel, image, (0.3, 0.9))) == (255, 255, 255)
    else:
        grey = image[(np.ptp(image, axis=-1) == 0) & (image[..., 0] > 130) & (image[..., 0] < 243)]
        assert len(grey) > 0.2 * image.shape[0] * image.shape[1]
        assert len(np.unique(grey[:, 0])) > 10  # lit from one side


def test_unknown_shapes_are_drawn(ground_truth, dim):
    panel = panel_of(with_shapes(ground_truth, Diamond(dim)))
    image = pixels(panel)
    if dim == 2:  # by their distance
        assert tuple(at(panel, image, (0.5, 0.65))) == (209, 209, 209) and tuple(at(panel, image, (0.5, 0.8))) == (255, 255, 255)
    else:  # by those nodes that face the viewer
        assert np.ptp(at(panel, image, (0.5, 0.5, 0.75))) == 0 and at(panel, image, (0.5, 0.5, 0.75))[0] < 250
        assert len(panel.axes.collections[-1].get_offsets()) == 1


def test_a_solid_outside_the_domain_draws_nothing_and_warns_of_nothing(ground_truth, dim):
    far = DistanceGrid.from_values((0.0,) * dim, 1.0, np.full((2,) * dim, 5.0), 0.3)
    everywhere = DistanceGrid.from_values((0.0,) * dim, 1.0, np.full((2,) * dim, -5.0), 0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels(panel_of(with_shapes(ground_truth, far)))
        pixels(panel_of(with_shapes(ground_truth, everywhere)))
        pixels(panel_of(with_shapes(ground_truth)))


def test_particles_behind_an_obstacle_are_faint(falling_3d):
    center, toward = np.full(3, 0.5), Camera(falling_3d).toward
    for obstacle in (Sphere((0.5,) * 3, 0.19, 0.3), Box((0.35,) * 3, (0.65,) * 3, 0.3)):
        three = np.stack([center + 0.4 * toward, center - 0.4 * toward, center - 0.4 * toward + [0.4, 0.4, 0.0]])
        pos = np.broadcast_to(three, (2, 3, 3)).copy()
        panel = panel_of(with_shapes(replace(falling_3d, pos=pos, vel=pos, node_type=falling_3d.node_type[:3]), obstacle))
        np.testing.assert_allclose(panel.particles.get_facecolor()[:, 3], [1, HIDDEN, 1])  # from far to near: beside, behind, in front


def test_near_particles_are_drawn_last_and_far_ones_are_paler(falling_3d):
    panel = panel_of(falling_3d, by="material")
    on_paper, depth = panel.camera.project(falling_3d.pos[0])
    order = [np.linalg.norm(on_paper - xy, axis=1).argmin() for xy in np.asarray(panel.particles.get_offsets())]
    assert (np.diff(depth[order]) >= 0).all()
    brightness = panel.particles.get_facecolor()[:, :3].sum(axis=1)
    assert (np.diff(brightness) <= 1e-9).all() and brightness[0] > brightness[-1]


def test_walls_between_viewer_and_scene_are_left_out(falling_3d):
    panel = panel_of(with_shapes(falling_3d, *domain_walls(((0.0, 1.0),) * 3, 0.3)))
    faces = [p.get_xy()[:-1] for p in panel.axes.patches]
    assert len(faces) == 3
    near = panel.camera.project(np.array([1.0, 0.0, 1.0]))[0]  # the corner next to the viewer
    assert all(np.abs(face - near).max(axis=1).min() > 1e-6 for face in faces)


def test_a_box_shows_its_three_near_faces(falling_3d):
    panel = panel_of(with_shapes(falling_3d, Box((0.2, 0.2, 0.2), (0.4, 0.4, 0.4), 0.3)))
    greys = [to_rgba(p.get_facecolor())[0] for p in panel.axes.patches]
    assert len(greys) == 3 and len(set(greys)) == 3
