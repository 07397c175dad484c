"""The suite compares labels with a solution that is finer still, at equal times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.benchmarks import finer_labels
from gpe_pl.benchmarks.finer_labels import COARSE, MEAN, PART, TRACERS, LabelsError, Settings, report, run, scene_records
from gpe_pl.benchmarks.trained import Case
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import initial_state
from gpe_pl.rollout.loop import SimulationError, steps


@pytest.mark.slow
def test_distances_are_those_of_the_solutions_at_the_given_times() -> None:
    spec = dataset("data=elastomer", "size=tiny")
    records = scene_records(spec, "elastomer", "test", 1, [0.05, 0.1])
    squared = {r["labels"]: r["values"] for r in records if r["metric"] == "squared_distance"}
    start = initial_state(spec, "test", 1)
    own, half, reference = ([*steps(spec.refined(k), start, 20)] for k in (1, 2, 4))
    for name, states in ((COARSE, own), (TRACERS, half)):
        for k, frame in enumerate((10, 20)):
            wanted = np.square(states[frame - 1].pos - reference[frame - 1].pos).sum(axis=1).mean()
            assert squared[name][k] == pytest.approx(wanted, rel=1e-9)
    assert squared[TRACERS][1] < 0.5 * squared[COARSE][1]
    # an elastic body does not tear its parts apart
    assert squared[MEAN] == pytest.approx(squared[TRACERS], rel=0.2)
    momentum = {r["labels"]: r["values"] for r in records if r["metric"] == "momentum"}
    assert {*momentum} == {TRACERS, PART} and momentum[TRACERS][1] < momentum[PART][1]
    assert [r["factor"] for r in records if r["metric"] == "seconds"] == [1, 2, 4]


def test_the_report_has_ratios_of_root_mean_squares() -> None:
    def record(labels: str, scene: int, values: list[float], metric: str = "squared_distance") -> dict[str, object]:
        return {"case": "sand", "scene": scene, "metric": metric, "labels": labels, "times": [0.05, 0.1], "values": values}

    records = [record(COARSE, k, [1e-20, 4e-6]) for k in range(2)] + [record(TRACERS, k, [1e-20, 1e-6]) for k in range(2)]
    records += [{"case": "sand", "scene": k, "metric": "seconds", "factor": f, "values": [float(f)]} for k in range(2) for f in (1, 2, 4)]
    records += [record(TRACERS, k, [0.0, 3e-3], "momentum") for k in range(2)]
    table = report(records)
    assert "| sand | both in free flight | 0.50 [0.50, 0.50] | 1 | 2 | 4 |" in table
    assert f"| sand | {COARSE} | 1e-07 | 2 |" in table and f"| sand | {TRACERS} | 0 | 3 |" in table


def test_too_few_scenes_and_failed_solutions_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = dataset("data=sand", "size=tiny")
    settings = Settings({"sand": Case(["data=sand"])}, num_scenes=7)
    with pytest.raises(LabelsError, match=r"suite\.cases\.sand: test has 6 scenes; lower suite\.num_scenes"):
        run(settings, {"sand": spec})

    def fails(*_: object) -> None:
        raise SimulationError("node 3 is not finite")

    monkeypatch.setattr(finer_labels, "solved", fails)
    with pytest.raises(LabelsError, match="sand, scene 0 of test: node 3 is not finite"):
        run(replace(settings, num_scenes=1), {"sand": spec})


def test_times_must_ascend() -> None:
    """The solutions are kept in the order of their frames."""
    with pytest.raises(ValueError, match=r"times=\[0.2, 0.05\]: must ascend"):
        Settings({"elastomer": Case([])}, times=[0.2, 0.05])
