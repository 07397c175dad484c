"""Half the time step is half of every substep, also where one substep takes a whole frame."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gpe_pl.benchmarks.half_steps import HalfSteps
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import initial_state
from gpe_pl.rollout.loop import steps


@pytest.mark.parametrize("data", ["sand", "fem", pytest.param("fluid", marks=pytest.mark.slow)])
@pytest.mark.parametrize("is_short", [False, True])
def test_half_the_time_step_is_half_of_every_substep(data: str, is_short: bool) -> None:
    spec = dataset(f"data={data}", "size=tiny")
    solver = replace(spec.solver, frame_dt=1e-6) if is_short else spec.solver  # type: ignore[type-var]
    start = initial_state(spec, "test_unseen", 0)
    whole, halved = (list(steps(simulator, start, 3)) for simulator in (solver, HalfSteps(solver)))
    if is_short:
        assert [state.num_substeps for state in whole] == [1, 1, 1]
    assert sum(state.num_substeps for state in halved) == 2 * sum(state.num_substeps for state in whole)
    assert halved[-1].time == pytest.approx(whole[-1].time)
