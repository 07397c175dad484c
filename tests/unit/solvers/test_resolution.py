"""A scene at another resolution has the same mass and momentum at the same place, and maps back to its original nodes."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.ground_truth import DatasetSpec, initial_state
from gpe_pl.solvers.resolution import Resolved, coarser, finer, outline
from gpe_pl.trajectory.state import State
from tests.runs import compose


def spec(domain: str) -> DatasetSpec:
    return dataset_spec(compose("simulate", f"data={domain}", "size=tiny"))


def scene(domain: str) -> tuple[State, float]:
    found = spec(domain)
    return initial_state(found, "test", 0), found.scene.spacing


def both(domain: str) -> tuple[State, list[Resolved]]:
    state, spacing = scene(domain)
    return state, [finer(state, spacing), coarser(state, spacing)]


@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_mass_and_momentum_stay_and_nodes_are_found_again(domain: str) -> None:
    state, others = both(domain)
    for k, other in enumerate(others):
        assert (other.state.num_nodes > 2 * state.num_nodes) if k == 0 else (other.state.num_nodes < state.num_nodes / 2)
        assert other.state.mass.sum() == pytest.approx(state.mass.sum(), rel=1e-12)
        momentum, before = (s.mass @ s.vel / s.mass.sum() for s in (other.state, state))
        np.testing.assert_allclose(momentum, before, atol=1e-12 if domain == "sand" else 2e-2)
        np.testing.assert_allclose(other.restrict(other.state.pos), state.pos, atol=1e-12)


@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_nodes_follow_a_motion_of_the_whole_scene(domain: str) -> None:
    state, others = both(domain)
    shift = np.array([0.3, -0.1])
    for other in others:
        np.testing.assert_allclose(other.restrict(other.state.pos + shift), state.pos + shift, atol=1e-12)


def test_nodes_of_a_mesh_follow_any_linear_motion() -> None:
    state, others = both("fem")
    stretch = np.array([[1.2, 0.3], [-0.1, 0.9]])
    for other in others:
        np.testing.assert_allclose(other.restrict(other.state.pos @ stretch), state.pos @ stretch, atol=1e-12)


def test_triangles_are_divided_into_four_of_the_same_orientation() -> None:
    state, spacing = scene("fem")
    divided = finer(state, spacing).state
    assert state.cells is not None and divided.cells is not None and len(divided.cells) == 4 * len(state.cells)

    def areas(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
        corners = points[cells]
        return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / 2)

    of_parents = areas(state.pos, state.cells)
    np.testing.assert_allclose(areas(divided.pos, divided.cells).reshape(4, -1), np.tile(of_parents / 4, (4, 1)), rtol=1e-9)


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
    for change in (finer, coarser):
        with pytest.raises(ValueError, match="triangles"):
            change(quads, spacing)


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["sand", "fem"])
def test_the_solver_at_half_the_spacing_does_nearly_the_same(domain: str) -> None:
    """Over a short time before chaos, the solver at another resolution agrees better than ballistic flight does."""
    from dataclasses import replace

    found = spec(domain)
    state, spacing = scene(domain)
    fine = finer(state, spacing)
    solver = found.solver
    fine_solver = replace(solver, grid_spacing=solver.grid_spacing / 2) if domain == "sand" else solver  # type: ignore[attr-defined,type-var]
    normal, refined = state, fine.state
    steps = round(0.15 / solver.frame_dt)
    for _ in range(steps):
        normal, refined = solver.step(normal), fine_solver.step(refined)
    time = steps * solver.frame_dt
    ballistic = state.pos + time * state.vel + state.gravity * time**2 / 2
    error = np.square(fine.restrict(refined.pos) - normal.pos).mean()
    assert error < 0.3 * np.square(ballistic - normal.pos).mean()


def test_a_mesh_that_is_deformed_keeps_its_resolution() -> None:
    """Dividing it would make its shape of now the undeformed one."""
    state, spacing = scene("fem")
    later = spec("fem").solver.step(state)
    for other in (finer, coarser):
        with pytest.raises(ValueError, match=r"the mesh at 0\.002 s is deformed"):
            other(later, spacing)
