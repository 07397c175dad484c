"""Elastomers of which Young's modulus and Poisson's ratio vary, from the solver to the exported program."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.generation import generate
from gpe_pl.data.validate import validate
from gpe_pl.evaluation.metric_rows import read_rows
from gpe_pl.export.program import scene_of
from gpe_pl.fit import fit
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.trajectory.store import iter_trajectories
from tests.programs import exported
from tests.runs import DATA, compose, tiny

RATIOS = (
    "data=elastomer",
    "+data.parameters.elastomer.further.poisson_ratio.seen=[0.2,0.4]",
    "+data.parameters.elastomer.further.poisson_ratio.interpolated=[0.3]",
    "+data.parameters.elastomer.further.poisson_ratio.extrapolated=[0.45]",
)


@pytest.mark.slow
def test_modulus_and_ratio_from_the_solver_to_the_exported_program(tmp_path: Path) -> None:
    folder = generate(tmp_path / "data", dataset_spec(compose("simulate", *DATA, *RATIOS)), 1)
    assert not validate([folder]).violations
    ratios = {split: [t.material_params[0, 1].item() for t in iter_trajectories(folder, split)] for split in ("train", "test_unseen")}
    assert sorted(ratios["train"]) == pytest.approx([0.2, 0.4]) and ratios["test_unseen"] == pytest.approx([0.3, 0.45])

    fit(tiny(tmp_path / "data", tmp_path / "runs", *RATIOS, "model=gpe_tuned", "name=run", "evaluation.splits=[test,test_unseen]"))
    run = tmp_path / "runs" / "run"
    rows = [row for row in read_rows(run / "metrics.csv") if row.metric == "rollout_mse" and row.horizon == "full"]
    assert {row.parameter_group for row in rows} == {"seen", "interpolated", "extrapolated"}
    assert all(2e4 <= row.parameter <= 1e6 for row in rows), "Young's modulus, the first parameter"

    simulator = LearnedSimulator.from_checkpoint(run)
    (trained,) = (values for _, values in simulator.trained_ranges())
    assert trained[:, 1].tolist() == pytest.approx([0.2, 0.4])
    truth = next(iter_trajectories(folder, "test_unseen"))
    state = simulator.initial_state(truth, simulator.builder.config.history)
    exported(simulator, tmp_path / "model.pt2")
    moved, _ = torch.export.load(tmp_path / "model.pt2").module()(scene_of(simulator, state))
    rows_of = simulator.builder(state)["elastomer"].node_id
    torch.testing.assert_close(moved["pos.elastomer"], simulator.step(state).pos[rows_of], rtol=0, atol=1e-8)
