from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from gpe_pl.schema import node_code
from gpe_pl.trajectory.state import Stress, von_mises
from gpe_pl.viz.coloring import MATERIAL_COLORS, REFERENCE, Coloring


def test_materials_have_their_colours_and_a_legend(ground_truth):
    types = np.array([node_code("sand")] * 20 + [node_code("solid")] * (ground_truth.num_nodes - 20), np.uint8)
    mixed = replace(ground_truth, node_type=types, cells=np.array([[20, 21, 22], [0, 1, 2]]))
    coloring = Coloring("material", [mixed], [0])
    nodes, cells = coloring(mixed, 0)
    np.testing.assert_allclose(nodes[[0, 24]], [to_rgba(MATERIAL_COLORS[m]) for m in ("sand", "solid")])
    np.testing.assert_allclose(cells, nodes[[24, 0]])
    assert coloring.legend([mixed]) == {m: MATERIAL_COLORS[m] for m in ("sand", "solid")}
    assert Coloring("height", [mixed], [0]).legend([mixed]) == {}
    assert coloring.bar_label is None


def test_every_material_has_a_colour_of_its_own():
    from gpe_pl.schema import MATERIALS

    assert set(MATERIAL_COLORS) == set(MATERIALS) and len(set(MATERIAL_COLORS.values())) == len(MATERIALS)


def test_speed_is_the_length_of_the_velocity(ground_truth):
    moving = replace(ground_truth, vel=np.random.default_rng(0).normal(size=ground_truth.vel.shape))
    coloring = Coloring("speed", [moving], range(moving.num_frames))
    np.testing.assert_allclose(coloring.values(moving, 3)[0], np.sqrt((moving.vel[3] ** 2).sum(-1)))
    assert coloring.scale.vmin == 0 and coloring.bar_label == "speed [m/s]"


def test_one_moving_node_among_many_at_rest_sets_the_scale(ground_truth):
    vel = np.zeros_like(ground_truth.vel)
    vel[1, 3, :2] = 3.0, 4.0
    coloring = Coloring("speed", [replace(ground_truth, vel=vel)], range(ground_truth.num_frames))
    assert np.quantile(np.linalg.norm(vel, axis=2), 0.99) == 0
    assert coloring.scale.vmax == pytest.approx(5.0) and not coloring.is_exceeded


def test_stress_has_one_scale_for_all_rows(mesh):
    stiff = replace(mesh, stress=type(mesh.stress)(4 * mesh.stress.node, 4 * mesh.stress.cell))
    coloring = Coloring("von_mises", [mesh, stiff], range(mesh.num_frames))
    assert coloring.scale.vmin == 0 and 2.5 < coloring.scale.vmax / mesh.stress.cell_von_mises.max() <= 4
    assert (coloring(mesh, -1)[1] != coloring(stiff, -1)[1]).any()
    np.testing.assert_allclose(coloring.values(mesh, 3)[1], mesh.stress.cell_von_mises[3], rtol=1e-6)


def stressed_beside(mesh, of_cells: float, of_particles: float):
    """Return the mesh with constant stresses [Pa] of its cells and of the particles beside it, and with a peak at its node 0."""
    node, cell = np.zeros_like(mesh.stress.node), np.zeros_like(mesh.stress.cell)
    cell[..., 0], node[:, :, 0] = of_cells, of_particles
    node[:, np.unique(mesh.cells), 0] = of_cells
    node[:, 0, 0] = 4 * of_cells
    metadata = replace(mesh.metadata, materials=("solid", "snow"), param_names=("youngs_modulus", "hardening_coefficient"))
    metadata = replace(metadata, stress_materials=("snow",))
    types = np.where(np.isin(np.arange(mesh.num_nodes), mesh.cells), node_code("solid"), node_code("snow")).astype(np.uint8)
    params = np.ones((mesh.num_nodes, 2))
    return replace(mesh, metadata=metadata, node_type=types, material_params=params, stress=Stress(node, cell))


def test_the_scale_of_stress_covers_cells_and_the_particles_beside_them(mesh):
    for of_cells, of_particles in ((1e4, 1e6), (1e6, 1e4)):
        mixed = stressed_beside(mesh, of_cells, of_particles)
        nodes, cells = Coloring("von_mises", [mixed], [0]).values(mixed, 0)
        assert np.isclose(nodes, of_particles).sum() == 2 and np.isclose(cells, of_cells).all()
        assert Coloring("von_mises", [mixed], [0]).scale.vmax == pytest.approx(1e6)


def test_a_mesh_painted_by_its_nodes_has_the_scale_of_their_values(mesh):
    mixed = stressed_beside(mesh, 1e4, 1e4)
    by_cell, by_node = (Coloring("von_mises", [mixed], [0], by_node=by_node) for by_node in (False, True))
    assert by_cell.scale.vmax == pytest.approx(1e4) and not by_cell.is_exceeded
    assert 3e4 < by_node.scale.vmax < 4e4 and by_node.is_exceeded


def test_what_has_no_stress_is_neutral(mesh):
    loose = np.setdiff1d(np.arange(mesh.num_nodes), mesh.cells)
    coloring = Coloring("von_mises", [mesh], [0, 1])
    assert len(loose) > 0
    np.testing.assert_allclose(coloring(mesh, 1)[0][loose], np.tile(to_rgba(REFERENCE), (len(loose), 1)))
    for colors in coloring(replace(mesh, stress=None), 1):
        np.testing.assert_allclose(colors, np.tile(to_rgba(REFERENCE), (len(colors), 1)))


def test_particles_with_a_stress_are_coloured(ground_truth):
    node = np.random.default_rng(0).normal(size=(ground_truth.num_frames, ground_truth.num_nodes, 4))
    with_stress = replace(ground_truth.metadata, stress_materials=ground_truth.metadata.materials)
    particles = replace(ground_truth, metadata=with_stress, stress=Stress(node, np.zeros((len(node), 0, 4))))
    coloring = Coloring("von_mises", [particles], range(particles.num_frames))
    np.testing.assert_allclose(coloring.values(particles, 2)[0], von_mises(node[2]))
    assert 0.5 < coloring.scale.vmax / von_mises(node).max() <= 1
    bare = replace(particles, metadata=replace(with_stress, stress_materials=()))
    assert np.isnan(coloring.values(bare, 2)[0]).all()


def test_cells_have_the_mean_of_their_corners(mesh):
    moved = replace(mesh, pos=mesh.pos + 0.01 * np.arange(mesh.num_nodes)[:, None])
    nodes, cells = Coloring("error", [mesh, moved], [0], mesh).values(moved, 0)
    np.testing.assert_allclose(cells, nodes[mesh.cells].mean(axis=1))
    assert nodes[1] == pytest.approx(0.01 * np.sqrt(mesh.metadata.dim), rel=1e-5)
    assert np.isnan(Coloring("error", [mesh, moved], [0], mesh).values(mesh, 0)[0]).all()


def test_frames_that_a_rollout_lacks_do_not_count(ground_truth, stopped):
    coloring = Coloring("error", [ground_truth, stopped], range(ground_truth.num_frames), ground_truth)
    assert 0 < coloring.scale.vmax < np.inf


def test_equal_trajectories_still_have_a_scale(ground_truth, mesh):
    assert Coloring("error", [ground_truth], [0], ground_truth).scale.vmax > 0
    still = replace(mesh, stress=type(mesh.stress)(0 * mesh.stress.node, 0 * mesh.stress.cell))
    assert Coloring("von_mises", [still], [0]).scale.vmax > 0


def test_colours_without_data_are_refused(ground_truth):
    with pytest.raises(ValueError, match="von_mises needs a stress"):
        Coloring("von_mises", [ground_truth], [0])
    with pytest.raises(ValueError, match="ground truth"):
        Coloring("error", [ground_truth], [0])
