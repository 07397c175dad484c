"""A coarser scene has the same mass and momentum at the same place, and maps back to its original nodes; ``test_finer_solver`` tests finer scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.ground_truth import DatasetSpec, initial_state
from gpe_pl.solvers.resolution import Resolved, coarser, divided_mesh, outline
from gpe_pl.trajectory.state import State
from tests.runs import compose


def spec(domain: str) -> DatasetSpec:
    return dataset_spec(compose("simulate", f"data={domain}", "size=tiny"))


def scene(domain: str) -> tuple[State, float]:
    found = spec(domain)
    return initial_state(found, "test", 0), found.scene.spacing


def both(domain: str) -> tuple[State, Resolved]:
    state, spacing = scene(domain)
    return state, coarser(state, spacing)


@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_mass_and_momentum_stay_and_nodes_are_found_again(domain: str) -> None:
    state, other = both(domain)
    assert other.state.num_nodes < state.num_nodes / 2
    assert other.state.mass.sum() == pytest.approx(state.mass.sum(), rel=1e-12)
    momentum, before = (s.mass @ s.vel / s.mass.sum() for s in (other.state, state))
    np.testing.assert_allclose(momentum, before, atol=1e-12 if domain == "sand" else 2e-2)
    np.testing.assert_allclose(other.restrict(other.state.pos), state.pos, atol=1e-12)


@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_nodes_follow_a_motion_of_the_whole_scene(domain: str) -> None:
    state, other = both(domain)
    shift = np.array([0.3, -0.1])
    np.testing.assert_allclose(other.restrict(other.state.pos + shift), state.pos + shift, atol=1e-12)


def test_nodes_of_a_mesh_follow_any_linear_motion() -> None:
    state, other = both("fem")
    stretch = np.array([[1.2, 0.3], [-0.1, 0.9]])
    np.testing.assert_allclose(other.restrict(other.state.pos @ stretch), state.pos @ stretch, atol=1e-12)


def test_materials_are_not_mixed() -> None:
    state, spacing = scene("mixed")
    merged = coarser(state, spacing).state
    for code in np.unique(state.node_type):
        assert merged.mass[merged.node_type == code].sum() == pytest.approx(state.mass[state.node_type == code].sum())


def test_an_outline_has_its_holes() -> None:
    ring = np.array([[0, 1, 4], [1, 5, 4], [1, 2, 5], [2, 6, 5], [2, 3, 6], [3, 7, 6], [3, 0, 7], [0, 4, 7]])  # around a square hole
    assert sorted(sorted(loop) for loop in outline(ring)) == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_other_cells_are_refused() -> None:
    state, spacing = scene("fem")
    from dataclasses import replace

    quads = replace(state, cells=np.array([[0, 1, 2, 3]]))
    with pytest.raises(ValueError, match="only meshes of triangles can be meshed again"):
        coarser(quads, spacing)
    with pytest.raises(
        ValueError, match=r"only meshes of triangles in 2D and of tetrahedra in 3D can be divided; choose data\.scene\.cell=triangle"
    ):
        divided_mesh(quads, 2)


def test_a_mesh_that_is_deformed_keeps_its_resolution() -> None:
    """Dividing it would make its shape of now the undeformed one."""
    state, spacing = scene("fem")
    later = spec("fem").solver.step(state)
    with pytest.raises(ValueError, match=r"the mesh at 0\.002 s is deformed"):
        coarser(later, spacing)
    with pytest.raises(ValueError, match=r"the mesh at 0\.002 s is deformed"):
        divided_mesh(later, 2)


def test_a_divided_mesh_keeps_its_densities() -> None:
    state, _ = scene("fem")
    heavy = state.pos[:, 0] > np.average(state.pos[:, 0], weights=state.mass)
    uneven = replace(state, mass=np.where(heavy, 4.0, 1.0) * state.mass)
    finer = divided_mesh(uneven, 2).state
    assert finer.mass.sum() == pytest.approx(uneven.mass.sum(), rel=1e-12)
    centre, before = (s.mass @ s.pos / s.mass.sum() for s in (finer, uneven))
    even = state.mass @ state.pos / state.mass.sum()
    assert np.linalg.norm(centre - before) < 0.1 * np.linalg.norm(even - before)
