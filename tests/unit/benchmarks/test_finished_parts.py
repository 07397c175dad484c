"""Finished parts are found by everything that their records depend on."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.benchmarks import finished_parts
from gpe_pl.benchmarks.finished_parts import FinishedParts
from gpe_pl.files.sealed import SealError


def test_a_part_is_found_by_its_whole_identity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = FinishedParts(tmp_path / "parts")
    assert parts.get({"test": 1}) is None
    parts.put({"test": 1, "values": (0.5, 2)}, [{"measured": 3.0}])
    assert parts.get({"values": [0.5, 2], "test": 1}) == [{"measured": 3.0}]
    assert parts.get({"test": 2, "values": (0.5, 2)}) is None
    monkeypatch.setattr(finished_parts, "_code", lambda: "later code")
    assert parts.get({"test": 1, "values": (0.5, 2)}) is None


def test_a_damaged_part_is_refused_and_cleared(tmp_path: Path) -> None:
    parts = FinishedParts(tmp_path / "parts")
    parts.put({"test": 1}, [{"measured": 3}])
    (file,) = parts.folder.iterdir()
    file.write_text(file.read_text().replace("3", "4"))
    with pytest.raises(SealError, match="delete it; the part is then measured again"):
        parts.get({"test": 1})
    parts.clear()
    assert parts.get({"test": 1}) is None and not parts.folder.exists()


def test_code_without_a_commit_of_its_own_is_known_by_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.py").write_text("LIMIT = 0.01")
    monkeypatch.setattr(finished_parts, "PACKAGE", tmp_path)
    found = []
    for name in ("2d7fb3a", "2d7fb3a-dirty", "unknown"):
        monkeypatch.setattr(finished_parts, "commit", lambda name=name: name)
        for text in ("LIMIT = 0.01", "LIMIT = 0.5"):
            (tmp_path / "a.py").write_text(text)
            found.append(finished_parts._code.__wrapped__())
    assert found[:2] == ["2d7fb3a", "2d7fb3a"]
    assert len(set(found)) == 5
