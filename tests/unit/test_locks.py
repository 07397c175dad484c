"""One command at a time writes to a folder."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from filelock import UnixFileLock

from gpe_pl import locks
from gpe_pl.locks import FolderError, held

ROOT = Path(__file__).parents[2]
OTHER = """
import sys
from pathlib import Path
from gpe_pl.locks import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held_elsewhere(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """By another process, until its standard input closes."""
    command = [sys.executable, "-c", OTHER, str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_folder_is_made_held_by_one_process_and_nothing_stays(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "sand"
    with held(folder):
        with held(folder):  # the same process again
            pass
        holder = json.loads((tmp_path / "runs" / ".sand.holder").read_text(encoding="utf-8"))
        assert holder["pid"] == os.getpid() and set(holder) == {"pid", "host", "command", "since"}
        (folder / "result").touch()
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["result", "runs", "sand"]
    with held(tmp_path / "new" / "empty"):
        pass
    assert not (tmp_path / "new").exists()


def test_a_second_command_is_told_who_holds_the_folder(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        with pytest.raises(FolderError, match=rf"a: another command writes to it \(process {process.pid} on .*, since 20.*\); wait"):
            held(tmp_path / "a").__enter__()
        with held(tmp_path / "b"):
            pass
        (tmp_path / "link").symlink_to(tmp_path / "a")
        with pytest.raises(FolderError, match="another command writes to it"):
            held(tmp_path / "link").__enter__()


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        process.kill()
        process.wait()
        assert (tmp_path / ".a.lock").exists()
        with held(tmp_path / "a"):
            pass
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_who_waits_says_so_and_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        assert process.stdin is not None
        threading.Timer(0.5, process.stdin.close).start()
        with held(tmp_path / "a", waits=True):
            assert process.wait() == 0
    assert f"waiting until another command has written it (process {process.pid} on " in caplog.text


def test_processes_of_one_run_share_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", "1")
    with held_elsewhere_as_first(tmp_path / "a"), held(tmp_path / "a"):
        pass


@contextmanager
def held_elsewhere_as_first(folder: Path) -> Iterator[None]:
    rank = os.environ.pop("LOCAL_RANK")
    with held_elsewhere(folder):
        os.environ["LOCAL_RANK"] = rank
        yield


def test_disks_without_locks_have_lock_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a process that has ended on this machine it counts as gone; of another machine nobody can tell."""

    def has_none(_: UnixFileLock) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(UnixFileLock, "_acquire", has_none)
    lock = tmp_path / ".a.lock"
    with held(tmp_path / "a"):
        assert str(os.getpid()) in lock.read_text(encoding="utf-8")
    assert not lock.exists()
    lock.write_text(f"{2**22 + 1}\n{locks.platform.node()}\n", encoding="utf-8")  # no such process
    with held(tmp_path / "a"):
        pass
    lock.write_text("1\nanother-host\n", encoding="utf-8")
    with pytest.raises(FolderError, match=r"; if that process is gone, delete .*\.a\.lock$"):
        held(tmp_path / "a").__enter__()


@pytest.mark.parametrize("ends_with", [None, FileNotFoundError])
def test_a_folder_that_was_deleted_meanwhile_is_an_error(tmp_path: Path, ends_with: type[OSError] | None) -> None:
    with (
        pytest.raises(FolderError, match="a: was deleted or replaced while this command wrote to it; run the command again"),
        held(tmp_path / "a"),
    ):
        shutil.rmtree(tmp_path / "a")
        if ends_with:
            raise ends_with
        (tmp_path / "a").mkdir()  # as whoever writes a file does
        (tmp_path / "a" / "file").touch()


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mine"), held(tmp_path / "a"):
        raise ValueError("mine")
    with pytest.raises(PermissionError), held(tmp_path / "a"):
        raise PermissionError


def test_a_folder_that_cannot_be_made_names_the_key(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file", encoding="utf-8")
    with pytest.raises(FolderError, match=r"runs/a: cannot be made \(Not a directory\); choose another folder with paths\.data=…"):
        held(tmp_path / "runs" / "a", "paths.data").__enter__()


def test_long_names_have_locks_too(tmp_path: Path) -> None:
    with held(tmp_path / ("x" * 255)):
        assert len(list(tmp_path.glob(".*.lock"))) == 1


def test_a_damaged_note_about_the_holder_is_no_obstacle(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a"):
        for text in ("[" * 10**5, '{"pid": 1e999}', "3", "\x00"):
            (tmp_path / ".a.holder").write_text(text, encoding="utf-8")
            with pytest.raises(FolderError, match=r"another command writes to it \(which has just begun\)"):
                held(tmp_path / "a").__enter__()
