"""A file appears complete or not at all, and no temporary file stays."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import pytest

from gpe_pl.files.atomic import machine_name, replace_text, replacing
from gpe_pl.system.locks import locked

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
    def part_of(pid: int | str, host: str = machine_name()) -> Path:
        return tmp_path / f".a.{host}.{pid}-00.part.json"

    running, elsewhere, killed = part_of(os.getppid()), part_of(NOBODY, "another-host"), part_of(NOBODY)
    for path in (running, elsewhere, killed):
        path.write_text("half")
    replace_text(tmp_path / "a.json", "{}")
    assert running.exists() and elsewhere.exists() and not killed.exists()


def test_a_process_with_the_id_of_a_killed_one_does_not_write_into_what_that_one_left(tmp_path: Path) -> None:
    """Ids repeat in containers, which all begin to count at 1."""
    seen = []
    for _ in range(2):
        with replacing(tmp_path / "store") as part:
            part.mkdir()  # fails if it is there
            seen.append(part.name)
    assert len(set(seen)) == 2


def test_names_are_as_long_as_the_file_system_allows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "node", lambda: "ip-10-0-112-134.eu-central-1.compute.internal")
    for length in (204, 250):
        replace_text(tmp_path / ("a" * length + ".json"), "{}")
    with locked(tmp_path / ("b" * 255)):
        pass
    assert sorted(len(p.stem) for p in tmp_path.iterdir()) == [204, 250]


def test_machines_and_containers_have_different_names(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {machine_name()}
    monkeypatch.setattr(os, "readlink", lambda path: "pid:[1]")
    names.add(machine_name())
    monkeypatch.setattr(platform, "node", lambda: "another")
    names.add(machine_name())

    def fails(path: str) -> str:
        raise OSError(path)

    monkeypatch.setattr(os, "readlink", fails)
    names.add(machine_name())
    assert len(names) == 4
