"""Tracers of a finer solution begin as the nodes of the scene, carry its mass, and move with the finer solution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec, initial_state
from gpe_pl.rollout.loop import SimulationError, steps
from gpe_pl.solvers.finer_solver import FinerSolver
from gpe_pl.solvers.resolution import MARKER, Divided
from gpe_pl.trajectory.state import State

SCENES = {
    "sand": ["data=sand"],
    "elastomer": ["data=elastomer"],
    "mixed": ["data=mixed"],
    "fluid in 3D": ["data=fluid"],
    "fem": ["data=fem"],
    "fem in 3D": ["data=fem", "dimension=3"],
}


def spec_of(name: str, fine: int) -> DatasetSpec:
    return dataset(*SCENES[name], "size=tiny", f"data.fine={fine}")


def started(name: str, fine: int) -> tuple[State, Divided]:
    """Return the start of a scene and of its finer solution."""
    spec = spec_of(name, fine)
    state = initial_state(spec, "train", 0)
    solver: Any = spec.label_solver
    return state, solver.solution(state)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("fine", [2, 4])
def test_the_finer_solution_begins_as_the_scene(name: str, fine: int) -> None:
    state, solution = started(name, fine)
    begun, count = solution.state, state.num_nodes
    np.testing.assert_array_equal(begun.pos[:count], state.pos)
    np.testing.assert_array_equal(begun.vel[:count], state.vel)
    # the masses of the particles into which a node was divided add up to its own
    np.testing.assert_allclose(solution.origin.T @ begun.mass, state.mass, rtol=1e-13)
    np.testing.assert_allclose(begun.mass @ begun.vel, state.mass @ state.vel, atol=1e-12 * state.mass.sum())
    np.testing.assert_allclose(begun.mass @ begun.pos, state.mass @ state.pos, rtol=1e-12)
    parts = fine**state.dim
    if "fem" in name:
        assert state.cells is not None and begun.cells is not None
        assert len(begun.cells) == parts * len(state.cells)
    else:
        assert begun.num_nodes == (1 + parts) * count
    np.testing.assert_array_equal(begun.material_params[:count], state.material_params)
    own, values = (np.unique(np.nan_to_num(s.material_params, nan=-1.0), axis=0) for s in (begun, state))
    np.testing.assert_array_equal(own, values)


@pytest.mark.parametrize("name", ["fem", "fem in 3D"])
def test_parts_of_a_cell_have_its_orientation_and_equal_volumes(name: str) -> None:
    state, solution = started(name, 2)
    assert state.cells is not None and solution.state.cells is not None

    def volumes(pos: np.ndarray, cells: np.ndarray) -> np.ndarray:
        corners = pos[cells]
        return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))

    whole, parts = volumes(state.pos, state.cells), volumes(solution.state.pos, solution.state.cells)
    num_parts = 2**state.dim
    np.testing.assert_allclose(parts.reshape(num_parts, -1), np.tile(whole / num_parts, (num_parts, 1)), rtol=1e-9)


def test_parts_of_an_elastic_body_continue_its_lattice() -> None:
    """The nearest two particles are at half the spacing, although the body is turned."""
    from scipy.spatial import cKDTree

    state, solution = started("elastomer", 2)
    parts = solution.state.pos[state.num_nodes :]
    near = cKDTree(parts).query(parts, 3)[0][:, 1:]
    np.testing.assert_allclose(near, spec_of("elastomer", 2).scene.spacing / 2, rtol=1e-6)


def test_tracers_do_not_act_on_the_finer_solution() -> None:
    spec = spec_of("sand", 2)
    state = initial_state(spec, "train", 0)
    traced: Any = spec.label_solver
    with_tracers = list(steps(traced, state, 20))[-1]
    begun = traced.solution(state).state
    parts = np.arange(state.num_nodes, begun.num_nodes)
    alone = replace(begun.take(parts), mass=begun.mass[parts] / (1 - MARKER))
    without = list(steps(traced.solver, alone, 20))[-1]
    np.testing.assert_allclose(with_tracers.internal.state.pos[parts], without.pos, atol=1e-6)
    assert np.abs(without.pos - alone.pos).max() > 0.05


def test_tracers_stay_among_the_particles_around_them() -> None:
    """In an elastic body, a tracer keeps the middle of the particles into which its node was divided."""
    spec = spec_of("elastomer", 2)
    state = list(steps(spec.label_solver, initial_state(spec, "train", 0), 60))[-1]
    parts = state.internal.state.pos[state.num_nodes :].reshape(state.num_nodes, -1, 2).mean(axis=1)
    assert np.abs(parts - state.pos).max() < 0.1 * spec.scene.spacing


def test_stress_of_a_cell_is_the_mean_of_its_parts() -> None:
    spec = spec_of("fem", 2)
    state = list(steps(spec.label_solver, initial_state(spec, "train", 0), 60))[-1]
    fine: State = state.internal.state
    assert state.stress is not None and fine.stress is not None and state.cells is not None and fine.cells is not None
    assert np.abs(state.stress.cell).max() > 0
    # the parts of a cell, found by the positions of their corners at rest
    assert state.rest_pos is not None and fine.rest_pos is not None
    for cell in (0, 57, len(state.cells) - 1):
        corners = state.rest_pos[state.cells[cell]]
        weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), np.vstack([fine.rest_pos.T, np.ones(fine.num_nodes)]))
        within = np.all(weights > -1e-9, axis=0)
        parts = np.all(within[fine.cells], axis=1)
        assert parts.sum() == 4
        np.testing.assert_allclose(state.stress.cell[cell], fine.stress.cell[parts].mean(axis=0), rtol=1e-12)
    plain = spec.solver.step(replace(state, internal=None))
    zero = replace(state, stress=None)
    around = [k for k, cell in enumerate(zero.cells) if 0 in cell]  # type: ignore[arg-type]
    assert plain.stress is not None and plain.stress.node.shape == state.stress.node.shape
    low, high = state.stress.cell[around].min(axis=0), state.stress.cell[around].max(axis=0)
    assert np.all((low - 1e-6 <= state.stress.node[0]) & (state.stress.node[0] <= high + 1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sand", *(pytest.param(name, marks=pytest.mark.long) for name in ("elastomer", "fem"))])
def test_tracers_are_nearer_to_a_solution_finer_still(name: str) -> None:
    """Until 0.15 s, on average over nodes and four scenes."""
    spec = spec_of(name, 2)
    near, far = 0.0, 0.0
    num_steps = round(0.15 / spec.solver.frame_dt)
    for index in range(4):
        start = initial_state(spec, "test", index)
        own, tracers, finest = ([*steps(spec.refined(k), start, num_steps)][-1].pos for k in (1, 2, 4))
        near, far = near + np.square(tracers - finest).mean(), far + np.square(own - finest).mean()
    assert near < 0.5 * far


def test_other_parameters_reach_the_particles() -> None:
    spec = spec_of("elastomer", 2)
    start = initial_state(spec, "train", 0)
    *_, state = steps(spec.label_solver, start, 30)
    stiff = replace(state, material_params=10 * state.material_params)
    own, other = spec.label_solver.step(state), spec.label_solver.step(stiff)
    assert np.all(other.internal.state.material_params == 10 * own.internal.state.material_params)
    assert np.abs(own.pos - other.pos).max() > 1e-6


def test_states_without_their_finer_solution_are_refused() -> None:
    spec = spec_of("sand", 2)
    state = spec.label_solver.step(initial_state(spec, "train", 0))
    refused = {
        r"the finer solution of the state at 0\.005 s is not known; start at frame 0": replace(state, internal=None),
        r"nodes at 0\.005 s were moved, which the finer solution does not contain": replace(state, pos=state.pos + 1e-6),
    }
    for message, wrong in refused.items():
        with pytest.raises(SimulationError, match=message) as failure:
            spec.label_solver.step(wrong)
        assert failure.value.reason == "input"


def test_an_error_names_the_node_of_the_scene() -> None:
    spec = spec_of("sand", 2)
    start = initial_state(spec, "train", 0)
    solver: Any = spec.label_solver
    fast = replace(start, vel=np.where(np.arange(start.num_nodes)[:, None] == 7, 1e6, start.vel))
    with pytest.raises(SimulationError, match="in the solution at 1/2 of the spacing: node ") as failure:
        solver.step(fast)
    assert failure.value.node == 7 and failure.value.reason == "explosion"


def test_the_solver_of_a_finer_spacing() -> None:
    spec: Any = spec_of("sand", 4)
    assert isinstance(spec.label_solver, FinerSolver)
    assert spec.label_solver.solver.grid_spacing == spec.solver.grid_spacing / 4
    assert spec.label_solver.solver_dt < spec.solver.solver_dt / 2 and spec.label_solver.frame_dt == spec.solver.frame_dt
