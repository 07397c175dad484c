"""Provenance that commands store about their results."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.system.provenance import PROVENANCE, recorded, sessions, shown


def test_every_session_is_noted_however_it_ends(tmp_path: Path) -> None:
    with recorded(tmp_path, "fit", ["seed=1"], "runs"):
        (tmp_path / "config.json").touch()
    with pytest.raises(KeyError), recorded(tmp_path, "fit", ["seed=1", "trainer=gpu"], "runs"):
        raise KeyError
    first, second = sessions(tmp_path)
    assert (first["command"], second["command"]) == ("python -m gpe_pl.fit seed=1", "python -m gpe_pl.fit seed=1 trainer=gpu")
    assert {"began", "seconds", "commit", "processor", "python", "packages"} <= set(first)
    assert first["packages"]["torch"] and first["seconds"] >= 0


def test_a_folder_without_results_stays_as_it_is(tmp_path: Path) -> None:
    with recorded(tmp_path, "fit", [], "runs"):
        (tmp_path / ".hydra").mkdir()
    assert not (tmp_path / PROVENANCE).exists()


def test_a_command_is_shown_without_the_folders_of_one_machine() -> None:
    arguments = ["-m", "name=a b", "paths.runs=/home/me/runs", "+paths.data=/data", "checkpoint=/home/me/runs/sand", "hydra.sweep.dir=/x"]
    assert shown("fit", arguments, "/home/me/runs") == "python -m gpe_pl.fit -m 'name=a b' checkpoint=paths.runs/sand"
    assert shown("docs/active_curve.py", ["FOLDER"], "/home/me/runs") == "python docs/active_curve.py FOLDER"


def test_only_paths_are_replaced_where_the_folder_has_a_common_name() -> None:
    arguments = ["suite.runs=[runs/table1,other/runs]", "num_runs=3", "checkpoint=runs/sand", "name=reruns"]
    expected = "'suite.runs=[paths.runs/table1,other/runs]' num_runs=3 checkpoint=paths.runs/sand name=reruns"
    assert shown("fit", arguments, "runs") == f"python -m gpe_pl.fit {expected}"


def test_a_damaged_file_does_not_end_the_command(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / PROVENANCE).write_text("{")
    with recorded(tmp_path, "fit", [], "runs"):
        (tmp_path / "metrics.csv").touch()
    assert "provenance of these results was not recorded" in caplog.text
    assert (tmp_path / PROVENANCE).read_text() == "{"
