"""Variables of Slurm and torchrun: a single process is a run of its own, and numbers of processes that differ are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from lightning.pytorch.utilities import rank_zero_only

from gpe_pl.config.explanations import ConfigError
from gpe_pl.config.fit_run import FitRun
from gpe_pl.fit import fit
from gpe_pl.system.locks import RANKS
from tests.runs import tiny

TASK = {"SLURM_JOB_ID": "1", "SLURM_JOB_NAME": "farm", "SLURM_NTASKS": "4", "SLURM_PROCID": "3", "SLURM_LOCALID": "3", "SLURM_NODEID": "0"}


@pytest.fixture(autouse=True)
def _own_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*RANKS, "WORLD_SIZE", "TORCHELASTIC_RUN_ID", *TASK, "SLURM_NTASKS_PER_NODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rank_zero_only, "rank", 0)


@pytest.mark.slow
@pytest.mark.parametrize("per_node", ["4", None])
def test_a_task_of_slurm_can_be_a_run_of_its_own(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, per_node: str | None
) -> None:
    for name, value in {**TASK, **({} if per_node is None else {"SLURM_NTASKS_PER_NODE": per_node})}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(rank_zero_only, "rank", 3)  # what Lightning takes from the task when it is imported
    cfg = tiny(tiny_data, tmp_path)
    assert fit(cfg) > 0
    assert len(list(tmp_path.rglob("metrics.csv"))) == 2  # of the evaluation, and the log of the training


@pytest.mark.parametrize(
    "launched", [{"TORCHELASTIC_RUN_ID": "1", "WORLD_SIZE": "1", "RANK": "0"}, {**TASK, "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}]
)
def test_a_launcher_that_started_another_number_of_processes_is_named(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launched: dict[str, str]
) -> None:
    for name, value in launched.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(
        ConfigError, match=r"trainer.devices=2, trainer.num_nodes=1: are 2 processes, and torchrun or Slurm started [14]; choose"
    ):
        FitRun(tiny(tiny_data, tmp_path, "trainer.devices=2"), tmp_path)
