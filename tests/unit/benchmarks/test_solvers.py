"""The benchmark of the solvers runs, counts the simulated steps, and names existing data sets."""

from typing import Any

import pytest
from omegaconf import OmegaConf

from gpe_pl.benchmarks.solvers import BenchmarkError, Case, Settings, run, simulate
from gpe_pl.config.datasets import dataset_spec
from tests.runs import compose

TINY = ["size=tiny", "data.sizes.tiny.num_train=3", "data.sizes.tiny.num_frames=5"]


@pytest.mark.slow
def test_every_configured_case_is_a_data_set():
    cases: Any = OmegaConf.to_container(compose("benchmark", "suite=solvers").suite.cases, resolve=True)
    assert {"sand", "snow", "elastomer", "fluid", "fem"} <= set(cases)
    specs = {label: dataset_spec(compose("simulate", *Case(**case).overrides)) for label, case in cases.items()}
    assert all(spec.size == "paper" and sum(spec.counts.values()) == 2700 for spec in specs.values())


def test_counts_nodes_frames_and_substeps():
    spec = dataset_spec(compose("simulate", *TINY, "data=sand"))
    timing = simulate(spec, 1, 3)
    assert (timing.num_frames, timing.num_nodes) == (3, spec.scene.max_nodes) and timing.seconds > 0
    assert 3 * spec.solver.frame_dt / spec.solver.solver_dt <= timing.num_substeps + 3
    assert timing.num_bytes > timing.num_nodes * 4 * 4 * 4 and timing.num_stored_bytes > 0


@pytest.mark.slow
def test_table_has_a_row_per_case():
    settings = Settings({"sand": Case([*TINY, "data=sand"], "10 per minute")}, num_trajectories=2, num_frames=3, num_workers=1)
    records, table = run(settings, {"sand": dataset_spec(compose("simulate", *settings.cases["sand"].overrides))})
    assert {r["metric"] for r in records} >= {"node_substeps_per_second", "trajectories_per_minute", "hours_per_2600_trajectories"}
    assert all(r["value"] > 0 for r in records)
    assert "| sand | 150 |" in table and "| 10 per minute |" in table


def test_a_solver_that_gives_up_is_named():
    spec = dataset_spec(compose("simulate", *TINY, "data=sand", "data.solver.max_substeps=1"))
    with pytest.raises(BenchmarkError, match="sand, training scene 0: frame"):
        simulate(spec, 0, 3)
