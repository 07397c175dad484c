"""Archives of runs in two small files: their tables equal those of the runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gpe_pl.files import sealed
from gpe_pl.reports import domain_table
from gpe_pl.reports.finished_runs import archive, finished_runs
from gpe_pl.reports.run_archive import COLUMNS, ROLLOUTS, RUNS, ArchiveError, read_archive, write_archive
from gpe_pl.reports.tables import write_tables
from tests.unit.reports.test_domain_table import write_run


@pytest.fixture
def archived(tmp_path: Path) -> Path:
    write_run(tmp_path / "runs" / "a", "sand", "GPE", 0, [1e-3, 3e-3])
    write_run(tmp_path / "runs" / "b", "sand", "GNS", 0, [4e-3, float("inf")], checksum="2")
    folder = tmp_path / "kept"
    folder.mkdir()
    archive(finished_runs(tmp_path / "runs"), tmp_path / "runs", folder)
    return folder


def test_tables_from_an_archive_are_those_of_the_runs(archived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain_table, "_figures", lambda *_: None)
    write_tables(tmp_path / "runs", finished_runs(tmp_path / "runs"))
    write_tables(archived, finished_runs(archived))
    for name in ("table1.md", "table1_ratios.md", "table1.csv"):
        assert (archived / name).read_text() == (tmp_path / "runs" / name).read_text()


def test_an_archive_has_what_the_runs_had(archived: Path, tmp_path: Path) -> None:
    for run, kept in zip(finished_runs(tmp_path / "runs"), finished_runs(archived), strict=True):
        assert (run.config, run.data, run.folder.name) == (kept.config, kept.data, kept.folder.name)
        keys = ["model", "split", "trajectory", "metric", "horizon"]
        pd.testing.assert_frame_equal(*(frame.sort_values(keys, ignore_index=True) for frame in (run.rows, kept.rows)), rtol=5e-5)


def test_a_value_that_is_no_number_stays_and_a_missing_one_stays_missing(tmp_path: Path) -> None:
    lines = [
        ["learned", "test", k, "", np.nan, metric, "full", value]
        for k, metric, value in ((0, "a", np.nan), (0, "b", np.inf), (1, "a", 1 / 3))
    ]
    rows = pd.DataFrame(lines, columns=COLUMNS)
    write_archive(tmp_path, {"x": {}}, {"x": rows})
    pd.testing.assert_frame_equal(read_archive(tmp_path)[1]["x"], rows, rtol=5e-5)


@pytest.mark.parametrize("name", [RUNS, ROLLOUTS])
def test_damage_is_told(archived: Path, name: str) -> None:
    content = bytearray((archived / name).read_bytes())
    content[len(content) // 2] ^= 4
    (archived / name).write_bytes(content)
    with pytest.raises(ArchiveError, match=name):
        finished_runs(archived)
    (archived / name).unlink()
    if name == ROLLOUTS:
        with pytest.raises(ArchiveError, match=ROLLOUTS):
            finished_runs(archived)


def test_an_archive_that_unpacks_to_gigabytes_is_refused(archived: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.reports.run_archive.MOST_BYTES", 100)
    with pytest.raises(ArchiveError, match="more than 100 bytes"):
        finished_runs(archived)


def test_what_several_runs_share_is_said_once_and_read_for_each(tmp_path: Path) -> None:
    runs = {"a": {"all": 1, "some": [1, 2]}, "b": {"all": 1, "some": [1, 2], "one": None}, "c": {"all": 1, "some": [2]}}
    rows = pd.DataFrame([["learned", "test", 0, "", np.nan, "x", "full", 1.0]], columns=COLUMNS)
    write_archive(tmp_path, runs, dict.fromkeys(runs, rows))
    about = json.loads((tmp_path / RUNS).read_text())
    assert about["shared"] == [{"runs": ["a", "b"], "values": {"some": [1, 2]}}]
    assert about["common"] == {"all": 1} and about["runs"] == {"a": {}, "b": {"one": None}, "c": {"some": [2]}}
    assert read_archive(tmp_path)[0] == runs


def test_an_archive_without_shared_values_is_read(archived: Path) -> None:
    """Archives of earlier versions repeat what several runs share."""
    about = json.loads((archived / RUNS).read_text())
    expected = read_archive(archived)[0]
    del about["shared"], about[sealed.SEAL]
    sealed.write(archived / RUNS, about)
    assert read_archive(archived)[0] == expected


def test_what_runs_have_in_common_is_said_once(archived: Path) -> None:
    about = json.loads((archived / RUNS).read_text())
    assert sealed.SEAL in about
    assert about["common"]["config:training.num_steps"] == 1000 and about["common"]["validation_steps"] == []
    assert {name: run["config:model._target_"] for name, run in about["runs"].items()} == {
        "a": "gpe_pl.models.x.GPE",
        "b": "gpe_pl.models.x.GNS",
    }


def test_runs_that_finished_beside_an_archive_join_its_runs(archived: Path, tmp_path: Path) -> None:
    write_run(archived / "c", "sand", "DPINet", 0, [2e-3, 2e-3])
    assert [run.folder.name for run in finished_runs(archived)] == ["a", "b", "c"]


def test_a_run_in_its_folder_replaces_itself_in_the_archive(archived: Path, tmp_path: Path) -> None:
    write_run(archived / "a", "sand", "GPE", 0, [7e-3, 7e-3])
    runs = finished_runs(archived)
    assert [run.folder.name for run in runs] == ["a", "b"]
    assert 7e-3 in runs[0].rows["value"].tolist() and runs[0].curve is None
