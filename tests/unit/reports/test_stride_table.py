"""Strides are compared at the instants that all of them have, over the trajectories that none of them failed."""

from __future__ import annotations

from pathlib import Path

from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.evaluation.rollout_cost import Timed, read_cost, write_cost
from gpe_pl.files import sealed
from gpe_pl.reports import sweep_table
from gpe_pl.reports.finished_runs import Run, archive, finished_runs, starts_of, table_of
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.trajectory.trajectory import Trajectory


def write_run(
    folder: Path, stride: int, errors: dict[str, list[float]], step: float | None, start_time: float | None = 0.1, on_gpu: bool = False
) -> None:
    folder.mkdir(parents=True)
    config = {
        "seed": 0,
        "data": {"name": "sand", "stride": stride, "solver": {"frame_dt": 0.005}},
        "model": {"_target_": "gpe_pl.models.gpe.GPE"},
        "graph": {"history": 5},
        "training": {"num_steps": 10},
        "evaluation": {"start_time": start_time},
    }
    sealed.write(folder / "config.json", config)
    rows = [Row(LEARNED, "test", k, "seen", 20.0, "final_mse", h, v) for h, values in errors.items() for k, v in enumerate(values)]
    rows += [Row(LEARNED, "test", k, "seen", 20.0, "rollout_mse", "full", 1.0) for k in range(3)]
    rows += [Row(LEARNED, "test", k, "seen", 20.0, "edges_per_node", "full", 10.0 * stride) for k in range(3)]
    write_rows(folder / "metrics.csv", rows)
    if step is not None:
        seconds = [9.0, *[step] * 19, *[0.5 * step, 1.5 * step] * 30]  # the first step compiles; others skip their work or do not
        write_cost(folder, seconds, 0.005 * stride, on_gpu)


def test_a_sweep_over_strides_has_a_table_of_instants_and_costs(tmp_path: Path) -> None:
    inf = float("inf")
    write_run(tmp_path / "1", 1, {"0.02s": [1.0] * 3, "0.025s": [1.0] * 3, "0.1s": [2e-3, 4e-3, 9e-3], "full": [1.0] * 3}, step=0.004)
    write_run(tmp_path / "4", 4, {"0.02s": [1.0] * 3, "0.1s": [1e-3, 2e-3, inf], "full": [1.0, 1.0, inf]}, step=0.005)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    lines = (tmp_path / "table.md").read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if "cost [s/s]" in line)
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start : start + 4] if "---" not in line]
    assert table[0] == ["stride", "split", "at 0.02s", "at 0.1s", "failed", "cost [s/s]", "edges per node"]
    assert table[1] == ["1", "test", "1e+03", "4", "0 of 3", "0.8", "10.0"]
    assert lines[start:] == (tmp_path / "strides.md").read_text().splitlines()
    assert table[2] == ["4", "test", "1e+03 (×1.00 [1.00, 1.00])", "2 (×0.50 [0.50, 0.50])", "1 of 3", "0.25 (×0.31)", "40.0"]


def test_an_archive_keeps_the_costs(tmp_path: Path) -> None:
    for stride in (1, 4):
        write_run(tmp_path / "runs" / str(stride), stride, {"0.1s": [1e-3, 2e-3], "full": [1.0, 1.0]}, step=0.004)
    runs = finished_runs(tmp_path / "runs")
    (tmp_path / "kept").mkdir()
    archive(runs, tmp_path / "runs", tmp_path / "kept")
    for folder in ("runs", "kept"):
        sweep_table.report_sweep(tmp_path / folder, finished_runs(tmp_path / folder))
    tables = [(tmp_path / folder / "strides.md").read_text() for folder in ("runs", "kept")]
    assert tables[0] == tables[1] and "0.8" in tables[0]


def test_costs_of_cpus_and_gpus_are_not_compared(tmp_path: Path) -> None:
    for stride, on_gpu in ((1, False), (2, True), (4, False)):
        write_run(tmp_path / "runs" / str(stride), stride, {"0.1s": [1e-3, 2e-3], "full": [1.0, 1.0]}, step=0.004, on_gpu=on_gpu)
    runs = finished_runs(tmp_path / "runs")
    (tmp_path / "kept").mkdir()
    archive(runs, tmp_path / "runs", tmp_path / "kept")
    for folder in ("runs", "kept"):
        sweep_table.report_sweep(tmp_path / folder, finished_runs(tmp_path / folder))
        costs = [line.split("|")[-3].strip() for line in (tmp_path / folder / "strides.md").read_text().splitlines()[2:5]]
        assert costs == ["0.8", "0.4 on a GPU", "0.2 (×0.25)"]


def test_rollouts_that_start_at_different_times_are_not_compared(tmp_path: Path) -> None:
    for stride in (1, 4):
        write_run(tmp_path / str(stride), stride, {"0.1s": [1e-3, 2e-3], "full": [1.0, 1.0]}, step=0.004, start_time=None)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    strides, table = ((tmp_path / name).read_text() for name in ("strides.md", "table.md"))
    assert "1.5" in strides and "(×1.00 [" not in strides
    for text in (strides, table):
        assert "**Rollouts start at different times (0.025 s, 0.1 s), so their errors are of different parts of the scenes" in text
    for stride in (1, 4):
        write_run(tmp_path / "same" / str(stride), stride, {"0.1s": [1e-3, 2e-3], "full": [1.0, 1.0]}, step=0.004)
    sweep_table.report_sweep(tmp_path / "same", finished_runs(tmp_path / "same"))
    assert "(×1.00 [" in (tmp_path / "same" / "strides.md").read_text()
    assert "different times" not in (tmp_path / "same" / "table.md").read_text()


def test_what_was_not_measured_is_said(tmp_path: Path) -> None:
    for stride in (1, 2):
        write_run(tmp_path / str(stride), stride, {"0.1s": [1e-3], "full": [1e-3]}, step=None)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    assert (tmp_path / "table.md").read_text().count("not measured") == 2
    assert read_cost(tmp_path / "1") is None


def test_other_sweeps_have_no_such_table(tmp_path: Path) -> None:
    write_run(tmp_path / "1", 2, {"0.1s": [1e-3], "full": [1e-3]}, step=0.1)
    sweep_table.report_sweep(tmp_path, finished_runs(tmp_path))
    assert "cost [s/s]" not in (tmp_path / "table.md").read_text()


def test_a_timed_simulator_makes_the_same_steps(trajectory: Trajectory) -> None:
    timed, state = Timed(ConstantVelocity(0.01)), trajectory.state(0)
    alone, together = timed.step(state), timed.step_all([state, trajectory.state(1)])
    assert (alone.pos == ConstantVelocity(0.01).step(state).pos).all()
    assert len(timed.seconds) == 3 and min(timed.seconds) >= 0
    assert (together[0].pos == alone.pos).all()  # type: ignore[union-attr]


def test_starts_are_counted_in_frames_of_the_evaluation() -> None:
    """Scenes of the evaluation can have longer frames than those of the training."""

    def start(**of_evaluation: float) -> list[str]:
        config = {"graph.history": 2, "data.stride": 1, "data.solver.frame_dt": 0.0025}
        config |= {f"evaluation.data.{key.replace('__', '.')}": value for key, value in of_evaluation.items()}
        return starts_of([Run(Path(), config, table_of([]))])

    assert start() == ["0.005 s"]
    assert start(stride=4) == ["0.02 s"]
    assert start(stride=4, solver__frame_dt=0.01) == ["0.08 s"]
