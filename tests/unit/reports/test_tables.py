"""``python -m gpe_pl.reports`` makes the tables of finished runs again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gpe_pl.reports import domain_table
from gpe_pl.reports.tables import main
from gpe_pl.system.locks import locked
from tests.unit.reports.test_domain_table import write_run


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(domain_table, "_figures", lambda *_: None)
    write_run(tmp_path / "runs" / "a", "sand", "GPE", 0, [1e-3, 3e-3])
    write_run(tmp_path / "runs" / "b", "sand", "GNS", 0, [4e-3, float("inf")])
    return tmp_path / "runs"


def test_tables_follow_the_runs_that_are_there(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(sweep)]) == 0
    first = (sweep / "table1.md").read_text()
    assert capsys.readouterr().out.strip() == first.strip()
    (sweep / "table1.md").write_text("of other rules")
    (sweep / "table1_ratios.md").unlink()
    assert main([str(sweep)]) == 0
    assert (sweep / "table1.md").read_text() == first
    assert (sweep / "table1_ratios.md").exists()


def test_a_folder_without_runs_is_refused_and_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "table1.md").write_text("of runs that are gone")
    assert main([str(tmp_path)]) == 2
    assert (
        capsys.readouterr().err
        == f"error: {tmp_path}: contains no finished run (a folder with config.json and metrics.csv); give the folder of a sweep or run\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["table1.md"]


def test_models_on_different_data_of_one_name_do_not_compare(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(sweep / "c", "sand", "DPINet", 0, [1e-3, 1e-3], checksum="2")
    write_run(sweep / "d", "sand", "ContinuousConvNet", 0, [1e-3, 1e-3], checksum="3")
    assert main([str(sweep)]) == 2
    assert "models on sand were trained or evaluated on different data (data_sha256.train) and do not compare" in capsys.readouterr().err
    assert not (sweep / "table1.md").exists()


@pytest.mark.slow
def test_it_is_a_command(sweep: Path) -> None:
    command = [sys.executable, "-m", "gpe_pl.reports", str(sweep)]
    with locked(sweep):
        result = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert result.returncode == 2 and result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
