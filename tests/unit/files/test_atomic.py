"""A file appears complete or not at all, and no temporary file stays."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import pytest

from gpe_pl.files.atomic import replace_text, replacing

NOBODY = 2**30
"""A number larger than any process number."""


def test_a_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "new" / "numbers.csv"
    with replacing(path) as part:
        part.write_text("1")
        assert part.suffix == ".csv" and part.parent == path.parent and not path.exists()
    assert path.read_text() == "1"
    replace_text(path, "2 µm")
    assert path.read_text(encoding="utf-8") == "2 µm"
    assert list(path.parent.iterdir()) == [path]


def test_what_is_synced_is_open_for_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses to sync a handle that only reads."""
    fcntl = pytest.importorskip("fcntl")
    modes = []
    monkeypatch.setattr(os, "fsync", lambda handle: modes.append(fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE))
    replace_text(tmp_path / "a.json", "{}")
    assert modes == [os.O_RDWR]


def test_a_folder_appears_when_the_block_ends(tmp_path: Path) -> None:
    with replacing(tmp_path / "store") as part:
        part.mkdir()
        (part / "a").write_text("1")
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")] == ["store", "store/a"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("is_folder", [True, False])
def test_an_error_leaves_what_was_there(tmp_path: Path, error: type[BaseException], is_folder: bool) -> None:
    path = tmp_path / "old.json"
    path.write_text("old")
    with pytest.raises(error), replacing(path) as part:
        part.mkdir() if is_folder else part.write_text("new")
        raise error
    assert [p.name for p in tmp_path.iterdir()] == ["old.json"] and path.read_text() == "old"


def test_what_a_killed_process_left_is_removed_and_what_a_running_one_writes_is_not(tmp_path: Path) -> None:
    def part_of(pid: int | str, host: str = platform.node()) -> Path:
        return tmp_path / f".a.{host}.{pid}.part.json"

    running, elsewhere, killed = part_of(os.getppid()), part_of(NOBODY, "another-host"), part_of(NOBODY)
    for path in (running, elsewhere, killed):
        path.write_text("half")
    replace_text(tmp_path / "a.json", "{}")
    assert running.exists() and elsewhere.exists() and not killed.exists()
