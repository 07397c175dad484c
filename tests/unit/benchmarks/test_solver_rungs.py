"""Cheaper variants of a solver."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpe_pl.benchmarks.solver_rungs import DATA, NODES, rungs, softer, with_longer_steps
from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.ground_truth import DatasetSpec, initial_state
from gpe_pl.solvers.finer_solver import FinerSolver
from tests.runs import compose


def spec_of(*overrides: str) -> DatasetSpec:
    return dataset_spec(compose("simulate", "size=tiny", *overrides))


def test_solvers_on_a_grid_have_longer_steps_up_to_a_cell() -> None:
    solver = spec_of("data=sand").solver
    longer = with_longer_steps(solver, 4)
    assert longer is not None
    assert (longer.frame_dt, longer.cfl) == (4 * solver.frame_dt, 1.0)
    assert with_longer_steps(spec_of("data=fem").solver, 4) is None


def test_softer_materials_allow_longer_substeps() -> None:
    for data in ("sand", "snow"):
        spec = spec_of(f"data={data}")
        soft = softer(spec.solver, 4.0)
        assert soft is not None
        assert np.isclose(soft.solver_dt, min(soft.frame_dt, 2 * spec.solver.solver_dt))
        state = initial_state(spec, "test", 0)
        assert soft.step(state).num_substeps < spec.solver.step(state).num_substeps


def test_moduli_that_the_data_give_stay_as_they_are() -> None:
    assert softer(spec_of("data=elastomer").solver, 4.0) is None
    assert softer(spec_of("data=fem").solver, 4.0) is None
    solver: Any = spec_of("data=mixed").solver
    mixed = softer(solver, 4.0)
    assert mixed is not None and mixed.elastomer == solver.elastomer


def test_every_combination_is_a_rung() -> None:
    spec = spec_of("data=sand")
    solver: Any = spec.solver
    found = {rung.name: rung for rung in rungs(spec, initial_state(spec, "test", 0), [2.0], [4], [4.0])}
    changes = ["", ", steps × 4", ", moduli ÷ 4", ", moduli ÷ 4, steps × 4"]
    assert [*found] == [DATA, *(f"solver{c}" for c in changes[1:]), *(f"solver, spacing × 2{c}" for c in changes)]
    last = found["solver, spacing × 2, moduli ÷ 4, steps × 4"]
    assert last.frames_per_step == 4 and last.start.state.num_nodes < found[DATA].start.state.num_nodes
    assert (last.solver.sand.youngs_modulus, last.solver.cfl) == (solver.sand.youngs_modulus / 4, 1.0)


def test_a_finer_solver_has_cheaper_variants_of_its_own() -> None:
    spec = spec_of("data=sand", "data.fine=2")
    solver: Any = spec.solver
    start = initial_state(spec, "test", 0)
    found = {rung.name: rung for rung in rungs(spec, start, [], [2], [4.0])}
    changes = ["", ", steps × 2", ", moduli ÷ 4", ", moduli ÷ 4, steps × 2"]
    assert [*found] == [*(f"{DATA}{c}" for c in changes), *(f"{NODES}{c}" for c in changes)]
    longer = found[f"{DATA}, moduli ÷ 4, steps × 2"].solver
    assert isinstance(longer, FinerSolver) and longer.frame_dt == 2 * spec.solver.frame_dt
    assert longer.solver.sand.youngs_modulus == solver.sand.youngs_modulus / 4
    assert longer.step(start).num_nodes == start.num_nodes
